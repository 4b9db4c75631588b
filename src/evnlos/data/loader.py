"""Modalities, which say what a reconstructor sees, and datasets of samples ready for it.

- What a reconstructor sees: a modality is a list of named groups of channels, each made from recorded maps.
- Samples ready for a network, on disk or in memory: what it sees is one switch, the modality.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.data.store import Dataset, read_shard, read_shard_index
from evnlos.errors import ConfigError, DataError
from evnlos.registry import Registry

Maps = Mapping[str, Tensor]
"""Recorded maps by name: "frame" [N, 1, H, W] and "surface" [N, 2 or 4, H, W] (ON, OFF, trace), float32."""


@dataclass(frozen=True)
class ChannelGroup:
    """Channels that belong together: one scale, one linear embedding.

    Args:
        name: Name of the group; an attribute name, unique in its modality.
        channels: Number of its channels.
        maps: Names of the recorded maps that it is made from.
        make: From the maps [N, ?, H, W] to the channels [N, `channels`, H, W]; None takes the one map as it is.
        centred: Whether the normalization takes the mean away; False where 0 means "nothing here".
        rank_share: How much of a linear embedding's rank the group gets, relative to the others.
    """

    name: str
    channels: int
    maps: tuple[str, ...]
    make: Callable[[Maps], Tensor] | None = None
    centred: bool = True
    rank_share: float = 1.0

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ConfigError(f"a channel group is called {self.name!r}; give letters, digits and underscores")
        if self.channels < 1 or not self.rank_share > 0 or not self.maps:
            raise ConfigError(f"the channel group {self.name!r} has no channel, no map or no share of the rank")
        if self.make is None and len(self.maps) != 1:
            raise ConfigError(f"the channel group {self.name!r} has several maps; say with `make` what to do")


@dataclass(frozen=True)
class Modality:
    """Named groups of channels, in the order in which a reconstructor sees them.

    Args:
        name: Name in settings, files and tables.
        groups: The groups.
        noun: What it is called in a sentence.
    """

    name: str
    groups: tuple[ChannelGroup, ...]
    noun: str

    def __post_init__(self) -> None:
        names = [group.name for group in self.groups]
        if not names or len(set(names)) != len(names):
            raise ConfigError(f"the modality {self.name!r} has no group or two of one name among {names}")

    @property
    def kind(self) -> str:
        """The name, under which a registry keeps it."""
        return self.name

    @property
    def channels(self) -> int:
        """Number of channels of all groups together."""
        return sum(group.channels for group in self.groups)

    @property
    def layout(self) -> dict[str, int]:
        """Name of each group -> number of its channels, in their order."""
        return {group.name: group.channels for group in self.groups}

    @property
    def slices(self) -> dict[str, slice]:
        """Name of each group -> its channels in the input."""
        found, first = {}, 0
        for group in self.groups:
            found[group.name] = slice(first, first + group.channels)
            first += group.channels
        return found

    def seeing(self, surface: str) -> Modality:
        """Return the modality with the group `TRACE` where it has `EVENTS` and the surface is `sae-trace`."""
        more = (TRACE,) if surface == "sae-trace" and EVENTS in self.groups else ()
        return replace(self, groups=self.groups + more)

    @property
    def needs_frames(self) -> bool:
        """Whether a group is made from frames."""
        return any("frame" in group.maps for group in self.groups)

    @property
    def needs_events(self) -> bool:
        """Whether a group is made from events."""
        return any("surface" in group.maps for group in self.groups)

    def ranks(self, rank: int) -> list[int]:
        """Return how the rank of a linear embedding is shared among the groups; each gets at least 1.

        Args:
            rank: Components of all groups together.

        Raises:
            ConfigError: There are fewer components than groups.
        """
        if rank < len(self.groups):
            names = " and ".join(group.name for group in self.groups)
            raise ConfigError(
                f"the rank is {rank}; {names} need one component each: give {len(self.groups)} or more"
            )
        total = sum(group.rank_share for group in self.groups)
        rest = [max(1, round(group.rank_share / total * rank)) for group in self.groups[1:]]
        return [max(1, rank - sum(rest)), *rest]

    def inputs(self, frame: NDArray | Tensor, surface: NDArray | Tensor) -> Tensor:
        """Return what a reconstructor sees, float32 [N, C, H, W]; the levels stay as they were measured, 0..1.

        Args:
            frame: Frames, [N, H, W].
            surface: Time surfaces, [N, 2 or 4, H, W]: ON, OFF, and the trace where it is there.

        Raises:
            ConfigError: A group gives another number of channels than it says, or asks for an unknown map.
        """
        maps = {
            "frame": torch.as_tensor(frame, dtype=torch.float32)[:, None],
            "surface": torch.as_tensor(surface, dtype=torch.float32),
        }
        parts = []
        for group in self.groups:
            if unknown := set(group.maps) - set(maps):
                wants = f"the channel group {group.name!r} asks for the map {min(unknown)!r}"
                raise ConfigError(f"{wants}; recordings have {', '.join(maps)}")
            part = maps[group.maps[0]] if group.make is None else group.make(maps)
            if part.ndim != 4 or part.shape[1] != group.channels:
                given = f"the channel group {group.name!r} gives {tuple(part.shape)}"
                raise ConfigError(f"{given}; it says [N, {group.channels}, H, W]")
            parts.append(part)
        return torch.cat(parts, dim=1)


FRAME = ChannelGroup("frame", 1, ("frame",), rank_share=0.625)
"""The frame."""


def _pair(first: int, maps: Maps) -> Tensor:
    return maps["surface"][:, first : first + 2]


EVENTS = ChannelGroup("events", 2, ("surface",), partial(_pair, 0), centred=False, rank_share=0.375)
"""The two polarities of the time surface; 0 is "no event"."""
TRACE = replace(EVENTS, name="trace", make=partial(_pair, 2))
"""The causal trace beside the time surface, which networks of single time steps see of `sae-trace`."""

MODALITIES: Registry[Modality] = Registry("evnlos.modalities", "modality")
"""Every modality by name."""
MODALITIES.register(Modality("frame", (FRAME,), "frames"))
MODALITIES.register(Modality("event", (EVENTS,), "events"))
MODALITIES.register(Modality("fusion", (FRAME, EVENTS), "frames and events"))

STANDARD_MODALITIES = ("frame", "event", "fusion")
"""The modalities that experiments compare."""


def as_modality(modality: str | Modality) -> Modality:
    """Return the modality of a name; a modality stands for itself.

    Args:
        modality: A name of `MODALITIES`, or a modality.

    Raises:
        ConfigError: There is no modality of this name.
    """
    return modality if isinstance(modality, Modality) else MODALITIES[modality]


def modality_order(name: str) -> int:
    """Return where a modality stands in tables: in the order of the registry, an unknown one last.

    Args:
        name: Name of a modality, e.g. "fusion".
    """
    names = list(MODALITIES)
    return names.index(name) if name in names else len(names)


class InMemoryDataset(torch.utils.data.Dataset):
    """Samples in memory: item i is (input [C, h, w], image [1, h, w]), float32.

    Args:
        inputs: What the network sees, float16 [N, C, h, w].
        truth: True images, float16 [N, h, w].
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


def _check_cameras(dataset: Dataset, objects: list[str], modality: Modality) -> None:
    """Raise `DataError` where a capture was recorded without what the modality shows: its maps are empty."""
    lacks = dataset.config.get("lacks")
    lacks = lacks if isinstance(lacks, dict) else {}
    for name in objects:
        for what, recorded, other in (("frames", "frame", "event"), ("events", "surface", "frame")):
            if lacks.get(name) == what and any(recorded in group.maps for group in modality.groups):
                lacking = f"{name} was recorded without {what}, and the modality is {modality.name}"
                raise DataError(f"{lacking}; give --modality {other}, or leave the capture out")


class NlosDataset(InMemoryDataset):
    """The samples of a split: item i is (input [C, H, W], truth [1, H, W]), float32, read when it is requested.

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
        _check_cameras(dataset, objects, self.modality)
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
        if self.modality.name in MODALITIES and MODALITIES[self.modality.name] == self.modality:
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
