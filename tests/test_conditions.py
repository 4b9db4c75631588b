"""Where events win: bounds and simulated sequences under one condition after another, resumable."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos.cameras import FlickeringWall, FrameCamera
from evnlos.experiment import Condition, conditions, conditions_table, regimes, sweep_parameters
from evnlos.inverse import SequenceLight, handwritten_prior, sequence_light
from evnlos.inverse.prior import TRAIN_CHARACTERS
from evnlos.plot.figures import draw_regimes
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import SensorSize
from evnlos.types import Plane

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


def test_noise_in_the_dark_is_not_clipped_and_rounding_hides_little_of_it() -> None:
    """At the largest gain zero electrons less four deviations are still above 0; rounding is a hundredth."""
    for bit_depth in (8, 12):
        camera = replace(Condition("dark", bit_depth=bit_depth).setup.frame_camera, gain=32.0)
        deviation = np.hypot(camera.read_noise_e, camera.dsnu_e) * camera.dn_per_electron
        assert camera.black_level > 4 * deviation
        assert 0.01 * (camera.read_noise_e * camera.dn_per_electron) ** 2 > 1 / 12


def test_light_and_speed_of_a_condition_scale_the_light_of_one_way() -> None:
    prior = handwritten_prior(Plane(16, 16, 0.005), 10, 1)
    one = Condition("some", light=0.1, speed_m_s=0.08, ambient=0.5, shade=30.0)
    light, setup = one.light_of(prior), one.setup
    span = (0.0, one.asked.duration_s)
    plain = sequence_light(setup, prior, one.asked.motion.position_m, span, setup.shape, fineness=2.0)
    z = np.linspace(-1, 1, prior.count)
    shade = one.shading().reshape(-1, 1)
    np.testing.assert_allclose(light(z), plain(z) * shade, rtol=1e-5)
    np.testing.assert_allclose(light.times_s, plain.times_s, rtol=1e-12)


def test_the_brightest_light_of_letters_is_that_about_the_frames() -> None:
    times = np.linspace(0.0, 1.0, 101)
    right = np.stack([np.sin(9 * times), np.cos(5 * times)], axis=1)[:, None]
    light = SequenceLight(np.array([[1.0], [2.0]]), right, np.full((2, 1), 0.1, np.float32), times, (1, 2))
    letters = [np.array([0.3]), np.array([-0.4])]
    frames = np.array([0.25, 0.5])
    found = module.brightest_light(light, letters, frames)
    expected = np.max([light(z)[:, [25, 26, 50, 51]] for z in letters], axis=(0, 2))
    np.testing.assert_allclose(found, expected)


def test_exposure_and_gain_are_those_of_training_letters_and_clip_no_pixel_that_counts(tmp_path) -> None:
    even = Condition("even", frames=40)
    chosen = [even, replace(even, name="shaded", shade=1000.0)]
    plain, shaded = sweep_parameters(chosen, tmp_path, workers=1, characters="")
    assert plain.left_out < 0.05 < shaded.left_out, "bright parts of a wall in shade may clip"
    assert plain.exposure_s < shaded.exposure_s <= even.duration_s / 40 * (1 + 1e-6)
    prior, setup = handwritten_prior(Plane(32, 32, 0.0025)), even.setup
    light = even.light_of(prior)
    camera, inside = module.tuned_camera(light, prior, setup, even.asked)
    assert (round(camera.exposure_s, 6), camera.gain) == (plain.exposure_s, plain.gain)
    exposed, scale = light.exposed(camera.exposure_s), camera.per_light().gain
    for name in TRAIN_CHARACTERS[:5]:
        glyphs = HandwritingGlyphs(characters=name, writers=1)
        z = prior.coefficients(glyphs.target(glyphs.objects()[0]).rasterise(prior.target_plane))
        frames = exposed(z)[:, 6:-6][:, ::6] * scale
        assert frames[inside].max() < 0.9


def test_a_ripple_costs_events_what_its_phase_is_unknown_by(tmp_path) -> None:
    still = Condition("still", frames=2, speed_m_s=0.32)
    unknown, known, wild = (
        replace(still, name=name, ripple=ripple, is_ripple_known=known)
        for name, ripple, known in (("unknown", 0.08, False), ("known", 0.08, True), ("wild", 0.2, False))
    )
    chosen = [still, unknown, known, wild]
    found = sweep_parameters(chosen, tmp_path, workers=1, characters="")
    events = [one.expected_db.get("events", (float("nan"),))[-1] for one in found]
    assert events[1] < events[0] - 0.05 and events[2] == events[0]
    assert list(found[3].expected_db) == ["frames"], "each ripple crosses thresholds: no bound"
    assert found[3].expected_db["frames"] == found[0].expected_db["frames"]
    row = conditions_table(found).splitlines()[-1].split(" | ")
    assert row[4] == "-" and row[6:10] == ["- / -", "- / -", "- / -", "-"] and row[5].endswith(" / -")


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
    assert [one.clipped for one in found] == [0, 0, 0]
    assert bright.thinned_frames * 16 * 24 <= bright.event_bytes[0] or bright.thinned_frames == 1
    assert bright.measured_db["frames thinned"][0] <= bright.measured_db["frames"][0] + 0.5
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
