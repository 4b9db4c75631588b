"""Recorded events beside simulated ones: maps of counts, and the time surfaces that a network sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
from evnlos.calibration.event_statistics import Recording, simulated
from evnlos.calibration.residual import Residual
from evnlos.dataset.sampling import Sampling, make_samples, reduce_by_area
from evnlos.seeds import derive_seed
from evnlos.sensor import PixelSettings
from evnlos.types import Events

_DRAWS = 4  # simulations whose mean stands for the model: one alone would add its own noise
_BLOCK_PX = 5

Maps = dict[str, NDArray[np.float32]]


def event_residuals(
    shots: Shots,
    recordings: Sequence[Recording],
    before: PixelSettings,
    after: PixelSettings,
    sampling: Sampling,
    seed: int,
) -> tuple[dict[str, Residual], dict[str, tuple[NDArray, NDArray]]]:
    """Compare recorded events with the mean of simulated ones under the same light.

    Args:
        shots: The captures.
        recordings: Light and events of some of them.
        before: Pixel of the start.
        after: Fitted pixel.
        sampling: Resolution and kind of the time surfaces.
        seed: Seed of the simulations.

    Returns:
        Residuals of `counts` (events a polarity in blocks of 5 x 5 pixels between two frames) and `surfaces`
        (the standard sample's maps); their noise is that of one simulated recording against the mean. And the
        surfaces [N, 2, h, w] of camera and model by capture.
    """
    edges = [shots.captures[r.index].frame_times_us for r in recordings]
    seen = _maps([r.events for r in recordings], edges, sampling)
    mean = {
        name: _mean_maps(recordings, pixel, edges, sampling, derive_seed(seed, "check"))
        for name, pixel in (("before", before), ("after", after))
    }
    other = _maps(simulated(recordings, after, derive_seed(seed, "noise")), edges, sampling)
    residuals = {}
    for kind, maps in seen.items():
        spread = float(maps.std())
        distance = {name: _rms(maps - model[kind]) / spread for name, model in mean.items()}
        residuals[kind] = Residual(**distance, noise=_rms(other[kind] - mean["after"][kind]) / spread)
    lengths = np.cumsum([len(e) - 1 for e in edges])[:-1]
    pairs = zip(*(np.split(m["surfaces"], lengths) for m in (seen, mean["after"])), strict=True)
    names = [shots.names[r.index] for r in recordings]
    return residuals, dict(zip(names, pairs, strict=True))


def _mean_maps(
    recordings: Sequence[Recording],
    pixel: PixelSettings,
    edges: list[NDArray[np.int64]],
    sampling: Sampling,
    seed: int,
) -> Maps:
    total: Maps = {}
    for draw in range(_DRAWS):
        maps = _maps(simulated(recordings, pixel, derive_seed(seed, draw)), edges, sampling)
        total = {kind: total.get(kind, np.float32(0)) + m / np.float32(_DRAWS) for kind, m in maps.items()}
    return total


def _maps(events: Sequence[Events], edges: list[NDArray[np.int64]], sampling: Sampling) -> Maps:
    """Return the counts and the surfaces of all recordings, one after the other."""
    pairs = list(zip(events, edges, strict=True))
    return {
        "counts": np.concatenate([_block_counts(e, instants) for e, instants in pairs]),
        "surfaces": np.concatenate([_surfaces(e, instants, sampling) for e, instants in pairs]),
    }


def _block_counts(events: Events, edges_us: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the mean events a pixel in blocks of the sensor between two instants, float32 [N, 2, h, w]."""
    bins = len(edges_us) - 1
    when = np.searchsorted(edges_us, events.t_us, side="left") - 1
    inside = (when >= 0) & (when < bins)
    place = ((when * 2 + ~events.p) * events.height + events.y) * events.width + events.x
    counts = np.bincount(place[inside], minlength=bins * 2 * events.height * events.width)
    full = counts.reshape(bins, 2, events.height, events.width)
    return reduce_by_area(full, (-(-events.height // _BLOCK_PX), -(-events.width // _BLOCK_PX)))


def _surfaces(events: Events, edges_us: NDArray[np.int64], sampling: Sampling) -> NDArray[np.float32]:
    """Return the time surfaces of a standard sample, float32 [N, 2, h, w]."""
    blank = np.zeros((len(edges_us) - 1, events.height, events.width), np.uint8)
    return make_samples(blank, 1.0, events, edges_us, sampling).surface


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
