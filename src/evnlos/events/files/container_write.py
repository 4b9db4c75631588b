"""Writing the containers of other tools piece by piece, all with checksums: HDF5 and MCAP.

- HDF5 with the columns of DSEC.
- MCAP with packets of event_camera_msgs (coded "mono") and images of them that Foxglove and rerun show: chunks,
  an index of them and a summary, so that viewers seek in it. Nothing is packed: every reader opens it.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.errors import DataError
from evnlos.events.files.columns import FileSink
from evnlos.events.files.mcap import RENDERED, SIGNATURE
from evnlos.machine import undisturbed
from evnlos.types import Events

_CHUNK = 65_536
_MAX_INDEX_MS = 1 << 24  # 4.7 hours; a longer index would be larger than the events of a sparse recording
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


class Storage:
    """The file beneath HDF5, for which every write succeeds.

    The library can't give up a file that it failed to write: it tries again at every close, at last when the
    process ends, and crashes there. So the first failure is kept for the sink to raise, and no more is written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb+", buffering=0)
        self.failure: OSError | None = None
        self.read, self.readinto = self._file.read, self._file.readinto
        self.seek, self.tell, self.flush = self._file.seek, self._file.tell, self._file.flush

    def write(self, content: memoryview) -> int:
        """Write all of it, or note why not."""
        left = memoryview(content).cast("B")
        try:
            while len(left) and self.failure is None:
                left = left[self._file.write(left) :]
        except OSError as error:
            self.failure = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the file's size, or note why not."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Hdf5Sink:
    """An HDF5 file that grows: columns events/{x, y, t, p}, `ms_to_idx` and `t_offset`."""

    def __init__(self, path: Path, first: Events) -> None:
        start = int(first.t_us[0]) if len(first) else 0
        self._wide = first.duration_us >= 2**32 or not -(2**62) < start < 2**62
        self._t_offset = 0 if self._wide else start
        self._events, self._last = 0, 0
        self._storage = Storage(path)
        with undisturbed():
            self._file = h5py.File(self._storage, "w", libver=("v110", "v110"))
            self._group = self._file.create_group("events")
            self._group.attrs["width"], self._group.attrs["height"] = first.width, first.height
        self._columns: dict[str, h5py.Dataset] = {}
        self._index: h5py.Dataset | None = None

    def append(self, events: Events) -> None:
        """Write a piece; the first decides how large a chunk is."""
        with self._told():
            self._append(events)

    def _append(self, events: Events) -> None:
        if len(events) and not self._wide and int(events.t_us[-1]) - self._t_offset >= 2**32:
            self._widen()
        # A difference of 64 bits: times that are far apart do not fit the narrow column, and are wide already.
        t_us = events.t_us if self._wide else (events.t_us - self._t_offset).astype(np.uint32)
        columns = {"x": events.x, "y": events.y, "t": t_us, "p": events.p.astype(np.uint8)}
        for name in ("adc", "polarity_known"):
            column = getattr(events, name)
            if column is not None:
                columns[name] = column.astype(np.uint8 if column.dtype == np.bool_ else column.dtype)
        for name, column in columns.items():
            if name not in self._columns:
                self._columns[name] = _create(self._group, name, column.dtype, len(column))
            _extend(self._columns[name], column)
        if len(events) and not self._wide:
            self._extend_index(t_us)
        self._events += len(events)

    def _extend_index(self, t_us: NDArray) -> None:
        """Note the index of the first event not earlier than each millisecond after `t_offset`."""
        known = 0 if self._index is None else len(self._index)
        self._last = int(t_us[-1]) // 1000
        if self._last >= _MAX_INDEX_MS:
            return
        starts = np.searchsorted(t_us, np.arange(known, self._last + 1, dtype=np.int64) * 1000)
        indices = starts.astype(np.uint64) + np.uint64(self._events)
        if self._index is None:
            self._index = _create(self._file, "ms_to_idx", indices.dtype, len(indices) + 1)
        _extend(self._index, indices)

    def _widen(self) -> None:
        """Put times of 64 bits in place of those of 32, which hold 71 minutes."""
        self._wide = True
        if "t" in self._columns:
            narrow = self._columns["t"]
            wide = _create(self._group, "t_wide", np.dtype(np.int64), _CHUNK)
            for start in range(0, len(narrow), _CHUNK):
                _extend(wide, narrow[start : start + _CHUNK].astype(np.int64) + self._t_offset)
            del self._group["t"]
            self._group.move("t_wide", "t")
            self._columns["t"] = wide
        if self._index is not None:
            del self._file["ms_to_idx"]
            self._index = None
        self._t_offset = 0

    def finish(self) -> None:
        """Complete the index and the offset."""
        with self._told():
            self._complete()
            self._file.close()  # here: what the library cannot write is an error before the file gets its name

    def _complete(self) -> None:
        if self._index is not None and self._last >= _MAX_INDEX_MS:
            del self._file["ms_to_idx"]
        elif not self._wide:
            if self._index is None:
                self._index = _create(self._file, "ms_to_idx", np.dtype(np.uint64), 2)
            missing = self._last + 2 - len(self._index)
            _extend(self._index, np.full(missing, self._events, np.uint64))
        _put_compact(self._file, "t_offset", self._t_offset)

    def close(self) -> None:
        """Close the file."""
        with undisturbed():
            self._file.close()
        self._storage.close()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Raise what the storage noted, also where the library stumbles over what was not written."""
        try:
            with undisturbed():
                yield
        finally:
            if self._storage.failure is not None:
                raise self._storage.failure


def _create(group: h5py.Group, name: str, dtype: np.dtype, expected: int) -> h5py.Dataset:
    chunk = (max(1, min(_CHUNK, expected)),)
    return group.create_dataset(name, (0,), dtype, chunks=chunk, maxshape=(None,), **_PACKED)


def _extend(dataset: h5py.Dataset, values: NDArray) -> None:
    count = len(dataset)
    dataset.resize(count + len(values), axis=0)
    dataset[count:] = values


def _put_compact(file: h5py.File, name: str, value: int) -> None:
    """Store one number inside the object header, which has a checksum; a plain scalar has none."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.COMPACT)
    layout.set_obj_track_times(False)  # the same events give the same bytes
    space = h5py.h5s.create(h5py.h5s.SCALAR)
    dataset = h5py.h5d.create(file.id, name.encode(), h5py.h5t.NATIVE_INT64, space, layout)
    dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, np.array(value, np.int64))


TOPIC, IMAGE_TOPIC = "/event_camera/events", "/event_camera/image"
_MOST_SIDES = 1 << 16, 1 << 15  # x has 16 bits, y has 15
_MOST_US = 2**31 * 10**6  # a ROS stamp has 31 bits of seconds
_PACKET = 1 << 14  # events
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
