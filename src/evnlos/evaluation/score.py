"""Scores of pictures against the truth: on the whole scored canvas and on the target's own box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from evnlos.metrics import HAAR_LEAST_SIDE, gmsd, haarpsi, ms_ssim, psnr, ssim

Perceptual = Callable[[Tensor, Tensor], Tensor]
_MARGIN = 2  # pixels around the target's bounding box: the blur of its edge belongs to it


@dataclass(frozen=True)
class Scores:
    """Scores of single images, in the order of the images; every array is float64 [N].

    Args:
        psnr_db: On the scored canvas, peak 1.
        ssim: On the scored canvas.
        psnr_box_db: On the smallest box that holds the target, grown by 2 pixels.
        ms_ssim: On the scored canvas, as many scales as it holds.
        haarpsi: On the scored canvas; None where a side has fewer than 16 pixels.
        gmsd: On the scored canvas; smaller is better.
        lpips: With the VGG trunk; None where it is not at hand.
    """

    psnr_db: np.ndarray
    ssim: np.ndarray
    psnr_box_db: np.ndarray
    ms_ssim: np.ndarray
    haarpsi: np.ndarray | None
    gmsd: np.ndarray
    lpips: np.ndarray | None = None

    def mean(self, chosen: np.ndarray | slice = slice(None)) -> dict[str, float | None]:
        """Return the mean over the chosen images, by name of the metric."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: None if v is None else round(float(v[chosen].mean()), 4) for name, v in values.items()}


def score(images: Tensor, truth: Tensor, perceptual: Perceptual | None = None) -> Scores:
    """Score pictures [N, H, W] in 0..1 against true ones, both already cut to the scored rows.

    Args:
        images: Reconstructions.
        truth: True pictures.
        perceptual: LPIPS of [N, 1, H, W] pairs, where its weights are at hand.
    """
    large = min(images.shape[-2:]) >= HAAR_LEAST_SIDE
    boxes = [_box(picture) for picture in truth]
    in_box = [psnr(image[box], picture[box]) for image, picture, box in zip(images, truth, boxes, strict=True)]
    return Scores(
        psnr_db=psnr(images, truth).double().numpy(),
        ssim=ssim(images, truth).double().numpy(),
        psnr_box_db=torch.stack(in_box).double().numpy(),
        ms_ssim=ms_ssim(images, truth).double().numpy(),
        haarpsi=haarpsi(images, truth).double().numpy() if large else None,
        gmsd=gmsd(images, truth).double().numpy(),
        lpips=perceptual(images[:, None], truth[:, None]).double().numpy() if perceptual else None,
    )


def _box(truth: Tensor) -> tuple[slice, slice]:
    """Return the rows and columns of the target; the whole picture where there is none."""
    rows, columns = (torch.nonzero(truth.amax(dim=axis) > 0).flatten() for axis in (1, 0))
    if not len(rows):
        return slice(None), slice(None)
    first = (max(int(rows[0]) - _MARGIN, 0), max(int(columns[0]) - _MARGIN, 0))
    return slice(first[0], int(rows[-1]) + 1 + _MARGIN), slice(first[1], int(columns[-1]) + 1 + _MARGIN)
