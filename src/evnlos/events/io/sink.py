"""What every writer of event files offers: pieces in, one complete file."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from evnlos.types import Events


class Sink(Protocol):
    """An event file that grows; it is complete after `finish`."""

    def append(self, events: Events) -> None:
        """Write a piece: the same sensor and columns as the first, and no time before its predecessor's."""
        ...

    def finish(self) -> None:
        """Complete the file: counts, indices."""
        ...

    def close(self) -> None:
        """Let go of the file, complete or not."""
        ...


class FileSink:
    """A sink on one plain file."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("wb")

    def close(self) -> None:
        """Close the file."""
        self.file.close()
