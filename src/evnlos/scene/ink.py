"""Measures of a drawing: where its ink is, and how wide its strokes are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.scene.distance import signed_distance


def pen_width(mask: NDArray[np.float32]) -> float:
    """Return the mean width of a drawing's strokes as a part of the longer side of its ink, 0..1.

    Args:
        mask: Bright ink on dark ground, [H, W], 0..1.

    Raises:
        DataError: The picture has no ink.
    """
    left, top, right, bottom = ink_box(mask)
    return pen_px(mask) / max(right - left, bottom - top)


def pen_px(ink: NDArray[np.float32]) -> float:
    """Return the mean width of the strokes, pixels: four times the mean distance of the ink to its edge."""
    distance = signed_distance(ink, reach=40)
    inside = distance < 0
    return 4.0 * float(-distance[inside].mean()) if inside.any() else 1.0


def ink_box(ink: NDArray[np.float32]) -> tuple[float, float, float, float]:
    """Return left, top, right, bottom of the ink, pixels from the centre."""
    rows, columns = np.flatnonzero((ink > 0.5).any(1)), np.flatnonzero((ink > 0.5).any(0))
    if not len(rows):
        raise DataError("a glyph has no ink (no pixel above 0.5); choose another base face or drawing")
    half = len(ink) / 2
    return columns[0] - half, rows[0] - half, columns[-1] + 1 - half, rows[-1] + 1 - half
