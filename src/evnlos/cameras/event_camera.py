"""Event cameras: what they make of a video, of light in blocks of frames, and of a wall in continuous time.

- Events from light that arrives in blocks of frames: bounded memory for recordings of any length.
- Events of a video: the function most users need.
- An event camera that looks at a wall, and chooses its instants from the motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import PixelMaps, PixelSettings
from evnlos.cameras.pixel import EventPixel, Mode, in_mode
from evnlos.cameras.pixels.continuous_math import log_light
from evnlos.cameras.random_numbers import check_seed
from evnlos.cameras.streams import (
    WHITE_DN,
    Columns,
    Frames,
    ImageStrips,
    Light,
    StripLight,
    check_light,
    check_times,
    join,
    sort_times,
)
from evnlos.errors import ConfigError, DataError
from evnlos.types import Events, Irradiance

_BLOCK_STEPS = 256
_CHUNK_BYTES = 64 << 20
_CHUNK_STEPS = 32
_STRIP_STEPS = 64
_RENDER_BYTES = 2 << 20  # of light at once: it is scaled while the cache still holds it
_LONGEST_SHIFT_PX = 4.0
_FEWEST_STEPS = 8
_PROBES = 3
_BLOCK = 512
_MOST_STEPS = 10_000_000


class EventStream:
    """An array of event pixels that takes light block by block and keeps its state in between.

    The events are the same bytes for any division of the frames into blocks, any number of threads and any
    size of tile.

    Args:
        pixel: Settings of the pixels: an `EventPixel`, or those of any other event model.
        shape: Sensor size (height, width), pixels.
        mode: "v2e" steps an `EventPixel` from frame to frame as v2e does; "exact" runs the model that the
            settings name.
        seed: Seed of mismatch and noise, 0 to 2**64 - 1.
        thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units, or measured; None draws them.
        threads: Number of threads; None = as many as torch uses.
        tile_px: Pixels that run through a block together; None = a size that fits the cache.

    Raises:
        ConfigError: Unknown mode, seed, thread count or threshold maps out of range.

    Example:
        >>> from evnlos.cameras import EventPixel
        >>> stream = EventStream(EventPixel(leak_rate_hz=0, shot_noise_rate_hz=0), (2, 3))
        >>> stream.push(np.full((1, 2, 3), 50.0), [0.0])
        >>> stream.push(np.full((2, 2, 3), 50.0), [0.1, 0.2])
        >>> stream.finish()
        Events(0 events, 3 x 2)
    """

    def __init__(
        self,
        pixel: PixelSettings,
        shape: tuple[int, int],
        *,
        mode: Mode = "exact",
        seed: int = 0,
        thresholds: tuple[ArrayLike, ArrayLike] | PixelMaps | None = None,
        threads: int | None = None,
        tile_px: int | None = None,
    ) -> None:
        pixel = in_mode(pixel, mode)
        if len(shape) != 2 or min(shape) < 1:
            raise ConfigError(f"shape is {tuple(shape)}; give (height, width), at least 1 pixel each")
        self.shape, self._disordered = shape, pixel.disorder_s > 0
        self._array = pixel.model(shape, check_seed(seed), thresholds, tile_px=tile_px, threads=threads)
        self._blocks: list[Columns] = []
        self._last_s = -np.inf

    def push(self, frames: ArrayLike | torch.Tensor, times_s: ArrayLike | torch.Tensor) -> None:
        """Take the next frames; the first frame ever is the light to which all pixels have settled.

        Args:
            frames: Light in DN (255 = white; fractions and more than 255 allowed), [T, H, W], at least 0.
            times_s: Instants of the frames, [T], seconds, ascending, after those of the block before.

        Raises:
            DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        """
        light = check_light(frames)
        if light.shape[1:] != tuple(self.shape):
            raise DataError(f"frames are {light.shape[1]} x {light.shape[2]}; the sensor is {self.shape}")
        self.push_light(Frames(np.ascontiguousarray(light).reshape(len(light), math.prod(self.shape))), times_s)

    def push_light(self, light: Light, times_s: ArrayLike | torch.Tensor) -> None:
        """Take the next light, in whatever form.

        Args:
            light: Light in DN at the instants.
            times_s: Its instants, [T], seconds, ascending, after those before.

        Raises:
            DataError: Not one time an instant, times that do not ascend, or what `light` raises.
        """
        times_s = check_times(times_s, len(light), self._last_s)
        if not len(times_s):
            return
        first = 0
        if np.isneginf(self._last_s):
            frames, _ = light[:1].pixels(0, self.shape[0] * self.shape[1])
            self._array.start(frames[0], float(times_s[0]))
            first = 1
        self._last_s = float(times_s[-1])
        for k in range(first, len(times_s), _BLOCK_STEPS):
            block = slice(k, k + _BLOCK_STEPS)
            self._blocks.append(self._array.advance(light[block], times_s[block]))

    def finish(self) -> Events:
        """Return all events since the last call, in order; the pixels keep their state."""
        time_us, where, on = join(self._blocks)
        if self._disordered:
            time_us, where, on = sort_times(time_us, where, on)
        height, width = self.shape
        y = where // width
        return Events(time_us, (where - y * width).astype(np.uint16), y.astype(np.uint16), on, width, height)


def simulate_events(
    frames: ArrayLike | torch.Tensor,
    times_s: ArrayLike | torch.Tensor,
    pixel: PixelSettings | None = None,
    mode: Mode = "exact",
    seed: int = 0,
    thresholds: tuple[ArrayLike, ArrayLike] | PixelMaps | None = None,
    *,
    threads: int | None = None,
    tile_px: int | None = None,
) -> Events:
    """Return the events that an array of event pixels sends while it watches a video.

    With L(I) = ln I above 20 DN and I ln(20) / 20 below, the filter's output P obeys
    dP/dt = 2 pi fc (I + 20) / 275 (L(I) - P), and a pixel sends an event whenever P has moved by a threshold
    away from its reference, which then follows by that threshold. The first frame gives the state at rest.

    Args:
        frames: Light in DN (255 = white; fractions and more than 255 allowed), [T, H, W], at least 0, numpy or
            torch; linear in time between the frames.
        times_s: Instants of the frames, [T], seconds, ascending; any spacing.
        pixel: Settings of the pixels: an `EventPixel`, or those of another event model, which then says what
            happens; None = the paper's.
        mode: "exact" solves for the instants in continuous time. "v2e" steps from frame to frame and gives the
            same multiset of events as v2e at commit cac6384 wherever no random number is involved.
        seed: Seed of mismatch and noise, 0 to 2**64 - 1: same seed, same bytes, for any threads and tiles.
        thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units, or measured; None draws them.
        threads: Number of threads; None = as many as torch uses.
        tile_px: Pixels that run together; None = a size that fits the cache.

    Returns:
        Events ordered by time, then row, then column, OFF before ON.

    Raises:
        DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        ConfigError: Unknown mode, seed, thread count or threshold maps out of range.

    Example:
        >>> times_s = np.linspace(0.0, 0.1, 11)
        >>> frames = 50.0 * np.exp(5.0 * times_s)[:, None, None] * np.ones((1, 1))
        >>> pixel = EventPixel(0.15, 0.15, 0, 0, 0, 0, initial_phase="rest")
        >>> simulate_events(frames, times_s, pixel).t_us // 1000
        array([30, 60, 90])
    """
    shape = np.shape(frames)
    if len(shape) != 3 or 0 in shape[1:]:
        raise DataError(f"frames has shape {tuple(shape)}; give [T, H, W] with at least one pixel")
    stream = EventStream(
        EventPixel() if pixel is None else pixel,
        (int(shape[1]), int(shape[2])),
        mode=mode,
        seed=seed,
        thresholds=thresholds,
        threads=threads,
        tile_px=tile_px,
    )
    stream.push(frames, times_s)
    return stream.finish()


@dataclass(frozen=True)
class EventCamera:
    """An array of event pixels that records per wall, choosing its own time steps from the motion.

    The wall is rendered in chunks; between two instants its light counts as a line. The camera renders probe
    instants in the middle of steps and shortens the steps until that line misses the true log light by no more
    than `tolerance` thresholds. An event is then early or late by at most that fraction of the time its pixel
    takes from one event to the next. No step moves the image by more than four pixels, so that the probes see
    what passes between two instants.

    Args:
        pixel: Settings of the pixels, of any event model.
        tolerance: Largest error of the interpolated log light, in thresholds, more than 0.
        time_step_s: Fixed time step, seconds; None = chosen from the motion. A `V2ePixel` needs one.
        mode: "exact" or "v2e", as in `simulate_events`.

    Raises:
        ConfigError: A tolerance or a time step that is not positive, or a `V2ePixel` without a time step.
    """

    pixel: PixelSettings = field(default_factory=EventPixel)
    """Settings of the pixels."""
    tolerance: float = 0.01
    """Largest error of the interpolated log light, in thresholds."""
    time_step_s: float | None = None
    """Fixed time step, seconds; None = chosen from the motion."""
    mode: Mode = "exact"
    """Continuous time ("exact") or frame by frame ("v2e")."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.tolerance) and self.tolerance > 0):
            raise ConfigError(
                f"EventCamera.tolerance is {self.tolerance}; give a positive number of thresholds"
            )
        step = self.time_step_s
        if step is not None and not (math.isfinite(step) and step > 0):
            raise ConfigError(f"EventCamera.time_step_s is {step}; give a positive number of seconds, or None")
        if (pixel := in_mode(self.pixel, self.mode)).stepped and step is None:
            raise ConfigError(
                f"{type(pixel).__name__} (mode v2e) depends on the time step; give time_step_s, e.g. 0.001"
            )

    def record(
        self, wall: Irradiance, t0: float, t1: float, *, seed: int = 0, threads: int | None = None
    ) -> Events:
        """Return the events of the time from t0 to t1; at t0 all pixels have settled to the light.

        Memory is that of one chunk of frames (64 MiB), the state of the pixels and the events.

        Args:
            wall: The light: `shape`, `irradiance(t_s)` and `speed_px_s`. With fixed steps, a wall that has
                `strips(t_s)`, as `SlidingWall` does, is rendered for the pixels at work only: much quicker.
            t0: First instant, seconds.
            t1: Last instant, seconds, after t0.
            seed: Seed of mismatch and noise.
            threads: Number of threads; None = as many as torch uses.

        Raises:
            ConfigError: t1 is not after t0, or the wall's speed asks for more than ten million steps.
            DataError: The wall returned NaN, negative light, or an image of the wrong size.
        """
        if not (math.isfinite(t0) and math.isfinite(t1) and t1 > t0):
            raise ConfigError(f"record from {t0} s to {t1} s; give finite times, the last after the first")
        height, width = wall.shape
        longest = _longest_step(wall, t0, t1) if self.time_step_s is None else self.time_step_s
        stream = EventStream(self.pixel, (height, width), mode=self.mode, seed=seed, threads=threads)
        stream.push(_render(wall, np.array([t0]), np.empty((1, height, width), np.float32)), [t0])
        if self.time_step_s is not None:
            _record_at(stream, wall, self.fixed_instants(t0, t1))
        else:
            for times_s, frames in self._chunks(wall, t0, t1, longest):
                stream.push(frames, times_s)
        return stream.finish()

    def fixed_instants(self, t0: float, t1: float) -> NDArray[np.float64]:
        """Return the instants after t0, up to t1, at which a camera of fixed time step sees the light, seconds.

        Raises:
            ConfigError: The time step is chosen from the motion.
        """
        if self.time_step_s is None:
            raise ConfigError("the event camera has no time_step_s; give one in seconds, e.g. 0.002")
        steps = max(1, math.ceil((t1 - t0) / self.time_step_s - 1e-9))
        return np.append(t0 + self.time_step_s * np.arange(1, steps), t1).astype(np.float64)

    def _chunks(
        self, wall: Irradiance, t0: float, t1: float, longest: float
    ) -> Iterator[tuple[NDArray[np.float64], NDArray]]:
        """Yield instants and frames that continue after t0 up to t1, at most `longest` seconds apart.

        All chunks are written to the same memory: each is gone when the next one is requested.
        """
        height, width = wall.shape
        most = _most_steps(wall)
        limit, curve = self.tolerance * self.pixel.finest_threshold, self.pixel.log_curve
        step, now = longest, t0
        # the last frame of the chunk before, the chunk, and the probes
        frames = np.empty((1 + most + _PROBES, height, width), np.float32)
        _render(wall, np.array([t0]), frames[:1])
        while now < t1:
            count = min(most, max(1, math.ceil((t1 - now) / step - 1e-9)))
            times = np.asarray(now + step * np.arange(1, count + 1), np.float64)
            if times[-1] >= t1 - 1e-9 * step:
                times[-1] = t1
            before = np.concatenate([[now], times[:-1]])
            probes = sorted({0, count // 2, count - 1})
            instants = np.concatenate([times, 0.5 * (before[probes] + times[probes])])
            _render(wall, instants, frames[1 : 1 + len(instants)])
            error = 0.0
            rows = frames.reshape(len(frames), -1)
            for probe, middle in zip(probes, rows[1 + count : 1 + len(instants)], strict=True):
                error = max(error, _worst_miss(rows[probe], rows[probe + 1], middle, curve))
            if error > limit and step > longest * 1e-3:
                step *= max(0.25, 0.9 * math.sqrt(limit / error))
                continue
            yield times, frames[1 : 1 + count]
            frames[0], now = frames[count], float(times[-1])
            if error < 0.5 * limit:
                step = min(longest, step * min(1.5, 0.9 * math.sqrt(limit / max(error, 1e-12))))


def _record_at(stream: EventStream, wall: Irradiance, times_s: NDArray[np.float64]) -> None:
    """Let the pixels see the wall at given instants: strip by strip where it can be had so, else in frames."""
    most = min(_most_steps(wall), len(times_s))
    frames = None
    render: Callable[..., ImageStrips | None] | None = getattr(type(wall), "strips", None)
    for part in np.split(times_s, range(_STRIP_STEPS, len(times_s), _STRIP_STEPS)):
        strips = render(wall, part) if callable(render) else None
        if strips is not None:
            stream.push_light(StripLight(strips), part)
            continue
        frames = np.empty((most, *wall.shape), np.float32) if frames is None else frames
        for few in np.split(part, range(most, len(part), most)):
            stream.push(_render(wall, few, frames[: len(few)]), few)


def _most_steps(wall: Irradiance) -> int:
    """Return how many frames are rendered together."""
    height, width = wall.shape
    return max(1, min(_CHUNK_STEPS, _CHUNK_BYTES // (4 * height * width)))


def _longest_step(wall: Irradiance, t0: float, t1: float) -> float:
    """Return the step that moves the image by four pixels, at most an eighth of the recording."""
    speed = float(wall.speed_px_s)
    if not (math.isfinite(speed) and speed >= 0):
        raise ConfigError(f"the wall's speed_px_s is {speed}; give pixels per second, 0 or more")
    own = float(getattr(wall, "longest_step_s", math.inf))  # of light that changes without motion
    step = min((t1 - t0) / _FEWEST_STEPS, _LONGEST_SHIFT_PX / max(speed, 1e-12), own)
    if (t1 - t0) / step > _MOST_STEPS:
        raise ConfigError(
            f"{t1 - t0:g} s at {speed:g} pixels/s need {(t1 - t0) / step:.0f} steps; record in parts"
        )
    return step


def _render(wall: Irradiance, times_s: NDArray[np.float64], out: NDArray[np.float32]) -> NDArray[np.float32]:
    """Write the wall's light at `times_s` in DN to `out` [T, H, W] and return it."""
    height, width = wall.shape
    most = max(1, _RENDER_BYTES // (4 * height * width))
    for k in range(0, len(times_s), most):
        part = times_s[k : k + most]
        light = wall.irradiance(part)
        if tuple(light.shape) != (len(part), height, width):
            raise DataError(
                f"the wall rendered {tuple(light.shape)} for {len(part)} instants; its shape is {wall.shape}"
            )
        levels = light.detach().to("cpu", torch.float32).numpy()
        np.multiply(levels, np.float32(WHITE_DN), out=out[k : k + most])
    return out


@njit(cache=True, error_model="numpy")
def _misses(earlier, later, middle, curve, out):
    """Fill how far the log of the mean of two frames is from the log of the frame between them."""
    for i in range(len(out)):
        line = 0.5 * (np.float64(earlier[i]) + np.float64(later[i]))
        there = np.float64(middle[i])
        out[i] = abs(
            log_light(curve.scale * line + curve.offset) - log_light(curve.scale * there + curve.offset)
        )


@njit(cache=True, error_model="numpy")
def _worst_miss(earlier, later, middle, curve):
    """Return the largest of the misses; block by block, so that a compiler takes the logarithms in vectors."""
    worst = 0.0
    block = np.empty(_BLOCK)
    for start in range(0, len(middle), _BLOCK):
        stop = min(start + _BLOCK, len(middle))
        out = block[: stop - start]
        _misses(earlier[start:stop], later[start:stop], middle[start:stop], curve, out)
        for miss in out:
            if miss > worst:
                worst = miss
    return worst
