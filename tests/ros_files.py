"""ROS recordings by hand: messages as ROS 1 and as CDR, and the three containers."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from pathlib import Path

import numpy as np

PACKET = "event_camera_msgs/msg/EventPacket"
IMAGE = "sensor_msgs/msg/Image"


class Cdr:
    """Little-endian CDR: each number at a multiple of its size."""

    def __init__(self) -> None:
        self.body = b""

    def put(self, kind: str, value: int) -> Cdr:
        self.body += bytes(-len(self.body) % struct.calcsize("<" + kind)) + struct.pack("<" + kind, value)
        return self

    def text(self, text: str) -> Cdr:
        self.put("I", len(text) + 1).body += text.encode() + b"\0"
        return self

    def data(self, data: bytes) -> Cdr:
        self.put("I", len(data)).body += data
        return self

    def header(self, stamp_ns: int, frame_id: str) -> Cdr:
        return self.put("i", stamp_ns // 10**9).put("I", stamp_ns % 10**9).text(frame_id)

    def message(self) -> bytes:
        return b"\0\1\0\0" + self.body


class Ros1(Cdr):
    """ROS 1: packed, strings without a zero, a counter before the stamp."""

    def put(self, kind: str, value: int) -> Cdr:
        self.body += struct.pack("<" + kind.upper(), value)
        return self

    def text(self, text: str) -> Cdr:
        self.put("I", len(text)).body += text.encode()
        return self

    def header(self, stamp_ns: int, frame_id: str) -> Cdr:
        return self.put("I", 7).put("I", stamp_ns // 10**9).put("I", stamp_ns % 10**9).text(frame_id)

    def message(self) -> bytes:
        return self.body


def packet(
    events: bytes,
    encoding: str = "mono",
    seq: int = 0,
    base_ns: int = 0,
    size=(64, 48),
    make=Cdr,
    frame_id="cam",
) -> bytes:
    message = make().header(5 * 10**9 + 12_345, frame_id).put("I", size[1]).put("I", size[0])
    return message.put("Q", seq).put("Q", base_ns).text(encoding).put("B", 0).data(events).message()


def mono(t_ns, x, y, p) -> bytes:
    """Return the words of the encoding mono."""
    t, x, y, p = (np.asarray(column, np.uint64) for column in (t_ns, x, y, p))
    return (t | x << np.uint64(32) | y << np.uint64(48) | p << np.uint64(63)).astype("<u8").tobytes()


def event_array(times_ns, x, y, p, size=(64, 48), make=Ros1) -> bytes:
    """Return a dvs_msgs/EventArray."""
    message = make().header(10**9, "dvs").put("I", size[1]).put("I", size[0]).put("I", len(x))
    for t, column, row, sign in zip(times_ns, x, y, p, strict=True):
        message.put("H", column).put("H", row).put("I", t // 10**9).put("I", t % 10**9).put("B", sign)
    return message.message()


def image(stamp_ns: int, pixels: np.ndarray, encoding: str = "mono8", make=Cdr) -> bytes:
    """Return a sensor_msgs/Image; [H, W] or [H, W, samples]."""
    step = pixels[0].nbytes
    message = make().header(stamp_ns, "cam").put("I", pixels.shape[0]).put("I", pixels.shape[1]).text(encoding)
    return message.put("B", 0).put("I", step).data(pixels.tobytes()).message()


Recording = list[tuple[str, str, int, bytes]]
"""Topic, type, time of receipt [ns], message."""


def write_db3(path: Path, messages: Recording, page: int = 4096) -> Path:
    base = sqlite3.connect(path)
    base.execute(f"PRAGMA page_size = {page}")
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,"
        "serialization_format TEXT NOT NULL,offered_qos_profiles TEXT NOT NULL)"
    )
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,"
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    base.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    numbers: dict[str, int] = {}
    for topic, kind, t_ns, data in messages:
        if topic not in numbers:
            numbers[topic] = len(numbers) + 1
            base.execute("INSERT INTO topics VALUES (?,?,?,'cdr','')", (numbers[topic], topic, kind))
        base.execute(
            "INSERT INTO messages(topic_id,timestamp,data) VALUES (?,?,?)", (numbers[topic], t_ns, data)
        )
    base.commit()
    base.close()
    return path


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def mcap_bytes(messages: Recording, compression: str = "", crc: bool = True, per_chunk: int = 2) -> bytes:
    """Return an MCAP file without a summary."""
    numbers: dict[str, int] = {}
    out = b"\x89MCAP0\r\n" + _record(1, _text("ros2") + _text("by hand"))
    for start in range(0, len(messages), per_chunk):
        body = b""
        for topic, kind, t_ns, data in messages[start : start + per_chunk]:
            if topic not in numbers:
                number = numbers[topic] = len(numbers) + 1
                body += _record(3, struct.pack("<H", number) + _text(kind) + _text("ros2msg") + _text(""))
                body += _record(4, struct.pack("<HH", number, number) + _text(topic) + _text("cdr") + _text(""))
            body += _record(5, struct.pack("<HIQQ", numbers[topic], 0, t_ns, t_ns) + data)
        head = struct.pack("<QQQI", 0, 0, len(body), zlib.crc32(body) if crc else 0) + _text(compression)
        packed = packed_by(compression, body)
        out += _record(6, head + struct.pack("<Q", len(packed)) + packed)
    return out + _record(15, bytes(4)) + _record(2, bytes(20)) + b"\x89MCAP0\r\n"


def packed_by(method: str, body: bytes) -> bytes:
    if method == "lz4":
        import lz4.frame

        return lz4.frame.compress(body)
    if method == "zstd":
        import zstandard

        return zstandard.ZstdCompressor().compress(body)
    return bz2.compress(body) if method == "bz2" else body


def _fields(**fields: bytes) -> bytes:
    body = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value
        for name, value in fields.items()
    )
    return struct.pack("<I", len(body)) + body


def bag_bytes(messages: Recording, compression: str = "none", per_chunk: int = 2, index: bool = True) -> bytes:
    """Return a ROS 1 bag; without its index as a recorder leaves it that was killed."""
    numbers: dict[str, int] = {}
    chunks, connections, places = b"", b"", []
    count = 0
    for start in range(0, len(messages), per_chunk):
        body = b""
        entries: dict[int, bytes] = {}
        for topic, kind, t_ns, data in messages[start : start + per_chunk]:
            if topic not in numbers:
                numbers[topic] = len(numbers)
                about = _fields(type=kind.replace("/msg/", "/").encode(), md5sum=b"*", message_definition=b"")
                connection = (
                    _fields(op=b"\7", conn=struct.pack("<I", numbers[topic]), topic=topic.encode()) + about
                )
                body += connection
                connections += connection
            stamp = struct.pack("<II", t_ns // 10**9, t_ns % 10**9)
            entries[numbers[topic]] = entries.get(numbers[topic], b"") + stamp + struct.pack("<I", len(body))
            body += _fields(op=b"\2", conn=struct.pack("<I", numbers[topic]), time=stamp)
            body += struct.pack("<I", len(data)) + data
        packed = packed_by(compression, body)
        held = [numbers[topic] for topic, *_ in messages[start : start + per_chunk]]
        places.append((len(chunks), {number: held.count(number) for number in held}))
        chunks += _fields(op=b"\5", compression=compression.encode(), size=struct.pack("<I", len(body)))
        chunks += struct.pack("<I", len(packed)) + packed
        for number, data in entries.items():
            many = struct.pack("<I", len(data) // 12)
            about = {"ver": b"\1\0\0\0", "conn": struct.pack("<I", number), "count": many}
            chunks += _fields(op=b"\4", **about) + struct.pack("<I", len(data)) + data
        count += 1
    first = b"#ROSBAG V2.0\n"

    def head(position: int) -> bytes:
        named = _fields(
            op=b"\3", index_pos=struct.pack("<Q", position), conn_count=struct.pack("<I", len(numbers)),
            chunk_count=struct.pack("<I", count),
        )  # fmt: skip
        return first + named + struct.pack("<I", 64) + b" " * 64

    if not index:
        return head(0) + chunks
    size = len(head(0))
    for place, counts in places:
        stamps = {"start_time": bytes(8), "end_time": bytes(8), "count": struct.pack("<I", len(counts))}
        connections += _fields(op=b"\6", ver=b"\1\0\0\0", chunk_pos=struct.pack("<Q", size + place), **stamps)
        connections += struct.pack("<I", 8 * len(counts))
        connections += b"".join(struct.pack("<II", number, many) for number, many in counts.items())
    return head(size + len(chunks)) + chunks + connections


def write_bag(path: Path, messages: Recording, **options) -> Path:
    path.write_bytes(bag_bytes(messages, **options))
    return path


def write_mcap(path: Path, messages: Recording, **options) -> Path:
    path.write_bytes(mcap_bytes(messages, **options))
    return path
