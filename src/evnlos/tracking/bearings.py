"""People behind a corner: how many, and their bearings over time, with a stated rate of false alarms.

A person is a strip behind the edge: on the floor a ramp over the bearing, and then a plateau
(`strip_response`). At each step the data say how much likelier such a strip is at each bearing than none, its
brightness integrated out under a normal prior of mean a and standard deviation a / 2:

    ln L(phi) = ((K + 4 / a)^2 / (J + 4 / a^2) - 4 - ln(1 + J a^2 / 4)) / 2,

with K the strip's matched filter of the data and J its information, the variance of K. A hidden Markov model
joins the steps: absent, or at a bearing that wanders as people walk. Its evidence over that of an empty scene
is the score of a track. Whether a score means anybody is decided by the same search on noise alone, as often as
the rate of false alarms asks; then the track is taken off and the next one looked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.config import check_made
from evnlos.errors import ConfigError
from evnlos.inverse import Penumbra, noise_of
from evnlos.optics import strip_response
from evnlos.types import derive_seed

Array = NDArray[np.float64]
UNSURE_NOISE = 10.0  # over that of independent pixels: from there on a result is doubtful
_COARSE_DEG, _FINE_DEG = 2.0, 0.25
_WIDTHS_DEG = (4.0, 12.0)
_STRENGTHS = (1.0, 4.0, 16.0, -1.0, -4.0, -16.0)  # a over the noise of one step, at the best bearing
_SPREAD = 0.5  # of a person's brightness from step to step, over its mean
_LEAST_SHARE = 0.1  # of the first track's brightness: below it, what a strip does not explain looks like one
_VARIANTS = ((0.0, 0.5), (0.0, 2.0), (-2.0, 1.0), (2.0, 1.0))  # shift in degrees, factor of the width
_ENTER_S, _STAY_S = 20.0, 20.0  # mean times until somebody comes, and goes
_CLEAREST = 25.0  # brightness over the noise in a step: a strip describes nobody better than to 4 %
_SHAPE = 0.04  # of a strip's width: how far off its middle what a plain strip leaves out may put a bearing
_STEPS = ("bearing_deg", "deviation_deg", "presence", "brightness")
_TOTALS = ("width_deg", "score", "threshold", "step_sigma")
_LEAST = 1e-100  # probability of nobody, which a bright person's likelihood would round to 0
_MOST = 200.0  # log likelihood that one step may add, for the same reason
_NORMAL_90 = 1.645


@dataclass(frozen=True)
class BearingTracking:
    """How people are searched for."""

    most: int = 3
    """Largest number of tracks."""
    false_alarms: float = 0.01
    """Probability that a video without a mover shows a track, 0.005 to 0.2."""
    turn_deg_s: float = 15.0
    """Standard deviation of a bearing's speed, degrees per second."""
    seed: int = 0
    """Seed of the noise on which the false alarms are counted."""

    def __post_init__(self) -> None:
        check_made(self)
        for name, low, high in (("most", 1, 10), ("false_alarms", 0.005, 0.2), ("turn_deg_s", 0.5, 200.0)):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"{name} is {getattr(self, name)}; give {low:g} to {high:g}")


@dataclass(frozen=True, eq=False)
class BearingTrack:
    """One person behind the corner.

    Args:
        bearing_deg: Mean bearing, [T], degrees from the wall's continuation; NaN where likelier absent.
        deviation_deg: Its standard deviation, [T], degrees: noise, widened by what the strip does not explain,
            and a twenty-fifth of the strip's width for its shape.
        presence: Probability of being there, [T].
        brightness: Change of the floor's light beyond the person, [T], relative.
        width_deg: Width of the strip that fits best, degrees.
        score: Natural logarithm of the evidence over that of nobody.
        threshold: Largest score of noise alone at the rate of false alarms.
        step_sigma: Brightness over its noise in a single step, median while present.
    """

    bearing_deg: Array
    deviation_deg: Array
    presence: Array
    brightness: Array
    width_deg: float
    score: float
    threshold: float
    step_sigma: float

    @property
    def there(self) -> NDArray[np.bool_]:
        """Steps in which presence is likelier than absence, [T]."""
        return self.presence > 0.5

    @property
    def typical(self) -> float:
        """Median size of the brightness while present; 0 where never."""
        return float(np.median(np.abs(self.brightness[self.there]))) if self.there.any() else 0.0

    @property
    def interval_90(self) -> tuple[Array, Array]:
        """Ends of the 90 % interval of each bearing, [T] each, degrees."""
        half = _NORMAL_90 * self.deviation_deg
        return self.bearing_deg - half, self.bearing_deg + half

    def summary(self) -> dict[str, Any]:
        """Return the track as plain values; None while absent."""
        steps = ((name, getattr(self, name).tolist()) for name in _STEPS)
        rows = {name: [None if math.isnan(v) else round(v, 8) for v in row] for name, row in steps}
        return rows | {name: round(getattr(self, name), 3) for name in _TOTALS}


@dataclass(frozen=True, eq=False)
class BearingTracks:
    """Who was found behind a corner.

    Args:
        times_s: Middles of the steps, [T], seconds.
        tracks: The tracks, the most certain one first.
        false_alarms: Rate at which noise alone shows a track in a video like this.
        next_score: Score of the strongest candidate that was turned down, over its threshold.
        limit: Brightness of a walker that nine of ten such videos would show, relative; NaN with tracks.
        variance: Variance of the noise of a bin in one step without the tracks, [B].
        noise_factor: That over independent pixels'; beyond `UNSURE_NOISE` the rate of false alarms is not kept.
    """

    times_s: Array
    tracks: tuple[BearingTrack, ...]
    false_alarms: float
    next_score: float
    limit: float
    variance: Array
    noise_factor: float


@njit(cache=True)
def _forward(likelihood: Array, move: Array, enter: float, leave: float, kept: Array) -> float:
    """Return the log evidence of the hidden Markov model over that of nobody.

    Args:
        likelihood: Log likelihood over that of nobody, [T, N].
        move: Probability of a move by -W..W cells in a step, [2 W + 1].
        enter: Probability that somebody comes in a step.
        leave: Probability of going in a step.
        kept: Probabilities given the data so far, [T, N + 1], nobody last; overwritten unless empty.
    """
    count, cells = likelihood.shape
    reach = len(move) // 2
    absent, there, moved = 1.0, np.zeros(cells), np.empty(cells)
    total = 0.0
    for t in range(count):
        highest, stayed, before = 0.0, 0.0, 0.0
        for j in range(cells):
            value = 0.0
            for k in range(max(0, j - reach), min(cells, j + reach + 1)):
                value += move[j - k + reach] * there[k]
            moved[j] = value * (1.0 - leave)
            stayed += moved[j]
            before += there[j]
            highest = max(highest, likelihood[t, j])
        new = absent * enter / cells
        absent = (absent * (1.0 - enter) + before - stayed) * math.exp(-highest)
        scale = absent
        for j in range(cells):
            there[j] = (moved[j] + new) * math.exp(likelihood[t, j] - highest)
            scale += there[j]
        absent = max(absent / scale, _LEAST)
        for j in range(cells):
            there[j] /= scale
        if kept.size:
            kept[t, :cells] = there
            kept[t, cells] = absent
        total += math.log(scale) + highest
    return total


@njit(cache=True)
def _backward(likelihood: Array, move: Array, enter: float, leave: float, kept: Array) -> None:
    """Turn probabilities given the data so far into those given all data, [T, N + 1], in place."""
    count, cells = likelihood.shape
    reach = len(move) // 2
    later, weighed = np.ones(cells), np.empty(cells)
    nobody_later = 1.0
    for t in range(count - 2, -1, -1):
        highest, sum_new = 0.0, 0.0
        for j in range(cells):
            highest = max(highest, likelihood[t + 1, j])
        for j in range(cells):
            weighed[j] = later[j] * math.exp(likelihood[t + 1, j] - highest)
            sum_new += weighed[j]
        off = nobody_later * math.exp(-highest)
        nobody = (1.0 - enter) * off + enter / cells * sum_new
        norm = nobody * kept[t, cells]
        for k in range(cells):
            value, inside = 0.0, 0.0
            for j in range(max(0, k - reach), min(cells, k + reach + 1)):
                value += move[j - k + reach] * weighed[j]
                inside += move[j - k + reach]
            later[k] = (1.0 - leave) * value + (1.0 - (1.0 - leave) * inside) * off
            norm += later[k] * kept[t, k]
        for k in range(cells):
            later[k] /= norm
            kept[t, k] *= later[k]
        nobody_later = nobody / norm
        kept[t, cells] *= nobody_later


class _Search:
    """The hidden Markov model on a grid of bearings, for data of unit noise."""

    def __init__(
        self, penumbra: Penumbra, settings: BearingTracking, cell_deg: float, widths: Sequence[float]
    ) -> None:
        edges = penumbra.edges_deg
        self.whitener, _ = penumbra.whitened()
        cells = max(8, round((edges[-1] - edges[0]) / cell_deg))
        self.grid = np.linspace(edges[0], edges[-1], cells + 1)
        step = penumbra.step_s
        spread = max(settings.turn_deg_s * step / (self.grid[1] - self.grid[0]), 0.5)
        reach = max(1, math.ceil(4 * spread))
        move = np.exp(-0.5 * (np.arange(-reach, reach + 1) / spread) ** 2)
        self.move = move / move.sum()
        self.enter, self.leave = min(0.5, step / _ENTER_S), min(0.5, step / _STAY_S)
        self.lost = penumbra.lost
        self.widths = tuple(widths)
        self.filters = [self.whitener @ strip_response(edges, self.grid, w).T for w in widths]  # [B - 2, N]
        self.information = [(f * f).sum(axis=0) for f in self.filters]

    def likelihood(self, match: Array, width: int, strength: float) -> tuple[Array, float]:
        """Return the log likelihood over that of nobody, [T, N], of the matched filters of a width, [T, N].

        No step exceeds what the recursions can hold; what was taken off is returned, its sum over the steps.
        """
        information = self.information[width]
        usual = strength / math.sqrt(information.max())  # a
        pull = (_SPREAD * usual) ** -2
        found = 0.5 * (
            (match + usual * pull) ** 2 / (information + pull) - usual**2 * pull - np.log1p(information / pull)
        )
        found[self.lost] = 0.0
        highest = np.maximum(found.max(axis=1, keepdims=True), 0.0)
        excess = np.maximum(highest - _MOST, 0.0)
        return np.maximum(found, highest - _MOST) - excess, float(excess.sum())

    def best(self, data: Array, strengths: Sequence[float] = _STRENGTHS) -> tuple[float, int, float]:
        """Return the largest score, and the width and the strength that have it."""
        none, found = np.empty((0, 0)), []
        for w, filters in enumerate(self.filters):
            match = data @ filters
            for s in strengths:
                likelihood, excess = self.likelihood(match, w, s)
                score = _forward(likelihood, self.move, self.enter, self.leave, none)
                found.append((score + excess, w, s))
        return max(found)

    def marginals(self, data: Array, width: int, strength: float) -> Array:
        """Return the probability of each bearing and, last, of nobody, [T, N + 1]."""
        likelihood, _ = self.likelihood(data @ self.filters[width], width, strength)
        kept = np.empty((len(data), len(self.grid) + 1))
        _forward(likelihood, self.move, self.enter, self.leave, kept)
        _backward(likelihood, self.move, self.enter, self.leave, kept)
        return kept


def _noise(search: _Search, draw: np.random.Generator) -> Array:
    data = draw.standard_normal((len(search.lost), len(search.whitener)))
    return data - data[~search.lost].mean(axis=0)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A track with what it adds to the floor, [T, B], as a plain strip and with what else looks like it."""

    track: BearingTrack
    floor: Array
    around: Array


def track_bearings(penumbra: Penumbra, settings: BearingTracking | None = None) -> BearingTracks:
    """Return who moves behind the corner: as many tracks as stand above the search's own false alarms.

    Args:
        penumbra: The floor's relative change.
        settings: How people are searched for.
    """
    settings = settings or BearingTracking()
    draw = np.random.default_rng(derive_seed(settings.seed, "false alarms"))
    coarse = _Search(penumbra, settings, _COARSE_DEG, _WIDTHS_DEG)
    alone = (coarse.best(_noise(coarse, draw))[0] for _ in range(math.ceil(1 / settings.false_alarms) - 1))
    threshold = max(0.0, *alone)
    fits: list[_Fit] = []
    rest, noise, inflation, factor = penumbra, penumbra, 1.0, penumbra.noise_factor
    while True:
        search = _Search(noise, settings, _COARSE_DEG, _WIDTHS_DEG)
        score, _, strength = search.best(rest.whitened()[1])
        if score <= threshold or len(fits) == settings.most:
            break
        fits.append(_fit(rest, settings, strength, (score, threshold)))
        if len(fits) == 1 and (ratio := fits[0].track.step_sigma / _CLEAREST) > 1:
            inflation = ratio**2
            noise = replace(noise, variance=inflation * noise.variance)
        for _ in range(3 if len(fits) > 1 else 2):
            _fit_again(fits, noise, penumbra, settings)
        new, first = fits[-1].track, fits[0].track
        if new.typical <= _LEAST_SHARE * first.typical or any(_same(new, one.track) for one in fits[:-1]):
            fits.pop()  # no more than what a strip does not explain of another one
            break
        rest = _without(penumbra, penumbra, [one.around for one in fits], None)
        variance, factor = noise_of(rest.change, penumbra.variance / penumbra.noise_factor)
        noise = replace(penumbra, variance=inflation * variance)
        rest = replace(rest, variance=noise.variance)
    _fit_again(fits, noise, penumbra, settings)  # with the noise that is left
    limit = _limit(coarse, threshold, draw) if not fits else math.nan
    tracks, rate = tuple(one.track for one in fits), settings.false_alarms
    return BearingTracks(penumbra.times_s, tracks, rate, score - threshold, limit, noise.variance, factor)


def _fit_again(fits: list[_Fit], noise: Penumbra, penumbra: Penumbra, settings: BearingTracking) -> None:
    """Fit each track to what the others leave, in place."""
    for k, one in enumerate(fits):
        alone = _without(noise, penumbra, [other.floor for other in fits if other is not one], one.floor)
        sign = math.copysign(4.0, one.track.brightness.sum())
        fits[k] = _fit(alone, settings, sign, (one.track.score, one.track.threshold))


def _same(one: BearingTrack, other: BearingTrack) -> bool:
    """Return whether two tracks run beside each other, nearer than their strips are wide."""
    both = one.there & other.there
    near = np.abs(one.bearing_deg - other.bearing_deg)[both] < 0.5 * (one.width_deg + other.width_deg)
    return int(near.sum()) > 0.25 * one.there.sum() and int(near.sum()) > 0.5 * both.sum()


def _without(noise: Penumbra, penumbra: Penumbra, others: Sequence[Array], own: Array | None) -> Penumbra:
    """Return the change without other tracks, the steady part anew; `own` is what the track itself adds."""
    change = penumbra.change - sum(others, np.zeros_like(penumbra.change))
    change = change - np.nanmean(change if own is None else change - own, axis=0)
    return replace(penumbra, change=change, variance=noise.variance)


def _fit(penumbra: Penumbra, settings: BearingTracking, strength: float, scores: tuple[float, float]) -> _Fit:
    """Return the track of the strip that explains most."""
    whitener, data = penumbra.whitened()
    coarse = _Search(penumbra, settings, _COARSE_DEG, (2.0, 4.0, 6.0, 9.0, 13.0, 20.0))
    _, which, strength = coarse.best(data, [strength * 2.0**k for k in range(-2, 4)])
    width = coarse.widths[which]
    fine = _Search(penumbra, settings, _FINE_DEG, (width,))
    probability = fine.marginals(data, 0, strength)
    presence = 1 - probability[:, -1]
    there = probability[:, :-1] / np.maximum(presence, 1e-12)[:, None]
    bearing = there @ fine.grid
    spread = np.maximum((there * (fine.grid - bearing[:, None]) ** 2).sum(axis=1), 0) + _FINE_DEG**2 / 12
    ramp = strip_response(penumbra.edges_deg, bearing, width)  # [T, B]
    filters = ramp @ whitener.T
    information = (filters * filters).sum(axis=1)
    mean = strength / math.sqrt(fine.information[0].max())
    pull = (_SPREAD * mean) ** -2
    brightness = ((filters * data).sum(axis=1) + mean * pull) / (information + pull) * presence
    on = (presence > 0.5) & ~penumbra.lost
    left = data[on] - brightness[on, None] * filters[on]
    misfit = max(1.0, float((left * left).mean())) if on.any() else 1.0
    shown = presence > 0.5
    spread = np.sqrt(misfit * spread + (_SHAPE * width) ** 2)
    bearings, deviations = (np.where(shown, v, np.nan) for v in (bearing, spread))
    sigma = float(np.median(np.abs(brightness[on]) * np.sqrt(information[on]))) if on.any() else 0.0
    track = BearingTrack(bearings, deviations, presence, brightness, width, *scores, sigma)
    return _Fit(track, brightness[:, None] * ramp, _around(penumbra, track, bearing, ramp))


def _around(penumbra: Penumbra, track: BearingTrack, bearing: Array, ramp: Array) -> Array:
    """Return all of the change, [T, B], that looks like a track: strips nearby, a plateau that slopes."""
    edges, width = penumbra.edges_deg, track.width_deg
    whitener, data = penumbra.whitened()
    beyond = np.clip(0.5 * (edges[1:] + edges[:-1]) - bearing[:, None], 0, None) / float(np.ptp(edges))
    shapes = [strip_response(edges, bearing + shift, factor * width) for shift, factor in _VARIANTS]
    basis = np.stack([ramp, *(shape - ramp for shape in shapes), beyond, beyond**2], axis=2)  # [T, B, K]
    seen = np.einsum("cb,tbk->tck", whitener, basis)
    gram = np.einsum("tck,tcl->tkl", seen, seen)
    gram += 1e-6 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(basis.shape[2])
    weight = np.linalg.solve(gram, np.einsum("tck,tc->tk", seen, data)[..., None])
    return np.where(track.there[:, None], (basis @ weight)[..., 0], 0.0)


def _limit(search: _Search, threshold: float, draw: np.random.Generator) -> float:
    """Return the brightness of a walker across the sector that nine of ten videos would show."""
    steps = len(search.lost)
    across = np.linspace(0.15, 0.85, steps) * (len(search.grid) - 1)
    walk = search.filters[0].T[np.rint(across).astype(int)].copy()
    walk -= walk[~search.lost].mean(axis=0)  # lost steps count nothing
    noise = [_noise(search, draw) for _ in range(10)]
    low, high = 0.05 / math.sqrt(search.information[0].max()), 50 / math.sqrt(search.information[0].max())
    while high / low > 1.15:
        middle = math.sqrt(low * high)
        seen = sum(search.best(one + middle * walk)[0] > threshold for one in noise)
        low, high = (low, middle) if seen >= 9 else (middle, high)
    return math.sqrt(low * high)
