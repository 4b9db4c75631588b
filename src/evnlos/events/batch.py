"""What a network is fed of events: the trace, log light smoothed over them, and batches of any map as tensors.

The trace: an event says by how much the log light of a pixel moved since the event before it, and no event says
that it moved by less. With the log light x in units of the threshold, at the instants t_0 (the beginning) and
t_1 .. t_n (the pixel's events), and s_k = +1 (ON) or -1 (OFF):

- x is stationary, of mean 0 and variance sigma^2: x_k = phi x_(k-1) + noise, phi = exp(-(t_k - t_(k-1)) / tau);
- x_k - x_(k-1) is s_k with variance r, or, where the event is noise, anything between the thresholds;
- which of both, sweeps decide: the probability of a signal is that of s_k given the pixel's other events.

Both neighbours of an instant are all that it depends on, so that two walks over the events of a pixel, forward
and back, give mean and variance of x anywhere (Rauch, Tung and Striebel, AIAA Journal 3, 1965; here with
precisions). The causal trace is the walk forward alone: each event is judged once, as it comes, by what was
expected of x_k - x_(k-1), and the mixture of signal and noise becomes the Gaussian of its mean and variance.

| symbol | meaning | unit |
|---|---|---|
| x | log light above its mean | thresholds |
| tau | correlation time | microseconds |
| sigma, r | `TraceLaw.spread`, square root of `TraceLaw.crossing` | thresholds |
| q | 1 / (sigma^2 (1 - phi^2)), precision of a step | 1 / thresholds squared |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.events.surface import time_surface
from evnlos.events.volume import (
    as_edges,
    event_frame,
    event_histogram,
    intensity_map,
    threshold_ordinal_surface,
    voxel_grid,
)
from evnlos.types import Events

if TYPE_CHECKING:
    import torch


class TraceLaw(NamedTuple):
    """What the trace takes the light and the crossings for.

    Args:
        spread: Standard deviation of the log light, thresholds.
        crossing: Variance of a crossing, thresholds squared.
        noise: Share of the events that are noise, before anything is known of them.
        quiet: Variance of a change that met no threshold, thresholds squared: 1/3 is uniform between both.
        sweeps: How often the probabilities of signals are brought up to date.
    """

    spread: float = 2.0
    crossing: float = 0.08
    noise: float = 0.2
    quiet: float = 1.0 / 3.0
    sweeps: int = 4


@njit(cache=True, inline="always")
def _step(elapsed, tau, law):
    """Return phi and q of a step of `elapsed` microseconds."""
    phi = np.exp(-elapsed / tau)
    return phi, 1.0 / (law.spread**2 * max(1.0 - phi * phi, 1e-9))


@njit(cache=True, inline="always")
def _jump(first, signal, sign, law):
    """Return precision and precision times mean of x_k - x_(k-1), for a signal's probability.

    A pixel begins anywhere between two thresholds: its first event says half a threshold, give or take.
    """
    if first:
        return signal / law.quiet, 0.5 * signal * sign / law.quiet
    return signal / law.crossing + (1.0 - signal) / law.quiet, signal * sign / law.crossing


@njit(cache=True)
def _walk_forward(times, signs, signal, tau, law, precision, weighted):
    """Fill precision and precision times mean of each x_k given the events up to k, [n + 1] both."""
    precision[0], weighted[0] = 1.0 / law.spread**2, 0.0
    for k in range(1, len(times)):
        phi, q = _step(times[k] - times[k - 1], tau, law)
        jump, aim = _jump(k == 1, signal[k], signs[k], law)
        before = precision[k - 1] + phi * phi * q + jump
        mixed = phi * q + jump
        precision[k] = q + jump - mixed * mixed / before
        weighted[k] = aim + mixed * (weighted[k - 1] - aim) / before


@njit(cache=True)
def _walk_back(times, signs, signal, tau, law, precision, weighted):
    """Fill precision and precision times mean of each x_k by the events after k alone, [n + 1] both."""
    last = len(times) - 1
    precision[last] = weighted[last] = 0.0
    for k in range(last, 0, -1):
        phi, q = _step(times[k] - times[k - 1], tau, law)
        jump, aim = _jump(k == 1, signal[k], signs[k], law)
        after = precision[k] + q + jump
        mixed = phi * q + jump
        precision[k - 1] = phi * phi * q + jump - mixed * mixed / after
        weighted[k - 1] = -aim + mixed * (weighted[k] + aim) / after


@njit(cache=True)
def _judge(times, signs, signal, tau, law, left, right):
    """Bring the probability of a signal up to date, of each event, by what the others say of its change."""
    for k in range(1, len(times)):
        phi, q = _step(times[k] - times[k - 1], tau, law)
        a, b, c = left[0][k - 1] + phi * phi * q, -phi * q, right[0][k] + q
        determinant = a * c - b * b
        start = (c * left[1][k - 1] - b * right[1][k]) / determinant
        end = (a * right[1][k] - b * left[1][k - 1]) / determinant
        change, variance = end - start, (a + c + 2.0 * b) / determinant
        aim, own = (0.5 * signs[k], law.quiet) if k == 1 else (1.0 * signs[k], law.crossing)
        likely = np.exp(-0.5 * (aim - change) ** 2 / (own + variance)) / np.sqrt(own + variance)
        other = np.exp(-0.5 * change**2 / (law.quiet + variance)) / np.sqrt(law.quiet + variance)
        signal[k] = (1.0 - law.noise) * likely / ((1.0 - law.noise) * likely + law.noise * other + 1e-300)


@njit(cache=True)
def _read(times, signs, signal, tau, law, left, right, edges, out, pixel):
    """Write sum and difference of what is known and the mean, at the end of each grid, [grids, 2, P]."""
    k, last = 0, len(times) - 1
    for grid in range(len(edges) - 1):
        now = edges[grid + 1]
        while k < last and times[k + 1] <= now:
            k += 1
        # x at t_k (a), now (b), and at t_(k+1) (c); what was met by now lies between the thresholds of x_k
        phi, q = _step(now - times[k], tau, law)
        quiet = 1.0 / law.quiet
        aa, ab, bb = left[0][k] + phi * phi * q + quiet, phi * q + quiet, q + quiet
        ha, hb = left[1][k], 0.0
        if k < last:
            then, w = _step(times[k + 1] - now, tau, law)
            jump, aim = _jump(k == 0, signal[k + 1], signs[k + 1], law)
            cc = right[0][k + 1] + w + jump
            hc = right[1][k + 1] + aim
            aa += jump - jump * jump / cc
            bb += then * then * w - (then * w) ** 2 / cc
            ab += jump * then * w / cc
            ha += -aim + jump * hc / cc
            hb += then * w * hc / cc
        precision = bb - ab * ab / aa
        mean = (hb + ab * ha / aa) / precision
        known = 1.0 - 1.0 / (precision * law.spread**2)
        out[grid, 0, pixel] = 0.5 * (known + mean)
        out[grid, 1, pixel] = 0.5 * (known - mean)


@njit(cache=True)
def _fill(order, starts, t_us, p, begin, edges, tau, law, out):
    """Fill [grids, 2, P]: the events of pixel i are those of `order` from starts[i] to starts[i + 1]."""
    most = 1
    for pixel in range(len(starts) - 1):
        most = max(most, starts[pixel + 1] - starts[pixel] + 1)
    times, signs, signal = np.empty(most), np.empty(most), np.empty(most)
    left, right = np.empty((2, most)), np.empty((2, most))
    for pixel in range(len(starts) - 1):
        size = starts[pixel + 1] - starts[pixel] + 1
        times[0], signs[0], signal[0] = begin, 0.0, 1.0
        for k in range(1, size):
            event = order[starts[pixel] + k - 1]
            times[k] = t_us[event]
            signs[k] = 1.0 if p[event] else -1.0
            signal[k] = 1.0 - law.noise
        now = times[:size], signs[:size], signal[:size]
        for sweep in range(law.sweeps + 1):
            _walk_forward(*now, tau, law, left[0], left[1])
            _walk_back(*now, tau, law, right[0], right[1])
            if sweep < law.sweeps and size > 1:
                _judge(*now, tau, law, left, right)
        _read(*now, tau, law, left, right, edges, out, pixel)


@njit(cache=True, inline="always")
def _later(mean, variance, elapsed, tau, law):
    """Return mean and variance of x and of its change, and their covariance, `elapsed` after the last event."""
    phi = np.exp(-elapsed / tau)
    walk = law.spread**2 * max(1.0 - phi * phi, 1e-9)
    change, spread = (phi - 1.0) * mean, (phi - 1.0) ** 2 * variance + walk
    return phi * mean, phi * phi * variance + walk, change, spread, phi * (phi - 1.0) * variance + walk


@njit(cache=True)
def _follow(t_us, x, y, p, tau, law, state):
    """Bring what is known of x at each pixel's last event up to date: its mean, variance, time, 1 = had one."""
    for k in range(len(t_us)):
        now = state[:, y[k], x[k]]
        mean, variance, change, spread, common = _later(now[0], now[1], t_us[k] - now[2], tau, law)
        sign = 1.0 if p[k] else -1.0
        aim, own = (sign, law.crossing) if now[3] else (0.5 * sign, law.quiet)
        likely = np.exp(-0.5 * (aim - change) ** 2 / (own + spread)) / np.sqrt(own + spread)
        other = np.exp(-0.5 * change**2 / (law.quiet + spread)) / np.sqrt(law.quiet + spread)
        signal = (1.0 - law.noise) * likely / ((1.0 - law.noise) * likely + law.noise * other + 1e-300)
        gain, quiet = common / (spread + own), common / (spread + law.quiet)
        if_signal, if_noise = mean + gain * (aim - change), mean - quiet * change
        now[0] = signal * if_signal + (1.0 - signal) * if_noise
        now[1] = variance - (signal * gain + (1.0 - signal) * quiet) * common
        now[1] += signal * (1.0 - signal) * (if_signal - if_noise) ** 2
        now[2], now[3] = t_us[k], 1.0


@njit(cache=True)
def _present(state, t_us, tau, law, out):
    """Write sum and difference of what is known and the mean at an instant, [2, H, W]."""
    for row in range(state.shape[1]):
        for column in range(state.shape[2]):
            now = state[:, row, column]
            mean, variance, change, spread, common = _later(now[0], now[1], t_us - now[2], tau, law)
            quiet = common / (spread + law.quiet)  # no threshold was met since
            mean, known = mean - quiet * change, 1.0 - (variance - quiet * common) / law.spread**2
            out[0, row, column], out[1, row, column] = 0.5 * (known + mean), 0.5 * (known - mean)


class RunningTrace:
    """The trace of a stream so far: `event_trace(..., causal=True)`, at any instant from its newest event on.

    The pixels begin to watch at the first event of the stream. Work grows with the events, and a map costs one
    exponential a pixel.

    Args:
        height: Sensor height, pixels.
        width: Sensor width, pixels.
        tau_us: Correlation time of the light, microseconds, above 0.
        law: What the light and the crossings are taken for; None is the default.

    Raises:
        DataError: A number is outside its range.
    """

    def __init__(self, height: int, width: int, tau_us: float, law: TraceLaw | None = None) -> None:
        self._law, self._tau_us = law or TraceLaw(), float(tau_us)
        _check_law(tau_us, self._law)
        self._begin_us: int | None = None
        self._state = np.zeros((4, height, width))
        self._state[1] = self._law.spread**2

    def add(self, events: Events) -> None:
        """Take the next events of the stream."""
        if not len(events):
            return
        if self._begin_us is None:
            self._begin_us = int(events.t_us[0]) - 1
        times = (events.t_us - self._begin_us).astype(np.float64)
        _follow(times, events.x, events.y, events.p, self._tau_us, self._law, self._state)

    def at(self, t_us: int) -> NDArray[np.float32]:
        """Return the trace at an instant, float32 [2, H, W]."""
        out = np.empty((2, *self._state.shape[1:]), np.float32)
        since_us = 0.0 if self._begin_us is None else max(float(t_us - self._begin_us), 0.0)
        _present(self._state, since_us, self._tau_us, self._law, out)
        return out


def _check_law(tau_us: float, law: TraceLaw) -> None:
    if not (np.isfinite(tau_us) and tau_us > 0):
        raise DataError(f"tau_us is {tau_us}; give a positive number of microseconds")
    if not (min(law.spread, law.crossing, law.quiet) > 0 and 0 < law.noise < 1 and law.sweeps >= 0):
        raise DataError(f"{law}: spread, crossing and quiet are positive, noise lies between 0 and 1")


def event_trace(
    events: Events, edges_us: ArrayLike, tau_us: float, law: TraceLaw | None = None, *, causal: bool = False
) -> NDArray[np.float32]:
    """Return the log light of each pixel at the end of each grid, smoothed over all its events.

    Unlike a time surface it looks at events before and after, unless it is causal. What is known is
    1 - variance / spread^2, 0 where events tell nothing; the mean is in thresholds above the pixel's own mean.
    ON - OFF is the mean, ON + OFF is what is known.

    Args:
        events: The stream; it is not changed.
        edges_us: Ascending edges, [grids + 1], microseconds; events after the last one count as well.
        tau_us: Correlation time of the light, microseconds, above 0.
        law: What the light and the crossings are taken for; None is the default.
        causal: Whether only the events up to the end of a grid count, as of `RunningTrace`.

    Returns:
        float32 [grids, 2, H, W], (known + mean) / 2 and (known - mean) / 2.

    Raises:
        DataError: The edges do not ascend, or a number is outside its range.

    Example:
        >>> events = Events([500, 900], [0, 0], [0, 0], [True, True], width=2, height=1)
        >>> on, off = event_trace(events, [0, 1000], tau_us=1e4)[0]
        >>> [round(float(mean), 2) for mean in (on - off)[0]]
        [0.43, 0.0]
    """
    edges = as_edges(edges_us)
    law = law or TraceLaw()
    _check_law(tau_us, law)
    if causal:
        running = RunningTrace(*events.shape, tau_us, law)
        ends = np.searchsorted(events.t_us, edges, side="right")
        ends[0], found = 0, np.empty((len(edges) - 1, 2, *events.shape), np.float32)
        for grid in range(len(found)):
            running.add(events[ends[grid] : ends[grid + 1]])
            found[grid] = running.at(int(edges[grid + 1]))
        return found
    pixel = events.y.astype(np.int64) * events.width + events.x
    order = np.argsort(pixel, kind="stable")
    starts = np.searchsorted(pixel[order], np.arange(events.width * events.height + 1))
    origin = min(int(edges[0]), int(events.t_us[0]) - 1) if len(events) else int(edges[0])
    out = np.empty((len(edges) - 1, 2, events.height * events.width), np.float32)
    times = (events.t_us - origin).astype(np.float64)
    _fill(order, starts, times, events.p, 0.0, (edges - origin).astype(np.float64), float(tau_us), law, out)
    return out.reshape(len(out), 2, events.height, events.width)


TRACE_TAUS = 10.0
"""Correlation time of the trace beside a surface of active events, in time constants of that surface."""


def surface_with_trace(events: Events, edges_us: ArrayLike, tau_us: float) -> NDArray[np.float32]:
    """Return surfaces of active events and, beside them, the causal trace of `TRACE_TAUS` times their constant.

    Args:
        events: The stream; it is not changed.
        edges_us: Ascending edges, [grids + 1], microseconds.
        tau_us: Time constant of the surface, microseconds, above 0.

    Returns:
        float32 [grids, 4, H, W]: ON and OFF of `time_surface`, then those of `event_trace`.
    """
    surface = time_surface(events, edges_us, tau_us)
    trace = event_trace(events, edges_us, TRACE_TAUS * tau_us, causal=True)
    return np.concatenate([surface, trace], axis=1)


Representation = Literal["histogram", "frame", "voxel", "surface", "trace", "ordinal", "intensity"]


def _until(events: Events, stop_us: int | None) -> list[int]:
    """Return the edges of one grid that ends at `stop_us`, by default at the last event."""
    if stop_us is None:
        stop_us = int(events.t_us[-1]) if len(events) else 1
    return [min(int(events.t_us[0]), stop_us) - 1 if len(events) else stop_us - 1, stop_us]


def _surface(events: Events, *, tau_us: float, stop_us: int | None = None, **options: Any) -> NDArray:
    return time_surface(events, _until(events, stop_us), tau_us, **options)[0]


def _trace(events: Events, *, tau_us: float, stop_us: int | None = None, **options: Any) -> NDArray:
    return event_trace(events, _until(events, stop_us), tau_us, **options)[0]


_MAKERS: dict[str, Callable[..., NDArray]] = {
    "histogram": lambda events: event_histogram(events)[0],
    "frame": lambda events, **options: event_frame(events, **options),
    "voxel": lambda events, **options: voxel_grid(events, **options),
    "surface": _surface,
    "trace": _trace,
    "ordinal": lambda events, **options: threshold_ordinal_surface(events, **options)[None],
    "intensity": lambda events, **options: intensity_map(events, **options),
}

_NEEDED = {"voxel": {"bins": 5}, "surface": {"tau_us": 30_000}, "trace": {"tau_us": 1_000_000}}
"""Options without a default, with an example of each."""


def event_batch(
    streams: Sequence[Events],
    representation: Representation = "histogram",
    *,
    device: str | torch.device | None = None,
    **options: Any,
) -> torch.Tensor:
    """Return one map a stream as a tensor [B, C, H, W].

    Args:
        streams: Streams of one sensor size, at least one; they are not changed and may be empty of events.
        representation: "histogram" (2 channels: ON, OFF), "frame" (1), "voxel" (`bins=`), "surface" (2;
            `tau_us=`, and `stop_us=`, `mode=`, `radius=`, ...), "trace" (2; `tau_us=`, and `stop_us=`, `law=`),
            "ordinal" (1) or "intensity" (1); options are those of `event_frame`, `voxel_grid`, `time_surface`,
            `event_trace`, `threshold_ordinal_surface`, `intensity_map`.
        device: Where the tensor goes, by default it stays in main memory.
        **options: Options of the representation, the same for all streams.

    Returns:
        float32 [B, C, H, W], "ordinal" uint8.

    Raises:
        DataError: No stream, streams of several sensors, or an option that the representation does not have.

    Example:
        >>> one = Events([5, 6], [0, 1], [0, 0], [True, False], width=2, height=1)
        >>> event_batch([one, one[:1]]).tolist()
        [[[[1.0, 0.0]], [[0.0, 1.0]]], [[[1.0, 0.0]], [[0.0, 0.0]]]]
    """
    import torch

    if representation not in _MAKERS:
        raise DataError(f"representation is {representation!r}; give one of {', '.join(_MAKERS)}")
    if not streams:
        raise DataError("no streams of events; give at least one")
    for events in streams:
        if events.shape != streams[0].shape:
            raise DataError(f"sensors of {streams[0].shape} and {events.shape} pixels; batch one size")
    make = _MAKERS[representation]
    lacking = [name for name in _NEEDED.get(representation, {}) if name not in options]
    if lacking:
        example = ", ".join(f"{name}={_NEEDED[representation][name]}" for name in lacking)
        raise DataError(f"{representation} needs {'= and '.join(lacking)}=; give e.g. {example}")
    batch: torch.Tensor | None = None
    for number, events in enumerate(streams):
        try:
            maps = make(events, **options)  # [C, H, W]
        except TypeError as error:
            raise DataError(f"{representation} cannot be made with {sorted(options)}: {error}") from None
        if batch is None:
            batch = torch.empty((len(streams), *maps.shape), dtype=torch.from_numpy(maps).dtype)
        batch[number] = torch.from_numpy(maps)
    assert batch is not None
    return batch if device is None else batch.to(device)


def events_from_tensors(
    t_us: torch.Tensor | ArrayLike,
    x: torch.Tensor | ArrayLike,
    y: torch.Tensor | ArrayLike,
    p: torch.Tensor | ArrayLike,
    *,
    width: int,
    height: int,
) -> Events:
    """Return events of columns that may be tensors on any device; those in main memory are not copied.

    Args:
        t_us: Times, whole numbers [N], microseconds, non-decreasing.
        x: Columns, whole numbers [N].
        y: Rows, whole numbers [N].
        p: Polarities [N]: bool, 0/1 or -1/+1.
        width: Sensor width, pixels.
        height: Sensor height, pixels.

    Raises:
        DataError: As `Events`.

    Example:
        >>> import torch
        >>> events_from_tensors(torch.tensor([3]), torch.tensor([1]), [0], [-1], width=2, height=1)
        Events(1 events, 2 x 1, 3..3 us, 0 % ON)
    """
    return Events(*map(_array, (t_us, x, y, p)), width=width, height=height)


def _array(column: Any) -> NDArray:
    """Return a column that may be a tensor on any device."""
    return np.asarray(column.detach().cpu() if hasattr(column, "detach") else column)


def events_to_tensors(events: Events, device: str | torch.device | None = None) -> dict[str, torch.Tensor]:
    """Return the columns as tensors by name: t_us int64, x and y int32, p bool, adc int32 where present.

    Args:
        events: The stream.
        device: Where the tensors go, by default main memory.

    Example:
        >>> events_to_tensors(Events([3], [1], [0], [1], width=2, height=1))["p"]
        tensor([True])
    """
    import torch

    wide = {
        name: column.astype(np.int32) if column.dtype == np.uint16 else column.copy()
        for name, column in events.columns().items()
    }
    return {name: torch.from_numpy(column).to(device or "cpu") for name, column in wide.items()}
