"""Recording a capture from any live source, looked at while it is recorded.

- What a recording is worth, while it runs: rate, polarity, readout, flicker, hot pixels, light.
- From a source to a capture folder, whole or not there: events, frames with times, and what the camera says.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.config import save_yaml, to_dict
from evnlos.data.capture_info import RecordingInfo
from evnlos.errors import ConfigError, DataError, EvnlosError
from evnlos.events import EventWriter
from evnlos.events.cleaning import flicker_line
from evnlos.events.filters import hot_by_counts
from evnlos.files import new_folder
from evnlos.live.device import DeviceSource
from evnlos.live.packet import Chunk, EventSource, SystemClock
from evnlos.types import Events

_KEPT_MS = 4096  # of the rate: enough for a line at 100 Hz
_FEWEST_EVENTS = 2000  # in _KEPT_MS, to tell of flicker
_HOT_S = 5.0  # between two looks at the pixels
_NAP_S = 0.1
_MOST_SIDE = 2048  # of a RAW file
_LEFT_FREE_BYTES = 64 << 20  # of the disk: a recording ends before it is full


class RecordingCheck:
    """What is seen of a recording while it runs; one thread adds, another asks.

    Args:
        most_rate_hz: Events per second that the camera's readout can pass; None = unknown.
    """

    def __init__(self, most_rate_hz: float | None = None) -> None:
        self._most_rate_hz, self._lock = most_rate_hz, threading.Lock()
        self._per_ms = np.zeros((2, _KEPT_MS), np.int64)  # OFF and ON
        self._first_ms: int | None = None
        self._newest_ms = 0
        self._counts: NDArray[np.int64] | None = None  # [H, W]
        self._hot, self._hot_at_s = (0, 0.0), -_HOT_S
        self._light: tuple[float, float] | None = None  # mean and clipped share of the newest frame
        self.events = self.on = self.frames = 0

    def add(self, events: Events, frame: NDArray[np.float32] | None = None) -> None:
        """Take what was recorded, in the order of time."""
        with self._lock:
            if frame is not None:
                self.frames += 1
                self._light = float(frame.mean()), float((frame >= 1).mean())
            if not len(events):
                return
            self.events += len(events)
            self.on += int(events.p.sum())
            if self._counts is None:
                self._counts = np.zeros(events.shape, np.int64)
            np.add.at(self._counts, (events.y, events.x), 1)
            in_ms = events.t_us // 1000
            if self._first_ms is None:
                self._first_ms = self._newest_ms = int(in_ms[0])
            new = int(in_ms[-1])
            gone = np.arange(self._newest_ms + 1, min(new, self._newest_ms + _KEPT_MS) + 1)
            self._per_ms[:, gone % _KEPT_MS] = 0
            if new > self._newest_ms + _KEPT_MS:
                self._per_ms[:] = 0
            kept = in_ms > new - _KEPT_MS
            np.add.at(self._per_ms, (events.p[kept].astype(int), in_ms[kept] % _KEPT_MS), 1)
            self._newest_ms = new

    def values(self, now_s: float) -> dict[str, Any]:
        """Return what is measured now.

        Args:
            now_s: Instant, seconds: the look at all pixels, which takes long, is for every 5 s only.

        Returns:
            rate_hz of the last second, on_fraction, readout (share of the last second's milliseconds with more
            than half of the readout's peak rate, None where unknown), flicker_hz (None without, or too few
            events), hot_pixels, hot_fraction, light (mean of the newest frame, 0..1), clipped (share of it).
        """
        with self._lock:
            events, on, counts, light = self.events, self.on, self._counts, self._light
            order = np.arange(self._newest_ms + 1 - _KEPT_MS, self._newest_ms + 1) % _KEPT_MS
            per_ms = self._per_ms[:, order]
            if self._first_ms is not None:
                per_ms = per_ms[:, -min(self._newest_ms - self._first_ms + 1, _KEPT_MS) :]
            if counts is not None and now_s - self._hot_at_s >= _HOT_S:
                counts = counts.copy()
            else:
                counts = None
        if counts is not None:
            hot = hot_by_counts(counts)
            self._hot = int(hot.sum()), float(counts[hot].sum() / max(events, 1))
            self._hot_at_s = now_s
        recent, flicker, readout = per_ms.sum(axis=0)[-1000:], None, None
        if per_ms.sum() >= _FEWEST_EVENTS and per_ms.shape[1] >= 1000:
            line = flicker_line(per_ms[:, None])
            flicker = round(line.frequency_hz, 1) if line.is_there else None
        if self._most_rate_hz is not None:
            readout = float((recent > self._most_rate_hz / 2000).mean())
        return {
            "rate_hz": float(recent.sum() * 1000 / len(recent)),
            "on_fraction": on / events if events else None,
            "readout": readout,
            "flicker_hz": flicker,
            "hot_pixels": self._hot[0],
            "hot_fraction": self._hot[1],
            "light": None if light is None else light[0],
            "clipped": None if light is None else light[1],
        }


def check_line(
    seconds: float, found: dict[str, Any], faults: dict[str, int], meter: float | None = None
) -> str:
    """Return the check as one line; what is wrong stands with a `!`.

    Args:
        seconds: Length of the recording so far.
        found: `RecordingCheck.values`.
        faults: What the source lost.
        meter: What the camera's light meter reads; None without one.
    """
    parts = [f"{seconds:.1f} s", f"{found['rate_hz'] / 1e3:,.1f} kev/s"]
    if found["on_fraction"] is not None:
        is_fair = 0.25 < found["on_fraction"] < 0.75
        parts.append(f"{'' if is_fair else '! '}ON {100 * found['on_fraction']:.0f} %")
    if found["readout"] is not None:
        parts.append(f"{'' if found['readout'] < 0.01 else '! '}readout busy {100 * found['readout']:.0f} %")
    parts.append("no flicker" if found["flicker_hz"] is None else f"! flicker at {found['flicker_hz']:.4g} Hz")
    is_calm = found["hot_fraction"] < 0.02
    parts.append(
        f"{'' if is_calm else '! '}{found['hot_pixels']} hot pixels ({100 * found['hot_fraction']:.1f} %)"
    )
    if found["light"] is not None:
        is_good = found["clipped"] < 1e-3 and found["light"] > 0.02
        clipped = f"clipped {100 * found['clipped']:.1f} %"
        parts.append(f"{'' if is_good else '! '}light {100 * found['light']:.0f} %, {clipped}")
    if meter is not None:
        parts.append(f"light meter {meter:g}")
    return "  ".join([*parts, *(f"! {count:,} {name}" for name, count in faults.items() if count)])


def record_capture(
    folder: str | Path,
    source: EventSource,
    *,
    seconds: float | None = None,
    tell: Callable[[str], None] | None = None,
    tell_every_s: float = 0.5,
) -> RecordingInfo:
    """Record a source until it ends, time is up, Ctrl-C, or the disk is nearly full; return how it went.

    The folder appears when it is complete. A source that fails ends the recording, what came before is kept.
    Where a stream begins anew, with a clock of its own, its times go on by the computer's clock.

    Args:
        folder: The capture's folder, new or empty.
        source: A camera or stream.
        seconds: Length, seconds; None = until the source ends.
        tell: Called with the check of the recording, one line.
        tell_every_s: Seconds between two lines.

    Raises:
        ConfigError: `seconds` is not positive.
        DataError: No event came, or the folder holds something.
        EventFileError: The disk can't be written; nothing is left.
    """
    if seconds is not None and not 0 < seconds < float("inf"):
        raise ConfigError(f"seconds is {seconds}; give a positive number")
    clock = SystemClock()
    facts = source.facts if isinstance(source, DeviceSource) else None
    with new_folder(folder) as draft:
        begun_s, begun = clock.now(), datetime.now(UTC)
        check = RecordingCheck(None if facts is None else facts.most_rate_hz)
        work = _Recording(draft, source, check)
        work.start()
        try:
            told_s = begun_s
            while not work.done.wait(_NAP_S):
                now = clock.now()
                if seconds is not None and now - begun_s >= seconds:
                    work.stop.set()
                if tell is not None and now - told_s >= tell_every_s:
                    told_s = now
                    meter = source.readings.get("light") if isinstance(source, DeviceSource) else None
                    found = check.values(now)
                    tell(check_line(now - begun_s, found, source.faults(), None if meter is None else meter[1]))
        except KeyboardInterrupt:
            pass  # the way to end what has no end
        finally:
            work.stop.set()
            work.done.wait()  # `join` returns at once where Ctrl-C came into another `join`
        if work.failure is not None:
            raise work.failure
        if not check.events:
            why = work.ended_by or f"{source.name} sent none in {clock.now() - begun_s:.1f} s"
            raise DataError(f"no event was recorded: {why}; nothing was written")
        took_s = round(clock.now() - begun_s, 3)
        recording = _description(source, work, begun.isoformat(timespec="milliseconds"), took_s)
        camera: dict[str, Any] = {"name": source.name, "width": work.size[0], "height": work.size[1]}
        if facts is not None:
            camera |= {"name": facts.name, "frame_rate_hz": facts.frame_rate_hz, "exposure_s": facts.exposure_s}
        about: dict[str, Any] = {"camera": _stated(camera), "events": work.file}
        about |= {"frames": "frames.csv" if work.frames else None, "recording": _stated(to_dict(recording))}
        save_yaml(about, draft / "capture.yaml")
    return recording


class _Recording(threading.Thread):
    """Takes chunks from a source and writes them, in a thread that Ctrl-C does not disturb."""

    def __init__(self, draft: Path, source: EventSource, check: RecordingCheck) -> None:
        super().__init__(name="recording", daemon=True)
        self._draft, self._source, self.check = draft, source, check
        self.stop, self.done = threading.Event(), threading.Event()
        self.failure: BaseException | None = None
        self.ended_by: str | None = None
        self.size, self.file, self.frames, self.anew = (0, 0), "events.raw", 0, 0
        self._writer: EventWriter | None = None
        self._shift_us, self._last_us, self._last_s = 0, 0, 0.0
        self._frame_us: int | None = None
        self._begins = False

    def run(self) -> None:
        """Record until the source ends or `stop` is set."""
        try:
            with ExitStack() as stack:
                chunks = self._source.chunks(self.stop.is_set)
                looked_s = 0.0
                while True:
                    try:
                        chunk = next(chunks, None)
                    except EvnlosError as error:
                        self.ended_by = str(error)
                        return
                    if chunk is None:
                        return
                    self._take(chunk, stack)
                    if chunk.last_s - looked_s > 1:
                        looked_s, free = chunk.last_s, shutil.disk_usage(self._draft).free
                        if free < _LEFT_FREE_BYTES:
                            self.ended_by = f"the disk has {free >> 20} MB left"
                            return
        except BaseException as error:
            self.failure = error
        finally:
            self.done.set()

    def _take(self, chunk: Chunk, stack: ExitStack) -> None:
        events = chunk.events
        self._begins |= chunk.restart and bool(self.check.events)
        frame_us = chunk.until_us if chunk.frame_us is None else chunk.frame_us
        if self._begins and (len(events) or chunk.frame is not None):
            first = int(events.t_us[0]) if len(events) else frame_us
            passed_us = max(round((chunk.first_s - self._last_s) * 1e6), 1)
            self._shift_us, self._begins = self._last_us + passed_us - first, False
            self.anew += 1
        if self._shift_us:
            shifted = {**events.columns(), "t_us": events.t_us + self._shift_us}
            events = Events(**shifted, width=events.width, height=events.height)
        if len(events) and self._writer is None:
            self.size = events.width, events.height
            self.file = "events.raw" if max(self.size) <= _MOST_SIDE else "events.h5"
            self._writer = stack.enter_context(EventWriter(self._draft / self.file))
        if len(events):
            assert self._writer is not None
            self._writer.write(events)
            self._last_us, self._last_s = int(events.t_us[-1]), chunk.last_s
        self.check.add(events, chunk.frame)
        if chunk.frame is not None:
            self._keep(chunk.frame, frame_us + self._shift_us)

    def _keep(self, frame: NDArray[np.float32], t_us: int) -> None:
        """Write a frame as an image of 16 bits; one that is not later than the frame before is left out."""
        if self._frame_us is not None and t_us <= self._frame_us:
            return
        self._frame_us = t_us
        folder = self._draft / "frames"
        folder.mkdir(exist_ok=True)
        name = f"frames/{self.frames:06d}.png"
        image = np.rint(np.clip(frame, 0, 1) * np.float32(65_535)).astype(np.uint16)
        Image.fromarray(image).save(self._draft / name, compress_level=1)
        with (self._draft / "frames.csv").open("a", encoding="utf-8") as table:
            table.write(f"{'' if self.frames else 't_us,file' + chr(10)}{t_us},{name}\n")
        self.frames += 1


def _description(source: EventSource, work: _Recording, begun: str, seconds: float) -> RecordingInfo:
    """Return how a recording went."""
    clock = "the source's own, microseconds"
    if work.anew:
        clock += f"; {work.anew} times begun anew and put on by the computer's clock"
    known: dict[str, Any] = {}
    if isinstance(source, DeviceSource):
        known = {"serial": source.facts.serial, "biases": dict(source.facts.biases)}
        known |= {key: (round(first, 3), round(last, 3)) for key, (first, last) in source.readings.items()}
    faults = {name: count for name, count in source.faults().items() if count}
    counts = work.check.events, work.frames
    return RecordingInfo(source.name, begun, seconds, *counts, clock, work.ended_by, faults=faults, **known)


def _stated(values: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None and value != {}}
