"""What does the wall's kernel do, and how near is it to Lambert's cosine law?

    python examples/02_diffuse_kernel.py docs/figures/diffuse_kernel.png

The paper shows curves and images for several mean free paths <l> and calls the curve very similar to
Lambert's cosine law. Each term of the tPSF is such a law, for a point source at the depth <l> + k t; the
nearest one, k = -1, lies at t - <l>. So the likeness is exact for one term; what do the others add?
"""

import sys

import numpy as np
import torch

from evnlos.optics import DiffuseReflection, tpsf_kernel, tpsf_profile
from evnlos.plot.figures import new_figure, save_figure
from evnlos.scene import FontGlyphs
from evnlos.types import Plane

CURVES, PICTURES = (0.2, 0.4, 0.6, 0.8, 0.9), (0.4, 0.8, 1.2, 1.6)  # <l>/t of the curves, <l> of the images


def cosine_law(rho, height):
    """Return what a point source at a height throws on a plane, over its maximum: E ~ cos / r^2, or cos^3."""
    return (1 + (rho / height) ** 2) ** -1.5


rho = np.linspace(0, 2, 201)
print("<l>/t   H(0)     half at rho/t   cos^3 at t - <l>: largest difference   best height   then")
worst = {}
for share in CURVES:
    curve = tpsf_profile(torch.from_numpy(rho), 1.0, share).numpy()
    shape = curve / curve[0]
    half = float(np.interp(-0.5, -shape, rho))
    nearest = float(np.abs(shape - cosine_law(rho, 1 - share)).max())
    heights = np.linspace(0.05, 1.5, 1451)
    misses = np.array([np.abs(shape - cosine_law(rho, h)).max() for h in heights])
    best, worst[share] = heights[misses.argmin()], float(misses.min())
    print(f"{share:5.1f}  {curve[0]:7.3f}  {half:10.3f}  {nearest:28.3f}  {best:24.3f}  {worst[share]:8.3f}")

assert max(worst.values()) < 0.09  # similar, not equal
if len(sys.argv) > 1:
    figure, rho = new_figure((10.5, 5.6)), np.linspace(0, 3, 301)
    grid = figure.add_gridspec(2, 4, height_ratios=(1.35, 1))
    axes = figure.add_subplot(grid[0, :])
    for share in CURVES:
        curve = tpsf_profile(torch.from_numpy(rho), 1.0, share)
        (line,) = axes.plot(rho, curve / curve[0], label=f"tPSF, <l> = {share:g} t")
        axes.plot(rho, cosine_law(rho, 1 - share), "--", color=line.get_color(), linewidth=0.9)
    axes.set(xlabel="rho / t", ylabel="H(rho) / H(0); dashed: cosine law", xlim=(0, 3), ylim=(0, 1.02))
    axes.legend()
    plane, letters = Plane(96, 96, 0.08 / 96), FontGlyphs(characters="R")
    letter = torch.from_numpy(letters.target(letters.objects()[0], 0).rasterise(plane))
    for column, path_length in enumerate(PICTURES):
        wall = DiffuseReflection(plane, tpsf_kernel(plane.pitch_m, t=2.0, mean_free_path=path_length))(letter)
        axes = figure.add_subplot(grid[1, column], title=f"t = 2, <l> = {path_length:g}")
        axes.imshow(wall[tuple(slice(n // 2 - 96, n // 2 + 96) for n in wall.shape)], cmap="gray", vmin=0)
        axes.axis("off")
    save_figure(figure, sys.argv[1], dpi=110)
