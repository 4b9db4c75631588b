"""Event cameras on a cable, without a maker's SDK: drivers, and a source that outlives a loose plug.

- What is asked of a driver, and the one driver there is: the package `neuromorphic-drivers`.
- A camera as a source: it is opened again where it went away; stalls and overflows are counted and told.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, MissingDependencyError
from evnlos.events.files.columns import Columns
from evnlos.live.growing_file import OrderedEvents
from evnlos.live.packet import UNKNOWN_US, Chunk, Clock, SystemClock
from evnlos.types import Events

_LOG = logging.getLogger("evnlos")
_NAP_S = 0.05
_STALL_S = 1.0  # without an event of a camera that is there
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.1, 2.0  # before a camera that went away is looked for again
_FULL_SCALE = 1023 * 64  # of the DAVIS346's frames as the driver gives them: 10 bits in the upper part of 16
_COLUMNS = (("t", "t_us", np.int64), ("x", "x", np.uint16), ("y", "y", np.uint16), ("on", "p", np.bool_))


class CameraLostError(ConfigError):
    """A camera can't be opened, or went away."""


@dataclass(frozen=True)
class CameraFacts:
    """What a driver knows about its camera.

    Args:
        name: Maker and model.
        width: Columns, pixels.
        height: Rows, pixels.
        serial: Serial number; None where it has none.
        biases: Bias settings, by the driver's names and in its units.
        exposure_s: Exposure of a frame, seconds; None without frames.
        frame_rate_hz: Frames per second; None without frames.
        most_rate_hz: Events per second that the sensor's readout can pass, as its maker states; None = unknown.
    """

    name: str
    width: int
    height: int
    serial: str | None = None
    biases: dict[str, int] = field(default_factory=dict)
    exposure_s: float | None = None
    frame_rate_hz: float | None = None
    most_rate_hz: float | None = None


@dataclass(frozen=True, eq=False)
class CameraPacket:
    """What a camera sent since the packet before.

    Args:
        columns: Its events; None where there are none.
        frames: Its frames: end of the exposure, microseconds, and image, float32 [H, W], 0..1.
        overflows: How often the computer was too slow and events were lost.
        temperature_c: Temperature, degrees Celsius; None where it is not in the packet.
    """

    columns: Columns | None
    frames: tuple[tuple[int, NDArray[np.float32]], ...] = ()
    overflows: int = 0
    temperature_c: float | None = None


class Driver(Protocol):
    """An open camera."""

    facts: CameraFacts

    def read(self) -> CameraPacket | None:
        """Return what came, None where nothing did within about 0.05 s.

        Raises:
            CameraLostError: The camera went away.
        """
        ...

    def measure(self) -> dict[str, float]:
        """Return what the camera says of itself now: `temperature_c`, and `light`, a reading without a unit."""
        ...

    def close(self) -> None:
        """Let the camera go; nothing happens where it is gone."""
        ...


DEVICES = {
    "evk4": ("prophesee_evk4", 1.06e9),
    "evk3-hd": ("prophesee_evk3_hd", 1.06e9),
    "davis346": ("inivation_davis346", 12e6),
    "dvxplorer": ("inivation_dvxplorer", 165e6),
    "centuryarks-vga": ("centuryarks_vga", None),
    "triton": ("lucid_triton", 1.06e9),
}
"""Cameras by their name on the command line: the package's module, the readout's stated peak rate in hertz."""


def device_of(source: str) -> tuple[str, str | None] | None:
    """Return name and serial number of the camera that `NAME` or `NAME:SERIAL` names; None for none."""
    name, _, serial = source.partition(":")
    return (name.lower(), serial or None) if name.lower() in DEVICES else None


class NeuromorphicDriver:
    """A camera by the package `neuromorphic-drivers`, with the settings that the package begins with.

    Args:
        name: One of `DEVICES`.
        serial: Serial number, where several are connected.

    Raises:
        MissingDependencyError: The package is missing.
        CameraLostError: There is no such camera, or it may not be opened.
    """

    def __init__(self, name: str, serial: str | None = None) -> None:
        try:
            import neuromorphic_drivers as drivers  # type: ignore[import-not-found]
        except ImportError:
            raise MissingDependencyError(
                "a camera on a cable needs the package neuromorphic-drivers: pip install 'evnlos[camera]'"
            ) from None
        module, most_rate_hz = DEVICES[name]
        configuration = getattr(drivers, module).Configuration()
        try:
            self._device: Any = drivers.open(configuration, iterator_timeout=_NAP_S, serial=serial)
            size, title = self._device.properties(), self._device.name().value
            number = self._device.serial()
        except RuntimeError as error:
            raise CameraLostError(
                f"{name}{f' {serial}' if serial else ''} can't be opened ({error}); plug it in, close other "
                "programs that use it, and on Linux run neuromorphic-drivers-install-udev-rules once"
            ) from None
        exposure_us = getattr(configuration, "exposure_us", None)
        interval_us = getattr(configuration, "frame_interval_us", None)
        self.facts = CameraFacts(
            title,
            int(size.width),
            int(size.height),
            number,
            {key: int(value) for key, value in asdict(configuration.biases).items()},
            None if exposure_us is None else exposure_us / 1e6,
            None if interval_us is None else 1e6 / interval_us,
            most_rate_hz,
        )
        self._asked = ["temperature_celsius", "illuminance"]
        self._dropped = 0

    def read(self) -> CameraPacket | None:
        """Return what came, None where nothing did in time."""
        try:
            status, packet = next(self._device)
        except (RuntimeError, StopIteration) as error:
            raise CameraLostError(f"{self.facts.name} went away ({error}); plug it in again") from None
        if packet is None or status.ring is None:
            return None
        dropped, self._dropped = self._dropped, getattr(status.ring, "dropped_packets", 0) or 0
        missed = packet.polarity_events_overflow_indices
        overflows = (0 if missed is None else len(missed)) + (self._dropped > dropped)
        rows, imu = packet.polarity_events, getattr(packet, "imu_events", None)
        columns = None
        if rows is not None and len(rows):
            columns = {ours: rows[theirs].astype(kind) for theirs, ours, kind in _COLUMNS}
        frames = tuple(
            (int(one.exposure_end_t or one.t), np.minimum(one.pixels / np.float32(_FULL_SCALE), np.float32(1)))
            for one in getattr(packet, "frames", ())
        )
        celsius = None if imu is None or not len(imu) else float(imu["temperature"].mean())
        return CameraPacket(columns, frames, overflows, celsius)

    def measure(self) -> dict[str, float]:
        """Return temperature and light, where the package can ask the camera for them."""
        found = {}
        for name, key in (("temperature_celsius", "temperature_c"), ("illuminance", "light")):
            if name not in self._asked:
                continue
            try:
                found[key] = float(getattr(self._device, name)())
            except (RuntimeError, AttributeError):  # this camera has no such sensor
                self._asked.remove(name)
        return found

    def close(self) -> None:
        """Let the camera go."""
        with suppress(RuntimeError):
            self._device.close()


class DeviceSource:
    """A source that reads a camera, and looks for it again where it went away.

    Args:
        open_driver: Opens the camera.
        name: What it is, for messages.
        idle_s: Give up after so many seconds without the camera; None = never.
        clock: The clock that arrivals are told by.

    Attributes:
        facts: What the driver knows about the camera.
        readings: What the camera said of itself, first and last: keys as of `Driver.measure`.

    Raises:
        CameraLostError: The camera can't be opened.
    """

    def __init__(
        self,
        open_driver: Callable[[], Driver],
        name: str,
        *,
        idle_s: float | None = 10.0,
        clock: Clock | None = None,
    ) -> None:
        self._open, self._idle_s, self._clock = open_driver, idle_s, clock or SystemClock()
        self._driver: Driver | None = open_driver()
        self.facts = self._driver.facts
        self.name, self.has_frames, self.waits = name, self.facts.frame_rate_hz is not None, False
        self.readings: dict[str, tuple[float, float]] = {}
        self._faults: Counter[str] = Counter()
        self._measured_s = -1.0
        self._begin()

    def _begin(self) -> None:
        self._sound, self._newest = OrderedEvents(self.facts.width, self.facts.height), UNKNOWN_US

    def faults(self) -> dict[str, int]:
        """Return how often the camera went away, fell silent and was read too slowly, and damaged events."""
        damaged = self._faults["damaged or late events"] + self._sound.faults
        names = ("disconnections", "stalls", "overflows")
        return {name: self._faults[name] for name in names} | {"damaged or late events": damaged}

    def close(self) -> None:
        """Let the camera go."""
        if self._driver is not None:
            self._driver.close()
            self._driver = None

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what the camera sends; it begins a new stream after it went away, for its clock does.

        Raises:
            CameraLostError: It went away and did not come back in time.
        """
        heard_s, is_silent, begins = self._clock.now(), False, False
        try:
            while not stop() and self._driver is not None:
                try:
                    packet = self._driver.read()
                except CameraLostError as error:
                    self._lost(error, stop)
                    heard_s, is_silent, begins = self._clock.now(), False, True
                    continue
                now = self._clock.now()
                self._note(packet, now)
                if packet is None or packet.columns is None:
                    if now - heard_s > _STALL_S and not is_silent:
                        is_silent = True
                        self._told("stalls", f"{self.name}: no event for {_STALL_S:g} s; is it dark, or hung?")
                else:
                    heard_s, is_silent = now, False
                if packet is not None:
                    for chunk in self._chunks(packet, now, begins):
                        yield chunk
                        begins = False
        finally:
            self.close()

    def _told(self, fault: str, text: str, count: int = 1) -> None:
        if not self._faults[fault] or fault != "overflows":
            _LOG.warning("%s", text)
        self._faults[fault] += count

    def _note(self, packet: CameraPacket | None, now: float) -> None:
        """Count overflows, and take temperature and light once per second."""
        found: dict[str, float] = {}
        if packet is not None and packet.overflows:
            text = f"{self.name}: the computer is too slow, events are lost: raise the thresholds"
            self._told("overflows", text, packet.overflows)
        if packet is not None and packet.temperature_c is not None:
            found["temperature_c"] = packet.temperature_c
        if self._driver is not None and now - self._measured_s >= 1:
            self._measured_s = now
            found |= self._driver.measure()
        for key, value in found.items():
            self.readings[key] = self.readings.get(key, (value, value))[0], value

    def _chunks(self, packet: CameraPacket, now: float, begins: bool) -> Iterator[Chunk]:
        """Yield the events of a packet, cut where a frame ends."""
        blank = Events.empty(self.facts.height, self.facts.width)
        events = blank if packet.columns is None else self._sound.sound(packet.columns)
        for t_us, image in packet.frames:
            count = int(np.searchsorted(events.t_us, t_us, "right"))
            before, events = events[:count], events[count:]
            self._newest = int(before.t_us[-1]) if count else self._newest
            until = max(t_us, self._newest) if self._newest != UNKNOWN_US else t_us
            if len(events):
                until = min(until, int(events.t_us[0]))
            yield Chunk(before, until, now, now, image, begins, frame_us=t_us)
            begins = False
        if len(events):
            self._newest = int(events.t_us[-1])
            yield Chunk(events, self._newest, now, now, restart=begins)

    def _lost(self, error: CameraLostError, stop: Callable[[], bool]) -> None:
        """Open the camera again, at growing distances of time."""
        self.close()
        self._told("disconnections", f"{error}; it is looked for")
        self._faults["damaged or late events"] += self._sound.faults
        self._begin()
        since_s, wait_s = self._clock.now(), _FIRST_WAIT_S
        while not stop():
            until_s = self._clock.now() + wait_s
            while not stop() and self._clock.now() < until_s:
                self._clock.sleep(min(_NAP_S, until_s - self._clock.now()))
            try:
                self._driver = self._open()
            except CameraLostError as again:
                if self._idle_s is not None and self._clock.now() - since_s > self._idle_s:
                    raise CameraLostError(f"{again} (looked for {self._idle_s:g} s, --idle)") from None
                wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
                continue
            if (self._driver.facts.width, self._driver.facts.height) != (self.facts.width, self.facts.height):
                raise CameraLostError(f"{self.name}: a camera with another sensor came back; begin anew")
            _LOG.warning("%s is back", self.name)
            return
