"""The settings of v2e's pixel: solved in continuous time (`EventPixel`), or frame by frame (`V2ePixel`).

- The codes of pixels whose log light is read out: what makes them, and the light that they stand for.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import (
    EVENT_MODELS,
    KNEE_DN,
    CrossingLaw,
    EventModel,
    LogCurve,
    Phase,
    PixelSettings,
    ThresholdPixel,
    check_pattern_seed,
    check_phase,
    require,
)
from evnlos.cameras.streams import WHITE_DN
from evnlos.errors import ConfigError, DataError

if TYPE_CHECKING:
    from evnlos.cameras.pixels.continuous_math import Curve

MAX_JITTER = 9
"""Standard deviations that the normal random numbers can reach."""

Logarithm = Literal["lin-log", "true"]
"""v2e's logarithm, which is a line below 20 DN, or a true one."""
Mode = Literal["exact", "v2e"]
"""How v2e's pixel sees time: solved in continuous time, or stepped from frame to frame as v2e does."""


@dataclass(frozen=True)
class _ContrastPixel(ThresholdPixel):
    """What both ways to run v2e's pixel share."""

    cutoff_hz: float = 15.0
    """Corner frequency of the low-pass filter at white, hertz; 0 = no filter."""
    leak_rate_hz: float = 0.01
    """Rate of ON events from the leaking reference, hertz per pixel."""
    shot_noise_rate_hz: float = 0.0015
    """Rate of noise events in the dark limit, ON and OFF together, hertz per pixel."""
    refractory_s: float = 0.0
    """Dead time of a pixel after each of its events, seconds."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("cutoff_hz", "leak_rate_hz", "shot_noise_rate_hz"):
            require(self, name, 0.0, math.inf, "hertz; 0 switches it off")
        require(self, "refractory_s", 0.0, math.inf, "seconds; 0 switches it off")

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw:
        """Return what an event says of the light; a crossing of v2e's pixel has no noise of its own."""
        noise_hz = self.shot_noise_rate_hz * (1.0 - 0.75 * min((light_dn + 20.0) / 275.0, 1.0))
        return self._law(events_hz=noise_hz, cutoff_hz=self.cutoff_hz)


@EVENT_MODELS.register
@dataclass(frozen=True)
class EventPixel(_ContrastPixel):
    """Parameters of a logarithmic change-detecting pixel; the defaults are the paper's table of settings.

    The pixel takes the logarithm of the light (linear below 20 DN), smooths it with a low-pass filter whose
    bandwidth grows with the light, and sends an event whenever the result has moved by a threshold since the
    last event (Hu, Liu and Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021). It is
    solved in continuous time; `simulate_events(..., mode="v2e")` steps it from frame to frame instead.

    Args:
        threshold_on: Mean contrast threshold of ON events, log units (e-fold), at least 0.01.
        threshold_off: Mean contrast threshold of OFF events, log units (e-fold), at least 0.01.
        threshold_sigma: Standard deviation of both thresholds over the pixels, log units; 0 = none.
        cutoff_hz: Corner frequency of the low-pass filter at white (255 DN), hertz; 0 = no filter. At black
            it is 20/275 of this.
        leak_rate_hz: Rate of the ON events that the leaking reference makes, events per second per pixel.
        shot_noise_rate_hz: Rate of noise events, ON and OFF together, of a pixel in the dark limit, hertz.
        refractory_s: Time after an event in which a pixel cannot send another one, seconds.
        hot_pixel_fraction: Fraction of pixels that fire without cause, 0 to 1 (`mode="exact"` only).
        hot_pixel_rate_hz: Rate of events of a hot pixel, ON and OFF together, hertz (`mode="exact"` only).
        jitter_s: Standard deviation of the time stamps, seconds (`mode="exact"` only).
        initial_phase: State before the first frame (`mode="exact"` only): "random" = the reference of each
            pixel somewhere between two ON events, "rest" = each as if it had just sent one. No other setting
            changes it, the leak neither.
        pattern_seed: Seed of what belongs to the sensor: thresholds, leak rates, hot pixels. With it they stay
            from recording to recording; None draws them anew from the seed of each recording.
        logarithm: "lin-log" = ln I above 20 DN and a line below, as v2e has it; "true" = ln(I + dark_dn), as a
            photoreceptor has it over more than 100 dB. I is the light at the pixel, exposure times that of the
            scene (`mode="exact"` only, and so the three that follow).
        exposure: DN at the pixel per DN of the light that it is fed, more than 0.
        dark_dn: Dark level of a true logarithm, DN at the pixel, more than 0.
        cutoff_floor_dn: f in the filter's bandwidth, cutoff_hz (I + f) / (255 + f), DN, at least 0.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> EventPixel(threshold_on=0.2).initial_phase, EventPixel(leak_rate_hz=0).initial_phase
        ('random', 'random')
    """

    hot_pixel_fraction: float = 0.0
    """Fraction of pixels that fire without cause, 0 to 1 (mode "exact" only)."""
    hot_pixel_rate_hz: float = 10.0
    """Rate of events of a hot pixel, hertz (mode "exact" only)."""
    jitter_s: float = 0.0
    """Standard deviation of the time stamps, seconds (mode "exact" only)."""
    initial_phase: Phase = "random"
    """State before the first frame: random = between two events, rest = just after one (mode "exact" only)."""
    pattern_seed: int | None = None
    """Seed of thresholds, leak rates, hot pixels: one sensor for all recordings; None = a new one for each."""
    logarithm: Logarithm = "lin-log"
    """v2e's logarithm, a line below 20 DN, or a true one of the light over a dark level (mode "exact" only)."""
    exposure: float = 1.0
    """DN at the pixel per DN of the light, an exposure of its own (mode "exact" only)."""
    dark_dn: float = 0.0025
    """Dark level of a true logarithm, DN at the pixel; 0.0025 is 100 dB below white."""
    cutoff_floor_dn: float = 20.0
    """What the filter's bandwidth keeps in the dark: it goes with light + this, DN (mode "exact" only)."""
    kind: Literal["continuous"] = "continuous"
    """The event model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "hot_pixel_rate_hz", 0.0, math.inf, "hertz; 0 switches it off")
        require(self, "jitter_s", 0.0, math.inf, "seconds; 0 switches it off")
        require(self, "hot_pixel_fraction", 0.0, 1.0, "a fraction; 0 switches it off")
        check_phase(self.initial_phase)
        check_pattern_seed(self.pattern_seed)
        if self.logarithm not in get_args(Logarithm):
            raise ConfigError(f'EventPixel.logarithm is {self.logarithm!r}; give "lin-log" or "true"')
        for name in ("exposure", "dark_dn"):
            require(self, name, 1e-9, 1e9, "(DN, or DN per DN)")
        require(self, "cutoff_floor_dn", 0.0, 1e9, "DN; v2e's is 20")

    def curve(self) -> Curve:
        """Return the pixel's logarithm as its kernels take it."""
        from evnlos.cameras.pixels.continuous_math import Curve

        exposure, floor = float(self.exposure), float(self.cutoff_floor_dn)
        if self.logarithm == "lin-log":
            return Curve(exposure, 0.0, floor, 1.0, 0.0)
        dark = float(self.dark_dn)
        stretch = 2.0 * KNEE_DN / dark  # all light above the knee
        return Curve(stretch * exposure, stretch * dark, stretch * (floor - dark), stretch, dark)

    @property
    def log_curve(self) -> LogCurve:
        """The logarithm that the camera chooses its time steps by."""
        curve = self.curve()
        return LogCurve(curve.scale, curve.offset)

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw:
        """Return what an event says of the light; see `PixelSettings.crossing_law`."""
        hot = self.hot_pixel_fraction * self.hot_pixel_rate_hz
        plain = super().crossing_law(self.exposure * light_dn)
        return replace(
            plain,
            events_hz=plain.events_hz + hot,
            floor_dn=self.cutoff_floor_dn,
            exposure=self.exposure,
        )

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
        from evnlos.cameras.pixels.arrays import ExactArray

        return ExactArray(self, shape, seed, thresholds, 1024 if tile_px is None else tile_px, threads)

    @property
    def disorder_s(self) -> float:
        """By how much the jitter can turn the order of two events around, seconds."""
        return MAX_JITTER * self.jitter_s


@EVENT_MODELS.register
@dataclass(frozen=True)
class V2ePixel(_ContrastPixel):
    """The same pixel stepped from frame to frame exactly as v2e does, for comparisons with results of v2e.

    Its events depend on the time step: every event of a step carries one of a few times that the busiest pixel
    sets. It starts at rest.

    Args:
        threshold_on: As in `EventPixel`, and so the six that follow.
        threshold_off: Mean contrast threshold of OFF events, log units.
        threshold_sigma: Standard deviation of both thresholds, log units.
        cutoff_hz: Corner frequency at white, hertz; 0 = no filter.
        leak_rate_hz: Rate of ON events from the leaking reference, hertz per pixel.
        shot_noise_rate_hz: Rate of noise events in the dark limit, hertz per pixel.
        refractory_s: Dead time after an event, seconds.
        pattern_seed: Seed of what belongs to the sensor; None draws it anew for each recording.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> V2ePixel.of(EventPixel(threshold_on=0.2)).threshold_on
        0.2
    """

    stepped = True

    pattern_seed: int | None = None
    """Seed of thresholds and leak rates: one sensor for all recordings; None = a new one for each."""
    kind: Literal["v2e"] = "v2e"
    """The event model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pattern_seed(self.pattern_seed)

    @classmethod
    def of(cls, pixel: EventPixel | V2ePixel) -> V2ePixel:
        """Return the stepped pixel with the parameters of another one.

        Raises:
            ConfigError: That one has what v2e lacks: hot pixels, jitter.
        """
        if isinstance(pixel, EventPixel) and (pixel.hot_pixel_fraction > 0 or pixel.jitter_s > 0):
            raise ConfigError('mode="v2e" has no hot pixels and no jitter; set them to 0 or use mode="exact"')
        if isinstance(pixel, EventPixel) and pixel.curve() != (1.0, 0.0, 20.0, 1.0, 0.0):
            raise ConfigError(
                'mode="v2e" has one logarithm, exposure and bandwidth floor; leave them as they are or use '
                'mode="exact"'
            )
        shared = {item.name for item in fields(cls)} - {"kind"}
        return cls(**{name: value for name, value in asdict(pixel).items() if name in shared})

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
        from evnlos.cameras.pixels.arrays import V2eArray

        return V2eArray(self, shape, seed, thresholds, 2048 if tile_px is None else tile_px, threads)


def in_mode(pixel: PixelSettings, mode: str) -> PixelSettings:
    """Return the event model that a pixel and the word `mode` of `simulate_events` mean together.

    Args:
        pixel: Settings of any kind.
        mode: "exact" leaves them as they are; "v2e" turns an `EventPixel` into a `V2ePixel`.

    Raises:
        ConfigError: An unknown mode, no settings of a pixel, or a pixel that v2e cannot step.
    """
    if mode not in get_args(Mode):
        raise ConfigError(f'mode is {mode!r}; give "exact" or "v2e"')
    if not isinstance(pixel, PixelSettings):
        raise ConfigError(f"pixel is {type(pixel).__name__}; give an EventPixel or other settings of a pixel")
    if mode == "exact" or isinstance(pixel, V2ePixel):
        return pixel
    if not isinstance(pixel, EventPixel):
        raise ConfigError(
            f'mode="v2e" is for an EventPixel; the pixel is a {type(pixel).__name__}, leave mode out'
        )
    return V2ePixel.of(pixel)


def continuous(pixel: PixelSettings) -> EventPixel:
    """Return the settings of a continuous pixel as such.

    Raises:
        ConfigError: They are of another kind.
    """
    if not isinstance(pixel, EventPixel):
        raise ConfigError(f"the pixel is of kind {getattr(pixel, 'kind', '?')!r}; this needs kind continuous")
    return pixel


LOG_WHITE = 4095
"""Largest code of a logarithmic pixel."""


@dataclass(frozen=True)
class LogCodes:
    """Codes of logarithmic pixels: a code y of 12 bits is of the light exp((y - white_code) / codes_per_efold).

    Codes of 8 bits lack the lower four: y = 16 code + 7.5, the middle of what they stand for.

    Args:
        codes_per_efold: Codes of 12 bits per log unit of light.
        white_code: Code of 12 bits that white light, 1.0, has.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> LogCodes(600.0, 2916.0).light(np.array([2916, 2316], np.uint16)).round(4).tolist()
        [1.0, 0.3679]
    """

    codes_per_efold: float
    """Codes of 12 bits per log unit (e-fold) of light, of files of 8 bits, too."""
    white_code: float
    """Code of 12 bits that counts as white; what is brighter is clipped."""

    def __post_init__(self) -> None:
        require(self, "codes_per_efold", 10.0, 1e5, "codes of 12 bits per log unit of light")
        require(self, "white_code", 1.0, LOG_WHITE, "of the 4096 codes of 12 bits")

    def light(self, codes: ArrayLike) -> NDArray[np.float64]:
        """Return the light that codes stand for, 1.0 = white, not clipped.

        Args:
            codes: uint8 for codes of 8 bits, else codes of 12 bits, [...].
        """
        codes = np.asarray(codes)
        fine = codes * 16.0 + 7.5 if codes.dtype == np.uint8 else codes
        return np.exp((fine - self.white_code) / self.codes_per_efold)

    def levels(self, frames: NDArray, what: str = "") -> NDArray[np.uint16]:
        """Return frames as numbers that are proportional to light, 65535 = white; clipped there.

        Args:
            frames: Codes, uint8 (8 bits) or uint16 (12 bits) [...].
            what: What they were read from, for a message.

        Raises:
            DataError: A code of more than 12 bits.
        """
        count = 256 if frames.dtype == np.uint8 else LOG_WHITE + 1
        if frames.size and (largest := int(frames.max())) >= count:
            raise DataError(
                f"{what}a log frame holds the code {largest}; codes of 12 bits end at {LOG_WHITE}: save them "
                "unscaled, or leave camera.log out where the frames are linear"
            )
        light = np.minimum(self.light(np.arange(count).astype(frames.dtype)), 1.0)
        return np.rint(light * 65_535).astype(np.uint16)[frames]


class LogResponse:
    """Base of what turns log light into codes with a fixed pattern, by the equation of `CelexCamera`."""

    codes_per_efold: float
    mid_code: float
    mid_dn: float
    gain_mismatch: float
    pattern_codes: float
    row_codes: float
    column_codes: float
    noise_codes: float

    @property
    def codes(self) -> LogCodes:
        """What the codes mean, but for the fixed pattern."""
        white = self.mid_code + self.codes_per_efold * math.log(WHITE_DN / self.mid_dn)
        return LogCodes(self.codes_per_efold, white)

    def _check_response(self) -> None:
        for name in ("codes_per_efold", "mid_dn"):
            require(self, name, 1e-6, 1e6, "(positive)")
        for name in ("gain_mismatch", "pattern_codes", "row_codes", "column_codes", "noise_codes"):
            require(self, name, 0.0, 4096.0, "(0 switches it off)")
        require(self, "mid_code", -1e6, 1e6, "digital numbers of 12 bits")

    def _pattern(self, shape: tuple[int, int], seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gain 1 + g, and f + r + c in codes of 12 bits, [H, W] each."""
        draw = np.random.default_rng([seed, 3])
        gain = 1.0 + self.gain_mismatch * draw.standard_normal(shape)
        offset = self.pattern_codes * draw.standard_normal(shape)
        offset += self.row_codes * draw.standard_normal((shape[0], 1))
        offset += self.column_codes * draw.standard_normal((1, shape[1]))
        return gain, offset

    def _values(
        self, level: NDArray, place: NDArray | slice, noise: NDArray, pattern: tuple[NDArray, NDArray]
    ) -> NDArray[np.uint16]:
        """Return the codes of pixels `place` at log levels [N], ln DN, with normal random numbers [N]."""
        gain, offset = (part.ravel()[place] for part in pattern)
        value = self.mid_code + self.codes_per_efold * gain * (level - math.log(self.mid_dn)) + offset
        return np.clip(np.rint(value + self.noise_codes * noise), 0, LOG_WHITE).astype(np.uint16)
