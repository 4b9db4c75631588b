"""Figures; matplotlib is imported when one is drawn.

`figures` draws wall, events, surfaces and reconstructions, and films of them over time; `setup` draws the setup
to scale; `preview` and `event_views` show events without matplotlib; `results` belongs to the commands.
"""

__all__: list[str] = []
