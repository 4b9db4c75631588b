"""A photoreceptor with currents: bandwidth and noise follow from the light (the model of Graca and Delbruck).

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
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.sensor._circuit import LEVEL, Pixel, State, Table, factor_of, run_frames, stationary
from evnlos.sensor._order import Columns, joined, sort_times
from evnlos.sensor._random import (
    STREAM_CIRCUIT_START,
    STREAM_LEAK_PHASE,
    normal_field,
    uniform_field,
)
from evnlos.sensor._tiles import check_tiling, map_shares, pixel_thresholds
from evnlos.sensor.event_model import (
    EVENT_MODELS,
    EventModel,
    LogCurve,
    Phase,
    ThresholdPixel,
    check_pattern_seed,
    check_phase,
    require,
)
from evnlos.sensor.light import Light

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
        leak_rate_hz: Rate of the leak's ON events, hertz a pixel.
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
    """Rate of the leak's ON events, hertz a pixel."""
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
