"""Reconstructions of a hidden screen side by side; needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.plot.figure import new_figure, save_figure


def draw_inversion(path: str | Path, panels: Sequence[tuple[str, torch.Tensor]]) -> Path:
    """Draw pictures [channels, h, w] in a row under their titles.

    Each is drawn from 0 to its own 99.5th percentile: how bright the screen was is not known.

    Args:
        path: The picture, PNG or SVG.
        panels: Titles and images, one or three channels.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure((3.1 * len(panels), 3.0))
    for axes, (title, image) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.imshow(as_picture(image), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    return save_figure(figure, path, dpi=100)


def as_picture(image: torch.Tensor) -> NDArray[np.float64]:
    """Return an image [channels, h, w] as [h, w] or [h, w, 3] in 0..1, 1 its 99.5th percentile."""
    picture = image.detach().double().clamp(min=0).numpy()
    picture = np.clip(picture / max(float(np.quantile(picture, 0.995)), 1e-12), 0, 1)
    return picture[0] if len(picture) == 1 else np.moveaxis(picture[:3], 0, -1)
