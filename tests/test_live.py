"""Live reconstruction: the running surface, the three sources, the queue, the page, and a run without one."""

import contextlib
import io
import json
import re
import shutil
import socket
import struct
import sys
import threading
import urllib.error
import urllib.request
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import chromium
from evnlos import EvnlosError
from evnlos.analysis import reconstruct
from evnlos.analysis.identify import verdict_on
from evnlos.cli import main
from evnlos.config import read_yaml, save_yaml
from evnlos.data import STANDARD_MODALITIES, Sampling, capture_samples, read_capture, reduce_by_area
from evnlos.errors import ConfigError, DataError, EventFileError
from evnlos.events import read_events, time_surface, write_events
from evnlos.live import display as record
from evnlos.live.display import Page
from evnlos.live.engine import AreaReduction, Engine, Picture, RunningSurface, Timing
from evnlos.live.growing_file import GrowingFile, open_tail
from evnlos.live.packet import Chunk, ChunkQueue, Packet, PacketError, pack, unpack, unpack_all
from evnlos.live.run import RateOptions, Run, RunStatistics, latency_table
from evnlos.live.sources import Replay, SourceOptions, TimedFrame, capture_replay, open_live, so_far_of
from evnlos.live.udp import UdpSender, UdpSource, send_timed
from evnlos.models import SequenceConfig, UNetConfig, Weights, published_setup, save_weights
from evnlos.setups import load_setup
from evnlos.types import Events

ABOUT = {"height": 16, "width": 24, "scored_rows": 12, "tau_s": 0.05}
NEVER = lambda: False  # noqa: E731


class Turned:
    """A clock that only `sleep` moves; work takes no time."""

    def __init__(self) -> None:
        self.at, self.sleeps = 100.0, 0

    def now(self) -> float:
        return self.at

    def sleep(self, seconds: float) -> None:
        self.sleeps += 1
        self.at += max(seconds, 0.0)


def stream(count: int, seed: int = 0, span_us: int = 100_000, width: int = 30, height: int = 20) -> Events:
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, span_us, count))
    x, y = draw.integers(0, width, count), draw.integers(0, height, count)
    return Events(t_us, x.astype(np.uint16), y.astype(np.uint16), draw.random(count) < 0.5, width, height)


def weights(modality: str = "event", **about) -> Weights:
    torch.manual_seed(0)
    network = UNetConfig(width=4, depth=1, rank=0).build(modality, Sampling(**ABOUT | about)).eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return Weights(network)


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(weights())


def joined(parts: list[Events]) -> Events:
    columns = (np.concatenate([part.columns()[name] for part in parts]) for name in ("t_us", "x", "y", "p"))
    return Events(*columns, parts[0].width, parts[0].height)


def chunk(events: Events, **more) -> Chunk:
    return Chunk(events, int(events.t_us[-1]) if len(events) else 0, 0.0, 0.0, **more)


# The running surface


@pytest.mark.parametrize("shift_us", [0, -(10**9), 2**40])
def test_the_running_surface_is_the_batch_surface(shift_us: int) -> None:
    draw = np.random.default_rng(1)
    for seed in range(8):
        events = stream(int(draw.integers(1, 600)), seed)
        events = Events(events.t_us + shift_us, events.x, events.y, events.p, 30, 20)
        tau_us = float(draw.uniform(100, 50_000))
        surface, at = RunningSurface(20, 30, tau_us), 0
        before = events.t_us.copy()
        while at < len(events):
            step = int(draw.integers(0, 200))
            surface.add(events[at : at + step])
            at += step
            if at and at % 2:
                now = int(events.t_us[min(at, len(events)) - 1]) + int(draw.integers(0, 30_000))
                expected = time_surface(events[:at], [min(now, int(events.t_us[0])) - 1, now], tau_us)[0]
                np.testing.assert_array_equal(surface.at(now), expected)
        np.testing.assert_array_equal(events.t_us, before)
        now = int(events.t_us[-1])
        np.testing.assert_array_equal(surface.at(now), time_surface(events, [now - 1, now], tau_us)[0])


def test_a_surface_without_events_is_blank_and_time_runs_one_way() -> None:
    surface = RunningSurface(2, 3, 10.0)
    assert not surface.at(5).any()
    surface.add(Events([10], [2], [1], [False], 3, 2))
    assert surface.at(10)[1, 1, 2] == 1
    with pytest.raises(DataError, match="in order"):
        surface.add(Events([9], [0], [0], [True], 3, 2))
    with pytest.raises(DataError, match="ask for a later one"):
        surface.at(9)
    with pytest.raises(DataError, match="one sensor a stream"):
        surface.add(Events.empty(2, 2))
    with pytest.raises(DataError, match="tau_us is 0"):
        RunningSurface(2, 3, 0)


@pytest.mark.parametrize("inside", [(1, 1), (5, 7), (16, 24), (20, 30), (100, 161), (9, 3)])
@pytest.mark.parametrize("outside", [(16, 24), (1, 1), (5, 7), (10, 2)])
def test_the_reduction_is_reduce_by_area(inside: tuple[int, int], outside: tuple[int, int]) -> None:
    maps = np.random.default_rng(0).random((2, *inside), np.float32)
    before = maps.copy()
    np.testing.assert_allclose(AreaReduction(inside, outside)(maps), reduce_by_area(maps, outside), atol=2e-6)
    np.testing.assert_array_equal(maps, before)


# Replay


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_a_replay_goes_at_its_speed(speed: float) -> None:
    clock, events = Turned(), stream(500, 3)
    begun, first = clock.now(), int(events.t_us[0])
    pieces = [events[:120], events[120:121], events[121:]]
    found = []
    for part in Replay(pieces, speed=speed, step_s=0.005, clock=clock).chunks(NEVER):
        found.append(part)
        now_us = first + (clock.now() - begun) * 1e6 * speed
        assert abs(now_us - part.until_us) <= 1
        if len(part.events):
            due = begun + (part.events.t_us[[0, -1]] - first) / 1e6 / speed
            np.testing.assert_allclose([part.first_s, part.last_s], due)
            assert part.events.t_us[-1] <= part.until_us
            assert part.events.t_us[0] > part.until_us - 5000 * speed - 1
    assert joined([part.events for part in found]) == events
    assert clock.now() - begun == pytest.approx(events.duration_us / 1e6 / speed, abs=0.0051)


def test_a_replay_begins_again_when_it_has_ended_or_is_asked_to() -> None:
    clock, events = Turned(), stream(200, 3)
    whole = list(Replay([events], clock=clock).chunks(NEVER))
    twice = Replay(lambda: iter([events]), clock=clock, repeat=True)
    parts = twice.chunks(NEVER)
    found = [next(parts) for _ in range(2 * len(whole))]
    assert [number for number, part in enumerate(found) if part.restart] == [len(whole)]
    assert joined([part.events for part in found[len(whole) :]]) == events
    asked = Replay([events], clock=clock)
    parts = asked.chunks(NEVER)
    next(parts)
    asked.again.set()
    rest = list(parts)  # from the beginning to the end, once
    assert rest[0].restart and joined([part.events for part in rest]) == events
    assert list(Replay([], repeat=True).chunks(NEVER)) == []


def test_frames_are_replayed_at_their_instants_with_all_events_before_them() -> None:
    clock, events = Turned(), stream(400, 4, span_us=50_000)
    frames = [TimedFrame(t, np.full((20, 30), k, np.float32)) for k, t in enumerate((0, 12_345, 80_000))]
    parts = list(Replay([events], frames, step_s=0.004, clock=clock).chunks(NEVER))
    shown = [part for part in parts if part.frame is not None]
    assert [part.until_us for part in shown] == [0, 12_345, 80_000]
    assert [float(part.frame[0, 0]) for part in shown] == [0, 1, 2]
    before = [part.events for part in parts[: parts.index(shown[1]) + 1]]
    assert joined(before) == events[events.t_us <= 12_345]
    assert joined([part.events for part in parts]) == events


def test_a_replay_that_is_told_to_stop_stops_within_a_nap() -> None:
    clock = Turned()
    events = Events([0, 10**9], [0, 0], [0, 0], [True, True], 2, 2)
    source = Replay([events], step_s=1.0, clock=clock)
    assert len(list(source.chunks(lambda: clock.now() > 103.5))) == 3
    assert clock.now() < 103.6
    assert list(Replay([]).chunks(NEVER)) == []
    for wrong in ({"speed": 0}, {"speed": float("nan")}, {"step_s": 0}):
        with pytest.raises(ConfigError):
            Replay([], **wrong)


# A growing file


@pytest.mark.parametrize(
    ("name", "kind"), [("e.raw", "EVT2"), ("e.raw", "EVT21"), ("e.raw", "EVT3"), ("e.csv", "CSV")]
)
def test_pieces_of_any_length_decode_to_what_the_whole_file_holds(name: str, kind: str, tmp_path: Path) -> None:
    events = stream(3000, 5, span_us=40_000_000)
    write_events(tmp_path / name, events, format=kind)
    data = (tmp_path / name).read_bytes()
    tail = open_tail(tmp_path / name)
    assert tail is not None and (tail.height, tail.width) == events.shape
    draw, at, found = np.random.default_rng(6), tail.start, []
    while at < len(data):
        step = int(draw.choice([1, 2, 3, 7, 64, 1000]))
        found.append(tail.feed(data[at : at + step]))
        at += step
    assert joined(found) == read_events(tmp_path / name) == events
    assert tail.faults == 0


@pytest.mark.parametrize("name", ["e.raw", "e.csv"])
def test_a_header_is_waited_for_byte_by_byte(name: str, tmp_path: Path) -> None:
    write_events(tmp_path / name, stream(50, 7))
    data = (tmp_path / name).read_bytes()
    whole = open_tail(tmp_path / name)
    path = tmp_path / f"begun_{name}"
    assert whole is not None and open_tail(path) is None
    for length in range(0, whole.start + 40):
        path.write_bytes(data[:length])
        begun = open_tail(path)
        if begun is not None:
            assert (begun.start, begun.width, begun.height) == (whole.start, 30, 20), length
    assert begun is not None


def test_a_file_is_followed_while_a_thread_appends_to_it(tmp_path: Path) -> None:
    events, path = stream(5000, 8), tmp_path / "growing.raw"
    write_events(tmp_path / "whole.raw", events)
    data = (tmp_path / "whole.raw").read_bytes()
    arrived, more = threading.Event(), iter(range(0, len(data), 1111))

    def write() -> None:
        for at in more:
            with path.open("ab") as file:
                file.write(data[at : at + 1111])
            if at > 2222:
                arrived.wait(5)  # the reader has taken something: it reads while we write
                arrived.clear()

    source = GrowingFile(path, idle_s=2.0)
    writer = threading.Thread(target=write)
    writer.start()
    parts: list[Chunk] = []
    for part in source.chunks(lambda: sum(len(part.events) for part in parts) == len(events)):
        parts.append(part)
        assert part.first_s == part.last_s and part.until_us == part.events.t_us[-1]
        arrived.set()
    writer.join()
    assert joined([part.events for part in parts]) == events
    assert len(parts) > 5 and source.faults() == {"damaged events": 0}


def test_damage_in_a_growing_file_is_counted_and_left_out(tmp_path: Path) -> None:
    path = tmp_path / "e.csv"
    path.write_text(
        "# width=30 height=20\nt_us,x,y,p\n5,1,1,1\n6,90,1,1\nnonsense\n7,0,1,0\n4,1,1,0\n8,2,2,0\n9,3"
    )
    source = GrowingFile(path, idle_s=1.0, clock=Turned())
    (part,) = source.chunks(NEVER)
    assert part.events == Events([5, 7, 8], [1, 0, 2], [1, 1, 2], [True, False, False], 30, 20)
    assert source.faults() == {"damaged events": 3}


def test_what_can_not_be_followed_is_one_line(tmp_path: Path) -> None:
    write_events(tmp_path / "e.npz", stream(5))
    with pytest.raises(EventFileError, match=r"RAW .* can be followed"):
        open_tail(tmp_path / "e.npz")
    (tmp_path / "bare.csv").write_text("t_us,x,y,p\n5,1,1,1\n")
    with pytest.raises(EventFileError, match="--width"):
        open_tail(tmp_path / "bare.csv")
    assert open_tail(tmp_path / "bare.csv", 30, 20) is not None
    with pytest.raises(EventFileError, match="does not exist after"):
        list(GrowingFile(tmp_path / "none.raw", idle_s=1.0, clock=Turned()).chunks(NEVER))
    write_events(tmp_path / "e.raw", stream(5000))
    parts = GrowingFile(tmp_path / "e.raw", idle_s=1.0, clock=Turned()).chunks(NEVER)
    next(parts)
    (tmp_path / "e.raw").write_bytes((tmp_path / "e.raw").read_bytes()[:400])
    with pytest.raises(EventFileError, match="became shorter"):
        list(parts)


# UDP


def test_packets_carry_events_and_nothing_else_passes() -> None:
    for seed in range(20):
        events = stream(seed * 11, seed, width=32_768, height=100)
        found = unpack(pack(Packet(seed, events, seed % 2 == 1)))
        assert (found.sequence, found.events, found.is_last) == (seed, events, seed % 2 == 1)
    assert unpack(pack(Packet(2**32 + 3, events))).sequence == 3
    data = pack(Packet(1, stream(40)))
    draw = np.random.default_rng(0)
    wrong = [data[:n] for n in (0, 3, 20, 23, 24, len(data) - 1)] + [data + b"x", b"EVNL" + b"\xff" * 20]
    for _ in range(300):
        changed = bytearray(data)
        changed[draw.integers(0, len(data))] = draw.integers(0, 256)
        wrong.append(bytes(changed))
    refused = 0
    for damaged in wrong:
        try:
            unpack(damaged)
        except PacketError:
            refused += 1
    assert refused > 60
    for k in range(8):
        with pytest.raises(PacketError):
            unpack(wrong[k])
    body = 24  # of the header; then 4 bytes of time, 2 of the column, 2 of the row and polarity
    for at, field in ((4, b"\x1e\x00"), (6, b"\x14\x00"), (6, b"\x14\x80"), (0, b"\xff\xff\xff\xff")):
        with pytest.raises(PacketError, match="outside its sensor, or with times"):
            unpack(data[: body + at] + field + data[body + at + len(field) :])
    with pytest.raises(DataError, match="at most 8000"):
        pack(Packet(0, stream(8001)))


def test_packets_decoded_together_are_those_decoded_one_by_one() -> None:
    draw = np.random.default_rng(4)
    for seed in range(30):
        datagrams = [pack(Packet(k, stream(int(draw.integers(0, 60)), k), k % 3 == 0)) for k in range(8)]
        for k in draw.integers(0, 8, seed % 9):
            damaged = bytearray(datagrams[k])
            damaged[draw.integers(0, len(damaged))] = draw.integers(0, 256)
            datagrams[k] = bytes(damaged)
        single = []
        for data in datagrams:
            with contextlib.suppress(PacketError):
                single.append(unpack(data))
        batch, malformed = unpack_all(datagrams)
        assert malformed == len(datagrams) - len(single)
        headings = batch.headings if batch else []
        assert [(h.sequence, h.is_last) for h in headings] == [(p.sequence, p.is_last) for p in single]
        for k, packet in enumerate(single):
            assert batch is not None and batch.events(k, k + 1) == packet.events
    assert unpack_all([b"rubbish"]) == (None, 1)


def test_udp_counts_malformed_lost_and_late_packets_and_goes_on() -> None:
    events, source = stream(900, 9), UdpSource(idle_s=5.0)
    parts = [events[at : at + 100] for at in range(0, 900, 100)]
    packets = [pack(Packet(k, part, k == 8)) for k, part in enumerate(parts)]
    foreign = pack(Packet(3, Events([10**6], [0], [0], [True], 31, 20)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        # 3 and 4 are lost at first; 4 comes too late; 2 comes twice.
        for data in (
            *packets[:3],
            b"rubbish",
            foreign,
            *packets[5:7],
            packets[4],
            packets[2],
            b"",
            *packets[7:],
        ):
            sender.sendto(data, ("127.0.0.1", source.port))
    found = joined([part.events for part in source.chunks(NEVER)])
    assert found == joined([*parts[:3], *parts[5:]])
    assert source.faults() == {
        "malformed packets": 3,
        "lost packets": 2,
        "late packets": 2,
        "streams taken up anew": 0,
    }


@pytest.mark.parametrize(
    "forged",
    [
        Packet(1, Events([(1 << 60) - 1], [0], [0], [True], 30, 20)),
        Packet((1 << 31) - 1, Events([0], [0], [0], [True], 30, 20)),
        Packet(1, Events([0], [0], [0], [True], 2048, 2048)),
    ],
    ids=["far time", "far number", "other sensor"],
)
@pytest.mark.parametrize("is_first", [False, True])
def test_one_forged_packet_does_not_stop_a_stream(forged: Packet, is_first: bool) -> None:
    events, source = stream(3000, 12), UdpSource(idle_s=5.0)
    parts = [events[at : at + 10] for at in range(0, 3000, 10)]
    packets = [pack(Packet(k + 2, part, k == 299)) for k, part in enumerate(parts)]
    before = [] if is_first else [pack(Packet(0, Events.empty(30, 20)))]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in (*before, pack(forged), *packets):
            sender.sendto(data, ("127.0.0.1", source.port))
    chunks = list(source.chunks(NEVER))
    found = [chunk for chunk in chunks if chunk.events.shape == (20, 30)]
    taken = sum(len(chunk.events) for chunk in found)
    if forged.events.shape == (2048, 2048) and not is_first:
        assert taken == 3000 and source.faults()["streams taken up anew"] == 0
        return
    assert source.faults()["streams taken up anew"] == 1
    assert 3000 - 10 * 99 <= taken <= 3000 - 10 * 99 + 1
    assert [chunk.restart for chunk in chunks].count(True) == 1 + (not is_first)
    assert joined([chunk.events for chunk in found][-1:])[-5:] == events[-5:]


def test_a_packet_can_not_claim_a_sensor_beyond_memory() -> None:
    header = struct.Struct("<4sBBHIHHq")
    with pytest.raises(PacketError, match="sensor"):
        unpack(header.pack(b"EVNL", 1, 0, 0, 0, 32_768, 32_768, 0))
    assert unpack(header.pack(b"EVNL", 1, 0, 0, 0, 2048, 2048, 0)).events.shape == (2048, 2048)
    with pytest.raises(DataError, match="sensor"):
        pack(Packet(0, Events.empty(2049, 2048)))


def test_a_sender_that_begins_anew_begins_a_new_stream(engine: Engine) -> None:
    source, first, second = UdpSource(idle_s=5.0), stream(300, 10, span_us=10**7), stream(300, 11)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k, events in enumerate((first[:150], first[150:])):
            sender.sendto(pack(Packet(k, events)), ("127.0.0.1", source.port))
    with UdpSender("127.0.0.1", source.port) as again:
        send_timed(again, second, clock=Turned())
    parts = list(source.chunks(NEVER))
    assert [part.restart for part in parts].count(True) == 2
    assert joined([part.events for part in parts][1:]) == second
    picture = engine.see(parts)
    assert picture is not None and picture.t_us == second.t_us[-1]
    with pytest.raises(ConfigError, match="can't be listened at"):
        UdpSource("203.0.113.1", 9)


def test_udp_gives_up_when_nothing_comes_and_a_stream_of_nothing_is_no_image(engine: Engine) -> None:
    source, turns = UdpSource(idle_s=0.06), iter(range(8))
    assert list(source.chunks(lambda: next(turns, None) is None)) == []
    assert next(turns, None) is None  # nobody sent yet: that is no stream which ended
    source = UdpSource(idle_s=0.06)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(pack(Packet(0, Events.empty(30, 20))), ("127.0.0.1", source.port))
    assert len(list(source.chunks(NEVER))) == 1
    source = UdpSource(idle_s=5.0)
    with UdpSender("127.0.0.1", source.port) as sender:
        sender.send(Events.empty(30, 20))
    (part,) = source.chunks(NEVER)
    assert engine.see([part]) is None


# Queue and engine


def test_the_queue_drops_the_oldest_and_counts() -> None:
    events, queue = stream(1000, 12), ChunkQueue(250)
    for at in range(0, 1000, 100):
        queue.put(chunk(events[at : at + 100]))
    queue.put(chunk(Events.empty(30, 20)))
    assert (queue.arrived_events, queue.dropped_events, queue.dropped_chunks) == (1000, 800, 8)
    held = queue.take(0)
    assert joined([part.events for part in held]) == events[800:]
    assert queue.take(0) == [] and not queue.ended
    queue.put(chunk(events))  # more than the bound: the newest is kept
    assert queue.take(0)[0].events == events
    queue.close(DataError("broken"))
    assert queue.ended
    with pytest.raises(DataError, match="broken"):
        queue.take(0)
    with pytest.raises(ConfigError):
        ChunkQueue(0)


def test_a_frame_outlives_its_dropped_chunk() -> None:
    queue, part = ChunkQueue(100), stream(100, 13)
    frame, newer = np.ones((20, 30), np.float32), np.zeros((20, 30), np.float32)
    queue.put(chunk(part, frame=frame, restart=True))
    queue.put(chunk(part))
    (held,) = queue.take(0)
    assert held.frame is frame and held.restart
    queue.put(chunk(part, frame=frame))
    queue.put(chunk(part, frame=newer))
    assert queue.take(0)[0].frame is newer
    queue.put(chunk(part, frame=frame))
    queue.put(chunk(part, restart=True))
    assert queue.take(0)[0].frame is None


@pytest.mark.parametrize("surface", ["sae", "sae-trace"])
@pytest.mark.parametrize("modality", STANDARD_MODALITIES)
def test_at_a_frame_the_live_image_is_the_one_of_reconstruct(
    modality: str, surface: str, tiny_captures
) -> None:
    loaded, capture = weights(modality, surface=surface), read_capture(tiny_captures[0])
    assert ("trace" in loaded.modality.layout) == (surface == "sae-trace" and modality != "frame")
    live = Engine(loaded)
    samples = capture_samples(capture, live.sampling)
    expected = reconstruct(loaded, samples.frame, samples.surface)
    found, events, counted = {}, 0, {}
    for part in capture_replay(tiny_captures[0], speed=10, clock=Turned()).chunks(NEVER):
        picture = live.see([part])
        events += 0 if picture is None else picture.events
        if part.frame is not None and picture is not None:
            found[part.until_us], counted[part.until_us] = picture, events
    assert counted == {t_us: int((capture.events.t_us <= t_us).sum()) for t_us in found}
    for k, t_us in enumerate(capture.frame_times_us[1:]):
        np.testing.assert_allclose(found[int(t_us)].surface, samples.surface[k], atol=1e-6)
        np.testing.assert_allclose(found[int(t_us)].image, expected[k].numpy(), atol=1e-5)


def test_the_engine_tells_how_long_events_waited() -> None:
    clock = Turned()
    live = Engine(weights(), clock)
    events = stream(100, 14)
    assert live.see([Chunk(Events.empty(30, 20), 50, 99.0, 99.0)]).timing.oldest_s != 0  # no event: no latency
    first = Chunk(events[:50], int(events.t_us[49]), 99.9, 99.95)
    second = Chunk(events[50:], int(events.t_us[99]), 99.96, 99.99)
    picture = live.see([first, second])
    times = picture.timing
    assert (times.oldest_s, times.newest_s, times.wait_s) == pytest.approx((0.1, 0.01, 0.1))
    assert picture.events == 100 and picture.number == 1 and picture.image.shape == (16, 24)
    assert 0 <= picture.image.min() <= picture.image.max() <= 1


def test_weights_that_do_not_fit_are_one_line(tmp_path: Path) -> None:
    source = Replay([stream(10)], name="walk.raw")
    with pytest.raises(DataError, match=r"'fusion' see frames and walk\.raw has none; .* modality 'event'"):
        Run(source, Engine(weights("fusion")))
    with pytest.raises(ConfigError, match="makes 'sae'"):
        Engine(weights(surface="context"))
    for wrong in ({"rate": 0}, {"queue_events": 0}, {"seconds": -1.0}):
        with pytest.raises(ConfigError):
            RateOptions(**wrong)


# Runs


class Kept:
    """A sink that keeps all images."""

    def __init__(self) -> None:
        self.pictures: list[Picture] = []

    def show(self, picture: Picture) -> None:
        self.pictures.append(picture)


def test_a_run_makes_the_last_image_of_all_events(engine: Engine) -> None:
    events, kept = stream(2000, 15, span_us=200_000), Kept()
    run = Run(Replay([events], speed=2), engine, RateOptions(rate=200))
    summary = run.go([kept]).summary()
    last = kept.pictures[-1]
    surface = RunningSurface(20, 30, 50_000)
    surface.add(events)
    np.testing.assert_allclose(last.surface, reduce_by_area(surface.at(last.t_us), (16, 24)), atol=1e-6)
    assert summary["events"] == 2000 and summary["dropped"] == {"events": 0, "chunks": 0}
    assert summary["images"] == len(kept.pictures) > 0
    spread = summary["latency_ms"]["oldest_event"]
    assert 0 < spread["p50"] <= spread["p90"] <= spread["p99"] <= spread["max"]
    text = latency_table(summary)
    assert "2,000 events" in text and f"{spread['p50']:9.1f}" in text
    assert run.statistics.now()["images"] == summary["images"]


def test_drops_and_the_error_of_a_source_reach_the_user(engine: Engine) -> None:
    class Flood:
        name, has_frames, waits = "flood", False, False

        def chunks(self, stop):
            events = stream(1000, 16)
            for at in range(0, 1000, 100):
                yield chunk(events[at : at + 100])
            raise EventFileError("the cable is out")

        def faults(self):
            return {"lost packets": 7}

        def close(self):
            pass

    kept = Kept()
    run = Run(Flood(), Slow(engine), RateOptions(rate=1000, queue_events=100))
    with pytest.raises(EventFileError, match="cable"):
        run.go([kept])
    summary = run.statistics.summary()
    assert summary["dropped"]["events"] == 1000 - summary["events"] > 0
    text = latency_table(summary)
    assert f"dropped by the queue: {summary['dropped']['events']:,} events" in text and "7 lost packets" in text


class Slow:
    """An engine that waits until nothing more comes."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.begin, self.needs_frames = engine.begin, engine.needs_frames

    def see(self, chunks):
        for thread in threading.enumerate():
            if thread.name == "source":
                thread.join(5)
        return self._engine.see(chunks)


@pytest.fixture(scope="module")
def event_weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "event.safetensors"
    save_weights(path, weights())
    return path


def recorded(folder: Path, capsys) -> dict:
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    table = json.loads((folder / "latency.json").read_text())
    assert printed == table | {"out": str(folder)}
    assert sorted(p.name for p in folder.iterdir()) == [".lock", "latency.json", f"video.{video_kind()}"]
    return table


def video_kind() -> str:
    return "mp4" if find_spec("av") else "png"


def test_headless_writes_video_and_table(event_weights: Path, tmp_path: Path, capsys) -> None:
    write_events(tmp_path / "walk.raw", stream(3000, 17, span_us=600_000))
    out = tmp_path / "out"
    call = [
        "live",
        str(tmp_path / "walk.raw"),
        "--weights",
        str(event_weights),
        "--headless",
        "--out",
        str(out),
    ]
    main([*call, "--speed", "2", "--rate", "40", "--json"])
    table = recorded(out, capsys)
    assert table["events"] == 3000 and table["modality"] == "event"
    assert (
        table["verdict"]["wall"] == "" and "single time steps" in table["verdict"]["recording"]
    )  # no setup known
    assert 0 < table["recorded"] + table["not_recorded"] <= table["images"]
    assert table["latency_ms"]["network"]["p50"] > 0
    if video_kind() == "mp4":
        import av

        with av.open(str(out / "video.mp4")) as container:
            frames = list(container.decode(video=0))
        assert len(frames) == table["recorded"]
        assert frames[0].width == 2 * 24 * 16 + 8 and frames[0].height == 256
        times_s = [float(frame.pts * frame.time_base) for frame in frames]
        assert times_s[0] == 0 and all(b - a > 0.03 for a, b in pairwise(times_s))
    with pytest.raises(SystemExit) as stop:
        main(call)
    assert stop.value.code == 2 and "not an empty folder" in capsys.readouterr().err


def test_without_pyav_the_video_is_an_animated_png(engine: Engine, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setattr(record, "_MOST_ANIMATED", 4)
    events = stream(600, 18)
    with record.Recorder(tmp_path / "out") as recorder:
        for k in range(6):
            part = events[100 * k : 100 * k + 100]
            shown = engine.see([chunk(part, restart=k == 0)])
            recorder.show(replace(shown, made_s=7.0 + 0.05 * k))
            recorder.show(replace(shown, made_s=7.01 + 0.05 * k))  # too soon for a video
    assert (recorder.recorded, recorder.left_out) == (4, 2)
    with Image.open(tmp_path / "out" / "video.png") as animation:
        assert animation.n_frames == 4 and animation.size == (2 * 24 * 16 + 8, 256)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [".lock", "video.png"]
    with pytest.raises(DataError, match="not an empty folder"):
        record.Recorder(tmp_path / "out")


def test_a_capture_is_replayed_with_its_frames(tiny_captures, tmp_path: Path, capsys) -> None:
    save_weights(tmp_path / "f.safetensors", weights("fusion"))
    out = tmp_path / "out"
    call = ["live", str(tiny_captures[0]), "--weights", str(tmp_path / "f.safetensors"), "--headless", "--json"]
    main([*call, "--out", str(out), "--speed", "20", "--rate", "30"])
    table = recorded(out, capsys)
    assert table["modality"] == "fusion" and table["images"] > 0
    assert table["events"] <= len(read_capture(tiny_captures[0]).events)


def test_without_weights_published_ones_of_single_positions_are_taken(
    tiny_captures, tmp_path: Path, capsys
) -> None:
    write_events(tmp_path / "walk.raw", stream(500, 21, span_us=100_000))
    for source, name in ((tiny_captures[0], "near-frame"), (tmp_path / "walk.raw", "near-event")):
        out = tmp_path / name
        main(["live", str(source), "--headless", "--out", str(out), "--speed", "20", "--seconds", "5"])
        assert f"{name} makes the images" in capsys.readouterr().err
        table = json.loads((out / "latency.json").read_text())
        assert table["weights"] == name and table["modality"] == name.partition("-")[2] and table["images"] > 0
        wall = verdict_on(load_setup(published_setup(name)), None, is_stated=False).wall
        assert wall and table["verdict"]["wall"] == wall  # what `reconstruct` says of the same setup
    with pytest.raises(SystemExit) as stop:
        main(["live", str(tmp_path / "walk.raw"), "--weights", "near-event-sequence", "--headless"])
    assert stop.value.code == 2 and "near-event or near-frame, which come with" in capsys.readouterr().err


def test_the_image_of_all_so_far_stands_beside_a_replay(tiny_captures, tmp_path: Path, capsys) -> None:
    sampling, folder = Sampling(**ABOUT), str(tiny_captures[0])
    network = SequenceConfig(width=4, depth=1, rank=4).build("frame", sampling).eval()
    save_weights(tmp_path / "all.safetensors", Weights(network))
    save_weights(tmp_path / "one.safetensors", weights("frame"))
    both = ["--weights", str(tmp_path / "one.safetensors"), "--so-far", str(tmp_path / "all.safetensors")]
    call = ["live", folder, *both, "--headless", "--json", "--speed", "20"]
    main([*call, "--out", str(tmp_path / "out")])
    table = recorded(tmp_path / "out", capsys)
    assert table["beside"]["images"] >= 1 and table["images"] > 0
    capture, beside = read_capture(folder), so_far_of(tmp_path / "all.safetensors", open_live(folder))
    samples = capture_samples(capture, sampling)
    beside.begin()
    for part in capture_replay(folder, speed=10, clock=Turned()).chunks(NEVER):
        beside.add([part])
    beside.finish()
    beside.close()
    seen = network.modality.inputs(samples.frame, samples.surface)
    expected = network.infer(seen, samples.position_m, so_far=True)[-1].numpy()
    np.testing.assert_allclose(beside.newest.image, expected, atol=1e-5)
    assert beside.newest.t_us == capture.frame_times_us[-1]
    picture = Engine(weights("frame")).see([chunk(stream(9), frame=np.ones((20, 30)))])
    assert picture is not None
    names = list(record.panels(replace(picture, beside=beside.newest)))
    assert names == [*record.panels(picture), "of all so far"]


def test_an_image_of_all_so_far_knows_what_it_needs(tiny_captures, tmp_path: Path) -> None:
    save_weights(tmp_path / "one.safetensors", weights("frame"))
    with pytest.raises(DataError, match="give weights of whole sequences"):
        so_far_of(tmp_path / "one.safetensors", open_live(str(tiny_captures[0])))
    write_events(tmp_path / "walk.raw", stream(500, 21))
    with pytest.raises(ConfigError, match="has to know the motion"):
        so_far_of("near-event-sequence", open_live(str(tmp_path / "walk.raw")))
    folder = tmp_path / "still"
    shutil.copytree(tiny_captures[0], folder)
    about = read_yaml(folder / "capture.yaml")
    save_yaml({key: value for key, value in about.items() if key != "motion"}, folder / "capture.yaml")
    with pytest.raises(DataError, match="states no motion"):
        so_far_of("near-event-sequence", open_live(str(folder)))


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with record.Recorder(tmp_path / "out"), pytest.raises(DataError, match="another process is at work"):
        record.Recorder(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".draft.tmp").write_text("mine")
    with pytest.raises(DataError, match="not an empty folder"):
        record.Recorder(tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".draft.tmp"]


@pytest.mark.parametrize("has_pyav", [True, False])
def test_a_video_on_a_full_disk_is_one_line_and_nothing_is_left(
    has_pyav: bool, engine: Engine, tmp_path: Path, monkeypatch
) -> None:
    from crash import small_disk

    if has_pyav:
        pytest.importorskip("av")
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    place, events = tmp_path / "small", stream(600, 18)
    place.mkdir()
    with small_disk(place, 4096) as is_small:
        if not is_small:
            pytest.skip("mounting a small tmpfs needs root")
        with (
            pytest.raises(DataError, match="could not be written") as caught,
            record.Recorder(place / "out") as to,
        ):
            for k in range(6):
                shown = engine.see([chunk(events[100 * k : 100 * k + 100], restart=k == 0)])
                to.show(replace(shown, made_s=7.0 + 0.05 * k))
        assert "No space left" in str(caught.value) and "\n" not in str(caught.value)
        assert list(place.iterdir()) == []


def test_a_run_without_an_image_leaves_no_folder(engine: Engine, tmp_path: Path) -> None:
    write_events(tmp_path / "e.npz", stream(5))
    with pytest.raises(EventFileError, match="followed"), record.Recorder(tmp_path / "new" / "out") as recorder:
        Run(open_live(str(tmp_path / "e.npz"), SourceOptions(follow=True)), engine).go([recorder])
    assert not (tmp_path / "new" / "out").exists()


def test_wrong_sources_are_one_line(event_weights: Path, tmp_path: Path, capsys) -> None:
    for source, more, words in (
        ("udp://127.0.0.1", [], "udp://127.0.0.1:7000"),
        ("udp://127.0.0.1:99999", [], "udp://127.0.0.1:7000"),
        (str(tmp_path / "none.raw"), [], "no such file"),
        (str(tmp_path), [], "capture.yaml"),
        (str(tmp_path), ["--follow"], "is a folder"),
        (str(tmp_path / "none.raw"), ["--width", "3"], "both or neither"),
        (str(tmp_path / "none.raw"), ["--idle", "-1"], "idle"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(
                [
                    "live",
                    source,
                    "--weights",
                    str(event_weights),
                    "--headless",
                    "--out",
                    str(tmp_path / "o"),
                    *more,
                ]
            )
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("evnlos")]
        assert stop.value.code == 2 and len(lines) == 1 and words in lines[0], (source, lines)
    assert not (tmp_path / "o").exists()
    source = open_live("udp://127.0.0.1:0", SourceOptions(idle=0))
    assert isinstance(source, UdpSource)
    source.close()


# The page


@pytest.fixture
def page(engine: Engine):
    statistics = RunStatistics(Replay([]), ChunkQueue(10))
    with Page(statistics.now, title="walk.raw, event") as shown:
        yield shown


def get(url: str, **headers: str):
    return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10)


def test_the_page_asks_nobody_else(page: Page) -> None:
    with get(page.url) as answer:
        text, policy = answer.read().decode(), answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "http" not in policy
    assert not re.findall(r"https?:|//[a-z]|@import|<script src|<link rel=.style", text)
    with get(page.url + "state.json") as answer:
        state = json.load(answer)
    assert state["title"] == "walk.raw, event" and state["images"] == 0 and not state["ended"]
    assert not page.seen.is_set()
    assert page.url.startswith("http://127.0.0.1:")


def test_other_hosts_and_addresses_are_refused(page: Page) -> None:
    for url, headers, code in ((page.url, {"Host": "evil.example"}, 403), (page.url + "x", {}, 404)):
        with pytest.raises(urllib.error.HTTPError) as stop:
            get(url, **headers)
        assert stop.value.code == code
        stop.value.close()
    with pytest.raises(ConfigError, match="can't be used"):
        Page(dict, page.port)


def test_a_replay_begins_again_for_a_page_of_this_machine_only(page: Page) -> None:
    def ask(shown: Page, **headers: str) -> int:
        request = urllib.request.Request(shown.url + "again", method="POST", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            error.close()
            return error.code

    assert ask(page) == 404  # a camera's
    again = threading.Event()
    with Page(RunStatistics(Replay([]), ChunkQueue(10)).now, again=again) as shown:
        home = shown.url.removesuffix("/")
        assert ask(shown, Origin="http://evil.example") == ask(shown, Host="evil.example") == 403
        assert not again.is_set()
        assert ask(shown, Origin=home) == 200 and again.is_set()


def test_the_page_of_a_replay_on_a_phone(engine: Engine, tmp_path: Path) -> None:
    if chromium.missing():
        pytest.skip(f"{chromium.missing()}: apt-get install chromium chromium-driver")
    again, image = threading.Event(), np.zeros((16, 24), np.float32)
    status = RunStatistics(Replay([]), ChunkQueue(10)).now
    title = "walk.raw, event"
    with (
        Page(lambda: status() | {"verdict": ["nothing is certain"]}, title=title, again=again) as page,
        chromium.Chromium(tmp_path / "profile") as browser,
    ):
        browser.devtools(
            "Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True
        )
        browser.open(page.url)
        told = "return document.querySelector('[role=status]').textContent"
        browser.wait(f"{told}.includes('waiting for its first events')")
        page.show(
            Picture(3, 1_500_000, 0.0, image, np.zeros((2, 16, 24), np.float32), image, 5, Timing(*[0.01] * 5))
        )
        browser.wait("return document.querySelectorAll('img').length === 3")
        assert browser.run("return document.documentElement.scrollWidth") <= 390
        assert browser.run(
            "return [...document.images].every(one => one.alt && one.getBoundingClientRect().right <= 390)"
        )
        browser.wait("return document.querySelector('#verdict').textContent === 'nothing is certain'")
        # By keys: hold the image, and then from the beginning.
        browser.press("\ue004 ")
        browser.wait("return document.querySelector('#hold').getAttribute('aria-pressed') === 'true'")
        browser.press("\ue004 ")
        assert again.wait(10)
        assert [one for one in browser.complaints() if "SEVERE" in one] == []


def test_the_stream_brings_each_new_image_and_the_end(page: Page, engine: Engine) -> None:
    image = np.linspace(0, 1, 16 * 24, dtype=np.float32).reshape(16, 24)
    timing = Timing(0.0214, 0.01, 0.01, 0.001, 0.01)
    nan = Timing(*[float("nan")] * 5)

    def messages(answer):
        while True:
            kind, data, _ = answer.readline(), answer.readline(), answer.readline()
            yield kind.decode().split()[1], json.loads(data.decode().removeprefix("data: "))

    page.show(Picture(3, 1_500_000, 0.0, image, np.zeros((2, 16, 24), np.float32), None, 5, timing))
    with get(page.url + "stream") as answer:
        assert answer.headers["Content-Type"] == "text/event-stream"
        heard = messages(answer)
        kind, shown = next(heard)
        assert (kind, shown["number"], shown["t_s"], shown["latency_ms"]) == ("image", 3, 1.5, 21.4)
        assert list(shown["panels"]) == ["events", "reconstruction"]
        with urllib.request.urlopen(shown["panels"]["reconstruction"]) as data:
            picture = np.asarray(Image.open(io.BytesIO(data.read())))
        np.testing.assert_array_equal(picture, np.round(255 * image).astype(np.uint8))
        assert next(heard)[0] == "state"
        page.wait_for_viewer(NEVER)
        page.show(Picture(4, 1_600_000, 0.0, image, np.zeros((2, 16, 24), np.float32), image, 0, nan))
        kind, shown = next(heard)
        assert (kind, shown["number"], shown["latency_ms"]) == ("image", 4, None)
        assert list(shown["panels"]) == ["wall", "events", "reconstruction"]
        threading.Thread(target=page.__exit__).start()
        while not (message := next(heard))[1].get("ended"):
            pass
        assert message[0] == "state"


def test_a_ninth_viewer_is_told_and_silent_ones_are_let_go(engine: Engine, monkeypatch, capfd) -> None:
    monkeypatch.setattr("evnlos.live.display._SILENT_S", 0.5)
    with Page(RunStatistics(Replay([]), ChunkQueue(10)).now) as page, contextlib.ExitStack() as open_ones:
        silent = open_ones.enter_context(socket.create_connection(("127.0.0.1", page.port), timeout=10))
        for _ in range(8):
            open_ones.enter_context(get(page.url + "stream"))
        with pytest.raises(urllib.error.HTTPError) as stop:
            get(page.url + "stream")
        assert stop.value.code == 503
        stop.value.close()
        assert silent.recv(1) == b""  # its time was up
        silent.close()
        leaver = socket.create_connection(("127.0.0.1", page.port))
        leaver.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        leaver.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        leaver.close()
    assert "Traceback" not in capfd.readouterr().err


def test_a_run_with_a_page_shows_its_images(event_weights: Path, tmp_path: Path, capsys) -> None:
    write_events(tmp_path / "walk.raw", stream(800, 19, span_us=100_000))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    seen: list[bytes] = []

    def look() -> None:
        for _ in range(100):
            try:
                with get(f"http://127.0.0.1:{port}/stream") as answer:
                    seen.extend(answer.readlines())
                return
            except (OSError, EvnlosError):
                threading.Event().wait(0.05)

    viewer = threading.Thread(target=look)
    viewer.start()
    main(["live", str(tmp_path / "walk.raw"), "--weights", str(event_weights), "--port", str(port)])
    viewer.join(10)
    assert sum(line.startswith(b"event: image") for line in seen) >= 1
    assert b'"ended": true' in seen[-2]
    shown = capsys.readouterr()
    assert f"http://127.0.0.1:{port}/" in shown.err and "oldest new event to image" in shown.out
    state = json.loads(
        next(line for line in reversed(seen) if b'"ended": true' in line).removeprefix(b"data: ")
    )
    assert len(state["verdict"]) == 2 and all(line in shown.out for line in state["verdict"])
