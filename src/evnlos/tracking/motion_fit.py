"""Fitting a motion, by the calibrated operator: the likeliest poses of targets, their number, a smoother."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import embedding_bag

from evnlos.inverse import BackgroundModel
from evnlos.inverse.operators import Gradient, normal_matrix
from evnlos.inverse.sequence_problem import mean_weight, strip_of
from evnlos.machine import note
from evnlos.optics import DepthTransport
from evnlos.optics.interpolation import spline_coefficients, spline_slopes, spline_weights
from evnlos.setups import Setup
from evnlos.tracking.track import (
    Measurements,
    most_likely_acceleration,
    straightened,
    strip_corners,
    walk_covariance,
)
from evnlos.types import Plane

Array = NDArray[np.float64]
REACH = 0.3
"""Largest change of the distance's logarithm that is looked for: 0.74 to 1.35 of the setup's own distance."""
REGION = (4.0, 2.8)
"""Sides of the part of the target's plane in which several targets are looked for, (x, y), over a target's."""
MOST_TARGETS = 5
"""Largest number of targets that is looked for by evidence."""
_ROUNDS, _TRIAL_ROUNDS, _STRAIGHT_ROUNDS = 24, 12, 5
_FIRST_FRAMES, _STRIDE = 24, 3  # of which first guesses of paths are made; cells between two of them at most
_BEND = 0.1  # what a bend of one cell costs, of the brightest score
_STATIC, _PRIOR = 1.0, 3.0  # a pixel's constant offset over its noise; weight of the target's smoothness
_LONGEST = 0.1  # step of a round, sides of a target
_ENOUGH = 0.1  # of a place's standard deviation: a step below it changes nothing that is known
_UNTOLD = 1e-7  # share of a direction's information that the target leaves, below which it is not told
_HELD = 1e6  # weight of the light's middle in the target's middle, over that of the frames


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Poses of the target and the target itself.

    Args:
        position_m: Middle of the object's light (x, y), float64 [N, 2], metres.
        covariance: Of x and y, metres, and, where looked for, ln(distance) and turn, radians, [N, K, N, K].
        target: The object, its light's middle in the array's middle, float64 [n, n].
        log_distance: ln(distance to the wall / the setup's), [N], of mean 0; None where it was not looked for.
        rotation_rad: Turn about the wall's normal, [N], of mean 0; None where it was not looked for.
        misfit: What the target leaves of the frames' changes, over their noise, rms; an exact setup leaves 1.
        surprise: Smallest sum of squares of what is left and of the target's roughness.
        volume: ln of how much the frames narrow down the target, a determinant over that of its prior.
        inside: As `misfit`, of what the strip can show of the frames, where the light is.
        noise: Standard deviation of a sample's noise that was taken for true, white levels.
        size_m: Side of the target's array, metres.
    """

    position_m: Array
    covariance: Array
    target: torch.Tensor
    log_distance: Array | None = None
    rotation_rad: Array | None = None
    misfit: float = 1.0
    surprise: float = 0.0
    volume: float = 0.0
    inside: float = 1.0
    noise: float = 1.0
    size_m: float = 0.1


def fit_motion(
    light: torch.Tensor,
    setup: Setup,
    start_m: Array,
    noise: float,
    target_size_m: float,
    cells: int = 20,
    *,
    depth: bool = False,
    turning: bool = False,
    rounds: int = _ROUNDS,
    bend_m: float = 0.0,
    degree: int | None = 2,
    image_cells: int | None = None,
) -> MotionFit:
    """Find the poses of a target, and the target, that explain the frames best: Gauss and Newton's method.

    The target is eliminated (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973): a
    step of the poses knows that the target follows, as it does where a path is stretched. A target and a path
    are only known together up to a shift; the target's middle of light is the reference. So are mean distance
    and turn: a nearer target and a larger one look alike. Each of several knows what the others explain.

    Args:
        light: Frames, white levels, [N, h, w], without ambient light as far as it is known.
        setup: The setup.
        start_m: First guess of the positions, [N, 2], of K targets [N, K, 2], metres.
        noise: Standard deviation of a sample's noise, white levels.
        target_size_m: Side of a target plane that surely holds the object, metres.
        cells: Cells a side of it.
        depth: Find the distance to the wall in each frame too.
        turning: Find the turn about the wall's normal in each frame too.
        rounds: Most steps.
        bend_m: Above 0: standard deviation of a path's second difference in the first rounds, metres, which
            carries it through frames in which another target hides where it is.
        degree: Ambient light that is left over is any polynomial of this total degree; None: no smooth one.
        image_cells: Cells a side of the target that is returned, solved anew at the poses; None: `cells`.
    """
    target_plane = Plane(cells, cells, target_size_m / cells)
    places = start_m.reshape(-1, 2)
    reach = strip_corners(places, target_size_m, turning)
    shape = (int(light.shape[1]), int(light.shape[2]))
    lights = Lights(setup, strip_of(reach, target_plane), shape, depth, degree)
    seen = lights.seen(light)
    count, targets = len(start_m), len(places) // len(start_m)
    prior = torch.block_diag(*[_smooth(target_plane, noise)] * targets)
    pose = np.zeros((count, targets, 4))  # x, y, ln(distance / own), turn
    pose[..., :2] = places.reshape(count, targets, 2)
    kinds = [0, 1, *([2] if depth else []), *([3] if turning else [])]
    scale = np.array([1.0, 1.0, setup.default_distance_m or 1.0, target_size_m / 4])  # to metres
    many = targets * len(kinds)
    covariance = np.zeros((count, many, count, many))
    image, told = torch.zeros(target_plane.shape), (1.0, 0.0, 0.0, 1.0)
    still = (1 - mean_weight(len(light), _STATIC)) / len(light)
    whole, part = (float((one - still * one.sum(dim=0)).square().sum()) for one in (light, seen))
    rest = whole - part  # what no target explains
    beyond = moving_energy(light) - moving_energy(seen)
    for number in range(1, rounds + 1):
        note(f"places and image, round {number}")
        fit = Fit(target_plane, lights, pose, kinds, scale)
        image, step, covariance, left = fit.step(seen, prior)
        misfit = math.sqrt((rest + left) / (light[0].numel() * (count - 1))) / noise
        inside = math.sqrt(left / (seen.shape[1] * (count - 1))) / noise
        told = misfit, beyond + fit.surprise, fit.volume, inside
        if straight := bend_m > 0 and number <= _STRAIGHT_ROUNDS:
            step = straightened(step, covariance, pose[..., kinds].reshape(count, many), bend_m / noise)
        step = step.reshape(count, targets, len(kinds))
        step = step * np.minimum(1.0, _LONGEST * target_size_m / np.abs(step).max(axis=(0, 2), keepdims=True))
        pose[..., kinds] += step / scale[kinds]
        pose[..., 2:] -= pose[..., 2:].mean(axis=0)
        pose[..., 2] = np.clip(pose[..., 2], -REACH, REACH)
        pose[..., :2] = np.clip(pose[..., :2], reach[0], reach[1])
        sigma = noise * np.sqrt(np.einsum("nknk->nk", covariance)).reshape(step.shape)
        if not straight and (np.abs(step) < _ENOUGH * sigma).all():
            break
    if image_cells is not None:
        target_plane = Plane(image_cells, image_cells, target_size_m / image_cells)
        prior = torch.block_diag(*[_smooth(target_plane, noise)] * targets)
        image = Fit(target_plane, lights, pose, kinds, scale).step(seen, prior)[0]
    unit = np.tile(scale[kinds], targets)
    # An exact setup leaves the noise alone; where the light is, its own noise and the fixed pattern add to it.
    covariance = (max(told[0], told[3], 1.0) * noise) ** 2 * covariance / unit[:, None, None] / unit
    away, turn = (pose[..., k].reshape(start_m.shape[:-1]) if k in kinds else None for k in (2, 3))
    place, image = pose[..., :2].reshape(start_m.shape), image if start_m.ndim > 2 else image[0]
    return MotionFit(place, covariance, image, away, turn, *told, noise, target_size_m)


def _smooth(plane: Plane, noise: float) -> torch.Tensor:
    return _PRIOR * noise**2 * normal_matrix(Gradient("dark"), torch.zeros(plane.shape).double())


def moving_energy(frames: torch.Tensor, degree: int | None = None) -> float:
    """Return the sum of squares of frames [N, ...], with as much of their mean as an unknown offset leaves.

    With a degree, frames [N, H, W] also lose of their mean what a polynomial of it could be.
    """
    mean, kept = frames.double().mean(dim=0), mean_weight(len(frames), _STATIC)
    known = mean.square().sum()
    if degree is not None:
        known -= (_ambient(tuple(mean.shape), degree).mT @ mean.flatten()).square().sum()
    return float(frames.double().square().sum() - len(frames) * (mean.square().sum() - kept * known))


def _ambient(shape: tuple[int, ...], degree: int) -> torch.Tensor:
    """Return polynomials over the pixels, orthonormal, float64 [H W, K]."""
    return torch.linalg.qr(BackgroundModel(degree).polynomials((shape[0], shape[1])).flatten(1).mT)[0]


def log_evidence(fit: MotionFit, times_s: Array, noise: float) -> float:
    """Return ln of the probability density of the frames, up to what all numbers of targets share.

    Targets are integrated out exactly, paths by Laplace's method: they may be anywhere in `REGION`, at any
    velocity that crosses it, which walks at random by as much as makes the path likeliest (`smooth`).

    Args:
        fit: Paths and targets in their plane.
        times_s: Instants of the frames, [N], seconds.
        noise: Standard deviation of the noise, white levels: the same for all numbers of targets.
    """
    count, many, passed = len(times_s), fit.covariance.shape[1], times_s - times_s.mean()
    variance, places = np.einsum("nknk->nk", fit.covariance), fit.position_m.reshape(count, many)
    covered = np.zeros((count, many, count, many))
    blank = np.full(count, np.nan)
    for k in range(0, many, 2):
        axes = [Measurements(times_s, places[:, k + j], variance[:, k + j], blank, blank) for j in range(2)]
        walk = walk_covariance(times_s - times_s[0], np.zeros(count, bool), most_likely_acceleration(axes))
        for j, side_m in enumerate(fit.size_m * np.array(REGION)):
            line = side_m**2 / 12 + np.outer(passed, passed) * (side_m / np.ptp(times_s)) ** 2
            covered[:, k + j, :, k + j] = walk + line
    size, scale = count * many, (max(fit.misfit, 1.0) * fit.noise / noise) ** 2
    root = np.linalg.cholesky(covered.reshape(size, size) + 1e-10 * fit.size_m**2 * np.eye(size))
    told = scale * np.linalg.pinv(fit.covariance.reshape(size, size), rcond=1e-10, hermitian=True)
    d = places.ravel()  # from the middle of the region
    within, b = np.eye(size) + root.T @ told @ root, root.T @ (told @ d)
    path = -0.5 * d @ told @ d + 0.5 * b @ np.linalg.solve(within, b) - 0.5 * np.linalg.slogdet(within)[1]
    return float(path - 0.5 * fit.surprise / noise**2 - 0.5 * fit.volume)


class Number(NamedTuple):
    """How many targets the frames show, and by how much."""

    fits: list[MotionFit]
    """Of 1, 2, ... targets, one more than were found at most."""
    gains: list[float]
    """ln of the evidence of each number over that of one target less and the setup's own error."""

    @property
    def found(self) -> int:
        """The number up to which each further target raises the evidence."""
        return next((k for k, gain in enumerate(self.gains) if gain <= 0), len(self.gains))


def count_targets(
    light: torch.Tensor,
    setup: Setup,
    times_s: Array,
    noise: float,
    target_size_m: float,
    cells: int = 20,
    most: int = MOST_TARGETS,
    degree: int | None = 2,
) -> Number:
    """Fit no target, one, two, ..., until one more is less likely: each pays for its paths and cells.

    A setup is not exact: what its operator gets wrong moves along with the targets and looks like one more.
    An error E of the operator with |E s| = e |s|, where s is the light of the targets found so far, raises ln
    of the evidence by at most e^2 |s|^2 / (2 sigma^2): a further target has to raise it by more.

    Args:
        light: Frames without ambient light, white levels, [N, h, w].
        setup: The setup; e is its `recording_error`.
        times_s: Instants of the frames, [N], seconds.
        noise: Standard deviation of a sample's noise, white levels.
        target_size_m: Side of a target plane that surely holds an object, metres.
        cells: Cells a side of it.
        most: Largest number that is tried.
        degree: As for `fit_motion`.
    """
    found, whole = Number([], []), moving_energy(light, degree)
    for number in range(1, most + 1):
        start_m = first_paths(light, setup, noise, target_size_m, number)
        bent = {"bend_m": target_size_m / 50, "degree": degree}
        fit = fit_motion(light, setup, start_m, noise, target_size_m, cells, rounds=_TRIAL_ROUNDS, **bent)
        sigma = noise * max(1.0, fit.inside)  # the fit of more targets tells it where the light is
        fewer = -0.5 * whole / sigma**2
        if found.fits:
            explained = max(whole - found.fits[-1].surprise, 0.0)
            fewer = (
                log_evidence(found.fits[-1], times_s, sigma)
                + 0.5 * setup.recording_error**2 * explained / sigma**2
            )
        found.fits.append(fit)
        found.gains.append(log_evidence(fit, times_s, sigma) - fewer)
        if found.gains[-1] <= 0:
            break
    return found


def first_paths(light: torch.Tensor, setup: Setup, noise: float, target_size_m: float, targets: int) -> Array:
    """Return first guesses of the paths of targets, [N, K, 2], metres, the brightest first.

    Each frame becomes an image of the target's plane (Tikhonov), blurred to a target's width. A path is the
    brightest one through the frames that bends little (dynamic programming over places and steps); its
    surroundings are then darkened for the next.

    Args:
        light: Frames without ambient light, white levels, [N, h, w].
        setup: The setup.
        noise: Standard deviation of a sample's noise, white levels.
        target_size_m: Side of a target plane that surely holds an object, metres.
        targets: How many, K.
    """
    from scipy.ndimage import gaussian_filter  # scipy loads slowly

    cell_m = target_size_m / 10
    plane = Plane(round(10 * REGION[1]), round(10 * REGION[0]), cell_m)
    shape = (int(light.shape[1]), int(light.shape[2]))
    matrix = setup.seen_by(shape).operator(plane, shape).dense()
    prior = _smooth(plane, noise)
    used = np.unique(np.linspace(0, len(light) - 1, min(len(light), _FIRST_FRAMES)).round().astype(int))
    back = matrix.mT @ light[torch.from_numpy(used)].double().flatten(1).mT
    shown = torch.linalg.solve(prior + matrix.mT @ matrix, back).mT.unflatten(1, plane.shape).numpy()
    score = gaussian_filter(shown, (0, 2, 2))
    score /= max(float(score.max()), 1e-12)
    paths = []
    for _ in range(targets):
        row, column = _brightest_path(score)
        path = np.stack([plane.x_m[column], plane.y_m[row]], axis=-1)
        away = [axis - path[:, k, None] for k, axis in enumerate((plane.x_m, plane.y_m))]
        near = (np.square(away[0])[:, None, :] + np.square(away[1])[:, :, None]) / (0.3 * target_size_m) ** 2
        score = score * (1 - np.exp(-near / 2))
        paths.append(np.stack([np.interp(np.arange(len(light)), used, axis) for axis in path.T], axis=-1))
    return np.stack(paths, axis=1)


def _brightest_path(score: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns [T] of the path of the largest sum of scores [T, H, W] less its bends.

    Viterbi's algorithm; a state is a cell and the step to it, of at most `_STRIDE` cells along each axis.
    """
    side, (height, width) = 2 * _STRIDE + 1, score.shape[1:]
    best = np.broadcast_to(score[0], (side, side, height, width))
    came = np.zeros((len(score), side, side, height, width), np.int8)
    for t in range(1, len(score)):
        around = np.pad(best, ((1, 1), (1, 1), (0, 0), (0, 0)), constant_values=-np.inf)
        bends = [(a, b, _BEND * ((a - 1) ** 2 + (b - 1) ** 2)) for a in range(3) for b in range(3)]
        options = [around[a : a + side, b : b + side] - bend for a, b, bend in bends]
        before = np.argmax(options, axis=0)
        margin = ((0, 0), (0, 0), (_STRIDE,) * 2, (_STRIDE,) * 2)
        top = np.pad(np.max(options, axis=0), margin, constant_values=-np.inf)
        before = np.pad(before, margin)
        best = np.empty((side, side, height, width))
        for i in range(side):
            for j in range(side):
                y, x = side - 1 - i, side - 1 - j
                best[i, j] = top[i, j, y : y + height, x : x + width] + score[t]
                came[t, i, j] = before[i, j, y : y + height, x : x + width]
    i, j, row, column = (int(one) for one in np.unravel_index(int(np.argmax(best)), best.shape))
    path = [(row, column)]
    for t in range(len(score) - 1, 0, -1):
        step = int(came[t, i, j, row, column])
        row, column = row - (i - _STRIDE), column - (j - _STRIDE)
        i, j = i + step // 3 - 1, j + step % 3 - 1
        path.append((row, column))
    rows, columns = np.array(path[::-1]).T
    return rows, columns


class Lights:
    """What cells of a strip make of the camera's image, as splines over the strip, at any distance.

    Images are told by their parts P in a basis of all that the strip can show, which leaves noise white; the
    first `ambient` of them are what ambient light could be, too.

    Args:
        setup: The setup.
        strip: Cells of the target's plane.
        shape: Size (H, W) of the images, pixels.
        depth: Whether other distances than the setup's are asked for.
        degree: Total degree of the ambient light; None: there is none.
        rank: So many main images of all distances are kept; None: all.
    """

    def __init__(
        self,
        setup: Setup,
        strip: Plane,
        shape: tuple[int, int],
        depth: bool,
        degree: int | None = None,
        rank: int | None = None,
    ) -> None:
        self.strip, setup = strip, setup.seen_by(shape)
        self._own_m = setup.default_distance_m or 1.0
        if depth:
            low_m, high_m = (self._own_m * math.exp(way * REACH) for way in (-1.01, 1.01))
            away = setup.at_distances(low_m, high_m, strip, shape)
        else:
            own = setup.operator(strip, shape).dense()
            away = DepthTransport(lambda _: own, 0.99 * self._own_m, 1.01 * self._own_m, strip, shape)
        own = away.basis.double()
        smooth = own[:, :0] if degree is None else _ambient(shape, degree)
        self.basis = torch.linalg.qr(torch.cat([smooth, own], dim=1))[0]
        self._away, self.ambient, self._known = copy(away), smooth.shape[1], dict[float, torch.Tensor]()
        turn = self.basis.mT @ own
        # All at once take gigabytes.
        planes = ((turn @ one.double()).unflatten(-1, strip.shape) for one in away.nodes)
        self._away.nodes = torch.stack([spline_coefficients(one).flatten(-2).float() for one in planes])
        if rank is not None:
            parts = self._away.nodes.double().transpose(0, 1).flatten(1)
            ways = torch.linalg.eigh(parts @ parts.mT)[1][:, -rank:]
            self.basis, self._away.nodes = self.basis @ ways, ways.mT.float() @ self._away.nodes
        self._away.nodes = self._away.nodes.mT.contiguous()  # poses take rows of them

    def seen(self, light: torch.Tensor) -> torch.Tensor:
        """Return frames [N, H, W] as their parts [N, P], float64."""
        return light.double().flatten(1) @ self.basis

    def at(self, log_distance: float) -> torch.Tensor:
        """Return splines over the strip, [cells, P]."""
        if log_distance not in self._known:  # poses in a plane ask for the same one again
            self._known = {log_distance: self._away.coefficients(self._own_m * math.exp(log_distance)).double()}
        return self._known[log_distance]

    def slope(self, log_distance: float) -> torch.Tensor:
        """Return the splines' derivative by ln(distance), [cells, P]."""
        return self._away.slope(self._own_m * math.exp(log_distance)).double()

    def taps(self, plane: Plane, pose: Array) -> tuple[torch.Tensor, torch.Tensor, dict[int, torch.Tensor]]:
        """Return which splines the cells of a target in a pose take, and how much of each.

        Args:
            plane: The target's cells, n.
            pose: x, y, ln(distance), turn.

        Returns:
            Places in the flattened strip [16, n], weights [16, n], their derivatives by x, y and turn (SI).
        """
        x, y = (torch.from_numpy(one) for one in np.meshgrid(plane.x_m, plane.y_m))
        cos, sin = math.cos(pose[3]), math.sin(pose[3])
        right, down = (cos * x - sin * y).flatten(), (sin * x + cos * y).flatten()
        pitch, (h, w) = self.strip.pitch_m, self.strip.shape
        column = (right + pose[0] - float(self.strip.x_m[0])) / pitch
        row = (down + pose[1] - float(self.strip.y_m[0])) / pitch
        (left, wx, dx), (top, wy, dy) = (_spline_taps(one) for one in (column, row))
        index = (top[:, None] % h) * w + left[None, :] % w  # beyond the strip there is no target
        share = plane.pitch_m**2 / pitch**2
        weights = share * wy[:, None] * wx[None]
        by_x, by_y = share / pitch * wy[:, None] * dx[None], share / pitch * dy[:, None] * wx[None]
        slopes = {0: by_x, 1: by_y, 3: by_y * right - by_x * down}
        return index.flatten(0, 1), weights.flatten(0, 1), {k: one.flatten(0, 1) for k, one in slopes.items()}


def _spline_taps(at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the four knots around points [n], their weights, and the weights' derivatives, each [4, n]."""
    whole = at.floor()
    knots = whole.long() + torch.arange(-1, 3)[:, None]
    return knots, spline_weights(at - whole), spline_slopes(at - whole)


class Fit:
    """The frames as a function of target and poses, around one state.

    Args:
        target_plane: The target plane's cells.
        lights: The light of the strip's cells.
        poses: x, y (metres), ln(distance), turn (radians) of each frame, [N, 4]; of K targets [N, K, 4].
        kinds: Which of them are looked for; `scale` is the metres per unit of each.
    """

    def __init__(
        self, target_plane: Plane, lights: Lights, poses: Array, kinds: list[int], scale: Array
    ) -> None:
        self.target_plane, self._lights, self._scale = target_plane, lights, scale
        targets, self._found = math.prod(poses.shape[1:-1]), (*poses.shape[1:-1], *target_plane.shape)
        self._each, self._kinds = kinds, kinds * targets
        every = poses.reshape(len(poses), targets, -1)
        self._sights = [[(float(one[2]), *lights.taps(target_plane, one)) for one in each] for each in every]
        # The lights of a distance are made anew where they are needed: one for each frame takes gigabytes.
        bags = [
            embedding_bag(at.mT, lights.at(away), per_sample_weights=weights.mT, mode="sum")
            for each in self._sights
            for away, at, weights, _ in each
        ]
        self.maps = torch.cat(bags).unflatten(0, (len(poses), -1)).mT  # [N, P, K n n]
        self._total = self.maps.sum(dim=0)
        # What an unknown offset of each pixel takes off the mean of each part; ambient light takes all of it.
        share = torch.ones(self.maps.shape[1], dtype=torch.float64) / len(poses)
        self._still = (1 - mean_weight(len(poses), _STATIC)) * share
        self._still[: lights.ambient] = 1 / len(poses)
        self.surprise = self.volume = 0.0  # of the state of `step`, for `log_evidence`

    def step(self, seen: torch.Tensor, prior: torch.Tensor) -> tuple[torch.Tensor, Array, Array, float]:
        """Return target, step of all poses [N, K], metres, their covariance [N, K, N, K], and what is left.

        The covariance is that of noise of variance 1; what is left is the sum of squares of the frames' changes
        that the target doesn't explain.

        Args:
            seen: Frames, float64 [N, P].
            prior: Matrix of the prior of all targets, [K n n, K n n].
        """
        normal = prior + torch.einsum("npc,npd->cd", self.maps, self.maps)
        normal -= (self._still * self._total.mT) @ self._total
        # The light's middle lies in the target's: only then is a place the light's middle.
        x, y = np.meshgrid(self.target_plane.x_m, self.target_plane.y_m)
        middle = torch.from_numpy(np.stack([x.ravel(), y.ravel()])) / self.target_plane.extent_m[0]
        middle = torch.block_diag(*[middle] * (len(normal) // middle.shape[1]))
        held = _HELD * float(normal.diagonal().mean()) * middle.mT @ middle
        normal += held
        root = torch.linalg.cholesky(normal)
        back = torch.einsum("npc,np->c", self.maps, self._moving(seen))
        image = torch.cholesky_solve(back[:, None], root)[:, 0]
        left = seen - self.maps @ image
        self.surprise = float((left * self._moving(left)).sum() + image @ (prior @ image))
        before = torch.linalg.cholesky(prior + held)
        self.volume = 2 * float((root.diagonal().log() - before.diagonal().log()).sum())
        slope = self.slopes(image)  # [N, K, P]
        frames, kinds = slope.shape[:2]
        # Coordinates in which each frame alone would know its pose equally well in all directions.
        lower = torch.linalg.cholesky(slope @ slope.mT)
        even = torch.linalg.solve_triangular(lower, slope, upper=False)
        pull = (even @ self._moving(left)[..., None]).flatten()
        flat = even.flatten(0, 1)  # [N K, P]
        back = (even @ self.maps).flatten(0, 1) - (self._still * flat) @ self._total  # [N K, n n]
        shared = torch.linalg.solve_triangular(root, back.mT, upper=False)
        one = torch.eye(len(flat), dtype=flat.dtype)
        told = one - (self._still * flat) @ flat.mT - shared.mT @ shared
        # A distance or a turn that is the same in all frames is the target's own: it is left out.
        own = torch.zeros(frames, kinds, kinds, dtype=flat.dtype)
        for k, kind in enumerate(self._kinds):
            own[:, k, k] = float(kind > 1)
        alike = torch.linalg.solve_triangular(lower, own, upper=False).flatten(0, 1)
        alike = alike[:, [k for k, kind in enumerate(self._kinds) if kind > 1]]
        alike = torch.linalg.qr(alike)[0] if alike.shape[1] else alike
        apart = one - alike @ alike.mT
        values, ways = torch.linalg.eigh(apart @ told @ apart)
        inverse = (ways * torch.where(values > _UNTOLD, 1 / values, 0.0)) @ ways.mT
        up = torch.block_diag(*torch.linalg.inv(lower).mT)
        step = (up @ inverse @ pull).reshape(frames, kinds).numpy()
        covariance = (up @ inverse @ up.mT).reshape(frames, kinds, frames, kinds).numpy()
        return image.reshape(self._found), step, covariance, float(self._moving(left).square().sum())

    def slopes(self, image: torch.Tensor) -> torch.Tensor:
        """Return the frames' derivatives, [N, K, P], a metre, by the poses of all targets, at these [K n n]."""
        rows = []
        for sights in self._sights:
            for (away, at, weights, ways), one in zip(sights, image.reshape(len(sights), -1), strict=True):
                for kind in self._each:
                    lights = self._lights.slope(away) if kind == 2 else self._lights.at(away)
                    used = weights if kind == 2 else ways[kind]
                    cells = torch.zeros(len(lights), dtype=image.dtype)
                    cells.index_add_(0, at.flatten(), (used * one).flatten())
                    rows.append(cells @ lights / self._scale[kind])
        return torch.stack(rows).unflatten(0, (len(self._sights), -1))

    def _moving(self, frames: torch.Tensor) -> torch.Tensor:
        """Return frames [N, P] without what stands still in them, as far as it is not known."""
        return frames - self._still * frames.sum(dim=0)


def smooth_together(
    times_s: Array,
    values: Array,
    covariance: Array,
    rates: list[tuple[Array, Array, Array] | None],
    accelerations: list[float],
    at_s: Array,
) -> tuple[Array, Array]:
    """Return values and rates at any instants given values whose errors belong together: the exact posterior.

    The prior of each kind is that of `smooth`, of unknown beginnings. Poses that one target ties together err
    together: smoothed one by one, errors that last along the path would pass for motion that is surely there.

    Args:
        times_s: Instants of the values, [N], seconds.
        values: Values of K kinds, [N, K].
        covariance: Of all of them, [N, K, N, K].
        rates: Of each kind, where they were measured: instants [M], rates [M] and their variances [M].
        accelerations: Spectral density of each kind's acceleration.
        at_s: Instants that are asked for, [T], seconds.

    Returns:
        Means [T, 2 (value, rate), K] and standard deviations, the same shape.
    """
    count, kinds = values.shape
    began = min(float(times_s[0]), float(at_s[0]))
    middle = values.mean(axis=0)
    seen, spread, noise, lines = [], [], [], []
    for k, rate in enumerate(rates):
        none = np.zeros(0)
        when, told, variance = rate if rate is not None else (none, none, none)
        t = np.concatenate([times_s, when, at_s, at_s]) - began
        is_rate = np.repeat([False, True, False, True], [count, len(when), len(at_s), len(at_s)])
        seen.append(np.concatenate([values[:, k] - middle[k], told]))
        spread.append(walk_covariance(t, is_rate, accelerations[k]))
        noise.append(np.concatenate([np.zeros(count), variance]))
        lines.append(np.stack([~is_rate, np.where(is_rate, 1.0, t)], axis=1))  # of the first value and rate
    starts = np.concatenate([[0], np.cumsum([len(one) for one in seen])])
    whole, basis = np.zeros((starts[-1], starts[-1])), np.zeros((starts[-1], 2 * kinds))
    for k in range(kinds):
        own, size = slice(starts[k], starts[k + 1]), len(seen[k])
        whole[own, own] += spread[k][:size, :size] + np.diag(noise[k])
        basis[own, 2 * k : 2 * k + 2] = lines[k][:size]
        for j in range(kinds):
            whole[starts[k] : starts[k] + count, starts[j] : starts[j] + count] += covariance[:, k, :, j]
    whole += 1e-10 * np.diag(np.diagonal(whole))
    inverse = np.linalg.inv(whole)
    told = np.linalg.inv(basis.T @ inverse @ basis)  # covariance of first values and rates
    line = told @ (basis.T @ (inverse @ np.concatenate(seen)))
    pulled = inverse @ (np.concatenate(seen) - basis @ line)
    mean, sigma = np.empty((2, len(at_s), 2, kinds))
    for k in range(kinds):
        own, size = slice(starts[k], starts[k + 1]), len(seen[k])
        cross = spread[k][size:, :size]  # [2 T, own]
        ways = -cross @ inverse[own] @ basis
        ways[:, 2 * k : 2 * k + 2] += lines[k][size:]
        left = np.diagonal(spread[k])[size:] - np.einsum("ta,ab,tb->t", cross, inverse[own, own], cross)
        left = left + np.einsum("ta,ab,tb->t", ways, told, ways)
        found = cross @ pulled[own] + lines[k][size:] @ line[2 * k : 2 * k + 2]
        mean[:, :, k], sigma[:, :, k] = (v.reshape(2, -1).T for v in (found, np.sqrt(np.maximum(left, 0.0))))
        mean[:, 0, k] += middle[k]
    return mean, sigma
