"""Writing AEDAT4: an XML description, then packets of events or frames as flat buffers, not compressed.

Flat buffers are laid out by hand: each packet is one table whose places are known beforehand. Numbers of bytes
in the comments count from the start of the packet's size.
"""

from __future__ import annotations

import struct
from contextlib import closing
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.events.io.sink import FileSink
from evnlos.files import new_file
from evnlos.types import Events

_SIGNATURE = b"#!AER-DAT4.0\r\n"
_MAX_SIDE = 1 << 15
_PACKET = 1 << 14  # events
_EVENT = np.dtype(
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
    rows = np.zeros(len(events), _EVENT)
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
        self.file.write(_SIGNATURE + _header(_description(first.width, first.height, has_frames)))

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
        """Write one grey picture [H, W] of 8 bits."""
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
        frames: Grey pictures, uint8 [T, H, W].
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
