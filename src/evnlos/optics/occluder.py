"""Things in the room beside target and wall: opaque polygons, and a lamp.

- Opaque planar polygons between the target and the wall, and exact visibility past them.
- A target that shines because a torch lights it: the first of two bounces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from evnlos.errors import ConfigError
from evnlos.optics.view import View
from evnlos.types import Plane

Point3 = tuple[float, float, float]


@dataclass(frozen=True)
class Occluder:
    """An opaque, flat polygon; it need not be convex, but its border must not cross itself.

    Args:
        vertices_m: Corners (x, y, z) in order, metres; x and y over the wall, z from the wall towards the
            target.

    Raises:
        ConfigError: Fewer than three corners, corners that are not finite or not in one plane, or a corner that
            lies in or behind the wall.

    Example:
        >>> len(Occluder.post(0.0, 0.15, 0.016).vertices_m)
        4
    """

    vertices_m: tuple[Point3, ...]

    def __post_init__(self) -> None:
        if len(self.vertices_m) < 3:
            raise ConfigError(f"an occluder has {len(self.vertices_m)} corners; give 3 or more")
        corners = torch.tensor(self.vertices_m, dtype=torch.float64)
        if corners.shape[1:] != (3,) or not bool(torch.isfinite(corners).all()):
            raise ConfigError("an occluder's corners must be finite (x, y, z), metres")
        nearest = float(corners[:, 2].min())
        if nearest <= 0:
            raise ConfigError(
                f"an occluder reaches z = {nearest:g} m and crosses the wall; keep it in front (z > 0)"
            )
        # The smallest singular value about the middle is the distance out of the plane.
        spread = torch.linalg.svdvals(corners - corners.mean(dim=0))
        if len(self.vertices_m) > 3 and float(spread[2]) > 1e-6 * float(spread[0]) + 1e-12:
            raise ConfigError(f"an occluder's corners lie {float(spread[2]):g} m out of one plane; split it")

    @classmethod
    def post(cls, x_m: float, z_m: float, width_m: float, height_m: float = 10.0) -> Occluder:
        """Return an upright post that is parallel to the wall.

        Args:
            x_m: Its middle, metres.
            z_m: Its distance from the wall, metres.
            width_m: Its width, metres, above 0.
            height_m: Its height, metres; the default reaches far above and below the scene.
        """
        if not (math.isfinite(width_m) and width_m > 0):
            raise ConfigError(f"width_m is {width_m}; give a positive number of metres")
        w, h = width_m / 2, height_m / 2
        return cls(((x_m - w, -h, z_m), (x_m + w, -h, z_m), (x_m + w, h, z_m), (x_m - w, h, z_m)))


def check_between(occluders: Sequence[Occluder], distance_m: float) -> None:
    """Refuse occluders that reach the target's plane at `distance_m` from the wall."""
    for occluder in occluders:
        farthest = max(z for _, _, z in occluder.vertices_m)
        if farthest >= distance_m:
            raise ConfigError(
                f"an occluder reaches z = {farthest:g} m and the target's plane at {distance_m:g} m; "
                "keep it nearer to the wall"
            )


def visibility(
    wall_m: torch.Tensor, x_m: torch.Tensor, y_m: torch.Tensor, distance_m: float, occluders: Sequence[Occluder]
) -> torch.Tensor:
    """Return where the line from a wall point to a target point passes no occluder: the slow, obvious form.

    Each polygon is projected from the wall point onto the target's plane, where an even-odd count of crossed
    edges decides whether the target point lies inside.

    Args:
        wall_m: Wall points (x, y), [P, 2], metres.
        x_m: x of the target points, [C], metres.
        y_m: y of the target points, [C], metres.
        distance_m: Distance from wall to target, metres.
        occluders: The polygons.

    Returns:
        Bool [P, C].
    """
    open_way = torch.ones(len(wall_m), len(x_m), dtype=torch.bool, device=wall_m.device)
    for occluder in occluders:
        corners = wall_m.new_tensor(occluder.vertices_m)  # [K, 3]
        stretch = distance_m / corners[:, 2]
        shadow = wall_m[:, None] + (corners[:, :2] - wall_m[:, None]) * stretch[:, None]  # [P, K, 2]
        inside = torch.zeros_like(open_way)
        for k in range(len(corners)):
            (x0, y0), (x1, y1) = (
                shadow[:, k - 1, :, None].unbind(1),
                shadow[:, k, :, None].unbind(1),
            )  # [P, 1] each
            crosses = (y0 > y_m) != (y1 > y_m)
            level = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)
            inside ^= crosses & (x_m < x0 + (y_m - y0) / level * (x1 - x0))
        open_way &= ~inside
    return open_way


def check_sight(view: View, occluders: Sequence[Occluder]) -> None:
    """Refuse occluders in the camera's line of sight: the matrix shades the way from target to wall only."""
    assert view.eye_m is not None  # a setup's view is a pin-hole
    x, y, z = (torch.tensor([value], dtype=torch.float64) for value in view.eye_m)
    before = [one for one in occluders if max(corner[2] for corner in one.vertices_m) < float(z)]
    hidden = ~visibility(view.wall_points_m().flatten(0, 1), x, y, float(z), before)
    if bool(hidden.any()):
        share = float(hidden.double().mean())
        raise ConfigError(
            f"an occluder hides the wall from {100 * share:.0f} % of the camera's pixels, which this model "
            "leaves out; move it towards the target or turn the camera"
        )


def lamp_radiance(
    source: Plane,
    distance_m: float,
    lamp_m: tuple[float, float, float],
    *,
    offset_m: tuple[float, float] = (0.0, 0.0),
    half_angle_deg: float = 20.0,
    albedo: float = 0.8,
    intensity: float = 1.0,
) -> torch.Tensor:
    """Return the radiance of a white target's cells in the beam of a torch.

    L = albedo / pi * I(angle) cos / r^2 with I(angle) = I cos^m(angle), m set by the half-power angle; the
    torch stays where it is and aims at the middle of the target's plane, which faces the wall. The result is
    the `emission` of `light_transport_matrix`: mask times emission is the target's radiosity in that light.

    Args:
        source: The target's plane.
        distance_m: Distance from wall to target, metres.
        lamp_m: The torch (x, y, z), metres, z from the wall and below `distance_m`.
        offset_m: Where the target plane's origin lies over the wall (x, y), metres.
        half_angle_deg: Angle from the axis at which the torch is half as bright, degrees, between 0 and 90.
        albedo: Reflected share of the target's white parts.
        intensity: Radiant intensity on the axis, W/sr.

    Returns:
        Radiance, float64 [h, w], W/(m^2 sr).

    Raises:
        ConfigError: The torch is behind the target's face, or the angle is out of range.

    Example:
        >>> lit = lamp_radiance(Plane(1, 3, 0.05), 0.5, (0.0, 0.0, 0.0))
        >>> bool(lit[0, 1] > lit[0, 0]), bool((lit[0, 0] - lit[0, 2]).abs() < 1e-12)
        (True, True)
    """
    height = distance_m - lamp_m[2]
    if not height > 0:
        raise ConfigError(
            f"lamp_m has z = {lamp_m[2]}; a target at {distance_m} m that faces the wall needs it below"
        )
    if not 0 < half_angle_deg < 90:
        raise ConfigError(f"half_angle_deg is {half_angle_deg}; give an angle between 0 and 90 degrees")
    exponent = math.log(0.5) / math.log(math.cos(math.radians(half_angle_deg)))
    dx = torch.as_tensor(source.x_m) + offset_m[0] - lamp_m[0]
    dy = (torch.as_tensor(source.y_m) + offset_m[1] - lamp_m[1])[:, None]
    r2 = dx * dx + dy * dy + height * height  # [h, w]
    ax = offset_m[0] + source.center_m[0] - lamp_m[0]
    ay = offset_m[1] + source.center_m[1] - lamp_m[1]
    axis = (dx * ax + dy * ay + height * height) / (r2 * (ax * ax + ay * ay + height * height)).sqrt()
    beam = intensity * axis.clamp(min=0) ** exponent
    return albedo / math.pi * beam * height / r2**1.5
