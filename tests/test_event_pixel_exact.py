"""The continuous-time pixel against closed forms, laws, its own fine runs, and brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from event_pixel_reference import reference_exact
from evnlos.cameras import EventPixel, EventStream, simulate_events
from evnlos.cameras.pixels.continuous_math import (
    LOG_LINEAR,
    LONGEST_TAU,
    LOW_PASS,
    crossing_time,
    first_crossing,
    is_monotone,
    is_smooth,
    response,
)
from evnlos.cameras.random_numbers import cos_turns, fast_exp, fast_log
from evnlos.cameras.streams import sort_times
from evnlos.errors import ConfigError

QUIET = {"threshold_sigma": 0.0, "leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0, "initial_phase": "rest"}


def _column(values):
    """Return a video of one pixel."""
    return np.asarray(values, dtype=np.float64)[:, None, None]


def _rate(intensity, cutoff_hz):
    return 2 * math.pi * cutoff_hz * (intensity + 20) / 275


def test_ramp_of_light_in_one_step():
    pixel = EventPixel(0.15, 0.15, cutoff_hz=0, **QUIET)
    events = simulate_events(_column([50, 150]), [0.0, 1.0], pixel)
    crossings = 0.15 * np.arange(1, 8)
    assert np.array_equal(events.t_us, np.rint((np.exp(crossings) - 1) * 50 / 100 * 1e6))
    assert events.p.all()
    falling = simulate_events(_column([150, 50]), [0.0, 1.0], pixel)
    assert np.array_equal(falling.t_us, np.rint((1 - np.exp(-crossings)) * 1.5 * 1e6))
    assert not falling.p.any()


def test_ramp_through_the_knee_of_the_log():
    pixel = EventPixel(0.5, 0.5, cutoff_hz=0, **QUIET)
    events = simulate_events(_column([0, 40]), [0.0, 1.0], pixel)
    slope = math.log(20) / 20
    levels = 0.5 * np.arange(1, 8)
    light = np.where(levels <= math.log(20), levels / slope, np.exp(levels))
    assert np.array_equal(events.t_us, np.rint(light / 40 * 1e6))


@pytest.mark.parametrize(("low", "high"), [(60.0, 200.0), (200.0, 60.0), (4.0, 90.0), (90.0, 4.0)])
def test_step_of_light_relaxes_exponentially(low, high):
    """P = L1 - (L1 - L0) exp(-w t): event k comes at -ln(1 - k theta / |L1 - L0|) / w."""
    log = [v * math.log(20) / 20 if v <= 20 else math.log(v) for v in (low, high)]
    rise, rate = abs(log[1] - log[0]), _rate(high, 15.0)
    times = np.concatenate([[0.0, 1e-9], np.linspace(1e-9, 1.0, 201)[1:]])
    events = simulate_events(_column([low] + [high] * 201), times, EventPixel(cutoff_hz=15, **QUIET))
    expected = -np.log(1 - 0.15 * np.arange(1, int(rise / 0.15) + 1) / rise) / rate
    expected = expected[expected < 1.0]
    assert len(events) == len(expected) > 5
    assert np.abs(events.t_us - expected * 1e6).max() <= 1
    assert (events.p == (high > low)).all()


def test_sinusoid_of_log_light_without_filter():
    amplitude, frequency, theta = 1.0, 5.0, 0.15
    times = np.linspace(0, 0.99 / frequency * 5, 20001)
    video = _column(80 * np.exp(amplitude * np.sin(2 * np.pi * frequency * times)))
    events = simulate_events(video, times, EventPixel(theta, theta, cutoff_hz=0, **QUIET))
    top = 6  # levels that are reached above the start, and as many below
    last = 3  # levels -5, -4 and -3 are passed when the video ends at sin(-0.1 pi) = -0.31
    assert int(events.p.sum()) == top + 4 * 2 * top + last
    assert len(events) - int(events.p.sum()) == 5 * 2 * top
    rising = np.arcsin(theta * np.arange(1, top + 1) / amplitude) / (2 * np.pi * frequency)
    assert np.abs(events.t_us[:top] - rising * 1e6).max() < 5


def test_sinusoid_below_the_knee_is_damped_as_the_filter_says():
    """Small light swings about I0 see a filter of fixed rate w: amplitude / sqrt(1 + (omega / w)^2)."""
    level, swing, frequency, cutoff = 10.0, 0.4, 20.0, 100.0
    rate, omega = _rate(level, cutoff), 2 * np.pi * frequency
    damped = swing * math.log(20) / 20 / math.sqrt(1 + (omega / rate) ** 2)
    times = np.linspace(0, 2.0, 20001)
    video = _column(level + swing * np.minimum(times / 0.5, 1.0) * np.sin(omega * times))
    for theta, a_period in ((0.98 * damped, 4), (1.02 * damped, 0)):
        events = simulate_events(video, times, EventPixel(theta, theta, cutoff_hz=cutoff, **QUIET))
        assert len(events.between(1_000_000, 2_000_000)) == a_period * 20


def _spot(times_s, speed=40.0, sigma=4.0, height=9, width=64, peak=150.0, floor=30.0):
    """Return a Gaussian spot that crosses the image, DN."""
    y, x = np.mgrid[:height, :width]
    centre = -14.0 + speed * np.asarray(times_s)[:, None, None]
    return floor + peak * np.exp(-((x - centre) ** 2 + (y - height // 2) ** 2) / (2 * sigma**2))


def test_gaussian_spot_counts_are_the_log_range_over_the_threshold():
    times = np.linspace(0, 2.3, 1151)
    pixel = EventPixel(0.15, 0.13, cutoff_hz=0, **QUIET)
    events = simulate_events(_spot(times), times, pixel)
    counts = np.zeros((2, 9, 64), int)
    np.add.at(counts, (events.p.astype(int), events.y, events.x), 1)
    row = np.arange(9)
    span = np.log1p(150 / 30 * np.exp(-((row - 4) ** 2) / 32))
    on = np.floor(span / 0.15)
    off = np.floor(on * 0.15 / 0.13 - 1e-12)
    assert np.array_equal(counts[1], np.broadcast_to(on[:, None], (9, 64)))
    assert np.array_equal(counts[0], np.broadcast_to(off[:, None], (9, 64)))


def _paired_errors(coarse, fine):
    """Return time differences in seconds of the events that two runs share, and the share of unpaired ones."""

    def key(e):
        order = np.lexsort([e.t_us, e.p, e.x, e.y])
        code = (e.y.astype(np.int64) * 4096 + e.x) * 2 + e.p
        code, time = code[order], e.t_us[order]
        start = np.searchsorted(code, code)
        return {
            (int(c), int(n)): int(t) for c, n, t in zip(code, np.arange(len(code)) - start, time, strict=True)
        }

    a, b = key(coarse), key(fine)
    both = a.keys() & b.keys()
    return np.array([a[k] - b[k] for k in both]) * 1e-6, 1 - len(both) / max(len(a), len(b))


@pytest.mark.parametrize("cutoff", [0.0, 15.0, 200.0])
def test_timing_at_one_millisecond_and_order_of_convergence(cutoff):
    pixel = EventPixel(cutoff_hz=cutoff, **QUIET)

    def run(step):
        times = np.arange(round(0.256 / step) + 1) * step
        return simulate_events(_spot(times, speed=100.0), times, pixel)

    truth = run(1e-3 / 16)
    rms = []
    for step in (8e-3, 4e-3, 2e-3, 1e-3):
        errors, unpaired = _paired_errors(run(step), truth)
        rms.append(np.sqrt(np.mean(errors**2)))
        assert unpaired < 2e-3
    assert rms[-1] < 5e-6
    assert 1.8 < np.log2(rms[0] / rms[3]) / 3 < 2.2


def test_busy_neighbours_change_nothing():
    times = np.linspace(0, 0.2, 201)
    alone = _spot(times, speed=100.0)
    busy = alone.copy()
    busy[:, 0, 0] = np.where(np.arange(201) % 2, 5.0, 250.0)
    pixel = EventPixel(cutoff_hz=200, **QUIET)
    a, b = (simulate_events(video, times, pixel) for video in (alone, busy))
    others = (b.x != 0) | (b.y != 0)
    assert b[others] == a[(a.x != 0) | (a.y != 0)]
    assert (~others).sum() > 100


def test_constant_light_gives_no_events():
    frames = np.random.default_rng(0).uniform(0, 255, (1, 6, 7)).repeat(50, 0)
    for cutoff in (0.0, 15.0, 1000.0):
        assert not len(simulate_events(frames, np.arange(50) * 0.01, EventPixel(cutoff_hz=cutoff, **QUIET)))


@pytest.mark.parametrize("mode", ["exact", "v2e"])
def test_brightness_scale_changes_no_event_above_the_knee(mode):
    times = np.linspace(0, 0.2, 101)
    video = _spot(times, speed=200.0)
    pixel = EventPixel(
        threshold_sigma=0.03, cutoff_hz=0, leak_rate_hz=0, shot_noise_rate_hz=0, initial_phase="rest"
    )
    base = simulate_events(video, times, pixel, mode=mode, seed=4)
    for factor in (0.75, 2.0, 7.3):
        assert simulate_events(factor * video, times, pixel, mode=mode, seed=4) == base


@pytest.mark.parametrize("mode", ["exact", "v2e"])
def test_a_monotone_signal_backwards_swaps_polarities(mode):
    draw = np.random.default_rng(2)
    video = np.sort(draw.uniform(1, 255, (30, 8, 9)), axis=0)
    times = np.linspace(0, 0.3, 30)
    pixel = EventPixel(0.11, 0.11, cutoff_hz=0, **QUIET)
    forward = simulate_events(video, times, pixel, mode=mode)
    backward = simulate_events(video[::-1], times, pixel, mode=mode)
    assert forward.p.all() and not backward.p.any() and len(forward) > 500
    counts = []
    for events in (forward, backward):
        count = np.zeros((8, 9), int)
        np.add.at(count, (events.y, events.x), 1)
        counts.append(count)
    assert np.array_equal(*counts)


def test_refractory_period_on_continuous_time():
    times = np.linspace(0, 0.2, 201)
    video = _spot(times, speed=300.0)
    free = simulate_events(video, times, EventPixel(0.05, 0.05, cutoff_hz=0, **QUIET))
    held = simulate_events(video, times, EventPixel(0.05, 0.05, cutoff_hz=0, refractory_s=2.345e-3, **QUIET))
    order = np.lexsort([held.t_us, held.x, held.y])
    same = (np.diff(held.x[order].astype(int)) == 0) & (np.diff(held.y[order].astype(int)) == 0)
    gaps = np.diff(held.t_us[order])[same]
    assert gaps.min() >= 2344 and (gaps <= 2346).mean() > 0.2
    assert 0.3 * len(free) < len(held) < 0.9 * len(free)


def test_leak_has_its_rate_from_the_first_moment():
    times = np.linspace(0, 2.0, 201)
    pixel = EventPixel(threshold_sigma=0.03, cutoff_hz=15, leak_rate_hz=3.0, shot_noise_rate_hz=0)
    events = simulate_events(np.full((201, 60, 80), 90.0), times, pixel, seed=1)
    expected = 3.0 * 2.0 * 4800 * math.exp((0.1 * math.log(10)) ** 2 / 2)
    assert events.p.all()
    assert abs(len(events) - expected) < 0.02 * expected
    per_bin = np.histogram(events.t_us, bins=20, range=(0, 2_000_000))[0]
    assert np.abs(per_bin / per_bin.mean() - 1).max() < 0.1


@pytest.mark.parametrize("level", [0.0, 100.0, 255.0])
def test_shot_noise_has_its_rate_and_is_poisson(level):
    times = np.linspace(0, 1.0, 11)
    pixel = EventPixel(
        threshold_sigma=0, cutoff_hz=15, leak_rate_hz=0, shot_noise_rate_hz=8.0, initial_phase="rest"
    )
    events = simulate_events(np.full((11, 80, 100), level), times, pixel, seed=3)
    expected = 8.0 * (1 - 0.75 * (level + 20) / 275) * 8000
    assert abs(len(events) - expected) < 4 * math.sqrt(expected)
    assert abs(events.p.mean() - 0.5) < 4 * 0.5 / math.sqrt(expected)
    counts = np.bincount(events.y.astype(int) * 100 + events.x, minlength=8000)
    assert abs(counts.var() / counts.mean() - 1) < 4 * math.sqrt(2 / 8000)
    assert np.histogram(events.t_us, 10, (0, 1_000_000))[0].std() < 3 * math.sqrt(expected / 10)
    assert len(np.unique(events.t_us)) > 0.9 * len(events) * (1 - len(events) / 2e6)


def test_noise_does_not_depend_on_the_frame_rate():
    pixel = EventPixel(leak_rate_hz=2.0, shot_noise_rate_hz=5.0)
    coarse, fine = (
        simulate_events(np.full((n, 20, 30), 60.0), np.linspace(0, 1, n), pixel, seed=8) for n in (3, 257)
    )
    assert len(coarse) == len(fine) > 1000
    assert np.abs(coarse.t_us - fine.t_us).max() <= 1


def test_hot_pixels_fire_at_their_rate():
    pixel = EventPixel(**QUIET, hot_pixel_fraction=0.1, hot_pixel_rate_hz=20.0)
    events = simulate_events(np.full((3, 50, 60), 60.0), [0, 0.5, 1.0], pixel, seed=2)
    counts = np.bincount(events.y.astype(int) * 60 + events.x, minlength=3000)
    assert abs((counts > 0).mean() - 0.1) < 0.02
    assert abs(counts[counts > 0].mean() - 20) < 1.2


def test_jitter_moves_time_stamps_only():
    times = np.linspace(0, 0.2, 101)
    video = _spot(times, speed=200.0)
    plain = simulate_events(video, times, EventPixel(**QUIET))
    moved = simulate_events(video, times, EventPixel(**QUIET, jitter_s=2e-4))
    assert len(plain) == len(moved) and (np.diff(moved.t_us) >= 0).all()
    differences, unpaired = _paired_errors(moved, plain)
    assert unpaired == 0 and 1e-4 < differences.std() < 2.2e-4


def _walk(seed, steps=8, height=3, width=5):
    draw = np.random.default_rng(seed)
    video = np.clip(
        draw.normal(0, 12, (steps, height, width)).cumsum(0) + draw.uniform(5, 200, (height, width)), 0, 300
    )
    return video, np.cumsum(draw.uniform(5e-4, 3e-3, steps))


@pytest.mark.parametrize(
    "pixel",
    [
        EventPixel(0.03, 0.03, cutoff_hz=15, **QUIET),
        EventPixel(0.1, 0.2, cutoff_hz=300, **QUIET),
        EventPixel(cutoff_hz=0, **QUIET),
        EventPixel(0.1, 0.1, 0.02, 100, 30.0, 0),
        EventPixel(0.1, 0.1, 0.02, 0, 30.0, 0),
        EventPixel(0.05, 0.05, 0.0, 200, 0, 0, refractory_s=1e-3),
    ],
)
def test_kernel_is_the_brute_force(pixel):
    paired, count = [], 0
    for seed in range(4):
        video, times = _walk(seed)
        events = simulate_events(video, times, pixel, seed=6)
        plain = reference_exact(video, times, pixel, seed=6)
        by_pixel = [{n: [] for n in range(15)} for _ in range(2)]
        for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True):
            by_pixel[0][int(y) * 5 + int(x)].append((t * 1e-6, 1 if p else -1))
        for t, n, sign in plain:
            by_pixel[1][n].append((t, sign))
        for n in range(15):
            mine, theirs = by_pixel[0][n], by_pixel[1][n]
            same = [s for _, s in mine] == [s for _, s in theirs]
            count += 1
            if same:
                paired += [a - b for (a, _), (b, _) in zip(mine, theirs, strict=True)]
            else:
                count -= 1
                assert abs(len(mine) - len(theirs)) <= 1  # a level that is only just touched
    assert count >= 58
    assert len(paired) > 100
    assert np.sqrt(np.mean(np.square(paired))) < 5e-6


@settings(max_examples=200, deadline=None)
@given(
    rise=st.floats(1e-6, 2.0),
    shares=st.tuples(st.floats(0, 3), st.floats(0, 3)),
    place=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_monotone_cubic_meets_its_levels(rise, shares, place, sign):
    """The cubic itself, at s, is the level whose s is requested, from any lower start."""
    rise *= sign
    first, second = (share * rise for share in shares)

    def cubic(s):
        bend, twist = 3 * rise - 2 * first - second, first + second - 2 * rise
        return s * (first + s * (bend + s * twist))

    assert is_monotone(rise, first, second)
    assert not is_monotone(rise, -1e-3 * rise, second) and not is_monotone(rise, first, 3.01 * rise)
    low, s = min(place), max(place)
    found = crossing_time(rise, first, second, cubic(s), low)
    assert low <= found <= 1
    assert abs(cubic(found) - cubic(s)) <= 1e-6 * abs(rise)


def test_smooth_steps_are_timed_as_if_cut_into_many():
    """The same light in its own steps and in steps cut in 20: up to tau = 1 both send the same events."""
    step, pixel = 0.018, EventPixel(0.1, 0.1, cutoff_hz=15, **QUIET)
    draw = np.random.default_rng(5)
    waves = draw.uniform(0.5, 2.2, 60) * step * np.arange(200)[:, None] + draw.uniform(0, 1, 60)
    coarse = 90 * np.exp(0.4 * np.sin(2 * np.pi * waves))
    half = np.pi * 15 / 275 * step
    steps = list(zip(coarse[:-1].flat, coarse[1:].flat, strict=True))
    assert np.mean([is_smooth(a, b, math.log(a), math.log(b), half, 40.0) for a, b in steps]) > 0.9
    assert max(half * (a + b + 40) for a, b in steps) > 0.9 * LONGEST_TAU
    times = step * np.arange(200)
    cuts = np.linspace(0, times[-1], 199 * 20 + 1)
    fine = np.stack([np.interp(cuts, times, column) for column in coarse.T], axis=1)
    few, many = (
        simulate_events(light[:, None, :], instants, pixel)
        for light, instants in ((coarse, times), (fine, cuts))
    )
    errors, unpaired = _paired_errors(few, many)
    assert len(errors) > 300 and unpaired < 5e-3
    assert np.percentile(np.abs(errors), 99) < 0.003 * step  # where the output turns, instants are ill-defined
    assert np.sqrt(np.mean(errors**2)) < 0.001 * step


@settings(max_examples=200, deadline=None)
@given(
    kind=st.sampled_from([LOW_PASS, LOG_LINEAR]),
    start=st.floats(-0.5, 0.5),
    slope=st.floats(-3, 3),
    pull=st.floats(-2, 2),
    length=st.floats(0.01, 3),
    on=st.floats(0.05, 1),
    off=st.floats(0.05, 1),
)
def test_first_crossing_is_the_first(kind, start, slope, pull, length, on, off):
    if kind == LOW_PASS:
        a, b, c = start, slope, pull
    else:
        a, b, c = 1.0 + abs(start), slope * 0.3 / length, abs(pull) * 0.5
        length = min(length, 0.9 * a / abs(b)) if b < 0 else length
    x = np.linspace(0, length, 4001)
    path = np.array([response(kind, a, b, c, v)[0] for v in x])
    up, down = path[0] + on, path[0] - off
    ends = [response(kind, a, b, c, end)[:2] for end in (0.0, length)]
    found, sign = first_crossing(kind, a, b, c, 0.0, length, *ends, up, down)
    beyond = np.flatnonzero((path >= up) | (path <= down))
    if len(beyond) == 0:
        assert sign == 0 or found > x[-2] or abs(path).max() + 1e-5 > min(abs(up), abs(down))
        return
    first = beyond[0]
    assert sign == (1 if path[first] >= up else -1) or found <= x[first]
    if sign == (1 if path[first] >= up else -1):
        assert x[first - 1] - 1e-9 <= found <= x[first] + 1e-9
        assert response(kind, a, b, c, found)[0] == pytest.approx(up if sign > 0 else down, abs=1e-9)


def test_logarithm_and_exponential_are_accurate():
    draw = np.random.default_rng(0)
    for value in np.concatenate([draw.uniform(0.5, 300, 500), 10 ** draw.uniform(-200, 200, 200), [1.0, 20.0]]):
        assert fast_log(value) == pytest.approx(math.log(value), rel=6e-16, abs=2e-16)
    for value in draw.uniform(0, 1, 500):
        assert cos_turns(value) == pytest.approx(math.cos(2 * math.pi * value), abs=1e-14)
    for value in np.concatenate([-(10 ** draw.uniform(-12, 2.8, 700)), [0.0]]):
        assert fast_exp(value) == pytest.approx(math.exp(value), rel=6e-16)


NOISY = EventPixel(0.15, 0.12, 0.03, 60, 20, 30, refractory_s=1e-3, hot_pixel_fraction=0.01, jitter_s=1e-5)


def test_same_bytes_for_any_tile_thread_and_block():
    video, times = _walk(0, steps=150, height=12, width=90)
    whole = simulate_events(video, times, NOISY, seed=2, threads=1)
    assert len(whole) > 5000
    assert whole == simulate_events(video, times, NOISY, seed=2, threads=3, tile_px=256)
    stream = EventStream(NOISY, video.shape[1:], seed=2)
    for first, last in ((0, 1), (1, 2), (2, 40), (40, 149), (149, 150)):
        stream.push(video[first:last], times[first:last])
    assert whole == stream.finish()
    assert whole != simulate_events(video, times, NOISY, seed=3)


def test_single_and_double_precision_and_bytes_agree():
    video, times = _walk(1, steps=40, height=12, width=90)
    bytes_in = np.clip(video, 0, 255).astype(np.uint8)
    runs = [
        simulate_events(bytes_in.astype(t), times, NOISY, seed=2) for t in (np.uint8, np.float32, np.float64)
    ]
    assert runs[0] == runs[1] == runs[2]


@pytest.mark.parametrize(("count", "span"), [(1, 1), (5, 3), (20_000, 700), (20_000, 1 << 20), (300, 1 << 40)])
def test_events_are_put_in_order_of_time_pixel_and_polarity(count: int, span: int) -> None:
    draw = np.random.default_rng(count)
    time = draw.integers(0, span, count) - 17
    pixel, on = draw.integers(0, 900, count).astype(np.int32), draw.random(count) < 0.5
    rank = np.lexsort((on, pixel, time))
    for found, column in zip(sort_times(time, pixel, on), (time, pixel, on), strict=True):
        np.testing.assert_array_equal(found, column[rank])


def test_the_first_state_is_a_setting_of_its_own() -> None:
    assert {EventPixel(leak_rate_hz=leak).initial_phase for leak in (0.0, 0.01)} == {"random"}
    assert replace(EventPixel(initial_phase="rest"), leak_rate_hz=1.0).initial_phase == "rest"
    with pytest.raises(ConfigError, match="initial_phase is None"):
        EventPixel(initial_phase=None)  # type: ignore[arg-type]
