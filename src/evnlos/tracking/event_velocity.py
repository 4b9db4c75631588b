"""How fast the picture of the object slides, from the events between its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.dataset.sampling import reduce_by_area
from evnlos.events import event_histogram
from evnlos.tracking.registration import Registration
from evnlos.types import Events

_FLOOR = 0.02  # of the frames' peak: light below has no logarithm worth a slope
_LEAST_EVENTS = 200
_WINDOWS_AT_A_TIME = 64


@dataclass(frozen=True, eq=False)
class EventVelocity:
    """Velocities of the picture.

    Args:
        time_s: Middle of each window, [M], seconds.
        velocity: (x, y), float64 [M, 2], pixels a second, of the reduced frames.
        variance: Of each component, [M, 2].
    """

    time_s: NDArray[np.float64]
    velocity: NDArray[np.float64]
    variance: NDArray[np.float64]


def event_velocity(
    events: Events, found: Registration, times_s: NDArray[np.float64], window_s: float
) -> EventVelocity | None:
    """Return the velocity in windows between the first and the last frame, None where events say nothing.

    A sliding picture changes a pixel's log light L by -grad L . d for a small displacement d, and the pixel
    sends an ON event for each rise by its threshold, an OFF event for each fall. Thresholds and noise rates are
    not known: they are found as the two lines (rate of events over expected change) that fit the frames' own
    displacements. Then ON / a - OFF / b in each window is a linear function of d, solved by least squares with
    the variance of Poisson counts.

    Args:
        events: The stream.
        found: Template and places from the frames.
        times_s: Instants of the frames on the events' clock, [N], seconds.
        window_s: Length of a window, seconds.
    """
    count = int(np.floor((times_s[-1] - times_s[0]) / window_s + 1e-9))
    if count < 1 or len(events) < _LEAST_EVENTS:
        return None
    edges = times_s[0] + np.arange(count + 1) * window_s
    middle = (edges[:-1] + edges[1:]) / 2
    shape = (found.background.shape[0], found.background.shape[1])
    counts = _counts(events, edges, shape)  # [M, 2, P], events a reduced pixel
    place, ends = _between(found.place_px, times_s, middle), _between(found.place_px, times_s, edges)
    slopes = _log_slopes(found, place, shape)  # [M, 2, P]
    change = -np.einsum("maP,ma->mP", slopes, np.diff(ends, axis=0))
    lines = [_line(counts[:, k].ravel(), np.maximum(sign * change, 0).ravel()) for k, sign in ((0, 1), (1, -1))]
    (dark_on, on), (dark_off, off) = lines
    if not (on > 0 and off > 0):
        return None
    signed = (counts[:, 0] - dark_on) / on - (counts[:, 1] - dark_off) / off
    rate = (dark_on + on * np.maximum(change, 0)) / on**2 + (dark_off + off * np.maximum(-change, 0)) / off**2
    # A pixel has no opinion before its light has changed by about a threshold since the recording began.
    awake = np.cumsum(np.abs(change), axis=0) >= 0.5 * (1 / on + 1 / off)
    weight = awake / np.maximum(rate, 1e-12)
    normal = np.einsum("maP,mbP,mP->mab", slopes, slopes, weight)
    right = -np.einsum("maP,mP,mP->ma", slopes, signed, weight)
    told = np.linalg.eigvalsh(normal)[:, 0] > 1e-9
    if not told.any():
        return None
    middle, slopes, signed, weight = middle[told], slopes[told], signed[told], weight[told]
    inverse, right = np.linalg.inv(normal[told]), right[told]
    moved = np.einsum("mab,mb->ma", inverse, right)
    left = signed + np.einsum("maP,ma->mP", slopes, moved)
    spread = float(
        (np.square(left) * weight).sum() / np.count_nonzero(weight)
    )  # above 1 where the picture is not what was thought
    variance = np.diagonal(inverse, axis1=1, axis2=2) * max(spread, 1.0) / window_s**2
    return EventVelocity(middle, moved / window_s, variance)


def _counts(events: Events, edges_s: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the events of each window, polarity and reduced pixel, [M, 2, P]."""
    edges = np.round(edges_s * 1e6).astype(np.int64)
    scale = events.height * events.width / (shape[0] * shape[1])
    parts = []
    for start in range(0, len(edges) - 1, _WINDOWS_AT_A_TIME):
        full = event_histogram(events, edges[start : start + _WINDOWS_AT_A_TIME + 1])
        parts.append(reduce_by_area(full, shape) * scale)
    return np.concatenate(parts).reshape(len(edges) - 1, 2, -1).astype(np.float64)


def _log_slopes(
    found: Registration, place_px: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the slopes (x, y) of the log light with the object at each place, [M, 2, P], a pixel."""
    floor = _FLOOR * float(found.template.max())
    slopes = np.empty((len(place_px), 2, shape[0] * shape[1]))
    for k, place in enumerate(place_px):
        light = found.picture(place, shape).numpy()
        # What rests has slopes too, but they do not move.
        down, across = (g / np.maximum(light + found.background, floor) for g in np.gradient(light))
        slopes[k] = across.ravel(), down.ravel()
    return slopes


def _line(counts: NDArray[np.float64], change: NDArray[np.float64]) -> tuple[float, float]:
    """Return (events without change, events a unit of change) by least squares."""
    columns = np.stack([np.ones_like(change), change], axis=1)
    dark, slope = np.linalg.lstsq(columns, counts, rcond=None)[0].tolist()
    return max(dark, 1e-6), slope


def _between(
    place: NDArray[np.float64], times_s: NDArray[np.float64], at_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.stack([np.interp(at_s, times_s, place[:, k]) for k in range(2)], axis=-1)
