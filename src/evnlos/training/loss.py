"""What training minimises: the paper's loss, and a default that does not collapse to black."""

from __future__ import annotations

from typing import Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from evnlos.metrics import ssim

LossName = Literal["balanced", "paper"]


class Loss(Protocol):
    """A mean over samples: the losses of the parts of a batch, weighted by their sizes, add up to its loss."""

    def __call__(self, image: Tensor, truth: Tensor, light: Tensor | None = None) -> Tensor:
        """Return the loss of pictures [B, 1, H, W]; `light` is that of the whole batch, see `light_of`."""
        ...


def light_of(truth: Tensor) -> Tensor:
    """Return mean and mean square of true pictures [B, 1, H, W], float [2]: what a loss may know of a batch."""
    return torch.stack([truth.mean(), truth.square().mean()])


def paper_loss(image: Tensor, truth: Tensor, light: Tensor | None = None) -> Tensor:
    """Return L1 + 2 / SSIM, as the paper prints it, with the SSIM of each sample, then the mean.

    Unbounded where an SSIM crosses 0, and an all-black picture of a sparse target already has SSIM 0.8:
    short trainings sit at exactly that output. The SSIM is kept at or above 0.05 so that the loss stays finite.

    Args:
        image: Pictures of the network, [B, 1, H, W], 0..1.
        truth: True pictures, [B, 1, H, W], 0..1.
        light: Of no meaning here: every sample counts alone.
    """
    structure = ssim(image, truth).clamp_min(0.05)  # [B, 1]
    return (image - truth).abs().mean() + (2 / structure).mean()


def balanced_loss(image: Tensor, truth: Tensor, light: Tensor | None = None) -> Tensor:
    """Return cross-entropy / entropy of the mean + squared error / energy of the truth + (1 - SSIM) / 4.

    The first two terms are those of the best constant picture = 1, whatever share of the canvas a
    character covers. Both are least at the posterior mean, which is also what PSNR asks for. The
    cross-entropy of an all-black picture is unbounded, and its gradient does not vanish behind a
    saturated sigmoid, so training can't rest there: squared error, SSIM and overlap alone can.

    Args:
        image: Pictures of the network, [B, 1, H, W], 0..1.
        truth: True pictures, [B, 1, H, W], 0..1.
        light: Mean and mean square of the true pictures of the whole batch, where `truth` is a part of it.
    """
    mean, energy = light_of(truth) if light is None else light
    share = mean.clamp(1e-4, 1 - 1e-4)
    entropy = -(share * share.log() + (1 - share) * (1 - share).log())
    cross = F.binary_cross_entropy(image, truth) / entropy
    error = (image - truth).square().mean() / (energy + 1e-4)
    return cross + error + (1 - ssim(image, truth).mean()) / 4


LOSSES: dict[LossName, Loss] = {"balanced": balanced_loss, "paper": paper_loss}
