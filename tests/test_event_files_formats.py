"""Formats of single makers, word by word and line by line, and the recordings that have a known truth."""

import struct

import numpy as np
import pytest

from evnlos.errors import ConfigError, DataError, EventFileError
from evnlos.events import (
    CelexOptions,
    read_events,
    read_events_report,
    read_frames,
    write_celex_frames,
    write_events,
)
from evnlos.types import Events

# ---------------------------------------------------------------- Prophesee EVT2.1 and DAT


def evt21_words(swapped: bool) -> bytes:
    words = [
        (0x8000_0002, 0),
        (0x1000_0000 | (5 << 22) | (32 << 11) | 7, 0b1001),
        ((6 << 22) | (64 << 11) | 8, 1),
    ]
    return b"".join(
        struct.pack("<II", high, low) if swapped else struct.pack("<II", low, high) for high, low in words
    )


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("stated", [False, True])
def test_evt21_in_both_word_orders(swapped, stated, tmp_path):
    order = f";endianness={'legacy' if swapped else 'little'}" if stated else ""
    path = tmp_path / "a.raw"
    path.write_bytes(f"% evt 2.1\n% format EVT21{order};width=128;height=16\n".encode() + evt21_words(swapped))
    assert read_events(path) == Events(
        [133, 133, 134], [32, 35, 64], [7, 7, 8], [True, True, False], width=128, height=16
    )


def dat_bytes(times: list[int], x: list[int], y: list[int], p: list[int], header: str = "") -> bytes:
    text = header or "% Data file containing CD events\n% Version 2\n% Width 640\n% Height 480\n"
    rows = zip(times, x, y, p, strict=True)
    return text.encode() + bytes([12, 8]) + b"".join(
        struct.pack("<II", t, column | row << 14 | sign << 28) for t, column, row, sign in rows
    )  # fmt: skip


def test_dat_by_hand(tmp_path):
    path = tmp_path / "a.dat"
    path.write_bytes(dat_bytes([5, 2**32 - 1, 3], [0, 639, 1], [479, 0, 2], [0, 1, 1]))
    events = Events([5, 2**32 - 1, 2**32 + 3], [0, 639, 1], [479, 0, 2], [0, 1, 1], width=640, height=480)
    assert read_events(path) == events
    with pytest.raises(EventFileError, match="DAT"):
        write_events(tmp_path / "b.dat", events, format="DAT")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (dat_bytes([5, 4], [0, 0], [0, 0], [0, 0]), "earlier"),
        (dat_bytes([5], [640], [0], [0]), "sensor is 640 x 480"),
        (dat_bytes([5], [0], [0], [2]), "unknown word type 0x2"),
        (dat_bytes([5, 6], [0, 0], [0, 0], [0, 0])[:-3], "5 bytes into a word"),
        (dat_bytes([], [], [], [])[:-1], "ends after its header"),
        (dat_bytes([], [], [], []).replace(b"Version 2", b"Version 1"), "version 1"),
        (dat_bytes([], [], [], [])[:-2] + bytes([14, 8]), "type 14"),
    ],
)
def test_damaged_dat(data, said, tmp_path):
    path = tmp_path / "a.dat"
    path.write_bytes(data)
    with pytest.raises(EventFileError, match=said):
        read_events(path)


# ---------------------------------------------------------------- CeleX-V

RECORDINGS = [("blob_EI_100M", 100), ("random_EO_70M", 140)]


@pytest.mark.parametrize(("name", "divisor"), RECORDINGS)
def test_celex_recordings_equal_their_truth(shared_data, name, divisor):
    truth = np.load(shared_data / "celex" / f"{name}.npz")
    events, report = read_events_report(shared_data / "celex" / f"{name}.bin", "strict")
    np.testing.assert_array_equal(events.x, truth["x"])
    np.testing.assert_array_equal(events.y, truth["y"])
    np.testing.assert_array_equal(events.t_us, np.rint(truth["ticks"] * 1024 / divisor))
    assert events.polarity_known is not None and report.skipped == 0
    if "adc" not in truth:
        assert events.adc is None and not events.polarity_known.any() and not events.p.any()
        return
    np.testing.assert_array_equal(events.adc, truth["adc"])
    last: dict[tuple[int, int], int] = {}
    for index, (x, y, adc) in enumerate(zip(events.x, events.y, truth["adc"].tolist(), strict=True)):
        before = last.get((int(x), int(y)), adc)
        assert bool(events.polarity_known[index]) == (adc != before)
        assert bool(events.p[index]) == (adc > before)
        last[int(x), int(y)] = adc


def test_celex_images_equal_their_truth(shared_data, tmp_path):
    path = shared_data / "celex" / "blob_F_100M.bin"
    truth = np.load(shared_data / "celex" / "blob_F_100M.npz")["frames"]
    np.testing.assert_array_equal(read_frames(path), truth)
    deep = read_frames(path, bits=12)
    np.testing.assert_array_equal(deep >> 4, truth)
    pattern = np.arange(800 * 1280).reshape(800, 1280) % 40
    np.savetxt(tmp_path / "fpn.txt", pattern, fmt="%d")
    corrected = np.clip(truth.astype(int) - pattern, 0, 255)
    np.testing.assert_array_equal(read_frames(path, fpn=pattern), corrected)
    np.testing.assert_array_equal(read_frames(path, fpn=tmp_path / "fpn.txt"), corrected)
    with pytest.raises(DataError, match="pixels"):
        read_frames(path, fpn=np.zeros(5))
    with pytest.raises(EventFileError, match="read_frames"):
        read_events(path)
    with pytest.raises(EventFileError, match="read_events"):
        read_frames(shared_data / "celex" / "blob_EI_100M.bin")


def test_celex_images_and_events_register(shared_data):
    """The same blob, once in images and once in events, moves to the right in both: neither is turned."""
    frames = read_frames(shared_data / "celex" / "blob_F_100M.bin").astype(float)
    columns = np.arange(1280)
    bright = [
        (np.maximum(frame - 200, 0).sum(0) * columns).sum() / np.maximum(frame - 200, 0).sum()
        for frame in frames
    ]
    events = read_events(shared_data / "celex" / "blob_EI_100M.bin")
    third = len(events) // 3
    assert bright[1] > bright[0] + 50
    assert events.x[-third:].mean() > events.x[:third].mean() + 50


def celex_events(adc: bool, clock_divisor: int = 100, span_ticks: int = 400_000, count: int = 3000) -> Events:
    """Return events at whole ticks, at most a few to a row, so that files give them back exactly."""
    draw = np.random.default_rng(4)
    ticks = np.sort(draw.integers(0, span_ticks, count))
    ticks -= ticks[0]
    values = draw.integers(0, 4096, count) if adc else None
    x, y = draw.integers(0, 1280, count), draw.integers(0, 800, count)
    t_us = np.rint(ticks * 1024 / clock_divisor).astype(np.int64)
    return Events(t_us, x, y, np.zeros(count, bool), width=1280, height=800, adc=values)


@pytest.mark.parametrize("adc", [True, False])
@pytest.mark.parametrize(("clock", "divisor"), [(100, 100), (70, 140), (30, 90), (10, 80)])
def test_celex_writer_round_trip(adc, clock, divisor, tmp_path):
    events = celex_events(adc, divisor)
    path = tmp_path / f"synthetic_{'EI' if adc else 'EO'}_{clock}M.bin"
    write_events(path, events)
    back = read_events(path)
    for name in ("t_us", "x", "y", "adc"):
        np.testing.assert_array_equal(getattr(back, name), getattr(events, name))
    path.rename(tmp_path / "renamed.bin")
    with pytest.raises(EventFileError, match="clock_mhz"):
        read_events(tmp_path / "renamed.bin")
    assert read_events(tmp_path / "renamed.bin", celex=CelexOptions(clock_mhz=clock)) == back


def test_celex_format_0_by_hand(tmp_path):
    row, stamp, column, adc = 700, 4090, 1111, 200
    groups = [
        ((stamp >> 2) & 0xFF, row >> 2, ((row & 3) << 6) | ((stamp >> 6) & 0x30) | ((stamp & 3) << 2) | 2)
    ]
    groups += [((column & 0x7F) << 1, adc, ((column >> 3) & 0xF0) | 1)]
    stamp = 2  # the clock of 12 bits has turned: 8 ticks later
    groups += [((stamp >> 2) & 0xFF, row >> 2, ((row & 3) << 6) | ((stamp & 3) << 2) | 2), groups[1]]
    payload = b"".join(map(bytes, groups)) + b"\1"
    path = tmp_path / "old_EI_100M.bin"
    path.write_bytes(
        struct.pack("<8BI", 0, 2, 255, 255, 0, 1, 2, 3, 1) + struct.pack("<I", len(payload)) + payload
    )
    events = read_events(path)
    assert (events.x.tolist(), events.y.tolist(), events.t_us.tolist()) == ([column] * 2, [row] * 2, [0, 82])
    assert events.adc is not None and events.adc.tolist() == [adc, adc]
    assert events.polarity_known is not None and not events.polarity_known.any()


def celex_file(tmp_path, loop: bool = False, imu: int | None = None, packages: int | None = None):
    """Return a path and its bytes: two packages of events, an image between them in loop mode."""
    write_events(tmp_path / "e_EI_100M.bin", celex_events(True))
    data = (tmp_path / "e_EI_100M.bin").read_bytes()
    package = data[12:]
    tail = b"" if imu is None else struct.pack("<qI", 77, imu) + bytes(32 * imu)
    picture = struct.pack("<I", 1_536_001) + bytes(1_536_000) + b"\0" + tail
    body = package + tail + (picture if loop else b"")
    count = 1 + loop if packages is None else packages
    kind = (1 if loop else 0) | (2 if imu is not None else 0)
    return tmp_path / "e_EI_100M.bin", struct.pack("<8BI", kind, 2, 3, 255, 1, 0, 0, 0, count) + body


def test_celex_loop_and_imu(tmp_path):
    path, data = celex_file(tmp_path, loop=True, imu=3)
    truth = read_events(path)
    path.write_bytes(data)
    assert read_events(path) == truth
    frames = read_frames(path)
    assert frames.shape == (1, 800, 1280) and (frames == 255).all()


def test_celex_after_a_crash(tmp_path):
    path, data = celex_file(tmp_path)
    truth = read_events(path)
    path.write_bytes(bytes([0xEE] * 12) + data[12:])
    with pytest.raises(EventFileError):
        read_events(path)
    assert read_events(path, celex=CelexOptions(event_format=1, has_imu=False)) == truth
    path.write_bytes(celex_file(tmp_path, packages=0)[1])  # a count that was never written announces nothing
    assert read_events(path) == truth


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: data[:-1], "are left"),
        (lambda data: data + b"\1", "are left"),
        (lambda data: data[:8] + struct.pack("<I", 9) + data[12:], "announces 9"),
        (lambda data: data[:12] + struct.pack("<I", 2**31) + data[16:], "no known"),
        (lambda data: data[:-1] + b"\0", "full image of"),
        (lambda data: data[:2000] + np.random.default_rng(0).bytes(3000) + data[5000:], "word|outside"),
    ],
)
def test_celex_damage(damage, said, tmp_path):
    path, data = celex_file(tmp_path)
    path.write_bytes(damage(data))
    with pytest.raises(EventFileError, match=said) as raised:
        read_events(path)
    assert "\n" not in str(raised.value) and "byte" in str(raised.value)


def test_celex_random_payload_and_lying_imu_count(tmp_path):
    for event_format in (0, 1, 2):
        path = tmp_path / "n_EI_100M.bin"
        head = struct.pack("<8BI", 0, 2, 255, 255, event_format, 0, 0, 0, 1) + struct.pack("<I", 357_001)
        path.write_bytes(head + np.random.default_rng(event_format).bytes(357_000) + b"\1")
        with pytest.raises(EventFileError):
            read_events(path)
        events, report = read_events_report(path)
        assert len(events) and not report.clean
        Events(events.t_us, events.x, events.y, events.p, 1280, 800)
    path, data = celex_file(tmp_path, imu=0)
    path.write_bytes(data[:-4] + struct.pack("<I", 2**32 - 1))
    with pytest.raises(EventFileError, match="IMU"):
        read_events(path)


def test_celex_refusals(tmp_path):
    with pytest.raises(EventFileError, match="_100M"):
        write_events(tmp_path / "a.bin", celex_events(True))
    with pytest.raises(DataError, match="1280 x 800"):
        write_events(tmp_path / "a_EI_100M.bin", Events.empty(640, 480))
    with pytest.raises(ConfigError, match="clock_mhz"):
        CelexOptions(clock_mhz=55)
    with pytest.raises(DataError):
        write_celex_frames(tmp_path / "f.bin", np.zeros((1, 2, 2), np.uint8))
    with pytest.raises(EventFileError, match="no known event format"):
        path = tmp_path / "n.h5"
        path.write_bytes(b"hello")
        read_frames(path)


def test_celex_images_round_trip(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (2, 800, 1280)).astype(np.uint8)
    write_celex_frames(tmp_path / "p_F_100M.bin", frames)
    np.testing.assert_array_equal(read_frames(tmp_path / "p_F_100M.bin"), frames)


# ---------------------------------------------------------------- text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("t,x,y,p\n1,2,3,1\n5,0,0,0\n", Events([1, 5], [2, 0], [3, 0], [1, 0], width=3, height=4)),
        ("x y polarity timestamp\r\n2 3 -1 1\r\n\r\n0 0 1 5\r\n", Events([1, 5], [2, 0], [3, 0], [0, 1], 3, 4)),
        ("%geometry:8,6\n2,3,1,1\n0,0,0,5\n", Events([1, 5], [2, 0], [3, 0], [1, 0], width=8, height=6)),
        ("0.0000014 2 3 1\n12.5 0 0 0\n", Events([1, 12_500_000], [2, 0], [3, 0], [1, 0], width=3, height=4)),
        ("7,2,3,1\n9,0,0,0", Events([7, 9], [2, 0], [3, 0], [1, 0], width=3, height=4)),
    ],
)
def test_text_of_other_programs(text, expected, tmp_path):
    (tmp_path / "a.csv").write_bytes(text.encode())
    assert read_events(tmp_path / "a.csv") == expected


def test_celex_exports(tmp_path):
    path = tmp_path / "export_EI_100M.csv"
    path.write_text("799,1279,4000,1,10\n5,6,100,-1,20\n5,6,100,0,30\n")
    events = read_events(path)
    assert (
        events.shape == (800, 1280)
        and events.y.tolist() == [799, 5, 5]
        and events.t_us.tolist() == [10, 20, 30]
    )
    assert events.p.tolist() == [True, False, False]
    assert events.adc is not None and events.adc.tolist() == [4000, 100, 100]
    assert events.polarity_known is not None and events.polarity_known.tolist() == [True, True, False]
    path.write_text("5,6,10\n7,8,20\n")
    assert read_events(path).polarity_known.tolist() == [False, False]  # type: ignore[union-attr]
    path.write_text("5,6,900,10\n7,8,901,20\n")
    assert read_events(path).t_us.tolist() == [10, 20]
    ticks = CelexOptions(csv_in_ticks=True)
    assert read_events(path, celex=ticks).t_us.tolist() == [102, 205]


@pytest.mark.parametrize(("clock", "turn_us"), [(100, 42_949_673), (70, 30_678_338)])
def test_celex_exports_that_turned_over(clock, turn_us, tmp_path):
    path = tmp_path / f"export_EO_{clock}M.csv"
    path.write_text(f"1,1,5\n1,1,{turn_us - 9}\n1,1,4\n1,1,{turn_us - 5}\n1,1,6\n")
    times = read_events(path).t_us
    np.testing.assert_allclose(times, [5, turn_us - 9, turn_us + 4, 2 * turn_us - 5, 2 * turn_us + 6], atol=1)
    path.rename(tmp_path / "export.csv")
    with pytest.raises(EventFileError, match="clock_mhz"):
        read_events(tmp_path / "export.csv")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,x,y,p\n1,2,3\n", "line"),
        ("t,x,y,p\n1,2,3,1,5\n", "line"),
        ("t,x,y,p\n1,two,3,1\n", "line"),
        ("t,x,y,p\n1,2,3,7\n", "p = 7"),
        ("t,x,y,p\n1,-2,3,1\n", "x = -2"),
        ("t,x,y,p\n1,70000,3,1\n", "x = 70000"),
        ("t,x,y,p\n5,2,3,1\n4,2,3,1\n", "earlier"),
        ("# geometry 2x2\nt,x,y,p\n5,2,1,1\n", "sensor is 2 x 2"),
        ("t,x,y,p\n99999999999999999999,2,3,1\n", "line"),
        ("hello\n", "no known"),
        ("t,x,y,p\n" + "1" * 2_000_000, "no CSV"),
    ],
)
def test_damaged_text(text, said, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(EventFileError, match=said) as raised:
        read_events(path)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


# ---------------------------------------------------------------- EVT3: bit errors of the clock


def evt3_recording(path, seed: int = 0, repeats: int = 1) -> Events:
    """Write EVT3 as a camera does, its TIME_HIGH several times in each 4 ms, and return the events."""
    draw = np.random.default_rng(seed)
    times = 11_000_000 + np.sort(draw.integers(0, 12_000_000, 60_000))  # across a turn of the clock
    columns = (
        draw.integers(0, 1280, len(times)),
        draw.integers(0, 720, len(times)),
        draw.integers(0, 2, len(times)),
    )
    events = Events(times, *columns, width=1280, height=720)
    write_events(path, events, format="EVT3")
    data = path.read_bytes().replace(b"% events 60000", b"% note   60000")
    head = data.index(b"% end\n") + 6
    words = np.frombuffer(data[head:], "<u2")
    is_low = words >> 12 == 6
    high = words[np.maximum.accumulate(np.where(words >> 12 == 8, np.arange(len(words)), 0))]
    counts = np.where(is_low, repeats, 1)
    out = np.repeat(np.where(is_low, high, words), counts)
    last = np.cumsum(counts) - 1
    out[last] = words  # before each TIME_LOW the TIME_HIGH once more
    path.write_bytes(data[:head] + out.tobytes())
    assert read_events(path) == events
    return events


@pytest.mark.parametrize("repeats", [1, 2])
def test_bit_errors_of_the_evt3_clock_are_named_and_mended(repeats, tmp_path):
    path = tmp_path / "camera.raw"
    events = evt3_recording(path, repeats=repeats)
    data = path.read_bytes()
    head = data.index(b"% end\n") + 6
    words = np.frombuffer(data[head:], "<u2")
    places = np.flatnonzero(words >> 12 == 8)
    draw = np.random.default_rng(1)
    tried = 0
    for place in draw.choice(places[5:-5], 60, replace=False).tolist():
        bit = int(draw.integers(4, 12))  # 16 steps and more: what lies nearer may be another good time
        damaged = words.copy()
        damaged[place] ^= 1 << bit
        path.write_bytes(data[:head] + damaged.tobytes())
        with pytest.raises(EventFileError, match=r"jumps and comes back.*16\.77 s.*salvage"):
            read_events(path)
        found, report = read_events_report(path)
        assert report.faults == {"clock": 1}
        np.testing.assert_array_equal(found.t_us, events.t_us)
        tried += 1
    assert tried == 60


def test_a_clock_error_at_the_end_of_a_block_is_seen_in_the_next(tmp_path):
    """The last word of the first megabyte is wrong: what follows keeps its times, what was before as well."""
    path = tmp_path / "a.raw"
    events = evt3_recording(path, repeats=2)
    data = path.read_bytes()
    head = data.index(b"% end\n") + 6
    words = np.frombuffer(data[head:], "<u2").copy()
    place = int(np.flatnonzero(words >> 12 == 8)[900])
    words[place] ^= 1 << 11
    foreign = np.full((1 << 19) - 1 - place, 0x7000, "<u2")  # words that decoders pass
    path.write_bytes(data[:head] + words[:1].tobytes() + foreign.tobytes() + words[1:].tobytes())
    with pytest.raises(EventFileError, match="jumps and comes back"):
        read_events(path)
    found, report = read_events_report(path)
    assert report.faults["clock"] == 1
    assert len(found) > len(events) - 50 and set(found.t_us.tolist()) <= set(events.t_us.tolist())
    assert found.t_us[-1] == events.t_us[-1]


def test_long_silences_are_no_clock_errors(tmp_path):
    draw = np.random.default_rng(0)
    gaps = np.cumsum(draw.choice([5, 10**4, 10**6, 2**24 - 3, 2**24, 2**24 + 9_000, 10**8], 400))
    events = Events(gaps, np.zeros(400, int), np.zeros(400, int), np.ones(400, bool), 8, 8)
    write_events(tmp_path / "a.raw", events, format="EVT3")
    assert read_events(tmp_path / "a.raw") == events


def test_a_recording_without_a_whole_frame_is_an_error_of_the_file(tmp_path):
    path = tmp_path / "MipiData_F_100M.bin"
    write_celex_frames(path, np.zeros((1, 800, 1280), np.uint8))
    path.write_bytes(path.read_bytes()[:500_000])
    with pytest.raises(EventFileError, match="no whole frame"):
        read_frames(path, on_error="salvage")
