"""Live cameras without one: words on a pipe, streams of other programs, a pretended device, captures of all."""

import contextlib
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from evnlos.cli import main
from evnlos.data import read_capture
from evnlos.data.capture_info import read_capture_info
from evnlos.errors import ConfigError, DataError, EventFileError, EvnlosError
from evnlos.events import read_events, write_events
from evnlos.live import (
    DEVICES,
    AestreamSource,
    CameraFacts,
    CameraLostError,
    CameraPacket,
    DeviceSource,
    DvSource,
    NeuromorphicDriver,
    RecordingCheck,
    WordInput,
    check_line,
    record_capture,
)
from evnlos.live.packet import Chunk, SystemClock
from evnlos.live.sources import SourceOptions, open_live
from evnlos.types import Events

NEVER = lambda: False  # noqa: E731


def stream(count: int, seed: int = 0, span_us: int = 100_000, width: int = 30, height: int = 20) -> Events:
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, span_us, count))
    x, y = draw.integers(0, width, count), draw.integers(0, height, count)
    return Events(t_us, x.astype(np.uint16), y.astype(np.uint16), draw.random(count) < 0.5, width, height)


def joined(parts: list[Events]) -> Events:
    columns = (np.concatenate([part.columns()[name] for part in parts]) for name in ("t_us", "x", "y", "p"))
    return Events(*columns, parts[0].width, parts[0].height)


def raw(events: Events, kind: str, folder: Path) -> tuple[bytes, bytes]:
    """Return the header and the words of a RAW file."""
    write_events(folder / "e.raw", events, format=kind)
    data = (folder / "e.raw").read_bytes()
    start = data.index(b"% end\n") + 6
    return data[:start], data[start:]


def piped(pieces: list[bytes]) -> int:
    """Return the reading end of a pipe into which a thread writes."""
    end, start = os.pipe()

    def write() -> None:
        with os.fdopen(start, "wb", buffering=0) as file:
            for piece in pieces:
                file.write(piece)

    threading.Thread(target=write, daemon=True).start()
    return end


def taken(source, stop=NEVER) -> list:
    """Return all chunks of a source."""
    return list(source.chunks(stop))


# Words on standard input


@pytest.mark.parametrize("kind", ["EVT2", "EVT21", "EVT3"])
@pytest.mark.parametrize("has_header", [True, False])
def test_words_in_pieces_of_any_length_are_the_events(kind: str, has_header: bool, tmp_path: Path) -> None:
    events = stream(6000, 5, span_us=40_000_000)
    header, words = raw(events, kind, tmp_path)
    data, draw, pieces = header * has_header + words, np.random.default_rng(6), []
    while data:
        length = int(draw.choice([1, 2, 3, 7, 64, 5000]))
        pieces.append(data[:length])
        data = data[length:]
    how = {} if has_header else {"format": kind.lower(), "width": 30, "height": 20}
    source = WordInput(piped(pieces), **how)
    parts = taken(source)
    assert joined([part.events for part in parts]) == events
    assert not any(part.restart for part in parts) and not any(source.faults().values())
    assert all(part.until_us == part.events.t_us[-1] for part in parts)


@pytest.mark.parametrize("kind", ["EVT2", "EVT3"])
@pytest.mark.parametrize("lost", [1, 3, 5001])
def test_a_stream_that_lost_bytes_is_entered_anew_and_told(
    kind: str, lost: int, tmp_path: Path, caplog
) -> None:
    events = stream(60_000, 7, span_us=1_000_000, width=640, height=480)
    header, words = raw(events, kind, tmp_path)
    half = len(words) // 2
    source = WordInput(piped([header, words[:half], words[half + lost :]]))
    parts = taken(source)
    anew = [k for k, part in enumerate(parts) if part.restart]
    assert 1 <= len(anew) <= 2
    before = joined([part.events for part in parts[: anew[0]]])
    after = joined([part.events for part in parts[anew[-1] :]])[-20_000:]
    ends = {name: column[-20_000:] for name, column in events.columns().items()}
    assert all((after.columns()[name] == column).all() for name, column in ends.items() if name != "t_us")
    assert np.ptp(after.t_us - ends["t_us"]) == 0
    good = min(len(before), 25_000)  # what stands well before the break
    assert (before.x[:good] == events.x[:good]).all() and (before.t_us[:good] == events.t_us[:good]).all()
    faults = source.faults()
    assert faults["streams taken up anew"] == len(anew) and faults["damaged events"] > 0
    assert "taken up anew" in caplog.text


def test_noise_on_the_pipe_is_counted_and_ends_by_itself() -> None:
    noise = np.random.default_rng(0).bytes(200_001)
    source = WordInput(piped([noise]), format="evt3", width=64, height=48)
    for part in taken(source):
        assert (np.diff(part.events.t_us) >= 0).all()
        assert not len(part.events) or (part.events.x.max() < 64 and part.events.y.max() < 48)
    assert source.faults()["damaged events"] > 5000 and source.faults()["bytes left out"] >= 1


def test_a_wrong_sensor_size_is_no_broken_stream(tmp_path: Path) -> None:
    _, words = raw(stream(20_000, 8, width=640, height=480), "EVT3", tmp_path)
    source = WordInput(piped([words]), format="evt3", width=320, height=240)
    found = joined([part.events for part in taken(source)])
    assert 4000 < len(found) < 6000 and source.faults()["streams taken up anew"] == 0
    assert source.faults()["damaged events"] == 20_000 - len(found)


def test_a_pipe_that_says_too_little_is_one_line(tmp_path: Path) -> None:
    header, words = raw(stream(10), "EVT3", tmp_path)
    for error, how, data, text in (
        (EventFileError, {}, words, "--format evt3"),
        (EventFileError, {}, b"", "--format evt3"),
        (EventFileError, {}, header[:40], "--format evt3"),
        (EventFileError, {}, b"t_us,x,y,p\n1,2,3,1\n", "no header of a RAW file"),
        (ConfigError, {"format": "evt2", "width": 30, "height": 20}, header + words, "leave --format out"),
    ):
        with pytest.raises(error, match=text) as caught:
            taken(WordInput(piped([data]), **how))
        assert "\n" not in str(caught.value)
    for how, text in (({"format": "evt9"}, "evt2, evt21, evt3"), ({"format": "evt3"}, "--width and --height")):
        with pytest.raises(ConfigError, match=text):
            WordInput(0, **how)


@pytest.mark.slow
def test_live_reads_standard_input_to_its_end(tmp_path: Path) -> None:
    """Sent = pictured + dropped, in a process of its own as a user starts it."""
    header, words = raw(stream(30_000, 9, span_us=900_000, width=160, height=100), "EVT3", tmp_path)
    call = [sys.executable, "-m", "evnlos", "live", "-", "--headless", "--out", str(tmp_path / "out"), "--json"]
    ended = subprocess.run(call, input=header + words, capture_output=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    table = json.loads(ended.stdout)
    assert table["events"] + table["dropped"]["events"] == 30_000 and table["images"] > 0
    assert table["source"] == "standard input" and not any(table["faults"].values())


# Streams of other programs


def aestream(events: Events, has_times: bool = True) -> bytes:
    """Return a packet as AEStream sends it."""
    words = (events.x.astype("<u4") & 0x7FFF) << 16 | events.y | (events.p.astype("<u4") << 15)
    if not has_times:
        return (words | 1 << 31).astype("<u4").tobytes()
    return np.stack([words, events.t_us.astype("<u8").astype("<u4")], axis=1).tobytes()


def packets(source, datagrams: list[bytes]) -> list:
    """Return the chunks that packets make, until the source falls silent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in datagrams:
            sender.sendto(data, ("127.0.0.1", source.port))
    return taken(source)


def test_packets_of_aestream_are_events_also_where_their_clock_turns() -> None:
    events = stream(6_000, 3, span_us=9_000_000)
    events = Events(events.t_us + 2**32 - 4_000_000, events.x, events.y, events.p, 30, 20)
    source = AestreamSource("127.0.0.1", 0, 30, 20, idle_s=0.2)
    parts = packets(source, [aestream(events[at : at + 32]) for at in range(0, 6_000, 32)])
    assert joined([part.events for part in parts]) == events
    assert not any(source.faults().values())


def test_faults_in_packets_of_aestream_are_counted() -> None:
    events = stream(96, 4)
    first, second, third = (aestream(events[at : at + 32]) for at in (0, 32, 64))
    outside = aestream(Events([99_999], [200], [3], [True], 300, 20))
    source = AestreamSource("127.0.0.1", 0, 30, 20, idle_s=0.2)
    # AEStream sends its last packet twice as long as it is full, with what the buffer held before.
    parts = packets(source, [first, second, third[:128] + first[:128], outside, b"", b"123", third[128:]])
    assert joined([part.events for part in parts]) == events
    assert source.faults()["damaged or late events"] == 16 + 1 + 1


def test_events_without_times_have_the_one_of_their_arrival() -> None:
    events = stream(64, 5)
    source = AestreamSource("127.0.0.1", 0, 30, 20, idle_s=0.2)
    found = joined([part.events for part in packets(source, [aestream(events, False)])])
    assert (found.x == events.x).all() and (found.p == events.p).all() and np.ptp(found.t_us) == 0


# What AEStream 0.6.4 sent of seven events of ours, in a .dat file: `aestream input file q.dat output udp
# 127.0.0.1 3399 --include-timestamp true`, and with `false`.
AESTREAM_TIMED = (
    "00800000 005ed0b2 df017f02 005ed0b2 00807f02 015ed0b2 df010000 465ed0b2 02800100 475ed0b2 f0004001"
    "90bdd1b2 04800300 90bdd1b2" + "00000000" * 14
)
AESTREAM_UNTIMED = "00800080 df017f82 00807f82 df010080 02800180 f0004081 04800380"


def test_packets_that_the_program_of_aestream_sent_are_its_events() -> None:
    t_us = 3_000_000_000 + np.array([0, 0, 1, 70, 71, 90_000, 90_000])
    x, y = np.array([[0, 639, 639, 0, 1, 320, 3], [0, 479, 0, 479, 2, 240, 4]], np.uint16)
    sent = Events(t_us, x, y, np.array([1, 0, 1, 0, 1, 0, 1], bool), 640, 480)
    for text, has_times in ((AESTREAM_TIMED, True), (AESTREAM_UNTIMED, False)):
        source = AestreamSource("127.0.0.1", 0, 640, 480, idle_s=0.2)
        found = joined([part.events for part in packets(source, [bytes.fromhex(text)])])
        assert not any(source.faults().values())
        assert found == (sent if has_times else replace(sent, t_us=found.t_us))


def test_a_sender_of_aestream_that_begins_anew_is_heard() -> None:
    late, early = stream(300, 6), stream(4_000, 7)
    late = Events(late.t_us + 10**9, late.x, late.y, late.p, 30, 20)
    source = AestreamSource("127.0.0.1", 0, 30, 20, idle_s=0.2)
    parts = packets(
        source, [aestream(one[at : at + 20]) for one in (late, early) for at in range(0, len(one), 20)]
    )
    assert [part.restart for part in parts].count(True) == 1
    assert joined([part.events for part in parts if part.until_us < 10**9]) == early[2000:]
    assert source.faults() == {"damaged or late events": 2000, "streams taken up anew": 1}


def served(pieces: list[bytes], port: int = 0) -> int:
    """Return the port of a server that sends pieces to the first who connects, and closes."""
    server = socket.create_server(("127.0.0.1", port))

    def serve() -> None:
        connection, _ = server.accept()
        with connection, server:
            for piece in pieces:
                connection.sendall(piece)

    threading.Thread(target=serve, daemon=True).start()
    return server.getsockname()[1]


def free_port() -> int:
    """Return a port at which nobody answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def dv_stream(events: Events, folder: Path, method: int = 0) -> list[bytes]:
    """Return what dv-processing's server sends: a header and packets as in an AEDAT4 file."""
    write_events(folder / "e.aedat4", events)
    data = bytearray((folder / "e.aedat4").read_bytes())
    data[54] = method
    at = 18 + struct.unpack_from("<I", data, 14)[0]
    pieces = [bytes(data[:at])]
    while at < len(data):
        number, length = struct.unpack_from("<ii", data, at)
        body = bytes(data[at + 8 : at + 8 + length])
        at += 8 + length
        if method == 1:
            body = pytest.importorskip("lz4.frame").compress(body)
        if method == 3:
            body = pytest.importorskip("zstandard").compress(body)
        pieces += [struct.pack("<ii", number, len(body)) + body]
    return pieces


@pytest.mark.parametrize("method", [0, 1, 3])
@pytest.mark.parametrize("start", [0, 14])
def test_the_stream_of_dv_is_its_events(method: int, start: int, tmp_path: Path) -> None:
    events = stream(40_000, 9, span_us=900_000)
    events = Events(events.t_us + 1_700_000_000_000_000, events.x, events.y, events.p, 30, 20)
    header, *bodies = dv_stream(events, tmp_path, method)
    other = struct.pack("<ii", 7, 5) + b"other"  # a packet of another stream
    source = DvSource("127.0.0.1", served([header[start:], other, *bodies]), idle_s=5)
    assert joined([part.events for part in taken(source)]) == events
    assert not any(source.faults().values())


def test_time_that_the_events_take_here_is_no_silence_of_dv(tmp_path: Path) -> None:
    """All packets lie in the socket while the first is looked at for longer than --idle."""

    class Slow(SystemClock):
        ahead_s = 0.0

        def now(self) -> float:
            return super().now() + self.ahead_s

    events, clock = stream(80_000, 9), Slow()
    source = DvSource("127.0.0.1", served(dv_stream(events, tmp_path)), idle_s=5, clock=clock)
    found = []
    for chunk in source.chunks(lambda: False):
        found.append(chunk.events)
        clock.ahead_s += 60
    assert len(found) > 3 and joined(found) == events


def test_a_server_of_dv_that_falls_silent_in_a_packet_is_counted(tmp_path: Path) -> None:
    header, first, *_ = dv_stream(stream(20_000, 9), tmp_path)
    held = threading.Event()
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = server.accept()
        with connection, server:
            connection.sendall(header + first + first[:100])
            held.wait(30)

    threading.Thread(target=serve, daemon=True).start()
    source = DvSource("127.0.0.1", server.getsockname()[1], idle_s=0.2)
    try:
        assert len(joined([part.events for part in taken(source)])) == 1 << 14
    finally:
        held.set()
    assert source.faults()["bytes left out"] == 92


def test_a_server_of_dv_that_is_not_there_or_says_nothing_is_one_line(tmp_path: Path) -> None:
    port = free_port()
    begun_s = time.monotonic()
    with pytest.raises(ConfigError, match=f"127.0.0.1:{port} did not answer within 3 s"):
        DvSource("127.0.0.1", port)
    assert time.monotonic() - begun_s < 10
    with socket.create_server(("127.0.0.1", 0)) as mute:  # it never accepts, and so never sends
        source = DvSource("127.0.0.1", mute.getsockname()[1])
        with pytest.raises(EventFileError, match="sent nothing for 3 s"):
            taken(source)
    with pytest.raises(EventFileError, match="closed"):
        taken(DvSource("127.0.0.1", served([])))


def test_a_server_of_dv_that_is_only_starting_is_waited_for(tmp_path: Path) -> None:
    events = stream(2_000, 9)
    pieces = dv_stream(events, tmp_path)
    port, slept = free_port(), list[float]()

    class Late(SystemClock):
        def sleep(self, seconds: float) -> None:
            slept.append(seconds)
            if len(slept) == 3:
                served(pieces, port)
            super().sleep(seconds)

    source = DvSource("127.0.0.1", port, clock=Late())
    assert len(slept) == 3 and joined([part.events for part in taken(source)]) == events


def test_damage_in_the_stream_of_dv_is_counted_or_one_line(tmp_path: Path) -> None:
    events = stream(40_000, 9)
    header, first, second, third = dv_stream(events, tmp_path)
    broken = first[:8] + b"\xff" * 32 + first[40:]
    source = DvSource("127.0.0.1", served([header, broken, second, third[:100]]))
    assert joined([part.events for part in taken(source)]) == events[1 << 14 : 2 << 14]
    assert source.faults() == {"damaged or late events": 0, "damaged packets": 1, "bytes left out": 92}
    for pieces, text in (
        ([header, struct.pack("<ii", 0, -5)], "a packet of -5 bytes"),
        ([header[:14], struct.pack("<I", 1 << 31)], "bytes, at most"),
        ([header.replace(b"EVTS", b"FRME")], "without events"),
        ([header[:18] + bytes(len(header) - 18)], "damaged|without events"),
    ):
        with pytest.raises(EventFileError, match=text) as caught:
            taken(DvSource("127.0.0.1", served(pieces)))
        assert "\n" not in str(caught.value)


def test_flipped_bytes_in_the_stream_of_dv_are_errors_of_ours_or_counted(tmp_path: Path) -> None:
    whole, draw = b"".join(dv_stream(stream(500, 10), tmp_path)), np.random.default_rng(3)
    for _ in range(60):
        data = bytearray(whole)
        for at in draw.integers(0, len(data) if draw.random() < 0.3 else 900, int(draw.integers(1, 9))):
            data[at] = draw.integers(256)
        with contextlib.suppress(EvnlosError):
            for part in taken(DvSource("127.0.0.1", served([bytes(data)]))):
                assert len(part.events) <= 500 and (np.diff(part.events.t_us) >= 0).all()


def test_addresses_of_other_programs_are_checked() -> None:
    for source, text in (
        ("aestream://127.0.0.1:0", "--width and --height"),
        ("aestream://127.0.0.1", "aestream://127.0.0.1:7000"),
        ("dv://127.0.0.1:1", "did not answer within 3 s"),
        ("dv://127.0.0.1:99999", "dv://127.0.0.1:7000"),
        ("udp://127.0.0.1:0", "--format is for words"),
        ("evk9", "neither a file nor one of the cameras .*evk4"),
    ):
        how = SourceOptions(format="evt3") if source.startswith("udp") else SourceOptions()
        with pytest.raises(ConfigError, match=text):
            open_live(source, how)


# Cameras


class Turned:
    """A clock that only `sleep` moves; work takes no time."""

    def __init__(self) -> None:
        self.at = 100.0

    def now(self) -> float:
        return self.at

    def sleep(self, seconds: float) -> None:
        self.at += max(seconds, 0.0)


class Pretended:
    """A camera that is none: it gives packets, is silent (None), or goes away ("out").

    What it does after its last step is `then`: "ended" raises as a cable that is pulled, and it stays away.
    """

    def __init__(self, clock: Turned, *lives: list, facts: CameraFacts | None = None) -> None:
        self.facts = facts or CameraFacts("Pretended 1", 30, 20, "0042", {"diff_on": 12, "diff_off": -3})
        self._lives, self._clock = [list(life) for life in lives], clock
        self.opened_s: list[float] = []

    def open(self) -> "Pretended":
        self.opened_s.append(self._clock.now())
        if not self._lives:
            raise CameraLostError("the pretended camera is not there")
        self._life = self._lives.pop(0)
        if self._life == ["missing"]:
            raise CameraLostError("the pretended camera is not there")
        return self

    def read(self) -> CameraPacket | None:
        self._clock.sleep(0.05)
        if not self._life:
            raise CameraLostError("the pretended camera went away")
        return self._life.pop(0)

    def measure(self) -> dict[str, float]:
        return {"temperature_c": 30 + self._clock.now() - 100, "light": 5.0}

    def close(self) -> None:
        pass


def sent(events: Events, *, frames: tuple = (), overflows: int = 0) -> CameraPacket:
    return CameraPacket(dict(events.columns()), frames, overflows)


def test_a_camera_that_goes_away_comes_back_and_all_is_counted(caplog) -> None:
    clock, events = Turned(), stream(600, 11)
    camera = Pretended(
        clock,
        [sent(events[:200]), sent(events[200:250], overflows=2), *[None] * 30, sent(events[250:300])],
        ["missing"],
        ["missing"],
        [sent(events[100:400])],  # its clock is another one
    )
    source = DeviceSource(camera.open, "pretended", idle_s=3, clock=clock)
    found: list = []
    with pytest.raises(CameraLostError, match=r"not there \(looked for 3 s"):
        found.extend(source.chunks(NEVER))
    assert [part.restart for part in found] == [False, False, False, True]
    assert joined([part.events for part in found[:3]]) == events[:300] and found[3].events == events[100:400]
    faults = {"disconnections": 2, "stalls": 1, "overflows": 2, "damaged or late events": 0}
    assert source.faults() == faults
    waits = np.diff(camera.opened_s)[1:]
    assert waits[0] == pytest.approx(0.2, abs=0.06) and waits[1] == pytest.approx(0.4, abs=0.06)  # they grow
    assert source.readings["light"] == (5.0, 5.0)
    assert source.readings["temperature_c"][1] > source.readings["temperature_c"][0]
    for text in ("no event for 1 s", "too slow, events are lost", "went away; it is looked for", "is back"):
        assert text in caplog.text


def test_overflows_and_events_out_of_order_are_counted() -> None:
    clock, events = Turned(), stream(300, 12)
    camera = Pretended(
        clock, [sent(events[:200]), sent(events[150:], overflows=3), sent(events[:5], overflows=1)]
    )
    source, found = DeviceSource(camera.open, "pretended", clock=clock), []
    found.extend(source.chunks(lambda: source.faults()["overflows"] == 4))
    assert joined([part.events for part in found]).t_us[-1] == events.t_us[-1]
    faults = source.faults()
    assert faults["overflows"] == 4 and faults["damaged or late events"] >= 50
    assert len(joined([part.events for part in found])) == 355 - faults["damaged or late events"]


def test_frames_of_a_camera_stand_between_the_events_before_and_after_them() -> None:
    clock, events = Turned(), stream(900, 13)
    image = np.full((20, 30), 0.5, np.float32)
    middle, early = int(events.t_us[450]), int(events.t_us[100])
    camera = Pretended(
        clock,
        [sent(events[:300]), sent(events[300:], frames=((early, image), (middle, image)))],
        facts=CameraFacts("P", 30, 20, frame_rate_hz=25.0, exposure_s=0.004),
    )
    source, found = DeviceSource(camera.open, "pretended", clock=clock), []
    assert source.has_frames
    found.extend(source.chunks(lambda: sum(len(one.events) for one in found) == 900))
    assert joined([part.events for part in found]) == events
    assert [part.frame_us for part in found if part.frame is not None] == [early, middle]
    assert all(not len(part.events) or part.events.t_us[-1] <= part.until_us for part in found)
    assert all(a.until_us <= b.until_us for a, b in pairwise(found))
    assert int(np.searchsorted(events.t_us, middle, "right")) == sum(len(part.events) for part in found[:3])


class Opened:
    """A device as the package `neuromorphic-drivers` gives it, of the package's own types."""

    def __init__(self, drivers, name: str, packets: list) -> None:
        module = getattr(drivers, DEVICES[name][0])
        self._drivers, self._module, self._packets = drivers, module, packets
        self.closed = False

    def properties(self):
        return self._module.Properties()

    def name(self):
        return next(one for one in self._drivers.Name if one.name.lower() == DEVICES_TITLE(self._module))

    def serial(self) -> str:
        return "00001234"

    def temperature_celsius(self) -> float:
        return 41.5

    def illuminance(self) -> int:
        raise RuntimeError("illuminance is not implemented for the pretended device")

    def close(self) -> None:
        self.closed = True

    def __next__(self):
        from neuromorphic_drivers.status import RingStatus, Status

        if not self._packets:
            raise RuntimeError("device not found")
        packet = self._packets.pop(0)
        ring = None if packet is None else RingStatus(1.0, 0, 1, False, 0, 0)
        return Status(1.0, ring), packet


def DEVICES_TITLE(module) -> str:  # noqa: N802
    return module.__name__.rpartition(".")[2]


def of_package(drivers, kind: str, events: Events, **more):
    """Return a packet of the package's own type."""
    packet = getattr(drivers.packet, kind)()
    rows = np.zeros(len(events), [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
    rows["t"], rows["x"], rows["y"], rows["on"] = events.t_us, events.x, events.y, events.p
    fields = {"polarity_events": rows, "polarity_events_overflow_indices": None, "trigger_events": None}
    if kind != "Evt3Packet":
        fields["imu_events"] = None
    for name, value in (fields | more).items():
        setattr(packet, name, value)
    return packet


def test_packets_of_the_package_become_events_frames_and_facts(monkeypatch) -> None:
    drivers = pytest.importorskip("neuromorphic_drivers")
    events = stream(500, 14, width=346, height=260)
    frame = drivers.packet.Frame()
    frame.start_t, frame.exposure_start_t, frame.exposure_end_t, frame.t = 1, 2, int(events.t_us[250]), 10**6
    frame.pixels = np.full((260, 346), 512 * 64, np.uint16)
    imu = np.zeros(2, [("t", "<u8"), ("temperature", "<f4")])
    imu["temperature"] = 33.0, 35.0
    more = {"frames": [frame], "imu_events": imu, "polarity_events_overflow_indices": np.array([0, 7])}
    first = of_package(drivers, "Davis346Packet", events, **more)
    silent = of_package(drivers, "Davis346Packet", events[:0], frames=[], polarity_events=None)
    opened = Opened(drivers, "davis346", [first, None, silent])
    asked = {}

    def open_device(configuration, **how):
        asked.update(how, configuration=configuration)
        return opened

    monkeypatch.setattr(drivers, "open", open_device)
    driver = NeuromorphicDriver("davis346", "00001234")
    assert isinstance(asked["configuration"], drivers.inivation_davis346.Configuration)
    assert asked["serial"] == "00001234" and 0 < asked["iterator_timeout"] <= 0.1
    facts = driver.facts
    assert (facts.name, facts.width, facts.height, facts.serial) == (
        "iniVation DAVIS 346",
        346,
        260,
        "00001234",
    )
    assert facts.exposure_s == 0.004 and facts.frame_rate_hz == 25.0 and facts.biases["diffbn"] == 1063
    packet = driver.read()
    assert packet is not None and packet.columns is not None
    assert Events(**packet.columns, width=346, height=260) == events
    assert packet.overflows == 2 and packet.temperature_c == 34.0
    ((t_us, image),) = packet.frames
    assert t_us == events.t_us[250] and image.shape == (260, 346) and image[0, 0] == np.float32(512 / 1023)
    assert driver.read() is None
    rest = driver.read()
    assert rest is not None and rest.columns is None and rest.frames == ()
    assert driver.measure() == {"temperature_c": 41.5} == driver.measure()
    with pytest.raises(CameraLostError, match="went away"):
        driver.read()
    driver.close()
    assert opened.closed


@pytest.mark.parametrize("name", DEVICES)
def test_every_camera_that_is_named_is_one_of_the_package(name: str, monkeypatch) -> None:
    drivers = pytest.importorskip("neuromorphic_drivers")
    monkeypatch.setattr(drivers, "open", lambda *_, **__: Opened(drivers, name, []))
    facts = NeuromorphicDriver(name).facts
    assert (
        facts.width >= 346 and facts.biases and all(isinstance(value, int) for value in facts.biases.values())
    )


def test_no_camera_and_no_package_are_one_line_each(monkeypatch, capsys) -> None:
    drivers = pytest.importorskip("neuromorphic_drivers")

    def refuse(*_, **__):
        raise RuntimeError("no device found")

    monkeypatch.setattr(drivers, "open", refuse)
    for missing, text in ((False, "install-udev-rules"), (True, "pip install 'evnlos[camera]'")):
        if missing:
            monkeypatch.setitem(sys.modules, "neuromorphic_drivers", None)
        with pytest.raises(SystemExit) as stop:
            main(["live", "evk4:77", "--headless"])
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("evnlos")]
        assert stop.value.code == 2 and len(lines) == 1 and text in lines[0]


def test_live_images_a_camera_that_comes_back_and_accounts_for_its_events(
    monkeypatch, tmp_path: Path, capsys
) -> None:
    drivers = pytest.importorskip("neuromorphic_drivers")
    events = stream(20_000, 19, span_us=400_000, width=640, height=480)
    parts = [of_package(drivers, "DvxplorerPacket", events[at : at + 1000]) for at in range(0, 20_000, 1000)]
    overflow = of_package(
        drivers, "DvxplorerPacket", events[:0], polarity_events_overflow_indices=np.array([0])
    )
    lives = [[*parts[:10], overflow], parts[10:]]

    def open_device(*_, **__):
        if not lives:
            raise RuntimeError("no device found")
        return Opened(drivers, "dvxplorer", lives.pop(0))

    monkeypatch.setattr(drivers, "open", open_device)
    out = str(tmp_path / "out")
    main(["live", "dvxplorer", "--headless", "--out", out, "--seconds", "4", "--idle", "0", "--json"])
    printed = capsys.readouterr()
    table = json.loads(printed.out.splitlines()[-1])
    assert table["events"] + table["dropped"]["events"] == 20_000 and table["images"] > 0
    assert table["faults"]["disconnections"] == 2 and table["faults"]["overflows"] == 1
    assert "is back" in printed.err and "too slow" in printed.err


def test_help_names_every_camera(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["live", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert [name for name in DEVICES if name not in text] == []


# Recording a capture


def wall(steps: int = 30) -> tuple[list[CameraPacket], Events]:
    """Return packets of 33 ms of a camera with frames, a spot that moves over a grey wall, and all events."""
    events = stream(30_000, 15, span_us=steps * 33_000, width=48, height=36)
    events = Events(events.t_us + 5_000_000, events.x, events.y, events.p, 48, 36)
    packets, rows = [], np.arange(36)[:, None]
    for k in range(steps):
        start, stop = (int(np.searchsorted(events.t_us, 5_000_000 + n * 33_000)) for n in (k, k + 1))
        image = 0.4 + 0.3 * np.exp(-((np.arange(48) - 8 - k) ** 2 + (rows - 18) ** 2) / 20)
        frame = (5_000_000 + k * 33_000 + 20_000, image.astype(np.float32))
        packets.append(sent(events[start:stop], frames=(frame,)))
    return packets, events


FACTS = CameraFacts("Pretended 346", 48, 36, "0042", {"onbn": 1564, "diffbn": 1063}, 0.004, 30.0, 12e6)


def test_a_recorded_capture_is_whole_checked_and_imported(tmp_path: Path, capsys) -> None:
    packets, events = wall()
    clock = Turned()
    camera = Pretended(clock, packets, facts=FACTS)
    source = DeviceSource(camera.open, "davis346", idle_s=1, clock=clock)
    lines: list[str] = []
    done = record_capture(tmp_path / "near_R", source, tell=lines.append, tell_every_s=0)
    assert done.events == 30_000 and done.frames == 30 and "not there" in (done.ended_by or "")
    assert sorted(path.name for path in (tmp_path / "near_R").iterdir()) == [
        "capture.yaml",
        "events.raw",
        "frames",
        "frames.csv",
    ]
    info = read_capture_info(tmp_path / "near_R")
    assert (info.camera.name, info.camera.exposure_s, info.camera.frame_rate_hz) == (
        "Pretended 346",
        0.004,
        30.0,
    )
    said = info.recording
    assert said is not None and said.serial == "0042" and said.biases == {"onbn": 1564, "diffbn": 1063}
    assert said.temperature_c is not None and said.temperature_c[0] < said.temperature_c[1]
    assert said.light == (5.0, 5.0) and said.source == "davis346" and said.faults["disconnections"] == 1
    capture = read_capture(tmp_path / "near_R")
    assert capture.events == events and capture.frames.dtype == np.uint16
    assert (capture.frame_times_us == 5_020_000 + 33_000 * np.arange(30)).all()
    np.testing.assert_allclose(capture.frames[3] / 65535, packets[3].frames[0][1], atol=1e-5)
    with contextlib.suppress(SystemExit):  # random events fit no movement: what counts is that all is looked at
        main(["capture", "check", str(tmp_path / "near_R"), "--json"])
    found = {one["what"] for one in json.loads(capsys.readouterr().out)["findings"]}
    assert {"saturation", "event rate", "flicker", "clock", "hot pixels"} <= found
    main(["import", str(tmp_path / "near_R"), "--out", str(tmp_path / "dataset")])
    assert (tmp_path / "dataset" / "checks").is_dir()


@pytest.mark.slow
def test_a_recording_of_events_alone_is_a_capture_too(tmp_path: Path, capsys) -> None:
    """From a pipe, in a process of its own: Ctrl-C ends it, and check and import take it."""
    events = stream(40_000, 16, span_us=2_000_000, width=64, height=48)
    header, words = raw(events, "EVT3", tmp_path)
    folder = tmp_path / "near_A"
    call = [sys.executable, "-m", "evnlos", "capture", "record", str(folder), "--source", "-", "--json"]
    process = subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None and process.stdout is not None and process.stderr is not None
    process.stdin.write(header + words)
    process.stdin.flush()
    assert b"Ctrl-C ends" in process.stderr.readline()
    time.sleep(3)  # the input stays open: nothing but the signal ends it
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    about = json.loads(out)
    assert about["events"] == 40_000 and about["frames"] == 0 and about["ended_by"] is None
    assert read_events(folder / "events.raw") == events
    assert read_capture_info(folder).frames is None
    with pytest.raises(DataError, match="events alone"):
        read_capture(folder)
    main(["capture", "check", str(folder)])
    text = capsys.readouterr().out
    assert "event camera alone" in text and "event rate" in text and "BAD" not in text
    main(["import", str(folder), "--out", str(tmp_path / "dataset"), "--json"])
    assert json.loads(capsys.readouterr().out)["split"]["train"] == ["near_A"]
    capture = read_capture(folder, needs_frames=False)
    assert capture.frames.shape == (60, 48, 64) and not capture.frames.any()
    main(["live", str(folder), "--headless", "--out", str(tmp_path / "live"), "--speed", "9", "--json"])
    table = json.loads(capsys.readouterr().out)
    assert table["modality"] == "event" and table["events"] + table["dropped"]["events"] == 40_000


def test_a_stream_that_begins_anew_goes_on_in_one_recording(tmp_path: Path) -> None:
    clock, events = Turned(), stream(600, 17)
    late = Events(events.t_us + 10**9, events.x, events.y, events.p, 30, 20)
    camera = Pretended(clock, [sent(late[:300])], [sent(events[300:])])
    record_capture(tmp_path / "c", DeviceSource(camera.open, "pretended", idle_s=0.5, clock=clock))
    found = read_events(tmp_path / "c" / "events.raw")
    assert found[:300] == late[:300] and (found.x[300:] == events.x[300:]).all()
    assert (np.diff(found.t_us[300:]) == np.diff(events.t_us[300:])).all()
    assert 100_000 < found.t_us[300] - found.t_us[299] < 1_000_000  # what passed by the clock
    said = read_capture_info(tmp_path / "c").recording
    assert said is not None and "1 times begun anew" in said.clock


class Endless:
    """A source that sends until it is told to stop, or for ever."""

    name, has_frames, waits = "endless", False, False

    def __init__(self, error: Exception | None = None) -> None:
        self._error = error

    def chunks(self, stop):
        at = 0
        while not stop():
            events = stream(2000, at, span_us=20_000)
            shifted = Events(events.t_us + 20_000 * at, events.x, events.y, events.p, 30, 20)
            yield Chunk(shifted, int(shifted.t_us[-1]), time.perf_counter(), time.perf_counter())
            at += 1
            time.sleep(0.01)
            if self._error is not None and at == 5:
                raise self._error

    def faults(self):
        return {"lost packets": 7}

    def close(self):
        pass


def test_time_an_error_and_a_full_disk_end_a_recording_that_stays(tmp_path: Path, monkeypatch) -> None:
    lines: list[str] = []
    done = record_capture(tmp_path / "timed", Endless(), seconds=0.5, tell=lines.append, tell_every_s=0.1)
    assert 0.5 <= done.seconds < 5 and done.ended_by is None
    assert lines and "kev/s" in lines[-1] and "! 7 lost packets" in lines[-1] and "\n" not in lines[-1]
    done = record_capture(tmp_path / "failed", Endless(EventFileError("the cable is out")))
    assert done.events == 10_000 and done.ended_by == "the cable is out"
    assert len(read_events(tmp_path / "failed" / "events.raw")) == 10_000
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    done = record_capture(tmp_path / "full", Endless())
    assert done.ended_by == "the disk has 1 MB left" and read_capture_info(tmp_path / "full").camera.width == 30


def test_what_can_not_be_recorded_leaves_nothing(tmp_path: Path, monkeypatch, capsys) -> None:
    with pytest.raises(DataError, match="no event was recorded: standard input begins with 00 00"):
        record_capture(tmp_path / "c", WordInput(piped([b"\0" * 99])))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="not an empty folder"):
        record_capture(tmp_path / "other", Endless())
    with pytest.raises(ConfigError, match="seconds is 0"):
        record_capture(tmp_path / "c", Endless(), seconds=0)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    packets, _ = wall()
    camera = Pretended(Turned(), packets, facts=FACTS)
    with pytest.raises(OSError, match="No space left"):
        record_capture(tmp_path / "c", DeviceSource(camera.open, "davis346", clock=Turned()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other"]
    with pytest.raises(SystemExit):
        main(["capture", "record", str(tmp_path / "c")])
    assert "--source" in capsys.readouterr().err


def test_a_recording_on_a_small_disk_leaves_nothing(tmp_path: Path) -> None:
    from crash import small_disk

    place = tmp_path / "small"
    place.mkdir()
    with small_disk(place, 1 << 20) as is_small:
        if not is_small:
            pytest.skip("mounting a small tmpfs needs root")
        # As where the disk fills up between two looks at it.
        with pytest.raises((EventFileError, OSError)), pytest.MonkeyPatch.context() as patch:
            patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 40))
            record_capture(place / "c", Endless(), seconds=60)
        assert list(place.iterdir()) == []


def test_the_check_sees_flicker_hot_pixels_readout_and_light() -> None:
    calm = RecordingCheck(12e6)
    calm.add(stream(50_000, 1, span_us=3_000_000, width=64, height=48), np.full((4, 4), 0.4, np.float32))
    found = calm.values(0.0)
    assert found["flicker_hz"] is None and found["hot_pixels"] == 0 and found["readout"] == 0
    assert found["rate_hz"] == pytest.approx(16_700, rel=0.05) and found["on_fraction"] == pytest.approx(
        0.5, abs=0.02
    )
    assert "!" not in check_line(3.0, found, {"lost packets": 0})
    draw, hertz = np.random.default_rng(2), 100
    t_us = np.sort(draw.integers(0, 3_000_000, 60_000))
    t_us = t_us[draw.random(60_000) < 0.5 + 0.4 * np.sin(2 * np.pi * hertz * t_us / 1e6)]
    x = np.where(draw.random(len(t_us)) < 0.1, 7, draw.integers(0, 64, len(t_us))).astype(np.uint16)
    y = np.where(x == 7, 9, draw.integers(0, 48, len(t_us))).astype(np.uint16)
    bad = RecordingCheck(30e3)
    for start in range(0, len(t_us), 777):
        part = slice(start, start + 777)
        ones = np.ones(len(t_us[part]), bool)
        bad.add(Events(t_us[part], x[part], y[part], ones, 64, 48), np.ones((4, 4), np.float32))
    found = bad.values(0.0)
    assert found["flicker_hz"] == hertz and found["hot_pixels"] == 1 and found["hot_fraction"] > 0.05
    assert found["readout"] > 0.2 and found["clipped"] == 1
    line = check_line(3.0, found, {})
    for text in ("! ON 100 %", "! readout busy", "! flicker at 100 Hz", "! 1 hot pixels", "! light 100 %"):
        assert text in line


def test_the_rate_forgets_what_is_long_ago() -> None:
    check = RecordingCheck()
    check.add(stream(9000, 1, span_us=1_000_000))
    quiet = stream(5, 2)
    check.add(Events(quiet.t_us + 9_000_000, quiet.x, quiet.y, quiet.p, 30, 20))
    assert check.values(0.0)["rate_hz"] == 5 and check.events == 9005


@pytest.mark.slow
def test_a_recording_that_is_killed_leaves_no_capture_and_is_swept(tmp_path: Path) -> None:
    header, words = raw(stream(200_000, 18, span_us=2_000_000), "EVT3", tmp_path)
    call = [
        sys.executable,
        "-m",
        "evnlos",
        "capture",
        "record",
        str(tmp_path / "a" / "near_B"),
        "--source",
        "-",
    ]
    process = subprocess.Popen(call, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None and process.stderr is not None
    assert b"Ctrl-C ends" in process.stderr.readline()
    process.stdin.write(header + words)
    process.stdin.flush()
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("a/.near_B*/.events.raw*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.communicate()
    assert [path.name[:7] for path in (tmp_path / "a").iterdir()] == [".near_B"]
    record_capture(tmp_path / "a" / "near_B", WordInput(piped([header + words])))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["near_B"]


# Recordings of real cameras


@pytest.mark.parametrize(
    "name", ["expelliarmus_evt2_sample.raw", "expelliarmus_evt3_sample.raw", "faery_evt2.raw"]
)
def test_words_of_real_cameras_on_a_pipe_are_those_of_the_file(name: str, shared_data: Path) -> None:
    path = shared_data / "recordings" / name
    events = read_events(path, on_error="salvage")
    data = path.read_bytes()
    source = WordInput(piped([data[at : at + 7_777] for at in range(0, len(data), 7_777)]))
    assert joined([part.events for part in taken(source)]) == events
    assert source.faults()["streams taken up anew"] == 0


def test_events_of_a_real_camera_by_the_package_are_recorded_as_they_were(
    shared_data: Path, tmp_path: Path, monkeypatch
) -> None:
    drivers = pytest.importorskip("neuromorphic_drivers")
    events = read_events(shared_data / "recordings" / "ros2_libcaer_dvxplorer.db3")
    height, width = events.shape
    size = max(len(events) // 50, 1)
    parts = [events[at : at + size] for at in range(0, len(events), size)]
    opened = Opened(drivers, "dvxplorer", [of_package(drivers, "DvxplorerPacket", part) for part in parts])
    opened.properties = lambda: drivers.inivation_dvxplorer.Properties(width, height)
    devices = [opened]

    def open_device(*_, **__):
        if not devices:
            raise RuntimeError("no device found")
        return devices.pop()

    monkeypatch.setattr(drivers, "open", open_device)
    source = DeviceSource(lambda: NeuromorphicDriver("dvxplorer"), "dvxplorer", idle_s=0.1)
    done = record_capture(tmp_path / "c", source)
    assert done.ended_by is not None and "no device found" in done.ended_by
    assert read_events(tmp_path / "c" / "events.raw") == events
    said = read_capture_info(tmp_path / "c").recording
    assert said is not None and said.biases is not None and said.biases["log_a"] == 1
