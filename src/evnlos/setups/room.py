"""The room: a setup with what real setups have and the radiometric one lacks, rendered by code of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras import EventCamera
from evnlos.errors import ConfigError
from evnlos.lab import (
    LitCells,
    Mount,
    Optics,
    Rays,
    Reflection,
    RenderedWall,
    Torch,
    brightness,
    cast,
    covered_plane,
    fill_throughput,
    texture,
    tilted,
    waves,
)
from evnlos.optics import MatrixTransport
from evnlos.optics.radiometric import noted_rows, torchs_threads
from evnlos.scene import Scene
from evnlos.setups.base import Setup, stated_distance_m
from evnlos.types import Plane

Array = NDArray[np.float64]

_TOGETHER = 32  # key frames that are made at a time
_RIPPLE_STEPS = 10  # steps of the event camera a period of the ripple
_WHITE_SQUARE = Plane(16, 16, 0.005)  # shines in the middle of the travel while `gain` is read
_GRAZING = 0.02  # smallest cosine between the wall's normal and the way to the lens


@Setup.registry.register
@dataclass(frozen=True)
class RoomSetup(Setup):
    """A wall that no formula of the simulator describes, a lens before it, and a target on a mount."""

    is_linear: ClassVar[bool] = True
    is_lit: ClassVar[bool] = True

    kind: Literal["room"] = "room"
    """Kind of this setup."""
    gain: float = 1.0
    """White levels of the brightest pixel while a square of 8 cm shines in the middle of the travel."""
    ambient: float = 0.06
    """Ambient light in the middle of the image, white levels; wall and lens act on it as on all light."""
    ambient_gradient: tuple[float, float] = (0.3, -0.2)
    """Relative growth of the ambient light from the middle to the right and the lower border."""
    reflection: Reflection = field(default_factory=Reflection)
    """How the wall reflects."""
    texture_smooth: float = 0.0
    """Standard deviation of the wall's albedo in waves of 40 to 120 mm, share of the mean."""
    texture_fine: float = 0.0
    """The same in waves of 4 to 12 mm."""
    grain: float = 1.0
    """How many times longer the fine waves are along x: above 1 on a brushed wall."""
    texture_seed: int = 0
    """Seed of texture and waves: one wall for all recordings."""
    curvature: tuple[float, float] = (0.0, 0.0)
    """Curvatures of the wall along x and y, 1/metre; positive bulges into the room."""
    waviness: float = 0.0
    """Standard deviation of the wall's slopes beside its curvature, in waves of 8 to 60 mm."""
    distance_m: float = 0.3
    """Distance from target to wall where the scene states none, metres."""
    target_offset_m: tuple[float, float] | None = None
    """Middle of the travel over the wall (x, y), metres; None is the mirror direction of the camera."""
    camera_distance_m: float = 0.6
    """Distance from lens to the wall's middle, metres."""
    camera_angle_deg: float = 30.0
    """Angle between the optical axis and the wall's normal about the vertical, degrees."""
    camera_elevation_deg: float = 0.0
    """Angle of the lens above the wall's middle, degrees."""
    camera_roll_deg: float = 0.0
    """Turn of the camera about its axis, degrees."""
    field_of_view_deg: float = 30.0
    """Horizontal field of view, degrees."""
    distortion: tuple[float, float] = (0.0, 0.0)
    """Radial distortion of second and fourth power: share by which the corner's ray moves outwards."""
    aperture_m: float = 0.0
    """Diameter of the lens's opening, metres; 0 is a pin-hole."""
    focus_m: float = 0.6
    """Distance along the axis at which the camera is in focus, metres."""
    vignetting: float = 0.0
    """Loss of light in the corners beside the cosine's fourth power, 0..1."""
    mount: Mount = field(default_factory=Mount)
    """What shines beside the target plane."""
    lamp: Torch | None = None
    """A torch that lights the target; None: it shines itself."""
    ripple: float = 0.0
    """Amplitude of the lamps' ripple, share of all light, 0 to below 1."""
    ripple_hz: float = 99.97
    """Frequency of the ripple, hertz."""
    cell_m: float = 0.0025
    """Side of a target cell, metres."""
    rays: int = 5
    """Rays a pixel, through other points of the pixel and of the lens each."""
    key_frame_s: float = 0.025
    """Time between two key frames, seconds; the light is linear between them."""

    def __post_init__(self) -> None:
        for name in ("distance_m", "camera_distance_m", "focus_m", "cell_m", "key_frame_s", "gain", "grain"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"RoomSetup.{name} is {value}; give a positive number")
        for name in ("texture_smooth", "texture_fine", "waviness", "ambient", "aperture_m", "ripple_hz"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"RoomSetup.{name} is {value}; give 0 or more")
        for name in ("ripple", "vignetting"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"RoomSetup.{name} is {getattr(self, name)}; give 0 to below 1")
        for name in ("camera_angle_deg", "camera_elevation_deg"):
            if not abs(getattr(self, name)) < 80:
                raise ConfigError(f"RoomSetup.{name} is {getattr(self, name)}; give -80 to 80 degrees")
        if not 0 < self.field_of_view_deg < 120:
            raise ConfigError(f"RoomSetup.field_of_view_deg is {self.field_of_view_deg}; give 0 to 120 degrees")
        if not 1 <= self.rays <= 256:
            raise ConfigError(f"RoomSetup.rays is {self.rays}; give 1 to 256 rays per pixel")
        if self.lamp is not None and not 0 < self.lamp.place_m[2] < self.distance_m:
            raise ConfigError(
                f"RoomSetup.lamp stands {self.lamp.place_m[2]:g} m from the wall; give a place between wall "
                f"and target, which is {self.distance_m:g} m from it"
            )
        super().__post_init__()

    def wall_description(self) -> str:
        """Return what the wall is, in a few words."""
        parts = [f"{lobe.shape} lobe {lobe.width_x:g} x {lobe.width_y:g}" for lobe in self.reflection.lobes]
        if self.texture_smooth or self.texture_fine:
            parts.append(f"texture {100 * math.hypot(self.texture_smooth, self.texture_fine):.2g} %")
        parts += ["curved"] if any(self.curvature) else []
        parts += [f"waves of slope {self.waviness:g}"] if self.waviness else []
        parts += ["torch-lit target"] if self.lamp else []
        return "second renderer: " + ", ".join(parts or ["matte"])

    def offset_m(self) -> tuple[float, float]:
        """Return where the middle of the travel lies over the wall (x, y), metres."""
        if self.target_offset_m is not None:
            return self.target_offset_m
        azimuth, elevation = math.radians(self.camera_angle_deg), math.radians(self.camera_elevation_deg)
        return -self.distance_m * math.tan(azimuth), self.distance_m * math.tan(elevation) / math.cos(azimuth)

    def at_distance(self, distance_m: float) -> RoomSetup:
        """Return the setup with its target plane at another distance from the wall, nothing else moved.

        Args:
            distance_m: Distance from target plane to wall, metres.
        """
        return replace(self, distance_m=distance_m, target_offset_m=self.offset_m())

    def observe(self, scene: Scene) -> RenderedWall:
        """Return the irradiance on the cameras' pixels while the scene's target moves, at any instant.

        Args:
            scene: The target and its motion; its pose states the distance, or leaves it to the setup.

        Raises:
            ConfigError: The target turns, approaches or retreats, or no light of it reaches the camera.
        """
        stated = stated_distance_m(self, scene)
        if stated is not None and stated != self.distance_m:
            return self.at_distance(stated).observe(scene)
        plane = covered_plane(scene, self.mount, self.cell_m)
        matrix = _matrix(self._light_path(), self.shape, plane)
        count = max(1, math.ceil(scene.duration_s / self.key_frame_s - 1e-9))
        times = scene.instants(count + 1)
        frames = np.empty((count + 1, matrix.shape[0]), np.float32)
        for first in range(0, count + 1, _TOGETHER):
            few = slice(first, first + _TOGETHER)
            shown = brightness(scene, self.mount, plane, times[few]).reshape(-1, matrix.shape[1])
            columns = np.flatnonzero(shown.any(axis=0))
            lit = slice(columns[0], columns[-1] + 1) if len(columns) else slice(0, 0)
            np.matmul(shown[:, lit], matrix[:, lit].T, out=frames[few])
        frames *= np.float32(self.gain)
        frames += self.ambient_light().numpy().ravel()
        return RenderedWall(
            times, frames.reshape(-1, *self.shape), self._speed(scene), self.ripple, self.ripple_hz
        )

    @property
    def event_camera(self) -> EventCamera:
        """The event camera; under rippling light with steps that resolve the ripple."""
        if self.time_step_s is None and self.ripple and self.ripple_hz:
            return EventCamera(self.pixel, time_step_s=1 / (_RIPPLE_STEPS * self.ripple_hz))
        return super().event_camera

    def operator(
        self, plane: Plane, shape: tuple[int, int] | None = None, dtype: torch.dtype = torch.float64
    ) -> MatrixTransport:
        """Return the linear map from the brightness of target cells to white levels; see `Setup.operator`.

        Args:
            plane: Cells of the target plane, in the coordinates of the target's motion.
            shape: Size (H, W) of the images, pixels; None is the sensor's. Fewer pixels see the same wall.
            dtype: Floating-point type of the map.
        """
        shape = self.shape if shape is None else shape
        matrix = torch.from_numpy(_matrix(self._light_path(), shape, plane)).to(dtype) * self.gain
        return MatrixTransport(matrix, plane, shape)

    def ambient_light(self, shape: tuple[int, int] | None = None) -> torch.Tensor:
        """Return the light that is there without target and mount, white levels, float32 [H, W].

        Args:
            shape: Size (H, W) of the image, pixels; None is the sensor's.
        """
        height, width = shape = self.shape if shape is None else shape
        rays = self.cast_rays(shape)
        across = 1 + self.ambient_gradient[0] * (2 * np.arange(width) + 1 - width) / width
        down = self.ambient_gradient[1] * (2 * np.arange(height) + 1 - height) / height
        light = (self.ambient * (across + down[:, None])).ravel()
        if self.lamp is not None:
            light = light + self.lamp.spilled(rays, self.offset_m())
        seen = np.maximum(light, 0.0) * rays.share.sum(axis=1)
        return torch.from_numpy(seen.reshape(shape).astype(np.float32))

    def cast_rays(self, shape: tuple[int, int]) -> Rays:
        """Return where the pixels look, and what vignetting and texture leave of their light.

        Args:
            shape: Size (H, W) of the image, pixels.

        Raises:
            ConfigError: Part of the image does not see the wall.
        """
        rays = cast(
            Optics(
                shape,
                self.camera_distance_m,
                math.radians(self.camera_angle_deg),
                math.radians(self.camera_elevation_deg),
                math.radians(self.camera_roll_deg),
                math.radians(self.field_of_view_deg),
                self.distortion,
                self.aperture_m,
                self.focus_m,
                self.vignetting,
                self.curvature,
                self.rays,
                self.sensor.aspect_at(shape),
            )
        )
        if (rays.eye[..., 2] < _GRAZING).any():
            raise ConfigError(
                "part of the image does not see the wall; turn the camera towards it or narrow its view"
            )
        x, y, _ = np.moveaxis(rays.point, -1, 0)
        albedo = texture(x, y, self.texture_seed, self.texture_smooth, self.texture_fine, self.grain)
        rays = tilted(rays, waves(x, y, self.texture_seed, self.waviness)) if self.waviness else rays
        return rays._replace(share=rays.share * albedo)

    def throughput(self, shape: tuple[int, int], plane: Plane) -> NDArray[np.float32]:
        """Return the radiance of the pixels for each cell of brightness 1, without `gain`, float32 [H W, h w].

        Args:
            shape: Size (H, W) of the image, pixels.
            plane: Cells of the target plane, in the coordinates of the target's motion.
        """
        rays, (ox, oy) = self.cast_rays(shape), self.offset_m()
        y, x = (values.ravel() for values in np.meshgrid(plane.y_m, plane.x_m, indexing="ij"))
        emission, discs = np.full(len(x), plane.pitch_m**2), np.zeros((0, 4))
        if self.lamp is not None:
            emission = emission * self.lamp.emission(x, y, self.distance_m)
            tx, ty, tz = self.lamp.place_m
            discs = np.array([[tx + ox, ty + oy, tz, self.lamp.body_m]])
        out = np.empty((shape[0] * shape[1], len(x)), np.float32)
        cells, table = LitCells(x + ox, y + oy, emission, self.distance_m), self.reflection.table()
        with torchs_threads():
            for here in noted_rows(len(out)):
                fill_throughput(out[here], Rays(*(values[here] for values in rays)), cells, table, discs)
        return out

    def _light_path(self) -> RoomSetup:
        """Return the setup without what does not change the matrix: the key under which it is kept."""
        still = {"ripple": 0.0, "key_frame_s": 1.0, "mount": Mount()}
        return replace(self.optics(), **still)

    def _speed(self, scene: Scene) -> float:
        """Return a bound of the speed of the image, pixels per second."""
        # The image of a mirror moves by a part of the way; that of a lobe by less than the target.
        tangent = 2 * math.tan(math.radians(self.field_of_view_deg) / 2) / self.shape[1]
        nearest = self.camera_distance_m * math.cos(math.radians(self.field_of_view_deg) / 2)
        first, last = scene.instants(2).tolist()
        return scene.motion.speed_bound_m_s(first, last) / (tangent * nearest)


@lru_cache(maxsize=1)
def _matrix(room: RoomSetup, shape: tuple[int, int], plane: Plane) -> NDArray[np.float32]:
    """Return the throughput over the light of the brightest pixel while the square in the middle shines."""
    square = room.throughput(shape, replace(_WHITE_SQUARE, center_m=(0.0, 0.0))).sum(axis=1)
    if not square.max() > 0:
        raise ConfigError("no light of the target reaches the camera; move the torch, the target or the camera")
    return room.throughput(shape, plane) / np.float32(square.max())
