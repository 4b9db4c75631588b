"""Figures; matplotlib is imported when one is drawn.

`figures` draws films of a sequence and shows events, as `preview` does, without matplotlib; `setup` draws the
setup to scale and what a corner shows; `results` belongs to the commands.
"""

__all__: list[str] = []
