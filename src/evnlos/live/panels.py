"""A picture and what it was made of, side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evnlos.live.engine import Picture
from evnlos.report.pictures import grey, polarity, stretched

_GAP_PX = 8


def panels(picture: Picture) -> dict[str, NDArray[np.uint8]]:
    """Return what there is to see, by name, in the order of the light path: uint8 [H, W] or [H, W, 3]."""
    shown = {"wall": stretched(picture.frame)} if picture.frame is not None else {}
    return shown | {"events": polarity(picture.surface), "reconstruction": grey(picture.image)}


def side_by_side(picture: Picture, height_px: int = 256) -> NDArray[np.uint8]:
    """Return the panels as one colour picture [H, W, 3] of even sides, magnified to about a height, pixels."""
    zoom = max(1, round(height_px / picture.image.shape[0]))
    row: list[NDArray[np.uint8]] = []
    for panel in panels(picture).values():
        colour = panel if panel.ndim == 3 else np.repeat(panel[..., None], 3, axis=-1)
        row += [colour.repeat(zoom, axis=0).repeat(zoom, axis=1)]
        row += [np.full((row[-1].shape[0], _GAP_PX, 3), 128, np.uint8)]
    sheet = np.concatenate(row[:-1], axis=1)
    odd = sheet.shape[0] % 2, sheet.shape[1] % 2  # video codecs take even sides
    return np.pad(sheet, ((0, odd[0]), (0, odd[1]), (0, 0)), mode="edge")
