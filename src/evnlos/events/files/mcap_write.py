"""Writing MCAP: packets of event_camera_msgs (coded "mono"), and images of them that Foxglove and rerun show.

The file has chunks with checksums, an index of them, and a summary, so that viewers seek in it. Nothing is
packed: every reader opens it.
"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.errors import DataError
from evnlos.events.files.columns import FileSink
from evnlos.events.files.mcap import RENDERED, SIGNATURE
from evnlos.types import Events

TOPIC, IMAGE_TOPIC = "/event_camera/events", "/event_camera/image"
_MOST_SIDES = 1 << 16, 1 << 15  # x has 16 bits, y has 15
_MOST_US = 2**31 * 10**6  # a ROS stamp has 31 bits of seconds
_PACKET = 1 << 14  # events
_PACKET_US = 4_000_000  # 32 bits of nanoseconds hold 4.29 s
_IMAGE_US = 40_000
_CHUNK_BYTES = 1 << 20
_DARK, _ON, _OFF = (24, 24, 28), (255, 150, 40), (70, 140, 255)
_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_SCHEMAS = (
    (
        "event_camera_msgs/msg/EventPacket",
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        f"bool is_bigendian\nuint8[] events\n{_HEADER}",
    ),
    ("sensor_msgs/msg/CompressedImage", f"std_msgs/Header header\nstring format\nuint8[] data\n{_HEADER}"),
)
_EVENTS, _IMAGES = 1, 2  # numbers of schemas and channels


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


class _Cdr:
    """A message as little-endian CDR."""

    def __init__(self, stamp_ns: int) -> None:
        self._parts = bytearray()
        self.put("i", stamp_ns // 10**9).put("I", stamp_ns % 10**9).text("event_camera")

    def put(self, kind: str, value: int) -> _Cdr:
        """Add a number."""
        size = struct.calcsize("<" + kind)
        self._parts += bytes(-len(self._parts) % size) + struct.pack("<" + kind, value)
        return self

    def text(self, text: str) -> _Cdr:
        """Add a string."""
        return self.sequence(text.encode() + b"\0")

    def sequence(self, data: bytes) -> _Cdr:
        """Add a sequence of bytes."""
        self.put("I", len(data))._parts += data
        return self

    def message(self) -> bytes:
        """Return it with the four bytes that tell the order of bytes."""
        return b"\0\1\0\0" + bytes(self._parts)


class McapSink(FileSink):
    """An MCAP file that grows; intensities are left out."""

    def __init__(self, path: Path, first: Events) -> None:
        if first.width > _MOST_SIDES[0] or first.height > _MOST_SIDES[1]:
            raise DataError(
                f"MCAP packets hold sensors up to {_MOST_SIDES[0]} x {_MOST_SIDES[1]}, "
                f"not {first.width} x {first.height}; write .h5 or .npz"
            )
        super().__init__(path)
        self._size = first.width, first.height
        self._chunk = bytearray()
        self._places: dict[int, list[tuple[int, int]]] = {_EVENTS: [], _IMAGES: []}  # (time, place in chunk)
        self._index: list[bytes] = []
        self._counts = {_EVENTS: 0, _IMAGES: 0}
        self._span: list[int] = []
        self._shown = np.zeros((first.height, first.width), np.int8)  # of the image that is being made
        self._window: int | None = None
        self._definitions = b"".join(
            _record(3, struct.pack("<H", number) + _text(name) + _text("ros2msg") + _text(definition))
            for number, (name, definition) in enumerate(_SCHEMAS, start=1)
        )
        rendered = _text(RENDERED) + _text(TOPIC)
        for number, topic, metadata in ((_EVENTS, TOPIC, b""), (_IMAGES, IMAGE_TOPIC, rendered)):
            content = struct.pack("<HH", number, number) + _text(topic) + _text("cdr")
            self._definitions += _record(4, content + struct.pack("<I", len(metadata)) + metadata)
        self.file.write(SIGNATURE + _record(1, _text("ros2") + _text("evnlos")) + self._definitions)

    def append(self, events: Events) -> None:
        """Write the packets of a piece, and the images that it completes."""
        if events.polarity_known is not None and not events.polarity_known.all():
            raise DataError(
                "MCAP packets have no mark for an unknown polarity; use keep_known_polarity(events) first, "
                "or write .h5"
            )
        if len(events) and not (int(events.t_us[0]) >= 0 and int(events.t_us[-1]) < _MOST_US):
            raise DataError(
                f"MCAP packets hold times of 0 to {_MOST_US} us, not {int(events.t_us[0])} to "
                f"{int(events.t_us[-1])}; write .h5 or .npz"
            )
        windows = events.t_us // _IMAGE_US
        start = 0
        while start < len(events):
            stop = int(np.searchsorted(windows, windows[start], "right"))
            if self._window is not None and windows[start] != self._window:
                self._finish_image()
            self._window = int(windows[start])
            for first in range(start, stop, _PACKET):
                self._packet(events[first : min(first + _PACKET, stop)])
            part = events[start:stop]
            self._shown[part.y, part.x] = np.where(part.p, 1, -1)
            start = stop

    def _packet(self, events: Events) -> None:
        base_us = int(events.t_us[0]) if len(events) else 0
        words = ((events.t_us - base_us) * 1000).astype(np.uint64)
        for column, place in ((events.x, 32), (events.y, 48), (events.p, 63)):
            words |= column.astype(np.uint64) << np.uint64(place)
        message = _Cdr(base_us * 1000).put("I", self._size[1]).put("I", self._size[0])
        message.put("Q", self._counts[_EVENTS]).put("Q", base_us * 1000).text("mono").put("B", 0)
        self._message(_EVENTS, base_us * 1000, message.sequence(words.astype("<u8").tobytes()).message())

    def _finish_image(self) -> None:
        """Write the image of the window that is over: the sign of each pixel's last event."""
        assert self._window is not None
        palette = np.array([_OFF, _DARK, _ON], np.uint8)
        pixels: NDArray[np.uint8] = palette[self._shown + 1]  # [H, W, 3]
        packed = io.BytesIO()
        Image.fromarray(pixels).save(packed, "png", compress_level=1)
        stamp_ns = (self._window + 1) * _IMAGE_US * 1000
        self._message(_IMAGES, stamp_ns, _Cdr(stamp_ns).text("png").sequence(packed.getvalue()).message())
        self._shown[:] = 0

    def _message(self, channel: int, time_ns: int, data: bytes) -> None:
        self._places[channel].append((time_ns, len(self._chunk)))
        head = struct.pack("<HIQQ", channel, self._counts[channel] & 0xFFFFFFFF, time_ns, time_ns)
        self._chunk += _record(5, head + data)
        self._counts[channel] += 1
        if len(self._chunk) >= _CHUNK_BYTES:
            self._finish_chunk()

    def _finish_chunk(self) -> None:
        """Write the chunk, where its messages stand, and note where it stands itself."""
        if not self._chunk:
            return
        times = [time for places in self._places.values() for time, _ in places]
        span = min(times), max(times)
        self._span = [min([span[0], *self._span[:1]]), max([span[1], *self._span[1:]])]
        start, size = self.file.tell(), len(self._chunk)
        head = struct.pack("<QQQI", *span, size, zlib.crc32(self._chunk)) + _text("") + struct.pack("<Q", size)
        self.file.write(_record(6, head + bytes(self._chunk)))
        end = self.file.tell()
        offsets = b""
        for channel, places in self._places.items():
            if places:
                offsets += struct.pack("<HQ", channel, self.file.tell())
                content = b"".join(struct.pack("<QQ", *place) for place in places)
                self.file.write(_record(7, struct.pack("<HI", channel, len(content)) + content))
        index = struct.pack("<QQQQI", *span, start, end - start, len(offsets)) + offsets
        index += struct.pack("<Q", self.file.tell() - end) + _text("") + struct.pack("<QQ", size, size)
        self._index.append(_record(8, index))
        self._chunk = bytearray()
        self._places = {_EVENTS: [], _IMAGES: []}

    def finish(self) -> None:
        """Write the last chunk, the summary and the end."""
        if not self._counts[_EVENTS]:
            self._packet(Events.empty(*self._size))  # states the sensor
        if self._window is not None:
            self._finish_image()
        self._finish_chunk()
        self.file.write(_record(15, bytes(4)))
        start = self.file.tell()
        counts = b"".join(struct.pack("<HQ", *item) for item in self._counts.items())
        numbers = (sum(self._counts.values()), 2, 2, 0, 0, len(self._index), *self._span, len(counts))
        groups = ((3, self._definitions), (11, _record(11, struct.pack("<QHIIIIQQI", *numbers) + counts)))
        offsets = b""
        for kind, content in (*groups, (8, b"".join(self._index))):
            if kind != 3:  # schemas and channels stand one behind the other: viewers read them as they come
                offsets += _record(14, struct.pack("<BQQ", kind, self.file.tell(), len(content)))
            self.file.write(content)
        where = self.file.tell()
        self.file.write(offsets + _record(2, struct.pack("<QQI", start, where, 0)) + SIGNATURE)
