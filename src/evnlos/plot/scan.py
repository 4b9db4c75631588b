"""The check picture of an imported scan; needs matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from evnlos.plot.figure import new_figure, save_figure
from evnlos.setups.measured_file import Measurement


def draw_scan(path: str | Path, measurement: Measurement, raw: torch.Tensor | None = None) -> Path:
    """Draw four columns of the matrix, the light of all cells, the noise, and the singular values.

    Args:
        path: The picture, PNG or SVG.
        measurement: What was measured.
        raw: The matrix before denoising, [H W, n], for its singular values beside the others.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    shape, plane = measurement.shape, measurement.about.plane
    figure = new_figure((13.0, 6.0))
    axes = figure.subplots(2, 4)
    rows, columns = (sorted({n // 4, n // 2}) for n in plane.shape)
    cells = [(r, c) for r in rows for c in columns][:4]
    for place, (row, column) in zip(axes[0], cells, strict=False):
        light = measurement.matrix[:, row * plane.width + column].reshape(shape)
        _picture(figure, place, light, f"cell ({row}, {column}), white levels")
    for place in axes[0][len(cells) :]:
        place.set_axis_off()
    _picture(figure, axes[1][0], measurement.matrix.sum(dim=1).reshape(shape), "all cells lit")
    noise = torch.where(measurement.bad, torch.nan, measurement.noise)
    _picture(figure, axes[1][1], noise, f"noise of an entry; {int(measurement.bad.sum())} pixels unusable")
    _picture(figure, axes[1][2], measurement.dark, "dark frame, white levels")
    last = axes[1][3]
    if raw is not None and raw.shape[1] == measurement.matrix.shape[1]:
        last.semilogy(_spectrum(raw), label="plain mean of the repeats", color="tab:gray")
    last.semilogy(_spectrum(measurement.matrix), label="as written", color="tab:blue")
    sigma = torch.where(measurement.bad, 0.0, measurement.noise).double()
    edge = float(sigma.max()) * (plane.height * plane.width) ** 0.5 + float(sigma.square().sum().sqrt())
    last.axhline(edge, color="tab:red", linestyle=":", label="largest of noise alone, at most")
    last.set_title("singular values", fontsize=9)
    last.set_ylim(bottom=max(last.get_ylim()[0], 1e-6))
    last.legend(fontsize=7)
    return save_figure(figure, path, dpi=90)


def _picture(figure: Any, axes: Any, image: torch.Tensor, title: str) -> None:
    shown = axes.imshow(np.asarray(image), cmap="gray", interpolation="nearest")
    figure.colorbar(shown, ax=axes, shrink=0.7)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def _spectrum(matrix: torch.Tensor) -> np.ndarray:
    work = matrix.double()
    gram = work.mT @ work if work.shape[1] <= work.shape[0] else work @ work.mT
    return torch.linalg.eigvalsh(gram).flip(0).clamp(min=0).sqrt().numpy()
