"""Sensors that exist: settings of pixels with the source of every number, and CeleX-V, the paper's camera.

A data sheet quotes a contrast c as a fraction of the light. An ON threshold is ln(1 + c). An OFF threshold is
-ln(1 - c) where c is a fraction of the light before, and ln(1 + c) where it is one of the darker light, as the
maker of the Prophesee sensors defines it: 100 % (L_max - L_min) / L_min ("Event-based vision sensor
characteristics", Prophesee support pages). Where no source is named, the number is an assumption for indoor
light: bandwidth and noise of real sensors depend on their biases and on the light, so fit them to a recording
when they matter.

CeleX-V, the paper's camera: events with the log level of their pixel, and frames of the same pixels.

With x the filtered log light of a pixel, ln(I + dark), an event that is granted at t, and a frame at t, hold

    y = clip(round(B + G (1 + g) (x(t) - ln I_B) + f + r_row + c_column + s n), 0, 4095)

with n normal. The camera's software takes the sign of the value less the pixel's last value for the polarity;
its store begins with zeros, so that a pixel's first event is ON, and an equal value has no polarity. The
figures are guesses within published ranges (12 bits over 120 dB, patterns of log pixels), no data sheet.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import EVENT_MODELS, CrossingLaw, EventModel, LogCurve, PixelSettings
from evnlos.cameras.pixel import EventPixel, LogResponse, continuous
from evnlos.cameras.pixels.brownian import BrownianPixel
from evnlos.cameras.pixels.readout import LogLevel, ReadoutPixel, ValuesArray
from evnlos.cameras.random_numbers import check_seed
from evnlos.cameras.streams import Frames, check_light, check_times
from evnlos.config import load_yaml
from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.types import Events


def paper() -> EventPixel:
    """Return the settings of Wang et al., arXiv 2404.05977, Table 1; leak 0.01 Hz and refractory 0 are ours.

    Example:
        >>> paper() == EventPixel()
        True
    """
    return EventPixel(0.15, 0.15, 0.03, 15.0, 0.01, 0.0015, 0.0)


def v2e_clean() -> EventPixel:
    """Return v2e's parameter set "clean": no noise, no filter, slight mismatch (v2e, `set_dvs_params`)."""
    return EventPixel(0.2, 0.2, 0.02, 0.0, 0.0, 0.0, 0.0, initial_phase="rest")


def v2e_noisy() -> EventPixel:
    """Return v2e's parameter set "noisy": a dim scene (v2e, `set_dvs_params`)."""
    return EventPixel(0.2, 0.2, 0.05, 30.0, 0.1, 5.0, 0.0)


def davis346() -> EventPixel:
    """Return a DAVIS346: contrast 14.3 to 22.5 % (Gallego et al., TPAMI 2020, Table 1), taken as ON and OFF.

    Mismatch 3.5 % of contrast (Brandli et al., JSSC 2014, for the DAVIS240); bandwidth, noise and refractory
    period are assumed, and so is that the OFF contrast is a fraction of the light before.
    """
    return EventPixel(_brighter(0.143), _darker(0.225), 0.035, 200.0, 0.1, 1.0, 5e-4)


def prophesee_gen3() -> EventPixel:
    """Return a Prophesee Gen3 VGA CD: contrast 12 % of the darker light (Gallego et al., TPAMI 2020, Table 1).

    The bandwidth is that of the slowest quoted latency, 200 us; the rest is assumed.
    """
    return EventPixel(_brighter(0.12), _brighter(0.12), 0.03, _cutoff(200e-6), 0.1, 0.5, 3e-4)


def prophesee_gen4() -> EventPixel:
    """Return a Prophesee Gen4 HD CD: contrast 11 % of the darker light (Gallego et al., TPAMI 2020, Table 1).

    The bandwidth is that of the slowest quoted latency, 150 us; the rest is assumed.
    """
    return EventPixel(_brighter(0.11), _brighter(0.11), 0.03, _cutoff(150e-6), 0.1, 0.5, 2e-4)


def celex_v() -> EventPixel:
    """Return a CeleX-V: contrast 10 % (Gallego et al., TPAMI 2020, Table 1); all else is assumed."""
    return EventPixel(_brighter(0.10), _darker(0.10), 0.03, 200.0, 0.2, 1.0, 5e-4)


def voltmeter_dvs346() -> BrownianPixel:
    """Return DVS-Voltmeter's DAVIS346 (Lin et al., ECCV 2022, published code): a Brownian pixel."""
    return BrownianPixel.voltmeter(5.265, 20.0, 1e-4, 1e-7, 5e-9, 1e-5)


def voltmeter_dvs240() -> BrownianPixel:
    """Return DVS-Voltmeter's DAVIS240 (Lin et al., ECCV 2022, published code): a Brownian pixel."""
    return BrownianPixel.voltmeter(4.4241, 23.0, 2e-4, 1e-7, 5e-8, 1e-5)


PRESETS: dict[str, Callable[[], EventPixel | BrownianPixel]] = {
    preset.__name__: preset
    for preset in (
        paper,
        v2e_clean,
        v2e_noisy,
        davis346,
        prophesee_gen3,
        prophesee_gen4,
        celex_v,
        voltmeter_dvs346,
        voltmeter_dvs240,
    )
}
"""All presets by name."""


def pixel_preset(name: str) -> EventPixel | BrownianPixel:
    """Return the preset of this name, in small or capital letters.

    Raises:
        ConfigError: There is no such preset; the nearest is named.

    Example:
        >>> pixel_preset("davis346").threshold_on
        0.1337
    """
    if name.lower() not in PRESETS:
        near = difflib.get_close_matches(name.lower(), PRESETS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"give one of {', '.join(PRESETS)}"
        raise UnknownNameError(f"there is no pixel preset {name!r}; {hint}")
    return PRESETS[name.lower()]()


def load_pixel(word: str) -> PixelSettings:
    """Return the pixel that a preset's name or a YAML file means: the one resolver of `--pixel`.

    Args:
        word: Name of a preset, or path of a file (.yaml) with the settings of any event model, as `evnlos pixel
            fit` writes it.

    Raises:
        ConfigError: There is no such preset, or the file does not fit.

    Example:
        >>> load_pixel("paper").threshold_on
        0.15
    """
    if Path(word).suffix in (".yaml", ".yml"):
        return load_yaml(PixelSettings, word)
    return pixel_preset(word)


def _brighter(contrast: float) -> float:
    """Return the threshold, log units, of a contrast in fractions of the darker light."""
    return round(math.log1p(contrast), 4)


def _darker(contrast: float) -> float:
    """Return the threshold, log units, of a fall by a fraction of the light before."""
    return round(-math.log1p(-contrast), 4)


def _cutoff(latency_s: float) -> float:
    """Return the corner frequency of a first-order low-pass filter with this time constant, hertz."""
    return round(1.0 / (2.0 * math.pi * latency_s), 1)


class CelexRecording(NamedTuple):
    """Events as the camera's software gives them, and what it does not know."""

    events: Events
    """With `adc`, the value of 12 bits; `p` and `polarity_known` as the software derives them from it."""
    polarity: NDArray[np.bool_]
    """True polarity of each event: True = brighter."""


def _pixels() -> ReadoutPixel:
    pixel = EventPixel(
        0.1, 0.1, 0.02, 200.0, 0.2, 0.0, logarithm="true", dark_dn=0.01, cutoff_floor_dn=1.0, pattern_seed=0
    )
    return ReadoutPixel(pixel, "row", 5e-7, 2e-8, pattern_seed=0)


@dataclass(frozen=True)
class CelexCamera(LogResponse):
    """Logarithmic pixels that are read in two ways: events with 12-bit values (EI), and frames (F).

    Args:
        pixel: The event pixels: a continuous pixel with a true logarithm, with or without a readout behind it.
        codes_per_efold: G, digital numbers of 12 bits per log unit of light.
        mid_code: B, value at the light `mid_dn`.
        mid_dn: I_B, DN at the pixel.
        gain_mismatch: Standard deviation of g over the pixels.
        pattern_codes: Standard deviation of the fixed pattern f, digital numbers of 12 bits.
        row_codes: That of the rows, r.
        column_codes: That of the columns, c.
        noise_codes: s, standard deviation of the noise of each value.
        pattern_seed: Seed of g, f, r and c: they belong to the camera.

    Raises:
        ConfigError: A value outside its range, or pixels without a true logarithm.

    Example:
        >>> camera = CelexCamera(gain_mismatch=0, pattern_codes=0, row_codes=0, column_codes=0, noise_codes=0)
        >>> camera.capture(np.full((2, 1, 1), 59.99 * math.e), [0.0, 1.0], [0.5], bits=12)
        array([[[2648]]], dtype=uint16)
    """

    pixel: PixelSettings = field(default_factory=_pixels)
    """The event pixels."""
    codes_per_efold: float = 600.0
    """Digital numbers of 12 bits per log unit of light."""
    mid_code: float = 2048.0
    """Value at the light `mid_dn`, digital numbers of 12 bits."""
    mid_dn: float = 60.0
    """Light of the value `mid_code`, DN at the pixel."""
    gain_mismatch: float = 0.02
    """Standard deviation of the pixels' gain, fraction."""
    pattern_codes: float = 100.0
    """Standard deviation of the fixed pattern, digital numbers of 12 bits."""
    row_codes: float = 20.0
    """Standard deviation of the rows, digital numbers of 12 bits."""
    column_codes: float = 20.0
    """Standard deviation of the columns, digital numbers of 12 bits."""
    noise_codes: float = 10.0
    """Standard deviation of the noise of each value, digital numbers of 12 bits."""
    pattern_seed: int = 0
    """Seed of the fixed pattern."""

    def __post_init__(self) -> None:
        self._check_response()
        check_seed(self.pattern_seed)
        if self._photoreceptor.logarithm != "true":
            raise ConfigError('CelexCamera.pixel is lin-log; give an EventPixel with logarithm="true"')

    @property
    def _photoreceptor(self) -> EventPixel:
        return continuous(self.pixel.pixel if isinstance(self.pixel, ReadoutPixel) else self.pixel)

    def record(self, frames: ArrayLike, times_s: ArrayLike, seed: int = 0) -> CelexRecording:
        """Return the EI events of light that is linear in time between the frames.

        Args:
            frames: Light in DN (255 = white), [T, H, W], at least 0.
            times_s: Instants of the frames, [T], seconds, ascending.
            seed: Seed of the noise.

        Raises:
            DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        """
        light = check_light(frames)
        times = check_times(times_s, len(light))
        if len(times) < 2:
            raise DataError(f"frames has {len(times)} instants; a recording needs at least two")
        height, width = light.shape[1:]
        rows = np.ascontiguousarray(light).reshape(len(light), height * width)
        array = self.model(self.pixel.model((height, width), check_seed(seed)), (height, width), seed)
        array.start(rows[0], float(times[0]))
        (t_us, place, polarity), values, sign = array.read(Frames(rows[1:]), times[1:])
        y, x = np.divmod(place, width)
        events = Events(t_us, x, y, sign > 0, width, height, adc=values, polarity_known=sign != 0)
        return CelexRecording(events, polarity)

    def capture(
        self, frames: ArrayLike, times_s: ArrayLike, instants_s: ArrayLike, bits: int = 8, seed: int = 0
    ) -> NDArray[np.uint8 | np.uint16]:
        """Return F frames: all pixels at one instant, their fixed pattern uncorrected.

        Args:
            frames: Light in DN, as in `record`.
            times_s: Its instants, [T], seconds.
            instants_s: Instants of the frames, [N], seconds, within those of the light.
            bits: 12, or 8: the lower four are left out.
            seed: Seed of the noise.

        Returns:
            Values [N, H, W], uint8 or uint16, brighter = greater.

        Raises:
            DataError: Wrong shapes or times, or another number of bits.
        """
        if bits not in (8, 12):
            raise DataError(f"bits is {bits}; give 8 or 12")
        light = check_light(frames)
        times = check_times(times_s, len(light))
        instants = np.atleast_1d(np.asarray(instants_s, np.float64))
        if not (instants >= times[0]).all() or not (instants <= times[-1]).all():
            raise DataError(f"instants_s leave the light's {times[0]:g} to {times[-1]:g} s; give times within")
        shape = light.shape[1:]
        rows = light.reshape(len(light), -1)
        draw = np.random.default_rng([check_seed(seed), 2])
        values = np.empty((len(instants), rows.shape[1]), np.uint16)
        level, pattern = LogLevel(self._photoreceptor, rows[0]), self.pattern((shape[0], shape[1]))
        steps, next_frame = np.diff(times, prepend=times[0] - 1.0), np.searchsorted(times, instants, "left")
        for k, row in enumerate(rows):
            level.step(row, steps[k])
            for n in np.flatnonzero(next_frame == k):
                now = level.at(1.0 - (times[k] - instants[n]) / steps[k])
                values[n] = self._values(now, slice(None), draw.standard_normal(len(row)), pattern)
        whole = values.reshape(len(instants), *shape)
        return whole if bits == 12 else (whole >> 4).astype(np.uint8)

    def pattern(self, shape: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the camera's fixed pattern: gain 1 + g, and f + r + c in digital numbers, [H, W] each.

        Args:
            shape: Sensor size (height, width), pixels.
        """
        return self._pattern(shape, self.pattern_seed)

    def model(self, array: EventModel, shape: tuple[int, int], seed: int) -> ValuesArray:
        """Return an array of the camera's event pixels with the software behind it.

        Args:
            array: The event pixels.
            shape: Sensor size (height, width), pixels.
            seed: Seed of the values' noise.
        """
        return ValuesArray(array, self._photoreceptor, partial(self._values, pattern=self.pattern(shape)), seed)


@EVENT_MODELS.register
@dataclass(frozen=True)
class CelexPixel(PixelSettings):
    """The event pixels of a `CelexCamera`, with the polarity that its software derives from their values.

    Events whose value is their pixel's last one have no polarity and are left out.

    Args:
        camera: The camera; its pixels have no jitter and no ticks.

    Raises:
        ConfigError: They have.

    Example:
        >>> CelexPixel().camera.codes_per_efold
        600.0
    """

    camera: CelexCamera = field(default_factory=CelexCamera)
    """The camera whose software gives the events their polarity."""
    kind: Literal["celex"] = "celex"
    """The event model."""

    def __post_init__(self) -> None:
        if self.camera.pixel.disorder_s > 0 or getattr(self.camera.pixel, "tick_s", 0.0) > 0:
            raise ConfigError("CelexPixel.camera.pixel has jitter or ticks; set jitter_s and tick_s to 0")

    def model(
        self,
        shape: tuple[int, int],
        seed: int = 0,
        thresholds: object = None,
        *,
        tile_px: int | None = None,
        threads: int | None = None,
    ) -> EventModel:
        """Return an array of such pixels; arguments as in `PixelSettings.model`."""
        array = self.camera.pixel.model(shape, seed, thresholds, tile_px=tile_px, threads=threads)
        return self.camera.model(array, shape, seed)

    @property
    def finest_threshold(self) -> float:
        """That of the camera's pixels, log units."""
        return self.camera.pixel.finest_threshold

    @property
    def log_curve(self) -> LogCurve:
        """That of the camera's pixels."""
        return self.camera.pixel.log_curve

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw | None:
        """Return that of the camera's pixels; of wrong polarities it knows nothing."""
        return self.camera.pixel.crossing_law(light_dn)
