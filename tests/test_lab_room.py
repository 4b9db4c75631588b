"""What stands in a rendered room: mount, torch and its shadows, key frames and the ripple of lamps."""

import numpy as np
import pytest

from evnlos.cameras import FrameCamera
from evnlos.errors import ConfigError
from evnlos.lab import Mount, RenderedWall, Torch, brightness, covered_plane
from evnlos.scene import LineMotion, Scene, Target


def scene() -> Scene:
    return Scene(Target("square", np.full((4, 4), 0.5)), LineMotion(), duration_s=8.0)


def test_mount_and_target_stay_on_the_plane_with_all_their_light():
    mount = Mount(0.04, rim_m=0.004, stick_m=(0.012, 0.08))
    plane = covered_plane(scene(), mount, 0.0025)
    times = np.linspace(0, 8, 7)
    light = brightness(scene(), mount, plane, times).sum(axis=(1, 2)) * plane.pitch_m**2
    area = 0.088**2 - 0.08**2 + 0.012 * 0.08
    np.testing.assert_allclose(light, 0.5 * 0.08**2 + 0.04 * area, rtol=1e-5)
    bare = brightness(scene(), Mount(), covered_plane(scene(), Mount(), 0.0025), times)
    assert bare.shape[1] < plane.height
    assert float(bare.max()) == pytest.approx(0.5)


def test_the_stick_hangs_below_the_target_and_moves_with_it():
    mount = Mount(1.0)
    plane = covered_plane(scene(), mount, 0.002)
    first, last = brightness(scene(), mount, plane, np.array([0.0, 8.0]))
    row = int(np.argmin(np.abs(plane.y_m - 0.1)))  # downwards of the target's edge at 0.04 m
    middles = [float((picture[row] * plane.x_m).sum() / picture[row].sum()) for picture in (first, last)]
    np.testing.assert_allclose(middles, [-0.08, 0.08], atol=1e-4)
    assert first[int(np.argmin(np.abs(plane.y_m + 0.05)))].sum() == 0


def test_a_torch_lights_the_place_before_it_most_and_falls_off_as_cosines_over_the_square():
    torch = Torch(place_m=(0.03, -0.02, 0.1), radius_m=0.0)
    x, y = np.array([0.03, 0.0, 0.13]), np.array([-0.02, 0.0, -0.02])
    light = torch.emission(x, y, 0.3)
    fall = 0.2**2 / (0.2**2 + np.array([0.0, 0.0013, 0.01]))
    np.testing.assert_allclose(light / light[0], fall**2, rtol=1e-12)
    assert light[1] == pytest.approx(1.0)


def test_a_holder_shades_the_target_with_a_penumbra_of_the_torchs_size():
    x = np.linspace(-0.1, 0.1, 2001)
    holder = (0.0, 0.0, 0.2, 0.02)
    sharp = Torch((0.0, 0.0, 0.1), radius_m=0.0, holder_m=holder).emission(x, 0 * x, 0.3)
    away = np.abs(np.abs(x) - 0.04) > 1e-9  # halfway: the shadow is twice as wide as the holder
    assert np.array_equal(sharp[away] == 0, np.abs(x[away]) < 0.04)
    soft = Torch((0.0, 0.0, 0.1), radius_m=0.01, holder_m=holder).emission(x, 0 * x, 0.3)
    lit = Torch((0.0, 0.0, 0.1), radius_m=0.01).emission(x, 0 * x, 0.3)
    share = soft / lit
    assert np.all(share[np.abs(x) < 0.029] == 0) and np.all(share[np.abs(x) > 0.051] > 0.999)
    assert np.any((share > 0.2) & (share < 0.8))


def rendered(ripple: float = 0.0, hz: float = 100.0) -> RenderedWall:
    times = np.linspace(0, 1, 11)
    frames = (1 + 0.3 * np.random.default_rng(0).random((11, 2, 3))).astype(np.float32)
    return RenderedWall(times, frames, 5.0, ripple, hz)


def test_light_is_linear_between_key_frames_and_rests_outside():
    wall = rendered()
    key = wall.irradiance([0.3, 0.4]).numpy()
    np.testing.assert_allclose(wall.irradiance(0.325).numpy(), 0.75 * key[0] + 0.25 * key[1], rtol=1e-6)
    np.testing.assert_array_equal(wall.irradiance(-1.0), wall.irradiance(0.0))
    np.testing.assert_array_equal(wall.irradiance(2.0), wall.irradiance(1.0))
    assert wall.irradiance(0.1).shape == wall.shape == (2, 3)


def test_an_exposure_averages_light_and_ripple():
    wall, middles = rendered(0.2, 37.0), np.array([0.31, 0.55])
    fine = middles[:, None] + (np.arange(20000) + 0.5) / 20000 * 0.06 - 0.03
    slow = np.stack([wall.irradiance(times).numpy().mean(axis=0) for times in fine])
    # light and ripple are averaged apart: exact but for the light's slope within a period
    np.testing.assert_allclose(wall.exposed(middles, 0.06), slow, rtol=0.003)
    whole = rendered(0.2, 100.0).exposed(middles, 0.02)
    np.testing.assert_allclose(whole, rendered(0.0).exposed(middles, 0.02), rtol=1e-6)
    moment = rendered(0.2, 37.0)
    np.testing.assert_allclose(moment.exposed(middles, 1e-9), moment.irradiance(middles), rtol=1e-5)


def test_a_frame_camera_takes_the_walls_own_average():
    wall = rendered(0.2, 50.0)
    quiet = FrameCamera(
        exposure_s=0.032, full_well_e=1e9, read_noise_e=0.0, prnu=0.0, dsnu_e=0.0, gain=0.5, bit_depth=16
    )
    times = np.array([0.305, 0.5])
    frames = quiet.capture(wall, times) / (0.5 * 65535)
    np.testing.assert_allclose(frames, wall.exposed(times, 0.032), atol=1e-3)
    three = wall.irradiance(quiet.instants(0.305)[0]).numpy()
    assert np.abs(np.einsum("q,qhw->hw", quiet.instants(0.305)[1], three) - frames[0]).max() > 0.01


def test_wrong_mounts_are_refused():
    with pytest.raises(ConfigError, match="brightness is -1"):
        Mount(-1.0)
    with pytest.raises(ConfigError, match="give lengths"):
        Mount(1.0, rim_m=-0.1)
