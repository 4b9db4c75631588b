"""Fitting the event pixel: simulate under the fitted light until the figures of the recordings agree.

- The parameters of a pixel, each with its error, and how well they explain recordings that were held out.
- The fitted numbers as rows of the calibration's table, and in words where they cannot be believed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.event_models import MODELS, SLOW, fit_model, is_better, is_near, misfit
from evnlos.calibration.event_statistics import (
    Recording,
    Regions,
    by_pixel,
    intervals,
    moments,
    regions_of,
    simulated,
    thinned,
)
from evnlos.calibration.transport_fit import Residual, forward_jacobian, levenberg_marquardt
from evnlos.cameras import EventPixel, PixelSettings
from evnlos.machine import note
from evnlos.types import Events

EVENT_RESIDUALS = ("counts held out", "surfaces held out")
"""Residuals that the event pixel decides; where they got worse the light path still stands."""

_MOST_OF_COUNTS, _LEAST_OF_COUNTS = 1.25, 0.25  # times the noise, beside it
_LOG_NAMES = ("threshold_on", "threshold_off", "threshold_sigma", "shot_noise_rate_hz")
_NAMES = (*_LOG_NAMES, "leak_rate_hz")
_STEPS = (0.05, 0.05, 0.2, 0.1, 0.03)
_LOWEST = (math.log(0.02), math.log(0.02), math.log(0.002), math.log(1e-4), 0.0)
_HIGHEST = (math.log(3.0), math.log(3.0), math.log(0.3), math.log(1e3), 10.0)
_CUTOFFS_HZ = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0)
CONTINUOUS = "continuous"
"""Name of v2e's event model."""
_MOST_NOISE = 10.0  # times the events of pixels that see nothing
_GRID = (20, 32)  # blocks of the map of counts, rows and columns
_BIN_S = 0.1
_TOLD_RATIO = 8.0  # of the highest cutoff that agrees to the lowest: more is no answer
_SLOW_PX = 1_000  # of the fit of a model that is slow to simulate


@dataclass(frozen=True)
class PixelFit:
    """A fitted event pixel.

    Args:
        pixel: The pixel.
        error: Standard error by name, from the scatter between the recordings; infinite where one recording is
            all there is.
        cutoff_range_hz: Corner frequencies that agree with the recordings within two standard errors; None for
            a model without.
        dead_time_s: No pixel can be blind for longer: its shortest time between two events, seconds.
        on_edge: Names of what ended on the edge of what was tried.
        compared: Misfit on captures held out, by name of the event model (see `event_models.misfit`).
        near: Whether its events are of the kind of those held out (see `event_models.is_near`).
    """

    pixel: PixelSettings
    error: dict[str, float]
    cutoff_range_hz: tuple[float, float] | None
    dead_time_s: float
    on_edge: tuple[str, ...] = ()
    compared: dict[str, float] = field(default_factory=dict)
    near: bool = True


def fit_pixel(recordings: Sequence[Recording], start: EventPixel, *, seed: int = 0) -> PixelFit:
    """Fit thresholds, mismatch, leak and shot noise by the method of simulated moments, and scan the cutoff.

    Six figures of the recordings (`moments`) must agree with those of simulated events under the fitted light.
    The same random draws are used for every trial, so the figures change smoothly with the settings. The cutoff
    shows only in when events come, so it is chosen by a map of counts in tenths of a second. A leak below its
    standard error is taken for none. The first state is the one of the two whose events are nearer to those
    recorded (`misfit`). The refractory period is left as it is: only a bound can be told.

    Args:
        recordings: Light and events.
        start: Pixel whose other settings are kept.
        seed: Seed of the simulations.

    Raises:
        DataError: The light moves so little that no pixel tells a threshold.
    """
    dead_time_s, every = shortest_interval_s([r.events for r in recordings]), recordings
    recordings = [thinned(recording) for recording in recordings]
    regions = [regions_of(recording) for recording in recordings]
    observed = moments(recordings, regions, [r.events for r in recordings])
    first = replace(_first_guess(recordings, regions, observed, start), cutoff_hz=_CUTOFFS_HZ[5])
    pixel, _ = _match(recordings, regions, observed, first, seed, 6)
    cutoff, allowed = _scan_cutoff(every, pixel, seed)
    pixel, values = _match(recordings, regions, observed, replace(pixel, cutoff_hz=cutoff), seed, 2)
    error = _errors(recordings, regions, pixel, values, seed)
    if pixel.leak_rate_hz < error["leak_rate_hz"]:
        pixel = replace(pixel, leak_rate_hz=0.0)  # not told from none
    begun = (replace(pixel, initial_phase=phase) for phase in ("random", "rest"))
    pixel = min(begun, key=lambda one: float(misfit(recordings, one, seed).sum()))
    edge = tuple(
        n for n in ("threshold_on", "threshold_off") if math.log(getattr(pixel, n)) > _HIGHEST[0] - 0.02
    )
    if cutoff in (_CUTOFFS_HZ[0], _CUTOFFS_HZ[-1]) and allowed[0] == allowed[1]:
        edge = (*edge, "cutoff_hz")
    return PixelFit(pixel, error, allowed, dead_time_s, edge)


def choose_pixel(
    known: PixelFit, recordings: Sequence[Recording], held: Sequence[Recording], *, seed: int = 0
) -> PixelFit:
    """Return the fit of the event model whose events are nearest to those of captures held out.

    Another model than v2e's must be better by a twentieth, and by over thrice the scatter of the difference;
    where v2e's is far from the recordings, by a fiftieth. Models that are slow to simulate are tried, with
    fewer pixels, where no other is near to what is held out.

    Args:
        known: The fit of v2e's continuous pixel.
        recordings: Light and events to fit.
        held: Light and events to judge on.
        seed: Seed of the simulations.
    """
    few, judged = ([thinned(r) for r in part] for part in (recordings, held))
    best, least = known, misfit(judged, known.pixel, seed)
    compared, near = {CONTINUOUS: float(least.sum())}, is_near(least, judged, known.pixel, seed)
    for name in MODELS:
        if name in SLOW and (near or (best is not known and is_near(least, judged, best.pixel, seed))):
            continue
        told = [thinned(r, _SLOW_PX) for r in recordings] if name in SLOW else few
        found = fit_model(told, name, known.pixel, seed=seed)
        pixel, cutoff = found.pixel, None
        if isinstance(pixel, EventPixel):
            corner, cutoff = _scan_cutoff(recordings, pixel, seed)
            pixel = replace(pixel, cutoff_hz=corner)
        after = misfit(judged, pixel, seed)
        compared[name] = float(after.sum())
        if is_better(least, after, near):
            best, least = PixelFit(pixel, found.error, cutoff, known.dead_time_s, found.on_edge), after
    kept = near if best is known else is_near(least, judged, best.pixel, seed)
    return replace(best, compared=compared, near=kept)


def _first_guess(
    recordings: Sequence[Recording], regions: Sequence[Regions], observed: NDArray, start: EventPixel
) -> EventPixel:
    """Shot noise from the OFF events where nothing moves; thresholds by counts, which fall as 1 / threshold."""
    level = np.mean([r.light[:, q.quiet].mean() for r, q in zip(recordings, regions, strict=True)])
    dark = 1 - 0.75 * min(1.0, (float(level) + 20) / 275)
    shot = min(max(2 * observed[5] / dark, 1e-3), 100.0)
    return replace(
        start,
        threshold_on=0.2,
        threshold_off=0.2,
        threshold_sigma=0.03,
        shot_noise_rate_hz=shot,
        leak_rate_hz=0.02,
    )


def _with(pixel: EventPixel, values: NDArray[np.float64]) -> EventPixel:
    named = zip(_NAMES, values, strict=True)
    chosen = {name: math.exp(v) if name in _LOG_NAMES else float(v) for name, v in named}
    phase = "random" if chosen["leak_rate_hz"] > 0 else "rest"  # in the search: a leak carries pixels apart
    return replace(pixel, **chosen, initial_phase=phase)


def _values(pixel: EventPixel) -> list[float]:
    return [math.log(getattr(pixel, n)) if n in _LOG_NAMES else getattr(pixel, n) for n in _NAMES]


def _match(
    recordings: Sequence[Recording],
    regions: Sequence[Regions],
    observed: NDArray,
    pixel: EventPixel,
    seed: int,
    iterations: int,
) -> tuple[EventPixel, NDArray[np.float64]]:
    """Return the pixel whose simulated figures agree with those observed, and the search's values."""

    def residual(values: NDArray[np.float64]) -> torch.Tensor:
        return _discrepancy(recordings, regions, observed, _with(pixel, values), seed)

    bounds = list(zip(_LOWEST, _HIGHEST, strict=True))
    # Noise far above all that is seen explains nothing, and takes most of the time to simulate.
    bounds[3] = (_LOWEST[3], math.log(max(_MOST_NOISE * float(observed[4] + observed[5]), 1.0)))
    found = levenberg_marquardt(residual, _values(pixel), _STEPS, bounds, iterations=iterations, tolerance=0.02)
    return _with(pixel, found.values), found.values


def _discrepancy(
    recordings: Sequence[Recording], regions: Sequence[Regions], observed: NDArray, pixel: EventPixel, seed: int
) -> torch.Tensor:
    """Return the logarithms of simulated over observed figures, float64 [6]."""
    made = moments(recordings, regions, simulated(recordings, pixel, seed))
    return torch.from_numpy(np.log((made + 1e-4) / (observed + 1e-4)))


def _errors(
    recordings: Sequence[Recording],
    regions: Sequence[Regions],
    pixel: EventPixel,
    values: NDArray[np.float64],
    seed: int,
) -> dict[str, float]:
    """Return standard errors from how much the discrepancy scatters between recordings."""
    if len(recordings) < 2:
        return dict.fromkeys(_NAMES, math.inf)
    each = []
    for k, (recording, region) in enumerate(zip(recordings, regions, strict=True)):
        observed = moments([recording], [region], [recording.events])
        each.append(_discrepancy([recording], [region], observed, pixel, seed + k).numpy())
    spread = np.cov(np.stack(each).T) / len(recordings)

    def figures(trial: NDArray[np.float64]) -> torch.Tensor:
        made = moments(recordings, regions, simulated(recordings, _with(pixel, trial), seed))
        return torch.from_numpy(np.log(made + 1e-4))

    slope = forward_jacobian(figures, values, figures(values), np.array(_STEPS), np.array(_HIGHEST)).numpy()
    back = np.linalg.pinv(slope)
    error = np.sqrt(np.diag(back @ spread @ back.T))
    scale = [getattr(pixel, name) if name in _LOG_NAMES else 1.0 for name in _NAMES]
    return dict(zip(_NAMES, (float(v) for v in error * scale), strict=True))


def _scan_cutoff(
    recordings: Sequence[Recording], pixel: EventPixel, seed: int
) -> tuple[float, tuple[float, float]]:
    """Return the best corner frequency of a list, and the lowest and highest that the recordings allow.

    A frequency is allowed where its misfit exceeds the best one's by no more than twice the standard error of
    that difference, from its scatter over the tenths of seconds.

    Args:
        recordings: Light and events of all pixels: those of a quarter leave a dim sensor's cutoff open.
        pixel: Its other settings.
        seed: Seed of the simulations.
    """
    misfit = []
    for cutoff in _CUTOFFS_HZ:
        note(f"cutoff {cutoff:g} Hz")
        made = simulated(recordings, replace(pixel, cutoff_hz=cutoff), seed)
        parts = []
        for recording, events in zip(recordings, made, strict=True):
            seen, volume = (_count_volume(recording, found) for found in (recording.events, events))
            parts.append(((seen - volume) ** 2 / (seen + volume + 1)).sum(axis=1))
        misfit.append(np.concatenate(parts))
    score = np.stack(misfit)  # [cutoffs, tenths of seconds of all recordings]
    best = int(score.sum(axis=1).argmin())
    excess = score - score[best]
    error = excess.std(axis=1) * math.sqrt(excess.shape[1])
    allowed = np.array(_CUTOFFS_HZ)[excess.sum(axis=1) <= 2 * error]
    return _CUTOFFS_HZ[best], (float(allowed.min()), float(allowed.max()))


def _count_volume(recording: Recording, events: Events) -> NDArray[np.float64]:
    """Return the counts in tenths of a second, of both polarities in blocks of the sensor, [T, blocks]."""
    rows, columns = (min(a, b) for a, b in zip(_GRID, (events.height, events.width), strict=True))
    chosen = events.t_us > recording.settled_us
    bins = max(1, math.ceil(recording.seconds / _BIN_S))
    when = np.minimum(((events.t_us[chosen] - recording.settled_us) * 1e-6 / _BIN_S).astype(np.int64), bins - 1)
    row = events.y[chosen].astype(np.int64) * rows // events.height
    column = events.x[chosen].astype(np.int64) * columns // events.width
    flat = ((when * 2 + events.p[chosen]) * rows + row) * columns + column
    counts = np.bincount(flat, minlength=bins * 2 * rows * columns)
    return counts.reshape(bins, -1).astype(np.float64)


def shortest_interval_s(events: Sequence[Events], share: float = 1e-3) -> float:
    """Return the time between two events of a pixel that only a share of the pairs fall below, seconds.

    Args:
        events: Recordings.
        share: Share of the pairs that noise may put closer together.
    """
    every = np.concatenate([intervals(*by_pixel(one))[1] for one in events])
    return float(np.quantile(every, share)) * 1e-6 if len(every) else math.inf


@dataclass(frozen=True)
class Row:
    """One fitted number.

    Args:
        name: Dotted name in the simulation's settings.
        before: Its value at the start.
        after: Its fitted value.
        error: Standard error; None where none is known.
        unit: Its unit.
        note: What the captures say about it, beyond a number.
    """

    name: str
    before: float
    after: float
    error: float | None
    unit: str
    note: str = ""


def pixel_rows(fit: PixelFit, start: Any) -> list[Row]:
    """Return the fitted numbers of an event pixel.

    Args:
        fit: The fitted pixel.
        start: The pixel that the search began with.
    """
    pixel, error = fit.pixel, fit.error
    rows = [
        Row(
            f"setup.pixel.{name}",
            getattr(start, name, getattr(pixel, name)),
            getattr(pixel, name),
            value,
            _unit_of(name),
        )
        for name, value in error.items()
    ]
    if fit.cutoff_range_hz is not None:
        low, high = fit.cutoff_range_hz
        told = high / low < _TOLD_RATIO
        tried = f"of those tried: {low:g} to {high:g}" if told else f"not identified: {low:g} to {high:g} agree"
        cutoff = getattr(pixel, "cutoff_hz", 0.0)
        rows.append(Row("setup.pixel.cutoff_hz", start.cutoff_hz, cutoff, None, "Hz", tried))
    if hasattr(pixel, "refractory_s"):
        bound = f"not identified: at most {fit.dead_time_s:g}"
        kept = getattr(pixel, "refractory_s", 0.0)
        rows.append(Row("setup.pixel.refractory_s", start.refractory_s, kept, None, "s", bound))
    return rows


def _unit_of(name: str) -> str:
    endings = {"_per_dn_hz": "Hz/DN", "_a_per_dn": "A/DN", "_hz": "Hz", "_dn": "DN", "_a": "A", "_factor": ""}
    return next((unit for ending, unit in endings.items() if name.endswith(ending)), "log units")


def went(name: str, residuals: Mapping[str, Residual]) -> str:
    """Return in words what became of a residual."""
    r = residuals[name]
    return f"{name}: the residual went from {100 * r.before:.1f} % to {100 * r.after:.1f} %"


def event_warnings(pixel: PixelFit, residuals: Mapping[str, Residual], worse: Collection[str]) -> list[str]:
    """Return where the event pixel does not make what the camera recorded, a line each.

    Args:
        pixel: The fitted pixel.
        residuals: What is left of captures held out, by name.
        worse: Names of the ones that got worse.
    """
    if (counts := residuals.get(EVENT_RESIDUALS[0])) is None:
        return []
    found = []
    if name := next((name for name in EVENT_RESIDUALS if name in worse), None):
        found.append(
            f"{went(name, residuals)}: the fitted event pixel is no nearer to this sensor than the usual one, "
            "so do not rely on events; train with frames, or fine-tune on captures"
        )
    elif counts.after > _MOST_OF_COUNTS * counts.noise and counts.unexplained > _LEAST_OF_COUNTS:
        found.append(
            f"counts held out: {100 * counts.after:.0f} % is left where noise alone leaves "
            f"{100 * counts.noise:.0f} %: this sensor is not of the event model's kind, so do not rely on a "
            "network that has seen simulated events alone; train with frames, or fine-tune on captures"
        )
    if pixel.on_edge:
        found.append(
            f"pixel.{', pixel.'.join(pixel.on_edge)}: ended on the edge of what was tried, so the event "
            "pixel is not known; the sensor may be of another kind"
        )
    return found
