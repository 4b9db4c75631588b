"""The map of where events win: one factor at a time, the same sequences for both cameras, resumable."""

from dataclasses import replace

import pytest

from evnlos.data import Sampling, SensorSize
from evnlos.experiment import base_simulation, conditions, conditions_table, sweep_parameters
from evnlos.experiment.conditions import FULL

SMALL = replace(
    base_simulation(2),
    glyphs=replace(base_simulation(2).glyphs, characters="AT"),
    setup=replace(base_simulation(2).setup, sensor=SensorSize(24, 36)),
    positions=10,
    sampling=Sampling(height=24, width=36, pitch_m=0.00667, scored_rows=18),
)


def test_conditions_change_one_factor_and_clip_nothing() -> None:
    base, *others = conditions(SMALL)
    assert base.simulation == SMALL
    for one in others:
        wall = one.simulation.setup
        assert wall.gain + wall.ambient <= FULL + 1e-9
        changed = {
            section
            for section in ("frame_camera", "motion", "pixel", "glyphs")
            if getattr(one.simulation, section) != getattr(SMALL, section)
        }
        if wall.with_cameras_of(SMALL.setup) != SMALL.setup:
            changed.add("wall")
        setup = dict.fromkeys(("ambient", "light", "roughness", "albedo", "distance"), "wall")
        expected = setup | {"speed": "motion"}
        assert changed == {expected.get(one.factor, "frame_camera")}
        way = one.simulation.motion.speed_m_s * one.simulation.duration_s
        assert way == pytest.approx(SMALL.motion.speed_m_s * SMALL.duration_s)
    setup = {"roughness", "albedo", "distance"}
    assert {one.factor for one in others} == {"ambient", "light", "read noise", "exposure", "speed"} | setup


def test_noise_takes_from_frames_what_it_leaves_to_events(tmp_path) -> None:
    every = conditions(SMALL)
    chosen = [every[0]] + [c for c in every if c.factor == "read noise" and c.value == 300.0]
    found = sweep_parameters(chosen, tmp_path, workers=1, rank=24)
    clean, noisy = found
    assert noisy.psnr_db["frame"] < clean.psnr_db["frame"] - 0.2
    assert noisy.psnr_db["event"] == pytest.approx(clean.psnr_db["event"], abs=1e-6)
    assert clean.gain_db[1] <= clean.gain_db[0] <= clean.gain_db[2]
    assert clean.event_bytes_s == pytest.approx(clean.events_per_pixel * 24 * 36 * 4 / 8.0, rel=1e-2)
    assert clean.frame_bytes_s == 100 * 24 * 36
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = sweep_parameters(chosen, tmp_path, workers=1, rank=24)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    assert conditions_table(again) == conditions_table(found)
    assert "| read noise 300 electrons |" in conditions_table(found)
