"""The room as a setup: moving targets against its operator, and the two renderers against each other."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch

from evnlos.cameras import EventPixel, FrameCamera, ReadoutPixel
from evnlos.cli.datasets import SimulateCommand
from evnlos.config import from_dict, to_dict
from evnlos.data import Simulation
from evnlos.errors import ConfigError
from evnlos.lab import Lobe, Mount, Reflection, Torch, tilted, waves
from evnlos.scene import LineMotion, Scene, Target
from evnlos.setups import ROOMS, RadiometricSetup, RoomSetup, SensorSize, Setup, load_setup
from evnlos.types import Plane

MIXED = Reflection((Lobe("ggx", 0.6, 0.06, 0.06), Lobe("streak", 0.4, 0.08, 0.2, turn_deg=20.0)), matte=0.05)


def room(**changes) -> RoomSetup:
    small = {"sensor": SensorSize(10, 16), "cell_m": 0.01, "key_frame_s": 0.25, "reflection": MIXED}
    return dataclasses.replace(RoomSetup(), **small | changes)


def scene() -> Scene:
    mask = np.random.default_rng(0).random((8, 8)).astype(np.float32)
    return Scene(Target("noise", mask), LineMotion(), duration_s=8.0)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"curvature": (0.9, 0.5), "texture_smooth": 0.05, "texture_fine": 0.05, "vignetting": 0.1},
        {"lamp": Torch(), "distortion": (-0.05, 0.01), "camera_roll_deg": 2.0, "camera_elevation_deg": 4.0},
        {"aperture_m": 0.012, "focus_m": 0.5, "ambient_gradient": (0.0, 0.0)},
        {"waviness": 0.005, "curvature": (0.4, 0.0)},
    ],
)
def test_the_wall_at_a_key_frame_is_what_the_operator_says(changes):
    setup, shown = room(**changes), scene()
    plane, place = Plane(8, 24, 0.01), shown.motion.position_m(2.5)
    picture = torch.from_numpy(shown.target.rasterise(plane, place)).double()
    expected = setup.operator(plane)(picture) + setup.ambient_light().double()
    seen = setup.observe(shown).irradiance(2.5).double()
    assert (expected - setup.ambient_light()).max() > 0.1
    torch.testing.assert_close(seen, expected, rtol=1e-4, atol=1e-5)


def test_a_process_that_begins_with_a_room_keeps_the_threads_of_pytorch():
    """It had a thread for each core, which waited for each other at every operation after the room."""
    code = (
        "import torch\nfrom evnlos.setups import RoomSetup\nfrom evnlos.types import Plane\n"
        "RoomSetup().throughput((4, 6), Plane(2, 3, 0.01))\nprint(torch.get_num_threads())"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "1\n"  # as `conftest.py` asks


def test_gain_is_the_brightest_pixel_while_a_square_shines():
    square = Scene(
        Target("square", np.ones((4, 4), np.float32)), LineMotion(start_m=(0.0, 0.0), speed_m_s=0.0), 1.0
    )
    light = room(gain=0.6, cell_m=0.005).observe(square).irradiance(0.5) - room().ambient_light()
    assert float(light.max()) == pytest.approx(0.6, rel=1e-4)


def test_the_mount_adds_light_below_the_target():
    still = Scene(Target("dark", np.zeros((4, 4), np.float32)), LineMotion(), 8.0)
    assert torch.equal(room().observe(still).irradiance(4.0), room().ambient_light())
    with_mount = room(mount=Mount(0.05)).observe(still).irradiance(4.0) - room().ambient_light()
    assert 0.001 < float(with_mount.max()) < 0.05


def test_texture_and_vignetting_act_on_all_light_alike():
    bare = room(rays=1)
    shaped = room(rays=1, texture_smooth=0.05, texture_fine=0.04, texture_seed=3)
    share = shaped.ambient_light().double() / bare.ambient_light().double()
    assert 0.02 < float(share.std()) < 0.12
    plane = Plane(4, 6, 0.02)
    # the scale by the brightest pixel is the only other difference
    ratio = shaped.throughput((10, 16), plane) / bare.throughput((10, 16), plane)
    np.testing.assert_allclose(ratio, np.broadcast_to(share.numpy().reshape(-1, 1), ratio.shape), rtol=1e-4)


def test_waves_are_slopes_of_one_surface_and_turn_what_the_wall_mirrors():
    """No curl, the stated deviation; and a wall of one slope everywhere is another renderer's turned wall."""
    x, y = np.meshgrid(np.linspace(0, 0.8, 801), np.linspace(0, 0.5, 501))
    slopes = waves(x, y, 3, 0.004)
    across, down = np.gradient(slopes[..., 0], 1e-3, axis=0), np.gradient(slopes[..., 1], 1e-3, axis=1)
    inside = np.s_[2:-2, 2:-2]
    assert np.abs(across - down)[inside].max() < 0.05 * np.abs(across).max()
    assert np.sqrt((slopes**2).mean()) == pytest.approx(0.004, rel=0.15)
    setup = room(rays=1, curvature=(0.0, 0.0))
    rays = setup.cast_rays((6, 9))
    turned = tilted(rays, np.broadcast_to([0.03, -0.02], (54, 1, 2)))
    normal = np.array([-0.03, 0.02, 1.0]) / np.linalg.norm([0.03, 0.02, 1.0])
    np.testing.assert_allclose(turned.frame[:, 0, 2], np.broadcast_to(normal, (54, 3)), atol=1e-12)
    np.testing.assert_allclose(
        turned.frame @ turned.frame.swapaxes(-1, -2), np.broadcast_to(np.eye(3), (54, 1, 3, 3)), atol=1e-12
    )
    seen, same = (np.einsum("psij,psi->psj", one.frame, one.eye) for one in (rays, turned))
    np.testing.assert_allclose(seen, same, atol=1e-12)
    flat = tilted(rays, np.zeros((54, 1, 2)))
    np.testing.assert_allclose(flat.frame, rays.frame, atol=1e-12)


def test_both_renderers_agree_where_both_can_describe_the_wall():
    """Roughness 0.1, small cells: masking and Fresnel terms differ by a per cent, geometry by nothing."""
    plane = Plane(6, 10, 0.008, (0.02, -0.01))
    shape = (12, 18)
    for angle in (30.0, -20.0):
        ours = RoomSetup(
            reflection=Reflection((Lobe("ggx", 1.0, 0.1, 0.16),), matte=0.0), camera_angle_deg=angle, rays=48
        )
        theirs = RadiometricSetup(roughness=0.1, roughness_y=0.16, camera_angle_deg=angle)
        a = ours.throughput(shape, plane).astype(np.float64)
        b = theirs.matrix(shape, plane).numpy().reshape(a.shape)
        # vignetting is the camera's own here
        a /= (ours.cast_rays(shape).share.sum(axis=1))[:, None]
        scale = (a * b).sum() / (b * b).sum()
        assert scale == pytest.approx(1.0, abs=0.03)
        assert np.linalg.norm(a - scale * b) / np.linalg.norm(a) < 0.015
        mirrored = b.reshape(*shape, *plane.shape)[:, ::-1].reshape(b.shape)
        assert np.linalg.norm(a - scale * mirrored) / np.linalg.norm(a) > 0.3


def test_a_ripple_is_in_the_light_but_not_in_long_exposures():
    rippling, still = room(ripple=0.05, ripple_hz=100.0), room()
    quarter = 4.0 + 0.0025
    ratio = rippling.observe(scene()).irradiance(quarter) / still.observe(scene()).irradiance(quarter)
    torch.testing.assert_close(ratio, torch.full_like(ratio, 1.05), rtol=1e-5, atol=0)
    quiet = FrameCamera(exposure_s=0.02, full_well_e=1e9, read_noise_e=0.0, prnu=0.0, dsnu_e=0.0, bit_depth=16)
    times = np.array([2.0013, 4.0037])
    frames = [quiet.capture(one.observe(scene()), times).astype(int) for one in (rippling, still)]
    assert np.abs(frames[0] - frames[1]).max() <= 4  # of 65535
    short = dataclasses.replace(quiet, exposure_s=0.001)
    frames = [short.capture(one.observe(scene()), times).astype(int) for one in (rippling, still)]
    assert np.abs(frames[0] - frames[1]).max() > 100


def test_the_event_camera_resolves_the_ripple():
    assert room().event_camera.time_step_s is None
    assert room(ripple=0.04, ripple_hz=100.0).event_camera.time_step_s == pytest.approx(0.001)


def test_another_distance_moves_the_target_alone():
    moved = room().at_distance(0.4)
    assert (moved.distance_m, moved.offset_m()) == (0.4, room().offset_m())
    assert moved.cast_rays((4, 6)).point.tolist() == room().cast_rays((4, 6)).point.tolist()


@pytest.mark.parametrize("name", sorted(ROOMS))
def test_every_named_room_shows_its_target_and_survives_a_file(name):
    setup = load_setup(name)
    assert from_dict(Setup, to_dict(setup)) == setup
    small = dataclasses.replace(setup.resized((10, 16)), cell_m=0.01, key_frame_s=0.5)
    wall = small.observe(scene())
    light = wall.irradiance(np.array([0.0, 4.0, 8.0])) - small.ambient_light()
    assert float(light.amax(dim=(1, 2)).min()) > 0.1
    assert float(light.max()) < 1.0


def test_rooms_are_read_when_one_is_asked_for():
    code = (
        "from evnlos.setups import ROOMS, load_setup\n"
        "load_setup('main-near'); print(vars(ROOMS).keys() - {'file'})\n"
        "load_setup('torch'); print(vars(ROOMS).keys() - {'file'})"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).split() == ["set()", "{'_stated'}"]


def test_the_file_of_rooms_states_what_is_meant():
    camera = FrameCamera(0.016, 10_000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=12)
    pixel = EventPixel(0.12, 1.4, 0.007, 40.0, 0.15, 0.02, 2e-3, pattern_seed=12, logarithm="true", dark_dn=1.0)
    one_sided = RoomSetup(
        reflection=Reflection((Lobe("ggx", 1.0, 0.05, 0.05),), matte=0.0),
        **{"ambient": 0.05, "ambient_gradient": (0.1, 0.1), "frame_camera": camera, "pixel": pixel},
        **{"distance_m": 0.28, "camera_distance_m": 0.55, "camera_angle_deg": 33.0, "field_of_view_deg": 32.0},
    )
    assert load_setup("one-sided") == one_sided
    inner = EventPixel(0.15, 0.17, 0.01, 90.0, 0.1, 0.1, 5e-4, pattern_seed=19, logarithm="true", dark_dn=0.5)
    faults = {"hot_pixel_fraction": 2e-3, "hot_pixel_rate_hz": 20.0, "dead_pixel_fraction": 5e-3}
    times = {"tick_s": 1e-4, "jitter_s": 2e-4}
    assert load_setup("slow-bus").pixel == ReadoutPixel(
        inner, "row", 2e-4, 2e-5, **times, **faults, pattern_seed=19
    )


def test_every_wall_and_every_sensor_is_in_some_room():
    """What real rigs have, one by one, and each event model; two rooms have both outside the simulator's."""
    rooms = dict(ROOMS)
    lobes = {name: one.reflection.lobes for name, one in rooms.items()}
    texture = {name: np.hypot(one.texture_smooth, one.texture_fine) for name, one in rooms.items()}
    walls = {
        "two lobes": {name for name in rooms if len(lobes[name]) == 2},
        "anisotropic": {name for name in rooms if any(one.width_x != one.width_y for one in lobes[name])},
        "texture of 5 to 10 %": {name for name in rooms if 0.05 <= texture[name] <= 0.1},
        "curvature of a metre": {name for name, one in rooms.items() if max(map(abs, one.curvature)) >= 0.8},
        "vignetting": {name for name, one in rooms.items() if one.vignetting},
        "distortion": {name for name, one in rooms.items() if any(one.distortion)},
        "defocus": {name for name, one in rooms.items() if one.aperture_m},
        "mount": {name for name, one in rooms.items() if one.mount.brightness},
        "ripple": {name for name, one in rooms.items() if one.ripple},
        "torch": {name for name, one in rooms.items() if one.lamp and one.lamp.body_m and one.lamp.holder_m},
    }
    assert [what for what, having in walls.items() if not having] == []
    kinds = {name: getattr(one.pixel, "kind", "") for name, one in rooms.items()}
    true_log = {name for name, one in rooms.items() if getattr(one.pixel, "logarithm", "") == "true"}
    assert true_log and set(kinds.values()) == {"continuous", "v2e", "brownian", "circuit", "readout", "celex"}
    plain = {name for name in rooms if not any(name in having for having in walls.values())}
    assert len(set(rooms) - plain - {n for n in rooms if kinds[n] == "continuous"}) >= 2


@pytest.mark.parametrize("name", sorted(ROOMS))
def test_the_sensor_of_every_room_records_its_target(name):
    setup = load_setup(name)
    small = dataclasses.replace(setup.resized((10, 16)), cell_m=0.01, key_frame_s=0.5)
    passing = Scene(scene().target, LineMotion(), 2.0)
    events = small.event_camera.record(small.observe(passing), 0.0, 2.0, seed=1)
    assert (events.width, events.height) == (16, 10)
    assert len(events) > 50 and 0 < events.p.mean() < 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_angle_deg": 85.0}, "camera_angle_deg is 85"),
        ({"ripple": 1.0}, "ripple is 1.0"),
        ({"gain": 0.0}, "gain is 0"),
        ({"texture_fine": -0.1}, "texture_fine is -0.1"),
        ({"rays": 0}, "rays is 0"),
        ({"lamp": Torch(place_m=(0.0, 0.0, 0.35))}, "lamp stands 0.35 m"),
    ],
)
def test_wrong_rooms_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        room(**changes)


def test_a_camera_that_looks_past_the_wall_is_refused():
    with pytest.raises(ConfigError, match="does not see the wall"):
        room(camera_angle_deg=70.0, field_of_view_deg=60.0).observe(scene())


def test_a_torch_that_shows_nothing_is_refused():
    dark = Torch(place_m=(0.0, 0.0, 0.1), radius_m=0.0, holder_m=(0.0, 0.0, 0.11, 1.0))
    with pytest.raises(ConfigError, match="no light of the target"):
        room(lamp=dark).observe(scene())


@pytest.mark.parametrize("name", ["circuit", "celex", "slow-bus"])
def test_a_simulation_in_a_room_keeps_the_sensor_of_the_room(name):
    asked = Simulation(vary={"setup.pixel.threshold_on": (0.1, 0.2), "motion.speed_m_s": (0.01, 0.02)})
    made, own = SimulateCommand.with_setup(asked, name), load_setup(name)
    assert made.setup == dataclasses.replace(own, sensor=asked.setup.sensor)
    assert list(made.vary) == ["motion.speed_m_s"]
    wall = SimulateCommand.with_setup(asked, "main-far")
    assert wall.setup.pixel == asked.setup.pixel and list(wall.vary) == list(asked.vary)
