"""A grid of rectangular patches, for screens and walls whose samples are not square or do not touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.types import Plane


@dataclass(frozen=True, eq=False)
class Patches:
    """Equal rectangles at the crossings of given columns and rows.

    Args:
        x_m: Middles of the columns, float64 [W], metres, to the right.
        y_m: Middles of the rows, float64 [H], metres, downwards.
        size_m: Width and height of one patch, metres.

    Raises:
        DataError: A list of middles is empty or not finite, or a patch has no size.

    Example:
        >>> Patches([0.2, 0.1], [0.0, 0.1, 0.2], (0.08, 0.05)).shape
        (3, 2)
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    size_m: tuple[float, float]

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m"):
            object.__setattr__(self, name, _middles(getattr(self, name), name))
        width, height = (float(side) for side in self.size_m)
        if not (np.isfinite([width, height]).all() and width > 0 and height > 0):
            raise DataError(f"Patches.size_m is {self.size_m}; give a positive width and height, metres")
        object.__setattr__(self, "size_m", (width, height))

    @property
    def height(self) -> int:
        """Number of rows."""
        return len(self.y_m)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.x_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (rows, columns)."""
        return self.height, self.width


def as_patches(grid: Plane | Patches) -> Patches:
    """Return the touching squares of a sampled plane, or the patches themselves."""
    if isinstance(grid, Patches):
        return grid
    return Patches(grid.x_m, grid.y_m, (grid.pitch_m, grid.pitch_m))


def _middles(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)  # a copy: the caller's array stays his own
    if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
        raise DataError(f"Patches.{name} must be one or more finite numbers, metres")
    array.setflags(write=False)
    return array
