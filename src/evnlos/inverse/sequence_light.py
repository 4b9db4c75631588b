"""A moving target as a few numbers, and all that a camera sees of it while it moves.

- The light of a moving target on every pixel at every instant: linear in the prior's coefficients, low rank.
- What frames say of it, summed once.
- Normal equations of rows that share an unknown offset by group: what thresholds or a fixed pattern leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras import FrameCamera, FrameCameraSettings
from evnlos.cameras.streams import WHITE_DN
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.prior import PatternPrior
from evnlos.inverse.sequence_problem import SequenceOperator, strip_of
from evnlos.optics import MatrixTransport
from evnlos.scene import Motion
from evnlos.setups import Setup
from evnlos.types import Plane

Array = NDArray[np.float64]
Single = NDArray[np.float32]

EVENT_PRIORS = (0.3, 2.0)
"""Weights of the prior, over its own, at which the events of a sequence are solved for the target: one image
each."""

# most factors; events see the logarithm: of rough metal 120 cost 0.7 dB, more than 200 bring nothing
_RANK = 200
_COARSEST = (50, 80)
_TAIL = 1e-4
_EXTRA, _POWERS = 40, 4  # directions and power iterations of the range finder
_STEP_CELLS = 0.25
_CHUNK = 16
_MOST_NODES = 4096


@dataclass(frozen=True, eq=False)
class SequenceLight:
    """Light I(i, t) = still(i, t) + left(i) right(t) (1, z) of pixel i at t, in white levels.

    Between two instants of `times_s` the light counts as a line.

    Args:
        left: The factor of the pixels, float64 [P, r].
        right: That of the instants: of the mean target, then of each pattern, float64 [T, r, 1 + k].
        still: Light without the target, float32 [P, 1], or [P, T] where something moves along.
        times_s: Instants, [T], seconds, equally spaced.
        shape: Size (H, W) of the images, P = H W.
    """

    left: Array
    right: Array
    still: NDArray[np.float32]
    times_s: Array
    shape: tuple[int, int]

    def __call__(self, z: Array) -> Array:
        """Return the light of a target with coefficients [k], white levels, [P, T]."""
        return self.left @ (self.right @ np.append(1.0, z)).T + self.still

    @property
    def typical_dn(self) -> float:
        """Mean light of the mean target, DN."""
        return WHITE_DN * float(self.still.mean() + self.left.mean(axis=0) @ self.right[:, :, 0].mean(axis=0))

    def every(self, stride: int, rank: int) -> SequenceLight:
        """Return the light of every so many rows and columns, by the main factors alone.

        Args:
            stride: 1 keeps all of them.
            rank: Most factors.
        """

        def kept(values: NDArray) -> NDArray:
            image = values.reshape(*self.shape, -1)[::stride, ::stride]
            return image.reshape(-1, values.shape[1])

        shape = (-(-self.shape[0] // stride), -(-self.shape[1] // stride))
        left = kept(self.left[:, :rank])
        return SequenceLight(left, self.right[:, :rank], kept(self.still), self.times_s, shape)

    def exposed(self, exposure_s: float) -> SequenceLight:
        """Return the light averaged over exposures about each instant, with the nodes of `FrameCamera`.

        Args:
            exposure_s: Exposure time, seconds.
        """
        from scipy.sparse import coo_array  # scipy loads slowly

        offsets, weights = FrameCamera(exposure_s=exposure_s).instants(0.0)
        node, share = self.place(self.times_s + np.asarray(offsets)[:, None])  # [exposure, T]
        shares = np.asarray(weights)[:, None] * np.stack([1 - share, share])
        at, ends = np.broadcast_arrays(np.arange(len(self.times_s)), np.stack([node, node + 1]))
        mixed = coo_array((shares.ravel(), (at.ravel(), ends.ravel())), 2 * (len(self.times_s),)).tocsr()
        right = (mixed @ self.right.reshape(len(self.right), -1)).reshape(self.right.shape)
        still = self.still if self.still.shape[1] == 1 else (mixed @ self.still.T).T.astype(np.float32)
        return SequenceLight(self.left, right, still, self.times_s, self.shape)

    def place(self, t_s: Array) -> tuple[NDArray[np.int64], Array]:
        """Return of instants [N] the node before, and the share of the way to the next; clipped to the ends."""
        step = self.times_s[1] - self.times_s[0]
        at = np.clip((t_s - self.times_s[0]) / step, 0.0, len(self.times_s) - 1.0)
        node = np.minimum(at.astype(np.int64), len(self.times_s) - 2)
        return node, at - node

    def at(self, values: Array, pixel: NDArray[np.int64], t_s: Array) -> Array:
        """Return values [P, T] of pixels [N] at instants [N], on a line between the nodes."""
        node, share = self.place(t_s)
        return (1 - share) * values[pixel, node] + share * values[pixel, node + 1]

    def rows(self, pixel: NDArray[np.int64], t_s: Array) -> Array:
        """Return the derivative of the light of pixels [N] at instants [N] by the coefficients, [N, k]."""
        share = self.place(t_s)[1][:, None]
        before, after = self.ends(pixel, t_s)
        return (1 - share) * before + share * after

    def ends(self, pixel: NDArray[np.int64], t_s: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the same at the nodes before and after, [N, k] both, in single precision."""
        node, _ = self.place(t_s)
        left, right = self._single
        size = (len(pixel), right.shape[2])
        before, after = np.empty(size, np.float32), np.empty(size, np.float32)
        order = np.argsort(node, kind="stable")
        starts = np.flatnonzero(np.diff(node[order], prepend=-1))
        for mine in np.split(order, starts[1:]) if len(order) else []:
            k, these = node[mine[0]], left[pixel[mine]]
            before[mine], after[mine] = these @ right[k], these @ right[k + 1]
        return before, after

    @cached_property
    def _single(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The factors in single precision, the mean target left out: what many rows are made of."""
        return self.left.astype(np.float32), np.ascontiguousarray(self.right[:, :, 1:], np.float32)


class SequenceLights:
    """Lights of the sequences of one setup, each made once: captures of one motion share theirs."""

    def __init__(self) -> None:
        self._made = dict[Hashable, SequenceLight]()

    def of(
        self,
        setup: Setup,
        prior: PatternPrior,
        motion: Motion,
        span_s: tuple[float, float],
        shape: tuple[int, int],
    ) -> SequenceLight:
        """Return the light of a motion, for the coefficients of a prior; as `sequence_light`."""
        key = (motion, span_s, shape, prior.target_plane, prior.count)
        if key not in self._made:
            self._made[key] = sequence_light(setup, prior, motion.position_m, span_s, shape)
        return self._made[key]


def sequence_light(
    setup: Setup,
    prior: PatternPrior,
    position_m: Callable[[Array], Array],
    span_s: tuple[float, float],
    shape: tuple[int, int] | None = None,
    fineness: float = 1.0,
) -> SequenceLight:
    """Return the light of a moving target on a camera.

    The setup's matrix is computed for pixels of at most 50 x 80 and for the coarsest cells that its blur
    allows, and brought to the camera's pixels by cubic splines: the light of a rough wall is smooth. Its
    factors are those of the largest eigenvalues of A^T A, down to 1e-4 of the largest singular value.

    Args:
        setup: A linear setup.
        prior: Of the target_plane.
        position_m: The target's centre (x, y) at instants [N], seconds: metres, [N, 2].
        span_s: First and last instant, seconds.
        shape: Size (H, W) of the images; None is the sensor's.
        fineness: How many times finer than its blur asks for the setup's cells are. Behind rough metal the
            light is right to 3e-3 of its changes with 1, and to 3e-4 with 2, which forty frames of little
            noise need.

    Raises:
        ConfigError: The setup is not linear, or gets no light.
        DataError: The span is empty, or the motion asks for more than 4096 instants.
    """
    shape = setup.shape if shape is None else shape
    coarse = (min(shape[0], _COARSEST[0]), min(shape[1], _COARSEST[1]))
    if not span_s[1] > span_s[0]:
        raise DataError(
            f"the sequence lasts from {span_s[0]} s to {span_s[1]} s; give the last after the first"
        )
    step = _STEP_CELLS * prior.target_plane.pitch_m
    probes = position_m(np.linspace(*span_s, 513))
    travel = float(np.hypot(*np.diff(probes, axis=0).T).max()) * 512
    count = max(16, math.ceil(travel / step)) + 1
    if count > _MOST_NODES:
        raise DataError(
            f"the motion of {travel:.3g} m in steps of {step:.2g} m asks for {count} instants; at most "
            f"{_MOST_NODES}: cut the sequence"
        )
    times = np.linspace(*span_s, count)
    places = position_m(times)
    cells = setup.coarsened(1 / fineness).target_cells()
    pitch = prior.target_plane.pitch_m if cells is None else max(cells.pitch_m, prior.target_plane.pitch_m)
    side = max(1, math.ceil(prior.target_plane.height * prior.target_plane.pitch_m / pitch - 1e-6))
    strip = strip_of(places, Plane(side, side, pitch))
    resized = setup.resized(shape)
    matrix = resized.operator(strip, coarse).dense()
    left, right = (factor.numpy() for factor in main_factors(matrix, _RANK))
    targets = np.concatenate([prior.mean[:, None], prior.patterns], axis=1).T.reshape(
        -1, *prior.target_plane.shape
    )
    drawn = torch.from_numpy(np.ascontiguousarray(targets))
    responses = np.empty((count, right.shape[0], len(targets)))
    carrier = MatrixTransport(torch.from_numpy(right), strip, (1, right.shape[0]))
    for start in range(0, count, _CHUNK):
        seen = SequenceOperator(carrier, prior.target_plane, places[start : start + _CHUNK])
        responses[start : start + _CHUNK] = seen(drawn)[..., 0, :].permute(1, 2, 0).numpy()
    still = resized.ambient_light(shape).flatten()[:, None].numpy()
    along = resized.companion_light(places)
    if along is not None:
        still = still + along.flatten(1).T.numpy()
    return SequenceLight(on_pixels(left, coarse, shape), responses, still, times, shape)


def on_pixels(images: Array, coarse: tuple[int, int], shape: tuple[int, int]) -> Array:
    """Return images [h w, r] of some rows and columns on those of a camera, [H W, r], by cubic splines."""
    if coarse == shape:
        return images
    down, across = (_spline_matrix(*sizes) for sizes in zip(coarse, shape, strict=True))
    fine = np.einsum("yi,xj,ijr->yxr", down, across, images.reshape(*coarse, -1), optimize=True)
    return fine.reshape(-1, images.shape[1])


def _spline_matrix(coarse: int, fine: int) -> Array:
    """Return the cubic spline from pixels [n] to pixels [m] of another size over the same way, [m, n]."""
    from scipy.interpolate import CubicSpline  # scipy loads slowly

    if coarse == fine:
        return np.eye(fine)
    middles = (np.arange(fine) + 0.5) * coarse / fine - 0.5
    return np.asarray(CubicSpline(np.arange(coarse), np.eye(coarse))(middles))


def main_factors(matrix: torch.Tensor, rank: int, tail: float = _TAIL) -> tuple[torch.Tensor, torch.Tensor]:
    """Return factors [P, r] and [r, cells] of a matrix [P, cells] by its largest singular values.

    By a randomised range finder with power iterations, whose draws are always the same (Halko, Martinsson and
    Tropp, SIAM Review 53, 2011). The columns of the first are orthogonal, the rows of the second orthonormal.

    Args:
        matrix: Of a light path.
        rank: Most factors.
        tail: Share of the largest singular value from which on factors are left out.

    Raises:
        ConfigError: The matrix is 0.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        _, values, axes = torch.svd_lowrank(matrix, q=min(rank + _EXTRA, *matrix.shape), niter=_POWERS)
    if not float(values[0]) > 0:
        raise ConfigError("the camera gets no light from the target; move the target or the camera")
    kept = min(rank, int((values > tail * values[0]).sum()))
    right = axes[:, :kept].mT.contiguous()
    return matrix @ right.mT, right


@dataclass
class NormalEquations:
    """Sums of rows y = J z + noise + an offset for each group: information J^T C^-1 J and score J^T C^-1 y.

    With weights w = 1 / variance of the rows of a group and offsets of variance s^2, C^-1 of the group is
    W - s^2 / (1 + s^2 sum w) w w^T (Sherman and Morrison): sums by group, one division.

    Args:
        information: [k, k].
        score: [k].
    """

    information: Array
    score: Array

    @classmethod
    def empty(cls, count: int) -> NormalEquations:
        """Return no information about `count` unknowns."""
        return cls(np.zeros((count, count)), np.zeros(count))

    def add(self, rows: Array, weight: Array, residual: Array, group: NDArray, spread: Array | float) -> None:
        """Add rows; those of one group lie side by side, and all of them are in one call.

        Args:
            rows: J, [N, k].
            weight: 1 / variance, [N].
            residual: y, [N].
            group: Number of each row's group, [N], equal ones side by side.
            spread: s, standard deviation of the offset that a group shares, one or each row's, [N]; 0 = none.
        """
        if not len(rows):
            return
        root = np.sqrt(weight)
        scaled = rows * root[:, None]
        self.information += scaled.T @ scaled  # a matrix by itself takes half of the work
        self.score += scaled.T @ (root * residual)
        if np.any(spread):
            starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
            total, seen = (np.add.reduceat(column, starts) for column in (weight, weight * residual))
            summed = np.add.reduceat(scaled * root[:, None], starts)  # [groups, k]
            self.subtract_offsets(summed, total, np.broadcast_to(spread, len(group))[starts], seen)

    def subtract_offsets(
        self, summed: Array, weights: Array, spread: Array, residual: Array | float = 0.0
    ) -> None:
        """Take away what groups with offsets do not know, after their rows were added one by one.

        Args:
            summed: Sum of w J of each group, [G, k].
            weights: Sum of w of each group, [G].
            spread: Standard deviation of the group's offset, [G].
            residual: Sum of w y of each group, [G].
        """
        share = spread**2 / (1.0 + spread**2 * weights)
        self.information -= summed.T @ (summed * share[:, None])
        self.score -= summed.T @ (share * residual)


class FrameTerm:
    """What frames say: sum over frames of J^T C^-1 J and J^T C^-1 y, once for all iterations.

    The weight of a pixel is that of its mean light over the frames; J = U R_k splits into pixels and instants.

    Args:
        light: The light.
        frames: White levels, [N, P].
        times_s: Instants, [N], seconds.
        camera: The frame camera.
        known_pattern: Whether its fixed pattern was taken off; else an offset of each pixel is integrated out.
        doubt: By how much the variance of the noise is raised, for what the light path gets wrong.

    Raises:
        DataError: The frames are not those of the light's pixels.
    """

    def __init__(
        self,
        light: SequenceLight,
        frames: Array,
        times_s: Array,
        camera: FrameCameraSettings,
        known_pattern: bool,
        doubt: float = 1.0,
    ) -> None:
        pixels = len(light.left)
        if frames.shape != (len(times_s), pixels):
            raise DataError(f"the frames are {frames.shape}; give [{len(times_s)}, {pixels}], one row a frame")
        mean = torch.from_numpy(frames.mean(axis=0).astype(np.float64))
        weight = 1.0 / (doubt * camera.noise_variance(mean).numpy())
        spread = np.zeros(pixels) if known_pattern else camera.pattern_variance(mean).sqrt().numpy()
        node, share = light.place(times_s)
        still = light.still.astype(np.float64)
        response = (1 - share)[:, None, None] * light.right[node] + share[:, None, None] * light.right[node + 1]
        everywhere = np.arange(pixels)
        gram = light.left.T @ (light.left * weight[:, None])  # [r, r]
        self.normal = NormalEquations.empty(response.shape[2] - 1)
        residuals = np.zeros(pixels)
        for k, time in enumerate(times_s):
            dark = light.at(still, everywhere, np.full(pixels, time)) if still.shape[1] > 1 else still[:, 0]
            residual = frames[k] - dark - light.left @ response[k, :, 0]
            rows = response[k, :, 1:]
            self.normal.information += rows.T @ gram @ rows
            self.normal.score += rows.T @ (light.left.T @ (weight * residual))
            residuals += weight * residual
        if spread.any():
            total = response[:, :, 1:].sum(axis=0)
            summed = weight[:, None] * (light.left @ total)
            self.normal.subtract_offsets(summed, len(times_s) * weight, spread, residuals)


def group_blocks(group: NDArray[np.int64], most: int) -> list[slice]:
    """Return slices of about `most` rows that cut no group; equal numbers lie side by side.

    Example:
        >>> group_blocks(np.array([0, 0, 1, 2, 2, 2]), 2)
        [slice(0, 2, None), slice(2, 6, None)]
    """
    edges = np.append(np.flatnonzero(np.diff(group)) + 1, len(group))
    blocks, start = [], 0
    while start < len(group):
        end = int(edges[np.searchsorted(edges, min(start + most, len(group)))])
        blocks.append(slice(start, end))
        start = end
    return blocks
