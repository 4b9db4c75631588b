"""The readout between pixels and file: settings and kernels.

- The kernels of the readout: arbitration, loss, events without cause, jitter.

What stands between pixels and file: defects, an arbiter of finite speed, queues, ticks, values of events and
the polarity that a camera's software takes from them; rippling lamps.

Pixels ask for the bus when they meet a threshold. A row arbiter reads all pixels of one row that ask, then goes
to the next row below that has any; an event arbiter reads one pixel at a time, first come, first served. All
events that are read together get the time of their grant. With s the set-up of a grant and e the time an event
takes, a grant of n events keeps the bus for s + n e.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import (
    EVENT_MODELS,
    CrossingLaw,
    EventModel,
    LogCurve,
    PixelSettings,
    check_pattern_seed,
    require,
)
from evnlos.cameras.frame_camera import FrameCamera
from evnlos.cameras.pixel import MAX_JITTER, EventPixel
from evnlos.cameras.random_numbers import (
    STREAM_CELEX,
    STREAM_DEAD,
    STREAM_RATE_CONTROL,
    STREAM_READOUT_CHOICE,
    STREAM_READOUT_GAP,
    STREAM_READOUT_HOT,
    STREAM_READOUT_JITTER,
    random_exponential,
    random_normal,
    random_uniform,
    uniform_field,
)
from evnlos.cameras.streams import Columns, Light, sort_times
from evnlos.errors import ConfigError
from evnlos.types import Irradiance

_WINDOW_US = 1000


class Bus(NamedTuple):
    """The arbiter's constants, microseconds."""

    rows: bool
    setup: float
    event: float
    queue: int
    width: int
    height: int


class Waiting(NamedTuple):
    """Who waits, by row: a chain of events from `head` to `tail` through `after`; -1 = none."""

    head: NDArray[np.int64]  # [rows]
    tail: NDArray[np.int64]  # [rows]
    after: NDArray[np.int64]  # [events]
    deaf: NDArray[np.bool_]  # [pixels]


@njit(cache=True, error_model="numpy")
def arbitrate(times, pixels, on, admitted, stop, free, last_row, bus, waiting, out_times, out_order):
    """Grant the bus to the events of a block until `stop`; return their number, who is lost, and the bus.

    times     when the events ask, microseconds [N], ascending; the first `admitted` wait from before
    free      when the bus is free, microseconds;  last_row  the row that was read last
    out_*     time of the grant and index of each event that was read [N]
    Returns (events read, events lost, free, last row). Events that still wait are in the chains.
    """
    count, lost, waiting_now, i, size = 0, 0, 0, 0, len(times)
    while True:
        now = free
        if waiting_now == 0:
            if i == size:
                break
            now = max(free, times[i])
        if now > stop:
            break
        while i < size and times[i] <= now:
            taken = admit(i, i < admitted, pixels, waiting_now, bus, waiting)
            waiting_now += taken
            lost += 1 - taken
            i += 1
        if waiting_now == 0:
            continue
        row, read = 0, 0
        if bus.rows:
            row = (last_row + 1) % bus.height
            while waiting.head[row] < 0:
                row = (row + 1) % bus.height
            last_row = row
        while waiting.head[row] >= 0 and (bus.rows or read == 0):
            event = waiting.head[row]
            waiting.head[row] = waiting.after[event]
            waiting.deaf[pixels[event]] = False
            out_times[count], out_order[count] = now, event
            count, read = count + 1, read + 1
        waiting_now -= read
        free = now + bus.setup + read * bus.event
    while i < size:
        taken = admit(i, i < admitted, pixels, waiting_now, bus, waiting)
        waiting_now += taken
        lost += 1 - taken
        i += 1
    return count, lost, free, last_row


@njit(cache=True, error_model="numpy")
def admit(event, before, pixels, waiting_now, bus, waiting):
    """Return 1 where an event joins those that wait, 0 where its pixel is deaf or the queue full."""
    pixel = pixels[event]
    if not before and (waiting.deaf[pixel] or (bus.queue > 0 and waiting_now >= bus.queue)):
        return 0
    row = pixel // bus.width if bus.rows else 0
    waiting.deaf[pixel] = True
    waiting.after[event] = -1
    if waiting.head[row] < 0:
        waiting.head[row] = event
    else:
        waiting.after[waiting.tail[row]] = event
    waiting.tail[row] = event
    return 1


@njit(cache=True, error_model="numpy")
def ask_without_cause(hot, rate, stop, candidate, drawn, seed, out):
    """Add what hot pixels send until `stop` seconds; return how many, also where `out` has no room for them."""
    times, pixels, on = out
    count = 0
    for n in range(len(hot)):
        pixel = hot[n]
        while candidate[n] <= stop:
            if count < len(times):
                times[count] = np.int64(np.rint(candidate[n] * 1e6))
                pixels[count] = pixel
                on[count] = random_uniform(seed, STREAM_READOUT_CHOICE, pixel, drawn[n]) < 0.5
            count += 1
            drawn[n] += 1
            candidate[n] += random_exponential(seed, STREAM_READOUT_GAP, pixel, drawn[n]) / rate
    return count


@njit(cache=True, error_model="numpy")
def thin(times, most, window, before, count, serial, seed, keep):
    """Mark which events pass the rate controller: all, or `most` of those of the window before.

    Returns the window, the counts of the one before and of this one, and the number of events so far.
    """
    for i in range(len(times)):
        this = times[i] // _WINDOW_US
        if this != window:
            before = count if this == window + 1 else 0
            window, count = this, 0
        count += 1
        keep[i] = before <= most or random_uniform(seed, STREAM_RATE_CONTROL, 0, serial) * before < most
        serial += 1
    return window, before, count, serial


@njit(cache=True, error_model="numpy")
def jittered(times, spread, first, last, serial, seed):
    """Add normal noise to time stamps, microseconds, within the recording."""
    for i in range(len(times)):
        moved = times[i] + spread * random_normal(seed, STREAM_READOUT_JITTER, 0, serial + i)
        times[i] = np.int64(np.rint(min(max(moved, first), last)))


@EVENT_MODELS.register
@dataclass(frozen=True)
class ReadoutPixel(PixelSettings):
    """Any event model behind a readout: late and equal time stamps in bursts, loss, hot and dead pixels.

    A pixel that waits for its grant is deaf: what it would send meanwhile is lost. The default bus is as fast
    as a DAVIS346's, one event in 80 ns; `arbiter="row"` with 0.5 us and 20 ns is of the kind of a CeleX-V.

    Args:
        pixel: The event model whose events are read; one without jitter of its own.
        arbiter: "event" = one event at a time in the order of asking, "row" = rows in turn, each read whole.
        setup_s: Time that a grant takes besides its events, seconds.
        event_s: Time that each event takes, seconds. With both 0 nothing waits.
        queue: Events that may wait at most; those that come then are lost. 0 = any number.
        max_rate_hz: Rate of the whole sensor above which events are dropped at random, by the count of the
            millisecond before, hertz; 0 = none.
        tick_s: Time stamps are whole multiples of this, rounded down, seconds; 0 = microseconds.
        jitter_s: Standard deviation of the time stamps, seconds.
        hot_pixel_fraction: Fraction of pixels that ask without cause, 0 to 1.
        hot_pixel_rate_hz: How often a hot pixel does so, ON and OFF together, hertz.
        dead_pixel_fraction: Fraction of pixels that never ask, 0 to 1.
        pattern_seed: Seed of which pixels are hot or dead; None = drawn anew for each recording.

    Raises:
        ConfigError: A value outside its range, or a readout of a readout.

    Example:
        >>> ReadoutPixel(EventPixel(threshold_on=0.2), arbiter="row").pixel.threshold_on
        0.2
    """

    pixel: PixelSettings = field(default_factory=EventPixel)
    """The event model whose events are read."""
    arbiter: Literal["event", "row"] = "event"
    """One event at a time in the order of asking, or rows in turn, each read whole."""
    setup_s: float = 0.0
    """Time that a grant takes besides its events, seconds."""
    event_s: float = 80e-9
    """Time that each event takes, seconds."""
    queue: int = 0
    """Events that may wait at most; 0 = any number."""
    max_rate_hz: float = 0.0
    """Rate of the whole sensor above which events are dropped at random, hertz; 0 = none."""
    tick_s: float = 0.0
    """Time stamps are whole multiples of this, seconds; 0 = microseconds."""
    jitter_s: float = 0.0
    """Standard deviation of the time stamps, seconds."""
    hot_pixel_fraction: float = 0.0
    """Fraction of pixels that ask without cause, 0 to 1."""
    hot_pixel_rate_hz: float = 10.0
    """How often a hot pixel asks, hertz."""
    dead_pixel_fraction: float = 0.0
    """Fraction of pixels that never ask, 0 to 1."""
    pattern_seed: int | None = None
    """Seed of which pixels are hot or dead; None = drawn anew for each recording."""
    kind: Literal["readout"] = "readout"
    """The event model."""

    def __post_init__(self) -> None:
        if isinstance(self.pixel, ReadoutPixel):
            raise ConfigError("ReadoutPixel.pixel is a readout itself; give the pixel that is read")
        if self.pixel.disorder_s > 0:
            raise ConfigError("ReadoutPixel.pixel has jitter; set it to 0 and give the readout's jitter_s")
        if self.arbiter not in ("event", "row"):
            raise ConfigError(f'ReadoutPixel.arbiter is {self.arbiter!r}; give "event" or "row"')
        for name in ("setup_s", "event_s", "tick_s", "jitter_s"):
            require(self, name, 0.0, 1.0, "seconds; 0 switches it off")
        for name in ("queue", "max_rate_hz", "hot_pixel_rate_hz"):
            require(self, name, 0.0, math.inf, "(0 switches it off)")
        for name in ("hot_pixel_fraction", "dead_pixel_fraction"):
            require(self, name, 0.0, 1.0, "a fraction; 0 switches it off")
        check_pattern_seed(self.pattern_seed)
        super().__post_init__()

    @property
    def finest_threshold(self) -> float:
        """That of the pixel, log units."""
        return self.pixel.finest_threshold

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw | None:
        """Return that of the pixel; hot pixels add events without cause."""
        law = self.pixel.crossing_law(light_dn)
        hot = self.hot_pixel_fraction * self.hot_pixel_rate_hz
        return None if law is None else replace(law, events_hz=law.events_hz + hot)

    @property
    def log_curve(self) -> LogCurve:
        """That of the pixel."""
        return self.pixel.log_curve

    @property
    def disorder_s(self) -> float:
        """By how much the jitter can turn the order of two events around, seconds."""
        return MAX_JITTER * self.jitter_s

    def model(
        self,
        shape: tuple[int, int],
        seed: int = 0,
        thresholds: object = None,
        *,
        tile_px: int | None = None,
        threads: int | None = None,
    ) -> EventModel:
        """Return an array of such pixels; arguments as in `PixelSettings.model`."""
        if self.pixel.stepped:
            raise ConfigError("a readout needs pixels in continuous time; v2e's events come on frame times")
        array = self.pixel.model(shape, seed, thresholds, tile_px=tile_px, threads=threads)
        return ReadoutArray(self, array, shape, seed)


class ReadoutArray(EventModel):
    """Pixels behind a readout; `lost` counts the events that no grant came for."""

    def __init__(self, settings: ReadoutPixel, array: EventModel, shape: tuple[int, int], seed: int) -> None:
        self.settings, self.lost = settings, 0
        self._array, self._shape, self._seed = array, shape, np.uint64(seed)
        count = shape[0] * shape[1]
        pattern = np.uint64(seed if settings.pattern_seed is None else settings.pattern_seed)
        self._dead = uniform_field(pattern, STREAM_DEAD, count) < settings.dead_pixel_fraction
        hot = uniform_field(pattern, STREAM_READOUT_HOT, count) < settings.hot_pixel_fraction
        if settings.hot_pixel_rate_hz == 0:
            hot[:] = False
        self._hot = np.flatnonzero(hot).astype(np.int32)
        self._bus = Bus(
            settings.arbiter == "row",
            1e6 * settings.setup_s,
            1e6 * settings.event_s,
            int(settings.queue),
            shape[1],
            shape[0],
        )

    def start(self, frame: NDArray, time_s: float) -> None:
        """Take the first light, DN [N]; nothing waits."""
        self._array.start(frame, time_s)
        gaps = [random_exponential(self._seed, STREAM_READOUT_GAP, pixel, 0) for pixel in self._hot]
        rate = max(self.settings.hot_pixel_rate_hz, 1e-30)
        self._candidate = time_s + np.array(gaps, np.float64) / rate
        self._drawn = np.zeros(len(self._hot), np.uint32)
        self._queue: Columns = (np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, np.bool_))
        self._free, self._last_row = -math.inf, self._bus.height - 1
        self._control = (-1, 0, 0, 0)
        self._serial, self._first_us = 0, 1e6 * time_s

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events granted meanwhile, in order."""
        stop = float(times_s[-1])
        asking = self._with_hot_pixels(self._array.advance(light, times_s), stop)
        kept = ~self._dead[asking[1]]
        if not kept.all():
            asking = asking[0][kept], asking[1][kept], asking[2][kept]
        time_us, pixel, on = self._granted(asking, float(np.rint(stop * 1e6)))
        if self.settings.tick_s > 0:
            tick = 1e6 * self.settings.tick_s
            time_us = np.floor(np.floor(time_us / tick) * tick)
        stamps = np.floor(time_us).astype(np.int64)
        if self.settings.max_rate_hz > 0:
            keep = np.empty(len(stamps), np.bool_)
            most = self.settings.max_rate_hz * _WINDOW_US * 1e-6
            self._control = thin(stamps, most, *self._control, self._seed, keep)
            stamps, pixel, on = stamps[keep], pixel[keep], on[keep]
        if self.settings.jitter_s > 0:
            spread = 1e6 * self.settings.jitter_s
            jittered(stamps, spread, self._first_us, math.inf, self._serial, self._seed)
            self._serial += len(stamps)
        return sort_times(stamps, pixel, on)

    def _with_hot_pixels(self, asking: Columns, stop: float) -> Columns:
        """Return the events with those of the hot pixels, in order."""
        if not len(self._hot):
            return asking
        room = 64 + int(2 * len(self._hot))
        while True:
            out = np.empty(room, np.int64), np.empty(room, np.int32), np.empty(room, np.bool_)
            candidate, drawn = self._candidate.copy(), self._drawn.copy()
            rate = self.settings.hot_pixel_rate_hz
            count = ask_without_cause(self._hot, rate, stop, candidate, drawn, self._seed, out)
            if count <= room:
                break
            room = count
        self._candidate, self._drawn = candidate, drawn
        return sort_times(*(np.concatenate([own, more[:count]]) for own, more in zip(asking, out, strict=True)))

    def _granted(self, asking: Columns, stop: float) -> tuple[NDArray[np.float64], NDArray, NDArray]:
        """Return time of the grant, pixel and polarity of what is read until `stop`, microseconds."""
        if self._bus.setup == 0 and self._bus.event == 0:
            return asking[0].astype(np.float64), asking[1], asking[2]
        waiting_time, waiting_pixel, waiting_on = self._queue
        time = np.concatenate([waiting_time, asking[0]])
        pixel = np.concatenate([waiting_pixel, asking[1]])
        on = np.concatenate([waiting_on, asking[2]])
        admitted, rows = len(self._queue[0]), self._bus.height
        waiting = Waiting(
            np.full(rows, -1, np.int64),
            np.full(rows, -1, np.int64),
            np.full(len(time), -1, np.int64),
            np.zeros(len(self._dead), np.bool_),
        )
        granted, order = np.empty(len(time)), np.empty(len(time), np.int64)
        count, lost, self._free, self._last_row = arbitrate(
            time.astype(np.float64), pixel, on, admitted, stop, self._free, self._last_row, self._bus, waiting,
            granted, order,
        )  # fmt: skip
        self.lost += int(lost)
        left = []
        for first in waiting.head:
            while first >= 0:
                left.append(int(first))
                first = waiting.after[first]
        rest = np.sort(np.array(left, np.int64))
        self._queue = time[rest], pixel[rest], on[rest]
        chosen = order[:count]
        return granted[:count], pixel[chosen], on[chosen]


class LogLevel:
    """The log light of all pixels behind their low-pass filter, carried from frame to frame.

    Args:
        pixel: The pixels, with a true logarithm.
        light: The light that they have settled to, DN [N].
    """

    def __init__(self, pixel: EventPixel, light: NDArray) -> None:
        self._pixel, self._seen = pixel, pixel.exposure * light.astype(np.float64)
        self._speed = 2.0 * math.pi * pixel.cutoff_hz / (255.0 + pixel.cutoff_floor_dn)
        self._log = self._level = np.log(self._seen + pixel.dark_dn)

    def step(self, light: NDArray, seconds: float) -> None:
        """Go on to the next light, DN [N]; its logarithm is a line until then, the bandwidth its mean."""
        seen = self._pixel.exposure * light.astype(np.float64)
        self._turns = self._speed * (0.5 * (seen + self._seen) + self._pixel.cutoff_floor_dn) * seconds
        self._start, self._lag, self._seen = self._log, self._level - self._log, seen
        self._log = np.log(seen + self._pixel.dark_dn)
        self._level = self.at(1.0)

    def at(
        self, share: float | NDArray[np.floating], place: NDArray | slice = slice(None)
    ) -> NDArray[np.floating]:
        """Return the level of pixels `place` at a share of the last step, 0 to 1."""
        start, change = self._start[place], self._log[place] - self._start[place]
        if self._speed == 0:
            return start + change * share
        turns = self._turns[place]
        passed = -np.expm1(-turns * share)
        behind = np.divide(passed, turns, out=np.broadcast_to(share, turns.shape).copy(), where=turns > 0)
        return start + change * (share - behind) + self._lag[place] * (1.0 - passed)


class ValuesArray(EventModel):
    """Pixels whose events carry a value, and the software that takes their polarity from it.

    Args:
        array: The event pixels.
        pixel: Their logarithm and low-pass filter.
        values: What the converter makes of levels, pixels and normal random numbers, [N] each.
        seed: Seed of the values' noise.
    """

    def __init__(
        self, array: EventModel, pixel: EventPixel, values: Callable[..., NDArray[np.uint16]], seed: int
    ) -> None:
        self._array, self._pixel, self._values, self._seed = array, pixel, values, np.uint64(seed)

    def start(self, frame: NDArray, time_s: float) -> None:
        """Take the first light, DN [N]; the software's store holds zeros."""
        self._array.start(frame, time_s)
        self._level, self._now = LogLevel(self._pixel, frame), time_s
        self._last, self._drawn = np.zeros(len(frame), np.int64), np.zeros(len(frame), np.uint32)

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events whose value has changed, in order."""
        (time_us, pixel, _), _, sign = self.read(light, times_s)
        told = sign != 0
        return time_us[told], pixel[told], sign[told] > 0

    def read(self, light: Light, times_s: NDArray[np.float64]) -> tuple[Columns, NDArray, NDArray]:
        """Return all events up to the last instant, their values [N] and the signs of their changes [N]."""
        events = self._array.advance(light, times_s)
        time_us, place, _ = events
        values, signs = np.empty(len(time_us), np.uint16), np.empty(len(time_us), np.int8)
        ends = np.append(np.searchsorted(time_us, 1e6 * times_s[:-1], "right"), len(time_us))
        for k, (first, last) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
            rows, _ = light[k : k + 1].pixels(0, len(self._last))
            before, self._now = self._now, float(times_s[k])
            self._level.step(rows[0], self._now - before)
            pixels = place[first:last]
            share = np.clip((1e-6 * time_us[first:last] - before) / (self._now - before), 0.0, 1.0)
            noise = _noise(pixels, self._seed, self._drawn)
            level = self._level.at(share, pixels)
            values[first:last] = self._values(level, pixels, noise)
            _compare(values[first:last], pixels, self._last, signs[first:last])
        return events, values, signs


@njit(cache=True)
def _noise(pixels, seed, drawn):
    """Return a normal number for each event, the next of its pixel; `drawn` [pixels] counts them."""
    out = np.empty(len(pixels))
    for i in range(len(pixels)):
        out[i] = random_normal(seed, STREAM_CELEX, pixels[i], drawn[pixels[i]])
        drawn[pixels[i]] += 1
    return out


@njit(cache=True)
def _compare(values, pixels, last, signs):
    """Fill the sign of each value less its pixel's last one, which `last` [pixels] keeps."""
    for i in range(len(values)):
        change = np.int64(values[i]) - last[pixels[i]]
        signs[i] = (change > 0) - (change < 0)
        last[pixels[i]] = values[i]


@dataclass(frozen=True)
class FlickeringWall:
    """A wall under lamps that ripple: its light times 1 + contrast sin(2 pi frequency t).

    Args:
        wall: The wall in steady light.
        contrast: Amplitude of the ripple, fraction of the light, 0 to below 1; 0.2 is a poor lamp.
        frequency_hz: Frequency of the ripple, hertz: twice that of the mains.

    Raises:
        ConfigError: A value outside its range.
    """

    wall: Irradiance
    contrast: float = 0.2
    frequency_hz: float = 100.0

    def __post_init__(self) -> None:
        require(self, "contrast", 0.0, 0.999, "a fraction of the light")
        require(self, "frequency_hz", 1e-3, 1e6, "hertz")

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the image (height, width), pixels."""
        return self.wall.shape

    @property
    def speed_px_s(self) -> float:
        """Upper bound of the speed of the image, pixels per second."""
        return self.wall.speed_px_s

    @property
    def longest_step_s(self) -> float:
        """Longest time step that resolves the ripple, seconds: a 32nd of its period."""
        return 1.0 / (32.0 * self.frequency_hz)

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return the image at the instants `t_s` [T] in seconds, float32 [T, H, W], 1.0 = white."""
        light = self.wall.irradiance(t_s)
        phase = 2.0 * math.pi * self.frequency_hz * np.atleast_1d(np.asarray(t_s, np.float64))
        factor = torch.from_numpy(1.0 + self.contrast * np.sin(phase)).to(light)
        return light * factor[:, None, None]

    def exposed(self, t_s: ArrayLike, exposure_s: float) -> NDArray[np.float64]:
        """Return the light averaged over exposures about the instants `t_s` [T], [T, H, W], white levels.

        The wall's own light moves little meanwhile (`FrameCamera.instants`); the ripple's mean is exact.
        """
        instants, camera = np.atleast_1d(np.asarray(t_s, np.float64)), FrameCamera(exposure_s=exposure_s)
        nodes = [camera.instants(float(time)) for time in instants]
        light = np.stack([np.tensordot(w, self.wall.irradiance(t).double().numpy(), 1) for t, w in nodes])
        ripple = np.sin(2.0 * math.pi * self.frequency_hz * instants) * np.sinc(self.frequency_hz * exposure_s)
        return light * (1.0 + self.contrast * ripple)[:, None, None]
