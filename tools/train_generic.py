"""Train the layers that a pre-training may begin with: one network per modality, over walls of many kinds.

What a network of whole sequences learns by gradients is how letters look behind a linear estimate in the plane
of the target; the wall itself is in the closed-form part, which is fitted again for each setup. So these
layers carry over from wall to wall. The walls here are drawn at random from round and brushed metal, at many
distances; no capture, no font of the captures and no room of `evnlos lab` is among them. Frames and events are
solved at once through the light path of each wall. Light, sensor and geometry scatter about what the solution
takes them for, as calibrations do: behind some walls by little, behind others by several times more, and the
solution doubts its frames accordingly.

Of each wall a few sequences are simulated: they tell by how much its light path errs. What the networks learn
from are newly drawn targets, without end, in closed form (`evnlos.models.drawn`); each batch shows some walls.
The published layers began with older ones, which had learned from rendered sequences behind 42 other walls.

    python tools/train_generic.py --out generic
    cp generic/generic-*.safetensors packages/evnlos-weights/src/evnlos_weights/
"""

from __future__ import annotations

import argparse
import math
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from evnlos.cameras import EventPixel, FrameCamera
from evnlos.config import save_yaml, to_dict
from evnlos.data import Sampling, Simulation
from evnlos.data.simulate import ranges_around, simulate_object
from evnlos.demo import sequence_network
from evnlos.inverse.event_images import EventErrors, event_prior, event_statistic
from evnlos.inverse.sequence_statistic import EventStatistic
from evnlos.machine import ProgressBars, Step
from evnlos.models import SequenceReconstructor, Weights, layers_of, load_weights, save_weights
from evnlos.models.drawn import (
    AboutDrawn,
    DrawnEvents,
    DrawnFrames,
    DrawnSequences,
    DrawnTargets,
    KnownSequence,
    TargetGrid,
    masks_of,
)
from evnlos.models.sequence import PooledFrames
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, HandwritingGlyphs, Ink, LineMotion, Strokes
from evnlos.setups import RadiometricSetup, Setup
from evnlos.training import LOSSES, Training, learning_rate_at
from evnlos.training.settings import light_of
from evnlos.types import derive_seed, target_side_m

_NETWORK = replace(sequence_network(), frames="likelihood")
_MODALITIES = ("frame", "event", "fusion")
_BATCH, _OF_WALLS, _WARM_UP = 32, 4, 200  # sequences of a step, walls that they are of; steps of growing size
_HELD_OUT = 8  # every so many walls is not learned from
_SEQUENCES = 14  # of a wall, which tell by how much its light path errs
_MOST_DOUBT, _LEARNED_DOUBT = 1000.0, 300.0  # that are drawn; walls that are doubted more teach nothing of use


@Setup.registry.register
@dataclass(frozen=True)
class DoubtedMetal(RadiometricSetup):
    """Rough metal as a calibration leaves it: known so far."""

    kind: Literal["doubted-metal"] = "doubted-metal"  # pyright: ignore[reportIncompatibleVariableOverride]
    """Kind of this setup."""
    frame_doubt: float = 1.0  # pyright: ignore[reportIncompatibleVariableOverride]
    """By how much the variance of the frames' noise is raised."""
    ink: Ink = field(default_factory=Ink)  # pyright: ignore[reportIncompatibleVariableOverride]
    """How large the letters are."""


_LETTERS = HandwritingGlyphs(
    characters=UPPER_CASE + DIGITS, writers=TRAIN_WRITERS, strokes=Strokes(faces="both")
)


def wall(number: int) -> tuple[Simulation, list[str]] | None:
    """Return the simulation of one wall (its own geometry, metal, light, cameras), and what of it is simulated.

    None: its letters do not fill the target plane, or its frames are hardly to be believed. Networks that
    learned from such walls, too, drew validation captures of full letters 0.5 to 1 dB worse.

    Args:
        number: Of the wall.
    """
    draw = np.random.default_rng((20261128, number))
    doubt = math.exp(draw.uniform(0, math.log(_MOST_DOUBT)))
    if float(draw.choice([1.0, draw.uniform(0.5, 1.0)])) < 1 or doubt >= _LEARNED_DOUBT:
        return None
    rough, threshold = math.exp(draw.uniform(math.log(0.03), math.log(0.12))), draw.uniform(0.1, 0.3)
    setup = DoubtedMetal(
        frame_doubt=doubt,
        ink=Ink(_LETTERS.target_plane.size_m),
        gain=draw.uniform(0.5, 1.5),
        roughness=rough,
        roughness_y=rough * np.exp(draw.uniform(-0.7, 0.7)),
        distance_m=draw.uniform(0.24, 0.52),
        camera_distance_m=draw.uniform(0.5, 0.75),
        camera_angle_deg=draw.uniform(20, 40),
        field_of_view_deg=draw.uniform(26, 36),
        cell_m=0.004,
        ambient=draw.uniform(0.03, 0.12),
        frame_camera=FrameCamera(
            full_well_e=draw.uniform(5_000, 20_000), read_noise_e=draw.uniform(5, 60), prnu=0.005
        ),
        pixel=EventPixel(
            threshold_on=threshold,
            threshold_off=threshold * np.exp(draw.uniform(-0.2, 0.2)),
            threshold_sigma=draw.uniform(0.01, 0.05),
            cutoff_hz=draw.uniform(40, 200),
            leak_rate_hz=draw.uniform(0, 0.15),
            shot_noise_rate_hz=draw.uniform(0.02, 0.5),
            logarithm="true",
        ),
    )
    wide = 0.1 * doubt ** (1 / 3)
    scatter = {f"setup.{name}": 0.08 * wide for name in ("gain", "ambient")}
    scatter |= {f"setup.{name}": 0.06 * wide for name in ("roughness", "roughness_y")}
    scatter |= {f"setup.{at}": 0.01 * wide for at in ("distance_m", "camera_distance_m", "field_of_view_deg")}
    scatter |= {f"setup.pixel.threshold_{kind}": 0.08 * wide for kind in ("on", "off")}
    motion = LineMotion((-0.08, 0.0), 0.02)
    plan = Simulation(glyphs=_LETTERS, motion=motion, setup=setup, setups=2, seed=number)
    names = draw.choice(_LETTERS.objects(), _SEQUENCES, replace=False).tolist()
    return replace(plan, vary=ranges_around(plan, scatter)), names


def solve(number: int, out: Path) -> Path | None:
    """Simulate some sequences of a wall, and return the file with what makes further ones; None: as of `wall`.

    Args:
        number: Of the wall.
        out: Folder of the files.
    """
    folder = out / f"wall{number:03d}"
    file = folder / "drawn.pt"
    if file.is_file():
        return file
    if (found := wall(number)) is None:
        return None
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    plan, names = found
    save_yaml(to_dict(plan.setup), folder / "setup.yaml")
    sampling = replace(plan.sampling, surface="likelihood", setup=str(folder / "setup.yaml"))
    made = [simulate_object(plan, name) for name in names]
    steps = plan.positions
    frames, truth, places = (
        torch.from_numpy(np.concatenate(parts))
        for parts in zip(*((s.frame, s.truth, s.position_m) for s, _ in made), strict=True)
    )
    solver = PooledFrames(sampling, _NETWORK.prior_weights, _NETWORK.rank)
    solver.fit(plan.setup, frames, truth, places, np.repeat(names, steps))
    known = [
        KnownSequence(*parts, solver)
        for parts in zip(frames.split(steps), truth.split(steps), places.split(steps), strict=True)
    ]
    side_m, glyph_seed = target_side_m(sampling.canvas), derive_seed(plan.seed, "glyph")
    prior, said = event_prior(plan.setup, side_m), list[EventStatistic]()
    for samples, events in made:
        edges_us = np.append(0, np.round(1e6 * samples.time_s)).astype(np.int64)
        said.append(event_statistic(events, edges_us, plan.motion, sampling.setup, side_m)[0])
    truths = [plan.glyphs.target(name, glyph_seed).rasterise(prior.target_plane) for name in names]
    some = slice(None, None, 3)  # a dozen tell as much, and each keeps two matrices
    EventErrors.of(names[some], said[some], prior, truths[some]).write(folder)
    grid = TargetGrid(sampling)
    parts = {
        "frame": DrawnFrames(solver, known, grid),
        "event": DrawnEvents(sampling, grid, torch.clone, places[:steps]),
    }
    torch.save(parts, file.with_suffix(".part"))
    file.with_suffix(".part").rename(file)
    return file


class Walls:
    """Newly drawn sequences behind some walls, on the scale that a network sees.

    Args:
        files: Of `solve`.
        modality: What the network sees.
        masks: Targets to draw, [M, h, h].
        network: The network, whose scale is that of each wall in turn.
    """

    def __init__(
        self, files: list[Path], modality: str, masks: torch.Tensor, network: SequenceReconstructor
    ) -> None:
        self._network, self._walls = network, list[tuple[DrawnSequences, dict[str, torch.Tensor]]]()
        seen = [kind for kind in ("frame", "event") if modality in (kind, "fusion")]
        for file in files:
            found = torch.load(file, weights_only=False)  # of this program
            targets = DrawnTargets(AboutDrawn("", _LETTERS.target_plane.size_m), masks)
            sequences = DrawnSequences(targets, network.grid, [found[kind] for kind in seen])
            network.scale.fit(torch.cat([sequences.batch(64, seed)[0] for seed in range(3)]).half())
            scale = {name: value.clone() for name, value in network.scale.state_dict().items()}
            self._walls.append((sequences, scale))

    @torch.no_grad()
    def batch(self, chosen: list[int], each: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return so many sequences of each of some walls, and their targets; the same for the same seed."""
        images, targets = list[torch.Tensor](), list[torch.Tensor]()
        for number in chosen:
            sequences, scale = self._walls[number]
            self._network.scale.load_state_dict(scale)
            seen, true = sequences.batch(each, derive_seed(seed, number))
            images.append(self._network.scale(seen))
            targets.append(true)
        return torch.cat(images), torch.cat(targets)

    def __len__(self) -> int:
        return len(self._walls)


def trained(modality: str, files: list[Path], start: str, steps: int, progress: ProgressBars) -> Weights:
    """Return a network that learned from all walls but every eighth, which score it.

    Args:
        modality: What it sees.
        files: Of `solve`.
        start: First part of the name of what it takes its layers from; empty: random ones.
        steps: Of the training; the rate falls along a cosine.
        progress: Called every hundred steps.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    settings = Training(modality, epochs=1, batch_size=_BATCH, learning_rate=1e-3)
    torch.manual_seed(settings.seed)
    network = _NETWORK.build(modality, Sampling(surface="likelihood"))
    assert isinstance(network, SequenceReconstructor)
    if start:
        network.take_layers(load_weights(layers_of(start, modality)[0]).network)
    masks = torch.from_numpy(np.stack([mask for mask, _ in masks_of(_LETTERS, (0, _LETTERS.objects()))])).half()
    held_out = files[::_HELD_OUT] if len(files) > _HELD_OUT else files
    learned = [file for file in files if file not in held_out] or files
    walls, others = (Walls(some, modality, masks, network) for some in (learned, held_out))
    seen, truth = others.batch(list(range(len(others))), 16, 1)
    unet = network.unet.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser, loss_of = torch.optim.Adam(unet.parameters()), LOSSES[settings.loss]
    order, what, score = np.random.default_rng(0), f"train {modality}", 0.0
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = learning_rate_at(settings, step / steps) * min(1.0, (step + 1) / _WARM_UP)
        few = min(_OF_WALLS, len(walls))
        chosen = order.choice(len(walls), few, replace=False).tolist()
        image, true = (part.to(device) for part in walls.batch(chosen, _BATCH // few, step))
        image = unet(image.contiguous(memory_format=torch.channels_last))
        loss = loss_of(image, true, light_of(true))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(unet.parameters(), 1.0)
        optimiser.step()
        if (step + 1) % 500 == 0 or step + 1 == steps:
            with torch.no_grad():
                images = torch.cat([unet(part.to(device)).cpu() for part in seen.split(64)])
            score = float((-10 * (images - truth).square().flatten(1).mean(dim=1).log10()).mean())
        if (step + 1) % 100 == 0 or step + 1 == steps:
            progress(Step(what, step + 1, steps, "steps", {"psnr_db": round(score, 3)}))
    history = [
        {
            "settings": to_dict(settings),
            "data": {"origin": "simulation", "name": f"{len(walls)} walls", "sequences": steps * _BATCH},
            "start": start,
            "psnr_db": score,
        }
    ]
    return Weights(network.cpu().eval(), history)


def main() -> None:
    """Simulate the walls, and train one network per modality through all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("generic"), help="folder (default: generic)")
    parser.add_argument("--walls", type=int, default=64, help="walls, of which half suit (default: 64)")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (default: the cores)")
    parser.add_argument("--modality", choices=_MODALITIES, help="train this network alone (default: all)")
    parser.add_argument("--start", default="generic", help="layers to begin with (default: generic)")
    parser.add_argument("--steps", type=int, default=2000, help="steps of a training (default: 2000)")
    options = parser.parse_args()
    out, files = options.out.resolve(), list[Path]()
    out.mkdir(parents=True, exist_ok=True)
    with ProgressBars() as progress:
        with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
            every = [pool.submit(solve, number, out) for number in range(options.walls)]
            for done, one in enumerate(as_completed(every), start=1):
                files += [file] if (file := one.result()) else []
                progress(Step("walls", done, options.walls, "walls"))
        for modality in [options.modality] if options.modality else _MODALITIES:
            found = trained(modality, sorted(files), options.start, options.steps, progress)
            # Whoever begins with these layers fits a closed-form part of his own.
            save_weights(
                out / f"{layers_of('generic', modality)[0]}.safetensors",
                replace(found, network=found.network.reduced(8)),
            )


if __name__ == "__main__":
    main()
