"""What reading an event file found: the strict mode raises at the first fault, salvage keeps a tally."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from evnlos.errors import EventFileError

OnError = Literal["strict", "salvage"]


def check_on_error(on_error: str) -> None:
    """Raise unless `on_error` is "strict" or "salvage"."""
    if on_error not in ("strict", "salvage"):
        raise EventFileError(f'on_error is {on_error!r}; give "strict" or "salvage"')


@dataclass
class ReadReport:
    """What was found in one event file.

    Args:
        path: The file.
        strict: Whether the first fault raises.
        format: Name of the format, as in `FORMATS`.
        width: Sensor width, pixels.
        height: Sensor height, pixels.
        geometry_from: Where the size comes from: "caller", "header", "camera" (the model that the header
            names), "format" (it has one sensor only), "events" (one past the largest coordinate) or
            "assumed" (the format's usual sensor).
        events: Events returned.
        triggers: External trigger edges seen.
        skipped: Events before the first row or time of a recording that starts in the middle; no fault.
        faults: How many faults of each kind: "truncated", "left_over", "out_of_range", "backwards",
            "undated", "unknown", "header", "checksum", "count".
        first: One line on the first fault of each kind, with its byte offset.
        bytes_left_over: Bytes that could not be used.
        truncated: Whether the file ends before it should.
    """

    path: Path
    strict: bool = True
    format: str = ""
    width: int = 0
    height: int = 0
    geometry_from: str = ""
    events: int = 0
    triggers: int = 0
    skipped: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    first: dict[str, str] = field(default_factory=dict)
    bytes_left_over: int = 0
    truncated: bool = False

    def set_geometry(self, width: object, height: object, source: str, offset: int = 0) -> None:
        """Take over a sensor size and where it comes from.

        Raises:
            EventFileError: A side is not a whole number of pixels between 1 and 65536.
        """
        try:
            sides = int(width), int(height)  # type: ignore[call-overload]
        except (TypeError, ValueError):
            sides = 0, 0
        if not all(1 <= side <= 65_536 for side in sides):
            found = f"a sensor of {str(width)[:20]} x {str(height)[:20]} pixels"
            raise unreadable(self.path, offset, found, "give width= and height=")
        self.width, self.height, self.geometry_from = *sides, source

    @property
    def clean(self) -> bool:
        """Whether no fault was found."""
        return not self.faults

    def fault(
        self, kind: str, offset: int, found: str, cure: str, *, count: int = 1, lost_bytes: int = 0
    ) -> None:
        """Note a fault at byte `offset`; in strict mode raise it as one line."""
        line = f"{self.path}: byte {offset}: {found}; {cure}"
        if self.strict:
            raise EventFileError(line)
        self.faults[kind] = self.faults.get(kind, 0) + count
        self.first.setdefault(kind, line)
        self.bytes_left_over += lost_bytes
        self.truncated |= kind == "truncated"

    def __str__(self) -> str:
        size = f"{self.width} x {self.height} ({self.geometry_from})"
        head = f"{self.path}: {self.format}, {size}, {self.events:,} events"
        if self.clean:
            return f"{head}, no faults"
        tally = ", ".join(f"{count:,} {kind.replace('_', ' ')}" for kind, count in self.faults.items())
        return f"{head}; {tally}; {self.bytes_left_over:,} bytes left over"


def unreadable(path: Path, offset: int, found: str, cure: str) -> EventFileError:
    """Return the error of a file from which nothing can be taken, strict or not."""
    return EventFileError(f"{path}: byte {offset}: {found}; {cure}")
