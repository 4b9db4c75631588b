"""The compiled loop that fills a light-transport matrix on the CPU; `radiometric` holds the slow reference."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numba import config, njit, prange, set_num_threads
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ends = NDArray[np.int64]


@njit(cache=True, fastmath=True, inline="always")
def _fresnel(cosine: float, n: float, k: float) -> float:
    c2 = cosine * cosine
    s2 = 1.0 - c2
    eta = n * n - k * k - s2
    both = math.sqrt(eta * eta + 4.0 * n * n * k * k)
    a = math.sqrt(0.5 * (both + eta))
    across = (both + c2 - 2.0 * a * cosine) / (both + c2 + 2.0 * a * cosine)
    along = (
        across * (c2 * both + s2 * s2 - 2.0 * a * cosine * s2) / (c2 * both + s2 * s2 + 2.0 * a * cosine * s2)
    )
    return 0.5 * (across + along)


@njit(cache=True, fastmath=True)
def _metal_row(value: Array, dx: Array, dy: float, z: float, eye: Array, metal: Array) -> None:
    """Set f cos cos / r^2 of a rough metal for one wall point and one row of target points."""
    ax, ay, n, k = metal[0], metal[1], metal[2], metal[3]
    ox, oy, oz = eye[0], eye[1], eye[2]
    seen = 2.0 / (1.0 + math.sqrt(1.0 + ((ax * ox) ** 2 + (ay * oy) ** 2) / (oz * oz)))
    # 1 / (4 cos i cos o) loses its cos i to one of the two cosines of the geometry.
    scale = seen / (4.0 * oz * math.pi * ax * ay)
    for c in range(value.size):
        r2 = dx[c] * dx[c] + dy * dy + z * z
        inverse = 1.0 / math.sqrt(r2)
        ix, iy, iz = dx[c] * inverse, dy * inverse, z * inverse
        hx, hy, hz = ix + ox, iy + oy, iz + oz
        squared = hx * hx + hy * hy + hz * hz
        stretched = (hx / ax) ** 2 + (hy / ay) ** 2 + hz * hz
        distribution = (squared / stretched) ** 2
        masking = 2.0 / (1.0 + math.sqrt(1.0 + ((ax * ix) ** 2 + (ay * iy) ** 2) / (iz * iz)))
        value[c] = scale * distribution * masking * _fresnel(0.5 * math.sqrt(squared), n, k) * iz / r2


@njit(cache=True, fastmath=True)
def _matte_row(value: Array, dx: Array, dy: float, z: float, albedo: float) -> None:
    """Set f cos cos / r^2 of a matte wall for one wall point and one row of target points."""
    scale = albedo / math.pi * z * z
    for c in range(value.size):
        r2 = dx[c] * dx[c] + dy * dy + z * z
        value[c] = scale / (r2 * r2)


@njit(cache=True)
def _project(shadow: Array, corners: Array, wx: float, wy: float, z: float) -> None:
    """Set the corners' projections [2, K] from a wall point onto the target's plane."""
    for k in range(corners.shape[0]):
        stretch = z / corners[k, 2]
        shadow[0, k] = wx + (corners[k, 0] - wx) * stretch
        shadow[1, k] = wy + (corners[k, 1] - wy) * stretch


@njit(cache=True)
def _hide_row(value: Array, x: Array, y: float, shadow: Array, ends: Ends) -> None:
    """Zero the target points of one row that lie in the shadows: between crossed edges, counted even-odd."""
    first = 0
    inside = np.empty(x.size, np.bool_)
    for end in ends:
        touched = False
        before = end - 1
        for k in range(first, end):
            y0, y1 = shadow[1, before], shadow[1, k]
            if (y0 > y) != (y1 > y):
                if not touched:
                    touched = True
                    inside[:] = False
                crossing = shadow[0, before] + (y - y0) / (y1 - y0) * (shadow[0, k] - shadow[0, before])
                for c in range(x.size):
                    inside[c] ^= x[c] < crossing
            before = k
        if touched:
            for c in range(x.size):
                if inside[c]:
                    value[c] = 0.0
        first = end


@contextmanager
def torchs_threads() -> Iterator[None]:
    """Let numba use as many threads as torch does, and leave torch as many as it had.

    Both share OpenMP's pool. Numba starts it with a thread for each core and makes that the number of the whole
    process; where torch was told to use fewer, because other processes keep the cores busy, its threads would
    then wait for each other at every operation: a hundred times slower for small matrices.
    """
    threads = torch.get_num_threads()
    set_num_threads(min(threads, config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@njit(cache=True, parallel=True)
def fill_matrix(
    out: NDArray,
    wall: Array,
    wall_weight: Array,
    target_x: Array,
    target_y: Array,
    target_weight: Array,
    emission: Array,
    distance_m: float,
    eye: Array,
    metal: Array,
    albedo: float,
    exponent: Array,
    corners: Array,
    ends: Ends,
) -> None:
    """Fill the matrix row by row; rows are independent, so any number of threads gives the same numbers.

    Args:
        out: Matrix [P, h w], float32 or float64, overwritten.
        wall: Wall points, [S, P, 2], metres: S quadrature points for each of P pixels.
        wall_weight: Their weights [S].
        target_x: x of the target points [q, w], metres: q quadrature points along each of w columns.
        target_y: y of the target points [q, h], metres.
        target_weight: Weights of the quadrature points [q] along either axis.
        emission: Radiance times area of each cell [h w].
        distance_m: Distance from wall to target, metres.
        eye: Pin-hole (x, y, z), metres.
        metal: (alpha x, alpha y, n, k) of a rough metal; alpha x = 0 asks for the matte wall.
        albedo: Albedo of the matte wall.
        exponent: Exponents of the emission's extra fall with the angle in x and y.
        corners: Corners of all occluders [K, 3], metres.
        ends: For each occluder, the index after its last corner.
    """
    width, height = target_x.shape[1], target_y.shape[1]
    for p in prange(out.shape[0]):
        total = np.zeros((height, width))
        value, dx, fall = np.empty(width), np.empty(width), np.ones(width)
        shadow = np.empty((2, corners.shape[0]))
        to_eye = np.empty(3)
        for s in range(wall.shape[0]):
            wx, wy = wall[s, p, 0], wall[s, p, 1]
            ex, ey, ez = eye[0] - wx, eye[1] - wy, eye[2]
            length = math.sqrt(ex * ex + ey * ey + ez * ez)
            to_eye[0], to_eye[1], to_eye[2] = ex / length, ey / length, ez / length
            _project(shadow, corners, wx, wy, distance_m)
            for i in range(target_x.shape[0]):
                for c in range(width):
                    dx[c] = target_x[i, c] - wx
                    if exponent[0] != 0.0:
                        fall[c] = (1.0 + (dx[c] / distance_m) ** 2) ** (-0.5 * exponent[0])
                for j in range(target_y.shape[0]):
                    share = wall_weight[s] * target_weight[i] * target_weight[j]
                    for r in range(height):
                        dy = target_y[j, r] - wy
                        if metal[0] > 0:
                            _metal_row(value, dx, dy, distance_m, to_eye, metal)
                        else:
                            _matte_row(value, dx, dy, distance_m, albedo)
                        if ends.size > 0:
                            _hide_row(value, target_x[i], target_y[j, r], shadow, ends)
                        part = share
                        if exponent[1] != 0.0:
                            part *= (1.0 + (dy / distance_m) ** 2) ** (-0.5 * exponent[1])
                        for c in range(width):
                            total[r, c] += part * fall[c] * value[c]
        for r in range(height):
            for c in range(width):
                out[p, r * width + c] = total[r, c] * emission[r * width + c]
