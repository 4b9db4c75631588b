"""Signed distance to the edge of a mask: what makes a pen thicker or thinner."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def signed_distance(mask: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Return the distance of each pixel to the mask's edge, negative inside, exact up to `reach`.

    Args:
        mask: Coverage, [H, W], 0..1; a pixel belongs to the mask from 0.5 on.
        reach: Distances are cut at +-`reach`, pixels, 1 or more.

    Returns:
        float32 [H, W], pixels: centre of the pixel to the edge between pixels.

    Example:
        >>> signed_distance(np.array([[0, 0, 1, 1, 0]]), 3)
        array([[ 1.5,  0.5, -0.5, -0.5,  0.5]], dtype=float32)
    """
    inside = np.asarray(mask) >= 0.5
    outer = _distance_to(inside, reach)
    inner = _distance_to(~inside, reach)
    return np.where(inside, 0.5 - inner, outer - 0.5).astype(np.float32)


def _distance_to(chosen: NDArray[np.bool_], reach: int) -> NDArray[np.float32]:
    """Return the distance to the nearest chosen pixel's centre, cut at `reach`, float32 [H, W], pixels."""
    height, width = chosen.shape
    column = np.arange(width)
    before = np.maximum.accumulate(np.where(chosen, column, -(reach + width)), axis=1)
    after = np.minimum.accumulate(np.where(chosen, column, reach + 2 * width)[:, ::-1], axis=1)[:, ::-1]
    along = np.minimum(np.minimum(column - before, after - column), reach).astype(np.float32) ** 2  # [H, W]
    nearest = along.copy()
    for step in range(1, min(reach, height - 1) + 1):
        np.minimum(nearest[step:], along[:-step] + step * step, out=nearest[step:])
        np.minimum(nearest[:-step], along[step:] + step * step, out=nearest[:-step])
    return np.minimum(np.sqrt(nearest), reach)
