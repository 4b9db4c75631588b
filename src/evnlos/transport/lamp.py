"""A target that shines because a torch lights it: the first of two bounces."""

from __future__ import annotations

import math

import torch

from evnlos.errors import ConfigError
from evnlos.types import Plane


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
