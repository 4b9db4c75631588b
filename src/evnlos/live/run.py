"""A live run, and its statistics.

- An image of a live run, and how long it took.
- What a live run did: images, latencies, drops, rates; as numbers and as a table.
- Images of what was seen over a longer time, made beside a run in a process of their own: of all so far by a
  network, or of a hidden plane that changes.
- A live run: the source fills a queue in its own thread, the network empties it, sinks get the images.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.live.packet import Chunk, ChunkQueue, Clock, EventSource, SystemClock
from evnlos.types import Events, Evidence

if TYPE_CHECKING:
    from concurrent.futures import Future

    from evnlos.live.engine import Engine, Picture
    from evnlos.models import FilmSolver, Weights
    from evnlos.scene import Motion


@dataclass(frozen=True)
class Timing:
    """How long an image took, seconds; NaN for both latencies where no event is new in it.

    Args:
        oldest_s: From the first event that is new in it to the image: the longest that an event waited.
        newest_s: From its last event to the image.
        wait_s: The part of `oldest_s` before work on the image began: in the source, in the queue, for the
            image before.
        surface_s: Taking the events and making the maps that the network sees.
        network_s: The network.
    """

    oldest_s: float
    newest_s: float
    wait_s: float
    surface_s: float
    network_s: float


class BesideImage(NamedTuple):
    """The newest image of what was seen over a longer time, made beside a run."""

    title: str
    """What it shows."""
    image: NDArray[np.float32]
    """Float32 [H, W], 0..1; black before the first."""
    t_us: int | None
    """Event time up to which it knows what was seen, microseconds; None before the first."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A reconstruction and what it was made of.

    Args:
        number: Its number, from 0.
        t_us: Event time that it shows, microseconds.
        made_s: Instant at which it was ready, seconds on the `Clock`.
        image: The reconstruction, float32 [H, W], 0..1; None without a network.
        surface: The time surface that the network saw, float32 [2, H, W]: ON, OFF; 4 maps of `sae-trace`.
        frame: The frame that it saw, float32 [H, W], 0..1; None without frames.
        events: Number of events that are new in it.
        timing: How long it took.
        beside: The newest image of what was seen over a longer time; None where none is made.
    """

    number: int
    t_us: int
    made_s: float
    image: NDArray[np.float32] | None
    surface: NDArray[np.float32]
    frame: NDArray[np.float32] | None
    events: int
    timing: Timing
    beside: BesideImage | None = None

    @property
    def beside_age_s(self) -> float | None:
        """Event time that went by since what the image beside it knows, seconds; None before the first."""
        known_us = None if self.beside is None else self.beside.t_us
        return None if known_us is None else max(self.t_us - known_us, 0) / 1e6


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
        self._ages_s: deque[float] = deque(maxlen=_KEPT)
        self.images = self.events = 0
        self._first: tuple[float, int] | None = None  # instant and events of the first image
        self._last_s = 0.0

    def add(self, picture: Picture) -> None:
        """Count an image."""
        t = picture.timing
        self._times.append((t.oldest_s, t.newest_s, t.wait_s, t.surface_s, t.network_s))
        self._recent.append((picture.made_s, picture.events, t.oldest_s))
        if picture.beside_age_s is not None:
            self._ages_s.append(picture.beside_age_s)
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
            **({"beside_age_s": _spread(np.array(self._ages_s))} if self._ages_s else {}),
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
    lines += [f"left out by the source: {faults}"] if faults else []
    if (beside := summary.get("beside")) is not None:
        age = summary.get("beside_age_s")
        old = f"; when shown {age['p50']:.1f} s old in the median, {age['max']:.1f} at most" if age else ""
        lines.append(f"{beside['title']}: {beside['images']} images of {beside['seconds']:.2f} s each{old}")
    return "\n".join(lines)


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


Made = tuple[NDArray[np.float32], int]
"""An image, float32 [H, W], 0..1, and the event time up to which it knows what was seen, microseconds."""


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

        check_sequence(weights)
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

    def after(self, chunks: Sequence[Chunk]) -> Made | None:
        """Take what came and return the image; None where there is none to be made.

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
            return self._network.draw(seen, place, place[-1:])[0].numpy(), times_us[-1]


class FilmImages:
    """What a hidden plane that changes shows now, by `evnlos.models.RunningFilm`.

    Args:
        solver: Of `RunningFilm`, as the next two.
        evidence: What the film is made of.
        newest_s: How much of the past an image knows, seconds.
        size: Rows and columns of the cameras, whose light paths are made at once; None: with the first image.
    """

    def __init__(
        self, solver: FilmSolver, evidence: Evidence, newest_s: float, size: tuple[int, int] | None
    ) -> None:
        from evnlos.models import RunningFilm

        self._film = RunningFilm(solver, evidence, newest_s)
        if size is not None:
            for frames in (True, False):
                if evidence in ("both", "frames" if frames else "events"):
                    solver.path(size, frames)

    def after(self, chunks: Sequence[Chunk]) -> Made | None:
        """Take what came and return the newest image; None where too little came.

        Raises:
            EvnlosError: The film cannot be estimated.
        """
        for chunk in chunks:
            if chunk.restart:
                self._film.forget()
            self._film.add(chunk.events, chunk.until_us, chunk.frame, chunk.frame_us)
        return self._film.newest()


def check_sequence(weights: Weights) -> None:
    """Refuse weights that make no image of all that was seen so far.

    Args:
        weights: The weights.

    Raises:
        DataError: They see single time steps, or surfaces that are no likelihood.
    """
    if not weights.network.sees_sequence or (weights.modality.needs_events and not weights.sampling.is_solved):
        raise DataError(
            "these weights do not see what all events and frames so far say of the target; give weights of "
            "whole sequences and the surface 'likelihood', such as near-event-sequence"
        )


_NICE = 5  # of the process beside a run, which comes first
_held: ImagesSoFar | FilmImages | None = None  # of a process beside a run


def _hold(make: type[ImagesSoFar | FilmImages], *about: Any) -> None:
    global _held
    if hasattr(os, "nice"):
        os.nice(_NICE)
    _held = make(*about)


def _timed(chunks: Sequence[Chunk]) -> tuple[Made | None, float]:
    assert _held is not None
    began_s = time.perf_counter()
    return _held.after(chunks), time.perf_counter() - began_s


_FEWEST_EVENTS = 500  # for the first image


class Beside:
    """Images of a longer time beside a run, in a process of their own: the run waits for none of them.

    Args:
        title: What they show.
        make: What makes them.
        about: Its arguments.
        shape: Rows and columns of the images.
        sees_events: Whether events make an image worth it, and not frames.
        worth: An image is begun when there are so many times as many of these as in the last one, and more.

    Attributes:
        title: What they show.
        seconds: How long each image took.
    """

    def __init__(
        self,
        title: str,
        make: type[ImagesSoFar | FilmImages],
        about: tuple[Any, ...],
        shape: tuple[int, int],
        sees_events: bool,
        worth: float = 1.0,
    ) -> None:
        self.title, self._about, self._ending = title, (make, *about), ExitStack()
        self._sees_events, self._worth = sees_events, worth
        self.seconds = list[float]()
        self._fault: DataError | None = None
        self._waiting, self._count, self._known = list[Chunk](), 0, 0
        self._at_work: Future[tuple[Made | None, float]] | None = None
        self._blank = BesideImage(title, np.zeros(shape, np.float32), None)
        self._image = self._blank

    def begin(self) -> None:
        """Start the process and wait until it is ready; errors are those of what makes the images."""
        from evnlos.data.pool import one_worker

        self._worker = self._ending.enter_context(one_worker())
        self._worker.submit(_hold, *self._about).result()

    def add(self, chunks: Sequence[Chunk]) -> None:
        """Take what came, and begin an image where that is worth it and none is at work; wait for nothing."""
        for chunk in chunks:
            if chunk.restart:
                self._count = self._known = 0
                self._image = self._blank
            self._waiting.append(chunk)
            self._count += len(chunk.events) if self._sees_events else chunk.frame is not None
        self._take_if_done()
        fewest = _FEWEST_EVENTS if self._sees_events else 1
        least = max(fewest, self._known + 1, self._worth * self._known)
        if self._at_work is None and self._count >= least:
            self._begin_image()

    def _begin_image(self) -> None:
        self._at_work, self._known = self._worker.submit(_timed, self._waiting), self._count
        self._waiting = []

    @property
    def newest(self) -> BesideImage:
        """The newest image; black before the first."""
        self._take_if_done()
        return self._image

    def _take_if_done(self) -> None:
        if self._at_work is not None and self._at_work.done():
            self._take()

    def _take(self) -> None:
        assert self._at_work is not None
        done, self._at_work = self._at_work, None
        try:
            made, seconds = done.result()
        except DataError as error:  # the target is off the canvas yet
            self._fault = error
            return
        if made is not None and self._known:  # else the replay began anew meanwhile
            self._image = BesideImage(self.title, *made)
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
        """Return what they show, how many there were, and the median of their times, seconds."""
        seconds = round(float(np.median(self.seconds or [0.0])), 3)
        return {"title": self.title, "images": len(self.seconds), "seconds": seconds}


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
        beside: What makes images of a longer time beside it.

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
        beside: Beside | None = None,
    ) -> None:
        if engine.needs_frames and not source.has_frames:
            raise DataError(
                f"weights of the modality {engine.modality.name!r} see frames and {source.name} has none; give "
                "the folder of a capture, or weights of the modality 'event'"
            )
        self._source, self._engine, self._pace, self._beside = source, engine, pace, beside
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
        sinks, beside, last = list(sinks), self._beside, None
        if beside is not None:
            beside.begin()
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
                if beside is not None:
                    beside.add(chunks)
                    picture = picture and replace(picture, beside=beside.newest)
                if picture is not None:
                    last = picture
                    due_s = taken_s + 1 / self._pace.rate
                    self.statistics.add(picture)
                    for sink in sinks:
                        sink.show(picture)
            self._queue.take(0)  # raises what ended the source
            if beside is not None:
                beside.finish()
                if last is not None:
                    whole = replace(last, number=last.number + 1, beside=beside.newest)
                    for sink in sinks:
                        sink.show(whole)
        except KeyboardInterrupt:
            pass  # the way to end what has no end
        finally:
            self._stop.set()
            pump.join(timeout=2)
            if beside is not None:
                beside.close()
        return self.statistics

    def _pump(self) -> None:
        error = None
        try:
            for chunk in self._source.chunks(self._stop.is_set):
                self._queue.put(chunk)
        except Exception as found:
            error = found
        self._queue.close(error)
