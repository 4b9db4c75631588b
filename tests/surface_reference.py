"""The time surfaces as their definitions say, event by event: slow, obvious, what the kernels must equal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evnlos.events import TraceLaw
from evnlos.types import Events


def neighbours(
    row: int, column: int, radius: int, shape: str, height: int, width: int
) -> list[tuple[int, int]]:
    """Return the pixels of the sensor within `radius` of a pixel, itself among them."""
    found = []
    for v in range(row - radius, row + radius + 1):
        for u in range(column - radius, column + radius + 1):
            near = shape == "box" or (v - row) ** 2 + (u - column) ** 2 <= radius**2
            if near and 0 <= v < height and 0 <= u < width:
                found.append((v, u))
    return found


def _mean_or_latest(
    mode: str, latest: dict, sign: int, near: list[tuple[int, int]], t: int, tau_us: float, area: int
) -> float:
    times = [latest[sign, v, u] for v, u in near if (sign, v, u) in latest]
    if not times:
        return 0.0
    if mode == "context":
        return float(np.exp(-(t - max(times)) / tau_us))
    return float(sum(np.exp(-(t - before) / tau_us) for before in times) / area)


def time_surface_reference(
    events: Events,
    edges_us: NDArray[np.int64],
    tau_us: float,
    mode: str = "sae",
    *,
    radius: int = 1,
    shape: str = "box",
    border: str = "crop",
    projection: str = "sum",
    include_self: bool = False,
    carry: bool = True,
) -> NDArray[np.float64]:
    """Return what `time_surface` returns, in double precision."""
    grids = len(edges_us) - 1
    out = np.zeros((grids, 2, events.height, events.width))
    latest: dict[tuple[int, int, int], int] = {}
    whole_area = len(neighbours(radius, radius, radius, shape, 2 * radius + 1, 2 * radius + 1))
    for grid in range(grids):
        start, stop = edges_us[grid], edges_us[grid + 1]
        if not carry:
            latest = {}
        for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True):
            row, column, sign = int(y), int(x), 0 if p else 1
            early = t <= start
            if t > stop or (early and not (carry and grid == 0)):
                continue
            if include_self:
                latest[sign, row, column] = int(t)
            if not early and mode != "sae":
                near = neighbours(row, column, radius, shape, events.height, events.width)
                area = whole_area if border == "zero" else len(near)
                value = _mean_or_latest(mode, latest, sign, near, int(t), tau_us, area)
                held = out[grid, sign, row, column]
                out[grid, sign, row, column] = {"sum": held + value, "last": value, "max": max(held, value)}[
                    projection
                ]
            latest[sign, row, column] = int(t)
        if mode == "sae":
            for (sign, row, column), t in latest.items():
                out[grid, sign, row, column] = np.exp(-(stop - t) / tau_us)
    return out


def causal_trace_reference(
    events: Events, edges_us: NDArray[np.int64], tau_us: float, law: TraceLaw
) -> NDArray[np.float64]:
    """Return what the causal `event_trace` returns, from covariances of x at two instants, event by event."""
    begin = int(events.t_us[0]) - 1
    out = np.zeros((len(edges_us) - 1, 2, events.height, events.width))

    def given(mean: float, variance: float, elapsed: float, change: float, error: float) -> tuple:
        """Return mean and variance of x where its change was seen with an error, and how likely that was."""
        phi = np.exp(-elapsed / tau_us)
        walk = law.spread**2 * (1 - phi**2)
        before, now = np.array([1.0, 0.0]), np.array([phi, 1.0])  # of the last x and the noise since
        own, step = np.diag([variance, walk]), now - before
        middle = np.array([mean, 0.0])
        seen = step @ own @ step + error
        gain = own @ step / seen
        middle = middle + gain * (change - step @ middle)
        likely = np.exp(-((change - step @ np.array([mean, 0.0])) ** 2) / (2 * seen)) / np.sqrt(seen)
        own = own - np.outer(gain, step @ own)
        return now @ middle, now @ own @ now, likely

    for row in range(events.height):
        for column in range(events.width):
            mine = (events.x == column) & (events.y == row)
            for grid, edge in enumerate(edges_us[1:]):
                mean, variance, last = 0.0, law.spread**2, begin
                for number, (t, on) in enumerate(zip(events.t_us[mine], events.p[mine], strict=True)):
                    if t > edge:
                        break
                    aim, error = (1.0, law.crossing) if number else (0.5, law.quiet)
                    sign = 1.0 if on else -1.0
                    each = [given(mean, variance, t - last, sign * aim, error)]
                    each.append(given(mean, variance, t - last, 0.0, law.quiet))
                    weights = np.array([(1 - law.noise) * each[0][2], law.noise * each[1][2]])
                    weights /= weights.sum()
                    means, variances = (np.array([one[k] for one in each]) for k in (0, 1))
                    mean = weights @ means
                    variance, last = weights @ (variances + (means - mean) ** 2), t
                x, spread, _ = given(mean, variance, edge - last, 0.0, law.quiet)
                known = 1 - spread / law.spread**2
                out[grid, :, row, column] = (known + x) / 2, (known - x) / 2
    return out


def event_trace_reference(
    events: Events, edges_us: NDArray[np.int64], tau_us: float, law: TraceLaw
) -> NDArray[np.float64]:
    """Return what `event_trace` returns, from whole covariances: one matrix for all instants of a pixel."""
    begin = min(int(edges_us[0]), int(events.t_us[0]) - 1) if len(events) else int(edges_us[0])
    out = np.zeros((len(edges_us) - 1, 2, events.height, events.width))
    for row in range(events.height):
        for column in range(events.width):
            mine = (events.x == column) & (events.y == row)
            times = np.concatenate([[begin], events.t_us[mine]]).astype(float)
            aim, error = np.where(events.p[mine], 1.0, -1.0), np.full(len(times) - 1, law.crossing)
            aim[:1], error[:1] = 0.5 * aim[:1], law.quiet
            signal = np.full(len(aim), 1 - law.noise)

            def moments(now: NDArray, but: int | None, said: tuple) -> tuple[NDArray, NDArray]:
                """Return mean and covariance at the events and `now`, without what event `but` says."""
                times, aim, error, signal = said
                instants = np.append(times, now)
                decay = np.exp(-np.abs(instants[:, None] - instants) / tau_us)
                precision, weighted = np.linalg.inv(law.spread**2 * decay), np.zeros(len(instants))
                for k in range(len(aim)):
                    step = np.zeros(len(instants))
                    step[k], step[k + 1] = -1.0, 1.0
                    if k != but:
                        weight = signal[k] / error[k] + ((1 - signal[k]) / law.quiet if k else 0.0)
                        precision += weight * np.outer(step, step)
                        weighted += signal[k] / error[k] * aim[k] * step
                for k, t in enumerate(now, start=len(times)):  # no threshold was met since the last event
                    step = np.zeros(len(instants))
                    step[k], step[np.searchsorted(times, t, side="right") - 1] = 1.0, -1.0
                    precision += np.outer(step, step) / law.quiet
                covariance = np.linalg.inv(precision)
                return covariance @ weighted, covariance

            for _ in range(law.sweeps):
                found = signal.copy()
                for k in range(len(aim)):
                    mean, covariance = moments(np.empty(0), k, (times, aim, error, signal))
                    step = np.zeros(len(times))
                    step[k], step[k + 1] = -1.0, 1.0
                    change, variance = step @ mean, step @ covariance @ step
                    of_signal, of_noise = (
                        share * np.exp(-((at - change) ** 2) / (2 * (own + variance))) / np.sqrt(own + variance)
                        for share, at, own in ((1 - law.noise, aim[k], error[k]), (law.noise, 0.0, law.quiet))
                    )
                    found[k] = of_signal / (of_signal + of_noise)
                signal = found
            for grid, now in enumerate(edges_us[1:]):
                mean, covariance = moments(np.array([float(now)]), None, (times, aim, error, signal))
                known = 1 - covariance[-1, -1] / law.spread**2
                out[grid, :, row, column] = (known + mean[-1]) / 2, (known - mean[-1]) / 2
    return out
