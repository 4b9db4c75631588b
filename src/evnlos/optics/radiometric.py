"""Light transport by radiometry: the matrix from a luminous plane over a wall to a camera (paper Eq. 2-3)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from numba import config, njit, prange, set_num_threads
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.machine import note
from evnlos.optics.angular_spectrum import check_lengths
from evnlos.optics.interpolation import gauss_points, points_for
from evnlos.optics.operator import Patches, as_patches
from evnlos.optics.reflection import GGX, Brdf, Direction, Lambert
from evnlos.optics.view import Occluder, View, check_between, visibility
from evnlos.types import Plane

Array = NDArray[np.float64]
Ends = NDArray[np.int64]

STRICT = {"nnan", "ninf", "nsz", "contract"}
"""What kernels take for granted: finite numbers, a zero without a sign. Sums stay in their order: else a
kernel that was compiled just now and the same from the cache would differ in their last bits."""


@njit(cache=True, fastmath=STRICT, error_model="numpy")
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


@njit(cache=True, fastmath=STRICT, error_model="numpy")
def _metal_row(value: Array, dx: Array, dy: float, z: float, eye: Array, metal: Array) -> None:
    """Set f cos cos / r^2 of a rough metal for one wall point and one row of target points."""
    ax, ay, n, k = metal[0], metal[1], metal[2], metal[3]
    ox, oy, oz = eye[0], eye[1], eye[2]
    seen = 2.0 / (1.0 + math.sqrt(1.0 + ((ax * ox) ** 2 + (ay * oy) ** 2) / (oz * oz)))
    # 1 / (4 cos i cos o) loses its cos i to one of the two cosines of the geometry.
    scale = 2.0 * z * seen / (4.0 * oz * math.pi * ax * ay)
    steep_x, steep_y = 1.0 / (ax * ax), 1.0 / (ay * ay)
    flat_x, flat_y = (ax / z) ** 2, (ay * dy / z) ** 2
    for c in range(value.size):
        square = dx[c] * dx[c]
        r2 = square + dy * dy + z * z
        inverse = 1.0 / math.sqrt(r2)
        hx, hy, hz = dx[c] * inverse + ox, dy * inverse + oy, z * inverse + oz
        squared = hx * hx + hy * hy + hz * hz
        ratio = squared / (hx * hx * steep_x + hy * hy * steep_y + hz * hz)  # its square is the distribution
        unmasked = 1.0 + math.sqrt(1.0 + square * flat_x + flat_y)
        value[c] = scale * ratio * ratio * _fresnel(0.5 * math.sqrt(squared), n, k) * inverse / (r2 * unmasked)


@njit(cache=True, fastmath=STRICT, error_model="numpy")
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


class LitWall(NamedTuple):
    """The wall and who looks at it.

    Args:
        points: Wall points, [S, P, 2], metres: S quadrature points for each of P pixels.
        weight: Their weights [S].
        eye: Pin-hole (x, y, z), metres.
        metal: (alpha x, alpha y, n, k) of a rough metal; alpha x = 0 asks for the matte wall.
        albedo: Albedo of the matte wall.
    """

    points: Array
    weight: Array
    eye: Array
    metal: Array
    albedo: float


class LightCells(NamedTuple):
    """The cells of the target plane, and what stands before it.

    Args:
        x: x of the target points [q, w], metres: q quadrature points along each of w columns.
        y: y of the target points [q, h], metres.
        weight: Weights of the quadrature points [q] along either axis.
        emission: Radiance times area of each cell [h w].
        exponent: Exponents of the emission's extra fall with the angle in x and y.
        distance_m: Distance from wall to target, metres.
        corners: Corners of all occluders [K, 3], metres.
        ends: For each occluder, the index after its last corner.
    """

    x: Array
    y: Array
    weight: Array
    emission: Array
    exponent: Array
    distance_m: float
    corners: Array
    ends: Ends


@njit(cache=True, parallel=True)
def fill_matrix(out: NDArray, wall: LitWall, cells: LightCells) -> None:
    """Fill the matrix row by row; rows are independent, so any number of threads gives the same numbers.

        out[p, c] = emission_c sum over points of pixel and cell of weights f cos cos / r^2 fall, where lit

    with f the wall's reflection, and fall what the emission has beyond Lambert's.

    Args:
        out: Matrix [P, h w], float32 or float64, overwritten.
        wall: Wall points of the pixels [P].
        cells: Cells [h w].
    """
    width, height, z = cells.x.shape[1], cells.y.shape[1], cells.distance_m
    eye, exponent = wall.eye, cells.exponent
    for p in prange(out.shape[0]):
        total = np.zeros((height, width))
        value, dx, fall = np.empty(width), np.empty(width), np.ones(width)
        shadow = np.empty((2, cells.corners.shape[0]))
        to_eye = np.empty(3)
        for s in range(wall.points.shape[0]):
            wx, wy = wall.points[s, p, 0], wall.points[s, p, 1]
            ex, ey, ez = eye[0] - wx, eye[1] - wy, eye[2]
            length = math.sqrt(ex * ex + ey * ey + ez * ez)
            to_eye[0], to_eye[1], to_eye[2] = ex / length, ey / length, ez / length
            _project(shadow, cells.corners, wx, wy, z)
            for i in range(cells.x.shape[0]):
                for c in range(width):
                    dx[c] = cells.x[i, c] - wx
                    if exponent[0] != 0.0:
                        fall[c] = (1.0 + (dx[c] / z) ** 2) ** (-0.5 * exponent[0])
                for j in range(cells.y.shape[0]):
                    share = wall.weight[s] * cells.weight[i] * cells.weight[j]
                    for r in range(height):
                        dy = cells.y[j, r] - wy
                        if wall.metal[0] > 0:
                            _metal_row(value, dx, dy, z, to_eye, wall.metal)
                        else:
                            _matte_row(value, dx, dy, z, wall.albedo)
                        if cells.ends.size > 0:
                            _hide_row(value, cells.x[i], cells.y[j, r], shadow, cells.ends)
                        part = share
                        if exponent[1] != 0.0:
                            part *= (1.0 + (dy / z) ** 2) ** (-0.5 * exponent[1])
                        for c in range(width):
                            total[r, c] += part * fall[c] * value[c]
        for r in range(height):
            for c in range(width):
                out[p, r * width + c] = total[r, c] * cells.emission[r * width + c]


_PARTS, _FEWEST = 16, 2048  # of a light path, so that progress moves; pixels of one: each costs a millisecond


def noted_rows(pixels: int) -> Iterator[slice]:
    """Yield the rows of a light path part by part, and note how many pixels are done.

    Args:
        pixels: How many there are.
    """
    size = max(_FEWEST, math.ceil(pixels / _PARTS))
    for start in range(0, pixels, size):
        note(f"light path, {start} of {pixels} pixels")
        yield slice(start, start + size)


_CHUNK = 2**19  # pairs of wall point and target point evaluated at a time
_POINTS_AT_A_SHADOW = 4  # a side of a cell when a shadow's edge may cut it

Scalar = float | torch.Tensor


def light_transport_matrix(
    seen: View | Plane | Patches,
    source: Plane | Patches,
    distance_m: Scalar,
    brdf: Brdf,
    *,
    offset_m: tuple[Scalar, Scalar] = (0.0, 0.0),
    occluders: Sequence[Occluder] = (),
    emission: torch.Tensor | None = None,
    emission_exponent: tuple[float, float] = (0.0, 0.0),
    points: tuple[int, int] | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
    compiled: bool | None = None,
) -> torch.Tensor:
    """Return the matrix from the brightness of target cells to the radiance of camera pixels.

    A[p, c] = mean over pixel p of integral over cell c of V f(i, o) cos_w cos_t / r^2 L dA, with f the wall's
    BRDF, r the distance, V the visibility, cos_w and cos_t the cosines at the wall and at the target, which is
    parallel to the wall and faces it, and L the radiance of a cell of brightness 1. Gauss-Legendre quadrature
    over cells and pixels, adapted to the width of the reflected lobe; nothing is random.

    Args:
        seen: The camera's view with a known pin-hole (`View.perspective`), or wall patches seen from
            anywhere (matte walls only).
        source: The target's plane or cells; its coordinates are relative to `offset_m`.
        distance_m: Distance from wall to target, metres; may be a tensor with a gradient.
        brdf: How the wall reflects; its parameters may be tensors with gradients.
        offset_m: Where the target plane's origin lies over the wall (x, y), metres; may be tensors with
            gradients.
        occluders: Opaque polygons between wall and target.
        emission: Radiance of each cell at brightness 1, [h, w]; None is 1 (see `lamp_radiance` for a lit
            target).
        emission_exponent: Extra fall of the emission, cos_x^a cos_y^b of its angles in the two axes; (0, 0) is
            Lambertian, screens have more.
        points: Quadrature points a side of a (pixel, cell); None adapts them to the lobe.
        dtype: Floating-point type of the result; what needs no gradient is computed in float64.
        device: Device of the result.
        compiled: Whether to use the compiled loop; None does so on the CPU when no gradient is requested.

    Returns:
        Matrix [H W, h w], without unit (radiance a radiance).

    Raises:
        ConfigError: The distance is not positive, the view has no pin-hole, or an occluder reaches the target.
    """
    distance = _number(distance_m)
    check_lengths(distance_m=distance)
    check_between(occluders, distance)
    eye = _eye(seen, brdf)
    over_pixel, over_cell = points or quadrature_points(seen, source, distance, brdf, occluders)
    if emission is not None and tuple(emission.shape) != source.shape:
        raise ConfigError(f"emission is {tuple(emission.shape)}; the target plane has {source.shape} cells")
    wall, wall_weight = _wall_points(seen, over_pixel)  # [S, P, 2], [S]
    differentiable = any(
        isinstance(value, torch.Tensor) and value.requires_grad
        for value in (distance_m, *offset_m, emission, *vars(brdf).values())
    )
    if compiled is None:
        compiled = torch.device(device).type == "cpu" and not differentiable and isinstance(brdf, Lambert | GGX)
    if compiled:
        cell_brightness = torch.ones(source.shape) if emission is None else emission
        matrix = torch.empty(wall.shape[1], source.height * source.width, dtype=dtype)
        _fill(
            matrix,
            wall,
            wall_weight,
            source,
            over_cell,
            cell_brightness,
            distance,
            offset_m,
            eye,
            brdf,
            emission_exponent,
            occluders,
        )
        return matrix.to(device)
    target, target_weight = _target_points(source, over_cell)  # [Q, 2, C], [Q]
    work = dtype if differentiable else torch.float64
    wall, target = wall.to(dtype=work, device=device), target.to(dtype=work, device=device)
    block_rows = max(1, _CHUNK // target.shape[-1])
    matrix = torch.empty(wall.shape[1], target.shape[-1], dtype=dtype, device=device)
    blocks = []
    for start in range(0, wall.shape[1], block_rows):
        patches = wall[:, start : start + block_rows]
        block = wall.new_zeros(patches.shape[1], target.shape[-1])
        for patch, share in zip(patches, wall_weight.tolist(), strict=True):
            for (x, y), part in zip(target, target_weight.tolist(), strict=True):
                pair = pair_throughput(
                    patch, x + offset_m[0], y + offset_m[1], distance_m, eye, brdf, emission_exponent
                )
                if occluders:
                    # Visibility is a step: it carries no gradient.
                    with torch.no_grad():
                        way = visibility(patch, x + offset_m[0], y + offset_m[1], distance, occluders)
                    pair = pair * way
                block = block + (share * part) * pair
        if differentiable:
            blocks.append(block)
        else:  # in place: at full resolution there may be no room for a copy
            matrix[start : start + len(block)] = block
    matrix = torch.cat(blocks) if differentiable else matrix
    return matrix if emission is None else matrix * emission.flatten().to(matrix)


def pair_throughput(
    wall_m: torch.Tensor,
    x_m: torch.Tensor,
    y_m: torch.Tensor,
    distance_m: Scalar,
    eye_m: tuple[Scalar, Scalar, Scalar],
    brdf: Brdf,
    emission_exponent: tuple[float, float] = (0.0, 0.0),
) -> torch.Tensor:
    """Return f cos cos / r^2 from target points over wall points to the eye: differentiable in everything.

    Args:
        wall_m: Wall points (x, y), [P, 2], metres.
        x_m: x of the target points, [C], metres.
        y_m: y of the target points, [C], metres.
        distance_m: Distance from wall to target, metres.
        eye_m: Pin-hole (x, y, z), metres.
        brdf: How the wall reflects.
        emission_exponent: Extra fall of the emission with its angle in both axes.

    Returns:
        Throughput [P, C], 1/m^2.
    """
    dx, dy = x_m - wall_m[:, :1], y_m - wall_m[:, 1:]  # [P, C]
    lateral = dx * dx + dy * dy
    r2 = lateral + distance_m * distance_m
    inverse = r2.rsqrt()
    light: Direction = (dx * inverse, dy * inverse, distance_m * inverse)
    ex, ey = eye_m[0] - wall_m[:, 0], eye_m[1] - wall_m[:, 1]
    ez = torch.zeros_like(ex) + eye_m[2]
    scale = (ex * ex + ey * ey + ez * ez).rsqrt()
    eye: Direction = ((ex * scale)[:, None], (ey * scale)[:, None], (ez * scale)[:, None])
    # Parallel planes: both cosines are distance / r.
    pair = brdf(light, eye) * light[2] * light[2] / r2
    for side, exponent in zip((dx, dy), emission_exponent, strict=True):
        if exponent:
            pair = pair * (1 + (side / distance_m) ** 2) ** (-exponent / 2)
    return pair


def quadrature_points(
    seen: View | Plane | Patches,
    source: Plane | Patches,
    distance_m: float,
    brdf: Brdf,
    occluders: Sequence[Occluder] = (),
) -> tuple[int, int]:
    """Return the Gauss points a side of a pixel and of a cell that resolve the reflected lobe and the falloff.

    A microfacet slope of alpha turns the ray by 2 alpha: 2 alpha r on the target, and on the wall the share of
    it that a move of the point makes, 2 alpha / (1/r + 1/R) with R the distance to the eye.
    """
    reach = torch.tensor(_eye(seen, brdf)).norm().item()
    pixel = float(seen.pixel_size_m().max()) if isinstance(seen, View) else max(as_patches(seen).size_m)
    cell = max(as_patches(source).size_m)
    # Without a lobe the falloff with r sets the scale: half the distance, as a standard deviation.
    on_target = min(2 * brdf.lobe * distance_m, distance_m / 2)
    on_wall = min(2 * brdf.lobe / (1 / distance_m + 1 / reach), distance_m / 2)
    over_pixel, over_cell = points_for(pixel, on_wall), points_for(cell, on_target)
    if occluders:
        # A cell's width already blurs a shadow's edge on the wall; coarse pixels need points of their own.
        over_pixel, over_cell = (
            max(over_pixel, 1 if pixel < cell / 2 else 2),
            max(over_cell, _POINTS_AT_A_SHADOW),
        )
    return over_pixel, over_cell


def _eye(seen: View | Plane | Patches, brdf: Brdf) -> tuple[float, float, float]:
    if isinstance(seen, View):
        if seen.eye_m is None:
            raise ConfigError("the view has no pin-hole; build it with View.perspective")
        return seen.eye_m
    if not isinstance(brdf, Lambert):
        raise ConfigError(
            f"a wall of {type(brdf).__name__} looks different from everywhere; give a View, not a Plane"
        )
    return (0.0, 0.0, 1.0)


def _number(value: Scalar) -> float:
    return float(value.detach()) if isinstance(value, torch.Tensor) else float(value)


def _wall_points(seen: View | Plane | Patches, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return wall points [S, P, 2], S = count^2 for each pixel, and their weights [S]."""
    sub, weight = gauss_points(count)
    if isinstance(seen, View):
        points = [seen.wall_points_m(du, dv).flatten(0, 1) for dv in sub for du in sub]
    else:
        patches = as_patches(seen)
        y, x = torch.tensor(patches.y_m)[:, None], torch.tensor(patches.x_m)
        flat = torch.stack(torch.broadcast_tensors(x, y), dim=-1).flatten(0, 1)
        size = flat.new_tensor(patches.size_m)
        points = [flat + flat.new_tensor([du, dv]) * size for dv in sub for du in sub]
    share = torch.tensor(weight, dtype=torch.float64)
    return torch.stack(points), torch.outer(share, share).flatten()


def _target_points(source: Plane | Patches, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return points [Q, 2, C], Q = count^2 a cell, and their weights [Q], which add up to its area."""
    points, weight = _wall_points(source, count)
    width, height = as_patches(source).size_m
    return points.mT.contiguous(), weight * (width * height)


def _fill(
    matrix: torch.Tensor,
    wall: torch.Tensor,
    wall_weight: torch.Tensor,
    source: Plane | Patches,
    over_cell: int,
    emission: torch.Tensor,
    distance_m: float,
    offset_m: tuple[Scalar, Scalar],
    eye_m: tuple[float, float, float],
    brdf: Brdf,
    exponent: tuple[float, float],
    occluders: Sequence[Occluder],
) -> None:
    """Fill `matrix` by the compiled loop."""
    metal, albedo = np.zeros(4), 0.0
    if isinstance(brdf, GGX):
        alpha_y = brdf.alpha if brdf.alpha_y is None else brdf.alpha_y
        metal = np.array([_number(value) for value in (brdf.alpha, alpha_y, brdf.n, brdf.k)])
    elif isinstance(brdf, Lambert):
        albedo = _number(brdf.albedo)
    patches = as_patches(source)
    sub, weight = (np.array(values) for values in gauss_points(over_cell))
    width, height = patches.size_m
    cells = LightCells(
        patches.x_m + _number(offset_m[0]) + sub[:, None] * width,
        patches.y_m + _number(offset_m[1]) + sub[:, None] * height,
        weight,
        emission.detach().flatten().double().numpy() * (width * height),
        np.array(exponent, dtype=np.float64),
        distance_m,
        np.array([corner for one in occluders for corner in one.vertices_m], np.float64).reshape(-1, 3),
        np.cumsum([len(one.vertices_m) for one in occluders], dtype=np.int64),
    )
    seen = LitWall(wall.numpy(), wall_weight.numpy(), np.array(eye_m), metal, albedo)
    with torchs_threads():
        for rows in noted_rows(len(matrix)):
            part = seen._replace(points=wall[:, rows].contiguous().numpy())
            fill_matrix(matrix.numpy()[rows], part, cells)
