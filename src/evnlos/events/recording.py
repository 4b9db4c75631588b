"""A recording on disk, read block by block: a stretch of time, a part of the sensor, a report of faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from evnlos.errors import ConfigError
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.columns import in_order, trusted_events
from evnlos.events.io.read import open_source
from evnlos.events.io.report import OnError, ReadReport
from evnlos.events.polarity import keep_known_polarity
from evnlos.types import Events


@dataclass(frozen=True)
class Box:
    """A part of the sensor, pixels.

    Args:
        x: Its first column, from 0.
        y: Its first row, from 0.
        width: Columns, at least 1.
        height: Rows, at least 1.

    Raises:
        ConfigError: A negative corner or a side below 1.
    """

    x: int
    y: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.x, self.y) < 0 or min(self.width, self.height) < 1:
            given = f"{self.x} {self.y} {self.width} {self.height}"
            raise ConfigError(f"the box {given} is X Y WIDTH HEIGHT in pixels; give X, Y >= 0 and sides >= 1")


@dataclass(frozen=True)
class Cut:
    """What to take of a recording.

    Args:
        start_s: Begin, seconds after the first event.
        stop_s: End, seconds after the first event; None = to the last. Events at this instant are left out.
        box: Part of the sensor; its corner becomes the pixel (0, 0). None = all.
        known_polarity: Whether to leave out events whose polarity the camera did not give.

    Raises:
        ConfigError: A start below 0 or an end that is not after it.
    """

    start_s: float = 0.0
    stop_s: float | None = None
    box: Box | None = None
    known_polarity: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.start_s < np.inf:
            raise ConfigError(f"start is {self.start_s} s; give 0 or more, seconds after the first event")
        if self.stop_s is not None and not self.stop_s > self.start_s:
            raise ConfigError(f"stop is {self.stop_s} s, start {self.start_s} s; give a stop after the start")


class Recording:
    """An event file that is read block by block; `report` fills while it is read.

    Args:
        path: The file; its format is found from its content.
        on_error: "strict" raises at the first fault, "salvage" leaves out what is damaged.
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.

    Raises:
        EventFileError: The file is absent, of no known format, or damaged at its start.
        MissingDependencyError: The format needs an optional package.

    Example:
        >>> import tempfile
        >>> from evnlos.events import write_events
        >>> name = tempfile.mkdtemp() + "/three.npz"
        >>> write_events(name, Events([5, 9, 12], [0, 3, 1], [1, 1, 0], [1, 0, 1], width=4, height=2))
        >>> recording = Recording(name)
        >>> list(recording.pieces(Cut(start_s=2e-6, box=Box(1, 0, 3, 2))))
        [Events(2 events, 3 x 2, 9..12 us, 50 % ON)]
    """

    def __init__(
        self,
        path: str | PathLike[str],
        on_error: OnError = "strict",
        *,
        width: int | None = None,
        height: int | None = None,
        celex: CelexOptions | None = None,
    ) -> None:
        self.path = Path(path)
        self._options = (on_error, width, height, celex)
        self.report: ReadReport = open_source(self.path, *self._options)[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Sensor size (height, width), pixels; of some formats known when their first events were read."""
        return self.report.height, self.report.width

    def pieces(self, cut: Cut | None = None) -> Iterator[Events]:
        """Yield the events in the order of time, as pieces of bounded size; each call reads the file anew.

        Args:
            cut: What to take; None = everything.

        Raises:
            EventFileError: In strict mode, at the first fault, after the pieces before it.
            ConfigError: The box leaves the sensor.
        """
        cut = cut or Cut()
        source, self.report = open_source(self.path, *self._options)
        first: int | None = None
        for columns in in_order(source.blocks(), self.report):
            events = trusted_events(columns, self.report.width, self.report.height)
            self.report.events += len(events)
            if first is None:
                first = int(events.t_us[0])
                _check_box(cut.box, events.shape)  # some formats state the sensor size with their first events
            over = cut.stop_s is not None and int(events.t_us[-1]) >= first + cut.stop_s * 1e6
            events = _stretch(events, first, cut)
            if cut.known_polarity:
                events = keep_known_polarity(events)
            if cut.box is not None:
                events = _crop(events, cut.box)
            if len(events):
                yield events
            if over:
                return

    def blank(self, cut: Cut | None = None) -> Events:
        """Return no events on the sensor, or on the part of it, that `pieces` yields events of."""
        box = cut.box if cut else None
        height, width = self.shape if box is None else (box.height, box.width)
        return Events.empty(width, height)


def _stretch(events: Events, first_us: int, cut: Cut) -> Events:
    if cut.start_s == 0 and cut.stop_s is None:
        return events
    start_us = first_us + int(np.ceil(cut.start_s * 1e6))
    start = int(np.searchsorted(events.t_us, start_us))
    stop = len(events)
    if cut.stop_s is not None and np.isfinite(cut.stop_s):
        stop = int(np.searchsorted(events.t_us, first_us + int(np.ceil(cut.stop_s * 1e6))))
    return events[start:stop]


def _crop(events: Events, box: Box) -> Events:
    # Coordinates are unsigned: left of the corner they wrap around to more than the box is wide.
    x, y = events.x - np.uint16(box.x), events.y - np.uint16(box.y)
    inside = (x < box.width) & (y < box.height)
    columns = {**events.columns(), "x": x, "y": y}
    return trusted_events({name: column[inside] for name, column in columns.items()}, box.width, box.height)


def _check_box(box: Box | None, shape: tuple[int, int]) -> None:
    if box is None:
        return
    if box.x + box.width > shape[1] or box.y + box.height > shape[0]:
        given = f"{box.x} {box.y} {box.width} {box.height}"
        raise ConfigError(
            f"the box {given} (X Y WIDTH HEIGHT) leaves the sensor of {shape[1]} x {shape[0]} pixels"
        )
