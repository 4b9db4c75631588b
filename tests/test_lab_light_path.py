"""The laboratory's own light path: energy, reciprocity, geometry, and the matrix against a slow sum."""

import dataclasses
import math

import numpy as np
import pytest

from evnlos.errors import ConfigError
from evnlos.lab import LitCells, Lobe, Optics, Reflection, cast, fill_throughput, texture
from evnlos.optics.radiometric import torchs_threads

SHAPES = ("ggx", "beckmann", "streak", "ring")
OPTICS = Optics(
    shape=(4, 6),
    distance_m=0.6,
    azimuth=0.5,
    elevation=0.1,
    roll=0.05,
    fov=0.5,
    radial=(-0.05, 0.02),
    aperture_m=0.012,
    focus_m=0.5,
    falloff=0.2,
    curvature=(0.9, 0.5),
    samples=5,
)


def test_pixels_of_another_height_see_their_part():
    plain = dataclasses.replace(OPTICS, aperture_m=0.0, samples=1)
    tall = cast(dataclasses.replace(plain, shape=(2, 6), pixel_aspect=2.0)).point.reshape(2, 6, 3)
    square = cast(plain).point.reshape(2, 2, 6, 3)
    np.testing.assert_allclose(tall, square.mean(axis=1), atol=1e-3)


def directions(draw: np.random.Generator, count: int, steepest: float = 1.2) -> np.ndarray:
    """Return unit vectors [count, 3] before the wall, at up to `steepest` radians from its normal."""
    polar, turn = steepest * np.sqrt(draw.random(count)), draw.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=1)


def mixture() -> Reflection:
    lobes = (
        Lobe("ggx", 2.0, 0.2, 0.3, turn_deg=25.0),
        Lobe("beckmann", 1.0, 0.3, 0.15, shift=(0.05, -0.1)),
        Lobe("streak", 0.5, 0.2, 0.1, turn_deg=-60.0),
        Lobe("ring", 0.5, 0.25, 0.2),
    )
    return Reflection(lobes, normal_reflectance=0.9, matte=0.1)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_density_of_slopes_integrates_to_one(shape):
    wall = Reflection((Lobe(shape, 3.0, 0.08, 0.03, turn_deg=30.0, shift=(0.02, -0.01)),), matte=0.0)
    # In scaled polar coordinates the GGX tail, 1 / (1 + R^2) beyond radius R, is seen too.
    radius = np.concatenate([np.linspace(0, 8, 700), np.geomspace(8.02, 300, 300)])
    angle = np.linspace(0, 2 * np.pi, 121)[:-1]
    u, v = 0.08 * radius[:, None] * np.cos(angle), 0.03 * radius[:, None] * np.sin(angle)
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    density = (
        wall.slopes(c * u - s * v + 0.02, s * u + c * v - 0.01).mean(axis=1) * 2 * np.pi * radius * 0.08 * 0.03
    )
    assert np.trapezoid(density, radius) == pytest.approx(1.0, abs=2e-3)


def test_the_lobes_share_the_light_by_their_weights():
    one, other = Lobe("ggx", 1.0, 0.1, 0.1), Lobe("streak", 3.0, 0.05, 0.2)
    u, v = np.random.default_rng(0).normal(0, 0.1, (2, 50))
    both = Reflection((one, other)).slopes(u, v)
    apart = 0.25 * Reflection((one,)).slopes(u, v) + 0.75 * Reflection((other,)).slopes(u, v)
    np.testing.assert_allclose(both, apart, rtol=1e-12)


def test_reflection_is_reciprocal():
    draw = np.random.default_rng(1)
    one, other = directions(draw, 500), directions(draw, 500)
    forth, back = mixture().brdf(one, other), mixture().brdf(other, one)
    np.testing.assert_allclose(forth, back, rtol=1e-10)
    assert forth.min() > 0


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("polar", [0.0, 0.7, 1.2])
def test_no_wall_reflects_more_light_than_it_gets(shape, polar):
    wall = Reflection((Lobe(shape, 1.0, 0.3, 0.3),), normal_reflectance=1.0, matte=0.0)
    light = np.array([math.sin(polar), 0.0, math.cos(polar)])
    cosine, turn = np.meshgrid(
        (np.arange(60) + 0.5) / 60, 2 * np.pi * (np.arange(90) + 0.5) / 90, indexing="ij"
    )
    sine = np.sqrt(1 - cosine**2)
    eyes = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
    share = (wall.brdf(light, eyes) * cosine).mean() * 2 * np.pi
    assert 0.2 < share < 1.01


def test_a_mirror_of_small_facets_sends_the_light_where_a_mirror_does():
    light = np.array([0.3, -0.2, math.sqrt(1 - 0.13)])
    mirrored = np.array([-0.3, 0.2, light[2]])
    away = directions(np.random.default_rng(2), 400)
    for shape in ("ggx", "beckmann", "streak"):
        wall = Reflection((Lobe(shape, 1.0, 0.05, 0.05),), matte=0.0)
        assert wall.brdf(light, mirrored) > 0.99 * wall.brdf(light, away).max()


def test_rays_meet_the_curved_wall_and_its_normal():
    rays = cast(OPTICS)
    x, y, z = np.moveaxis(rays.point, -1, 0)
    np.testing.assert_allclose(z, -(0.9 * x**2 + 0.5 * y**2) / 2, atol=1e-14)
    step = 1e-6
    for axis, (dx, dy) in enumerate([(step, 0.0), (0.0, step)]):
        rise = (-(0.9 * (x + dx) ** 2 + 0.5 * (y + dy) ** 2) / 2 - z) / step
        tangent = np.stack([np.full_like(x, dx / step), np.full_like(x, dy / step), rise], axis=-1)
        assert np.abs(np.einsum("psi,psi->ps", tangent, rays.frame[:, :, 2])).max() < 1e-5
        assert np.einsum("psi,psi->ps", tangent, rays.frame[:, :, axis]).min() > 0.9
    unit = np.einsum("psij,pskj->psik", rays.frame, rays.frame)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(rays.eye, axis=-1), 1.0, rtol=1e-12)


def test_a_plain_camera_sees_what_its_angles_say():
    plain = dataclasses.replace(
        OPTICS, shape=(1, 1), elevation=0.0, roll=0.0, radial=(0.0, 0.0), aperture_m=0.0, curvature=(0.0, 0.0)
    )
    rays = cast(dataclasses.replace(plain, samples=1))
    np.testing.assert_allclose(rays.point[0, 0], 0.0, atol=1e-14)
    np.testing.assert_allclose(rays.eye[0, 0], [math.sin(0.5), 0.0, math.cos(0.5)], rtol=1e-12)
    wide = cast(dataclasses.replace(plain, shape=(1, 2), samples=1)).point[:, 0, 0]
    # a pin-hole at angle a: x = D p / (cos a + p sin a)
    p = np.array([-0.5, 0.5]) * math.tan(0.25)
    np.testing.assert_allclose(wide, 0.6 * p / (math.cos(0.5) + p * math.sin(0.5)), rtol=1e-12)


def test_defocus_spreads_the_rays_of_a_pixel_by_the_circle_of_confusion():
    def spread(focus_m: float) -> float:
        flat = dataclasses.replace(
            OPTICS, shape=(1, 1), azimuth=0.0, elevation=0.0, fov=1e-6, focus_m=focus_m, samples=200
        )
        point = cast(dataclasses.replace(flat, curvature=(0.0, 0.0))).point[0]
        return float(np.sqrt((point[:, :2] ** 2).sum(axis=-1).mean()))

    assert spread(0.6) < 1e-6
    # a disc of diameter A |D - F| / F has a root mean square radius of a quarter of sqrt(2) of it
    assert spread(0.5) == pytest.approx(0.012 * 0.1 / 0.5 / math.sqrt(8), rel=0.02)


def test_vignetting_falls_as_the_fourth_power_of_the_cosine():
    plain = dataclasses.replace(OPTICS, shape=(1, 101), radial=(0.0, 0.0), falloff=0.0, fov=1.2, azimuth=0.0)
    share = cast(dataclasses.replace(plain, aperture_m=0.0, samples=1)).share[:, 0]
    tangent = (np.arange(101) - 50) * 2 * math.tan(0.6) / 101
    np.testing.assert_allclose(share, np.cos(np.arctan(tangent)) ** 4, rtol=1e-12)
    darker = cast(dataclasses.replace(plain, aperture_m=0.0, samples=1, falloff=0.2)).share[:, 0]
    assert darker[50] == pytest.approx(1.0) and darker[0] == pytest.approx(0.8 * share[0], rel=0.02)


def slow_throughput(rays, cells, emission, distance_m, reflection, discs):
    """Return the matrix from the definition, vector by vector."""
    matrix = np.zeros((len(rays.point), len(cells)))
    for p in range(len(rays.point)):
        for c, cell in enumerate(cells):
            lamp = np.array([*cell, distance_m])
            for s in range(rays.point.shape[1]):
                point = rays.point[p, s]
                way = lamp - point
                length = np.linalg.norm(way)
                hidden = False
                for x, y, z, radius in discs:
                    at = point + way * (z - point[2]) / way[2]
                    hidden |= math.hypot(at[0] - x, at[1] - y) < radius
                if hidden:
                    continue
                light = rays.frame[p, s] @ (way / length)
                bright = float(reflection.brdf(light, rays.eye[p, s])) * light[2]
                cos_target = way[2] / length
                matrix[p, c] += rays.share[p, s] * bright * cos_target / length**2 * emission[c]
    return matrix


def test_the_matrix_is_the_sum_over_rays_and_cells():
    draw = np.random.default_rng(3)
    rays = cast(OPTICS)
    cells = np.stack([draw.uniform(-0.3, 0.0, 9), draw.uniform(-0.1, 0.1, 9)], axis=1)
    emission = draw.random(9) * 1e-5
    discs = np.array([[-0.08, 0.0, 0.15, 0.02], [0.0, 0.02, 0.1, 0.01]])
    out = np.full((24, 9), np.nan, np.float32)
    table = mixture().table()
    with torchs_threads():
        fill_throughput(out, rays, LitCells(*cells.T.copy(), emission, 0.3), table, discs)
    slow = slow_throughput(rays, cells, emission, 0.3, mixture(), discs)
    np.testing.assert_allclose(out, slow, rtol=2e-6)
    without = slow_throughput(rays, cells, emission, 0.3, mixture(), discs[:0])
    assert (without > slow).any()  # the discs hide something


def test_texture_has_the_asked_deviation_and_runs_along_the_grain():
    y, x = np.meshgrid(np.linspace(-0.5, 0.5, 500), np.linspace(-0.5, 0.5, 500), indexing="ij")
    both = texture(x, y, 7, 0.05, 0.04, 1.0)
    assert both.mean() == pytest.approx(1.0, abs=0.01)
    assert both.std() == pytest.approx(math.hypot(0.05, 0.04), rel=0.15)
    fine = texture(x, y, 7, 0.0, 0.04, 10.0)
    across, along = np.diff(fine, axis=0).std(), np.diff(fine, axis=1).std()
    assert across > 4 * along
    np.testing.assert_array_equal(both, texture(x, y, 7, 0.05, 0.04, 1.0))
    assert np.abs(both - texture(x, y, 8, 0.05, 0.04, 1.0)).max() > 0.05


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Lobe("disc"), "Lobe.shape is 'disc'"),  # type: ignore[arg-type]
        (lambda: Lobe(width_x=0.0), "Lobe.width_x is 0.0"),
        (lambda: Lobe(weight=-1.0), "Lobe.weight is -1.0"),
        (lambda: Reflection(matte=1.5), "Reflection.matte is 1.5"),
        (lambda: Reflection((), matte=0.0), "black wall"),
        (lambda: Reflection((Lobe(weight=0.0),)), "weigh 0"),
    ],
)
def test_wrong_walls_are_refused(make, words):
    with pytest.raises(ConfigError, match=words.replace("(", r"\(")):
        make()
