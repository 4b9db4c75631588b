"""The light-transport matrix against an independent path tracer, to within the tracer's own noise."""

import dataclasses

import numpy as np
import pytest
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.optics import GGX, Lambert, Occluder, View, light_transport_matrix
from evnlos.setups import RadiometricSetup
from evnlos.types import Plane
from mitsuba_oracle import (
    PATTERN,
    SHADOW_POINTS,
    WALLS,
    Agreement,
    compare,
    pattern,
    trace,
    trace_setup,
    triangulate,
    usable_variant,
    wall_image,
)

SHAPE = (8, 12)
RENDERS: dict[str, np.ndarray] = {}


def renders(name: str) -> np.ndarray:
    """Return the renders of one wall; each is made once."""
    pytest.importorskip("mitsuba")
    if name not in RENDERS:
        RENDERS[name] = trace_setup(WALLS[name], SHAPE, pattern())
    return RENDERS[name]


def image(name: str, brightness: np.ndarray | None = None, **changes) -> np.ndarray:
    setup = dataclasses.replace(WALLS[name], **changes)
    return wall_image(
        setup,
        SHAPE,
        pattern() if brightness is None else brightness,
        SHADOW_POINTS if setup.occluders() else None,
    )


@pytest.mark.parametrize("name", list(WALLS))
def test_the_matrix_agrees_with_the_tracer(name):
    found = compare(image(name), renders(name))
    assert found.agrees, found
    assert found.gain_sigma < 0.002, "the tracer is too noisy to say anything"


@pytest.mark.parametrize("name", ["Lambert", "GGX 0.3", "GGX 0.05", "GGX 0.3, post"])
def test_two_per_cent_of_gain_are_found(name):
    assert not compare(1.02 * image(name), renders(name)).agrees
    assert not compare(0.98 * image(name), renders(name)).agrees


@pytest.mark.parametrize("name", ["GGX 0.3", "GGX 0.05", "GGX 0.05, far"])
def test_two_per_cent_of_roughness_are_found(name):
    for factor in (0.98, 1.02):
        assert not compare(image(name, roughness=factor * WALLS[name].roughness), renders(name)).agrees


@pytest.mark.parametrize("name", ["Lambert", "GGX 0.05", "brushed 0.05 x 0.2"])
@pytest.mark.parametrize("axis", [0, 1], ids=["y", "x"])
def test_a_mirrored_axis_is_found(name, axis):
    assert not compare(np.flip(image(name), axis), renders(name)).agrees
    assert not compare(image(name, np.flip(pattern(), axis)), renders(name)).agrees


def test_a_wrong_occluder_is_found():
    assert not compare(image("Lambert, post", post_width_m=0.017), renders("Lambert, post")).agrees
    assert not compare(image("Lambert, post", post_width_m=0.0), renders("Lambert, post")).agrees


def test_swapped_brushing_is_found():
    swapped = image("brushed 0.05 x 0.2", roughness=0.2, roughness_y=0.05)
    assert not compare(swapped, renders("brushed 0.05 x 0.2")).agrees


def test_a_notched_and_tilted_occluder():
    """Five corners, one of them inward, in a tilted plane: triangles cover what the crossing count hides."""
    pytest.importorskip("mitsuba")
    flat = [(-0.15, -0.03), (-0.05, -0.03), (-0.05, 0.04), (-0.1, -0.01), (-0.15, 0.04)]
    notched = Occluder(tuple((x, y, 0.2 + 0.5 * y) for x, y in flat))
    setup = RadiometricSetup(roughness=0.3).seen_by(SHAPE)
    place = {"offset_m": setup.offset_m(), "occluders": (notched,)}
    matrix = light_transport_matrix(
        setup.view(SHAPE), PATTERN, 0.3, setup.brdf(), points=SHADOW_POINTS, **place
    )
    expected = (matrix @ torch.as_tensor(pattern()).flatten()).reshape(SHAPE).numpy()
    traced = trace(setup.view(SHAPE), PATTERN, pattern(), 0.3, setup.brdf(), **place)
    assert compare(expected, traced).agrees
    assert not compare(image("GGX 0.3"), traced).agrees


def test_same_seed_same_render():
    pytest.importorskip("mitsuba")
    setup = WALLS["GGX 0.3"].seen_by((3, 4))

    def once(seed: int) -> np.ndarray:
        camera, place = setup.view((3, 4)), {"offset_m": setup.offset_m()}
        return trace(camera, PATTERN, pattern(), 0.3, setup.brdf(), samples=4, repeats=2, seed=seed, **place)

    np.testing.assert_array_equal(once(5), once(5))
    assert (once(5)[0] != once(5)[1]).any()
    assert (once(5) != once(6)).any()


def test_compare_knows_its_own_noise():
    """Gaussian renders of a known image: chi2 scatters about 1 as stated, and the gain about its truth."""
    draw = np.random.default_rng(0)
    truth = draw.uniform(1, 2, (8, 12))
    found: list[Agreement] = []
    for _ in range(200):
        noisy = 1.01 * truth + 0.02 * truth * draw.standard_normal((16, 8, 12))
        found.append(compare(truth, noisy))
    chi2 = np.array([one.chi2 for one in found])
    assert chi2.mean() == pytest.approx(1, abs=4 * found[0].chi2_sigma / np.sqrt(200))
    assert chi2.std() == pytest.approx(found[0].chi2_sigma, rel=0.2)
    pull = np.array([(one.gain - 1.01) / one.gain_sigma for one in found])
    assert abs(pull.mean()) < 0.3
    assert pull.std() == pytest.approx(1, abs=0.15)


def test_a_wrong_llvm_does_not_end_this_process():
    pytest.importorskip("mitsuba")
    assert usable_variant() in ("llvm_ad_rgb", "scalar_rgb")


def test_triangles_cover_a_notched_polygon():
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 0.5], [0.0, 2.0]])
    for order in (corners, corners[::-1]):
        area = 0.0
        for a, b, c in triangulate(order):
            one, two = order[b] - order[a], order[c] - order[a]
            area += float(one[0] * two[1] - one[1] * two[0]) / 2
        assert area == pytest.approx(2.5)
    with pytest.raises(ConfigError, match="crosses itself"):
        triangulate(np.array([[0.0, 0.0], [2.0, 1.0], [1.0, 0.0], [0.0, 1.0]]))


def test_bad_input():
    pytest.importorskip("mitsuba")
    camera = WALLS["Lambert"].seen_by((3, 4)).view((3, 4))
    with pytest.raises(DataError, match="brightness"):
        trace(camera, PATTERN, np.ones((2, 2)), 0.3, Lambert())
    with pytest.raises(ConfigError, match="pin-hole"):
        trace(View.affine((3, 4), 10.0), Plane(1, 1, 0.1), [[1.0]], 0.3, GGX())
    with pytest.raises(DataError, match="at least 6"):
        compare(np.ones((3, 4)), np.ones((5, 3, 4)))
