"""Samples ready for a network, on disk or in memory: what it sees is one switch, the modality."""

from __future__ import annotations

import math
import os
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.dataset.modality import MODALITIES, Modality, as_modality
from evnlos.dataset.shard import read_shard, read_shard_index
from evnlos.dataset.store import Dataset
from evnlos.errors import DataError


class HeldSamples(torch.utils.data.Dataset):
    """Samples in memory: item i is (input [C, h, w], picture [1, h, w]), float32.

    Args:
        inputs: What the network sees, float16 [N, C, h, w].
        truth: True pictures, float16 [N, h, w].
        names: The object of each sample, [N].
    """

    def __init__(self, inputs: Tensor, truth: Tensor, names: NDArray[np.str_]) -> None:
        self.inputs, self.truth, self.names = inputs, truth, names

    def __len__(self) -> int:
        return len(self.inputs)

    def bytes(self) -> int:
        """Return the size of inputs and truth, bytes."""
        return self.inputs.nbytes + self.truth.nbytes

    def to(self, device: torch.device) -> None:
        """Move inputs and truth to a device, where batches are then cut without a copy from main memory."""
        self.inputs, self.truth = self.inputs.to(device), self.truth.to(device)

    def __getitem__(self, index: int | Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return one sample, or a batch for a tensor of indices."""
        return self.inputs[index].float(), self.truth[index].unsqueeze(-3).float()


class NlosDataset(HeldSamples):
    """The samples of a split: item i is (input [C, H, W], truth [1, H, W]), float32, read when it is asked for.

    A map-style dataset for `torch.utils.data.DataLoader`, with any number of workers: it keeps no file open
    and, until `load`, no map in memory, whatever its size.

    Args:
        dataset: The dataset on disk.
        split: "train", "validation", "test" or "all".
        modality: What the inputs show, or its name.

    Attributes:
        inputs: float16 [N, C, H, W]; the first use reads the whole split into memory, as `load` does.
        truth: float16 [N, H, W]; the same.
        names: The object of each sample, [N].
        modality: What the inputs show.
        position_m: The target's centre, (x, y) in metres, float32 [N, 2]; NaN where it is unknown.

    Raises:
        DataError: A shard is missing or damaged, an object has no truth to learn from, or shards are of
            different sizes.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> def batches(dataset: Dataset) -> DataLoader:
        ...     samples = NlosDataset(dataset, "train", "fusion")
        ...     return DataLoader(samples, batch_size=32, shuffle=True, num_workers=4)
    """

    def __init__(self, dataset: Dataset, split: str, modality: str | Modality) -> None:
        self.modality = as_modality(modality)
        objects = dataset.objects(split)
        self._shards = [dataset.shard(name) for name in objects]
        places, lengths, shapes = [], [], {}
        for path in self._shards:
            index = read_shard_index(path)
            if not index.has_truth:
                raise DataError(f"{path} has no truth (unknown target or motion); reconstruct it instead")
            unknown = np.full((index.length, 2), np.nan)
            places.append(unknown if index.position_m is None else index.position_m)
            lengths.append(index.length)
            shapes.setdefault(index.shape, path)
        if len(shapes) > 1:
            one, other = list(shapes.items())[:2]
            raise DataError(
                f"{one[1]} holds maps of {one[0]} and {other[1]} of {other[0]} pixels; make the dataset again"
            )
        (self._shape,) = shapes
        self._ends = np.cumsum(lengths)  # number of samples up to the end of each shard
        self.names = np.repeat(np.array(objects), lengths)
        self.position_m = np.concatenate(places).astype(np.float32)

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def inputs(self) -> Tensor:  # type: ignore[override]
        """What the network sees of the whole split, in memory, float16 [N, C, H, W]."""
        return self.load().inputs

    @cached_property
    def truth(self) -> Tensor:  # type: ignore[override]
        """True images of the whole split, in memory, float16 [N, H, W]."""
        return self.load().truth

    @property
    def in_memory(self) -> bool:
        """Whether the whole split has been read."""
        return "inputs" in self.__dict__

    def load(self) -> NlosDataset:
        """Read the whole split into memory, from where samples are then taken, and return it.

        Raises:
            DataError: A shard is missing or damaged.
        """
        if not self.in_memory:
            channels = self.modality.channels
            inputs = torch.empty(len(self), channels, *self._shape, dtype=torch.float16)
            truth = torch.empty(len(self), *self._shape, dtype=torch.float16)
            for number, end in enumerate(self._ends):
                seen, true = self._read(number)
                inputs[end - len(seen) : end], truth[end - len(seen) : end] = seen, true
            self.inputs, self.truth = inputs, truth
        return self

    def bytes(self) -> int:
        """Return the size of inputs and truth of the whole split in memory, bytes; nothing is read."""
        return 2 * len(self) * (self.modality.channels + 1) * math.prod(self._shape)

    def fits_in_memory(self) -> bool:
        """Return whether the whole split takes at most half of the memory that is free."""
        return self.in_memory or self.bytes() <= free_memory() // 2

    def to(self, device: torch.device) -> None:
        """Read the whole split and move it to a device."""
        super().to(device) if self.in_memory else self.load().to(device)

    def __getitem__(self, index: int | Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return one sample, or a batch for a tensor of indices or a slice.

        Raises:
            DataError: A shard is missing or damaged.
            IndexError: There are not so many samples.
        """
        if self.in_memory:
            return super().__getitem__(index)
        wanted = np.arange(len(self))[index.cpu().numpy() if isinstance(index, Tensor) else index]
        rows = np.atleast_1d(wanted)
        owners = np.searchsorted(self._ends, rows, side="right")
        inputs = torch.empty(len(rows), self.modality.channels, *self._shape)
        truth = torch.empty(len(rows), 1, *self._shape)
        for number in np.unique(owners):
            mine = np.flatnonzero(owners == number)
            first = self._ends[number - 1] if number else 0
            steps, back = np.unique(rows[mine] - first, return_inverse=True)
            seen, true = self._read(int(number), steps)
            inputs[mine], truth[mine, 0] = seen[back].float(), true[back].float()
        return (inputs, truth) if np.ndim(wanted) else (inputs[0], truth[0])

    def __getstate__(self) -> dict[str, Any]:
        """Return what a worker process needs: the maps stay on disk, a modality goes by its name."""
        state = {key: value for key, value in self.__dict__.items() if key not in ("inputs", "truth")}
        if self.modality.name in MODALITIES:
            state["modality"] = self.modality.name
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"modality": as_modality(state["modality"])}

    def _read(self, number: int, steps: NDArray[np.int64] | None = None) -> tuple[Tensor, Tensor]:
        """Return inputs [n, C, H, W] and truth [n, H, W] of a shard, float16, at some of its time steps."""
        samples, _ = read_shard(self._shards[number], steps)
        if samples.truth is None or samples.frame.shape[1:] != self._shape:
            raise DataError(f"{self._shards[number]} was changed meanwhile; make the dataset again")
        inputs = self.modality.inputs(samples.frame, samples.surface)
        return inputs.half(), torch.from_numpy(samples.truth).half()


def free_memory() -> int:
    """Return how much memory this process may still take, bytes: of the machine, and of its container."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
        cache = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):  # none, or "max"
        return free
    return min(free, max(0, limit - used + int(cache.get("inactive_file", 0))))
