"""Bounds of a moving target: the closed forms against dense algebra and drawn noise, and their laws."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evnlos.analysis import (
    AnalysisSettings,
    SequenceAnalysisSettings,
    event_information,
    frame_information,
    identify,
    row_information,
    sequence_bounds,
)
from evnlos.cameras import CrossingLaw, EventPixel, FrameCamera, simulate_events
from evnlos.config import from_dict
from evnlos.data import Capture, CaptureInfo
from evnlos.errors import ConfigError
from evnlos.inverse import (
    EventRecord,
    NormalEquations,
    PatternPrior,
    SequenceLight,
    levels_of,
    predicted_record,
    record_of,
    sequence_light,
)
from evnlos.plot.setup import draw_identification
from evnlos.scene import LineMotion, Target
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.types import Events, Plane

PLATE = Plane(8, 8, 0.01)
SETUP = RadiometricSetup(cell_m=0.01, gain=2.0, ambient=0.1, sensor=SensorSize(8, 12))
SETTINGS = SequenceAnalysisSettings(
    positions=8, counts=(1, 2, 4, 8), coefficients=12, writers=1, cells=8, crossing_noise=0.03, other_noises=()
)


def prior(count: int = 6, seed: int = 0) -> PatternPrior:
    draw = np.random.default_rng(seed)
    patterns = np.linalg.qr(draw.standard_normal((64, count)))[0] * np.linspace(1.5, 0.5, count)
    return PatternPrior(PLATE, np.full(64, 0.4), patterns, 0.01)


def light_of(targets: PatternPrior) -> SequenceLight:
    return sequence_light(SETUP, targets, SETTINGS.motion.position_m, (0.0, SETTINGS.duration_s))


@pytest.fixture(scope="module")
def light() -> SequenceLight:
    return light_of(prior())


def law(**changes: float) -> CrossingLaw:
    return replace(
        EventPixel(
            0.1, 0.12, 0.02, leak_rate_hz=0.0, shot_noise_rate_hz=0.0, initial_phase="rest"
        ).crossing_law(),
        **changes,
    )


def test_a_question_about_a_capture_has_its_motion_and_its_frames() -> None:
    info = from_dict(
        CaptureInfo,
        {"camera": {"width": 12, "height": 8}, "motion": {"start_m": -0.03, "speed_m_s": 0.03}},
        source="a test",
    )
    times = np.arange(1, 21) * 50_000
    nothing = Events(*np.zeros((4, 0)), width=12, height=8)
    capture = Capture("x", info, nothing, np.zeros((20, 8, 12), np.uint8), times, None)
    asked = SequenceAnalysisSettings.of_capture(capture)
    assert (asked.positions, asked.counts, asked.speed_m_s) == (20, (1, 20), 0.03)
    assert asked.duration_s == pytest.approx(1.0) and asked.travel_m == pytest.approx(0.03)
    found = sequence_bounds(SETUP, replace(asked, coefficients=12, writers=1, cells=8))
    assert [one.kind for one in found.events] == ["continuous"] and len(found.frames_db) == 2
    unknown = replace(capture, info=replace(info, motion=None))
    assert SequenceAnalysisSettings.of_capture(unknown).positions == 40


def test_the_light_is_that_of_the_setup(light: SequenceLight) -> None:
    targets, z = prior(), np.random.default_rng(1).standard_normal(6)
    image = targets.image(z)
    scale = image.max() - image.min()
    target = Target("drawn", ((image - image.min()) / scale).astype(np.float32), 0.08)
    flat = Target("flat", np.ones((8, 8), np.float32), 0.08)
    for k in (0, 60, len(light.times_s) - 1):
        place = SETTINGS.motion.position_m(light.times_s[k])
        plane = Plane(12, 40, 0.01)
        operator = SETUP.operator(plane)
        drawn = scale * target.rasterise(plane, place) + image.min() * flat.rasterise(plane, place)
        expected = operator(torch.from_numpy(drawn.astype(np.float64))).numpy() + SETUP.ambient_light().numpy()
        np.testing.assert_allclose(light(z)[:, k].reshape(8, 12), expected, atol=4e-3 * expected.max())


def test_rows_are_the_derivative_of_the_change(light: SequenceLight) -> None:
    plain = law(cutoff_hz=0.0)
    z, draw = np.zeros(6), np.random.default_rng(2)
    levels = levels_of(light(z), light.times_s, plain)
    record = predicted_record(light, levels, plain)
    assert record.measured.sum() > 100
    step = 1e-5 * draw.standard_normal(6)
    ahead, behind = (record.change(light, levels_of(light(z + s), light.times_s, plain)) for s in (step, -step))
    rows = np.concatenate([rows for _, rows, _ in record.blocks(light, levels)])
    known = record.measured
    np.testing.assert_allclose((rows @ step)[known], 0.5 * (ahead - behind)[known], atol=2e-8)


def test_the_filter_is_a_delay_to_first_order(light: SequenceLight) -> None:
    """On a slow ramp of log light the filtered level lags by 1 / w; fast filters change nothing."""
    times = np.linspace(0.0, 2.0, 201)
    ramp = 0.4 * np.exp(0.2 * times)[None]
    slow = levels_of(ramp, times, law(cutoff_hz=15.0))
    plain = levels_of(ramp, times, law(cutoff_hz=0.0)).value
    late = np.interp(times[100:] - slow.lag_s[0, 100:], times, plain[0])
    np.testing.assert_allclose(slow.value[0, 100:], late, atol=2e-4)
    fast = levels_of(ramp, times, law(cutoff_hz=1e7)).value
    np.testing.assert_allclose(fast, plain, atol=1e-5)


def test_offsets_are_integrated_out_as_a_dense_covariance_does() -> None:
    draw = np.random.default_rng(3)
    rows, weight = draw.standard_normal((30, 5)), draw.uniform(0.5, 2.0, 30)
    group, residual, spread = np.sort(draw.integers(0, 7, 30)), draw.standard_normal(30), 0.7
    found = NormalEquations.empty(5)
    found.add(rows, weight, residual, group, spread)
    covariance = np.diag(1 / weight) + spread**2 * (group[:, None] == group)
    np.testing.assert_allclose(found.information, rows.T @ np.linalg.solve(covariance, rows), atol=1e-10)
    np.testing.assert_allclose(found.score, rows.T @ np.linalg.solve(covariance, residual), atol=1e-10)


def test_the_expected_error_is_that_of_drawn_measurements() -> None:
    """Monte Carlo: targets from the prior, rows with noise and shared offsets, the posterior's mean."""
    draw, targets = np.random.default_rng(4), prior()
    rows, group, sigma, spread = draw.standard_normal((20, 6)), np.repeat(np.arange(5), 4), 0.8, 0.5
    found = NormalEquations.empty(6)
    found.add(rows, np.full(20, sigma**-2), np.zeros(20), group, spread)
    trials = 20_000
    z = draw.standard_normal((trials, 6))
    y = (
        z @ rows.T
        + sigma * draw.standard_normal((trials, 20))
        + spread * draw.standard_normal((trials, 5))[:, group]
    )
    covariance = sigma**2 * np.eye(20) + spread**2 * (group[:, None] == group)
    score = np.linalg.solve(covariance, y.T).T @ rows
    estimate = np.linalg.solve(np.eye(6) + found.information, score.T).T
    error = np.square((estimate - z) @ targets.patterns.T).mean() + targets.rest
    assert targets.error(found.information) == pytest.approx(error, rel=0.02)
    posterior = np.linalg.inv(np.eye(6) + found.information)
    assert targets.variance(posterior).mean() == pytest.approx(targets.error(found.information))


def slow_crossings(levels: np.ndarray, on: float, off: float) -> list[tuple[int, float, int]]:
    """Each pixel's crossings on a grid a thousand times finer, written as one thinks of them."""
    found = []
    fine = np.linspace(0, levels.shape[1] - 1, 1000 * (levels.shape[1] - 1) + 1)
    for i, level in enumerate(levels):
        values = np.interp(fine, np.arange(len(level)), level)
        reference = values[0]
        for t, value in zip(fine, values, strict=True):
            while value >= reference + on:
                reference += on
                found.append((i, t, 1))
            while value <= reference - off:
                reference -= off
                found.append((i, t, -1))
    return found


def test_predicted_events_against_a_slow_reference(light: SequenceLight) -> None:
    plain = law(cutoff_hz=0.0)
    levels = levels_of(light(np.zeros(6))[36:60, ::2], light.times_s[::2], plain)
    thin = replace(
        light,
        left=light.left[36:60],
        right=light.right[::2],
        still=light.still[36:60],
        times_s=light.times_s[::2],
    )
    record = predicted_record(thin, levels, plain)
    step = thin.times_s[1] - thin.times_s[0]
    expected = slow_crossings(levels.value, 0.1, 0.12)
    got = [
        (int(i), t / step, int(s)) for i, t, s in zip(record.pixel, record.t_s, record.sign, strict=True) if s
    ]
    assert len(expected) > 20
    assert [(i, s) for i, _, s in got] == [(i, s) for i, _, s in expected]
    np.testing.assert_allclose([t for _, t, _ in got], [t for _, t, _ in expected], atol=2e-3)


def test_the_pixels_own_events_lie_a_threshold_apart(light: SequenceLight) -> None:
    """The levels are those of the continuous pixel, filter and knee included."""
    pixel = EventPixel(0.1, 0.12, 0.0, 30.0, 0.0, 0.0, initial_phase="rest")
    z = 0.3 * np.ones(6)
    seen = light(z)
    frames = (255 * seen.T.reshape(-1, *light.shape)).astype(np.float32)
    events = simulate_events(frames, light.times_s, pixel, seed=1)
    rule = pixel.crossing_law()
    record = record_of(events, rule, (light.times_s[0], light.times_s[-1]))
    change = record.change(light, levels_of(seen, light.times_s, rule))[record.measured]
    sign = record.sign[record.measured]
    assert len(change) == len(events) > 200
    assert np.abs(change - np.where(sign > 0, 0.1, -0.12)).max() < 2e-3


def test_the_result_does_not_depend_on_blocks(light: SequenceLight) -> None:
    plain = law(events_hz=0.2)
    levels = levels_of(light(np.zeros(6)), light.times_s, plain)
    record = predicted_record(light, levels, plain, seed=5)
    weight = np.where(record.measured, 400.0, 0.0)
    found = [row_information(light, levels, record, weight[None], 0.02, block)[0] for block in (1, 50, 10**6)]
    for one in found[1:]:
        np.testing.assert_allclose(one, found[0], rtol=0, atol=1e-6 * np.abs(found[0]).max())


def test_more_noise_or_mismatch_never_helps(light: SequenceLight) -> None:
    """Differences of information are positive semidefinite."""

    def information(noise: float = 0.03, **changes: float) -> np.ndarray:
        return event_information(light, np.zeros(6), law(**changes), SETTINGS, [noise])[0][0]

    base = information()
    for worse in (information(noise=0.06), information(threshold_sigma=0.05), information(noise=0.03)[:-1]):
        better = base[1:] if len(worse) < len(base) else base
        for one, other in zip(better, worse, strict=True):
            assert np.linalg.eigvalsh(one - other)[0] > -1e-9 * np.abs(one).max()
    silent = event_information(light, np.zeros(6), law(), replace(SETTINGS, silences=True))[0][0]
    assert all(
        np.linalg.eigvalsh(a - b)[0] > -1e-9 * np.abs(a).max() for a, b in zip(silent, base, strict=True)
    )


def test_an_unknown_pattern_costs_and_fades_with_its_size(light: SequenceLight) -> None:
    def information(known: bool, dsnu_e: float) -> np.ndarray:
        setup = replace(SETUP, frame_camera=FrameCamera(prnu=0.0, dsnu_e=dsnu_e))
        asked = replace(SETTINGS, fpn_corrected=known)
        two = frame_information(light, np.stack([np.zeros(6), np.ones(6)]), setup, asked)
        alone = [frame_information(light, z, setup, asked) for z in (np.zeros(6), np.ones(6))]
        np.testing.assert_array_equal(two, alone)  # at several targets, as at each
        return two[0]

    known = information(True, 100.0)
    for one, other in zip(known, information(False, 100.0), strict=True):
        assert np.linalg.eigvalsh(one - other)[0] > -1e-9 * np.abs(one).max()
        assert np.trace(other) < 0.99 * np.trace(one)
    np.testing.assert_allclose(information(False, 0.0), known, rtol=1e-9)


def test_bounds_of_a_setup() -> None:
    found = sequence_bounds(SETUP, SETTINGS, "small")
    assert {one.kind for one in found.events} == {"continuous", "v2e", "brownian", "circuit"}
    assert list(found.frames_db) == sorted(found.frames_db) and found.frames_db[0] > found.prior_db
    for one in found.events:
        assert list(one.events_db) == sorted(one.events_db)
        assert all(
            both >= max(pair) for both, *pair in zip(one.both_db, one.events_db, found.frames_db, strict=True)
        )
    table = found.table()
    assert table.count("\n| events,") == 4 and found.summary()["frames_db"] == found.frames_db
    shown = found.table(in_columns=True)
    rows, ends = shown.splitlines()[:-1], set()
    for row in rows:
        ends.add(re.search(r"  (?=[\d.]+(  |$))", row).start())
    assert "|" not in shown and len(ends) == 1 and len(rows) == 2 + 2 * 4  # columns, for a terminal
    for cell in re.findall(r"[\d.]+(?= \|)", table):
        assert cell in shown


def test_the_figure_of_a_setup_draws_them_over_the_number_of_positions(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    found = identify(SETUP, AnalysisSettings(cells=8, height=8, width=12, writers=1), "small")
    limits = sequence_bounds(SETUP, replace(SETTINGS, other_noises=(0.06,)), "small")
    for k, given in enumerate((limits, None)):
        words = re.findall(
            "<!-- (.*?) -->", draw_identification(found, tmp_path / f"{k}.svg", given).read_text()
        )
        drawn = {"positions", "frames", "both, continuous, 3.0 %", "events, continuous, 3.0 %", "6 %"}
        drawn |= {"events, v2e, brownian, circuit", "prior alone"}
        assert drawn <= set(words) if given else not drawn & set(words)
        assert {"mode", "noise", "truth"} <= set(words)


def test_a_record_knows_where_each_event_is_measured_from() -> None:
    events = Events([10, 20, 30], [0, 0, 1], [0, 0, 0], [True, False, True], 2, 1)
    resting, other = (record_of(events, law(starts_at_rest=rest), (0.0, 1e-4)) for rest in (True, False))
    assert resting.sign.tolist() == [0, 1, -1, 0, 0, 1, 0] and isinstance(resting, EventRecord)
    assert resting.origin.tolist() == [-1, 0, 1, 2, -1, 4, 5]
    assert other.origin.tolist() == [-1, -1, 1, 2, -1, -1, 5]
    quiet = record_of(events, law(), (0.0, 1e-4), gap_s=3e-5)
    assert quiet.origin[quiet.sign == 0].tolist() == [-1, 2, 2, 2, -1, 7, 7, 7]


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"counts": (50,)}, "1 to 8"), ({"crossing_noise": 0.0}, "positive"), ({"cells": 4}, "8 to 64")],
)
def test_bad_benches(changes: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        replace(SETTINGS, **changes)


def test_the_motion_of_the_bench_is_centred() -> None:
    assert isinstance(SETTINGS.motion, LineMotion)
    np.testing.assert_allclose(
        SETTINGS.motion.position_m([0.0, SETTINGS.duration_s]), [[-0.08, 0], [0.08, 0]], atol=1e-12
    )
