"""Frame cameras: a linear one, and one of logarithmic pixels with its codes; colour filters.

- `FrameCamera`: exposure, shot noise, read noise, fixed pattern, gain, quantisation.
- `LogFrameCamera`: frames of pixels that take the logarithm of the light, as CeleX-V's frames (mode F) are.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.pixel import LogResponse
from evnlos.cameras.random_numbers import check_seed, fill_electrons
from evnlos.cameras.streams import WHITE_DN
from evnlos.errors import ConfigError, DataError
from evnlos.registry import Kinded, Registry
from evnlos.types import COLOURS, LUMA_601, Colour, Irradiance, Mosaic

_GAUSS = {1: [(0.0, 1.0)], 3: [(-math.sqrt(0.6), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.6), 5 / 18)]}


@dataclass(frozen=True)
class SensorSize:
    """Pixels of the sensor that carries both the frame and the event pixels."""

    height: int = 100
    """Rows, pixels."""
    width: int = 160
    """Columns, pixels."""
    pixel_aspect: float = 1.0
    """Height of a pixel over its width."""

    def __post_init__(self) -> None:
        for name in ("height", "width"):
            if not 1 <= getattr(self, name) <= 8192:
                raise ConfigError(f"SensorSize.{name} is {getattr(self, name)}; give 1 to 8192 pixels")
        if not 0.01 <= self.pixel_aspect <= 100:
            raise ConfigError(f"SensorSize.pixel_aspect is {self.pixel_aspect}; give 0.01 to 100")

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W), pixels."""
        return self.height, self.width

    def resized(self, shape: tuple[int, int]) -> SensorSize:
        """Return a sensor of another size (H, W) that sees the same: its pixels are larger or smaller.

        Example:
            >>> SensorSize(260, 346).resized((50, 80)).pixel_aspect
            1.2023121387283238
        """
        aspect = self.pixel_aspect * (self.height * shape[1]) / (self.width * shape[0])
        return SensorSize(*shape, aspect)

    def aspect_at(self, shape: tuple[int, int]) -> float:
        """Return height over width of the pixels of an image of a size (H, W) of what the sensor sees."""
        return self.resized(shape).pixel_aspect


class FrameCameraSettings(Kinded, ABC):
    """Base of the settings of all frame cameras: what simulation, lab, calibration and solvers ask of one.

    Derive a frozen dataclass, give it `kind`, what is abstract here, and register it. Settings without `kind`
    are those of the linear camera.

    Example:
        >>> FrameCameraSettings.registry["linear"] is FrameCamera
        True
    """

    registry: ClassVar[Registry[type[FrameCameraSettings]]] = Registry("evnlos.frame_cameras", "frame camera")
    default_kind: ClassVar[str] = "linear"
    bit_depth: int
    """Bits of a digital number."""
    pattern_seed: int | None
    """Seed of the fixed pattern; None = a new pattern for each capture."""
    exposure_s: float = 0.0
    """Exposure time, seconds; 0 = an instant."""

    @property
    def white(self) -> int:
        """Largest digital number, 2^bit_depth - 1."""
        return 2**self.bit_depth - 1

    @property
    def peak(self) -> int:
        """Number of white light in `linear_levels`."""
        return self.white

    def linear_levels(self, frames: NDArray) -> NDArray[np.uint8 | np.uint16]:
        """Return frames of this camera as numbers that are proportional to light, white = `peak`.

        Args:
            frames: Digital numbers [...], as `capture` returns them.
        """
        return frames

    def capture(self, wall: Irradiance, times_s: ArrayLike, seed: int = 0) -> NDArray[np.uint8 | np.uint16]:
        """Return one frame for each instant: the wall, averaged over an exposure centred there.

        The average is a Gauss-Legendre quadrature with 3 instants, or the wall's own where its light changes
        faster, as that of lamps does: `exposed(t_s, exposure_s)`, white levels [T, H, W].

        Args:
            wall: The light: `shape` and `irradiance(t_s)`, and `exposed` where it has that.
            times_s: Middles of the exposures, [N], seconds.
            seed: Seed of the noise, 0 to 2**64 - 1.

        Returns:
            Digital numbers [N, H, W]; uint8 for 8 bits, uint16 above.

        Raises:
            DataError: Times that are not finite, or a wall with NaN or negative light.
        """
        times = np.asarray(times_s, dtype=np.float64)
        if times.ndim != 1 or not np.isfinite(times).all():
            raise DataError(f"times_s has shape {times.shape}; give a 1-D array of finite seconds")
        height, width = wall.shape
        frames = np.empty((len(times), height, width), np.uint8 if self.bit_depth == 8 else np.uint16)
        seed = check_seed(seed)
        pattern = self.fixed_pattern((height, width), seed)
        averaged = getattr(wall, "exposed", None)
        for n, time in enumerate(times):
            if averaged is not None:
                mean = np.asarray(averaged([time], self.exposure_s)[0], np.float64)
            else:
                instants, weights = self.instants(time)
                light = wall.irradiance(instants).detach().to("cpu", torch.float64)  # [Q, H, W]
                mean = torch.einsum("q,qhw->hw", light.new_tensor(weights), light).numpy()
            frames[n] = self._frame(_checked(mean), seed, n, pattern)
        return frames

    def instants(self, time_s: float) -> tuple[NDArray[np.float64], list[float]]:
        """Return instants [Q], seconds, and the weights [Q] of their light in the mean over an exposure."""
        nodes = _GAUSS[3 if self.exposure_s > 0 else 1]
        instants = [time_s + 0.5 * self.exposure_s * offset for offset, _ in nodes]
        return np.array(instants), [weight for _, weight in nodes]

    def expose(
        self, irradiance: ArrayLike | torch.Tensor, seed: int = 0, first_frame: int = 0
    ) -> NDArray[np.uint8 | np.uint16]:
        """Return digital numbers of light that is already averaged over the exposure.

        Args:
            irradiance: Light [N, H, W], 1.0 = white, at least 0.
            seed: Seed of the noise, 0 to 2**64 - 1.
            first_frame: Number of the first frame: frame n of a capture has its own noise, however it is split.

        Returns:
            Digital numbers [N, H, W]; uint8 for 8 bits, uint16 above.

        Raises:
            DataError: A wrong shape, NaN, or negative light.
        """
        if isinstance(irradiance, torch.Tensor):
            irradiance = irradiance.detach().cpu().numpy()
        light = np.asarray(irradiance, dtype=np.float64)
        if light.ndim != 3:
            raise DataError(f"irradiance has shape {light.shape}; give [N, H, W]")
        _checked(light)
        seed = check_seed(seed)
        pattern = self.fixed_pattern(light.shape[1:], seed)  # type: ignore[arg-type]
        frames = np.empty(light.shape, np.uint8 if self.bit_depth == 8 else np.uint16)
        for n, image in enumerate(light):
            frames[n] = self._frame(image, seed, first_frame + n, pattern)
        return frames

    @abstractmethod
    def fixed_pattern(
        self, shape: tuple[int, int], seed: int = 0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return this camera's fixed pattern: relative gain, and an offset in the camera's unit, [H, W] each.

        Args:
            shape: Sensor size (height, width), pixels.
            seed: Seed of the capture; used when `pattern_seed` is None.
        """

    @abstractmethod
    def noise_variance(self, light: torch.Tensor, frames: int = 1, fpn_corrected: bool = True) -> torch.Tensor:
        """Return the variance of the noise of `linear_levels` at a mean light, white levels squared, [...].

        Args:
            light: Mean light, white levels, [...].
            frames: Frames that are averaged.
            fpn_corrected: Whether the fixed pattern was measured and taken off.
        """

    @abstractmethod
    def pattern_variance(self, light: torch.Tensor) -> torch.Tensor:
        """Return the variance of the fixed pattern at a mean light [...], white levels squared."""

    @abstractmethod
    def shows(self, light: torch.Tensor) -> torch.Tensor:
        """Return where a frame tells light [...], white levels, from more and from less: it is not clipped."""

    @abstractmethod
    def _frame(
        self, image: NDArray[np.float64], seed: int, number: int, pattern: tuple[NDArray, NDArray]
    ) -> NDArray:
        """Return the digital numbers of one frame, light [H, W], as whole numbers."""


@FrameCameraSettings.registry.register
@dataclass(frozen=True)
class FrameCamera(FrameCameraSettings):
    """A linear frame camera in the terms of the EMVA 1288 standard.

    A pixel under irradiance E (1.0 = white) collects a Poisson number of electrons with mean
    full_well_e (1 + prnu g) E + dsnu_e h, g and h being the fixed pattern, normal; read noise is added, and

        DN = black_level + (2^bit_depth - 1 - black_level) gain electrons / full_well_e,

    rounded and clipped to 0..2^bit_depth - 1.

    Args:
        exposure_s: Exposure time, seconds; the light is averaged over it. 0 = an instant.
        full_well_e: Electrons at white, more than 0.
        read_noise_e: Standard deviation of the read noise, electrons.
        prnu: Standard deviation of the pixels' sensitivity, fraction of the mean.
        dsnu_e: Standard deviation of the pixels' offset, electrons.
        gain: Amplification after the pixel, 1 = white fills the range.
        bit_depth: Bits a pixel, 8 to 16.
        black_level: Digital number of darkness, DN.
        pattern_seed: Seed of the fixed pattern: one camera for all captures; None = a new one for each capture.
        electrons_per_s: Electrons per second that white light makes: a pixel then collects
            electrons_per_s exposure_s E, and holds full_well_e at most, so that a short exposure is a dim one.
            None = the light is set so that white fills the well, whatever the exposure.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> camera = FrameCamera(read_noise_e=0.0, prnu=0.0, dsnu_e=0.0, full_well_e=1e9)
        >>> camera.expose(np.full((1, 1, 2), 0.25), seed=0)
        array([[[64, 64]]], dtype=uint8)
    """

    exposure_s: float = 0.01
    """Exposure time, seconds; the light is averaged over it."""
    full_well_e: float = 15_000.0
    """Electrons at white."""
    read_noise_e: float = 6.0
    """Standard deviation of the read noise, electrons."""
    prnu: float = 0.01
    """Standard deviation of the pixels' sensitivity, fraction."""
    dsnu_e: float = 3.0
    """Standard deviation of the pixels' offset, electrons."""
    gain: float = 1.0
    """Amplification after the pixel; 1 = white fills the range."""
    bit_depth: int = 8
    """Bits a pixel, 8 to 16."""
    black_level: float = 0.0
    """Digital number of darkness, DN."""
    pattern_seed: int | None = 0
    """Seed of the fixed pattern; None = a new pattern for each capture."""
    electrons_per_s: float | None = None
    """Electrons per second at white, collected over the exposure; None = white fills the well."""
    kind: Literal["linear"] = "linear"
    """Kind of this frame camera: linear, or log for logarithmic pixels."""

    def __post_init__(self) -> None:
        for name, unit in (
            ("exposure_s", "seconds"),
            ("read_noise_e", "electrons"),
            ("prnu", "a fraction"),
            ("dsnu_e", "electrons"),
            ("black_level", "DN"),
        ):
            self._require(name, 0.0, unit, strict=False)
        self._require("full_well_e", 0.0, "electrons", strict=True)
        self._require("gain", 0.0, "1 = white fills the range", strict=True)
        if isinstance(self.bit_depth, bool) or self.bit_depth not in range(8, 17):
            raise ConfigError(f"FrameCamera.bit_depth is {self.bit_depth!r}; give 8 to 16 bits")
        if self.black_level >= self.white:
            raise ConfigError(
                f"FrameCamera.black_level is {self.black_level:g}; give less than white, {self.white} DN"
            )
        if self.pattern_seed is not None:
            check_seed(self.pattern_seed)
        if self.electrons_per_s is not None:
            self._require("electrons_per_s", 0.0, "electrons per second", strict=True)
            self._require("exposure_s", 0.0, "seconds, as electrons are collected over it", strict=True)
        super().__post_init__()

    def _require(self, name: str, low: float, unit: str, *, strict: bool) -> None:
        value = getattr(self, name)
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < low or (strict and value == low):
            limit = f"more than {low:g}" if strict else f"at least {low:g}"
            raise ConfigError(f"FrameCamera.{name} is {value!r}; give {limit} ({unit})")

    @property
    def white_e(self) -> float:
        """Mean number of electrons that a pixel collects at white, were its well deep enough."""
        if self.electrons_per_s is None:
            return self.full_well_e
        return self.electrons_per_s * self.exposure_s

    @property
    def dn_per_electron(self) -> float:
        """Digital numbers that an electron adds."""
        return (self.white - self.black_level) * self.gain / self.full_well_e

    def per_light(self) -> FrameCamera:
        """Return the camera whose noise is that of this one in white levels of the light, not of the frame.

        Where electrons are collected over the exposure, a frame shows electrons_per_s exposure_s / full_well_e
        times the light. White of that camera is 1 / gain, in light.
        """
        share = self.white_e / self.full_well_e
        return replace(self, full_well_e=self.white_e, gain=self.gain * share, electrons_per_s=None)

    def noise_variance(self, light: torch.Tensor, frames: int = 1, fpn_corrected: bool = True) -> torch.Tensor:
        """Return the variance of the noise at a mean light: shot, read, rounding, fixed pattern.

        var(E) = (E / N + (r / N)^2 + q^2) / frames + pattern, N the full well, r the read noise, q the rounding
        to digital numbers over sqrt(12), in white levels; the pattern (sensitivity and offset) does not average
        out.

        Args:
            light: Mean light, white levels, [...].
            frames: Frames that are averaged.
            fpn_corrected: Whether the fixed pattern was measured and taken off.

        Returns:
            Variance, white levels squared, [...].

        Example:
            >>> camera = FrameCamera(full_well_e=10_000.0, read_noise_e=0.0, bit_depth=16)
            >>> round(float(camera.noise_variance(torch.tensor(0.25))) ** 0.5, 4)
            0.005
        """
        well = self.full_well_e
        rounding = 1 / ((self.white - self.black_level) * self.gain) ** 2 / 12
        variance = (light.clamp(min=0) / well + (self.read_noise_e / well) ** 2 + rounding) / frames
        return variance if fpn_corrected else variance + self.pattern_variance(light)

    def pattern_variance(self, light: torch.Tensor) -> torch.Tensor:
        """Return the variance of the fixed pattern at a mean light [...], white levels squared."""
        return (self.prnu * light) ** 2 + (self.dsnu_e / self.full_well_e) ** 2

    def shows(self, light: torch.Tensor) -> torch.Tensor:
        """Return where a frame tells light [...], white levels, from more: below the largest number."""
        return light < 1 / self.gain

    def _frame(
        self, image: NDArray[np.float64], seed: int, number: int, pattern: tuple[NDArray, NDArray]
    ) -> NDArray:
        sensitivity, offset_e = pattern
        mean = self.white_e * sensitivity * image
        if self.electrons_per_s is not None:
            np.minimum(mean, self.full_well_e, out=mean)
        levels = np.empty_like(mean)
        fill_electrons(
            mean.ravel(),
            offset_e.ravel(),
            self.read_noise_e,
            np.uint64(seed),
            np.uint64(number),
            levels.ravel(),
        )
        levels *= self.dn_per_electron
        levels += self.black_level
        return np.clip(np.rint(levels, out=levels), 0, self.white, out=levels)

    def fixed_pattern(
        self, shape: tuple[int, int], seed: int = 0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return this camera's fixed pattern: relative sensitivity and offset in electrons, [H, W] each.

        Args:
            shape: Sensor size (height, width), pixels.
            seed: Seed of the capture; used when `pattern_seed` is None.
        """
        own = check_seed(seed) if self.pattern_seed is None else self.pattern_seed
        draw = np.random.Generator(np.random.Philox(np.random.SeedSequence([own, 0])))
        sensitivity = np.maximum(1.0 + self.prnu * draw.standard_normal(shape), 0.0)
        return sensitivity, self.dsnu_e * draw.standard_normal(shape)


@FrameCameraSettings.registry.register
@dataclass(frozen=True)
class LogFrameCamera(LogResponse, FrameCameraSettings):
    """Frames of logarithmic pixels, as CeleX-V's mode F makes them: of all pixels at one instant.

    `capture` returns codes, as files hold them; `codes` says what they mean, and `linear_levels` makes light
    of them. Pixels follow the light at once and have no dark light; `CelexCamera` has both. The noise of the
    light is a share of it, whatever the light: sigma_E = E sigma_code / codes_per_efold, sigma_code from
    `noise_codes` and the rounding to 12 or 8 bits (1 or 16 codes, over sqrt(12)).

    Raises:
        ConfigError: A value outside its range, or white light that has no code.

    Example:
        >>> camera = LogFrameCamera(600.0, 2048.0, 60.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        >>> camera.expose(np.full((1, 1, 1), 60 / 255 * math.e))
        array([[[2648]]], dtype=uint16)
    """

    codes_per_efold: float = 600.0
    """Codes of 12 bits per log unit of light."""
    mid_code: float = 2048.0
    """Code of the light `mid_dn`, 12 bits."""
    mid_dn: float = 60.0
    """Light of the code `mid_code`, DN (255 = white)."""
    gain_mismatch: float = 0.02
    """Standard deviation of the pixels' gain, fraction."""
    pattern_codes: float = 100.0
    """Standard deviation of the fixed pattern, codes of 12 bits."""
    row_codes: float = 20.0
    """Standard deviation of the rows, codes of 12 bits."""
    column_codes: float = 20.0
    """Standard deviation of the columns, codes of 12 bits."""
    noise_codes: float = 10.0
    """Standard deviation of the noise of each code, codes of 12 bits."""
    bit_depth: int = 12
    """Bits of a code: 12, or 8, without the lower four."""
    pattern_seed: int | None = 0
    """Seed of the fixed pattern; None = a new pattern for each capture."""
    kind: Literal["log"] = "log"
    """Kind of this frame camera."""

    def __post_init__(self) -> None:
        self._check_response()
        check_seed(0 if self.pattern_seed is None else self.pattern_seed)
        if isinstance(self.bit_depth, bool) or self.bit_depth not in (8, 12):
            raise ConfigError(f"LogFrameCamera.bit_depth is {self.bit_depth!r}; give 8 or 12 bits")
        try:
            _ = self.codes
        except ConfigError as error:
            raise ConfigError(f"LogFrameCamera has codes that do not fit: {error}") from None
        super().__post_init__()

    @property
    def peak(self) -> int:
        """Number of white light in `linear_levels`."""
        return 65_535

    def linear_levels(self, frames: NDArray) -> NDArray[np.uint8 | np.uint16]:
        """Return codes [...] as numbers that are proportional to light, 65535 = white."""
        return self.codes.levels(frames)

    @property
    def relative_noise(self) -> float:
        """Standard deviation of the light that a code stands for, over that light: noise and rounding."""
        step = 2.0 ** (12 - self.bit_depth)
        return math.sqrt(self.noise_codes**2 + step**2 / 12) / self.codes_per_efold

    def noise_variance(self, light: torch.Tensor, frames: int = 1, fpn_corrected: bool = True) -> torch.Tensor:
        """Return the variance of the noise at a mean light: (E relative_noise)^2, and rounding to levels.

        Light darker than that of code 0 is read as that, and counts as noisy as it.

        Args:
            light: Mean light, white levels, [...].
            frames: Frames that are averaged.
            fpn_corrected: Whether the fixed pattern was measured and taken off.

        Example:
            >>> camera = LogFrameCamera(codes_per_efold=500.0, noise_codes=10.0)
            >>> round(float(camera.noise_variance(torch.tensor(0.25))) ** 0.5, 4)
            0.005
        """
        seen = light.clamp(min=self._darkest)
        variance = ((seen * self.relative_noise) ** 2 + 1 / self.peak**2 / 12) / frames
        return variance if fpn_corrected else variance + self.pattern_variance(light)

    def pattern_variance(self, light: torch.Tensor) -> torch.Tensor:
        """Return the variance of the fixed pattern at a mean light [...], white levels squared."""
        seen = light.clamp(min=self._darkest)
        codes = math.hypot(self.pattern_codes, self.row_codes, self.column_codes) / self.codes_per_efold
        away = seen.log() - math.log(self.mid_dn / WHITE_DN)
        return seen**2 * ((self.gain_mismatch * away) ** 2 + codes**2)

    def shows(self, light: torch.Tensor) -> torch.Tensor:
        """Return where a code tells light [...], white levels: between those of code 0 and of white."""
        return (light > self._darkest) & (light < 1)

    @property
    def _darkest(self) -> float:
        return float(self.codes.light(0))

    def fixed_pattern(
        self, shape: tuple[int, int], seed: int = 0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return this camera's fixed pattern: gain 1 + g, and f + r + c in codes of 12 bits, [H, W] each.

        Args:
            shape: Sensor size (height, width), pixels.
            seed: Seed of the capture; used when `pattern_seed` is None.
        """
        return self._pattern(shape, check_seed(seed) if self.pattern_seed is None else self.pattern_seed)

    def _frame(
        self, image: NDArray[np.float64], seed: int, number: int, pattern: tuple[NDArray, NDArray]
    ) -> NDArray:
        draw = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, number, 2])))
        level = np.log(np.maximum(WHITE_DN * image.ravel(), 1e-12))
        codes = self._values(level, slice(None), draw.standard_normal(image.size), pattern)
        return (codes >> (12 - self.bit_depth)).reshape(image.shape)


def _checked(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return light, refusing what is none."""
    if light.size:
        check_extremes(light.min(), light.max())
    return light


def check_extremes(lowest: float, highest: float) -> None:
    """Refuse light of which an extreme is not finite, or below 0."""
    if not (lowest >= 0 and highest < math.inf):  # false for NaN, which an extreme keeps
        raise DataError("irradiance holds NaN, infinity or negative light; give at least 0, 1.0 = white")


def colour_filters(mosaic: Mosaic, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which pixels see red, green and blue behind Bayer's mosaic, bool [3, H, W].

    Args:
        mosaic: The first 2 x 2 pixels, row by row.
        shape: Size (H, W) of the sensor, pixels.

    Example:
        >>> colour_filters("rggb", (2, 4)).sum(axis=(1, 2))
        array([2, 4, 2])
    """
    square = np.array([["rgb".index(one) for one in mosaic[row : row + 2]] for row in (0, 2)])
    seen = np.tile(square, [-(-side // 2) for side in shape])[: shape[0], : shape[1]]
    return seen == np.arange(3)[:, None, None]


def mosaicked(pictures: NDArray, mosaic: Mosaic) -> NDArray:
    """Return what a sensor with colour filters has of coloured pictures [..., H, W, 3]: [..., H, W].

    Args:
        pictures: Coloured pictures (red, green, blue), of any unit, [..., H, W, 3].
        mosaic: Pattern of the filters.
    """
    seen = np.moveaxis(colour_filters(mosaic, pictures.shape[-3:-1]), 0, -1)  # type: ignore[arg-type]
    return np.where(seen, pictures, 0).sum(axis=-1, dtype=pictures.dtype)


def of_mosaic(raw: NDArray, mosaic: Mosaic, colour: Colour | None = None) -> NDArray[np.uint16]:
    """Return one colour of raw values behind a mosaic, or their grey, at every pixel.

    With m the pixels of the colour and k the kernel (1 2 1)^T (1 2 1), for green without its corners, the
    colour is (k * (m raw)) / (k * m): bilinear, and exact on m. Grey is the luma of the three (Rec. 601),
    and white where a pixel's own value is: what is clipped stays so. Beyond the border the sensor is mirrored
    about its last pixels, which keeps the mosaic.

    Args:
        raw: Digital numbers, uint8 or uint16 [..., H, W], at least 2 x 2 pixels.
        mosaic: Its colour filters.
        colour: The colour; None is grey.

    Returns:
        uint16 [..., H, W]; of 8 bits times 257, so that white stays white.

    Raises:
        DataError: Fewer than 2 x 2 pixels.

    Example:
        >>> of_mosaic(np.array([[4, 2], [2, 1]], np.uint8) * 20, "rggb", "green") // 257
        array([[40, 40],
               [40, 40]], dtype=uint16)
    """
    if min(raw.shape[-2:]) < 2:
        raise DataError(f"a mosaic of {raw.shape[-2]} x {raw.shape[-1]} pixels; give 2 x 2 or more")
    values = raw.astype(np.float32) * (257 if raw.dtype == np.uint8 else 1)
    filters = colour_filters(mosaic, raw.shape[-2:]).astype(np.float32)  # type: ignore[arg-type]
    shares = np.array(LUMA_601) / 1000 if colour is None else [float(one == colour) for one in COLOURS]
    found = np.zeros(raw.shape, np.float32)
    for k, (mask, share) in enumerate(zip(filters, shares, strict=True)):
        if share:
            found += np.float32(share) * _around(values * mask, k != 1) / _around(mask, k != 1)
    levels = np.rint(found).astype(np.uint16)
    if colour is None:
        levels[raw >= np.iinfo(raw.dtype).max] = 65_535
    return levels


def _around(image: NDArray[np.float32], corners: bool) -> NDArray[np.float32]:
    """Return an image [..., H, W] convolved with (1 2 1)^T (1 2 1), or that without corners; mirrored."""
    padded = np.pad(image, [(0, 0)] * (image.ndim - 2) + [(1, 1), (1, 1)], mode="reflect")
    height, width = image.shape[-2:]
    found = np.zeros_like(image)
    for down, right in np.ndindex(3, 3):
        weight = (2 - abs(down - 1)) * (2 - abs(right - 1))
        if corners or weight > 1:
            found += np.float32(weight) * padded[..., down : down + height, right : right + width]
    return found
