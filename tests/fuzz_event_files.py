"""Coverage-guided fuzzing of the event file readers: inputs that reach new lines or new outcomes are kept and
mutated.

    python tests/fuzz_event_files.py --seconds 300 --seed 1

Lines of the readers are traced; what happens inside compiled kernels, which no tracer sees, counts through its
outcome (kinds of faults, magnitudes of counts, the text of an error without its numbers). Kernels are compiled
with checks of every index. An input fails when anything but `EventFileError` in one line comes out, when whole
and streamed reading disagree, when checked construction refuses the events, or when it takes longer than ten
seconds; it is kept in the folder of failures, and the exit code is 1. AEDAT4 is decoded in a process of its own
and is too slow for this loop; its hand-written part, the walk over the packets, is in.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ["NUMBA_BOUNDSCHECK"] = "1"
os.environ["NUMBA_CACHE_DIR"] = str(
    Path(tempfile.gettempdir()) / "evnlos_fuzz_numba"
)  # never mixed with the fast ones
os.environ.setdefault("OMP_NUM_THREADS", "1")

import h5py
import numpy as np

from ecf_files import write_ecf
from evnlos.errors import EventFileError
from evnlos.events import (
    CelexOptions,
    ReadReport,
    iter_events,
    read_events,
    read_events_report,
    read_frames,
    read_triggers,
    write_aedat4,
    write_events,
)
from evnlos.events.files import aedat4
from evnlos.types import Events
from ros_files import (
    IMAGE,
    PACKET,
    Cdr,
    Recording,
    Ros1,
    bag_bytes,
    event_array,
    image,
    mcap_bytes,
    mono,
    packet,
    write_db3,
)

_SLOW_S = 10.0
_MOST_BYTES = 20_000
_INTERESTING = (0, 1, 2, 3, 0x0F, 0x10, 0x7F, 0x80, 0x8F, 0xA0, 0xFE, 0xFF)
_READERS = str(Path(aedat4.__file__).parent)


def seeds(folder: Path) -> Iterator[bytes]:
    """Yield small good files of every format that is read in this process."""
    draw = np.random.default_rng(0)
    count = 60
    t = np.sort(draw.integers(0, 300_000, count))
    x, y, p = draw.integers(0, 1280, count), draw.integers(0, 720, count), draw.integers(0, 2, count)
    small = Events(t, x, y, p, 1280, 720)
    celex = Events(t, x, y, p, 1280, 800, adc=draw.integers(0, 256, count))
    for name, events, format in (
        ("a.raw", small, "EVT2"), ("a.raw", small, "EVT21"), ("a.raw", small, "EVT3"), ("a.csv", small, None),
        ("a.npz", small, None), ("a.h5", small, None),
    ):  # fmt: skip
        write_events(folder / name, events, format=format)
        yield (folder / name).read_bytes()
    for format in ("CELEX", "CELEX0"):
        write_events(folder / "a_100M.bin", celex, format=format)
        data = (folder / "a_100M.bin").read_bytes()
        used = 3 * 200 if format == "CELEX0" else 7 * 120  # a short package in place of a full one
        yield (
            data[:8]
            + (1).to_bytes(4, "little")
            + (used + 1).to_bytes(4, "little")
            + data[16 : 16 + used]
            + b"\1"
        )
    write_aedat4(folder / "a.aedat4", small, np.zeros((1, 4, 4), np.uint8), np.array([5]))
    yield (folder / "a.aedat4").read_bytes()
    words = np.array([t, x | y << 14 | p << 28]).T.astype("<u4")
    yield b"% Version 2\n% Width 1280\n% Height 720\n\x0c\x08" + words.tobytes()
    yield b"Event Stream\2\0\0\1" + bytes([64, 1, 240, 0]) + b"".join(
        bytes([3, k, 0, k, 0]) + b"\xff" * (k % 3) for k in range(60)
    )  # fmt: skip
    yield from ros_seeds(folder, small)
    yield from aedat_seeds()
    for form in ("packed", "pairs", "masks"):
        yield write_ecf(folder / "ecf.h5", small, form).read_bytes()
    with h5py.File(folder / "m3ed.h5", "w", libver="latest") as file:
        for side in ("left", "right"):
            for name, column in (("x", x), ("y", y), ("t", t / 1e6), ("p", p)):
                file[f"prophesee/{side}/{name}"] = column
    yield (folder / "m3ed.h5").read_bytes()
    yield "\n".join(
        f"{b},{a},{200 + k},{k % 2},{k * 9}" for k, (a, b) in enumerate(zip(x, y, strict=True))
    ).encode()


def ros_seeds(folder: Path, events: Events) -> Iterator[bytes]:
    """Yield ROS recordings of every container, encoding and message."""
    write_events(folder / "words.raw", events, format="EVT3")
    data = (folder / "words.raw").read_bytes()
    words = data[data.index(b"% end\n") + 6 :]
    picture = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for make in (Cdr, Ros1):
        packed = mono(events.t_us * 1000, events.x, events.y, events.p)
        libcaer = struct.pack("<IiIi", 3 << 17 | 2 << 2 | 3, 5, 1, 7)
        compressed = struct.pack("<6H", 0x1005, 0x2003, 0x3802, 0x1007, 0x4000 | 40, 0x5081)
        columns = ([k * 1000 for k in range(4)], [1, 2, 3, 4], [4, 3, 2, 1], [1, 0, 1, 0])
        messages: Recording = []
        for k, (encoding, payload) in enumerate(
            (
                ("mono", packed),
                ("libcaer", libcaer),
                ("libcaer_cmp", compressed),
                ("evt3", words),
                ("evt3", words),
            )
        ):
            data = packet(payload, encoding, k, k * 10**9, (1280, 720), make)
            messages.append((f"/{encoding}", PACKET, k, data))
        messages.append(("/dvs", "dvs_msgs/msg/EventArray", 9, event_array(*columns, make=make)))
        messages.append(("/image", IMAGE, 10, image(7, picture, make=make)))
        for chosen in (messages, messages[:1], messages[3:5], messages[-2:], messages[-1:]):
            if make is Ros1:
                yield from (bag_bytes(chosen), bag_bytes(chosen, "bz2"), bag_bytes(chosen, index=False))
                continue
            yield from (mcap_bytes(chosen), mcap_bytes(chosen, crc=False))
            (folder / "a.db3").unlink(missing_ok=True)
            yield write_db3(folder / "a.db3", chosen, page=512).read_bytes()
    write_events(folder / "a.mcap", events)
    yield (folder / "a.mcap").read_bytes()


def aedat_seeds() -> Iterator[bytes]:
    """Yield AEDAT 2.0 and 3.1 with events, frames and inputs."""
    for chip in ("DAVIS240C", "DVS128"):
        words = [(k << 22 | k << 12 | 1 << 11, k) for k in range(40)] + [(1 << 31 | 1, 50), (1 << 10, 60)]
        head = f"#!AER-DAT2.0\r\n# AEChip: {chip}\r\n".encode()
        yield head + b"".join(struct.pack(">II", *pair) for pair in words)
    head = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 0: DAVIS240C\r\n#Source 1: DVS128\r\n#!END-HEADER\r\n"
    events = b"".join(struct.pack("<Ii", k << 17 | k << 2 | 1, k) for k in range(20))
    frame = struct.pack("<Iiiiiiiii", 3, 1, 2, 3, 4, 4, 3, 0, 0) + bytes(24)
    special = struct.pack("<Ii", 5, 9)
    for sources in (head, head.replace(b"#Source 1: DVS128\r\n", b"")):
        yield sources + b"".join(
            struct.pack("<hhiiiiii", kind, 0, size, 4, 1, len(data) // size, len(data) // size, 1) + data
            for kind, size, data in ((1, 8, events), (2, 60, frame), (0, 8, special))
        )


def mutate(draw: np.random.Generator, corpus: list[bytes]) -> bytes:
    """Return one input of the corpus with one to eight changes."""
    out = bytearray(corpus[int(draw.integers(len(corpus)))])
    for _ in range(int(draw.integers(1, 9))):
        size = len(out)
        top = size if draw.random() < 0.6 else min(size, 200)  # headers are worth more
        at = int(draw.integers(0, top + 1)) if top else 0
        span = int(2 ** draw.integers(0, 8))
        kind = int(draw.integers(9))
        if kind == 0 and at < size:
            out[at] ^= 1 << int(draw.integers(8))
        elif kind == 1 and at < size:
            out[at] = _INTERESTING[int(draw.integers(len(_INTERESTING)))]
        elif kind == 2:
            out[at : at + span] = draw.bytes(span)
        elif kind == 3:
            del out[at : at + span]
        elif kind == 4:
            out[at:at] = out[at : at + span]
        elif kind == 5:
            del out[at:]
        elif kind == 6:
            other = corpus[int(draw.integers(len(corpus)))]
            start = int(draw.integers(0, len(other) + 1))
            out[at : at + span] = other[start : start + span]
        elif kind == 7:
            number = int(draw.choice([0, 1, -1, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63]))
            width = int(draw.choice([2, 4, 8]))
            out[at : at + width] = (number % 2 ** (8 * width)).to_bytes(width, "little")
        else:
            digits = [place for place, byte in enumerate(out[:400]) if 48 <= byte <= 57]
            if digits:
                place = digits[int(draw.integers(len(digits)))]
                out[place : place + 1] = str(int(draw.choice([0, 9, 10, 65_536, 10**18, 10**19]))).encode()
    return bytes(out[:_MOST_BYTES])


class Tracer:
    """Notes which lines of the readers run."""

    def __init__(self) -> None:
        self.lines: set[tuple[str, int]] = set()

    def __call__(self, frame, event, argument):
        name = frame.f_code.co_filename
        if not name.startswith(_READERS):
            return None
        if event == "line":
            self.lines.add((name, frame.f_lineno))
        return self


def outcome(read: Callable[[], object]) -> str:
    """Return what reading gave, without its numbers."""
    try:
        found = read()
    except EventFileError as error:
        text = str(error)
        assert "\n" not in text, f"an error of several lines: {text!r}"
        return re.sub(r"[0-9a-f]*\d[0-9a-f]*", "0", text.split(": ", 2)[-1])[:80]
    if isinstance(found, tuple):
        events, report = found
        faults = {kind: count.bit_length() for kind, count in sorted(report.faults.items())}
        return f"{report.format} {len(events).bit_length()} {faults} {report.truncated} {report.triggers > 0}"
    return f"{type(found).__name__} {len(found).bit_length()}"  # type: ignore[arg-type]


def examine(path: Path) -> tuple[str, ...]:
    """Read a file in every way; raise `AssertionError` where the ways disagree."""
    if path.suffix == ".aedat4":
        return (outcome(lambda: aedat4.check_packets(path, ReadReport(path)) or []),)
    celex = CelexOptions(clock_mhz=100)
    found = [outcome(lambda: read_events_report(path, "strict", celex=celex))]
    found.append(outcome(lambda: read_events_report(path, "salvage", celex=celex)))
    found.append(outcome(lambda: list(iter_events(path, window_us=1_000, on_error="salvage", celex=celex))))
    found.append(outcome(lambda: read_triggers(path, "salvage")))
    found.append(outcome(lambda: read_frames(path, on_error="salvage", celex=celex)))
    try:
        whole = read_events(path, celex=celex)
    except EventFileError:
        return tuple(found)
    Events(**whole.columns(), width=whole.width, height=whole.height)
    pieces = list(iter_events(path, n_events=7, celex=celex))
    for name, column in whole.columns().items():
        joined = np.concatenate([piece.columns()[name] for piece in pieces]) if pieces else column[:0]
        assert np.array_equal(joined, column), f"column {name} differs between whole and streamed reading"
    return tuple(found)


def main() -> None:
    """Fuzz until the time is over."""
    logging.disable()  # a guessed sensor size is worth a word to a user, not here
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--failures", type=Path, default=Path("fuzz_failures"))
    arguments = parser.parse_args()
    draw, tracer = np.random.default_rng(arguments.seed), Tracer()
    seen: set[tuple[int, str]] = set()
    corpus: list[bytes] = []
    runs = failures = 0
    with tempfile.TemporaryDirectory() as folder:
        waiting = list(seeds(Path(folder)))
        for data in waiting:  # compile before the clock starts
            _place(Path(folder), data)
            examine(_place(Path(folder), data))
        end = time.monotonic() + arguments.seconds
        while time.monotonic() < end:
            data = waiting.pop() if waiting else mutate(draw, corpus)
            path = _place(Path(folder), data)
            before, start = len(tracer.lines), time.process_time()  # the machine may be busy elsewhere
            sys.settrace(tracer)
            try:
                signature = examine(path)
                assert time.process_time() - start < _SLOW_S, f"took {time.process_time() - start:.0f} s"
            except Exception as error:
                sys.settrace(None)
                failures += 1
                arguments.failures.mkdir(exist_ok=True)
                kept = arguments.failures / f"seed{arguments.seed}_{failures:03d}{path.suffix}"
                kept.write_bytes(data)
                print(f"{kept}: {type(error).__name__}: {error}", flush=True)
                continue
            finally:
                sys.settrace(None)
            runs += 1
            new = set(enumerate(signature)) - seen
            if len(tracer.lines) > before or new:
                seen |= new
                corpus.append(data)
    print(f"{runs} inputs, {len(corpus)} kept, {len(tracer.lines)} lines reached, {failures} failures")
    if not tracer.lines:
        print("no line of the readers was seen: the loop was not guided")
    sys.exit(failures > 0 or not tracer.lines)


def _place(folder: Path, data: bytes) -> Path:
    path = folder / ("fuzzed.aedat4" if data.startswith(aedat4.SIGNATURE) else "fuzzed_EI_100M.bin")
    path.write_bytes(data)
    return path


if __name__ == "__main__":
    main()
