"""The best linear estimate of a plate from one picture of the wall, and how wrong it is on average."""

from __future__ import annotations

import math

import torch

from evnlos.errors import DataError

_STEPS_AN_OCTAVE = 8
_PHASES = 4
RESOLVED = 0.5
"""Bars count as resolved when the expected error is at most this share of an even grey's."""


class LinearEstimator:
    """The linear minimum mean-square error estimator of x from y = A x + noise (Wiener; LMMSE).

    x^ = m + C A^T (A C A^T + D)^-1 (y - A m), with m and C the mean and the covariance of the plates and D that
    of the noise. In the basis T of patterns in which C = T T^T and T^T A^T D^-1 A T = diag(snr), pattern k is
    seen with a signal-to-noise ratio snr_k in power, and x^ = m + T (snr + 1)^-1 T^T A^T D^-1 (y - A m).

    Args:
        gram: A^T D^-1 A, [n, n]: the information that the picture carries.
        mean: m, [n], 0..1.
        patterns: T, [n, n].
        snr: Signal-to-noise ratio of each pattern, [n], descending.
    """

    def __init__(
        self, gram: torch.Tensor, mean: torch.Tensor, patterns: torch.Tensor, snr: torch.Tensor
    ) -> None:
        self.mean, self.snr = mean, snr
        self._patterns = patterns
        self._gain = patterns / (snr + 1)
        self._kept = self._gain @ (patterns.mT @ gram)  # what the estimate keeps of x - m, [n, n]
        share = snr / (snr + 1).square()
        self.noise_error = float((share * patterns.square().sum(dim=0)).sum() / len(mean))

    @classmethod
    def known(cls, gram: torch.Tensor, mean: torch.Tensor, root: torch.Tensor) -> LinearEstimator:
        """Return the estimator for plates of mean m and covariance C = R R^T.

        Args:
            gram: A^T D^-1 A, [n, n].
            mean: m, [n].
            root: R, [n, n].

        Raises:
            DataError: The sizes do not belong together.
        """
        count = len(mean)
        if gram.shape != (count, count) or root.shape != (count, count):
            raise DataError(
                f"gram is {tuple(gram.shape)}, root {tuple(root.shape)}; both need {count} x {count} entries"
            )
        snr, turn = torch.linalg.eigh(root.mT @ gram @ root)
        return cls(gram, mean, (root @ turn).flip(1), snr.flip(0).clamp(min=0))

    @classmethod
    def white(cls, gram: torch.Tensor, power: torch.Tensor, axes: torch.Tensor) -> LinearEstimator:
        """Return the estimator that knows no shapes: cells are independent, as often bright as dark.

        Args:
            gram: A^T D^-1 A, [n, n].
            power: Its eigenvalues, [n], descending.
            axes: Its eigenvectors, [n, n].
        """
        mean = torch.full_like(power, 0.5)
        return cls(gram, mean, axes / 2, power / 4)  # variance 1/4

    @property
    def patterns_seen(self) -> int:
        """Number of patterns in which these plates differ by more than the noise: snr above 1."""
        return int((self.snr > 1).sum())

    def expected(self, plates: torch.Tensor) -> torch.Tensor:
        """Return the estimate without its noise: its mean over many pictures of each plate [..., n]."""
        return self.mean + (plates - self.mean) @ self._kept.mT

    def expected_error(self, plates: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error a cell, over the noise, for given plates [..., n] -> [...]."""
        return (self.expected(plates) - plates).square().mean(dim=-1) + self.noise_error

    def estimate(self, backprojected: torch.Tensor) -> torch.Tensor:
        """Return x^ from A^T D^-1 (y - A m), [..., n]."""
        return self.mean + (backprojected @ self._patterns) @ self._gain.mT


def bars(cells: int, width: float, phase: float, upright: bool = True) -> torch.Tensor:
    """Return bright bars on a dark plate, each cell the exact mean over its area.

    Args:
        cells: Cells a side.
        width: Width of a bar and of a gap, cells, above 0.
        phase: Where the first bar begins, cells.
        upright: Whether the bars run along y; they then follow each other along x.

    Returns:
        Brightness, float64 [cells, cells], 0..1.

    Example:
        >>> bars(4, 1.0, 0.5)[0]
        tensor([0.5000, 0.5000, 0.5000, 0.5000], dtype=torch.float64)
    """
    edge = torch.arange(cells + 1, dtype=torch.float64) - phase
    periods = torch.floor(edge / (2 * width))
    filled = periods * width + (edge - 2 * width * periods).clamp(max=width)
    profile = filled.diff()
    return (profile if upright else profile[:, None]).expand(cells, cells).clone()


def finest_bars(estimator: LinearEstimator, cells: int, upright: bool = True) -> float | None:
    """Return the width of the finest bars that one picture resolves, in cells; None where none are.

    Bars of full contrast fill the plate. They are resolved when the expected squared error of the estimate,
    averaged over their phase, is at most half of what an even grey of their mean would have (a quarter of the
    all-black picture's), and so are all wider bars. Widths go from half of the plate down to one cell in steps
    of 9 %.

    Args:
        estimator: The estimator, `LinearEstimator.white` for one without any knowledge of shapes.
        cells: Cells a side of the plate.
        upright: Whether the bars run along y.
    """
    octaves = math.log2(cells / 2)
    steps = round(_STEPS_AN_OCTAVE * octaves)
    found = None
    for step in range(steps + 1):
        width = cells / 2 * 2 ** (-octaves * step / steps)
        plates = torch.stack(
            [bars(cells, width, 2 * width * k / _PHASES, upright).flatten() for k in range(_PHASES)]
        ).to(estimator.mean)
        grey = (plates - plates.mean(dim=-1, keepdim=True)).square().mean()
        if float(estimator.expected_error(plates).mean()) > RESOLVED * float(grey):
            break
        found = width
    return found
