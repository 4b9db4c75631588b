"""A live run, and its statistics.

- What a live run did: images, latencies, drops, rates; as numbers and as a table.
- The image of all that was seen so far, made beside a run in a process of its own, as often as it is worth it.
- A live run: the source fills a queue in its own thread, the network empties it, sinks get the images.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.live.packet import Chunk, ChunkQueue, Clock, EventSource, SystemClock
from evnlos.types import Events

if TYPE_CHECKING:
    from concurrent.futures import Future

    from evnlos.live.engine import Engine, Picture
    from evnlos.models import Weights
    from evnlos.scene import Motion

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


class ImagesSoFar:
    """Images of all that was seen so far, by a network of whole sequences, one after the other.

    It sees the target that the events so far make most likely, and all frames so far but the first: images of
    `evnlos reconstruct --so-far`, but for where each search begins.

    Args:
        weights: Such a network; its samples name the setup whose light path is undone.
        motion: Of the target, on the clock of the source.
        span_us: First and last instant of the sequence, microseconds.
        shape: Rows and columns of the event camera.

    Raises:
        ConfigError: The setup is unknown.
        DataError: The network sees single time steps, or surfaces that are no likelihood.
    """

    def __init__(
        self, weights: Weights, motion: Motion, span_us: tuple[int, int], shape: tuple[int, int]
    ) -> None:
        from evnlos.inverse import RunningEventImages

        _check_sequence(weights)
        sampling = weights.sampling
        self._network = weights.network.seeing(replace(sampling, surface="so-far")).eval()
        self._modality, self._motion, self._canvas = weights.modality, motion, sampling.canvas
        known = span_us, motion, sampling.setup, sampling.canvas, shape
        self._events = RunningEventImages(*known) if self._modality.needs_events else None
        self._forget()

    def _forget(self) -> None:
        self._parts, self._until_us = list[Events](), 0
        self._frames, self._times_us = list[NDArray[np.float32]](), list[int]()
        if self._events is not None:
            self._events.begin()

    def after(self, chunks: Sequence[Chunk]) -> NDArray[np.float32] | None:
        """Take what came and return the image, float32 [H, W], 0..1; None where there is none to be made.

        Raises:
            DataError: The target is off the canvas.
        """
        import torch

        from evnlos.data.sampling import reduce_by_area

        for chunk in chunks:
            if chunk.restart:
                self._forget()
            self._parts += [chunk.events] if len(chunk.events) else []
            self._until_us = chunk.until_us
            if chunk.frame is not None:
                self._frames.append(reduce_by_area(np.asarray(chunk.frame), self._canvas.shape))
                self._times_us.append(chunk.until_us if chunk.frame_us is None else chunk.frame_us)
        frames, times_us = self._frames[1:], self._times_us[1:]
        if not self._modality.needs_frames:
            frames, times_us = [np.zeros(self._canvas.shape, np.float32)], [self._until_us]
        if not frames or (self._events is not None and not self._parts):
            return None
        at = self._motion.position_m(np.asarray(times_us, np.float64) * 1e-6)
        surface = np.zeros((len(frames), 2, *self._canvas.shape), np.float32)
        if self._events is not None:
            self._parts = [Events.concatenate(self._parts)]
            surface[-1] = self._events.at(self._parts[0], times_us[-1], at[-1])
        with torch.inference_mode():
            place = torch.from_numpy(at.astype(np.float32))
            seen = self._modality.inputs(np.stack(frames), surface)
            return self._network.draw(seen, place, place[-1:])[0].numpy()


def _check_sequence(weights: Weights) -> None:
    if not weights.network.sees_sequence or (weights.modality.needs_events and not weights.sampling.is_solved):
        raise DataError(
            "these weights do not see what all events and frames so far say of the target; give weights of "
            "whole sequences and the surface 'likelihood', such as near-event-sequence"
        )


_held: ImagesSoFar | None = None  # of a process beside a run


def _hold(*about: Any) -> None:
    global _held
    _held = ImagesSoFar(*about)


def _timed(chunks: Sequence[Chunk]) -> tuple[NDArray[np.float32] | None, float]:
    assert _held is not None
    began_s = time.perf_counter()
    return _held.after(chunks), time.perf_counter() - began_s


_FEWEST_EVENTS = 500  # for the first image


class SoFar:
    """`ImagesSoFar` beside a run, in a process of their own: the run's images wait for none of them.

    Args:
        weights: As for `ImagesSoFar`.
        about: Its other arguments.

    Attributes:
        seconds: How long each image took.

    Raises:
        DataError: The weights do not fit.
    """

    def __init__(self, weights: Weights, *about: Any) -> None:
        from evnlos.inverse.event_images import WORTH  # which compiles

        _check_sequence(weights)
        self._worth = WORTH
        self._about, self._ending = (weights, *about), ExitStack()
        self._sees_events = weights.modality.needs_events
        self.seconds = list[float]()
        self._fault: DataError | None = None
        self._waiting, self._count, self._known = list[Chunk](), 0, 0
        self._at_work: Future[tuple[NDArray[np.float32] | None, float]] | None = None
        self._image = np.zeros(weights.sampling.canvas.shape, np.float32)

    def begin(self) -> None:
        """Start the process and wait until it is ready; errors are those of `ImagesSoFar`."""
        from evnlos.data.pool import one_worker

        self._worker = self._ending.enter_context(one_worker())
        self._worker.submit(_hold, *self._about).result()

    def add(self, chunks: Sequence[Chunk]) -> None:
        """Take what came, and begin an image where that is worth it and none is at work; wait for nothing."""
        for chunk in chunks:
            if chunk.restart:
                self._count = self._known = 0
                self._image = np.zeros_like(self._image)
            self._waiting.append(chunk)
            self._count += len(chunk.events) if self._sees_events else chunk.frame is not None
        self._take_if_done()
        least = max(_FEWEST_EVENTS, self._worth * self._known) if self._sees_events else self._known + 1
        if self._at_work is None and self._count >= least:
            self._begin_image()

    def _begin_image(self) -> None:
        self._at_work, self._known = self._worker.submit(_timed, self._waiting), self._count
        self._waiting = []

    @property
    def newest(self) -> NDArray[np.float32]:
        """The newest image, float32 [H, W], 0..1; black before the first."""
        self._take_if_done()
        return self._image

    def _take_if_done(self) -> None:
        if self._at_work is not None and self._at_work.done():
            self._take()

    def _take(self) -> None:
        assert self._at_work is not None
        done, self._at_work = self._at_work, None
        try:
            image, seconds = done.result()
        except DataError as error:  # the target is off the canvas yet
            self._fault = error
            return
        if image is not None and self._known:  # else the replay began anew meanwhile
            self._image = image
            self.seconds.append(seconds)

    def finish(self) -> None:
        """Wait for the image of everything.

        Raises:
            DataError: There was never an image, and why.
        """
        if self._at_work is not None:
            self._take()
        if self._waiting and self._count > self._known:
            self._begin_image()
            self._take()
        if self._fault is not None and not self.seconds:
            raise self._fault

    def close(self) -> None:
        """End the process, once it is done with an image that it is at."""
        self._ending.close()

    def summary(self) -> dict[str, Any]:
        """Return how many images there were, and the median of their times, seconds."""
        return {"images": len(self.seconds), "seconds": round(float(np.median(self.seconds or [0.0])), 3)}


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
        so_far: What makes the image of all so far beside it.

    Attributes:
        statistics: What it did so far.

    Raises:
        DataError: The network needs frames and the source has none.
    """

    def __init__(
        self,
        source: EventSource,
        engine: Engine,
        pace: RateOptions = RateOptions(),
        clock: Clock | None = None,
        so_far: SoFar | None = None,
    ) -> None:
        if engine.needs_frames and not source.has_frames:
            raise DataError(
                f"weights of the modality {engine.modality.name!r} see frames and {source.name} has none; give "
                "the folder of a capture, or weights of the modality 'event'"
            )
        self._source, self._engine, self._pace, self._so_far = source, engine, pace, so_far
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
        sinks, so_far, last = list(sinks), self._so_far, None
        self._engine.begin()
        if so_far is not None:
            so_far.begin()
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
                if so_far is not None:
                    so_far.add(chunks)
                    picture = picture and replace(picture, so_far=so_far.newest)
                if picture is not None:
                    last = picture
                    due_s = taken_s + 1 / self._pace.rate
                    self.statistics.add(picture)
                    for sink in sinks:
                        sink.show(picture)
            self._queue.take(0)  # raises what ended the source
            if so_far is not None:
                so_far.finish()
                if last is not None:
                    whole = replace(last, number=last.number + 1, so_far=so_far.newest)
                    for sink in sinks:
                        sink.show(whole)
        except KeyboardInterrupt:
            pass  # the way to end what has no end
        finally:
            self._stop.set()
            pump.join(timeout=2)
            if so_far is not None:
                so_far.close()
        return self.statistics

    def _pump(self) -> None:
        error = None
        try:
            for chunk in self._source.chunks(self._stop.is_set):
                self._queue.put(chunk)
        except Exception as found:
            error = found
        self._queue.close(error)
