"""Samples that are simulated as a training needs them: no dataset on disk, and each epoch another draw."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.config import config_hash, to_dict
from evnlos.dataset.loader import Paradigm, network_input
from evnlos.dataset.pool import run_in_order
from evnlos.dataset.sampling import Samples, edges_from, make_samples
from evnlos.dataset.simulate import Simulation, drawn_for, simulate_object, split_of
from evnlos.dataset.store import Dataset
from evnlos.errors import ConfigError
from evnlos.scene import Scene
from evnlos.seeds import derive_seed
from evnlos.sensor import simulate_batch
from evnlos.sensor.light import WHITE_DN
from evnlos.transport import SlidingWall


@dataclass(frozen=True)
class LiveDataset(Dataset):
    """A simulation that takes the place of a dataset on disk; make it with `live_dataset`.

    Epoch 0 is the dataset that `simulate` would write; epoch n has other handwriting, settings from the same
    ranges and other noise, and is the same whenever it is asked for.
    """

    simulation: Simulation = field(default_factory=Simulation)
    """The settings."""
    workers: int = 1
    """Processes that simulate on the CPU; 1 = in this process, 0 = one for each core."""
    mix: int = 8
    """Objects whose samples are shuffled together."""
    step_s: float = 0.002
    """Time step of the pixels on a GPU, seconds; on the CPU the camera chooses its steps."""

    def stream(
        self, names: Iterable[str], epoch: int, paradigm: Paradigm, device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield input [N, C, H, W] and truth [N, 1, H, W] of each object, in order, float32.

        On a CPU the samples are those of `simulate_object`, bit for bit. On a GPU light and pixels are computed
        there, in steps of `step_s`.
        """
        config = epoch_settings(self.simulation, epoch)
        made: Iterator[Samples]
        if device.type == "cpu":
            made = run_in_order(_samples, [(config, name) for name in names], self.workers)
        else:
            made = (simulate_object_on(config, name, device, self.step_s) for name in names)
        for samples in made:
            assert samples.truth is not None  # a simulation knows its target
            # in half precision twice, as shards hold the maps and a loader the inputs
            frame, surface, truth = (
                torch.from_numpy(maps.astype(np.float16)).to(device).float()
                for maps in (samples.frame, samples.surface, samples.truth)
            )
            yield network_input(frame, surface, paradigm).half().float(), truth[:, None]

    def truth(self, name: str) -> NDArray[np.float32]:
        """Return the true pictures of an object in the first epoch, float32 [N, H, W], 0..1."""
        config = self.simulation
        scene = _scene(config, drawn_for(config, name), name)
        times_s = scene.position_times_s(config.positions)
        return scene.target.rasterise(config.sampling.canvas, scene.motion.position_m(times_s))


def live_dataset(config: Simulation, workers: int = 1) -> LiveDataset:
    """Return a simulation as a dataset to train on.

    Args:
        config: The settings.
        workers: Processes that simulate on the CPU; 0 means one for each core.

    Raises:
        ConfigError: No object is left to train on.
    """
    split = split_of(config)
    if not split["train"]:
        raise ConfigError(
            f"the simulation has {len(config.glyphs.objects())} objects, none to train on; add some"
        )
    return LiveDataset(
        Path("live"),
        "simulation",
        config.sampling,
        split,
        to_dict(config),
        config_hash(config),
        config.optics(),
        simulation=config,
        workers=workers,
    )


def epoch_settings(config: Simulation, epoch: int) -> Simulation:
    """Return the settings of an epoch (from 0): those of the first are the simulation's own."""
    return replace(config, seed=derive_seed(config.seed, "epoch", epoch)) if epoch else config


def simulate_object_on(config: Simulation, name: str, device: torch.device, step_s: float) -> Samples:
    """Simulate one object's pass with light and pixels on a device, in steps of `step_s` seconds.

    The pixels step from frame to frame (`mode="v2e"`); columns of events, frames and maps pass through main
    memory. The wall is built on the CPU and, where it slides, carried over.

    Args:
        config: The settings.
        name: One of `config.glyphs.objects()`.
        device: Where the light is rendered and the pixels live.
        step_s: Time step, seconds.

    Raises:
        ConfigError: The pixel has hot pixels or jitter, which this mode has not.
    """
    drawn = drawn_for(config, name)
    scene = _scene(config, drawn, name)
    wall = drawn.transport.wall(scene, (config.sensor.height, config.sensor.width))
    times_s = scene.position_times_s(config.positions)
    # frames are drawn where their random numbers are the same as on the CPU
    frames = drawn.frame_camera.capture(wall, times_s, seed=derive_seed(config.seed, name, "frames"))
    if isinstance(wall, SlidingWall):
        wall = wall.to(device)
    steps = max(1, round(drawn.duration_s / step_s))
    instants = np.linspace(0.0, drawn.duration_s, steps + 1)
    with torch.inference_mode():
        light = wall.irradiance(instants).to(device).mul_(WHITE_DN)  # [T, H, W]
    seed = derive_seed(config.seed, name, "events")
    (events,) = simulate_batch(light[None], instants, drawn.pixel, [seed], dtype=torch.float32)
    edges_us = edges_from(times_s)
    peak = 2**drawn.frame_camera.bit_depth - 1
    return make_samples(
        frames, peak, events, edges_us, config.sampling, motion=scene.motion, target=scene.target
    )


def _scene(config: Simulation, drawn: Simulation, name: str) -> Scene:
    target = config.glyphs.target(name, derive_seed(config.seed, "glyph"))
    return Scene(target, drawn.motion, drawn.duration_s)


def _samples(task: tuple[Simulation, str]) -> Samples:
    return simulate_object(*task)[0]
