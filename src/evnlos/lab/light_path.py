"""The light path of a real setup: lens -> curved, textured wall -> target plane, as a matrix of throughputs.

Coordinates: x to the right, y downwards, z from the wall's middle into the room, metres. The wall is the
paraboloid z = -(c_x x^2 + c_y y^2) / 2, the target's plane is z = distance. A pixel averages `samples` rays,
each through another point of the pixel and of the lens: area, defocus and texture in one sum.

How the wall of a real setup reflects: a mixture of microfacet lobes that no single formula holds, and paint.

The lobes are densities over the slopes of the microfacets: P(u, v), u = h_x / h_z and v = h_y / h_z of the half
vector, with integral 1. The wall's BRDF is

    f(i, o) = k / pi + F(i . h) G(i, o, h) P(u, v) / (4 cos i cos o h_z^4),
    G = min(1, 2 cos h cos o / (o . h), 2 cos h cos i / (o . h))        (Torrance and Sparrow, JOSA 1967)
    F = F0 + (1 - F0) (1 - i . h)^5                                     (Schlick, 1994)

so that it is reciprocal and loses energy for any density whatever. Nothing here is shared with the simulator's
wall, which has one GGX lobe, Smith's masking and a metal's refractive index.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from evnlos.errors import ConfigError

Array = NDArray[np.float64]
STRICT = {"nnan", "ninf", "nsz", "contract"}  # sums in their order: compiled or cached, a kernel gives the same

_KINDS = ("ggx", "beckmann", "streak", "ring")
_RING_WIDTH = 0.3  # standard deviation of a ring's radius, in radii


@dataclass(frozen=True)
class Lobe:
    """One density of microfacet slopes."""

    shape: Literal["ggx", "beckmann", "streak", "ring"] = "ggx"
    """ggx: 1 / (pi (1 + r^2)^2); beckmann: e^(-r^2) / pi; streak: e^(-|u| - |v|) / 4, of which the contours are
    diamonds; ring: a Gaussian around radius 1. All in slopes divided by the widths."""
    weight: float = 1.0
    """Share of the mixture, 0 or more; the weights are divided by their sum."""
    width_x: float = 0.05
    """Width along the lobe's own x axis, slope, above 0."""
    width_y: float = 0.05
    """Width along its own y axis, slope, above 0."""
    turn_deg: float = 0.0
    """Turn of the lobe's axes from the wall's, degrees, from x towards y."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Mean slope (u, v): facets that lean to one side."""

    def __post_init__(self) -> None:
        if self.shape not in _KINDS:
            raise ConfigError(f"Lobe.shape is {self.shape!r}; give {', '.join(_KINDS)}")
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ConfigError(f"Lobe.weight is {self.weight}; give 0 or more")
        for name in ("width_x", "width_y"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"Lobe.{name} is {getattr(self, name)}; give a positive slope")


@dataclass(frozen=True)
class Reflection:
    """The reflection of a wall: lobes, and a matte part."""

    lobes: tuple[Lobe, ...] = (Lobe(),)
    """The mixture; () is a matte wall."""
    normal_reflectance: float = 0.91
    """Reflectance F0 of the facets at normal incidence, 0..1; 0.91 is aluminium."""
    matte: float = 0.02
    """Albedo of the matte part, 0..1."""

    def __post_init__(self) -> None:
        for name in ("normal_reflectance", "matte"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"Reflection.{name} is {getattr(self, name)}; give 0 to 1")
        if not self.lobes and not self.matte:
            raise ConfigError("Reflection.lobes is () and matte is 0: a black wall; give one of them")
        if self.lobes and not sum(lobe.weight for lobe in self.lobes) > 0:
            raise ConfigError("Reflection.lobes weigh 0 together; give one of them a weight")

    def table(self) -> Array:
        """Return what the compiled code takes: a row for each lobe [K, 8], then F0 and the matte albedo."""
        total = sum(lobe.weight for lobe in self.lobes) or 1.0
        rows = [
            (
                _KINDS.index(lobe.shape),
                lobe.weight / total * _scale(lobe.shape) / (lobe.width_x * lobe.width_y),
                1 / lobe.width_x,
                1 / lobe.width_y,
                math.cos(math.radians(lobe.turn_deg)),
                math.sin(math.radians(lobe.turn_deg)),
                *lobe.shift,
            )
            for lobe in self.lobes
        ]
        return np.array([*rows, (self.normal_reflectance, self.matte, 0, 0, 0, 0, 0, 0)], dtype=np.float64)

    def slopes(self, u: Array, v: Array) -> Array:
        """Return the density P over slopes `u` and `v` of any shape [...]."""
        u, v = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        table = self.table()
        flat = [slope_density(a, b, table) for a, b in zip(u.ravel(), v.ravel(), strict=True)]
        return np.array(flat).reshape(u.shape)

    def brdf(self, light: Array, eye: Array) -> Array:
        """Return f, 1/sr, of unit vectors away from the wall in its own frame, [..., 3] and [..., 3]."""
        light, eye = np.broadcast_arrays(np.asarray(light, np.float64), np.asarray(eye, np.float64))
        table = self.table()
        pairs = zip(light.reshape(-1, 3), eye.reshape(-1, 3), strict=True)
        flat = [reflected(i[0], i[1], i[2], o[0], o[1], o[2], table) / i[2] for i, o in pairs]
        return np.array(flat).reshape(light.shape[:-1])


def _scale(shape: str) -> float:
    """Return what makes the integral of a density over its scaled slopes 1."""
    if shape == "streak":
        return 1 / 4
    if shape == "ring":
        s = _RING_WIDTH
        # integral of r e^(-(r - 1)^2 / 2 s^2) over r > 0
        radial = s * s * math.exp(-0.5 / s**2) + s * math.sqrt(math.pi / 2) * (
            1 + math.erf(1 / (s * math.sqrt(2)))
        )
        return 1 / (2 * math.pi * radial)
    return 1 / math.pi


@njit(cache=True)
def slope_density(u: float, v: float, table: Array) -> float:
    """Return P(u, v) of the mixture; `table` as `Reflection.table` makes it."""
    total = 0.0
    for k in range(table.shape[0] - 1):
        du, dv = u - table[k, 6], v - table[k, 7]
        a = (du * table[k, 4] + dv * table[k, 5]) * table[k, 2]
        b = (dv * table[k, 4] - du * table[k, 5]) * table[k, 3]
        kind = table[k, 0]
        if kind == 0:
            one = 1.0 + a * a + b * b
            value = 1.0 / (one * one)
        elif kind == 1:
            value = math.exp(-a * a - b * b)
        elif kind == 2:
            value = math.exp(-abs(a) - abs(b))
        else:
            off = (math.sqrt(a * a + b * b) - 1.0) / _RING_WIDTH
            value = math.exp(-0.5 * off * off)
        total += table[k, 1] * value
    return total


@njit(cache=True, error_model="numpy", fastmath=STRICT)
def add_density(total: Array, factor: Array, u: Array, v: Array, lobe: Array) -> None:
    """Add factor P(u, v) of one lobe, a row of `Reflection.table`, to `total`: all four are [C]."""
    kind, scale = lobe[0], lobe[1]
    ax, ay = lobe[4] * lobe[2], lobe[5] * lobe[2]
    bx, by = -lobe[5] * lobe[3], lobe[4] * lobe[3]
    u0, v0 = lobe[6], lobe[7]
    if kind == 0:
        for c in range(total.size):
            a, b = (u[c] - u0) * ax + (v[c] - v0) * ay, (u[c] - u0) * bx + (v[c] - v0) * by
            one = 1.0 + a * a + b * b
            total[c] += factor[c] * scale / (one * one)
        return
    for c in range(total.size):
        a, b = (u[c] - u0) * ax + (v[c] - v0) * ay, (u[c] - u0) * bx + (v[c] - v0) * by
        if kind == 1:
            power = a * a + b * b
        elif kind == 2:
            power = abs(a) + abs(b)
        else:
            off = (math.sqrt(a * a + b * b) - 1.0) / _RING_WIDTH
            power = 0.5 * off * off
        total[c] += factor[c] * scale * math.exp(-power)


@njit(cache=True)
def reflected(ix: float, iy: float, iz: float, ox: float, oy: float, oz: float, table: Array) -> float:
    """Return f cos i for unit vectors in the wall's frame; 0 where one of them is behind the wall."""
    if iz <= 0.0 or oz <= 0.0:
        return 0.0
    last = table.shape[0] - 1
    value = table[last, 1] / math.pi * iz
    if last == 0:
        return value
    hx, hy, hz = ix + ox, iy + oy, iz + oz
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    density = slope_density(hx / hz, hy / hz, table)
    cos_h = hz / length
    cos_d = 0.5 * length  # i . h = o . h = |i + o| / 2
    masking = min(1.0, 2.0 * cos_h * min(iz, oz) / cos_d)
    miss = 1.0 - cos_d
    squared = miss * miss
    fresnel = table[last, 0] + (1.0 - table[last, 0]) * squared * squared * miss
    c2 = cos_h * cos_h
    return value + fresnel * masking * density / (4.0 * oz * c2 * c2)


class Rays(NamedTuple):
    """Where the rays of the pixels meet the wall, in which frame, and from where they are seen.

    Args:
        point: Points of the wall, [P, S, 3], metres.
        frame: Tangents along x and y, and normal, [P, S, 3, 3].
        eye: Unit vectors towards the lens, in that frame, [P, S, 3].
        share: Weights of the rays, [P, S]: their share of the pixel, texture and vignetting.
    """

    point: Array
    frame: Array
    eye: Array
    share: Array


@dataclass(frozen=True)
class Optics:
    """A camera before a curved wall.

    Args:
        shape: Size (H, W) of the image, pixels.
        distance_m: Distance from the lens to the wall's middle, metres.
        azimuth: Angle between the optical axis and the wall's normal about the vertical, radians; positive puts
            the camera at +x.
        elevation: Angle of the lens above the wall's middle, radians.
        roll: Turn of the camera about its axis, radians.
        fov: Horizontal field of view, radians.
        radial: Radial distortion of second and fourth power: share by which the corner's ray moves outwards.
        aperture_m: Diameter of the lens's opening, metres; 0 is a pin-hole.
        focus_m: Distance along the axis at which the camera is in focus, metres.
        falloff: Loss of light in the corners beside the cosine's fourth power, 0..1.
        curvature: Curvatures of the wall along x and y, 1/metre; positive bulges into the room.
        samples: Rays a pixel.
        pixel_aspect: Height of a pixel over its width.
    """

    shape: tuple[int, int]
    distance_m: float
    azimuth: float
    elevation: float
    roll: float
    fov: float
    radial: tuple[float, float]
    aperture_m: float
    focus_m: float
    falloff: float
    curvature: tuple[float, float]
    samples: int
    pixel_aspect: float = 1.0


def camera_axes(optics: Optics) -> tuple[Array, Array, Array, Array]:
    """Return the lens's place and the camera's forward, right and down vectors, [3] each."""
    sa, ca = math.sin(optics.azimuth), math.cos(optics.azimuth)
    se, ce = math.sin(optics.elevation), math.cos(optics.elevation)
    place = optics.distance_m * np.array([sa * ce, -se, ca * ce])
    forward = -place / optics.distance_m
    right = np.array([ca, 0.0, -sa])
    down = np.array([sa * se, ce, ca * se])  # at right angles to both; y grows downwards
    cr, sr = math.cos(optics.roll), math.sin(optics.roll)
    return place, forward, cr * right + sr * down, cr * down - sr * right


def cast(optics: Optics) -> Rays:
    """Return the rays of all pixels, row by row, with vignetting but without texture.

    Args:
        optics: Pixels, lens and pose of the camera.

    Raises:
        ConfigError: Part of the image does not see the wall.
    """
    height, width = optics.shape
    pixel, lens = _spread(optics.samples)
    place, forward, right, down = camera_axes(optics)
    tangent = 2 * math.tan(optics.fov / 2) / width
    rows, columns = np.divmod(np.arange(height * width), width)
    p = (columns[:, None] - (width - 1) / 2 + pixel[:, 0]) * tangent  # [P, S]
    tall = tangent * optics.pixel_aspect
    q = (rows[:, None] - (height - 1) / 2 + pixel[:, 1]) * tall
    r2 = (p * p + q * q) / (((width * tangent) ** 2 + (height * tall) ** 2) / 4)  # 1 in the corners
    stretch = 1 + optics.radial[0] * r2 + optics.radial[1] * r2 * r2
    p, q = p * stretch, q * stretch
    straight = forward + p[..., None] * right + q[..., None] * down  # [P, S, 3], of length 1 along the axis
    shift = optics.aperture_m / 2 * (lens[:, :1] * right + lens[:, 1:] * down)  # [S, 3]
    origin = place + shift
    ray = straight * optics.focus_m - shift
    point = _meet(origin, ray, optics.curvature)
    if not np.isfinite(point).all():
        raise ConfigError(
            "part of the image does not see the wall; turn the camera towards it or narrow its field of view"
        )
    cx, cy = optics.curvature
    along_x = np.zeros_like(point)
    along_x[..., 0], along_x[..., 2] = 1.0, -cx * point[..., 0]
    normal = np.stack([cx * point[..., 0], cy * point[..., 1], np.ones(point.shape[:-1])], axis=-1)
    along_x /= np.linalg.norm(along_x, axis=-1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along_y = np.cross(normal, along_x)
    frame = np.stack([along_x, along_y, normal], axis=-2)
    eye = origin - point
    eye /= np.linalg.norm(eye, axis=-1, keepdims=True)
    cos4 = (1 + p * p + q * q) ** -2.0
    share = cos4 * (1 - optics.falloff * r2) / optics.samples
    return Rays(point, frame, np.einsum("psij,psj->psi", frame, eye), share)


def _spread(samples: int) -> tuple[Array, Array]:
    """Return points of a pixel (-0.5..0.5) and of the unit disc, [S, 2] each: an additive recurrence."""
    k = np.arange(samples)[:, None]
    root = 1.1673039782614187  # the real root of x^5 = x + 1: the four-dimensional golden ratio
    steps = root ** -np.arange(1.0, 5.0)
    u = (0.5 + k * steps) % 1.0 if samples > 1 else np.full((1, 4), 0.5)
    radius, angle = (np.sqrt(u[:, 2]), 2 * np.pi * u[:, 3]) if samples > 1 else (np.zeros(1), np.zeros(1))
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    pixel, disc = u[:, :2] - 0.5, disc
    return pixel - pixel.mean(axis=0), disc - disc.mean(axis=0)


def _meet(origin: Array, ray: Array, curvature: tuple[float, float]) -> Array:
    """Return where rays [..., 3] from origins meet the paraboloid; not finite where they do not."""
    cx, cy = curvature
    a = (cx * ray[..., 0] ** 2 + cy * ray[..., 1] ** 2) / 2
    b = ray[..., 2] + cx * origin[..., 0] * ray[..., 0] + cy * origin[..., 1] * ray[..., 1]
    c = origin[..., 2] + (cx * origin[..., 0] ** 2 + cy * origin[..., 1] ** 2) / 2
    inside = b * b - 4 * a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        t = 2 * c / (-b + np.sqrt(inside))
        return origin + t[..., None] * ray


class LitCells(NamedTuple):
    """The cells of the target plane.

    Args:
        x_m: x of their centres [C], metres.
        y_m: y of their centres [C], metres.
        emission: Radiance times area of each cell [C].
        distance_m: z of the cells.
    """

    x_m: Array
    y_m: Array
    emission: Array
    distance_m: float


class _Scratch(NamedTuple):
    """Room for what one ray tells of each cell [C]: factors of facets and matte wall, and the slopes (u, v)."""

    facet: Array
    matte: Array
    u: Array
    v: Array


@njit(cache=True, error_model="numpy", fastmath=STRICT)
def _add_ray(
    total: Array, scratch: _Scratch, rays: Rays, p: int, s: int, cells: LitCells, table: Array, blockers: Array
) -> None:
    """Add share f(i, o) cos i cos t / r^2 of ray s of pixel p to `total` [C], cell by cell."""
    point, m, eye, share = rays.point[p, s], rays.frame[p, s], rays.eye[p, s], rays.share[p, s]
    facet, matte, u, v = scratch.facet, scratch.matte, scratch.u, scratch.v
    x_m, y_m = cells.x_m, cells.y_m
    last = table.shape[0] - 1
    dz = cells.distance_m - point[2]
    px, py = point[0], point[1]
    ox, oy, oz = eye[0], eye[1], eye[2]
    ax, ay, az = m[0, 0], m[0, 1], m[0, 2] * dz
    bx, by, bz = m[1, 0], m[1, 1], m[1, 2] * dz
    nx, ny, nz = m[2, 0], m[2, 1], m[2, 2] * dz
    f0, paint = table[last, 0], table[last, 1] / math.pi
    for c in range(total.size):
        dx, dy = x_m[c] - px, y_m[c] - py
        r2 = dx * dx + dy * dy + dz * dz
        inverse = 1.0 / math.sqrt(r2)
        ix, iy = (ax * dx + ay * dy + az) * inverse, (bx * dx + by * dy + bz) * inverse
        iz = max((nx * dx + ny * dy + nz) * inverse, 0.0)
        geometry = share * dz * inverse / r2
        hx, hy, hz = ix + ox, iy + oy, iz + oz
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        cos_h, cos_d = hz / length, 0.5 * length
        miss = 1.0 - cos_d
        fresnel = f0 + (1.0 - f0) * (miss * miss) * (miss * miss) * miss
        masking = min(1.0, 2.0 * cos_h * min(iz, oz) / cos_d)
        u[c], v[c] = hx / hz, hy / hz
        facet[c] = geometry * fresnel * masking / (4.0 * oz * (cos_h * cos_h) * (cos_h * cos_h))
        matte[c] = geometry * paint * iz
    for k in range(blockers.shape[0]):
        way = (blockers[k, 2] - point[2]) / dz
        for c in range(total.size):
            x = px + way * (x_m[c] - px) - blockers[k, 0]
            y = py + way * (y_m[c] - py) - blockers[k, 1]
            clear = 1.0 if x * x + y * y >= blockers[k, 3] * blockers[k, 3] else 0.0
            facet[c] *= clear
            matte[c] *= clear
    for c in range(total.size):
        total[c] += matte[c]
    for k in range(last):
        add_density(total, facet, u, v, table[k])


@njit(cache=True, parallel=True)
def fill_throughput(
    out: NDArray[np.float32], rays: Rays, cells: LitCells, table: Array, blockers: Array
) -> None:
    """Fill out [P, C] with the pixels' radiance for cells of brightness 1, ray by ray and cell by cell.

    out[p, c] = sum over rays s of share f(i, o) cos i cos t / r^2 emission; the cells' areas are in `emission`.

    Args:
        out: Overwritten.
        rays: Rays of the pixels [P].
        cells: Cells [C].
        table: As `Reflection.table` makes it.
        blockers: Opaque discs parallel to the wall [B, 4]: (x, y, z, radius), metres.
    """
    for p in prange(out.shape[0]):
        size = out.shape[1]
        total = np.zeros(size)
        scratch = _Scratch(np.empty(size), np.empty(size), np.empty(size), np.empty(size))
        for s in range(rays.point.shape[1]):
            _add_ray(total, scratch, rays, p, s, cells, table, blockers)
        for c in range(size):
            out[p, c] = total[c] * cells.emission[c]


def texture(x_m: Array, y_m: Array, seed: int, smooth: float, fine: float, grain: float) -> Array:
    """Return the wall's texture around 1 at points of any shape: a sum of random waves, the same everywhere.

    Args:
        x_m: x of the points, metres.
        y_m: y of the points, metres.
        seed: Seed of the waves.
        smooth: Standard deviation of the smooth part (waves of 40 to 120 mm).
        fine: Standard deviation of the fine part (waves of 4 to 12 mm).
        grain: How many times longer the fine waves are along x (brushed) than along y.
    """
    draw = np.random.default_rng(seed)
    value = np.ones(np.shape(x_m))
    for waves, low, high, deviation, stretch in (
        (12, 0.04, 0.12, smooth, 1.0),
        (48, 0.004, 0.012, fine, grain),
    ):
        length, turn, phase = _random_waves(draw, waves, low, high)
        for n in range(waves if deviation else 0):
            kx = 2 * np.pi / length[n] * np.cos(turn[n]) / stretch
            ky = 2 * np.pi / length[n] * np.sin(turn[n])
            value += deviation * np.sqrt(2 / waves) * np.cos(kx * x_m + ky * y_m + phase[n])
    return np.maximum(value, 0.05)


def _random_waves(
    draw: np.random.Generator, count: int, low_m: float, high_m: float
) -> tuple[Array, Array, Array]:
    """Return lengths between two, metres, directions and phases of waves, [count] each."""
    length = np.exp(draw.uniform(np.log(low_m), np.log(high_m), count))
    return length, *draw.uniform(0, 2 * np.pi, (2, count))


def waves(x_m: Array, y_m: Array, seed: int, deviation: float) -> Array:
    """Return the slopes dz/dx, dz/dy of an uneven wall at points of any shape, [..., 2]: a sum of waves.

    Args:
        x_m: x of the points, metres.
        y_m: y of the points, metres.
        seed: Seed of the waves.
        deviation: Standard deviation of either slope (waves of 8 to 60 mm).
    """
    draw, count = np.random.default_rng([seed, 1]), 24
    length, turn, phase = _random_waves(draw, count, 0.008, 0.06)
    slopes = np.zeros((*np.shape(x_m), 2))
    for n in range(count):
        way = np.array([np.cos(turn[n]), np.sin(turn[n])])
        along = 2 * np.pi / length[n] * (way[0] * x_m + way[1] * y_m) + phase[n]
        slopes += deviation * np.sqrt(4 / count) * np.cos(along)[..., None] * way
    return slopes


def tilted(rays: Rays, slopes: Array) -> Rays:
    """Return rays that meet a wall of further slopes; the height of its waves, micrometres, is left out.

    Args:
        rays: What the pixels see.
        slopes: dz/dx and dz/dy of the waves where they meet the wall, [P, S, 2].
    """
    eye = np.einsum("psij,psi->psj", rays.frame, rays.eye)
    normal = rays.frame[..., 2, :] / rays.frame[..., 2, 2:]
    normal = normal - np.concatenate([slopes, np.zeros_like(slopes[..., :1])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along_x = np.cross(np.array([0.0, 1.0, 0.0]), normal)
    along_x /= np.linalg.norm(along_x, axis=-1, keepdims=True)
    frame = np.stack([along_x, np.cross(normal, along_x), normal], axis=-2)
    return rays._replace(frame=frame, eye=np.einsum("psij,psj->psi", frame, eye))
