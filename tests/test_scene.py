"""Targets, their drawing on planes, and how they move."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evnlos.errors import DataError
from evnlos.scene import LineMotion, Motion, PathMotion, Scene, Target
from evnlos.types import Plane

CANVAS = Plane(64, 96, 0.0025)


def random_target(side=13, seed=0, size_m=0.03):
    return Target("noise", np.random.default_rng(seed).random((side, side)), size_m)


def slow_rasterise(target, plane, position_m):
    """The definition: each cell is the mean of the mask over its area, pixel by pixel, with plain loops."""
    side = target.mask.shape[0]
    pixel = target.size_m / side
    picture = np.zeros(plane.shape)
    left, top = position_m[0] - target.size_m / 2, position_m[1] - target.size_m / 2
    for j, y in enumerate(plane.y_m):
        for i, x in enumerate(plane.x_m):
            for row in range(side):
                low, high = top + row * pixel, top + (row + 1) * pixel
                tall = min(high, y + plane.pitch_m / 2) - max(low, y - plane.pitch_m / 2)
                if tall <= 0:
                    continue
                for column in range(side):
                    low, high = left + column * pixel, left + (column + 1) * pixel
                    wide = min(high, x + plane.pitch_m / 2) - max(low, x - plane.pitch_m / 2)
                    if wide > 0:
                        picture[j, i] += tall * wide * target.mask[row, column]
    return picture / plane.pitch_m**2


@settings(max_examples=25, deadline=None)
@given(
    side=st.integers(1, 9),
    shape=st.tuples(st.integers(1, 8), st.integers(1, 8)),
    pitch=st.floats(0.002, 0.05),
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.05, 0.05),
    seed=st.integers(0, 99),
)
def test_rasterise_matches_the_plain_loops(side, shape, pitch, x, y, seed):
    target, plane = random_target(side, seed), Plane(*shape, pitch, center_m=(0.003, -0.002))
    np.testing.assert_allclose(
        target.rasterise(plane, (x, y)), slow_rasterise(target, plane, (x, y)), atol=2e-7, rtol=0
    )


@settings(max_examples=50, deadline=None)
@given(x=st.floats(-0.07, 0.07), y=st.floats(-0.035, 0.035), side=st.integers(1, 40), seed=st.integers(0, 99))
def test_light_is_conserved_at_any_position(x, y, side, seed):
    target = random_target(side, seed, size_m=0.08)
    light = target.rasterise(CANVAS, (x, y)).sum(dtype=np.float64) * CANVAS.pitch_m**2
    assert light == pytest.approx(float(target.mask.mean(dtype=np.float64)) * 0.08**2, rel=1e-6)


@given(dx=st.integers(-10, 10), dy=st.integers(-5, 5), x=st.floats(-0.01, 0.01))
@settings(max_examples=30, deadline=None)
def test_a_shift_by_whole_samples_rolls_the_image(dx, dy, x):
    target = random_target(size_m=0.08)
    still = target.rasterise(CANVAS, (x, 0.0))
    moved = target.rasterise(CANVAS, (x + dx * CANVAS.pitch_m, dy * CANVAS.pitch_m))
    np.testing.assert_allclose(moved, np.roll(still, (dy, dx), axis=(0, 1)), atol=1e-6)


@given(part=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_a_shift_by_part_of_a_sample_is_linear_where_the_mask_is_flat_within_it(part):
    # Mask pixels of exactly one sample: a shift by a part of one mixes two neighbours in proportion.
    target = random_target(side=8, size_m=8 * CANVAS.pitch_m)
    still, next_sample = (target.rasterise(CANVAS, (k * CANVAS.pitch_m, 0.0)) for k in (0, 1))
    between = target.rasterise(CANVAS, (part * CANVAS.pitch_m, 0.0))
    np.testing.assert_allclose(between, (1 - part) * still + part * next_sample, atol=1e-6)


def test_many_positions_equal_one_at_a_time_and_the_mask_is_unchanged():
    mask = np.random.default_rng(1).random((32, 32))
    kept = mask.copy()
    target = Target("noise", mask, 0.08)
    places = np.random.default_rng(2).uniform(-0.2, 0.2, (12, 2))
    places[3:6, 1] = places[3, 1]
    pictures = target.rasterise(CANVAS, places)
    assert pictures.shape == (12, 64, 96)
    assert pictures.dtype == np.float32
    for picture, place in zip(pictures, places, strict=True):
        np.testing.assert_allclose(picture, target.rasterise(CANVAS, place), atol=1e-7)
    np.testing.assert_array_equal(mask, kept)
    assert target.rasterise(CANVAS, np.zeros((0, 2))).shape == (0, 64, 96)


def test_outside_the_target_is_exactly_dark_and_far_away_draws_nothing():
    target = Target("bright", np.ones((5, 5)), 0.02)
    picture = target.rasterise(CANVAS, (0.0, 0.0))
    assert picture.sum() == pytest.approx(64)
    assert picture[:28].max() == picture[36:].max() == 0
    assert target.rasterise(CANVAS, (1.0, 0.0)).max() == 0


def test_rows_run_downwards_and_columns_to_the_right():
    mask = np.zeros((2, 2))
    mask[0, 1] = 1  # upper right quarter
    picture = Target("corner", mask, 0.08).rasterise(CANVAS)
    row, column = np.argwhere(picture > 0.5).mean(axis=0)
    assert row < 31.5 < column - 16
    assert Target("corner", mask, 0.08).rasterise(CANVAS, (0.0, 0.02)).sum(1).argmax() > picture.sum(1).argmax()


def test_the_truth_of_a_standard_sample_is_fast():
    scene = Scene(random_target(256, size_m=0.08))
    times = scene.position_times_s()
    scene.truth(CANVAS, times)
    spent = []
    for _ in range(5):
        start = time.perf_counter()
        scene.truth(CANVAS, times)
        spent.append(time.perf_counter() - start)
    assert min(spent) < 0.02  # about 2.5 ms on an idle core


@pytest.mark.parametrize(
    ("mask", "size", "words"),
    [
        (np.ones((3, 4)), 0.08, "square"),
        (np.ones(9), 0.08, "square"),
        (np.ones((0, 0)), 0.08, "square"),
        (np.full((3, 3), np.nan), 0.08, "finite"),
        (np.full((3, 3), 1.5), 0.08, "from 0 to 1"),
        (np.full((3, 3), -0.1), 0.08, "from 0 to 1"),
        (np.ones((3, 3)), 0.0, "positive"),
        (np.ones((3, 3)), float("nan"), "positive"),
    ],
)
def test_a_bad_target_is_refused_in_one_line(mask, size, words):
    with pytest.raises(DataError, match=words) as caught:
        Target("bad", mask, size)
    assert "\n" not in str(caught.value)


def test_a_target_is_frozen_and_compares_by_value():
    target = random_target()
    assert target == random_target()
    assert target != random_target(seed=1)
    with pytest.raises(ValueError, match="read-only"):
        target.mask[0, 0] = 0
    for position in ((0.0,), (np.nan, 0.0), np.zeros((2, 3))):
        with pytest.raises(DataError, match="position_m"):
            target.rasterise(CANVAS, position)


# Motion


def test_the_papers_line_crosses_the_middle_after_four_seconds():
    line = LineMotion()
    assert isinstance(line, Motion)
    np.testing.assert_allclose(line.position_m([0.0, 4.0, 8.0]), [[-0.08, 0], [0, 0], [0.08, 0]], atol=1e-15)
    assert line.speed_bound_m_s(0, 8) == 0.02


@given(
    angle=st.floats(0, 6.3),
    length=st.floats(0.01, 100),
    speed=st.floats(0, 10),
    times=st.lists(st.floats(-100, 100), min_size=2, max_size=2),
)
@settings(max_examples=50, deadline=None)
def test_a_line_covers_speed_times_time(angle, length, speed, times):
    line = LineMotion((0.1, -0.2), speed, (length * np.cos(angle), length * np.sin(angle)), start_s=1.0)
    a, b = line.position_m(times)
    assert np.hypot(*(b - a)) == pytest.approx(speed * abs(times[1] - times[0]), abs=1e-9)
    np.testing.assert_allclose(line.position_m(1.0), [0.1, -0.2], atol=1e-15)


@st.composite
def paths(draw):
    count = draw(st.integers(2, 6))
    steps = draw(st.lists(st.floats(0.1, 3), min_size=count, max_size=count))
    coordinate = st.floats(-0.2, 0.2)
    points = draw(st.lists(st.tuples(coordinate, coordinate), min_size=count, max_size=count))
    return PathMotion(tuple(np.cumsum(steps)), tuple(points))


@given(path=paths())
@settings(max_examples=60, deadline=None)
def test_a_path_meets_its_points_stays_between_them_and_keeps_its_speed_bound(path):
    times, points = np.array(path.times_s), np.array(path.points_m)
    np.testing.assert_allclose(path.position_m(times), points, atol=1e-12)
    fine = np.linspace(times[0] - 1, times[-1] + 1, 2001)
    places = path.position_m(fine)
    assert (places >= points.min(0) - 1e-12).all()
    assert (places <= points.max(0) + 1e-12).all()
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(fine)
    assert speed.max() <= path.speed_bound_m_s(fine[0], fine[-1]) * (1 + 1e-9) + 1e-12
    assert path.speed_bound_m_s(times[-1], times[-1] + 5) == 0
    np.testing.assert_allclose(path.position_m(times[-1] + 5), points[-1], atol=1e-15)


def test_a_path_agrees_with_scipys_monotone_cubic():
    scipy_interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(3)
    times, points = np.cumsum(rng.uniform(0.2, 1, 8)), rng.uniform(-0.1, 0.1, (8, 2))
    fine = np.linspace(times[1], times[-2], 501)  # the end slopes differ on purpose: ours are at rest
    path = PathMotion(tuple(times), tuple(map(tuple, points)))
    np.testing.assert_allclose(
        path.position_m(fine), scipy_interpolate.PchipInterpolator(times, points)(fine), atol=1e-12
    )


def test_the_velocity_of_a_path_is_continuous_and_zero_at_its_ends():
    path = PathMotion((0.0, 1.0, 1.5, 4.0), ((0.0, 0.0), (0.05, 0.01), (0.06, 0.03), (0.1, 0.0)))
    step = 1e-6
    for knot in (1.0, 1.5):
        before = (path.position_m(knot) - path.position_m(knot - step)) / step
        after = (path.position_m(knot + step) - path.position_m(knot)) / step
        np.testing.assert_allclose(before, after, atol=1e-6)
    assert np.abs(path.position_m(step) - path.position_m(0.0)).max() / step < 1e-6


@pytest.mark.parametrize(
    "build",
    [
        lambda: LineMotion(speed_m_s=-1),
        lambda: LineMotion(direction=(0, 0)),
        lambda: LineMotion(start_m=(np.nan, 0)),
        lambda: LineMotion(start_s=np.inf),
        lambda: LineMotion().position_m(np.nan),
        lambda: PathMotion((0.0,), ((0.0, 0.0),)),
        lambda: PathMotion((0.0, 0.0), ((0.0, 0.0), (1.0, 1.0))),
        lambda: PathMotion((0.0, 1.0), ((0.0, 0.0),)),
        lambda: PathMotion((0.0, 1.0), ((0.0, 0.0), (np.nan, 1.0))),
        lambda: Scene(random_target(), duration_s=0),
        lambda: Scene(random_target()).position_times_s(0),
    ],
)
def test_bad_motion_is_refused(build):
    with pytest.raises(DataError):
        build()


def test_the_standard_sample_is_forty_positions_a_fifth_of_a_second_apart():
    times = Scene(random_target()).position_times_s()
    np.testing.assert_allclose(times, 0.2 * np.arange(1, 41), atol=1e-12)


def test_a_turned_target_is_its_mask_turned():
    """Against points of the turned plane, looked up in a smooth mask; light is kept, a quarter is exact."""
    at = (np.arange(80) + 0.5) / 80 - 0.5
    smooth = lambda x, y: np.exp(-((x - 0.1) ** 2 / 0.02 + (y + 0.15) ** 2 / 0.01))  # noqa: E731
    target = Target("blob", smooth(at, at[:, None]).astype(np.float32), 0.08)
    plane = Plane(120, 150, 0.001, (0.004, 0.0))
    x, y = (plane.x_m - 0.01) / 0.08, (plane.y_m[:, None] + 0.005) / 0.08
    for angle in (0.4, -2.0):
        drawn = target.rasterise(plane, (0.01, -0.005), angle)
        # What is at (x, y) was at R^T (x, y) of the upright target; clockwise as rows and columns run.
        cos, sin = np.cos(angle), np.sin(angle)
        expected = smooth(cos * x + sin * y, cos * y - sin * x)
        assert np.abs(drawn - expected).max() < 0.02
        assert drawn.sum() == pytest.approx(target.rasterise(plane, (0.01, -0.005)).sum(), rel=2e-3)
    quarter = Target("blob", np.rot90(target.mask, -1), 0.08)
    own = Plane(80, 80, 0.001)
    np.testing.assert_allclose(target.rasterise(own, (0, 0), np.pi / 2), quarter.rasterise(own), atol=0.02)
    scene = Scene(target, LineMotion((0.0, 0.0), 0.0, spin_deg_s=90.0), 1.0)
    np.testing.assert_allclose(scene.truth(own, [0.0, 1.0])[1], quarter.mask, atol=0.02)


def test_motions_in_space_say_where_they_are():
    line = LineMotion(z_m=0.3, retreat_m_s=0.01, spin_deg_s=10.0, start_s=1.0)
    pose = line.pose([1.0, 3.0])
    np.testing.assert_allclose(pose.z_m, [0.3, 0.32])
    np.testing.assert_allclose(np.degrees(pose.rotation_rad), [0.0, 20.0], atol=1e-12)
    path = PathMotion((0.0, 1.0, 2.0), ((0, 0), (0.1, 0), (0.2, 0)), (0.3, 0.4, 0.35), (0.0, 30.0, -10.0))
    pose = path.pose([0.0, 1.0, 2.0, 5.0])
    np.testing.assert_allclose(pose.z_m, [0.3, 0.4, 0.35, 0.35])
    np.testing.assert_allclose(np.degrees(pose.rotation_rad), [0.0, 30.0, -10.0, -10.0])
    target = Target("square", np.ones((4, 4)))
    assert Scene(target, path, 2.0).moves_in_space and not Scene(target, LineMotion(z_m=0.3)).moves_in_space
    for wrong in (
        {"retreat_m_s": 0.1},
        {"retreat_m_s": float("nan"), "z_m": 0.3},
        {"spin_deg_s": float("inf")},
    ):
        with pytest.raises(DataError):
            LineMotion(**wrong)
    for wrong in ({"z_m": (0.3,)}, {"z_m": (0.3, -0.1)}, {"rotation_deg": (0.0, float("nan"))}):
        with pytest.raises(DataError):
            PathMotion((0.0, 1.0), ((0, 0), (0.1, 0)), **wrong)
