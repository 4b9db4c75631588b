"""The Brownian pixel: settings, array and kernels of DVS-Voltmeter's equation.

- The kernels of the Brownian pixel: exact first passages of a drifting Brownian motion, one tile at a time.

A pixel whose voltage is a drifting Brownian motion: the equation of DVS-Voltmeter, sampled exactly.

With L(t) the light in DN, x the log light since the last event, and W a Brownian motion,

    dx = d ln(L + k) + theta_on (r + s L) dt + (a sqrt(L) / (L + k) + b) dW,
    ON at x = theta_on, OFF at x = -theta_off, then x = 0

(Lin, Ma, Guo and Wen, "DVS-Voltmeter: Stochastic Process-based Event Simulator for Dynamic Vision Sensors",
ECCV 2022, where x is counted in thresholds). Between two instants of the light, L is taken at their mean in all
but the first term; x is then a Brownian motion with constant drift, and nothing depends on how a stretch of
constant light is cut into frames. The published code draws from another law (its spread depends on the frame
distance); this module draws from the equation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.cameras.event_model import (
    EVENT_MODELS,
    CrossingLaw,
    EventModel,
    LogCurve,
    Phase,
    ThresholdPixel,
    check_pattern_seed,
    check_phase,
    require,
)
from evnlos.cameras.pixels.arrays import TiledArray, check_tiling, pixel_thresholds
from evnlos.cameras.random_numbers import (
    STREAM_BARRIER,
    STREAM_LEAK_PHASE,
    STREAM_PASSAGE,
    STREAM_PENDING,
    STREAM_WALK,
    fast_log,
    random_normal,
    random_normals,
    random_uniform,
)
from evnlos.cameras.streams import Columns, grown
from evnlos.errors import ConfigError

_SAFE = 8.0
_STRIDE = 0.2


class Law(NamedTuple):
    """The equation's constants; symbols as in the module's first lines."""

    dark: float  # k, DN
    leak: float  # theta_on r, log units per s
    leak_light: float  # theta_on s, log units per s and DN
    photon: float  # a, log units sqrt(DN / s)
    floor: float  # b, log units per sqrt(s)
    exposure: float
    linear: bool  # whether changes of light are taken relative to their mean
    seed: np.uint64


class State(NamedTuple):
    """The pixels, [N] each: x is normal around `mean` with `variance` while it cannot have met a threshold."""

    light: NDArray[np.float64]  # DN
    mean: NDArray[np.float64]  # log units since the last event
    low: NDArray[np.float64]  # least mean since x was last drawn
    high: NDArray[np.float64]  # greatest mean since then
    variance: NDArray[np.float64]  # of what was not drawn yet, log units squared
    drawn: NDArray[np.uint32]  # sub-steps of the walk so far
    pending: NDArray[np.uint32]  # draws of what was pending so far


@njit(cache=True, error_model="numpy", inline="always")
def passage(d0, d1, spread, normal, uniform):
    """Return at which share of a step a walk meets a barrier, given that it does.

    d0, d1    distance to the barrier at the start and at the end of the step, log units; d1 < 0 beyond it
    spread    sigma^2 h, variance of the step
    The time is h s / (1 + s) with s inverse Gaussian of mean d0 / |d1| and shape d0^2 / spread (a Brownian
    bridge: the drift cancels), drawn as Michael, Schucany and Haas do (The American Statistician 30, 1976).
    """
    mean = d0 / max(abs(d1), 1e-12 * d0)
    w = 0.5 * mean * normal * normal * spread / (d0 * d0)
    root = 1.0 + w + math.sqrt(w * (w + 2.0))
    s = mean / root
    if uniform * (mean + s) > mean:
        s = mean * root
    return s / (1.0 + s)


@njit(cache=True, error_model="numpy")
def walk(out, count, pixel, start, length, x, drift, noise, on, off, seed, drawn):
    """Send a pixel's events of one step; return the fill of the columns, x at its end, and the draws so far.

    x       log units since the last event, at `start`
    drift   mu, log units per s;  noise  sigma, log units per sqrt(s)
    on, off thresholds, log units
    In sub-steps h with sigma sqrt(h) <= 0.2 thresholds: x' = x + mu h + sigma sqrt(h) n; a threshold at the
    distances d0 and d1 is met if x' lies beyond it, else with probability exp(-2 d0 d1 / (sigma^2 h)).
    """
    times, pixels, polarity = out
    longest = length
    if noise > 0.0:
        longest = (_STRIDE * min(on, off) / noise) ** 2
    at = 0.0
    while at < length:
        h = min(longest, length - at)
        spread = noise * noise * h
        x1 = x + drift * h
        up, down = on - x, x + off
        share, sign = 2.0, 0
        if spread > 0.0:
            x1 += math.sqrt(spread) * random_normal(seed, STREAM_WALK, pixel, drawn)
            up1, down1 = on - x1, x1 + off
            base = 4 * np.int64(drawn)
            met_on = up1 <= 0.0 or random_uniform(seed, STREAM_BARRIER, pixel, base) < math.exp(
                -2.0 * up * up1 / spread
            )
            met_off = down1 <= 0.0 or random_uniform(seed, STREAM_BARRIER, pixel, base + 1) < math.exp(
                -2.0 * down * down1 / spread
            )
            if met_on or met_off:
                one, other = random_normals(seed, STREAM_PASSAGE, pixel, drawn)
                if met_on:
                    uniform = random_uniform(seed, STREAM_BARRIER, pixel, base + 2)
                    share, sign = passage(up, up1, spread, one, uniform), 1
                if met_off:
                    uniform = random_uniform(seed, STREAM_BARRIER, pixel, base + 3)
                    when = passage(down, down1, spread, other, uniform)
                    if when < share:
                        share, sign = when, -1
            drawn += 1
        elif x1 >= on:
            share, sign = up / (x1 - x), 1
        elif x1 <= -off:
            share, sign = down / (x - x1), -1
        if sign == 0:
            x = x1
            at = at + h if h < length - at else length
            continue
        at = min(at + share * h, length)
        x = 0.0
        if count < len(times):
            times[count] = np.int64(np.rint((start + at) * 1e6))
            pixels[count] = pixel
            polarity[count] = sign > 0
        count += 1
    return count, x, drawn


# Each of the following loops writes one array: with more, a compiler gives up proving that they do not overlap.


@njit(cache=True, error_model="numpy")
def log_row(light, dark, logs):
    """Fill the logarithm of the light and the dark current."""
    for i in range(len(light)):
        logs[i] = fast_log(light[i] + dark)


@njit(cache=True, error_model="numpy")
def change_row(light, light_1, logs, logs_1, law, length, change):
    """Fill what the mean moves in a step: the change of log light, and the leak."""
    for i in range(len(light)):
        middle = 0.5 * (light[i] + light_1[i])
        step = logs_1[i] - logs[i]
        if law.linear:
            step = (light_1[i] - light[i]) / (middle + law.dark)
        change[i] = step + (law.leak + law.leak_light * middle) * length


@njit(cache=True, error_model="numpy")
def variance_row(light, light_1, variance, law, length, variance_1):
    """Fill the variance of what is not drawn yet at the end of a step."""
    for i in range(len(light)):
        middle = 0.5 * (light[i] + light_1[i])
        noise = law.photon * math.sqrt(middle) / (middle + law.dark) + law.floor
        variance_1[i] = variance[i] + noise * noise * length


@njit(cache=True, error_model="numpy")
def mean_row(mean, change, mean_1):
    """Fill the mean at the end of a step."""
    for i in range(len(mean)):
        mean_1[i] = mean[i] + change[i]


@njit(cache=True, error_model="numpy")
def lowest_row(low, mean_1, low_1):
    """Fill the lowest mean so far."""
    for i in range(len(low)):
        low_1[i] = min(low[i], mean_1[i])


@njit(cache=True, error_model="numpy")
def highest_row(high, mean_1, high_1):
    """Fill the highest mean so far."""
    for i in range(len(high)):
        high_1[i] = max(high[i], mean_1[i])


@njit(cache=True, error_model="numpy")
def flag_row(low, high, variance, on, off, flags):
    """Flag the pixels that may have met a threshold: fewer than eight standard deviations from one."""
    for i in range(len(flags)):
        up, down = on[i] - high[i], off[i] + low[i]
        reach = _SAFE * _SAFE * variance[i]
        flags[i] = (up <= 0.0) | (down <= 0.0) | (up * up <= reach) | (down * down <= reach)


@njit(cache=True, error_model="numpy")
def run_tile(out, count, frames, origin, times, first, last, state, on, off, law):
    """Run the pixels first..last - 1 through all steps; return the columns and their fill."""
    size = last - first
    now, then = np.empty((6, size)), np.empty((6, size))  # light, log light, mean, low, high, variance
    change, flags = np.empty(size), np.empty(size, np.bool_)
    on, off = on[first:last], off[first:last]
    now[0], now[2], now[3] = state.light[first:last], state.mean[first:last], state.low[first:last]
    now[4], now[5] = state.high[first:last], state.variance[first:last]
    log_row(now[0], law.dark, now[1])
    for k in range(len(frames)):
        start, length = times[k], times[k + 1] - times[k]
        row = frames[k, first - origin : last - origin]
        light = then[0]
        for i in range(size):
            light[i] = law.exposure * np.float64(row[i])
        log_row(then[0], law.dark, then[1])
        change_row(now[0], then[0], now[1], then[1], law, length, change)
        mean_row(now[2], change, then[2])
        lowest_row(now[3], then[2], then[3])
        highest_row(now[4], then[2], then[4])
        variance_row(now[0], then[0], now[5], law, length, then[5])
        flag_row(then[3], then[4], then[5], on, off, flags)
        for i in range(size):
            if not flags[i]:
                continue
            pixel = first + i
            x, step_variance = now[2, i], then[5, i] - now[5, i]
            if now[5, i] > 0.0:
                x += math.sqrt(now[5, i]) * random_normal(law.seed, STREAM_PENDING, pixel, state.pending[pixel])
                x = min(max(x, -off[i]), on[i])
                state.pending[pixel] += np.uint32(1)
            end = x + change[i]
            low, high = min(x, end), max(x, end)
            gap = min(on[i] - high, off[i] + low)
            if gap > 0.0 and gap * gap > _SAFE * _SAFE * step_variance:
                then[2, i], then[3, i], then[4, i], then[5, i] = end, low, high, step_variance
                continue
            noise, drift = math.sqrt(step_variance / length), change[i] / length
            while True:
                filled, end, drawn = walk(
                    out, count, pixel, start, length, x, drift, noise, on[i], off[i], law.seed,
                    state.drawn[pixel],
                )  # fmt: skip
                if filled <= len(out[0]):
                    break
                out = grown(out[0]), grown(out[1]), grown(out[2])
            count, state.drawn[pixel] = filled, drawn
            then[2, i] = then[3, i] = then[4, i] = end
            then[5, i] = 0.0
        now, then = then, now
    state.light[first:last], state.mean[first:last], state.low[first:last] = now[0], now[2], now[3]
    state.high[first:last], state.variance[first:last] = now[4], now[5]
    return out, count


@njit(cache=True, error_model="numpy", nogil=True)
def run_tiles(frames, origin, times, first, last, tile_px, state, on, off, law):
    """Run the pixels first..last - 1 through a block of light, tile by tile, and return what they sent.

    frames   light, DN [T, M], of the pixels origin..origin + M - 1 at times[1:], seconds [T + 1]
    state    `State`, changed;  on, off  thresholds, log units [N];  law  `Law`
    Returns three columns: time stamp in microseconds, pixel, polarity.
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count = np.int64(0)
    for start in range(first, last, tile_px):
        out, count = run_tile(
            out, count, frames, origin, times, start, min(start + tile_px, last), state, on, off, law
        )
    return out[0][:count], out[1][:count], out[2][:count]


@njit(cache=True, error_model="numpy")
def settled(light, on, off, law):
    """Return states x of pixels that have long seen constant light, drawn from their density.

    With c = 2 mu / sigma^2 the density is 1 - exp(-c (on - x)) above 0 and, below,
    (1 - exp(-c on)) (exp(c x) - exp(-c off)) / (1 - exp(-c off)); its integral is inverted by bisection.
    """
    x = np.zeros(len(light))
    for i in range(len(light)):
        noise = law.photon * math.sqrt(light[i]) / (light[i] + law.dark) + law.floor
        drift = law.leak + law.leak_light * light[i]
        uniform = random_uniform(law.seed, STREAM_LEAK_PHASE, i, 0)
        if drift == 0.0 and noise == 0.0:
            continue
        c = 2.0 * drift / (noise * noise) if noise > 0.0 else np.inf
        if c * on[i] > 1e8:
            x[i] = uniform * on[i]
            continue
        low, high = -off[i], on[i]
        total = mass_below(on[i], c, on[i], off[i])
        for _ in range(60):
            middle = 0.5 * (low + high)
            if mass_below(middle, c, on[i], off[i]) < uniform * total:
                low = middle
            else:
                high = middle
        x[i] = 0.5 * (low + high)
    return x


@njit(cache=True, error_model="numpy")
def mass_below(x, c, on, off):
    """Return the integral of the settled density, up to a factor, from -off to x."""
    if c * (on + off) < 1e-5:  # a tent
        left = 0.5 * on / off * (min(x, 0.0) + off) ** 2
        return left if x <= 0.0 else left + on * x - 0.5 * x * x
    below = min(x, 0.0)
    factor = math.expm1(-c * on) / math.expm1(-c * off)
    left = factor * ((math.exp(c * below) - math.exp(-c * off)) / c - (below + off) * math.exp(-c * off))
    if x <= 0.0:
        return left
    return left + x + (math.exp(-c * on) - math.exp(-c * (on - x))) / c


@EVENT_MODELS.register
@dataclass(frozen=True)
class BrownianPixel(ThresholdPixel):
    """A pixel with noise that grows in dim light and leak that grows with light; defaults are a DAVIS346's.

    Times of events jitter the more, the slower the light changes. The model has no bandwidth, no refractory
    period and no memory in its noise: with the default numbers noise does little but jitter the leak, and it is
    no model of the noise of a dim pixel.

    Args:
        threshold_on: Mean contrast threshold of ON events, log units (e-fold), at least 0.01; 1/k1.
        threshold_off: The same for OFF events.
        threshold_sigma: Standard deviation of both thresholds over the pixels, log units; 0 = none.
        dark_dn: Offset k of the logarithm, DN, more than 0; k2.
        leak_rate_hz: Rate r of the leak's ON events in the dark, hertz per pixel; k4.
        leak_rate_per_dn_hz: What each DN of light adds to that rate, hertz per DN; k5.
        photon_noise: Strength a of the noise of the light, log units times sqrt(DN / s); k3/k1.
        dark_noise: Strength b of the noise in the dark, log units per sqrt(s); k6/k1.
        exposure: DN of the pixel per DN of the light that it is fed, more than 0.
        initial_phase: "random" = each pixel in a state of long constant light, "rest" = just after an event.
        increments: What the first term of the equation is between two instants: "log" = the change of
            ln(L + k), so that a change of light counts alike however it is cut; "linear" = that of L over the
            mean of L + k, as in the publication.
        pattern_seed: Seed of the thresholds: one sensor for all recordings; None = a new one for each.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> round(BrownianPixel.voltmeter(5.265, 20, 1e-4, 1e-7, 5e-9, 1e-5).threshold_on, 4)
        0.1899
    """

    threshold_on: float = 0.18993
    """Mean contrast threshold of ON events, log units (e-fold)."""
    threshold_off: float = 0.18993
    """Mean contrast threshold of OFF events, log units (e-fold)."""
    threshold_sigma: float = 0.0
    """Standard deviation of both thresholds over the pixels, log units; 0 = none."""
    dark_dn: float = 20.0
    """Offset of the logarithm, DN."""
    leak_rate_hz: float = 0.1
    """Rate of the leak's ON events in the dark, hertz per pixel."""
    leak_rate_per_dn_hz: float = 0.005
    """What each DN of light adds to the leak's rate, hertz per DN."""
    photon_noise: float = 0.018993
    """Strength of the noise of the light, log units times sqrt(DN / s)."""
    dark_noise: float = 0.0018993
    """Strength of the noise in the dark, log units per sqrt(s)."""
    exposure: float = 1.0
    """DN of the pixel per DN of the light that it is fed."""
    initial_phase: Phase = "random"
    """State before the first frame: random = that of long constant light, rest = just after an event."""
    increments: Literal["log", "linear"] = "log"
    """Change of ln(L + k), or of L over the mean of L + k as in the publication."""
    pattern_seed: int | None = None
    """Seed of the thresholds: one sensor for all recordings; None = a new one for each."""
    kind: Literal["brownian"] = "brownian"
    """The event model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("dark_dn", "exposure"):
            require(self, name, 1e-6, 1e9, "(DN, or DN per DN)")
        for name in ("leak_rate_hz", "leak_rate_per_dn_hz"):
            require(self, name, 0.0, math.inf, "hertz; 0 switches it off")
        for name in ("photon_noise", "dark_noise"):
            require(self, name, 0.0, math.inf, "log units per sqrt(s); 0 switches it off")
        check_phase(self.initial_phase)
        if self.increments not in ("log", "linear"):
            raise ConfigError(f'increments is {self.increments!r}; give "log" or "linear"')
        check_pattern_seed(self.pattern_seed)

    @classmethod
    def voltmeter(cls, k1: float, k2: float, k3: float, k4: float, k5: float, k6: float) -> BrownianPixel:
        """Return the pixel with parameters as DVS-Voltmeter states them, in thresholds, DN and microseconds.

        Args:
            k1: Thresholds per log unit.
            k2: Offset, DN.
            k3: Noise of the light, thresholds times sqrt(DN / us).
            k4: Leak in the dark, thresholds per us.
            k5: Leak by light, thresholds per us and DN.
            k6: Noise in the dark, thresholds per sqrt(us).
        """
        return cls(1 / k1, 1 / k1, 0.0, k2, k4 * 1e6, k5 * 1e6, k3 * 1e3 / k1, k6 * 1e3 / k1)

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
        return BrownianArray(self, shape, seed, thresholds, 1024 if tile_px is None else tile_px, threads)

    @property
    def log_curve(self) -> LogCurve:
        """The logarithm of the light over the dark offset, which lies above the knee throughout."""
        factor = 40.0 / self.dark_dn
        return LogCurve(factor * self.exposure, 40.0)

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw:
        """Return what an event says of the light; its noise is that of the walk since the event before."""
        return self._law(
            leak_per_dn=self.threshold_on * self.leak_rate_per_dn_hz,
            walk=(self.photon_noise, self.dark_noise, self.dark_dn),
            exposure=self.exposure,
        )


class BrownianArray(TiledArray):
    """An array of `BrownianPixel`s."""

    def __init__(
        self,
        pixel: BrownianPixel,
        shape: tuple[int, int],
        seed: int,
        thresholds: object = None,
        tile_px: int = 1024,
        threads: int | None = None,
    ) -> None:
        self.pixel = pixel
        self._tile_px, self._threads = check_tiling(tile_px, threads)
        self._on, self._off = pixel_thresholds(pixel, shape, seed, thresholds)
        self._law = Law(
            dark=float(pixel.dark_dn),
            leak=float(pixel.threshold_on * pixel.leak_rate_hz),
            leak_light=float(pixel.threshold_on * pixel.leak_rate_per_dn_hz),
            photon=float(pixel.photon_noise),
            floor=float(pixel.dark_noise),
            exposure=float(pixel.exposure),
            linear=pixel.increments == "linear",
            seed=np.uint64(seed),
        )

    def start(self, frame: NDArray, time_s: float) -> None:
        """Let all pixels have seen the first light, DN [N], for long, or have just sent an event."""
        light = self.pixel.exposure * frame.astype(np.float64)
        count = len(light)
        mean = np.zeros(count)
        if self.pixel.initial_phase == "random":
            mean = settled(light, self._on, self._off, self._law)
        counters = np.zeros(count, np.uint32), np.zeros(count, np.uint32)
        self._state = State(light, mean, mean.copy(), mean.copy(), np.zeros(count), *counters)
        self._time = time_s

    def _run(self, times: NDArray[np.float64]) -> Callable[..., Columns]:
        what = self._tile_px, self._state, self._on, self._off, self._law
        return lambda frames, origin, first, last: run_tiles(frames, origin, times, first, last, *what)
