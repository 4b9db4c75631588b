"""Chunks of events on their way from a source to the network: clock, chunk, bounded queue.

- The clock that a live reconstruction goes by; tests give it one that they turn themselves.
- What a source hands on: events, the instants at which they came, and now and then a frame.
- A queue of bounded length between source and network: what does not fit is counted, never waited for.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.types import Events


class Clock(Protocol):
    """Instants in seconds from an arbitrary origin, and waiting."""

    def now(self) -> float:
        """Return the instant, seconds; it never runs backwards."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; nothing happens for 0 or less."""
        ...


class SystemClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Return the instant, seconds."""
        return time.perf_counter()

    def sleep(self, seconds: float) -> None:
        """Wait; nothing happens for 0 or less."""
        if seconds > 0:
            time.sleep(seconds)


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


class EventSource(Protocol):
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


class ChunkQueue:
    """Chunks on their way to the network; the oldest ones are dropped where they would be too many.

    A source never waits. A dropped chunk's frame goes to the next chunk that has none: frames are few, and
    fusion needs one. The newest chunk is kept whatever its size.

    Args:
        most_events: Most events held; a chunk without events counts as one.

    Attributes:
        arrived_events: Events put in so far.
        dropped_events: Events dropped so far.
        dropped_chunks: Chunks dropped so far.

    Raises:
        ConfigError: The bound is below 1.
    """

    def __init__(self, most_events: int) -> None:
        if most_events < 1:
            raise ConfigError(f"the queue is to hold {most_events} events; give at least 1")
        self.most_events = most_events
        self.arrived_events = self.dropped_events = self.dropped_chunks = 0
        self._held: deque[Chunk] = deque()
        self._size = 0
        self._ready = threading.Condition()
        self._closed = False
        self._error: Exception | None = None

    def put(self, chunk: Chunk) -> None:
        """Add a chunk at once."""
        with self._ready:
            self.arrived_events += len(chunk.events)
            self._held.append(chunk)
            self._size += _size(chunk)
            while self._size > self.most_events and len(self._held) > 1:
                self._drop()
            self._ready.notify()

    def _drop(self) -> None:
        oldest = self._held.popleft()
        self._size -= _size(oldest)
        self.dropped_chunks += 1
        self.dropped_events += len(oldest.events)
        following = self._held[0]
        if following.restart:
            return
        if oldest.restart or (oldest.frame is not None and following.frame is None):
            frame = oldest.frame if following.frame is None else following.frame
            self._held[0] = replace(following, frame=frame, restart=oldest.restart)

    def take(self, timeout_s: float) -> list[Chunk]:
        """Return all chunks held, in their order; none where nothing came in time or the queue was closed.

        Raises:
            Exception: What ended the source, once everything before it was taken.
        """
        with self._ready:
            self._ready.wait_for(lambda: self._held or self._closed, timeout_s)
            chunks = list(self._held)
            self._held.clear()
            self._size = 0
            if not chunks and self._error is not None:
                raise self._error
            return chunks

    def close(self, error: Exception | None = None) -> None:
        """Say that nothing more will come, and why."""
        with self._ready:
            self._closed, self._error = True, error
            self._ready.notify()

    @property
    def ended(self) -> bool:
        """Whether nothing is held and nothing more will come."""
        with self._ready:
            return self._closed and not self._held


def _size(chunk: Chunk) -> int:
    return max(len(chunk.events), 1)
