"""Train the learned prior of targets: a network that takes noise out of letters and drawings.

    python tools/train_prior.py packages/evnlos-weights/src/evnlos_weights/priors/targets.safetensors

It learns from letters by many hands and in print, without A G K S 2 4 9, and from drawings, in grey too, each
shifted, scaled, turned, slanted, bent, thicker or thinner anew. Letters of hands 39 and above and drawings 0 to
99 of each kind are not among them (`benchmarks/learned_prior.py` asks for these).
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from evnlos.inverse.prior import TRAIN_CHARACTERS
from evnlos.models import AboutPrior, LearnedPrior, save_prior
from evnlos.scene import TRAIN_WRITERS, HandwritingGlyphs, Strokes
from evnlos.scene.databases import TargetPlane
from evnlos.scene.glyph_sets import DrawingGlyphs

_SIDE, _POPULATIONS, _DRAWINGS = 64, 3, 300  # pixels; seeds of the hands; drawings of each kind
_LETTERS, _AS_DRAWN, _GREY = 0.6, 0.5, 0.15  # shares: of letters, of targets at full size, of dimmer ones
_TURN, _PLACE, _SLANT = 0.06, 0.08, 0.03  # standard deviations: radians, half sides, of the affine matrix
_BEND, _KNOTS, _PEN = 0.035, 5, 0.4  # of the bends, half sides; their knots along a side; share of other pens
_RATE, _WARM, _KEPT = 2e-3, 200, 0.999


def drawn() -> tuple[Tensor, int]:
    """Return targets [M, 64, 64], 0..1, and how many of them, the first, are letters."""
    plane, masks = TargetPlane(size_px=_SIDE), list[np.ndarray]()
    hands = HandwritingGlyphs(
        characters=TRAIN_CHARACTERS, writers=TRAIN_WRITERS, strokes=Strokes(faces="both"), target_plane=plane
    )
    for seed in range(_POPULATIONS):
        masks += [hands.target(name, seed).mask for name in tqdm(hands.objects(), desc=f"hands {seed}")]
    letters = len(masks)
    drawings = DrawingGlyphs(each=_DRAWINGS, first=100, target_plane=plane)
    masks += [drawings.target(name).mask for name in drawings.objects()]
    return torch.from_numpy(np.stack(masks)).mul(255).round() / 255, letters


def batch(masks: Tensor, letters: int, count: int, draw: torch.Generator) -> Tensor:
    """Return targets as the network learns them, [count, 1, 32, 32], 0..1."""
    chosen = torch.where(
        torch.rand(count, generator=draw) < _LETTERS,
        torch.randint(letters, (count,), generator=draw),
        letters + torch.randint(len(masks) - letters, (count,), generator=draw),
    )
    smaller = torch.rand(count, generator=draw) * 0.7 + 0.9
    size = torch.where(torch.rand(count, generator=draw) < _AS_DRAWN, torch.ones(count), smaller)
    angle = torch.randn(count, generator=draw) * _TURN
    affine = torch.zeros(count, 2, 3)
    affine[:, 0, 0], affine[:, 0, 1] = size * angle.cos(), -size * angle.sin()
    affine[:, 1, 0], affine[:, 1, 1] = size * angle.sin(), size * angle.cos()
    affine[:, :, 2] = torch.randn(count, 2, generator=draw) * _PLACE
    affine[:, :, :2] += torch.randn(count, 2, 2, generator=draw) * _SLANT
    grid = F.affine_grid(affine, [count, 1, _SIDE, _SIDE], align_corners=False)
    knots = _BEND * torch.randn(count, 2, _KNOTS, _KNOTS, generator=draw)
    bends = F.interpolate(knots, (_SIDE, _SIDE), mode="bicubic", align_corners=True)
    bent = F.grid_sample(masks[chosen][:, None], grid + bends.permute(0, 2, 3, 1), align_corners=False)
    thick, thin = F.max_pool2d(bent, 3, stride=1, padding=1), -F.max_pool2d(-bent, 3, stride=1, padding=1)
    pen = torch.rand(count, 1, 1, 1, generator=draw)
    bent = torch.where(pen < _PEN / 2, thick, torch.where(pen < _PEN, thin, bent))
    cells = F.avg_pool2d(bent, 2)
    is_grey = torch.rand(count, generator=draw) < _GREY
    level = torch.where(is_grey, torch.rand(count, generator=draw) * 0.7 + 0.3, torch.ones(count))
    return cells * level[:, None, None, None]


def trained(about: AboutPrior, steps: int, size: int) -> LearnedPrior:
    """Return the network after so many steps with batches of a size: the mean of its last ones.

    The loss is |D(x + s n, s) - x|^2, s log-uniform, weighted by 1 / s^2 + 16, at most 400.
    """
    torch.manual_seed(0)
    masks, letters = drawn()
    prior, draw = LearnedPrior(about).train(), torch.Generator().manual_seed(1)
    prior.unet.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(prior.parameters(), lr=_RATE, weight_decay=1e-3)
    kept = [value.detach().clone() for value in prior.parameters()]
    low, high = math.log(about.least_noise), math.log(about.most_noise)
    for step in (bar := tqdm(range(steps), unit="step", desc="prior")):
        clean = batch(masks, letters, size, draw)
        noise = torch.exp(torch.rand(size, 1, 1, 1, generator=draw) * (high - low) + low)
        noisy = clean + noise * torch.randn(clean.shape, generator=draw)
        errors = (prior(noisy[:, 0], noise.flatten()) - clean[:, 0]).square().mean(dim=(1, 2))
        loss = ((1 / noise.flatten() ** 2 + 16).clamp_max(400) * errors).mean()
        for group in optimiser.param_groups:
            group["lr"] = _RATE * min(1, step / _WARM) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(prior.parameters(), 1.0)
        optimiser.step()
        with torch.no_grad():
            for mean, value in zip(kept, prior.parameters(), strict=True):
                mean.lerp_(value, 1 - min(_KEPT, (step + 1) / (step + 10)))
        if step % 100 == 0:
            bar.set_postfix(loss=f"{float(loss.detach()):.3f}")
    for mean, value in zip(kept, prior.parameters(), strict=True):
        value.data.copy_(mean)
    return prior.eval()


def main() -> None:
    """Train the prior and write it to the file that is named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="file of the prior")
    parser.add_argument("--steps", type=int, default=12000, help="steps of the training")
    parser.add_argument("--batch", type=int, default=32, help="targets a step")
    parser.add_argument("--width", type=int, default=32, help="channels of the network")
    options = parser.parse_args()
    known = f"{TRAIN_CHARACTERS} by {TRAIN_WRITERS} hands and in print, and drawings"
    save_prior(options.out, trained(AboutPrior(options.width, 32, known), options.steps, options.batch))


if __name__ == "__main__":
    main()
