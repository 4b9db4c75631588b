"""Samples that are simulated as a training needs them: no dataset on disk, and each epoch another draw."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.config import config_hash, to_dict
from evnlos.dataset.loader import Paradigm, network_input
from evnlos.dataset.on_device import bytes_of_a_wall, simulate_objects_on
from evnlos.dataset.pool import run_in_order
from evnlos.dataset.sampling import Samples
from evnlos.dataset.simulate import Simulation, drawn_for, scene_of, simulate_object, split_of
from evnlos.dataset.store import Dataset
from evnlos.errors import ConfigError
from evnlos.seeds import derive_seed
from evnlos.threads import cores

Place = Literal["device", "cpu"]
_MOST_BYTES = 4 << 30  # of walls that a GPU holds at a time


@dataclass(frozen=True)
class LiveDataset(Dataset):
    """A simulation that takes the place of a dataset on disk; make it with `live_dataset`.

    Made on a CPU, epoch 0 is the dataset that `simulate` would write; epoch n has other handwriting, settings
    from the same ranges and other noise, and is the same whenever it is asked for. A GPU has other time steps.
    """

    simulation: Simulation = field(default_factory=Simulation)
    """The settings."""
    workers: int = 1
    """Processes that simulate on the CPU; 1 = in this process, 0 = one for each core."""
    mix: int = 8
    """Objects whose samples are shuffled together."""
    where: Place = "device"
    """Simulate on the device of the training, or on the CPU also beside a GPU."""
    together: int = 16
    """Objects that a GPU simulates at a time."""
    step_s: float = 0.002
    """Time step of the pixels on a GPU, seconds; on the CPU the camera chooses its steps."""

    def stream(
        self, names: Iterable[str], epoch: int, paradigm: Paradigm, device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield input [N, C, H, W] and truth [N, 1, H, W] of each object, in order, float32.

        Simulated on a CPU the samples are those of `simulate_object`, bit for bit. On a GPU all but the drawing
        of the plate happens there, in steps of `step_s`.
        """
        config = epoch_settings(self.simulation, epoch)
        made: Iterator[tuple[Tensor, Tensor, Tensor]]
        if self._uses(device):
            made = self._on_device(config, list(names), device)
        else:
            tasks = [(config, name) for name in names]
            # one process a core, shared by the processes that train on this machine
            workers = self.workers or max(1, cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
            made = (_tensors(samples) for samples in run_in_order(_samples, tasks, workers))
        for maps in made:
            # in half precision twice, as shards hold the maps and a loader the inputs
            frame, surface, truth = (part.half().to(device).float() for part in maps)
            yield network_input(frame, surface, paradigm).half().float(), truth[:, None]

    def way(self, device: torch.device) -> dict[str, float]:
        """Return what besides the settings decides the samples: the time step, where a GPU makes them."""
        return {"step_s": self.step_s} if self._uses(device) else {}

    def _uses(self, device: torch.device) -> bool:
        return self.where == "device" and device.type != "cpu"

    def _on_device(
        self, config: Simulation, names: list[str], device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        together = max(1, min(self.together, _MOST_BYTES // bytes_of_a_wall(config)))
        for first in range(0, len(names), together):
            yield from simulate_objects_on(config, names[first : first + together], device, self.step_s)

    def truth(self, name: str) -> NDArray[np.float32]:
        """Return the true pictures of an object in the first epoch, float32 [N, H, W], 0..1."""
        config = self.simulation
        scene = scene_of(config, drawn_for(config, name), name)
        return scene.truth(config.sampling.canvas, scene.position_times_s(config.positions))


def live_dataset(config: Simulation, workers: int = 1, where: Place = "device") -> LiveDataset:
    """Return a simulation as a dataset to train on.

    Args:
        config: The settings.
        workers: Processes that simulate on the CPU; 0 means one for each core.
        where: "device" simulates where the network trains, "cpu" on the CPU also beside a GPU.

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
        where=where,
    )


def epoch_settings(config: Simulation, epoch: int) -> Simulation:
    """Return the settings of an epoch (from 0): those of the first are the simulation's own."""
    return replace(config, seed=derive_seed(config.seed, "epoch", epoch)) if epoch else config


def _samples(task: tuple[Simulation, str]) -> Samples:
    return simulate_object(*task)[0]


def _tensors(samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    assert samples.truth is not None  # a simulation knows its target
    frame, surface, truth = map(torch.from_numpy, (samples.frame, samples.surface, samples.truth))
    return frame, surface, truth
