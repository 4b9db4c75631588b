"""The light-transport matrix from a self-luminous plane over a wall to a camera (paper Eq. 2-3)."""

from __future__ import annotations

import torch

from evnlos.errors import ConfigError
from evnlos.transport.angular_spectrum import check_lengths
from evnlos.transport.brdf import Brdf, Direction
from evnlos.transport.quadrature import gauss_points, points_for
from evnlos.transport.view import View
from evnlos.types import Plane

_CHUNK = 2**19  # pairs of wall point and target point evaluated at a time


def light_transport_matrix(
    view: View,
    source: Plane,
    distance_m: float,
    brdf: Brdf,
    *,
    offset_m: tuple[float, float] = (0.0, 0.0),
    points: tuple[int, int] | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> torch.Tensor:
    """Return the matrix from the radiance of target cells to the radiance of camera pixels.

    A[p, c] = mean over pixel p of integral over cell c of f(i, o) cos_w cos_t / r^2 dA, with f the wall's BRDF,
    r the distance, cos_w and cos_t the cosines at the wall and at the target, which is parallel to the wall,
    faces it and is a Lambertian emitter. Gauss-Legendre quadrature over cells and pixels, adapted to the width
    of the reflected lobe; nothing is random.

    Args:
        view: The camera's view with a known pin-hole (`View.perspective`).
        source: The target's plane; its coordinates are relative to `offset_m`.
        distance_m: Distance from wall to target, metres.
        brdf: How the wall reflects.
        offset_m: Where the target plane's origin lies over the wall (x, y), metres.
        points: Quadrature points a side of a (pixel, cell); None adapts them to the lobe.
        dtype: Floating-point type of the work and of the result.
        device: Device of the work and of the result.

    Returns:
        Matrix [H W, h w], without unit (radiance a radiance).

    Raises:
        ConfigError: The distance is not positive, or the view has no pin-hole.
    """
    check_lengths(distance_m=distance_m)
    if view.eye_m is None:
        raise ConfigError("the view has no pin-hole; build it with View.perspective")
    over_pixel, over_cell = points or quadrature_points(view, source, distance_m, brdf)
    targets = _cell_points(source, offset_m, over_cell, dtype, device)
    sub, area = gauss_points(over_pixel)
    cells = source.height * source.width
    matrix = torch.zeros(view.shape[0] * view.shape[1], cells, dtype=dtype, device=device)
    rows = max(1, _CHUNK // cells)
    for dv, wv in zip(sub, area, strict=True):
        for du, wu in zip(sub, area, strict=True):
            wall = view.wall_points_m(du, dv).reshape(-1, 2).to(dtype=dtype, device=device)  # [P, 2]
            for start in range(0, len(wall), rows):
                block = wall[start : start + rows]
                for (x, y), share in targets:
                    pair = _pair_throughput(block, x, y, distance_m, view.eye_m, brdf)
                    matrix[start : start + rows] += (wu * wv * share) * pair
    return matrix.mul_(source.pitch_m**2)


def quadrature_points(view: View, source: Plane, distance_m: float, brdf: Brdf) -> tuple[int, int]:
    """Return the Gauss points a side of a pixel and of a cell that resolve the reflected lobe and the falloff.

    A microfacet slope of alpha turns the ray by 2 alpha: 2 alpha r on the target, and on the wall the share of
    it that a move of the point makes, 2 alpha / (1/r + 1/R) with R the distance to the eye.
    """
    if view.eye_m is None:
        raise ConfigError("the view has no pin-hole; build it with View.perspective")
    eye = torch.tensor(view.eye_m).norm().item()
    pixel = float(view.pixel_size_m().max())
    # Without a lobe the falloff with r sets the scale: half the distance, as a standard deviation.
    on_target = min(2 * brdf.lobe * distance_m, distance_m / 2)
    on_wall = min(2 * brdf.lobe / (1 / distance_m + 1 / eye), distance_m / 2)
    return points_for(pixel, on_wall), points_for(source.pitch_m, on_target)


def _cell_points(
    source: Plane, offset_m: tuple[float, float], count: int, dtype: torch.dtype, device: torch.device | str
) -> list[tuple[tuple[torch.Tensor, torch.Tensor], float]]:
    """Return, for each quadrature point of a cell, its (x, y) in all cells [h w] and its weight."""
    sub, weight = gauss_points(count)
    found = []
    for dy, wy in zip(sub, weight, strict=True):
        for dx, wx in zip(sub, weight, strict=True):
            x = torch.as_tensor(source.x_m + offset_m[0] + dx * source.pitch_m).to(dtype=dtype, device=device)
            y = torch.as_tensor(source.y_m + offset_m[1] + dy * source.pitch_m).to(dtype=dtype, device=device)
            found.append(((x.repeat(source.height), y.repeat_interleave(source.width)), wx * wy))
    return found


def _pair_throughput(
    wall: torch.Tensor,
    x: torch.Tensor,
    y: torch.Tensor,
    distance_m: float,
    eye_m: tuple[float, float, float],
    brdf: Brdf,
) -> torch.Tensor:
    """Return f cos cos / r^2 [P, C] from target points (x, y) [C] over wall points [P, 2] to the eye."""
    dx, dy = x - wall[:, :1], y - wall[:, 1:]  # [P, C]
    r2 = dx * dx + dy * dy + distance_m**2
    inverse = r2.rsqrt()
    light: Direction = (dx * inverse, dy * inverse, distance_m * inverse)
    to_eye = torch.stack([eye_m[0] - wall[:, 0], eye_m[1] - wall[:, 1], torch.full_like(wall[:, 0], eye_m[2])])
    ex, ey, ez = (to_eye / to_eye.norm(dim=0))[:, :, None]  # three [P, 1]
    # Parallel planes: both cosines are distance / r.
    return brdf(light, (ex, ey, ez)) * light[2] * light[2] / r2
