"""What a recording says of each pixel, in numbers, and the posterior of a few settings given these numbers.

Pixels do not see each other. Given the light, the numbers of one pixel are a draw that owes nothing to those of
another, mismatch included, so their scatter over the pixels is the covariance of their mean. That makes the
likelihood of the mean (a synthetic likelihood, Wood, Nature 466, 2010) without a formula for the pixel.

The posterior is found from simulations: ensemble Kalman updates drive a cloud of positions towards what was
observed, a quadratic polynomial stands for the simulation around the result, and a random walk draws from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.event_statistics import by_pixel, intervals, simulated
from evnlos.calibration.pixel_light import LitRecording
from evnlos.cameras import PixelSettings
from evnlos.types import Events, derive_seed

Array = NDArray[np.floating[Any]]

_QUANTILES = (0.02, 0.15, 0.5, 0.85)  # of the intervals, between which they are counted
_SWINGS = (0.15, 0.6)  # ranges of log light between pixels at rest, moving, and moving much
_FEWEST_PX = 24  # pixels of a class
_SCALE = 3.0  # standard deviations of a mean up to which it is taken as it is, and beyond by its logarithm


@dataclass(frozen=True, eq=False)
class Binning:
    """How the numbers of one recording are taken, the same for recorded and simulated events.

    Args:
        intervals_s: Edges of the interval bins, seconds.
        groups: Group of each pixel by light and motion, int [N].
        group_count: Number of groups.
        windows_s: With an edge: edges of the times around its passage, seconds.
        lag_s: With frames: how much earlier the light is looked at for the second time, seconds.
    """

    intervals_s: Array
    groups: NDArray[np.int64]
    group_count: int
    windows_s: Array
    lag_s: float


def binning_of(recording: LitRecording) -> Binning:
    """Choose bins from a recording's own events and light."""
    pixels = recording.light.shape[2]
    index, t_us, on = by_pixel(recording.events, recording.settled_us)
    time_s, gaps = t_us * 1e-6, intervals(index, t_us, on)[1] * 1e-6
    edges = np.unique(np.quantile(gaps, _QUANTILES)) if len(gaps) >= 50 else np.zeros(0)
    groups, windows, lag = np.zeros(pixels, np.int64), np.zeros(0), 0.0
    if recording.known.kind == "edge":
        passed = _passage(recording, index, time_s, on)
        windows = np.unique(np.quantile(passed, (0.1, 0.3, 0.5, 0.7, 0.9))) if len(passed) >= 20 else windows
    if recording.known.kind == "frames":
        light = recording.light[:, 0]
        swing = np.ptp(np.log(np.maximum(light, 1e-3)), axis=0)
        motion = np.digitize(swing, _SWINGS)
        mean = light.mean(axis=0)
        for kind in range(len(_SWINGS) + 1):
            here = motion == kind
            if here.any():
                groups[here] = 2 * kind + (mean[here] > np.median(mean[here]))
        _, groups, counts = np.unique(groups, return_inverse=True, return_counts=True)
        if counts.min() < _FEWEST_PX:
            groups = np.where(np.isin(groups, np.flatnonzero(counts < _FEWEST_PX)), counts.argmax(), groups)
            groups = np.unique(groups, return_inverse=True)[1]
        lag = 2.0 * float(np.median(np.diff(recording.times_s)))
    return Binning(edges, groups, int(groups.max()) + 1, windows, lag)


def statistics_of(
    recordings: Sequence[LitRecording], binnings: Sequence[Binning], events: Sequence[Events]
) -> Array:
    """Return numbers of each pixel, [N, K]: K grows with the recordings and their groups of pixels.

    Of each recording: counts of ON and OFF events, their roots and the root of their product (the roots' means
    tell how counts scatter, so mismatch); pairs of successive events of unlike sign; intervals in bins; and
    when the events come: under a sine or square wave two harmonics of each polarity, with an edge the time
    around its passage, with frames the log light then and a little earlier.

    Args:
        recordings: Light of the pixels, and the instants that count.
        binnings: Bins of each recording.
        events: Recorded or simulated events of each.
    """
    blocks = []
    for recording, binning, found in zip(recordings, binnings, events, strict=True):
        block = _block(recording, binning, found)
        if binning.group_count > 1:
            block = _by_group(block, binning)
        blocks.append(block)
    return np.concatenate(blocks, axis=1)


def _by_group(block: Array, binning: Binning) -> Array:
    pixels, width = block.shape
    wide = np.zeros((pixels, binning.group_count, width))
    share = np.bincount(binning.groups, minlength=binning.group_count) / pixels
    wide[np.arange(pixels), binning.groups] = block / share[binning.groups, None]
    return wide.reshape(pixels, -1)


def _block(recording: LitRecording, binning: Binning, events: Events) -> Array:
    pixels = recording.light.shape[2]
    index, t_us, on = by_pixel(events, recording.settled_us)
    time_s = t_us * 1e-6
    count_on = np.bincount(index[on], minlength=pixels).astype(np.float64)
    count_off = np.bincount(index[~on], minlength=pixels).astype(np.float64)
    columns = [count_on, count_off, np.sqrt(count_on), np.sqrt(count_off), np.sqrt(count_on * count_off)]
    where, gaps_us, unlike = intervals(index, t_us, on)
    columns.append(np.bincount(where[unlike], minlength=pixels))
    if len(binning.intervals_s):
        place = np.digitize(gaps_us * 1e-6, binning.intervals_s)
        bins = len(binning.intervals_s) + 1
        columns += list(np.bincount(where * bins + place, minlength=pixels * bins).reshape(pixels, bins).T[:-1])
    marks = [
        np.bincount(index[chosen], mark[chosen], minlength=pixels).astype(np.float64)
        for mark in _marks(recording, binning, index, time_s, on)
        for chosen in (on, ~on)
    ]
    columns += _with_common_phase(marks) if recording.known.kind in ("sine", "square") else list(marks)
    return np.stack(columns, axis=1).astype(np.float64)


def _marks(
    recording: LitRecording, binning: Binning, index: NDArray[np.int64], time_s: Array, on: NDArray[np.bool_]
) -> list[Array]:
    """Return what each event says of its time, [E] each."""
    known = recording.known
    if known.kind in ("sine", "square") and len(index):
        phase = 2.0 * math.pi * known.frequency_hz * time_s
        # When the modulation began is not known: phases count from that of all events together.
        phase = phase - np.angle((np.where(on, 1.0, -1.0) * np.exp(1j * phase)).sum())
        return [np.cos(phase), np.sin(phase), np.cos(2 * phase), np.sin(2 * phase)]
    if known.kind in ("sine", "square"):
        return [np.zeros(0)] * 4
    if known.kind == "edge" and len(binning.windows_s):
        place = np.digitize(_passage(recording, index, time_s, on), binning.windows_s)
        return [(place == k).astype(np.float64) for k in range(len(binning.windows_s))]
    if known.kind == "frames":
        light = np.log(recording.light[:, 0].astype(np.float64) + 1.0)
        light -= light.mean(axis=0)
        return [_at(light, recording.times_s, time_s - lag, index) for lag in (0.0, binning.lag_s)]
    return []


def _with_common_phase(harmonics: Sequence[Array]) -> list[Array]:
    """Return harmonics of ON and OFF events, [N] each, that scatter as they do with a phase of all pixels.

    A pixel's sine turns the common phase a little, and with it the harmonics of all: to first order each pixel
    adds its share of that turn. The shares sum to zero, so the means stay as they are.

    Args:
        harmonics: cos of ON, of OFF, sin of ON, of OFF, and the four of the double phase.
    """
    cos_on, cos_off, sin_on, sin_off, *double = harmonics
    turn = (sin_on - sin_off) / max(float((cos_on - cos_off).mean()), 1e-9)
    cos_2on, cos_2off, sin_2on, sin_2off = double
    along = (sin_on, sin_off, -cos_on, -cos_off, 2 * sin_2on, 2 * sin_2off, -2 * cos_2on, -2 * cos_2off)
    return [one + change.mean() * turn for one, change in zip(harmonics, along, strict=True)]


def _passage(recording: LitRecording, index: NDArray[np.int64], time_s: Array, on: NDArray[np.bool_]) -> Array:
    """Return the times since the edge passed, seconds; zero is the median of the events of its sign."""
    assert recording.crossing_s is not None
    passed = time_s - recording.crossing_s[index]
    sign = on == (recording.known.ratio > 1)
    if not sign.any():
        return passed
    low, high = np.quantile(passed[sign], (0.25, 0.75))
    near = sign & (passed >= low) & (passed <= high)
    return passed - float(np.median(passed[near]))


def _at(values: Array, times: Array, instants: Array, place: NDArray[np.int64]) -> Array:
    """Return values [T, N] of pixels `place` [E] at `instants` [E], on lines between the times [T]."""
    after = np.clip(np.searchsorted(times, instants, "left"), 1, len(times) - 1)
    share = np.clip((instants - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0)
    return values[after - 1, place] * (1.0 - share) + values[after, place] * share


@dataclass(frozen=True, eq=False)
class Scale:
    """How means become numbers in which a fit is nearly linear: asinh(mean / unit).

    Args:
        unit: [K].
    """

    unit: Array

    def of(self, statistics: Array) -> Array:
        """Return the scaled means of the statistics of pixels [N, K], float64 [K]."""
        return np.arcsinh(statistics.mean(axis=0) / self.unit)

    def covariance(self, statistics: Array, about: Array) -> Array:
        """Return the covariance of scaled means [K, K], from the scatter of pixels [N, K].

        Args:
            statistics: Of each pixel, or their differences from what was expected of it.
            about: Means at which the scale is taken, [K].
        """
        slope = 1.0 / np.sqrt(about**2 + self.unit**2)
        deviation = (statistics - statistics.mean(axis=0)) * slope
        return deviation.T @ deviation / (len(statistics) - 1) / len(statistics)


def scale_of(statistics: Array) -> Scale:
    """Return the scale for the recorded statistics of pixels, [N, K]."""
    pixels = len(statistics)
    error = statistics.std(axis=0) / math.sqrt(pixels)
    return Scale(_SCALE * np.maximum(error, 1.0 / pixels))


def simulated_events(recordings: Sequence[LitRecording], pixel: PixelSettings, seed: int) -> list[Events]:
    """Return simulated events of one sensor: its mismatch is the same in all recordings.

    Args:
        recordings: Light of the pixels.
        pixel: Their settings; they have long seen the first light.
        seed: Seed of mismatch and noise.
    """
    settled = {"pattern_seed": derive_seed(seed, "sensor"), "initial_phase": "random"}
    sensor: PixelSettings = replace(pixel, **settled)  # type: ignore[type-var]
    return simulated(recordings, sensor, seed)


NEAR = 1.5
"""Standard deviations of the posterior by which the last simulations scatter."""
_REACH = 3.0  # standard deviations of these simulations beyond which the polynomial is not believed
_CHAINS, _SWEEPS = 64, 240
_KEPT = 2048  # posterior draws


def updated(ensemble: Array, made: Array, target: Array, error: Array, draw: np.random.Generator) -> Array:
    """Return an ensemble after a Kalman update towards the target."""
    u, z = ensemble - ensemble.mean(axis=0), made - made.mean(axis=0)
    gain = np.linalg.solve(z.T @ z / (len(u) - 1) + error, z.T @ u / (len(u) - 1)).T
    noise = draw.standard_normal(made.shape) @ np.linalg.cholesky(error).T
    after = ensemble + (target + noise - made) @ gain.T
    spread = after.std(axis=0)
    after = after.mean(axis=0) + (after - after.mean(axis=0)) * np.maximum(1.0, 0.06 / np.maximum(spread, 1e-9))
    return np.clip(after, -3.0, 3.0)


def clipped(covariance: Array, least: float, most: float) -> Array:
    """Return a covariance whose principal standard deviations lie between two bounds."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.clip(np.sqrt(np.maximum(values, 0)), least, most) ** 2) @ vectors.T


@dataclass(frozen=True, eq=False)
class Surface:
    """What a model makes of the statistics around a point: a quadratic polynomial.

    Args:
        centre: The point [P].
        root: Cholesky factor of the scatter of the simulations, [P, P].
        terms: Coefficients [T, K]: of 1, of each number, and of its square or of all products.
        error: Covariance of the polynomial within, as a share of one simulation's.
        residual: Covariance of a simulation about it, [K, K].
    """

    centre: Array
    root: Array
    terms: Array
    error: float
    residual: Array

    @classmethod
    def fitted(cls, design: Array, made: Array, centre: Array, scatter: Array) -> Surface:
        """Return the polynomial through simulations: positions [M, P], scaled means [M, K]."""
        root = np.linalg.cholesky(scatter)
        bare = _powers(np.linalg.solve(root, (design - centre).T).T)
        size = design.shape[1]
        if len(design) < 2.5 * bare.shape[1]:  # too few simulations for the products
            rows, columns = np.triu_indices(size)
            bare = bare[:, np.concatenate([np.ones(1 + size, np.bool_), rows == columns])]
        terms = np.linalg.lstsq(bare, made, rcond=None)[0]
        miss = made - bare @ terms
        residual = miss.T @ miss / max(len(design) - bare.shape[1], 1)
        return cls(centre, root, terms, bare.shape[1] / len(design), residual)

    def posterior(self, target: Array, covariance: Array, draw: np.random.Generator) -> tuple[Array, float]:
        """Return posterior draws [S, P], and the target's squared distance over the simulations' mean one.

        Statistics depend on each other so much that a distance of K of them has far fewer degrees of freedom;
        how far simulations lie from the polynomial tells what a matching recording has.
        """
        # What the polynomial misses counts as noise of each statistic: on the safe side, as many are alike.
        missed = np.maximum(np.diag(self.residual) - np.diag(covariance), 0.0)
        error = (covariance + np.diag(missed)) * (1.0 + self.error)
        white = np.linalg.inv(np.linalg.cholesky(error)).T
        aim, terms = target @ white, self.terms @ white
        full = len(terms) > 1 + 2 * len(self.centre)

        size, freedom = len(self.centre), max(len(target) - len(self.centre), 1)

        def miss_of(u: Array) -> Array:
            v = np.linalg.solve(self.root, (u - self.centre).T).T
            powers = _powers(v) if full else np.concatenate([np.ones((len(v), 1)), v, v * v], axis=1)
            return aim - powers @ terms

        def score(u: Array, widening: float) -> Array:
            far = np.linalg.norm(np.linalg.solve(self.root, (u - self.centre).T), axis=0) / math.sqrt(size)
            outside = np.maximum(far - _REACH, 0.0) ** 2 + np.maximum(abs(u) - 3.5, 0.0).sum(axis=1)
            distance = (miss_of(u) ** 2).sum(axis=1)
            return -0.5 * distance / widening - 0.5 * (u**2).sum(axis=1) - 1e3 * outside

        best, slope = self._best(miss_of, score)
        distance = float((miss_of(best[None]) ** 2).sum())
        widening = max(1.0, distance / freedom)
        step = np.linalg.cholesky(np.linalg.inv(slope.T @ slope / widening + np.eye(size)))
        at = best + draw.standard_normal((_CHAINS, size)) @ step.T
        kept: list[Array] = []
        for _ in range(2):
            now, kept = score(at, widening), []
            for sweep in range(_SWEEPS):
                factor = 2.4 / math.sqrt(size) * math.exp(draw.normal(-0.3, 0.7))
                trial = at + factor * draw.standard_normal(at.shape) @ step.T
                value = score(trial, widening)
                taken = np.log(draw.random(len(at))) < value - now
                at, now = np.where(taken[:, None], trial, at), np.where(taken, value, now)
                if sweep >= _SWEEPS // 3:
                    kept.append(at.copy())
            every = np.concatenate(kept)
            step = np.linalg.cholesky(np.cov(every.T) + 1e-10 * np.eye(size))
        every = np.concatenate(kept)
        return every[:: max(1, len(every) // _KEPT)], distance / float(
            np.trace(white.T @ self.residual @ white)
        )

    def _best(
        self, miss_of: Callable[[Array], Array], score: Callable[[Array, float], Array]
    ) -> tuple[Array, Array]:
        """Return the likeliest position by Gauss and Newton, and the slope of what is missed there, [K, P]."""
        at, damping = self.centre.copy(), 1e-2
        small = 1e-3 * self.root

        def slope_at(u: Array) -> Array:
            change = miss_of(u + small.T) - miss_of(u - small.T)  # along the scatter's axes
            return np.linalg.solve(2.0 * small.T, change).T

        for _ in range(40):
            slope, miss = slope_at(at), miss_of(at[None])[0]
            curve = slope.T @ slope + np.eye(len(at))
            step = np.linalg.solve(curve + damping * np.diag(np.diag(curve)), -slope.T @ miss - at)
            if score((at + step)[None], 1.0)[0] > score(at[None], 1.0)[0]:
                at, damping = at + step, max(damping / 5, 1e-9)
            else:
                damping = min(damping * 6, 1e9)
        return at, slope_at(at)


def _powers(v: Array) -> Array:
    """Return 1, v, and all products of two of v, [S, T]."""
    rows, columns = np.triu_indices(v.shape[1])
    return np.concatenate([np.ones((len(v), 1)), v, v[:, rows] * v[:, columns]], axis=1)
