"""The radiometric matrix: reflectance, geometry, quadrature, mode counts."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import dblquad

from evnlos.errors import ConfigError
from evnlos.transport import GGX, Lambert, RadiometricTransport, View, light_transport_matrix, rig_preset
from evnlos.transport.brdf import conductor_fresnel
from evnlos.transport.radiometric import quadrature_points
from evnlos.types import Plane

ANGLE = math.radians(30)


def camera(shape=(60, 96)) -> View:
    return View.perspective(shape, 0.6, ANGLE, ANGLE)


def modes(matrix: torch.Tensor) -> int:
    values = torch.linalg.eigvalsh(matrix.mT @ matrix).clamp(min=0).sqrt()
    return int((values > 1e-2 * values.max()).sum())


def rig_matrix(brdf, distance: float, **options) -> torch.Tensor:
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
        assert abs(modes(rig_matrix(brdf, distance)) - count) <= max(1, 0.03 * count)


def test_mode_count_of_the_smoothest_wall():
    """One quadrature point will do for a count within three per cent."""
    assert abs(modes(rig_matrix(GGX(0.02), 0.5, points=(1, 1), dtype=torch.float32).double()) - 47) <= 1.5


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
    # Share of the hemisphere (cosine-weighted) that a square of half-side a at height h leaves out is about (h/a)^2.
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


def test_presets():
    assert [rig_preset(name).roughness for name in ("easy", "main", "hard")] == [0.02, 0.05, 0.1]
    assert isinstance(rig_preset("matte", 0.5).brdf(), Lambert)
    assert rig_preset("main", 0.5).distance_m == 0.5
    with pytest.raises(ConfigError, match="easy, main"):
        rig_preset("none")


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
        ("does not see", lambda: RadiometricTransport(camera_angle_deg=80.0).view((10, 10))),
    ],
)
def test_bad_input(match, make):
    with pytest.raises(ConfigError, match=match):
        make()
