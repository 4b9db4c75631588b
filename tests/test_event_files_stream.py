"""Streaming gives what whole reading gives, in bounded memory."""

import tracemalloc

import numpy as np
import pytest

from evnlos.errors import EventFileError
from evnlos.events import iter_events, read_events, write_events
from evnlos.events.files import read, words
from evnlos.types import Events

FILES = [
    ("HDF5", "e.h5"),
    ("NPZ", "e.npz"),
    ("EVT3", "e.raw"),
    ("EVT2", "e.raw"),
    ("EVT21", "e.raw"),
    ("CSV", "e.csv"),
]


def sample(count: int = 5_000, span_us: int = 60_000_000) -> Events:
    draw = np.random.default_rng(9)
    times = np.sort(draw.integers(0, span_us, count))
    columns = (
        draw.integers(0, 64, count),
        draw.integers(0, 48, count),
        draw.integers(0, 2, count).astype(bool),
    )
    return Events(times, *columns, width=64, height=48)


def joined(pieces: list[Events]) -> Events:
    columns = {
        name: np.concatenate([piece.columns()[name] for piece in pieces]) for name in ("t_us", "x", "y", "p")
    }
    return Events(width=pieces[0].width, height=pieces[0].height, **columns)


@pytest.mark.parametrize(("name", "file"), FILES)
def test_pieces_join_to_the_whole(name, file, tmp_path, monkeypatch):
    monkeypatch.setattr(words, "_BLOCK_BYTES", 64)  # many blocks: a decoder's state must survive every cut
    events = sample()
    write_events(tmp_path / file, events, format=name)
    assert read_events(tmp_path / file) == events
    by_count = list(iter_events(tmp_path / file, n_events=777))
    assert joined(by_count) == events and [len(piece) for piece in by_count[:-1]] == [777] * (
        len(events) // 777
    )
    by_time = list(iter_events(tmp_path / file, window_us=1_000_000))
    assert joined(by_time) == events
    windows = [(piece.t_us - events.t_us[0]) // 1_000_000 for piece in by_time]
    assert all(len(np.unique(window)) == 1 for window in windows)
    assert np.all(np.diff([window[0] for window in windows]) > 0)


def test_celex_in_pieces(shared_data):
    path = shared_data / "celex" / "blob_EI_100M.bin"
    pieces = list(iter_events(path, n_events=10_000))
    whole = read_events(path)
    np.testing.assert_array_equal(np.concatenate([piece.adc for piece in pieces]), whole.adc)
    np.testing.assert_array_equal(np.concatenate([piece.p for piece in pieces]), whole.p)


def test_gaps_and_empty_files(tmp_path):
    far = Events([0, 10**15], [0, 0], [0, 0], [True, True], width=1, height=1)
    write_events(tmp_path / "far.npz", far)
    assert [piece.t_us.tolist() for piece in iter_events(tmp_path / "far.npz", window_us=1)] == [[0], [10**15]]
    write_events(tmp_path / "none.npz", Events.empty(3, 2))
    assert list(iter_events(tmp_path / "none.npz", n_events=5)) == []


def test_arguments_are_checked_before_the_first_piece(tmp_path):
    write_events(tmp_path / "e.npz", sample(10))
    for wrong in ({}, {"window_us": 5, "n_events": 5}, {"window_us": 0}, {"n_events": -1}):
        with pytest.raises(EventFileError):
            iter_events(tmp_path / "e.npz", **wrong)
    with pytest.raises(EventFileError, match="no such file"):
        iter_events(tmp_path / "none.npz", n_events=5)


@pytest.mark.parametrize("name", ["EVT2", "EVT3", "EVT21"])
def test_damage_in_the_middle_of_a_stream(name, tmp_path, monkeypatch):
    monkeypatch.setattr(words, "_BLOCK_BYTES", 4096)
    events = sample(20_000)
    path = tmp_path / "e.raw"
    write_events(path, events, format=name)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = np.random.default_rng(7).bytes(64)
    path.write_bytes(data)
    before = 0
    with pytest.raises(EventFileError, match="byte"):
        for piece in iter_events(path, n_events=100):
            assert piece == events[before : before + 100]
            before += 100
    assert before > 5_000
    pieces = list(iter_events(path, n_events=100, on_error="salvage"))
    joined(pieces)  # the constructor checks order and range over all pieces


@pytest.mark.parametrize("ahead", [600, 1 << 17])
@pytest.mark.parametrize("wrong", [1, 300])
def test_events_dated_too_late_cost_themselves_alone(wrong, ahead, tmp_path, monkeypatch):
    """At the end of a block they are no fault yet: only what follows tells."""
    monkeypatch.setattr(words, "_BLOCK_BYTES", 4096)
    monkeypatch.setattr(read, "_LOOK_AHEAD", ahead)
    events = sample(20_000)
    late = np.arange(1024 - wrong, 1024)
    data = np.where(np.isin(np.arange(20_000), late), events.t_us + 2**31, events.t_us)
    path = tmp_path / "e.raw"
    both = np.empty(40_000, np.uint32)  # a word of the clock before each event
    both[::2] = 0x8000_0000 | data >> 6
    both[1::2] = (
        events.p.astype(np.uint32) << 28 | (data & 63) << 22 | events.x.astype(np.uint32) << 11 | events.y
    )
    path.write_bytes(b"% evt 2.0\n% geometry 64x48\n% end\n" + both.astype("<u4").tobytes())
    found = joined(list(iter_events(path, n_events=100, on_error="salvage")))
    kept = ~np.isin(np.arange(20_000), late)
    assert found == Events(events.t_us[kept], events.x[kept], events.y[kept], events.p[kept], 64, 48)


@pytest.mark.parametrize(
    ("name", "file"), [("HDF5", "e.h5"), ("NPZ", "e.npz"), ("EVT3", "e.raw"), ("EVT2", "e.raw")]
)
def test_memory_does_not_grow_with_the_file(name, file, tmp_path):
    peaks = []
    for count in (1_000_000, 3_000_000):
        write_events(tmp_path / file, sample(count), format=name)
        sum(len(piece) for piece in iter_events(tmp_path / file, n_events=10_000))  # compiled, cached
        tracemalloc.start()
        assert sum(len(piece) for piece in iter_events(tmp_path / file, n_events=10_000)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0] + 1_000_000
