"""Fitting a wall of any kind: the facets' slopes, the camera's place and the wall's bend from known targets.

The frames are y(p, n) = shared(p, place of n) + g(p) sum_q A(p, q; pose, slopes) x(q, n), with x the known
images. What all captures share at a place is taken off both sides: ambient light, and anything else that
moves along. Where light drifts, the brightness of each capture's target is free. The rest is least squares
in the numbers of the pose, the logarithm of the slopes' density, a polynomial for the sensitivity g and a matte
part, all at once (Gauss-Newton with damping; Marquardt 1963), with priors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.captures import CaptureSet, relit
from evnlos.calibration.transport_fit import BLOCKS, scatter_of
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError
from evnlos.machine import note
from evnlos.optics.facets import (
    MASKING,
    Cells,
    Pose,
    Seen,
    SlopeTable,
    SparseImages,
    carry_facets,
    carry_lobes,
    facet_slopes,
    folded_columns,
    second_differences,
    seen_points,
    target_cells,
)
from evnlos.optics.interpolation import point_samples
from evnlos.optics.radiometric import torchs_threads
from evnlos.types import Plane

Array = NDArray[np.float64]

LOBES = np.array(
    [(a, a * r) for a in (0.02, 0.035, 0.06, 0.10, 0.17, 0.3) for r in (0.6, 1.0, 1.6)], dtype=np.float64
)
"""Roughness along x and y of the GGX lobes that the search starts from."""
EFFECTIVE = 60_000.0
"""Independent numbers that frames are worth beside what is known before; few leave the wall where it began."""
_BEND = 0.3  # standard deviation of the second differences of the slopes' log density about its start
_LEVEL = 2.0  # that of the log density itself
_TILT = 0.15  # of the coefficients of the sensitivity's polynomial
_MATTE = 10.0  # of the matte part, in units that count beside the facets
_CHUNK = 400  # pixels whose derivatives are held at a time
_TRIALS = 6
_DIMMEST_BRIGHTEST = (0.2, 5.0)  # targets of captures beside the mean of all
_SATURATED = 0.995
_TOLERANCE = 1e-3  # a search ends when a step lowers its cost by a smaller fraction


@dataclass(frozen=True, eq=False)
class WallData:
    """What the fit works on: some pixels of some frames, and the targets as sparse images.

    Args:
        shape: Size (H, W) of the camera image, pixels.
        columns: Columns of the pixels [P] in that image.
        rows: Their rows [P].
        seen: White levels [P, N].
        capture: Capture of each frame [N].
        group: Place of the target of each frame [N]: light that all captures share there is left out.
        weight: Weight of each pixel's squares [P].
        grid: Size (h, w) of the working images.
        pixel: Number of each pixel in them [P].
        places: Place (x, y) of the target in each frame [N, 2], metres.
        plane: Cells of the targets' images.
        images: The targets' images [N].
        drifts: Whether light that is the same all over the frames of a capture is left out.
    """

    shape: tuple[int, int]
    columns: Array
    rows: Array
    seen: Array
    capture: NDArray[np.int64]
    group: NDArray[np.int64]
    weight: Array
    grid: tuple[int, int]
    pixel: NDArray[np.int64]
    places: Array
    plane: Plane
    images: SparseImages
    drifts: bool = False

    def shared_removed(self, values: NDArray) -> NDArray:
        """Return values [P, N, ...] without what frames of a group share, and what a capture has all over."""
        out = np.array(values)
        for k in np.unique(self.capture) if self.drifts else ():
            out[:, self.capture == k] -= out[:, self.capture == k].mean(axis=(0, 1))
        for g in range(int(self.group.max()) + 1):
            rows = np.flatnonzero(self.group == g)
            out[:, rows] -= out[:, rows].mean(axis=1, keepdims=True)
        return out

    def pixels(self, chosen: NDArray) -> WallData:
        """Return the data of some of the pixels."""
        names = ("columns", "rows", "seen", "weight", "pixel")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def image(self, values: Array, fill: float) -> Array:
        """Return values of the pixels [P] as a working image [h, w], `fill` where a pixel takes no part."""
        out = np.full(self.grid[0] * self.grid[1], fill)
        out[self.pixel] = values
        return out.reshape(self.grid)

    def monomials(self) -> Array:
        """Return x, y, x^2, x y, y^2 over the image, [P, 5], each from -1 to 1."""
        x = 2 * self.columns / (self.shape[1] - 1) - 1
        y = 2 * self.rows / (self.shape[0] - 1) - 1
        return np.stack([x, y, x * x, x * y, y * y], axis=1)


def wall_data(
    capture_set: CaptureSet,
    columns: int,
    plane: Plane,
    *,
    every: int = 4,
    first: int | None = None,
    checkered: bool = False,
) -> WallData:
    """Return frames of captures in the middles of larger pixels, and targets as images on a plane's cells.

    Args:
        capture_set: The captures.
        columns: Columns of the working images, at most the sensor's.
        plane: Cells, over the whole travel.
        every: Only every n-th frame of a capture takes part.
        first: The first of them; None is the middle of the first n.
        checkered: Whether only every second pixel takes part, in the pattern of a chessboard.
    """
    height, width = capture_set.shape
    columns = min(columns, width)
    grid = (max(8, round(columns * height / width)), columns) if columns < width else (height, width)
    begin = every // 2 if first is None else first
    frames, pictures, capture, places = [], [], [], []
    for k, one in enumerate(capture_set.captures):
        picked = np.arange(begin, len(one.frames), every)
        means = reduce_by_area(one.frames[picked] / np.float32(capture_set.peak), grid)
        frames.append(point_samples(means, (height / grid[0], width / grid[1])))
        scene = capture_set.scenes[k]
        place = scene.motion.position_m(capture_set.times_s(k)[picked])
        pictures.append(scene.target.rasterise(plane, place).reshape(len(picked), -1))
        capture.append(np.full(len(picked), k))
        places.append(place)
    seen, drawn = np.concatenate(frames), np.concatenate(pictures)
    v, u = np.meshgrid(np.arange(grid[0]), np.arange(grid[1]), indexing="ij")
    keep = ((u + v) % 2 == 0).ravel() if checkered else np.ones(u.size, bool)
    keep &= (seen < _SATURATED).all(axis=0).ravel()
    light = np.ascontiguousarray(seen.reshape(len(seen), -1).T[keep], dtype=np.float64)
    level = light.mean(axis=1)
    weight = 1 / (level + 0.05 * level.max() + 1e-9)
    return WallData(
        capture_set.shape,
        ((u.ravel() + 0.5) * width / grid[1] - 0.5)[keep],
        ((v.ravel() + 0.5) * height / grid[0] - 0.5)[keep],
        light,
        np.concatenate(capture),
        grouped(np.concatenate(places), np.concatenate(capture)),
        weight * (len(weight) / weight.sum()),
        grid,
        np.flatnonzero(keep),
        np.concatenate(places),
        plane,
        SparseImages.of(drawn),
        capture_set.drifts,
    )


def grouped(places: Array, capture: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the group of each frame: those with targets within a millimetre, if most captures share places.

    Args:
        places: Places of the targets [N, 2], metres.
        capture: Capture of each frame [N].
    """
    keys = np.round(places / 1e-3).astype(np.int64)
    _, group, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    captures = len(np.unique(capture))
    if captures < 4 or count.min() < max(3, captures / 2):
        return np.zeros(len(places), np.int64)
    return group.reshape(-1).astype(np.int64)


@dataclass(frozen=True)
class Freedom:
    """A number of the pose that the frames decide, with what is known before.

    Args:
        name: Name in `Pose`; `.0` for the first entry of a tuple.
        unit: Its unit.
        spread: Standard deviation of what is known before, in the unit, or relative where `log`.
        step: Step of the finite difference, likewise.
        log: Whether the search runs over its logarithm.
        fine: Whether only the last stage of the search moves it; the small images hardly tell it.
    """

    name: str
    unit: str
    spread: float
    step: float
    log: bool = False
    fine: bool = False

    def read(self, pose: Pose) -> float:
        """Return the number in a pose."""
        name, _, entry = self.name.partition(".")
        value = getattr(pose, name)
        return float(value[int(entry)] if entry else value)

    def into(self, pose: Pose, value: float) -> Pose:
        """Return the pose with another value."""
        name, _, entry = self.name.partition(".")
        if not entry:
            return replace(pose, **{name: value})
        both = list(getattr(pose, name))
        both[int(entry)] = value
        return replace(pose, **{name: tuple(both)})

    def between(self, first: Pose, last: Pose) -> float:
        """Return the step in the search's coordinate from one pose to another."""
        low, high = self.read(first), self.read(last)
        return math.log(high / low) if self.log else high - low

    def moved(self, pose: Pose, by: float) -> Pose:
        """Return the pose after a step in the search's coordinate."""
        value = self.read(pose)
        return self.into(pose, value * math.exp(by) if self.log else value + by)


FREEDOMS = (
    Freedom("camera_distance_m", "m", 0.5, 0.02, log=True),
    Freedom("camera_angle_deg", "deg", 20.0, 0.5),
    Freedom("camera_elevation_deg", "deg", 5.0, 0.5),
    Freedom("camera_roll_deg", "deg", 2.0, 0.3),
    Freedom("field_of_view_deg", "deg", 0.3, 0.01, log=True),
    Freedom("target_offset_m.0", "m", 0.1, 0.002),
    Freedom("target_offset_m.1", "m", 0.03, 0.002),
    Freedom("distance_m", "m", 0.03, 0.01, log=True),
    Freedom("curvature_per_m.0", "1/m", 0.7, 0.05),
    Freedom("curvature_per_m.1", "1/m", 0.7, 0.05),
    Freedom("distortion", "", 0.05, 0.01, fine=True),
    Freedom("travel_slope", "m/m", 0.03, 0.01, fine=True),
)


@dataclass(frozen=True, eq=False)
class WallState:
    """A wall in the course of a fit.

    Args:
        pose: Camera, wall and target.
        table: The facets' slopes, white levels included.
        sensitivity: Logarithm of the pixels' sensitivity: coefficients of `WallData.monomials` [5].

    What its methods take as `tilt` are slopes of the wall where each pixel sees it, beside its bend, [P, 2].
    """

    pose: Pose
    table: SlopeTable
    sensitivity: Array = field(default_factory=lambda: np.zeros(5))

    def place(self, data: WallData, pose: Pose | None = None, tilt: Array | None = None) -> tuple[Seen, Cells]:
        """Return wall points and target cells."""
        pose = self.pose if pose is None else pose
        seen = seen_points(pose, data.shape, data.columns, data.rows, tilt=tilt)
        return seen, target_cells(pose, data.plane)

    def light(self, data: WallData, pose: Pose | None = None, tilt: Array | None = None) -> Array:
        """Return what the pixels see, without light that does not come from the targets, [P, N]."""
        out = np.empty(data.seen.shape)
        with torchs_threads():
            carry_facets(out, *self.place(data, pose, tilt), self.table, MASKING, data.images)
        return out * np.exp(data.monomials() @ self.sensitivity)[:, None]

    def gains(self, data: WallData, light: Array | None = None) -> Array:
        """Return how bright the target of each frame is beside the mean of all, [N]; 1 where no light drifts.

        Least squares over the captures, whose mean is taken off together as it is from what they show.
        """
        if not data.drifts:
            return np.ones(data.seen.shape[1])
        light = self.light(data) if light is None else light
        member, root = _members(data.capture), np.sqrt(data.weight)[:, None]
        own = np.stack([(data.shared_removed(light * one) * root).ravel() for one in member.T])
        found = np.linalg.lstsq(own @ own.T, own @ (data.shared_removed(data.seen) * root).ravel(), rcond=None)[
            0
        ]
        return member @ (found / found.mean()).clip(*_DIMMEST_BRIGHTEST)

    def residual(self, data: WallData) -> Array:
        """Return the weighted residual [P, N] without what the captures share."""
        light = self.light(data)
        left = data.shared_removed(data.seen - light * self.gains(data, light))
        return left * np.sqrt(data.weight)[:, None]


def start_at(data: WallData, pose: Pose, lobes: Array = LOBES) -> tuple[WallState, float]:
    """Return the wall of GGX lobes that fits best at a pose, and the share of the light that it leaves, 0..1.

    Args:
        data: Frames and targets.
        pose: Camera, wall and target.
        lobes: Roughness along x and y of the lobes [L, 2]; their weights are not negative.

    Raises:
        ConfigError: The camera of that pose does not see the wall.
    """
    from scipy.optimize import nnls  # scipy loads slowly

    seen = seen_points(pose, data.shape, data.columns, data.rows)
    cells = target_cells(pose, data.plane)
    out = np.empty((*data.seen.shape, len(lobes) + 1))
    with torchs_threads():
        carry_lobes(out, seen, cells, lobes, MASKING, data.images)
    root = np.sqrt(data.weight)[:, None]
    basis = (data.shared_removed(out) * root[..., None]).reshape(-1, len(lobes) + 1)
    wanted = (data.shared_removed(data.seen) * root).ravel()
    gram, right = basis.T @ basis, basis.T @ wanted
    size = np.sqrt(np.diag(gram)) + 1e-300
    normal = gram / np.outer(size, size) + 1e-6 * np.eye(len(size))
    factor = np.linalg.cholesky(normal).T
    solved, _ = nnls(factor, np.linalg.solve(factor.T, right / size))
    weights = solved / size
    power = float(wanted @ wanted)
    left = (power - 2 * weights @ right + weights @ gram @ weights) / power
    share = weights[:-1] * size[:-1]
    if share.sum() <= 0:
        weights = weights.copy()
        weights[:-1] = 1e-6 / size[:-1]
        share = weights[:-1] * size[:-1]
    main = lobes[share > 0.05 * share.sum()].min()
    scale = float(np.clip(main, 0.01, 0.2))
    table = SlopeTable.of_lobes(lobes, weights[:-1], scale=scale, matte=float(weights[-1]))
    return WallState(pose, table), float(left)


@dataclass(frozen=True, eq=False)
class Progress:
    """Where a search stands.

    Args:
        state: The wall.
        left: Share of what differs between captures that the wall leaves, 0..1.
        evaluations: How often derivatives were computed.
        prior: Misfit of what is known before, in squared standard deviations.
    """

    state: WallState
    left: float
    evaluations: int = 0
    prior: float = 0.0

    def cost(self) -> float:
        """Return the misfit of the frames and of what is known, in squared standard deviations."""
        return EFFECTIVE * math.log(self.left) + self.prior


class Unknowns:
    """Where the numbers of a fit stand in its vector: pose, slopes, sensitivity, matte part.

    Args:
        freedoms: Numbers of the pose.
        start: The state that the slopes' prior is about.
        prior: Means of the pose's priors.
    """

    def __init__(self, freedoms: Sequence[Freedom], start: WallState, prior: Pose) -> None:
        self.freedoms, self.prior_pose = tuple(freedoms), prior
        nodes = start.table.nodes
        self.column, self.count = folded_columns(nodes)
        self.poses = len(self.freedoms)
        self.size = self.poses + self.count + 6
        self.matte = max(float(np.exp(start.table.log_density).max()) * 1e-3, start.table.matte)
        self.first = self._folded(start.table.log_density)
        known = np.array([f.spread for f in self.freedoms])
        other = np.repeat([_LEVEL, _TILT, _MATTE], [self.count, 5, 1])
        self.information = np.diag(1 / np.concatenate([known, other]) ** 2)
        smooth = second_differences(nodes, self.column, self.count) / _BEND
        slopes = slice(self.poses, self.poses + self.count)
        self.information[slopes, slopes] += smooth.T @ smooth

    def away(self, state: WallState) -> Array:
        """Return the distance of a state from the priors' means, [size]."""
        moved = [f.between(self.prior_pose, state.pose) for f in self.freedoms]
        slopes = self._folded(state.table.log_density) - self.first
        return np.concatenate([moved, slopes, state.sensitivity, [state.table.matte / self.matte]])

    def stepped(self, state: WallState, step: Array) -> WallState:
        """Return the state after a step [size]; no number of the pose goes further than its prior's spread."""
        pose = state.pose
        for freedom, by in zip(self.freedoms, step, strict=False):
            pose = freedom.moved(pose, float(np.clip(by, -freedom.spread, freedom.spread)))
        slopes = np.clip(step[self.poses : self.poses + self.count], -2, 2)[self.column]
        matte = max(0.0, state.table.matte + float(step[-1]) * self.matte)
        table = state.table._replace(log_density=state.table.log_density + slopes, matte=matte)
        return WallState(pose, table, state.sensitivity + step[self.poses + self.count : -1])

    def _folded(self, table: Array) -> Array:
        total = np.bincount(self.column.ravel(), weights=table.ravel(), minlength=self.count)
        return total / np.bincount(self.column.ravel(), minlength=self.count)


def evenly_lit(captures: CaptureSet, state: WallState, plane: Plane) -> CaptureSet:
    """Return captures whose light drifts with targets of the same brightness in all; others as they are.

    Args:
        captures: The captures.
        state: Behind which their brightness is told.
        plane: Cells of the targets' images.
    """
    if not captures.drifts:
        return captures
    data, frames = wall_data(captures, 25, plane, every=8), []
    own = state.gains(data)[np.unique(data.capture, return_index=True)[1]]
    for one, gain in zip(captures.captures, own.tolist(), strict=True):
        frames.append(relit(one, one.frames / np.float32(gain), captures.peak))
    return replace(captures, captures=tuple(frames))


def refine(
    data: WallData,
    state: WallState,
    *,
    prior: Pose,
    freedoms: Sequence[Freedom] = FREEDOMS,
    iterations: int = 10,
) -> Progress:
    """Fit pose, slopes and sensitivity together: Gauss-Newton with damping, smooth slopes, and what is known.

    Args:
        data: Frames and targets.
        state: Start; the slopes stay near it, and smooth about it.
        prior: What is known of the pose: the means of the freedoms' priors.
        freedoms: Numbers of the pose that move.
        iterations: Most steps.
    """
    unknowns = Unknowns(freedoms, state, prior)
    power = float((data.shared_removed(data.seen) ** 2 * data.weight[:, None]).sum())
    now, damping, evaluations = state.residual(data), 1e-2, 0
    for round_ in range(1, iterations + 1):
        note(f"wall, round {round_}")
        temper = EFFECTIVE / float((now**2).sum())
        away = unknowns.away(state)
        cost = EFFECTIVE + away @ unknowns.information @ away
        gram, right = normal_equations(data, state, unknowns, now)
        evaluations += 1
        hessian = gram * temper + unknowns.information
        slope = right * temper - unknowns.information @ away
        reached = cost
        for _ in range(_TRIALS):
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), slope)
            trial = unknowns.stepped(state, np.asarray(step, np.float64))
            damping *= 8
            try:
                after = trial.residual(data)
            except ConfigError:  # a camera that can't be: the search turns back
                continue
            far = unknowns.away(trial)
            reached = float((after**2).sum()) * temper + far @ unknowns.information @ far
            if reached < cost:
                state, now, damping = trial, after, max(damping / 40, 1e-6)
                break
        if cost - reached < _TOLERANCE * cost:
            break
    away = unknowns.away(state)
    return Progress(
        state, float((now**2).sum()) / power, evaluations, float(away @ unknowns.information @ away)
    )


def uncertainty(
    data: WallData, state: WallState, *, prior: Pose, freedoms: Sequence[Freedom] = FREEDOMS
) -> Array:
    """Return standard errors of the pose's freedoms, in the search's coordinates; see `scatter_of`.

    Args:
        data: Frames and targets.
        state: The fit.
        prior: See `refine`.
        freedoms: Numbers of the pose that were fitted.
    """
    unknowns = Unknowns(freedoms, state, prior)
    now, scores = state.residual(data), []
    gram, _ = normal_equations(data, state, unknowns, now, scores)
    temper = EFFECTIVE / float((now**2).sum())
    inverse = np.linalg.inv(gram * temper + unknowns.information)
    each = np.concatenate(scores).swapaxes(0, 1)  # [C, P, M]
    ends = [(v - v.min()) / (np.ptp(v) + 1e-9) * BLOCKS for v in (data.rows, data.columns)]
    row, column = (np.minimum(v, BLOCKS - 1).astype(int) for v in ends)
    scatter = temper**2 * scatter_of(each, np.arange(len(each)), row * BLOCKS + column) + unknowns.information
    return np.sqrt(np.diag(inverse @ scatter @ inverse)[: unknowns.poses])


def normal_equations(
    data: WallData, state: WallState, unknowns: Unknowns, now: Array, scores: list[Array] | None = None
) -> tuple[Array, Array]:
    """Return J^T W J [M, M] and J^T W r [M], with the rows free of what the captures share.

    Args:
        data: Frames and targets.
        state: Where.
        unknowns: What J derives by.
        now: The weighted residual r there [P, N], as `WallState.residual` gives it.
        scores: Where it is a list, each pixel's and capture's part of the latter is appended to it, [P, C, M].
    """
    poses, count, table = unknowns.poses, unknowns.count, state.table
    light, moves = state.light(data), []
    for freedom in unknowns.freedoms:
        try:
            moves.append((state.light(data, freedom.moved(state.pose, freedom.step)) - light) / freedom.step)
        except ConfigError:
            moves.append((light - state.light(data, freedom.moved(state.pose, -freedom.step))) / freedom.step)
    seen, cells = state.place(data)
    monomials, root = data.monomials(), np.sqrt(data.weight).astype(np.float32)
    gain, bright = np.exp(monomials @ state.sensitivity), state.gains(data, light).astype(np.float32)
    gram, right = np.zeros((unknowns.size, unknowns.size)), np.zeros(unknowns.size)
    member = _members(data.group) / np.sqrt(np.bincount(data.group)).astype(np.float32)  # [N, G]
    capture = torch.from_numpy(_members(data.capture))
    for start in range(0, len(light), _CHUNK):
        part = slice(start, start + _CHUNK)
        own = light[part]
        slopes = np.empty((*own.shape, count + 1), np.float32)
        with torchs_threads():
            facet_slopes(slopes, seen.part(part), cells, table, MASKING, unknowns.column, data.images)
        jac = np.empty((*own.shape, unknowns.size), np.float32)
        for k, move in enumerate(moves):
            jac[..., k] = move[part]
        jac[..., poses : poses + count] = slopes[..., :-1] * gain[part, None, None]
        jac[..., poses + count : -1] = own[..., None] * monomials[part, None, :]
        jac[..., -1] = slopes[..., -1] * (gain[part, None] * unknowns.matte)
        jac *= root[part, None, None] * bright[:, None]
        every = torch.from_numpy(jac)
        left = torch.from_numpy(now[part].astype(np.float32))
        flat = every.flatten(0, 1)
        gram += (flat.T @ flat).double().numpy()
        right += (flat.T @ left.flatten()).double().numpy()
        # Without the means m of the n frames of a group, sum J^T J falls by n m^T m.
        means = (every.mT @ torch.from_numpy(member)).mT.flatten(0, 1)
        gram -= (means.T @ means).double().numpy()
        if scores is not None:
            scores.append(((every * left[..., None]).mT @ capture).mT.double().numpy())
    return gram, right


def _members(numbers: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return 1 where a frame belongs to a group, [N, G]."""
    return (numbers[:, None] == np.unique(numbers)).astype(np.float32)
