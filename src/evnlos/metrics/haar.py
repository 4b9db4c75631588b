"""Haar wavelet perceptual similarity."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from evnlos.errors import DataError
from evnlos.metrics.pixelwise import checked

_C, _ALPHA = 30.0, 4.2
HAAR_LEAST_SIDE = 16
"""Smallest side of an image, pixels: three scales of a picture halved once."""


def haarpsi(image: torch.Tensor, truth: torch.Tensor, *, peak: float = 1.0) -> torch.Tensor:
    """Return the Haar wavelet perceptual similarity index of each image, in [0, 1]; 1 = the same.

    Local similarities of the Haar coefficients at two fine scales, weighted by those of a third, coarser one,
    of grey images halved once: Reisenhofer, Bosse, Kutyniok and Wiegand, Signal Processing: Image Communication
    61 (2018), Eq. 10-12, with C = 30 and alpha = 4.2 on values from 0 to 255.

    Args:
        image: Reconstructions [..., H, W], each side at least 16 pixels.
        truth: True images [..., H, W].
        peak: Dynamic range of the images.

    Returns:
        One value an image, shape [...]; 1 where neither image holds an edge.

    Raises:
        DataError: The shapes differ, a value is not finite, or the image is too small.

    Example:
        >>> picture = torch.linspace(0, 1, 256).reshape(16, 16)
        >>> round(haarpsi(picture, picture).item(), 6)
        1.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    if min(height, width) < HAAR_LEAST_SIDE:
        raise DataError(f"haarpsi: image is {height} x {width}; give at least {HAAR_LEAST_SIDE} pixels a side")
    x, y = (_coefficients(part.reshape(-1, 1, height, width) * (255 / peak)) for part in (image, truth))
    likeness = (2 * x * y + _C**2) / (x * x + y * y + _C**2)  # [N, scale, orientation, H, W]
    local = torch.sigmoid(_ALPHA * likeness[:, :2].mean(dim=1))
    weight = torch.maximum(x[:, 2], y[:, 2])
    total = weight.flatten(1).sum(dim=1)
    mean = (local * weight).flatten(1).sum(dim=1) / total.clamp_min(1e-12)
    found = (torch.logit(mean.clamp(0.5, 1 - 1e-7)) / _ALPHA).square()
    return torch.where(total > 0, found, torch.ones_like(found)).reshape(image.shape[:-2])


def _coefficients(x: torch.Tensor) -> torch.Tensor:
    """Return magnitudes of the Haar coefficients at scales 1 to 3, horizontal and vertical: [N, 3, 2, H, W]."""
    x = F.avg_pool2d(x, 2)
    found = []
    for scale in (1, 2, 3):
        side = 2**scale
        edge = torch.full((side, side), 1.0 / side, dtype=x.dtype, device=x.device)
        edge[: side // 2] *= -1
        kernels = torch.stack([edge, edge.T])[:, None]  # [2, 1, side, side]
        before = side // 2
        padded = F.pad(x, (before, side - 1 - before, before, side - 1 - before))
        found.append(F.conv2d(padded, kernels).abs())
    return torch.stack(found, dim=1)
