"""What does the wall's kernel do, and how near is it to Lambert's cosine law?

    python examples/02_diffuse_kernel.py docs/figures/diffuse_kernel.png

The paper shows curves and images for several mean free paths <l> and calls the curve very similar to
Lambert's cosine law. Each term of the tPSF is such a law, for a point source at the depth <l> + k t; the
nearest one, k = -1, lies at t - <l>. So the likeness is exact for one term; what do the others add?
"""

import sys

import numpy as np
import torch

from evnlos.optics import tpsf_profile
from evnlos.plot.setup import CURVES, cosine_law, draw_kernel

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
    worst[share] = float(misses.min())
    best = float(heights[misses.argmin()])
    print(f"{share:5.1f}  {curve[0]:7.3f}  {half:10.3f}  {nearest:28.3f}  {best:24.3f}  {worst[share]:8.3f}")

assert max(worst.values()) < 0.09  # similar, not equal
if len(sys.argv) > 1:
    print(draw_kernel(sys.argv[1]))
