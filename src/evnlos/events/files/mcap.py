"""MCAP, the container of ROS 2 and Foxglove, read from its start: neither index nor end is needed.

Records are one byte of kind, eight of length, and content; chunks hold further records, packed by lz4 or zstd
or as they are, with a CRC-32. Format: mcap.dev/spec. All numbers are little endian. Chunks, those of other bags
too, are unpacked into no more memory than they may take: what a file says of a size decides nothing, bytes are
counted while they come out.
"""

from __future__ import annotations

import bz2
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from evnlos.errors import MissingDependencyError
from evnlos.events.files.columns import SALVAGE, ReadReport, unreadable
from evnlos.untrusted import open_regular

MOST_CHUNK_BYTES = 1 << 27
"""Size of a chunk, packed or not, at most; recorders write about a megabyte."""


def unpack(method: str, data: bytes | memoryview, size: int | None) -> bytes | memoryview:
    """Return the unpacked bytes of a chunk.

    Args:
        method: "" or "none" (as they are), "bz2", "lz4" (frames) or "zstd".
        data: The packed bytes.
        size: How many bytes they are unpacked, as the file says; None where it does not.

    Raises:
        ValueError: Another method, damage, another size than stated, or a chunk that is too large.
        MissingDependencyError: lz4 or zstd without its package.
    """
    is_stated, size = size is not None, MOST_CHUNK_BYTES if size is None else size
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, at most {MOST_CHUNK_BYTES} are read")
    if method in ("", "none"):
        unpacked: Any = data
    elif method == "bz2":
        unpacked = _bz2(data, size)
    elif method == "lz4":
        unpacked = _lz4(data, size)
    elif method == "zstd":
        unpacked = _zstd(data, size)
    else:
        raise ValueError(f"a chunk packed by {method[:20]!r}; none, bz2, lz4 and zstd are read")
    if len(unpacked) != size if is_stated else len(unpacked) > size:
        raise ValueError(f"a chunk of {len(unpacked)} bytes or more where {size} are announced")
    return unpacked


def _bz2(data: bytes | memoryview, size: int) -> bytes:
    try:
        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"a chunk that bz2 cannot unpack ({error})") from None


def _lz4(data: bytes | memoryview, size: int) -> bytes:
    try:
        import lz4.frame  # type: ignore[import-not-found]
    except ImportError:
        raise MissingDependencyError(_missing("lz4")) from None
    try:
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise ValueError(f"a chunk that lz4 cannot unpack ({error})") from None


def _zstd(data: bytes | memoryview, size: int) -> bytes:
    try:
        import zstandard  # type: ignore[import-not-found]
    except ImportError:
        raise MissingDependencyError(_missing("zstd")) from None
    try:
        decoder = zstandard.ZstdDecompressor(max_window_size=MOST_CHUNK_BYTES)
        return decoder.stream_reader(data, read_across_frames=True).read(size + 1)
    except (zstandard.ZstdError, MemoryError, ValueError) as error:
        raise ValueError(f"a chunk that zstd cannot unpack ({error})") from None


def _missing(method: str) -> str:
    return (
        f"this recording is packed by {method}, which needs a package: pip install evnlos[ros], "
        "or write the recording again without compression"
    )


SIGNATURE = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END = 3, 4, 5, 6, 11, 15
FOOTER = 2
_FOOTER_BYTES = 9 + 20 + len(SIGNATURE)
_MESSAGE_HEAD = 22
_SALVAGE = f"copy the file again or {SALVAGE}"
RENDERED = "rendered from"
"""Key of a channel's metadata: what its images were made of, so that no one takes them for a camera's."""


class Topic(NamedTuple):
    """A topic of a recording: its name, message type ("package/Name"), coding ("cdr" or "ros1"), messages."""

    name: str
    type: str
    coding: str
    messages: int | None = None
    is_rendered: bool = False


def topics_of(connections: dict[int, Topic], counts: dict[int, int]) -> list[Topic]:
    """Return the topics of numbered connections, of which several may share a name, with their messages."""
    found: dict[str, Topic] = {}
    for number, topic in connections.items():
        before = found[topic.name].messages or 0 if topic.name in found else 0
        count = before + counts[number] if number in counts else None
        found[topic.name] = topic._replace(messages=count)
    return list(found.values())


class Message(NamedTuple):
    """A message: its topic, where it (or its chunk) stands in the file, its time of receipt, its bytes.

    The place is a byte; of a `.db3` it is the number of the message.
    """

    topic: Topic
    offset: int
    received_ns: int
    data: bytes | memoryview


class Walk:
    """Strings and numbers of a record, in their order; reading past the end is a ValueError."""

    def __init__(self, data: bytes | memoryview, at: int = 0) -> None:
        self.data, self.at = memoryview(data), at

    def take(self, size: int) -> memoryview:
        """Return the next bytes."""
        if size > len(self.data) - self.at:
            raise ValueError(f"{size} bytes wanted, {len(self.data) - self.at} are left in the record")
        self.at += size
        return self.data[self.at - size : self.at]

    def number(self, size: int) -> int:
        """Return an unsigned number of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """Return a string: four bytes of length, then UTF-8."""
        return bytes(self.take(self.number(4))).decode("utf-8", "replace")


class McapFile:
    """An MCAP file.

    Args:
        path: The file.
        report: Takes what is wrong.
    """

    name = "MCAP"

    def __init__(self, path: Path, report: ReadReport) -> None:
        self.path, self.report = path, report
        self._size = path.stat().st_size
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Topic] = {}

    def topics(self) -> list[Topic]:
        """Return the topics: from the summary behind the messages, else by reading all."""
        with open_regular(self.path) as file:
            counts = self._read_summary(file)
        if not self._channels:
            for _ in McapFile(self.path, ReadReport(self.path, strict=False))._walk(
                self._channels, frozenset()
            ):
                pass
            counts = {}
        return topics_of(self._channels, counts)

    def messages(self, names: frozenset[str]) -> Iterator[Message]:
        """Yield the messages of the named topics in the order of the file."""
        yield from self._walk({}, names)

    def _read_summary(self, file: BinaryIO) -> dict[int, int]:
        """Fill schemas and channels from the summary, if it is whole, and return messages per channel."""
        counts: dict[int, int] = {}
        try:
            file.seek(self._size - _FOOTER_BYTES)
            footer = file.read(_FOOTER_BYTES)
            kind, _, start = struct.unpack_from("<BQQ", footer)
            if kind != FOOTER or not 0 < start < self._size or not footer.endswith(SIGNATURE):
                return counts
            if self._size - start > MOST_CHUNK_BYTES:
                return counts
            file.seek(start)
            for kind, content in _records(memoryview(file.read(self._size - start - _FOOTER_BYTES))):
                self._define(kind, content, self._channels)
                if kind == _STATISTICS:
                    walk = Walk(content, 42)
                    for _ in range(walk.number(4) // 10):
                        channel = walk.number(2)
                        counts[channel] = walk.number(8)
        except (OSError, struct.error, ValueError):
            self._channels.clear()
        return counts

    def _define(self, kind: int, content: memoryview, channels: dict[int, Topic]) -> None:
        """Take a schema or a channel."""
        walk = Walk(content)
        if kind == _SCHEMA:
            number = walk.number(2)
            self._schemas[number] = walk.text()
        elif kind == _CHANNEL:
            number, schema, name, coding = walk.number(2), walk.number(2), walk.text(), walk.text()
            end = walk.number(4) + walk.at
            metadata = {}
            while walk.at < end:
                key = walk.text()
                metadata[key] = walk.text()
            type_name = self._schemas.get(schema, "").replace("/msg/", "/")
            channels[number] = Topic(name, type_name, coding, None, RENDERED in metadata)

    def _walk(self, channels: dict[int, Topic], names: frozenset[str]) -> Iterator[Message]:
        """Go through all records; fill `channels` and yield messages of the named topics."""
        at = len(SIGNATURE)
        with open_regular(self.path) as file:
            while True:
                file.seek(at)
                head = file.read(_HEAD.size)
                if len(head) < _HEAD.size:
                    lost = len(head)
                    self.report.fault("truncated", at, "an MCAP file without an end", _SALVAGE, lost_bytes=lost)
                    return
                kind, length = _HEAD.unpack(head)
                if length > self._size - at - _HEAD.size:
                    found = f"a record of {length} bytes, {self._size - at - _HEAD.size} are left"
                    self.report.fault("truncated", at, found, _SALVAGE, lost_bytes=self._size - at)
                    return
                if kind == _DATA_END:
                    break
                if kind in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                    if length > MOST_CHUNK_BYTES:
                        found = f"a record of {length} bytes, at most {MOST_CHUNK_BYTES} are read"
                        raise unreadable(
                            self.path, at, found, "write it again with smaller chunks (mcap recover)"
                        )
                    content = memoryview(file.read(length))
                    yield from self._record(kind, content, at, channels, names)
                at += _HEAD.size + length
            self._check_end(file, at)

    def _record(
        self, kind: int, content: memoryview, at: int, channels: dict[int, Topic], names: frozenset[str]
    ) -> Iterator[Message]:
        try:
            if kind == _MESSAGE:
                message = _message(content, at, channels)
                if message.topic.name in names:
                    yield message
                return
            if kind != _CHUNK:
                return self._define(kind, content, channels)
            unpacked = self._unpack(content, at)
            for inner, record in _records(unpacked):
                if inner == _MESSAGE:
                    message = _message(record, at, channels)
                    if message.topic.name in names:
                        yield message
                else:
                    self._define(inner, record, channels)
        except ValueError as error:
            self.report.fault("left_over", at, str(error), _SALVAGE, lost_bytes=len(content))

    def _unpack(self, content: memoryview, at: int) -> memoryview:
        walk = Walk(content, 16)
        size, crc, method = walk.number(8), walk.number(4), walk.text()
        unpacked = memoryview(unpack(method, walk.take(walk.number(8)), size))
        if crc and zlib.crc32(unpacked) != crc:
            self.report.fault("checksum", at, "a chunk whose checksum is wrong", _SALVAGE)
            # Salvage: one wrong byte of a plain chunk costs one message. Unpacking spreads it over all of them,
            # and what comes out may look like messages.
            if method:
                raise ValueError(f"a chunk packed by {method} that unpacks to other bytes than were packed")
        return unpacked

    def _check_end(self, file: BinaryIO, at: int) -> None:
        file.seek(max(self._size - len(SIGNATURE), at))
        if file.read() != SIGNATURE:
            self.report.fault("truncated", at, "an MCAP file whose end is missing", _SALVAGE)


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of the records of a chunk."""
    at, size = 0, len(data)
    while at < size:
        if size - at < _HEAD.size:
            raise ValueError(f"{size - at} bytes behind the last record of a chunk")
        kind, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if length > size - at:
            raise ValueError(f"a record of {length} bytes in a chunk, {size - at} are left")
        yield kind, data[at : at + length]
        at += length


def _message(content: memoryview, at: int, channels: dict[int, Topic]) -> Message:
    if len(content) < _MESSAGE_HEAD:
        raise ValueError(f"a message of {len(content)} bytes")
    channel, _, received = struct.unpack_from("<HIQ", content)
    if channel not in channels:
        raise ValueError(f"a message of channel {channel}, which is not announced")
    return Message(channels[channel], at, received, content[_MESSAGE_HEAD:])
