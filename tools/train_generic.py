"""Train the layers that a pre-training may begin with: one network per modality, over walls of many kinds.

What a network of whole sequences learns by gradients is how letters look behind a linear estimate in the plane
of the target; the wall itself is in the closed-form part, which is fitted again for each setup. So these
layers carry over from wall to wall. The walls here are drawn at random from round and brushed metal, at many
distances; no capture, no font of the captures and no room of `evnlos lab` is among them. Frames and events are
solved at once through the light path of each wall; light, roughness and view scatter about what the solution
takes them for, as calibrations do: behind every other wall by little, behind the others by more.

Each wall is simulated and solved once, in one process; the walls together make one training set. The network of
fusion begins with the layers of that of frames.

    python tools/train_generic.py --out generic
    cp generic/generic-*.safetensors packages/evnlos-weights/src/evnlos_weights/
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from evnlos.cameras import EventPixel, FrameCamera
from evnlos.config import save_yaml, to_dict
from evnlos.data import NlosDataset, Sampling, Simulation, as_modality, simulate
from evnlos.data.simulate import ranges_around
from evnlos.demo import sequence_network
from evnlos.machine import ProgressBars, Step
from evnlos.models import SequenceReconstructor, Weights, layers_of, save_weights
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, HandwritingGlyphs, LineMotion, Strokes
from evnlos.setups import RadiometricSetup
from evnlos.training import LOSSES, Training, learning_rate_at
from evnlos.training.settings import light_of

_NETWORK = replace(sequence_network(), frames="likelihood")
_EPOCHS = {"frame": 20, "event": 16, "fusion": 16}
_WRITERS = {False: 2, True: 1}  # whether events are seen, which takes most of the time -> writers of each wall
_VIEWS = 3  # of each sequence: all positions, every other one, some
_SPLITS = ("train", "validation")


def wall(number: int, glyphs: HandwritingGlyphs, file: Path, *, sees_events: bool) -> Simulation:
    """Return the simulation of one wall: its own geometry, metal, light and cameras.

    Args:
        number: Of the wall.
        glyphs: What is hidden.
        file: Where the wall's setup is written, for what is solved through it.
        sees_events: Whether a network sees the events; else the pixel sends none.
    """
    draw = np.random.default_rng((20261127, number))
    rough, threshold = draw.uniform(0.03, 0.10), draw.uniform(0.1, 0.3)
    setup = RadiometricSetup(
        gain=draw.uniform(0.5, 1.5),
        roughness=rough,
        roughness_y=rough * np.exp(draw.uniform(-0.7, 0.7)),
        distance_m=draw.uniform(0.24, 0.40),
        camera_distance_m=draw.uniform(0.5, 0.75),
        camera_angle_deg=draw.uniform(20, 40),
        field_of_view_deg=draw.uniform(26, 36),
        cell_m=0.004,
        ambient=draw.uniform(0.03, 0.12),
        frame_camera=FrameCamera(
            full_well_e=draw.uniform(5_000, 20_000), read_noise_e=draw.uniform(5, 60), prnu=0.01
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
    wide = 1 + 2 * (number % 2)
    scatter = {"setup.gain": 0.08, "setup.ambient": 0.08}
    scatter |= {f"setup.{name}": 0.03 * wide for name in ("roughness", "roughness_y")}
    if wide > 1:
        scatter |= {f"setup.{name}": 0.01 for name in ("distance_m", "camera_distance_m", "field_of_view_deg")}
    if sees_events:
        scatter |= {f"setup.pixel.threshold_{kind}": 0.03 * wide for kind in ("on", "off")}
    else:
        setup = replace(setup, pixel=EventPixel(10.0, 10.0, 0.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0))
    save_yaml(to_dict(setup), file)
    plan = Simulation(
        glyphs=glyphs,
        motion=LineMotion((-0.08, 0.0), 0.02),
        setup=setup,
        sampling=Sampling(surface="likelihood" if sees_events else "sae", setup=str(file)),
        validation=0.05,
        setups=2,
        seed=number,
    )
    return replace(plan, vary=ranges_around(plan, scatter))


def solve(number: int, out: Path) -> Path:
    """Simulate a wall, and return the file with what a network sees of it and with the true images.

    Args:
        number: Of the wall.
        out: Folder of the files.
    """
    file = out / f"wall{number}.pt"
    if file.is_file():
        return file
    torch.set_num_threads(1)
    solved = dict[tuple[str, str], Sequence[torch.Tensor]]()
    for sees_events, writers in _WRITERS.items():
        name = f"wall{number}-{'events' if sees_events else 'frames'}"
        glyphs = HandwritingGlyphs(
            characters=UPPER_CASE + DIGITS,
            writers=writers,
            first_writer=number * writers % (TRAIN_WRITERS - writers + 1),
            strokes=Strokes(faces="both"),
        )
        plan = wall(number, glyphs, out / f"{name}.yaml", sees_events=sees_events)
        data = simulate(plan, out / name, 1)
        for modality in _EPOCHS if sees_events else ("frame",):
            network = _NETWORK.build(modality, data.sampling)
            for is_new, split in zip((True, False), _SPLITS, strict=True):
                samples = NlosDataset(data, split, as_modality(modality))
                pooled = network.training_samples(samples, _VIEWS if is_new else 1, number, is_new=is_new)
                seen = network.scale(pooled.inputs.float()).half(), pooled.truth
                before = solved.get((modality, split), (seen[0][:0], seen[1][:0]))
                solved[modality, split] = [torch.cat(both) for both in zip(before, seen, strict=True)]
        shutil.rmtree(out / name)
    torch.save(solved, file.with_suffix(".part"))
    file.with_suffix(".part").rename(file)
    return file


def trained(
    modality: str, files: list[Path], first: Weights | None, settings: Training, progress: ProgressBars
) -> Weights:
    """Return a network that learned from all walls together.

    Args:
        modality: What it sees.
        files: Of `solve`.
        first: What it takes its layers from to begin with; None: random ones.
        settings: Epochs, size of a batch, and rate, which falls along a cosine.
        progress: Called as the epochs end.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    walls = [torch.load(file) for file in files]
    (inputs, truth), held_out = (
        [torch.cat([one[modality, split][part] for one in walls]).to(device) for part in (0, 1)]
        for split in _SPLITS
    )
    torch.manual_seed(settings.seed)
    network = _NETWORK.build(modality, Sampling(surface="likelihood"))
    assert isinstance(network, SequenceReconstructor)
    if first is not None:
        network.take_layers(first.network)
    unet = network.unet.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser, loss_of = torch.optim.Adam(unet.parameters()), LOSSES[settings.loss]
    steps, what = math.ceil(len(inputs) / settings.batch_size), f"train {modality}"
    score = 0.0
    for epoch in range(settings.epochs):
        for step, chosen in enumerate(torch.randperm(len(inputs), device=device).split(settings.batch_size)):
            for group in optimiser.param_groups:
                group["lr"] = learning_rate_at(settings, epoch + step / steps)
            image, true = unet(inputs[chosen].float()), truth[chosen, None].float()
            loss = loss_of(image, true, light_of(true))
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(unet.parameters(), 1.0)
            optimiser.step()
        with torch.no_grad():
            images = torch.cat([unet(part.float())[:, 0] for part in held_out[0].split(64)])
            errors = (images - held_out[1].float()).square().flatten(1).mean(dim=1)
        score = float((-10 * errors.log10()).mean())
        progress(Step(what, epoch + 1, settings.epochs, "epochs", {"psnr_db": round(score, 3)}))
    network = network.cpu().eval()
    history = [
        {
            "settings": to_dict(replace(settings, modality=modality)),
            "data": {"origin": "simulation", "name": f"{len(files)} walls", "sequences": len(inputs) // _VIEWS},
            "psnr_db": score,
        }
    ]
    return Weights(network, history)


def main() -> None:
    """Simulate the walls, and train one network per modality through all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("generic"), help="folder (default: generic)")
    parser.add_argument("--walls", type=int, default=42, help="walls (default: 42)")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (default: the cores)")
    options = parser.parse_args()
    out, files = options.out.resolve(), list[Path]()
    out.mkdir(parents=True, exist_ok=True)
    with ProgressBars() as progress:
        with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
            for one in as_completed([pool.submit(solve, number, out) for number in range(options.walls)]):
                files.append(one.result())
                progress(Step("walls", len(files), options.walls, "walls"))
        first: Weights | None = None
        for modality, epochs in _EPOCHS.items():
            settings = Training(epochs=epochs, batch_size=32, learning_rate=2e-3, schedule="cosine")
            begins = first if as_modality(modality).needs_frames else None
            found = trained(modality, sorted(files), begins, settings, progress)
            # Whoever begins with these layers fits a closed-form part of his own.
            save_weights(
                out / f"{layers_of('generic', modality)[0]}.safetensors",
                replace(found, network=found.network.reduced(8)),
            )
            first = first or found


if __name__ == "__main__":
    main()
