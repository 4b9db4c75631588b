"""A queue of bounded length between source and network: what does not fit is counted, never waited for."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace

from evnlos.errors import ConfigError
from evnlos.live.chunk import Chunk


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
