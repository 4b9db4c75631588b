"""Walls whose facets have any density of slopes: geometry, compiled loops against slow references, files."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.optics import GGX, View, light_transport_matrix
from evnlos.optics.facets import (
    MASKING,
    Cells,
    Pose,
    Seen,
    SlopeTable,
    SparseImages,
    carry_facets,
    carry_lobes,
    facet_matrix,
    facet_slopes,
    fill_facets,
    seen_points,
    target_cells,
)
from evnlos.optics.radiometric import torchs_threads
from evnlos.scene import LineMotion, Scene, Target
from evnlos.setups import FittedSetup, SensorSize
from evnlos.setups.files import WALL, AboutWall, FittedWall, write_fitted
from evnlos.types import Plane


@pytest.fixture(autouse=True)
def threads_of_torch():
    """Kernels are called as they are here: what they leave of PyTorch's threads would slow all later tests."""
    with torchs_threads():
        yield


POSE = Pose(
    camera_distance_m=0.55,
    camera_angle_deg=24.0,
    camera_elevation_deg=4.0,
    camera_roll_deg=3.0,
    field_of_view_deg=33.0,
    distortion=-0.05,
    distance_m=0.35,
    target_offset_m=(-0.14, 0.01),
    travel_slope=0.05,
    curvature_per_m=(0.7, -0.4),
)
SHAPE = (9, 14)
PLANE = Plane(4, 7, 0.02)


def pixels(shape=SHAPE):
    rows, columns = np.meshgrid(
        np.arange(shape[0], dtype=float), np.arange(shape[1], dtype=float), indexing="ij"
    )
    return columns.ravel(), rows.ravel()


def table(seed=0, scale=0.05) -> SlopeTable:
    """A lobe of two widths with a bumpy, lopsided density."""
    first = SlopeTable.of_lobes(
        np.array([[0.05, 0.12], [0.2, 0.15]]), np.array([1.0, 0.3]), scale=scale, matte=0.4
    )
    bumps = np.random.default_rng(seed).normal(0, 0.3, first.log_density.shape)
    return first._replace(log_density=first.log_density + bumps)


def slow_matrix(pose: Pose, wall: SlopeTable, shape, plane) -> np.ndarray:
    """f cos_i cos_t / r^2 times the cell's area, pair by pair, from the definition."""
    seen, cells = seen_points(pose, shape, *pixels(shape)), target_cells(pose, plane)
    out = np.empty((len(seen.points), len(cells.points)))
    for p, (point, frame, eye) in enumerate(zip(seen.points, seen.frames, seen.eyes, strict=True)):
        away = cells.points - point
        r = np.linalg.norm(away, axis=1)
        light = (away / r[:, None]) @ frame.reshape(3, 3).T
        half = light + eye
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        density = wall.density(half[:, 0] / half[:, 2], half[:, 1] / half[:, 2])

        def seen_share(cosine):
            return 2 / (1 + np.sqrt(1 + MASKING**2 * (1 / cosine**2 - 1)))

        facets = density / half[:, 2] ** 4 * seen_share(light[:, 2]) * seen_share(eye[2])
        brdf = facets / (4 * light[:, 2] * eye[2]) + wall.matte / math.pi
        out[p] = brdf * light[:, 2] * (away[:, 2] / r) / r**2 * cells.area
    return out


def parts(pose: Pose = POSE) -> tuple[Seen, Cells]:
    return seen_points(pose, SHAPE, *pixels()), target_cells(pose, PLANE)


def test_a_plain_pose_sees_the_points_of_a_perspective_view():
    pose = Pose(camera_distance_m=0.7, camera_angle_deg=-25.0, field_of_view_deg=28.0)
    view = View.perspective(SHAPE, 0.7, math.radians(-25.0), math.radians(28.0))
    seen = seen_points(pose, SHAPE, *pixels())
    np.testing.assert_allclose(seen.points[:, :2], view.wall_points_m().reshape(-1, 2), atol=1e-12)
    np.testing.assert_allclose(seen.points[:, 2], 0, atol=1e-12)
    to_eye = np.array(view.eye_m) - seen.points
    np.testing.assert_allclose(seen.eyes, to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True), atol=1e-12)


def test_a_bent_wall_is_met_where_it_is_and_its_frames_stand_on_it():
    seen = seen_points(POSE, SHAPE, *pixels())
    x, y, z = seen.points.T
    np.testing.assert_allclose(z, (0.7 * x**2 - 0.4 * y**2) / 2, atol=1e-12)
    frames = seen.frames.reshape(-1, 3, 3)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-12
    )
    along_x = np.stack([np.ones_like(x), np.zeros_like(x), 0.7 * x], axis=1)
    along_y = np.stack([np.zeros_like(x), np.ones_like(x), -0.4 * y], axis=1)
    for tangent in (along_x, along_y):
        np.testing.assert_allclose((tangent * frames[:, 2]).sum(axis=1), 0, atol=1e-12)
    assert (np.linalg.det(frames) > 0).all()


def test_a_camera_that_looks_past_the_wall_is_refused():
    with pytest.raises(ConfigError, match="does not see the wall"):
        seen_points(Pose(camera_angle_deg=80.0, field_of_view_deg=40.0), SHAPE, *pixels())


def test_the_compiled_matrix_is_the_definition():
    expected = slow_matrix(POSE, table(), SHAPE, PLANE)
    np.testing.assert_allclose(facet_matrix(POSE, table(), SHAPE, PLANE, np.float64), expected, rtol=1e-9)


def test_a_table_of_one_lobe_reflects_like_ggx():
    # Fresnel's factor is left out of the table, and masking is that of one roughness: both are nearly constant.
    pose = Pose(target_offset_m=(-0.17, 0.0))
    lobe = SlopeTable.of_lobes(np.array([[0.1, 0.2]]), np.array([1.0]), scale=0.1, step=0.1)
    view = View.perspective(SHAPE, 0.6, math.radians(30), math.radians(30))
    wanted = light_transport_matrix(
        view, PLANE, 0.3, GGX(0.1, 0.2), offset_m=(-0.17, 0.0), points=(1, 1)
    ).numpy()
    ratio = facet_matrix(pose, lobe, SHAPE, PLANE, np.float64) / wanted
    assert ratio.std() / ratio.mean() < 0.02
    assert ratio.mean() == pytest.approx(1 / 0.92, rel=0.02)  # aluminium's reflectance


def test_carried_images_are_the_matrix_times_the_images():
    rng = np.random.default_rng(1)
    pictures = rng.uniform(0, 1, (5, 28)) * (rng.uniform(0, 1, (5, 28)) < 0.3)
    wall, place = table(), parts()
    matrix, out = np.empty((126, 28)), np.empty((126, 5))
    fill_facets(matrix, *place, wall, MASKING)
    carry_facets(out, *place, wall, MASKING, SparseImages.of(pictures))
    np.testing.assert_allclose(out, matrix @ pictures.T, rtol=1e-9)


def test_derivatives_are_differences():
    rng = np.random.default_rng(2)
    pictures = rng.uniform(0, 1, (3, 28))
    wall, place = table(), parts()
    column = np.arange(wall.nodes**2).reshape(wall.nodes, wall.nodes)
    column[-1, -1] = column[0, 0]  # two coefficients that are one number
    out = np.empty((126, 3, wall.nodes**2 + 1))
    facet_slopes(out, *place, wall, MASKING, column, SparseImages.of(pictures))

    def light(log_density, matte):
        made = np.empty((126, 3))
        at = wall._replace(log_density=log_density, matte=matte)
        carry_facets(made, *place, at, MASKING, SparseImages.of(pictures))
        return made

    step, middle = 1e-5, wall.nodes // 2
    for i, j in ((middle, middle), (middle + 1, middle - 2), (middle - 2, middle)):
        bump = np.zeros_like(wall.log_density)
        bump[i, j] = step
        slope = (light(wall.log_density + bump, wall.matte) - light(wall.log_density - bump, wall.matte)) / (
            2 * step
        )
        np.testing.assert_allclose(out[..., column[i, j]], slope, rtol=1e-6, atol=1e-12)
    slope = light(wall.log_density, wall.matte + 1) - light(wall.log_density, wall.matte)
    np.testing.assert_allclose(out[..., -1], slope, rtol=1e-6)


def test_lobes_are_tables_of_lobes():
    pictures = np.random.default_rng(3).uniform(0, 1, (2, 28))
    alphas, place = np.array([[0.1, 0.1], [0.1, 0.25]]), parts()
    out = np.empty((126, 2, 3))
    carry_lobes(out, *place, alphas, MASKING, SparseImages.of(pictures))
    for k in range(2):
        fine = SlopeTable.of_lobes(alphas[k : k + 1], np.ones(1), scale=0.1, step=0.1)
        made = np.empty((126, 2))
        carry_facets(made, *place, fine, MASKING, SparseImages.of(pictures))
        np.testing.assert_allclose(out[..., k], made, rtol=0.02)


def fitted(rank=2, companion=0.0) -> FittedWall:
    rng = np.random.default_rng(4)
    plane, wall = Plane(4, 12, 0.02), table()
    picture = np.zeros((8, 8), np.float32)
    picture[6, 4] = companion
    return FittedWall(
        wall.log_density,
        rng.uniform(0.8, 1.2, SHAPE).astype(np.float32),
        np.ones((3, 4), np.float32),
        picture,
        rng.normal(0, 1e-3, (rank, 5, 7)).astype(np.float32),
        rng.normal(0, 1, (rank, 48)).astype(np.float32),
        AboutWall(wall.scale, wall.step, wall.matte, Plane(8, 8, 0.02), plane, {"kept": ["texture"]}),
    )


def setup_of(path, wall: FittedWall, **changes) -> FittedSetup:
    checksum = write_fitted(path, wall)
    plain = Pose(target_offset_m=(-0.17, 0.0))
    pose = {name: getattr(plain, name) for name in plain.__dataclass_fields__}
    return FittedSetup(
        file=str(path),
        checksum=checksum,
        ambient=0.1,
        cell_m=0.02,
        strip_m=(0.24, 0.08),
        sensor=SensorSize(*SHAPE),
        **(pose | changes),
    )


def test_a_fitted_wall_survives_its_file(tmp_path):
    wall = fitted()
    write_fitted(tmp_path / "wall.safetensors", wall)
    back = WALL.read(tmp_path / "wall.safetensors")
    for name in ("log_density", "sensitivity", "ambient", "companion", "left", "right", "tilt"):
        np.testing.assert_array_equal(getattr(back, name), getattr(wall, name))
    assert back.about == wall.about


def test_a_tilt_turns_the_wall(tmp_path):
    """The same slopes everywhere are a wall that is turned; a file of before has none."""
    turned = np.full((2, 3, 4), 0.0, np.float32)
    turned[0], turned[1] = 0.02, -0.01
    flat, tilted = fitted(0), replace(fitted(0), tilt=turned)
    source = Plane(4, 12, 0.02)
    one, other = (setup_of(tmp_path / f"{k}.safetensors", wall) for k, wall in enumerate((flat, tilted)))
    made, changed = (setup.matrix(SHAPE, source).numpy() for setup in (one, other))
    rows, columns = (v.ravel().astype(float) for v in np.meshgrid(*map(np.arange, SHAPE), indexing="ij"))
    seen = seen_points(one.pose(), SHAPE, columns, rows)
    normal = np.array([-0.02, 0.01, 1.0])
    normals = np.tile(normal / np.linalg.norm(normal), (len(rows), 1))
    first = np.cross(np.array([0.0, 1.0, 0.0]), normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first), normals], axis=1)
    eyes = np.einsum("pij,pj->pi", frames, np.einsum("pji,pj->pi", seen.frames.reshape(-1, 3, 3), seen.eyes))
    expected = np.empty_like(made)
    fill_facets(
        expected,
        Seen(seen.points, np.ascontiguousarray(frames.reshape(-1, 9)), eyes),
        target_cells(one.pose(), source),
        one.table(),
        MASKING,
    )
    expected *= flat.image("sensitivity", SHAPE).flatten().double().numpy()[:, None]
    np.testing.assert_allclose(changed, expected, rtol=1e-6)
    assert np.abs(changed - made).max() > 0.01 * made.max()
    tensors = {name: torch.from_numpy(getattr(flat, name)) for name in WALL.names}
    replace(WALL, later=()).write(tmp_path / "old.safetensors", tensors, flat.about)
    old = replace(one, file=str(tmp_path / "old.safetensors"), checksum="")
    np.testing.assert_array_equal(old.matrix(SHAPE, source), made)
    with pytest.raises(DataError, match="tilt is"):
        replace(flat, tilt=np.zeros((3, 4), np.float32))


def test_damaged_files_and_arrays_that_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "wall.safetensors"
    with pytest.raises(DataError, match="does not exist"):
        WALL.read(path)
    setup = setup_of(path, fitted())
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(DataError, match="not a readable safetensors"):
        WALL.read(path)
    with pytest.raises(ConfigError, match="checksum"):
        setup.fitted()
    with pytest.raises(DataError, match="companion is"):
        replace(fitted(), companion=np.zeros((2, 2), np.float32))
    with pytest.raises(DataError, match="NaN"):
        replace(fitted(), sensitivity=np.full(SHAPE, np.nan, np.float32))
    with pytest.raises(ConfigError, match="ends in"):
        write_fitted(tmp_path / "wall.npz", fitted())
    with pytest.raises(ConfigError, match="is empty"):
        FittedSetup().fitted()


def test_the_setup_is_facets_times_sensitivity_plus_correction(tmp_path):
    setup = setup_of(tmp_path / "a.safetensors", fitted())
    wall = setup.fitted()
    facets = facet_matrix(setup.pose(), wall.table, SHAPE, setup.source(), np.float64)
    left = wall.image("left", SHAPE).double().flatten(1)
    expected = (
        torch.from_numpy(facets * wall.sensitivity.reshape(-1, 1))
        + left.T @ torch.from_numpy(wall.right).double()
    )
    torch.testing.assert_close(setup.matrix(SHAPE, setup.source()), expected)
    # Cells that halve the fitted ones share their light.
    fine = setup.matrix(SHAPE, Plane(8, 24, 0.01)).unflatten(1, (4, 2, 12, 2)).sum((2, 4)).flatten(1)
    torch.testing.assert_close(fine, expected, rtol=0.05, atol=float(expected.max()) * 0.02)


def test_larger_slopes_are_a_wider_lobe_of_as_much_light(tmp_path):
    setup = setup_of(tmp_path / "a.safetensors", fitted(rank=0))
    wide = replace(setup, slopes=2.0).table()
    x = np.linspace(-0.1, 0.1, 7)
    np.testing.assert_allclose(wide.density(2 * x, -x), setup.table().density(x, -x / 2) / 4, rtol=1e-9)


def test_what_travels_along_is_seen_beside_the_target(tmp_path):
    target = Target("target", np.ones((4, 4), np.float32), 0.08)
    scene = Scene(target, LineMotion(start_m=(-0.04, 0.0), speed_m_s=0.02), 4.0)
    dark = setup_of(tmp_path / "a.safetensors", fitted(rank=0)).observe(scene)
    lit = setup_of(tmp_path / "b.safetensors", fitted(rank=0, companion=0.5)).observe(scene)
    times = np.array([0.5, 2.0, 3.1])
    added = (lit.irradiance(times) - dark.irradiance(times)).numpy()
    # The cell (row 6, column 4) of 8 x 8 cells of 2 cm: 1 cm right of and 5 cm below the target's middle.
    spot = Target("spot", np.full((1, 1), 0.5, np.float32), 0.02)
    cells = Plane(24, 40, 0.01)
    setup = setup_of(tmp_path / "b.safetensors", fitted(rank=0))
    matrix = setup.matrix(SHAPE, cells)
    for k, t in enumerate(times):
        drawn = spot.rasterise(cells, (-0.04 + 0.02 * t + 0.01, 0.05))
        expected = (matrix @ torch.from_numpy(drawn).double().flatten()).reshape(SHAPE).numpy()
        np.testing.assert_allclose(added[k], expected, rtol=0.02, atol=0.01 * expected.max())
    gone = replace(setup_of(tmp_path / "c.safetensors", fitted(rank=0, companion=0.5)), companion=0.0).observe(
        scene
    )
    torch.testing.assert_close(gone.irradiance(times), dark.irradiance(times))


def test_a_target_that_leaves_the_strip_is_refused(tmp_path):
    target = Target("target", np.ones((4, 4), np.float32), 0.08)
    with pytest.raises(ConfigError, match="strip_m to at least"):
        setup_of(tmp_path / "a.safetensors", fitted()).observe(Scene(target, LineMotion((-0.2, 0.0)), 1.0))
