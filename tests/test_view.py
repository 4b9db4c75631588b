"""Which wall point a pixel sees."""

import math

import pytest
import torch

from evnlos.errors import ConfigError
from evnlos.optics import View, ViewOperator
from evnlos.types import Plane

OBLIQUE = View.perspective((60, 96), 0.6, math.radians(30), math.radians(30))


def test_affine_axes():
    points = View.affine((3, 5), 100.0).wall_points_m()
    torch.testing.assert_close(points[1, 2], torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(points[1, 4], torch.tensor([0.02, 0.0], dtype=torch.float64))
    torch.testing.assert_close(points[2, 2], torch.tensor([0.0, 0.01], dtype=torch.float64))


def test_affine_turns_clockwise_shifts_and_flips():
    point = torch.tensor([0.01, 0.0], dtype=torch.float64)
    turned = View.affine((3, 5), 100.0, rotation_rad=math.pi / 2, offset_px=(0.5, 0.25))
    torch.testing.assert_close(turned.pixels(point), torch.tensor([2.5, 2.25], dtype=torch.float64))
    flipped = View.affine((3, 5), 100.0, flip_x=True)
    torch.testing.assert_close(flipped.pixels(point), torch.tensor([1.0, 1.0], dtype=torch.float64))


@pytest.mark.parametrize("view", [OBLIQUE, View.affine((60, 96), 300.0, 0.2, 0.1, 1.1, (3.0, -2.0))])
def test_pixels_invert_wall_points(view):
    v, u = torch.meshgrid(torch.arange(60), torch.arange(96), indexing="ij")
    torch.testing.assert_close(
        view.pixels(view.wall_points_m()), torch.stack([u, v], -1).double(), rtol=0, atol=1e-9
    )


def test_pin_hole_geometry():
    """Each wall point lies on the ray of its pixel, traced through the pin-hole by hand."""
    angle = math.radians(30)
    eye = torch.tensor([0.6 * math.sin(angle), 0.0, 0.6 * math.cos(angle)], dtype=torch.float64)
    torch.testing.assert_close(torch.tensor(OBLIQUE.eye_m, dtype=torch.float64), eye)
    forward = -eye / 0.6
    right = torch.tensor([math.cos(angle), 0.0, -math.sin(angle)], dtype=torch.float64)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    points = OBLIQUE.wall_points_m()
    for row, column in ((0, 0), (59, 0), (17, 80), (30, 95)):
        p = (column - 47.5) * 2 * math.tan(math.radians(15)) / 96
        q = (row - 29.5) * 2 * math.tan(math.radians(15)) / 96
        ray = forward + p * right + q * down
        hit = eye - ray * eye[2] / ray[2]
        torch.testing.assert_close(points[row, column], hit[:2], rtol=0, atol=1e-12)


def test_aim_moves_everything():
    moved = View.perspective((60, 96), 0.6, math.radians(30), math.radians(30), aim_m=(0.05, -0.02))
    shift = moved.wall_points_m() - OBLIQUE.wall_points_m()
    torch.testing.assert_close(
        shift, torch.tensor([0.05, -0.02], dtype=torch.float64).expand_as(shift), rtol=0, atol=1e-12
    )


def test_magnification_bounds_image_motion():
    bound = OBLIQUE.magnification()
    step = 1e-4
    points = OBLIQUE.wall_points_m()
    for move in ((step, 0.0), (0.0, step), (step / math.sqrt(2), step / math.sqrt(2))):
        moved = OBLIQUE.pixels(points + torch.tensor(move, dtype=torch.float64)) - OBLIQUE.pixels(points)
        assert float(moved.norm(dim=-1).max()) <= bound * step * 1.02
    assert View.affine((4, 4), 250.0).magnification() == pytest.approx(250.0)


def test_viewing_reproduces_a_linear_image():
    """Bilinear sampling, and any mean over a pixel, is exact on a tilted plane of brightness."""
    plane = Plane(60, 80, 0.005)
    view = View.affine((21, 31), 150.0, 0.2)
    y, x = torch.as_tensor(plane.y_m)[:, None], torch.as_tensor(plane.x_m)
    for samples in (1, 3):
        seen = ViewOperator(plane, view, samples)(1 + 2 * x - 3 * y)
        points = view.wall_points_m()
        torch.testing.assert_close(seen, 1 + 2 * points[..., 0] - 3 * points[..., 1])


def test_area_average_keeps_the_light():
    """A coarse camera that averages sees the same light as the plane holds, wherever a point source lies."""
    plane = Plane(64, 64, 0.001)
    view = View.affine((20, 20), 250.0)  # four samples per pixel
    viewing = ViewOperator(plane, view)
    assert viewing.samples == 4
    for row, column in ((30, 31), (33, 40), (25, 26)):
        point = torch.zeros(64, 64, dtype=torch.float64)
        point[row, column] = 1
        assert float(viewing(point).sum()) * 16 == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("match", "make"),
    [
        ("pixels_per_m", lambda: View.affine((4, 4), 0.0)),
        ("stretch", lambda: View.affine((4, 4), 1.0, stretch=0.0)),
        ("at least 1", lambda: View.affine((0, 4), 1.0)),
        ("distance_m", lambda: View.perspective((4, 4), -1.0, 0.0, 1.0)),
        ("angle_rad", lambda: View.perspective((4, 4), 1.0, 1.6, 0.1)),
        ("fov_rad", lambda: View.perspective((4, 4), 1.0, 0.0, 4.0)),
        ("does not see the wall", lambda: View.perspective((4, 4), 1.0, 1.4, 1.0)),
        ("singular", lambda: View((4, 4), ((1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1.0)))),
    ],
)
def test_bad_input(match, make):
    with pytest.raises(ConfigError, match=match):
        make()
