"""What is hidden and how it moves, in continuous time: a flat, square target, its motion, its drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.config import check_made
from evnlos.errors import DataError
from evnlos.types import Plane


class Pose(NamedTuple):
    """Where a target is and how it is turned, at some times of shape [...]."""

    x_m: NDArray[np.float64]
    """To the right, metres, [...]."""
    y_m: NDArray[np.float64]
    """Downwards, metres, [...]."""
    z_m: NDArray[np.float64]
    """Distance from the wall, metres, [...]; NaN where the motion leaves it to the setup."""
    rotation_rad: NDArray[np.float64]
    """Turn about the wall's normal, clockwise as the camera's rows and columns run, radians, [...]."""


@runtime_checkable
class Motion(Protocol):
    """Anything that knows where the target's centre is at every instant.

    The distance of the target and its pose belong to the scene: a motion that knows them has a method
    `pose(t_s) -> Pose` too. Without one it stays upright in one plane, at the distance that is the setup's.
    """

    def position_m(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the centre (x, y) at times `t_s` (seconds, any shape [...]), metres, float64 [..., 2]."""
        ...

    def speed_bound_m_s(self, start_s: float, stop_s: float) -> float:
        """Return an upper bound of the speed between two times (seconds), metres per second."""
        ...


def pose_of(motion: Motion, t_s: ArrayLike) -> Pose:
    """Return the pose of a motion at times `t_s`; one that knows no pose rests upright at the setup's distance.

    Args:
        motion: The motion.
        t_s: Times, seconds, any shape [...].
    """
    pose: Any = getattr(motion, "pose", None)
    return _upright(motion.position_m(t_s), None) if pose is None else pose(t_s)


def _upright(position_m: NDArray[np.float64], z_m: float | None) -> Pose:
    x, y = position_m[..., 0], position_m[..., 1]
    return Pose(x, y, np.full(x.shape, np.nan if z_m is None else z_m), np.zeros(x.shape))


def _check_distance(name: str, z_m: float | None) -> None:
    if z_m is not None and not (np.isfinite(z_m) and z_m > 0):
        raise DataError(f"{name}.z_m is {z_m}; give the metres from target to wall, above 0, or None")


def _times(t_s: ArrayLike) -> NDArray[np.float64]:
    """Return times as float64, refusing NaN and infinity."""
    times = np.asarray(t_s, dtype=np.float64)
    if not np.isfinite(times).all():
        raise DataError("t_s holds NaN or infinity; give finite seconds")
    return times


@dataclass(frozen=True)
class LineMotion:
    """Constant speed along a straight line, for all times.

    position(t) = start + speed * direction / |direction| * (t - start time); the defaults are the paper's:
    2 cm/s from left to right, 8 s for 16 cm. It may retreat from the wall and turn in its plane on the way,
    both steadily.

    Args:
        start_m: Centre (x, y) at `start_s`, metres, x to the right and y downwards.
        speed_m_s: Speed, metres per second, 0 or more.
        direction: Direction (x, y) of any length above 0.
        start_s: Time at which the centre is at `start_m`, seconds.
        z_m: Distance from target to wall at `start_s`, metres, above 0; None is the setup's own.
        retreat_m_s: Speed away from the wall, metres per second; below 0 it approaches.
        spin_deg_s: Turn about the wall's normal from upright at `start_s`, clockwise as the camera's rows and
            columns run, degrees per second.

    Raises:
        DataError: A value is not finite, the speed is negative, the direction has no length, or the target
            retreats from no stated distance.

    Example:
        >>> LineMotion().position_m(4.0)
        array([0., 0.])
    """

    start_m: tuple[float, float] = (-0.08, 0.0)
    speed_m_s: float = 0.02
    direction: tuple[float, float] = (1.0, 0.0)
    start_s: float = 0.0
    z_m: float | None = None
    retreat_m_s: float = 0.0
    spin_deg_s: float = 0.0

    def __post_init__(self) -> None:
        for name, pair in {"start_m": self.start_m, "direction": self.direction}.items():
            if not hasattr(pair, "__len__") or len(pair) != 2 or not all(map(math.isfinite, pair)):
                raise DataError(f"LineMotion.{name} is {pair}; give two finite numbers (x, y)")
            object.__setattr__(self, name, (float(pair[0]), float(pair[1])))
        if not (math.isfinite(self.speed_m_s) and self.speed_m_s >= 0):
            raise DataError(f"LineMotion.speed_m_s is {self.speed_m_s}; give 0 or more metres per second")
        if not math.hypot(*self.direction) > 0:
            raise DataError("LineMotion.direction is (0, 0); give a direction with a length")
        for name in ("start_s", "retreat_m_s", "spin_deg_s"):
            if not math.isfinite(getattr(self, name)):
                raise DataError(f"LineMotion.{name} is {getattr(self, name)}; give a finite number")
        _check_distance("LineMotion", self.z_m)
        if self.retreat_m_s and self.z_m is None:
            raise DataError(
                f"LineMotion.retreat_m_s is {self.retreat_m_s} from no stated distance; give z_m, the metres "
                "to the wall at start_s"
            )
        check_made(self)

    def in_its_plane(self) -> LineMotion:
        """Return the motion for a use that knows one target plane, upright.

        Raises:
            DataError: The target turns, approaches or retreats.
        """
        if self.retreat_m_s or self.spin_deg_s:
            raise DataError(
                f"the motion retreats at {self.retreat_m_s:g} m/s and turns at {self.spin_deg_s:g} degrees/s, "
                "and this knows one plane and an upright target; follow it, which writes its image, too "
                "(`evnlos track --depth --turning`)"
            )
        return self

    def pose(self, t_s: ArrayLike) -> Pose:
        """Return the pose at times `t_s` (seconds, any shape [...])."""
        upright, passed = _upright(self.position_m(t_s), self.z_m), _times(t_s) - self.start_s
        z_m, turned = self.retreat_m_s * passed, math.radians(self.spin_deg_s) * passed
        return upright._replace(z_m=upright.z_m + z_m, rotation_rad=turned)

    def position_m(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the centre (x, y) at times `t_s` (seconds, any shape [...]), metres, float64 [..., 2]."""
        velocity = self.speed_m_s * np.asarray(self.direction) / np.hypot(*self.direction)
        return np.asarray(self.start_m) + (_times(t_s)[..., None] - self.start_s) * velocity

    def speed_bound_m_s(self, start_s: float, stop_s: float) -> float:
        """Return the speed, metres per second; it does not depend on the times (seconds)."""
        return float(self.speed_m_s)


@dataclass(frozen=True)
class PathMotion:
    """A smooth path through given points: monotone cubic in time, at rest before the first and after the last.

    Each coordinate is a cubic Hermite curve with the slopes of Fritsch and Butland (1984): it passes through
    every point, its velocity is continuous, and it never leaves the range of two neighbouring points. The slope
    at both ends is zero, so that the target starts from rest and comes to rest.

    Args:
        times_s: Times of the points, seconds, strictly increasing, two or more.
        points_m: Centres (x, y) at these times, metres, one pair a time.
        z_m: Distance from target to wall, metres, above 0: one, or one a time; None is the setup's own.
        rotation_deg: Turn about the wall's normal, clockwise as the camera's rows and columns run, degrees:
            one, or one a time.

    Raises:
        DataError: Fewer than two points, unequal lengths, times that do not increase, or values not finite.

    Example:
        >>> PathMotion((0.0, 1.0), ((0.0, 0.0), (0.1, 0.0))).position_m([-1.0, 0.5, 2.0])
        array([[0.  , 0.  ],
               [0.05, 0.  ],
               [0.1 , 0.  ]])
    """

    times_s: tuple[float, ...]
    points_m: tuple[tuple[float, float], ...]
    z_m: float | tuple[float, ...] | None = None
    rotation_deg: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        times = np.asarray(self.times_s, dtype=np.float64)
        points = np.asarray(self.points_m, dtype=np.float64)
        if times.ndim != 1 or len(times) < 2:
            raise DataError(f"PathMotion.times_s has {times.size} times; give two or more")
        if points.shape != (len(times), 2):
            raise DataError(
                f"PathMotion.points_m has shape {points.shape}; give ({len(times)}, 2), one (x, y) a time"
            )
        if not (np.isfinite(times).all() and np.isfinite(points).all()):
            raise DataError("PathMotion holds NaN or infinity; give finite seconds and metres")
        if not (np.diff(times) > 0).all():
            raise DataError("PathMotion.times_s does not increase; give each time once, in order")
        object.__setattr__(self, "times_s", tuple(times.tolist()))
        object.__setattr__(self, "points_m", tuple((x, y) for x, y in points.tolist()))
        for name in ("z_m", "rotation_deg"):
            value = getattr(self, name)
            if isinstance(value, tuple | list):
                if len(value) != len(times):
                    raise DataError(f"PathMotion.{name} has {len(value)} values; give one, or {len(times)}")
                object.__setattr__(self, name, tuple(float(one) for one in value))
        for one in () if self.z_m is None else np.atleast_1d(self.z_m).tolist():
            _check_distance("PathMotion", one)
        if not np.isfinite(self.rotation_deg).all():
            raise DataError(f"PathMotion.rotation_deg is {self.rotation_deg}; give finite degrees")
        check_made(self)

    def pose(self, t_s: ArrayLike) -> Pose:
        """Return the pose at times `t_s` (seconds, any shape [...])."""
        x, y, z, turned = np.moveaxis(self._at(t_s), -1, 0)
        return Pose(x, y, z, np.radians(turned))

    def position_m(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the centre (x, y) at times `t_s` (seconds, any shape [...]), metres, float64 [..., 2]."""
        return self._at(t_s)[..., :2]

    def _at(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return x, y, z (metres) and rotation (degrees), [..., 4]."""
        knots, points, slopes = self._curve()
        times = np.clip(_times(t_s), knots[0], knots[-1])
        left = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
        step = (knots[left + 1] - knots[left])[..., None]
        u = (times - knots[left])[..., None] / step  # 0..1 within the piece
        rise = points[left + 1] - points[left]
        # Hermite basis written around the left point: exact there, and short.
        bend = slopes[left] * step * u * (1 - u) ** 2 - slopes[left + 1] * step * u**2 * (1 - u)
        return points[left] + rise * u**2 * (3 - 2 * u) + bend

    def speed_bound_m_s(self, start_s: float, stop_s: float) -> float:
        """Return an upper bound of the speed in the plane between two times (seconds), metres per second.

        The velocity of a cubic piece is a parabola, bounded by its Bezier coefficients: both end slopes and
        3 rise / step - slope - slope.
        """
        knots, points, slopes = self._curve()
        points, slopes = points[:, :2], slopes[:, :2]
        step = np.diff(knots)[:, None]
        middle = 3 * np.diff(points, axis=0) / step - slopes[:-1] - slopes[1:]
        hull = np.stack([slopes[:-1], middle, slopes[1:]])  # [3, pieces, 2]
        bound = np.linalg.norm(hull, axis=-1).max(axis=0)  # [pieces]
        touched = (knots[1:] > start_s) & (knots[:-1] < stop_s)
        return float(bound[touched].max(initial=0.0))

    def _curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return knots [K], points (x, y, z, rotation) [K, 4] and their slopes [K, 4]."""
        knots = np.asarray(self.times_s)
        others = (np.nan if self.z_m is None else self.z_m, self.rotation_deg)
        columns = [np.broadcast_to(np.asarray(one, np.float64), len(knots)) for one in others]
        points = np.column_stack([self.points_m, *columns])
        step = np.diff(knots)[:, None]
        secant = np.diff(points, axis=0) / step
        slopes = np.zeros_like(points)
        before, after = secant[:-1], secant[1:]
        same_way = before * after > 0
        # Weighted harmonic mean; zero where the direction turns, which keeps the curve within its points.
        w_before, w_after = step[:-1] + 2 * step[1:], 2 * step[:-1] + step[1:]
        # Written as a fraction of products: a slope of almost nothing must not overflow when divided by.
        below = np.where(same_way, w_before * after + w_after * before, 1.0)
        mean = (w_before + w_after) * (before * after) / below
        slopes[1:-1] = np.where(same_way, mean, 0.0)
        return knots, points, slopes


_PROBES = 65  # instants at which a scene's pose is looked at
_FINE_SIDE = 128  # pixels a side from which a mask is fine enough to be turned as it is
_MAX_SIDE = 4096  # pixels; a drawing of 20 um a pixel on an 8 cm target


@dataclass(frozen=True, eq=False)
class Target:
    """A flat, square target that moves behind the corner.

    Args:
        name: Name of the object, not empty.
        mask: How bright each part of the target is, float32 [S, S], 0..1, row 0 on top; it covers the target.
        size_m: Side of the target plane, metres.

    Raises:
        DataError: The mask is not square, holds NaN or values outside 0..1, or the size is not positive.

    Example:
        >>> Target("square", np.ones((4, 4)), size_m=0.08)
        Target('square', 4 x 4 px, 0.08 m)
    """

    name: str
    mask: NDArray[np.float32]
    size_m: float = 0.08

    def __post_init__(self) -> None:
        if not self.name:
            raise DataError("Target.name is empty; give the object a name")
        mask = np.array(self.mask, dtype=np.float32)  # a copy: the caller's array stays his own
        if mask.ndim != 2 or mask.shape[0] != mask.shape[1] or not 1 <= mask.shape[0] <= _MAX_SIDE:
            raise DataError(
                f"Target.mask of {self.name} is {mask.shape}; give a square of 1 to {_MAX_SIDE} pixels"
            )
        # NaN fails both comparisons, so the range check finds it too.
        if not (mask.min() >= 0 and mask.max() <= 1):
            raise DataError(
                f"Target.mask of {self.name} holds {mask.min()}..{mask.max()}; give finite values from 0 to 1"
            )
        if not (np.isfinite(self.size_m) and self.size_m > 0):
            raise DataError(f"Target.size_m of {self.name} is {self.size_m}; give a positive number of metres")
        mask.setflags(write=False)
        object.__setattr__(self, "mask", mask)
        object.__setattr__(self, "size_m", float(self.size_m))

    def __repr__(self) -> str:
        side = self.mask.shape[0]
        return f"Target({self.name!r}, {side} x {side} px, {self.size_m:g} m)"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Target):
            return NotImplemented
        same = (self.name, self.size_m) == (other.name, other.size_m)
        return same and np.array_equal(self.mask, other.mask)

    def banded(self, brightness: ArrayLike) -> Target:
        """Return the target in bands of equal height, from the top, each brighter or darker than it was.

        Args:
            brightness: What the mask is multiplied by in each band, [bands], 0..1.
        """
        factors = np.asarray(brightness, np.float32)
        rows = np.arange(len(self.mask)) * len(factors) // len(self.mask)
        return replace(self, mask=self.mask * factors[rows, None])

    @property
    def light_m(self) -> NDArray[np.float64]:
        """Middle of its light from its centre (x, y), [2], metres."""
        along, mask = ((np.arange(len(self.mask)) + 0.5) / len(self.mask) - 0.5), self.mask.astype(np.float64)
        return self.size_m * np.array([mask.sum(axis=0) @ along, mask.sum(axis=1) @ along]) / mask.sum()

    def turned(self, rotation_rad: float) -> Target:
        """Return the target turned about its centre, on a larger plane; a coarse mask gets half the pixel.

        Bilinear between the mask's pixels: what a pixel's width of blur hides.

        Args:
            rotation_rad: Angle, clockwise as rows and columns run, radians.
        """
        from scipy.ndimage import map_coordinates  # scipy loads slowly

        side = len(self.mask)
        finer = 2 if side < _FINE_SIDE else 1
        fine = finer * math.ceil(side * math.sqrt(2))  # room for the corners
        along = (np.arange(fine) - (fine - 1) / 2) / finer
        cos, sin = math.cos(rotation_rad), math.sin(rotation_rad)
        row = cos * along[:, None] - sin * along + (side - 1) / 2
        column = cos * along + sin * along[:, None] + (side - 1) / 2
        found = map_coordinates(self.mask.astype(np.float64), [row, column], order=1, mode="grid-constant")
        return Target(self.name, np.clip(found, 0, 1).astype(np.float32), self.size_m * fine / (finer * side))

    def rasterise(
        self, plane: Plane, position_m: ArrayLike = (0.0, 0.0), rotation_rad: float = 0.0
    ) -> NDArray[np.float32]:
        """Draw the target on a sampled plane, exactly: each sample is the mean of the mask over its cell.

        With O_y [H, S] and O_x [W, S] the fractions of each cell that each mask pixel covers along one axis,
        the image is O_y mask O_x^T (computed from running integrals). Light is conserved: where the whole
        target lies on the plane, image.sum() pitch^2 = mask.mean() size^2, at any sub-pixel position.

        Args:
            plane: The plane to draw on.
            position_m: Target's centre (x, y) in the plane's coordinates, metres, [2], or [N, 2] for N places.
            rotation_rad: Turn about the centre, radians; a turned target is drawn as `turned` says.

        Returns:
            float32 [H, W], or [N, H, W] for N places, 0..1; zero outside the target plane.

        Raises:
            DataError: The position is not finite or of another shape.

        Example:
            >>> Target("square", np.ones((2, 2)), size_m=0.03).rasterise(Plane(3, 4, 0.01), (0.005, 0.0))
            array([[0., 1., 1., 1.],
                   [0., 1., 1., 1.],
                   [0., 1., 1., 1.]], dtype=float32)
        """
        if rotation_rad:
            return self.turned(rotation_rad).rasterise(plane, position_m)
        position = np.asarray(position_m, dtype=np.float64)
        if position.ndim not in (1, 2) or position.shape[-1] != 2:
            raise DataError(f"position_m has shape {position.shape}; give (x, y) or [N, 2] metres")
        if not np.isfinite(position).all():
            raise DataError("position_m holds NaN or infinity; give finite metres")
        places = position.reshape(-1, 2)  # [N, 2]
        x_edges = self._edges(plane.x_m, plane.pitch_m, places[:, 0])  # [N, W + 1]
        y_edges = self._edges(plane.y_m, plane.pitch_m, places[:, 1])  # [N, H + 1]
        image = np.zeros((len(places), *plane.shape), np.float32)
        side = self.mask.shape[0]
        # Motion along a row is the usual case: places at one height share their vertical resampling.
        heights, group = np.unique(places[:, 1], return_inverse=True)
        integral = _integral(self.mask.astype(np.float64))  # [S + 1, S]
        for k in range(len(heights)):
            chosen = np.flatnonzero(group == k)
            y, x = _covered(y_edges[chosen[:1]], side), _covered(x_edges[chosen], side)
            rows = _cell_means(integral, y_edges[chosen[0], y.start : y.stop + 1])  # [h, S]
            columns = _cell_means(_integral(rows.T), x_edges[chosen, x.start : x.stop + 1])  # [n, w, h]
            image[chosen, y, x] = columns.transpose(0, 2, 1)
        np.clip(image, 0.0, 1.0, out=image)
        return image if position.ndim == 2 else image[0]

    def _edges(
        self, centre_m: NDArray[np.float64], pitch_m: float, place_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the edges of a plane's cells, mask pixels from the target's edge, float64 [N, cells + 1]."""
        edge_m = np.append(centre_m - 0.5 * pitch_m, centre_m[-1] + 0.5 * pitch_m)
        side = self.mask.shape[0]
        return (edge_m[None, :] - place_m[:, None]) * (side / self.size_m) + 0.5 * side


def _covered(edges: NDArray[np.float64], side: int) -> slice:
    """Return the cells between edges [n, M + 1] (mask pixels) that touch 0..side in any of the n rows."""
    touched = np.flatnonzero(((edges[:, 1:] > 0) & (edges[:, :-1] < side)).any(axis=0))
    return slice(int(touched[0]), int(touched[-1]) + 1) if len(touched) else slice(0, 0)


def _integral(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the running integral of `image` [S, K] along its first axis, from 0, float64 [S + 1, K]."""
    return np.concatenate([np.zeros((1, image.shape[1])), np.cumsum(image, axis=0)])


def _cell_means(integral: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of an image over cells along its first axis, zero outside it, float64 [..., M, K].

    The integral of a piecewise constant image is piecewise linear: its value at each cell's edge is exact.

    Args:
        integral: Running integral of the image, float64 [S + 1, K]; image row s covers s..s + 1.
        edges: Edges of M cells of equal width, rows, float64 [..., M + 1].
    """
    side = len(integral) - 1
    if edges.shape[-1] < 2:
        return np.zeros((*edges.shape[:-1], 0, integral.shape[1]))
    inside = np.clip(edges, 0, side)
    row = np.minimum(inside.astype(np.intp), side - 1)
    part = (inside - row)[..., None]
    at_edge = (1 - part) * integral[row] + part * integral[row + 1]  # [..., M + 1, K]
    width = (edges[..., -1:] - edges[..., :1]) / (edges.shape[-1] - 1)  # [..., 1]
    return np.diff(at_edge, axis=-2) / width[..., None]


@dataclass(frozen=True)
class Scene:
    """A target, its motion, and for how long it is watched.

    Args:
        target: The hidden target.
        motion: Where its centre is at every instant.
        duration_s: Length of the recording, seconds.
        start_s: Its first instant, on the clock of the motion, seconds.

    Raises:
        DataError: The duration is not positive and finite.

    Example:
        >>> scene = Scene(Target("square", np.ones((4, 4))))
        >>> scene.position_times_s(4)
        array([2., 4., 6., 8.])
    """

    target: Target
    motion: Motion = field(default_factory=LineMotion)
    duration_s: float = 8.0
    start_s: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.duration_s) and self.duration_s > 0):
            raise DataError(f"Scene.duration_s is {self.duration_s}; give a positive number of seconds")

    @classmethod
    def watched(cls, target: Target, motion: Motion, times_us: NDArray[np.int64]) -> Scene:
        """Return a target as it is watched from the first to the last of some instants [N], microseconds."""
        first_s, last_s = (float(times_us[k]) * 1e-6 for k in (0, -1))
        return cls(target, motion, max(last_s - first_s, 1e-6), first_s)

    def position_times_s(self, n: int = 40) -> NDArray[np.float64]:
        """Return the instants start + k duration / n, k = 1..n, of `n` equidistant positions, [n], seconds."""
        if n < 1:
            raise DataError(f"n is {n}; ask for 1 position or more")
        return self.start_s + np.arange(1, n + 1) * self.duration_s / n

    def instants(self, count: int) -> NDArray[np.float64]:
        """Return equally spaced instants from the first to the last, [count], seconds."""
        return np.linspace(self.start_s, self.start_s + self.duration_s, count)

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """This scene alone, as a scene of several targets holds more (`SeveralTargets`)."""
        return (self,)

    def pose(self, t_s: ArrayLike) -> Pose:
        """Return x, y, z and rotation of the target at times `t_s` (seconds, any shape [...])."""
        return pose_of(self.motion, t_s)

    @property
    def moves_in_space(self) -> bool:
        """Whether the target turns, or its distance from the wall changes, while it is watched."""
        pose = self.pose(self.instants(_PROBES))
        return bool(pose.rotation_rad.any() or np.ptp(pose.z_m) > 0)  # NaN is the setup's own distance

    def light_m(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the middle of the target's light at times `t_s` (seconds, [N]), [N, 2], metres."""
        (x, y), pose = self.target.light_m, self.pose(t_s)
        cos, sin = np.cos(pose.rotation_rad), np.sin(pose.rotation_rad)
        return np.stack([pose.x_m + cos * x - sin * y, pose.y_m + sin * x + cos * y], axis=-1)

    def truth(self, plane: Plane, t_s: ArrayLike) -> NDArray[np.float32]:
        """Return the target at times `t_s` (seconds, [] or [N]) on a plane, float32 [H, W] or [N, H, W]."""
        pose = self.pose(t_s)
        places = np.stack([pose.x_m, pose.y_m], axis=-1)
        turns = np.asarray(pose.rotation_rad)
        if not turns.any():
            return self.target.rasterise(plane, places)
        drawn = [
            self.target.rasterise(plane, place, float(turn))
            for place, turn in zip(places.reshape(-1, 2), turns.reshape(-1), strict=True)
        ]
        return np.stack(drawn).reshape(*turns.shape, *plane.shape)


@dataclass(frozen=True)
class SeveralTargets:
    """Several targets at once, each on a path of its own: `Setup.observe_all` shows them.

    Their light adds. With `cover`, a later target hides those before it as far as it shines itself:
    drawn = earlier (1 - mask) + mask.

    Args:
        scenes: Each target with its motion, of one time, in the order in which they are drawn.
        cover: Whether a later target hides earlier ones. All of them are then at the setup's own distance.

    Raises:
        DataError: There is no target, their times differ, or targets that cover each other state a distance or
            turn.
    """

    scenes: tuple[Scene, ...]
    cover: bool = False

    def __post_init__(self) -> None:
        lasting = {(one.start_s, one.start_s + one.duration_s) for one in self.scenes}
        if len(lasting) != 1:
            told = ", ".join(f"{first:g} to {last:g} s" for first, last in sorted(lasting))
            raise DataError(f"{len(self.scenes)} scenes last from {told}; give one or more of one time")
        for one in self.scenes if self.cover else ():
            if one.moves_in_space or np.isfinite(one.pose(0.0).z_m):
                raise DataError(
                    f"{one.target.name} states a distance or turns, and targets that cover each other share "
                    "one plane; leave z_m and turns out, or let the light add (cover: false)"
                )

    @property
    def duration_s(self) -> float:
        """Length of the recording, seconds."""
        return self.scenes[0].duration_s

    @property
    def target(self) -> Target:
        """None: whoever takes one target gets an error instead of one of several."""
        raise DataError(
            f"the scene holds {len(self.scenes)} targets, and this takes one; give one scene, or ask "
            "Setup.observe_all for the light of all"
        )

    def truth(self, plane: Plane, t_s: ArrayLike) -> NDArray[np.float32]:
        """Return all targets at times `t_s` (seconds, [] or [N]) on a plane, float32 [H, W] or [N, H, W]."""
        return self._layers(plane, t_s)[0]

    def hidden(self, plane: Plane, t_s: ArrayLike) -> NDArray[np.float32]:
        """Return how much of the sum of all targets is hidden at times `t_s`, as `truth`; 0 without `cover`."""
        return self._layers(plane, t_s)[1]

    def _layers(self, plane: Plane, t_s: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        drawn = hidden = np.zeros((*np.shape(t_s), *plane.shape), np.float32)
        for one in self.scenes:
            image = one.truth(plane, t_s)
            behind = drawn * image if self.cover else np.zeros_like(drawn)
            drawn, hidden = drawn + image - behind, hidden + behind
        return drawn, hidden
