"""Train the layers that a pre-training may begin with: one network per modality, over walls of many kinds.

What a network of whole sequences learns by gradients is how letters look behind a linear estimate in the plane
of the target; the wall itself is in the closed-form part, which is fitted again for each setup. So these
layers carry over from wall to wall. The walls here are drawn at random from round and brushed metal, at many
distances; no capture, no font of the captures and no room of `evnlos lab` is among them. Frames are solved at
once through the light path of each wall; light and roughness scatter about what the solution takes them for, as
calibrations do.

    python tools/train_generic.py --out generic --modalities frame
    python tools/train_generic.py --out generic-fusion --modalities fusion
    python tools/train_generic.py --out generic-event --modalities event --rounds 1 --epochs 4
    cp generic*/generic-*.safetensors packages/evnlos-weights/src/evnlos_weights/
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from evnlos.cameras import EventPixel, FrameCamera
from evnlos.config import save_yaml, to_dict
from evnlos.data import STANDARD_MODALITIES, Sampling, Simulation, as_modality, simulate
from evnlos.demo import SEQUENCE_NETWORK
from evnlos.machine import ProgressBars
from evnlos.models import layers_of, load_weights, save_weights, with_rank
from evnlos.scene import DIGITS, UPPER_CASE, HandwritingGlyphs, LineMotion, Strokes
from evnlos.setups import RadiometricSetup
from evnlos.training import Training, train


def wall(number: int, writers: int, file: Path, *, sees_events: bool) -> Simulation:
    """Return the simulation of one wall: its own geometry, metal, light, cameras and writers.

    Args:
        number: Of the wall.
        writers: Writers of its objects, 36 each.
        file: Where the wall's setup is written, for what is solved through it.
        sees_events: Whether a network sees the events; else the pixel sends none.
    """
    draw = np.random.default_rng((20261123, number))
    rough = draw.uniform(0.03, 0.10)
    distance = draw.uniform(0.24, 0.40)
    threshold = draw.uniform(0.1, 0.3)
    setup = RadiometricSetup(
        gain=draw.uniform(0.5, 1.5),
        roughness=rough,
        roughness_y=rough * np.exp(draw.uniform(-0.7, 0.7)),
        distance_m=distance,
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
    if not sees_events:
        setup = replace(setup, pixel=EventPixel(10.0, 10.0, 0.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0))
    save_yaml(to_dict(setup), file)
    scatter = {"gain": 0.08, "ambient": 0.08, "roughness": 0.03, "roughness_y": 0.03}
    return Simulation(
        glyphs=HandwritingGlyphs(
            characters=UPPER_CASE + DIGITS,
            writers=writers,
            first_writer=number % 4 * writers,
            strokes=Strokes(faces="both"),
        ),
        motion=LineMotion((-0.08, 0.0), 0.02),
        setup=setup,
        sampling=Sampling(surface="hots" if sees_events else "sae", radius=1, setup=str(file)),
        validation=0.03,
        vary={
            f"setup.{name}": ((1 - part) * getattr(setup, name), (1 + part) * getattr(setup, name))
            for name, part in scatter.items()
        },
        setups=2,
        seed=number,
    )


def main() -> None:
    """Simulate the walls, and train one network per modality through all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("generic"), help="folder (default: generic)")
    parser.add_argument("--walls", type=int, default=9, help="walls (default: 9)")
    parser.add_argument("--writers", type=int, default=8, help="writers per wall (default: 8)")
    parser.add_argument("--epochs", type=int, default=3, help="epochs on each wall and round (default: 3)")
    parser.add_argument("--rounds", type=int, default=2, help="rounds over the walls (default: 2)")
    parser.add_argument("--modalities", nargs="*", default=list(STANDARD_MODALITIES), help="what is seen")
    options = parser.parse_args()
    sees_events = any(as_modality(name).needs_events for name in options.modalities)
    options.out.mkdir(parents=True, exist_ok=True)
    data = []
    with ProgressBars() as progress:
        for number in range(options.walls):
            folder = options.out / f"wall{number}"
            one = wall(number, options.writers, folder.with_suffix(".yaml"), sees_events=sees_events)
            data.append(simulate(one, folder, 2, progress=progress))
        total = options.rounds * options.walls
        for modality in options.modalities:
            frames = "embedding" if as_modality(modality).needs_events else "likelihood"
            last: Path | None = None
            for step in range(total):
                plan = Training(
                    modality=modality,
                    epochs=options.epochs,
                    batch_size=16,
                    network=replace(SEQUENCE_NETWORK, frames=frames),
                    sequence_augmentations=2,
                    refit_embedding=step > 0,
                    # The rate falls from wall to wall along the cosine that one long training would have.
                    learning_rate=2e-3 * 0.5 * (1 + np.cos(np.pi * step / total)),
                    schedule="constant" if step < total - 1 else "cosine",
                )
                run = options.out / f"{modality}-{step}"
                train(data[step % options.walls], plan, run, last, progress)
                last = run
            assert last is not None
            # Whoever begins with these layers fits an embedding of his own.
            slim = with_rank(load_weights(last), 8)
            slim.network.sampling = replace(slim.network.sampling, setup="")
            save_weights(options.out / f"{layers_of('generic', modality)[0]}.safetensors", slim)


if __name__ == "__main__":
    main()
