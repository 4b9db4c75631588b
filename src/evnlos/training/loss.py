"""What training minimises: the paper's loss, and a default that does not collapse to black."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from torch import Tensor

from evnlos.metrics import ssim

LossName = Literal["balanced", "paper"]


def paper_loss(image: Tensor, truth: Tensor) -> Tensor:
    """Return L1 + 2 / SSIM, as the paper prints it, with the SSIM of each sample, then the mean.

    Unbounded where an SSIM crosses 0, and an all-black picture of a sparse target already has SSIM 0.8:
    short trainings sit at exactly that output. The SSIM is kept at or above 0.05 so that the loss stays finite.

    Args:
        image: Pictures of the network, [B, 1, H, W], 0..1.
        truth: True pictures, [B, 1, H, W], 0..1.
    """
    structure = ssim(image, truth).clamp_min(0.05)  # [B, 1]
    return (image - truth).abs().mean() + (2 / structure).mean()


def balanced_loss(image: Tensor, truth: Tensor) -> Tensor:
    """Return MSE relative to the truth's own energy + (1 - SSIM) / 4 + (1 - Dice) / 4.

    Each term is bounded. Dividing the squared error of a batch by its mean square makes the all-black
    picture cost 1 whatever share of the canvas a character covers, and the soft Dice overlap,
    2 sum(xy) / (sum(x^2) + sum(y^2)) (Milletari, Navab and Ahmadi, 3DV 2016), has its worst value there.

    Args:
        image: Pictures of the network, [B, 1, H, W], 0..1.
        truth: True pictures, [B, 1, H, W], 0..1.
    """
    energy = truth.square().mean()
    error = (image - truth).square().mean() / (energy + 1e-4)
    together = (image * truth).sum(dim=(-3, -2, -1))
    apart = image.square().sum(dim=(-3, -2, -1)) + truth.square().sum(dim=(-3, -2, -1))
    dice = (2 * together + 1e-3) / (apart + 1e-3)
    return error + (1 - ssim(image, truth).mean()) / 4 + (1 - dice.mean()) / 4


LOSSES: dict[LossName, Callable[[Tensor, Tensor], Tensor]] = {"balanced": balanced_loss, "paper": paper_loss}
