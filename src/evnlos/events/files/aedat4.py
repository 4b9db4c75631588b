"""AEDAT4, the format of iniVation's cameras, read and written.

- Reading goes through the optional package `aedat`.
- Writing: an XML description, then packets of events or frames as flat buffers, not compressed.

Flat buffers are laid out by hand: each packet is one table whose places are known beforehand. Numbers of bytes
in the comments count from the start of the packet's size.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import closing
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError, MissingDependencyError
from evnlos.events.files.columns import (
    ColumnCheck,
    Columns,
    FileSink,
    ReadReport,
    Stream,
    StreamKind,
    choose_stream,
    join,
    unreadable,
)
from evnlos.events.files.ros_messages import grey_of
from evnlos.files import new_file
from evnlos.types import Events
from evnlos.untrusted import Child

SIGNATURE = b"#!AER-DAT4.0\r\n"
_CHILD_BYTES = 2 << 30  # address space of numpy and the package
_MAX_RATIO = 300  # LZ4 expands at most 255 times
_CURE = "the file is damaged or not complete: copy it again"


def _require_package() -> None:
    try:
        import aedat  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "reading AEDAT4 needs the package aedat: pip install evnlos[aedat], "
            "or convert the file elsewhere to HDF5 (DSEC columns), NPZ or RAW"
        ) from None


class _Decoder(Child):
    """The package at work in a process of its own, whose memory and time grow with the file only."""

    def __init__(self, path: Path, kind: str, number: int | None) -> None:
        self._path = path
        size = path.stat().st_size
        limits = [str(_CHILD_BYTES + _MAX_RATIO * size), str(30 + size // 500_000)]
        super().__init__(
            Path(__file__).with_name("_aedat4_child.py"),
            [str(path.absolute()), *limits, kind, *([] if number is None else [str(number)])],
        )

    def stream_size(self) -> tuple[int, int] | None:
        """Return width and height of the stream, None where there is none; the first thing to take."""
        size = self.take_json()
        return None if size is None else (size[0], size[1])

    def failure(self, found: str) -> EventFileError:
        """Return the error of a decoder that stopped before the end of the file."""
        return unreadable(self._path, 0, f"AEDAT4 cannot be decoded ({found})", _CURE)


def check_packets(path: Path, report: ReadReport) -> None:
    """Walk the packets' lengths from the header to the data table, which shows where a file was cut."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = len(SIGNATURE)
        file.seek(start)
        prefix = file.read(4)
        length = struct.unpack("<I", prefix)[0] if len(prefix) == 4 else 0
        if length < 16 or start + 4 + length > size:
            raise unreadable(path, start, f"a header of {length} bytes in a file of {size}", _CURE)
        end = _data_table_position(file.read(length), size)
        at = start + 4 + length
        if not at <= end <= size:
            raise unreadable(path, start, f"a data table at byte {end} of {size}", _CURE)
        while at < end:
            file.seek(at)
            head = file.read(8)
            length = struct.unpack("<ii", head)[1] if len(head) == 8 else -1
            if length < 0 or at + 8 + length > end:
                raise unreadable(path, at, f"a packet of {length} bytes, {end - at} are left", _CURE)
            at += 8 + length


def field_of(table: bytes, number: int, root: int = 0) -> int:
    """Return where a field of a flat buffer's table begins, 0 where it is absent.

    Raises:
        struct.error: The buffer is damaged.
    """
    start = root + struct.unpack_from("<I", table, root)[0]
    vtable = start - struct.unpack_from("<i", table, start)[0]
    if vtable < 0:
        raise struct.error("a table before its buffer")
    if struct.unpack_from("<H", table, vtable)[0] < 6 + 2 * number:
        return 0
    field = struct.unpack_from("<H", table, vtable + 4 + 2 * number)[0]
    return start + field if field else 0


def _data_table_position(header: bytes, size: int) -> int:
    """Return the second field of the header's flat buffer, the file's size where it is absent or -1."""
    try:
        field = field_of(header, 1)
        position = struct.unpack_from("<q", header, field)[0] if field else -1
    except struct.error:
        return 2**63 - 1  # outside every file: the caller reports it
    return size if position < 0 else position


COMPRESSIONS = ("none", "lz4", "lz4", "zstd", "zstd")
"""How packets are packed, by the number in the header."""


class Described(NamedTuple):
    """A stream as the header describes it: kind ("EVTS"), name, camera, sensor size or zeros."""

    number: int
    identifier: str
    output: str
    source: str
    width: int
    height: int


def described(header: bytes) -> tuple[str, list[Described]]:
    """Return how packets are packed and the streams that a header (without its size) describes.

    Raises:
        ValueError: It is damaged.
    """
    try:
        packed = field_of(header, 0)
        method = struct.unpack_from("<i", header, packed)[0] if packed else 0
        text = field_of(header, 2)
        text += struct.unpack_from("<I", header, text)[0]
        length = struct.unpack_from("<I", header, text)[0]
    except struct.error:
        raise ValueError("a header that is damaged") from None
    description = header[text + 4 : text + 4 + length].decode("latin-1")
    if not 0 <= method < len(COMPRESSIONS):
        raise ValueError(f"packets packed by method {method}, none, LZ4 and Zstandard are read")
    nodes = re.split(r'<node name="(\d{1,9})"', description)
    found = []
    for number, node in zip(nodes[1::2], nodes[2::2], strict=True):
        kind, output, source, *sides = (_attribute(node, key) for key in _ATTRIBUTES)
        width, height = (int(side) if side.isdecimal() and len(side) < 6 else 0 for side in sides)
        found.append(Described(int(number), kind, output, source, width, height))
    return COMPRESSIONS[method], found


_ATTRIBUTES = "typeIdentifier", "originalOutputName", "source", "sizeX", "sizeY"


def _attribute(node: str, key: str) -> str:
    """Return the text of an attribute of a node's XML, "" where it has none."""
    match = re.search(rf'"{key}"[^>]*>([^<]{{0,200}})<', node)
    return match[1].strip() if match else ""


_KINDS: dict[str, StreamKind] = {"EVTS": "events", "FRME": "frames"}


def _choose(path: Path, report: ReadReport, topic: str | None, kind: StreamKind) -> int | None:
    """List the streams of a file and return the number of the one to read.

    None is the first of its kind: the header says of no stream what it holds.

    Raises:
        EventFileError: No stream of that kind or name, or several and no name.
    """
    with path.open("rb") as file:
        file.seek(len(SIGNATURE))
        try:
            streams = described(file.read(struct.unpack("<I", file.read(4))[0]))[1]
        except (ValueError, struct.error):
            streams = []  # the package judges it
    streams = [stream for stream in streams if stream.identifier]
    numbers = {f"{stream.number}/{stream.output}".rstrip("/"): stream.number for stream in streams}
    report.streams = tuple(
        Stream(name, _KINDS.get(stream.identifier, "other"), f"{stream.identifier} {stream.source}".strip())
        for name, stream in zip(numbers, streams, strict=False)
    )
    if not any(stream.kind == kind for stream in report.streams) and topic is None:
        return None
    report.topic = choose_stream(path, report.streams, topic, kind, report.strict).name
    return numbers[report.topic]


class Aedat4Source:
    """One event stream of an AEDAT4 file."""

    def __init__(
        self, path: Path, report: ReadReport, width: int | None, height: int | None, topic: str | None = None
    ) -> None:
        self.path, self.report = path, report
        report.format = "AEDAT4"
        _require_package()
        check_packets(path, report)
        self._number = _choose(path, report, topic, "events")
        if width is not None:
            report.set_geometry(width, height, "caller")

    def _read_size(self, decoder: _Decoder) -> None:
        size = decoder.stream_size()
        if size is None:
            raise unreadable(self.path, 0, "an AEDAT4 file without an event stream", "record events as well")
        if not self.report.geometry_from:
            self.report.set_geometry(size[0], size[1], "header")

    def blocks(self) -> Iterator[Columns]:
        """Yield the columns packet by packet."""
        check = ColumnCheck(self.report)
        with _Decoder(self.path, "events", self._number) as decoder:
            self._read_size(decoder)
            while True:
                count = struct.unpack("<q", decoder.take(8))[0]
                if count < 0:
                    return
                data = decoder.take(13 * count)
                times = np.frombuffer(data, "<i8", count)
                x, y = (np.frombuffer(data, "<u2", count, place * count) for place in (8, 10))
                p = np.frombuffer(data, np.bool_, count, 12 * count)
                yield check({"t_us": times, "x": x, "y": y, "p": p})

    def read(self) -> Columns:
        """Return all events of the stream."""
        return join(list(self.blocks()))


def aedat4_frames(path: Path, report: ReadReport, topic: str | None) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield the time [us] and the grey image [H, W] of each frame of a stream.

    Raises:
        EventFileError: The file is damaged or has no frames.
        MissingDependencyError: The package `aedat` is not installed.
    """
    _require_package()
    check_packets(path, ReadReport(path))
    number = _choose(path, report, topic, "frames")
    with _Decoder(path, "frame", number) as decoder:
        if decoder.stream_size() is None:
            raise unreadable(path, 0, "an AEDAT4 file without frames", "record frames as well")
        while (t_us := struct.unpack("<q", decoder.take(8))[0]) != -1:
            height, width, channels = struct.unpack("<3q", decoder.take(24))
            pixels = np.frombuffer(decoder.take(height * width * channels), np.uint8)
            yield t_us, grey_of(pixels.reshape(height, width, channels))


_MAX_SIDE = 1 << 15
_PACKET = 1 << 14  # events
EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "on"],
        "formats": ["<i8", "<i2", "<i2", "?"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
_EVENTS, _FRAMES = 0, 1  # numbers of the streams


def _description(width: int, height: int, has_frames: bool) -> bytes:
    """Return the XML that names the streams."""
    streams = [(_EVENTS, "events", "EVTS")] + [(_FRAMES, "frames", "FRME")] * has_frames
    nodes = "".join(
        f'<node name="{number}" path="/outInfo/{number}/">'
        f'<attr key="compression" type="string">NONE</attr>'
        f'<attr key="originalOutputName" type="string">{name}</attr>'
        f'<attr key="typeIdentifier" type="string">{kind}</attr>'
        f'<node name="info" path="/outInfo/{number}/info/">'
        f'<attr key="sizeX" type="int">{width}</attr><attr key="sizeY" type="int">{height}</attr>'
        f'<attr key="source" type="string">evnlos</attr></node></node>'
        for number, name, kind in streams
    )
    return f'<dv version="2.0"><node name="outInfo" path="/outInfo/">{nodes}</node></dv>'.encode("ascii")


def _header(description: bytes) -> bytes:
    """Return the table IOHeader: no compression, no data table, the description."""
    vtable = struct.pack("<5H", 10, 20, 12, 4, 16)  # at 12
    table = struct.pack("<iqiI", 28 - 12, -1, 0, 4)  # at 28
    text = struct.pack("<I", len(description)) + description + b"\0"  # at 48
    body = struct.pack("<I4s", 28 - 4, b"IOHE") + vtable + bytes(6) + table + text
    return struct.pack("<I", len(body)) + body


def _event_packet(events: Events) -> bytes:
    """Return the table EventPacket: a vector of structures of 16 bytes."""
    rows = np.zeros(len(events), EVENT)
    rows["t"], rows["x"], rows["y"], rows["on"] = events.t_us, events.x, events.y, events.p
    vtable = struct.pack("<3H", 6, 8, 4)  # at 12
    table = struct.pack("<iI", 20 - 12, 4)  # at 20
    body = struct.pack("<I4s", 20 - 4, b"EVTS") + vtable + bytes(2) + table
    body += struct.pack("<I", len(rows)) + rows.tobytes()  # at 28, the rows at 32
    return struct.pack("<I", len(body)) + body


def _frame_packet(frame: NDArray[np.uint8], t_us: int) -> bytes:
    """Return the table Frame: five times, the format (0 is grey), size, place and pixels."""
    height, width = frame.shape
    vtable = struct.pack("<13H", 26, 60, 4, 12, 20, 28, 36, 56, 48, 50, 52, 54, 44)  # at 12
    table = struct.pack("<i5qI4hb3x", 44 - 12, *[t_us] * 5, 16, width, height, 0, 0, 0)  # at 44
    body = struct.pack("<I4s", 44 - 4, b"FRME") + vtable + bytes(6) + table
    body += struct.pack("<I", frame.size) + frame.tobytes()  # at 104
    return struct.pack("<I", len(body)) + body


class Aedat4Sink(FileSink):
    """An AEDAT4 file that grows; intensities of events are left out."""

    def __init__(self, path: Path, first: Events, *, has_frames: bool = False) -> None:
        if max(first.width, first.height) > _MAX_SIDE:
            raise DataError(
                f"AEDAT4 holds sensors up to {_MAX_SIDE} x {_MAX_SIDE}, not {first.width} x {first.height}; "
                "write .h5 or .npz"
            )
        super().__init__(path)
        self.file.write(SIGNATURE + _header(_description(first.width, first.height, has_frames)))

    def _packet(self, stream: int, content: bytes) -> None:
        self.file.write(struct.pack("<ii", stream, len(content)) + content)

    def append(self, events: Events) -> None:
        """Write the packets of a piece."""
        if events.polarity_known is not None and not events.polarity_known.all():
            raise DataError(
                "AEDAT4 has no mark for an unknown polarity; use keep_known_polarity(events) first, "
                "or write .h5"
            )
        for start in range(0, len(events), _PACKET):
            self._packet(_EVENTS, _event_packet(events[start : start + _PACKET]))

    def append_frame(self, frame: NDArray[np.uint8], t_us: int) -> None:
        """Write one grey image [H, W] of 8 bits."""
        self._packet(_FRAMES, _frame_packet(frame, t_us))

    def finish(self) -> None:
        """Do nothing: the file holds no count and no index."""


def write_aedat4(
    path: str | PathLike[str], events: Events, frames: NDArray[np.uint8], times_us: NDArray
) -> None:
    """Write events and frames of one clock into one AEDAT4 file, as cameras with both kinds of pixels do.

    Args:
        path: The file to write; an existing one is replaced.
        events: The events.
        frames: Grey images, uint8 [T, H, W].
        times_us: Time of each frame, [T], microseconds, ascending, on the events' clock.

    Raises:
        DataError: Frames of another shape or type, times that do not ascend or are not as many as the frames.
    """
    frames, times = np.asarray(frames), np.asarray(times_us, np.int64)
    if frames.ndim != 3 or frames.dtype != np.uint8 or max(frames.shape[1:]) >= _MAX_SIDE:
        raise DataError(f"frames of shape {frames.shape} and type {frames.dtype}; give uint8 [T, H, W]")
    if times.shape != frames.shape[:1] or (np.diff(times) <= 0).any():
        raise DataError(f"{len(frames)} frames with times of shape {times.shape}; give one each, ascending")
    with new_file(path) as temporary, closing(Aedat4Sink(temporary, events, has_frames=True)) as sink:
        done = 0
        for frame, t_us in zip(frames, times.tolist(), strict=True):
            until = int(np.searchsorted(events.t_us, t_us, side="right"))
            sink.append(events[done:until])
            sink.append_frame(frame, t_us)
            done = until
        sink.append(events[done:])
