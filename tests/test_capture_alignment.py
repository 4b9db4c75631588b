"""Clock, pixels and noise of loose recordings: each step against its analytic truth or a slow reference."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evnlos.data import correct_frames, read_capture
from evnlos.data.clocks import find_offset
from evnlos.data.fixed_pattern import warp_frames
from evnlos.data.frames import find_dots, homography_from_points, registration_error
from evnlos.errors import DataError
from evnlos.types import Events

TILTED = np.array([[0.9, -0.12, 14.0], [0.08, 0.95, -6.0], [2e-4, -1e-4, 1.0]])


def project(matrix, points):
    mapped = np.column_stack([points, np.ones(len(points))]) @ np.asarray(matrix).T
    return mapped[:, :2] / mapped[:, 2:]


# ---------------------------------------------------------------- clock


def blinking(seed: int, duration_s: float = 4.0, noise: int = 300):
    """A lamp with irregular steps, as events (0.1 in the logarithm each) and as a function of time."""
    draw = np.random.default_rng(seed)
    switches = np.sort(draw.uniform(0.2, duration_s - 0.2, 12))
    levels = np.concatenate([[0.0], draw.choice([-0.6, 0.6], 12)]).cumsum() % 1.2
    times, signs = [], []
    for when, change in zip(switches, np.diff(levels), strict=True):
        steps = round(abs(change) * 10)
        times += [when * 1e6 + 500 * k for k in range(steps)]
        signs += [change > 0] * steps
    t = np.repeat(np.array(times), 30)
    p = np.repeat(np.array(signs, bool), 30)
    t, p = (
        np.concatenate([t, draw.uniform(0, duration_s * 1e6, noise)]),
        np.concatenate([p, draw.random(noise) < 0.5]),
    )
    order = np.argsort(t, kind="stable")
    where = draw.integers(0, [[16], [12]], (2, len(t)))
    events = Events(t[order].astype(np.int64), *where, p[order], 16, 12)
    return events, lambda time_s: np.exp(levels[np.searchsorted(switches, time_s)])


@pytest.mark.parametrize("offset_ms", [-730, 0, 41, 512])
@pytest.mark.parametrize("blocks", [1, 4])
def test_the_offset_of_a_blinking_light_is_found(offset_ms, blocks):
    events, light = blinking(3)
    true_us = np.arange(5, 118) * 33_333
    frames = (100 * light(true_us / 1e6))[:, None, None] * np.ones((12, 16))
    noisy = np.clip(frames + np.random.default_rng(0).normal(0, 1, frames.shape), 0, 255).astype(np.uint8)
    before = noisy.copy()
    found = find_offset(events, noisy, true_us - offset_ms * 1000, blocks=blocks)
    assert abs(found.offset_us - offset_ms * 1000) < 8_000
    assert found.correlation > 0.8 and found.ratio > 1.5
    np.testing.assert_array_equal(noisy, before)


def test_an_offset_beyond_the_search_or_from_noise_is_refused():
    events, light = blinking(3)
    true_us = np.arange(5, 118) * 33_333
    frames = (100 * light(true_us / 1e6))[:, None, None] * np.ones((12, 16))
    with pytest.raises(DataError, match="uncertain"):
        find_offset(events, frames, true_us - 700_000, search_us=300_000)
    noise = np.random.default_rng(1).random(frames.shape)
    with pytest.raises(DataError, match=r"uncertain.*blink"):
        find_offset(events, noise, true_us)
    with pytest.raises(DataError, match="no offset up to"):
        find_offset(events, frames, true_us + 10**9)
    with pytest.raises(DataError, match="5 frames"):
        find_offset(events, frames[:3], true_us[:3])


@pytest.mark.parametrize("name", ["near_A", "near_L", "far_W"])
def test_a_slow_steady_motion_is_refused_and_not_guessed(shared_data, name):
    """These agree with their events over a second and more: the best offset is off by up to half a second."""
    if name.startswith("far"):
        pytest.importorskip("aedat")
    recording = read_capture(shared_data / "captures" / name)
    for blocks in (1, 8):
        with pytest.raises(DataError, match="uncertain"):
            find_offset(recording.events, recording.frames, recording.frame_times_us - 137_000, blocks=blocks)


# ---------------------------------------------------------------- pixels


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(4, 30))
def test_a_homography_is_recovered_from_its_points(seed, count):
    draw = np.random.default_rng(seed)
    matrix = np.eye(3) + draw.uniform(-1, 1, (3, 3)) * [[0.3, 0.3, 50], [0.3, 0.3, 50], [1e-4, 1e-4, 0]]
    corners = np.array([(0, 0), (1279, 0), (1279, 799), (0, 799)], float)
    points = np.concatenate([corners, draw.uniform(0, 800, (count - 4, 2))])
    found = homography_from_points(points, project(matrix, points))
    np.testing.assert_allclose(project(found, points), project(matrix, points), atol=1e-6)
    assert registration_error(found, points, project(matrix, points)) < 1e-6


def test_points_that_fix_no_homography_are_refused():
    line = [(k, 2 * k) for k in range(6)]
    with pytest.raises(DataError, match="line"):
        homography_from_points(line, line)
    with pytest.raises(DataError, match="coincide"):
        homography_from_points([(1, 1)] * 4, [(1, 1)] * 4)
    with pytest.raises(DataError, match="at least 4"):
        homography_from_points(line[:3], line[:3])


def slow_warp(picture, matrix, shape, samples):
    back, out = np.linalg.inv(matrix), np.zeros(shape)
    height, width = picture.shape
    for row in range(shape[0]):
        for column in range(shape[1]):
            values = []
            for i in range(samples):
                for j in range(samples):
                    place = np.array([column + (j + 0.5) / samples - 0.5, row + (i + 0.5) / samples - 0.5, 1.0])
                    u, v, w = back @ place
                    u, v = u / w, v / w
                    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                        continue
                    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
                    x, y = min(int(u), width - 2), min(int(v), height - 2)
                    a, b = u - x, v - y
                    values.append(
                        (1 - b) * ((1 - a) * picture[y, x] + a * picture[y, x + 1])
                        + b * ((1 - a) * picture[y + 1, x] + a * picture[y + 1, x + 1])
                    )
            out[row, column] = np.mean(values) if values else 0.0
    return out


@pytest.mark.parametrize(
    ("scale", "samples", "shape"), [(1.0, 2, (17, 19)), (0.4, 3, (9, 19)), (2.0, 1, (24, 50))]
)
def test_warping_equals_the_slow_one(scale, samples, shape):
    draw = np.random.default_rng(5)
    frames = draw.random((2, 23, 31)).astype(np.float32)
    matrix = np.diag([scale, scale, 1.0]) @ TILTED
    out, covered = warp_frames(frames, matrix, shape)
    for frame, warped in zip(frames, out, strict=True):
        np.testing.assert_allclose(warped, slow_warp(frame.astype(float), matrix, shape, samples), atol=2e-6)
    assert ((covered > 0) >= (out[0] > 0)).all()


def test_warping_keeps_pixels_and_averages_finer_ones():
    frames = np.random.default_rng(6).integers(0, 255, (3, 20, 30)).astype(np.uint8)
    same, covered = warp_frames(frames, np.eye(3), (20, 30))
    np.testing.assert_array_equal(same, frames)
    assert covered.min() == 1
    # Half the size: centres of 2 x 2 pixels, x' = (x - 0.5) / 2.
    half, _ = warp_frames(frames, [[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]], (10, 15))
    np.testing.assert_allclose(half, frames.reshape(3, 10, 2, 15, 2).mean(axis=(2, 4)), atol=1e-4)
    with pytest.raises(DataError, match="outside"):
        warp_frames(frames, [[1, 0, 1000], [0, 1, 0], [0, 0, 1]], (20, 30))
    with pytest.raises(DataError, match="inverted"):
        warp_frames(frames, np.zeros((3, 3)), (20, 30))


def dots_image(matrix, shape, rows=4, columns=6, step=30.0, spread=3.0):
    """A grid of soft dots under a homography, and their true centres."""
    grid = np.array([(60 + step * c, 40 + step * r) for r in range(rows) for c in range(columns)], float)
    centres = project(matrix, grid)
    y, x = np.mgrid[: shape[0], : shape[1]]
    picture = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * spread**2)) for cx, cy in centres)
    return picture, centres


def test_dots_are_found_in_their_order_under_perspective():
    picture, truth = dots_image(TILTED, (200, 300))
    noisy = 20 + 150 * picture + np.random.default_rng(2).normal(0, 3, picture.shape)
    found = find_dots(noisy, 4, 6)
    assert np.abs(found - truth).max() < 0.25
    with pytest.raises(DataError, match="no grid"):
        find_dots(noisy, 6, 4)
    with pytest.raises(DataError, match="24 dots found where 5 x 5"):
        find_dots(noisy, 5, 5)
    with pytest.raises(DataError, match="hide other lights"):
        find_dots(noisy, 3, 6)
    with pytest.raises(DataError, match="dots found"):
        find_dots(np.zeros((20, 20)), 2, 2)


# ---------------------------------------------------------------- noise


def test_dark_frame_and_flat_field_undo_what_the_camera_did():
    draw = np.random.default_rng(7)
    light = draw.uniform(0, 0.8, (4, 9, 11))
    dark, gain = draw.uniform(5, 30, (9, 11)), draw.uniform(0.6, 1.4, (9, 11))
    peak = 4000.0
    frames = dark + (peak - dark.mean()) * light * gain / gain.mean()
    found = correct_frames(frames, peak, dark, dark + 1500 * gain)
    np.testing.assert_allclose(found, light, atol=2e-6)
    np.testing.assert_allclose(correct_frames(frames, peak), np.clip(frames / peak, 0, 1), atol=1e-6)
    with pytest.raises(DataError, match="flat frame"):
        correct_frames(frames, peak, dark, np.ones((3, 3)))
    with pytest.raises(DataError, match="flat field"):
        correct_frames(frames, peak, dark, dark)
