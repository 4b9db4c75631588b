"""Compiled loops over pairs of wall point and target cell for a wall whose facets' slopes have any density.

A wall whose facets have any density of slopes, bent a little, before a pin-hole camera that stands anywhere.

The wall reflects f(i, o) = P(h_x / h_z, h_y / h_z) G(i) G(o) / (4 cos_i cos_o cos_h^4) + albedo / pi, with h
the half vector in the wall's own frame, P the density of the facets' slopes and G Smith's masking: the
microfacet model (Cook and Torrance 1982; Walter et al. 2007) with P free instead of a formula. Fresnel's factor
of a metal varies by a few per cent up to 70 degrees and is part of P.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.optics.radiometric import STRICT, noted_rows, torchs_threads
from evnlos.types import Plane

Array = NDArray[np.float64]


class Seen(NamedTuple):
    """The wall points that some pixels see.

    Args:
        points: Places [P, 3], metres.
        frames: Two tangents and the normal at each, [P, 9].
        eyes: Direction to the pin-hole in that frame, [P, 3], unit vectors.
    """

    points: Array
    frames: Array
    eyes: Array

    def part(self, pixels: slice) -> Seen:
        """Return those of some of the pixels.

        Args:
            pixels: Which.
        """
        return Seen(self.points[pixels], self.frames[pixels], self.eyes[pixels])


class Cells(NamedTuple):
    """The cells of the target plane.

    Args:
        points: Their middles [Q, 3], metres.
        area: Area of one, m^2.
    """

    points: Array
    area: float


class SparseImages(NamedTuple):
    """Images of the target by their bright cells.

    Args:
        starts: Where each image's entries begin, and their end [N + 1].
        cell: Cell of each entry.
        light: Brightness of each entry.
    """

    starts: NDArray[np.int64]
    cell: NDArray[np.int64]
    light: Array

    @classmethod
    def of(cls, images: Array) -> SparseImages:
        """Return the bright cells of images [N, Q].

        Args:
            images: Brightness of each cell.
        """
        image, cell = np.nonzero(images)
        starts = np.searchsorted(image, np.arange(len(images) + 1)).astype(np.int64)
        return cls(starts, cell.astype(np.int64), images[image, cell].astype(np.float64))


class SlopeTable(NamedTuple):
    """A density of facet slopes: a quadratic B-spline of its logarithm over slopes stretched by asinh.

    Args:
        log_density: Coefficients [K, K], K odd; first axis x.
        scale: Slope at which the even spacing in the middle turns into a logarithmic one.
        step: Distance of the nodes in asinh(slope / scale).
        matte: Albedo of a matte wall that adds its light, 0 or more.
    """

    log_density: Array
    scale: float
    step: float
    matte: float = 0.0

    @classmethod
    def of_lobes(
        cls, alphas: Array, weights: Array, *, scale: float, step: float = 0.6, matte: float = 0.0
    ) -> SlopeTable:
        """Return the table of a sum of GGX lobes.

        Args:
            alphas: Roughness along x and y of each lobe [L, 2].
            weights: Their weights [L], 0 or more.
            scale: See the class.
            step: See the class.
            matte: See the class.
        """
        half = math.ceil(math.asinh(_LARGEST_SLOPE / scale) / step) + 1
        slopes = _slopes(np.arange(-half, half + 1, dtype=np.float64) * step, scale)
        x, y = slopes[..., 0], slopes[..., 1]
        density = np.full(x.shape, 1e-12)
        for (ax, ay), weight in zip(alphas, weights, strict=True):
            density += weight / (math.pi * ax * ay * (1 + (x / ax) ** 2 + (y / ay) ** 2) ** 2)
        return cls(np.log(density), scale, step, matte)

    @property
    def nodes(self) -> int:
        """Nodes a side."""
        return len(self.log_density)

    def density(self, slope_x: Array, slope_y: Array) -> Array:
        """Return the density at slopes [...], the slow reference of the compiled loops."""
        length = np.hypot(slope_x, slope_y)
        factor = np.where(
            length > 1e-9 * self.scale,
            np.arcsinh(length / self.scale) / np.maximum(length, 1e-300),
            1 / self.scale,
        )
        middle = (self.nodes - 1) / 2
        total = np.zeros(np.broadcast(slope_x, slope_y).shape)
        at = [np.clip(s * factor / self.step + middle, 1, self.nodes - 2) for s in (slope_x, slope_y)]
        for i in range(self.nodes):
            wx = _bump(at[0] - i)
            if not wx.any():
                continue
            for j in range(self.nodes):
                total += wx * _bump(at[1] - j) * self.log_density[i, j]
        return np.exp(total)

    def scaled(self, factor: float) -> SlopeTable:
        """Return the table of a wall that reflects `factor` times as much."""
        return self._replace(log_density=self.log_density + math.log(factor), matte=self.matte * factor)


@njit(cache=True, fastmath=STRICT, inline="always")
def _pair(seen: Seen, p: int, cells: Cells, q: int, masking: float):
    """Return slopes (x, y) of the half vector, the facets' factor but for their density, the matte one."""
    point, frame, eye, cell = seen.points[p], seen.frames[p], seen.eyes[p], cells.points[q]
    dx, dy, dz = cell[0] - point[0], cell[1] - point[1], cell[2] - point[2]
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
    viewed = 2.0 / (1.0 + math.sqrt(1.0 + masking * masking * (1.0 - eye[2] * eye[2]) / (eye[2] * eye[2])))
    lit = 2.0 / (1.0 + math.sqrt(1.0 + masking * masking * (1.0 - iz * iz) / (iz * iz)))
    # f cos_i = D G / (4 cos_o), and D = P(slopes) / cos^4 of the half vector.
    return sx, sy, viewed * lit * bent * bent / (4.0 * eye[2]) * fall, iz * fall / math.pi


@njit(cache=True, fastmath=STRICT, inline="always")
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


@njit(cache=True, fastmath=STRICT, inline="always")
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


@njit(cache=True, fastmath=STRICT, parallel=True)
def fill_facets(out: NDArray, seen: Seen, cells: Cells, table: SlopeTable, masking: float) -> None:
    """Fill the matrix from target cells to wall points of a wall with any density of facet slopes.

        out[p, q] = area (g exp(log P(s)) + matte d)

    with s the half vector's slopes of the pair, g what facets of density 1 would reflect, d a matte wall.

    Args:
        out: Matrix [P, Q], float32 or float64, overwritten.
        seen: Wall points [P].
        cells: Target cells [Q].
        table: log P, and the albedo `matte`.
        masking: Roughness of Smith's masking.
    """
    nodes = table.log_density.shape[0]
    for p in prange(out.shape[0]):
        for q in range(cells.points.shape[0]):
            sx, sy, glossy, dull = _pair(seen, p, cells, q, masking)
            a, b = _place(sx, sy, table.scale, table.step, nodes)
            out[p, q] = cells.area * (glossy * math.exp(_value(table.log_density, a, b)) + table.matte * dull)


@njit(cache=True, fastmath=STRICT, parallel=True)
def carry_facets(
    out: NDArray, seen: Seen, cells: Cells, table: SlopeTable, masking: float, images: SparseImages
) -> None:
    """Set what the wall points see of sparse images of the target: `fill_facets` times the images, [P, N].

        out[p, n] = sum over entries e of image n of A[p, cell(e)] light(e)

    Args:
        out: Light [P, N], overwritten.
        seen: See `fill_facets`, as the next three.
        cells: See there.
        table: See there.
        masking: See there.
        images: The images [N].
    """
    nodes = table.log_density.shape[0]
    for p in prange(out.shape[0]):
        row = np.empty(cells.points.shape[0])
        for q in range(cells.points.shape[0]):
            sx, sy, glossy, dull = _pair(seen, p, cells, q, masking)
            a, b = _place(sx, sy, table.scale, table.step, nodes)
            row[q] = cells.area * (glossy * math.exp(_value(table.log_density, a, b)) + table.matte * dull)
        for n in range(out.shape[1]):
            total = 0.0
            for e in range(images.starts[n], images.starts[n + 1]):
                total += row[images.cell[e]] * images.light[e]
            out[p, n] = total


@njit(cache=True, fastmath=STRICT, parallel=True)
def facet_slopes(
    out: NDArray,
    seen: Seen,
    cells: Cells,
    table: SlopeTable,
    masking: float,
    column: NDArray[np.int64],
    images: SparseImages,
) -> None:
    """Set the derivatives of `carry_facets` by the table's coefficients, and by the albedo in the last column.

        out[p, n, c] = sum over entries e, and coefficients k of column c, of area g exp(log P) B_k(s) light(e)

    with B_k(s) the B-spline of coefficient k at the slopes s of the pair of wall point and cell.

    Args:
        out: Derivatives [P, N, columns + 1], overwritten.
        seen: See `fill_facets`, as the next three.
        cells: See there.
        table: See there.
        masking: See there.
        column: Column of each coefficient [K, K]; coefficients that are the same number share one.
        images: The images [N].
    """
    nodes = table.log_density.shape[0]
    last = out.shape[2] - 1
    for p in prange(out.shape[0]):
        cell_count = cells.points.shape[0]
        row, dull_row = np.empty(cell_count), np.empty(cell_count)
        place = np.empty((cell_count, 2), np.int64)
        weight = np.empty((cell_count, 6))
        acc = np.empty(out.shape[2])
        for q in range(cell_count):
            sx, sy, glossy, dull = _pair(seen, p, cells, q, masking)
            a, b = _place(sx, sy, table.scale, table.step, nodes)
            row[q] = cells.area * glossy * math.exp(_value(table.log_density, a, b))
            dull_row[q] = cells.area * dull
            i, j = math.floor(a + 0.5), math.floor(b + 0.5)
            f, g = a - i, b - j
            place[q, 0], place[q, 1] = i - 1, j - 1
            weight[q, 0], weight[q, 1], weight[q, 2] = 0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2
            weight[q, 3], weight[q, 4], weight[q, 5] = 0.5 * (0.5 - g) ** 2, 0.75 - g * g, 0.5 * (0.5 + g) ** 2
        for n in range(out.shape[1]):
            acc[:] = 0.0
            for e in range(images.starts[n], images.starts[n + 1]):
                q = images.cell[e]
                value = row[q] * images.light[e]
                acc[last] += dull_row[q] * images.light[e]
                i, j = place[q, 0], place[q, 1]
                for m in range(3):
                    part = value * weight[q, m]
                    for k in range(3):
                        acc[column[i + m, j + k]] += part * weight[q, 3 + k]
            for c in range(out.shape[2]):
                out[p, n, c] = acc[c]


@njit(cache=True, fastmath=STRICT, parallel=True)
def carry_lobes(
    out: NDArray, seen: Seen, cells: Cells, alphas: Array, masking: float, images: SparseImages
) -> None:
    """Set what GGX walls of several roughnesses make of sparse images, and a matte wall last, [P, N, L + 1].

        P(s) = 1 / (pi a_x a_y (1 + (s_x / a_x)^2 + (s_y / a_y)^2)^2)  for the lobe of roughness (a_x, a_y)

    Args:
        out: Light, overwritten.
        seen: See `fill_facets`, as the next.
        cells: See there.
        alphas: Roughness along x and y of each lobe [L, 2].
        masking: See `fill_facets`.
        images: The images [N].
    """
    lobes = alphas.shape[0]
    for p in prange(out.shape[0]):
        rows = np.empty((cells.points.shape[0], lobes + 1))
        acc = np.empty(lobes + 1)
        for q in range(cells.points.shape[0]):
            sx, sy, glossy, dull = _pair(seen, p, cells, q, masking)
            for k in range(lobes):
                ax, ay = alphas[k, 0], alphas[k, 1]
                wide = 1.0 + (sx / ax) ** 2 + (sy / ay) ** 2
                rows[q, k] = cells.area * glossy / (math.pi * ax * ay * wide * wide)
            rows[q, lobes] = cells.area * dull
        for n in range(out.shape[1]):
            acc[:] = 0.0
            for e in range(images.starts[n], images.starts[n + 1]):
                for k in range(lobes + 1):
                    acc[k] += rows[images.cell[e], k] * images.light[e]
            for k in range(lobes + 1):
                out[p, n, k] = acc[k]


MASKING = 0.15
"""Roughness of Smith's masking: a factor so smooth that the slopes' density makes up for another one."""
_LARGEST_SLOPE = 1.0


@dataclass(frozen=True)
class Pose:
    """Where camera, wall and target are; the origin is the wall's point that the camera looks at.

    Args:
        camera_distance_m: From the pin-hole to the origin, metres.
        camera_angle_deg: Angle of the optical axis to the wall's normal, towards +x, degrees.
        camera_elevation_deg: The same towards +y, degrees.
        camera_roll_deg: Turn of the camera about its axis, degrees.
        field_of_view_deg: Horizontal field of view, degrees.
        distortion: Relative growth of a ray's tangent at the image's left and right border (barrel above 0).
        distance_m: From the wall's plane to the middle of the travel, metres.
        target_offset_m: The middle of the travel over the wall (x, y), metres.
        travel_slope: Growth of the target's distance with x, metres per metre.
        curvature_per_m: Curvatures of the wall along x and y, 1 / metres; above 0 the borders come nearer.
    """

    camera_distance_m: float = 0.6
    camera_angle_deg: float = 30.0
    camera_elevation_deg: float = 0.0
    camera_roll_deg: float = 0.0
    field_of_view_deg: float = 30.0
    distortion: float = 0.0
    distance_m: float = 0.3
    target_offset_m: tuple[float, float] = (0.0, 0.0)
    travel_slope: float = 0.0
    curvature_per_m: tuple[float, float] = (0.0, 0.0)


def seen_points(
    pose: Pose,
    shape: tuple[int, int],
    columns: Array,
    rows: Array,
    pixel_aspect: float = 1.0,
    tilt: Array | None = None,
) -> Seen:
    """Return the wall points that a camera sees at given places of its image.

    The wall is z = (c_x x^2 + c_y y^2) / 2, with c its curvatures; the ray meets it after three Newton steps
    from the plane.

    Args:
        pose: Camera and wall.
        shape: Size (H, W) of the camera image, pixels.
        columns: Columns of the places [P], pixels; pixel centres are whole numbers.
        rows: Their rows [P].
        pixel_aspect: Height of a pixel over its width.
        tilt: Slopes of the wall along x and y at each place, beside those of its curvatures, [P, 2].

    Raises:
        ConfigError: Some of the pixels do not see the wall.
    """
    height, width = shape
    slope = 2 * math.tan(math.radians(pose.field_of_view_deg) / 2) / width
    p, q = (columns - (width - 1) / 2) * slope, (rows - (height - 1) / 2) * (slope * pixel_aspect)
    grown = 1 + pose.distortion * (p * p + q * q) / (slope * width / 2) ** 2
    p, q = p * grown, q * grown
    roll = math.radians(pose.camera_roll_deg)
    p, q = p * math.cos(roll) - q * math.sin(roll), p * math.sin(roll) + q * math.cos(roll)
    angle, rise = math.radians(pose.camera_angle_deg), math.radians(pose.camera_elevation_deg)
    c, s, ce, se = math.cos(angle), math.sin(angle), math.cos(rise), math.sin(rise)
    axis = np.array([s * ce, se, c * ce])  # from the wall to the pin-hole
    eye = pose.camera_distance_m * axis
    right, down = np.array([c, 0.0, -s]), np.array([-s * se, ce, -c * se])
    ray = p[:, None] * right + q[:, None] * down - axis
    if float(ray[:, 2].max()) >= -1e-3:
        raise ConfigError(
            "part of the image does not see the wall; turn the camera towards it or narrow its view"
        )
    bend = np.array([*pose.curvature_per_m, 0.0])
    along = -eye[2] / ray[:, 2]
    for _ in range(3 if bend.any() else 0):
        at = eye + along[:, None] * ray
        gap = at[:, 2] - 0.5 * (at * at) @ bend
        along = along - gap / (ray[:, 2] - (at * ray) @ bend)
    points = eye + along[:, None] * ray
    tilt_x, tilt_y = bend[0] * points[:, 0], bend[1] * points[:, 1]
    if tilt is not None:
        tilt_x, tilt_y = tilt_x + tilt[:, 0], tilt_y + tilt[:, 1]
    normal = np.stack([-tilt_x, -tilt_y, np.ones_like(tilt_x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = np.stack([np.ones_like(tilt_x), np.zeros_like(tilt_x), tilt_x], axis=1)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normal, first), normal], axis=1)
    to_eye = eye - points
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    eyes = np.einsum("pij,pj->pi", frames, to_eye)
    return Seen(points, np.ascontiguousarray(frames.reshape(-1, 9)), eyes)


def target_cells(pose: Pose, plane: Plane) -> Cells:
    """Return the cells of a plane along the travel, [h w], row by row."""
    y, x = np.meshgrid(plane.y_m, plane.x_m, indexing="ij")
    x, y = x.ravel(), y.ravel()
    z = pose.distance_m + pose.travel_slope * x
    points = np.stack([x + pose.target_offset_m[0], y + pose.target_offset_m[1], z], axis=1)
    return Cells(points, plane.pitch_m**2)


def _slopes(stretched: Array, scale: float) -> Array:
    """Return the slopes [K, K, 2] of the nodes at stretched coordinates [K]."""
    a, b = np.meshgrid(stretched, stretched, indexing="ij")
    length = np.hypot(a, b)
    factor = np.where(length > 0, scale * np.sinh(length) / np.maximum(length, 1e-300), scale)
    return np.stack([a * factor, b * factor], axis=-1)


def _bump(t: Array) -> Array:
    """Return the quadratic B-spline at distances from its node."""
    t = np.abs(t)
    return np.where(t <= 0.5, 0.75 - t * t, np.where(t < 1.5, 0.5 * (1.5 - t) ** 2, 0.0))


def folded_columns(nodes: int) -> tuple[NDArray[np.int64], int]:
    """Return the column of each coefficient [K, K], the same for a slope and its opposite, and their number.

    A slope and its opposite are as frequent: a wall whose facets lean to one side is a wall that stands askew.
    """
    number = np.arange(nodes * nodes).reshape(nodes, nodes)
    first, column = np.unique(np.minimum(number, number[::-1, ::-1]), return_inverse=True)
    return column.reshape(nodes, nodes).astype(np.int64), len(first)


def second_differences(nodes: int, column: NDArray[np.int64], count: int) -> Array:
    """Return the second differences of a table by its columns, along both axes and across, [R, count]."""
    stencils = (
        {(-1, 0): 1.0, (0, 0): -2.0, (1, 0): 1.0},
        {(0, -1): 1.0, (0, 0): -2.0, (0, 1): 1.0},
        {(0, 0): 1.0, (1, 0): -1.0, (0, 1): -1.0, (1, 1): 1.0},
    )
    rows = []
    for stencil in stencils:
        for i, j in np.ndindex(nodes, nodes):
            places = {(i + di, j + dj): weight for (di, dj), weight in stencil.items()}
            if all(0 <= a < nodes and 0 <= b < nodes for a, b in places):
                row = np.zeros(count)
                for place, weight in places.items():
                    row[column[place]] += weight
                rows.append(row)
    return np.array(rows)


def facet_matrix(
    pose: Pose,
    table: SlopeTable,
    shape: tuple[int, int],
    source: Plane,
    dtype: type = np.float32,
    pixel_aspect: float = 1.0,
    tilt: Array | None = None,
) -> NDArray:
    """Return the matrix from the brightness of target cells to the light of camera pixels, [H W, h w].

    A[p, c] = f(i, o) cos_i cos_t / r^2 in the middle of pixel p, times the cell's area; see the module.

    Args:
        pose: Camera, wall and target.
        table: The wall's facets.
        shape: Size (H, W) of the camera image, pixels.
        source: Cells, in the coordinates of the target's motion.
        dtype: float32 or float64.
        pixel_aspect: Height of a pixel over its width.
        tilt: Slopes of the wall at each pixel, beside those of its curvatures, [H W, 2].
    """
    height, width = shape
    cells = target_cells(pose, source)
    out = np.zeros((height * width, len(cells.points)), dtype)
    rows, columns = np.meshgrid(
        np.arange(height, dtype=np.float64), np.arange(width, dtype=np.float64), indexing="ij"
    )
    seen = seen_points(pose, shape, columns.ravel(), rows.ravel(), pixel_aspect, tilt)
    with torchs_threads():
        for here in noted_rows(len(out)):
            fill_facets(out[here], seen.part(here), cells, table, MASKING)
    return out
