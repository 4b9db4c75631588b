"""CeleX-V recordings (`.bin`): events and full images.

- What a CeleX-V recording does not say about itself, or says wrongly after a crash.
- CeleX-V recordings (`.bin`): a header of 12 bytes, then packages of events or full images.
- Full images of CeleX-V recordings (mode F).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError, EventFileError
from evnlos.events.files import celex_kernels as slots
from evnlos.events.files.celex_kernels import DECODERS, EVENTS_A_GROUP, GROUP_BYTES, HEIGHT, SCRATCH, WIDTH
from evnlos.events.files.columns import (
    SALVAGE,
    Columns,
    OnError,
    ReadReport,
    allocate,
    cut,
    shorten,
    unreadable,
)

_CLOCK = "give celex=CelexOptions(clock_mhz=...) (--celex.clock-mhz MHZ)"
# Ticks are 1024 / D microseconds; D for clocks of 10, 20, ... 100 MHz.
_DIVISORS = (80, 80, 90, 80, 100, 120, 140, 80, 90, 100)


@dataclass(frozen=True)
class CelexOptions:
    """Overrides for a CeleX-V `.bin` or CSV file.

    Args:
        clock_mhz: Clock of the sensor, MHz: 10, 20, ... 100; by default from the file name (`_70M`).
        event_format: 0, 1 or 2 in place of the header's, for recordings whose header is garbage.
        has_imu: Whether packages are followed by a time stamp and IMU samples, in place of the header's.
        csv_in_ticks: Whether the last column of a CSV file counts ticks, as the SDK before 2.0 wrote it.

    Raises:
        ConfigError: A clock or format that does not exist.
    """

    clock_mhz: int | None = None
    event_format: int | None = None
    has_imu: bool | None = None
    csv_in_ticks: bool = False

    def __post_init__(self) -> None:
        if self.clock_mhz is not None and self.clock_mhz not in range(10, 101, 10):
            raise ConfigError(f"clock_mhz is {self.clock_mhz}; give 10, 20, ... 100 MHz")
        if self.event_format not in (None, 0, 1, 2):
            raise ConfigError(f"event_format is {self.event_format}; give 0, 1 or 2")


def tick_divisor(clock_mhz: int) -> int:
    """Return D: a tick of a sensor that runs at `clock_mhz` is 1024 / D microseconds."""
    return _DIVISORS[clock_mhz // 10 - 1]


def clock_from_name(path: Path) -> int | None:
    """Return the clock, MHz, that the recording program wrote into the file name, as in `..._EI_70M.bin`."""
    found = re.search(r"_(\d{2,3})M(?=[._-]|$)", path.name)
    clock = int(found[1]) if found else 0
    return clock if clock in range(10, 101, 10) else None


HEADER_BYTES = 12
IMAGE_BYTES = WIDTH * HEIGHT * 3 // 2
_MAX_PAYLOAD = IMAGE_BYTES + 1  # the longest that the camera sends; the last byte is the kind
_FULL_IMAGE = 3  # a mode
_IMU_BYTES = 32


@dataclass(frozen=True)
class CelexHeader:
    """The 12 bytes at the start of a recording.

    Args:
        loop: Whether modes alternate.
        has_imu: Whether a time stamp and IMU samples follow each package.
        modes: The modes of loop A, B, C; a fixed mode is the first, 255 is none.
        event_format: 0, 1 or 2.
        packages: Number of packages that the camera counted; 0 where it was not written.
    """

    loop: bool
    has_imu: bool
    modes: tuple[int, int, int]
    event_format: int
    packages: int


@dataclass(frozen=True)
class Package:
    """One package: byte offset and length of its data (without the kind), and what it holds."""

    offset: int
    length: int
    is_image: bool
    host_time: int | None


def sniff_celex(start: bytes) -> bool:
    """Return whether the fields of the header and the length of the first package are possible."""
    if len(start) < HEADER_BYTES + 4:
        return False
    kind, mode, _, _, event_format, hour, minute, second = start[:8]
    length = struct.unpack_from("<I", start, HEADER_BYTES)[0]
    clock = hour < 24 and minute < 60 and second < 60
    return kind <= 3 and mode <= 6 and event_format <= 2 and clock and 1 < length <= _MAX_PAYLOAD


def parse_header(path: Path, options: CelexOptions) -> CelexHeader:
    """Return the header, with the caller's overrides in place of what a crash left."""
    with path.open("rb") as file:
        data = file.read(HEADER_BYTES)
    if len(data) < HEADER_BYTES:
        raise unreadable(path, 0, f"a CeleX header of {len(data)} bytes", "12 are needed: copy the file again")
    event_format = data[4] if options.event_format is None else options.event_format
    if event_format > 2:
        cure = "0, 1 and 2 exist: give celex=CelexOptions(event_format=...) (--celex.event-format N)"
        raise unreadable(path, 4, f"event format {event_format}", cure)
    crashed = options.event_format is not None
    has_imu = bool(data[0] & 2) if options.has_imu is None else options.has_imu
    packages = 0 if crashed else struct.unpack_from("<I", data, 8)[0]
    return CelexHeader(bool(data[0] & 1), has_imu, (data[1], data[2], data[3]), event_format, packages)


def walk_packages(file: FileIO, header: CelexHeader, report: ReadReport) -> Iterator[Package]:
    """Yield the packages up to the end of the file; a length is believed only as far as the file reaches."""
    size = file.seek(0, 2)
    at, count = HEADER_BYTES, 0
    while at < size:
        file.seek(at)
        head = file.read(4)
        length = struct.unpack("<I", head)[0] if len(head) == 4 else 0
        if not 1 < length <= _MAX_PAYLOAD and len(head) == 4:
            found = f"a package of {length} bytes"
            report.fault(
                "unknown", at, found, f"2 to {_MAX_PAYLOAD} are possible: {SALVAGE}", lost_bytes=size - at
            )
            return
        after = at + 4 + length
        if after > size or len(head) < 4:
            found = f"a package of {length} bytes, {size - at - len(head)} are left"
            report.fault("truncated", at, found, f"copy the file again or {SALVAGE}", lost_bytes=size - at)
            return
        file.seek(after - 1)
        is_image = file.read(1) == b"\0"
        host_time = None
        if header.has_imu:
            tail = file.read(12)
            host_time, samples = struct.unpack("<qI", tail) if len(tail) == 12 else (None, 0)
            after += 12 + _IMU_BYTES * samples
            if after > size or host_time is None:
                found = f"{samples} IMU samples behind a package"
                report.fault("truncated", at, found, f"copy the file again or {SALVAGE}", lost_bytes=size - at)
                return
        if is_image and length != _MAX_PAYLOAD:
            found = f"a full image of {length - 1} bytes"
            report.fault("unknown", at, found, f"{IMAGE_BYTES} are one: {SALVAGE}", lost_bytes=length)
        else:
            yield Package(at + 4, length - 1, is_image, host_time)
        at, count = after, count + 1
    if header.packages and count != header.packages:
        kind = "truncated" if count < header.packages else "count"
        found = f"{count} packages where the header announces {header.packages}"
        stated = f"celex=CelexOptions(event_format={(n := header.event_format)}) (--celex.event-format {n})"
        cure = f"after a crash give {stated}, or {SALVAGE}"
        report.fault(kind, size, found, cure)


class CelexSource:
    """The events of an open CeleX-V recording."""

    def __init__(
        self,
        path: Path,
        report: ReadReport,
        width: int | None,
        height: int | None,
        options: CelexOptions | None,
    ) -> None:
        self.path, self.report = path, report
        options = options or CelexOptions()
        self._header = parse_header(path, options)
        report.format = "CELEX"
        if not self._header.loop and self._header.modes[0] == _FULL_IMAGE and options.event_format is None:
            raise unreadable(path, 1, "a recording of full images", "read it with evnlos.read_frames(path)")
        if width is not None and (width, height) != (WIDTH, HEIGHT):
            raise unreadable(
                path, 0, f"a sensor of {width} x {height}", "CeleX-V has 1280 x 800: leave the size out"
            )
        report.set_geometry(WIDTH, HEIGHT, "format")
        clock = options.clock_mhz or clock_from_name(path)
        if clock is None:
            found = "a file name without the sensor's clock"
            report.fault("header", 0, found, f"name it ..._100M.bin or {_CLOCK}")
            clock = 100
        self._divisor = tick_divisor(clock)
        self._buffer = np.empty(_MAX_PAYLOAD, np.uint8)
        self._scratch = np.empty(SCRATCH, np.uint64)

    def _names(self) -> tuple[str, ...]:
        names = ("t_us", "x", "y", "p", "polarity_known")
        return names if self._header.event_format == 2 else (*names, "adc")

    def _bound(self, package: Package) -> int:
        format = self._header.event_format
        return package.length // GROUP_BYTES[format] * EVENTS_A_GROUP[format]

    def _new_state(self) -> tuple[np.ndarray, np.ndarray]:
        state = np.zeros(slots.STATE_SIZE, np.int64)
        state[slots.DIVISOR] = self._divisor
        # Twice the room: an array of 4 MB and more lies in large pages, and events fall anywhere in it.
        last = np.empty((2, HEIGHT, WIDTH), np.int16)[0]
        last.fill(-1)
        return state, last

    def _decode(self, file: FileIO, package: Package, state: np.ndarray, last: np.ndarray, out: Columns) -> int:
        file.seek(package.offset)
        data = self._buffer[: package.length]
        data = data[: file.readinto(memoryview(data))]  # type: ignore[arg-type]
        format = self._header.event_format
        left = package.length % GROUP_BYTES[format]
        if left:
            found = f"a package that ends {left} bytes into a group of {GROUP_BYTES[format]}"
            self.report.fault(
                "left_over", package.offset + package.length - left, found, SALVAGE, lost_bytes=left
            )
        adc = out.get("adc", out["x"])  # format 2 has none and writes none
        count = DECODERS[format](
            data,
            state,
            out["t_us"],
            out["x"],
            out["y"],
            out["p"],
            adc,
            out["polarity_known"],
            last,
            self._scratch,
        )
        for kind, slot, first, found in (
            ("unknown", slots.UNKNOWN, slots.FIRST_UNKNOWN, "a word of an unknown kind"),
            ("out_of_range", slots.OUTSIDE, slots.FIRST_OUTSIDE, "an event outside 1280 x 800"),
        ):
            if state[slot]:
                offset = package.offset + int(state[first])
                self.report.fault(
                    kind, offset, found, f"the file is damaged there: {SALVAGE}", count=int(state[slot])
                )
                state[slot] = 0
        return int(count)

    def _finish(self, state: np.ndarray, events: int, pictures: int) -> None:
        self.report.skipped = int(state[slots.SKIPPED])
        if not events and pictures:
            raise unreadable(
                self.path, 0, "a recording of full images", "read it with evnlos.read_frames(path)"
            )

    def blocks(self) -> Iterator[Columns]:
        """Yield the events package by package."""
        state, last = self._new_state()
        events = pictures = 0
        with self.path.open("rb", buffering=0) as file:
            for package in walk_packages(file, self._header, self.report):
                if package.is_image:
                    pictures += 1
                    continue
                out = allocate(self._bound(package), self._names())
                count = self._decode(file, package, state, last, out)
                events += count
                yield cut(out, 0, count)
        self._finish(state, events, pictures)

    def read(self) -> Columns:
        """Return all events, decoded straight into columns of the whole size."""
        state, last = self._new_state()
        with self.path.open("rb", buffering=0) as file:
            packages = list(walk_packages(file, self._header, self.report))
            held = [package for package in packages if not package.is_image]
            columns = allocate(sum(map(self._bound, held)), self._names())
            count = 0
            for package in held:
                out = cut(columns, count, len(columns["t_us"]))
                count += self._decode(file, package, state, last, out)
        self._finish(state, count, len(packages) - len(held))
        shorten(columns, count)
        return columns


def _fixed_pattern(fpn: NDArray | str | PathLike[str] | None) -> NDArray | None:
    """Return the fixed pattern [H, W] of an array or of the SDK's text file of whole numbers."""
    if fpn is None:
        return None
    if isinstance(fpn, (str, PathLike)):
        path = Path(fpn)
        try:
            values = np.array(path.read_text("ascii").split(), np.int64)
        except (OSError, ValueError) as error:
            raise EventFileError(
                f"{path}: not a fixed pattern ({error}); whole numbers in text belong there"
            ) from None
    else:
        values = np.asarray(fpn)
    if values.size != WIDTH * HEIGHT:
        raise DataError(f"the fixed pattern has {values.size} values; the sensor has {WIDTH * HEIGHT} pixels")
    return values.reshape(HEIGHT, WIDTH)


def _decode_image(data: NDArray[np.uint8], bits: int) -> NDArray:
    """Return one image [H, W]: three bytes are two pixels, inverted; the third holds their low bits."""
    groups = data.reshape(-1, 3)  # [H * W / 2, 3]
    first, second, low = groups[:, 0], groups[:, 1], groups[:, 2]
    if bits == 8:
        pixels = 255 - np.stack([first, second], axis=1)
    else:
        high = np.stack([first, second], axis=1).astype(np.uint16) << 4
        pixels = 4095 - (high | np.stack([low & 0xF, low >> 4], axis=1))
    return pixels.reshape(HEIGHT, WIDTH)  # [H, W]


def read_celex_frames(
    path: Path,
    bits: int,
    pattern: NDArray | str | PathLike[str] | None,
    on_error: OnError,
    options: CelexOptions,
) -> NDArray:
    """Return the full images [T, 800, 1280] of a CeleX-V recording; arguments as those of `read_frames`."""
    if bits not in (8, 12):
        raise DataError(f"bits is {bits}; give 8 or 12")
    fixed = _fixed_pattern(pattern)
    with path.open("rb", buffering=0) as file:
        report = ReadReport(path, strict=on_error == "strict")
        packages = walk_packages(file, parse_header(path, options), report)
        pictures = [package for package in packages if package.is_image]
        if not pictures and report.clean:
            raise unreadable(path, 0, "a recording without images", "read its events with read_events")
        frames = np.empty((len(pictures), HEIGHT, WIDTH), np.uint8 if bits == 8 else np.uint16)
        for frame, package in zip(frames, pictures, strict=True):
            file.seek(package.offset)
            picture = _decode_image(np.frombuffer(file.read(package.length), np.uint8), bits)
            if fixed is not None:
                picture = np.clip(picture.astype(np.int64) - fixed, 0, 2**bits - 1)
            frame[:] = picture
    return frames


_SDK_WRAP_TICKS = 1 << 22  # the camera's program prints times modulo this


class UnwrapTimes:
    """Undoes the turns of the times that the CeleX-V program prints, and converts ticks to microseconds."""

    def __init__(self, path: Path, report: ReadReport, options: CelexOptions) -> None:
        self._path, self._report, self._ticks = path, report, options.csv_in_ticks
        self._clock = options.clock_mhz or clock_from_name(path)
        self._turns, self._last = 0, 0

    def _divisor(self) -> int:
        if self._clock is None:
            found = "times that turn over or count ticks, and no clock"
            self._report.fault("header", 0, found, _CLOCK)
            self._clock = 100
        return tick_divisor(self._clock)

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the times of the next rows, int64 [rows], in microseconds that go on ascending."""
        if not len(times):
            return times
        steps = np.diff(times, prepend=self._last)
        self._last = int(times[-1])
        shortest = _SDK_WRAP_TICKS if self._ticks else _SDK_WRAP_TICKS * 1024 // 140
        turned = steps < -shortest // 2  # a smaller step back is a fault, which the check of order reports
        turns = self._turns + np.cumsum(turned)
        self._turns = int(turns[-1])
        if not self._ticks and not self._turns:
            return times
        divisor = self._divisor()
        if self._ticks:
            return ((times + turns * _SDK_WRAP_TICKS) * 2048 + divisor) // (2 * divisor)
        return times + (turns * _SDK_WRAP_TICKS * 2048 + divisor) // (2 * divisor)
