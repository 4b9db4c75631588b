"""One likelihood of a whole sequence: the target from events, from frames, or from both, with its uncertainty.

With z the coefficients of the Gaussian prior and L(i, t; z) the filtered log light of pixel i:
- Between two events of a pixel, L (with the leak's share) moves by D = +theta_on or -theta_off, less what noise
  carries both ahead (`CrossingLaw.ahead`), with the error of a crossing. What a pixel's own thresholds differ
  from their mean is integrated out in closed form, by polarity: the mean of all pixels and the mismatch, or
  where the sensor was measured (`CrossingLaw.known`) each pixel's own mean and the error of that. What error of
  a crossing is taken for granted may be one of the pixel, as that of its light is: it counts there, too.
- What is observed is a time: the level's density times |dD/dt|, without which contrasts come out too low.
- The error of a crossing is estimated, from events of a pixel and polarity; too large, contrasts are too high.
- An event is a signal or noise: that density, by what the pixel's other events say of its threshold, or the
  rate of noise events times the probability that the threshold was not met yet.
- A silence bounds L from both sides, where L is furthest up and down in each gap, by what crossings leave open
  of the threshold. The side of the event that ends the gap counts as far as that event is noise.
- The leak is known to a few per cent and is estimated along; so are both mean thresholds where asked.
- Frames are linear in z, with the camera's noise, and an unknown offset of each pixel of an unknown pattern.

Gauss-Newton on it, the error of a crossing annealed from 0.25, of events alone on some thousand pixels first,
where more steps cost little: with few, some letters end where a wrong one explains them. The curvature is the
estimate's information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras import CrossingLaw
from evnlos.errors import ConfigError
from evnlos.events import stride_for
from evnlos.inverse.event_record import EventRecord, Levels, levels_of
from evnlos.inverse.prior import PatternPrior
from evnlos.inverse.sequence_light import (
    Array,
    FrameTerm,
    NormalEquations,
    SequenceLight,
)

_NUISANCES = 3  # of the mean thresholds ON and OFF, relative, and of the leak
_KNOWN = 1e-6  # relative error of a threshold that is not estimated
_LONGEST_STEP = 1.5  # of a coefficient in an iteration, standard deviations of the prior
_FEWEST_NOISE = 0.01  # share of the events that no model explains
_SMALLEST_NOISE = 3e-3  # that crossings are believed to have, log units
_NEAR_NOISE = 0.05  # first error of a crossing where a start is given, log units
_STEADY_S = 0.4  # errors of the level change in about this time
_FIRST_PIXELS, _FIRST_RANK = 1000, 120  # about, and most factors of their light, of the estimate to start from
FIRST_STEPS, ANNEALED = 28, 12
"""Steps of an estimate from few pixels, and in how many its error of a crossing shrinks to the least."""
_ACTIVE = 1e-3  # weight of a silence, in that of a threshold just met, below which it is left out


@dataclass(frozen=True)
class LikelihoodSettings:
    """What the likelihood of events takes for granted."""

    least_noise: float = 0.04
    """Least standard deviation of the error of a crossing beside the event model's own, log units; how large it
    is, the events of one pixel and polarity tell, which share a threshold."""
    threshold_error: float = 0.0
    """Standard deviation of both mean thresholds, relative; 0 = those of the setup. Where a third of the
    events is noise, thresholds that are left free drift below half of the true ones, and contrast with them."""
    leak_error: float = 0.005
    """Standard deviation of the leak, log units per second."""
    gap_s: float = 0.4
    """Distance of the instants at which silences are looked at, seconds."""
    first_noise: float = 0.25
    """Error of a crossing in the first iteration, log units."""
    iterations: int = 12
    """Iterations of Gauss and Newton with all pixels; a third of them from an estimate of few."""
    block: int = 16_384
    """Instants that are looked at together: what bounds the memory. The result does not depend on it."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.threshold_error) and self.threshold_error >= 0):
            raise ConfigError(f"LikelihoodSettings.threshold_error is {self.threshold_error}; give 0 or more")
        for name in ("least_noise", "leak_error", "gap_s", "first_noise"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"LikelihoodSettings.{name} is {getattr(self, name)}; give a positive number")
        if self.iterations < 2:
            raise ConfigError(f"LikelihoodSettings.iterations is {self.iterations}; give 2 or more")

    def noise_in(self, step: float | NDArray[np.int64], annealed: int) -> Any:
        """Return the least error of a crossing in a step, log units: from `first_noise` down to `least_noise`.

        Args:
            step: Number of the step, or of several, from 0.
            annealed: Steps in which it shrinks, each by the same factor.
        """
        share = np.minimum(np.asarray(step) / annealed, 1.0)
        return self.first_noise ** (1 - share) * self.least_noise**share


@dataclass(frozen=True, eq=False)
class SequenceEstimate:
    """A target with its uncertainty.

    Args:
        z: Its coefficients, [k].
        covariance: Their covariance, [k, k].
        image: The target, [h, w].
        deviation: Standard deviation of each cell, [h, w].
        expected_error: Mean squared error of a cell that the covariance says.
        thresholds: Factors on the mean thresholds ON and OFF; 1 without events.
        leak: What was added to the leak, log units per second.
        noise_share: Share of the events that count as noise; NaN without events.
        noise: Error of a crossing that the events show, beside the event model's own, log units; NaN without.
    """

    z: Array
    covariance: Array
    image: Array
    deviation: Array
    expected_error: float
    thresholds: tuple[float, float]
    leak: float
    noise_share: float
    noise: float


def estimate_sequence(
    light: SequenceLight,
    prior: PatternPrior,
    law: CrossingLaw | None = None,
    record: EventRecord | None = None,
    frames: FrameTerm | None = None,
    settings: LikelihoodSettings | None = None,
    start: Array | None = None,
) -> SequenceEstimate:
    """Return the target that frames, events, or both, make most likely under a Gaussian prior.

    Args:
        light: The light of the moving target.
        prior: The prior that its coefficients belong to.
        law: Constants of the event model; for events.
        record: The events, with silences (`record_of`, `gap_s`); None = frames alone.
        frames: The frames; None = events alone.
        settings: What is taken for granted; None is the default.
        start: Coefficients to start from, [k]; None = those of frames, or else of few pixels.

    Raises:
        ConfigError: Neither frames nor events, or events without their law.
    """
    if record is None and frames is None:
        raise ConfigError("neither frames nor events; give at least one of them")
    if record is not None and law is None:
        raise ConfigError("events without the law of their pixels; the event model states no crossing_law")
    settings = settings or LikelihoodSettings()
    count = prior.count
    unit = np.eye(count)
    if record is None or law is None:
        assert frames is not None
        covariance = np.asarray(np.linalg.inv(unit + frames.normal.information), np.float64)
        return _finished(
            prior, covariance @ frames.normal.score, covariance, np.zeros(_NUISANCES), math.nan, math.nan
        )
    law, unknown = law.doubted(settings.least_noise), np.zeros(count + _NUISANCES)
    if start is not None:
        unknown[:count] = start
    elif frames is not None:
        unknown[:count] = np.linalg.solve(unit + frames.normal.information, frames.normal.score)
    near = replace(settings, first_noise=min(settings.first_noise, _NEAR_NOISE))
    if start is not None:
        settings = near
    elif frames is None and (stride := stride_for(len(light.left), _FIRST_PIXELS)) > 1:
        few, those = light.every(stride, _FIRST_RANK), record.every(stride, light.shape[1])
        own = law.mapped(lambda one: one[::stride, ::stride])
        _annealed(few, own, those, None, unknown, replace(settings, iterations=FIRST_STEPS))
        settings = replace(near, iterations=max((settings.iterations + 2) // 3, 2))
    total, trust, noise = _annealed(light, law, record, frames, unknown, settings)
    covariance = np.asarray(np.linalg.inv(total.information)[:count, :count], np.float64)
    noisy = float(1.0 - trust[record.measured].mean()) if record.measured.any() else math.nan
    return _finished(prior, unknown[:count], covariance, unknown[count:], noisy, noise)


def _annealed(
    light: SequenceLight,
    law: CrossingLaw,
    record: EventRecord,
    frames: FrameTerm | None,
    unknown: Array,
    settings: LikelihoodSettings,
) -> tuple[NormalEquations, Array, float]:
    """Improve `unknown`, and return its equations, the probability of each instant, the error of a crossing."""
    count = len(unknown) - _NUISANCES
    error = max(settings.threshold_error, _KNOWN)
    known = np.concatenate([np.ones(count), np.full(2, error**-2), [settings.leak_error**-2]])
    trust = np.ones(len(record))
    total, noise = NormalEquations.empty(len(unknown)), settings.first_noise
    annealed = max(min(settings.iterations - 3, ANNEALED), 1)  # the last ones have the final error
    for step in range(settings.iterations):
        least = float(settings.noise_in(step, annealed))
        total = NormalEquations.empty(len(unknown))
        noise = _add_events(total, light, law, record, unknown, least, trust, settings.block)
        if frames is not None:
            total.information[:count, :count] += frames.normal.information
            total.score[:count] += frames.normal.score - frames.normal.information @ unknown[:count]
        total.information += np.diag(known)
        total.score -= known * unknown
        change = np.linalg.solve(total.information, total.score)
        unknown += change * min(1.0, _LONGEST_STEP / max(float(np.abs(change[:count]).max()), 1e-12))
    return total, trust, noise


def _finished(
    prior: PatternPrior, z: Array, covariance: Array, nuisances: Array, noise_share: float, noise: float
) -> SequenceEstimate:
    variance = prior.variance(covariance)
    factors = (1.0 + float(nuisances[0]), 1.0 + float(nuisances[1]))
    return SequenceEstimate(
        z,
        covariance,
        prior.image(z),
        np.sqrt(variance),
        float(variance.mean()),
        factors,
        float(nuisances[2]),
        noise_share,
        noise,
    )


def _add_events(
    total: NormalEquations,
    light: SequenceLight,
    law: CrossingLaw,
    record: EventRecord,
    unknown: Array,
    least: float,
    trust: Array,
    most: int,
) -> float:
    """Add the rows of crossings and silences, update `trust`, and return the error of a crossing."""
    count = len(unknown) - _NUISANCES
    found = rows_of(light, law, record, unknown[:count], least, trust, unknown[count:])
    together, steep, wait = found.changes, found.times, found.wait
    needed = record.measured.copy()
    needed[together.at] = True
    part, kept = record.only(needed), np.flatnonzero(needed)
    place = np.full(len(part), -1)  # in the whole record; references alone have none
    place[part.origin >= 0] = kept
    owner = record.pixel[together.at]
    theta, spread = law.thresholds(len(light.left))
    for block, rows, rates in part.blocks(light, found.levels, most):
        mine = place[block]
        pixels = part.pixel[block]
        here = slice(np.searchsorted(owner, pixels[0]), np.searchsorted(owner, pixels[-1], side="right"))
        at, sign = together.at[here], together.sign[here]
        group = 2 * owner[here] + (sign > 0)
        named = np.flatnonzero(mine >= 0)
        row = named[np.searchsorted(mine[named], at)]
        extra = np.zeros((len(at), _NUISANCES))
        extra[:, 0] = np.where(sign > 0, -theta[group], 0.0)
        extra[:, 1] = np.where(sign < 0, theta[group], 0.0)
        extra[:, 2] = wait[at]
        whole = np.concatenate([rows[row], extra], axis=1)
        total.add(whole, together.weight[here], together.residual[here], group, spread[group])
        events = np.flatnonzero((mine >= 0) & record.measured[np.maximum(mine, 0)])
        at = mine[events]
        sloping = np.zeros((len(at), len(unknown)))
        sloping[:, :count], sloping[:, -1] = rates[events], 1.0
        total.add(sloping, steep.weight[at], steep.residual[at], at, 0.0)
    return found.noise


class Rows(NamedTuple):
    """Rows of the normal equations: which instant, which threshold, 1 / variance, residual; [N] each."""

    at: NDArray[np.int64]
    sign: NDArray[np.int8]
    weight: Array
    residual: Array


class EventRows(NamedTuple):
    """All that the events of a sequence say about one estimate of its light."""

    changes: Rows
    """Of crossings and silences: changes since the origin of an instant, by pixel, then by polarity."""
    times: Rows
    """Of the density in time: rates of change at each instant of the record."""
    levels: Levels
    """Those of the estimate."""
    wait: Array
    """Time of each instant since its origin, seconds."""
    noise: float
    """Error of a crossing, log units."""


def rows_of(
    light: SequenceLight,
    law: CrossingLaw,
    record: EventRecord,
    z: Array,
    least: float,
    trust: Array,
    nuisances: Array | None = None,
) -> EventRows:
    """Return the rows of crossings, silences and times about an estimate, and bring `trust` up to date.

    Args:
        light: The light.
        law: Constants of the event model.
        record: The events, with silences.
        z: The estimate, as `light` takes it.
        least: Least error of a crossing, log units.
        trust: Probability of each instant to be a signal, [N]; changed in place.
        nuisances: Relative errors of the thresholds ON and OFF, and of the leak; None = none.
    """
    unknown = np.zeros(_NUISANCES) if nuisances is None else nuisances
    seen = light(z)
    levels = levels_of(seen, light.times_s, law)
    state = EventState(light, law, record, unknown, least, seen, levels)
    state.update_trust(trust)
    scatter = state.scatter(trust)
    noise = max(least, scatter)
    state = EventState(light, law, record, unknown, noise, seen, levels)
    state.update_trust(trust)
    steep = state.steepness(trust)
    steep = steep._replace(weight=steep.weight * state.temper(trust, max(scatter, _SMALLEST_NOISE)))
    crossed = np.flatnonzero(record.measured)
    crossings = Rows(
        crossed, record.sign[crossed], trust[crossed] / state.variance[crossed], state.residual[crossed]
    )
    quiet = (state.silences(sign, trust) for sign in (1, -1))
    columns = [np.concatenate(column) for column in zip(crossings, *quiet, strict=True)]
    order = np.lexsort((columns[1], record.pixel[columns[0]]))
    return EventRows(Rows(*(column[order] for column in columns)), steep, levels, state.wait, float(noise))


class EventState:
    """What a record says at one estimate: changes, residuals, slopes, and the offsets of the thresholds."""

    def __init__(
        self,
        light: SequenceLight,
        law: CrossingLaw,
        record: EventRecord,
        nuisances: Array,
        noise: float,
        seen: Array,
        levels: Levels,
    ) -> None:
        self.light, self.law, self.record, self.seen = light, law, record, seen
        theta, spread = law.thresholds(len(light.left))
        self.theta, self.spread = theta * np.tile(1 + nuisances[1::-1], len(light.left)), spread**2  # [2 P]
        self.group = 2 * record.pixel + (record.sign > 0)
        self.wait = record.t_s - record.t_s[record.origin]
        self.change = record.change(light, levels) + nuisances[2] * self.wait
        self.residual = np.where(record.sign > 0, 1.0, -1.0) * self.theta[self.group] - self.change
        self.residual -= law.lead(record.sign, record.sign[record.origin])
        self.noise = math.hypot(noise, law.noise)
        self.variance = record.variance(light, seen, law, noise)
        node, _ = light.place(record.t_s)
        step = light.times_s[1] - light.times_s[0]
        rate = (levels.value[record.pixel, node + 1] - levels.value[record.pixel, node]) / step
        self.rate = rate + levels.fall[record.pixel] + nuisances[2]
        self.blur = noise / _STEADY_S

    def offsets(self, trust: Array) -> tuple[Array, Array]:
        """Return mean and variance of what each group's threshold is off by, times its sign."""
        measured = np.flatnonzero(self.record.measured)
        of, size = self.group[measured], 2 * len(self.light.left)
        weight = trust[measured] / self.variance[measured]
        variance = np.asarray(self.spread / (1.0 + self.spread * np.bincount(of, weight, size)), np.float64)
        mean = -variance * np.bincount(of, weight * self.residual[measured], size)
        return np.asarray(mean, np.float64), variance

    def scatter(self, trust: Array) -> float:
        """Return the error of a crossing, log units, from what the events of a group differ by."""
        measured = np.flatnonzero(self.record.measured)
        of, size = self.group[measured], 2 * len(self.light.left)
        weight, residual = trust[measured], self.residual[measured]
        sums = np.bincount(of, weight, size)
        mean = np.bincount(of, weight * residual, size) / np.maximum(sums, 1e-12)
        freedom = float(np.maximum(sums - 1.0, 0.0).sum())
        several = (sums > 1.0)[of]
        square = float((weight * (residual - mean[of]) ** 2)[several].sum())
        return math.sqrt(max(square / max(freedom, 1.0) - self.law.noise**2, 0.0))

    def temper(self, trust: Array, scatter: float) -> Array:
        """Return by how much the rows of each event are weaker than their scatter says, [N], 0..1.

        An error above that of the data tempers the likelihood, and the density in time has to follow: a group
        of n events has n - 1 degrees of freedom of the variance noise^2, and one of noise^2 / n + mismatch^2.
        """
        measured = np.flatnonzero(self.record.measured)
        of, size = self.group[measured], 2 * len(self.light.left)
        sums = np.maximum(np.bincount(of, trust[measured], size), 1.0)
        own, seen, spread = self.noise**2, min(scatter, self.noise) ** 2, self.spread
        shared = (spread + seen / sums) / (spread + own / sums)
        return ((shared + (sums - 1.0) * seen / own) / sums)[self.group]

    def update_trust(self, trust: Array) -> None:
        """Bring the probability of a signal up to date: its density in time against the noise events' rate."""
        measured = np.flatnonzero(self.record.measured)
        # by the group's other events: with its own say each would confirm itself
        of, residual, own = self.group[measured], self.residual[measured], self.variance[measured]
        weight, mismatch = trust[measured] / own, self.spread[of]
        known, seen = (
            np.bincount(of, column, 2 * len(self.light.left))[of] for column in (weight, weight * residual)
        )
        variance = mismatch / (1.0 + mismatch * np.maximum(known - weight, 0.0))
        spread = own + variance
        away = residual - variance * (seen - weight * residual)
        signal = np.exp(-0.5 * away**2 / spread) / np.sqrt(2 * math.pi * spread)
        signal *= upward(self.record.sign[measured] * self.rate[measured], self.blur)[0]
        duration = self.light.times_s[-1] - self.light.times_s[0]
        least = _FEWEST_NOISE * len(measured) / (duration * len(self.light.left))
        # a noise event meets a pixel that has not crossed its threshold yet
        room = torch.from_numpy(self.record.sign[measured] * away / np.sqrt(spread))
        noise = 0.5 * max(self.law.events_hz, least) * torch.special.ndtr(room).numpy()
        trust[measured] = signal / (signal + np.maximum(noise, 1e-300))

    def steepness(self, trust: Array) -> Rows:
        """Return the rows of log |dD/dt|, the density of an event in time over that in its level, [N] each."""
        _, slope, bend = upward(self.record.sign * self.rate, self.blur)
        bend = np.maximum(bend, 1e-12)
        everything = np.arange(len(self.record))
        residual = np.where(self.record.measured, self.record.sign * slope / bend, 0.0)
        weight = np.where(self.record.measured, trust * bend, 0.0)
        return Rows(everything, self.record.sign, weight, residual)

    def silences(self, sign: int, trust: Array) -> Rows:
        """Return the rows of what was not met: of each gap the instant nearest to the threshold of a sign.

        With y the distance to the pixel's own threshold, normal with mean m and variance v given the crossings,
        the probability of none is Phi(m / s), s^2 = v + noise^2. Its slope g and its curvature h in m are those
        of an observation of y: at m + g / h, with the precision h / (1 - h v).
        """
        record = self.record
        unmet = np.ones(len(record))  # what ends a gap may be the crossing itself
        crossed = np.flatnonzero(record.measured & (record.sign == sign))
        unmet[record.origin[crossed]] = 1.0 - trust[crossed]
        free = np.flatnonzero((record.origin >= 0) & ((record.sign == 0) | (record.sign == sign)))
        order = free[np.lexsort((-sign * self.change[free], record.origin[free]))]
        at = order[np.diff(record.origin[order], prepend=-1) != 0]
        offset, variance = (column[2 * record.pixel[at] + (sign > 0)] for column in self.offsets(trust))
        theta = self.theta[2 * record.pixel[at] + (sign > 0)] - sign * self.law.lead(
            sign, record.sign[record.origin[at]]
        )
        room = theta + sign * offset - sign * self.change[at]
        width = np.sqrt(variance + self.noise**2)
        scaled = torch.from_numpy(room / width)
        ratio = torch.exp(-0.5 * scaled**2 - torch.special.log_ndtr(scaled)).numpy() / math.sqrt(2 * math.pi)
        bend = np.clip(ratio * (ratio + scaled.numpy()), 0.0, 1.0)
        near = unmet[record.origin[at]] * bend > _ACTIVE
        at, theta, room, width = at[near], theta[near], room[near], width[near]
        variance, ratio, bend = variance[near], ratio[near], bend[near]
        curve = bend / width**2
        precision = unmet[record.origin[at]] * curve / np.maximum(1.0 - curve * variance, 1e-6)
        seen = room + ratio / width / curve  # y as if it were observed
        residual = sign * (theta - seen) - self.change[at]
        return Rows(at, np.full(len(at), sign, np.int8), precision, residual)


def upward(rate: Array, blur: float) -> tuple[Array, Array, Array]:
    """Return E of max(rate + blur n, 0), n normal, and slope and negative curvature of its logarithm.

    Args:
        rate: Rate towards the threshold, log units per second.
        blur: Standard deviation of what is not known of it.
    """
    scaled = torch.from_numpy(np.maximum(rate / blur, -30.0))
    below = torch.special.ndtr(scaled).numpy()
    density = np.exp(-0.5 * scaled.numpy() ** 2) / math.sqrt(2 * math.pi)
    # far below zero the sum of the two cancels: the tail's own form is density / scaled^2
    whole = np.where(
        scaled.numpy() < -5,
        density / np.maximum(scaled.numpy() ** 2 + 2, 1.0),
        scaled.numpy() * below + density,
    )
    whole = np.maximum(whole, 1e-300)
    slope = below / whole
    return blur * whole, slope / blur, np.clip(slope**2 - density / whole, 0.0, None) / blur**2
