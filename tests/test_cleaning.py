"""What the scene did not cause is left out of a recording, and the rest stays."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from evnlos.cameras import EventPixel, simulate_events
from evnlos.cli import main
from evnlos.errors import ConfigError, DataError
from evnlos.events import (
    Cleaner,
    CleanOptions,
    clean_events,
    crop_events,
    find_hot_pixels,
    keep_supported,
    read_events,
    remove_flicker,
    write_events,
)
from evnlos.events.cleaning import find_flicker, flicker_line
from evnlos.events.filters import without_pixels
from evnlos.types import Events

BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1))


def scattered(seed: int, count: int = 400, width: int = 12, height: int = 9, span_us: int = 2_000) -> Events:
    draw = np.random.default_rng(seed)
    return Events(
        np.sort(draw.integers(0, span_us, count)), draw.integers(0, width, count),
        draw.integers(0, height, count), draw.integers(0, 2, count), width, height,
    )  # fmt: skip


def merged(*streams: Events) -> tuple[Events, np.ndarray]:
    """Return streams as one, and from which stream each event is."""
    columns = {
        name: np.concatenate([one.columns()[name] for one in streams]) for name in ("t_us", "x", "y", "p")
    }
    order = np.argsort(columns["t_us"], kind="stable")
    origin = np.repeat(np.arange(len(streams)), [len(one) for one in streams])[order]
    columns = {name: column[order] for name, column in columns.items()}
    return Events(**columns, width=streams[0].width, height=streams[0].height), origin


@pytest.mark.parametrize(("window", "sides"), [(20, 1), (80, 2), (160, 2), (300, 3), (600, 4)])
def test_the_background_filter_equals_the_slow_one(window, sides):
    events = scattered(window)
    x, y, t = (column.astype(int) for column in (events.x, events.y, events.t_us))
    near = (abs(t[:, None] - t) <= window) & (events.p[:, None] == events.p)
    right, down = x[:, None] - x, y[:, None] - y
    support = sum((near & (right == u) & (down == v)).any(axis=1).astype(int) for u, v in BESIDE)
    kept = support >= sides
    before = events.x.copy()
    assert 0 < kept.sum() < len(events) and keep_supported(events, window, sides) == events[kept]
    np.testing.assert_array_equal(events.x, before)


@pytest.mark.parametrize("hertz", [900.0, 3100.0])
def test_the_comb_filter_equals_the_slow_one(hertz):
    events = scattered(int(hertz), count=600, width=4, height=3, span_us=6_000)
    period, slack = round(1e6 / hertz), round(0.1e6 / hertz)
    gone, repeated = np.zeros(len(events), bool), np.zeros(len(events), bool)
    for i in range(len(events)):
        candidates = []
        for j in range(i):
            same = (events.x[i], events.y[i], events.p[i]) == (events.x[j], events.y[j], events.p[j])
            off_by = abs(int(events.t_us[i] - events.t_us[j]) - period)
            between = slice(j + 1, i)
            pixel = (events.x[between] == events.x[i]) & (events.y[between] == events.y[i])
            turned = (pixel & (events.p[between] != events.p[i])).any()
            if same and off_by <= slack and turned and not repeated[j]:
                candidates.append((off_by, -j))
        if candidates:
            best = -min(candidates)[1]
            gone[i] = gone[best] = repeated[best] = True
    assert 0 < gone.sum() < len(events)
    assert remove_flicker(events, hertz) == events[~gone]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), cuts=st.lists(st.integers(0, 400), max_size=6))
@example(seed=3, cuts=[0, 0, 400])
def test_pieces_are_cleaned_like_the_whole(seed, cuts):
    events = scattered(seed, span_us=8_000)
    edges = [0, *sorted(cuts), len(events)]
    pieces = [events[a:b] for a, b in pairwise(edges)]
    options = CleanOptions(hot_pixel_factor=2.0, flicker_hz=1500.0, background_us=90)
    cleaner = Cleaner(options)
    cleaner.look(pieces)
    parts = list(cleaner.clean(pieces))
    whole, report = clean_events(events, options)
    assert sum(map(len, parts)) == len(whole) and report == cleaner.report
    assert [int(t) for part in parts for t in part.t_us] == whole.t_us.tolist()
    assert [int(x) for part in parts for x in part.x] == whole.x.tolist()
    left_out = report.hot_events + report.flicker_events + report.background_events
    assert report.kept == len(whole) == report.events - left_out
    one_by_one = without_pixels(events, find_hot_pixels(events, 2.0))
    assert whole == keep_supported(remove_flicker(one_by_one, 1500.0), 90)


def test_hot_pixels_equal_the_slow_ones_and_go():
    hot_at = Events(np.arange(500) * 4, np.full(500, 3), np.full(500, 2), np.zeros(500, bool), 12, 9)
    mixed, _ = merged(scattered(1), hot_at)
    found = find_hot_pixels(mixed, 10)
    counts = np.zeros((9, 12), int)
    np.add.at(counts, (mixed.y, mixed.x), 1)
    for row in range(9):
        for column in range(12):
            block = counts[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3].ravel().tolist()
            block.remove(counts[row, column])
            expected = counts[row, column] > 20 and counts[row, column] > 10 * max(np.median(block), 1)
            assert found[row, column] == expected
    assert found.sum() == 1 and found[2, 3]
    assert len(without_pixels(mixed, found)) == len(mixed) - counts[2, 3]


def test_cropping_moves_the_corner_to_zero():
    events = scattered(4)
    part = crop_events(events, 2, 3, 5, 4)
    inside = (events.x >= 2) & (events.x < 7) & (events.y >= 3) & (events.y < 7)
    np.testing.assert_array_equal(part.t_us, events.t_us[inside])
    np.testing.assert_array_equal(part.x, events.x[inside] - 2)
    assert part.shape == (4, 5)
    with pytest.raises(ConfigError, match="leaves the sensor"):
        crop_events(events, 8, 0, 5, 4)


@pytest.mark.parametrize("hertz", [99.2, 100.0, 119.87])
@pytest.mark.parametrize("seconds", [1.0, 10.0])
def test_the_frequency_of_the_lamps_is_found(hertz, seconds):
    """Poisson events, 20 % modulated, of lamps on two phases of the mains."""
    draw = np.random.default_rng(int(hertz))
    t = np.sort(draw.uniform(0, seconds, int(8_000 * seconds)))
    y = draw.integers(0, 32, len(t))
    on = draw.random(len(t)) < 0.5 + 0.2 * np.sin(2 * np.pi * (hertz * t + (y >= 16) / 3))
    events = Events((t * 1e6).astype(int), draw.integers(0, 48, len(t)), y, on, 48, 32)
    found = find_flicker(events)
    assert (
        found is not None and found.is_there and found.frequency_hz == pytest.approx(hertz, abs=0.15 / seconds)
    )
    still = find_flicker(Events(events.t_us, events.x, events.y, draw.random(len(t)) < 0.6, 48, 32))
    assert still is not None and not still.is_there


@pytest.mark.parametrize("shape", [(9, 12), (3, 2), (260, 346)])
def test_rates_are_those_of_counting_one_by_one(shape):
    events = scattered(3, 20_000, shape[1], shape[0], 3_999_999)
    counts = np.zeros((2, 16, 4000))
    for t_us, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True):
        part = 4 * (4 * int(y) // shape[0]) + 4 * int(x) // shape[1]
        counts[int(p), part, (t_us - events.t_us[0]) // 1000] += 1
    assert find_flicker(events) == flicker_line(counts[..., : (events.t_us[-1] - events.t_us[0]) // 1000 + 1])


def test_too_short_for_a_frequency():
    assert find_flicker(scattered(1)) is None and find_flicker(Events.empty(3, 2)) is None
    with pytest.raises(DataError, match="500 ms are needed"):
        flicker_line(np.zeros((2, 1, 100)))
    cleaned, report = clean_events(scattered(1))
    assert report.flicker_hz is None and cleaned == scattered(1)


@pytest.fixture(scope="module")
def lamps() -> tuple[Events, np.ndarray]:
    """Two seconds of a disc that moves (0), of a wall in part under lamps at 100.4 Hz (1), of noise (2)."""
    times = np.arange(0, 2, 4e-4)
    y, x = np.mgrid[:32, :48]
    disc = 40 + 120 / (1 + np.exp(np.hypot(x - 8 - 14 * times[:, None, None], y - 16) - 6))
    ripple = np.where(x < 12, 0.15, 0.0) * np.sin(2 * np.pi * 100.4 * times)[:, None, None]
    pixels = [
        EventPixel(on, 0.12, sigma, 0, 0, 0, initial_phase="rest") for on, sigma in ((0.1, 0.02), (0.12, 0.01))
    ]
    signal = simulate_events(disc.astype(np.float32), times, pixels[0], seed=1)
    flicker = simulate_events(
        (90 * (1 + ripple)).astype(np.float32),
        times,
        pixels[1],
        seed=2,
    )
    draw, count = np.random.default_rng(3), 3000
    noise = Events(
        np.sort(draw.integers(0, 2_000_000, count)), draw.integers(0, 48, count), draw.integers(0, 32, count),
        draw.integers(0, 2, count), 48, 32,
    )  # fmt: skip
    return merged(signal, flicker, noise)


def test_lamps_and_noise_go_and_what_moves_stays(lamps):
    events, origin = lamps
    assert np.bincount(origin).min() > 2000
    kept, report = clean_events(events, CleanOptions(background_us=40_000))
    assert report.flicker_hz == pytest.approx(100.4, abs=0.05)
    # Labels travel along as a column that no filter looks at.
    labelled = Events(**{**events.columns(), "adc": origin.astype(np.uint16)}, width=48, height=32)
    stays, _ = clean_events(labelled, CleanOptions(background_us=40_000))
    assert stays.t_us.tolist() == kept.t_us.tolist() and stays.adc is not None
    share = np.bincount(stays.adc, minlength=3) / np.bincount(origin, minlength=3)
    assert share[0] > 0.9 and share[1] < 0.05 and share[2] < 0.2, share


def test_the_command_cleans_any_file(lamps, tmp_path, capsys):
    raw, out = tmp_path / "lamps.raw", tmp_path / "clean.npz"
    write_events(raw, lamps[0])
    main(["clean", str(raw), "--out", str(out), "--background-ms", "auto", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["flicker_hz"] == pytest.approx(100.4, abs=0.05) and found["background_us"] > 1000
    assert found["kept"] == len(read_events(out)) < found["events"] == len(lamps[0])
    assert sum(found[name] for name in ("kept", "hot_events", "flicker_events", "background_events")) == len(
        lamps[0]
    )
    main(
        [
            "clean",
            str(raw),
            "--out",
            str(out),
            "--force",
            "--hot-factor",
            "none",
            "--flicker",
            "none",
            "--stop",
            "0.5",
        ]
    )
    assert capsys.readouterr().out.endswith("left out: nothing\n")
    half = read_events(out)
    assert half == lamps[0][lamps[0].t_us < int(lamps[0].t_us[0]) + 500_000]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--hot-factor", "0.5"], "0.5; give more than 1"),
        (["--flicker", "0"], "0 Hz; give 1 to 5000 Hz"),
        (["--flicker", "nan"], "nan"),
        (["--background-ms", "0"], "--background-ms is 0; give"),
        (["--background-ms", "inf"], "inf"),
        (["--background-ms", "often"], "often"),
        (["--background-sides", "5"], "5 sides"),
        (["--box", "0", "0", "500", "5"], "leaves the sensor of 12 x 9"),
        (["--background-ms", "auto", "--start", "0.0018"], "most pixels sent no event"),
    ],
)
def test_what_cannot_be_is_one_line_and_writes_nothing(words, said, tmp_path: Path, capsys):
    write_events(tmp_path / "a.npz", scattered(1))
    with pytest.raises(SystemExit) as end:
        main(["clean", str(tmp_path / "a.npz"), "--out", str(tmp_path / "b.npz"), *words])
    err = capsys.readouterr().err
    assert end.value.code == 2 and said in err and len(err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_nothing_that_stays_is_an_empty_recording_of_the_same_sensor(tmp_path):
    write_events(tmp_path / "a.npz", Events([5, 900], [0, 9], [0, 8], [1, 0], 12, 9))
    main(["clean", str(tmp_path / "a.npz"), "--out", str(tmp_path / "b.npz"), "--background-ms", "1"])
    empty = read_events(tmp_path / "b.npz")
    assert len(empty) == 0 and empty.shape == (9, 12)
