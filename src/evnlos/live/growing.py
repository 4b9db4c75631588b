"""An event file that a camera's program still writes, read as it grows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from evnlos.errors import EventFileError
from evnlos.live.chunk import Chunk
from evnlos.live.clock import Clock, SystemClock
from evnlos.live.tail import OrderedTail, open_tail

_POLL_S = 0.002
_BLOCK_BYTES = 1 << 16


class GrowingFile:
    """A source that follows a file from its first event on, until it stops growing.

    The file may not be there yet. What it already holds is decoded first, because formats with running clocks
    can't be entered in the middle. An event's instant is the one at which its bytes were read.

    Args:
        path: The file: RAW (EVT2, EVT2.1, EVT3), DAT or CSV.
        width: Sensor width, pixels, where the file does not say; give both or neither.
        height: Sensor height, pixels.
        idle_s: End after so many seconds without a new byte; None = never.
        clock: The clock that it goes by.
    """

    def __init__(
        self,
        path: Path,
        *,
        width: int | None = None,
        height: int | None = None,
        idle_s: float | None = 10.0,
        clock: Clock | None = None,
    ) -> None:
        self.path, self.name, self.has_frames, self.waits = path, str(path), False, False
        self._size, self._idle_s, self._clock = (width, height), idle_s, clock or SystemClock()
        self._tail: OrderedTail | None = None

    def faults(self) -> dict[str, int]:
        """Return how many words, lines or events were left out as damaged."""
        return {"damaged events": self._tail.faults if self._tail else 0}

    def close(self) -> None:
        """Do nothing: the file is closed when its last chunk is taken."""

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what was written since the chunk before.

        Raises:
            EventFileError: The file can't be followed, never came, or became shorter.
        """
        self._tail = tail = self._opened(stop)
        if tail is None:
            return
        place, heard_s = tail.start, self._clock.now()
        with self.path.open("rb", buffering=0) as file:
            file.seek(place)
            while not stop():
                data = file.read(_BLOCK_BYTES)
                now = self._clock.now()
                if not data:
                    if self.path.stat().st_size < place:
                        raise EventFileError(f"{self.path} became shorter; follow a file that only grows")
                    if self._idle_s is not None and now - heard_s > self._idle_s:
                        return
                    self._clock.sleep(_POLL_S)
                    continue
                place, heard_s = place + len(data), now
                events = tail.feed(data)
                if len(events):
                    yield Chunk(events, int(events.t_us[-1]), now, now)

    def _opened(self, stop: Callable[[], bool]) -> OrderedTail | None:
        """Return the decoder as soon as the header is there; None where `stop` came first."""
        begun_s = self._clock.now()
        while not stop():
            tail = open_tail(self.path, *self._size)
            if tail is not None:
                return tail
            if self._idle_s is not None and self._clock.now() - begun_s > self._idle_s:
                what = "holds no event" if self.path.is_file() else "does not exist"
                raise EventFileError(f"{self.path} {what} after {self._idle_s} s; start the recording first")
            self._clock.sleep(_POLL_S)
        return None
