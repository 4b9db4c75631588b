"""Where the batches of an epoch come from: shards on disk, or a simulation that runs beside the training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.dataset import HeldSamples, LiveDataset, Paradigm
from evnlos.errors import ConfigError
from evnlos.seeds import derive_seed
from evnlos.training.team import Team


class Batch(NamedTuple):
    """What one process sees of a batch."""

    seen: Tensor
    """Input, float32 [b, C, H, W]."""
    truth: Tensor
    """True pictures, float32 [b, 1, H, W]."""
    share: float
    """The part of the batch that these are, 0..1."""
    weight: float
    """The part of the epoch's samples that the whole batch is, 0..1."""


Samples = tuple[Tensor, Tensor, NDArray[np.str_]]


class Source(Protocol):
    """Batches of any epoch, always the same for the same seed and epoch."""

    steps: int
    """Batches of an epoch."""

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield this process's part of each batch of an epoch (from 0)."""
        ...

    def mean_image(self) -> Tensor:
        """Return the mean of the true pictures, float32 [H, W]."""
        ...

    def some(self, count: int) -> Samples:
        """Return about `count` samples at most, the same in every process: inputs [n, C, H, W], pictures
        [n, H, W] and the object of each.
        """
        ...


class Stored:
    """The samples of a dataset on disk, in memory: the device's, where they fill at most half of what is free.

    A batch is cut into as many parts as there are processes; together they are the batch of one process.

    Args:
        samples: The samples: positions, or passes.
        batch_size: Samples a step, of all processes together.
        seed: Seed of the order.
        team: The processes.
    """

    def __init__(self, samples: HeldSamples, batch_size: int, seed: int, team: Team) -> None:
        self.samples, self._batch_size, self._seed, self._team = samples, batch_size, seed, team
        self.steps = -(-len(samples) // batch_size)
        if team.device.type == "cuda" and samples.bytes() < torch.cuda.mem_get_info(team.device)[0] // 2:
            samples.to(team.device)

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield this process's part of each batch; a process that has none is given a sample of share 0."""
        order = torch.Generator().manual_seed(derive_seed(self._seed, "order", epoch))
        for batch in torch.randperm(len(self.samples), generator=order).split(self._batch_size):
            mine = batch[self._team.rank :: self._team.size]
            seen, truth = self.samples[mine if len(mine) else batch[:1]]
            yield Batch(seen, truth, len(mine) / len(batch), len(batch) / len(self.samples))

    def mean_image(self) -> Tensor:
        """Return the mean of the true pictures, float32 [H, W]."""
        return self.samples.truth.float().mean(dim=0).cpu()

    def some(self, count: int) -> Samples:
        """Return at most `count` samples, chosen by the seed, on the CPU."""
        draw = torch.Generator().manual_seed(derive_seed(self._seed, "some"))
        chosen = torch.randperm(len(self.samples), generator=draw)[:count].sort().values
        inputs, truth = (
            part[chosen.to(part.device)].cpu() for part in (self.samples.inputs, self.samples.truth)
        )
        return inputs, truth, self.samples.names[chosen.numpy()]


class Live:
    """Samples that are simulated as they are needed: epoch n is another draw, and the same one each time.

    The objects come in a seeded order; the samples of some of them are mixed, shuffled and cut into batches.
    Several processes simulate other objects each and mix among their own, so their batches are not those of
    one process; objects that do not fill all processes are left out of that epoch.

    Args:
        dataset: The simulation.
        paradigm: What the network sees.
        batch_size: Samples a step, of all processes together.
        seed: Seed of the order.
        team: The processes.

    Raises:
        ConfigError: The processes cannot share a batch, or are more than the objects.
    """

    def __init__(
        self, dataset: LiveDataset, paradigm: Paradigm, batch_size: int, seed: int, team: Team
    ) -> None:
        names = dataset.objects("train")
        if batch_size % team.size or len(names) < team.size:
            raise ConfigError(
                f"{team.size} processes can't share batches of {batch_size} of {len(names)} simulated objects; "
                "give a batch_size that they divide, and no more processes than objects"
            )
        self._dataset, self._names, self._team = dataset, names, team
        self._paradigm: Paradigm = paradigm
        self._size, self._seed = batch_size // team.size, seed
        self._objects = len(names) // team.size
        self.steps = -(-self._objects * dataset.simulation.positions // self._size)

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield the batches that this process makes in an epoch."""
        order = torch.Generator().manual_seed(derive_seed(self._seed, "order", epoch))
        turn = torch.randperm(len(self._names), generator=order)[: self._objects * self._team.size]
        names = [self._names[i] for i in turn[self._team.rank :: self._team.size].tolist()]
        made = self._dataset.stream(names, epoch, self._paradigm, self._team.device)
        held: list[tuple[Tensor, Tensor]] = []
        for number, samples in enumerate(made, start=1):
            held.append(samples)
            if number % self._dataset.mix and number < len(names):
                continue
            inputs, truth = (torch.cat(parts) for parts in zip(*held, strict=True))
            shuffled = torch.randperm(len(inputs), generator=order).to(inputs.device)
            full = len(inputs) if number == len(names) else len(inputs) // self._size * self._size
            for mine in shuffled[:full].split(self._size):
                weight = len(mine) / (self._objects * self._dataset.simulation.positions)
                yield Batch(inputs[mine], truth[mine], 1 / self._team.size, weight)
            held = [(inputs[shuffled[full:]], truth[shuffled[full:]])]

    def mean_image(self) -> Tensor:
        """Return the mean of the true pictures of the first epoch, float32 [H, W]; it takes no simulation."""
        total = sum(self._dataset.truth(name).mean(axis=0, dtype=np.float64) for name in self._names)
        return torch.from_numpy(total / len(self._names)).float()

    def some(self, count: int) -> Samples:
        """Return the samples of the first objects of the first epoch, of as many as `count` allows."""
        objects = max(1, min(len(self._names), count // self._dataset.simulation.positions))
        names = self._names[:: max(1, len(self._names) // objects)][:objects]  # some of every hand
        made = list(self._dataset.stream(names, 0, self._paradigm, self._team.device))
        inputs, truth = (torch.cat(parts).cpu() for parts in zip(*made, strict=True))
        return inputs, truth[:, 0], np.repeat(names, [len(seen) for seen, _ in made])
