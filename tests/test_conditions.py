"""Where events win: bounds and simulated sequences under one condition after another, resumable."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos.cameras import FlickeringWall, FrameCamera
from evnlos.experiment import Condition, conditions, conditions_table, regimes, sweep_parameters
from evnlos.inverse import SequenceLight
from evnlos.plot.figures import draw_regimes
from evnlos.setups import SensorSize

module = importlib.import_module("evnlos.experiment.conditions")


@pytest.fixture(autouse=True)
def small_sensor(monkeypatch):
    monkeypatch.setattr(module, "_SENSOR", SensorSize(16, 24))
    monkeypatch.setattr(module, "_GAINS", (1.0, 8.0))


def test_conditions_have_names_of_their_own_and_clip_nothing() -> None:
    found = conditions()
    assert found[0] == Condition("base") and len({one.name for one in found}) == len(found)
    for one in (*found, *regimes()):
        assert one.setup.gain + one.setup.ambient <= module.FULL + 1e-9
        asked = one.asked
        assert asked.counts[-1] == asked.positions <= one.frames
        assert asked.positions / asked.duration_s <= 100 + 1e-9
    shade = replace(found[0], shade=1000.0).shading()
    assert shade.max() <= 1 + 1e-12 and shade.min() == pytest.approx(1e-3, rel=0.5)
    assert (found[0].shading() == 1).all()


def test_light_sets_what_frames_and_events_are_worth(tmp_path) -> None:
    base = Condition("base", frames=5)
    chosen = [base, replace(base, name="dim", light=0.003), replace(base, name="lost", is_motion_known=False)]
    found = sweep_parameters(chosen, tmp_path, workers=1, characters="A")
    bright, dim, lost = found
    for one in found:
        for name in ("frames", "events", "both"):
            db = one.expected_db[name]
            assert one.counts == (1, 2, 5) and list(db) == sorted(db) and db[0] >= one.prior_db
        assert all(
            b >= max(f, e) for f, e, b in zip(*(one.expected_db[k] for k in module.EVIDENCE), strict=True)
        )
    assert dim.expected_db["frames"][-1] < bright.expected_db["frames"][-1] - 0.5
    assert dim.exposure_s > bright.exposure_s
    for name in module.EVIDENCE:
        assert lost.expected_db[name][-1] < bright.expected_db[name][-1]
        assert abs(bright.measured_db[name][0] - bright.expected_db[name][-1]) < 3
    assert lost.measured_db == {} and bright.event_bytes[0] == pytest.approx(
        bright.events_per_pixel * 16 * 24 * 4, rel=1e-2
    )
    assert bright.frame_bytes[0] == 5 * 16 * 24
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = sweep_parameters(chosen, tmp_path, workers=1, characters="A")
    assert again == found and {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    table = conditions_table(found)
    assert "| dim | 5 | " in table and len(table.splitlines()) == 5


def test_the_map_is_drawn(tmp_path) -> None:
    pytest.importorskip("matplotlib")
    (one,) = sweep_parameters([Condition("regime", frames=2)], tmp_path, workers=1, characters="")
    assert one.measured_db["events"] == () and one.event_bytes == (0, 0)
    cells = [Condition("regime", light=a, speed_m_s=b, frames=2) for a in (1.0, 0.1) for b in (0.08, 0.32)]
    found = [replace(one, condition=cell) for cell in cells]
    assert draw_regimes(found, tmp_path / "map.png").stat().st_size > 5_000


def test_further_unknowns_cost_what_a_larger_posterior_says() -> None:
    rows = np.random.default_rng(0).standard_normal((40, 7))
    whole = rows.T @ rows
    kept = np.linalg.inv(np.linalg.inv(np.eye(7) + whole)[:5, :5]) - np.eye(5)
    np.testing.assert_allclose(module.marginal_information(whole, 5), kept, atol=1e-10)
    np.testing.assert_array_equal(module.marginal_information(whole, 7), whole)


def test_an_unknown_motion_is_a_shift_in_time() -> None:
    """Along the way a place is a time: what moves by 10 mm is what comes later by that over the speed."""
    times = np.linspace(0.0, 2.0, 201)
    right = np.sin(3 * times)[:, None, None] * np.ones((1, 1, 2))
    light = SequenceLight(np.ones((4, 1)), right, np.zeros((4, 1), np.float32), times, (2, 2))
    asked = replace(Condition("a").asked, speed_m_s=0.08)
    (found,) = module.motion_unknowns(light, [np.array([0.5])], asked)
    late_s = 0.01 / 0.08
    expected = 1.5 * np.cos(3 * times) * 3 * late_s
    np.testing.assert_allclose(found.right[5:-5, 0, 2], expected[5:-5], atol=1e-3)
    assert found.right.shape == (201, 1, 4)


def test_frames_that_collect_electrons_have_the_noise_of_the_light() -> None:
    camera = FrameCamera(electrons_per_s=2e5, exposure_s=0.02, gain=3.0, prnu=0, dsnu_e=0, bit_depth=12)
    light = np.full((1, 300, 300), 0.4)
    frames = camera.expose(light, seed=1) / camera.dn_per_electron / camera.white_e
    variance = float(camera.per_light().noise_variance(torch.tensor(0.4)))
    assert frames.mean() == pytest.approx(0.4, rel=3e-3)
    assert frames.var() == pytest.approx(variance, rel=0.02)
    assert FrameCamera().per_light() == FrameCamera()


def test_light_is_averaged_over_an_exposure() -> None:
    times = np.linspace(0.0, 1.0, 401)
    right = np.exp(1j * 9 * times).real[:, None, None] * np.ones((1, 2, 3))
    still = np.sin(5 * times)[None].astype(np.float32) * np.ones((4, 1), np.float32)
    light = SequenceLight(np.ones((4, 2)), right, still, times, (2, 2))
    seen = light.exposed(0.2)
    sinc = np.sinc(0.2 * 9 / (2 * np.pi)), np.sinc(0.2 * 5 / (2 * np.pi))
    inside = slice(60, -60)
    np.testing.assert_allclose(seen.right[inside], right[inside] * sinc[0], atol=1e-3)
    np.testing.assert_allclose(seen.still[:, inside], still[:, inside] * sinc[1], atol=1e-3)
    assert light.exposed(0.0).right == pytest.approx(right)


def test_a_frame_sees_the_mean_of_a_ripple() -> None:
    class Steady:
        shape, speed_px_s = (2, 3), 0.0

        def irradiance(self, t_s):
            return torch.full((len(np.atleast_1d(t_s)), 2, 3), 0.5)

    wall = FlickeringWall(Steady(), contrast=0.3, frequency_hz=100.0)
    for exposure_s in (1e-4, 0.004, 0.01, 0.013):
        fine = 0.0123 + exposure_s * ((np.arange(4000) + 0.5) / 4000 - 0.5)
        mean = float(wall.irradiance(fine).double().mean())
        assert wall.exposed([0.0123], exposure_s)[0, 0, 0] == pytest.approx(mean, rel=1e-5)
    camera = FrameCamera(exposure_s=0.01, full_well_e=1e9, read_noise_e=0, prnu=0, dsnu_e=0)
    assert np.ptp(camera.capture(wall, np.linspace(0.1, 0.2, 7))) <= 1
