"""Fitting a motion: positions, and distances and turns where they change, by the calibrated operator.

- Poses that make the frames of one target likeliest, by the calibrated operator.
- A smoother of poses whose errors belong together.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.inverse.operators import Gradient, normal_matrix
from evnlos.inverse.sequence_problem import mean_weight, strip_of
from evnlos.machine import note
from evnlos.optics import DepthTransport
from evnlos.optics.interpolation import spline_coefficients, spline_slopes, spline_weights
from evnlos.setups import Setup
from evnlos.types import Plane

REACH = 0.3
"""Largest change of the distance's logarithm that is looked for: 0.74 to 1.35 of the setup's own distance."""
_ROUNDS = 24
_STATIC = 1.0  # a pixel's constant offset over its noise
_PRIOR = 3.0  # weight of the target's smoothness, in units of the noise's variance
_MARGIN_M = 0.03
_STRIP_M = 0.04
_LONGEST_M = 0.01  # step of one round
_ENOUGH = 0.1  # of a place's standard deviation: a step below it changes nothing that is known
_UNTOLD = 1e-7  # share of a direction's information that the target leaves, below which it is not told
_HELD = 1e6  # weight of the light's middle in the target's middle, over that of the frames


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Poses of the target and the target itself.

    Args:
        position_m: Middle of the object's light (x, y), float64 [N, 2], metres.
        covariance: Of all poses, float64 [N, K, N, K]: of x and y, metres, then, where they were looked for, of
            ln(distance) and of the turn, radians.
        target: The object, its light's middle in the array's middle, float64 [n, n].
        log_distance: ln(distance to the wall / the setup's), [N]; its mean is 0, as a target that is nearer and
            one that is larger and dimmer look much the same. None where it was not looked for.
        rotation_rad: Turn about the wall's normal, [N]; its mean is 0, as nobody knows which way up the object
            is. None where it was not looked for.
        misfit: What the target leaves of the frames' changes, over their noise, root mean square; 1 is a setup
            that explains all.
    """

    position_m: NDArray[np.float64]
    covariance: NDArray[np.float64]
    target: torch.Tensor
    log_distance: NDArray[np.float64] | None = None
    rotation_rad: NDArray[np.float64] | None = None
    misfit: float = 1.0


def fit_motion(
    light: torch.Tensor,
    setup: Setup,
    start_m: NDArray[np.float64],
    noise: float,
    target_size_m: float,
    cells: int = 20,
    *,
    depth: bool = False,
    turning: bool = False,
) -> MotionFit:
    """Find the poses of a target, and the target, that explain the frames best: Gauss and Newton's method.

    The target is eliminated (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973): a
    step of the poses knows that the target follows, as it does where a path is stretched or a target comes
    nearer on its way. A target and a path are only known together up to a shift; the target's middle of light
    is the reference.

    Args:
        light: Frames without ambient light, white levels, [N, h, w].
        setup: The setup.
        start_m: First guess of the positions, [N, 2], metres.
        noise: Standard deviation of a sample's noise, white levels.
        target_size_m: Side of a target plane that surely holds the object, metres.
        cells: Cells a side of it.
        depth: Find the distance to the wall in each frame too.
        turning: Find the turn about the wall's normal in each frame too.
    """
    target_plane = Plane(cells, cells, target_size_m / cells)
    reach = np.concatenate([start_m + _MARGIN_M, start_m - _MARGIN_M])
    if turning:  # corners reach further
        reach = np.concatenate([reach + 0.21 * target_size_m, reach - 0.21 * target_size_m])
    # Whole steps: recordings alike share their matrices.
    reach = np.stack([np.floor(reach.min(axis=0) / _STRIP_M), np.ceil(reach.max(axis=0) / _STRIP_M)]) * _STRIP_M
    lights = Lights(setup, strip_of(reach, target_plane), (int(light.shape[1]), int(light.shape[2])), depth)
    seen = lights.seen(light)
    prior = _PRIOR * noise**2 * normal_matrix(Gradient("dark"), torch.zeros(target_plane.shape).double())
    pose = np.zeros((len(start_m), 4))  # x, y, ln(distance / own), turn
    pose[:, :2] = start_m
    kinds = [0, 1, *([2] if depth else []), *([3] if turning else [])]
    scale = np.array([1.0, 1.0, setup.default_distance_m or 1.0, target_size_m / 4])  # to metres
    covariance = np.zeros((len(pose), len(kinds), len(pose), len(kinds)))
    misfit, image = 1.0, torch.zeros(target_plane.shape)
    still = (1 - mean_weight(len(light), _STATIC)) / len(light)
    whole, part = (float((one - still * one.sum(dim=0)).square().sum()) for one in (light, seen))
    rest = whole - part  # what no target explains
    for number in range(1, _ROUNDS + 1):
        note(f"places and image, round {number}")
        fit = Fit(target_plane, lights, pose, kinds, scale)
        image, step, covariance, left = fit.step(seen, prior)
        samples = light[0].numel() * (len(light) - 1)
        misfit = math.sqrt((rest + left) / samples) / noise
        step = step * min(1.0, _LONGEST_M / np.abs(step).max())
        pose[:, kinds] += step / scale[kinds]
        pose[:, 2:] -= pose[:, 2:].mean(axis=0)
        pose[:, 2] = np.clip(pose[:, 2], -REACH, REACH)
        sigma = noise * np.sqrt(np.einsum("nknk->nk", covariance))
        if (np.abs(step) < _ENOUGH * sigma).all():
            break
    # Pixels that no target reaches hold the noise alone: a setup that explains all leaves just that.
    unit = scale[kinds]
    covariance = (max(misfit, 1.0) * noise) ** 2 * covariance / unit[:, None, None] / unit
    return MotionFit(
        pose[:, :2].copy(),
        covariance,
        image,
        pose[:, 2].copy() if depth else None,
        pose[:, 3].copy() if turning else None,
        misfit,
    )


class Lights:
    """What cells of a strip make of the camera's image, as splines over the strip, at any distance.

    Images are told by their parts P in a basis of all that the strip can show, which leaves noise white.

    Args:
        setup: The setup.
        strip: Cells of the target's plane.
        shape: Size (H, W) of the images, pixels.
        depth: Whether other distances than the setup's are asked for.
    """

    def __init__(self, setup: Setup, strip: Plane, shape: tuple[int, int], depth: bool) -> None:
        self.strip = strip
        self._own_m = setup.default_distance_m or 1.0
        if depth:
            low_m, high_m = (self._own_m * math.exp(way * REACH) for way in (-1.01, 1.01))
            away = setup.at_distances(low_m, high_m, strip, shape)
        else:
            own = setup.resized(shape).operator(strip, shape).dense()
            away = DepthTransport(lambda _: own, 0.99 * self._own_m, 1.01 * self._own_m, strip, shape)
        self._basis, self._away = away.basis.double(), copy(away)
        splines = spline_coefficients(away.nodes.double().unflatten(-1, strip.shape))
        self._away.nodes = splines.flatten(-2)

    def seen(self, light: torch.Tensor) -> torch.Tensor:
        """Return frames [N, H, W] as their parts [N, P], float64."""
        return light.double().flatten(1) @ self._basis

    def at(self, log_distance: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return splines over the strip, [P, cells], and their derivative by ln(distance)."""
        distance_m = self._own_m * math.exp(log_distance)
        return self._away.coefficients(distance_m), self._away.slope(distance_m)

    def taps(
        self, plane: Plane, pose: NDArray[np.float64]
    ) -> tuple[torch.Tensor, torch.Tensor, dict[int, torch.Tensor]]:
        """Return which splines the cells of a target in a pose take, and how much of each.

        Args:
            plane: The target's cells, n.
            pose: x, y, ln(distance), turn.

        Returns:
            Places in the flattened strip [16, n], weights [16, n], and their derivatives by x, y, a metre,
            and the turn, a radian.
        """
        x, y = (torch.from_numpy(one) for one in np.meshgrid(plane.x_m, plane.y_m))
        cos, sin = math.cos(pose[3]), math.sin(pose[3])
        right, down = (cos * x - sin * y).flatten(), (sin * x + cos * y).flatten()
        pitch = self.strip.pitch_m
        column = (right + pose[0] - float(self.strip.x_m[0])) / pitch
        row = (down + pose[1] - float(self.strip.y_m[0])) / pitch
        (left, wx, dx), (top, wy, dy) = (_spline_taps(one) for one in (column, row))
        h, w = self.strip.shape
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
        poses: x, y (metres), ln(distance), turn (radians) of each frame, [N, 4].
        kinds: Which of them are looked for.
        scale: Metres a unit of each.
    """

    def __init__(
        self,
        target_plane: Plane,
        lights: Lights,
        poses: NDArray[np.float64],
        kinds: list[int],
        scale: NDArray[np.float64],
    ) -> None:
        self.target_plane, self._kinds, self._scale = target_plane, kinds, scale
        self._sights = [(*lights.at(float(pose[2])), *lights.taps(target_plane, pose)) for pose in poses]
        self.maps = torch.stack(
            [(own[:, at] * weights).sum(dim=1) for own, _, at, weights, _ in self._sights]
        )  # [N, P, n n]
        self._total = self.maps.sum(dim=0)
        self._still = (1 - mean_weight(len(poses), _STATIC)) / len(poses)

    def step(
        self, seen: torch.Tensor, prior: torch.Tensor
    ) -> tuple[torch.Tensor, NDArray[np.float64], NDArray[np.float64], float]:
        """Return target, step of all poses [N, K], metres, their covariance [N, K, N, K], and what is left.

        The covariance is that of noise of variance 1; what is left is the sum of squares of the frames' changes
        that the target doesn't explain.

        Args:
            seen: Frames, float64 [N, P].
            prior: Matrix of the target's prior, [n n, n n].
        """
        normal = prior + torch.einsum("npc,npd->cd", self.maps, self.maps)
        normal -= self._still * self._total.mT @ self._total
        # The light's middle lies in the target's: only then is a place the light's middle.
        x, y = np.meshgrid(self.target_plane.x_m, self.target_plane.y_m)
        middle = torch.from_numpy(np.stack([x.ravel(), y.ravel()])) / self.target_plane.extent_m[0]
        normal += _HELD * float(normal.diagonal().mean()) * middle.mT @ middle
        root = torch.linalg.cholesky(normal)
        back = torch.einsum("npc,np->c", self.maps, self._moving(seen))
        image = torch.cholesky_solve(back[:, None], root)[:, 0]
        left = seen - self.maps @ image
        slope = self.slopes(image)  # [N, K, P]
        frames, kinds = slope.shape[:2]
        # Coordinates in which each frame alone would know its pose equally well in all directions.
        lower = torch.linalg.cholesky(slope @ slope.mT)
        even = torch.linalg.solve_triangular(lower, slope, upper=False)
        pull = (even @ self._moving(left)[..., None]).flatten()
        flat = even.flatten(0, 1)  # [N K, P]
        back = (even @ self.maps).flatten(0, 1) - self._still * flat @ self._total  # [N K, n n]
        shared = torch.linalg.solve_triangular(root, back.mT, upper=False)
        one = torch.eye(len(flat), dtype=flat.dtype)
        told = one - self._still * flat @ flat.mT - shared.mT @ shared
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
        found = image.reshape(self.target_plane.shape)
        return found, step, covariance, float(self._moving(left).square().sum())

    def slopes(self, image: torch.Tensor) -> torch.Tensor:
        """Return the frames' derivatives, [N, K, P], a metre, at a target [n n]."""
        rows = []
        for own, away, at, weights, ways in self._sights:
            each = []
            for kind in self._kinds:
                cells = torch.zeros(own.shape[1], dtype=image.dtype)
                used = weights if kind == 2 else ways[kind]
                cells.index_add_(0, at.flatten(), (used * image).flatten())
                each.append((away if kind == 2 else own) @ cells / self._scale[kind])
            rows.append(torch.stack(each))
        return torch.stack(rows)

    def _moving(self, frames: torch.Tensor) -> torch.Tensor:
        """Return frames [N, P] without what stands still in them, as far as it is not known."""
        return frames - self._still * frames.sum(dim=0)


def smooth_together(
    times_s: NDArray[np.float64],
    values: NDArray[np.float64],
    covariance: NDArray[np.float64],
    rates: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None],
    accelerations: list[float],
    at_s: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
        spread.append(_walk(t, is_rate, accelerations[k]))
        noise.append(np.concatenate([np.zeros(count), variance]))
        lines.append(
            np.stack([~is_rate, np.where(is_rate, 1.0, t)], axis=1)
        )  # of the first value, the first rate
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
    mean, sigma = np.empty((len(at_s), 2, kinds)), np.empty((len(at_s), 2, kinds))
    for k in range(kinds):
        own, size = slice(starts[k], starts[k + 1]), len(seen[k])
        cross = spread[k][size:, :size]  # [2 T, own]
        ways = -cross @ inverse[own] @ basis
        ways[:, 2 * k : 2 * k + 2] += lines[k][size:]
        left = np.diagonal(spread[k])[size:] - np.einsum("ta,ab,tb->t", cross, inverse[own, own], cross)
        left = left + np.einsum("ta,ab,tb->t", ways, told, ways)
        found = cross @ pulled[own] + lines[k][size:] @ line[2 * k : 2 * k + 2]
        mean[:, :, k], sigma[:, :, k] = (
            one.reshape(2, -1).T for one in (found, np.sqrt(np.maximum(left, 0.0)))
        )
        mean[:, 0, k] += middle[k]
    return mean, sigma


def _walk(t: NDArray[np.float64], is_rate: NDArray[np.bool_], acceleration: float) -> NDArray[np.float64]:
    """Return the covariance of values and rates at instants t >= 0, both 0 at 0; the rate walks at random."""
    s, r = t[:, None], t[None, :]
    low = np.minimum(s, r)
    value = low**2 * (np.maximum(s, r) / 2 - low / 6)
    rate_value = low * r - low**2 / 2  # rate at s, value at r
    row, column = is_rate[:, None], is_rate[None, :]
    both = np.where(row, np.where(column, low, rate_value), np.where(column, rate_value.T, value))
    return acceleration * both
