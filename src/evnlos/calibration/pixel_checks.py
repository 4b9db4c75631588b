"""Is a fitted pixel believable: models compared on pixels held out, and predictive checks.

- The likelihood of pixels held out, by model.
- Posterior predictive checks: numbers that the fit did not take as such, recorded and simulated.
- The refractory period, and noise and bandwidth against light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from evnlos.calibration.event_fit import shortest_interval_s
from evnlos.calibration.event_statistics import by_pixel, count_map, intervals
from evnlos.calibration.pixel_fit import CandidateFit, Estimate, Panels, PixelFitSettings
from evnlos.calibration.pixel_light import KnownLight, LitRecording, waveform
from evnlos.calibration.pixel_statistics import Array, simulated_events
from evnlos.machine import Progress, Step, silent
from evnlos.types import Events, derive_seed

_DRAWS = 12  # posterior draws whose simulations stand for a model
_RESAMPLES = 200
_UNLIKELY = 0.01
_FEWEST_PAIRS = 30  # intervals that are all alike before they count as the refractory period
_LONGEST_S = 1.0  # refractory period, above those of all sensors: longer intervals bound nothing
_FINE_TICKS = 5  # ticks of the time stamps that a refractory period must last to be told from them
_PILE = 5.0  # times as many intervals at the shortest as just above it
_TEETH, _PARTS = 6, 8  # how far a comb is followed, and in how many parts of the shortest interval
_ON_COMB = 0.7  # resultant of the phases: 1 on a comb, 0.6 where intervals fall off in a fifth of it
_STATIC_S, _STATIC_PX = 10.0, 200
_BINS = 24


@dataclass(frozen=True)
class Comparison:
    """A model on the pixels held out.

    Args:
        name: Its name.
        log_likelihood: Log likelihood of their statistics, nats.
        behind: By how much the best model's is higher, nats.
        error: Standard error of that difference, from resampled pixels.
        bits_per_event: The difference in bits per event held out.
    """

    name: str
    log_likelihood: float
    behind: float
    error: float
    bits_per_event: float


@dataclass(frozen=True)
class Check:
    """A number of the recordings beside that of simulations with draws of the posterior.

    Args:
        name: What it is.
        recording: Of which recording.
        recorded: Its value.
        low: 5 % quantile of the simulated values.
        high: Their 95 % quantile.
        p: Share of a normal law with their mean and spread below the recorded value.
    """

    name: str
    recording: str
    recorded: float
    low: float
    high: float
    p: float

    @property
    def passed(self) -> bool:
        """Whether the recorded value is none of the least likely hundredth on either side."""
        return _UNLIKELY <= self.p <= 1.0 - _UNLIKELY


@dataclass(frozen=True)
class AtLight:
    """Noise and bandwidth at a light level, with 95 % intervals of the posterior.

    Args:
        light_dn: The light, DN.
        on_hz: Rate of ON events without cause (median, low, high), hertz per pixel.
        off_hz: The same for OFF events.
        bandwidth_hz: Corner frequency (median, low, high), hertz; infinite where the model has none.
    """

    light_dn: float
    on_hz: tuple[float, float, float]
    off_hz: tuple[float, float, float]
    bandwidth_hz: tuple[float, float, float]


def tick_of(events: Events) -> int:
    """Return what all time stamps but for one in a hundred are multiples of, microseconds; 1 = nothing coarser.

    Args:
        events: A recording.
    """
    steps = np.diff(np.unique(events.t_us))
    if len(steps) < 50:
        return 1
    tick = int(np.quantile(steps, 0.01))
    return tick if tick > 1 and float((steps % tick == 0).mean()) > 0.99 else 1


def refractory_of(events: Sequence[Events]) -> Estimate:
    """Return the refractory period, from how the shortest intervals pile up.

    A pixel whose light has moved by more than a threshold while it was blind sends its next event at the end of
    the refractory period, so many intervals are alike. Where they do not, only a bound is known. So it is where
    they pile up again at multiples of it, or of a part of it: so often is that sensor read. Where even the
    shortest are longer than a second, nothing is known.

    Args:
        events: Recordings of one sensor.
    """
    shortest, tick_us = shortest_interval_s(events), max(tick_of(one) for one in events)
    if shortest > _LONGEST_S:
        return Estimate("refractory_s", 0.0, 0.0, math.inf, "not identified")
    every = np.concatenate([intervals(*by_pixel(one))[1] for one in events]).astype(np.float64)
    base = shortest * 1e6
    pile = every[(every >= 0.98 * base - 1) & (every <= 1.05 * base + 1)]
    above = np.count_nonzero((every > 1.05 * base + 1) & (every <= 1.12 * base + 3))
    if (
        len(pile) < _FEWEST_PAIRS
        or len(pile) < _PILE * max(above, 1)
        or base < _FINE_TICKS * tick_us
        or _is_scanned(every, base)
    ):
        return Estimate("refractory_s", 0.0, 0.0, shortest, "at most")
    low, middle, high = np.quantile(pile, (0.025, 0.5, 0.975))
    return Estimate(
        "refractory_s", float(middle) * 1e-6, float(low - 1) * 1e-6, float(high + 1) * 1e-6, "identified"
    )


def _is_scanned(every: Array, base: float) -> bool:
    """Return whether intervals longer than the shortest lie on a comb of it, or of a part of it."""
    longer = every[(every > 1.12 * base + 3) & (every < _TEETH * base)]
    if len(longer) < _FEWEST_PAIRS:
        return False
    spacings = np.outer(base / np.arange(1, _PARTS + 1), np.linspace(0.97, 1.03, 61)).ravel()
    return any(abs(np.exp(2j * np.pi / one * longer).mean()) > _ON_COMB for one in spacings if one > 2)


def compared(
    fits: Sequence[CandidateFit], held: Panels, settings: PixelFitSettings, progress: Progress = silent
) -> tuple[Comparison, ...]:
    """Return the likelihood of held-out pixels under each model, the best first.

    The statistics' mean is normal: around the mean of simulations with posterior draws, with the
    covariance that the model gives to it and that of the draws.

    Args:
        fits: The fitted models.
        held: Pixels held out.
        settings: Seeds.
        progress: Called after each model.
    """
    draw = np.random.default_rng(derive_seed(settings.seed, "held out"))
    pixels = len(held.statistics)
    rows = [draw.integers(0, pixels, pixels) for _ in range(_RESAMPLES)]
    target = np.stack([held.scale.of(held.statistics), *(held.scale.of(held.statistics[row]) for row in rows)])
    about = held.statistics.mean(axis=0)
    scores = []
    for k, fit in enumerate(fits):
        progress(Step("compare models", k, len(fits), "models"))
        made = [
            held.simulate(fit.drawn(n * (len(fit.draws) // _DRAWS)), derive_seed(settings.seed, "held", n))
            for n in range(_DRAWS)
        ]
        expected = np.mean(made, axis=0)
        own = np.mean([held.scale.covariance(one - expected, about) for one in made], axis=0)
        own *= _DRAWS / (_DRAWS - 1)
        means = np.stack([held.scale.of(one) for one in made])
        drift = np.maximum(means.var(axis=0, ddof=1) - np.diag(own), 0.0)
        error = own * (1 + 1 / _DRAWS) + np.diag(drift + (1e-3 + 0.05 * np.sqrt(np.diag(own))) ** 2)
        root = np.linalg.cholesky(error)
        miss = np.linalg.solve(root, (target - means.mean(axis=0)).T)
        scores.append(-0.5 * (miss**2).sum(axis=0) - np.log(np.diag(root)).sum())
    progress(Step("compare models", len(fits), len(fits), "models"))
    best = max(range(len(fits)), key=lambda k: scores[k][0])
    events = sum(len(one.events) for one in held.recordings)
    found = []
    for fit, score in zip(fits, scores, strict=True):
        gap = scores[best] - score
        bits = float(gap[0]) / math.log(2) / max(events, 1)
        found.append(Comparison(fit.name, float(score[0]), float(gap[0]), float(gap[1:].std()), bits))
    return tuple(sorted(found, key=lambda one: one.behind))


def numbers_of(recording: LitRecording, events: Events) -> dict[str, float]:
    """Return what a check looks at: counts of pixels, intervals, alternation, polarity.

    Args:
        recording: The light.
        events: Recorded or simulated events.
    """
    count = sum(count_map(events, sign, recording.settled_us) for sign in (True, False)).ravel()  # type: ignore[attr-defined]
    on = float(count_map(events, True, recording.settled_us).sum())
    total = float(count.sum())
    hottest = np.sort(count)[-max(1, len(count) // 100) :].sum()
    _, gaps, unlike = intervals(*by_pixel(events, recording.settled_us))
    return {
        "rate, Hz per pixel": total / len(count) / max(recording.seconds, 1e-9),
        "variance / mean of counts": float(count.var() / max(count.mean(), 1e-9)),
        "share of silent pixels": float((count == 0).mean()),
        "share of events of the hottest 1 %": float(hottest / max(total, 1.0)),
        "log10 of median interval, s": math.log10(max(float(np.median(gaps)), 1.0) * 1e-6)
        if len(gaps)
        else math.nan,
        "share of alternating pairs": float(unlike.mean()) if len(unlike) >= 20 else math.nan,
        "ON / OFF": (on + 0.5) / (total - on + 0.5),
    }


@dataclass(frozen=True, eq=False)
class Predicted:
    """Checks, and the histograms behind them: recorded [B], and simulated [S, B].

    Args:
        checks: The checks.
        counts: Edges and histograms of events per pixel, shares.
        intervals: Edges (log10 s) and histograms of intervals, shares.
    """

    checks: tuple[Check, ...]
    counts: tuple[Array, Array, Array]
    intervals: tuple[Array, Array, Array]


def predicted(
    fit: CandidateFit,
    held: Panels,
    names: Sequence[str],
    settings: PixelFitSettings,
    progress: Progress = silent,
) -> Predicted:
    """Return predictive checks of a model on pixels held out.

    Args:
        fit: The model.
        held: Pixels held out.
        names: Names of the recordings.
        settings: Number of simulations, and their seed.
        progress: Called after each simulation.
    """
    recorded = [numbers_of(one, one.events) for one in held.recordings]
    totals = [_totals(held.recordings, [one.events for one in held.recordings])]
    gaps = [_gaps([one.events for one in held.recordings])]
    made: list[list[dict[str, float]]] = []
    for n in range(settings.checks):
        progress(Step("check", n, settings.checks, "simulations"))
        pixel = fit.drawn(n * max(1, len(fit.draws) // settings.checks))
        events = simulated_events(held.recordings, pixel, derive_seed(settings.seed, "check", n))
        made.append([numbers_of(one, found) for one, found in zip(held.recordings, events, strict=True)])
        totals.append(_totals(held.recordings, events))
        gaps.append(_gaps(events))
    progress(Step("check", settings.checks, settings.checks, "simulations"))
    checks = []
    for k, own in enumerate(recorded):
        for name, value in own.items():
            values = np.array([one[k][name] for one in made])
            values = values[np.isfinite(values)]
            if not math.isfinite(value) or len(values) < 5:
                continue
            spread = max(float(values.std(ddof=1)), 1e-6 * max(abs(value), 1e-3))
            p = NormalDist().cdf((value - float(values.mean())) / spread)
            low, high = np.quantile(values, (0.05, 0.95))
            checks.append(Check(name, names[k], value, float(low), float(high), p))
    top = max(1.0, float(np.quantile(totals[0], 0.99)) * 1.3)
    edges = np.unique(np.round(np.linspace(0, top, _BINS + 1))) - 0.5
    shares = np.stack([np.histogram(np.minimum(one, edges[-1] - 0.1), edges)[0] / len(one) for one in totals])
    spans = np.linspace(-6, 2, 3 * _BINS + 1)
    times = np.stack([np.histogram(one, spans)[0] / max(len(one), 1) for one in gaps])
    return Predicted(tuple(checks), (edges, shares[0], shares[1:]), (spans, times[0], times[1:]))


def _totals(recordings: Sequence[LitRecording], events: Sequence[Events]) -> Array:
    maps = [
        count_map(found, sign, one.settled_us)
        for one, found in zip(recordings, events, strict=True)
        for sign in (True, False)
    ]
    return np.sum(maps, axis=0).ravel().astype(np.float64)


def _gaps(events: Sequence[Events]) -> Array:
    found = np.concatenate([intervals(*by_pixel(one))[1] for one in events])
    return np.log10(np.maximum(found, 1)) - 6


def at_lights(fit: CandidateFit, levels_dn: Sequence[float], seed: int) -> tuple[AtLight, ...]:
    """Return noise and bandwidth of a fitted model at light levels, by simulations with posterior draws.

    Args:
        fit: The model.
        levels_dn: Light, DN.
        seed: Seed of the simulations.
    """
    seconds, pixels, found = _STATIC_S, _STATIC_PX, []
    for level in levels_dn:
        times, light = waveform(KnownLight("static", level), seconds)
        still = np.repeat(light[:, None].astype(np.float32), pixels, axis=1)[:, None]
        recording = LitRecording(np.ascontiguousarray(still), times, Events.empty(pixels, 1))
        rates, corners = [], []
        for n in range(6):
            pixel = fit.drawn(n * (len(fit.draws) // 6))
            events = simulated_events([recording], pixel, derive_seed(seed, "light", n))[0]
            late = events.t_us > recording.settled_us
            scale = pixels * recording.seconds
            rates.append([float((events.p & late).sum()) / scale, float((~events.p & late).sum()) / scale])
        for n in range(64):
            law = fit.drawn(n * max(1, len(fit.draws) // 64)).crossing_law(level)
            corners.append(math.inf if law is None else float(law.bandwidth(np.array(level))) / (2 * math.pi))
        on, off = (_interval([pair[k] for pair in rates], 1.0 / (pixels * recording.seconds)) for k in (0, 1))
        quantiles = tuple(float(q) for q in np.quantile(corners, (0.5, 0.025, 0.975), method="nearest"))
        found.append(AtLight(level, on, off, quantiles))  # type: ignore[arg-type]
    return tuple(found)


def _interval(values: Sequence[float], least: float) -> tuple[float, float, float]:
    """Return mean and a normal 95 % interval of a few values, at least a count wide."""
    mean, spread = float(np.mean(values)), max(float(np.std(values, ddof=1)), least)
    return mean, max(mean - 2 * spread, 0.0), mean + 2 * spread
