"""A grid of bright dots, as a screen or a board of lamps shows it, found in a frame or in a map of events."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.dataset.registration import homography_from_points
from evnlos.errors import DataError

_SMALLEST = 3  # pixels of a dot
_OFF_GRID = 0.3  # of a grid step: farther dots are no grid


@njit(cache=True)
def _blobs(bright, picture):
    """Return for each 8-connected set of bright pixels: weight, weighted sums of x and y, pixels."""
    height, width = bright.shape
    seen = np.zeros((height, width), np.bool_)
    stack = np.empty((height * width, 2), np.int64)
    found = []
    for row in range(height):
        for column in range(width):
            if not bright[row, column] or seen[row, column]:
                continue
            seen[row, column] = True
            stack[0, 0], stack[0, 1] = row, column
            size, weight, sum_x, sum_y, pixels = 1, 0.0, 0.0, 0.0, 0
            while size:
                size -= 1
                at_row, at_column = stack[size, 0], stack[size, 1]
                value = picture[at_row, at_column]
                weight += value
                sum_x += value * at_column
                sum_y += value * at_row
                pixels += 1
                for v in range(max(0, at_row - 1), min(height, at_row + 2)):
                    for u in range(max(0, at_column - 1), min(width, at_column + 2)):
                        if bright[v, u] and not seen[v, u]:
                            seen[v, u] = True
                            stack[size, 0], stack[size, 1] = v, u
                            size += 1
            found.append((weight, sum_x, sum_y, float(pixels)))
    return found


def find_dots(picture: NDArray, rows: int, columns: int) -> NDArray[np.float64]:
    """Return the centres of a grid of bright dots on a dark ground, row by row from the top left.

    Pixels above the middle between the ground (median) and the brightest (99.9th percentile) form dots; the
    `rows` x `columns` largest are taken, their centres of brightness fitted by a homography from their four
    corners. The grid may be tilted by less than 45 degrees and seen in perspective.

    Args:
        picture: [H, W], brighter dots; for a blinking grid the number of events a pixel.
        rows: Rows of dots, at least 2.
        columns: Dots a row, at least 2.

    Returns:
        Points (x, y), float64 [rows * columns, 2], pixels.

    Raises:
        DataError: Another number of dots, or dots that form no such grid.
    """
    if rows < 2 or columns < 2:
        raise DataError(f"a grid of {rows} x {columns} dots; give at least 2 x 2")
    picture = np.asarray(picture, np.float64)
    ground, top = np.median(picture), np.percentile(picture, 99.9)
    top = max(top, picture.max() * 0.5)  # dots may cover less than a thousandth
    above = np.clip(picture - ground, 0, None)
    blobs = [blob for blob in _blobs(above > (top - ground) / 2, above) if blob[3] >= _SMALLEST]
    count = rows * columns
    if top <= ground or len(blobs) < count:
        raise DataError(
            f"{len(blobs)} dots found where {rows} x {columns} are announced; check light and focus"
        )
    largest = np.array(sorted(blobs, key=lambda blob: -blob[0])[:count])
    if len(blobs) > count and sorted(blob[0] for blob in blobs)[-count - 1] > 0.5 * np.median(largest[:, 0]):
        raise DataError(f"{len(blobs)} dots found where {rows} x {columns} are announced; hide other lights")
    centres = largest[:, 1:3] / largest[:, :1]
    ends = centres.sum(axis=1), centres[:, 0] - centres[:, 1]
    corners = [np.argmin(ends[0]), np.argmax(ends[1]), np.argmax(ends[0]), np.argmin(ends[1])]
    steps = np.array([(0, 0), (columns - 1, 0), (columns - 1, rows - 1), (0, rows - 1)], float)
    if len(set(corners)) < 4:
        raise DataError("the dots have no four corners; turn the grid upright")
    to_grid = homography_from_points(centres[corners], steps)
    mapped = np.column_stack([centres, np.ones(count)]) @ to_grid.T
    place = mapped[:, :2] / mapped[:, 2:]
    nearest = np.round(place)
    away = np.abs(place - nearest).max()
    order = (nearest[:, 1] * columns + nearest[:, 0]).astype(int)
    if away > _OFF_GRID or sorted(order) != list(range(count)):
        raise DataError(f"the dots form no grid of {rows} x {columns}; check its rows and columns")
    return centres[np.argsort(order)]
