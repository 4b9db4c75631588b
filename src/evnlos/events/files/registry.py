"""The formats of event files, and writing them.

- The formats, found from a file's content before its name; a new format is one entry here.
- Writing event files: under a temporary name first, so that a file that exists is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError
from evnlos.events.files import (
    aedat,
    aedat4,
    celex,
    container_write,
    csv,
    fixed_words,
    hdf5,
    mcap,
    npz,
    raw,
    ros,
    ros_bags,
    word_write,
)
from evnlos.events.files.celex import CelexOptions
from evnlos.events.files.columns import Columns, ReadReport, Sink, refuse_topic, unreadable
from evnlos.events.files.ros_messages import ZSTD
from evnlos.files import new_file
from evnlos.types import Events
from evnlos.untrusted import no_file, open_regular

_SNIFFED_BYTES = 65_536


class FileSource(Protocol):
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
        open: Opens a file: (path, report, width, height, celex options, topic).
        create: Begins a file: (path, first piece of the events, the name that it will get); None where the
            format is only read.
        frames: Yields time [us] and image of its frames: (path, report, topic); None where it has none.
        has_streams: Whether a file may hold several streams, of which `topic` names one.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    open: Callable[[Path, ReadReport, int | None, int | None, CelexOptions | None, str | None], FileSource]
    create: Callable[[Path, Events, Path], Sink] | None = None
    frames: Callable[[Path, ReadReport, str | None], Iterator[tuple[int, NDArray]]] | None = None
    has_streams: bool = False

    def check_topic(self, path: Path, topic: str | None) -> None:
        """Raise EventFileError where a topic is named for a file that holds one stream."""
        if not self.has_streams:
            refuse_topic(path, path.suffix or self.name, topic)


def _plain(
    source: Callable[[Path, ReadReport, int | None, int | None], FileSource],
) -> Callable[..., FileSource]:
    """Return an opener of a format with one stream, which has no use for the options of CeleX-V."""
    return lambda path, report, width, height, _celex, _topic: source(path, report, width, height)


def _of_streams(source: Callable[..., FileSource]) -> Callable[..., FileSource]:
    """Return an opener of a format with several streams."""
    return lambda path, report, width, height, _, topic: source(path, report, width, height, topic)


def _celex(source: Callable[..., FileSource]) -> Callable[..., FileSource]:
    """Return an opener of a format with one stream and the options of CeleX-V."""
    return lambda path, report, width, height, options, _: source(path, report, width, height, options)


def _raw(name: str) -> Format:
    return Format(
        name,
        (".raw",),
        lambda start: raw.sniff_raw(start) == name,
        _plain(raw.RawSource),
        lambda path, first, _: raw.RawSink(path, first, name),
    )


def _ros(
    name: str,
    signature: bytes,
    container: Callable[..., ros.Container],
    create: Callable[[Path, Events, Path], Sink] | None = None,
) -> Format:
    def opened(path, report, width, height, _, topic):
        return ros.RosSource(container(path, report), path, report, width, height, topic)

    def frames(path, report, topic):
        return ros.ros_frames(container(path, report), path, report, topic)

    suffix = f".{name.lower()}"
    return Format(name, (suffix,), lambda start: start.startswith(signature), opened, create, frames, True)


FORMATS = (
    Format(
        "HDF5",
        (".h5", ".hdf5"),
        lambda start: start.startswith(hdf5.SIGNATURE),
        _of_streams(hdf5.open_hdf5_events),
        lambda path, first, _: container_write.Hdf5Sink(path, first),
        has_streams=True,
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
    Format("DAT", (".dat",), fixed_words.sniff_dat, _plain(fixed_words.DatSource)),
    Format("ES", (".es",), lambda start: start.startswith(fixed_words.SIGNATURE), _plain(fixed_words.EsSource)),
    Format(
        "AEDAT4",
        (".aedat4",),
        lambda start: start.startswith(aedat4.SIGNATURE),
        _of_streams(aedat4.Aedat4Source),
        lambda path, first, _: aedat4.Aedat4Sink(path, first),
        aedat4.aedat4_frames,
        has_streams=True,
    ),
    Format(
        "AEDAT2",
        (".aedat",),
        lambda start: start.startswith(aedat.SIGNATURE_2),
        _plain(aedat.Aedat2Source),
        frames=aedat.aedat2_frames,
    ),
    Format(
        "AEDAT3",
        (".aedat",),
        lambda start: start.startswith(aedat.SIGNATURE_3),
        _of_streams(aedat.Aedat3Source),
        frames=aedat.aedat3_frames,
        has_streams=True,
    ),
    _ros("DB3", ros_bags.DB3_SIGNATURE, ros_bags.Db3File),
    _ros("MCAP", mcap.SIGNATURE, mcap.McapFile, lambda path, first, _: container_write.McapSink(path, first)),
    _ros("BAG", ros_bags.BAG_SIGNATURE, ros_bags.BagFile),
    Format("CELEX", (".bin",), celex.sniff_celex, _celex(celex.CelexSource), word_write.CelexSink),
    Format(  # read as CELEX: the header tells the event formats apart
        "CELEX0",
        (),
        lambda _: False,
        _celex(celex.CelexSource),
        lambda path, first, target: word_write.CelexSink(path, first, target, event_format=0),
    ),
    Format(
        "CSV",
        (".csv", ".txt"),
        lambda start: csv.find_layout(start) is not None,
        _celex(csv.CsvSource),
        lambda path, first, _: csv.CsvSink(path, first),
    ),
)


def find_format(path: Path, celex: CelexOptions | None = None, wanted: str = "a recording") -> Format:
    """Return the format of a file from its content; a stated CeleX event format overrides a damaged header.

    Raises:
        EventFileError: The file is absent, empty, or of no known format.
    """
    if not path.is_file():
        raise EventFileError(no_file(path))
    with open_regular(path) as file:
        start = file.read(_SNIFFED_BYTES)
    if not start:
        raise unreadable(path, 0, "the file is empty", "record or copy it again")
    if celex is not None and celex.event_format is not None:
        return next(format for format in FORMATS if format.name == "CELEX")
    for format in FORMATS:
        if format.sniff(start):
            return format
    if start.startswith(ZSTD):
        raise unreadable(path, 0, "a file packed by zstd as a whole", "unpack it first: zstd -d FILE")
    known = ", ".join(format.name for format in FORMATS if format.suffixes)
    cure = f"give {wanted} ({known}; text in rows of t, x, y, p)"
    raise EventFileError(f"{path} is {_looks(start)}, of no known event format; {cure}")


def _looks(start: bytes) -> str:
    """Return what a file that holds no events looks like, from its first bytes."""
    text = start.decode("utf-8", "ignore")
    if "\0" in text or len(text.encode()) < len(start) - 3:  # a character may be cut
        return f"binary data that begin with the bytes {start[:8].hex(' ')}"
    line = next((line.strip() for line in text.splitlines() if line.strip()), "")
    return f"text that begins with {line[:30]!r}"


def format_to_write(path: Path, name: str | None) -> Format:
    """Return the format to write: the named one, else the first of the file's suffix.

    Raises:
        EventFileError: The name or suffix is unknown, or the format is only read.
    """
    writable = [format for format in FORMATS if format.create]
    if name is None:
        found = [format for format in writable if path.suffix.lower() in format.suffixes]
        what = f"suffix {path.suffix!r}" if path.suffix else "a name without suffix"
    else:
        found = [format for format in writable if format.name == name.upper()]
        what = f"format {name!r}"
    if not found:
        suffixes = dict.fromkeys(suffix for format in writable for suffix in format.suffixes)
        names = ", ".join(format.name for format in writable)
        cure = f"end its name in one of {', '.join(suffixes)}, or give format= (--format), one of {names}"
        raise EventFileError(f"{path}: cannot write {what}; {cure}")
    return found[0]


_PIECE = 1 << 16  # smaller pieces are put together: they would cost a call and a chunk each


class EventWriter:
    """An event file that grows piece by piece; it appears under its name when all went well.

    Memory is bounded by the largest piece. Leaving the block by an error leaves no file.

    Args:
        path: The file to write; an existing one is replaced.
        format: Name of the format, by default that of the suffix (`write_events` lists them).

    Raises:
        EventFileError: No writable format has that suffix or name, or the folder cannot be written.
        DataError: A piece of another sensor or with other columns than the first, or earlier than the one
            before; no piece at all; or the format cannot hold the sensor size or the times.

    Example:
        >>> import tempfile, pathlib
        >>> from evnlos.events import read_events
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "three.raw"
        >>> with EventWriter(path) as writer:
        ...     writer.write(Events([5], [0], [1], [True], width=4, height=2))
        ...     writer.write(Events([5, 9], [3, 3], [1, 0], [True, False], width=4, height=2))
        >>> read_events(path)
        Events(3 events, 4 x 2, 5..9 us, 67 % ON)
    """

    def __init__(self, path: str | PathLike[str], *, format: str | None = None) -> None:
        self.path = Path(path)
        self._format = format_to_write(self.path, format)
        self._place = new_file(self.path)
        self._temporary = self._place.__enter__()
        self._sink: Sink | None = None
        self._blank: Events | None = None  # states the sensor
        self._names: tuple[str, ...] = ()
        self._held: list[Events] = []
        self._newest: int | None = None
        self.events = 0

    def __enter__(self) -> EventWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            with ExitStack() as leaving:
                leaving.push(self._place)  # at the end: the file gets its name, or goes
                leaving.callback(self._let_go)
                if error is not None:
                    raise error
                self._finish()
        except OSError as failure:
            if failure is error:
                raise
            raise self._failure(failure) from None

    def _let_go(self) -> None:
        if self._sink is not None:
            with suppress(OSError):  # what could not be written was told before, and the file goes
                self._sink.close()

    def write(self, events: Events) -> None:
        """Add a piece; one without events states the sensor size, for a stream that may have none."""
        self._check(events)
        if len(events):
            self._held.append(events)
            self.events += len(events)
        if sum(map(len, self._held)) >= _PIECE:
            try:
                self._flush()
            except OSError as error:
                raise self._failure(error) from None

    def _check(self, events: Events) -> None:
        if self._blank is None:
            self._blank = events[:0]
        if events.shape != self._blank.shape:
            raise DataError(
                f"{self.path}: a piece of {events.width} x {events.height} pixels after one of "
                f"{self._blank.width} x {self._blank.height}; write one sensor a file"
            )
        if not len(events):
            return
        names = tuple(events.columns())
        if self._names and names != self._names:
            raise DataError(
                f"{self.path}: a piece with columns {names} after {self._names}; make them the same"
            )
        self._names = names
        if self._newest is not None and int(events.t_us[0]) < self._newest:
            raise DataError(
                f"{self.path}: a piece from {int(events.t_us[0])} us after an event at {self._newest} us; "
                "write pieces in the order of time"
            )
        self._newest = int(events.t_us[-1])

    def _flush(self) -> None:
        piece = _joined(self._held) if self._held else self._blank
        assert piece is not None
        self._held = []
        if self._sink is None:
            assert self._format.create is not None
            self._sink = self._format.create(self._temporary, piece, self.path)
        self._sink.append(piece)

    def _finish(self) -> None:
        if self._blank is None:
            raise DataError(f"{self.path}: nothing to write; give at least one piece, which may be empty")
        if self._held or self._sink is None:
            self._flush()
        assert self._sink is not None
        self._sink.finish()
        self._sink.close()

    def _failure(self, error: OSError) -> EventFileError:
        return EventFileError(f"{self.path}: writing failed ({error}); check the folder and the space on it")


def _joined(pieces: list[Events]) -> Events:
    if len(pieces) == 1:
        return pieces[0]
    columns = {
        name: np.concatenate([piece.columns()[name] for piece in pieces]) for name in pieces[0].columns()
    }
    return Events._trusted(columns, pieces[0].width, pieces[0].height)


def write_events(
    path: str | PathLike[str], events: Events | Iterable[Events], *, format: str | None = None
) -> None:
    """Write events to a file; it appears under its name only when it is complete.

    Args:
        path: The file to write; an existing one is replaced.
        events: The events, or pieces of one stream in the order of time, such as `iter_events` yields: memory
            is then bounded by the largest piece.
        format: Name of the format, such as "EVT2"; by default the suffix decides: .h5 and .hdf5 HDF5 with
            DSEC columns, .npz NPZ, .raw EVT3, .csv CSV, .mcap MCAP with images for viewers,
            .bin CeleX-V (name it ..._100M.bin).

    Raises:
        EventFileError: No writable format has that suffix or name, or the folder cannot be written.
        DataError: The format cannot hold the sensor size or the times, or the pieces do not fit together.
    """
    with EventWriter(path, format=format) as writer:
        for piece in [events] if isinstance(events, Events) else events:
            writer.write(piece)
