"""Figures; matplotlib is imported when one is drawn.

`figures` draws films of a sequence and what a corner shows; `setup` draws the setup
to scale; `preview` and `event_views` show events without matplotlib; `results` belongs to the commands.
"""

__all__: list[str] = []
