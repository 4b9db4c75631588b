"""Which event model a sensor follows: each is fitted to the same figures, and captures held out decide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.event_statistics import Recording, count_map, simulated
from evnlos.calibration.frame_model import local_square
from evnlos.calibration.transport_fit import levenberg_marquardt
from evnlos.cameras import PixelSettings
from evnlos.cameras.pixel import EventPixel
from evnlos.cameras.pixels.brownian import BrownianPixel
from evnlos.cameras.pixels.circuit import CircuitPixel
from evnlos.errors import ConfigError
from evnlos.machine import note
from evnlos.types import Events, derive_seed

Array = NDArray[np.float64]

_LEVELS = 3  # classes of pixels by their mean light
_MOVING = (0.15, 0.6)  # swings of the log light between pixels at rest, moving, and moving much
_FLOOR = 0.05  # relative error of a figure that no model is held to
_FEWEST = 1e-3  # events per pixel per second that count as none
_BIN_S, _BLOCK_PX = 0.4, 5
_SHARED = ("threshold_on", "threshold_off", "threshold_sigma", "leak_rate_hz", "shot_noise_rate_hz")
_MARGIN, _LESS = 0.05, 0.02
_NEAR = 1.5  # times the misfit of a model's own events: sensors of its kind have 1.0 to 1.1, others 1.4 to 2.8
_FURTHEST = 0.7  # of a step along a logarithm: a factor of two
_EDGE = 0.02  # of a parameter's range


@dataclass(frozen=True)
class Free:
    """A number of an event model that is fitted.

    Args:
        name: Its name.
        low: Smallest value.
        high: Largest value.
        step: Step of the finite difference, relative where `log`.
        log: Whether the search runs over its logarithm.
        starts: Values to begin at, the best of which is taken, where one alone may end beside the best fit.
    """

    name: str
    low: float
    high: float
    step: float
    log: bool = True
    starts: tuple[float, ...] = ()


_THRESHOLDS = (
    Free("threshold_on", 0.02, 3.0, 0.05),
    Free("threshold_off", 0.02, 3.0, 0.05),
    Free("threshold_sigma", 0.002, 0.5, 0.2),
)
MODELS: dict[str, tuple[PixelSettings, tuple[Free, ...]]] = {
    "continuous, true logarithm": (
        EventPixel(0.2, 0.2, 0.02, 80.0, 0.05, 0.2, 0.0, logarithm="true", dark_dn=1.0),
        (
            *_THRESHOLDS,
            Free("shot_noise_rate_hz", 1e-4, 1e3, 0.1),
            Free("leak_rate_hz", 0.0, 10.0, 0.03, log=False),
            Free("dark_dn", 0.01, 60.0, 0.2),
        ),
    ),
    "brownian": (
        BrownianPixel(0.2, 0.2, 0.02, dark_dn=10.0, leak_rate_per_dn_hz=0.002),
        (
            *_THRESHOLDS,
            Free("dark_dn", 0.1, 100.0, 0.2),
            Free("leak_rate_hz", 0.0, 10.0, 0.03, log=False),
            Free("leak_rate_per_dn_hz", 0.0, 1.0, 5e-4, log=False),
            Free("photon_noise", 1e-3, 1.0, 0.1),
        ),
    ),
    "circuit, one pole": (
        CircuitPixel(photocurrent_a_per_dn=2.8e-15, follower_a=5e-12, poles=1),
        (
            *_THRESHOLDS,
            Free("photocurrent_a_per_dn", 1e-17, 3e-14, 0.2, starts=(1e-16, 5e-16, 2.5e-15, 1.2e-14)),
            Free("follower_a", 5e-13, 3e-11, 0.2),
            Free("leak_rate_hz", 0.0, 10.0, 0.03, log=False),
            Free("noise_factor", 0.2, 5.0, 0.1),
        ),
    ),
}
"""Event models beside v2e's continuous one, slow ones last: a start, and what is fitted."""
SLOW = ("circuit, one pole",)
"""Those that are slow to simulate: tried where no other comes near to the recordings."""


@dataclass(frozen=True)
class ModelFit:
    """An event model that was fitted to recordings.

    Args:
        name: Name in `MODELS`.
        pixel: The fitted pixel.
        error: Standard error by name; infinite where the figures say nothing.
        on_edge: Names of numbers that ended on the edge of their range.
    """

    name: str
    pixel: PixelSettings
    error: dict[str, float]
    on_edge: tuple[str, ...]


def figures_of(recordings: Sequence[Recording], events: Sequence[Events]) -> tuple[Array, Array]:
    """Return figures of recordings and how many events stand behind each, [F] both.

    Rates of ON and OFF events, hertz per pixel, in nine classes of pixels: by terciles of their mean light, and
    by how much the light moves; and how much the counts of neighbours scatter where it moves.

    Args:
        recordings: Light, and the instants that count.
        events: Recorded or simulated events of each.
    """
    total, pixels = np.zeros((_LEVELS, 3, 2)), np.zeros((_LEVELS, 3, 1))
    scatter, where = np.zeros(2), 0.0
    for recording, found in zip(recordings, events, strict=True):
        light = np.log(np.maximum(recording.light, 1e-3))
        level, swing = light.mean(axis=0), np.ptp(light, axis=0)
        tercile = np.digitize(level, np.quantile(level, np.arange(1, _LEVELS) / _LEVELS))
        moving = np.digitize(swing, _MOVING)
        counts = [count_map(found, polarity, recording.settled_us) for polarity in (True, False)]
        for k, count in enumerate(counts):
            np.add.at(total[..., k], (tercile, moving), count)
            scatter[k] += local_square(np.sqrt(count))[moving > 0].sum()
        np.add.at(pixels[..., 0], (tercile, moving), recording.seconds)
        where += float((moving > 0).sum()) * recording.seconds
    rates = total / np.maximum(pixels, 1e-9)
    behind = np.concatenate([total.ravel(), np.full(2, total.sum())])
    return np.concatenate([rates.ravel(), scatter / max(where, 1e-9)]), behind


def fit_model(
    recordings: Sequence[Recording],
    name: str,
    near: PixelSettings,
    *,
    seed: int = 0,
) -> ModelFit:
    """Fit one of `MODELS` by the method of simulated moments: the logarithms of `figures_of` must agree.

    Args:
        recordings: Light and events.
        name: Name of the model.
        near: A pixel of another model that was fitted: the search starts at its thresholds, leak and noise.
        seed: Seed of the simulations; all trials draw the same noise.
    """
    chosen, free = MODELS[name]
    start: Any = chosen
    shared = {f.name: getattr(near, f.name) for f in free if f.name in _SHARED and hasattr(near, f.name)}
    start = replace(start, **shared)
    observed, behind = figures_of(recordings, [r.events for r in recordings])
    weight = 1 / np.sqrt(1 / np.maximum(behind, 1) + _FLOOR**2)

    def made(values: Array) -> PixelSettings:
        return replace(start, **{f.name: _decoded(f, v) for f, v in zip(free, values, strict=True)})

    def residual(values: Array) -> torch.Tensor:
        try:
            figures, _ = figures_of(recordings, simulated(recordings, made(values), seed))
        except ConfigError:
            return torch.full((len(observed),), 1e3, dtype=torch.float64)
        return torch.from_numpy(weight * np.log((figures + _FEWEST) / (observed + _FEWEST)))

    bounds = [(_encoded(f, f.low), _encoded(f, f.high)) for f in free]
    first = [_encoded(f, min(max(getattr(start, f.name), f.low), f.high)) for f in free]
    for place, one in enumerate(free):
        tried = [[*first[:place], _encoded(one, v), *first[place + 1 :]] for v in one.starts]
        if tried:
            first = min(tried, key=lambda values: float(residual(np.array(values)).square().sum()))
    # A bold step may end where a pixel sends a hundred times the events: half a minute that tells nothing.
    most = [_FURTHEST if f.log else 0.5 * (f.high - f.low) for f in free]
    steps = [f.step for f in free]
    found = levenberg_marquardt(residual, first, steps, bounds, iterations=12, tolerance=5e-3, most=most)
    pixel = made(found.values)
    scale = [getattr(pixel, f.name) if f.log else 1.0 for f in free]
    error = {f.name: float(e * s) for f, e, s in zip(free, found.error, scale, strict=True)}
    edge = tuple(
        f.name
        for f, v, (low, high) in zip(free, found.values, bounds, strict=True)
        if high - v < _EDGE * (high - low) or (f.name in _SHARED[:2] and v - low < _EDGE * (high - low))
    )
    return ModelFit(name, pixel, error, edge)


def misfit(recordings: Sequence[Recording], pixel: PixelSettings, seed: int) -> Array:
    """Return how far a pixel's events are from recorded ones, a number for each 0.4 s, [T].

    Squared differences of counts, by polarity in blocks of 5 x 5 pixels, over the variance of two Poisson
    counts; the mean of four simulations stands for the model.

    Args:
        recordings: Light and events.
        pixel: The pixel.
        seed: Seed of the simulations.
    """
    parts = []
    draws = []
    for k in range(4):
        note(f"judge {type(pixel).__name__}, draw {k + 1} of 4")
        draws.append(simulated(recordings, pixel, derive_seed(seed, "misfit", k)))
    for k, recording in enumerate(recordings):
        seen = _volume(recording, recording.events)
        model = sum((_volume(recording, draw[k]) for draw in draws), np.zeros(())) / len(draws)
        parts.append(((seen - model) ** 2 / (seen + model + 1)).sum(axis=1))
    return np.concatenate(parts)


def is_near(found: Array, recordings: Sequence[Recording], pixel: PixelSettings, seed: int) -> bool:
    """Return whether a misfit is below 1.5 times that of the model's own events.

    Args:
        found: `misfit` of the pixel.
        recordings: Light and events.
        pixel: The pixel.
        seed: Seed of the simulations.
    """
    drawn = simulated(recordings, pixel, derive_seed(seed, "drawn"))
    own = [replace(recording, events=events) for recording, events in zip(recordings, drawn, strict=True)]
    return float(found.sum()) < _NEAR * float(misfit(own, pixel, seed).sum())


def is_better(before: Array, after: Array, near: bool = True) -> bool:
    """Return whether a model's misfit is lower by a twentieth, and by over thrice the difference's scatter.

    Args:
        before: Misfit of the model that is kept otherwise, by stretches of time.
        after: That of the other.
        near: Whether the first one is of the recordings' kind. Where it is not, nothing speaks for it, and a
            fiftieth is enough.
    """
    gain = before - after
    least = max(3 * math.sqrt(len(gain)) * gain.std(), _MARGIN * before.sum()) if near else _LESS * before.sum()
    return bool(gain.sum() > least)


def _volume(recording: Recording, events: Events) -> Array:
    """Return counts by stretch of time, polarity and block of the sensor, [T, 2 blocks]."""
    rows, columns = (-(-n // _BLOCK_PX) for n in (events.height, events.width))
    bins = max(1, math.ceil(recording.seconds / _BIN_S))
    kept = events.t_us > recording.settled_us
    when = ((events.t_us[kept] - recording.settled_us) * 1e-6 / _BIN_S).astype(np.int64)
    block = (events.y[kept] // _BLOCK_PX).astype(np.int64) * columns + events.x[kept] // _BLOCK_PX
    place = (np.minimum(when, bins - 1) * 2 + events.p[kept]) * rows * columns + block
    counts = np.bincount(place, minlength=bins * 2 * rows * columns)
    return counts.reshape(bins, -1).astype(np.float64)


def _encoded(free: Free, value: float) -> float:
    return math.log(value) if free.log else value


def _decoded(free: Free, value: float) -> float:
    return math.exp(value) if free.log else float(value)
