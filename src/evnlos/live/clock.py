"""The clock that a live reconstruction goes by; tests give it one that they turn themselves."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Instants in seconds from an arbitrary origin, and waiting."""

    def now(self) -> float:
        """Return the instant, seconds; it never runs backwards."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; nothing happens for 0 or less."""
        ...


class SystemClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Return the instant, seconds."""
        return time.perf_counter()

    def sleep(self, seconds: float) -> None:
        """Wait; nothing happens for 0 or less."""
        if seconds > 0:
            time.sleep(seconds)
