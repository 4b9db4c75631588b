"""Fitting an event pixel to recordings under known light: the posterior of its settings, for several models.

With s the means over the pixels of the statistics of `pixel_statistics`, m(u) what a model makes of them on
average, and u its free numbers on a scale on which their range is a standard normal prior,

    log p(u | s) = -1/2 (s - m(u))^T C^-1 (s - m(u)) - 1/2 u^T u,

C from the scatter of the pixels (a synthetic likelihood: Wood, Nature 466, 2010). An ensemble of simulations is
driven towards s by Kalman updates (Iglesias, Law and Stuart, Inverse Problems 29, 2013) whose tolerance falls
from step to step; around what it finds, m is a quadratic polynomial fitted to simulations, each with mismatch
and noise of its own, and the posterior is sampled. Where the model explains s as well as chance allows, C is as
it is; where it explains it worse, C is widened by the excess.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.event_models import Free
from evnlos.calibration.pixel_light import LitRecording
from evnlos.calibration.pixel_statistics import (
    NEAR,
    Array,
    Binning,
    Scale,
    Surface,
    binning_of,
    clipped,
    scale_of,
    simulated_events,
    statistics_of,
    updated,
)
from evnlos.cameras import BrownianPixel, CircuitPixel, EventPixel, PixelSettings
from evnlos.errors import ConfigError, DataError
from evnlos.machine import Progress, Step, silent
from evnlos.types import derive_seed

MISMATCH = "mismatch"
"""Free number of a candidate: standard deviation of the thresholds over the mean of the two."""
_FLOORS = (0.6, 0.2, 0.07, 0.025)  # tolerances of the ensemble's updates, on the scale of the statistics
_LEAST = (0.3, 0.12, 0.05, 0.02, 0.008, 0.004)  # least scatter of the last rounds: wide first
_SHARED = 1.6  # standard deviations of the last simulations within which earlier ones are used again
_NARROWED = 1.7  # mean ratio of their standard deviations to those asked for, above which another round follows
_MAY_BE_NONE = (MISMATCH, "leak_rate_hz", "shot_noise_rate_hz", "leak_rate_per_dn_hz")
_ATTEMPTS = 3
_AT_END = 0.05  # share of the searched range at whose ends the range decides, not the recording
_REPLICATES = 4
_WIDER = 1.6  # errors of v2e's pixel over those of the posterior, of these (benchmarks/pixel_fit_coverage.py)
_WIDENED = ("threshold_on", "threshold_off", "leak_rate_hz", "shot_noise_rate_hz")

_THRESHOLDS = (
    Free("threshold_on", 0.03, 1.5, 0.05),
    Free("threshold_off", 0.03, 1.5, 0.05),
    Free(MISMATCH, 0.003, 0.6, 0.2),
)
_NOISE = Free("shot_noise_rate_hz", 1e-3, 100.0, 0.1)
_LEAK = Free("leak_rate_hz", 1e-3, 20.0, 0.1)
CANDIDATES: dict[str, tuple[PixelSettings, tuple[Free, ...]]] = {
    "continuous": (EventPixel(), (*_THRESHOLDS, Free("cutoff_hz", 1.0, 5000.0, 0.1), _LEAK, _NOISE)),
    "continuous, true logarithm": (
        EventPixel(logarithm="true", dark_dn=1.0, cutoff_floor_dn=1.0),
        (*_THRESHOLDS, Free("cutoff_hz", 1.0, 5000.0, 0.1), _LEAK, _NOISE, Free("dark_dn", 0.02, 60.0, 0.2)),
    ),
    "brownian": (
        BrownianPixel(dark_noise=0.0),
        (
            *_THRESHOLDS,
            Free("dark_dn", 0.2, 100.0, 0.2),
            _LEAK,
            Free("leak_rate_per_dn_hz", 1e-5, 0.3, 0.2),
            Free("photon_noise", 3e-3, 3.0, 0.1),
        ),
    ),
    "circuit": (
        CircuitPixel(poles=1),
        (
            *_THRESHOLDS,
            Free("photocurrent_a_per_dn", 1e-17, 3e-14, 0.2),
            _LEAK,
            Free("noise_factor", 0.2, 5.0, 0.1),
        ),
    ),
}
"""Event models that may be fitted: a start, and the free numbers with the range that is searched."""


@dataclass(frozen=True)
class PixelFitSettings:
    """How a pixel is fitted."""

    models: tuple[str, ...] = tuple(CANDIDATES)
    """Models to fit and compare: continuous; continuous, true logarithm; brownian; circuit (with one pole)."""
    pixels: int = 800
    """Pixels that are fitted; half as many are held out."""
    most_s: float = 30.0
    """What is taken of each recording, seconds from its start."""
    ensemble: int = 20
    """Simulations of each of the four steps of the search."""
    simulations: int = 60
    """Simulations around the result, from which its uncertainty comes."""
    checks: int = 40
    """Simulations of each predictive check."""
    seed: int = 0
    """Seed of every draw."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.models if name not in CANDIDATES]:
            raise ConfigError(f"there is no model {unknown[0]!r} to fit; give some of {', '.join(CANDIDATES)}")
        if not self.models:
            raise ConfigError("no model to fit; give one at least")
        least = {"pixels": 48, "ensemble": 12, "simulations": 30, "checks": 10}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise ConfigError(f"PixelFitSettings.{name} is {getattr(self, name)}; give at least {low}")
        if not self.most_s > 0:
            raise ConfigError(f"PixelFitSettings.most_s is {self.most_s}; give a positive number of seconds")


@dataclass(frozen=True, eq=False)
class Estimate:
    """A number with its uncertainty.

    Args:
        name: Its name.
        value: Median of the posterior.
        low: Its 2.5 % quantile.
        high: Its 97.5 % quantile.
        state: "identified", "at most" (not told from none; `high` bounds it) or "not identified": the interval
            is more than half as wide as the range in which it was looked for, or ends at an end of that.
    """

    name: str
    value: float
    low: float
    high: float
    state: str


@dataclass(frozen=True, eq=False)
class Panels:
    """Recorded statistics of fitted pixels, and how they are taken.

    Args:
        recordings: Light and events.
        binnings: Bins of each recording.
        statistics: Recorded statistics [N, K].
        scale: Scale of their means.
    """

    recordings: tuple[LitRecording, ...]
    binnings: tuple[Binning, ...]
    statistics: Array
    scale: Scale

    def simulate(self, pixel: PixelSettings, seed: int) -> Array:
        """Return the statistics of simulated pixels, [N, K]."""
        events = simulated_events(self.recordings, pixel, seed)
        return statistics_of(self.recordings, self.binnings, events)


@dataclass(frozen=True, eq=False)
class CandidateFit:
    """An event model that was fitted.

    Args:
        name: Name in `CANDIDATES`.
        pixel: The pixel at the median of the posterior; what is not told from none is none.
        start: The settings that were not fitted, the refractory period among them.
        free: What was fitted.
        draws: Posterior draws on the normal scale, [S, P].
        estimates: Each free number, and the standard deviation of the thresholds.
        misfit: Mean squared distance of the statistics from the model's, in standard errors; 1 is chance.
        correlation: Posterior correlation of the free numbers, [P, P].
    """

    name: str
    pixel: PixelSettings
    start: PixelSettings
    free: tuple[Free, ...]
    draws: Array
    estimates: tuple[Estimate, ...]
    misfit: float
    correlation: Array = field(repr=False)

    def drawn(self, index: int) -> PixelSettings:
        """Return the pixel of a posterior draw."""
        return pixel_at(self.start, self.free, self.draws[index % len(self.draws)])


def panels_of(recordings: Sequence[LitRecording], like: Panels | None = None) -> Panels:
    """Return the statistics of recordings; those held out are binned and scaled as those fitted.

    Args:
        recordings: Light and events of pixels.
        like: The fitted pixels, for those held out.

    Raises:
        DataError: The recordings hold too few events to say anything.
    """
    binnings = tuple(binning_of(one) for one in recordings)
    if like is not None:
        binnings = tuple(
            replace(own, intervals_s=other.intervals_s, windows_s=other.windows_s, lag_s=other.lag_s)
            for own, other in zip(binnings, like.binnings, strict=True)
        )
    events = sum(len(one.events) for one in recordings)
    if events < 100:
        raise DataError(f"the chosen pixels hold {events} events; 100 or more are needed: record longer")
    statistics = statistics_of(recordings, binnings, [one.events for one in recordings])
    return Panels(tuple(recordings), binnings, statistics, scale_of(statistics))


def value_of(free: Free, u: NDArray | float) -> Array:
    """Return a free number at normal positions: its range is uniform on its own (logarithmic) scale.

    Args:
        free: The number's range and scale.
        u: Positions, standard normal, any shape.
    """
    share = 0.5 * (1.0 + torch.erf(torch.as_tensor(np.asarray(u, np.float64)) / math.sqrt(2.0)).numpy())
    low, high = (math.log(free.low), math.log(free.high)) if free.log else (free.low, free.high)
    return np.exp(low + share * (high - low)) if free.log else low + share * (high - low)


def pixel_at(start: PixelSettings, free: Sequence[Free], u: Array) -> PixelSettings:
    """Return a pixel whose free numbers stand at normal positions u [P].

    Args:
        start: Settings of the other numbers.
        free: The free numbers, P of them.
        u: Positions, standard normal, [P].
    """
    changes: dict[str, Any] = {one.name: float(value_of(one, u[k])) for k, one in enumerate(free)}
    ratio = changes.pop(MISMATCH, None)
    if ratio is not None:
        changes["threshold_sigma"] = ratio * 0.5 * (changes["threshold_on"] + changes["threshold_off"])
    return replace(start, **changes)  # type: ignore[type-var]


def fit_candidate(
    name: str,
    panels: Panels,
    settings: PixelFitSettings,
    refractory_s: float = 0.0,
    progress: Progress = silent,
) -> CandidateFit:
    """Fit one event model.

    Args:
        name: Name in `CANDIDATES`.
        panels: Recorded statistics.
        settings: How to fit.
        refractory_s: Dead time of the pixels, seconds, for models that have one.
        progress: Called after each simulation.
    """
    start, free = CANDIDATES[name][0], within_reach(CANDIDATES[name][1], panels)
    if hasattr(start, "refractory_s"):
        start = replace(start, refractory_s=refractory_s)  # type: ignore[type-var]
    search = _Search(name, panels, settings, start, free, progress)
    found: list[tuple[float, Array]] = []
    while len(found) < _ATTEMPTS:
        draws, distance = search.attempt(len(found))
        # Simulations there judge, too: the polynomial of a poor place is poor, and excuses more.
        found.append((search.misfit(draws.mean(axis=0)), draws))
        if distance <= 1.0 and found[-1][0] <= 1.0:  # else it may have ended beside the likeliest place
            break
    misfit, draws = min(found, key=lambda one: one[0])
    wide = [_WIDER if isinstance(start, EventPixel) and one.name in _WIDENED else 1.0 for one in free]
    estimates = tuple(_estimate(one, draws[:, k], wide[k]) for k, one in enumerate(free))
    pixel = pixel_at(start, free, np.median(draws, axis=0))
    for one in estimates:
        if one.state == "at most" and one.name in _MAY_BE_NONE[1:]:
            pixel = replace(pixel, **{one.name: 0.0})  # type: ignore[type-var]
    pixel = replace(pixel, initial_phase="random")  # type: ignore[type-var]  # as all that it is compared with
    on, off, ratio = (value_of(one, draws[:, k]) for k, one in enumerate(free[:3]))
    low, middle, high = (float(q) for q in np.quantile(ratio * 0.5 * (on + off), (0.025, 0.5, 0.975)))
    state = next((one.state for one in estimates[:2] if one.state != "identified"), estimates[2].state)
    estimates += (Estimate("threshold_sigma", middle, low, high, state),)
    return CandidateFit(name, pixel, start, free, draws, estimates, misfit, np.asarray(np.corrcoef(draws.T)))


class _Search:
    """Attempts to find the posterior of a model: an ensemble to come near, polynomials to be exact."""

    def __init__(
        self,
        name: str,
        panels: Panels,
        settings: PixelFitSettings,
        start: PixelSettings,
        free: Sequence[Free],
        progress: Progress,
    ) -> None:
        self._name, self._panels, self._settings = name, panels, settings
        self._pixel, self._size, self._progress = partial(pixel_at, start, free), len(free), progress
        self._target = panels.scale.of(panels.statistics)
        self._seed = derive_seed(settings.seed, "pixel fit", name)
        self._done = self._total = 0

    def _means(self, u: Array) -> Array:
        """Return the scaled means of simulations at positions [M, P], [M, K]."""
        found = []
        for one in u:
            seed = derive_seed(self._seed, "simulation", self._done)
            found.append(self._panels.scale.of(self._panels.simulate(self._pixel(one), seed)))
            self._done += 1
            self._progress(Step(f"fit {self._name}", self._done, self._total, "simulations"))
        return np.stack(found)

    def attempt(self, number: int) -> tuple[Array, float]:
        """Return posterior draws [S, P], and how far the recording is from the polynomial at the likeliest.

        That distance is counted in those of the simulations. At the right place it is below 1: the recording is
        one more such draw, and the free numbers were fitted to it.
        """
        panels, settings, target, size = self._panels, self._settings, self._target, self._size
        draw = np.random.default_rng(derive_seed(self._seed, "attempt", number))
        self._total += len(_FLOORS) * settings.ensemble + len(_LEAST) * settings.simulations
        self._progress(Step(f"fit {self._name}", self._done, self._total, "simulations"))
        own = panels.scale.covariance(panels.statistics, panels.statistics.mean(axis=0))
        ensemble = 0.9 * draw.standard_normal((settings.ensemble, size))
        for floor in _FLOORS:
            error = own + floor**2 * np.eye(len(target))
            ensemble = updated(ensemble, self._means(ensemble), target, error, draw)
        centre, spread = ensemble.mean(axis=0), np.cov(ensemble.T) + 0.05**2 * np.eye(size)
        draws, distance = ensemble, math.inf
        tried, seen = np.zeros((0, size)), np.zeros((0, len(target)))
        for least in _LEAST:
            scatter = clipped(NEAR**2 * spread, least, 0.7)
            root = np.linalg.cholesky(scatter)
            design = np.clip(centre + draw.standard_normal((settings.simulations, size)) @ root.T, -3.2, 3.2)
            tried, seen = np.concatenate([tried, design]), np.concatenate([seen, self._means(design)])
            away = np.linalg.solve(root, (tried - centre).T)
            near = (away**2).sum(axis=0) < _SHARED**2 * size  # those of earlier rounds, too
            covariance = _covariance(panels, self._pixel(centre), self._seed)[0]
            draws, distance = Surface.fitted(tried[near], seen[near], centre, scatter).posterior(
                target, covariance, draw
            )
            before, centre, spread = centre, draws.mean(axis=0), np.cov(draws.T)
            shift = (centre - before) @ np.linalg.solve(scatter, centre - before)
            narrowed = np.linalg.slogdet(scatter)[1] - np.linalg.slogdet(NEAR**2 * spread)[1]
            if shift < 0.5 * size and narrowed < 2.0 * size * math.log(_NARROWED):
                break
        self._progress(Step(f"fit {self._name}", self._total, self._total, "simulations"))
        return draws, distance

    def misfit(self, u: Array) -> float:
        """Return the mean squared distance of the statistics from simulations at u, in standard errors."""
        covariance, expected = _covariance(self._panels, self._pixel(u), derive_seed(self._seed, "misfit"))
        miss = self._target - self._panels.scale.of(expected)
        return float(np.mean(miss**2 / (np.diag(covariance) * (1.0 + 1.0 / _REPLICATES))))


def within_reach(free: Sequence[Free], panels: Panels) -> tuple[Free, ...]:
    """Return free numbers whose noise rates stay within ten times the highest rate that a recording has."""
    rate = max(len(one.events) / len(panels.statistics) / float(one.times_s[-1]) for one in panels.recordings)
    most = {"shot_noise_rate_hz": 10 * rate, "leak_rate_hz": 3 * rate}
    return tuple(
        replace(one, high=min(one.high, max(most[one.name], 20 * one.low))) if one.name in most else one
        for one in free
    )


def _covariance(panels: Panels, pixel: PixelSettings, seed: int) -> tuple[Array, Array]:
    """Return the covariance of the recorded means about what a model expects of each pixel, and that."""
    made = [panels.simulate(pixel, derive_seed(seed, "covariance", k)) for k in range(_REPLICATES)]
    expected = np.mean(made, axis=0)
    about = panels.statistics.mean(axis=0)
    recorded = panels.scale.covariance(panels.statistics - expected, about)
    model = np.mean([panels.scale.covariance(one - expected, about) for one in made], axis=0)
    # Differences from a mean of R draws hold (R + 1) / R, or (R - 1) / R, of the variance of one.
    half = 0.5 * recorded * _REPLICATES / (_REPLICATES + 1) + 0.5 * model * _REPLICATES / (_REPLICATES - 1)
    least = np.diag((0.1 * panels.scale.unit / np.sqrt(about**2 + panels.scale.unit**2)) ** 2)
    return half + least, expected


def _estimate(free: Free, draws: Array, wider: float = 1.0) -> Estimate:
    low, middle, high = np.quantile(draws, (0.025, 0.5, 0.975))
    low, high = middle - wider * (middle - low), middle + wider * (high - middle)
    shares = [NormalDist().cdf(float(u)) for u in (low, high)]
    state = "identified"
    at_low, at_high = shares[0] < _AT_END, shares[1] > 1.0 - _AT_END
    if shares[1] - shares[0] > 0.5 or at_high or (at_low and free.name not in _MAY_BE_NONE):
        state = "not identified"
    elif at_low:
        state = "at most"
    value, least, most = (float(value_of(free, u)) for u in (middle, low, high))
    return Estimate(free.name, value, least, most, state)
