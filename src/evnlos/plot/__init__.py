"""Figures, one file each; matplotlib is imported when a figure is drawn.

`stages` draws wall, events, surfaces and reconstructions; `film` puts them side by side over positions;
`rig` draws the set-up to scale; `preview` and `event_views` show events without matplotlib; the others belong
to one command each.
"""

__all__: list[str] = []
