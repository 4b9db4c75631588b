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
from evnlos.dataset.modality import Modality, as_modality
from evnlos.dataset.on_device import bytes_of_a_wall, no_backend, simulate_objects_on
from evnlos.dataset.pool import processes, run_in_order
from evnlos.dataset.sampling import Samples
from evnlos.dataset.simulate import (
    Simulation,
    check_passes,
    drawn_for,
    object_bytes,
    scene_of,
    simulate_object,
    split_of,
)
from evnlos.dataset.store import Dataset
from evnlos.errors import ConfigError
from evnlos.seeds import derive_seed
from evnlos.threads import cores

Place = Literal["device", "cpu"]
_MOST_BYTES = 4 << 30  # of walls that a GPU holds at a time


@dataclass(frozen=True)
class LiveDataset(Dataset):
    """A simulation that takes the place of a dataset on disk; make it with `live_dataset`.

    Epoch 0 is the dataset that `simulate` would write; epoch n has other handwriting, settings from the same
    ranges and other noise, and is the same whenever it is asked for. The settings alone decide the physics: a
    GPU simulates where the event model has a torch backend, else the CPU does.
    """

    simulation: Simulation = field(default_factory=Simulation)
    """The settings."""
    workers: int = 1
    """Processes that simulate on the CPU; 1 = in this process, 0 = one for each core."""
    mix: int = 8
    """Objects whose samples are shuffled together."""
    where: Place = "device"
    """Simulate on the device of the training, where the event model can, or on the CPU also beside a GPU."""
    together: int = 16
    """Objects that a GPU simulates at a time."""

    def stream(
        self, names: Iterable[str], epoch: int, modality: str | Modality, device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield input [N, C, H, W] and truth [N, 1, H, W] of each object, in order, float32.

        Simulated on a CPU the samples are those of `simulate_object`, bit for bit. On a GPU all but the drawing
        of the plate happens there; see `simulate_objects_on`.
        """
        config, seen = epoch_settings(self.simulation, epoch), as_modality(modality)
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
            yield seen.inputs(frame, surface).half().float(), truth[:, None]

    def note(self, device: torch.device) -> str:
        """Return one line on why the CPU simulates beside a GPU; "" where it does not, or was asked to."""
        if self.where == "cpu" or device.type == "cpu" or self._uses(device):
            return ""
        return no_backend(self.simulation)

    def _uses(self, device: torch.device) -> bool:
        has_backend = self.simulation.pixel.torch_backend() is not None
        return self.where == "device" and device.type != "cpu" and has_backend

    def _on_device(
        self, config: Simulation, names: list[str], device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        together = max(1, min(self.together, _MOST_BYTES // bytes_of_a_wall(config)))
        for first in range(0, len(names), together):
            yield from simulate_objects_on(config, names[first : first + together], device)

    def truth(self, name: str) -> NDArray[np.float32]:
        """Return the true pictures of an object in the first epoch, float32 [N, H, W], 0..1."""
        config = self.simulation
        scene = scene_of(config, drawn_for(config, name), name)
        return scene.truth(config.sampling.canvas, scene.position_times_s(config.positions))


def live_dataset(
    config: Simulation, workers: int = 1, where: Place = "device", force: bool = False
) -> LiveDataset:
    """Return a simulation as a dataset to train on.

    Args:
        config: The settings.
        workers: Processes that simulate on the CPU; 0 means one for each core.
        where: "device" simulates where the network trains if the event model has a torch backend, "cpu" on the
            CPU also beside a GPU.
        force: Whether to go on although the machine's memory will hardly do.

    Raises:
        ConfigError: No object is left to train on.
        DataError: The objects that are simulated at a time take more memory than there is.
    """
    if not force:
        check_passes(object_bytes(config), processes(workers, len(config.glyphs.objects())))
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
