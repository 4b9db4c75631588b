"""What stands in the room of a rendered setup, and the light on its wall in continuous time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError
from evnlos.lab.light_path import Rays
from evnlos.scene import Scene
from evnlos.types import Plane

Array = NDArray[np.float64]

_TORCH_POINTS = 61
_EXPOSURE_PARTS = 8
_INSTANTS = 65  # at which the place of the target is looked at


@dataclass(frozen=True)
class Mount:
    """What carries the target and shines, too: a rim around it and a stick below, as bright all over."""

    brightness: float = 0.0
    """Brightness, 1 = the shining parts of the target plane; 0 = nothing to be seen."""
    rim_m: float = 0.004
    """Width of the rim around the target plane, metres."""
    stick_m: tuple[float, float] = (0.012, 0.08)
    """Width and length of the stick below the rim, metres."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.brightness) and self.brightness >= 0):
            raise ConfigError(f"Mount.brightness is {self.brightness}; give 0 or more")
        if not min(self.rim_m, *self.stick_m) >= 0:
            raise ConfigError(f"Mount: rim {self.rim_m} m, stick {self.stick_m} m; give lengths of 0 or more")


@dataclass(frozen=True)
class Torch:
    """A torch between wall and target that lights the target, hides part of it, and may be hidden itself."""

    place_m: tuple[float, float, float] = (0.10, 0.07, 0.15)
    """x and y from the middle of the travel, z from the wall, metres."""
    radius_m: float = 0.01
    """Radius of the shining disc, metres: it blurs the holder's shadow."""
    body_m: float = 0.02
    """Radius of the body, which hides part of the target from the wall, metres."""
    holder_m: tuple[float, float, float, float] | None = None
    """A disc in the torch's light (x, y from the middle of the travel, z from the wall, radius), metres."""
    spill: float = 0.0
    """Light of the torch that reaches the wall beside it by other ways, white levels."""

    def emission(self, x_m: Array, y_m: Array, distance_m: float) -> Array:
        """Return the radiance of a bright target at places of the plane; 1 in the middle without holder.

        Each of 61 points of the torch's disc gives cos cos / r^2 where the holder does not stand in its way.

        Args:
            x_m: x of the places from the middle of the travel, metres, any shape [...].
            y_m: y of the places.
            distance_m: Distance of the plane from the wall, metres.
        """
        x, y, z = self.place_m
        height = distance_m - z
        turn = np.pi * (3 - math.sqrt(5)) * np.arange(_TORCH_POINTS)
        radius = self.radius_m * np.sqrt((np.arange(_TORCH_POINTS) + 0.5) / _TORCH_POINTS)
        total, middle = np.zeros(np.shape(x_m)), 0.0
        for px, py in zip(x + radius * np.cos(turn), y + radius * np.sin(turn), strict=True):
            light = (height / ((x_m - px) ** 2 + (y_m - py) ** 2 + height**2)) ** 2
            middle += (height / (px**2 + py**2 + height**2)) ** 2
            if self.holder_m is not None:
                hx, hy, hz, wide = self.holder_m
                way = (hz - z) / height
                off = (px + way * (x_m - px) - hx) ** 2 + (py + way * (y_m - py) - hy) ** 2
                light = light * (off > wide**2)
            total += light
        return total / middle

    def spilled(self, rays: Rays, offset_m: tuple[float, float]) -> Array:
        """Return the light on the wall beside the torch, white levels, a number for each pixel [P].

        Args:
            rays: Where the pixels look.
            offset_m: Middle of the travel over the wall (x, y), metres.
        """
        x, y, z = self.place_m
        point = rays.point.mean(axis=1)
        away2 = (point[:, 0] - x - offset_m[0]) ** 2 + (point[:, 1] - y - offset_m[1]) ** 2
        return self.spill * (z**2 / (away2 + z**2)) ** 2


def covered_plane(scene: Scene, mount: Mount, cell_m: float) -> Plane:
    """Return the part of the target's plane over which target and mount move, in whole cells.

    Args:
        scene: The target and its motion.
        mount: What carries it.
        cell_m: Side of a cell, metres.
    """
    half = scene.target.size_m / 2
    place = scene.motion.position_m(np.linspace(0, scene.duration_s, _INSTANTS))
    low, high = place.min(axis=0) - half, place.max(axis=0) + half
    if mount.brightness > 0:
        low, high = low - mount.rim_m, high + mount.rim_m
        high[1] += mount.stick_m[1]
    first = np.floor(low / cell_m - 1e-9)
    count = np.ceil(high / cell_m + 1e-9) - first
    centre = (first + count / 2) * cell_m
    return Plane(int(count[1]), int(count[0]), cell_m, (float(centre[0]), float(centre[1])))


def brightness(scene: Scene, mount: Mount, plane: Plane, times_s: Array) -> NDArray[np.float32]:
    """Return the brightness of target and mount on a plane at times [T], float32 [T, h, w].

    Args:
        scene: The target and its motion.
        mount: What carries it.
        plane: The plane.
        times_s: Instants, seconds.
    """
    place = scene.motion.position_m(times_s).reshape(-1, 2)
    shown = scene.target.rasterise(plane, place)
    if mount.brightness > 0:
        half, outer = scene.target.size_m / 2, scene.target.size_m / 2 + mount.rim_m
        wide, long = mount.stick_m
        for picture, (x, y) in zip(shown, place, strict=True):
            rim = _box(plane, x - outer, x + outer, y - outer, y + outer)
            rim -= _box(plane, x - half, x + half, y - half, y + half)
            stick = _box(plane, x - wide / 2, x + wide / 2, y + outer, y + outer + long)
            picture += np.float32(mount.brightness) * (rim + stick)
    return shown


class RenderedWall:
    """The camera's image of the wall: linear in time between key frames, times the ripple of the lamps.

    Args:
        times_s: Instants of the key frames [K], seconds, evenly spaced, at least two; before and after them
            the light rests.
        frames: Light, white levels, float32 [K, H, W].
        speed_px_s: Upper bound of the speed of the image, pixels per second.
        ripple: Amplitude of the ripple, share of the light.
        ripple_hz: Its frequency, hertz.
    """

    def __init__(
        self,
        times_s: Array,
        frames: NDArray[np.float32],
        speed_px_s: float,
        ripple: float = 0.0,
        ripple_hz: float = 100.0,
    ) -> None:
        self._times_s = times_s
        self._frames = frames
        self._speed_px_s = speed_px_s
        self._ripple = ripple
        self._pulse = 2 * np.pi * ripple_hz

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the image, pixels."""
        return self._frames.shape[1], self._frames.shape[2]

    @property
    def speed_px_s(self) -> float:
        """Upper bound of the speed of the image on the sensor, pixels per second."""
        return self._speed_px_s

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return the light at times `t_s` (seconds, [] or [T]), white levels, float32 [H, W] or [T, H, W]."""
        times = np.asarray(t_s, dtype=np.float64)
        light = self._steady(times.ravel())
        if self._ripple:
            light *= _column(1 + self._ripple * np.sin(self._pulse * times.ravel()))
        return torch.from_numpy(light.reshape((*times.shape, *self.shape)))

    def exposed(self, t_s: ArrayLike, exposure_s: float) -> NDArray[np.float32]:
        """Return the light averaged over exposures, white levels, float32 [T, H, W].

        The ripple is averaged in closed form: sinc(f exposure) of its amplitude is left.

        Args:
            t_s: Middles of the exposures [T], seconds.
            exposure_s: Their length, seconds.
        """
        times = np.asarray(t_s, dtype=np.float64)
        offsets = ((np.arange(_EXPOSURE_PARTS) + 0.5) / _EXPOSURE_PARTS - 0.5) * exposure_s
        steady = np.zeros((len(times), *self.shape), np.float32)
        for offset in offsets:
            steady += self._steady(times + offset) / np.float32(_EXPOSURE_PARTS)
        left = self._ripple * np.sinc(self._pulse * exposure_s / (2 * np.pi))
        return steady * _column(1 + left * np.sin(self._pulse * times))

    def _steady(self, times_s: Array) -> NDArray[np.float32]:
        last = len(self._times_s) - 1
        place = np.interp(times_s, self._times_s, np.arange(last + 1.0))
        first = np.minimum(place.astype(int), last - 1)
        light = self._frames[first]
        light += (self._frames[first + 1] - light) * _column(place - first)
        return light


def _column(values: Array) -> NDArray[np.float32]:
    return values.astype(np.float32)[:, None, None]


def _box(plane: Plane, left: float, right: float, top: float, bottom: float) -> NDArray[np.float32]:
    """Return the share of each cell that a rectangle covers, [h, w]."""
    half = plane.pitch_m / 2
    across = np.clip(np.minimum(plane.x_m + half, right) - np.maximum(plane.x_m - half, left), 0, None)
    down = np.clip(np.minimum(plane.y_m + half, bottom) - np.maximum(plane.y_m - half, top), 0, None)
    return (down[:, None] * across / plane.pitch_m**2).astype(np.float32)
