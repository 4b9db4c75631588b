"""What events say of motion: how fast the image slides between frames, and the whole path without any frame.

Without frames the path is a cubic spline through poses p_j at knots, and Gauss and Newton's method finds it
with the target's coefficients z. What a small change of a pose does to the light is one more pattern beside
those of the target, so the likelihood of the events (`EventSolver`) is asked for both at once:

    I(i, t) = still(i, t) + left(i) [right(t) (1, z) + sum_j w_j(t) ds(t)/dp dp_j]

| symbol | meaning | unit |
|---|---|---|
| left, right | light of the mean target and of each pattern on the path, `SequenceLight` | white levels |
| s | right(t) (1, z) of the target as it is known so far | white levels |
| w_j | what the pose at knot j has of the pose at t | |
| dp_j | change of the pose at knot j: x, y, and, where asked for, distance and turn, as lengths | m |
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras import CrossingLaw
from evnlos.cameras.streams import WHITE_DN
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import DataError
from evnlos.events import event_histogram
from evnlos.inverse import (
    TRACKED_ROOM,
    EventRecord,
    EventSolver,
    LikelihoodSettings,
    PatternPrior,
    SequenceLight,
    handwritten_prior,
    record_of,
    sequence_light,
)
from evnlos.inverse.event_images import CELLS, COEFFICIENTS
from evnlos.inverse.sequence_light import on_pixels
from evnlos.inverse.sequence_problem import strip_of
from evnlos.machine import note
from evnlos.scene import Ink
from evnlos.setups import Setup
from evnlos.tracking.motion_fit import REACH, Fit, Lights, MotionFit
from evnlos.tracking.registration import Registration, middle_of_light, plane_map
from evnlos.tracking.track import Measurements, most_likely_acceleration, smooth, strip_corners
from evnlos.types import Events, Plane

Array = NDArray[np.float64]

_FLOOR = 0.02  # of the frames' peak: light below has no logarithm worth a slope
_LEAST_EVENTS = 200
_WINDOWS_AT_A_TIME = 64


@dataclass(frozen=True, eq=False)
class EventVelocity:
    """Velocities of the image.

    Args:
        time_s: Middle of each window, [M], seconds.
        velocity: (x, y), float64 [M, 2], pixels per second, of the reduced frames.
        variance: Of each component, [M, 2].
    """

    time_s: NDArray[np.float64]
    velocity: NDArray[np.float64]
    variance: NDArray[np.float64]


def event_velocity(
    events: Events, found: Registration, times_s: NDArray[np.float64], window_s: float
) -> EventVelocity | None:
    """Return the velocity in windows between the first and the last frame, None where events say nothing.

    A sliding image changes a pixel's log light L by -grad L . d for a small displacement d, and the pixel
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
    counts = event_counts(events, edges, shape)  # [M, 2, P], events a reduced pixel
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
    )  # above 1 where the image is not what was thought
    variance = np.diagonal(inverse, axis1=1, axis2=2) * max(spread, 1.0) / window_s**2
    return EventVelocity(middle, moved / window_s, variance)


def event_counts(events: Events, edges_s: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the events of each window, polarity and reduced pixel, [M, 2, P]; edges [M + 1], seconds."""
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
    """Return (events without change, events per unit of change) by least squares."""
    columns = np.stack([np.ones_like(change), change], axis=1)
    dark, slope = np.linalg.lstsq(columns, counts, rcond=None)[0].tolist()
    return max(dark, 1e-6), slope


def _between(
    place: NDArray[np.float64], times_s: NDArray[np.float64], at_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.stack([np.interp(at_s, times_s, place[:, k]) for k in range(2)], axis=-1)


_KNOTS = (9, 61)  # fewest and most
_NODES, _PER_KNOT = 64, 4  # instants at which the light is known: at least, and for each knot
_PATTERNS, _RANK = 120, 200  # of the target's prior; images of the wall, common to all poses
_STRIDES = ((8, 16), (4, 8), (2, 8), (1, 8))  # pixels from one row or column to the next, and most rounds
_FEWEST_PIXELS = 200
_ANNEALED, _BENT = 6, 8  # rounds in which the error of a crossing shrinks, and in which the path stays stiff
_STIFF, _FREE = 0.02, 0.1  # standard deviation of a second difference of the path, in sides of the target
_LEAK_ERROR = 5e-4  # log units per second: one that is free takes noise events for change, and tilts the path
_SHINE = 0.02  # deviation of the brightness at the ends of the path that the setup has not right, relative
_HELD = 1e4  # weight of the target's middle of light, and of the mean distance and turn
_ENOUGH = 0.2  # of a pose's standard deviation: a smaller step changes nothing that is known
_LONGEST, _LONGEST_Z = 0.1, 1.5  # step of a pose, sides of the target; of a coefficient
_BEYOND_CHANCE = 3.0  # times what noise alone lets a path explain; a letter of weak light reaches 9
_DARK = 1e-3  # white levels, of which the logarithm is taken at least
_UNTOLD = 0.25  # standard deviation of a place, sides of the target, from which on it is not told
_UNSURE = 0.3  # deviation of a first guess, sides of the target
_BLUR_PX, _RESTS = 1.5, 0.1  # of first guesses; share of the time in which a pixel shows least light


def fit_motion_to_events(
    events: Events,
    span_s: tuple[float, float],
    setup: Setup,
    target_size_m: float,
    cells: int = 20,
    step_s: float = 0.5,
    columns: int = 80,
    *,
    depth: bool = False,
    turning: bool = False,
) -> tuple[Array, MotionFit]:
    """Find the poses of a target, and the target, that make the events of a recording likeliest.

    As in `fit_motion` the middle of the light is the reference, and mean distance and turn are the setup's and
    0. The setup's leak counts as known; the brightness may change along the path by some per cent beside what
    the poses say. Pixels are taken from every eighth row and column first, from all of them at last. Where
    distance and turn are the setup's, the target is solved anew along the path, on finer cells.

    Args:
        events: The stream.
        span_s: First and last instant, seconds.
        setup: A linear setup with its event pixel.
        target_size_m: Side of a target plane that surely holds the object, metres.
        cells: Cells a side of it.
        step_s: Time between two knots of the path, seconds; 9 to 61 knots are taken.
        columns: Columns of the image for which the setup's light is rendered, pixels at most; the sensor's
            pixels get it by splines.
        depth: Find the distance to the wall too.
        turning: Find the turn about the wall's normal too.

    Returns:
        Instants of the knots, [N], seconds, and the poses there.

    Raises:
        ConfigError: The setup's event model states no law of its crossings.
        DataError: Too few events, or they do not tell where the target was.
    """
    inside = (events.t_us >= 1e6 * span_s[0]) & (events.t_us <= 1e6 * span_s[1])
    if (count := int(inside.sum())) < _LEAST_EVENTS:
        raise DataError(f"{count} events between first and last instant; a path needs {_LEAST_EVENTS} or more")
    shape = (events.height, events.width)
    seen, size_m = setup.seen_by(shape), target_size_m
    times = np.linspace(*span_s, int(np.clip(round((span_s[1] - span_s[0]) / step_s), *_KNOTS)))
    columns = min(columns, shape[1])
    coarse = (max(1, round(shape[0] * columns / shape[1])), columns)
    ambient = seen.ambient_light(shape)
    law = seen.pixel.known_law(WHITE_DN * float(ambient.mean()))
    counts = event_counts(events, times, coarse)
    start_m = _first_path(counts, ambient.numpy(), seen, law, times, size_m, coarse)
    fit = EventFit(
        seen, strip_corners(start_m, size_m, turning), times, shape, coarse, size_m, cells, depth, turning
    )
    law = seen.pixel.known_law(fit.light(start := fit.start(start_m)).typical_dn)
    record = record_of(events, law, span_s, fit.settings.gap_s)
    from threadpoolctl import threadpool_limits  # whose import changes the environment

    with threadpool_limits(1):  # products are small: a second thread mostly waits
        path, covariance = fit.solved(start, record, law, events.width)
        share, chance = fit.explained(path, covariance, counts, law, coarse)
        if share < _BEYOND_CHANCE * chance:
            raise DataError(
                f"the path explains {100 * share:.2g} % of what the events say of the light, noise alone lets "
                f"it explain {100 * chance:.2g} %: nothing to follow; light the target more, or lower the "
                "thresholds"
            )
        found = fit.as_motion(path, covariance)
        return times, found if depth or turning else replace(found, target=fit.sharper(path, events, span_s))


def log_changes(counts: Array, law: CrossingLaw) -> Array:
    """Return how the log light changes by the thresholds that events [M, 2, P] passed, [M, P]."""
    return law.threshold_on * counts[:, 0] - law.threshold_off * counts[:, 1]


def _first_path(
    counts: Array,
    ambient: NDArray[np.float32],
    setup: Setup,
    law: CrossingLaw,
    times_s: Array,
    size_m: float,
    shape: tuple[int, int],
) -> Array:
    """Return a first guess of the places at instants, [N, 2], metres: where the light's middle seems to be.

    Thresholds passed add up to the log light of a pixel, less what it is while it shows least.
    """
    from scipy.ndimage import gaussian_filter  # scipy loads slowly

    change = log_changes(counts, law)
    level = np.concatenate([np.zeros((1, change.shape[1])), np.cumsum(change, axis=0)])
    level = gaussian_filter(level.reshape(-1, *shape), (0, _BLUR_PX, _BLUR_PX))
    light = reduce_by_area(ambient, shape) * np.expm1(
        np.clip(level - np.quantile(level, _RESTS, axis=0), -3.0, 3.0)
    )
    peak = light.max(axis=(1, 2))
    if not float(peak.max()) > 0:
        raise DataError(
            "the events do not brighten any part of the wall for a while; there is nothing to follow"
        )
    bright = np.clip(light - 0.5 * peak[:, None, None], 0.0, None) + 1e-9 * peak.max()
    guess = plane_map(setup, shape, size_m)(middle_of_light(bright))
    unsure = (_UNSURE * size_m * np.clip(peak.max() / np.maximum(peak, 1e-9), 1.0, 10.0)) ** 2
    blank = np.full(len(times_s), np.nan)
    axes = [Measurements(times_s, one, unsure, blank, blank) for one in guess.T]
    acceleration = most_likely_acceleration(axes)
    return np.stack([smooth(one, acceleration).mean[:, 0] for one in axes], axis=-1)


@dataclass(frozen=True, eq=False)
class EventPath:
    """Target and poses as far as they are known."""

    pose: Array
    """x, y, ln(distance / own), turn at the knots, [N, 4]."""
    z: Array
    """Coefficients of the target."""
    shine: float = 0.0
    """Relative brightness at the last knot less 1, and the opposite at the first."""
    leak: float = 0.0


class EventFit:
    """The events as a function of target and path, around one state."""

    def __init__(
        self,
        setup: Setup,
        reach: Array,
        times_s: Array,
        shape: tuple[int, int],
        coarse: tuple[int, int],
        size_m: float,
        cells: int,
        depth: bool,
        turning: bool,
    ) -> None:
        from scipy.interpolate import CubicSpline

        plane = Plane(cells, cells, size_m / cells)
        # Not where the setup's own letters had their ink: the light's middle is the target's here.
        self._ink = Ink(setup.ink.size_m or size_m / TRACKED_ROOM)
        self.prior: PatternPrior = handwritten_prior(plane, min(_PATTERNS, cells**2), ink=self._ink)
        self.kinds = [0, 1, *([2] if depth else []), *([3] if turning else [])]
        self._scale = np.array([1.0, 1.0, setup.default_distance_m or 1.0, size_m / 4])  # to metres
        self.settings = LikelihoodSettings(leak_error=_LEAK_ERROR)
        self._setup, self._reach, self._size_m, self._shape = setup, reach, size_m, shape
        note("light of the setup")
        self._lights = Lights(setup, strip_of(reach, plane), coarse, depth, rank=_RANK)
        self._left = on_pixels(self._lights.basis.numpy(), coarse, shape)
        self._nodes = np.linspace(times_s[0], times_s[-1], max(_NODES, _PER_KNOT * len(times_s)))
        self._share = np.asarray(CubicSpline(times_s, np.eye(len(times_s)))(self._nodes))  # [T, N]
        self._ramp = np.linspace(-1.0, 1.0, len(self._nodes))
        self._still = setup.ambient_light(shape).flatten()[:, None].numpy()
        self._drawn = torch.from_numpy(np.column_stack([self.prior.mean, self.prior.patterns]))
        x, y = np.meshgrid(plane.x_m, plane.y_m)
        middle = np.stack([x.ravel(), y.ravel()]) / plane.extent_m[0]
        self._middle, self._off = middle @ self.prior.patterns, middle @ self.prior.mean

    def start(self, start_m: Array) -> EventPath:
        """Return the mean target on a path through places [N, 2], metres."""
        pose = np.zeros((len(start_m), 4))
        pose[:, :2] = start_m
        return EventPath(pose, np.zeros(self.prior.count))

    def light(self, path: EventPath) -> SequenceLight:
        """Return the light by coefficients, then changes of poses (in sides of the target), and shine."""
        poses = self._share @ path.pose
        fit = Fit(self.prior.target_plane, self._lights, poses, self.kinds, self._scale)
        image = torch.from_numpy(self.prior.image(path.z)).flatten()
        gain = 1.0 + path.shine * self._ramp
        right = gain[:, None, None] * (fit.maps @ self._drawn).numpy()  # [T, r, 1 + k]
        slope = gain[:, None, None] * fit.slopes(image).numpy()  # [T, K, r]
        moved = np.einsum("tj,tkr->trjk", self._share, slope).reshape(*right.shape[:2], -1) * self._size_m
        shine = _SHINE * (fit.maps @ image).numpy() * self._ramp[:, None]
        still, along = self._still, self._setup.companion_light(poses[:, :2])
        if along is not None:
            still = still + along.flatten(1).T.numpy()
        right = np.concatenate([right, moved, shine[..., None]], axis=2)
        return SequenceLight(self._left, right, still, self._nodes, self._shape)

    def solved(
        self, path: EventPath, record: EventRecord, law: CrossingLaw, width: int
    ) -> tuple[EventPath, Array]:
        """Return the path after all rounds, and the covariance of all unknowns."""
        strides = [one for one in _STRIDES if one[0] == 1 or len(self._left) >= _FEWEST_PIXELS * one[0] ** 2]
        covariance, number = np.zeros((0, 0)), 0
        for stride, most in strides:
            own = record.every(stride, width)
            for _ in range(most):
                note(f"path and target from the events, round {number + 1}, every {stride}. row and column")
                light = self.light(path).every(stride, _RANK)
                path, covariance, settled = self._step(
                    path, own, EventSolver(light, law, self.settings), number
                )
                number += 1
                if settled and number > _BENT:
                    break
        return path, covariance

    def explained(
        self, path: EventPath, covariance: Array, counts: Array, law: CrossingLaw, shape: tuple[int, int]
    ) -> tuple[float, float]:
        """Return the share of what the events say that the path explains, and what it would of noise.

        What they say is how the log light changes from knot to knot in blocks of pixels; the share is the
        square of its correlation with what target and path make of it.

        Args:
            path: The path.
            covariance: Of all unknowns.
            counts: Events of each time between knots, polarity and block, [N - 1, 2, P].
            law: Constants of the event model.
            shape: Rows and columns of the blocks.
        """
        light, known = self.light(path), len(path.z)
        at = light.place(np.linspace(self._nodes[0], self._nodes[-1], len(path.pose)))[0]
        bright = light(np.append(path.z, np.zeros(len(covariance) - known)))[:, at]
        made = np.diff(np.log(np.maximum(bright, _DARK)), axis=1).T.reshape(-1, *self._shape)
        made = reduce_by_area(made, shape).reshape(len(counts), -1)
        said = log_changes(counts, law)
        share = float((said * made).sum()) ** 2 / max(float((said**2).sum() * (made**2).sum()), 1e-300)
        free = len(covariance) - float(np.diag(covariance)[:known].sum())  # the prior decides the rest
        return share, free / said.size

    def as_motion(self, path: EventPath, covariance: Array) -> MotionFit:
        """Return poses and target with what is known of them.

        Raises:
            DataError: The events do not tell where the target was.
        """
        knots, kinds = len(path.pose), len(self.kinds)
        poses = slice(self.prior.count, self.prior.count + knots * kinds)
        unit = self._size_m / np.tile(self._scale[self.kinds], knots)
        covariance = (unit[:, None] * covariance[poses, poses] * unit).reshape(knots, kinds, knots, kinds)
        sigma_m = float(np.sqrt(np.median(np.einsum("nknk->nk", covariance)[:, :2])))
        if not sigma_m < _UNTOLD * self._size_m:
            raise DataError(
                f"the events tell the place of the target to {1e3 * sigma_m:.0f} mm, a quarter of its side at "
                "most is needed: light it more, move it faster, or lower the thresholds"
            )
        away, turn = (path.pose[:, k] if k in self.kinds else None for k in (2, 3))
        image = torch.from_numpy(self.prior.image(path.z))
        return MotionFit(path.pose[:, :2], covariance, image, away, turn, size_m=self._size_m)

    def sharper(self, path: EventPath, events: Events, span_s: tuple[float, float]) -> torch.Tensor:
        """Return the target on finer cells, solved anew along the path, [n, n].

        What coarse cells and few patterns leave of a letter is an error that ten thousand events do not average
        away: along the path they tell where the target was, but not always what it is.

        Args:
            path: The path, at the setup's distance.
            events: The stream.
            span_s: First and last instant, seconds.
        """
        from scipy.interpolate import CubicSpline

        note("the target, along the path found")
        plane = Plane(CELLS, CELLS, self._size_m / CELLS)
        prior = handwritten_prior(plane, COEFFICIENTS, ink=self._ink)
        place_m = CubicSpline(np.linspace(*span_s, len(path.pose)), path.pose[:, :2])
        light = sequence_light(self._setup, prior, lambda t_s: np.asarray(place_m(t_s)), span_s, self._shape)
        law = self._setup.pixel.known_law(light.typical_dn)
        return torch.from_numpy(prior.image(EventSolver(light, law)(events).z))

    def _step(
        self, path: EventPath, record: EventRecord, solver: EventSolver, number: int
    ) -> tuple[EventPath, Array, bool]:
        """Return the path after a Gauss-Newton step, all unknowns' covariance, and whether it was short."""
        count, (knots, kinds) = self.prior.count, (len(path.pose), len(self.kinds))
        poses, least = slice(count, count + knots * kinds), float(self.settings.noise_in(number, _ANNEALED))
        unknown = np.concatenate([path.z, np.zeros(knots * kinds + 1), [path.leak]])
        told = solver.improve(record, unknown, np.array([least]))
        known, score = np.zeros_like(told.information), told.score.copy()
        known[:count, :count] = np.eye(count) + _HELD * self._middle.T @ self._middle
        score[:count] -= _HELD * self._middle.T @ self._off
        bends = np.kron(np.diff(np.eye(knots), n=2, axis=0), np.eye(kinds))
        bends /= _STIFF if number < _BENT else _FREE
        known[poses, poses] = bends.T @ bends + 1e-6 * np.eye(knots * kinds)
        now = path.pose[:, self.kinds] * self._scale[self.kinds] / self._size_m
        score[poses] -= bends.T @ (bends @ now.ravel())
        for k, kind in enumerate(self.kinds):
            if kind > 1:  # the mean is the setup's; all of it until the path in the plane is about right
                mean = np.tile(np.eye(kinds)[k], knots)
                known[poses, poses] += _HELD * (np.outer(mean, mean) if number >= _BENT else np.diag(mean))
        known[-1, -1], score[-1] = 1.0, score[-1] - path.shine / _SHINE
        covariance = np.asarray(np.linalg.inv(told.information + known), np.float64)
        found = covariance @ score
        z, step = found[:count] - path.z, found[poses].reshape(knots, kinds)
        sigma = np.sqrt(np.diag(covariance)[poses]).reshape(knots, kinds)
        settled = bool((np.abs(step) < _ENOUGH * sigma).all())
        step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=0), 1e-12))
        pose = path.pose.copy()
        pose[:, self.kinds] += step * self._size_m / self._scale[self.kinds]
        pose[:, 2:] -= pose[:, 2:].mean(axis=0)
        pose[:, 2] = np.clip(pose[:, 2], -REACH, REACH)
        pose[:, :2] = np.clip(pose[:, :2], *self._reach)
        z = path.z + z * min(1.0, _LONGEST_Z / max(float(np.abs(z).max()), 1e-12))
        return (
            EventPath(pose, z, path.shine + _SHINE * float(found[-1]), float(unknown[-1])),
            covariance,
            settled,
        )
