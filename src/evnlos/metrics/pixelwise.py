"""PSNR and SSIM."""

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
        One value an image, shape [...]; infinite where the two are equal.

    Raises:
        DataError: The shapes differ, or a value is not finite.

    Example:
        >>> psnr(torch.zeros(8, 8), torch.full((8, 8), 0.1)).item()
        20.0
    """
    image, truth = checked(image, truth)
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
        One value an image, shape [...].

    Raises:
        DataError: The shapes differ, a value is not finite, or the image is smaller than the window.

    Example:
        >>> picture = torch.linspace(0, 1, 256).reshape(16, 16)
        >>> round(ssim(picture, picture).item(), 6)
        1.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    if min(height, width) < window:
        raise DataError(
            f"ssim: image is {height} x {width}; the window of {window} needs {window} pixels a side"
        )
    x = image.reshape(-1, 1, height, width) / peak  # [N, 1, H, W]
    y = truth.reshape(-1, 1, height, width) / peak  # [N, 1, H, W]
    return ssim_map(x, y, window, sigma).mean(dim=(-3, -2, -1)).reshape(image.shape[:-2])


def ssim_map(x: torch.Tensor, y: torch.Tensor, window: int = 11, sigma: float = 1.5) -> torch.Tensor:
    """Return the SSIM at each position of the window: x, y [N, 1, H, W] in 0..1 -> [N, 1, H-w+1, W-w+1]."""
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
    rows = taps.reshape(1, 1, -1, 1).expand(5, 1, window, 1)
    columns = taps.reshape(1, 1, 1, -1).expand(5, 1, 1, window)
    blurred = F.conv2d(F.conv2d(moments, rows, groups=5), columns, groups=5)
    mx, my, xx, yy, xy = blurred.split(1, dim=1)
    vx, vy, cov = xx - mx * mx, yy - my * my, xy - mx * my
    return (2 * mx * my + _C1) / (mx * mx + my * my + _C1), (2 * cov + _C2) / (vx + vy + _C2)


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
