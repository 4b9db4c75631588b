"""The wall's kernel: curves, what they do to a letter, and the cosine law beside them (paper Fig. 5)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.plot.figure import new_figure, save_figure
from evnlos.scene import FontGlyphs
from evnlos.transport import DiffuseReflection, tpsf_kernel, tpsf_profile
from evnlos.types import Plane

CURVES = (0.2, 0.4, 0.6, 0.8, 0.9)
"""Mean free paths of the curves, in units of t."""
PICTURES = (0.4, 0.8, 1.2, 1.6)
"""Mean free paths of the pictures, at t = 2."""


def cosine_law(rho: NDArray, height: float, power: int = 3) -> NDArray:
    """Return the light that a point source at a height throws on a plane, over its maximum: cos^power.

    A source that shines alike in all directions gives E ~ cos / r^2, cos^3; one that itself obeys Lambert's law
    gives cos^4.

    Args:
        rho: Distance along the plane from the foot of the source, [...], any unit.
        height: Height of the source, the same unit.
        power: 3 or 4.

    Example:
        >>> cosine_law(np.array([0.0, 1.0]), 1.0).round(4)
        array([1.    , 0.3536])
    """
    return (1 + (rho / height) ** 2) ** (-power / 2)


def blurred(letter: str, mean_free_path: float, t: float = 2.0, side: int = 96) -> NDArray:
    """Return a letter after the convolution with the tPSF, rho in samples of 0.02 as in the paper, [H, W]."""
    name = FontGlyphs(characters=letter)
    target = name.target(name.objects()[0], 0)
    plane = Plane(side, side, target.size_m / side)
    kernel = tpsf_kernel(plane.pitch_m, t=t, mean_free_path=mean_free_path)
    wall = DiffuseReflection(plane, kernel)(torch.from_numpy(target.rasterise(plane)))
    middle, half = [n // 2 for n in wall.shape], side
    image = wall[middle[0] - half : middle[0] + half, middle[1] - half : middle[1] + half]
    return image.numpy() / float(image.max())


def draw_kernel(path: str | Path, letter: str = "R") -> Path:
    """Draw the kernel's curves and a letter behind each of several walls; needs matplotlib.

    Args:
        path: The picture, PNG or SVG.
        letter: What is hidden.

    Returns:
        The path.
    """
    figure = new_figure((10.5, 5.6))
    grid = figure.add_gridspec(2, len(PICTURES), height_ratios=(1.35, 1))
    axes = figure.add_subplot(grid[0, :])
    rho = np.linspace(0, 3, 301)
    for share in CURVES:
        curve = tpsf_profile(torch.from_numpy(rho), 1.0, share).numpy()
        (line,) = axes.plot(rho, curve / curve[0], label=f"tPSF, <l> = {share:g} t")
        law = cosine_law(rho, 1 - share)
        axes.plot(rho, law, "--", color=line.get_color(), linewidth=0.9)
    axes.plot([], [], "k--", linewidth=0.9, label="cosine law, source at t - <l>")
    axes.set(xlabel="rho / t", ylabel="H(rho) / H(0)", xlim=(0, 3), ylim=(0, 1.02))
    axes.legend(frameon=False)
    for column, path_length in enumerate(PICTURES):
        picture = figure.add_subplot(grid[1, column])
        picture.imshow(blurred(letter, path_length), cmap="gray", vmin=0, vmax=1)
        picture.set_title(f"t = 2, <l> = {path_length:g}", fontsize=10)
        picture.set_axis_off()
    return save_figure(figure, path, dpi=110)
