"""What a reconstructor sees: a modality is a list of named groups of channels, each made from recorded maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.errors import ConfigError
from evnlos.registry import Registry

Maps = Mapping[str, Tensor]
"""Recorded maps by name: "frame" [N, 1, H, W] and "surface" [N, 2, H, W] (ON, OFF), float32."""


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
            surface: Time surfaces, [N, 2, H, W]: ON, OFF.

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
                raise ConfigError(
                    f"the channel group {group.name!r} asks for the map {min(unknown)!r}; recordings have "
                    f"{', '.join(maps)}"
                )
            part = maps[group.maps[0]] if group.make is None else group.make(maps)
            if part.ndim != 4 or part.shape[1] != group.channels:
                raise ConfigError(
                    f"the channel group {group.name!r} gives {tuple(part.shape)}; it says "
                    f"[N, {group.channels}, H, W]"
                )
            parts.append(part)
        return torch.cat(parts, dim=1)


FRAME = ChannelGroup("frame", 1, ("frame",), rank_share=0.625)
"""The frame."""
EVENTS = ChannelGroup("events", 2, ("surface",), centred=False, rank_share=0.375)
"""The two polarities of the time surface; 0 is "no event"."""

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
    """Return where a modality stands in tables: in the order of the registry, an unknown one last."""
    names = list(MODALITIES)
    return names.index(name) if name in names else len(names)
