"""What the commands on event files share: how a file is read, what is taken of it, numbers in words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from evnlos.errors import ConfigError
from evnlos.events import CelexOptions
from evnlos.events.io.report import OnError
from evnlos.events.recording import Box, Cut, Recording
from evnlos.types import Events

EventFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
"""An event file, given without a flag."""


@dataclass(frozen=True)
class Reading:
    """What a file does not say about itself."""

    width: int | None = None
    """Sensor width, pixels, where the file does not say or is wrong; give both or neither."""
    height: int | None = None
    """Sensor height, pixels."""
    celex: CelexOptions = field(default_factory=CelexOptions)
    """What a CeleX-V recording does not say."""

    def open(self, path: Path, on_error: OnError) -> Recording:
        """Return the recording, its start checked."""
        celex = None if self.celex == CelexOptions() else self.celex
        return Recording(path, on_error, width=self.width, height=self.height, celex=celex)


@dataclass(frozen=True)
class Taking:
    """Which events are taken."""

    start: float = 0.0
    """Begin, seconds after the first event."""
    stop: float | None = None
    """End, seconds after the first event; by default the last event."""
    box: tuple[int, int, int, int] | None = None
    """Part of the sensor: X Y WIDTH HEIGHT, pixels; its corner becomes pixel (0, 0)."""

    def cut(self, known_polarity: bool = False) -> Cut:
        """Return the cut."""
        return Cut(self.start, self.stop, Box(*self.box) if self.box else None, known_polarity)


def refuse_existing(path: Path, force: bool) -> None:
    """Raise where a file would be replaced without --force."""
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; give another name, or --force to replace it")


def counted(pieces: Iterable[Events], name: str, total: int | None = None) -> Iterator[Events]:
    """Yield the pieces under a progress bar that counts their events and is gone when they are through."""
    bar = tqdm(desc=name, total=total, unit=" events", unit_scale=True, delay=0.5, leave=False)
    with bar:
        for piece in pieces:
            yield piece
            bar.update(len(piece))


def amount(value: float, unit: str) -> str:
    """Return a number with a prefix: 12.3 kev/s.

    Example:
        >>> amount(12_345.0, "ev/s"), amount(999.99, "B")
        ('12.3 kev/s', '1000 B')
    """
    for prefix in ("", "k", "M", "G"):
        if abs(value) < 1000 or prefix == "G":
            break
        value /= 1000
    return f"{value:.3g} {prefix}{unit}" if value < 999.5 else f"{value:.0f} {prefix}{unit}"
