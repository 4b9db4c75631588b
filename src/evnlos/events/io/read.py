"""Reading event files whole or in pieces."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from evnlos.errors import EventFileError
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.columns import allocate, keep_in_order, trusted_events
from evnlos.events.io.registry import Source, find_format
from evnlos.events.io.report import OnError, ReadReport, check_on_error
from evnlos.types import Events


def open_source(
    path: Path, on_error: OnError, width: int | None, height: int | None, celex: CelexOptions | None = None
) -> tuple[Source, ReadReport]:
    """Return an open file and the report that reading it fills."""
    check_on_error(on_error)
    if (width is None) != (height is None):
        raise EventFileError(f"width={width} with height={height}; give both or neither")
    for name, side in (("width", width), ("height", height)):
        if side is not None and not 1 <= side <= 65_536:
            raise EventFileError(f"{name}={side}; give 1 to 65536 pixels")
    report = ReadReport(path, strict=on_error == "strict")
    try:
        source = find_format(path, celex).open(path, report, width, height, celex)
    except OSError as error:
        raise EventFileError(f"{path}: cannot be opened ({error.strerror}); check its permissions") from None
    return source, report


def read_events_report(
    path: str | PathLike[str],
    on_error: OnError = "salvage",
    *,
    width: int | None = None,
    height: int | None = None,
    celex: CelexOptions | None = None,
) -> tuple[Events, ReadReport]:
    """Return the events of a file, and what was found wrong with it.

    Args:
        path: The file; its format is found from its content.
        on_error: "salvage" skips what is damaged and reports it; "strict" raises at the first fault.
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.

    Raises:
        EventFileError: Nothing can be read, or in strict mode anything is wrong.
        MissingDependencyError: The format needs an optional package.
    """
    source, report = open_source(Path(path), on_error, width, height, celex)
    try:
        columns = source.read()
    except OSError as error:
        raise EventFileError(f"{path}: reading failed ({error.strerror}); copy the file again") from None
    if not columns:
        columns = allocate(0)
    if report.faults.get("backwards"):
        columns = keep_in_order(columns)
    report.events = len(columns["t_us"])
    return trusted_events(columns, report.width, report.height), report


def read_events(
    path: str | PathLike[str],
    on_error: OnError = "strict",
    *,
    width: int | None = None,
    height: int | None = None,
    celex: CelexOptions | None = None,
) -> Events:
    """Return the events of a file.

    Read are HDF5 (DSEC columns), NPZ, CSV, Prophesee RAW (EVT2, EVT2.1, EVT3) and DAT, CeleX-V `.bin` and
    CSV and, with the extra `aedat`, AEDAT4.

    Args:
        path: The file; its format is found from its content, whatever its name.
        on_error: "strict" raises at the first fault with the byte offset, what was found and what to do;
            "salvage" returns what is good (`read_events_report` returns the tally of faults beside it).
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.

    Raises:
        EventFileError: The file is damaged, contradicts itself or is of no known format.
        MissingDependencyError: The format needs an optional package.

    Example:
        >>> import tempfile, pathlib
        >>> from evnlos.events import write_events
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "two.raw"
        >>> write_events(path, Events([5, 9], [0, 3], [1, 1], [True, False], width=4, height=2))
        >>> read_events(path)
        Events(2 events, 4 x 2, 5..9 us, 50 % ON)
    """
    return read_events_report(path, on_error, width=width, height=height, celex=celex)[0]
