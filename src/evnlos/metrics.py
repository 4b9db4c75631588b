"""Image metrics that need no weights, for single images and batches.

- PSNR and SSIM.
- Gradient magnitude similarity deviation.
- Haar wavelet perceptual similarity.
- Multi-scale SSIM.
- Image metrics that need no weights, for single images and batches.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from evnlos.errors import DataError

_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, for a dynamic range of 1


def psnr(image: torch.Tensor, truth: torch.Tensor, peak: float = 1.0) -> torch.Tensor:
    """Return the peak signal-to-noise ratio of each image, dB: 10 log10(peak^2 / MSE).

    Args:
        image: Reconstructions [..., H, W], same range as `truth`.
        truth: True images [..., H, W].
        peak: Largest possible value, in the images' own unit.

    Returns:
        One value per image, shape [...]; infinite where the two are equal.

    Raises:
        DataError: The shapes differ, a value is not finite, or the peak is not above 0.

    Example:
        >>> psnr(torch.zeros(8, 8), torch.full((8, 8), 0.1)).item()
        20.0
    """
    image, truth = checked(image, truth)
    if not peak > 0:
        raise DataError(f"peak is {peak}; give the largest possible value, above 0")
    mse = (image - truth).square().mean(dim=(-2, -1))
    return 10 * torch.log10(peak**2 / mse)


def ssim(
    image: torch.Tensor, truth: torch.Tensor, *, window: int = 11, sigma: float = 1.5, peak: float = 1.0
) -> torch.Tensor:
    """Return the structural similarity of each image, in [-1, 1].

    Gaussian window, no padding (the mean is over positions where the window fits), biased local
    moments, K1 = 0.01, K2 = 0.03: Wang, Bovik, Sheikh and Simoncelli, IEEE TIP 13 (2004), Eq. 13.

    Args:
        image: Reconstructions [..., H, W].
        truth: True images [..., H, W].
        window: Side of the window, pixels (odd); each side of the image must be at least as long.
        sigma: Standard deviation of the window, pixels.
        peak: Dynamic range of the images.

    Returns:
        One value per image, shape [...].

    Raises:
        DataError: The shapes differ, a value is not finite, or the window is even or larger than the image.

    Example:
        >>> image = torch.linspace(0, 1, 256).reshape(16, 16)
        >>> round(ssim(image, image).item(), 6)
        1.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    if window < 1 or window % 2 == 0:
        raise DataError(f"ssim: window is {window}; give an odd number of pixels")
    if min(height, width) < window:
        raise DataError(
            f"ssim: image is {height} x {width}; the window of {window} needs {window} pixels per side"
        )
    x = image.reshape(-1, 1, height, width) / peak  # [N, 1, H, W]
    y = truth.reshape(-1, 1, height, width) / peak  # [N, 1, H, W]
    return ssim_map(x, y, window, sigma).mean(dim=(-3, -2, -1)).reshape(image.shape[:-2])


def ssim_map(x: torch.Tensor, y: torch.Tensor, window: int = 11, sigma: float = 1.5) -> torch.Tensor:
    """Return the SSIM at each position of the window: x, y [N, 1, H, W] in 0..1 -> [N, 1, H-w+1, W-w+1].

    Args:
        x: Images in 0..1, [N, 1, H, W].
        y: Images to compare them with, likewise.
        window: Side w of the Gaussian window, pixels, at most H and W.
        sigma: Its standard deviation, pixels.
    """
    luminance, structure = ssim_terms(x, y, window, sigma)
    return luminance * structure


def ssim_terms(
    x: torch.Tensor, y: torch.Tensor, window: int = 11, sigma: float = 1.5
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the two factors of the SSIM at each position: luminance, and contrast times structure."""
    taps = torch.arange(window, device=x.device, dtype=x.dtype) - (window - 1) / 2
    taps = torch.exp(-taps.square() / (2 * sigma**2))
    taps = taps / taps.sum()
    moments = torch.cat([x, y, x * x, y * y, x * y], dim=1)  # [N, 5, H, W]
    # As products with banded matrices: on images of this size several times as fast as convolutions.
    rows, columns = (_banded(taps, side) for side in x.shape[-2:])
    mx, my, xx, yy, xy = (rows @ moments @ columns.T).split(1, dim=1)
    vx, vy, cov = xx - mx * mx, yy - my * my, xy - mx * my
    return (2 * mx * my + _C1) / (mx * mx + my * my + _C1), (2 * cov + _C2) / (vx + vy + _C2)


def _banded(taps: torch.Tensor, side: int) -> torch.Tensor:
    """Return the matrix [side - w + 1, side] that blurs with taps [w] wherever they fit."""
    places = side - len(taps) + 1
    shift = torch.arange(side, device=taps.device) - torch.arange(places, device=taps.device)[:, None]
    inside = (shift >= 0) & (shift < len(taps))
    return torch.where(inside, taps[shift.clamp(0, len(taps) - 1)], 0.0)


def checked(image: torch.Tensor, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return two finite float images [..., H, W] of the same shape and type.

    Raises:
        DataError: The shapes differ, a value is not finite, or the images are integers.
    """
    image, truth = torch.as_tensor(image), torch.as_tensor(truth)
    if image.shape != truth.shape or image.ndim < 2:
        raise DataError(
            f"image {tuple(image.shape)} and truth {tuple(truth.shape)} differ; give two of [..., H, W]"
        )
    if not image.is_floating_point() or not truth.is_floating_point():
        raise DataError(f"image is {image.dtype}, truth {truth.dtype}; give floats, e.g. 8-bit values / 255")
    if not (torch.isfinite(image).all() and torch.isfinite(truth).all()):
        raise DataError("an image holds NaN or infinity; mask or replace those pixels first")
    dtype = torch.promote_types(torch.promote_types(image.dtype, truth.dtype), torch.float32)
    return image.to(dtype), truth.to(dtype)


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
        One value per image, shape [...].

    Raises:
        DataError: The shapes differ, a value is not finite, or the image is too small.

    Example:
        >>> image = torch.linspace(0, 1, 256).reshape(16, 16)
        >>> gmsd(image, image).item()
        0.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    if min(height, width) < 6:
        raise DataError(f"gmsd: image is {height} x {width}; give at least 6 pixels per side")
    m1, m2 = (_magnitude(part.reshape(-1, 1, height, width) / peak) for part in (image, truth))
    similarity = (2 * m1 * m2 + _C) / (m1.square() + m2.square() + _C)
    return similarity.flatten(1).std(dim=1, correction=0).reshape(image.shape[:-2])


def _magnitude(x: torch.Tensor) -> torch.Tensor:
    x = F.avg_pool2d(x, 2)
    across = torch.tensor([[1.0, 0.0, -1.0]] * 3, dtype=x.dtype, device=x.device) / 3
    kernels = torch.stack([across, across.T])[:, None]  # [2, 1, 3, 3]
    # sqrt has no slope at 0; the smallest positive number keeps a gradient finite
    return F.conv2d(x, kernels).square().sum(dim=1).clamp_min(1e-24).sqrt()


_HAAR_C, _HAAR_ALPHA = 30.0, 4.2
HAAR_LEAST_SIDE = 16
"""Smallest side of an image, pixels: three scales of an image halved once."""


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
        One value per image, shape [...]; 1 where neither image holds an edge.

    Raises:
        DataError: The shapes differ, a value is not finite, or the image is too small.

    Example:
        >>> image = torch.linspace(0, 1, 256).reshape(16, 16)
        >>> round(haarpsi(image, image).item(), 6)
        1.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    if min(height, width) < HAAR_LEAST_SIDE:
        raise DataError(
            f"haarpsi: image is {height} x {width}; give at least {HAAR_LEAST_SIDE} pixels per side"
        )
    x, y = (_coefficients(part.reshape(-1, 1, height, width) * (255 / peak)) for part in (image, truth))
    likeness = (2 * x * y + _HAAR_C**2) / (x * x + y * y + _HAAR_C**2)  # [N, scale, orientation, H, W]
    local = torch.sigmoid(_HAAR_ALPHA * likeness[:, :2].mean(dim=1))
    weight = torch.maximum(x[:, 2], y[:, 2])
    total = weight.flatten(1).sum(dim=1)
    mean = (local * weight).flatten(1).sum(dim=1) / total.clamp_min(1e-12)
    found = (torch.logit(mean.clamp(0.5, 1 - 1e-7)) / _HAAR_ALPHA).square()
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


_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_WINDOW = 11


def ms_ssim(image: torch.Tensor, truth: torch.Tensor, *, peak: float = 1.0) -> torch.Tensor:
    """Return the multi-scale structural similarity of each image, in [0, 1].

    MS-SSIM = l_M^w_M prod_j cs_j^w_j: contrast and structure at each of M scales, each half the size of the one
    before, and luminance at the coarsest (Wang, Simoncelli and Bovik, Asilomar 2003, Eq. 7). The published five
    weights need 161 pixels per side; on smaller images as many scales as hold the window of 11 are used, their
    weights scaled to the sum 1, so that figures compare only between images of the same size.

    Args:
        image: Reconstructions [..., H, W].
        truth: True images [..., H, W].
        peak: Dynamic range of the images.

    Returns:
        One value per image, shape [...]. Negative terms count as 0.

    Raises:
        DataError: The shapes differ, a value is not finite, or a side has fewer than 11 pixels.

    Example:
        >>> image = torch.linspace(0, 1, 1024).reshape(32, 32)
        >>> round(ms_ssim(image, image).item(), 6)
        1.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    scales = 0
    while scales < len(_WEIGHTS) and min(height, width) >> scales >= _WINDOW:
        scales += 1
    if not scales:
        raise DataError(f"ms_ssim: image is {height} x {width}; the window needs {_WINDOW} pixels per side")
    x = image.reshape(-1, 1, height, width) / peak  # [N, 1, H, W]
    y = truth.reshape(-1, 1, height, width) / peak  # [N, 1, H, W]
    result = torch.ones(len(x), dtype=x.dtype, device=x.device)
    for scale, weight in enumerate(_WEIGHTS[:scales]):
        if scale:
            x, y = F.avg_pool2d(x, 2), F.avg_pool2d(y, 2)
        luminance, structure = ssim_terms(x, y, _WINDOW)
        term = luminance * structure if scale == scales - 1 else structure
        result = result * term.mean(dim=(1, 2, 3)).clamp_min(0) ** (weight / sum(_WEIGHTS[:scales]))
    return result.reshape(image.shape[:-2])


__all__ = ["HAAR_LEAST_SIDE", "gmsd", "haarpsi", "ms_ssim", "psnr", "ssim", "ssim_map"]
