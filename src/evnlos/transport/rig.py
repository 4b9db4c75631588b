"""The radiometric transport as settings: a wall, a camera, and the strip along which the target moves."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import torch

from evnlos.errors import ConfigError
from evnlos.scene import Scene
from evnlos.transport.ambient import ambient_plane
from evnlos.transport.angular_spectrum import check_lengths
from evnlos.transport.brdf import GGX, Brdf, Lambert
from evnlos.transport.lamp import lamp_radiance
from evnlos.transport.matrix_wall import MatrixWall
from evnlos.transport.occluder import Occluder, check_between, visibility
from evnlos.transport.operator import MatrixTransport
from evnlos.transport.radiometric import light_transport_matrix
from evnlos.transport.view import View
from evnlos.types import Plane

_MOST_KEPT_BYTES = 1 << 30  # a matrix on a GPU that is kept for the next object
_LEAST_CELLS = 4  # a side of the plate: fewer show no shape at all


@dataclass(frozen=True)
class RadiometricTransport:
    """A self-luminous target, a wall with a BRDF, and a pin-hole camera that sees the wall at an angle."""

    kind: Literal["radiometric"] = "radiometric"
    """Tag of this transport."""
    wall_material: Literal["ggx", "lambert"] = "ggx"
    """Rough aluminium (GGX microfacets) or a matte wall (Lambert)."""
    roughness: float = 0.05
    """GGX roughness alpha, above 0; along x for a brushed wall."""
    roughness_y: float | None = None
    """GGX roughness along y; None is the same as along x."""
    albedo: float = 0.8
    """Reflected share of a matte wall, 0..1."""
    distance_m: float = 0.3
    """Distance from target to wall, metres."""
    target_offset_m: tuple[float, float] | None = None
    """Middle of the travel over the wall (x, y), metres; None is the mirror direction of the camera."""
    camera_distance_m: float = 0.6
    """Distance from camera to the wall's middle, metres."""
    camera_angle_deg: float = 30.0
    """Angle between the optical axis and the wall's normal, degrees."""
    field_of_view_deg: float = 30.0
    """Horizontal field of view, degrees."""
    cell_m: float = 0.0025
    """Side of a target cell, metres."""
    strip_m: tuple[float, float] = (0.24, 0.08)
    """Width and height of the region in which the target moves, metres."""
    post_width_m: float = 0.0
    """Width of an upright post halfway between the wall's middle and the travel's, metres; 0 is none."""
    occluders_m: tuple[tuple[tuple[float, float, float], ...], ...] = ()
    """Opaque flat polygons between target and wall: corners (x, y, z) of each, metres, z from the wall."""
    lamp_m: tuple[float, float, float] | None = None
    """A torch (x, y, z) that lights the target, metres, z from the wall; None: it shines itself."""
    lamp_half_angle_deg: float = 20.0
    """Angle from the torch's axis at which it is half as bright, degrees."""
    wavelength_m: float = 500e-9
    """Wavelength at which the metal's n and k are taken, metres: 450e-9, 500e-9, 550e-9 or 650e-9."""
    gain: float = 0.8
    """White levels of the brightest pixel while a square of the strip's height shines in its middle."""
    ambient: float = 0.05
    """Ambient light in the middle of the image, white levels."""
    ambient_gradient: tuple[float, float] = (0.0, 0.0)
    """Relative growth of the ambient light from the middle to the right and the lower border."""

    def brdf(self) -> Brdf:
        """Return the wall's BRDF."""
        if self.wall_material == "lambert":
            return Lambert(self.albedo)
        if self.wall_material != "ggx":
            raise ConfigError(f"wall_material is {self.wall_material!r}; give ggx (metal) or lambert (matte)")
        return GGX.aluminium(self.roughness, self.wavelength_m, self.roughness_y)

    def view(self, shape: tuple[int, int]) -> View:
        """Return the camera's view for an image of `shape` (H, W), pixels."""
        angle, fov = math.radians(self.camera_angle_deg), math.radians(self.field_of_view_deg)
        return View.perspective(shape, self.camera_distance_m, angle, fov)

    def source(self) -> Plane:
        """Return the strip of cells, in the coordinates of the target's motion."""
        check_lengths(cell_m=self.cell_m, strip_width_m=self.strip_m[0], strip_height_m=self.strip_m[1])
        width, height = (max(1, round(side / self.cell_m)) for side in self.strip_m)
        return Plane(height, width, self.cell_m)

    def offset_m(self) -> tuple[float, float]:
        """Return where the middle of the travel lies over the wall (x, y), metres."""
        if self.target_offset_m is not None:
            return self.target_offset_m
        return -self.distance_m * math.tan(math.radians(self.camera_angle_deg)), 0.0

    def occluders(self) -> tuple[Occluder, ...]:
        """Return what stands between wall and target."""
        polygons = tuple(Occluder(corners) for corners in self.occluders_m)
        if self.post_width_m == 0:
            return polygons
        return (*polygons, Occluder.post(self.offset_m()[0] / 2, self.distance_m / 2, self.post_width_m))

    def transport(self, shape: tuple[int, int], device: torch.device | str = "cpu") -> MatrixTransport:
        """Return the matrix from the strip to the camera, scaled so that `gain` means what it says; cached."""
        # Light that only adds up afterwards does not belong to the matrix's key.
        key, where = replace(self, gain=1.0, ambient=0.0, ambient_gradient=(0.0, 0.0)), torch.device(device)
        source = self.source()
        is_large = 4 * shape[0] * shape[1] * source.height * source.width > _MOST_KEPT_BYTES
        make = _transport.__wrapped__ if is_large and where.type != "cpu" else _transport
        return make(key, shape, where)

    def matrix(
        self,
        shape: tuple[int, int],
        source: Plane,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> torch.Tensor:
        """Return the matrix from any cells of the target's plane to the camera, without `gain`, [H W, h w].

        Args:
            shape: Size (H, W) of the camera image, pixels.
            source: Cells, in the coordinates of the target's motion.
            dtype: Floating-point type of the result.
            device: Where it is computed and stays.

        Raises:
            ConfigError: An occluder reaches the wall or the target's plane, or hides the wall from the camera.
        """
        view, occluders, emission = self.view(shape), self.occluders(), None
        check_lengths(distance_m=self.distance_m)
        check_between(occluders, self.distance_m)
        _check_sight(view, occluders)
        if self.lamp_m is not None:
            emission = lamp_radiance(
                source,
                self.distance_m,
                self.lamp_m,
                offset_m=self.offset_m(),
                half_angle_deg=self.lamp_half_angle_deg,
            )
        return light_transport_matrix(
            view,
            source,
            self.distance_m,
            self.brdf(),
            offset_m=self.offset_m(),
            occluders=occluders,
            emission=emission,
            dtype=dtype,
            device=device,
        )

    def wall(self, scene: Scene, shape: tuple[int, int], device: torch.device | str = "cpu") -> MatrixWall:
        """Return the wall that a camera of `shape` (H, W) sees while the scene's plate moves.

        Args:
            scene: The plate and its motion.
            shape: Size (H, W) of the camera image, pixels.
            device: Where the matrix of the transport is made and the wall then renders.

        Raises:
            ConfigError: The plate leaves the strip, or needs finer cells, or a setting is out of range.
        """
        self.source()  # refuses cells or a strip without size
        self._check_travel(scene)
        self._check_cells(scene.target.size_m)
        return MatrixWall(
            self.transport(shape, device),
            scene.target,
            scene.motion,
            # No point of the image outruns the target: the reflection moves at most as fast as the plate.
            magnification_px_m=self.view(shape).magnification(),
            gain=self.gain,
            ambient=ambient_plane(self.ambient, self.ambient_gradient, shape),
        )

    def _check_travel(self, scene: Scene) -> None:
        positions = scene.motion.position_m(np.linspace(0.0, scene.duration_s, 65))
        reach = np.abs(positions).max(axis=0) + scene.target.size_m / 2
        for name, needed, side in zip(("width", "height"), reach, self.strip_m, strict=True):
            if needed > side / 2 + self.cell_m:
                raise ConfigError(
                    f"the plate reaches {needed:.3f} m from the middle of a strip of {name} {side} m; "
                    f"set strip_m to at least {2 * needed:.3f} m there"
                )

    def _check_cells(self, plate_m: float) -> None:
        if self.cell_m > plate_m / _LEAST_CELLS * (1 + 1e-9):
            raise ConfigError(
                f"cell_m is {self.cell_m:g} m; a plate of {plate_m:g} m needs {_LEAST_CELLS} "
                f"cells a side to show any shape: give at most {plate_m / _LEAST_CELLS:g} m"
            )


@lru_cache(maxsize=8)
def _transport(rig: RadiometricTransport, shape: tuple[int, int], device: torch.device) -> MatrixTransport:
    source = rig.source()
    matrix = rig.matrix(shape, source, torch.float32, device)
    # A square of the strip's height is the plate of the paper; it makes gains comparable between walls.
    lit = (torch.arange(source.width) - (source.width - 1) / 2).abs() <= source.height / 2
    brightest = (matrix @ lit.to(matrix).repeat(source.height)).max()
    if not float(brightest) > 0:
        raise ConfigError("the camera receives no light from the target; move the target or the camera")
    return MatrixTransport(matrix.div_(brightest), source, shape)


def _check_sight(view: View, occluders: Sequence[Occluder]) -> None:
    """Refuse occluders in the camera's line of sight: the matrix shades the way from target to wall only."""
    assert view.eye_m is not None  # a rig's view is a pin-hole
    x, y, z = (torch.tensor([value], dtype=torch.float64) for value in view.eye_m)
    before = [one for one in occluders if max(corner[2] for corner in one.vertices_m) < float(z)]
    hidden = ~visibility(view.wall_points_m().flatten(0, 1), x, y, float(z), before)
    if bool(hidden.any()):
        share = float(hidden.double().mean())
        raise ConfigError(
            f"an occluder hides the wall from {100 * share:.0f} % of the camera's pixels, which this model "
            "leaves out; move it towards the target or turn the camera"
        )


NEAR_M, FAR_M = 0.30, 0.50

_PRESETS = {
    "mirror": RadiometricTransport(roughness=0.005),
    "easy": RadiometricTransport(roughness=0.02),
    "main": RadiometricTransport(roughness=0.05),
    "hard": RadiometricTransport(roughness=0.1),
    "matte": RadiometricTransport(wall_material="lambert"),
    "aperture": RadiometricTransport(wall_material="lambert", post_width_m=0.016),
}


_DISTANCES = {"near": NEAR_M, "far": FAR_M}


def rig_names() -> list[str]:
    """Return the names of all rigs with their distances, e.g. "main-near"."""
    return [f"{name}-{place}" for name in _PRESETS for place in _DISTANCES]


def rig_preset(name: str, distance_m: float | None = None) -> RadiometricTransport:
    """Return one of the named rigs.

    Args:
        name: "mirror" (polished, for alignment; sharp to about a cell), "easy", "main" or "hard" (rough
            aluminium of roughness 0.02, 0.05, 0.1), "matte" (a plain white wall, the control on which every
            method must fail), or "aperture" (a white wall and a 16 mm post halfway); with "-near" (0.30 m) or
            "-far" (0.50 m) behind it, or near.
        distance_m: Distance from target to wall, metres, instead of the one that the name says.

    Raises:
        ConfigError: The name is unknown.

    Example:
        >>> rig_preset("hard").roughness, rig_preset("hard-far").distance_m
        (0.1, 0.5)
    """
    wall, _, place = name.partition("-")
    if wall not in _PRESETS or (place or "near") not in _DISTANCES:
        near = difflib.get_close_matches(name, rig_names(), n=1)
        hint = f"; perhaps you meant {near[0]!r}" if near else ""
        raise ConfigError(
            f"the rig {name!r} is unknown; choose one of {', '.join(_PRESETS)} with -near or -far{hint}"
        )
    return replace(_PRESETS[wall], distance_m=_DISTANCES[place or "near"] if distance_m is None else distance_m)
