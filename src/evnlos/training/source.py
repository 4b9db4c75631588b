"""Where the batches of an epoch come from, and the processes that share them.

- The processes that train one network together, one a device, as `torchrun` starts them.
- Where the batches of an epoch come from: shards on disk, or a simulation that runs beside the training.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.data import DataLoader

from evnlos.data import InMemoryDataset, LiveDataset, Modality, NlosDataset
from evnlos.errors import ConfigError
from evnlos.machine import cores
from evnlos.models import DrawnSequences, Reconstructor
from evnlos.types import derive_seed


@dataclass(frozen=True)
class ProcessGroup:
    """This process and the others; a training without `torchrun` is a group of one.

    Args:
        rank: Number of this process, from 0; number 0 writes the run's folder.
        size: Number of processes.
        device: Where this process computes.
    """

    rank: int
    size: int
    device: torch.device

    def wait(self) -> None:
        """Return when every process has come here."""
        if self.size > 1:
            dist.barrier()

    def total(self, value: Tensor) -> Tensor:
        """Return the sum of the processes' values, the same on each; for a group of one the value itself."""
        if self.size > 1:
            value = value.clone()
            dist.all_reduce(value)
        return value

    def share(self, network: nn.Module) -> None:
        """Give every process the parameters and buffers of number 0, in place."""
        if self.size > 1:
            for value in network.state_dict().values():
                whole = value.contiguous()  # a layout other than C order is not sent
                dist.broadcast(whole, 0)
                value.copy_(whole)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace each parameter's gradient by its mean over the processes; one that has none counts as 0.

        Not by `DistributedDataParallel`, whose reducer outlives it and keeps the group's threads alive into the
        interpreter's end, where now and then one of them aborts the process.
        """
        if self.size == 1:
            return
        gradients = []
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            gradients.append(parameter.grad)
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        parts = (flat / self.size).split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))


@contextmanager
def process_group() -> Iterator[ProcessGroup]:
    """Join the processes that `torchrun` started (it sets RANK, WORLD_SIZE, LOCAL_RANK), for one training.

    A process that already belongs to a group of `torch.distributed` trains with that group and stays in it.
    """
    place, started = int(os.environ.get("LOCAL_RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)) > 1
    device = torch.device("cuda", place) if torch.cuda.is_available() else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if dist.is_available() and dist.is_initialized():
        yield ProcessGroup(dist.get_rank(), dist.get_world_size(), device)
    elif started:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        try:
            yield ProcessGroup(dist.get_rank(), dist.get_world_size(), device)
        finally:
            dist.destroy_process_group()
    else:
        yield ProcessGroup(0, 1, device)


_READERS = 4
"""Processes that read samples from disk, at most."""


class Batch(NamedTuple):
    """What one process sees of a batch."""

    seen: Tensor
    """Input, float32 [b, C, H, W]."""
    truth: Tensor
    """True images, float32 [b, 1, H, W]."""
    share: float
    """The part of the batch that these are, 0..1."""
    weight: float
    """The part of the epoch's samples that the whole batch is, 0..1."""


Samples = tuple[Tensor, Tensor, NDArray[np.str_]]


class BatchSource(Protocol):
    """Batches of any epoch, always the same for the same seed and epoch."""

    steps: int
    """Batches of an epoch."""

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield this process's part of each batch of an epoch (from 0)."""
        ...

    def mean_image(self) -> Tensor:
        """Return the mean of the true images, float32 [H, W]."""
        ...

    def subset(self, count: int) -> Samples:
        """Return about `count` samples at most, the same in every process: inputs [n, C, H, W], images
        [n, H, W] and the object of each.
        """
        ...

    def for_network(self, network: Reconstructor, augmentations: int, *, is_new: bool) -> BatchSource:
        """Return the source of what a network learns from, where these are single time steps.

        Arguments as in `Reconstructor.training_samples`.
        """
        ...


class DiskSource:
    """The samples of a dataset on disk: in memory, the device's first, where they fill at most half of what is
    free; else read batch by batch in processes of their own.

    A batch is cut into as many parts as there are processes; together they are the batch of one process.

    Args:
        samples: The samples: positions, or sequences.
        batch_size: Samples per step, of all processes together.
        seed: Seed of the order.
        process_group: The processes.
    """

    def __init__(
        self, samples: InMemoryDataset, batch_size: int, seed: int, process_group: ProcessGroup
    ) -> None:
        self.samples, self._batch_size, self._seed, self._process_group = (
            samples,
            batch_size,
            seed,
            process_group,
        )
        self.steps = -(-len(samples) // batch_size)
        self._reads = isinstance(samples, NlosDataset) and not samples.fits_in_memory()
        if self._reads:
            return
        if isinstance(samples, NlosDataset):
            samples.load()
        if (
            process_group.device.type == "cuda"
            and samples.bytes() < torch.cuda.mem_get_info(process_group.device)[0] // 2
        ):
            samples.to(process_group.device)

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield this process's part of each batch; a process that has none is given a sample of share 0."""
        order = torch.Generator().manual_seed(derive_seed(self._seed, "order", epoch))
        batches = torch.randperm(len(self.samples), generator=order).split(self._batch_size)
        parts = [batch[self._process_group.rank :: self._process_group.size] for batch in batches]
        chosen = [mine if len(mine) else batch[:1] for mine, batch in zip(parts, batches, strict=True)]
        for batch, mine, (seen, truth) in zip(batches, parts, self._taken(chosen), strict=True):
            yield Batch(seen, truth, len(mine) / len(batch), len(batch) / len(self.samples))

    def _taken(self, chosen: list[Tensor]) -> Iterable[tuple[Tensor, Tensor]]:
        """Return inputs and true images of each batch, in order."""
        if not self._reads:
            return (self.samples[indices] for indices in chosen)
        workers = min(_READERS, cores() - 1)
        # A batch at a time is an item of its own, so that a shard is opened once for it.
        return DataLoader(
            self.samples,
            batch_size=None,
            sampler=chosen,  # type: ignore[arg-type]
            num_workers=workers,
            multiprocessing_context="spawn" if workers else None,
        )

    def mean_image(self) -> Tensor:
        """Return the mean of the true images, float32 [H, W]."""
        if self._reads:
            every = torch.arange(len(self.samples)).split(self._batch_size)
            total = sum(truth[:, 0].sum(dim=0, dtype=torch.float64) for _, truth in self._taken(list(every)))
            return (total / len(self.samples)).float()  # type: ignore[union-attr]
        return self.samples.truth.float().mean(dim=0).cpu()

    def subset(self, count: int) -> Samples:
        """Return at most `count` samples, chosen by the seed, on the CPU."""
        draw = torch.Generator().manual_seed(derive_seed(self._seed, "some"))
        chosen = torch.randperm(len(self.samples), generator=draw)[:count].sort().values
        if self._reads:
            inputs, truth = self.samples[chosen]
            return inputs.half(), truth[:, 0].half(), self.samples.names[chosen.numpy()]
        inputs, truth = (
            part[chosen.to(part.device)].cpu() for part in (self.samples.inputs, self.samples.truth)
        )
        return inputs, truth, self.samples.names[chosen.numpy()]

    def for_network(self, network: Reconstructor, augmentations: int, *, is_new: bool) -> BatchSource:
        """Return the source of what a network learns from."""
        if not isinstance(self.samples, NlosDataset):
            return self
        samples = network.training_samples(self.samples, augmentations, self._seed, is_new=is_new)
        return (
            self
            if samples is self.samples
            else DiskSource(samples, self._batch_size, self._seed, self._process_group)
        )


class SimulatedSource:
    """Samples that are simulated as they are needed: epoch n is another draw, and the same one each time.

    The objects come in a seeded order; the samples of some of them are mixed, shuffled and cut into batches.
    Several processes simulate other objects each and mix among their own, so their batches are not those of
    one process; objects that do not fill all processes are left out of that epoch.

    Args:
        dataset: The simulation.
        modality: What the network sees.
        batch_size: Samples per step, of all processes together.
        seed: Seed of the order.
        process_group: The processes.

    Raises:
        ConfigError: The processes cannot share a batch, or are more than the objects.
    """

    def __init__(
        self,
        dataset: LiveDataset,
        modality: str | Modality,
        batch_size: int,
        seed: int,
        process_group: ProcessGroup,
    ) -> None:
        names = dataset.objects("train")
        if batch_size % process_group.size or len(names) < process_group.size:
            raise ConfigError(
                f"{process_group.size} processes can't share batches of {batch_size} of {len(names)} "
                "simulated objects; "
                "give a batch_size that they divide, and no more processes than objects"
            )
        self._dataset, self._names, self._process_group = dataset, names, process_group
        self._modality = modality
        self._size, self._seed = batch_size // process_group.size, seed
        self._objects = len(names) // process_group.size
        self.steps = -(-self._objects * dataset.simulation.positions // self._size)

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield the batches that this process makes in an epoch."""
        order = torch.Generator().manual_seed(derive_seed(self._seed, "order", epoch))
        turn = torch.randperm(len(self._names), generator=order)[: self._objects * self._process_group.size]
        names = [self._names[i] for i in turn[self._process_group.rank :: self._process_group.size].tolist()]
        made = self._dataset.stream(names, epoch, self._modality, self._process_group.device)
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
                yield Batch(inputs[mine], truth[mine], 1 / self._process_group.size, weight)
            held = [(inputs[shuffled[full:]], truth[shuffled[full:]])]

    def mean_image(self) -> Tensor:
        """Return the mean of the true images of the first epoch, float32 [H, W]; it takes no simulation."""
        total = sum(self._dataset.truth(name).mean(axis=0, dtype=np.float64) for name in self._names)
        return torch.from_numpy(total / len(self._names)).float()

    def subset(self, count: int) -> Samples:
        """Return the samples of the first objects of the first epoch, of as many as `count` allows."""
        objects = max(1, min(len(self._names), count // self._dataset.simulation.positions))
        names = self._names[:: max(1, len(self._names) // objects)][:objects]  # some of every hand
        made = list(self._dataset.stream(names, 0, self._modality, self._process_group.device))
        inputs, truth = (torch.cat(parts).cpu() for parts in zip(*made, strict=True))
        return inputs, truth[:, 0], np.repeat(names, [len(seen) for seen, _ in made])

    def for_network(self, network: Reconstructor, augmentations: int, *, is_new: bool) -> BatchSource:
        """Return this: a network of single time steps learns from them as they come."""
        return self


class DrawnSource:
    """Sequences of newly drawn targets, other ones each epoch, mixed with samples where there are any.

    Args:
        sequences: Makes them.
        count: Their number in an epoch.
        samples: What each batch shows beside them, by its number; None: nothing.
        batch_size: Samples per step, of all processes together.
        seed: Seed of the draws.
        process_group: The processes.
    """

    def __init__(
        self,
        sequences: DrawnSequences,
        count: int,
        samples: InMemoryDataset | None,
        batch_size: int,
        seed: int,
        process_group: ProcessGroup,
    ) -> None:
        self._sequences, self._seed, self._process_group = sequences, seed, process_group
        others = 0 if samples is None else len(samples)
        own = max(1, round(batch_size * others / (count + others))) if others else 0  # of a batch
        self._others = None if samples is None else DiskSource(samples, own, seed, process_group)
        self.steps = max(1, -(-count // batch_size)) if self._others is None else self._others.steps
        self._each = max(1, round((batch_size - own) / process_group.size))

    def batches(self, epoch: int) -> Iterator[Batch]:
        """Yield this process's part of each batch."""
        rank, size = self._process_group.rank, self._process_group.size
        others = [None] * self.steps if self._others is None else self._others.batches(epoch)
        for step, batch in enumerate(others):
            seed = derive_seed(self._seed, "drawn", epoch, step, rank)
            made = self._sequences.batch(self._each, seed)
            seen, truth = (part.to(self._process_group.device) for part in made)
            if batch is not None:
                seen, truth = torch.cat([batch.seen, seen]), torch.cat([batch.truth, truth])
            yield Batch(seen, truth, 1 / size, 1 / self.steps)


def half_mirrored(seen: Tensor, truth: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Return a batch of which about half of the samples, drawn by the seed, are upside down.

    Args:
        seen: Input, [b, C, H, W].
        truth: True images, [b, 1, h, w].
        seed: Seed of the draw.
    """
    draw = torch.rand(len(seen), generator=torch.Generator().manual_seed(seed)) < 0.5
    turned = draw.to(seen.device)[:, None, None, None]
    return torch.where(turned, seen.flip(-2), seen), torch.where(turned, truth.flip(-2), truth)


def with_mirrored(subset: Callable[[int], Samples]) -> Callable[[int], Samples]:
    """Return what draws samples as `subset` does, half of them being the other half upside down.

    Args:
        subset: Returns at most so many samples, as `BatchSource.subset`.
    """

    def both(count: int) -> Samples:
        inputs, truth, names = subset(max(1, count // 2))
        both_inputs, both_truth = (torch.cat([part, part.flip(-2)]) for part in (inputs, truth))
        return both_inputs, both_truth, np.concatenate([names, names])

    return both
