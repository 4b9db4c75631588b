"""What hidden plates look like: a Gaussian prior from some characters, and others to test it on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.scene import TRAIN_WRITERS, HandwritingGlyphs, Target
from evnlos.types import Plane

TEST_CHARACTERS = "AGKS249"
"""Characters that the prior never sees, from writers that it never sees."""
TRAIN_CHARACTERS = "BCDEFHIJLMNOPQRTUVWXYZ0135678"
"""Characters of the prior."""
TYPICAL = "G"
"""The character whose Picard plot is shown."""
_TEST_WRITERS = 2
_RIDGE = 1e-3  # white part of the prior, share of its mean variance: no shape is impossible


@dataclass(frozen=True, eq=False)
class Plates:
    """Plates to learn a prior from, and others to test on, drawn on the same cells.

    Args:
        mean: Mean training plate, float64 [n], 0..1.
        root: R with R R^T their covariance and a small white part, float64 [n, n].
        test: Test plates, float64 [M, n].
        names: Their names, [M].
        stroke_m: Median stroke width of the test plates, metres.
    """

    mean: torch.Tensor
    root: torch.Tensor
    test: torch.Tensor
    names: tuple[str, ...]
    stroke_m: float

    @property
    def typical(self) -> int:
        """Number of the test plate that stands for all."""
        return next(i for i, name in enumerate(self.names) if name.endswith(f"_{TYPICAL}"))


@lru_cache(maxsize=2)
def handwritten_plates(plate: Plane, writers: int = 6) -> Plates:
    """Return NIST-like handwriting as prior and test.

    Training plates are also moved by a cell each way, so that the prior does not know the place to a cell.

    Args:
        plate: Cells of the plate, square.
        writers: Writers of the training plates.
    """
    training = HandwritingGlyphs(characters=TRAIN_CHARACTERS, writers=writers)
    drawn = np.stack([training.target(name).rasterise(plate) for name in training.objects()]).astype(np.float64)
    moved = [np.roll(drawn, (dy, dx), axis=(1, 2)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    samples = torch.from_numpy(np.concatenate(moved)).flatten(1)  # [9 N, n]
    mean = samples.mean(dim=0)
    covariance = torch.cov(samples.mT)
    variance, axes = torch.linalg.eigh(covariance)
    root = axes * (variance.clamp(min=0) + _RIDGE * variance.mean()).sqrt()
    testing = HandwritingGlyphs(characters=TEST_CHARACTERS, writers=_TEST_WRITERS, first_writer=TRAIN_WRITERS)
    targets = [testing.target(name) for name in testing.objects()]
    test = torch.from_numpy(np.stack([one.rasterise(plate) for one in targets])).double().flatten(1)
    stroke = float(np.median([stroke_width_m(one) for one in targets]))
    return Plates(mean, root, test, tuple(testing.objects()), stroke)


def stroke_width_m(target: Target) -> float:
    """Return the mean width of a plate's strokes, metres: twice their area over the length of their border.

    A stroke of width w and length l has the area w l and, but for its ends, a border of 2 l. The border's
    length is the total variation of the mask.

    Example:
        >>> bar = np.zeros((100, 100)); bar[:, 40:50] = 1
        >>> round(stroke_width_m(Target("bar", bar, 0.1)), 4)
        0.01
    """
    mask = target.mask.astype(np.float64)
    pixel_m = target.size_m / mask.shape[0]
    border = float(np.hypot(*_slopes(mask)).sum())
    return 2 * float(mask.sum()) / max(border, 1e-12) * pixel_m


def _slopes(mask: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return forward differences along y and x, [S, S]."""
    return np.diff(mask, axis=0, append=mask[-1:]), np.diff(mask, axis=1, append=mask[:, -1:])
