"""A live run, and its statistics.

- What a live run did: images, latencies, drops, rates; as numbers and as a table.
- A live run: the source fills a queue in its own thread, the network empties it, sinks get the images.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from evnlos.errors import ConfigError, DataError
from evnlos.live.packet import ChunkQueue, Clock, EventSource, SystemClock

if TYPE_CHECKING:
    from evnlos.live.engine import Engine, Picture

_KEPT = 100_000  # images whose times are kept: half an hour at 50 a second, 6 MB
_RECENT = 100
_PERCENTILES = (50, 90, 99)

ROWS = {
    "oldest_event": "oldest new event to image",
    "newest_event": "newest event to image",
    "wait": "of the oldest: waiting",
    "surface": "of both: surface and maps",
    "network": "of both: network",
}
"""What is measured of each image, in words."""


class RunStatistics:
    """Counts what a run does, while it runs and afterwards.

    Args:
        source: Where the events come from.
        queue: The queue behind it.
    """

    def __init__(self, source: EventSource, queue: ChunkQueue) -> None:
        self._source, self._queue = source, queue
        self._times: deque[tuple[float, ...]] = deque(maxlen=_KEPT)
        self._recent: deque[tuple[float, int, float]] = deque(maxlen=_RECENT)
        self.images = self.events = 0
        self._first: tuple[float, int] | None = None  # instant and events of the first image
        self._last_s = 0.0

    def add(self, picture: Picture) -> None:
        """Count an image."""
        t = picture.timing
        self._times.append((t.oldest_s, t.newest_s, t.wait_s, t.surface_s, t.network_s))
        self._recent.append((picture.made_s, picture.events, t.oldest_s))
        self.images += 1
        self.events += picture.events
        self._first = self._first or (picture.made_s, picture.events)
        self._last_s = picture.made_s

    def now(self) -> dict[str, Any]:
        """Return how it goes: rates of the last 100 images, their median latency, drops."""
        recent = list(self._recent)
        span = recent[-1][0] - recent[0][0] if len(recent) > 1 else 0.0
        times = np.array([oldest_s * 1e3 for _, _, oldest_s in recent if np.isfinite(oldest_s)])
        return {
            "images": self.images,
            "images_hz": round((len(recent) - 1) / span, 1) if span else 0.0,
            "events_hz": round(sum(n for _, n, _ in recent[1:]) / span) if span else 0,
            "latency_ms": [round(float(v), 1) for v in np.percentile(times, [50, 99])] if len(times) else [],
            **self._losses(),
        }

    def _losses(self) -> dict[str, Any]:
        queue = self._queue
        dropped = {"events": queue.dropped_events, "chunks": queue.dropped_chunks}
        return {"dropped": dropped, "faults": self._source.faults()}

    def summary(self) -> dict[str, Any]:
        """Return everything: counts, rates, percentiles of the last 100,000 images in milliseconds.

        Seconds and rates are from the first image to the last.
        """
        begun_s, first_events = self._first or (self._last_s, 0)
        seconds = self._last_s - begun_s
        times = np.array(self._times).reshape(-1, len(ROWS)) * 1e3  # [images, rows]
        return {
            "source": self._source.name,
            "seconds": round(seconds, 3),
            "images": self.images,
            "images_hz": round((self.images - 1) / seconds, 2) if seconds else 0.0,
            "events": self.events,
            "events_hz": round((self.events - first_events) / seconds) if seconds else 0,
            **self._losses(),
            "latency_ms": {name: _spread(times[:, k]) for k, name in enumerate(ROWS)},
        }


def _spread(values: np.ndarray) -> dict[str, float] | None:
    """Return percentiles, maximum and mean of the values that are finite; None where there is none."""
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    found = {f"p{q}": float(np.percentile(values, q)) for q in _PERCENTILES}
    found |= {"max": float(values.max()), "mean": float(values.mean())}
    return {name: round(value, 3) for name, value in found.items()}


def latency_table(summary: dict[str, Any]) -> str:
    """Return a summary as lines of text: percentiles, rates, what was lost."""
    names = ("p50", "p90", "p99", "max")
    lines = [f"{'latency, ms':<32}{''.join(f'{name:>9}' for name in names)}"]
    for row, title in ROWS.items():
        spread = summary["latency_ms"][row]
        cells = (f"{spread[name]:9.1f}" if spread else f"{'-':>9}" for name in names)
        lines.append(f"{title:<32}{''.join(cells)}")
    images = f"{summary['images']:,} images ({summary['images_hz']:.1f} a second)"
    events = f"{summary['events']:,} events ({summary['events_hz']:,} a second)"
    lines.append(f"{images} of {events} in {summary['seconds']:.1f} s")
    dropped, faults = summary["dropped"], _listed(summary["faults"].items())
    lines.append(f"dropped by the queue: {dropped['events']:,} events in {dropped['chunks']:,} chunks")
    return "\n".join([*lines, *([f"left out by the source: {faults}"] if faults else [])])


def _listed(faults: Iterable[tuple[str, int]]) -> str:
    return ", ".join(f"{count:,} {name}" for name, count in faults if count)


_NAP_S = 0.05


@dataclass(frozen=True)
class RateOptions:
    """How often there is an image, and how much may wait for one."""

    rate: float = 100.0
    """Most images per second; one is made only when something came, and events wait for it."""
    queue_events: int = 200_000
    """Most events that wait between source and network; beyond that the oldest are dropped and counted."""
    seconds: float | None = None
    """End after so many seconds; by default with the source, or with Ctrl-C."""

    def __post_init__(self) -> None:
        if not 0.1 <= self.rate <= 1000:
            raise ConfigError(f"rate is {self.rate}; give 0.1 to 1000 images per second")
        if self.queue_events < 1:
            raise ConfigError(f"queue_events is {self.queue_events}; give at least 1")
        if self.seconds is not None and not self.seconds > 0:
            raise ConfigError(f"seconds is {self.seconds}; give a positive number")


class Sink(Protocol):
    """Something that takes images without making the run wait."""

    def show(self, picture: Picture) -> None:
        """Take an image."""
        ...


class Run:
    """One run from a source to its sinks.

    Args:
        source: Where the events come from.
        engine: What makes images of them.
        pace: How often, and how much may wait.
        clock: The clock that it goes by.

    Attributes:
        statistics: What it did so far.

    Raises:
        DataError: The network needs frames and the source has none.
    """

    def __init__(
        self, source: EventSource, engine: Engine, pace: RateOptions = RateOptions(), clock: Clock | None = None
    ) -> None:
        if engine.needs_frames and not source.has_frames:
            raise DataError(
                f"weights of the modality {engine.modality.name!r} see frames and {source.name} has none; give "
                "the folder of a capture, or weights of the modality 'event'"
            )
        self._source, self._engine, self._pace = source, engine, pace
        self._clock = clock or SystemClock()
        self._queue = ChunkQueue(pace.queue_events)
        self._stop = threading.Event()
        self.statistics = RunStatistics(source, self._queue)

    def stop(self) -> None:
        """End the run soon; any thread may ask for it."""
        self._stop.set()

    def go(self, sinks: Iterable[Sink] = ()) -> RunStatistics:
        """Run until the source ends, time is up, or `stop` or Ctrl-C ends it; return what was done.

        Raises:
            EvnlosError: The source can't go on; earlier images were made.
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
                    self.statistics.add(picture)
                    for sink in sinks:
                        sink.show(picture)
            self._queue.take(0)  # raises what ended the source
        except KeyboardInterrupt:
            pass  # the way to end what has no end
        finally:
            self._stop.set()
            pump.join(timeout=2)
        return self.statistics

    def _pump(self) -> None:
        error = None
        try:
            for chunk in self._source.chunks(self._stop.is_set):
                self._queue.put(chunk)
        except Exception as found:
            error = found
        self._queue.close(error)
