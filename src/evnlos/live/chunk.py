"""What a source hands on: events, the instants at which they came, and now and then a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.types import Events

UNKNOWN_US = -(1 << 62)
"""The event time of a stretch that has no event and says nothing of time."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """A stretch of the stream, short beside the latency that is aimed at.

    Args:
        events: Its events, in the order of time; there may be none.
        until_us: Event time that the stretch reaches, microseconds; no later event is in it.
        first_s: Instant at which its first event came, seconds on the `Clock`: in a replay the one at which it
            is due, else that of its arrival.
        last_s: Instant at which its last event came, seconds.
        frame: What the frame camera saw at `until_us`, float32 [H, W], 0..1; None where it took no frame.
        restart: Whether a new stream begins: what came before, and its clock, is forgotten.
    """

    events: Events
    until_us: int
    first_s: float
    last_s: float
    frame: NDArray[np.float32] | None = None
    restart: bool = False


class Source(Protocol):
    """Where events come from, as they come."""

    name: str
    """What it is, for a message."""
    has_frames: bool
    """Whether chunks can carry frames."""
    waits: bool
    """Whether it begins when it is asked to, and not when something happens."""

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield chunks as time goes by, until the stream ends or `stop` says so."""
        ...

    def faults(self) -> dict[str, int]:
        """Return how many of each kind of fault were met so far; what is damaged is left out."""
        ...

    def close(self) -> None:
        """Give back what it holds, such as a port."""
        ...
