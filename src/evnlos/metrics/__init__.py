"""Image metrics that need no weights, for single images and batches."""

from evnlos.metrics.gradient import gmsd
from evnlos.metrics.haar import HAAR_LEAST_SIDE, haarpsi
from evnlos.metrics.pixelwise import psnr, ssim, ssim_map
from evnlos.metrics.scales import ms_ssim

__all__ = ["HAAR_LEAST_SIDE", "gmsd", "haarpsi", "ms_ssim", "psnr", "ssim", "ssim_map"]
