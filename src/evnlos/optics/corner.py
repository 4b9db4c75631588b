"""A corner as a camera: the light that a hidden scene throws past an upright edge onto a matte floor.

The wall stands on the negative x axis of the floor and ends at the origin, in an upright edge. The camera is on
the side y < 0, what is hidden on the side y > 0. A floor point whose bearing about the edge is theta, counted
from the wall, sees of the hidden side only the bearings 0 to theta, counted from the wall's continuation (the
positive x axis), whatever its distance from the edge:

    E(r, theta) = E_visible(r, theta) + integral from 0 to theta of e(phi; r, theta) dphi.

For a scene that is far compared with r, e depends on phi alone, and the derivative of the light along theta is
an image of the hidden side with one dimension (Bouman, Ye, Yedidia, Durand, Wornell, Torralba and Freeman,
"Turning corners into cameras: principles and methods", ICCV 2017).

- The exact irradiance of upright rectangles behind the edge, by Lambert's contour formula.
- The far operator on bins of bearing, with its adjoint.
- A whole scene: floor with texture, steady light, people who walk, a pin-hole camera in perspective.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.config import check_made
from evnlos.errors import ConfigError
from evnlos.optics.angular_spectrum import check_lengths
from evnlos.optics.view import View
from evnlos.optics.wall import checked_times

Array = NDArray[np.float64]


@njit(cache=True)
def _rim(ax: float, ay: float, bx: float, by: float, z: float) -> float:
    """Return gamma n_z of a level rim: the angle it subtends times the upright part of its plane's normal."""
    nx, ny, nz = z * (ay - by), z * (bx - ax), ax * by - ay * bx  # (a, z) x (b, z)
    across = math.sqrt(nx * nx + ny * ny + nz * nz)
    if across == 0.0:
        return 0.0
    return math.atan2(across, ax * bx + ay * by + z * z) * nz / across


@njit(cache=True)
def _add_rectangle(out: Array, points: Array, base: Array, low: float, high: float, radiance: float) -> None:
    """Add the irradiance of an upright rectangle behind the edge to floor points.

    E = L / 2 |sum of gamma n_z over the two horizontal rims|; upright sides add nothing to a level floor.

    Args:
        out: Irradiance [P], added to.
        points: Floor points (x, y) [P, 2], metres.
        base: The rectangle's two lower corners on the floor (x, y) [2, 2], y > 0, metres.
        low: Height of its lower rim, metres.
        high: Height of its upper rim, metres.
        radiance: Its radiance L, the same in all directions.
    """
    for p in range(len(points)):
        px, py = points[p, 0], points[p, 1]
        first, last = 0.0, 1.0
        if py < 0.0:  # seen where the way there meets the wall's line at x > 0
            f0 = px * base[0, 1] - py * base[0, 0]
            f1 = px * base[1, 1] - py * base[1, 0]
            if f0 <= 0.0 and f1 <= 0.0:
                continue
            if f0 < 0.0:
                first = f0 / (f0 - f1)
            elif f1 < 0.0:
                last = f0 / (f0 - f1)
        dx, dy = base[1, 0] - base[0, 0], base[1, 1] - base[0, 1]
        ax, ay = base[0, 0] + first * dx - px, base[0, 1] + first * dy - py
        bx, by = base[0, 0] + last * dx - px, base[0, 1] + last * dy - py
        out[p] += 0.5 * radiance * abs(_rim(ax, ay, bx, by, low) - _rim(ax, ay, bx, by, high))


def edge_irradiance(
    points_m: ArrayLike, base_m: ArrayLike, heights_m: tuple[float, float], radiance: float = 1.0
) -> Array:
    """Return the irradiance of a level floor by an upright Lambertian rectangle behind a wall's edge.

    The wall covers the negative x axis and is high. Exact for any distance: the edge cuts a rectangle into a
    narrower one, and that one has Lambert's closed form E = L / 2 |sum of gamma_i n_i . z| over its rims.

    Args:
        points_m: Floor points (x, y), [P, 2], metres; those with y < 0 look past the edge.
        base_m: Lower corners of the rectangle over the floor (x, y), [2, 2], metres, with y > 0.
        heights_m: Heights of its lower and upper rim, metres, 0 or more.
        radiance: Its radiance; the unit of the result is this times steradian.

    Returns:
        Irradiance, float64 [P].

    Raises:
        ConfigError: The rectangle is not behind the wall's line, or its heights do not ascend from 0.

    Example:
        A screen so high and wide that it fills a quarter of all bearings gives pi / 4, half of its bearings.

        >>> edge_irradiance([[0.0, -1.0]], [[1e-9, 1e-9], [1e4, 1e-9]], (0.0, 1e7)).round(3)
        array([0.785])
    """
    points, base = np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(base_m, np.float64)
    low, high = heights_m
    if not 0 <= low < high:
        raise ConfigError(f"heights_m is {heights_m}; give two heights that ascend from 0 m")
    if base.shape != (2, 2) or not base[:, 1].min() > 0:
        raise ConfigError("base_m must be two corners with y > 0, behind the wall's line, metres")
    if points.ndim != 2 or points.shape[1:] != (2,):
        raise ConfigError(f"points_m has shape {points.shape}; give [P, 2]")
    out = np.zeros(len(points))
    _add_rectangle(out, points, base, low, high, radiance)
    return out


def floor_bearing(points_m: ArrayLike) -> Array:
    """Return the bearing of floor points (x, y) [..., 2] about the edge, from the wall, radians, 0..2 pi.

    Args:
        points_m: Points of the floor (x, y) from the edge, metres, [..., 2].

    Example:
        >>> np.degrees(floor_bearing([[-1.0, -1e-9], [0.0, -1.0], [1.0, -1.0]])).round(1)
        array([  0.,  90., 135.])
    """
    x, y = np.moveaxis(np.asarray(points_m, np.float64), -1, 0)
    return np.mod(np.arctan2(-y, -x), 2 * np.pi)


@dataclass(frozen=True, eq=False)
class EdgeOperator:
    """The far operator: from light per bearing to the light of bins of the floor, and its adjoint.

    y_b = mean over theta in bin b of the integral from theta_0 to theta of x(phi) dphi, where x is constant in
    each bin. Light from before theta_0 is the same for all bins, and is not part of it.

    Args:
        edges: Ends of the bins of bearing, ascending, [B + 1], any unit of angle.

    Raises:
        ConfigError: Fewer than two bins, or ends that do not ascend.

    Example:
        >>> EdgeOperator(np.array([0.0, 1.0, 3.0])).forward(np.array([1.0, 1.0]))
        array([0.5, 2. ])
    """

    edges: Array

    def __post_init__(self) -> None:
        if np.ndim(self.edges) != 1 or len(self.edges) < 3 or not (np.diff(self.edges) > 0).all():
            raise ConfigError("the ends of the bins must ascend; give three or more")

    def forward(self, light: Array) -> Array:
        """Return the light of the bins, [..., B], of light per unit of bearing, [..., B]."""
        part = light * np.diff(self.edges)
        return np.cumsum(part, axis=-1) - 0.5 * part

    def adjoint(self, floor: Array) -> Array:
        """Return the transpose of `forward` applied to values of the bins, [..., B]."""
        after = np.cumsum(floor[..., ::-1], axis=-1)[..., ::-1]
        return (after - 0.5 * floor) * np.diff(self.edges)

    def matrix(self) -> Array:
        """Return the operator as a matrix [B, B]."""
        return self.forward(np.eye(len(self.edges) - 1)).T


def strip_response(edges: Array, middle: ArrayLike, width: float) -> Array:
    """Return what a strip of total light 1 behind the edge adds to bins of the floor: a ramp, then 1.

    Args:
        edges: Ends of the bins of bearing, [B + 1].
        middle: Bearing of the strip's middle, any shape [...], in the unit of `edges`.
        width: Width of the strip, more than 0.

    Returns:
        Means over the bins, [..., B].

    Example:
        >>> strip_response(np.array([0.0, 1.0, 2.0, 3.0]), 1.5, 1.0)
        array([0. , 0.5, 1. ])
    """
    start = np.asarray(middle, np.float64)[..., None] - width / 2
    into = np.clip(edges - start, 0, width)
    area = into * into / (2 * width) + np.clip(edges - start - width, 0, None)
    return np.diff(area, axis=-1) / np.diff(edges)


@dataclass(frozen=True)
class Walker:
    """Somebody who walks on the hidden side: an upright strip that faces the edge.

    Args:
        path: Time and place (seconds, x, y) of the corners of the way, times ascending, y > 0; straight between
            them, absent before the first and after the last.
        width_m: Width, metres.
        height_m: Height, metres.
        radiance: Radiance over that of what is behind, relative to other walkers'; negative is darker.
    """

    path: tuple[tuple[float, float, float], ...]
    width_m: float = 0.45
    height_m: float = 1.75
    radiance: float = 1.0

    def __post_init__(self) -> None:
        check_lengths(width_m=self.width_m, height_m=self.height_m)
        try:
            times, _, ys = zip(*((float(t), float(x), float(y)) for t, x, y in self.path), strict=True)
        except (TypeError, ValueError):
            times = ys = ()
        if len(times) < 2 or not all(before < after for before, after in pairwise(times)):
            raise ConfigError("a walker's path needs two or more (seconds, x, y) with ascending times")
        if not min(ys) > self.width_m:
            raise ConfigError(
                f"a walker's path reaches y = {min(ys):g} m; keep more than {self.width_m:g} m behind the wall"
            )

    def position_m(self, t_s: float) -> Array | None:
        """Return the place (x, y) at a time, metres; None before the way begins and after it ends."""
        knots = np.array(self.path, np.float64)
        if not knots[0, 0] <= t_s <= knots[-1, 0]:
            return None
        return np.array([np.interp(t_s, knots[:, 0], knots[:, k]) for k in (1, 2)])

    def bearing_rad(self, t_s: float) -> float:
        """Return the bearing about the edge from the wall's continuation, radians; NaN while absent."""
        place = self.position_m(t_s)
        return math.nan if place is None else math.atan2(place[1], place[0])

    def base_m(self, t_s: float) -> Array | None:
        """Return the two lower corners at a time, [2, 2], metres; None while absent."""
        place = self.position_m(t_s)
        if place is None:
            return None
        across = np.array([-place[1], place[0]]) / math.hypot(*place) * self.width_m / 2
        return np.stack([place - across, place + across])


ONE_WALKER = (Walker(((1.0, -2.4, 0.9), (9.0, 1.0, 2.6), (10.0, 1.0, 2.6), (19.0, -2.2, 1.4))),)
"""One person, there and back."""
TWO_WALKERS = (
    Walker(((1.0, -2.4, 0.9), (11.0, 1.4, 2.4), (19.0, -0.6, 2.6))),
    Walker(((4.0, 1.6, 1.9), (14.0, -2.0, 1.9), (18.0, -2.2, 1.2)), 0.4, 1.6, 0.8),
)
"""Two people whose bearings cross."""


@dataclass(frozen=True)
class CornerScene:
    """A corner that a camera on a tripod looks at, and who walks behind it.

    Axes: the floor is x, y; the wall stands on the negative x axis, its edge at the origin, z points up.

    Raises:
        ConfigError: A setting outside its range, or a camera that does not see the floor.
    """

    walkers: tuple[Walker, ...] = ONE_WALKER
    """Who walks on the hidden side."""
    contrast: float = 0.01
    """Largest change of the floor's light by the walkers, fraction of the steady light."""
    level: float = 0.45
    """Mean steady light of the floor in the image, fraction of white."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the image, pixels."""
    eye_m: tuple[float, float, float] = (-1.5, -0.9, 1.5)
    """Place of the pin-hole (x, y, z), metres."""
    aim_m: tuple[float, float] = (0.05, -0.25)
    """Floor point in the middle of the image (x, y), metres."""
    fov_deg: float = 40.0
    """Horizontal field of view, degrees."""
    texture: float = 0.15
    """Standard deviation of the floor's reflectance, fraction of the mean: tiles, stains and grain."""
    hidden_light: float = 0.3
    """Steady light from the hidden side, by a bright wall there, fraction of the light of this side."""
    slope: float = 0.2
    """Growth of this side's steady light with x, fraction per metre."""
    drift: float = 0.0
    """Amplitude of a slow swing of the exposure's gain (period 7 s), fraction."""
    shake_px: float = 0.0
    """Standard deviation of the camera's shake, pixels (a slow random swing)."""
    seed: int = 0
    """Seed of the floor's texture and of the shake."""

    def __post_init__(self) -> None:
        check_made(self)
        for name, low, high in (
            ("contrast", 0.0, 1.0),
            ("level", 1e-3, 1.0),
            ("texture", 0.0, 0.5),
            ("hidden_light", 0.0, 100.0),
            ("drift", 0.0, 0.5),
            ("shake_px", 0.0, 20.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"{name} is {getattr(self, name)}; give {low:g} to {high:g}")
        if not (self.eye_m[2] > 0 and self.eye_m[1] < 0):
            raise ConfigError(f"eye_m is {self.eye_m}; the camera stands at y < 0 and z > 0")
        if not 1 < self.fov_deg < 120:
            raise ConfigError(f"fov_deg is {self.fov_deg}; give 1 to 120 degrees")

    @property
    def view(self) -> View:
        """The camera's map between pixels and floor."""
        eye, aim = np.array(self.eye_m), np.array([*self.aim_m, 0.0])
        forward = (aim - eye) / np.linalg.norm(aim - eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        width, height = self.size
        slope = 2 * math.tan(math.radians(self.fov_deg) / 2) / width
        # Ray of pixel (u, v): forward + slope ((u - u0) right + (v - v0) down); it meets z = 0.
        rays = np.stack([slope * right, slope * down, forward], axis=1)
        rays[:, 2] -= rays[:, 0] * (width - 1) / 2 + rays[:, 1] * (height - 1) / 2
        matrix = np.stack([eye[k] * -rays[2] + eye[2] * rays[k] for k in (0, 1)] + [-rays[2]])
        rows = tuple((float(a), float(b), float(c)) for a, b, c in matrix)
        return View((height, width), (rows[0], rows[1], rows[2]), self.eye_m)

    def hidden_from_deg(self) -> float:
        """Return the bearing from which on the camera itself does not see the hidden side, degrees."""
        return float(np.degrees(floor_bearing(self.eye_m[:2])))

    def bearings_deg(self, t_s: ArrayLike) -> Array:
        """Return the true bearings of the walkers, [walkers, T], degrees; NaN while they are absent."""
        times = np.atleast_1d(np.asarray(t_s, np.float64))
        rows = [[math.degrees(walker.bearing_rad(t)) for t in times] for walker in self.walkers]
        return np.array(rows).reshape(len(self.walkers), len(times))


_FAR_WALL = np.array([[4.0, 4.0], [-4.0, 4.0]])  # the bright wall of the hidden side
_TILE_M, _GROUT_M = 0.3, 0.012
_WALL_LEVEL = 0.8  # of the occluding wall's face, relative to the floor's mean


@dataclass(eq=False)
class CornerFloor:
    """The camera's image of a `CornerScene` at every instant, before the sensor (an `Irradiance`).

    Args:
        scene: The scene.
    """

    scene: CornerScene
    speed_px_s: float = field(default=0.0, init=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.scene.size[1], self.scene.size[0]

    @cached_property
    def _points(self) -> Array:
        return self.scene.view.wall_points_m().numpy().reshape(-1, 2)

    @cached_property
    def _behind_wall(self) -> NDArray[np.bool_]:
        """Pixels that see the occluding wall instead of the floor."""
        x, y = self._points.T
        ex, ey, _ = self.scene.eye_m
        crossing = ex + (x - ex) * -ey / np.where(y > ey, y - ey, np.inf)
        return (y > 0) & (crossing < 0)

    @cached_property
    def steady(self) -> Array:
        """Steady light of the floor over its mean albedo, [P], in white levels."""
        light = 1 + self.scene.slope * self._points[:, 0]
        own = edge_irradiance(self._points, _FAR_WALL, (0.0, 2.5))
        full = edge_irradiance(np.array([[0.5, 0.0]]), _FAR_WALL, (0.0, 2.5))[0]
        light = np.maximum(light, 0.05) + self.scene.hidden_light * own / full
        return light * self.scene.level / light.mean()

    @cached_property
    def albedo(self) -> Array:
        """Reflectance of the floor over its mean, [P]: tiles with grout between them, stains and grain."""
        draw = np.random.default_rng(self.scene.seed)
        x, y = self._points.T
        tiles = draw.standard_normal((64, 64))
        i, j = (np.floor(v / _TILE_M).astype(int) % 64 for v in (x + 0.1, y + 0.05))
        value = 0.6 * tiles[i, j]
        for _ in range(24):
            length, turn, phase = np.exp(draw.uniform(-3.5, -1.5)), draw.uniform(0, np.pi), draw.uniform(0, 7)
            value += 0.2 * np.cos(2 * np.pi / length * (x * np.cos(turn) + y * np.sin(turn)) + phase)
        value += 0.3 * draw.standard_normal(len(x))
        grout = np.minimum((x + 0.1) % _TILE_M, (y + 0.05) % _TILE_M) < _GROUT_M
        return np.maximum(1 + self.scene.texture * (value - 1.5 * grout), 0.1)

    def walkers(self, t_s: float) -> Array:
        """Return the walkers' light on the floor at a time, [P], before it is scaled to the contrast."""
        light = np.zeros(len(self._points))
        for walker in self.scene.walkers:
            base = walker.base_m(t_s)
            if base is not None:
                _add_rectangle(light, self._points, base, 0.0, walker.height_m, walker.radiance)
        return light

    @cached_property
    def scale(self) -> float:
        """Radiance of a walker of radiance 1 that makes the floor's largest change the contrast."""
        seen = ~self._behind_wall & (self._points[:, 1] < 0)
        ends = [knot[0] for walker in self.scene.walkers for knot in walker.path]
        times = np.linspace(min(ends), max(ends), 41) if ends else np.empty(0)
        most = max((float((np.abs(self.walkers(t)) / self.steady)[seen].max()) for t in times), default=0.0)
        return self.scene.contrast / most if most else 0.0

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return the image at times `t_s` (seconds, [] or [T]), float32 [H, W] or [T, H, W], 1 = white."""
        times = checked_times(t_s)
        images = np.stack([self._image(float(t)) for t in np.atleast_1d(times)])
        found = torch.from_numpy(images.astype(np.float32))
        return found if np.ndim(t_s) else found[0]

    def _image(self, t_s: float) -> Array:
        light = self.albedo * (self.steady + self.scale * self.walkers(t_s))
        light[self._behind_wall] = _WALL_LEVEL * self.scene.level
        image = light.reshape(self.shape) * (1 + self.scene.drift * math.sin(2 * math.pi * t_s / 7))
        return image if self.scene.shake_px == 0 else _shifted(image, *self.shake(t_s))

    def shake(self, t_s: float) -> tuple[float, float]:
        """Return the image's shift (columns, rows) at a time, pixels: five swings between 0.2 and 2 Hz."""
        draw = np.random.default_rng([self.scene.seed, 1])
        rate, phase = draw.uniform(0.2, 2.0, (2, 5)), draw.uniform(0, 7, (2, 5))
        swing = np.cos(2 * np.pi * rate * t_s + phase).sum(axis=1) / math.sqrt(2.5)
        return self.scene.shake_px * float(swing[0]), self.scene.shake_px * float(swing[1])

    def marks(self) -> dict[str, list[float]]:
        """Return the pixels (column, row) that `evnlos corner` asks for: edge, wall, end and floor."""
        reach, tile = 0.7, 0.3  # of the floor that is used, and of what shows how it lies, metres
        last = math.radians(165)
        places = [(0.0, 0.0), (-reach, 0.0), (-reach * math.cos(last), -reach * math.sin(last))]
        places += [(-tile, -2 * tile), (tile, -2 * tile), (tile, 0.0), (-tile, 0.0)]
        found = self.scene.view.pixels(torch.tensor(places)).numpy().round(1)
        names = ("edge", "wall", "end")
        marks = {name: point.tolist() for name, point in zip(names, found, strict=False)}
        return marks | {"floor": found[3:].ravel().tolist()}


def _shifted(image: Array, across: float, down: float) -> Array:
    """Return an image moved by a part of a pixel or more, bilinear, its border repeated."""
    for axis, shift in ((1, across), (0, down)):
        whole = math.floor(shift)
        part = shift - whole
        index = np.arange(image.shape[axis]) - whole
        near, far = (np.clip(index - k, 0, image.shape[axis] - 1) for k in (0, 1))
        image = (1 - part) * np.take(image, near, axis) + part * np.take(image, far, axis)
    return image
