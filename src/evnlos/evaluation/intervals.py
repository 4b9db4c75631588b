"""Intervals for differences between methods, by a paired bootstrap over objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evnlos.errors import DataError


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % interval.

    Args:
        mean: The mean over all pictures.
        low: 2.5 % point of the bootstrap.
        high: 97.5 % point of the bootstrap.
    """

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def paired_difference(
    a: ArrayLike, b: ArrayLike, objects: ArrayLike, *, draws: int = 10_000, seed: int = 0
) -> Interval:
    """Return the mean of a - b with a 95 % percentile interval, objects drawn with replacement.

    The positions of one object are not independent, so whole objects are drawn, and both methods are always
    compared on the same pictures. With few objects (4 characters) such an interval is coarse and, as a rule,
    too narrow; it speaks of other objects like these, not of other rigs.

    Args:
        a: Scores of one method, [N], or [S, N] for S seeds, which are averaged.
        b: Scores of the other, the same pictures in the same order.
        objects: Object of each picture, [N].
        draws: Number of bootstrap samples.
        seed: Seed of the draws.

    Raises:
        DataError: The lengths disagree, or there is no picture.

    Example:
        >>> str(paired_difference([3.0, 4.0, 6.0], [1.0, 2.0, 3.0], ["A", "A", "B"]))
        '+2.33 [+2.00, +3.00]'
    """
    difference = np.atleast_2d(np.asarray(a, np.float64)).mean(axis=0)
    difference = difference - np.atleast_2d(np.asarray(b, np.float64)).mean(axis=0)
    labels = np.asarray(objects)
    if difference.shape != labels.shape or not len(labels):
        raise DataError(f"{difference.shape} differences and {labels.shape} objects; give one object a picture")
    _, group = np.unique(labels, return_inverse=True)
    sums, counts = np.bincount(group, difference), np.bincount(group)
    chosen = np.random.default_rng(seed).integers(0, len(sums), (draws, len(sums)))
    means = sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(float(difference.mean()), float(low), float(high))
