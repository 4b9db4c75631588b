"""Figures, one file each; matplotlib is imported when a figure is drawn."""

__all__: list[str] = []
