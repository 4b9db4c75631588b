"""What a rig can show, drawn: singular values, Picard plot, modes, and the best linear picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evnlos.plot.figure import new_figure, save_figure, signed_map

if TYPE_CHECKING:
    from evnlos.evaluation.identify import Identification

_FLOOR = 1e-7


def draw_identification(found: Identification, path: str | Path) -> Path:
    """Draw singular values, the Picard plot of a typical plate, the first modes, truth and linear picture.

    Args:
        found: What `identify` returned.
        path: The picture, PNG or SVG.

    Returns:
        The path.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
    """
    figure = new_figure((10.5, 6.2))
    grid = figure.add_gridspec(2, 1, height_ratios=(1.5, 1))
    curves, pictures = grid[0].subgridspec(1, 2), grid[1].subgridspec(2, 6)
    _singular_values(figure.add_subplot(curves[0]), [found])
    _picard(figure.add_subplot(curves[1]), found)
    at = found.at_camera
    for row, (image, title) in enumerate(((found.truth, "truth"), (at.picture, "best linear"))):
        _picture(figure.add_subplot(pictures[row, 0]), image, title)
    for k, mode in enumerate(at.modes):
        place = figure.add_subplot(pictures[k // 4, 1 + k % 4])
        _picture(place, mode, f"mode {k + 1}", signed_map(), float(mode.abs().max()))
    words = figure.add_subplot(pictures[:, 5])
    words.set_axis_off()
    strokes = " x ".join("none" if w is None else f"{1e3 * w:.1f}" for w in at.stroke_m)
    words.text(
        0.0,
        0.5,
        f"{found.modes} modes > 1e-2\n{at.patterns} patterns > noise\nbars {strokes} mm\n"
        f"linear {at.psnr_db:.1f} dB\nmean {found.mean_db:.1f} dB\nblack {found.zero_db:.1f} dB\n"
        "modes: light > 0 > dark",
        va="center",
        fontsize=9,
    )
    figure.suptitle(found.name)
    return save_figure(figure, path, dpi=100)


def draw_rigs(found: Sequence[Identification], path: str | Path) -> Path:
    """Draw the singular values of several rigs in one plot.

    Args:
        found: The rigs.
        path: The picture, PNG or SVG.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
    """
    figure = new_figure((8.0, 4.6))
    _singular_values(figure.add_subplot(), found)
    return save_figure(figure, path, dpi=100)


def _singular_values(axes: Any, found: Sequence[Identification]) -> None:
    walls = list(dict.fromkeys(one.name.partition("-")[0] for one in found))
    for one in found:
        values = one.singular.numpy()
        wall, _, place = one.name.partition("-")
        style = {"color": f"C{walls.index(wall)}", "linestyle": "--" if place == "far" else "-", "lw": 1.2}
        axes.semilogy(np.arange(1, len(values) + 1), _above(values, _FLOOR), label=one.name, **style)
    axes.axhline(1e-2, color="k", lw=0.7, ls=":")
    axes.set(xlabel="mode", ylabel="singular value / largest", ylim=(_FLOOR, 1.5), xscale="log")
    axes.legend(frameon=False, fontsize=8, ncols=2 if len(found) > 6 else 1)


def _picard(axes: Any, found: Identification) -> None:
    at = found.at_camera
    mode = np.arange(1, len(at.spectrum) + 1)
    axes.semilogy(mode, _above(at.spectrum.numpy(), 1e-3), label="singular value / noise", lw=1.2)
    axes.semilogy(mode, _above(at.picard.numpy(), 1e-3), ".", ms=3, label="a letter's coefficient / noise")
    axes.axhline(1.0, color="k", lw=0.7, ls=":", label="noise")
    axes.set(xlabel="mode", xscale="log", ylim=(1e-3, None))
    axes.legend(frameon=False, fontsize=8)


def _above(values: Any, floor: float) -> Any:
    """Return the values with NaN, which is not drawn, below a floor."""
    return np.where(values > floor, values, np.nan)


def _picture(axes: Any, image: Any, title: str, cmap: Any = "gray", largest: float | None = None) -> None:
    low, high = (0.0, 1.0) if largest is None else (-largest, largest)
    axes.imshow(image.numpy(), cmap=cmap, vmin=low, vmax=high)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()
