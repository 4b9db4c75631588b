"""The weight of a prior by leaving out blocks of the wall: no truth, and no belief in independent errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch

from evnlos.errors import ConfigError
from evnlos.solver.problem import Problem

_HOPELESS = 1.1

Path = Callable[[Problem], Iterable[torch.Tensor]]
"""From a problem to its images [..., h, w], one for each lam."""


@dataclass(frozen=True)
class Choice:
    """What cross-validation found.

    Args:
        lam: The best lam.
        errors: Mean squared misfit of a left-out sample for each lam tried, in the squared weighted unit.
    """

    lam: float
    errors: tuple[float, ...]


def block_folds(shape: tuple[int, int], *, blocks: int = 6, folds: int = 4) -> torch.Tensor:
    """Return the fold 0..folds - 1 of each sample: blocks x blocks rectangles, spread over the wall.

    Args:
        shape: Size (H, W) of the measurement.
        blocks: Blocks a side; their size must exceed the length over which the model's errors are alike.
        folds: Number of folds.

    Raises:
        ConfigError: Fewer than two folds, or more blocks a side than samples.

    Example:
        >>> block_folds((2, 4), blocks=2, folds=2)
        tensor([[0, 0, 1, 1],
                [1, 1, 0, 0]])
    """
    if folds < 2 or not 2 <= blocks <= min(shape):
        raise ConfigError(
            f"{blocks} blocks in {folds} folds on {shape}; give 2 or more, fewer than samples a side"
        )
    by, bx = (torch.arange(n) * blocks // n for n in shape)
    # A stride that shares no factor with the folds would put whole columns into few folds.
    stride = 1 if folds < 4 else 2
    return (by[:, None] + stride * bx + (by[:, None] // folds)) % folds


def cross_validate(problem: Problem, path: Path, lams: Sequence[float], folds: torch.Tensor) -> Choice:
    """Return the lam whose images, made from all blocks but a fold's, predict that fold best.

    The search ends early once the error is a tenth above the least one seen.

    Args:
        problem: The problem.
        path: From a problem to the images for `lams`, in their order; only those that are asked for are made.
        lams: Weights of the prior to try, from the strongest to the weakest.
        folds: Fold of each sample, integers [H, W].
    """
    helds = [folds == fold for fold in range(int(folds.max()) + 1)]
    kept = [problem.reweighted((~held).to(problem.measurement)) for held in helds]
    errors: list[float] = []
    for images in zip(*(path(part) for part in kept), strict=True):
        misfits = [problem.held_out_error(image, held) for image, held in zip(images, helds, strict=True)]
        errors.append(sum(misfits) / problem.measurement.numel())
        if errors[-1] > _HOPELESS * min(errors):
            break
    best = errors.index(min(errors))
    return Choice(float(lams[best]), tuple(errors))
