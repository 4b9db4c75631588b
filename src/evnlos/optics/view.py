"""A camera's view of the wall, as a linear operator, and what stands in the room: opaque polygons, a torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from evnlos.errors import ConfigError
from evnlos.optics.operator import LinearTransport
from evnlos.types import Plane

Point3 = tuple[float, float, float]
Matrix3 = tuple[Point3, Point3, Point3]


@dataclass(frozen=True)
class View:
    """The projective map from camera pixels to the wall: (x, y, 1) ~ matrix (column, row, 1), metres.

    Args:
        shape: Size (H, W) of the camera image, pixels; pixel centres are at whole columns and rows.
        matrix: Homography from pixels to wall metres, row by row; x to the right and y downwards.
        eye_m: Place of the pin-hole (x, y, z), metres, z towards the camera; None when only the map matters.

    Raises:
        ConfigError: The image has no pixels, the map is singular, or part of the image does not see the wall.

    Example:
        >>> View.affine((100, 160), pixels_per_m=1000.0).wall_points_m()[0, 0]
        tensor([-0.0795, -0.0495], dtype=torch.float64)
    """

    shape: tuple[int, int]
    matrix: Matrix3
    eye_m: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        height, width = self.shape
        if height < 1 or width < 1:
            raise ConfigError(f"View.shape is {self.shape}; give at least 1 x 1 pixels")
        matrix = torch.tensor(self.matrix, dtype=torch.float64)
        if matrix.shape != (3, 3) or not bool(torch.isfinite(matrix).all()):
            raise ConfigError("View.matrix must be 3 x 3 finite numbers")
        if abs(float(torch.linalg.det(matrix / matrix.abs().amax(dim=1, keepdim=True)))) < 1e-14:
            raise ConfigError("View.matrix is singular; the camera sees the wall edge-on")
        corners = [(u, v, 1.0) for u in (-0.5, width - 0.5) for v in (-0.5, height - 0.5)]
        if float((torch.tensor(corners, dtype=torch.float64) @ matrix[2]).min()) <= 0:
            raise ConfigError(
                "part of the image does not see the wall; turn the camera towards it or narrow its view"
            )

    @classmethod
    def affine(
        cls,
        shape: tuple[int, int],
        pixels_per_m: float,
        rotation_rad: float = 0.0,
        shear: float = 0.0,
        stretch: float = 1.0,
        offset_px: tuple[float, float] = (0.0, 0.0),
        flip_x: bool = False,
        flip_y: bool = False,
        pixel_aspect: float = 1.0,
    ) -> View:
        """Return the view of a far camera: pixel = middle + offset + scale rotation shear stretch flip (x, y).

        Args:
            shape: Size (H, W), pixels.
            pixels_per_m: Magnification, pixels per metre of wall, above 0.
            rotation_rad: Turn of the image, radians, from x towards y (clockwise on the screen).
            shear: Columns that one row adds.
            stretch: Magnification along y divided by that along x, above 0.
            offset_px: Where the wall's origin falls, relative to the image's middle (columns, rows).
            flip_x: Whether x runs to the left.
            flip_y: Whether y runs upwards.
            pixel_aspect: Height of a pixel over its width.
        """
        if not (math.isfinite(pixels_per_m) and pixels_per_m > 0):
            raise ConfigError(f"pixels_per_m is {pixels_per_m}; give a positive number")
        if not stretch > 0:
            raise ConfigError(f"stretch is {stretch}; give a positive number")
        c, s = math.cos(rotation_rad), math.sin(rotation_rad)
        turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
        lean = torch.tensor([[1.0, shear], [0.0, stretch]], dtype=torch.float64)
        flip = torch.diag(torch.tensor([-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0], dtype=torch.float64))
        to_wall = torch.linalg.inv(pixels_per_m * turn @ lean @ flip) * flip.new_tensor([1.0, pixel_aspect])
        middle = to_wall.new_tensor([(shape[1] - 1) / 2 + offset_px[0], (shape[0] - 1) / 2 + offset_px[1]])
        (a, b), (d, e) = to_wall.tolist()
        tx, ty = (-to_wall @ middle).tolist()
        return cls((int(shape[0]), int(shape[1])), ((a, b, tx), (d, e, ty), (0.0, 0.0, 1.0)))

    @classmethod
    def perspective(
        cls,
        shape: tuple[int, int],
        distance_m: float,
        angle_rad: float,
        fov_rad: float,
        aim_m: tuple[float, float] = (0.0, 0.0),
        pixel_aspect: float = 1.0,
    ) -> View:
        """Return the view of a pin-hole camera that looks at a point of the wall, turned about the vertical.

        Args:
            shape: Size (H, W), pixels.
            distance_m: Distance from the pin-hole to the aimed point, metres, above 0.
            angle_rad: Angle between axis and the wall's normal, radians; positive puts the camera at +x.
            fov_rad: Horizontal field of view over W pixels, radians, 0 to pi.
            aim_m: The aimed point (x, y), metres.
            pixel_aspect: Height of a pixel over its width.
        """
        if not (math.isfinite(distance_m) and distance_m > 0):
            raise ConfigError(f"distance_m is {distance_m}; give a positive number of metres")
        if not abs(angle_rad) < math.pi / 2:
            raise ConfigError(f"angle_rad is {angle_rad}; the camera must stand before the wall, within +-pi/2")
        if not 0 < fov_rad < math.pi:
            raise ConfigError(f"fov_rad is {fov_rad}; give a field of view between 0 and pi")
        height, width = shape
        slope = 2 * math.tan(fov_rad / 2) / width  # tangent a pixel
        u0, v0 = (width - 1) / 2, (height - 1) / 2
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        # With tangents (p, q) of a pixel, the ray meets the wall at aim + D (p, q c) / (c + s p).
        w = (s * slope, 0.0, c - s * slope * u0)
        x = (distance_m * slope + aim_m[0] * w[0], 0.0, -distance_m * slope * u0 + aim_m[0] * w[2])
        rise = distance_m * c * slope * pixel_aspect  # of a row
        y = (aim_m[1] * w[0], rise, -rise * v0 + aim_m[1] * w[2])
        eye = (aim_m[0] + distance_m * s, aim_m[1], distance_m * c)
        return cls((int(height), int(width)), (x, y, w), eye)

    @property
    def is_affine(self) -> bool:
        """Whether equal steps in the image are equal steps on the wall."""
        return self.matrix[2][0] == 0 and self.matrix[2][1] == 0

    def wall_points_m(self, du: float = 0.0, dv: float = 0.0) -> torch.Tensor:
        """Return the wall points (x, y) seen at the pixel centres, float64 [H, W, 2], metres.

        Args:
            du: Offset within the pixel along columns, -0.5..0.5.
            dv: Offset within the pixel along rows, -0.5..0.5.
        """
        height, width = self.shape
        u = torch.arange(width, dtype=torch.float64)[None, :] + du
        v = torch.arange(height, dtype=torch.float64)[:, None] + dv
        rows = [a * u + b * v + c for a, b, c in self.matrix]
        return torch.stack([rows[0] / rows[2], rows[1] / rows[2]], dim=-1)

    def pixels(self, points_m: torch.Tensor) -> torch.Tensor:
        """Return the pixel (column, row), float64 [..., 2], of wall points (x, y) [..., 2], metres."""
        inverse = torch.linalg.inv(torch.tensor(self.matrix, dtype=torch.float64))
        x, y = points_m.double().unbind(-1)
        rows = [a * x + b * y + c for a, b, c in inverse.tolist()]
        return torch.stack([rows[0] / rows[2], rows[1] / rows[2]], dim=-1)

    def pixel_size_m(self) -> torch.Tensor:
        """Return how far on the wall a column and a row step reach at each pixel, float64 [H, W, 2], metres."""
        return self._steps_m().norm(dim=-2)

    def magnification(self) -> float:
        """Return the largest image motion of a wall point over the image, pixels per metre."""
        return float(1.0 / torch.linalg.svdvals(self._steps_m())[..., -1].min())

    def _steps_m(self) -> torch.Tensor:
        ends = ((0.5, 0.0), (0.0, 0.5))
        return torch.stack([self.wall_points_m(u, v) - self.wall_points_m(-u, -v) for u, v in ends], dim=-1)


_MAX_SAMPLES = 8  # per pixel and axis


class ViewOperator(LinearTransport):
    """Bilinear sampling of a wall plane at the points that a camera's pixels see, averaged over each pixel.

    Outside the plane the wall is dark. With `samples` = 1 a pixel is its centre; more samples average over its
    area, which keeps a coarse camera from aliasing a finely sampled wall.

    Args:
        source: Plane of the wall image.
        view: The camera's view.
        samples: Points a pixel and axis; None takes as many as the pixel is wide in samples of the plane.
    """

    def __init__(self, source: Plane, view: View, samples: int | None = None) -> None:
        self.source = source
        self.view = view
        if samples is None:
            # The rounding allowance keeps a pixel of exactly one sample from counting as two.
            footprint = float(view.pixel_size_m().mean()) / source.pitch_m
            samples = min(_MAX_SAMPLES, max(1, math.ceil(footprint * (1 - 1e-6))))
        self.samples = samples
        offsets = [(k + 0.5) / samples - 0.5 for k in range(samples)]
        taps = [_bilinear(source, view.wall_points_m(du, dv)) for dv in offsets for du in offsets]
        self._index = torch.cat([index for index, _ in taps])  # [taps, H W]
        self._weight = torch.cat([weight for _, weight in taps]) / samples**2

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the camera image."""
        return self.view.shape

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        flat = scene.flatten(-2)  # [..., h w]
        index, weight = self._index.to(scene.device), self._weight.to(scene)
        image = torch.zeros(*flat.shape[:-1], index.shape[1], dtype=scene.dtype, device=scene.device)
        for tap, share in zip(index, weight, strict=True):
            image = image + flat[..., tap] * share
        return image.unflatten(-1, self.shape)

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        flat = image.flatten(-2)  # [..., H W]
        index, weight = self._index.to(image.device), self._weight.to(image)
        size = self.source.height * self.source.width
        scene = torch.zeros(*flat.shape[:-1], size, dtype=image.dtype, device=image.device)
        for tap, share in zip(index, weight, strict=True):
            scene = scene.index_add(-1, tap, flat * share)
        return scene.unflatten(-1, self.source.shape)


def _bilinear(plane: Plane, points_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return indices and weights [4, points] of bilinear interpolation; weights outside the plane are zero."""
    x, y = points_m.reshape(-1, 2).unbind(-1)
    column = (x - plane.center_m[0]) / plane.pitch_m + (plane.width - 1) / 2
    row = (y - plane.center_m[1]) / plane.pitch_m + (plane.height - 1) / 2
    left, top = column.floor(), row.floor()
    indices, weights = [], []
    for dy in (0, 1):
        for dx in (0, 1):
            c, r = left + dx, top + dy
            weight = (1 - (column - c).abs()) * (1 - (row - r).abs())
            inside = (c >= 0) & (c < plane.width) & (r >= 0) & (r < plane.height)
            weights.append(torch.where(inside, weight, torch.zeros_like(weight)))
            index = r.clamp(0, plane.height - 1) * plane.width + c.clamp(0, plane.width - 1)
            indices.append(index.long())
    return torch.stack(indices), torch.stack(weights)


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
            (x0, y0), (x1, y1) = (shadow[:, at, :, None].unbind(1) for at in (k - 1, k))  # [P, 1] each
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
