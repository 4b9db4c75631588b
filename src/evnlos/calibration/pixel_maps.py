"""Thresholds of each pixel, by a regression that simulated pixels of known thresholds teach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.event_statistics import count_map, simulated
from evnlos.calibration.pixel_fit import CandidateFit, Panels, PixelFitSettings
from evnlos.calibration.pixel_light import LitEvents, LitRecording, lit_recording
from evnlos.calibration.pixel_statistics import Array
from evnlos.cameras import PixelSettings
from evnlos.cameras.pixels.arrays import pixel_thresholds
from evnlos.types import Events, derive_seed

_TOLD = 0.3  # share of a map's variance that events must explain


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """Thresholds of each pixel, log units, [H, W].

    Args:
        on: Threshold of ON events.
        off: Threshold of OFF events.
        error_on: Standard error of `on`; that of the mismatch where a pixel's events do not tell.
        error_off: The same for `off`.
        told: Share of the mismatch's variance that events explain, (ON, OFF); 0 = not identified.
        hot: Pixels that fire without cause, bool [H, W].
    """

    on: Array
    off: Array
    error_on: Array
    error_off: Array
    told: tuple[float, float]
    hot: NDArray[np.bool_]


def maps_of(
    fit: CandidateFit,
    sources: Sequence[LitEvents],
    panels: Panels,
    hot: NDArray[np.bool_],
    settings: PixelFitSettings,
) -> PixelMaps | None:
    """Return each pixel's thresholds, by a regression that simulated pixels of known thresholds teach.

    What is regressed on is the log of the way that the log light goes up and down, over the events of either
    sign, of each recording whose light moves. The regression's own residual is the error.

    Args:
        fit: The model.
        sources: The recordings, all pixels.
        panels: Recordings of the fitted pixels.
        hot: Pixels that fire without cause.
        settings: Seeds.
    """
    moving = [k for k, one in enumerate(panels.recordings) if one.known.kind not in ("static", "unknown")]
    if not moving:
        return None
    pixel, pixels = fit.pixel, panels.recordings[0].light.shape[2]
    few = [panels.recordings[k] for k in moving]
    known, looked = [], []
    for n in range(4):
        seed = derive_seed(settings.seed, "maps", n)
        sensor: PixelSettings = replace(pixel, pattern_seed=seed, initial_phase="random")  # type: ignore[type-var]
        events = simulated(few, sensor, seed)
        known.append(np.log(np.stack(pixel_thresholds(sensor, (1, pixels), seed, None))))  # type: ignore[arg-type]
        looked.append(_ratios([(one, found) for one, found in zip(few, events, strict=True)]))
    truth, given = np.concatenate(known, axis=1).T, np.concatenate(looked, axis=0)
    design = np.concatenate([np.ones((len(given), 1)), given], axis=1)
    pull = np.diag([0.0, *np.full(given.shape[1], 1e-3 * len(given))])
    weights = np.linalg.solve(design.T @ design + pull, design.T @ truth)
    left = (truth - design @ weights).std(axis=0)
    told = tuple(
        float(max(0.0, 1 - (r / max(s, 1e-9)) ** 2)) for r, s in zip(left, truth.std(axis=0), strict=True)
    )
    shape = sources[0].events.shape
    inside = np.logical_and.reduce([sources[k].inside for k in moving]) & ~hot
    place = np.flatnonzero(inside)
    seen = []
    for block in np.array_split(place, max(1, len(place) // 4096)):
        lit = [lit_recording(sources[k], block, settings.most_s) for k in moving]
        seen.append(_ratios([(one, one.events) for one in lit]))
    made = np.concatenate(seen, axis=0)
    values = np.exp(np.concatenate([np.ones((len(made), 1)), made], axis=1) @ weights)
    means = truth.mean(axis=0)
    out = []
    for k in range(2):
        value, error = (
            np.full(shape, math.exp(means[k])),
            np.full(shape, math.exp(means[k]) * truth[:, k].std()),
        )
        if told[k] >= _TOLD:
            value.ravel()[place] = np.maximum(values[:, k], 0.01)
            error.ravel()[place] = values[:, k] * left[k]
        out.append((value, error))
    shown = tuple(one if one >= _TOLD else 0.0 for one in told)
    return PixelMaps(out[0][0], out[1][0], out[0][1], out[1][1], shown, hot)  # type: ignore[arg-type]


def _ratios(pairs: Sequence[tuple[LitRecording, Events]]) -> Array:
    """Return log(way of the log light / events) of each pixel, ON and OFF, [N, 2 R]."""
    columns = []
    for recording, events in pairs:
        steps = np.diff(np.log(recording.light[:, 0].astype(np.float64) + 1.0), axis=0)
        for sign, polarity in ((1.0, True), (-1.0, False)):
            way = np.maximum(sign * steps, 0.0).sum(axis=0)
            count = count_map(events, polarity, recording.settled_us).ravel()
            columns.append(np.log((way + 0.1) / (count + 0.5)))
    return np.stack(columns, axis=1)
