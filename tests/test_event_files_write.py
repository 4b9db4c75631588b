"""Writing piece by piece gives what writing at once gives; formats of frames, triggers and small makers."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from evnlos.errors import DataError, EventFileError
from evnlos.events import (
    EventWriter,
    iter_events,
    read_events,
    read_events_report,
    read_frames,
    read_timed_frames,
    read_triggers,
    write_aedat4,
    write_events,
)
from evnlos.events.files import aedat4, container_write
from evnlos.events.files import registry as write
from evnlos.types import Events

FILES = [
    "e.h5",
    "e.npz",
    "evt3.raw",
    "evt2.raw",
    "evt21.raw",
    "e.csv",
    "e_EI_100M.bin",
    "e_EO_70M.bin",
    "e.aedat4",
    "e.mcap",
]


def name_of(file: str) -> str | None:
    stem = file.split(".")[0].upper()
    return stem if stem.startswith("EVT") else None


def sample(file: str, count: int = 5_000, span_us: int = 60_000_000) -> Events:
    draw = np.random.default_rng(9)
    width, height = (1280, 800) if file.endswith(".bin") else (64, 48)
    times = np.sort(draw.integers(0, span_us, count))
    columns = draw.integers(0, width, count), draw.integers(0, height, count), draw.integers(0, 2, count) == 1
    adc = draw.integers(0, 4096, count) if "EI" in file else None
    return Events(times, *columns, width=width, height=height, adc=adc)


def pieces_of(events: Events, size: int):
    return (events[start : start + size] for start in range(0, len(events), size))


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("size", [1_500, 100_000])
def test_pieces_are_written_like_the_whole(file, size, tmp_path, monkeypatch):
    if file.endswith(".aedat4"):
        pytest.importorskip("aedat")
    monkeypatch.setattr(write, "_PIECE", 1_000)
    events = sample(file)
    whole, streamed = tmp_path / f"whole_{file}", tmp_path / f"streamed_{file}"
    write_events(whole, events, format=name_of(file))
    write_events(streamed, pieces_of(events, size), format=name_of(file))
    assert read_events(streamed) == read_events(whole)
    if file.endswith(".bin"):
        ticks = {"e_EI_100M.bin": 10.24, "e_EO_70M.bin": 1024 / 140}[file]
        assert np.abs(read_events(whole).t_us - (events.t_us - events.t_us[0])).max() <= ticks / 2 + 1
        np.testing.assert_array_equal(read_events(whole).x, events.x)
    else:
        assert read_events(whole) == events
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([whole.name, streamed.name])


@pytest.mark.parametrize("file", ["evt3.raw", "evt2.raw", "evt21.raw"])
def test_clock_turns_between_and_inside_pieces(file, tmp_path, monkeypatch):
    monkeypatch.setattr(write, "_PIECE", 2)
    times = np.cumsum([5, 2**36, 0, 3, 2**24, 2**35, 2**35, 1, 2**24 - 1, 70])
    events = Events(times, np.arange(10), np.arange(10), np.arange(10) % 2, width=10, height=10)
    write_events(tmp_path / file, pieces_of(events, 3), format=name_of(file))
    assert read_events(tmp_path / file) == events


def test_long_recordings_widen_the_times_of_hdf5(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "_PIECE", 5_000)
    monkeypatch.setattr(container_write, "_CHUNK", 4_096)  # several chunks are copied
    events = sample("e.h5", 40_000, 2**34)
    write_events(tmp_path / "e.h5", pieces_of(events, 5_000))
    assert read_events(tmp_path / "e.h5") == events


def test_index_of_milliseconds_is_the_same_in_pieces(tmp_path, monkeypatch):
    import h5py

    events = sample("e.h5", 3_000, 500_000)
    write_events(tmp_path / "whole.h5", events)
    monkeypatch.setattr(write, "_PIECE", 100)
    write_events(tmp_path / "pieces.h5", pieces_of(events, 100))
    t = events.t_us - events.t_us[0]
    expected = np.searchsorted(t, np.arange(t[-1] // 1000 + 2) * 1000)
    for name in ("whole", "pieces"):
        with h5py.File(tmp_path / f"{name}.h5") as file:
            np.testing.assert_array_equal(file["ms_to_idx"], expected)


@pytest.mark.parametrize("file", ["e.h5", "e.npz", "evt3.raw", "e.csv", "e_EO_70M.bin", "e.aedat4", "e.mcap"])
def test_a_stream_without_events(file, tmp_path):
    if file.endswith(".aedat4"):
        pytest.importorskip("aedat")
    blank = sample(file)[:0]
    write_events(tmp_path / file, iter([blank]))
    assert read_events(tmp_path / file).shape == blank.shape and not len(read_events(tmp_path / file))
    with pytest.raises(DataError, match="nothing to write"):
        write_events(tmp_path / "none.h5", iter([]))
    assert not (tmp_path / "none.h5").exists()


def test_pieces_that_do_not_fit_leave_no_file(tmp_path):
    events = sample("e.h5", 20)
    other = Events.empty(7, 7)
    later = Events([2**40], [0], [0], [1], 64, 48, adc=[5])
    for wrong, said in (
        ([events[10:], events[:10]], "in the order of time"),
        ([events, other], "one sensor"),
        ([events, later], "columns"),
    ):
        with pytest.raises(DataError, match=said):
            write_events(tmp_path / "e.h5", wrong)
    with pytest.raises(KeyError), EventWriter(tmp_path / "e.raw") as writer:
        writer.write(events)
        raise KeyError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("file", ["e.h5", "e.npz", "evt3.raw", "e.aedat4", "e.mcap"])
def test_memory_does_not_grow_with_the_stream(file, tmp_path):
    def stream(count):
        for k in range(count):
            yield Events(events.t_us + k * 2_000_000, events.x, events.y, events.p, 64, 48)

    events = sample(file, 100_000, 1_000_000)
    peaks = []
    for count in (6, 18):
        write_events(tmp_path / file, stream(1))
        tracemalloc.start()
        write_events(tmp_path / file, stream(count))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0] + 500_000


# ---------------------------------------------------------------- CeleX-V format 0, ES, AEDAT4 frames, triggers


def test_celex_format_0_round_trip(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "_PIECE", 300)
    draw = np.random.default_rng(4)
    times = np.cumsum(draw.integers(0, 90_000, 1_000))  # some steps are longer than a turn of the row clock
    events = Events(
        times, draw.integers(0, 1280, 1_000), draw.integers(0, 800, 1_000), np.zeros(1_000, bool), 1280, 800,
        adc=draw.integers(0, 256, 1_000),
    )  # fmt: skip
    path = tmp_path / "e_EI_100M.bin"
    write_events(path, pieces_of(events, 170), format="CELEX0")
    back = read_events(path)
    for name in ("x", "y", "adc"):
        np.testing.assert_array_equal(getattr(back, name), getattr(events, name))
    assert np.abs(back.t_us - (events.t_us - events.t_us[0])).max() <= 6
    assert path.read_bytes()[4] == 0
    with pytest.raises(DataError, match="at most 255"):
        write_events(path, Events([1], [0], [0], [0], 1280, 800, adc=[256]), format="CELEX0")
    with pytest.raises(DataError, match="needs intensities"):
        write_events(path, Events([1], [0], [0], [0], 1280, 800), format="CELEX0")


def es_bytes(body: bytes, version: int = 2, kind: int = 1) -> bytes:
    return b"Event Stream" + bytes([version, 0, 0, kind]) + struct.pack("<HH", 10, 6) + body


def test_es_by_hand(tmp_path):
    path = tmp_path / "e.es"
    first = bytes([5 << 1 | 1]) + struct.pack("<HH", 9, 0)
    second = bytes([255, 255, 254, 3 << 1]) + struct.pack("<HH", 0, 5)
    path.write_bytes(es_bytes(first + second))
    assert read_events(path) == Events([5, 262], [9, 0], [5, 0], [True, False], width=10, height=6)
    for data, said in (
        (es_bytes(first + second[:-1]), "4 bytes into an event of 5"),
        (es_bytes(first, kind=2), "ATIS"),
        (es_bytes(first, version=1), "version 1"),
        (es_bytes(bytes([0]) + struct.pack("<HH", 10, 0)), "10 x 6"),
        (es_bytes(b"")[:-1], "19 bytes"),
    ):
        path.write_bytes(data)
        with pytest.raises(EventFileError, match=said):
            read_events(path)


def test_real_es_has_its_known_count(shared_data):
    events = read_events(shared_data / "recordings" / "faery_dvs.es")
    assert len(events) == 473_225 and events.shape == (240, 320)
    assert sum(
        len(piece) for piece in iter_events(shared_data / "recordings" / "faery_dvs.es", n_events=999)
    ) == len(events)


def test_aedat4_with_frames_and_events(tmp_path):
    pytest.importorskip("aedat")
    events = sample("e.aedat4", 40_000, 1_000_000)
    frames = np.random.default_rng(0).integers(0, 256, (5, 48, 64), dtype=np.uint8)
    times = np.arange(5) * 200_000 + 7
    write_aedat4(tmp_path / "davis.aedat4", events, frames, times)
    assert read_events(tmp_path / "davis.aedat4") == events
    found = read_timed_frames(tmp_path / "davis.aedat4")
    np.testing.assert_array_equal(found.images, frames)
    np.testing.assert_array_equal(found.t_us, times)
    np.testing.assert_array_equal(read_frames(tmp_path / "davis.aedat4"), frames)
    write_events(tmp_path / "events.aedat4", events)
    with pytest.raises(EventFileError, match="without frames"):
        read_frames(tmp_path / "events.aedat4")
    data = (tmp_path / "davis.aedat4").read_bytes()
    (tmp_path / "cut.aedat4").write_bytes(data[:-100])
    with pytest.raises(EventFileError, match="packet"):
        read_frames(tmp_path / "cut.aedat4")
    for wrong in (frames[:4], frames.astype(float), frames[0]):
        with pytest.raises(DataError):
            write_aedat4(tmp_path / "wrong.aedat4", events, wrong, times)


def packets(path: Path) -> list[tuple[int, bytes]]:
    """Return stream and content of each packet of an AEDAT4 file without a data table."""
    data, found = path.read_bytes(), []
    at = len(aedat4.SIGNATURE)
    at += 4 + struct.unpack_from("<I", data, at)[0]
    while at < len(data):
        number, size = struct.unpack_from("<ii", data, at)
        found.append((number, data[at + 8 : at + 8 + size]))
        at += 8 + size
    return found


def io_header(description: bytes) -> bytes:
    """Return the flat buffer of an AEDAT4 file's header: nothing is packed, no data table, a description."""
    vtable = struct.pack("<5H", 10, 20, 12, 4, 16)  # at 12
    table = struct.pack("<iqiI", 28 - 12, -1, 0, 4)  # at 28
    text = struct.pack("<I", len(description)) + description + b"\0"  # at 48
    body = struct.pack("<I4s", 28 - 4, b"IOHE") + vtable + bytes(6) + table + text
    return struct.pack("<I", len(body)) + body


def test_cameras_of_an_aedat4_are_listed_and_chosen(tmp_path):
    """Two cameras in one file: neither is taken in silence, and each is had by its name."""
    pytest.importorskip("aedat")
    left, right = sample("e.aedat4", 500), sample("e.aedat4", 700)
    node = (
        '<node name="{0}" path="/outInfo/{0}/"><attr key="originalOutputName" type="string">{1}</attr>'
        '<attr key="typeIdentifier" type="string">{2}</attr><node name="info" path="/outInfo/{0}/info/">'
        '<attr key="sizeX" type="int">{3}</attr><attr key="sizeY" type="int">{4}</attr></node></node>'
    )
    size = left.width, left.height
    streams = ((0, "left", "EVTS"), (1, "right", "EVTS"), (2, "imu", "IMUS"), (3, "frames", "FRME"))
    nodes = "".join(node.format(*one, *size) for one in streams)
    text = f'<dv version="2.0"><node name="outInfo" path="/outInfo/">{nodes}</node></dv>'
    data = aedat4.SIGNATURE + io_header(text.encode())
    for number, events in ((0, left), (1, right)):
        write_events(tmp_path / "one.aedat4", events)
        data += b"".join(
            struct.pack("<ii", number, len(one)) + one for _, one in packets(tmp_path / "one.aedat4")
        )
    write_aedat4(tmp_path / "one.aedat4", left[:0], np.full((1, 4, 6), 7, np.uint8), np.array([5]))
    ((_, picture),) = packets(tmp_path / "one.aedat4")
    path = tmp_path / "two.aedat4"
    path.write_bytes(data + struct.pack("<ii", 3, len(picture)) + picture)
    with pytest.raises(EventFileError, match=r"2 streams of events; give topic=.*: 0/left, 1/right"):
        read_events(path)
    assert read_events(path, topic="left") == left and read_events(path, topic="1/right") == right
    _, report = read_events_report(path, topic="right")
    assert [(one.name, one.kind) for one in report.streams] == [
        ("0/left", "events"), ("1/right", "events"), ("2/imu", "other"), ("3/frames", "frames"),
    ]  # fmt: skip
    assert read_timed_frames(path).images.tolist() == np.full((1, 4, 6), 7).tolist()
    with pytest.raises(EventFileError, match="no stream of events is 'imu'"):
        read_events(path, topic="imu")


def test_an_independent_reader_agrees_on_aedat4(tmp_path):
    faery = pytest.importorskip("faery")
    events = sample("e.aedat4", 40_000, 1_000_000)
    write_events(tmp_path / "e.aedat4", events)
    rows = faery.events_stream_from_file(str(tmp_path / "e.aedat4")).to_array()
    for name, column in (("t", events.t_us), ("x", events.x), ("y", events.y), ("on", events.p)):
        np.testing.assert_array_equal(rows[name], column)


def test_without_aedat_the_error_says_what_to_do(tmp_path, monkeypatch):
    import builtins

    from evnlos.errors import MissingDependencyError

    write_events(tmp_path / "e.aedat4", sample("e.aedat4", 5))
    real = builtins.__import__

    def absent(name, *args, **kwargs):
        if name == "aedat":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    for read in (read_events, read_frames):
        with pytest.raises(MissingDependencyError, match=r"pip install evnlos\[aedat\].*HDF5"):
            read(tmp_path / "e.aedat4")


def write_words(path: Path, version: str, words: list[int], dtype: str) -> Path:
    head = f"% evt {version}\n% geometry 8x8\n% t0 1000\n".encode()
    path.write_bytes(head + np.array(words, np.uint64).astype(dtype).tobytes())
    return path


def test_triggers_of_every_raw_format(tmp_path):
    """Two edges of channel 3 at clock 70 and one turn and 9 us later, by the tables of the maker's manual."""
    evt2 = [
        0x8000_0001,
        0xA << 28 | 6 << 22 | 3 << 8 | 1,
        0x8FFF_FFFF,
        0x8000_0000,
        0xA << 28 | 9 << 22 | 3 << 8,
    ]
    evt21 = [word << 32 for word in evt2]
    evt3 = [0x8000, 0x6000 | 70, 0xA301, 0x8FFF, 0x8000, 0x6009, 0xA300]
    for name, version, words, dtype, turn in (
        ("evt2", "2.0", evt2, "<u4", 2**34),
        ("evt21", "2.1", evt21, "<u8", 2**34),
        ("evt3", "3.0", evt3, "<u2", 2**24),
    ):
        found = read_triggers(write_words(tmp_path / f"{name}.raw", version, words, dtype))
        assert found.t_us.tolist() == [1070, turn + 1009], name
        assert found.channel.tolist() == [3, 3] and found.rising.tolist() == [True, False]
    write_events(tmp_path / "e.npz", sample("e.npz", 5))
    with pytest.raises(EventFileError, match="Prophesee RAW"):
        read_triggers(tmp_path / "e.npz")


def test_triggers_across_blocks_and_of_real_files(shared_data, tmp_path, monkeypatch):
    from evnlos.events import read_events_report
    from evnlos.events.files import words

    path = shared_data / "recordings" / "expelliarmus_evt2_sample.raw"
    assert len(read_triggers(path)) == read_events_report(path)[1].triggers
    evt3 = [0x8000, 0x6000 | 70, 0xA301, *[0x6000 | 71, 0xA300, 0x6000 | 72, 0xA301] * 50]
    file = write_words(tmp_path / "t.raw", "3.0", evt3, "<u2")
    whole = read_triggers(file)
    monkeypatch.setattr(words, "_BLOCK_BYTES", 6)
    pieces = read_triggers(file)
    np.testing.assert_array_equal(whole.t_us, pieces.t_us)
    assert len(whole) == 101 and whole.rising.sum() == 51
