"""HDF5 of other makers: Prophesee's with ECF chunks, and columns by the names of DSEC, M3ED and EVIMO."""

import struct
import tracemalloc

import h5py
import numpy as np
import pytest

from ecf_files import CHUNK, chunk, write_ecf
from evnlos.errors import EventFileError
from evnlos.events import iter_events, read_events, read_events_report, read_triggers
from evnlos.types import Events

FORMS = ("packed", "pairs", "masks")


@pytest.mark.parametrize("name", ["evt3_sample", "random", "rows", "masks", "gaps", "partial"])
def test_ecf_files_equal_their_truth(shared_data, name):
    truth = np.load(shared_data / "recordings" / "ecf_truth.npz")
    path = shared_data / "recordings" / f"ecf_{name}.h5"
    events = read_events(path)
    for ours, theirs in (("x", "x"), ("y", "y"), ("p", "p"), ("t_us", "t")):
        np.testing.assert_array_equal(getattr(events, ours), truth[f"{name}_{theirs}"])
    assert (events.width, events.height) == tuple(truth[f"{name}_size"])
    if name == "random":
        triggers = read_triggers(path)
        np.testing.assert_array_equal(triggers.t_us, truth["random_trigger_t"])
        np.testing.assert_array_equal(triggers.rising, truth["random_trigger_p"])


def sample(count: int, seed: int = 0, span: int = 60) -> Events:
    """Return events with long runs of rows and signs, neighbours, and steps of time of every size."""
    draw = np.random.default_rng(seed)
    steps = np.where(draw.random(count) < 0.9, 0, 2 ** draw.integers(0, 34, count))
    x = (np.arange(count) * draw.integers(1, 3)) % 1280
    return Events(
        np.cumsum(steps) + 5, x, draw.integers(0, 720, count // span + 1).repeat(span)[:count],
        draw.integers(0, 2, count // span + 1).repeat(span)[:count], 1280, 720,
    )  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("count", [1, 4, 5, 999, CHUNK, CHUNK + 1])
def test_the_three_forms_of_a_chunk(form, count, tmp_path):
    events = sample(count, count, 200 if form == "masks" else 60)
    path = write_ecf(tmp_path / "a.h5", events, form)
    assert read_events(path) == events
    assert sum(map(len, iter_events(path, n_events=100))) == count


def test_a_padded_last_chunk_and_a_plain_one(tmp_path):
    events = sample(CHUNK + 10)
    padded = sample(CHUNK + CHUNK)[CHUNK:]
    last = Events(*(getattr(padded, name) for name in ("t_us", "x", "y", "p")), width=1280, height=720)
    path = write_ecf(tmp_path / "a.h5", events, chunks=[chunk(events[:CHUNK]), chunk(last)])
    assert len(read_events(path)) == CHUNK + 10


@pytest.mark.parametrize("form", FORMS)
def test_damaged_chunks_are_one_line_and_the_others_stay(form, tmp_path):
    events = sample(3 * CHUNK, 1, 200)
    good = [chunk(events[start : start + CHUNK], form) for start in range(0, 3 * CHUNK, CHUNK)]
    draw = np.random.default_rng(2)
    failed = 0
    for attempt in range(40):
        damaged = bytearray(good[1])
        if attempt % 4 == 0:
            del damaged[int(draw.integers(0, len(damaged))) :]
        elif attempt % 4 == 1:
            damaged += draw.bytes(3)
        else:
            damaged[int(draw.integers(0, min(len(damaged), 400)))] ^= 1 << int(draw.integers(0, 8))
        path = write_ecf(tmp_path / "a.h5", events, chunks=[good[0], bytes(damaged), good[2]])
        try:
            read_events(path)
        except EventFileError as error:
            assert "\n" not in str(error) and str(path) in str(error)
            failed += 1
            found, report = read_events_report(path)
            assert not report.clean and len(found) >= CHUNK
    assert failed >= 20


def test_a_chunk_that_lies_about_its_size(tmp_path):
    events = sample(100)
    for count in (0, 99, 101, 65_535, 2**30 - 1):
        data = struct.pack("<I", (count << 2 | 2) & 0xFFFFFFFF) + chunk(events)[4:]
        with pytest.raises(EventFileError, match="events where 100 are announced"):
            read_events(write_ecf(tmp_path / "a.h5", events, chunks=[data]))


def test_a_file_that_lies_about_its_length_costs_no_memory(tmp_path):
    path = write_ecf(tmp_path / "a.h5", sample(100))
    with h5py.File(path, "r+") as file:
        file["CD/events"].resize((10**12,))
    tracemalloc.start()
    with pytest.raises(EventFileError, match="announces 1000000000000 events"):
        read_events(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 22
    tracemalloc.stop()


# ---------------------------------------------------------------- names of columns


def put(path, group: str, events: Events, names=("x", "y", "t", "p"), seconds: bool = False) -> None:
    with h5py.File(path, "a") as file:
        times = events.t_us / 1e6 if seconds else events.t_us
        for name, column in zip(names, (events.x, events.y, times, events.p), strict=True):
            file[f"{group}/{name}"] = column


def small(seed: int = 0) -> Events:
    draw = np.random.default_rng(seed)
    columns = (draw.integers(0, 64, 50), draw.integers(0, 48, 50), draw.integers(0, 2, 50))
    return Events(np.sort(draw.integers(0, 9**6, 50)), *columns, width=64, height=48)


def test_cameras_of_m3ed_are_streams(tmp_path):
    path = tmp_path / "a.h5"
    for seed, side in enumerate(("left", "right")):
        put(path, f"prophesee/{side}", small(seed))
        with h5py.File(path, "a") as file:
            file[f"prophesee/{side}/calib/resolution"] = [64, 48]
            file[f"prophesee/{side}/ms_map_idx"] = [0]
    with pytest.raises(EventFileError, match="prophesee/left, prophesee/right"):
        read_events(path)
    assert read_events(path, topic="prophesee/right") == small(1) and read_events(path, topic="left") == small(
        0
    )


@pytest.mark.parametrize("names", [("xs", "ys", "ts", "ps"), ("x", "y", "timestamps", "polarity")])
def test_other_names_and_seconds(names, tmp_path):
    put(tmp_path / "a.h5", "events", small(), names, seconds=True)
    assert read_events(tmp_path / "a.h5", width=64, height=48) == small()


def test_pairs_of_evimo(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events_xy"] = np.stack([small().x, small().y], axis=1)
        file["events_t"], file["events_p"] = small().t_us / 1e6, small().p
    events, report = read_events_report(tmp_path / "a.h5", "strict", width=64, height=48)
    assert events == small() and report.topic == "/"
    assert read_events(tmp_path / "a.h5").width == int(small().x.max()) + 1


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e13, -1e300])
def test_times_that_are_no_seconds(wrong, tmp_path):
    put(tmp_path / "a.h5", "events", small(), seconds=True)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["events/t"][3] = wrong
    with pytest.raises(EventFileError, match="events/t holds NaN or no times; mend them"):
        read_events(tmp_path / "a.h5")


def test_links_are_not_followed_in_a_search(tmp_path):
    put(tmp_path / "other.h5", "events", small())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["camera"] = h5py.ExternalLink("other.h5", "/events")
        file["b/x"] = h5py.ExternalLink("other.h5", "/events/x")
        for name in "ytp":
            file[f"b/{name}"] = [0]
    with pytest.raises(EventFileError, match="link"):
        read_events(tmp_path / "a.h5")


def packed(path, count: int, t: str, length: int, **how) -> tuple[Events, dict[str, list[int]]]:
    """Write packed columns; return the events and the bytes where each column's chunks stand."""
    draw = np.random.default_rng(count)
    events = Events(
        np.sort(draw.integers(0, 10**6, count)),
        draw.integers(0, 640, count),
        draw.integers(0, 480, count),
        draw.integers(0, 2, count) > 0,
        width=640,
        height=480,
    )
    with h5py.File(path, "w") as file:
        for name, dtype in (("t", t), ("x", "u2"), ("y", ">i4"), ("p", "i1")):
            values = getattr(events, "t_us" if name == "t" else name) / (
                1e6 if t == "f8" and name == "t" else 1
            )
            file.create_dataset(
                f"events/{name}", data=values.astype(dtype), chunks=(min(length, count),), **how
            )
        file["t_offset"] = 0 if t == "f8" else 7
        ids = {name: file[f"events/{name}"].id for name in "txyp"}
        places = {
            name: [one.get_chunk_info(k).byte_offset + 40 for k in range(one.get_num_chunks())]
            for name, one in ids.items()
        }
    moved = events.t_us + (0 if t == "f8" else 7)
    return Events(moved, events.x, events.y, events.p, width=640, height=480), places


@pytest.mark.parametrize("fletcher32", [False, True])
@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize("compression", [None, "gzip", "lzf"])
def test_packings_are_read_alike(compression, shuffle, fletcher32, tmp_path):
    """Whole chunks of deflate are unpacked here, others by the library: nobody can tell which."""
    how = {"compression": compression, "shuffle": shuffle, "fletcher32": fletcher32}
    for count, t, length in ((1, "u4", 8192), (20_001, "u4", 8192), (16_384, "i8", 8192), (9000, "f8", 3000)):
        events, _ = packed(tmp_path / "a.h5", count, t, length, **how)
        assert read_events(tmp_path / "a.h5", width=640, height=480) == events
        pieces = list(iter_events(tmp_path / "a.h5", n_events=5000, width=640, height=480))
        assert Events.concatenate(pieces) == events


@pytest.mark.parametrize("fletcher32", [False, True])
def test_a_flipped_bit_of_a_packed_chunk_is_told(fletcher32, tmp_path):
    how = {"compression": "gzip", "shuffle": True, "fletcher32": fletcher32}
    _, places = packed(tmp_path / "a.h5", 20_001, "u4", 8192, **how)
    good = (tmp_path / "a.h5").read_bytes()
    for place in (place for column in places.values() for place in column):
        damaged = bytearray(good)
        damaged[place] ^= 4
        (tmp_path / "a.h5").write_bytes(damaged)
        with pytest.raises(EventFileError, match="HDF5 cannot read it"):
            read_events(tmp_path / "a.h5", width=640, height=480)
