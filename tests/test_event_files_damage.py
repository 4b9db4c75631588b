"""Damaged event files: strict reading gives one error of one line or the truth, salvage gives what is good."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from evnlos.errors import EventFileError
from evnlos.events import read_events, read_events_report, write_events
from evnlos.types import Events

WRITABLE = [
    ("HDF5", ".h5"),
    ("NPZ", ".npz"),
    ("EVT3", ".raw"),
    ("EVT2", ".raw"),
    ("EVT21", ".raw"),
    ("CSV", ".csv"),
    ("MCAP", ".mcap"),
]
RAW = ("EVT2", "EVT21", "EVT3")
CHECKSUMMED = {"HDF5", "NPZ"}


def sample(count: int = 20_000) -> Events:
    draw = np.random.default_rng(8)
    return Events(
        1_000 + np.sort(draw.integers(0, 500_000, count)),
        draw.integers(0, 128, count),
        draw.integers(0, 96, count),
        draw.integers(0, 2, count).astype(bool),
        width=128,
        height=96,
    )


@pytest.fixture(params=WRITABLE, ids=lambda pair: pair[0])
def written(request, tmp_path) -> tuple[str, Path, bytes]:
    name, suffix = request.param
    path = tmp_path / f"e{suffix}"
    write_events(path, sample(), format=name)
    return name, path, path.read_bytes()


def one_error(path: Path) -> str:
    """Return the text of the one error that strict reading must raise."""
    with pytest.raises(EventFileError) as raised:
        read_events(path)
    text = str(raised.value)
    assert text.startswith(str(path)) and "\n" not in text and "byte" in text and ";" in text
    return text


def never_lies(path: Path, name: str, truth: Events) -> bool:
    """Read both ways; return whether strict raised. A format with checksums may only tell the truth."""
    try:
        events = read_events(path)
    except EventFileError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        failed = True
    else:
        failed = False
        Events(events.t_us, events.x, events.y, events.p, events.width, events.height)
        assert name not in CHECKSUMMED or events == truth
    try:
        salvaged, report = read_events_report(path)
    except EventFileError:
        assert failed
    else:
        assert failed != report.clean
        Events(salvaged.t_us, salvaged.x, salvaged.y, salvaged.p, salvaged.width, salvaged.height)
    return failed


def test_empty_missing_folder(tmp_path):
    (tmp_path / "empty.raw").write_bytes(b"")
    assert "empty" in one_error(tmp_path / "empty.raw")
    with pytest.raises(EventFileError, match="no such file"):
        read_events(tmp_path / "none.raw")
    with pytest.raises(EventFileError, match="is a folder"):
        read_events(tmp_path)
    with pytest.raises(EventFileError, match="on_error"):
        read_events(tmp_path / "empty.raw", on_error="ignore")  # type: ignore[arg-type]


@pytest.mark.parametrize("cut", [0.5, 0.9, 0.999])
def test_cut_files_are_errors(written, cut):
    name, path, data = written
    path.write_bytes(data[: int(len(data) * cut)])
    one_error(path)
    if name in RAW:
        events, report = read_events_report(path)
        assert report.truncated
        assert events == sample()[: len(events)] and len(events) > 0.9 * cut * len(sample())


def test_one_missing_byte_is_an_error(written):
    _, path, data = written
    path.write_bytes(data[:-1])
    one_error(path)


def test_flipped_bits(written):
    name, path, data = written
    draw = np.random.default_rng(1)
    failures = 0
    for _ in range(40):
        damaged = bytearray(data)
        position = int(draw.integers(0, len(data)))
        damaged[position] ^= 1 << int(draw.integers(0, 8))
        path.write_bytes(damaged)
        failures += never_lies(path, name, sample())
    assert failures > 0


def test_two_hundred_flipped_bits_are_an_error(written):
    name, path, data = written
    draw = np.random.default_rng(2)
    damaged = bytearray(data)
    for position in draw.integers(len(data) // 50, len(data), 200):
        damaged[position] ^= 1 << int(draw.integers(0, 8))
    path.write_bytes(damaged)
    one_error(path)
    never_lies(path, name, sample())


def test_flipped_header(written):
    name, path, data = written
    draw = np.random.default_rng(3)
    for _ in range(40):
        damaged = bytearray(data)
        damaged[int(draw.integers(0, 80))] ^= 1 << int(draw.integers(0, 8))
        path.write_bytes(damaged)
        never_lies(path, name, sample())


@pytest.mark.parametrize("seed", range(3))
def test_random_bytes_are_an_error(seed, tmp_path):
    for suffix in (".raw", ".h5", ".npz", ".aedat4", ".bin", ".dat", ".csv"):
        path = tmp_path / f"noise{suffix}"
        path.write_bytes(np.random.default_rng(seed).bytes(1 << 20))
        one_error(path)


def test_valid_start_before_random_bytes_is_an_error(written):
    name, path, data = written
    keep = data.find(b"% end\n") + 6 if name in RAW else 512
    path.write_bytes(data[:keep] + np.random.default_rng(5).bytes(1 << 20))
    one_error(path)
    tracemalloc.start()
    never_lies(path, name, sample())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * (1 << 20)  # a 2-byte word can stand for 12 events of 13 bytes


def test_foreign_headers_without_a_count(tmp_path):
    """Headers as cameras write them announce no length: random bytes behind them must still be seen."""
    noise = np.random.default_rng(6).bytes(1 << 20)
    for version in ("2.0", "3.0"):
        path = tmp_path / "n.raw"
        path.write_bytes(f"% evt {version}\n% geometry 640x480\n% end\n".encode() + noise)
        one_error(path)
        events, report = read_events_report(path)
        assert not report.clean and (not len(events) or events.x.max() < 640)


def test_lying_sizes_cost_no_memory(tmp_path):
    import h5py

    path = tmp_path / "lie.h5"
    with h5py.File(path, "w") as file:
        for name in "xytp":
            file.create_dataset(f"events/{name}", shape=(10**12,), dtype="u2", chunks=(65_536,))
    tracemalloc.start()
    one_error(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 22
    tracemalloc.stop()


def test_salvage_keeps_a_readable_part_of_a_recording(written):
    name, path, data = written
    if name in CHECKSUMMED:
        return
    damaged = bytearray(data)
    damaged[len(data) // 2 : len(data) // 2 + 400] = np.random.default_rng(7).bytes(400)
    path.write_bytes(damaged)
    events, report = read_events_report(path)
    assert len(events) > 0.95 * len(sample())
    assert not report.clean and str(path) in str(report)
