"""The photoreceptor with currents: settings, array and kernels.

- The kernels of the photoreceptor with currents: its state carried from threshold to threshold, exactly.

A photoreceptor with currents: bandwidth and noise follow from the light (the model of Graca and Delbruck).

With I light and dark current together, q the charge of an electron, U = kT/q, gs = I / U, gm = kappa gs,
ga = kappa I_pr / U, R = V_A / (2 I_pr), A = ga R kappa, three voltages obey

    (C_pd + C_fb) v_pd' - C_fb v_pr' + gs v_pd - gm v_pr = -gm (1 + A) / A V + n_pd
    -C_fb v_pd' + (C_pr + C_fb) v_pr' + ga v_pd + v_pr / R = n_pr
    C_sf v_sf' = (I_sf / U) (kappa v_pr - v_sf) + n_sf
    V = (U / kappa) A / (1 + A) ln(I / I_start),  n white with variances 2 q I, 2 q I_pr, 2 q I_sf per second

and a pixel sends an event where v_sf, in log units of light, has moved by a threshold since its last one
(R. Graca and T. Delbruck, arXiv 2304.04706 and 2505.07386). Within a short step I is frozen; what the light
does and what the noise does add, since the equations are linear. Both are advanced exactly, by the matrix
exponential of the step for a table of currents; the noise starts in its stationary state.
"""

from __future__ import annotations

import math
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
    require,
)
from evnlos.cameras.pixels.arrays import check_tiling, map_shares, pixel_thresholds
from evnlos.cameras.random_numbers import (
    STREAM_CIRCUIT,
    STREAM_CIRCUIT_START,
    STREAM_LEAK_PHASE,
    fast_log,
    normal_field,
    random_normals,
    uniform_field,
)
from evnlos.cameras.streams import Columns, Light, grown, joined, sort_times

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


def stationary(m: NDArray, noise: NDArray) -> NDArray[np.float64]:
    """Return P of M P + P M^T + noise = 0, [L, 3, 3]: the covariance of what settles."""
    one = np.eye(3)
    system = np.einsum("lij,kn->likjn", m, one) + np.einsum("ij,lkn->likjn", one, m)
    return np.linalg.solve(system.reshape(-1, 9, 9), -noise.reshape(-1, 9, 1)).reshape(-1, 3, 3)


def factor_of(covariance: NDArray) -> NDArray[np.float64]:
    """Return lower-triangular factors of covariances, zero where they are."""
    if not covariance.any():
        return np.zeros_like(covariance)
    scale = np.sqrt(np.einsum("lii->li", covariance))
    correlation = covariance / scale[:, :, None] / scale[:, None, :]
    return scale[:, :, None] * np.linalg.cholesky(correlation + 1e-12 * np.eye(3))


@njit(cache=True, error_model="numpy", inline="always")
def apply(matrix, vector, i, add, scale):
    """Replace row i of `vector` by matrix @ row + scale * add."""
    a, b, c = vector[i, 0], vector[i, 1], vector[i, 2]
    for n in range(3):
        vector[i, n] = matrix[n, 0] * a + matrix[n, 1] * b + matrix[n, 2] * c + scale * add[n]


@njit(cache=True, error_model="numpy")
def normals(seed, stream, pixel, counter, factor, out):
    """Fill `out` [3] with normal numbers of the covariance factor factor^T."""
    a, b = random_normals(seed, stream, pixel, counter)
    c, _ = random_normals(seed, stream, pixel, counter + 1)
    out[0] = factor[0, 0] * a
    out[1] = factor[1, 0] * a + factor[1, 1] * b
    out[2] = factor[2, 0] * a + factor[2, 1] * b + factor[2, 2] * c


@njit(cache=True, error_model="numpy")
def catch_up(i, level, state, table, pixel, kick):
    """Bring a pixel's noise up to date: step by step, or drawn anew where it has forgotten."""
    if state.stale[i] > _FORGOTTEN:
        normals(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.settled[level], kick)
        state.drawn[i] += np.uint32(2)
        for n in range(3):
            state.noise[i, n] = kick[n]
    else:
        for _ in range(state.stale[i]):
            normals(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.kick[level], kick)
            state.drawn[i] += np.uint32(2)
            apply(table.decay[level], state.noise, i, kick, 1.0)
    state.stale[i] = 0


@njit(cache=True, error_model="numpy")
def run_interval(out, count, i, start, length, steps, x1, state, table, pixel, kick):
    """Advance one pixel by `steps` steps of log light, a line to x1; return the columns and their fill."""
    x0, h = state.x[i], length / steps
    change = (x1 - x0) / steps
    top = len(table.decay) - 1
    middle = min(int(0.5 * (x0 + x1) / LEVEL + 0.5), top)
    rms = 0.0
    for n in range(3):
        rms += table.settled[middle, 2, n] ** 2
    margin = _SAFE * math.sqrt(rms)
    deaf = state.deaf[i] > start
    # without its noise: how far does the response go, and can it come near a threshold?
    if not deaf:
        lift = x0 + state.lag[i, 2] - state.reference[i]
        reach = max(abs(state.lag[i, 0]), abs(state.lag[i, 1]), abs(state.lag[i, 2])) + abs(x1 - x0)
        reach += pixel.leak * length + margin
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
        normals(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.kick[level], kick)
        state.drawn[i] += np.uint32(2)
        apply(table.decay[level], state.noise, i, kick, 1.0)
        now = x0 + (k + 1) * change + state.lag[i, 2] + state.noise[i, 2]
        state.reference[i] -= pixel.leak * h
        at = start + k * h
        if state.deaf[i] > at:
            if state.deaf[i] >= at + h:
                state.reference[i] = now
                before = now
                continue
            share = (state.deaf[i] - at) / h
            before += share * (now - before)
            at, state.reference[i] = state.deaf[i], before
        left = start + (k + 1) * h - at
        while True:
            lift = now - state.reference[i]
            sign = 1 if lift >= pixel.on[i] else (-1 if lift <= -pixel.off[i] else 0)
            if sign == 0:
                break
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
                break
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
        length = times[k + 1] - times[k]
        w = which[k]
        table = Table(tables.decay[w], tables.push[w], tables.kick[w], tables.settled[w])
        for i in range(first, last):
            x1 = min(fast_log(1.0 + pixel.factor * np.float64(frames[k, i - origin])), pixel.top)
            out, count = run_interval(out, count, i, times[k], length, steps[k], x1, state, table, pixel, kick)
    return out[0][:count], out[1][:count], out[2][:count]


_CHARGE, _THERMAL_V = 1.602176634e-19, 0.0258
_RANGE = 3.0
"""Currents stay below the amplifier's by this factor: the equations ask for it."""
_STEP_SHARE = 0.1
"""Longest step, in time constants of the follower: between two steps its output counts as a line."""


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
        leak_rate_hz: Rate of the leak's ON events, hertz per pixel.
        refractory_s: Time after an event in which the reference follows the light, seconds.
        initial_phase: "rest" = the reference stands at the settled level, "random" = anywhere between the
            thresholds.
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
    leak_rate_hz: float = 0.1
    """Rate of the leak's ON events, hertz per pixel."""
    refractory_s: float = 0.0
    """Time after an event in which the reference follows the light, seconds."""
    initial_phase: Phase = "rest"
    """First state of the reference: rest = at the settled level, random = anywhere between the thresholds."""
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
        return self._law(
            noise=math.sqrt(2.0) * self.noise_rms(current),
            cutoff_hz=self.bandwidth_hz(current),
            floor_dn=1e9,  # one bandwidth at all light
        )

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


class CircuitArray(EventModel):
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
        current = settings.dark_current_a * np.exp(LEVEL * np.arange(int(top / LEVEL) + 2))
        self._m, self._rest, noise = settings.matrices(current)
        self._covariance = stationary(self._m, noise)
        self._longest = _STEP_SHARE * _THERMAL_V * settings.follower_f / settings.follower_a
        self._tables: dict[float, Table] = {}

    def _table(self, h: float) -> Table:
        """Return one step of h seconds; kept, as most steps are alike."""
        key = float(f"{h:.9g}")
        if key not in self._tables:
            if len(self._tables) > 64:
                self._tables.clear()
            decay = torch.matrix_exp(torch.from_numpy(self._m * key)).numpy()
            push = np.linalg.solve(self._m, (decay - np.eye(3)) @ self._rest[:, None])[..., 0] / key
            noise = self._covariance - decay @ self._covariance @ decay.transpose(0, 2, 1)
            parts = decay, push, factor_of(noise), factor_of(self._covariance)
            self._tables[key] = Table(*(np.ascontiguousarray(part, dtype=np.float64) for part in parts))
        return self._tables[key]

    def start(self, frame: NDArray, time_s: float) -> None:
        """Let all pixels have settled to the first light, DN [N], their noise in its stationary state."""
        count, pixel = len(frame), self._pixel
        x = np.minimum(np.log1p(pixel.factor * frame.astype(np.float64)), pixel.top)
        factor = factor_of(self._covariance)[np.rint(x / LEVEL).astype(np.int64)]
        normal = normal_field(pixel.seed, STREAM_CIRCUIT_START, 3 * count).reshape(count, 3)
        reference = x.copy()
        if self.settings.initial_phase == "random":
            place = uniform_field(pixel.seed, STREAM_LEAK_PHASE, count)
            reference -= place * (pixel.on + pixel.off) - pixel.off
        self._state = State(
            x,
            np.zeros((count, 3)),
            np.einsum("nij,nj->ni", factor, normal),
            reference,
            np.full(count, -np.inf),
            np.zeros(count, np.uint32),
            np.zeros(count, np.int64),
        )
        self._time = time_s

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events in order."""
        times = np.concatenate([[self._time], times_s])
        lengths = np.diff(times)
        steps = np.maximum(1, np.ceil(lengths / self._longest - 1e-9)).astype(np.int64)
        keys = [float(f"{h:.9g}") for h in lengths / steps]
        distinct = list(dict.fromkeys(keys))
        tables = [self._table(key) for key in distinct]
        stacked = Table(*(np.stack([getattr(table, name) for table in tables]) for name in Table._fields))
        which = np.array([distinct.index(key) for key in keys])

        def work(first: int, last: int) -> Columns:
            frames, origin = light.pixels(first, last)
            return run_frames(
                frames, origin, times, steps, first, last, self._state, stacked, which, self._pixel
            )

        tiles = list(map_shares(work, len(self._state.x), self._tile_px, self._threads, light.most_px))
        self._time = float(times_s[-1])
        return sort_times(*joined(tiles))
