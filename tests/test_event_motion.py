"""A path found from events alone: against the true path, and each derivative against finite differences."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from evnlos.cameras import EventCamera, EventPixel, FrameCamera
from evnlos.cli import main
from evnlos.config import read_yaml, save_yaml
from evnlos.data import SensorSize, Simulation, read_capture
from evnlos.data.lab import Lab, render_captures
from evnlos.errors import ConfigError, DataError
from evnlos.models import published_setup
from evnlos.scene import FontGlyphs, HandwritingGlyphs, LineMotion, PathMotion, Scene
from evnlos.setups import RadiometricSetup, load_setup
from evnlos.tracking import Tracking, track_capture, track_events
from evnlos.tracking.event_motion import EventFit
from evnlos.types import Events

PIXEL = EventPixel(0.15, 0.18, 0.02, 60.0, 0.0, 0.1, 0.0)
SETUP = RadiometricSetup(
    roughness=0.04,
    camera_angle_deg=20.0,
    field_of_view_deg=40.0,
    cell_m=0.008,
    gain=0.8,
    ambient=0.05,
    pixel=PIXEL,
    sensor=SensorSize(32, 48),
    strip_m=(0.24, 0.12),
)
SPAN_S = (0.2, 5.8)


def recorded(motion: PathMotion, setup: RadiometricSetup = SETUP) -> tuple[Scene, Events]:
    scene = Scene(HandwritingGlyphs().target("writer03_R"), motion, 6.0)
    return scene, EventCamera(PIXEL).record(setup.observe(scene), 0.0, 6.0, seed=3)


BENT = PathMotion((0.0, 2.0, 4.0, 6.0), ((-0.06, -0.01), (-0.03, 0.012), (0.02, 0.008), (0.06, -0.01)))


def test_events_alone_tell_a_bent_path_within_what_they_state() -> None:
    scene, events = recorded(BENT)
    track = track_events(events, SPAN_S, SETUP, Tracking(target_size_m=0.1))
    error, sigma = track.position - scene.light_m(track.time_s), track.position_sigma
    assert track.unit == "m" and track.events == len(events) and track.event_windows == 0
    assert np.sqrt(np.square(error).mean()) < 6e-4  # a stroke is 11 mm wide
    assert sigma.mean() < 6e-4 and np.abs(error / sigma).mean() < 1.6  # 0.8 of exact deviations
    assert np.abs(track.velocity[8:-8, 0] - 0.02).max() < 0.012


@pytest.mark.slow
def test_events_alone_tell_distance_and_turn() -> None:
    away, setup = (0.28, 0.3, 0.32, 0.3), replace(SETUP, roughness=0.09)  # behind which fewer distances differ
    scene, events = recorded(replace(BENT, z_m=away, rotation_deg=(-20.0, 5.0, 20.0, -5.0)), setup)
    small = Tracking(target_size_m=0.1, depth=True, turning=True, columns=24, cells=12)
    track = track_events(events, SPAN_S, setup, small)
    pose = scene.pose(track.frame_time_s)
    assert track.distance is not None and track.turn is not None
    assert track.distance.is_identified and track.turn.is_identified
    off = track.distance.distance_m / track.distance.distance_m.mean() - pose.z_m / pose.z_m.mean()
    assert np.abs(off).max() < 0.03
    degrees = np.degrees(pose.rotation_rad - pose.rotation_rad.mean())
    assert np.abs(track.turn.rotation_deg - degrees).max() < 5.0


def test_a_wrong_setup_makes_no_distance_that_changes() -> None:
    """Thresholds a tenth off bend a constant distance by more than noise does: it passed as identified."""
    setup, away = replace(SETUP, roughness=0.09), replace(BENT, z_m=(0.28, 0.3, 0.32, 0.3))
    wrong = replace(setup, pixel=replace(PIXEL, threshold_on=0.165))
    few = Tracking(target_size_m=0.1, depth=True, columns=24, cells=12)
    for motion, told in ((BENT, False), (away, True)):
        found = track_events(recorded(motion, setup)[1], SPAN_S, wrong, few).distance
        assert found is not None and found.distance_m.std() > found.distance_sigma.mean()
        assert found.feigned_m == pytest.approx(0.006) and found.is_identified is told
    with pytest.raises(DataError, match="this wall does not show where its light comes from"):
        matte = replace(setup, wall_material="lambert")
        track_events(recorded(away, matte)[1], SPAN_S, matte, few)


@pytest.mark.slow
def test_a_capture_of_constant_distance_is_not_identified(shared_data) -> None:
    """Found are 3.3 mm rms about the mean, where 0.75 mm are stated: errors of the setup and of its pixel."""
    setup = load_setup(published_setup("near-event-sequence"))
    capture = read_capture(shared_data / "captures" / "near_5", needs_frames=False)
    found = track_capture(capture, setup, Tracking(frames=False, depth=True, turning=True)).distance
    assert found is not None and not found.is_identified
    assert 2 * found.distance_sigma.mean() < found.distance_m.std() < 0.8 * found.feigned_m


def test_what_a_pose_changes_of_the_light_is_its_derivative() -> None:
    """Slow reference: the light of the same target at poses on both sides."""
    times, reach = np.linspace(*SPAN_S, 9), np.array([[-0.1, -0.06], [0.1, 0.06]])
    fit = EventFit(SETUP, reach, times, (16, 24), (16, 24), 0.1, 12, depth=True, turning=True)
    path = fit.start(BENT.position_m(times))
    rng = np.random.default_rng(2)
    path = replace(path, z=0.3 * rng.standard_normal(len(path.z)), shine=0.05)
    light, count, knots = fit.light(path), len(path.z), len(times)
    target = np.concatenate([path.z, np.zeros(4 * knots + 1)])
    plain = light(target) - light.still
    for kind, (step, unit) in enumerate(((1e-4, 1.0), (1e-4, 1.0), (1e-3, 0.3), (4e-3, 0.025))):
        for knot in (2, 6):
            sides = []
            for way in (-1, 1):
                pose = path.pose.copy()
                pose[knot, kind] += way * step
                sides.append(fit.light(replace(path, pose=pose))(target))
            slow = (sides[1] - sides[0]) / (2 * step * unit) * 0.1  # a side of the target
            asked = target.copy()
            asked[count + 4 * knot + kind] = 1.0
            fast = light(asked) - light.still - plain
            assert np.abs(fast - slow).max() < 0.02 * np.abs(slow).max(), (kind, knot)
    asked = target.copy()
    asked[-1] = 1.0
    brighter = fit.light(replace(path, shine=0.07))(target) - fit.light(path)(target)
    np.testing.assert_allclose(light(asked) - light.still - plain, brighter, atol=1e-5 * np.abs(plain).max())


class Lawless(EventPixel):
    """A pixel of which nobody knows when it sends."""

    def crossing_law(self, light_dn: float = 60.0):
        return None


def test_what_no_path_can_be_found_from_is_refused() -> None:
    events = Events.empty(48, 32)
    with pytest.raises(DataError, match=r"0 events between first and last instant; a path needs 200"):
        track_events(events, SPAN_S, SETUP)
    with pytest.raises(ConfigError, match=r"targets is 2; several are found by frames alone"):
        track_events(events, SPAN_S, SETUP, Tracking(targets=2))
    with pytest.raises(ConfigError, match=r"both off"):
        Tracking(events=False, frames=False)
    with pytest.raises(ConfigError, match=r"step_s is 0.0; give"):
        Tracking(step_s=0.0)
    rng, many = np.random.default_rng(0), 3_000
    order = np.sort(rng.integers(0, 6_000_000, many))
    noise = Events(order, rng.integers(0, 48, many), rng.integers(0, 32, many), rng.random(many) < 0.5, 48, 32)
    with pytest.raises(ConfigError, match=r"states no law of its crossings"):
        track_events(noise, SPAN_S, replace(SETUP, pixel=Lawless(0.15, 0.18)))
    with pytest.raises(
        DataError, match=r"the path explains .* % of what the events say of the light, noise alone"
    ):
        track_events(noise, SPAN_S, SETUP, Tracking(target_size_m=0.1, columns=24, cells=12))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    camera = FrameCamera(exposure_s=0.016, full_well_e=8000.0, read_noise_e=20.0)
    lab = Lab(
        glyphs=FontGlyphs(family="kalam", characters="L"),
        setup=replace(SETUP, frame_camera=camera),
        motion=LineMotion((-0.05, 0.0), 0.02),
        duration_s=5.0,
        frame_rate_hz=4.0,
        spread={},
    )
    folder = tmp_path_factory.mktemp("events")
    (made,) = render_captures(lab, folder / "captures")
    save_yaml(Simulation(setup=SETUP), folder / "setup.yaml")
    return made, folder / "setup.yaml"


def test_the_command_follows_events_where_frames_are_left_out_or_absent(capture, tmp_path, capsys) -> None:
    folder, setup = capture
    pytest.importorskip("matplotlib")
    small = ["--setup", str(setup), "--columns", "24", "--cells", "12"]
    main(["track", str(folder), *small, "--no-frames", "--out", str(tmp_path / "t.png"), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["frames"] == 0 and found["events"] > 1000 and "size_change" not in found
    assert found["position_error"] < 1e-3 and found["travel"] == pytest.approx(0.1, abs=0.002)
    info = read_yaml(folder / "capture.yaml")
    info["frames"] = None
    (folder.parent / "alone").mkdir()
    for name in ("events.raw", "target.png"):
        (folder.parent / "alone" / name).hardlink_to(folder / name)
    (folder.parent / "alone" / "capture.yaml").write_text(yaml.safe_dump(info))
    with pytest.raises(SystemExit):
        main(["track", str(folder.parent / "alone"), "--out", str(tmp_path / "p.png")])
    assert "events alone need a setup to be followed; give one (--setup)" in capsys.readouterr().err
    for words in ([str(folder), "--no-frames"], [str(folder.parent / "alone")]):
        with pytest.raises(SystemExit):
            main(["track", *words, "--setup", str(setup), "--targets", "2", "--out", str(tmp_path / "p.png")])
        assert "Tracking.targets is 2; several are found by frames alone" in capsys.readouterr().err
    assert not (tmp_path / "p.png").exists()
    main(["track", str(folder.parent / "alone"), *small, "--out", str(tmp_path / "a.png")])
    assert " events alone" in capsys.readouterr().out


@pytest.mark.parametrize("evidence", ["events", "frames"])
def test_a_target_is_solved_from_a_path_that_nobody_stated(evidence, capture, tmp_path, capsys) -> None:
    """An L, whose light's middle is far from the middle that the prior's letters have, loses 2 to 4 dB."""
    folder, setup = capture
    pytest.importorskip("matplotlib")
    info = read_yaml(folder / "capture.yaml")
    info["motion"] = None
    unstated = shutil.copytree(folder, tmp_path / "unstated")
    (unstated / "capture.yaml").write_text(yaml.safe_dump(info))
    rows = []
    for k, words in enumerate(([str(folder)], [str(folder), "--track"], [str(unstated)])):
        out = ["--out", str(tmp_path / f"found{k}.png"), "--json"]
        main(["invert", *words, "--setup", str(setup), "--from", evidence, *out])
        rows += json.loads(capsys.readouterr().out)["rows"]
    stated, tracked, found = rows
    assert stated["psnr_db"] > 20 and 18 < tracked["psnr_db"] < stated["psnr_db"]
    assert tracked["expected_db"] == pytest.approx(stated["expected_db"], abs=1.0)
    assert "covered_90" in stated and "covered_90" not in tracked
    assert found["psnr_db"] is None and found["side_m"] == tracked["side_m"] > stated["side_m"]
