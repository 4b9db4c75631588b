"""The formats, found from a file's content before its name; a new format is one entry here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from evnlos.errors import EventFileError
from evnlos.events.io import (
    aedat4,
    aedat4_write,
    celex,
    celex_write,
    csv,
    csv_layout,
    dat,
    es,
    hdf5,
    hdf5_write,
    npz,
    raw,
    raw_write,
)
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.columns import Columns
from evnlos.events.io.report import ReadReport, unreadable
from evnlos.events.io.sink import Sink
from evnlos.types import Events
from evnlos.untrusted import open_regular

_SNIFFED_BYTES = 65_536


class Source(Protocol):
    """An open event file: checked header, events as one set of columns or block by block."""

    def read(self) -> Columns:
        """Return all events."""
        ...

    def blocks(self) -> Iterator[Columns]:
        """Yield the events in blocks of bounded size."""
        ...


@dataclass(frozen=True)
class Format:
    """One event file format.

    Args:
        name: Its name, as `write_events(format=...)` takes it.
        suffixes: File name endings, lower case with the dot.
        sniff: Whether the first bytes of a file (64 KiB at most) are of this format.
        open: Opens a file: (path, report, width, height, celex options).
        create: Begins a file: (path, first piece of the events, the name that it will get); None where the
            format is only read.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    open: Callable[[Path, ReadReport, int | None, int | None, CelexOptions | None], Source]
    create: Callable[[Path, Events, Path], Sink] | None = None


def _plain(source: Callable[[Path, ReadReport, int | None, int | None], Source]) -> Callable[..., Source]:
    """Return an opener that has no use for the options of CeleX-V."""
    return lambda path, report, width, height, _: source(path, report, width, height)


def _raw(name: str) -> Format:
    return Format(
        name,
        (".raw",),
        lambda start: raw.sniff_raw(start) == name,
        _plain(raw.RawSource),
        lambda path, first, _: raw_write.RawSink(path, first, name),
    )


FORMATS = (
    Format(
        "HDF5",
        (".h5", ".hdf5"),
        lambda start: start.startswith(hdf5.SIGNATURE),
        _plain(hdf5.Hdf5Source),
        lambda path, first, _: hdf5_write.Hdf5Sink(path, first),
    ),
    Format(
        "NPZ",
        (".npz",),
        lambda start: start.startswith(npz.SIGNATURE),
        _plain(npz.NpzSource),
        lambda path, first, _: npz.NpzSink(path, first),
    ),
    _raw("EVT3"),  # the first of a suffix is the one that is written by default
    _raw("EVT2"),
    _raw("EVT21"),
    Format("DAT", (".dat",), dat.sniff_dat, _plain(dat.DatSource)),
    Format("ES", (".es",), lambda start: start.startswith(es.SIGNATURE), _plain(es.EsSource)),
    Format(
        "AEDAT4",
        (".aedat4",),
        lambda start: start.startswith(aedat4.SIGNATURE),
        _plain(aedat4.Aedat4Source),
        lambda path, first, _: aedat4_write.Aedat4Sink(path, first),
    ),
    Format("CELEX", (".bin",), celex.sniff_celex, celex.CelexSource, celex_write.CelexSink),
    Format(  # read as CELEX: the header tells the event formats apart
        "CELEX0",
        (),
        lambda _: False,
        celex.CelexSource,
        lambda path, first, target: celex_write.CelexSink(path, first, target, event_format=0),
    ),
    Format(
        "CSV",
        (".csv", ".txt"),
        lambda start: csv_layout.find_layout(start) is not None,
        csv.CsvSource,
        lambda path, first, _: csv.CsvSink(path, first),
    ),
)


def find_format(path: Path, celex_options: CelexOptions | None = None) -> Format:
    """Return the format of a file from its content; a stated CeleX event format overrides a damaged header.

    Raises:
        EventFileError: The file is absent, empty, or of no known format.
    """
    if not path.is_file():
        raise EventFileError(f"{path}: no such file; check the path")
    with open_regular(path) as file:
        start = file.read(_SNIFFED_BYTES)
    if not start:
        raise unreadable(path, 0, "the file is empty", "record or copy it again")
    if celex_options is not None and celex_options.event_format is not None:
        return next(format for format in FORMATS if format.name == "CELEX")
    for format in FORMATS:
        if format.sniff(start):
            return format
    known = ", ".join(format.name for format in FORMATS if format.suffixes)
    raise unreadable(
        path, 0, f"no known event format starts with {start[:8].hex(' ')}", f"these are read: {known}"
    )


def format_to_write(path: Path, name: str | None) -> Format:
    """Return the format to write: the named one, else the first of the file's suffix.

    Raises:
        EventFileError: The name or suffix is unknown, or the format is only read.
    """
    writable = [format for format in FORMATS if format.create]
    if name is None:
        found = [format for format in writable if path.suffix.lower() in format.suffixes]
        what = f"suffix {path.suffix!r}"
    else:
        found = [format for format in writable if format.name == name.upper()]
        what = f"format {name!r}"
    if not found:
        suffixes = dict.fromkeys(suffix for format in writable for suffix in format.suffixes)
        names = ", ".join(format.name for format in writable)
        raise EventFileError(f"{path}: cannot write {what}; suffixes {', '.join(suffixes)}, formats {names}")
    return found[0]
