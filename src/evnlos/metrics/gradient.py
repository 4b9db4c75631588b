"""Gradient magnitude similarity deviation."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from evnlos.errors import DataError
from evnlos.metrics.pixelwise import checked

_C = 170 / 255**2  # the published constant, for a dynamic range of 1


def gmsd(image: torch.Tensor, truth: torch.Tensor, *, peak: float = 1.0) -> torch.Tensor:
    """Return the gradient magnitude similarity deviation of each image; 0 = the same, larger = worse.

    The standard deviation over the pixels of (2 m1 m2 + c) / (m1^2 + m2^2 + c), with Prewitt gradient
    magnitudes m on images averaged and halved once: Xue, Zhang, Mou and Bovik, IEEE TIP 23 (2014), Eq. 4-7.

    Args:
        image: Reconstructions [..., H, W], each side at least 6 pixels.
        truth: True images [..., H, W].
        peak: Dynamic range of the images.

    Returns:
        One value an image, shape [...].

    Raises:
        DataError: The shapes differ, a value is not finite, or the image is too small.

    Example:
        >>> picture = torch.linspace(0, 1, 256).reshape(16, 16)
        >>> gmsd(picture, picture).item()
        0.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    if min(height, width) < 6:
        raise DataError(f"gmsd: image is {height} x {width}; give at least 6 pixels a side")
    m1, m2 = (_magnitude(part.reshape(-1, 1, height, width) / peak) for part in (image, truth))
    similarity = (2 * m1 * m2 + _C) / (m1.square() + m2.square() + _C)
    return similarity.flatten(1).std(dim=1, correction=0).reshape(image.shape[:-2])


def _magnitude(x: torch.Tensor) -> torch.Tensor:
    x = F.avg_pool2d(x, 2)
    across = torch.tensor([[1.0, 0.0, -1.0]] * 3, dtype=x.dtype, device=x.device) / 3
    kernels = torch.stack([across, across.T])[:, None]  # [2, 1, 3, 3]
    # sqrt has no slope at 0; the smallest positive number keeps a gradient finite
    return F.conv2d(x, kernels).square().sum(dim=1).clamp_min(1e-24).sqrt()
