"""The times that the CeleX-V program prints into CSV files: they turn over, and some count ticks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.events.io.celex_options import CelexOptions, clock_from_name, tick_divisor
from evnlos.events.io.report import ReadReport

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
            self._report.fault("header", 0, found, "give celex=CelexOptions(clock_mhz=...)")
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
