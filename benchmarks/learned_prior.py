"""What a learned prior adds to a Gaussian one, and whether its intervals hold, on targets that neither knows.

    python benchmarks/learned_prior.py [SETUP] [--each 12]

The light path is that of a setup, whose frames of one sequence say A and b of a target's coefficients; b is
drawn exactly as the frames' noise has it, at the light of the setup and at less. Targets are letters by hands
that are held out, and drawings of other numbers than those learned from. Printed, of each: PSNR on the target's
cells of the Gaussian estimate, of the mean of the learned prior's samples and of one sample; the share of cells
within the 90 % interval of the samples, of all and of open ones (intervals above 0.2), and how many are open.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch

from evnlos.inverse import FrameTerm, sequence_light
from evnlos.inverse.event_images import CELLS, event_prior
from evnlos.inverse.prior import PatternPrior
from evnlos.metrics import psnr
from evnlos.models import TargetLikelihood, load_prior, posterior_samples
from evnlos.models.posterior import OPEN, interval_of
from evnlos.scene import TRAIN_WRITERS, HandwritingGlyphs, LineMotion
from evnlos.scene.glyph_sets import DrawingGlyphs
from evnlos.setups import load_setup
from evnlos.types import Plane

SHAPE = (100, 160)
LIGHT = (1.0, 0.1, 0.01)
SIDE_M, SPAN_S, FRAMES = 0.08, (0.0, 8.0), 40


def information_of(setup_name: str, basis: PatternPrior) -> np.ndarray:
    """Return what the frames of one pass say of the coefficients, [k, k]."""
    setup = load_setup(setup_name)
    light = sequence_light(setup.seen_by(SHAPE), basis, LineMotion().position_m, SPAN_S, SHAPE)
    blank = np.full((FRAMES, SHAPE[0] * SHAPE[1]), 0.1)
    term = FrameTerm(light, blank, np.linspace(*SPAN_S, FRAMES), setup.frame_camera, False, setup.frame_doubt)
    return term.normal.information


def row_of(
    name: str, targets: np.ndarray, basis: PatternPrior, information: np.ndarray, prior_name: str
) -> str:
    """Return the row of a table for targets [N, h, w] at one light."""
    draw, prior = np.random.default_rng(3), load_prior(prior_name)
    values, axes = np.linalg.eigh(information)
    root = axes * np.sqrt(values.clip(0))
    found, held, open_cells, began = [], [], [], time.perf_counter()
    for number, truth in enumerate(targets):
        score = information @ basis.coefficients(truth) + root @ draw.standard_normal(len(values))
        z = np.linalg.solve(information + np.eye(len(values)), score)
        samples = posterior_samples(prior, TargetLikelihood(basis, information, score), seed=number)
        seen = torch.from_numpy(truth).float()
        images = torch.from_numpy(basis.image(z)).float().clamp(0, 1), samples.mean(dim=0), samples[0]
        found.append([float(psnr(one[None], seen[None])) for one in images])
        low, high = interval_of(samples.double().numpy())
        inside, is_open = (truth >= low) & (truth <= high), high - low > OPEN
        held.append(float(inside.mean()))
        open_cells.append((int((inside & is_open).sum()), int(is_open.sum())))
    mean = np.mean(found, axis=0)
    inside, total = np.sum(open_cells, axis=0)
    seconds = (time.perf_counter() - began) / len(targets)
    return (
        f"| {name} | {mean[0]:.2f} | {mean[1]:.2f} | {mean[2]:.2f} | {100 * np.mean(held):.0f} % "
        f"| {100 * inside / max(total, 1):.0f} % | {100 * total / targets.size:.0f} % | {seconds:.0f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    near = Path(__file__).parent.parent / "packages/evnlos-weights/src/evnlos_weights/near.yaml"
    parser.add_argument("setup", nargs="?", default=str(near), help="a setup, as of `evnlos invert`")
    parser.add_argument("--prior", default="targets", help="name or file of the learned prior")
    parser.add_argument("--each", type=int, default=12, help="targets of each kind")
    options = parser.parse_args()
    torch.set_num_threads(1)
    basis = event_prior(load_setup(options.setup), SIDE_M)
    hands = HandwritingGlyphs(characters="HSU5", writers=options.each, first_writer=TRAIN_WRITERS)
    sets = {"letters": hands, "drawings": DrawingGlyphs(each=-(-options.each // 6), first=0)}
    information = information_of(options.setup, basis)
    sys.stdout.write(
        "| targets, light | Gaussian, dB | learned: mean | one sample | in 90 % | of open | open | s |\n"
        "|---|---|---|---|---|---|---|---|\n"
    )
    for kind, glyphs in sets.items():
        names = glyphs.objects()[:: max(1, len(glyphs.objects()) // options.each)][: options.each]
        masks = [glyphs.target(name) for name in names]
        drawn = np.stack([one.rasterise(Plane(CELLS, CELLS, one.size_m / CELLS)) for one in masks]).astype(
            float
        )
        for share in LIGHT:
            # of the same signal to noise as this share of the light: A falls with it
            row = row_of(f"{kind}, {share:g}", drawn, basis, share * information, options.prior)
            sys.stdout.write(row + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
