"""A corner as a camera, the other way: from a video of the floor to an image over bearing and time.

- The sector of the floor that is looked at, and the bearing of each of its pixels about the edge.
- The floor's relative change per bin of bearing and step of time, read from a video frame by frame.
- The most probable image of the hidden side, with its uncertainty and its evidence.

The floor's texture multiplies its light, so each pixel is divided by its own mean: what is left is the relative
change dE / E, the same for a dark tile and a bright one. The model of a bin b at step t is

    y_b(t) = A x(t) + m_b + N c(t) + noise,

with A of `evnlos.optics.EdgeOperator`, m the unknown steady part, N constants and slopes over the bearing (gain
of the camera, lamps of this side; both unknown at each step) and x a Gaussian process with covariance s^2
exp(-|dphi| / l) exp(-|dt| / tau): the prior on first differences over the bearing of Bouman et al. (ICCV 2017),
with a weak pull to nothing and a memory in time. m and c have flat priors and are integrated out; s, l and tau
are those of largest evidence. Everything is exact: in the modes of prior and noise, the image falls into
independent series, each solved by a Kalman filter and a smoother (Rauch, Tung and Striebel 1965).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.optics import EdgeOperator

Array = NDArray[np.float64]
Point = tuple[float, float]
_MARGIN_DEG = 2.0  # next to the wall and to the last bearing, where pixels are mixed
_REFERENCE, _LEAST_FRAMES = 64, 16  # frames from which each pixel's mean and noise are taken
_REFERENCE_VALUES = 1 << 24  # of them that are held, about
_LEAST_PIXELS, _LEAST_STEPS = 400, 8
_NORMAL_MEDIAN = 0.4549  # of a squared standard normal number


@dataclass(frozen=True)
class FloorSector:
    """The part of an image of the floor that looks past the edge, and its bearings.

    Args:
        edge: Foot of the wall's edge (column, row), pixels.
        wall: Another point of the line in which the wall meets the floor, on the wall's side of the edge.
        end: A point of the floor; the sector runs from the wall's line to the ray through it, by less than 180
            degrees. The farther of `wall` and `end` says how far from the edge pixels are taken.
        to_ground: Homography [3, 3] from pixels to any plane that is similar to the floor; None takes bearings
            as they are in the image, which is right at the wall's line alone.

    Raises:
        ConfigError: Points that coincide or are not finite.
    """

    edge: Point
    wall: Point
    end: Point
    to_ground: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        points = np.array([self.edge, self.wall, self.end], np.float64)
        if points.shape != (3, 2) or not np.isfinite(points).all():
            raise ConfigError("edge, wall and end are points (column, row) in pixels; give two numbers each")
        for name in ("wall", "end"):
            if math.dist(getattr(self, name), self.edge) < 8:
                raise ConfigError(f"{name} is {getattr(self, name)}, beside the edge; give one 8 px off")

    @property
    def reach_px(self) -> float:
        """Largest distance from the edge, pixels."""
        return max(math.dist(self.wall, self.edge), math.dist(self.end, self.edge))

    def _mapped(self, points: Array) -> Array:
        if self.to_ground is None:
            return points
        rows = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.array(self.to_ground).T
        return rows[:, :2] / rows[:, 2:]

    def _turned(self, points: Array) -> Array:
        """Return the angle from the wall's ray towards the end's, 0..2 pi."""
        origin, wall, end = self._mapped(np.array([self.edge, self.wall, self.end], np.float64))
        along, last = wall - origin, end - origin
        sign = 1.0 if along[0] * last[1] - along[1] * last[0] >= 0 else -1.0
        p = self._mapped(points) - origin
        angle = np.arctan2(sign * (along[0] * p[:, 1] - along[1] * p[:, 0]), p @ along)
        return np.mod(angle, 2 * np.pi)

    @property
    def span_deg(self) -> float:
        """Bearing of the last ray, degrees."""
        return float(np.degrees(self._turned(np.array([self.end], np.float64))[0]))

    def pixels(self, shape: tuple[int, int]) -> tuple[tuple[int, int, int, int], NDArray[np.int64], Array]:
        """Return the box (left, top, right, bottom) around the sector, its pixels in it, and their bearings.

        Args:
            shape: Size (H, W) of the image, pixels.

        Returns:
            Box; flat indices within the box [P]; bearings [P], degrees.

        Raises:
            ConfigError: The edge lies outside the image, too little of the sector inside, or it is too narrow
                or too wide.
        """
        height, width = shape
        if not (0 <= self.edge[0] < width and 0 <= self.edge[1] < height):
            raise ConfigError(
                f"the edge {self.edge} lies outside the image of {width} x {height} pixels; give "
                "the column and the row of its foot"
            )
        if not 10 < self.span_deg < 179.9:
            raise ConfigError(
                f"the sector from the wall to the end is {self.span_deg:.3g} degrees wide; give an end that "
                "makes it 10 to 179 degrees"
            )
        (x, y), reach = self.edge, self.reach_px
        left, right = max(0, math.floor(x - reach)), min(width, math.ceil(x + reach) + 1)
        top, bottom = max(0, math.floor(y - reach)), min(height, math.ceil(y + reach) + 1)
        v, u = np.mgrid[top:bottom, left:right]
        points = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        far = np.hypot(points[:, 0] - x, points[:, 1] - y)
        bearing = np.degrees(self._turned(points))
        inside = (far <= reach) & (far >= max(4.0, 0.06 * reach))
        inside &= (bearing >= _MARGIN_DEG) & (bearing <= self.span_deg - _MARGIN_DEG)
        index = np.flatnonzero(inside)
        if len(index) < _LEAST_PIXELS:
            raise ConfigError(
                f"the sector has {len(index)} pixels inside the image; give wall and end so that it has "
                f"{_LEAST_PIXELS} or more"
            )
        return (left, top, right, bottom), index, bearing[index]


@dataclass(frozen=True, eq=False)
class Penumbra:
    """The floor's relative change, per step of time and bin of bearing.

    Args:
        edges_deg: Ends of the bins of bearing, [B + 1], degrees.
        times_s: Middles of the steps, [T], seconds.
        change: dE / E less its mean over time, [T, B]; NaN where a step is lost.
        variance: Variance of the noise of a bin in one step, [B].
        gain: Common factor of the floor's light, [T].
        shift_px: The image's shift (columns, rows), [T, 2]; NaN where the floor has no texture to tell.
        disturbed: Fraction of the frames in which something moves on the floor itself.
        noise_factor: Noise over that of independent pixels: what the codec and unsteady light add.
        level: Mean light of the floor, fraction of white.
        frames: Frames read.
    """

    edges_deg: Array
    times_s: Array
    change: Array
    variance: Array
    gain: Array
    shift_px: Array
    disturbed: float
    noise_factor: float
    level: float
    frames: int

    @property
    def step_s(self) -> float:
        """Length of a step, seconds."""
        return float(np.median(np.diff(self.times_s)))

    @property
    def shift_known(self) -> bool:
        """Whether the floor has texture enough to tell the image's shift."""
        return not bool(np.isnan(self.shift_px).all())

    @cached_property
    def lost(self) -> NDArray[np.bool_]:
        """Steps in which nothing could be read, [T]."""
        return np.isnan(self.change[:, 0])

    def whitened(self) -> tuple[Array, Array]:
        """Return the projector W [B - 2, B] off gain and slope onto data of unit noise, and W y, [T, B - 2]."""
        scale = 1 / np.sqrt(self.variance)
        middle = 0.5 * (self.edges_deg[1:] + self.edges_deg[:-1])
        basis = np.stack([scale, scale * (middle - middle.mean())], axis=1)
        full, _ = np.linalg.qr(basis, mode="complete")
        whitener = full[:, 2:].T * scale
        return whitener, np.where(self.lost[:, None], 0.0, np.nan_to_num(self.change) @ whitener.T)


def read_penumbra(
    frames: Iterable[tuple[float, NDArray]],
    index: NDArray[np.int64],
    bearing_deg: Array,
    *,
    step_s: float = 0.1,
    bin_deg: float = 1.0,
    white: float = 255.0,
) -> Penumbra:
    """Return the floor's relative change per bin of bearing, from frames that are read once, one by one.

    The first frames give each pixel's mean B and noise sigma (as a function of the light). Each frame I is then
    reduced to sums over the bins of (B / sigma^2)(I - B), and to its likeness to B shifted by a pixel across
    and down, from which small shifts of the camera are found and taken off. Memory does not grow with the
    frames.

    Args:
        frames: Time in seconds and light [h, w] of each frame's box, 255 = white; times ascend.
        index: Pixels of the sector in the flat box, [P].
        bearing_deg: Their bearings, [P], degrees.
        step_s: Length of a step of time over which frames are averaged, seconds.
        bin_deg: Width of a bin of bearing, degrees.
        white: Light of a saturated pixel, DN.

    Raises:
        DataError: Too few frames or steps; a floor that is too dark, saturated or covered.
    """
    source = iter(frames)
    most = min(_REFERENCE, max(_LEAST_FRAMES, _REFERENCE_VALUES // len(index)))
    held: list[tuple[float, NDArray]] = []
    total: Array | float = 0.0
    for time_s, light in source:
        total = total + light
        held.append((time_s, light.ravel()[index]))
        if len(held) == most:
            break
    if len(held) < _LEAST_FRAMES:
        raise DataError(f"the video has {len(held)} frames; give {_LEAST_FRAMES} or more, better some seconds")
    stack = np.stack([values for _, values in held])
    if not np.ptp(stack, axis=0).any():
        raise DataError("the frames are all alike, as no camera's are; give the video as it was recorded")
    across = [slope.ravel()[index] for slope in np.gradient(np.asarray(total, np.float64) / len(held))[::-1]]
    reducer = _reducer(stack, np.stack(across), bearing_deg, bin_deg, white)
    del stack
    times, sums, counts = list[float](), list[Array](), list[int]()
    disturbed = number = 0

    def frames_again() -> Iterable[tuple[float, NDArray]]:
        yield from held
        held.clear()
        yield from ((time_s, light.ravel()[index]) for time_s, light in source)

    start = held[0][0]
    pace = (held[-1][0] - start) / (len(held) - 1)
    step = max(step_s, pace)
    for time_s, values in frames_again():
        number += 1
        slot = int((time_s - start + 0.5 * pace) / step)
        while len(sums) <= slot:
            times.append(start + (len(sums) + 0.5) * step - 0.5 * pace)
            sums.append(np.zeros(reducer.size))
            counts.append(0)
        found, calm = reducer.reduce(values)
        disturbed += not calm
        if calm:
            sums[slot] += found
            counts[slot] += 1
    count = np.array(counts)
    if np.count_nonzero(count) < _LEAST_STEPS:
        raise DataError(
            f"{np.count_nonzero(count)} steps of {step:g} s can be used of {number} frames"
            + (f", in {disturbed} something moves on the floor itself" if disturbed else "")
            + f"; give a longer video or a shorter step, {_LEAST_STEPS} steps or more"
        )
    mean = np.stack(sums) / np.maximum(count, 1)[:, None]
    change, gain, shift = reducer.solve(mean)
    change[count == 0] = np.nan
    change -= np.nanmean(change, axis=0)
    usual = float(np.median(count[count > 0]))
    variance, factor = noise_of(change, reducer.variance / usual)
    return Penumbra(
        reducer.edges, np.array(times), change, variance, gain, shift, disturbed / number, factor,
        reducer.level / white, number,
    )  # fmt: skip


@dataclass(eq=False)
class _Reducer:
    """Sums of a frame over bins of bearing: fixed weights, so that frames may be averaged before or after."""

    edges: Array
    order: NDArray[np.int64]  # usable pixels of the sector, sorted by bin
    starts: NDArray[np.int64]  # of the bins in that order
    mean: Array
    weight: Array  # B / sigma^2
    sigma: Array
    slopes: Array  # of the mean light along columns and rows, [2, P]
    level: float

    def __post_init__(self) -> None:
        self.precision = np.add.reduceat(self.weight * self.mean, self.starts)  # of a bin's relative change
        self.variance = 1 / self.precision
        self.size = len(self.starts) + 2
        slope_weight = self.slopes * (self.weight / self.mean)
        self._slope_weight = slope_weight
        self._cross = np.stack([np.add.reduceat(s * self.weight, self.starts) for s in self.slopes])  # [2, B]
        own = slope_weight @ self.slopes.T
        # The shift is solved together with all bins; a prior of one pixel keeps a smooth floor's shift at 0.
        self._schur = own - (self._cross * self.variance) @ self._cross.T + np.eye(2)

    def reduce(self, values: NDArray) -> tuple[Array, bool]:
        """Return the sums [B + 2] of a frame's pixels [P], and whether nothing moves on the floor itself."""
        rest = values[self.order] - self.mean
        common = float(np.median(rest[::7] / self.mean[::7]))
        odd = np.abs(rest - common * self.mean) > 6 * self.sigma + 0.1 * self.mean
        bins = np.add.reduceat(self.weight * rest, self.starts)
        return np.concatenate([bins, self._slope_weight @ rest]), float(odd.mean()) < 0.02

    def solve(self, sums: Array) -> tuple[Array, Array, Array]:
        """Return relative changes [T, B], gains [T] and shifts [T, 2] of sums [T, B + 2]."""
        bins, likeness = sums[:, :-2], sums[:, -2:]
        against = likeness - (bins * self.variance) @ self._cross.T
        moved: Array = against @ np.linalg.inv(self._schur)  # image = mean - slope * shift
        change = (bins - moved @ self._cross) * self.variance
        known = np.linalg.eigvalsh(self._schur)[0] > 400  # a twentieth of a pixel
        gain = 1 + (change * self.precision).sum(axis=1) / self.precision.sum()
        return change, gain, -np.asarray(moved, np.float64) if known else np.full(moved.shape, np.nan)


def _reducer(stack: NDArray, slopes: Array, bearing: Array, bin_deg: float, white: float) -> _Reducer:
    mean = stack.mean(axis=0, dtype=np.float64)
    level = float(mean.mean())
    bright = (stack >= 0.985 * white).mean(axis=0) > 0.02
    dark = mean < 0.004 * white
    if bright.mean() > 0.5:
        raise DataError(
            f"{100 * bright.mean():.0f} % of the floor's pixels are saturated; record a darker video"
        )
    if dark.mean() > 0.5:
        raise DataError(
            f"the floor's light is {100 * level / white:.2g} % of white; record a brighter video, 5 % or more"
        )
    good = ~(bright | dark)
    relative = stack[:, good] / np.maximum(stack[:, good].mean(axis=1, keepdims=True), 1e-9)
    variance = (np.diff(relative, axis=0) ** 2).mean(axis=0, dtype=np.float64) / 2 * level**2
    del relative
    mean, bearing, slopes = mean[good], bearing[good], slopes[:, good]
    # Variance as a line of the light: single pixels' are too few to be told, and rounding may hide it.
    sides = np.quantile(mean, np.linspace(0, 1, 9))
    group = np.clip(np.searchsorted(sides, mean, "right") - 1, 0, 7)
    x, y = (np.array([v[group == k].mean() for k in range(8) if (group == k).any()]) for v in (mean, variance))
    slope, offset = np.polyfit(x, y, 1) if np.ptp(x) > 0.02 * x.mean() else (0.0, float(y.mean()))
    least = max(1 / 12, 0.2 * float(y.mean()))
    sigma = np.sqrt(np.maximum(offset + slope * mean, least))
    bins = max(16, round((bearing.max() - bearing.min()) / bin_deg))
    while True:
        edges = np.linspace(bearing.min(), bearing.max() + 1e-9, bins + 1)
        number = np.clip(np.searchsorted(edges, bearing, "right") - 1, 0, bins - 1)
        held_bins = np.bincount(number, minlength=bins)
        if bins == 16 or held_bins.min() >= 20:
            break
        bins = max(16, bins * 3 // 4)  # too narrow for the pixels that there are
    if held_bins.min() == 0:
        raise DataError("a bearing of the sector has no usable pixel; give another wall or end, or less light")
    order = np.argsort(number, kind="stable")
    starts = np.concatenate([[0], np.cumsum(held_bins)[:-1]])
    mean, sigma = mean[order], sigma[order]
    usable = np.flatnonzero(good)[order]
    return _Reducer(edges, usable, starts, mean, mean / sigma**2, sigma, slopes[:, order], level)


def noise_of(change: Array, predicted: Array) -> tuple[Array, float]:
    """Return the variance of the noise of each bin, [B], and its factor over the predicted one.

    Between neighbours of three, a hidden scene changes evenly but for few of them: second differences over the
    bearing are noise, and a median leaves the few out. They are taken of bins, of sums of 3 and of 10 bins, in
    steps and in means of 4, 16 and 64 steps; noise of independent pixels gives each the same factor. The
    largest counts, so that noise with a width or a memory (codecs, lamps) is not missed.

    Args:
        change: Relative changes, [T, B]; NaN = lost.
        predicted: Variance of the noise of independent pixels, [B].
    """
    y = change[~np.isnan(change[:, 0])] / np.sqrt(predicted)
    middle = np.arange(y.shape[1]) - (y.shape[1] - 1) / 2
    basis, _ = np.linalg.qr(np.stack([np.ones_like(middle), middle], axis=1) / np.sqrt(predicted)[:, None])
    y = y - (y @ basis) @ basis.T  # the gain, and light that slopes
    factors = [1e-12]
    for cells in (1, 3, 10):
        count = y.shape[1] // cells
        if cells > 1 and count < 12:
            continue
        blocks = y[:, : count * cells].reshape(len(y), count, cells).sum(axis=2) / math.sqrt(cells)
        across = blocks[:, 1:-1] - 0.5 * (blocks[:, 2:] + blocks[:, :-2])
        for span in (1, 4, 16, 64):
            whole = len(y) // span
            if whole >= 6 and whole * across.shape[1] >= 150:
                means = across[: whole * span].reshape(whole, span, -1).mean(axis=1)
                spread = float(np.median((means - means.mean(axis=0)) ** 2)) * whole / (whole - 1)
                factors.append(span * spread / 1.5 / _NORMAL_MEDIAN)
    factor = max(factors)
    return factor * predicted, factor


class Prior(NamedTuple):
    """The prior of the hidden image."""

    deviation: float
    """Standard deviation s, relative change of the floor per degree."""
    length_deg: float
    """Length of correlation over the bearing, degrees."""
    memory_s: float
    """Length of correlation over time, seconds."""


@dataclass(frozen=True, eq=False)
class CornerImage:
    """The hidden side over bearing and time.

    Args:
        bearings_deg: Middles of the cells, [B], degrees.
        times_s: [T], seconds.
        mean: Most probable change of the hidden light per degree, relative to the floor's light, [T, B].
        deviation: Its standard deviation, [T, B].
        prior: The prior of largest evidence.
        evidence: Natural logarithm of the evidence over that of a scene in which nothing changes.
        resolution_deg: Width at half height of what becomes of a thin bright strip, [B], degrees.
    """

    bearings_deg: Array
    times_s: Array
    mean: Array
    deviation: Array
    prior: Prior
    evidence: float
    resolution_deg: Array


@njit(cache=True)
def _smooth(
    data: Array, lost: NDArray[np.bool_], gain: Array, keep: float, mean: Array, variance: Array
) -> float:
    """Smooth series z_t = g c_t + m + noise, c an AR(1) of unit variance, m flat; return the log evidence.

    Symbols: c_t+1 = a c_t + sqrt(1 - a^2) e; z, the same with all ones in place of z (h) for the flat m.

    Args:
        data: z of each mode, [K, T].
        lost: Steps without data, [T].
        gain: g of each mode, [K].
        keep: a, from a step to the next.
        mean: Smoothed c, [K, T], overwritten; nothing is smoothed where it is empty.
        variance: Its variance, [K, T], overwritten.
    """
    modes, steps = data.shape
    total = 0.0
    c, h, p = np.empty(steps), np.empty(steps), np.empty(steps)
    for k in range(modes):
        g = gain[k]
        cz, ch, pp = 0.0, 0.0, 1.0
        szz, szh, shh, logs = 0.0, 0.0, 0.0, 0.0
        seen = 0
        for t in range(steps):
            if t > 0:
                cz, ch, pp = keep * cz, keep * ch, keep * keep * pp + 1.0 - keep * keep
            if not lost[t]:
                f = g * g * pp + 1.0
                ez, eh = data[k, t] - g * cz, 1.0 - g * ch
                kalman = pp * g / f
                cz, ch, pp = cz + kalman * ez, ch + kalman * eh, pp / f
                szz += ez * ez / f
                szh += ez * eh / f
                shh += eh * eh / f
                logs += math.log(f)
                seen += 1
            c[t], h[t], p[t] = cz, ch, pp
        m = szh / shh
        total -= 0.5 * (szz - m * szh + logs + math.log(shh / seen))
        if mean.size == 0:
            continue
        for t in range(steps - 2, -1, -1):
            ahead = keep * keep * p[t] + 1.0 - keep * keep
            back = p[t] * keep / ahead
            c[t] += back * (c[t + 1] - keep * c[t])
            h[t] += back * (h[t + 1] - keep * h[t])
            p[t] += back * back * (p[t + 1] - ahead)
        for t in range(steps):
            mean[k, t] = c[t] - m * h[t]
            variance[k, t] = p[t] + h[t] * h[t] / shh
    return total


class _Modes:
    """A penumbra in the modes of a prior of one length of correlation."""

    def __init__(self, penumbra: Penumbra, length_deg: float) -> None:
        edges = penumbra.edges_deg
        self.middle = 0.5 * (edges[1:] + edges[:-1])
        whitener, data = penumbra.whitened()
        covariance = np.exp(-np.abs(self.middle[:, None] - self.middle) / length_deg)
        self.root = np.linalg.cholesky(covariance + 1e-10 * np.eye(len(covariance)))
        self.operator = whitener @ EdgeOperator(edges).matrix()
        u, self.gain, vt = np.linalg.svd(self.operator @ self.root)
        self.basis = self.root @ vt.T  # [B, B]
        self.gain = np.concatenate([self.gain, np.zeros(len(vt) - len(self.gain))])
        rest = np.zeros((len(vt) - u.shape[1], len(data)))
        self.data = np.ascontiguousarray(np.concatenate([u.T @ data.T, rest]))  # [B, T]
        self.lost = penumbra.lost

    def evidence(self, deviation: float, keep: float) -> float:
        none = np.empty((0, 0))
        return _smooth(self.data, self.lost, deviation * self.gain, keep, none, none)


def estimate_corner(penumbra: Penumbra, prior: Prior | None = None) -> CornerImage:
    """Return the most probable image of the hidden side, its deviation and its evidence.

    Args:
        penumbra: What the floor shows.
        prior: The prior; None = that of the largest evidence.
    """
    step = penumbra.step_s
    if prior is None:
        prior = _likeliest(penumbra)
    modes = _Modes(penumbra, prior.length_deg)
    keep = math.exp(-step / prior.memory_s)
    mean, variance = np.empty_like(modes.data), np.empty_like(modes.data)
    evidence = _smooth(modes.data, modes.lost, prior.deviation * modes.gain, keep, mean, variance)
    basis = prior.deviation * modes.basis
    # What one step shows of a thin strip, with the memory's steps averaged.
    steps = max(1.0, prior.memory_s / step)
    gain2 = steps * (prior.deviation * modes.gain) ** 2
    spread = (modes.basis * (gain2 / (1 + gain2))) @ np.linalg.inv(modes.basis)
    return CornerImage(
        modes.middle,
        penumbra.times_s,
        (basis @ mean).T,
        np.sqrt(basis**2 @ variance).T,
        prior,
        evidence - modes.evidence(0.0, keep),
        _half_widths(spread, modes.middle),
    )


def _likeliest(penumbra: Penumbra) -> Prior:
    from scipy.optimize import minimize

    step = penumbra.step_s
    scale = math.sqrt(float(np.median(penumbra.variance))) / float(np.ptp(penumbra.edges_deg))
    best: tuple[float, Prior] | None = None
    for length in (2.0, 4.0, 8.0, 16.0):
        modes = _Modes(penumbra, length)

        def cost(logs: ArrayLike, modes: _Modes = modes) -> float:
            a, b = np.clip(logs, (-8, math.log(0.5 * step)), (16, math.log(60.0)))
            return -modes.evidence(scale * math.exp(a), math.exp(-step / math.exp(b)))

        found = minimize(
            cost, (3.0, 0.0), method="Nelder-Mead", options={"xatol": 0.1, "fatol": 0.1, "maxfev": 60}
        )
        a, b = np.clip(found.x, (-8, math.log(0.5 * step)), (16, math.log(60.0)))
        if best is None or -found.fun > best[0]:
            best = float(-found.fun), Prior(scale * math.exp(a), length, math.exp(b))
    assert best is not None
    return best[1]


def _half_widths(spread: Array, middle: Array) -> Array:
    """Return the width at half height of each column's peak, in the unit of `middle`; infinite without one."""
    cell = float(np.diff(middle).mean())
    widths = np.full(len(middle), np.inf)
    for k in range(len(middle)):
        column = spread[:, k]
        top = int(np.argmax(column))
        if column[top] <= 1e-6:
            continue
        low = high = top
        while low > 0 and column[low - 1] > column[top] / 2:
            low -= 1
        while high < len(column) - 1 and column[high + 1] > column[top] / 2:
            high += 1
        widths[k] = (high - low + 1) * cell
    return widths
