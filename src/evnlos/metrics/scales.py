"""Multi-scale SSIM."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from evnlos.errors import DataError
from evnlos.metrics.pixelwise import checked, ssim_terms

_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_WINDOW = 11


def ms_ssim(image: torch.Tensor, truth: torch.Tensor, *, peak: float = 1.0) -> torch.Tensor:
    """Return the multi-scale structural similarity of each image, in [0, 1].

    MS-SSIM = l_M^w_M prod_j cs_j^w_j: contrast and structure at each of M scales, each half the size of the one
    before, and luminance at the coarsest (Wang, Simoncelli and Bovik, Asilomar 2003, Eq. 7). The published five
    weights need 161 pixels a side; on smaller images as many scales as hold the window of 11 are used, their
    weights scaled to the sum 1, so that figures compare only between images of the same size.

    Args:
        image: Reconstructions [..., H, W].
        truth: True images [..., H, W].
        peak: Dynamic range of the images.

    Returns:
        One value an image, shape [...]. Negative terms count as 0.

    Raises:
        DataError: The shapes differ, a value is not finite, or a side has fewer than 11 pixels.

    Example:
        >>> picture = torch.linspace(0, 1, 1024).reshape(32, 32)
        >>> round(ms_ssim(picture, picture).item(), 6)
        1.0
    """
    image, truth = checked(image, truth)
    height, width = image.shape[-2:]
    scales = 0
    while scales < len(_WEIGHTS) and min(height, width) >> scales >= _WINDOW:
        scales += 1
    if not scales:
        raise DataError(f"ms_ssim: image is {height} x {width}; the window needs {_WINDOW} pixels a side")
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
