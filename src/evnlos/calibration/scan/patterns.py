"""What a scan shows on the target's plane, and how cells are told apart again: raster, points, Hadamard.

Multiplexing lights about half of the cells at a time (Harwit and Sloane, Hadamard Transform Optics, 1979).
Under noise that does not depend on the light, q patterns make the noise of a cell (q + 1) / (2 sqrt q) times
smaller; under shot noise alone they bring nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError

Pattern = Literal["raster", "hadamard", "points"]


@dataclass(frozen=True)
class Patterns:
    """The patterns of a scan.

    Raster and points light one cell at a time. Hadamard: q is the smallest prime of the form 4 m - 1 that is
    not below the number of cells n; in pattern i cell k is lit when (i + k) mod q is 0 or a square modulo q
    (the quadratic-residue S-matrix of order q, of which n columns are used).

    Args:
        kind: "raster", "hadamard" or "points".
        cells: Number of cells that are measured, n: all of the plane, or the points.

    Raises:
        ConfigError: No cells, or more than 65,536.

    Example:
        >>> Patterns("hadamard", 3).lit.astype(int)
        array([[1, 1, 0],
               [1, 0, 1],
               [0, 1, 1]])
    """

    kind: Pattern
    cells: int

    def __post_init__(self) -> None:
        if not 1 <= self.cells <= 65_536:
            raise ConfigError(f"the scan has {self.cells} cells; give 1 to 65536, or a larger pitch")

    @cached_property
    def count(self) -> int:
        """Number of patterns."""
        return residue_order(self.cells) if self.kind == "hadamard" else self.cells

    def row(self, index: int) -> NDArray[np.bool_]:
        """Return which cells pattern `index` lights, [n]."""
        if self.kind == "hadamard":
            return self._residues[(index + np.arange(self.cells)) % self.count]
        return np.arange(self.cells) == index

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Which cells each pattern lights, [patterns, n]."""
        return np.stack([self.row(index) for index in range(self.count)])

    @property
    def noise_factor(self) -> float:
        """Noise of a cell over the noise of a frame, for noise that is the same in all frames.

        Example:
            >>> round(1 / Patterns("hadamard", 103).noise_factor, 3), round(104 / 2 / 103**0.5, 3)
            (5.124, 5.124)
        """
        if self.kind != "hadamard":
            return 1.0
        n = self.cells
        return math.sqrt(4 / (self.count + 1) * n / (n + 1))

    @property
    def offset_factor(self) -> float:
        """Error of a cell over an offset that all frames share, e.g. the error of the dark frame."""
        return 2 / (self.cells + 1) if self.kind == "hadamard" else 1.0

    def separate(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the light of each cell, [n, pixels], from the frames of the patterns, [patterns, pixels].

        Least squares: with P the patterns, P^T P = (q + 1) / 4 (I + J), whose inverse is known.
        """
        if self.kind != "hadamard":
            return frames
        back = self.lit.astype(np.float32).T @ frames  # [n, pixels]
        back -= back.sum(axis=0, dtype=np.float64) / (self.cells + 1)
        back *= 4 / (self.count + 1)
        return back

    @cached_property
    def _residues(self) -> NDArray[np.bool_]:
        found = np.zeros(self.count, np.bool_)
        found[np.arange(self.count, dtype=np.int64) ** 2 % self.count] = True
        return found


def residue_order(cells: int) -> int:
    """Return the smallest prime 4 m - 1 that is not below `cells`.

    Example:
        >>> [residue_order(n) for n in (1, 4, 8, 768)]
        [3, 7, 11, 787]
    """
    order = max(3, cells + (3 - cells) % 4)
    while not _is_prime(order):
        order += 4
    return order


def _is_prime(number: int) -> bool:
    return number > 1 and all(number % k for k in range(2, math.isqrt(number) + 1))
