"""CeleX-V's two channels: values, fixed pattern, the software's polarity, files."""

import math
from dataclasses import replace

import numpy as np
import pytest

from evnlos.cameras import CelexCamera, CelexPixel, EventPixel, ReadoutPixel, simulate_events
from evnlos.errors import ConfigError, DataError
from evnlos.events import read_events, read_frames, write_celex_frames, write_events

PIXEL = EventPixel(0.1, 0.1, 0.0, 0.0, 0.0, 0.0, logarithm="true", dark_dn=0.01)
CLEAN = CelexCamera(
    PIXEL, gain_mismatch=0.0, pattern_codes=0.0, row_codes=0.0, column_codes=0.0, noise_codes=0.0
)
FLAT = np.full((2, 60, 80), 60.0)


def test_a_frame_of_a_uniform_field_shows_the_fixed_pattern() -> None:
    camera = CelexCamera(PIXEL, gain_mismatch=0.0)
    frames = camera.capture(FLAT, [0.0, 1.0], np.linspace(0, 1, 16), bits=12, seed=1)
    mean = frames.astype(float).mean(0)
    _, offset = camera.pattern((60, 80))
    assert np.abs(mean - 2048 - offset).max() < 5 * 10 / 4 + 1
    assert (mean - mean.mean()).std() == pytest.approx(math.sqrt(100**2 + 20**2 + 20**2), rel=0.1)
    assert np.array_equal(camera.pattern((60, 80))[1], offset)
    assert not np.array_equal(replace(camera, pattern_seed=1).pattern((60, 80))[1], offset)


def test_the_makers_correction_leaves_its_rounding() -> None:
    """Five frames of 8 bits, averaged, as whole numbers: at least 16 / sqrt(12) codes of 12 bits remain."""
    camera = replace(CelexCamera(PIXEL), noise_codes=0.0, gain_mismatch=0.0)
    white = camera.capture(FLAT, [0.0, 1.0], np.linspace(0, 1, 5), seed=1)
    pattern = np.rint(white.astype(float).mean(0) - white.mean())
    left = 16 * (camera.capture(FLAT * 1.7, [0.0, 1.0], [0.5], seed=2)[0].astype(float) - pattern)
    assert left.std() >= 16 / math.sqrt(12) * 0.95
    assert left.std() < 20


def test_values_of_two_light_levels_differ_by_the_gain() -> None:
    one, other = (
        CLEAN.capture((level - 0.01) * np.ones((2, 2, 2)), [0.0, 1.0], [1.0], bits=12)
        for level in (40.0, 40.0 * math.e)
    )
    assert np.all(np.abs(other.astype(int) - one - 600) <= 1)


def test_an_event_carries_the_level_at_which_it_was_granted() -> None:
    times = np.linspace(0.0, 1.0, 201)
    light = 20.0 * np.exp(1.5 * times)[:, None, None] * np.ones((1, 3, 4))
    events, polarity = CLEAN.record(light, times)
    level = np.log(np.interp(events.t_us * 1e-6, times, light[:, 0, 0]) + 0.01)
    expected = 2048 + 600 * (level - math.log(60))
    assert len(events) == 15 * 12 or len(events) == 14 * 12
    assert np.abs(events.adc - expected).max() <= 1.1
    assert polarity.all()
    assert events.p.all()


def test_values_of_pixels_that_fire_without_cause_scatter_by_their_noise() -> None:
    hot = ReadoutPixel(PIXEL, hot_pixel_fraction=1.0, hot_pixel_rate_hz=100.0)
    camera = replace(CLEAN, pixel=hot, noise_codes=13.0)
    events, _ = camera.record(np.full((3, 4, 5), 60.0), [0.0, 0.5, 1.0], seed=3)
    assert len(events) > 1500
    assert events.adc.astype(float).std() == pytest.approx(13.0, rel=0.06)


@pytest.mark.parametrize(("noise", "share"), [(10.0, 0.0067), (20.0, 0.108)])
def test_the_softwares_polarity_is_wrong_as_often_as_the_noise_says(noise, share) -> None:
    """Q(G theta / (sqrt 2 s)): steps of G theta = 35 codes."""
    camera = replace(CLEAN, codes_per_efold=350.0, noise_codes=noise)
    times = np.linspace(0.0, 1.0, 101)
    light = 60.0 * np.exp(2.5 * np.sin(2 * np.pi * 2.25 * times))[:, None, None] * np.ones((1, 12, 16))
    events, polarity = camera.record(light, times, seed=4)
    order = np.lexsort((events.t_us, events.x, events.y))
    same = np.concatenate(
        [[False], (np.diff(events.y[order].astype(int)) == 0) & (np.diff(events.x[order].astype(int)) == 0)]
    )
    steady = same & np.concatenate([[False], polarity[order][1:] == polarity[order][:-1]])
    wrong = (events.p[order] != polarity[order])[steady]
    count = steady.sum()
    assert count > 10_000
    # half of the values that are equal count as wrong: a value's step is one code of 35
    assert abs(wrong.mean() - share) < 5 * math.sqrt(share / count) + 0.25 * share


def test_the_first_event_of_each_pixel_is_on_and_equal_values_have_no_polarity() -> None:
    times = np.linspace(0.0, 1.0, 51)
    light = 60.0 * np.exp(-1.0 * times)[:, None, None] * np.ones((1, 3, 4))
    events, polarity = CLEAN.record(light, times)
    assert not polarity.any()
    _, first = np.unique(events.y.astype(int) * 4 + events.x, return_index=True)
    assert events.p[first].all()
    assert int(events.p.sum()) == 12
    coarse, _ = replace(CLEAN, codes_per_efold=1.0).record(light, times)
    assert coarse.polarity_known is not None
    assert not coarse.polarity_known.all()


def test_recordings_go_through_the_cameras_own_files(tmp_path) -> None:
    light = np.full((3, 800, 1280), 60.0, np.float32)
    light[1:, 300:420, 500:700] *= 1.5
    camera = CelexCamera()
    events, _ = camera.record(light, [0.0, 0.01, 0.02], seed=5)
    assert len(events) > 20_000
    write_events(tmp_path / "scene_EI_70M.bin", events)
    again = read_events(tmp_path / "scene_EI_70M.bin")
    assert len(again) == len(events)
    assert sorted(again.adc.tolist()) == sorted(events.adc.tolist())
    for bits in (8, 12):
        frames = camera.capture(light, [0.0, 0.01, 0.02], [0.0, 0.02], bits=bits, seed=1)
        path = tmp_path / f"scene_F_100M_{bits}.bin"
        write_celex_frames(path, frames)
        assert np.array_equal(read_frames(path, bits=bits), frames)


def test_the_level_is_that_of_the_low_pass_filter() -> None:
    """Against steps of 2 us, in light whose bandwidth changes: the frames' own steps are 5 ms."""
    pixel = replace(PIXEL, cutoff_hz=60.0, cutoff_floor_dn=5.0)
    times = np.linspace(0.0, 0.1, 21)
    light = 30.0 + 25.0 * np.sin(2 * np.pi * 8 * times)
    fine = np.linspace(0.0, 0.1, 50_001)
    log = np.interp(fine, times, np.log(light + 0.01))  # a line between the frames, as documented
    speed = 2 * np.pi * 60 * (np.interp(fine, times, light) + 5) / 260 * np.diff(fine, prepend=0)
    level = log.copy()
    for k in range(1, len(fine)):
        level[k] = level[k - 1] + (log[k] - level[k - 1]) * -np.expm1(-speed[k])
    at = np.array([0.0123, 0.031, 0.0475, 0.1])
    frames = replace(CLEAN, pixel=pixel, codes_per_efold=1000.0).capture(
        light[:, None, None], times, at, bits=12
    )
    expected = 2048 + 1000 * (np.interp(at, fine, level) - math.log(60))
    assert np.abs(log - level).max() > 0.1
    np.testing.assert_allclose(frames.ravel(), expected, atol=6)


def test_the_event_model_sends_what_the_software_reports() -> None:
    """`CelexPixel` streams the events of `record` that have a polarity."""
    times = np.linspace(0.0, 0.5, 51)
    light = 60.0 * np.exp(np.sin(12 * times))[:, None, None] * np.ones((1, 6, 5))
    camera = CelexCamera(PIXEL, codes_per_efold=100.0, noise_codes=8.0)
    full, polarity = camera.record(light, times, seed=3)
    told = full[full.polarity_known]
    events = simulate_events(light, times, CelexPixel(camera), seed=3)
    assert np.array_equal(events.t_us, told.t_us) and np.array_equal(events.x, told.x)
    assert np.array_equal(events.p, told.p)
    assert len(told) < len(full) and 0.02 < (full.p != polarity).mean() < 0.5


def test_wrong_cameras_are_refused() -> None:
    with pytest.raises(ConfigError, match="jitter"):
        CelexPixel(CelexCamera(ReadoutPixel(PIXEL, jitter_s=1e-4)))
    with pytest.raises(DataError, match="two"):
        CLEAN.record(FLAT[:1], [0.0])
    with pytest.raises(ConfigError, match="true"):
        CelexCamera(EventPixel())
    with pytest.raises(ConfigError, match="noise_codes"):
        CelexCamera(noise_codes=-1.0)
    with pytest.raises(DataError, match="bits"):
        CLEAN.capture(FLAT, [0.0, 1.0], [0.5], bits=10)
    with pytest.raises(DataError, match="instants_s"):
        CLEAN.capture(FLAT, [0.0, 1.0], [1.5])
