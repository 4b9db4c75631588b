"""What stands in the room of a rendered setup, the light on its wall in continuous time, and a phone.

- What carries and lights the target, and the wall's image while it moves.
- A phone that films a wall: row after row, in eight bits, with tone curve, automatic exposure and shake.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.video_files import Tone, coded
from evnlos.config import check_made
from evnlos.errors import ConfigError
from evnlos.lab.light_path import Rays
from evnlos.scene import Scene
from evnlos.types import Plane, derive_seed

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
    place = scene.motion.position_m(scene.instants(_INSTANTS))
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
        for image, (x, y) in zip(shown, place, strict=True):
            rim = _box(plane, x - outer, x + outer, y - outer, y + outer)
            rim -= _box(plane, x - half, x + half, y - half, y + half)
            stick = _box(plane, x - wide / 2, x + wide / 2, y + outer, y + outer + long)
            image += np.float32(mount.brightness) * (rim + stick)
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


_BANDS = 8  # parts of a frame whose rows are taken as exposed at once
_MOMENTS = 4  # of an exposure
_WAVES = 6  # sinusoids of a hand's shake
_SHAKE_HZ = (0.05, 0.6)
_METERED = 0.5  # mean code, of white, to which an automatic exposure drives


class FilmedLight(Protocol):
    """Light on the phone's sensor, as a function of time."""

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the image, pixels."""
        ...

    def at(self, t_s: float) -> NDArray[np.float32]:
        """Return the light at an instant, white levels at the locked exposure, float32 [H, W]."""
        ...


@dataclass(frozen=True)
class Phone:
    """A phone's video camera: a linear sensor read row by row, then what a phone makes of it.

    Row y of H of frame n is exposed around t = n / frame_rate_hz + (y / H - 1/2) readout_s. The light, times
    the gain of the automatic exposure, makes a Poisson number of electrons and read noise; tone curve and
    contrast make codes v of it, v + contrast v (1 - v) (2 v - 1), rounded to eight bits.

    Args:
        frame_rate_hz: Frames per second.
        exposure_s: Exposure of a row, seconds.
        readout_s: Time from the first row to the last, seconds.
        full_well_e: Electrons at white.
        read_noise_e: Standard deviation of the read noise, electrons.
        tone: Curve of the codes: "srgb", "rec709", or "as-is" for a linear video.
        contrast: How much steeper the codes are in the middle than at black and white, 0 to below 1.
        auto_exposure: Share of a change of the mean light that the exposure takes back, 0 (locked) to 1.
        auto_exposure_s: Time constant of that, seconds.
        shake_px: Root mean square of a hand's movement, pixels of the film, along each axis.
        clock_ppm: By how much the phone's clock runs faster than the display's, millionths.
        quality: H.264's CRF of the film, 1 (best) to 51.

    Raises:
        ConfigError: A value outside its range.
    """

    frame_rate_hz: float = 30.0
    """Frames per second."""
    exposure_s: float = 1 / 60
    """Exposure of a row, seconds."""
    readout_s: float = 0.02
    """Time from the first row to the last, seconds (rolling shutter)."""
    full_well_e: float = 6_000.0
    """Electrons at white."""
    read_noise_e: float = 4.0
    """Standard deviation of the read noise, electrons."""
    tone: Tone = "srgb"
    """Tone curve of the codes."""
    contrast: float = 0.0
    """How much steeper codes are in the middle than at black and white, 0 to below 1."""
    auto_exposure: float = 0.0
    """Share of a change of the mean light that the exposure takes back; 0 = locked."""
    auto_exposure_s: float = 0.6
    """Time constant of the automatic exposure, seconds."""
    shake_px: float = 0.0
    """Root mean square of a hand's movement, pixels of the film; 0 = on a tripod."""
    clock_ppm: float = 20.0
    """By how much the phone's clock runs faster than the display's, millionths."""
    quality: int = 20
    """H.264's CRF of the film, 1 (best) to 51."""

    def __post_init__(self) -> None:
        limits = {
            "frame_rate_hz": (1.0, 1000.0),
            "exposure_s": (1e-5, 1.0),
            "readout_s": (0.0, 1.0),
            "full_well_e": (1.0, 1e7),
            "read_noise_e": (0.0, 1e4),
            "contrast": (0.0, 0.9),
            "auto_exposure": (0.0, 1.0),
            "auto_exposure_s": (0.01, 100.0),
            "shake_px": (0.0, 100.0),
            "clock_ppm": (-1e4, 1e4),
            "quality": (1, 51),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"Phone.{name} is {getattr(self, name)}; give {low:g} to {high:g}")
        if self.tone not in get_args(Tone):
            raise ConfigError(f"Phone.tone is {self.tone!r}; give one of {', '.join(get_args(Tone))}")
        check_made(self)

    def codes(self, light: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the codes of light, both in fractions of white, not yet rounded.

        Example:
            >>> (255 * Phone().codes(np.array([0.0, 0.5, 1.0]))).round(1)
            array([  0. , 187.5, 255. ])
        """
        codes = coded(light, self.tone)
        return codes + self.contrast * codes * (1 - codes) * (2 * codes - 1)

    def film(self, light: FilmedLight, duration_s: float, seed: int = 0) -> Iterator[NDArray[np.uint8]]:
        """Yield the frames of a film, uint8 [H, W], frame n at n / frame_rate_hz on the phone's clock.

        Args:
            light: What the sensor sees, on the display's clock, which starts as the phone's does.
            duration_s: Length on the phone's clock, seconds.
            seed: Seed of noise and shake.
        """
        from scipy.ndimage import shift  # loads slowly

        height, _ = light.shape
        draw = np.random.default_rng(derive_seed(seed, "phone"))
        edges = np.linspace(0, height, min(_BANDS, height) + 1).round().astype(int)
        offsets = ((np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5) * self.exposure_s
        waves = _Hand(draw, self.shake_px)
        gain = 1.0
        for number in range(round(duration_s * self.frame_rate_hz)):
            clock_s = number / self.frame_rate_hz
            image = np.empty(light.shape)
            for first, last in pairwise(edges):
                row_s = ((first + last) / 2 / height - 0.5) * self.readout_s
                instants = (clock_s + row_s + offsets) / (1 + 1e-6 * self.clock_ppm)
                image[first:last] = np.mean([light.at(float(t))[first:last] for t in instants], axis=0)
            if self.shake_px > 0:
                image = shift(image, waves(clock_s), order=3, mode="nearest").clip(min=0)
            electrons = draw.poisson(gain * image * self.full_well_e).astype(np.float64)
            electrons += self.read_noise_e * draw.standard_normal(image.shape)
            codes = self.codes(electrons / self.full_well_e)
            yield np.rint(255 * codes).astype(np.uint8)
            if self.auto_exposure > 0:
                wanted = (_METERED**2.2 / max(float(image.mean()), 1e-6)) ** self.auto_exposure
                gain += (wanted - gain) * -math.expm1(-1 / self.frame_rate_hz / self.auto_exposure_s)


class _Hand:
    """Slow movement (down, right), pixels: sinusoids of random phases."""

    def __init__(self, draw: np.random.Generator, rms_px: float) -> None:
        self._hz = draw.uniform(*_SHAKE_HZ, size=(2, _WAVES))
        self._phase = draw.uniform(0, 2 * math.pi, size=(2, _WAVES))
        self._amplitude = rms_px * math.sqrt(2 / _WAVES)

    def __call__(self, t_s: float) -> NDArray[np.float64]:
        return self._amplitude * np.sin(2 * math.pi * self._hz * t_s + self._phase).sum(axis=1)
