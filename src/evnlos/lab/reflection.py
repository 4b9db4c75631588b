"""How the wall of a real setup reflects: a mixture of microfacet lobes that no single formula holds, and paint.

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
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError

Array = NDArray[np.float64]

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


@njit(cache=True, fastmath=True)
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
