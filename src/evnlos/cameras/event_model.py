"""What an event model is: settings of a pixel, and an array of such pixels that light is fed to.

An event model has two halves. Its settings are a frozen dataclass derived from `PixelSettings`, with units and
a `kind`; they stand in a simulation's YAML file and decide the physics alone. Its array is an `EventModel`,
made by `settings.model(...)`: it holds the pixels' state, takes the light from instant to instant and returns
events. `EVENT_MODELS` knows the kinds; installed packages add theirs by an entry point of the group
`evnlos.event_models`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.registry import Kinded, Registry

if TYPE_CHECKING:
    from evnlos.cameras.streams import Columns, Light

Phase = Literal["random", "rest"]
"""State of the pixels before the first frame: anywhere between two events, or as if one had just been sent."""

MIN_THRESHOLD = 0.01
"""Smallest threshold that mismatch can leave a pixel with, log units."""

KNEE_DN = 20.0
"""Light below which v2e's logarithm is a line, DN."""
KNEE_SLOPE = math.log(KNEE_DN) / KNEE_DN
"""Its slope there, log units per DN."""

EVENT_MODELS: Registry[type[PixelSettings]] = Registry("evnlos.event_models", "event model")
"""The event models by kind."""


class EventModel(ABC):
    """An array of event pixels with its state: `start` it with the first light, then `advance` it.

    The events must not depend on how the light is divided into calls of `advance`, and every random draw must
    be a function of the seed, the pixel and a count.
    """

    @abstractmethod
    def start(self, frame: NDArray, time_s: float) -> None:
        """Take the first light.

        Args:
            frame: Light of all pixels in DN (255 = white), [H * W].
            time_s: Its instant, seconds.
        """

    @abstractmethod
    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take further light and return the events of the time up to the last instant, in order.

        Args:
            light: Light in DN at `times_s`, linear in time between the instants.
            times_s: Instants [T], seconds, ascending, after those before.

        Returns:
            Time stamps in microseconds, flat pixel indices, polarities; ordered by time, pixel, polarity.
        """


class LogCurve(NamedTuple):
    """The logarithm that a pixel takes: of `scale * I + offset`, linear below `KNEE_DN` of that."""

    scale: float
    """Factor of the light in DN."""
    offset: float
    """What is added, DN."""


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """What is known of the thresholds of each pixel of a sensor, log units, [H, W].

    A threshold is normal about its mean, which is that of a posterior: the less a pixel's events tell, the
    nearer it is to the mean of all pixels, and the nearer its error to the mismatch.

    Args:
        on: Mean of the ON threshold.
        off: Mean of the OFF threshold.
        error_on: Standard deviation of what the ON threshold differs by.
        error_off: The same for OFF.
        hot: Pixels that fire without cause, bool [H, W]; their events tell nothing.
        told: Share of the mismatch's variance that events explain, (ON, OFF); 0 = not identified.
    """

    on: NDArray[np.float64]
    off: NDArray[np.float64]
    error_on: NDArray[np.float64]
    error_off: NDArray[np.float64]
    hot: NDArray[np.bool_]
    told: tuple[float, float] = (1.0, 1.0)

    def mapped(self, work: Callable[[NDArray], NDArray]) -> PixelMaps:
        """Return maps with the same done to each, such as a cut."""
        errors = work(self.error_on), work(self.error_off)
        return PixelMaps(work(self.on), work(self.off), *errors, work(self.hot), self.told)


@dataclass(frozen=True)
class CrossingLaw:
    """What an event of a threshold pixel says of the light, in numbers: the constants of a likelihood.

    Between two events of a pixel the filtered log light P, less the leak's share, moves by +threshold_on or
    -threshold_off, less ahead (s - s'), s = +1 or -1 the sign of the event and s' that of the one before, 0 for
    a first light: noise carries each ahead, so that a turn needs less than a threshold. dP/dt = bandwidth(I)
    (ln I - P). The error of that change has the variance noise^2 + walk_variance(I) times the time between the
    two. Light I is in DN, 255 = white.

    Args:
        threshold_on: Mean threshold of ON events, log units.
        threshold_off: Mean threshold of OFF events, log units.
        threshold_sigma: Standard deviation of both over the pixels, log units.
        curve: The pixel's logarithm.
        leak: By how much the reference falls, log units per second.
        leak_per_dn: What each DN of light adds to that.
        events_hz: Events without cause, but for the leak's, hertz per pixel.
        noise: Standard deviation of the change between two events, whatever its length, log units.
        ahead: How far noise that comes and goes carries a crossing ahead of the light, log units; `noise_lead`.
        walk: Strengths (a, b) of a random walk and its dark light k, DN: variance (a sqrt(I) / (I + k) + b)^2
            per second.
        cutoff_hz: Corner frequency of the low-pass filter at white, hertz; 0 = none.
        floor_dn: Light that its bandwidth keeps in the dark, DN.
        exposure: DN at the pixel per DN of the light, for filter and walk.
        starts_at_rest: Whether the first event, too, is a threshold away from a known level: that of the first
            light.
        known: Thresholds of each pixel where they were measured; None = mean and mismatch are those of all.
    """

    threshold_on: float
    threshold_off: float
    threshold_sigma: float
    curve: LogCurve
    leak: float = 0.0
    leak_per_dn: float = 0.0
    events_hz: float = 0.0
    noise: float = 0.0
    ahead: float = 0.0
    walk: tuple[float, float, float] = (0.0, 0.0, 1.0)
    cutoff_hz: float = 0.0
    floor_dn: float = 20.0
    exposure: float = 1.0
    starts_at_rest: bool = False
    known: PixelMaps | None = field(default=None, compare=False)

    def thresholds(self, pixels: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mean and standard deviation of the thresholds of pixels, [2 P]: OFF and ON of each in turn.

        Args:
            pixels: Their number P, that of the measured ones where they were measured.
        """
        if self.known is None:
            return np.tile([self.threshold_off, self.threshold_on], pixels), np.full(
                2 * pixels, self.threshold_sigma
            )
        pairs = (self.known.off, self.known.on), (self.known.error_off, self.known.error_on)
        mean, deviation = (np.stack(pair, axis=-1).ravel() for pair in pairs)
        return mean, deviation

    def doubted(self, error: float) -> CrossingLaw:
        """Return the law where crossings of a pixel may share an error that its thresholds do not explain.

        Args:
            error: Its standard deviation, log units: no threshold is known better, nor less than unmeasured.
        """
        if (known := self.known) is None:
            return self
        most, errors = self.threshold_sigma, (known.error_on, known.error_off)
        on, off = (np.minimum(np.hypot(one, error), np.maximum(one, most)) for one in errors)
        return replace(self, known=replace(known, error_on=on, error_off=off))

    def mapped(self, work: Callable[[NDArray], NDArray]) -> CrossingLaw:
        """Return the law of other pixels where they were measured: the same is done to each of their maps."""
        return self if self.known is None else replace(self, known=self.known.mapped(work))

    def level(self, light: NDArray) -> NDArray:
        """Return the log light of light in DN, [...]."""
        bright = np.maximum(self.curve.scale * light + self.curve.offset, 0.0)
        return np.where(bright > KNEE_DN, np.log(np.maximum(bright, KNEE_DN)), bright * KNEE_SLOPE)

    def slope(self, light: NDArray) -> NDArray:
        """Return the derivative of `level`, log units per DN, [...]."""
        bright = np.maximum(self.curve.scale * light + self.curve.offset, 0.0)
        return self.curve.scale * np.where(bright > KNEE_DN, 1.0 / np.maximum(bright, KNEE_DN), KNEE_SLOPE)

    def bandwidth(self, light: NDArray) -> NDArray:
        """Return the filter's speed at light in DN, 1 / s, [...]; infinite without one."""
        if self.cutoff_hz == 0:
            return np.full(np.shape(light), math.inf)
        speed = 2.0 * math.pi * self.cutoff_hz / (255.0 + self.floor_dn)
        return speed * (self.exposure * np.maximum(light, 0.0) + self.floor_dn)

    def fall(self, light: NDArray) -> NDArray:
        """Return by how much the reference falls at light in DN, log units per second, [...]."""
        return self.leak + self.leak_per_dn * self.exposure * np.maximum(light, 0.0)

    def lead(self, sign: Any, before: Any) -> Any:
        """Return what noise takes from the change between two events, log units: ahead (s - s').

        Args:
            sign: +1 or -1, of the later one [...].
            before: Of the earlier one, 0 for a first light [...].
        """
        return self.ahead * (sign - before)

    def walk_variance(self, light: NDArray) -> NDArray:
        """Return the variance that a random walk gains at light in DN, log units squared per second, [...]."""
        photon, floor, dark = self.walk
        seen = self.exposure * np.maximum(light, 0.0)
        return (photon * np.sqrt(seen) / (seen + dark) + floor) ** 2


_USUAL_RATE = 0.5  # of log light at a crossing, per second


def noise_lead(rms: float, memory_s: float, rate: float = _USUAL_RATE) -> float:
    """Return by how much noise lets log light that nears a threshold as a ramp cross it early, log units, >= 0.

    Noise that is drawn anew each `memory_s` passes u rms with the probability Q(u), the normal upper tail. The
    light nears by rate memory_s a draw, so that before it is u rms away the expected number of passages is
    rms / (rate memory_s) times the integral of Q from u on, phi(u) - u Q(u). Where that is ln 2 is the median.

    Args:
        rms: Standard deviation of the noise, log units.
        memory_s: Its correlation time, seconds.
        rate: Of the log light, log units per second.

    Example:
        >>> round(noise_lead(0.026, 0.0025), 3)
        0.038
    """
    if rms <= 0:
        return 0.0
    wanted, low, high = math.log(2) * rate * memory_s / rms, 0.0, 8.0
    for _ in range(50):
        u = 0.5 * (low + high)
        passed = math.exp(-0.5 * u * u) / math.sqrt(2 * math.pi) - 0.5 * u * math.erfc(u / math.sqrt(2))
        low, high = (u, high) if passed > wanted else (low, u)
    return rms * low


class PixelSettings(Kinded):
    """Base of the settings of all event models; derive a frozen dataclass, give it `kind`, register it.

    Example:
        >>> from evnlos.cameras import EventPixel
        >>> EVENT_MODELS["continuous"] is EventPixel
        True
    """

    registry = EVENT_MODELS
    default_kind = "continuous"
    stepped: ClassVar[bool] = False
    """Whether the physics depends on the time step, which a simulation must then state."""

    def model(
        self,
        shape: tuple[int, int],
        seed: int = 0,
        thresholds: object = None,
        *,
        tile_px: int | None = None,
        threads: int | None = None,
    ) -> EventModel:
        """Return an array of such pixels.

        Args:
            shape: Sensor size (height, width), pixels.
            seed: Seed of mismatch and noise, 0 to 2**64 - 1.
            thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units; None draws them.
            tile_px: Pixels that run together; None = a size that fits the cache.
            threads: Number of threads; None = as many as torch uses.
        """
        raise NotImplementedError(f"{type(self).__name__} has no array of pixels; define `model`")

    @property
    def finest_threshold(self) -> float:
        """The smallest change of log light that matters, log units: a camera chooses its time steps by it."""
        return 0.1

    @property
    def log_curve(self) -> LogCurve:
        """The logarithm that the camera chooses its time steps by."""
        return LogCurve(1.0, 0.0)

    def crossing_law(self, light_dn: float = 60.0) -> CrossingLaw | None:
        """Return what an event of such a pixel says of the light; None where no threshold is known.

        Args:
            light_dn: Typical light, DN, for noise that no simple law describes at all light levels.
        """
        return None

    def known_law(self, light_dn: float) -> CrossingLaw:
        """Return `crossing_law`, without which nobody knows what an event says of the light.

        Args:
            light_dn: As for `crossing_law`.

        Raises:
            ConfigError: The model states none.
        """
        law = self.crossing_law(light_dn)
        if law is None:
            raise ConfigError(
                f"{type(self).__name__}, the setup's event model, states no law of its crossings; take one of "
                "kind continuous, v2e, brownian or circuit, or the frames alone"
            )
        return law

    @property
    def disorder_s(self) -> float:
        """By how much an event of later light may carry an earlier time stamp, seconds."""
        return 0.0

    @property
    def noise_hz(self) -> float:
        """Events that a pixel sends without cause, about, hertz: leak, shot noise and hot pixels."""
        hot = getattr(self, "hot_pixel_fraction", 0.0) * getattr(self, "hot_pixel_rate_hz", 0.0)
        return hot + sum(getattr(self, name, 0.0) for name in ("leak_rate_hz", "shot_noise_rate_hz"))


@dataclass(frozen=True)
class ThresholdPixel(PixelSettings):
    """Base of the pixels that send an event where log light, as they see it, has moved by a threshold."""

    threshold_on: float = 0.15
    """Mean contrast threshold of ON events, log units (e-fold)."""
    threshold_off: float = 0.15
    """Mean contrast threshold of OFF events, log units (e-fold)."""
    threshold_sigma: float = 0.03
    """Standard deviation of both thresholds over the pixels, log units; 0 = none."""

    def __post_init__(self) -> None:
        for name in ("threshold_on", "threshold_off"):
            require(self, name, MIN_THRESHOLD, math.inf, "log units; the paper's value is 0.15")
        require(self, "threshold_sigma", 0.0, math.inf, "log units; 0 gives every pixel the same threshold")
        super().__post_init__()

    @property
    def finest_threshold(self) -> float:
        """The smaller of the two mean thresholds, log units."""
        return min(self.threshold_on, self.threshold_off)

    def _law(self, **changes: Any) -> CrossingLaw:
        """Return the crossing law of the thresholds, the logarithm and the leak, if there is one."""
        leak = self.threshold_on * getattr(self, "leak_rate_hz", 0.0)
        plain = CrossingLaw(self.threshold_on, self.threshold_off, self.threshold_sigma, self.log_curve, leak)
        at_rest = getattr(self, "initial_phase", "rest") == "rest"
        return replace(plain, starts_at_rest=at_rest, **changes)


def require(owner: object, name: str, low: float, high: float, unit: str) -> None:
    """Refuse a setting that is not a finite number in [low, high].

    Args:
        owner: The settings.
        name: Name of the setting.
        low: Its smallest value.
        high: Its largest value; infinity = none.
        unit: Unit, and what a special value means.

    Raises:
        ConfigError: The value is no number, or out of range.
    """
    value, label = getattr(owner, name), f"{type(owner).__name__}.{name}"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"{label} is {value!r}; give a number in {unit}")
    if not (math.isfinite(value) and low <= value <= high):
        limit = f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
        raise ConfigError(f"{label} is {value:g}; give {limit} {unit}")


def check_phase(phase: object) -> None:
    """Refuse what is no first state.

    Raises:
        ConfigError: Neither "random" nor "rest".
    """
    if phase not in get_args(Phase):
        raise ConfigError(f'initial_phase is {phase!r}; give "random" or "rest"')


def check_pattern_seed(seed: object) -> None:
    """Refuse what is no seed of a sensor.

    Raises:
        ConfigError: Neither None nor an integer from 0 to 2**64 - 1.
    """
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**64):
        raise ConfigError(f"pattern_seed is {seed!r}; give an integer from 0 to 2**64 - 1, or None")
