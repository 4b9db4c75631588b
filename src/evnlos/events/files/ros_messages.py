"""Messages of ROS recordings as columns: packets of events, arrays of events, images.

Read are `event_camera_msgs/EventPacket` (and its older name `event_array_msgs/EventArray`),
`dvs_msgs/EventArray`, `prophesee_event_msgs/EventArray`, `sensor_msgs/Image` and `CompressedImage`, as ROS 1
lays them out (packed) and as CDR does (each number at a multiple of its size, counted from after the first four
bytes).
"""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import Columns, allocate, cut
from evnlos.events.files.mcap import Message
from evnlos.untrusted import open_image

PACKETS = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray")
ARRAYS = ("dvs_msgs/EventArray", "prophesee_event_msgs/EventArray")
IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
ENCODINGS = ("evt3", "libcaer", "libcaer_cmp", "mono", "trigger")
ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_SIDE = 1 << 14
_IMAGE_BYTES = {
    "mono8": (1, 1), "8UC1": (1, 1), "mono16": (2, 1), "16UC1": (2, 1), "rgb8": (1, 3), "bgr8": (1, 3),
    "8UC3": (1, 3), "rgba8": (1, 4), "bgra8": (1, 4), "8UC4": (1, 4), "bayer_rggb8": (1, 1),
    "bayer_bggr8": (1, 1), "bayer_gbrg8": (1, 1), "bayer_grbg8": (1, 1),
}  # fmt: skip
"""Bytes of a sample and samples of a pixel; the mosaic of a colour sensor is taken as it is."""


class Fields:
    """The fields of one message, in their order; whatever leaves the message is a ValueError."""

    def __init__(self, data: bytes | memoryview, coding: str) -> None:
        self.data, self.at = memoryview(data), 0
        if self.data[:4] == ZSTD:
            raise ValueError(
                "a message that is packed by itself (compression_mode: message): ros2 bag convert it"
            )
        self._is_cdr = coding == "cdr"
        self.order = "<"
        if self._is_cdr:
            if len(self.data) < 4 or self.data[1] not in (0, 1):
                raise ValueError("a message that does not begin as CDR does")
            self.order = "<" if self.data[1] else ">"
            self.data = self.data[4:]
        elif coding != "ros1":
            raise ValueError(f"a message coded as {coding[:20]!r}; cdr and ros1 are read")

    def number(self, kind: str) -> int:
        """Return one number: B, I, i or Q, as `struct` calls them."""
        size = struct.calcsize("<" + kind)
        if self._is_cdr:
            self.at += -self.at % size
        value = struct.unpack(self.order + kind, self._take(size))[0]
        return int(value)

    def text(self) -> str:
        """Return a string."""
        data = bytes(self._take(self.number("I")))
        return (data[:-1] if self._is_cdr else data).decode("utf-8", "replace")

    def sequence(self) -> memoryview:
        """Return a sequence of bytes."""
        return self._take(self.number("I"))

    def rest(self) -> memoryview:
        """Return what follows."""
        return self.data[self.at :]

    def header(self) -> int:
        """Pass the header and return its stamp, nanoseconds."""
        if not self._is_cdr:
            self.number("I")  # counts messages
        second, nanosecond = self.number("i" if self._is_cdr else "I"), self.number("I")
        self.text()
        return second * 10**9 + nanosecond

    def _take(self, size: int) -> memoryview:
        if size > len(self.data) - self.at:
            raise ValueError(
                f"a message that ends {size - len(self.data) + self.at} bytes before its last field"
            )
        self.at += size
        return self.data[self.at - size : self.at]


class Packet:
    """An `EventPacket`: stamp [ns], height, width, seq, time_base [ns], encoding, events."""

    def __init__(self, message: Message) -> None:
        fields = Fields(message.data, message.topic.coding)
        self.stamp_ns = fields.header()
        self.height, self.width = fields.number("I"), fields.number("I")
        self.seq, self.time_base = fields.number("Q"), fields.number("Q")
        self.encoding = fields.text()
        if fields.number("B"):
            raise ValueError("a packet of big-endian events; little endian is read")
        self.events = fields.sequence()

    def columns(self) -> tuple[Columns, int]:
        """Return the events of a packet that needs no other (all but evt3), and how many words were unknown.

        Raises:
            ValueError: The encoding is not known, or the bytes do not fit it.
        """
        size = {"libcaer": 8, "libcaer_cmp": 2, "mono": 8}.get(self.encoding)
        if size is None:
            raise ValueError(f"events coded as {self.encoding[:20]!r}; {', '.join(ENCODINGS)} are read")
        if len(self.events) % size:
            raise ValueError(f"{len(self.events)} bytes of events that have {size} bytes each")
        if self.time_base >= 2**62:
            raise ValueError(f"a time of {self.time_base} ns, which no clock shows")
        words = np.frombuffer(self.events, f"<u{size}")
        unknown = 0
        room = int(_bound_compressed(words)) if size == 2 else len(words)
        out = allocate(room)
        columns = out["t_us"], out["x"], out["y"], out["p"]
        if self.encoding == "mono":
            count = _decode_mono(words, self.time_base, *columns)
        elif self.encoding == "libcaer":
            count = decode_libcaer(words, self.time_base, True, *columns)
        else:
            count, unknown = _decode_compressed(words, self.time_base, *columns)
        return cut(out, 0, count), int(unknown)


@njit(cache=True)
def _decode_mono(words, base_ns, t_us, x, y, p):
    for index in range(len(words)):
        word = words[index]
        t_us[index] = (base_ns + np.int64(word & np.uint64(0xFFFFFFFF))) // 1000
        x[index] = (word >> np.uint64(32)) & np.uint64(0xFFFF)
        y[index] = (word >> np.uint64(48)) & np.uint64(0x7FFF)
        p[index] = (word >> np.uint64(63)) != 0
    return len(words)


@njit(cache=True)
def decode_libcaer(words, base_ns, turns, t_us, x, y, p):
    """Decode iniVation's events of 8 bytes, without the invalid ones.

    Args:
        words: uint64 [N].
        base_ns: Added to all times, nanoseconds.
        turns: Whether the clock of 31 bits may turn over inside the packet.
        t_us: Takes the times, int64 [N], microseconds.
        x: Takes the columns, pixels.
        y: Takes the rows, pixels.
        p: Takes the polarities.

    Returns:
        The number of events.
    """
    count, turn, before = 0, np.int64(0), np.int64(0)
    for index in range(len(words)):
        word = np.int64(words[index])
        if word & 1:
            stamp = (word >> 32) & 0x7FFFFFFF
            if turns and before - stamp > 1 << 30:
                turn += 1 << 31
            before = stamp
            t_us[count] = (base_ns + 1000 * (stamp + turn)) // 1000
            x[count] = (word >> 17) & 0x7FFF
            y[count] = (word >> 2) & 0x7FFF
            p[count] = (word & 2) != 0
            count += 1
    return count


@njit(cache=True)
def _bound_compressed(words):
    count = 0
    for word in words:
        kind = word >> 12
        if kind == 3:
            count += 1
        elif kind == 5:
            count += 8
    return count


@njit(cache=True)
def _decode_compressed(words, base_ns, t_us, x, y, p):
    """Decode the words of libcaer_cmp; times and places begin anew in each packet."""
    count, unknown = 0, 0
    high, low, column, base, sign = np.int64(0), np.int64(0), np.int64(0), np.int64(0), False
    time = base_ns // 1000
    for index in range(len(words)):
        word = np.int64(words[index])
        kind, value = word >> 12, word & 0xFFF
        if kind == 0 or kind == 1:
            high, low = (value, low) if kind == 0 else (high, value)
            time = (base_ns + 1000 * ((high << 12) | low)) // 1000
        elif kind == 2:
            column = value & 0x7FF
        elif kind == 3:
            t_us[count], x[count], y[count], p[count] = time, column, value & 0x7FF, value > 0x7FF
            count += 1
        elif kind == 4:
            base, sign = value & 0x7FF, value > 0x7FF
        elif kind == 5:
            for bit in range(8):
                if value >> bit & 1:
                    t_us[count], x[count], y[count], p[count] = time, column, base + bit, sign
                    count += 1
            base += 8
        else:
            unknown += 1
    return count, unknown


class EventArray:
    """An `EventArray` of dvs_msgs or prophesee_event_msgs: height, width, events with a stamp each."""

    def __init__(self, message: Message) -> None:
        fields = Fields(message.data, message.topic.coding)
        fields.header()
        self.height, self.width = fields.number("I"), fields.number("I")
        self.count = fields.number("I")
        self._fields, self._is_cdr = fields, message.topic.coding == "cdr"

    def columns(self) -> Columns:
        """Return the events.

        Raises:
            ValueError: The message ends before its last event.
        """
        rest = np.frombuffer(self._fields.rest(), np.uint8)
        if self.count > (len(rest) + 3) // 13:
            raise ValueError(f"{self.count} events in {len(rest)} bytes")
        out = allocate(self.count)
        columns = out["t_us"], out["x"], out["y"], out["p"]
        is_big = self._fields.order == ">"
        if _decode_array(rest, self._fields.at, self._is_cdr, is_big, *columns) != self.count:
            raise ValueError(f"{self.count} events in {len(rest)} bytes")
        return out


@njit(cache=True)
def _number(data, at, size, is_big):
    value = np.int64(0)
    for place in range(size):
        shift = 8 * (size - 1 - place if is_big else place)
        value |= np.int64(data[at + place]) << shift
    return value


@njit(cache=True)
def _decode_array(data, start, is_cdr, is_big, t_us, x, y, p):
    """Decode events {u16 x, u16 y, u32 s, u32 ns, bool}; in CDR the seconds stand at a multiple of four."""
    at = 0
    for index in range(len(t_us)):
        if is_cdr:
            at += (start + at) & 1
        stamp = at + 4
        if is_cdr:
            stamp += -(start + stamp) & 3
        if stamp + 9 > len(data):
            return index
        x[index] = _number(data, at, 2, is_big)
        y[index] = _number(data, at + 2, 2, is_big)
        t_us[index] = _number(data, stamp, 4, is_big) * 1_000_000 + _number(data, stamp + 4, 4, is_big) // 1000
        p[index] = data[stamp + 8] != 0
        at = stamp + 9
    return len(t_us)


def image_of(message: Message) -> tuple[int, NDArray]:
    """Return the stamp of an image message, nanoseconds, and its image, uint8 or uint16 [H, W], grey.

    Raises:
        ValueError: The message is damaged, or of an encoding that is not read.
    """
    fields = Fields(message.data, message.topic.coding)
    stamp_ns = fields.header()
    if message.topic.type == IMAGES[1]:
        fields.text()
        return stamp_ns, _unpacked(bytes(fields.sequence()))
    height, width, encoding = fields.number("I"), fields.number("I"), fields.text()
    is_big, step, data = fields.number("B"), fields.number("I"), fields.sequence()
    if encoding not in _IMAGE_BYTES:
        raise ValueError(f"an image coded as {encoding[:20]!r}; {', '.join(_IMAGE_BYTES)} are read")
    size, samples = _IMAGE_BYTES[encoding]
    if not (0 < height <= _MOST_SIDE and 0 < width <= _MOST_SIDE and width * size * samples <= step):
        raise ValueError(f"an image of {width} x {height} pixels in rows of {step} bytes")
    if len(data) < step * height:
        raise ValueError(f"an image of {len(data)} bytes instead of {step * height}")
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, : width * size * samples]
    values: Any = np.ascontiguousarray(rows).view((">" if is_big else "<") + f"u{size}")
    values = values.astype(f"u{size}").reshape(height, width, samples)
    return stamp_ns, grey_of(values, encoding.startswith("b") and samples > 1)


def grey_of(values: NDArray, is_blue_first: bool = False) -> NDArray:
    """Return [H, W] of [H, W, samples]; colours by ITU-R BT.601, transparency left out."""
    if values.shape[2] == 1:
        return values[:, :, 0]
    weights = np.array([0.299, 0.587, 0.114])[:: -1 if is_blue_first else 1]
    return np.round(values[:, :, :3] @ weights).astype(values.dtype)


def _unpacked(data: bytes) -> NDArray:
    try:
        with open_image(io.BytesIO(data)) as image:
            return np.asarray(image if image.mode.startswith("I;16") else image.convert("L"))
    except OSError as error:
        raise ValueError(
            f"a compressed image that cannot be read ({' '.join(str(error).split())[:80]})"
        ) from None
