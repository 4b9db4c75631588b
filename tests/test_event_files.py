"""Event files: every format gives back what was written, and real recordings have their known counts."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evnlos.errors import DataError, EventFileError, EvnlosError
from evnlos.events import iter_events, keep_known_polarity, read_events, read_events_report, write_events
from evnlos.types import Events

WRITABLE = [
    ("HDF5", ".h5"),
    ("NPZ", ".npz"),
    ("EVT3", ".raw"),
    ("EVT2", ".raw"),
    ("EVT21", ".raw"),
    ("CSV", ".csv"),
]
RAW = ["EVT3", "EVT2", "EVT21"]
MANY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def streams(draw, max_side: int = 2048) -> Events:
    """Return any small stream: empty, one pixel, largest sensor, equal times, far and long times."""
    width, height = draw(st.sampled_from([(1, 1), (3, 2), (160, 100), (1280, 720), (max_side, max_side)]))
    steps = st.one_of(
        st.just(0), st.integers(0, 70), st.integers(0, 5000), st.integers(0, 2**25), st.integers(0, 2**36)
    )
    gaps = draw(st.lists(steps, max_size=40))
    start = draw(st.one_of(st.just(0), st.integers(-(2**40), 2**50)))
    count = len(gaps)
    columns = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    near = columns.integers(0, min(width, 40), count)  # close columns exercise the vectors of EVT3
    return Events(
        start + np.cumsum(np.array(gaps, np.int64)),
        np.sort(near) if draw(st.booleans()) else columns.integers(0, width, count),
        np.zeros(count, int) + height - 1 if draw(st.booleans()) else columns.integers(0, height, count),
        columns.integers(0, 2, count).astype(bool),
        width=width,
        height=height,
    )


@pytest.mark.parametrize(("name", "suffix"), WRITABLE)
def test_round_trip(name, suffix, tmp_path):
    path = tmp_path / f"events{suffix}"

    @MANY
    @given(streams())
    def check(events):
        write_events(path, events, format=name)
        back, report = read_events_report(path, "strict")
        assert back == events
        assert report.clean and report.format == name and report.events == len(events)
        assert [p.name for p in tmp_path.iterdir()] == [path.name]

    check()


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_optional_columns_and_largest_sensor(suffix, tmp_path):
    events = Events(
        [-(2**62), 0, 2**62], [0, 65_535, 1], [65_535, 0, 1], [1, 0, 0], width=65_536, height=65_536,
        adc=[0, 4095, 65_535], polarity_known=[True, False, True],
    )  # fmt: skip
    write_events(tmp_path / f"e{suffix}", events)
    assert read_events(tmp_path / f"e{suffix}") == events


def test_dense_vectors_survive_evt3(tmp_path):
    """Whole rows at one instant are written as vectors; the file must be smaller than a word per event."""
    x = np.tile(np.arange(1280), 20)
    y = np.repeat(np.arange(20), 1280)
    events = Events(np.full(len(x), 5), x, y, np.ones(len(x), bool), width=1280, height=720)
    write_events(tmp_path / "rows.raw", events)
    assert read_events(tmp_path / "rows.raw") == events
    assert (tmp_path / "rows.raw").stat().st_size < len(events)


@pytest.mark.parametrize("name", RAW)
def test_clock_wraps_are_unwrapped(name, tmp_path):
    turn = 1 << 24 if name == "EVT3" else 1 << 34
    times = np.array([0, turn - 1, turn, 3 * turn + 5, 3 * turn + 5, 20 * turn, 20 * turn + turn // 2])
    zeros = np.zeros(len(times), int)
    events = Events(times, zeros, zeros, zeros.astype(bool), width=1, height=1)
    write_events(tmp_path / "long.raw", events, format=name)
    np.testing.assert_array_equal(read_events(tmp_path / "long.raw").t_us, times)


def test_formats_refuse_what_they_cannot_hold(tmp_path):
    with pytest.raises(DataError, match="2048"):
        write_events(tmp_path / "wide.raw", Events.empty(2049, 10))
    century = Events([0, 3 * 10**15], [0, 0], [0, 0], [True, True], width=1, height=1)
    with pytest.raises(DataError, match="clock"):
        write_events(tmp_path / "old.raw", century)
    unknown = Events([1, 2], [0, 0], [0, 0], [0, 1], width=1, height=1, polarity_known=[False, True])
    with pytest.raises(DataError, match="keep_known_polarity"):
        write_events(tmp_path / "a.raw", unknown)
    assert not list(tmp_path.iterdir())
    write_events(tmp_path / "a.raw", keep_known_polarity(unknown))
    assert read_events(tmp_path / "a.raw").t_us.tolist() == [2]


def test_writing_is_atomic_and_says_what_is_wrong(tmp_path, monkeypatch):
    events = Events([1], [0], [0], [True], width=1, height=1)
    path = tmp_path / "e.npz"
    write_events(path, events)
    before = path.read_bytes()

    def full_disk(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full_disk)
    with pytest.raises(EventFileError, match="No space"):
        write_events(path, events)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["e.npz"]
    for wrong, said in (("a.xyz", "suffix '.xyz'; end its name in one of .h5"), ("a", "a name without suffix")):
        with pytest.raises(EventFileError, match=said):
            write_events(tmp_path / wrong, events)
    with pytest.raises(EventFileError, match="format"):
        write_events(path, events, format="EVT9")


@pytest.mark.parametrize(("name", "suffix"), WRITABLE)
def test_content_decides_before_the_name(name, suffix, tmp_path):
    events = Events([1, 2], [0, 1], [1, 0], [True, False], width=2, height=2)
    write_events(tmp_path / f"e{suffix}", events, format=name)
    (tmp_path / f"e{suffix}").rename(tmp_path / "e.dat")
    back, report = read_events_report(tmp_path / "e.dat", "strict")
    assert back == events and report.format == name


@pytest.mark.parametrize(("name", "suffix"), WRITABLE)
def test_caller_overrides_geometry_and_it_is_checked(name, suffix, tmp_path):
    events = Events([1, 2], [0, 9], [3, 0], [True, False], width=16, height=16)
    path = tmp_path / f"e{suffix}"
    write_events(path, events, format=name)
    assert read_events(path, width=10, height=4).shape == (4, 10)
    with pytest.raises(EventFileError, match="sensor is 9 x 4"):
        read_events(path, width=9, height=4)
    kept, report = read_events_report(path, width=9, height=4)
    assert kept.t_us.tolist() == [1] and report.faults == {"out_of_range": 1}
    for wrong in ({"width": 4}, {"width": 0, "height": 4}):
        with pytest.raises(EventFileError):
            read_events(path, **wrong)


def write_raw(path: Path, header: str, words: list[int], dtype: str) -> Path:
    path.write_bytes(header.encode() + np.array(words, dtype).tobytes())
    return path


def test_header_t0_is_added(tmp_path):
    path = write_raw(
        tmp_path / "a.raw", "% evt 2.0\n% geometry 8x8\n% t0 -400\n", [0x80000001, 0x1040_0801], "<u4"
    )
    events = read_events(path)
    assert events.t_us.tolist() == [64 + 1 - 400] and (events.x[0], events.y[0], events.p[0]) == (1, 1, True)


@pytest.mark.parametrize(
    ("header", "shape", "source"),
    [
        ("% evt 3.0\n% geometry 320x200\n", (200, 320), "header"),
        ("% format EVT3;height=200;width=320\n", (200, 320), "header"),
        ("% evt 3.0\n% width 320\n% height 200\n", (200, 320), "header"),
        ("% evt 3.0\n% plugin_name hal_plugin_gen3_fx3\n", (480, 640), "camera"),
        ("% evt 3.0\n% plugin_name hal_plugin_imx636_evk4\n% end\n", (720, 1280), "camera"),
        ("% evt 3.0\n", (720, 1280), "assumed"),
    ],
)
def test_geometry_comes_from_the_header(header, shape, source, tmp_path):
    events, report = read_events_report(
        write_raw(tmp_path / "a.raw", header, [0x8000, 0x6001, 3, 0x2802], "<u2")
    )
    assert (events.shape, report.geometry_from) == (shape, source)
    assert (events.t_us[0], events.x[0], events.y[0], events.p[0]) == (1, 2, 3, True)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("% evt 3.0\n% format EVT2;width=4;height=4\n", "EVT3 and EVT2"),
        ("% evt 3.0\n% geometry 4x4\n% format EVT3;width=5;height=4\n", "after one of"),
        ("% evt 3.0\n% geometry 0x4\n", "0 x 4"),
        ("% evt 3.0\n% geometry 9999x4\n", "9999"),
        ("% evt 3.0\n% geometry wide\n", "WIDTHxHEIGHT"),
        ("% evt 3.0\n% geometry 4x4\n% t0 soon\n", "t0"),
        ("% evt 3.0\n% geometry 4x4\n% t0 9223372036854775807\n", "t0"),
        ("% evt 3.0\n% geometry 4x4\n% note \x01\n", "control"),
        ("% evt 3.0\n% geometry 4x4\n% events 7\n", "announces 7"),
    ],
)
def test_contradicting_headers_are_errors(header, said, tmp_path):
    path = write_raw(tmp_path / "a.raw", header, [0x8000, 0x6001, 3, 0x2802], "<u2")
    with pytest.raises(EventFileError, match=said):
        read_events(path)
    events, report = read_events_report(path)
    assert not report.clean and len(events) <= 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([0x8000, 0x6001, 0x2802], "before the first time or row"),
        ([0x0003, 0x2802], "before the first time or row"),
        ([0x8000, 0x6001, 0x0003, 0x4001], "before the first time or row"),
        ([0x8000, 0x1000], "unknown word type 0x1"),
        ([0x8000, 0x6001, 0x0003, 0x2804], "sensor is 4 x 4"),
        ([0x8000, 0x6001, 0x0004, 0x2800], "sensor is 4 x 4"),
        ([0x8000, 0x6001, 0x0003, 0x3802, 0x4007], "sensor is 4 x 4"),
        ([0x8000, 0x6400, 0x6010], "earlier"),
        ([0x8005, 0x8004], "clock that runs backwards"),
    ],
)
def test_evt3_words_out_of_place_are_errors(words, said, tmp_path):
    path = write_raw(tmp_path / "a.raw", "% evt 3.0\n% geometry 4x4\n", words, "<u2")
    with pytest.raises(EventFileError, match=said) as raised:
        read_events(path)
    offset = int(str(raised.value).split("byte ")[1].split(":")[0])
    assert 10 <= offset < path.stat().st_size and str(path) in str(raised.value)
    assert not read_events_report(path)[1].clean


def test_evt3_jitter_of_a_camera_is_clamped(tmp_path):
    words = [0x8000, 3, 0x600B, 0x2001, 0x6000, 0x2002, 0x600C, 0x2003]
    path = write_raw(tmp_path / "a.raw", "% evt 3.0\n% geometry 4x4\n", words, "<u2")
    assert read_events(path).t_us.tolist() == [11, 11, 12]


def camera_words(seed: int, has_vectors: bool, jitter_us: int) -> np.ndarray:
    """Return 30,000 EVT3 words as a camera sends them: rows, single events, vectors, times that waver."""
    draw = np.random.default_rng(seed)
    likely = np.array([3, 8, has_vectors, 2 * has_vectors, has_vectors, 3, 0.02, 0.01, 0.01])
    kinds = draw.choice([0, 2, 3, 4, 5, 6, 8, 7, 14], 30_000, p=likely / likely.sum())
    values = draw.integers(0, 4096, len(kinds))
    values[kinds == 0] = draw.integers(0, 720, np.sum(kinds == 0))
    for kind in (2, 3):
        signs = draw.integers(0, 2, np.sum(kinds == kind)) << 11
        values[kinds == kind] = draw.integers(0, 700, np.sum(kinds == kind)) | signs
    high, time_us = 0, 0.0
    for place in np.flatnonzero((kinds == 6) | (kinds == 8)):
        time_us += draw.exponential(2.0)
        if int(time_us) >> 12 != high or kinds[place] == 8:
            high = int(time_us) >> 12
            kinds[place], values[place] = 8, high
        else:
            values[place] = max(int(time_us) - draw.integers(0, jitter_us + 1) - (high << 12), 0)
    return np.concatenate([[0x8000, 0x6000, 0x0005, 0x3007], kinds << 12 | values])


@pytest.mark.parametrize("jitter_us", [0, 5, 70])
@pytest.mark.parametrize("has_vectors", [False, True])
def test_evt3_is_read_quickly_as_it_is_with_care(has_vectors, jitter_us, tmp_path):
    """A trigger edge among a thousand words has them decoded one by one: nothing may come out differently."""
    for seed in range(4):
        words = camera_words(seed, has_vectors, jitter_us)
        edges = np.insert(words, np.arange(100, len(words), 1000), 0xA001)
        head = "% evt 3.0\n% geometry 1280x720\n"
        quick, found = read_events_report(write_raw(tmp_path / "quick.raw", head, words, "<u2"))
        careful, noted = read_events_report(write_raw(tmp_path / "careful.raw", head, edges, "<u2"))
        assert quick == careful and found.faults == noted.faults and noted.triggers == 30
        assert len(quick) > 10_000 and found.clean == (jitter_us < 64)


def evt2_words(draw: np.random.Generator, count: int, every: int, kinds: list[int]) -> np.ndarray:
    """Return EVT2 words: events in order of time, a word of the clock about every `every`, and others."""
    high = np.cumsum(draw.random(count) * every < 1)
    low = draw.integers(0, 64, count)
    low = low[np.lexsort((low, high))]
    events = draw.integers(0, 2, count) << 28 | low << 22 | draw.integers(0, 1280, count) << 11
    words = (events | draw.integers(0, 720, count)).tolist()
    starts = np.flatnonzero(np.diff(high, prepend=-1))
    mixed = {int(at): [0x8000_0000 | int(high[at])] for at in starts}
    for kind in kinds:
        at = int(draw.integers(1, count))
        mixed.setdefault(at, []).append(kind << 28 | int(draw.integers(0, 1 << 20)))
    return np.array([word for at in range(count) for word in (*mixed.get(at, []), words[at])], np.int64)


@pytest.mark.parametrize("every", [1, 7, 60, 500, 30_000])
def test_evt2_is_read_quickly_as_it_is_with_care(every, tmp_path):
    """Among few and many words of the clock, in chunks with and without what has them decoded one by one."""
    draw = np.random.default_rng(every)
    head = "% evt 2.0\n% geometry 1280x720\n"
    for kinds in ([], [10], [10, 10, 14, 15]):
        words = evt2_words(draw, 20_000, every, kinds)
        t_us, x, y, p, high = [], [], [], [], 0
        for word in words.tolist():  # as slow and as obvious as can be
            if word >> 28 == 8:
                high = word & 0xFFFFFFF
            elif word >> 28 < 2:
                t_us.append(high << 6 | word >> 22 & 63)
                x.append(word >> 11 & 0x7FF)
                y.append(word & 0x7FF)
                p.append(word >> 28 == 1)
        events, report = read_events_report(write_raw(tmp_path / "a.raw", head, words, "<u4"))
        assert report.clean and report.triggers == kinds.count(10)
        assert events == Events(t_us, x, y, p, width=1280, height=720)
        assert Events.concatenate(list(iter_events(tmp_path / "a.raw", n_events=777))) == events
    at = np.flatnonzero(words >> 28 < 2)[9_000]
    words[at] = words[at] & ~0x7FF | 720  # a row that the sensor has not
    _, report = read_events_report(write_raw(tmp_path / "b.raw", head, words, "<u4"))
    assert report.faults == {"out_of_range": 1} and report.events == 19_999


@pytest.mark.parametrize("every", [1, 40, 2_000])
@pytest.mark.parametrize("swapped", [False, True])
def test_evt21_is_read_quickly_as_it_is_with_care(swapped, every, tmp_path):
    """Masks of one column and of many, at the sensor's edge too, empty ones, and other words among them."""
    draw = np.random.default_rng(every)
    layout = "legacy" if swapped else "little"
    for width, kinds in ((1280, []), (2048, []), (2048, [10, 10, 14, 15])):
        fields = evt2_words(draw, 6_000, every, kinds)
        masks = 1 << draw.integers(0, 32, len(fields))
        many = draw.random(len(fields)) < 0.4
        masks[many] = draw.integers(1 << 20, 1 << 32, int(many.sum())) >> draw.integers(0, 20)
        masks[draw.integers(0, len(fields), 2 * len(kinds))] = 0
        is_event, column = fields >> 28 < 2, fields >> 11 & 0x7FF
        last = np.floor(np.log2(np.maximum(masks, 1))).astype(int)
        fields[is_event] += np.clip(width - 1 - last - column, None, width // 3)[is_event] << 11
        t_us, x, y, p, high = [], [], [], [], 0
        for word, mask in zip(fields.tolist(), masks.tolist(), strict=True):
            if word >> 28 == 8:
                high = word & 0xFFFFFFF
            for bit in range(32 * (word >> 28 < 2)):
                if mask >> bit & 1:
                    t_us.append(high << 6 | word >> 22 & 63)
                    x.append((word >> 11 & 0x7FF) + bit)
                    y.append(word & 0x7FF)
                    p.append(word >> 28 == 1)
        upper, lower = (masks, fields) if swapped else (fields, masks)
        words = upper.astype(np.uint64) << np.uint64(32) | lower.astype(np.uint64)
        head = f"% evt 2.1\n% format EVT21;endianness={layout};width={width};height=720\n"
        path = tmp_path / "a.raw"
        path.write_bytes(head.encode() + b"% end\n" + words.astype("<u8").tobytes())
        events, report = read_events_report(path)
        assert report.clean and report.triggers == kinds.count(10)
        assert events == Events(t_us, x, y, p, width=width, height=720)
        assert Events.concatenate(list(iter_events(path, n_events=777))) == events
        at = int(np.flatnonzero(is_event & (masks > 0))[3_000])
        words[at] |= np.uint64(0x7FF << 32 * (not swapped))  # a row that the sensor has not
        path.write_bytes(head.encode() + b"% end\n" + words.astype("<u8").tobytes())
        assert read_events_report(path)[1].faults == {"out_of_range": int(masks[at]).bit_count()}


def test_salvage_drops_an_outlier_not_what_follows_it(tmp_path):
    times = [0, 100, 200, 300, 400, 500]
    words = [w for t in times for w in (0x8000_0000 | (t >> 6), ((t & 63) << 22))]
    words[4] ^= 1 << 20  # one flipped bit of the clock: 67 s too late
    path = write_raw(tmp_path / "a.raw", "% evt 2.0\n% geometry 4x4\n", words, "<u4")
    with pytest.raises(EventFileError, match="backwards"):
        read_events(path)
    events, report = read_events_report(path)
    assert events.t_us.tolist() == [0, 100, 300, 400, 500]
    assert report.faults == {"backwards": 1} and "backwards" in str(report)


def test_triggers_and_vendor_words_are_no_events(tmp_path):
    words = [0x8000, 0x6001, 0xA001, 0xE123, 0x7001, 0xF001, 0x0003, 0x2001]
    path = write_raw(tmp_path / "a.raw", "% evt 3.0\n% geometry 4x4\n", words, "<u2")
    events, report = read_events_report(path, "strict")
    assert len(events) == 1 and report.triggers == 1


@pytest.mark.parametrize(
    ("name", "count", "shape", "span_us"),
    [
        ("faery_evt2.raw", 521_252, (480, 640), None),
        ("expelliarmus_evt2_sample.raw", 539_481, (480, 640), None),
        ("expelliarmus_evt3_sample.raw", 219_596, (720, 1280), 8_801),
    ],
)
def test_real_recordings(shared_data, name, count, shape, span_us):
    events, report = read_events_report(shared_data / "recordings" / name, "strict")
    assert (len(events), events.shape, report.geometry_from) == (count, shape, "camera")
    Events(
        events.t_us, events.x, events.y, events.p, events.width, events.height
    )  # the checked constructor agrees
    if span_us is not None:
        assert events.duration_us == span_us


def test_evt3_agrees_with_another_decoder(shared_data, tmp_path):
    evt3 = pytest.importorskip("evt3")
    written = tmp_path / "w.raw"
    draw = np.random.default_rng(3)
    times = np.sort(draw.integers(0, 40_000_000, 5000))
    columns = (
        draw.integers(0, 1280, 5000),
        draw.integers(0, 720, 5000),
        draw.integers(0, 2, 5000).astype(bool),
    )
    write_events(written, Events(times, *columns, width=1280, height=720))
    for path in (shared_data / "recordings" / "expelliarmus_evt3_sample.raw", written):
        ours, theirs = read_events(path), evt3.decode_file(str(path))
        np.testing.assert_array_equal(ours.x, theirs.x)
        np.testing.assert_array_equal(ours.y, theirs.y)
        np.testing.assert_array_equal(ours.p, theirs.p.astype(bool))
        np.testing.assert_array_equal(ours.t_us, np.maximum.accumulate(theirs.t.astype(np.int64)))


def test_captures_share_the_clock_of_their_frames(shared_data):
    events = read_events(shared_data / "captures" / "near_A" / "events.raw")
    assert events.shape == (100, 160) and (events.t_us[0], events.t_us[-1]) == (4_000, 8_000_000)
    pytest.importorskip("aedat")
    events = read_events(shared_data / "captures" / "far_A" / "events.aedat4")
    assert events.shape == (100, 160) and (events.t_us[0], events.t_us[-1]) == (4_000, 8_000_000)


def test_aedat4_without_its_package_names_the_cure(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "aedat", None)
    path = tmp_path / "a.aedat4"
    path.write_bytes(b"#!AER-DAT4.0\r\n" + bytes(100))
    with pytest.raises(EvnlosError, match=r"pip install evnlos\[aedat\].*convert"):
        read_events(path)


def test_hdf5_has_the_columns_of_dsec(tmp_path):
    h5py = pytest.importorskip("h5py")
    events = Events([5_000, 5_999, 6_000, 8_100], [0, 1, 2, 3], [0] * 4, [1, 0, 1, 0], width=4, height=1)
    write_events(tmp_path / "e.h5", events)
    with h5py.File(tmp_path / "e.h5") as file:
        kinds = {name: file["events"][name].dtype.str for name in "xytp"}
        assert kinds == {"x": "<u2", "y": "<u2", "t": "<u4", "p": "|u1"}
        assert all(file["events"][name].fletcher32 for name in "xytp") and file["ms_to_idx"].fletcher32
        assert int(file["t_offset"][()]) == 5_000 and file["events/t"][:].tolist() == [0, 999, 1000, 3100]
        index = file["ms_to_idx"][:].tolist()
        assert index == [0, 2, 3, 3, 4]


def test_a_foreign_dsec_file_without_geometry(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, column in {"x": [3, 1], "y": [0, 6], "t": [10, 20], "p": [0, 1]}.items():
            file[f"events/{name}"] = np.array(column)
        file["t_offset"] = 1_000
    events, report = read_events_report(tmp_path / "e.h5", "strict")
    assert events == Events([1010, 1020], [3, 1], [0, 6], [0, 1], width=4, height=7)
    assert report.geometry_from == "events"
