"""A live run: the source fills a queue in its own thread, the network empties it, sinks get the pictures."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from evnlos.errors import ConfigError, DataError
from evnlos.live.chunk import Source
from evnlos.live.clock import Clock, SystemClock
from evnlos.live.engine import Engine, Picture
from evnlos.live.queue import ChunkQueue
from evnlos.live.tally import Tally

_NAP_S = 0.05


@dataclass(frozen=True)
class Pace:
    """How often there is a picture, and how much may wait for one."""

    rate: float = 100.0
    """Most pictures a second; one is made only when something came, and events wait for it."""
    queue_events: int = 200_000
    """Most events that wait between source and network; beyond that the oldest are dropped and counted."""
    seconds: float | None = None
    """End after so many seconds; by default with the source, or with Ctrl-C."""

    def __post_init__(self) -> None:
        if not 0.1 <= self.rate <= 1000:
            raise ConfigError(f"rate is {self.rate}; give 0.1 to 1000 pictures a second")
        if self.queue_events < 1:
            raise ConfigError(f"queue_events is {self.queue_events}; give at least 1")
        if self.seconds is not None and not self.seconds > 0:
            raise ConfigError(f"seconds is {self.seconds}; give a positive number")


class Sink(Protocol):
    """Something that takes pictures without making the run wait."""

    def show(self, picture: Picture) -> None:
        """Take a picture."""
        ...


class Run:
    """One run from a source to its sinks.

    Args:
        source: Where the events come from.
        engine: What makes pictures of them.
        pace: How often, and how much may wait.
        clock: The clock that it goes by.

    Attributes:
        tally: What it did so far.

    Raises:
        DataError: The network needs frames and the source has none.
    """

    def __init__(self, source: Source, engine: Engine, pace: Pace = Pace(), clock: Clock | None = None) -> None:
        if engine.needs_frames and not source.has_frames:
            raise DataError(
                f"weights of the modality {engine.modality.name!r} see frames and {source.name} has none; give "
                "the folder of a capture, or weights of the modality 'event'"
            )
        self._source, self._engine, self._pace = source, engine, pace
        self._clock = clock or SystemClock()
        self._queue = ChunkQueue(pace.queue_events)
        self._stop = threading.Event()
        self.tally = Tally(source, self._queue)

    def stop(self) -> None:
        """End the run soon; any thread may ask for it."""
        self._stop.set()

    def go(self, sinks: Iterable[Sink] = ()) -> Tally:
        """Run until the source ends, time is up, or `stop` or Ctrl-C ends it; return what was done.

        Raises:
            EvnlosError: The source can't go on; the pictures before it were made.
        """
        sinks = list(sinks)
        self._engine.begin()
        start_s = due_s = self._clock.now()
        pump = threading.Thread(target=self._pump, name="source", daemon=True)
        pump.start()
        try:
            while not self._stop.is_set() and not self._queue.ended:
                now = self._clock.now()
                if self._pace.seconds is not None and now - start_s >= self._pace.seconds:
                    break
                if now < due_s:
                    self._clock.sleep(due_s - now)
                chunks = self._queue.take(_NAP_S)
                taken_s = self._clock.now()
                picture = self._engine.see(chunks) if chunks else None
                if picture is not None:
                    due_s = taken_s + 1 / self._pace.rate
                    self.tally.add(picture)
                    for sink in sinks:
                        sink.show(picture)
            self._queue.take(0)  # raises what ended the source
        except KeyboardInterrupt:
            pass  # the way to end what has no end
        finally:
            self._stop.set()
            pump.join(timeout=2)
        return self.tally

    def _pump(self) -> None:
        error = None
        try:
            for chunk in self._source.chunks(self._stop.is_set):
                self._queue.put(chunk)
        except Exception as found:
            error = found
        self._queue.close(error)
