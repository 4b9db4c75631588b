"""What all events of a sequence say of the target, in a second.

The estimate of `event_likelihood`, in single precision: from every fourth row and column first (of a larger
sensor every eighth), then a step from every second, and a last one from all. Mean thresholds are those of the
setup, and the filter counts as a delay 1 / w. What the last iteration leaves, information A and score b about
the coefficients z of the prior, is all that the events say of the target there.

| symbol | meaning | unit |
|---|---|---|
| `light` | of a pixel at a node of time, [P, T] | white levels |
| `level`, `slope` | filtered log light, its derivative by the light | log units, per white level |
| `rate`, `bend` | derivatives of level and slope by time | per second |
| `node`, `before` | of the light nearest to an instant and before it, delayed | |
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from evnlos.cameras import CrossingLaw
from evnlos.cameras.event_model import KNEE_DN, KNEE_SLOPE
from evnlos.cameras.streams import WHITE_DN
from evnlos.inverse.event_likelihood import ANNEALED, FIRST_STEPS, LikelihoodSettings, upward
from evnlos.inverse.event_record import EventRecord, record_of
from evnlos.inverse.sequence_light import Array, SequenceLight, Single
from evnlos.types import Events

_FIRST_GRIDS = ((8, 80), (4, 120), (2, 200))  # stride of rows and columns, and most factors, before all pixels
_FEWEST_PIXELS = 900  # of a grid: with a quarter of them some letters end where a wrong one explains them
_SETTLED = 0.2  # step of a coefficient, standard deviations of the prior, after which no other is made
_LONGEST_STEP = 1.5  # of a coefficient, standard deviations of the prior
_FEWEST_NOISE, _SMALLEST_NOISE = 0.01, 3e-3  # as in `event_likelihood`
_STEADY_S = 0.4
_ACTIVE = 0.01  # weight of a silence, in that of a threshold just met, below which it is left out
_SAFE = 1e-3  # white levels under which no light is taken to lie


@njit(cache=True, error_model="numpy")
def _level(bright, scale, offset):
    """Return log light of a light in DN, and its derivative by the light, per DN."""
    bright = max(scale * bright + offset, 0.0)
    if bright > KNEE_DN:
        return math.log(bright), scale / bright
    return bright * KNEE_SLOPE, scale * KNEE_SLOPE


@njit(cache=True, error_model="numpy")
def _at_instants(light, pixel, at, scale, offset, speed, floor, node, before, values):
    """Fill what the light of `pixel` [N] is at instants `at` [N], in nodes.

    scale, offset  of the logarithm;  speed, floor  of the filter: w = speed (DN + floor) per node, 0 = none
    node, before   out, [N];  values  out: level, slope, rate, bend, slope a node on, DN; [6, N]
    """
    last = light.shape[1] - 1
    for n in range(len(pixel)):
        row = light[pixel[n]]
        place = min(max(at[n], 0.0), float(last))
        k = min(int(place), last - 1)
        seen = WHITE_DN * max(row[k] + (place - k) * (row[k + 1] - row[k]), _SAFE)
        if speed > 0.0:
            place = max(place - 1.0 / (speed * (seen + floor)), 0.0)
            k = min(int(place), last - 1)
            seen = WHITE_DN * max(row[k] + (place - k) * (row[k + 1] - row[k]), _SAFE)
        level, slope = _level(seen, scale, offset)
        first, first_slope = _level(WHITE_DN * max(row[k], _SAFE), scale, offset)
        second, second_slope = _level(WHITE_DN * max(row[k + 1], _SAFE), scale, offset)
        values[0, n], values[1, n], values[5, n] = level, WHITE_DN * slope, seen
        values[2, n], values[3, n] = second - first, WHITE_DN * (second_slope - first_slope)
        values[4, n] = WHITE_DN * second_slope
        node[n], before[n] = (k if place - k < 0.5 else k + 1), k


@njit(cache=True)
def _furthest(origin, sign, change, up, down):
    """Fill where the level of each gap is furthest up and down, by the instant that it begins at; -1 = none."""
    up[:] = -1
    down[:] = -1
    for n in range(len(origin)):
        start = origin[n]
        if start >= 0 and sign[n] >= 0 and (up[start] < 0 or change[n] > change[up[start]]):
            up[start] = n
        if start >= 0 and sign[n] <= 0 and (down[start] < 0 or change[n] < change[down[start]]):
            down[start] = n


@njit(cache=True)
def _rows(seen, place, at, origin, slope, wait, rows):
    """Fill the derivatives of the changes of instants `at` by the coefficients and the leak, [n, k + 1]."""
    count = seen.shape[1]
    for n in range(len(at)):
        here, there = seen[place[at[n]]], seen[place[origin[at[n]]]]
        now, then = slope[at[n]], slope[origin[at[n]]]
        for j in range(count):
            rows[n, j] = now * here[j] - then * there[j]
        rows[n, count] = wait[at[n]]


@njit(cache=True)
def _rate_rows(moved, seen, place, slope, bend, rows):
    """Fill the derivatives of the rates by the coefficients and the leak, [n, k + 1]."""
    count = seen.shape[1]
    for n in range(len(moved)):
        here = seen[place[n]]
        for j in range(count):
            rows[n, j] = slope[n] * moved[n, j] + bend[n] * here[j]
        rows[n, count] = 1.0


@njit(cache=True)
def _sums(rows, weight, residual, group, summed, total, seen):
    """Add up w J [G, k + 1], w and w y [G] of the groups of rows; equal numbers lie side by side."""
    place = -1
    for n in range(len(weight)):
        if n == 0 or group[n] != group[n - 1]:
            place += 1
        total[place] += weight[n]
        seen[place] += weight[n] * residual[n]
        for j in range(rows.shape[1]):
            summed[place, j] += weight[n] * rows[n, j]


@dataclass(frozen=True, eq=False)
class EventStatistic:
    """What events say of the target, about an estimate of it.

    Args:
        z: The estimate, [k].
        information: J^T C^-1 J of the coefficients, the leak integrated out, [k, k].
        score: J^T C^-1 (y + J z), [k]: with a prior of weight m the estimate is (information + m)^-1 score.
    """

    z: Array
    information: Array
    score: Array

    def solutions(self, priors: tuple[float, ...]) -> Array:
        """Return the coefficients at each weight of the prior, [n, k]."""
        own = np.eye(len(self.z))
        found = [np.linalg.solve(self.information + weight * own, self.score) for weight in priors]
        return np.asarray(found, np.float64)


class EventSolver:
    """Finds the statistic of the events of a sequence; one for all sequences of a setup and a motion.

    Args:
        light: The light of the moving target.
        law: Constants of the event model.
        settings: What the likelihood takes for granted; its mean thresholds are those of the setup. None is the
            default.
    """

    def __init__(
        self, light: SequenceLight, law: CrossingLaw, settings: LikelihoodSettings | None = None
    ) -> None:
        self.light, self.law, self.settings = light, law, settings or LikelihoodSettings()
        self._left, right = light.left.astype(np.float32), light.right.astype(np.float32)
        self._right, self._seen = right, np.ascontiguousarray(right[:, :, 1:])
        self._moved = np.concatenate([np.diff(self._seen, axis=0), np.zeros_like(self._seen[:1])])
        self._step = float(light.times_s[1] - light.times_s[0])

    @cached_property
    def _coarse(self) -> list[tuple[int, EventSolver]]:
        """Strides of rows and columns, and the solvers of what is left, which start the estimate."""
        return [
            (stride, EventSolver(self.light.every(stride, rank), self.law, self.settings))
            for stride, rank in _FIRST_GRIDS
            if len(self._left) >= _FEWEST_PIXELS * stride**2
        ]

    def nothing_known(self) -> Array:
        """Return the unknowns, coefficients and what is added to the leak, before any event: zeros [k + 1]."""
        return np.zeros(self._seen.shape[2] + 1)

    def __call__(self, events: Events) -> EventStatistic:
        """Return the statistic of a sequence's events, on the clock of the light."""
        return self.solved(events, float(self.light.times_s[-1]), self.nothing_known())

    def so_far(self, events: Events, instants_s: Array) -> Iterator[EventStatistic]:
        """Yield the statistic of the events up to each instant; each estimate starts from the one before.

        Args:
            events: Of the whole sequence, on the clock of the light.
            instants_s: Ascending, within the light's, seconds.
        """
        unknown = self.nothing_known()
        for until_s in instants_s.tolist():
            yield self.solved(events, until_s, unknown)

    def solved(self, events: Events, until_s: float, unknown: Array) -> EventStatistic:
        """Return the statistic of the events up to an instant; `unknown` is changed.

        Args:
            events: On the clock of the light, later ones too.
            until_s: The instant, seconds.
            unknown: Coefficients and what is added to the leak, [k + 1], to start from.
        """
        span = (float(self.light.times_s[0]), until_s)
        record = record_of(events, self.law, span, self.settings.gap_s)
        noises = self.settings.noise_in(np.arange(FIRST_STEPS), ANNEALED)
        for stride, solver in self._coarse:
            solver.improve(record.every(stride, events.width), unknown, noises)
            noises = noises[-1:]
        return self.improve(record, unknown, noises)

    def improve(self, record: EventRecord, unknown: Array, noises: Array) -> EventStatistic:
        """Return the statistic after a Gauss-Newton step at each error of a crossing; `unknown` is changed.

        Args:
            record: The events.
            unknown: Coefficients and what is added to the leak, [k + 1], to start from.
            noises: Least errors of a crossing, log units, one an iteration; a short step at the last ends it.
        """
        count, trust = len(unknown) - 1, np.ones(int(record.measured.sum()))
        known = np.append(np.ones(count), self.settings.leak_error**-2)
        information, score = np.zeros((count + 1, count + 1)), np.zeros(count + 1)
        for least in noises:
            information, score = self._equations(record, unknown, float(least), trust)
            step = np.linalg.solve(information + np.diag(known), score - known * unknown)
            score = score + information @ unknown
            longest = max(float(np.abs(step[:count]).max()), 1e-12)
            unknown += step * min(1.0, _LONGEST_STEP / longest)
            if least == noises[-1] and longest < _SETTLED:
                break
        leak = information[:count, count]
        share = leak / (information[count, count] + known[count])
        return EventStatistic(
            unknown[:count].copy(),
            information[:count, :count] - np.outer(share, leak),
            score[:count] - share * score[count],
        )

    def _equations(
        self, record: EventRecord, unknown: Array, least: float, trust: Array
    ) -> tuple[Array, Array]:
        """Return information and score about the unknowns, and bring `trust` of the crossings up to date."""
        law, count, size = self.law, len(unknown) - 1, 2 * len(self._left)
        factor = self._right @ np.append(1.0, unknown[:count]).astype(np.float32)  # [T, r]
        light = self._left @ factor.T + self.light.still
        node, before = np.empty((2, len(record)), np.int64)
        values = np.empty((6, len(record)))
        speed = self._step * 2 * math.pi * law.cutoff_hz / (255.0 + law.floor_dn)
        at = (record.t_s - self.light.times_s[0]) / self._step
        shape = (law.curve.scale, law.curve.offset, speed * law.exposure, law.floor_dn / law.exposure)
        _at_instants(light, record.pixel, at, *shape, node, before, values)
        level, slope, rate, bend, after, seen_dn = values
        fall = law.fall(WHITE_DN * light.mean(axis=1))[record.pixel] + unknown[count]
        wait = np.where(record.origin >= 0, record.t_s - record.t_s[record.origin], 0.0)
        change = np.where(record.origin >= 0, level - level[record.origin] + fall * wait, 0.0)
        crossed = np.flatnonzero(record.measured)
        sign = record.sign[crossed].astype(np.float64)
        of = 2 * record.pixel[crossed] + (sign > 0)
        residual = np.where(sign > 0, law.threshold_on, -law.threshold_off) - change[crossed]
        residual -= law.lead(sign, record.sign[record.origin[crossed]])
        walk = law.noise**2 + law.walk_variance(seen_dn[crossed]) * wait[crossed]
        upwards = sign * (rate[crossed] / self._step + fall[crossed])
        spread = law.threshold_sigma**2
        pixels = 1 + int((np.diff(record.pixel) != 0).sum())  # they are in order

        def update_trust(noise: float) -> None:
            own = walk + noise**2
            weight = trust / own
            known, seen = (np.bincount(of, column, size)[of] for column in (weight, weight * residual))
            variance = spread / (1.0 + spread * np.maximum(known - weight, 0.0))
            away = residual - variance * (seen - weight * residual)
            signal = np.exp(-0.5 * away**2 / (own + variance)) / np.sqrt(2 * math.pi * (own + variance))
            signal *= upward(upwards, noise / _STEADY_S)[0]
            duration = self.light.times_s[-1] - self.light.times_s[0]
            rare = _FEWEST_NOISE * len(crossed) / (duration * pixels)
            room = torch.from_numpy(sign * away / np.sqrt(own + variance))
            false = 0.5 * max(law.events_hz, rare) * torch.special.ndtr(room).numpy()
            trust[:] = signal / (signal + np.maximum(false, 1e-300))

        update_trust(least)
        sums = np.bincount(of, trust, size)
        away = residual - (np.bincount(of, trust * residual, size) / np.maximum(sums, 1e-12))[of]
        square = float((trust * away**2)[(sums > 1.0)[of]].sum())
        freedom = max(float(np.maximum(sums - 1.0, 0.0).sum()), 1.0)
        scatter = math.sqrt(max(square / freedom - law.noise**2, 0.0))
        noise = max(least, scatter)
        update_trust(noise)
        weight = trust / (walk + noise**2)
        variance = spread / (1.0 + spread * np.bincount(of, weight, size))
        offset = -variance * np.bincount(of, weight * residual, size)
        up, down = np.empty((2, len(record)), np.int64)
        _furthest(record.origin, record.sign, change, up, down)
        parts = [(crossed, sign, weight, residual)]
        for side, furthest, theta in ((1, up, law.threshold_on), (-1, down, law.threshold_off)):
            unmet = np.ones(len(record))  # what ends a gap may be the crossing itself
            ends = sign == side
            unmet[record.origin[crossed[ends]]] = 1.0 - trust[ends]
            begin = np.flatnonzero((furthest >= 0) & (unmet > _ACTIVE))
            quiet = furthest[begin]
            group = 2 * record.pixel[quiet] + (side > 0)
            met = theta - side * law.lead(side, record.sign[begin])
            room = met + side * (offset[group] - change[quiet])
            width = np.sqrt(variance[group] + law.noise**2 + noise**2)
            scaled = torch.from_numpy(room / width)
            ratio = torch.exp(-0.5 * scaled**2 - torch.special.log_ndtr(scaled)).numpy() / math.sqrt(
                2 * math.pi
            )
            bends = np.clip(ratio * (ratio + scaled.numpy()), 0.0, 1.0)
            near = unmet[begin] * bends > _ACTIVE
            curve = bends[near] / width[near] ** 2
            precision = unmet[begin][near] * curve / np.maximum(1.0 - curve * variance[group][near], 1e-6)
            seen = side * (met[near] - room[near] - ratio[near] / width[near] / curve) - change[quiet[near]]
            parts.append((quiet[near], np.full(int(near.sum()), float(side)), precision, seen))
        at, sides, weights, seen = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((sides, record.pixel[at]))
        at, weights, seen = at[order], weights[order].astype(np.float32), seen[order].astype(np.float32)
        group = 2 * record.pixel[at] + (sides[order] > 0)
        needed = np.zeros(len(record), np.bool_)
        needed[at] = needed[record.origin[at]] = True
        place = np.cumsum(needed) - 1
        lights = self._responses(self._seen, record.pixel[needed], node[needed])
        rows = np.empty((len(at), count + 1), np.float32)
        _rows(lights, place, at, record.origin, slope, wait, rows)
        groups = 1 + int((np.diff(group) != 0).sum()) if len(group) else 0
        summed, (total, shift) = np.zeros((groups, count + 1), np.float32), np.zeros((2, groups), np.float32)
        _sums(rows, weights, seen, group, summed, total, shift)
        share = spread / (1.0 + spread * total)
        score = rows.T @ (weights * seen) - summed.T @ (share * shift)
        rows *= np.sqrt(weights)[:, None]
        summed *= np.sqrt(share)[:, None]
        information = rows.T @ rows - summed.T @ summed
        # the density in time: |dD/dt|, tempered as the rows are
        _, steep, curve = upward(upwards, noise / _STEADY_S)
        curve = np.maximum(curve, 1e-12)
        own, seen_noise = law.noise**2 + noise**2, min(max(scatter, _SMALLEST_NOISE), noise) ** 2
        number = np.maximum(np.bincount(of, trust, size), 1.0)
        shared = (spread + seen_noise / number) / (spread + own / number)
        temper = ((shared + (number - 1.0) * seen_noise / own) / number)[of] * trust
        moved = self._responses(self._moved, record.pixel[crossed], before[crossed])
        rows = np.empty((len(crossed), count + 1), np.float32)
        _rate_rows(moved, lights, place[crossed], after[crossed] / self._step, bend[crossed] / self._step, rows)
        score = score + rows.T @ (temper * sign * steep).astype(np.float32)
        rows *= np.sqrt(temper * curve).astype(np.float32)[:, None]
        information += rows.T @ rows
        return information.astype(np.float64), score.astype(np.float64)

    def _responses(self, factors: Single, pixel: NDArray[np.int64], node: NDArray[np.int64]) -> Single:
        """Return u_i F_t of pixels i [N] at nodes t [N], [N, k], with factors F [T, r, k]."""
        found = np.empty((len(pixel), factors.shape[2]), np.float32)
        order = np.argsort(node, kind="stable")
        starts = np.flatnonzero(np.diff(node[order], prepend=-1))
        for mine in np.split(order, starts[1:]) if len(order) else []:
            found[mine] = self._left[pixel[mine]] @ factors[node[mine[0]]]
        return found
