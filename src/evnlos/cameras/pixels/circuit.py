"""The photoreceptor with currents: bandwidth and noise follow from the light (the model of Graca and Delbruck).

With I light and dark current together, q the charge of an electron, U = kT/q, gs = I / U, gm = kappa gs,
ga = kappa I_pr / U, R = V_A / (2 I_pr), A = ga R kappa, three voltages obey

    (C_pd + C_fb) v_pd' - C_fb v_pr' + gs v_pd - gm v_pr = -gm (1 + A) / A V + n_pd
    -C_fb v_pd' + (C_pr + C_fb) v_pr' + ga v_pd + v_pr / R = n_pr
    C_sf v_sf' = (I_sf / U) (kappa v_pr - v_sf) + n_sf
    V = (U / kappa) A / (1 + A) ln(I / I_start),  n white with variances 2 q I, 2 q I_pr, 2 q I_sf per second

and a pixel sends an event where v_sf, in log units of light, has moved by a threshold since its last one
(R. Graca and T. Delbruck, arXiv 2304.04706 and 2505.07386). Within a short step I is frozen; what the light
does and what the noise does add, since the equations are linear. Both are advanced exactly, by the matrix
exponential of the step for a table of currents; noise and reference start in their stationary state.

With `poles` 1, v_sf follows x with one time constant and carries one Ornstein-Uhlenbeck noise: that of the
same mean lag, and that of the same variance and correlation time as the three equations have at each current,

    lag = -(M^-1 c)_3,  rms^2 = P_33,  memory = -(M^-1 P)_33 / P_33,  P the covariance of what settles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
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
    noise_lead,
    require,
)
from evnlos.cameras.pixels.arrays import TiledArray, check_tiling, pixel_thresholds
from evnlos.cameras.random_numbers import (
    STREAM_CIRCUIT,
    STREAM_CIRCUIT_START,
    factor_of,
    fast_log,
    normal_field,
    normal_row,
    passage_times,
    random_triple,
    settled_reference,
    stationary,
)
from evnlos.cameras.streams import Columns, grown
from evnlos.errors import ConfigError

LEVEL = 0.02
"""Distance of two currents of the table, e-fold."""
_SAFE = 7.0
"""Standard deviations of the noise from a threshold at which a pixel's noise need not be drawn."""
_FORGOTTEN = 2048
"""Steps after which noise that was not drawn is drawn anew from its stationary state."""


class Table(NamedTuple):
    """One step h of the equations, for currents `LEVEL` apart."""

    decay: NDArray[np.float64]  # exp(M h), [L, 3, 3]
    push: NDArray[np.float64]  # M^-1 (exp(M h) - 1) c / h: what a change of log light takes away, [L, 3]
    kick: NDArray[np.float64]  # Cholesky factor of the noise of a step, [L, 3, 3]
    settled: NDArray[np.float64]  # Cholesky factor of the stationary noise, [L, 3, 3]


class Pole(NamedTuple):
    """One step h of the equations with one time constant each, for currents `LEVEL` apart; all [L]."""

    decay: NDArray[np.float64]  # exp(-h / lag)
    push: NDArray[np.float64]  # lag (1 - exp(-h / lag)) / h: what a change of log light takes away
    keep: NDArray[np.float64]  # exp(-h / memory) of the noise
    kick: NDArray[np.float64]  # rms of the noise of a step, log units


class State(NamedTuple):
    """The pixels. The follower stands at x + lag[2] + noise[2], x being the log current."""

    x: NDArray[np.float64]  # log current over dark current, [N]
    lag: NDArray[np.float64]  # response to light less what it settles at, log units [N, 3]
    noise: NDArray[np.float64]  # log units [N, 3]
    reference: NDArray[np.float64]  # log units [N]
    deaf: NDArray[np.float64]  # end of the refractory period, seconds [N]
    drawn: NDArray[np.uint32]  # pairs of normal numbers so far [N]
    stale: NDArray[np.int64]  # steps by which the noise is behind [N]


class Pixel(NamedTuple):
    """Constants of the array."""

    on: NDArray[np.float64]  # thresholds, log units [N]
    off: NDArray[np.float64]
    factor: float  # light current over dark current, per DN
    top: float  # largest log current of the table
    leak: float  # log units per s
    refractory: float  # s
    seed: np.uint64


@njit(cache=True, error_model="numpy", inline="always")
def apply(matrix, vector, i, add, scale):
    """Replace row i of `vector` by matrix @ row + scale * add."""
    a, b, c = vector[i, 0], vector[i, 1], vector[i, 2]
    for n in range(3):
        vector[i, n] = matrix[n, 0] * a + matrix[n, 1] * b + matrix[n, 2] * c + scale * add[n]


@njit(cache=True, error_model="numpy")
def catch_up(i, level, state, table, pixel, kick):
    """Bring a pixel's noise up to date: step by step, or drawn anew where it has forgotten."""
    if state.stale[i] > _FORGOTTEN:
        random_triple(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.settled[level], kick)
        state.drawn[i] += np.uint32(2)
        for n in range(3):
            state.noise[i, n] = kick[n]
    else:
        for _ in range(state.stale[i]):
            random_triple(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.kick[level], kick)
            state.drawn[i] += np.uint32(2)
            apply(table.decay[level], state.noise, i, kick, 1.0)
    state.stale[i] = 0


@njit(cache=True, error_model="numpy", inline="always")
def cross(out, count, i, at, h, before, now, state, pixel):
    """Send a pixel's events of a step from `at`, in which its follower goes from `before` to `now`."""
    left = h
    if state.deaf[i] > at:
        if state.deaf[i] >= at + h:
            state.reference[i] = now
            return out, count
        share = (state.deaf[i] - at) / h
        before += share * (now - before)
        left -= state.deaf[i] - at
        at, state.reference[i] = state.deaf[i], before
    while True:
        lift = now - state.reference[i]
        sign = 1 if lift >= pixel.on[i] else (-1 if lift <= -pixel.off[i] else 0)
        if sign == 0:
            return out, count
        state.reference[i] += pixel.on[i] if sign > 0 else -pixel.off[i]
        share = 0.0
        if now != before:
            share = min(max((state.reference[i] - before) / (now - before), 0.0), 1.0)
        if count == len(out[0]):
            out = grown(out[0]), grown(out[1]), grown(out[2])
        out[0][count] = np.int64(np.rint((at + share * left) * 1e6))
        out[1][count], out[2][count] = i, sign > 0
        count += 1
        if pixel.refractory > 0.0:
            state.deaf[i] = at + share * left + pixel.refractory
            state.reference[i] = now
            return out, count


@njit(cache=True, error_model="numpy")
def run_interval(out, count, i, start, length, steps, x1, state, table, pixel, kick):
    """Advance one pixel by `steps` steps of log light, a line to x1; return the columns and their fill."""
    x0, h = state.x[i], length / steps
    change = (x1 - x0) / steps
    top = len(table.decay) - 1
    middle = min(int(0.5 * (x0 + x1) / LEVEL + 0.5), top)
    rms = math.sqrt((table.settled[middle, 2] ** 2).sum())
    deaf = state.deaf[i] > start
    # without its noise: how far does the response go, and can it come near a threshold?
    if not deaf:
        lift = x0 + state.lag[i, 2] - state.reference[i]
        reach = max(abs(state.lag[i, 0]), abs(state.lag[i, 1]), abs(state.lag[i, 2])) + abs(x1 - x0)
        reach += pixel.leak * length + _SAFE * rms
        if lift + reach < pixel.on[i] and lift - reach > -pixel.off[i]:
            for _ in range(steps):
                apply(table.decay[middle], state.lag, i, table.push[middle], -change)
            state.stale[i] += steps
            state.reference[i] -= pixel.leak * length
            state.x[i] = x1
            return out, count
    catch_up(i, middle, state, table, pixel, kick)
    before = x0 + state.lag[i, 2] + state.noise[i, 2]
    for k in range(steps):
        level = min(int((x0 + (k + 0.5) * change) / LEVEL + 0.5), top)
        apply(table.decay[level], state.lag, i, table.push[level], -change)
        random_triple(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.kick[level], kick)
        state.drawn[i] += np.uint32(2)
        apply(table.decay[level], state.noise, i, kick, 1.0)
        now = x0 + (k + 1) * change + state.lag[i, 2] + state.noise[i, 2]
        state.reference[i] -= pixel.leak * h
        out, count = cross(out, count, i, start + k * h, h, before, now, state, pixel)
        before = now
    state.x[i] = x1
    return out, count


@njit(cache=True, error_model="numpy", nogil=True)
def run_frames(frames, origin, times, steps, first, last, state, tables, which, pixel):
    """Run the pixels first..last - 1 through a block of light and return what they sent.

    frames  light, DN [T, M], of the pixels origin..origin + M - 1 at times[1:], seconds [T + 1]
    steps   steps of each interval [T];  tables  `Table` with a first axis for each length of a step
    which   the table of each interval [T];  state, pixel  `State`, changed, and `Pixel`
    Returns three columns: time stamp in microseconds, pixel, polarity.
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count, kick = np.int64(0), np.empty(3)
    for k in range(len(frames)):
        length, w = times[k + 1] - times[k], which[k]
        table = Table(tables.decay[w], tables.push[w], tables.kick[w], tables.settled[w])
        for i in range(first, last):
            x1 = min(fast_log(1.0 + pixel.factor * np.float64(frames[k, i - origin])), pixel.top)
            out, count = run_interval(out, count, i, times[k], length, steps[k], x1, state, table, pixel, kick)
    return out[0][:count], out[1][:count], out[2][:count]


# Each of the following loops writes few arrays: with more, a compiler gives up proving that none overlap.


@njit(cache=True, error_model="numpy")
def noise_row(noise, keep, kick, normal, which):
    """Advance the noise by a step, with the first or the second of two normal numbers."""
    for i in range(len(noise)):
        noise[i] = keep[i] * noise[i] + kick[i] * normal[2 * i + which]


@njit(cache=True, error_model="numpy")
def lag_row(lag, decay, push):
    """Advance the response by a step."""
    for i in range(len(lag)):
        lag[i] = decay[i] * lag[i] - push[i]


@njit(cache=True, error_model="numpy")
def stand_row(x0, x1, share, leaked, lag, noise, now):
    """Fill where the follower stands, `share` of the way between two frames, over a reference that leaked."""
    for i in range(len(now)):
        now[i] = x0[i] + share * (x1[i] - x0[i]) + (lag[i] + noise[i] + leaked)


@njit(cache=True, error_model="numpy")
def flag_row(now, reference, on, off, deaf, at, flags):
    """Flag the pixels that meet a threshold in a step or rest at its start."""
    for i in range(len(now)):
        lift = now[i] - reference[i]
        flags[i] = (lift >= on[i]) | (lift <= -off[i]) | (deaf[i] > at)


@njit(cache=True, error_model="numpy")
def send_row(out, count, start, at, h, before, now, flags, state, pixel):
    """Send the events of the flagged pixels, from `start` on, in a step."""
    for i in range(len(flags)):
        if flags[i]:
            out, count = cross(out, count, start + i, at, h, before[i], now[i], state, pixel)
    return out, count


@njit(cache=True, error_model="numpy", nogil=True)
def run_poles(frames, origin, times, steps, first, last, tile_px, state, tables, which, pixel):
    """Run pixels of one time constant through a block of light; arguments and result as of `run_frames`.

    tables  `Pole` with a first axis for each length of a step;  tile_px  pixels that go through it together
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count, top = np.int64(0), tables.decay.shape[1] - 1
    for start in range(first, last, tile_px):
        size = min(tile_px, last - start)
        stop = start + size
        rows, normal, flags = np.empty((10, size)), np.empty(2 * size), np.empty(size, np.bool_)
        lag, noise, before, now, x0, x1 = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
        decay, push, keep, kick = rows[6], rows[7], rows[8], rows[9]
        lag[:], noise[:], x0[:] = state.lag[start:stop, 2], state.noise[start:stop, 2], state.x[start:stop]
        on, off, deaf = pixel.on[start:stop], pixel.off[start:stop], state.deaf[start:stop]
        reference, drawn, leaked = state.reference[start:stop], state.drawn[start], 0.0
        stand_row(x0, x0, 0.0, leaked, lag, noise, before)
        for k in range(len(frames)):
            h, w = (times[k + 1] - times[k]) / steps[k], which[k]
            for i in range(size):
                x1[i] = min(fast_log(1.0 + pixel.factor * np.float64(frames[k, start - origin + i])), pixel.top)
                level = min(int(0.5 * (x0[i] + x1[i]) / LEVEL + 0.5), top)
                decay[i], keep[i] = tables.decay[w, level], tables.keep[w, level]
                push[i], kick[i] = tables.push[w, level] * (x1[i] - x0[i]) / steps[k], tables.kick[w, level]
            for n in range(steps[k]):
                at = times[k] + n * h
                leaked += pixel.leak * h
                if n % 2 == 0:
                    normal_row(pixel.seed, STREAM_CIRCUIT, start, drawn, normal)
                    drawn += np.uint32(1)
                lag_row(lag, decay, push)
                noise_row(noise, keep, kick, normal, n % 2)
                stand_row(x0, x1, (n + 1) / steps[k], leaked, lag, noise, now)
                flag_row(now, reference, on, off, deaf, at, flags)
                if flags.any():
                    out, count = send_row(out, count, start, at, h, before, now, flags, state, pixel)
                before, now = now, before
            x0, x1 = x1, x0
        state.drawn[start:stop] = drawn
        reference -= leaked
        state.lag[start:stop, 2], state.noise[start:stop, 2], state.x[start:stop] = lag, noise, x0
    return out[0][:count], out[1][:count], out[2][:count]


_CHARGE, _THERMAL_V = 1.602176634e-19, 0.0258
_RANGE = 3.0
"""Currents stay below the amplifier's by this factor: the equations ask for it."""
_STEP_SHARE = 0.1
"""Longest step, in time constants of the follower: between two steps its output counts as a line."""
_POLE_SHARE = 1.0
"""The same of one pole, whose noise would have ever shorter swings in ever shorter steps."""


@EVENT_MODELS.register
@dataclass(frozen=True)
class CircuitPixel(ThresholdPixel):
    """A pixel of a photodiode, an amplifier with feedback and a source follower, with the shot noise of each.

    Dim pixels are slow and noisy, bright ones fast and quiet, and one event of the noise is followed by one of
    the other sign. The defaults were fitted by others to a measured pulse from 10 fA to 1 pA; here 1 pA is
    white.

    Args:
        threshold_on: Mean contrast threshold of ON events, log units (e-fold), at least 0.01.
        threshold_off: The same for OFF events.
        threshold_sigma: Standard deviation of both thresholds over the pixels, log units; 0 = none.
        photocurrent_a_per_dn: Current of the photodiode per DN of light, ampere; 255 DN make 1 pA.
        dark_current_a: Current in the dark, ampere.
        photodiode_f: C_pd, farad; and so the three that follow.
        feedback_f: C_fb, farad.
        amplifier_f: C_pr, farad.
        follower_f: C_sf, farad.
        amplifier_a: I_pr, ampere.
        follower_a: I_sf, ampere: with `follower_f` the ceiling of the bandwidth, 106 Hz.
        kappa: Slope factor of the transistors, 0 to 1.
        early_v: V_A, volt.
        noise_factor: Factor of all noise voltages; 1 = the shot noise of the currents, 0 = none.
        poles: 3 = the equations; 1 = one time constant for the response and one for the noise, much faster:
            nearly the same events of pixels that are slower than their follower, half the noise of others.
        leak_rate_hz: Rate of the leak's ON events, hertz per pixel.
        refractory_s: Time after an event in which the reference follows the light, seconds.
        initial_phase: "random" = noise and reference of long constant light, so that noise events come as
            often at first as later; "rest" = the reference stands at the settled level.
        pattern_seed: Seed of the thresholds: one sensor for all recordings; None = a new one for each.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> [round(CircuitPixel().noise_rms(current), 3) for current in (1e-14, 1e-12)]
        [0.039, 0.011]
    """

    threshold_on: float = 0.2
    """Mean contrast threshold of ON events, log units (e-fold)."""
    threshold_off: float = 0.2
    """Mean contrast threshold of OFF events, log units (e-fold)."""
    threshold_sigma: float = 0.02
    """Standard deviation of both thresholds over the pixels, log units; 0 = none."""
    photocurrent_a_per_dn: float = 3.92e-15
    """Current of the photodiode per DN of light, ampere."""
    dark_current_a: float = 1e-15
    """Current in the dark, ampere."""
    photodiode_f: float = 71.5e-15
    """Capacitance of the photodiode, farad."""
    feedback_f: float = 0.87e-15
    """Capacitance of the feedback, farad."""
    amplifier_f: float = 23.7e-15
    """Capacitance at the amplifier's output, farad."""
    follower_f: float = 581e-15
    """Capacitance at the follower's output, farad."""
    amplifier_a: float = 3e-9
    """Current of the amplifier, ampere."""
    follower_a: float = 10e-12
    """Current of the follower, ampere."""
    kappa: float = 0.7
    """Slope factor of the transistors, 0 to 1."""
    early_v: float = 3.0
    """Early voltage of the amplifier, volt."""
    noise_factor: float = 1.0
    """Factor of all noise voltages; 1 = the shot noise of the currents, 0 = none."""
    poles: Literal[3, 1] = 3
    """3 = the equations; 1 = one time constant for the response and one for the noise."""
    leak_rate_hz: float = 0.1
    """Rate of the leak's ON events, hertz per pixel."""
    refractory_s: float = 0.0
    """Time after an event in which the reference follows the light, seconds."""
    initial_phase: Phase = "random"
    """First state of the reference: random = that of long constant light, rest = at the settled level."""
    pattern_seed: int | None = None
    """Seed of the thresholds: one sensor for all recordings; None = a new one for each."""
    kind: Literal["circuit"] = "circuit"
    """The event model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("photocurrent_a_per_dn", "dark_current_a", "amplifier_a", "follower_a"):
            require(self, name, 1e-21, 1.0, "ampere")
        for name in ("photodiode_f", "feedback_f", "amplifier_f", "follower_f"):
            require(self, name, 1e-18, 1.0, "farad")
        require(self, "kappa", 0.1, 1.0, "(no unit)")
        require(self, "early_v", 0.1, 1e3, "volt")
        require(self, "noise_factor", 0.0, 100.0, "(no unit); 0 switches the noise off")
        if self.poles not in (3, 1):
            raise ConfigError(f"poles is {self.poles!r}; give 3 or 1")
        require(self, "leak_rate_hz", 0.0, math.inf, "hertz; 0 switches it off")
        require(self, "refractory_s", 0.0, math.inf, "seconds; 0 switches it off")
        check_phase(self.initial_phase)
        check_pattern_seed(self.pattern_seed)

    def matrices(self, current_a: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return the equations x' = M (x - c ln(I / I_start)) + noise, voltages in log units of light.

        Args:
            current_a: Currents I, ampere [L].

        Returns:
            M per second [L, 3, 3], c [3], and the noise's covariance per second [L, 3, 3]; the rows are
            photodiode, amplifier, follower.
        """
        current = np.atleast_1d(np.asarray(current_a, np.float64))
        gs = current / _THERMAL_V
        ga, load = self.kappa * self.amplifier_a / _THERMAL_V, 2.0 * self.amplifier_a / self.early_v
        gain = ga / load * self.kappa
        unit = _THERMAL_V / self.kappa * gain / (1.0 + gain)  # volt per log unit at the amplifier
        capacity = np.array(
            [
                [self.photodiode_f + self.feedback_f, -self.feedback_f],
                [-self.feedback_f, self.amplifier_f + self.feedback_f],
            ]
        )
        inverse = np.linalg.inv(capacity)
        conductance = np.zeros((len(current), 2, 2))
        conductance[:, 0, 0], conductance[:, 0, 1] = gs, -self.kappa * gs
        conductance[:, 1, 0], conductance[:, 1, 1] = ga, load
        follow = self.follower_a / (_THERMAL_V * self.follower_f)
        m = np.zeros((len(current), 3, 3))
        m[:, :2, :2] = -inverse @ conductance
        m[:, 2, 1], m[:, 2, 2] = follow, -follow
        charge = np.zeros((len(current), 2, 2))
        charge[:, 0, 0] = 2.0 * _CHARGE * current
        charge[:, 1, 1] = 2.0 * _CHARGE * self.amplifier_a
        noise = np.zeros((len(current), 3, 3))
        noise[:, :2, :2] = inverse @ charge @ inverse.T / unit**2
        noise[:, 2, 2] = 2.0 * _CHARGE * self.follower_a / (self.follower_f * self.kappa * unit) ** 2
        return m, np.array([-load / ga, 1.0, 1.0]), self.noise_factor**2 * noise

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw:
        """Return what an event says of the light; noise and bandwidth are those at the light `light_dn`."""
        current = self.dark_current_a + self.photocurrent_a_per_dn * light_dn
        rms, corner = self.noise_rms(current), self.bandwidth_hz(current)
        ahead = noise_lead(rms, 1.0 / (2.0 * math.pi * corner))
        # one bandwidth at all light
        return self._law(noise=math.sqrt(2.0) * rms, ahead=ahead, cutoff_hz=corner, floor_dn=1e9)

    def noise_rms(self, current_a: float) -> float:
        """Return the standard deviation of the follower's noise, log units, at a current in ampere."""
        m, _, noise = self.matrices(np.array([current_a]))
        return math.sqrt(stationary(m, noise)[0, 2, 2])

    def bandwidth_hz(self, current_a: float) -> float:
        """Return the frequency at which a small change of light is damped to 1 / sqrt(2), hertz."""
        m, rest, _ = self.matrices(np.array([current_a]))

        def gain(hertz: float) -> float:
            pulse = 2j * math.pi * hertz * np.eye(3)
            return float(abs(np.linalg.solve(pulse - m[0], -m[0] @ rest)[2]))

        low, high = 1e-6, 1e9
        while high / low > 1 + 1e-6:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if gain(middle) > math.sqrt(0.5) else (low, middle)
        return low

    @property
    def log_curve(self) -> LogCurve:
        """The logarithm of light over dark current, which lies above the knee throughout."""
        return LogCurve(40.0 * self.photocurrent_a_per_dn / self.dark_current_a, 40.0)

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
        return CircuitArray(self, shape, seed, thresholds, 1024 if tile_px is None else tile_px, threads)


class CircuitArray(TiledArray):
    """An array of `CircuitPixel`s."""

    def __init__(
        self,
        settings: CircuitPixel,
        shape: tuple[int, int],
        seed: int,
        thresholds: object = None,
        tile_px: int = 1024,
        threads: int | None = None,
    ) -> None:
        self.settings = settings
        self._tile_px, self._threads = check_tiling(tile_px, threads)
        on, off = pixel_thresholds(settings, shape, seed, thresholds)
        top = math.log(settings.amplifier_a / _RANGE / settings.dark_current_a)
        self._pixel = Pixel(
            on,
            off,
            settings.photocurrent_a_per_dn / settings.dark_current_a,
            top,
            float(settings.threshold_on * settings.leak_rate_hz),
            float(settings.refractory_s),
            np.uint64(seed),
        )
        levels = LEVEL * np.arange(int(top / LEVEL) + 2)
        self._m, self._rest, noise = settings.matrices(settings.dark_current_a * np.exp(levels))
        self._covariance = stationary(self._m, noise)
        self._lag, whole = -np.linalg.solve(self._m, self._rest[:, None])[:, 2, 0], self._covariance[:, 2, 2]
        memory = -np.linalg.solve(self._m, self._covariance)[:, 2, 2] / np.maximum(whole, 1e-300)
        self._memory = np.where(whole > 0, memory, self._lag)  # of the noise
        share = _STEP_SHARE if settings.poles == 3 else _POLE_SHARE
        self._longest = share * _THERMAL_V * settings.follower_f / settings.follower_a
        self._tables: dict[float, Table | Pole] = {}

    def _table(self, h: float) -> Table | Pole:
        """Return one step of h seconds; kept, as most steps are alike."""
        key = float(f"{h:.9g}")
        if key not in self._tables:
            if len(self._tables) > 64:
                self._tables.clear()
            self._tables[key] = self._steps(key) if self.settings.poles == 3 else self._pole(key)
        return self._tables[key]

    def _steps(self, h: float) -> Table:
        """Return one step of the three equations."""
        decay = torch.matrix_exp(torch.from_numpy(self._m * h)).numpy()
        push = np.linalg.solve(self._m, (decay - np.eye(3)) @ self._rest[:, None])[..., 0] / h
        noise = self._covariance - decay @ self._covariance @ decay.transpose(0, 2, 1)
        parts = decay, push, factor_of(noise), factor_of(self._covariance)
        return Table(*(np.ascontiguousarray(part, dtype=np.float64) for part in parts))

    def _pole(self, h: float) -> Pole:
        """Return one step with one time constant each for response and noise."""
        lag, memory = self._lag, self._memory
        kick = np.sqrt(-np.expm1(-2 * h / memory) * self._covariance[:, 2, 2])
        return Pole(np.exp(-h / lag), -lag * np.expm1(-h / lag) / h, np.exp(-h / memory), kick)

    def _crossings(self) -> NDArray[np.float64]:
        """Return how often the follower's noise crosses its mean upwards, as steps see it, per second [L]."""
        h, alike = self._longest, np.exp(-self._longest / self._memory)
        if self.settings.poles == 3 and self._covariance.any():
            decay = torch.matrix_exp(torch.from_numpy(self._m * h)).numpy()
            alike = np.einsum("lj,lj->l", decay[:, 2], self._covariance[:, 2]) / self._covariance[:, 2, 2]
        return np.arccos(alike) / (2 * math.pi * h)

    def start(self, frame: NDArray, time_s: float) -> None:
        """Let all pixels have settled to the first light, DN [N], their noise in its stationary state."""
        count, pixel, above = len(frame), self._pixel, np.zeros(len(frame))
        x = np.minimum(np.log1p(pixel.factor * frame.astype(np.float64)), pixel.top)
        level = np.rint(x / LEVEL).astype(np.int64)
        normal = normal_field(pixel.seed, STREAM_CIRCUIT_START, 3 * count).reshape(count, 3)
        noise = np.einsum("nij,nj->ni", factor_of(self._covariance)[level], normal)
        if self.settings.initial_phase == "random":
            rms, rate = np.sqrt(self._covariance[level, 2, 2]), self._crossings()[level]
            seen = noise[:, 2].copy(), rms, self._memory[level], rate, pixel.seed, passage_times(), above
            settled_reference(pixel.on, pixel.off, pixel.leak, pixel.refractory, *seen)
        rest = np.full(count, -np.inf), np.zeros(count, np.uint32), np.zeros(count, np.int64)
        self._state = State(x, np.zeros((count, 3)), noise, x + above, *rest)
        self._time = time_s

    def _run(self, times: NDArray[np.float64]) -> Callable[..., Columns]:
        lengths = np.diff(times)
        steps = np.maximum(1, np.ceil(lengths / self._longest - 1e-9)).astype(np.int64)
        keys = [float(f"{h:.9g}") for h in lengths / steps]
        distinct = list(dict.fromkeys(keys))
        tables = [self._table(key) for key in distinct]
        stacked = type(tables[0])(*map(np.stack, zip(*tables, strict=True)))
        which = np.array([distinct.index(key) for key in keys])
        what = self._state, stacked, which, self._pixel
        if self.settings.poles == 3:
            return lambda frames, origin, first, last: run_frames(
                frames, origin, times, steps, first, last, *what
            )
        return lambda frames, origin, first, last: run_poles(
            frames, origin, times, steps, first, last, self._tile_px, *what
        )
