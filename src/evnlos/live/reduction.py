"""Area averaging with what does not change worked out beforehand, for one picture after the other."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def _reduce(images, first_y, over_y, first_x, over_x, out):
    """Fill `out` [N, h, w] from `images` [N, H, W]; an axis has each cell's first place and weights."""
    width = images.shape[2]
    line = np.empty(width, np.float32)
    for number in range(images.shape[0]):
        for row in range(out.shape[1]):
            line[:] = np.float32(0)
            for k in range(over_y.shape[1]):
                share, source = over_y[row, k], images[number, first_y[row] + k]
                for column in range(width):
                    line[column] += share * source[column]
            for column in range(out.shape[2]):
                start, total = first_x[column], np.float32(0)
                for k in range(over_x.shape[1]):
                    total += over_x[column, k] * line[start + k]
                out[number, row, column] = total


def _cells(inside: int, outside: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return, for each of `outside` equal cells, the first of `inside` places covered, and their shares."""
    cell = inside / outside
    edges = np.arange(outside + 1) * cell
    most = min(int(np.ceil(cell)) + 1, inside)
    first = np.minimum(np.floor(edges[:-1]).astype(np.int64), inside - most)
    places = first[:, None] + np.arange(most)
    covered = np.minimum(edges[1:, None], places + 1) - np.maximum(edges[:-1, None], places)
    return first, (np.maximum(covered, 0.0) / cell).astype(np.float32)


class AreaReduction:
    """`reduce_by_area` from one size to another, without its threads.

    For small maps those cost more than the work.

    Args:
        inside: Height and width of the maps given, pixels.
        outside: Height and width of those returned, pixels.

    Example:
        >>> AreaReduction((1, 6), (1, 4))(np.arange(6.0, dtype=np.float32).reshape(1, 1, 6)).round(2)
        array([[[0.33, 1.67, 3.33, 4.67]]], dtype=float32)
    """

    def __init__(self, inside: tuple[int, int], outside: tuple[int, int]) -> None:
        self.outside = outside
        self._first_y, self._over_y = _cells(inside[0], outside[0])
        self._first_x, self._over_x = _cells(inside[1], outside[1])

    def __call__(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return maps [N, H, W] as maps [N, *outside]; each is the mean over its cell."""
        out = np.empty((len(images), *self.outside), np.float32)
        _reduce(images, self._first_y, self._over_y, self._first_x, self._over_x, out)
        return out
