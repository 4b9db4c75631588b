"""The radiometric setup: a wall with a BRDF, a pin-hole camera, and the strip along which the target moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Literal, TypeVar

import numpy as np
import torch

from evnlos.errors import ConfigError
from evnlos.optics import (
    GGX,
    Brdf,
    Lambert,
    MatrixTransport,
    MatrixWall,
    Occluder,
    SpaceWall,
    View,
    lamp_radiance,
    light_transport_matrix,
)
from evnlos.optics.angular_spectrum import check_lengths
from evnlos.optics.facets import Pose
from evnlos.optics.view import check_between, check_sight
from evnlos.scene import Scene
from evnlos.setups.base import Layout, Parameter, Setup, stated_distance_m
from evnlos.types import Plane

R = TypeVar("R", bound="RadiometricSetup")

_LEAST_CELLS = 4  # a side of the target: fewer show no shape at all


@Setup.registry.register
@dataclass(frozen=True)
class RadiometricSetup(Setup):
    """A self-luminous target, a wall with a BRDF, and a pin-hole camera that sees the wall at an angle.

    Its parts are methods that a derived kind replaces one by one: `brdf` (how the wall reflects), `gain_map`
    (what each pixel makes of its light: texture of the wall, vignetting), `view` (camera), `occluders`,
    `emission` (how bright each cell of the target plane shines). `matrix` puts them together, and everything
    else follows from it: `observe`, `operator` and the searches of calibration and tracking.
    """

    is_linear: ClassVar[bool] = True

    kind: Literal["radiometric"] = "radiometric"
    """Kind of this setup."""
    gain: float = 0.8
    """White levels of the brightest pixel while a square of the strip's height shines in its middle."""
    wall_material: Literal["ggx", "lambert"] = "ggx"
    """Rough aluminium (GGX microfacets) or a matte wall (Lambert)."""
    roughness: float = 0.05
    """GGX roughness alpha, above 0; along x for a brushed wall."""
    roughness_y: float | None = None
    """GGX roughness along y; None is the same as along x."""
    albedo: float = 0.8
    """Reflected share of a matte wall, 0..1."""
    distance_m: float = 0.3
    """Distance from target to wall where the scene states none, metres."""
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
        aspect = self.sensor.aspect_at(shape)
        return View.perspective(shape, self.camera_distance_m, angle, fov, pixel_aspect=aspect)

    def target_cells(self) -> Plane:
        """Return the strip of cells, in the coordinates of the target's motion."""
        return self.source()

    def source(self) -> Plane:
        """Return the strip of cells on which targets are drawn, in the coordinates of the target's motion."""
        check_lengths(cell_m=self.cell_m, strip_width_m=self.strip_m[0], strip_height_m=self.strip_m[1])
        width, height = (max(1, round(side / self.cell_m)) for side in self.strip_m)
        return Plane(height, width, self.cell_m)

    def offset_m(self) -> tuple[float, float]:
        """Return where the middle of the travel lies over the wall (x, y), metres."""
        if self.target_offset_m is not None:
            return self.target_offset_m
        return -self.distance_m * math.tan(math.radians(self.camera_angle_deg)), 0.0

    def wall_start(self) -> tuple[Pose, float, float]:
        """Return camera and target, and the roughness along x and y."""
        pose = Pose(
            camera_distance_m=self.camera_distance_m,
            camera_angle_deg=self.camera_angle_deg,
            field_of_view_deg=self.field_of_view_deg,
            distance_m=self.distance_m,
            target_offset_m=self.offset_m(),
        )
        return pose, self.roughness, self.roughness_y or self.roughness

    def occluders(self) -> tuple[Occluder, ...]:
        """Return what stands between wall and target."""
        polygons = tuple(Occluder(corners) for corners in self.occluders_m)
        if self.post_width_m == 0:
            return polygons
        return (*polygons, Occluder.post(self.offset_m()[0] / 2, self.distance_m / 2, self.post_width_m))

    def gain_map(self, shape: tuple[int, int]) -> torch.Tensor | None:
        """Return what each pixel makes of its light, float64 [H, W], 1 = all of it; None is 1 everywhere.

        Args:
            shape: Size (H, W) of the camera image, pixels; the map is that of the sensor, averaged over areas.
        """
        return None

    def emission(self, source: Plane) -> torch.Tensor | None:
        """Return the radiance of cells of brightness 1, float64 [h, w]; None is 1 everywhere.

        Args:
            source: Cells of the target plane, in the coordinates of the target's motion.
        """
        if self.lamp_m is None:
            return None
        offset_m, half = self.offset_m(), self.lamp_half_angle_deg
        if not 0 < half < 90:
            raise ConfigError(f"lamp_half_angle_deg is {half}; give above 0 and below 90 degrees")
        return lamp_radiance(source, self.distance_m, self.lamp_m, offset_m=offset_m, half_angle_deg=half)

    def transport(self, shape: tuple[int, int] | None = None) -> MatrixTransport:
        """Return the matrix from the strip to the camera, scaled so that `gain` means what it says; cached.

        Args:
            shape: Size (H, W) of the camera image, pixels; None is the sensor's.
        """
        shape = self.shape if shape is None else shape
        # Light that only adds up afterwards and the cameras do not belong to the matrix's key.
        return _transport(self.optics(), shape)

    def matrix(
        self,
        shape: tuple[int, int],
        source: Plane,
        dtype: torch.dtype = torch.float64,
    ) -> torch.Tensor:
        """Return the matrix from any cells of the target's plane to the camera, without `gain`, [H W, h w].

        Args:
            shape: Size (H, W) of the camera image, pixels.
            source: Cells, in the coordinates of the target's motion.
            dtype: Floating-point type of the result.

        Raises:
            ConfigError: An occluder reaches the wall or the target's plane, or hides the wall from the camera.
        """
        view, occluders = self.view(shape), self.occluders()
        check_lengths(distance_m=self.distance_m)
        check_between(occluders, self.distance_m)
        check_sight(view, occluders)
        matrix = light_transport_matrix(
            view,
            source,
            self.distance_m,
            self.brdf(),
            offset_m=self.offset_m(),
            occluders=occluders,
            emission=self.emission(source),
            dtype=dtype,
        )
        seen = self.gain_map(shape)
        return matrix if seen is None else matrix * seen.to(matrix).reshape(-1, 1)

    def operator(
        self, plane: Plane, shape: tuple[int, int] | None = None, dtype: torch.dtype = torch.float64
    ) -> MatrixTransport:
        """Return the matrix from any cells of the target plane to the camera, gain included.

        The gain is defined for the sensor's own pixels; a smaller image has the mean of theirs.

        Args:
            plane: Cells, in the coordinates of the target's motion.
            shape: Size (H, W) of images to which the sensor's are reduced by area averaging; None: as they are.
            dtype: Floating-point type of the matrix.

        Raises:
            ConfigError: As for `matrix`.
        """
        shape = self.shape if shape is None else shape
        if plane == self.source() and tuple(shape) == self.shape and dtype == torch.float32:
            own = self.transport()  # that of the simulator, cached
            return own if self.gain == 1 else MatrixTransport(own.matrix * self.gain, plane, shape)
        matrix = self.matrix(shape, plane, dtype)
        if tuple(shape) == self.shape and plane == self._full_square():
            brightest = float(matrix.sum(dim=1).max())
            _check_light(brightest)
        else:
            brightest, mean = _full_light(self.optics(), self.shape)
            if tuple(shape) != self.shape:  # quadrature over larger pixels: area averages keep the mean
                brightest *= _full_light(self.optics(), shape)[1] / mean
        return MatrixTransport(matrix * (self.gain / brightest), plane, shape)

    def _full_square(self) -> Plane:
        """Return the square of the strip's height in its middle, whose light `gain` refers to."""
        strip = self.source()
        columns = (torch.arange(strip.width) - (strip.width - 1) / 2).abs() <= strip.height / 2
        return Plane(strip.height, int(columns.sum()), strip.pitch_m)

    def observe(self, scene: Scene) -> MatrixWall | SpaceWall:
        """Return the irradiance on the sensor while the scene's target moves.

        At any distance the exposure is that of the setup's own: what is further away is darker.

        Args:
            scene: The target and its motion; one in space, with depth or turning, may leave the strip.

        Raises:
            ConfigError: The target leaves the strip, needs finer cells, or a setting is out of range.
        """
        seen_px_m = self.view(self.shape).magnification()
        self.source()  # refuses cells or a strip without size
        self._check_cells(scene.target.size_m)
        if scene.moves_in_space:
            where = self.cell_m, self.distance_m, seen_px_m
            return SpaceWall(self.at_distances, scene, *where, self.ambient_light())
        distance_m = stated_distance_m(self, scene)
        if distance_m is not None and distance_m != self.distance_m:
            there = self.at_distance(distance_m)
            brighter = _full_light(there.optics(), self.shape)[0] / _full_light(self.optics(), self.shape)[0]
            return replace(there, gain=self.gain * brighter).observe(scene)
        self._check_travel(scene)
        return MatrixWall(
            self.transport(self.shape),
            scene.target,
            scene.motion,
            magnification_px_m=seen_px_m,  # no point of the image outruns the target
            gain=self.gain,
            ambient=self.ambient_light(),
        )

    def parameters(self) -> tuple[Parameter, ...]:
        """Return what frames decide about this setup: blur, distances, place of the target, camera."""
        x_m, y_m = self.offset_m()
        return (
            Parameter("roughness", "", self.roughness, 0.004, 1.0, 0.02, True, "blur"),
            Parameter("distance_m", "m", self.distance_m, 0.02, 20.0, 0.005, True),
            Parameter("target_offset_m.0", "m", x_m, -10.0, 10.0, 5e-4, role="place"),
            Parameter("target_offset_m.1", "m", y_m, -10.0, 10.0, 5e-4, role="place"),
            Parameter("camera_distance_m", "m", self.camera_distance_m, 0.05, 20.0, 0.005, True),
            Parameter("camera_angle_deg", "deg", self.camera_angle_deg, -75.0, 75.0, 0.2),
            Parameter(
                "field_of_view_deg", "deg", self.field_of_view_deg, 2.0, 120.0, 0.005, True, "magnification"
            ),
        )

    def with_parameters(self: R, values: Mapping[str, float]) -> R:
        """Return the setup with other values of some parameters; the place of the target is then written out.

        Args:
            values: Values by the names of `parameters`.
        """
        placed = self
        if any(name.startswith("target_offset_m.") for name in values):
            placed = replace(self, target_offset_m=self.offset_m())
        return super(RadiometricSetup, placed).with_parameters(values)

    def wall_description(self) -> str:
        """Return wall, occluders and torch in words."""
        parts = ["matte" if self.wall_material == "lambert" else f"aluminium, GGX roughness {self.roughness:g}"]
        parts += [f"{len(self.occluders())} occluder(s)"] if self.occluders() else []
        return ", ".join([*parts, "torch-lit target"] if self.lamp_m is not None else parts)

    def layout(self) -> Layout:
        """Return where target, camera, occluders and torch are."""
        angle, fov = math.radians(self.camera_angle_deg), math.radians(self.field_of_view_deg)
        eye = (self.camera_distance_m * math.sin(angle), self.camera_distance_m * math.cos(angle))
        left, right = (eye[0] - eye[1] * math.tan(angle + side * fov / 2) for side in (1, -1))
        is_matte = self.wall_material == "lambert"
        return Layout(
            (self.offset_m()[0], self.distance_m),
            "relay wall, matte" if is_matte else f"relay wall, metal of roughness {self.roughness:.2g}",
            eye,
            f"{100 * self.camera_distance_m:.3g} cm, {self.camera_angle_deg:.3g} deg",
            (left, right),
            tuple(tuple((x, z) for x, _, z in one.vertices_m) for one in self.occluders()),
            None if self.lamp_m is None else (self.lamp_m[0], self.lamp_m[2]),
        )

    def at_distance(self: R, distance_m: float) -> R:
        """Return the setup with the target plane elsewhere; camera, occluders and the plane's origin stay.

        Args:
            distance_m: Distance from target plane to wall, metres.
        """
        return replace(
            self,
            distance_m=distance_m,
            target_offset_m=self.offset_m(),
            occluders_m=tuple(one.vertices_m for one in self.occluders()),
            post_width_m=0.0,
        )

    def covering(self: R, size_m: tuple[float, float]) -> R:
        """Return the setup with a strip of at least this width and height, metres."""
        width, height = (max(s, round(float(one), 9)) for s, one in zip(self.strip_m, size_m, strict=True))
        return replace(self, strip_m=(width, height))

    def coarsened(self: R, factor: float = 1.0) -> R:
        """Return the setup with the coarsest cells that its blur allows: finer ones cost time and show nothing.

        A microfacet slope of alpha blurs the target by about 2 alpha r, with r the distance; a cell gets a
        sixth of that, as exact means over cells are what the matrix multiplies.

        Args:
            factor: Factor on the size of the cells.

        Example:
            >>> RadiometricSetup(roughness=0.05, distance_m=0.3).coarsened().cell_m
            0.005
        """
        blur = self.roughness * self.distance_m / 3 * factor
        width, height = self.strip_m
        # Whole cells across the target's height, so that nothing of it is cut off.
        rows = max(8, min(64, math.ceil(height / blur)))
        cell = height / rows
        return replace(self, cell_m=cell, strip_m=(round(math.ceil(width / cell - 1e-9) * cell, 9), height))

    def bytes_of_a_scene(self, target_m: float) -> int:
        """Return the size of the matrix and of the keyframes, bytes."""
        source = self.source()
        keyframes = 2 * (source.extent_m[1] + target_m) / source.pitch_m
        return 4 * self.shape[0] * self.shape[1] * (source.height * source.width + round(keyframes))

    def _check_travel(self, scene: Scene) -> None:
        positions = scene.motion.position_m(scene.instants(65))
        reach = np.abs(positions).max(axis=0) + scene.target.size_m / 2
        for name, needed, side in zip(("width", "height"), reach, self.strip_m, strict=True):
            if needed > side / 2 + self.cell_m:
                raise ConfigError(
                    f"the target reaches {needed:.3f} m from the middle of a strip of {name} {side} m; "
                    f"set strip_m to at least {2 * needed:.3f} m there"
                )

    def _check_cells(self, target_size_m: float) -> None:
        if self.cell_m > target_size_m / _LEAST_CELLS * (1 + 1e-9):
            raise ConfigError(
                f"cell_m is {self.cell_m:g} m; a target of {target_size_m:g} m needs {_LEAST_CELLS} "
                f"cells per side to show any shape: give at most {target_size_m / _LEAST_CELLS:g} m"
            )


@lru_cache(maxsize=8)
def _transport(setup: RadiometricSetup, shape: tuple[int, int]) -> MatrixTransport:
    source = setup.source()
    matrix = setup.matrix(shape, source, torch.float32)
    # A square of the strip's height is the target of the paper; it makes gains comparable between walls.
    lit = (torch.arange(source.width) - (source.width - 1) / 2).abs() <= source.height / 2
    brightest = (matrix @ lit.to(matrix).repeat(source.height)).max()
    _check_light(float(brightest))
    return MatrixTransport(matrix.div_(brightest), source, shape)


@lru_cache(maxsize=64)
def _full_light(setup: RadiometricSetup, shape: tuple[int, int]) -> tuple[float, float]:
    """Return the brightest and the mean pixel while the square shines that `gain` refers to, without `gain`."""
    light = setup.matrix(shape, setup._full_square()).sum(dim=1)
    _check_light(float(light.max()))
    return float(light.max()), float(light.mean())


def _check_light(brightest: float) -> None:
    if not brightest > 0:
        raise ConfigError("the camera receives no light from the target; move the target or the camera")
