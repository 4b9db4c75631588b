"""Decodes an AEDAT4 file in a process of its own: on damage the package may abort, hang or ask for all memory.

Run as a program: path, limit of memory in bytes, limit of processor time in seconds, "events" or "frame",
and the number of a stream where it is not the first of that kind.
Writes one line of JSON (width and height of the stream, or null), then for every packet of
events a 64-bit count and the columns t, x, y, on, for every frame its time, height, width and channels (64 bits
each) and its pixels; -1 ends a complete file.
"""

import json
import struct
import sys

from evnlos.untrusted import limit_this_process


def main(path: str, memory_bytes: int, seconds: int, kind: str, chosen: int | None = None) -> None:
    """Write one stream of a kind in `path` to the standard output."""
    limit_this_process(memory_bytes, seconds)
    import aedat

    decoder = aedat.Decoder(path)
    streams = [(number, stream) for number, stream in decoder.id_to_stream().items() if stream["type"] == kind]
    streams = [one for one in streams if chosen in (None, one[0])]
    out = sys.stdout.buffer
    if not streams:
        out.write(b"null\n")
        return
    number, stream = streams[0]
    out.write(json.dumps([stream["width"], stream["height"]]).encode() + b"\n")
    for packet in decoder:
        if packet["stream_id"] != number or kind not in packet:
            continue
        if kind == "frame":
            frame = packet["frame"]
            pixels = frame["pixels"]
            channels = pixels.shape[2] if pixels.ndim == 3 else 1
            out.write(struct.pack("<4q", frame["t"], *pixels.shape[:2], channels) + pixels.tobytes())
            continue
        events = packet["events"]
        columns = (
            events["t"].astype("<i8"),
            events["x"].astype("<u2"),
            events["y"].astype("<u2"),
            events["on"],
        )
        out.write(struct.pack("<q", len(events)) + b"".join(column.tobytes() for column in columns))
    out.write(struct.pack("<q", -1))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4], *map(int, sys.argv[5:6]))
