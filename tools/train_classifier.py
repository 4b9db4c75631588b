"""Train the character reader on clean glyphs of many hands, degraded at random.

    python tools/train_classifier.py classifier.safetensors

It never sees a reconstruction, nor the typeface of the standard captures: what it says of a reconstruction is
independent of how that was made.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from evnlos.analysis.scores import CHARACTERS, CharacterReader
from evnlos.files import write_atomically
from evnlos.models.confidence import SIDE
from evnlos.scene import FontGlyphs, HandwritingGlyphs
from evnlos.tensor_file import sealed_bytes
from evnlos.types import Plane, derive_seed

FAMILIES = (
    "Caveat",
    "Caveat Bold",
    "Kalam",
    "Kalam Bold",
    "Indie Flower",
    "Permanent Marker",
    "Shadows Into Light",
    "Fredoka",
    "Nunito",
    "Nunito Bold",
    "Quicksand",
    "Quicksand Bold",
    "Varela Round",
)
_REPEATS = 4  # a typeface counts as much as so many writers
_DRAWN = 2 * SIDE  # glyphs are drawn at twice the size, so that turning them keeps their edges


def clean_glyphs(
    writers: int, first_writer: int = 0, families: tuple[str, ...] = FAMILIES
) -> tuple[Tensor, Tensor]:
    """Return glyphs [N, 1, 64, 64] in 0..1 and the number of each character in `CHARACTERS`, [N]."""
    sets = [HandwritingGlyphs(characters=CHARACTERS, writers=writers, first_writer=first_writer)]
    sets += [FontGlyphs(family=name, characters=CHARACTERS) for name in families]
    plane = Plane(_DRAWN, _DRAWN, 0.08 / _DRAWN)
    pictures, labels = [], []
    for glyphs in sets:
        for name in glyphs.objects():
            pictures.append(glyphs.target(name, 0).rasterise(plane))
            labels.append(CHARACTERS.index(name.rsplit("_", 1)[1]))
    return torch.from_numpy(np.stack(pictures))[:, None], torch.tensor(labels)


def degrade(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """Return glyphs [N, 1, 32, 32] as a poor reconstruction may show them: moved, bolder, blurred, noisy."""
    count = len(pictures)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    angle, size = uniform(-0.15, 0.15), uniform(0.9, 1.35)
    dx, dy, lean = uniform(-0.12, 0.12), uniform(-0.12, 0.12), uniform(-0.15, 0.15)
    rows = torch.stack(
        [size * angle.cos(), -size * (angle.sin() + lean), dx, size * angle.sin(), size * angle.cos(), dy],
        dim=1,
    )
    grid = F.affine_grid(rows.reshape(-1, 2, 3), [count, 1, _DRAWN, _DRAWN], align_corners=False)
    moved = F.grid_sample(pictures, grid, align_corners=False)
    bold = int(torch.randint(0, 4, (), generator=generator))
    if bold:
        moved = F.max_pool2d(moved, 2 * bold + 1, stride=1, padding=bold)
    small = F.avg_pool2d(moved, 2)
    sigma = float(torch.rand((), generator=generator)) * 2.5 + 0.1
    taps = torch.exp(-torch.arange(-7, 8).float().square() / (2 * sigma**2))
    taps = taps / taps.sum()
    blurred = F.conv2d(
        F.conv2d(small, taps.reshape(1, 1, 1, -1), padding=(0, 7)), taps.reshape(1, 1, -1, 1), padding=(7, 0)
    )
    noise = torch.randn(blurred.shape, generator=generator) * uniform(0, 0.15).reshape(-1, 1, 1, 1)
    return (blurred * uniform(0.5, 1.0).reshape(-1, 1, 1, 1) + noise).clamp(0, 1)


def train_reader(
    writers: int = 36, epochs: int = 40, seed: int = 0, families: tuple[str, ...] = FAMILIES
) -> tuple[CharacterReader, dict]:
    """Train the reader; return it and what a user of the file must know.

    Args:
        writers: Writers of the simulated hand; the two behind them are for validation.
        epochs: Passes over the glyphs, each time degraded anew.
        seed: Seed of weights, order and degradation.
        families: Typefaces beside the writers.

    Returns:
        The network, and a record with its accuracy on clean and degraded glyphs of writers that it never saw.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "reader"))
        network = CharacterReader()
    generator = torch.Generator().manual_seed(derive_seed(seed, "degrade"))
    pictures, labels = clean_glyphs(writers, families=families)
    drawn = torch.cat(
        [
            torch.arange(len(pictures)),
            torch.arange(len(CHARACTERS) * writers, len(pictures)).repeat(_REPEATS - 1),
        ]
    )
    held, answers = clean_glyphs(2, writers, ())
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-2)
    steps = epochs * -(-len(drawn) // 64)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    for _ in tqdm(range(epochs), unit="epoch", desc="reader"):
        for batch in drawn[torch.randperm(len(drawn), generator=generator)].split(64):
            loss = F.cross_entropy(network(degrade(pictures[batch], generator)), labels[batch])
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
    network.eval()
    with torch.inference_mode():
        clean = (network(F.avg_pool2d(held, 2)).argmax(dim=1) == answers).float().mean().item()
        poor = torch.stack([network(degrade(held, generator)).argmax(dim=1) == answers for _ in range(10)])
    about = {
        "characters": CHARACTERS,
        "trained_on": f"{writers} writers and {', '.join(families)}",
        "epochs": epochs,
        "seed": seed,
        "accuracy_clean": round(clean, 4),
        "accuracy_degraded": round(poor.float().mean().item(), 4),
    }
    return network, about


def main() -> None:
    """Train the reader and write it to the file that is named on the command line."""
    network, about = train_reader()
    state = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    write_atomically(Path(sys.argv[1]), sealed_bytes(state, json.dumps(about)))
    sys.stdout.write(json.dumps(about, indent=2) + "\n")


if __name__ == "__main__":
    main()
