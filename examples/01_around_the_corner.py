"""A hidden letter passes behind the corner: its light on the wall, events, their surface, and the letter back.

    python examples/01_around_the_corner.py docs/figures/around_the_corner.webp

Nothing is learned: setup and motion are known, and all frames so far are inverted together.
"""

import sys
from dataclasses import replace

import numpy as np
import torch

from evnlos import EventCamera, EventPixel, FrameCamera, Scene, Target, psnr, time_surface
from evnlos.data import Sampling, object_light
from evnlos.inverse import SequenceOperator, SequenceProblem
from evnlos.inverse.sequence_problem import strip_gram_of
from evnlos.plot.figures import Column, film, signed_images, slice_images
from evnlos.report.pictures import grey, save_animation
from evnlos.scene import FontGlyphs
from evnlos.setups import load_setup
from evnlos.types import Plane

SHAPE, CANVAS = (40, 64), Sampling()
scene = Scene(FontGlyphs(family="Nunito Black").target("nunito_black_R"))  # 8 cm, 2 cm/s, 16 cm of travel
setup = replace(load_setup("main-near"), cell_m=0.005).resized(SHAPE)  # rough aluminium, 0.30 m away
times_s = scene.position_times_s(40)
places = scene.motion.position_m(times_s)

wall = setup.observe(scene)
frames = FrameCamera(exposure_s=0.016).capture(wall, times_s, seed=1)
events = EventCamera(EventPixel(cutoff_hz=15)).record(wall, 0, 8, seed=1)
edges_us = np.r_[0, 1e6 * times_s].astype(np.int64)
surface = time_surface(events, edges_us, tau_us=200_000)

camera = setup.operator(setup.target_cells())
light, target_plane, gram = object_light(frames, 255, setup, SHAPE), Plane(16, 16, 0.005), strip_gram_of(camera)
truth = scene.truth(CANVAS.canvas, times_s)[:, CANVAS.scored]
found = np.zeros_like(truth)
for k in range(40) if len(sys.argv) > 1 else (0, 39):
    problem = SequenceProblem(SequenceOperator(camera, target_plane, places[: k + 1]), strip_gram=gram)
    image = problem.tikhonov(light[: k + 1], 1e-3).image.clamp(0, 1).float()
    drawn = Target("found", image.numpy(), 0.08).rasterise(CANVAS.canvas, places[k : k + 1])
    found[k] = drawn[0][CANVAS.scored]
scores = psnr(torch.from_numpy(found), torch.from_numpy(truth))
print(f"{len(events):,} events; PSNR from 1 frame {scores[0]:.1f} dB, from 40 frames {scores[-1]:.1f} dB")
assert scores[-1] > scores[0] + 2
if len(sys.argv) > 1:
    low, high = np.percentile(frames, [0.5, 99.8])
    columns = [
        Column("hidden object", "24 cm around the corner", grey(truth)),
        Column("wall", "what the frame camera sees", grey(frames, low, high)),
        Column("events", "orange brighter, blue darker", slice_images(events, edges_us)),
        Column("time surface", "fades in 0.2 s", signed_images(surface, 1.0, faintest=0.0)),
        Column("found", "all frames so far, inverted", grey(found)),
    ]
    save_animation(sys.argv[1], film(columns, 190, "dark"), 10)
