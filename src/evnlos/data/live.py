"""Samples that are simulated as a training needs them: no dataset on disk, and each epoch another draw."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.config import config_hash, to_dict
from evnlos.data.loader import Modality, as_modality
from evnlos.data.pool import processes, run_in_order
from evnlos.data.sampling import Samples
from evnlos.data.simulate import (
    Simulation,
    check_sequences,
    drawn_for,
    object_bytes,
    scene_of,
    simulate_object,
    split_of,
)
from evnlos.data.store import Dataset
from evnlos.errors import ConfigError
from evnlos.machine import cores
from evnlos.types import derive_seed


@dataclass(frozen=True)
class LiveDataset(Dataset):
    """A simulation that takes the place of a dataset on disk; make it with `live_dataset`.

    Epoch 0 is the dataset that `simulate` would write; epoch n has other handwriting, settings from the same
    ranges and other noise, and is the same whenever it is requested.
    """

    simulation: Simulation = field(default_factory=Simulation)
    """The settings."""
    workers: int = 1
    """Processes that simulate; 1 = in this process, 0 = one for each core."""
    mix: int = 8
    """Objects whose samples are shuffled together."""

    def stream(
        self, names: Iterable[str], epoch: int, modality: str | Modality, device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield input [N, C, H, W] and truth [N, 1, H, W] of each object, in order, float32.

        The samples are those of `simulate_object`, bit for bit, and go to the device in half precision.
        """
        config, seen = epoch_settings(self.simulation, epoch), as_modality(modality)
        tasks = [(config, name) for name in names]
        # one process per core, shared by the processes that train on this machine
        workers = self.workers or max(1, cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
        made = (_tensors(samples) for samples in run_in_order(_samples_of, tasks, workers))
        for maps in made:
            # in half precision twice, as shards hold the maps and a loader the inputs
            frame, surface, truth = (part.half().to(device).float() for part in maps)
            yield seen.inputs(frame, surface).half().float(), truth[:, None]

    def truth(self, name: str) -> NDArray[np.float32]:
        """Return the true images of an object in the first epoch, float32 [N, H, W], 0..1."""
        config = self.simulation
        scene = scene_of(config, drawn_for(config, name), name)
        return scene.truth(config.sampling.canvas, scene.position_times_s(config.positions))


def live_dataset(config: Simulation, workers: int = 1, force: bool = False) -> LiveDataset:
    """Return a simulation as a dataset to train on.

    Args:
        config: The settings.
        workers: Processes that simulate; 0 means one for each core.
        force: Whether to go on although the machine's memory will hardly do.

    Raises:
        ConfigError: No object is left to train on.
        DataError: The objects that are simulated at a time take more memory than there is.
    """
    if not force:
        check_sequences(object_bytes(config), processes(workers, len(config.glyphs.objects())))
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


def _samples_of(task: tuple[Simulation, str]) -> Samples:
    return simulate_object(*task)[0]


def _tensors(samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    assert samples.truth is not None  # a simulation knows its target
    frame, surface, truth = map(torch.from_numpy, (samples.frame, samples.surface, samples.truth))
    return frame, surface, truth
