"""The paper's setup: diffraction, modulus, tPSF, view, gain and ambient light."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Literal

import torch

from evnlos.cameras import EventPixel
from evnlos.errors import ConfigError
from evnlos.machine import note
from evnlos.optics import (
    Diffraction,
    DiffuseReflection,
    LinearTransport,
    SlidingWall,
    Transport,
    View,
    ViewOperator,
    blur_radius_px,
    fresnel_number,
    sampling_limit_m,
    tpsf_kernel,
)
from evnlos.optics.angular_spectrum import check_lengths
from evnlos.scene import Scene
from evnlos.setups.base import Layout, Parameter, SensorSize, Setup, stated_distance_m
from evnlos.types import Plane

_SAMPLES_PER_RHO = 4  # samples of the target to one unit of the tPSF's rho
_FINEST = 16  # samples a side of a cell, at most


@Setup.registry.register
@dataclass(frozen=True)
class PaperSetup(Setup):
    """The setup of the paper, steps A and B: shift-invariant, so a moving target is an image that slides."""

    artifact: ClassVar[str] = "the kink at the edge of the tPSF (raise window towards 1)"

    kind: Literal["paper"] = "paper"
    """Kind of this setup."""
    distance_m: float = 0.5
    """Distance from target to wall where the scene states none, metres."""
    wavelength_m: float = 500e-9
    """Wavelength, metres."""
    pitch_m: float = 3.125e-4
    """Distance between samples of the target, metres; 8 cm / 256 by default."""
    field_step_m: float | None = None
    """Pitch that the propagation sees, metres; None is the physical `pitch_m`, about 1e-5 shows fringes."""
    field: Literal["intensity", "amplitude"] = "intensity"
    """Whether the mask itself is the field, as the paper prints, or its square root."""
    result: Literal["modulus", "intensity"] = "modulus"
    """Whether the wall receives |E|, as the paper prints, or |E|^2."""
    tpsf_length_m: float = 0.02
    """Length of one unit of the tPSF's rho on the wall, metres: the knob of difficulty."""
    tpsf_t: float = 2.0
    """Thickness t of the equivalent slab, units of rho."""
    mean_free_path: float = 0.8
    """Scattering mean free path <l>, units of rho."""
    kernel_radius: float = 2.0
    """Radius of the tPSF's disc, units of rho."""
    window: float = 0.0
    """Outer share of the tPSF's radius that fades to zero, 0..1; 0 is the paper's hard edge."""
    field_of_view_m: float = 0.24
    """Width of wall that the image shows (in its middle, for an oblique view), metres."""
    camera_angle_deg: float = 0.0
    """Angle between the optical axis and the wall's normal, degrees; 0 is an affine view."""
    camera_distance_m: float = 0.6
    """Distance from camera to wall, metres; used by an oblique view."""
    rotation_deg: float = 0.0
    """Turn of an affine view, degrees, clockwise."""
    shear: float = 0.0
    """Columns that one row adds in an affine view."""
    stretch: float = 1.0
    """Magnification along y divided by that along x in an affine view."""
    offset_m: tuple[float, float] = (0.0, 0.0)
    """Point of the wall (x, y) in the middle of the image, metres."""

    def view(self, shape: tuple[int, int]) -> View:
        """Return the camera's view for an image of `shape` (H, W), pixels."""
        check_lengths(field_of_view_m=self.field_of_view_m, camera_distance_m=self.camera_distance_m)
        pixels = self.sensor.aspect_at(shape)
        if self.camera_angle_deg:
            fov = 2 * math.atan(self.field_of_view_m / 2 / self.camera_distance_m)
            angle = math.radians(self.camera_angle_deg)
            return View.perspective(shape, self.camera_distance_m, angle, fov, self.offset_m, pixels)
        scale = shape[1] / self.field_of_view_m
        turn = math.radians(self.rotation_deg)
        plain = View.affine(shape, scale, turn, self.shear, self.stretch, pixel_aspect=pixels)
        # The aimed point goes to the middle of the image, whatever the turn.
        moved = plain.pixels(torch.tensor([(0.0, 0.0), self.offset_m], dtype=torch.float64))
        across, down = (moved[0] - moved[1]).tolist()
        return View.affine(shape, scale, turn, self.shear, self.stretch, (across, down), pixel_aspect=pixels)

    def transport(self, size_m: float) -> Transport:
        """Return diffraction, then diffuse reflection, for a target of side `size_m`, metres; not linear."""
        plane = self.source(size_m)
        return self._diffraction(plane).then(DiffuseReflection(plane, self._kernel(self.pitch_m)))

    def source(self, size_m: float) -> Plane:
        """Return the plane on which a target of side `size_m` is drawn: the target and room for its fringes."""
        check_lengths(pitch_m=self.pitch_m, size_m=size_m)
        side = math.ceil(size_m / self.pitch_m * (1 - 1e-9))
        fringes = blur_radius_px(self._wave_pitch_m, self.wavelength_m, self.distance_m)
        side += 2 * min(side, math.ceil(4 * fringes) + 1)
        return Plane(side, side, self.pitch_m)

    def observe(self, scene: Scene) -> SlidingWall:
        """Return the irradiance on the sensor while the scene's target moves: a wall image that slides.

        Args:
            scene: The target and its motion, at a constant distance.

        Raises:
            ConfigError: A setting is outside its range, or the target turns, approaches or retreats.
        """
        distance_m = stated_distance_m(self, scene)
        if distance_m is not None and distance_m != self.distance_m:
            return self.at_distance(distance_m).observe(scene)
        transport = self.transport(scene.target.size_m)
        mask = torch.from_numpy(scene.target.rasterise(self.source(scene.target.size_m)))
        plane = transport.output
        assert plane is not None  # both steps end on planes
        return SlidingWall(
            transport(mask),
            plane,
            self.view(self.shape),
            scene.motion,
            gain=self.gain,
            ambient=self.ambient_light(),
        )

    def operator(
        self, plane: Plane, shape: tuple[int, int] | None = None, dtype: torch.dtype = torch.float64
    ) -> LinearTransport:
        """Refuse: the modulus of step A is not linear; `linear_part` leaves that step out."""
        raise ConfigError(
            "the setup 'paper' is not linear: its wall receives the modulus of a field; "
            "give a setup of kind radiometric or measured"
        )

    def linear_part(self, plane: Plane) -> LinearTransport:
        """Return step B and the view, gain included: step A changes an 8 cm target by a few per cent.

        Args:
            plane: Cells of the target plane.
        """
        fine = min(_FINEST, max(1, math.ceil(_SAMPLES_PER_RHO * plane.pitch_m / self.tpsf_length_m)))
        samples = Plane(plane.height * fine, plane.width * fine, plane.pitch_m / fine, plane.center_m)
        reflection = DiffuseReflection(samples, self._kernel(samples.pitch_m))
        view = ViewOperator(reflection.output, self.view(self.shape))
        return _LinearPart(plane, fine, reflection, view, self.gain)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return what frames decide about this setup: blur, magnification, turn, shear and place."""
        return (
            Parameter("tpsf_length_m", "m", self.tpsf_length_m, 1e-4, 1.0, 0.02, True, "blur"),
            Parameter("mean_free_path", "", self.mean_free_path, 0.05, 1.9, 0.02),
            Parameter("field_of_view_m", "m", self.field_of_view_m, 0.01, 20.0, 0.005, True, "magnification"),
            Parameter("stretch", "", self.stretch, 0.2, 5.0, 0.005, True),
            Parameter("rotation_deg", "deg", self.rotation_deg, -45.0, 45.0, 0.2),
            Parameter("shear", "", self.shear, -1.0, 1.0, 0.005),
            Parameter("offset_m.0", "m", self.offset_m[0], -10.0, 10.0, 5e-4),
            Parameter("offset_m.1", "m", self.offset_m[1], -10.0, 10.0, 5e-4),
        )

    def wall_description(self) -> str:
        """Return the kernel in words."""
        return f"the paper's kernel, {1e3 * self.tpsf_length_m:.3g} mm per unit of rho"

    def layout(self) -> Layout:
        """Return target and wall; the paper states no place of the camera."""
        return Layout((0.0, self.distance_m), f"relay wall ({self.wall_description()})")

    def at_distance(self, distance_m: float) -> PaperSetup:
        """Return the setup with another distance from target to wall, metres: only diffraction changes."""
        return replace(self, distance_m=distance_m)

    def coarsened(self, factor: float = 1.0) -> PaperSetup:
        """Return the setup with ten samples of the target to a unit of rho, times a factor."""
        return replace(self, pitch_m=min(2e-3, max(2.5e-4, self.tpsf_length_m / 10 * factor)))

    def without_artifacts(self) -> PaperSetup | None:
        """Return the same tPSF four times as wide, faded out instead of cut: what it is without the kink."""
        return replace(self, kernel_radius=4 * self.kernel_radius, window=0.5) if self.window < 1 else None

    def optical_values(self, target_m: float) -> dict[str, float]:
        """Return what diffraction does to a target: Fresnel number, blur in camera pixels, sampling limit.

        Args:
            target_m: Side of the target, metres.

        Example:
            >>> round(PaperSetup().optical_values(0.08)["fresnel_number"])
            6400
        """
        source = self.source(target_m)
        scale = self._wave_pitch_m / self.pitch_m
        fringes_px = blur_radius_px(self._wave_pitch_m, self.wavelength_m, self.distance_m)
        magnification = self.sensor.width / self.field_of_view_m
        return {
            "fresnel_number": fresnel_number(target_m / 2 * scale, self.wavelength_m, self.distance_m),
            "diffraction_blur_px": fringes_px * self.pitch_m * magnification,
            "tpsf_radius_px": self.kernel_radius * self.tpsf_length_m * magnification,
            "sampling_limit_m": sampling_limit_m(source.width, self._wave_pitch_m, self.wavelength_m),
        }

    def _kernel(self, pitch_m: float) -> torch.Tensor:
        return _tpsf(
            pitch_m, self.tpsf_length_m, self.tpsf_t, self.mean_free_path, self.kernel_radius, self.window
        )

    @property
    def _wave_pitch_m(self) -> float:
        return self.pitch_m if self.field_step_m is None else self.field_step_m

    def _diffraction(self, plane: Plane) -> Diffraction:
        return Diffraction(
            plane, self.wavelength_m, self.distance_m, self.field_step_m, self.field, self.result
        )


@lru_cache(maxsize=2)  # a fit asks for each capture's, and they share it
def _tpsf(
    pitch_m: float, length_m: float, t: float, mean_free_path: float, radius: float, window: float
) -> torch.Tensor:
    return tpsf_kernel(
        pitch_m, length_m, t=t, mean_free_path=mean_free_path, kernel_radius=radius, window=window
    )


class _LinearPart(LinearTransport):
    """Diffuse reflection and view of cells that are drawn on finer samples."""

    def __init__(
        self, plane: Plane, fine: int, reflection: DiffuseReflection, view: ViewOperator, gain: float
    ) -> None:
        self.source = self._plane = plane
        self._fine, self._gain = fine, gain
        self._reflection, self._view = reflection, view

    @property
    def shape(self) -> tuple[int, int]:
        return self._view.shape

    def dense(self, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Return the matrix, [H W, h w]: what a cell reflects is the same everywhere, only shifted."""
        (height, width), side = self._plane.shape, self._fine
        one = Plane(side, side, self._plane.pitch_m / side)
        spot = DiffuseReflection(one, self._reflection.kernel)(torch.ones(one.shape, dtype=dtype))
        rows = []
        for row in range(height):
            note(f"light path, {row * width} of {height * width} cells")
            wall = torch.zeros(width, *self._reflection.shape, dtype=dtype)
            for column, lit in enumerate(wall):
                down, across = row * side, column * side
                lit[down : down + spot.shape[0], across : across + spot.shape[1]] = spot
            rows.append(self._gain * self._view(wall).flatten(1).mT)
        return torch.cat(rows, dim=1)

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        samples = scene.repeat_interleave(self._fine, -2).repeat_interleave(self._fine, -1)
        return self._gain * self._view(self._reflection(samples))

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        samples = self._reflection.adjoint(self._view.adjoint(self._gain * image))
        height, width = self.source.shape
        return samples.unflatten(-1, (width, self._fine)).unflatten(-3, (height, self._fine)).sum(dim=(-3, -1))


def rough_paper() -> PaperSetup:
    """Return the paper's wall around a target 0.3 m and a camera 0.6 m from it: what `default` varies."""
    return PaperSetup(field_of_view_m=0.585, tpsf_length_m=0.02)


def as_in_the_paper() -> PaperSetup:
    """Return the paper's simulated setup: 0.5 m, 500 nm, 960 x 600 pixels."""
    return PaperSetup(
        distance_m=0.5,
        wavelength_m=500e-9,
        tpsf_t=2.0,
        mean_free_path=0.8,
        kernel_radius=2.0,
        sensor=SensorSize(600, 960),
        pixel=EventPixel(0.15, 0.15, 0.03, 15.0, 0.01, 0.0015, 0.0),
    )
