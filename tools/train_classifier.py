"""Train the character reader on print and handwriting faces that nothing else here uses, degraded at random.

    python tools/train_classifier.py classifier.safetensors --captures ../shared/data/captures

The faces are of the Debian packages in `PACKAGES`, below /usr/share/fonts or below `--fonts FOLDER`. No glyph
to pre-train on and no capture is drawn with them, and the reader never sees a reconstruction: what it says of
one is independent of how that was made. Printed: how often it is right on faces that it never saw, on hands
like those of the pre-training, and on the true images of captures, and which characters it takes for which.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from evnlos.analysis.scores import CHARACTERS, CharacterReader
from evnlos.data import character_of
from evnlos.files import write_atomically
from evnlos.models.confidence import SIDE
from evnlos.scene import FontGlyphs, HandwritingGlyphs, Target
from evnlos.scene.glyph_sets import GlyphSet
from evnlos.tensor_file import sealed_bytes
from evnlos.types import Plane, derive_seed
from evnlos.untrusted import open_image

PACKAGES = {
    "fonts-averia-sans-gwf": ("AveriaSansGWF-Bold.ttf", "AveriaSansGWF-Regular.ttf"),
    "fonts-beteckna": ("Beteckna.ttf", "BetecknaGS-Bold.ttf"),
    "fonts-breip": ("Breip.ttf",),
    "fonts-bwht": (
        "BecauseWeBuild-Regular.otf",
        "BecauseWeConnect-Regular.otf",
        "BecauseWeCreate-Regular.otf",
        "BecauseWeLearn-Regular.otf",
        "BecauseWeMentor-Regular.otf",
        "BecauseWeOrganize-Regular.otf",
    ),
    "fonts-cabin": ("Cabin-Bold.otf", "Cabin-Regular.otf"),
    "fonts-cantarell": ("Cantarell-ExtraBold.otf", "Cantarell-Regular.otf"),
    "fonts-comfortaa": ("Comfortaa-Bold.ttf", "Comfortaa-Regular.ttf"),
    "fonts-dejavu-core": ("DejaVuSans-Bold.ttf", "DejaVuSans.ttf"),
    "fonts-dkg-handwriting": ("dkg.ttf", "dkgBd.ttf"),
    "fonts-dosis": ("Dosis-Bold.otf", "Dosis-Medium.otf"),
    "fonts-eurofurence": ("eurof55.ttf", "eurof75.ttf"),
    "fonts-humor-sans": ("Humor-Sans.ttf",),
    "fonts-jura": ("Jura-Bold.otf", "Jura-Medium.otf"),
    "fonts-karla": ("Karla-Bold.otf", "Karla-Regular.otf"),
    "fonts-klee": ("KleeOne-Regular.ttf", "KleeOne-SemiBold.ttf"),
    "fonts-lato": ("Lato-Black.ttf", "Lato-Regular.ttf"),
    "fonts-liberation": ("LiberationSans-Bold.ttf", "LiberationMono-Bold.ttf", "LiberationSerif-Bold.ttf"),
    "fonts-manrope": ("Manrope-ExtraBold.ttf", "Manrope-Medium.ttf"),
    "fonts-open-sans": ("OpenSans-Bold.ttf", "OpenSans-CondBold.ttf", "OpenSans-Regular.ttf"),
    "fonts-play": ("Play-Bold.ttf", "Play-Regular.ttf"),
    "fonts-rufscript": ("Rufscript010.ttf",),
    "fonts-sjfonts": ("Delphine.ttf", "SteveHand.ttf"),
    "fonts-tomsontalks": ("TomsonTalks.ttf",),
}
"""Debian packages and the files of their faces to learn from."""
HELD = {
    "fonts-clear-sans": ("ClearSans-Bold.ttf",),
    "fonts-roboto-unhinted": ("Roboto-Bold.ttf", "Roboto-Regular.ttf"),
    "fonts-yusei-magic": ("YuseiMagic-Regular.ttf",),
}
"""Those to measure with."""
FONTS = Path("/usr/share/fonts")
_DRAWN = 2 * SIDE  # glyphs are drawn at twice the size, so that turning them keeps their edges
_WAVES = 3  # cosines a direction and axis of the elastic deformation


def faces(packages: dict[str, tuple[str, ...]], folder: Path = FONTS) -> tuple[str, ...]:
    """Return the paths of the faces of Debian packages.

    Args:
        packages: Name of each package -> names of its files.
        folder: Where they are installed or unpacked.

    Raises:
        SystemExit: A file is not there; names its package.
    """
    there = {path.name: str(path) for path in sorted(folder.rglob("*.?tf"))}
    for package, names in packages.items():
        if missing := [name for name in names if name not in there]:
            raise SystemExit(f"{folder} holds no {missing[0]}; install the Debian package {package}")
    return tuple(there[name] for names in packages.values() for name in names)


def drawn(sets: list[GlyphSet]) -> tuple[Tensor, Tensor]:
    """Return the glyphs of sets, [N, 1, 64, 64] in 0..1, and the number of each in `CHARACTERS`, [N]."""
    plane = Plane(_DRAWN, _DRAWN, 0.08 / _DRAWN)
    pictures, labels = [], []
    for glyphs in sets:
        for name in glyphs.objects():
            pictures.append(glyphs.target(name, 0).rasterise(plane))
            labels.append(CHARACTERS.index(name.rsplit("_", 1)[1]))
    return torch.from_numpy(np.stack(pictures))[:, None], torch.tensor(labels)


def printed(families: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Return the glyphs of typefaces, named or font files, as of `drawn`."""
    return drawn([FontGlyphs(family=name, characters=CHARACTERS) for name in families])


def captured(folder: Path) -> tuple[Tensor, Tensor]:
    """Return the true targets of the captures in a folder, one of each character, as of `drawn`."""
    found = {}
    for path in sorted(folder.glob("*/target.png")):
        with open_image(path) as image:
            mask = np.asarray(image.convert("L"), np.float32) / np.float32(255)
        found[character_of(path.parent.name)] = Target("target", mask, 0.08)
    if not set(found) <= set(CHARACTERS) or not found:
        raise SystemExit(f"{folder} holds no captures of characters with a target.png; give their folder")
    plane = Plane(_DRAWN, _DRAWN, 0.08 / _DRAWN)
    pictures = torch.from_numpy(np.stack([target.rasterise(plane) for target in found.values()]))
    return pictures[:, None], torch.tensor([CHARACTERS.index(name) for name in found])


def degrade(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """Return glyphs [N, 1, 32, 32] as a poor reconstruction may show them: bent, bolder, blurred, noisy."""
    count = len(pictures)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    angle, size, aspect = uniform(-0.15, 0.15), uniform(0.95, 1.15), uniform(0.85, 1.2)
    dx, dy, lean = uniform(-0.06, 0.06), uniform(-0.06, 0.06), uniform(-0.25, 0.25)
    rows = torch.stack(
        [
            size * aspect * angle.cos(),
            -size * (angle.sin() + lean),
            dx,
            size * angle.sin(),
            size * angle.cos(),
            dy,
        ],
        dim=1,
    )
    grid = F.affine_grid(rows.reshape(-1, 2, 3), [count, 1, _DRAWN, _DRAWN], align_corners=False)
    moved = F.grid_sample(pictures, grid + _bend(count, generator), align_corners=False)
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


def _bend(count: int, generator: torch.Generator) -> Tensor:
    """Return a smooth displacement of each image, as another hand would draw it, [N, 64, 64, 2]."""
    ticks = torch.linspace(0, torch.pi, _DRAWN)
    waves = torch.cos(torch.arange(_WAVES)[:, None] * ticks)  # [K, 64]
    amounts = 0.05 * torch.randn(count, 2, _WAVES, _WAVES, generator=generator)
    return torch.einsum("nckl,ky,lx->nyxc", amounts, waves, waves)


def train_reader(families: tuple[str, ...], epochs: int = 200, seed: int = 0) -> CharacterReader:
    """Return the reader, trained on typefaces.

    Args:
        families: Typefaces, by name or font file.
        epochs: Passes over the glyphs, each time degraded anew.
        seed: Seed of weights, order and degradation.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "reader"))
        network = CharacterReader()
    generator = torch.Generator().manual_seed(derive_seed(seed, "degrade"))
    pictures, labels = printed(families)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-2)
    steps = epochs * -(-len(pictures) // 64)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    for _ in tqdm(range(epochs), unit="epoch", desc="reader"):
        for batch in torch.randperm(len(pictures), generator=generator).split(64):
            loss = F.cross_entropy(network(degrade(pictures[batch], generator)), labels[batch])
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
    return network.eval()


@torch.inference_mode()
def measure(network: CharacterReader, glyphs: tuple[Tensor, Tensor]) -> tuple[dict[str, float], str]:
    """Return how often the reader is right on clean and on degraded glyphs, and what it takes for what.

    Args:
        network: The reader.
        glyphs: As of `drawn`.
    """
    pictures, answers = glyphs
    generator = torch.Generator().manual_seed(derive_seed(0, "measure"))
    clean = network(F.avg_pool2d(pictures, 2)).argmax(dim=1)
    poor = torch.stack([network(degrade(pictures, generator)).argmax(dim=1) for _ in range(10)])
    wrong = Counter((a, b) for a, b in zip(answers.tolist(), clean.tolist(), strict=True) if a != b)
    words = ", ".join(f"{CHARACTERS[a]} as {CHARACTERS[b]} x {n}" for (a, b), n in wrong.most_common())
    shares = {"clean": (clean == answers).float().mean(), "degraded": (poor == answers).float().mean()}
    return {name: round(float(share), 4) for name, share in shares.items()}, words or "none"


def main() -> None:
    """Train the reader, write it to the file that is named on the command line, and print what it reads."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="file of the reader")
    parser.add_argument("--fonts", type=Path, default=FONTS, help="folder that holds the faces")
    parser.add_argument("--captures", type=Path, help="captures whose true images are read, too")
    parser.add_argument("--epochs", type=int, default=200, help="passes over the glyphs")
    options = parser.parse_args()
    learned, held = faces(PACKAGES, options.fonts), faces(HELD, options.fonts)
    sets = {
        "unseen faces": printed(held),
        "hands": drawn([HandwritingGlyphs(characters=CHARACTERS, writers=8)]),
    }
    if options.captures:
        sets["captures"] = captured(options.captures)
    network = train_reader(learned, options.epochs)
    about = {
        "characters": CHARACTERS,
        "trained_on": ", ".join(Path(face).name for face in learned),
        "epochs": options.epochs,
        "seed": 0,
    }
    for name, glyphs in sets.items():
        about[f"right on {name}"], confusion = measure(network, glyphs)
        sys.stdout.write(f"{name}: {about[f'right on {name}']}; misread: {confusion}\n")
    state = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    write_atomically(options.out, sealed_bytes(state, json.dumps(about)))


if __name__ == "__main__":
    main()
