"""Image metrics that need no weights, for single images and batches."""

from evnlos.metrics.gradient import gmsd
from evnlos.metrics.haar import haarpsi
from evnlos.metrics.pixelwise import psnr, ssim, ssim_map
from evnlos.metrics.scales import ms_ssim

__all__ = ["gmsd", "haarpsi", "ms_ssim", "psnr", "ssim", "ssim_map"]
