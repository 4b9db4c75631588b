"""The radiometric matrix: reflectance, geometry, quadrature, mode counts."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from evnlos.errors import ConfigError
from evnlos.optics import (
    GGX,
    Lambert,
    Occluder,
    Patches,
    View,
    lamp_radiance,
    light_transport_matrix,
)
from evnlos.optics.radiometric import pair_throughput, quadrature_points
from evnlos.optics.reflection import conductor_fresnel
from evnlos.optics.view import visibility
from evnlos.setups import RadiometricSetup, setup_preset
from evnlos.types import Plane

ANGLE = math.radians(30)


def camera(shape=(60, 96)) -> View:
    return View.perspective(shape, 0.6, ANGLE, ANGLE)


def modes(matrix: torch.Tensor) -> int:
    values = torch.linalg.eigvalsh(matrix.mT @ matrix).clamp(min=0).sqrt()
    return int((values > 1e-2 * values.max()).sum())


def setup_matrix(brdf, distance: float, **options) -> torch.Tensor:
    offset = (-distance * math.tan(ANGLE), 0.0)
    return light_transport_matrix(camera(), Plane(32, 32, 0.0025), distance, brdf, offset_m=offset, **options)


def directions(theta: torch.Tensor, phi: torch.Tensor):
    return theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()


@pytest.mark.parametrize(
    ("brdf", "near", "far"),
    [(Lambert(), 3, 3), (GGX(0.3), 6, 3), (GGX(0.1), 12, 7), (GGX(0.05), 28, 14)],
    ids=["lambert", "0.3", "0.1", "0.05"],
)
def test_mode_counts(brdf, near, far):
    for distance, count in ((0.3, near), (0.5, far)):
        assert abs(modes(setup_matrix(brdf, distance)) - count) <= max(1, 0.03 * count)


def test_mode_count_of_the_smoothest_wall():
    """One quadrature point a cell will do for a count within three per cent; 106 of 107 near take two."""
    assert abs(modes(setup_matrix(GGX(0.02), 0.5, points=(2, 1))) - 47) <= 1.5


def test_mode_count_behind_a_post():
    for distance, count in ((0.3, 16), (0.5, 17)):
        post = Occluder.post(-distance * math.tan(ANGLE) / 2, distance / 2, 0.016)
        assert abs(modes(setup_matrix(Lambert(), distance, occluders=(post,))) - count) <= 1


@pytest.mark.parametrize("brdf", [Lambert(0.7), GGX(0.2), GGX(0.3, 0.1)], ids=["lambert", "ggx", "brushed"])
def test_entry_against_adaptive_integration(brdf):
    """One pixel and one cell, with vectors written out and scipy's adaptive quadrature over the cell."""
    view = camera((3, 5))
    source = Plane(2, 3, 0.02, (0.01, -0.02))
    matrix = light_transport_matrix(view, source, 0.3, brdf, offset_m=(-0.1, 0.0), points=(1, 5))
    pixel, cell = (1, 3), (0, 2)
    x, y = view.wall_points_m()[pixel].tolist()
    to_eye = np.array(view.eye_m) - (x, y, 0.0)
    to_eye /= np.linalg.norm(to_eye)

    def integrand(ty: float, tx: float) -> float:
        ray = np.array([tx - x, ty - y, 0.3])
        r = np.linalg.norm(ray)
        light = ray / r
        pair = [tuple(torch.tensor(v, dtype=torch.float64) for v in d) for d in (light, to_eye)]
        return float(brdf(*pair)) * light[2] * light[2] / r**2

    tx, ty = source.x_m[cell[1]] - 0.1, source.y_m[cell[0]]
    expected, _ = dblquad(integrand, tx - 0.01, tx + 0.01, ty - 0.01, ty + 0.01, epsrel=1e-9)
    row, column = pixel[0] * 5 + pixel[1], cell[0] * 3 + cell[1]
    assert float(matrix[row, column]) == pytest.approx(expected, rel=1e-7)


def test_lambert_of_a_wide_plane_approaches_albedo():
    """A wall that faces an endless bright plane returns albedo times its radiance."""
    source = Plane(401, 401, 0.1)
    view = View.perspective((1, 1), 0.1, 0.0, 0.01)
    total = light_transport_matrix(view, source, 0.5, Lambert(0.6), points=(1, 2)).sum()
    # The cosine-weighted share of the hemisphere beyond a square of half-side a at height h is about (h/a)^2.
    assert float(total) == pytest.approx(0.6, abs=0.6 * 1.5 * (0.5 / 20) ** 2)


@pytest.mark.parametrize("brdf", [GGX(0.02), GGX(0.05), GGX(0.1), GGX(0.3), Lambert(), GGX(0.05, 0.2)])
def test_quadrature_has_converged(brdf):
    view = camera((10, 16))
    source = Plane(8, 8, 0.0025)
    offset = (-0.3 * math.tan(ANGLE), 0.0)
    used = quadrature_points(view, source, 0.3, brdf)
    matrix = light_transport_matrix(view, source, 0.3, brdf, offset_m=offset)
    finer = light_transport_matrix(view, source, 0.3, brdf, offset_m=offset, points=(used[0] + 4, used[1] + 3))
    assert float((matrix - finer).abs().max() / finer.max()) < 5e-3


@pytest.mark.parametrize("brdf", [Lambert(), GGX(0.1), GGX(0.3, 0.05)])
def test_brdf_is_reciprocal_and_positive(brdf):
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(2, 500, generator=generator, dtype=torch.float64) * 1.5
    phi = torch.rand(2, 500, generator=generator, dtype=torch.float64) * 2 * math.pi
    light, eye = directions(theta[0], phi[0]), directions(theta[1], phi[1])
    torch.testing.assert_close(brdf(light, eye), brdf(eye, light))
    assert bool((brdf(light, eye) > 0).all())


@pytest.mark.parametrize("alpha", [(0.1, 0.1), (0.3, 0.3), (0.15, 0.4)])
def test_ggx_normals_project_to_one(alpha):
    """Integral of D(h) cos over the hemisphere is 1: D is read off the BRDF itself."""
    theta = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 * math.pi / 2
    phi = (torch.arange(180, dtype=torch.float64) + 0.5) / 180 * math.pi / 2
    h = directions(theta[:, None], phi)
    same = GGX(*alpha)(h, h)  # light = eye = h
    slope = ((alpha[0] * h[0]) ** 2 + (alpha[1] * h[1]) ** 2) / h[2] ** 2
    masking = (2 / (1 + (1 + slope).sqrt())) ** 2
    fresnel = conductor_fresnel(torch.tensor(1.0, dtype=torch.float64), 0.769, 6.08)
    distribution = same * 4 * h[2] ** 2 / (masking * fresnel)
    solid = theta.sin()[:, None] * (math.pi / 2 / 4000) * (math.pi / 2 / 180) * 4
    assert float((distribution * h[2] * solid).sum()) == pytest.approx(1.0, abs=2e-3)


def test_ggx_reflects_no_more_than_it_receives():
    theta = (torch.arange(600, dtype=torch.float64) + 0.5) / 600 * math.pi / 2
    phi = (torch.arange(720, dtype=torch.float64) + 0.5) / 720 * 2 * math.pi
    eye = directions(theta[:, None], phi)
    solid = theta.sin()[:, None] * (math.pi / 2 / 600) * (2 * math.pi / 720)
    for alpha in (0.05, 0.3):
        for angle in (0.0, 0.6, 1.2):
            light = directions(torch.tensor(angle, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64))
            albedo = float((GGX(alpha)(light, eye) * eye[2] * solid).sum())
            assert 0.7 < albedo < 1.0


def test_fresnel_of_aluminium():
    """Normal incidence has a closed form; grazing light is all reflected."""
    n, k = 0.769, 6.08
    normal = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    assert float(conductor_fresnel(torch.tensor(1.0, dtype=torch.float64), n, k)) == pytest.approx(
        normal, abs=1e-12
    )
    assert float(conductor_fresnel(torch.tensor(0.0, dtype=torch.float64), n, k)) == pytest.approx(
        1.0, abs=1e-12
    )
    # Complex-valued Fresnel equations at 1 rad.
    c = math.cos(1.0)
    eta = complex(n, k)
    inner = (eta**2 - math.sin(1.0) ** 2) ** 0.5
    s, p = (c - inner) / (c + inner), (eta**2 * c - inner) / (eta**2 * c + inner)
    expected = (abs(s) ** 2 + abs(p) ** 2) / 2
    assert float(conductor_fresnel(torch.tensor(c, dtype=torch.float64), n, k)) == pytest.approx(
        expected, abs=1e-12
    )


def test_rough_metal_mirrors():
    """The light of a point reaches the camera by way of the mirror point of the wall."""
    view = camera((61, 97))
    source = Plane(1, 1, 0.001)
    matrix = light_transport_matrix(
        view, source, 0.3, GGX(0.01), offset_m=(-0.3 * math.tan(ANGLE) + 0.03, 0.02)
    )
    brightest = divmod(int(matrix[:, 0].argmax()), 97)
    target = torch.tensor([-0.3 * math.tan(ANGLE) + 0.03, 0.02])
    eye = torch.tensor(view.eye_m)
    share = 0.3 / (0.3 + eye[2])
    mirror = target + share * (eye[:2] - target)
    expected = view.pixels(mirror)
    assert abs(float(expected[0]) - brightest[1]) <= 1
    assert abs(float(expected[1]) - brightest[0]) <= 1


TRIANGLE = Occluder(((-0.02, -0.01, 0.05), (0.03, -0.02, 0.1), (0.0, 0.03, 0.12)))
NOTCHED = Occluder(
    ((-0.04, -0.04, 0.1), (0.04, -0.04, 0.1), (0.04, 0.04, 0.1), (0.0, -0.02, 0.1), (-0.04, 0.04, 0.1))
)


@pytest.mark.parametrize("brdf", [Lambert(), GGX(0.1), GGX(0.05, 0.3)], ids=["lambert", "ggx", "brushed"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"occluders": (TRIANGLE, Occluder.post(-0.05, 0.2, 0.01), NOTCHED)},
        {
            "emission_exponent": (2.5, 1.0),
            "emission": torch.rand(6, 7, generator=torch.Generator().manual_seed(0)),
        },
        {"points": (2, 3)},
    ],
    ids=["plain", "occluded", "screen", "few points"],
)
def test_compiled_loop_equals_the_reference(brdf, options):
    arguments = (camera((12, 19)), Plane(6, 7, 0.02), 0.3, brdf)
    fast = light_transport_matrix(*arguments, offset_m=(-0.17, 0.01), compiled=True, **options)
    slow = light_transport_matrix(*arguments, offset_m=(-0.17, 0.01), compiled=False, **options)
    torch.testing.assert_close(fast, slow, rtol=1e-12, atol=1e-13 * float(slow.max()))
    assert bool((slow > 0).any())


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-0.2, 0.2)] * 4))
def test_visibility_equals_crossing_the_polygon(ends):
    """The line itself meets the triangle's plane; barycentric coordinates say where."""
    (wx, wy, tx, ty), distance = ends, 0.3
    a, b, c = (np.array(v) for v in TRIANGLE.vertices_m)
    ray = np.array([tx - wx, ty - wy, distance])
    try:
        u, v, s = np.linalg.solve(np.stack([b - a, c - a, -ray], axis=1), np.array([wx, wy, 0.0]) - a)
    except np.linalg.LinAlgError:
        return
    if min(abs(u), abs(v), abs(1 - u - v)) < 1e-9:
        return  # on the border
    blocked = u > 0 and v > 0 and u + v < 1 and 0 < s < 1
    points = (torch.tensor([value], dtype=torch.float64) for value in (tx, ty))
    seen = visibility(torch.tensor([[wx, wy]], dtype=torch.float64), *points, distance, (TRIANGLE,))
    assert bool(seen) is not blocked


def test_shadow_of_a_post_has_its_width():
    """From one wall point, a post halfway hides a band twice as wide as itself."""
    wall = torch.zeros(1, 2, dtype=torch.float64)
    x = torch.linspace(-0.1, 0.1, 2001, dtype=torch.float64)
    hidden = ~visibility(wall, x, torch.zeros_like(x), 0.3, (Occluder.post(0.01, 0.15, 0.016),))
    assert float(x[hidden[0]].min()) == pytest.approx(0.004, abs=2e-4)
    assert float(x[hidden[0]].max()) == pytest.approx(0.036, abs=2e-4)


@pytest.mark.parametrize("name", ["alpha", "alpha_y", "n", "k", "albedo", "distance", "x", "y", "emission"])
def test_gradient_through_physical_parameters(name):
    start = {
        "alpha": 0.2,
        "alpha_y": 0.3,
        "n": 0.8,
        "k": 6.0,
        "albedo": 0.7,
        "distance": 0.3,
        "x": -0.1,
        "y": 0.02,
    }

    def light(value: torch.Tensor) -> torch.Tensor:
        p = {key: torch.tensor(number, dtype=torch.float64) for key, number in start.items()} | {name: value}
        brdf = Lambert(p["albedo"]) if name == "albedo" else GGX(p["alpha"], p["alpha_y"], p["n"], p["k"])
        emission = torch.linspace(0.5, 1, 6, dtype=torch.float64).reshape(2, 3)
        emission = emission * value if name == "emission" else emission
        return light_transport_matrix(
            camera((3, 5)),
            Plane(2, 3, 0.02),
            p["distance"],
            brdf,
            offset_m=(p["x"], p["y"]),
            occluders=(Occluder.post(0.3, 0.1, 0.01),),
            emission=emission,
            points=(1, 2),
            compiled=False,
        )

    value = torch.tensor(start.get(name, 1.0), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad((light(value) ** 2).sum(), value)
    step = 1e-5
    finite = ((light(value.detach() + step) ** 2).sum() - (light(value.detach() - step) ** 2).sum()) / (
        2 * step
    )
    assert float(slope) == pytest.approx(float(finite), rel=1e-6)
    assert float(slope) != 0


def test_gradient_through_the_camera_and_the_wall():
    def light(eye: torch.Tensor, wall: torch.Tensor) -> torch.Tensor:
        target = torch.tensor([-0.1, 0.0, 0.1], dtype=torch.float64)
        return pair_throughput(wall, target, 0.5 * target, 0.3, tuple(eye), GGX(0.2), (1.5, 0.5))

    eye = torch.tensor([0.3, 0.05, 0.5], dtype=torch.float64, requires_grad=True)
    wall = torch.tensor([[0.0, 0.0], [0.05, -0.03]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(light, (eye, wall), eps=1e-7, atol=1e-5)


def test_lamp():
    """Inverse square and cosine under the torch; half the light at the half-power angle."""
    plane = Plane(1, 201, 0.01)
    lit = lamp_radiance(plane, 0.5, (0.0, 0.0, 0.1), half_angle_deg=30.0, albedo=0.5, intensity=3.0)[0]
    assert float(lit[100]) == pytest.approx(0.5 / math.pi * 3.0 / 0.4**2)
    angle = math.atan2(0.5, 0.4)
    exponent = math.log(0.5) / math.log(math.cos(math.radians(30)))
    assert float(lit[150] / lit[100]) == pytest.approx(math.cos(angle) ** (3 + exponent))


def test_torch_lit_setup_is_the_bare_one_times_the_light():
    bare = RadiometricSetup(roughness=0.3, cell_m=0.02)
    lit = RadiometricSetup(roughness=0.3, cell_m=0.02, lamp_m=(-0.5, 0.0, 0.05))
    ratio = lit.transport((4, 6)).matrix / bare.transport((4, 6)).matrix
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio))
    assert float(ratio.max() / ratio.min()) > 1.05
    with pytest.raises(ConfigError, match="lamp_half_angle_deg is -1"):
        replace(lit, lamp_half_angle_deg=-1).emission(lit.target_cells())


def test_colour():
    """Aluminium is a little redder than white light; each wavelength is its own transport."""
    light = directions(torch.tensor(0.5), torch.tensor(0.0))
    blue, red = (float(GGX.aluminium(0.1, w)(light, light)) for w in (450e-9, 650e-9))
    assert red != blue
    assert red == pytest.approx(blue, rel=0.05)
    with pytest.raises(ConfigError, match="450, 500, 550, 650 nm"):
        GGX.aluminium(0.1, 1e-6)


def test_real_photograph_is_explained_by_the_occluder(shared_data):
    """Projected from the true screen, the wall photograph fits far better with the chair than without."""
    data = np.load(shared_data / "periscopy" / "mushroom_chair.npz")
    x, z = data["wall_x_m"][::3], data["wall_z_m"][::3]
    wall = Patches(x, -z, (0.0032, 0.0032))
    screen = Patches(data["cell_x_m"], -data["cell_z_m"], tuple(data["cell_size_m"]))
    distance = float(data["distance_m"])
    chair = tuple(
        Occluder(tuple((float(px), float(-pz), float(distance - py)) for px, py, pz in polygon))
        for polygon in data["occluder_polygons_m"]
    )
    photo = torch.as_tensor(data["wall_rgb"][::3, ::3]).double().flatten(0, 1)  # [P, 3]
    truth = torch.as_tensor(data["truth_rgb"]).double().flatten(0, 1)  # [C, 3]
    v, u = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64) for n in wall.shape), indexing="ij")
    background = torch.stack([u**i * v**j for i in range(3) for j in range(3 - i)], -1).flatten(0, 1)
    left = {}
    for name, occluders in (("chair", chair), ("none", ())):
        matrix = light_transport_matrix(
            wall,
            screen,
            distance,
            Lambert(),
            occluders=occluders,
            emission_exponent=(1.0, float(data["lcd_exponent"])),
        )
        residual = 0.0
        for channel in range(3):
            basis = torch.cat([(matrix @ truth[:, channel])[:, None], background], dim=1)
            fit = torch.linalg.lstsq(basis / basis.norm(dim=0), photo[:, channel : channel + 1]).solution
            rest = photo[:, channel] - (basis / basis.norm(dim=0) @ fit)[:, 0]
            flat = torch.linalg.lstsq(background, photo[:, channel : channel + 1]).solution
            spread = photo[:, channel] - (background @ flat)[:, 0]
            residual += float(rest.norm() / spread.norm()) / 3
        left[name] = residual
    assert left["chair"] < 0.16
    assert left["none"] > 0.95


def test_presets():
    assert setup_preset("aperture").occluders()[0].vertices_m[0][2] == pytest.approx(0.15)
    assert [setup_preset(name).roughness for name in ("easy", "main", "hard")] == [0.02, 0.05, 0.1]
    assert isinstance(setup_preset("matte", 0.5).brdf(), Lambert)
    assert setup_preset("main", 0.5).distance_m == 0.5
    with pytest.raises(ConfigError, match="easy, main"):
        setup_preset("none")


@pytest.mark.parametrize(
    ("match", "make"),
    [
        ("alpha", lambda: GGX(0.0)),
        ("albedo", lambda: Lambert(1.5)),
        ("k is", lambda: GGX(0.1, k=-1.0)),
        (
            "pin-hole",
            lambda: light_transport_matrix(View.affine((2, 2), 1.0), Plane(1, 1, 1.0), 1.0, Lambert()),
        ),
        ("distance_m", lambda: light_transport_matrix(camera((2, 2)), Plane(1, 1, 1.0), 0.0, Lambert())),
        ("crosses the wall", lambda: Occluder(((0.0, 0.0, -0.1), (0.1, 0.0, 0.1), (0.0, 0.1, 0.1)))),
        ("3 or more", lambda: Occluder(((0.0, 0.0, 0.1), (0.1, 0.0, 0.1)))),
        (
            "out of one plane",
            lambda: Occluder(((0.0, 0.0, 0.1), (0.1, 0.0, 0.1), (0.1, 0.1, 0.1), (0.0, 0.1, 0.2))),
        ),
        ("width_m", lambda: Occluder.post(0.0, 0.1, 0.0)),
        ("reaches z", lambda: setup_matrix(Lambert(), 0.1, occluders=(Occluder.post(0.0, 0.15, 0.01),))),
        ("needs it below", lambda: lamp_radiance(Plane(1, 1, 1.0), 0.3, (0.0, 0.0, 0.4))),
        ("half_angle_deg", lambda: lamp_radiance(Plane(1, 1, 1.0), 0.3, (0.0, 0.0, 0.0), half_angle_deg=90.0)),
        (
            "emission",
            lambda: light_transport_matrix(
                Plane(1, 1, 1.0), Plane(1, 1, 1.0), 1.0, Lambert(), emission=torch.ones(2, 2)
            ),
        ),
        ("give a View", lambda: light_transport_matrix(Plane(1, 1, 1.0), Plane(1, 1, 1.0), 1.0, GGX())),
        ("does not see", lambda: RadiometricSetup(camera_angle_deg=80.0).view((10, 10))),
    ],
)
def test_bad_input(match, make):
    with pytest.raises(ConfigError, match=match):
        make()
