"""Compiled loops over pairs of wall point and target cell for a wall whose facets' slopes have any density."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, fastmath=True, inline="always")
def _pair(point: Array, frame: Array, eye: Array, cx: float, cy: float, cz: float, masking: float):
    """Return slopes (x, y) of the half vector, the facets' factor but for their density, the matte one."""
    dx, dy, dz = cx - point[0], cy - point[1], cz - point[2]
    inverse2 = 1.0 / (dx * dx + dy * dy + dz * dz)
    inverse = math.sqrt(inverse2)
    ix = (dx * frame[0] + dy * frame[1] + dz * frame[2]) * inverse
    iy = (dx * frame[3] + dy * frame[4] + dz * frame[5]) * inverse
    iz = (dx * frame[6] + dy * frame[7] + dz * frame[8]) * inverse
    if iz <= 1e-3 or eye[2] <= 1e-3:
        return 0.0, 0.0, 0.0, 0.0
    fall = dz * inverse * inverse2  # cosine at the target over the squared distance
    hz = iz + eye[2]
    sx, sy = (ix + eye[0]) / hz, (iy + eye[1]) / hz
    bent = 1.0 + sx * sx + sy * sy
    seen = 2.0 / (1.0 + math.sqrt(1.0 + masking * masking * (1.0 - eye[2] * eye[2]) / (eye[2] * eye[2])))
    lit = 2.0 / (1.0 + math.sqrt(1.0 + masking * masking * (1.0 - iz * iz) / (iz * iz)))
    # f cos_i = D G / (4 cos_o), and D = P(slopes) / cos^4 of the half vector.
    return sx, sy, seen * lit * bent * bent / (4.0 * eye[2]) * fall, iz * fall / math.pi


@njit(cache=True, fastmath=True, inline="always")
def _place(sx: float, sy: float, scale: float, step: float, nodes: int):
    """Return the table's coordinates of a slope: its length is stretched by asinh, its direction is kept."""
    length = math.sqrt(sx * sx + sy * sy)
    ratio = length / scale
    factor = 1.0 / (scale * step)
    if ratio > 1e-4:
        factor = math.log(ratio + math.sqrt(1.0 + ratio * ratio)) / (length * step)
    middle = 0.5 * (nodes - 1)
    low, high = 1.0, nodes - 2.0
    a = min(max(sx * factor + middle, low), high)
    b = min(max(sy * factor + middle, low), high)
    return a, b


@njit(cache=True, fastmath=True, inline="always")
def _value(table: Array, a: float, b: float) -> float:
    """Return the quadratic B-spline with the table's coefficients."""
    i, j = math.floor(a + 0.5), math.floor(b + 0.5)
    f, g = a - i, b - j
    total = 0.0
    for m in range(3):
        wm = 0.75 - f * f if m == 1 else 0.5 * (0.5 + (m - 1) * f) ** 2
        for n in range(3):
            wn = 0.75 - g * g if n == 1 else 0.5 * (0.5 + (n - 1) * g) ** 2
            total += wm * wn * table[i + m - 1, j + n - 1]
    return total


@njit(cache=True, fastmath=True, parallel=True)
def fill_facets(
    out: NDArray,
    points: Array,
    frames: Array,
    eyes: Array,
    cells: Array,
    area: float,
    table: Array,
    scale: float,
    step: float,
    matte: float,
    masking: float,
) -> None:
    """Fill the matrix from target cells to wall points of a wall with any density of facet slopes.

    Args:
        out: Matrix [P, Q], float32 or float64, overwritten.
        points: Wall points [P, 3], metres.
        frames: The wall's tangents and normal there, rows of [P, 9].
        eyes: Directions to the eye in these frames [P, 3], unit vectors.
        cells: Target points [Q, 3], metres.
        area: Area of a cell, m^2.
        table: B-spline coefficients of the log density [K, K] (first axis: slope along x).
        scale: Slope at which the table's spacing turns from even to logarithmic.
        step: Distance of the nodes in asinh(slope / scale).
        matte: Albedo of a matte wall that adds its light.
        masking: Roughness of Smith's masking.
    """
    nodes = table.shape[0]
    for p in prange(out.shape[0]):
        for q in range(cells.shape[0]):
            sx, sy, glossy, dull = _pair(
                points[p], frames[p], eyes[p], cells[q, 0], cells[q, 1], cells[q, 2], masking
            )
            a, b = _place(sx, sy, scale, step, nodes)
            out[p, q] = area * (glossy * math.exp(_value(table, a, b)) + matte * dull)


@njit(cache=True, fastmath=True, parallel=True)
def carry_facets(
    out: NDArray,
    points: Array,
    frames: Array,
    eyes: Array,
    cells: Array,
    area: float,
    table: Array,
    scale: float,
    step: float,
    matte: float,
    masking: float,
    starts: NDArray[np.int64],
    index: NDArray[np.int64],
    light: Array,
) -> None:
    """Set what the wall points see of sparse pictures of the target: `fill_facets` times the pictures, [P, N].

    Args:
        out: Light [P, N], overwritten.
        points: See `fill_facets`, as the next nine.
        frames: See there.
        eyes: See there.
        cells: See there.
        area: See there.
        table: See there.
        scale: See there.
        step: See there.
        matte: See there.
        masking: See there.
        starts: Where each picture's entries begin, and their end [N + 1].
        index: Cell of each entry.
        light: Brightness of each entry.
    """
    nodes = table.shape[0]
    for p in prange(out.shape[0]):
        row = np.empty(cells.shape[0])
        for q in range(cells.shape[0]):
            sx, sy, glossy, dull = _pair(
                points[p], frames[p], eyes[p], cells[q, 0], cells[q, 1], cells[q, 2], masking
            )
            a, b = _place(sx, sy, scale, step, nodes)
            row[q] = area * (glossy * math.exp(_value(table, a, b)) + matte * dull)
        for n in range(out.shape[1]):
            total = 0.0
            for e in range(starts[n], starts[n + 1]):
                total += row[index[e]] * light[e]
            out[p, n] = total


@njit(cache=True, fastmath=True, parallel=True)
def facet_slopes(
    out: NDArray,
    points: Array,
    frames: Array,
    eyes: Array,
    cells: Array,
    area: float,
    table: Array,
    scale: float,
    step: float,
    masking: float,
    column: NDArray[np.int64],
    starts: NDArray[np.int64],
    index: NDArray[np.int64],
    light: Array,
) -> None:
    """Set the derivatives of `carry_facets` by the table's coefficients, and by the albedo in the last column.

    Args:
        out: Derivatives [P, N, columns + 1], overwritten.
        points: See `fill_facets`, as the next eight.
        frames: See there.
        eyes: See there.
        cells: See there.
        area: See there.
        table: See there.
        scale: See there.
        step: See there.
        masking: See there.
        column: Column of each coefficient [K, K]; coefficients that are the same number share one.
        starts: See `carry_facets`, as the next two.
        index: See there.
        light: See there.
    """
    nodes = table.shape[0]
    last = out.shape[2] - 1
    for p in prange(out.shape[0]):
        cell_count = cells.shape[0]
        row, dull_row = np.empty(cell_count), np.empty(cell_count)
        place = np.empty((cell_count, 2), np.int64)
        weight = np.empty((cell_count, 6))
        acc = np.empty(out.shape[2])
        for q in range(cell_count):
            sx, sy, glossy, dull = _pair(
                points[p], frames[p], eyes[p], cells[q, 0], cells[q, 1], cells[q, 2], masking
            )
            a, b = _place(sx, sy, scale, step, nodes)
            row[q] = area * glossy * math.exp(_value(table, a, b))
            dull_row[q] = area * dull
            i, j = math.floor(a + 0.5), math.floor(b + 0.5)
            f, g = a - i, b - j
            place[q, 0], place[q, 1] = i - 1, j - 1
            weight[q, 0], weight[q, 1], weight[q, 2] = 0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2
            weight[q, 3], weight[q, 4], weight[q, 5] = 0.5 * (0.5 - g) ** 2, 0.75 - g * g, 0.5 * (0.5 + g) ** 2
        for n in range(out.shape[1]):
            acc[:] = 0.0
            for e in range(starts[n], starts[n + 1]):
                q = index[e]
                value = row[q] * light[e]
                acc[last] += dull_row[q] * light[e]
                i, j = place[q, 0], place[q, 1]
                for m in range(3):
                    part = value * weight[q, m]
                    for k in range(3):
                        acc[column[i + m, j + k]] += part * weight[q, 3 + k]
            for c in range(out.shape[2]):
                out[p, n, c] = acc[c]


@njit(cache=True, fastmath=True, parallel=True)
def carry_lobes(
    out: NDArray,
    points: Array,
    frames: Array,
    eyes: Array,
    cells: Array,
    area: float,
    alphas: Array,
    masking: float,
    starts: NDArray[np.int64],
    index: NDArray[np.int64],
    light: Array,
) -> None:
    """Set what GGX walls of several roughnesses make of sparse pictures, and a matte wall last, [P, N, L + 1].

    Args:
        out: Light, overwritten.
        points: See `fill_facets`, as the next four.
        frames: See there.
        eyes: See there.
        cells: See there.
        area: See there.
        alphas: Roughness along x and y of each lobe [L, 2].
        masking: See `fill_facets`.
        starts: See `carry_facets`, as the next two.
        index: See there.
        light: See there.
    """
    lobes = alphas.shape[0]
    for p in prange(out.shape[0]):
        rows = np.empty((cells.shape[0], lobes + 1))
        acc = np.empty(lobes + 1)
        for q in range(cells.shape[0]):
            sx, sy, glossy, dull = _pair(
                points[p], frames[p], eyes[p], cells[q, 0], cells[q, 1], cells[q, 2], masking
            )
            for k in range(lobes):
                ax, ay = alphas[k, 0], alphas[k, 1]
                wide = 1.0 + (sx / ax) ** 2 + (sy / ay) ** 2
                rows[q, k] = area * glossy / (math.pi * ax * ay * wide * wide)
            rows[q, lobes] = area * dull
        for n in range(out.shape[1]):
            acc[:] = 0.0
            for e in range(starts[n], starts[n + 1]):
                for k in range(lobes + 1):
                    acc[k] += rows[index[e], k] * light[e]
            for k in range(lobes + 1):
                out[p, n, k] = acc[k]
