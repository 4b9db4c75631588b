"""Every representation against its slow reference or a count by hand; inputs untouched."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evnlos.errors import DataError
from evnlos.events import (
    TRACE_TAUS,
    RunningTrace,
    TraceLaw,
    edges_from_count,
    edges_from_rate,
    event_frame,
    event_histogram,
    event_trace,
    suggest_tau_us,
    surface_with_trace,
    threshold_ordinal_surface,
    time_surface,
    voxel_grid,
)
from evnlos.types import Events
from surface_reference import causal_trace_reference, event_trace_reference, time_surface_reference


def random_events(seed: int, count: int = 300, width: int = 9, height: int = 7, span_us: int = 1000) -> Events:
    draw = np.random.default_rng(seed)
    return Events(
        np.sort(draw.integers(0, span_us, count)),
        draw.integers(0, width, count),
        draw.integers(0, height, count),
        draw.integers(0, 2, count).astype(bool),
        width=width,
        height=height,
    )


EDGES = np.array([100, 350, 351, 600, 2000])


NEIGHBOURHOODS = [("sae", 1, "sum")] + [
    (mode, radius, projection)
    for mode in ("context", "hots")
    for radius in (0, 1, 3)
    for projection in ("sum", "last", "max")
]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("carry", [True, False])
@pytest.mark.parametrize(("mode", "radius", "projection"), NEIGHBOURHOODS)
def test_time_surface_equals_its_reference(seed, carry, mode, radius, projection):
    events = random_events(seed)
    options = {
        "carry": carry,
        "radius": radius,
        "projection": projection,
        "shape": "disc" if seed == 1 else "box",
        "border": "zero" if seed == 2 else "crop",
        "include_self": seed == 2,
    }
    fast = time_surface(events, EDGES, 90.0, mode, **options)
    slow = time_surface_reference(events, EDGES, 90.0, mode, **options)
    assert fast.dtype == np.float32 and fast.shape == (4, 2, 7, 9)
    np.testing.assert_allclose(fast, slow, rtol=3e-6, atol=1e-7)
    assert slow.max() > 0


@given(
    st.integers(0, 2**31),
    st.sampled_from(["sae", "context", "hots"]),
    st.integers(0, 4),
    st.sampled_from(["box", "disc"]),
    st.booleans(),
    st.booleans(),
    st.integers(-(2**40), 2**40),
)
@settings(max_examples=40, deadline=None)
def test_time_surface_anywhere_in_time(seed, mode, radius, shape, carry, include_self, shift):
    events = random_events(seed, count=60, width=5, height=4)
    options = {"radius": radius, "shape": shape, "carry": carry, "include_self": include_self}
    moved = Events(events.t_us + shift, events.x, events.y, events.p, 5, 4)
    fast = time_surface(moved, EDGES + shift, 50.0, mode, **options)
    slow = time_surface_reference(events, EDGES, 50.0, mode, **options)
    np.testing.assert_allclose(fast, slow, rtol=3e-6, atol=1e-7)


def test_sae_by_hand_and_its_edges():
    events = Events([10, 20, 30], [0, 0, 1], [0, 0, 0], [True, True, False], width=2, height=1)
    surface = time_surface(events, [10, 20, 30], tau_us=10.0)
    # The event at 10 us lies before the first grid and is context; the one at 20 us closes the first grid.
    np.testing.assert_allclose(surface[:, 0, 0, 0], [1.0, np.exp(-1)], rtol=1e-6)
    np.testing.assert_allclose(surface[:, 1, 0, 1], [0.0, 1.0], rtol=1e-6)
    blank = time_surface(events[:1], [10, 20, 30], tau_us=10.0, carry=False)
    assert not blank.any()


def test_paper_surface_taken_literally_is_a_count():
    events = random_events(5)
    literal = time_surface(events, [-1, 1000], 10.0, "context", radius=2, include_self=True)
    np.testing.assert_array_equal(literal, event_histogram(events))


def test_long_streams_do_not_overflow():
    day_us = 86_400_000_000
    events = Events([0, day_us, 2 * day_us], [0, 0, 0], [0, 0, 0], [True] * 3, width=1, height=1)
    surface = time_surface(
        events, [-1, day_us, 2 * day_us + 10], tau_us=float(day_us), mode="context", radius=0
    )
    np.testing.assert_allclose(surface[:, 0, 0, 0], [np.exp(-1), np.exp(-1)], rtol=1e-6)


@pytest.mark.parametrize("mode", ["sae", "context", "hots"])
def test_empty_streams_and_single_pixels(mode):
    assert not time_surface(Events.empty(3, 2), [0, 5], 1.0, mode).any()
    one = Events([1], [0], [0], [True], width=1, height=1)
    assert time_surface(one, [0, 1], 1.0, mode, include_self=True, radius=5).tolist() == [[[[1.0]], [[0.0]]]]


@pytest.mark.parametrize(
    "wrong",
    [
        {"edges_us": [0]},
        {"edges_us": [5, 5]},
        {"edges_us": [0, 0.5]},
        {"edges_us": [0, float("nan")]},
        {"tau_us": 0.0},
        {"tau_us": float("nan")},
        {"mode": "other"},
        {"radius": -1},
        {"shape": "star"},
        {"border": "wrap"},
        {"projection": "mean"},
    ],
)
def test_time_surface_refuses(wrong):
    arguments = {"edges_us": [0, 10], "tau_us": 1.0, "mode": "context"} | wrong
    with pytest.raises(DataError) as raised:
        time_surface(random_events(0), **arguments)
    assert "\n" not in str(raised.value)


def test_nothing_writes_into_the_events():
    events = random_events(1)
    before = {name: column.copy() for name, column in events.columns().items()}
    for column in events.columns().values():
        column.setflags(write=False)
    for mode in ("sae", "context", "hots"):
        time_surface(events, EDGES, 5.0, mode)
    event_trace(events, EDGES, 5.0)
    voxel_grid(events, 4)
    event_histogram(events)
    event_frame(events, mode="last")
    threshold_ordinal_surface(events)
    for name, column in events.columns().items():
        np.testing.assert_array_equal(column, before[name])


@pytest.mark.parametrize("seed", range(4))
def test_voxel_grid_equals_its_equation(seed):
    events = random_events(seed)
    bins = seed + 1
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    slow = np.zeros((bins, events.height, events.width))
    for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True):
        place = (bins - 1) * (t - first) / (last - first)
        for b in range(bins):
            slow[b, y, x] += (1 if p else -1) * max(0.0, 1 - abs(b - place))
    np.testing.assert_allclose(voxel_grid(events, bins), slow, atol=2e-5)


def test_voxel_grid_window_and_ends():
    events = random_events(3)
    part = voxel_grid(events, 3, 200, 700)
    inside = events[(events.t_us >= 200) & (events.t_us <= 700)]
    assert part.sum() == pytest.approx(np.where(inside.p, 1, -1).sum(), abs=1e-3)
    assert not voxel_grid(Events.empty(2, 2), 3).any()
    one = Events([7], [0], [0], [False], width=1, height=1)
    assert voxel_grid(one, 2).ravel().tolist() == [-1.0, 0.0]
    for wrong in ({"bins": 0}, {"bins": 2, "start_us": 9, "stop_us": 8}):
        with pytest.raises(DataError):
            voxel_grid(events, **wrong)


def test_histogram_and_frames_by_counting():
    events = random_events(4)
    counts = event_histogram(events, EDGES)
    frames = event_frame(events, EDGES)
    last = event_frame(events, EDGES, "last")
    for grid in range(len(EDGES) - 1):
        part = events.between(EDGES[grid], EDGES[grid + 1])
        expected = np.zeros((2, 7, 9))
        newest = np.zeros((7, 9))
        for x, y, p in zip(part.x, part.y, part.p, strict=True):
            expected[0 if p else 1, y, x] += 1
            newest[y, x] = 1 if p else -1
        np.testing.assert_array_equal(counts[grid], expected)
        np.testing.assert_array_equal(frames[grid], expected[0] - expected[1])
        np.testing.assert_array_equal(last[grid], newest)
    assert event_histogram(events).sum() == len(events)


@pytest.mark.parametrize("radius", [1, 3])
def test_threshold_ordinal_surface_step_by_step(radius):
    events = random_events(6, count=80)
    floor = max(1, 255 - 2 * (2 * radius + 1))
    slow = np.zeros((7, 9), int)
    for x, y in zip(events.x.astype(int), events.y.astype(int), strict=True):
        near = slow[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
        near -= 1
        near[near < floor] = 0
        slow[y, x] = 255
    np.testing.assert_array_equal(threshold_ordinal_surface(events, radius), slow)


def test_grid_makers():
    assert edges_from_rate(10, 1_000_010, 4).tolist() == [10, 250_010, 500_010, 750_010, 1_000_010]
    events = random_events(0, span_us=100_000)
    edges = edges_from_count(events, 50)
    counts = [len(events.between(a, b)) for a, b in itertools.pairwise(edges)]
    assert sum(counts) == len(events)
    assert max(counts) <= 52 and min(counts[:-1]) >= 48
    assert suggest_tau_us(0.004, 0.02) == pytest.approx(200_000)
    for wrong in (
        lambda: edges_from_rate(0, 10, 1),
        lambda: edges_from_count(events, 0),
        lambda: suggest_tau_us(0, 1),
    ):
        with pytest.raises(DataError):
            wrong()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("law", [TraceLaw(), TraceLaw(spread=5.0, crossing=0.01, noise=0.5, sweeps=2)])
def test_the_trace_is_the_smoother_of_whole_covariances(seed, law):
    draw = np.random.default_rng(seed)
    count = 40
    events = Events(
        2 * np.sort(draw.choice(1000, count, replace=False)),
        draw.integers(0, 3, count),
        draw.integers(0, 2, count),
        draw.integers(0, 2, count).astype(bool),
        width=3,
        height=2,
    )
    edges = np.array([101, 351, 361, 901, 2801])  # events lie before the first; after the last, time goes on
    fast, slow = event_trace(events, edges, 700.0, law), event_trace_reference(events, edges, 700.0, law)
    assert fast.dtype == np.float32 and fast.shape == (4, 2, 2, 3)
    np.testing.assert_allclose(fast, slow, atol=3e-7)
    assert np.abs(slow).max() > 0.5
    causal = event_trace(events, edges, 700.0, law, causal=True)
    assert causal.dtype == np.float32 and np.abs(causal - fast).max() > 0.1
    np.testing.assert_allclose(causal, causal_trace_reference(events, edges, 700.0, law), atol=3e-7)


def test_the_causal_trace_knows_nothing_of_later_events():
    """What is known at an instant stays, whatever comes later, and a stream in pieces is the stream."""
    events, edges = random_events(1), np.array([0, 20, 50, 90])
    whole = surface_with_trace(events, edges, 5.0)
    assert whole.shape == (3, 4, *events.shape)
    np.testing.assert_array_equal(whole[:, :2], time_surface(events, edges, 5.0))
    early = events[events.t_us <= 50]
    np.testing.assert_array_equal(surface_with_trace(early, edges[:3], 5.0), whole[:2])
    running, done = RunningTrace(*events.shape, 5.0 * TRACE_TAUS), 0
    for end in (7, 20, 33, 50):
        count = int(np.searchsorted(events.t_us, end, side="right"))
        running.add(events[done:count])
        done = count
    np.testing.assert_array_equal(running.at(50), whole[1, 2:])
    with pytest.raises(DataError, match="tau_us is 0"):
        RunningTrace(2, 3, 0.0)


def test_the_trace_follows_a_known_light_and_doubts_noise():
    """A wave of 6 thresholds, met exactly, and now and then an event of the other polarity that is none."""
    time_s = np.linspace(0, 8, 80_001)
    wave = 3.05 * (1 - np.cos(2 * np.pi * time_s / 8))
    met, rising, reference = [], [], -0.5
    for k, level in enumerate(wave):
        if abs(level - reference) >= 1:
            met.append(round(time_s[k] * 1e6))
            rising.append(level > reference)
            reference = level
    clean = Events(met, len(met) * [0], len(met) * [0], rising, width=1, height=1)
    edges = np.arange(0, 8_000_001, 200_000)
    on, off = event_trace(clean, edges, 5e6)[:, :, 0, 0].T
    truth = np.interp(edges[1:] * 1e-6, time_s, wave)
    assert np.corrcoef(on - off, truth)[0, 1] > 0.97
    assert (on + off).min() > 0 and (on + off).max() < 1
    # an OFF event a millisecond after an ON one moves the estimate by less than half a threshold
    between = 1
    t_us = int(clean.t_us[between]) + 1000
    dirty = Events(
        np.insert(clean.t_us, between + 1, t_us),
        np.zeros(len(clean) + 1, int),
        np.zeros(len(clean) + 1, int),
        np.insert(clean.p, between + 1, False),
        width=1,
        height=1,
    )
    moved = event_trace(dirty, edges, 5e6)[:, :, 0, 0].T
    assert np.abs(np.diff(moved - np.stack([on, off]), axis=0)).max() < 0.5


def test_the_trace_of_nothing_and_what_it_refuses():
    on, off = event_trace(Events.empty(3, 2), [0, 1000], 100.0)[0]
    np.testing.assert_array_equal(on, off)
    assert 0 < on.max() < 0.5
    for wrong in (
        {"tau_us": 0.0},
        {"edges_us": [5, 5]},
        {"law": TraceLaw(noise=1.0)},
        {"law": TraceLaw(spread=0.0)},
    ):
        with pytest.raises(DataError) as raised:
            event_trace(**({"events": random_events(0), "edges_us": [0, 10], "tau_us": 1.0} | wrong))
        assert "\n" not in str(raised.value)
