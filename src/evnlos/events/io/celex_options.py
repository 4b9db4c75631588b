"""What a CeleX-V recording does not say about itself, or says wrongly after a crash."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from evnlos.errors import ConfigError

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
