"""The paper's transport as settings: diffraction, modulus, tPSF, view, gain and ambient light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

from evnlos.scene import Scene
from evnlos.transport.ambient import ambient_plane
from evnlos.transport.angular_spectrum import blur_radius_px, check_lengths, fresnel_number, sampling_limit_m
from evnlos.transport.diffraction import Diffraction
from evnlos.transport.operator import Transport
from evnlos.transport.reflection import DiffuseReflection
from evnlos.transport.tpsf import tpsf_kernel
from evnlos.transport.view import View
from evnlos.transport.wall import SlidingWall
from evnlos.types import Plane


@dataclass(frozen=True)
class PaperTransport:
    """The transport of the paper, steps A and B: shift-invariant, so a moving plate is an image that slides."""

    kind: Literal["paper"] = "paper"
    """Tag of this transport."""
    distance_m: float = 0.5
    """Distance from target to wall, metres."""
    wavelength_m: float = 500e-9
    """Wavelength, metres."""
    pitch_m: float = 3.125e-4
    """Distance between samples of the plate, metres; 8 cm / 256 by default."""
    wave_pitch_m: float | None = None
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
    rho_max: float = 2.0
    """Radius of the tPSF's disc, units of rho."""
    taper: float = 0.0
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
    gain: float = 1.0
    """White levels that a plate without holes and without blur would reach."""
    ambient: float = 0.05
    """Ambient light in the middle of the image, white levels."""
    ambient_gradient: tuple[float, float] = (0.0, 0.0)
    """Relative growth of the ambient light from the middle to the right and the lower border."""

    def view(self, shape: tuple[int, int]) -> View:
        """Return the camera's view for an image of `shape` (H, W), pixels."""
        check_lengths(field_of_view_m=self.field_of_view_m, camera_distance_m=self.camera_distance_m)
        if self.camera_angle_deg:
            fov = 2 * math.atan(self.field_of_view_m / 2 / self.camera_distance_m)
            angle = math.radians(self.camera_angle_deg)
            return View.perspective(shape, self.camera_distance_m, angle, fov, aim_m=self.offset_m)
        scale = shape[1] / self.field_of_view_m
        turn = math.radians(self.rotation_deg)
        plain = View.affine(shape, scale, turn, self.shear, self.stretch)
        # The aimed point goes to the middle of the image, whatever the turn.
        moved = plain.pixels(torch.tensor([(0.0, 0.0), self.offset_m], dtype=torch.float64))
        across, down = (moved[0] - moved[1]).tolist()
        return View.affine(shape, scale, turn, self.shear, self.stretch, (across, down))

    def transport(self, size_m: float) -> Transport:
        """Return diffraction, then diffuse reflection, for a plate of side `size_m`, metres; not linear."""
        plane = self.source(size_m)
        kernel = tpsf_kernel(
            self.pitch_m,
            self.tpsf_length_m,
            t=self.tpsf_t,
            mean_free_path=self.mean_free_path,
            rho_max=self.rho_max,
            taper=self.taper,
        )
        return self._diffraction(plane).then(DiffuseReflection(plane, kernel))

    def source(self, size_m: float) -> Plane:
        """Return the plane on which a plate of side `size_m` is drawn: the plate and room for its fringes."""
        check_lengths(pitch_m=self.pitch_m, size_m=size_m)
        side = math.ceil(size_m / self.pitch_m * (1 - 1e-9))
        fringes = blur_radius_px(self._wave_pitch_m, self.wavelength_m, self.distance_m)
        side += 2 * min(side, math.ceil(4 * fringes) + 1)
        return Plane(side, side, self.pitch_m)

    def wall(self, scene: Scene, shape: tuple[int, int], device: torch.device | str = "cpu") -> SlidingWall:
        """Return the wall that a camera of `shape` (H, W) sees while the scene's plate moves.

        Args:
            scene: The plate and its motion.
            shape: Size (H, W) of the camera image, pixels.
            device: Where diffraction and reflection are computed and the wall then renders.

        Raises:
            ConfigError: A setting is outside its range; the text names it.
        """
        transport = self.transport(scene.target.size_m)
        mask = torch.from_numpy(scene.target.rasterise(self.source(scene.target.size_m))).to(device)
        plane = transport.output
        assert plane is not None  # both steps end on planes
        ambient = ambient_plane(self.ambient, self.ambient_gradient, shape)
        view = self.view(shape)
        return SlidingWall(transport(mask), plane, view, scene.motion, gain=self.gain, ambient=ambient)

    def figures(self, size_m: float, shape: tuple[int, int]) -> dict[str, float]:
        """Return what diffraction does to a plate: Fresnel number, blur in camera pixels, sampling limit.

        Args:
            size_m: Side of the plate, metres.
            shape: Size (H, W) of the camera image, pixels.

        Example:
            >>> round(PaperTransport().figures(0.08, (100, 160))["fresnel_number"])
            6400
        """
        source = self.source(size_m)
        scale = self._wave_pitch_m / self.pitch_m
        fringes_px = blur_radius_px(self._wave_pitch_m, self.wavelength_m, self.distance_m)
        magnification = shape[1] / self.field_of_view_m
        return {
            "fresnel_number": fresnel_number(size_m / 2 * scale, self.wavelength_m, self.distance_m),
            "diffraction_blur_px": fringes_px * self.pitch_m * magnification,
            "tpsf_radius_px": self.rho_max * self.tpsf_length_m * magnification,
            "sampling_limit_m": sampling_limit_m(source.width, self._wave_pitch_m, self.wavelength_m),
        }

    @property
    def _wave_pitch_m(self) -> float:
        return self.pitch_m if self.wave_pitch_m is None else self.wave_pitch_m

    def _diffraction(self, plane: Plane) -> Diffraction:
        return Diffraction(
            plane, self.wavelength_m, self.distance_m, self.wave_pitch_m, self.field, self.result
        )
