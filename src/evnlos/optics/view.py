"""A camera's view of the wall: which point of the wall each pixel sees.

- Sampling a wall image through a view: the linear operator that a camera's geometry is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from evnlos.errors import ConfigError
from evnlos.optics.operator import LinearTransport
from evnlos.types import Plane

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


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
        """
        if not (math.isfinite(pixels_per_m) and pixels_per_m > 0):
            raise ConfigError(f"pixels_per_m is {pixels_per_m}; give a positive number")
        if not stretch > 0:
            raise ConfigError(f"stretch is {stretch}; give a positive number")
        c, s = math.cos(rotation_rad), math.sin(rotation_rad)
        turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
        lean = torch.tensor([[1.0, shear], [0.0, stretch]], dtype=torch.float64)
        flip = torch.diag(torch.tensor([-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0], dtype=torch.float64))
        to_wall = torch.linalg.inv(pixels_per_m * turn @ lean @ flip)
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
    ) -> View:
        """Return the view of a pin-hole camera that looks at a point of the wall, turned about the vertical.

        Args:
            shape: Size (H, W), pixels (square ones).
            distance_m: Distance from the pin-hole to the aimed point, metres, above 0.
            angle_rad: Angle between the optical axis and the wall's normal, radians; positive puts the camera
                at +x.
            fov_rad: Horizontal field of view over W pixels, radians, 0 to pi.
            aim_m: The aimed point (x, y), metres.
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
        y = (aim_m[1] * w[0], distance_m * c * slope, -distance_m * c * slope * v0 + aim_m[1] * w[2])
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
        across = self.wall_points_m(0.5, 0.0) - self.wall_points_m(-0.5, 0.0)
        down = self.wall_points_m(0.0, 0.5) - self.wall_points_m(0.0, -0.5)
        return torch.stack([across.norm(dim=-1), down.norm(dim=-1)], dim=-1)

    def magnification(self) -> float:
        """Return the largest image motion of a wall point over the image, pixels per metre."""
        across = self.wall_points_m(0.5, 0.0) - self.wall_points_m(-0.5, 0.0)
        down = self.wall_points_m(0.0, 0.5) - self.wall_points_m(0.0, -0.5)
        jacobian = torch.stack([across, down], dim=-1)  # [H, W, 2, 2], metres per pixel
        return float(1.0 / torch.linalg.svdvals(jacobian)[..., -1].min())


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
