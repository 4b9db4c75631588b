"""Walls in continuous time: the fast paths against slow, obvious ones."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.optics import (
    DepthTransport,
    Diffraction,
    DiffuseReflection,
    MatrixTransport,
    MatrixWall,
    SlidingWall,
    View,
    coarsest_keyframe_step_m,
    tpsf_kernel,
)
from evnlos.optics.interpolation import (
    spline_coefficients,
    spline_sample,
    spline_scattered,
    spline_slopes,
    spline_weights,
)
from evnlos.optics.wall import ambient_plane
from evnlos.scene import LineMotion, PathMotion, Scene, SeveralTargets, Target
from evnlos.setups import PaperSetup, RadiometricSetup
from evnlos.types import Irradiance, Plane

SHAPE = (40, 64)
PLANE = Plane(80, 90, 0.001, (0.002, -0.003))
DIAGONAL = LineMotion((-0.03, 0.01), 0.02, (1.0, -0.3))


def spot(plane: Plane, x0: float, y0: float, sigma: float = 0.006) -> torch.Tensor:
    x, y = torch.as_tensor(plane.x_m), torch.as_tensor(plane.y_m)[:, None]
    return torch.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))


def letter(seed: int = 0, side: int = 32) -> Target:
    """Blocky random strokes."""
    mask = np.random.default_rng(seed).integers(0, 2, (8, 8)).astype(np.float32)
    return Target("noise", np.kron(mask, np.ones((side // 8, side // 8), np.float32)), 0.08)


def pixel_mean_of_spot(view: View, position: np.ndarray, sigma: float) -> torch.Tensor:
    """Mean of a Gaussian spot over each pixel by fine sampling: the truth of a sliding wall."""
    total = torch.zeros(view.shape, dtype=torch.float64)
    offsets = (np.arange(8) + 0.5) / 8 - 0.5
    for dv in offsets:
        for du in offsets:
            points = view.wall_points_m(du, dv)
            d2 = (points[..., 0] - position[0]) ** 2 + (points[..., 1] - position[1]) ** 2
            total += torch.exp(-d2 / (2 * sigma**2))
    return total / 64


@pytest.mark.parametrize(
    "view",
    [
        View.affine(SHAPE, 400.0),
        View.affine(SHAPE, 400.0, 0.05, offset_px=(3.3, -2.2)),
        View.perspective(SHAPE, 0.4, math.radians(20), math.radians(20)),
    ],
    ids=["axis-aligned", "turned", "oblique"],
)
@pytest.mark.parametrize("motion", [LineMotion((-0.03, 0.004), 0.02), DIAGONAL], ids=["along x", "diagonal"])
def test_sliding_wall_follows_a_spot(view, motion):
    sigma = 0.006
    wall = SlidingWall(spot(PLANE, 0.0, 0.0, sigma).float(), PLANE, view, motion, gain=0.7, ambient=0.1)
    times = np.array([0.0, 0.731, 1.5])
    for image, time in zip(wall.irradiance(times), times, strict=True):
        truth = 0.1 + 0.7 * pixel_mean_of_spot(view, motion.position_m(time), sigma)
        assert float((image - truth).abs().max()) < 2e-3 * 0.7


def test_shift_by_whole_pixels_is_exact():
    view = View.affine(SHAPE, 500.0)
    wall = SlidingWall(spot(PLANE, 0.0, 0.0).float(), PLANE, view, LineMotion((0.0, 0.0), 0.02))
    first, later = wall.irradiance([0.0, 0.5])  # 0.5 s at 0.02 m/s and 500 px/m: 5 px
    torch.testing.assert_close(later[:, 10:], first[:, 5:-5], rtol=0, atol=2e-6)


@pytest.mark.parametrize("view", [View.affine(SHAPE, 400.0, 0.1), View.perspective(SHAPE, 0.4, 0.3, 0.35)])
def test_signal_is_smooth_in_time(view):
    """The second derivative in time has no jumps: its steps shrink with the time step."""
    wall = SlidingWall(spot(PLANE, 0, 0, 0.004).double(), PLANE, view, DIAGONAL)
    jumps = []
    for step in (8e-3, 4e-3):
        light = wall.irradiance(0.9 + step * np.arange(60)).double()[:, 18:22, 20:40]
        second = light.diff(n=2, dim=0) / step**2
        jumps.append(float(second.diff(dim=0).abs().max() / second.abs().max()))
    assert jumps[1] < 0.75 * jumps[0]
    assert jumps[0] < 0.3


@pytest.mark.parametrize(
    "position", [(0.0, 0.0), (0.0131, -0.0077), (0.09, 0.0), (-0.1, 0.02), (3.0, 0.0), (-3.0, 1.0)]
)
@pytest.mark.parametrize("scale", [150.0, 400.0, 2000.0])
def test_compiled_shift_equals_the_reference(position, scale):
    wall = SlidingWall(
        spot(PLANE, 0, 0).float(), PLANE, View.affine(SHAPE, scale, 0.1), DIAGONAL, gain=0.7, ambient=0.1
    )
    fast = torch.empty((1, *SHAPE))
    wall._write(np.array([position]), fast)
    slow = 0.1 + 0.7 * wall._shifted(*position).clamp(min=0)
    torch.testing.assert_close(fast[0], slow, rtol=0, atol=3e-7)


def test_any_pixels_of_the_light_are_those_of_the_images():
    """Strips start and end in the middle of rows, at places where taps lie inside and outside of the band."""
    view = View.affine(SHAPE, 700.0)
    level = LineMotion((-0.1, 0.01), 0.05)
    wall = SlidingWall(spot(PLANE, 0, 0).float(), PLANE, view, level, gain=0.7, ambient=0.1)
    times_s = np.linspace(0, 4, 7)
    images = wall.irradiance(times_s).flatten(1).numpy()
    for k, time_s in enumerate(times_s):
        assert np.array_equal(wall.irradiance(time_s).numpy().ravel(), images[k])
    strips = wall.strips(times_s)
    assert strips is not None
    assert len(strips) == 7
    draw = np.random.default_rng(0)
    for _ in range(30):
        first, last = np.sort(draw.choice(images.shape[1] + 1, 2, replace=False))
        out = np.empty((7, last - first), np.float32)
        strips.write(first, out)
        assert np.array_equal(out, images[:, first:last])
        strips[2:5].write(first, out[:3], 255.0)
        assert np.array_equal(out[:3], np.float32(255) * images[2:5, first:last])


def test_walls_that_have_no_strips():
    image, affine = spot(PLANE, 0, 0).float(), View.affine(SHAPE, 400.0, 0.1)
    assert SlidingWall(image, PLANE, affine, DIAGONAL).strips([0.0, 1.0]) is None
    assert SlidingWall(image, PLANE, affine, DIAGONAL).strips([1.0]) is not None
    view = View.perspective(SHAPE, 0.4, 0.3, 0.35)
    assert SlidingWall(image, PLANE, view, DIAGONAL).strips([1.0]) is None
    assert SlidingWall(image.requires_grad_(), PLANE, affine, DIAGONAL).strips([1.0]) is None


def test_wall_carries_a_gradient():
    image = spot(PLANE, 0, 0).requires_grad_()
    SlidingWall(image, PLANE, View.affine(SHAPE, 400.0), DIAGONAL).irradiance([0.5, 1.0]).sum().backward()
    assert image.grad is not None
    assert float(image.grad.abs().sum()) > 0


def test_scalar_and_array_times_agree():
    wall = SlidingWall(spot(PLANE, 0, 0).float(), PLANE, View.affine(SHAPE, 400.0), DIAGONAL, ambient=0.05)
    assert isinstance(wall, Irradiance)
    assert wall.irradiance(1.0).shape == SHAPE
    assert wall.irradiance([]).shape == (0, *SHAPE)
    one, many = wall.irradiance(1.0), wall.irradiance([0.2, 1.0])
    assert one.dtype == many.dtype == torch.float32
    assert torch.equal(one, many[1])
    with pytest.raises(DataError, match="1-D"):
        wall.irradiance([[0.0]])


def test_far_away_only_ambient_light_is_left():
    wall = SlidingWall(spot(PLANE, 0, 0).float(), PLANE, View.affine(SHAPE, 400.0), LineMotion(), ambient=0.05)
    assert torch.equal(wall.irradiance(1e4), torch.full(SHAPE, 0.05))
    assert torch.equal(wall.irradiance(-1e4), torch.full(SHAPE, 0.05))


def test_light_never_falls_below_the_ambient():
    """Interpolation of a sharp edge would ring below zero."""
    hard = (spot(PLANE, 0, 0) > 0.5).float()
    wall = SlidingWall(hard, PLANE, View.affine(SHAPE, 900.0), LineMotion((0.0, 0.0)), ambient=0.05)
    assert float(wall.irradiance([0.0, 0.123]).min()) >= 0.05


def test_speed_bounds_the_image_motion():
    for view in (View.affine(SHAPE, 400.0, 0.3), View.perspective(SHAPE, 0.4, 0.5, 0.3)):
        wall = SlidingWall(
            spot(PLANE, 0, 0).float(), PLANE, view, PathMotion((0.0, 1.0), ((0.0, 0.0), (0.01, 0.02)))
        )
        track = view.pixels(torch.as_tensor(wall.motion.position_m(np.linspace(0, 1, 500))))
        assert float(track.diff(dim=0).norm(dim=-1).max()) * 499 <= wall.speed_px_s * 1.001


def test_paper_wall_equals_the_plain_chain_of_steps():
    """Every frame rendered on its own, the slow way: draw, diffract, convolve, sample."""
    config = PaperSetup(
        pitch_m=0.001, tpsf_length_m=0.008, gain=0.9, ambient=0.02, ambient_gradient=(0.2, -0.1)
    )
    scene = Scene(letter(), LineMotion((-0.02, 0.005), 0.02))
    wall = config.resized((60, 96)).observe(scene)
    view = config.view((60, 96))
    transport = config.transport(0.08)
    source = transport.source
    for time in (0.0, 1.234):
        x, y = scene.motion.position_m(time)
        wide = Plane(source.height + 60, source.width + 80, source.pitch_m)
        drawn = torch.from_numpy(scene.target.rasterise(wide, (x, y))).double()
        step_a = Diffraction(wide, config.wavelength_m, config.distance_m, None, config.field, config.result)(
            drawn
        )
        step_b = DiffuseReflection(wide, tpsf_kernel(0.001, 0.008))
        pixel = torch.zeros(60, 96, dtype=torch.float64)
        for dv in (-0.375, -0.125, 0.125, 0.375):
            for du in (-0.375, -0.125, 0.125, 0.375):
                points = view.wall_points_m(du, dv)
                rows = (points[..., 1]) / 0.001 + (step_b.shape[0] - 1) / 2
                columns = (points[..., 0]) / 0.001 + (step_b.shape[1] - 1) / 2
                pixel += spline_sample(spline_coefficients(step_b(step_a)), rows, columns) / 16
        truth = ambient_plane(0.02, (0.2, -0.1), (60, 96)) + 0.9 * pixel
        error = (wall.irradiance(time) - truth).abs().max() / (truth.max() - truth.min())
        assert float(error) < 4e-3


def test_paper_defaults():
    config = PaperSetup()
    figures = config.optical_values(0.08)
    assert figures["fresnel_number"] == pytest.approx(6400)
    wall = config.resized((50, 80)).observe(Scene(letter()))
    light = wall.irradiance(np.linspace(0, 8, 5))
    assert light.shape == (5, 50, 80)
    assert float(light.min()) >= 0.05
    assert float(light.max()) < 1.05
    # The centre of light moves to the right at the speed of the target.
    x = torch.arange(80.0)
    centre = ((light - 0.05) * x).sum((1, 2)) / (light - 0.05).sum((1, 2))
    speed = float(centre[3] - centre[1]) / 4
    assert speed == pytest.approx(wall.speed_px_s, rel=0.01)


def test_offset_is_the_middle_of_the_image():
    for angle in (0.0, 25.0):
        view = PaperSetup(offset_m=(0.03, -0.01), rotation_deg=20.0, camera_angle_deg=angle).view((41, 61))
        assert view.wall_points_m()[20, 30].tolist() == pytest.approx([0.03, -0.01], abs=1e-12)


def strip_wall(motion, **options) -> MatrixWall:
    """A smooth shift-variant transport on a strip: a Gaussian that widens to the right."""
    strip, pixels = Plane(16, 48, 0.005), Plane(9, 30, 0.008)
    x, y = torch.as_tensor(pixels.x_m), torch.as_tensor(pixels.y_m)
    columns = []
    for row in strip.y_m:
        for column in strip.x_m:
            width = 0.02 + 0.05 * (column + 0.12)
            columns.append(torch.exp(-((x - column) ** 2 + (y[:, None] - row) ** 2) / (2 * width**2)).flatten())
    transport = MatrixTransport(torch.stack(columns, dim=1), strip, pixels.shape)
    return MatrixWall(transport, letter(), motion, magnification_px_m=125.0, **options)


def test_keyframes_agree_with_the_direct_product():
    times = np.random.default_rng(0).uniform(0, 8, 30)
    keyed, direct = strip_wall(LineMotion()), strip_wall(LineMotion(), keyframe_step_m=0.0)
    error = (keyed.irradiance(times) - direct.irradiance(times)).abs().max() / direct.irradiance(times).max()
    assert 0 < float(error) < 3e-3  # two different ways
    finer = strip_wall(LineMotion(), keyframe_step_m=0.0005).irradiance(times)
    assert float((finer - direct.irradiance(times)).abs().max()) < 0.4 * float(
        error * direct.irradiance(times).max()
    )


def test_keyframes_of_a_travel_are_those_of_the_strip_and_other_places_are_multiplied(monkeypatch):
    multiplied = []
    light = MatrixWall.light
    monkeypatch.setattr(MatrixWall, "light", lambda wall, at: multiplied.append(len(at)) or light(wall, at))
    times = np.random.default_rng(1).uniform(2.0, 4.0, 20)  # x from -4 to 0 cm
    part = strip_wall(LineMotion(), travel_m=(-0.04, 0.0))
    whole, direct = strip_wall(LineMotion()), strip_wall(LineMotion(), keyframe_step_m=0.0)
    by_part, by_whole = part.irradiance(times), whole.irradiance(times)
    assert float((by_part - by_whole).abs().max()) < 1e-4 * float(by_whole.max())
    of_part, of_whole = multiplied  # keyframes, once each
    assert of_part < of_whole
    torch.testing.assert_close(part.irradiance([7.0]), direct.irradiance([7.0]))


def test_keyframes_are_as_far_apart_as_the_blur_allows():
    strip, cell = Plane(32, 96, 0.0025), 0.0025
    blur = [np.exp(-((np.subtract.outer(x, x) / 0.03) ** 2)) for x in (strip.y_m, strip.x_m)]
    smooth = MatrixTransport(torch.from_numpy(np.kron(*blur)).float(), strip, strip.shape)
    assert coarsest_keyframe_step_m(smooth, 0.08) == 2 * cell
    # A wall that shows each cell for itself has no blur to lean on.
    sharp = MatrixTransport(torch.eye(smooth.matrix.shape[1]), strip, strip.shape)
    assert coarsest_keyframe_step_m(sharp, 0.08) == cell / 2


def test_matrix_wall_equals_the_matrix_times_the_drawing():
    wall = strip_wall(DIAGONAL, gain=0.5, ambient=0.03)
    drawn = wall.target.rasterise(wall.transport.source, DIAGONAL.position_m(0.77))
    expected = 0.03 + 0.5 * wall.transport(torch.as_tensor(drawn).double())
    torch.testing.assert_close(wall.irradiance(0.77), expected.float())
    assert isinstance(wall, Irradiance)
    assert wall.speed_px_s == pytest.approx(2.5)


WINDING = PathMotion(
    (0.0, 1.0, 2.0, 3.0),
    ((-0.04, 0.0), (-0.01, 0.02), (0.02, -0.02), (0.05, 0.0)),
    (0.28, 0.33, 0.31, 0.36),
    (0.0, 40.0, 90.0, 20.0),
)
SMALL = RadiometricSetup(roughness=0.08, cell_m=0.008, gain=0.7, ambient=0.05).resized((10, 16))


def test_light_of_any_distance_is_off_by_less_than_is_stated():
    """Interpolated over distances in a basis of images, against matrices made at distances that no node has."""
    cells = Plane(8, 16, 0.01)
    exact = lambda z_m: SMALL.at_distance(z_m).matrix((10, 16), cells)  # noqa: E731
    found = DepthTransport(exact, 0.25, 0.4, cells, (10, 16))
    assert found.error < 1e-3 and found.basis.shape[1] < 128
    away = np.random.default_rng(0).uniform(0.25, 0.4, 8)
    errors = [float((found.at(z_m).matrix - exact(z_m)).norm() / exact(z_m).norm()) for z_m in away]
    assert max(errors) < 2 * found.error
    assert max(errors) > 0.05 * found.error  # what is stated is not a guess from above
    a, b = (found.coefficients(0.3 * math.exp(way)) for way in (5e-4, -5e-4))
    torch.testing.assert_close(found.slope(0.3), (a - b) / 1e-3, rtol=2e-2, atol=2e-2 * float(a.abs().max()))
    with pytest.raises(DataError, match="not between"):
        found.coefficients(0.5)
    with pytest.raises(ConfigError, match="rougher wall"):
        DepthTransport(
            lambda z: torch.sin(torch.arange(128.0) * 99 * z).expand(160, -1), 0.2, 0.4, cells, (10, 16)
        )


def test_a_target_that_turns_and_retreats_is_seen_as_by_exact_matrices():
    scene = Scene(letter(), WINDING, 3.0)
    wall = SMALL.observe(scene)
    assert isinstance(wall, Irradiance)
    cells = wall.transport.source
    own = SMALL.operator(SMALL.source()).dense().sum() / SMALL.matrix(SMALL.shape, SMALL.source()).sum()
    for time in np.random.default_rng(3).uniform(0, 3, 5):
        pose = scene.pose(time)
        drawn = scene.target.rasterise(cells, (pose.x_m, pose.y_m), float(pose.rotation_rad))
        light = (
            own
            * SMALL.at_distance(float(pose.z_m)).matrix(SMALL.shape, cells)
            @ torch.from_numpy(drawn).double().flatten()
        )
        off = wall.irradiance(time) - (SMALL.ambient_light() + light.unflatten(0, SMALL.shape))
        assert float(off.norm() / light.norm()) < 1e-3
    some = np.array([0.3, 2.9])
    torch.testing.assert_close(wall.irradiance(some)[1], wall.irradiance(2.9))
    assert wall.irradiance([]).shape == (0, *SMALL.shape)


def test_nothing_in_a_turning_image_outruns_its_bound():
    """A spinning, resting target: the motion's own speed is nought, its corners' is not."""
    scene = Scene(letter(), LineMotion(speed_m_s=0.0, start_m=(0.0, 0.0), spin_deg_s=45.0), 2.0)
    wall = SMALL.observe(scene)
    corner = math.radians(45) * 0.08 / math.sqrt(2) * SMALL.view(SMALL.shape).magnification()
    assert wall.speed_px_s == pytest.approx(corner, rel=0.03)
    still = SMALL.observe(Scene(letter(), LineMotion(speed_m_s=0.0, start_m=(0.0, 0.0)), 2.0))
    light = wall.irradiance(0.0)
    assert float((light - still.irradiance(0.0)).norm() / light.norm()) < 2e-3
    assert float((light - wall.irradiance(1.0)).norm() / light.norm()) > 2e-2


def test_matrix_wall_is_dark_when_the_target_has_left():
    wall = strip_wall(LineMotion(), ambient=0.03)
    gone = wall.irradiance([-100.0, 100.0])
    assert float((gone - 0.03).abs().max()) < 1e-4


def test_matrix_wall_scalar_and_array_times_agree():
    wall = strip_wall(LineMotion())
    torch.testing.assert_close(wall.irradiance(1.0), wall.irradiance([0.2, 1.0])[1])
    assert wall.irradiance([]).shape == (0, 9, 30)


def test_radiometric_wall():
    config = RadiometricSetup(roughness=0.3, cell_m=0.01, gain=0.6, ambient=0.1)
    lit = Scene(Target("target", np.ones((8, 8)), 0.08))
    wall = config.resized((20, 32)).observe(lit)
    assert wall.transport is config.resized((20, 32)).observe(lit).transport  # one matrix for all targets
    middle = wall.irradiance(4.0)
    assert float(middle.max()) == pytest.approx(0.7, abs=1e-3)
    x = torch.arange(32.0)
    light = wall.irradiance([1.0, 7.0]) - 0.1
    centre = (light * x).sum((1, 2)) / light.sum((1, 2))
    assert float(centre[1] - centre[0]) > 3
    with pytest.raises(ConfigError, match="strip_m"):
        config.resized((20, 32)).observe(Scene(lit.target, LineMotion((0.0, 0.0))))


def test_spline_interpolates_and_its_weights_add_up():
    samples = torch.randn(2, 9, 14, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    coefficients = spline_coefficients(samples)
    row, column = torch.meshgrid(torch.arange(2.0, 7), torch.arange(2.0, 12), indexing="ij")
    torch.testing.assert_close(
        spline_sample(coefficients[1], row.double(), column.double()), samples[1, 2:7, 2:12]
    )
    fraction = torch.linspace(0, 1, 7, dtype=torch.float64)
    torch.testing.assert_close(spline_weights(fraction).sum(0), torch.ones(7, dtype=torch.float64))
    (slopes,) = torch.func.jvp(spline_weights, (fraction,), (torch.ones_like(fraction),))[1:]
    torch.testing.assert_close(spline_slopes(fraction), slopes)


@pytest.mark.parametrize(
    ("error", "match", "options"),
    [
        (ConfigError, "gain", {"gain": -1.0}),
        (ConfigError, "ambient light", {"ambient": -0.1}),
        (ConfigError, "ambient light", {"ambient": float("nan")}),
        (DataError, "ambient light", {"ambient": np.zeros((3, 3))}),
    ],
)
def test_bad_input(error, match, options):
    with pytest.raises(error, match=match):
        SlidingWall(spot(PLANE, 0, 0), PLANE, View.affine(SHAPE, 400.0), LineMotion(), **options)
    with pytest.raises(error, match=match):
        strip_wall(LineMotion(), **options)


def test_images_of_the_wrong_size_are_refused():
    with pytest.raises(DataError, match="samples"):
        SlidingWall(torch.zeros(3, 3), PLANE, View.affine(SHAPE, 400.0), LineMotion())
    with pytest.raises(ConfigError, match="8192"):
        SlidingWall(torch.zeros(PLANE.shape), PLANE, View.affine(SHAPE, 1e6), LineMotion())


def test_a_grid_of_points_is_sampled_as_points_in_any_order_are() -> None:
    draw = torch.Generator().manual_seed(4)
    coefficients = torch.rand(13, 17, generator=draw, dtype=torch.float64)
    row = (torch.rand(9, 1, generator=draw, dtype=torch.float64) * 20 - 4).expand(9, 11)
    column = (torch.rand(1, 11, generator=draw, dtype=torch.float64) * 24 - 4).expand(9, 11)
    expected = spline_scattered(coefficients, row, column)
    assert (expected == 0).any() and (expected > 0.1).any()  # points outside, points inside
    torch.testing.assert_close(spline_sample(coefficients, row, column), expected, rtol=1e-12, atol=1e-12)
    tilted = row + 0.01 * torch.arange(11)
    torch.testing.assert_close(
        spline_sample(coefficients, tilted, column),
        spline_scattered(coefficients, tilted, column),
        rtol=0,
        atol=0,
    )


@pytest.mark.parametrize("cover", [False, True])
def test_the_light_of_several_targets_is_the_matrix_times_their_drawing(cover) -> None:
    setup = RadiometricSetup(cell_m=0.01, strip_m=(0.24, 0.16), ambient=0.05).resized((10, 16))
    times = np.linspace(0, 8, 5)
    targets = [Target(name, np.random.default_rng(k).random((6, 6)), 0.08) for k, name in enumerate("ab")]
    motions = LineMotion((-0.08, 0.0)), LineMotion((0.07, 0.02), 0.018, (-1.0, -0.2))
    scene = SeveralTargets(tuple(Scene(a, m) for a, m in zip(targets, motions, strict=True)), cover)
    wall = setup.observe_all(scene)
    first, second = (
        a.rasterise(setup.source(), m.position_m(times)) for a, m in zip(targets, motions, strict=True)
    )
    drawn = first * (1 - second) + second if cover else first + second
    exact = setup.operator(setup.source())(torch.from_numpy(drawn).double()) + setup.ambient_light()
    torch.testing.assert_close(wall.irradiance(times).double(), exact, rtol=0, atol=3e-4)
    assert float((first * second).max()) > 0.1  # they do meet
    assert wall.speed_px_s == max(setup.observe(one).speed_px_s for one in scene.scenes)
    alone = scene.scenes[0]
    assert torch.equal(setup.observe_all(alone).irradiance(times), setup.observe(alone).irradiance(times))


def test_whoever_takes_one_target_refuses_several() -> None:
    one = Scene(Target("a", np.ones((4, 4)), 0.08))
    with pytest.raises(DataError, match="holds 2 targets, and this takes one"):
        RadiometricSetup().observe(SeveralTargets((one, one)))
    with pytest.raises(DataError, match=r"2 scenes last from 0 to 4 s, 0 to 8 s"):
        SeveralTargets((one, replace(one, duration_s=4.0)))
    with pytest.raises(DataError, match="leave z_m and turns out, or let the light add"):
        SeveralTargets((one, replace(one, motion=LineMotion(z_m=0.3))), cover=True)
    with pytest.raises(ConfigError, match="draws no targets on cells, so none covers another"):
        PaperSetup().resized((5, 8)).observe_all(SeveralTargets((one, one), cover=True))
