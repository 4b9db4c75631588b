"""Electrons of a frame as plain torch operations: `fill_electrons` on any device."""

from __future__ import annotations

import torch
from torch import Tensor

from evnlos.sensor._photons import FEW
from evnlos.sensor._random import STREAM_FEW_PHOTONS, STREAM_PHOTONS
from evnlos.sensor._torch_random import random_normals, random_uniform, stream_word

_MOST = 2000
_UNASKED = 16  # steps between questions to the device whether any pixel still counts


def electrons(mean: Tensor, offset: Tensor, read_noise: float, seed: int, first: int) -> Tensor:
    """Return the electrons of some frames: Poisson numbers of `mean`, `offset`, and read noise.

    The numbers are those of `fill_electrons` but for pixels, one in millions, whose normal number lies within
    the last digits of a step.

    Args:
        mean: Electrons expected, float64 [frames, N], 0 or more.
        offset: Electrons added, float64 [N].
        read_noise: Standard deviation, electrons.
        seed: Seed of the capture.
        first: Number of the first frame; the others follow it.

    Returns:
        float64 [frames, N].
    """
    number, pixel = (torch.arange(side, device=mean.device) for side in mean.shape)
    number = number[:, None] + first
    shot, read = random_normals(stream_word([seed], STREAM_PHOTONS, mean.device), pixel, number)
    many = mean.clamp(min=FEW)
    root = many.sqrt()
    count = many + root * shot + (shot * shot - 1.0) / 6.0 + (shot - shot * shot * shot) / (72.0 * root)
    count = count.round_().clamp_(min=0.0)
    frame, few = (mean < FEW).nonzero(as_tuple=True)
    if len(few):
        word = stream_word([seed], STREAM_FEW_PHOTONS, mean.device)
        count[frame, few] = _few(mean[frame, few], random_uniform(word, few, frame + first))
    return count.add_(offset).add_(read.mul_(read_noise))


def _few(mean: Tensor, uniform: Tensor) -> Tensor:
    """Return the Poisson numbers of small means by inverting the distribution."""
    share = torch.exp(-mean)
    total, count = share.clone(), torch.zeros_like(mean)
    for step in range(1, _MOST + 1):
        going = total < uniform
        if step % _UNASKED == 1 and not bool(going.any()):
            break
        share = share * (mean / step)
        count += going
        total = torch.where(going, total + share, total)
    return count
