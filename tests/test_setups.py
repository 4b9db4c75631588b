"""Setups: what every kind promises, how words become setups, old files, and the distance of the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
import torch

from evnlos.cameras import EventPixel, FrameCamera
from evnlos.config import from_dict, load_yaml, save_yaml, to_dict
from evnlos.data import Simulation, simulate_object
from evnlos.data.lab import Lab, lab_of
from evnlos.errors import ConfigError, DataError
from evnlos.optics.facets import SlopeTable
from evnlos.registry import migrate
from evnlos.scene import HandwritingGlyphs, LineMotion, PathMotion, Pose, Scene, Target
from evnlos.setups import (
    FittedSetup,
    MeasuredSetup,
    PaperSetup,
    RadiometricSetup,
    SensorSize,
    Setup,
    load_setup,
    named_setup,
    setup_names,
)
from evnlos.setups.files import About, AboutWall, FittedWall, Measurement, write_fitted, write_measurement
from evnlos.types import Plane

SHAPE = (10, 16)
PLANE = Plane(4, 6, 0.02)


def _measured(folder: Path) -> MeasuredSetup:
    draw = torch.Generator().manual_seed(1)
    cells = Plane(6, 14, 0.02)
    matrix = torch.rand(SHAPE[0] * SHAPE[1], 6 * 14, generator=draw)
    measurement = Measurement(
        matrix, torch.full(SHAPE, 0.01), torch.zeros(SHAPE), About(cells, *SHAPE, magnification_px_m=100.0)
    )
    path = folder / "transport.safetensors"
    write_measurement(path, measurement)
    return MeasuredSetup(file=str(path), sensor=SensorSize(*SHAPE), gain=0.01)


def _fitted(folder: Path) -> FittedSetup:
    table = SlopeTable.of_lobes(np.array([[0.1, 0.15]]), np.array([1.0]), scale=0.1, matte=0.1)
    ones, cells = np.ones(SHAPE, np.float32), Plane(4, 12, 0.02)
    about = AboutWall(table.scale, table.step, table.matte, Plane(1, 1, 0.01), cells)
    left, right = np.zeros((1, *SHAPE), np.float32), np.zeros((1, 48), np.float32)
    path = folder / "wall.safetensors"
    wall = FittedWall(table.log_density, ones, ones, np.zeros((1, 1), np.float32), left, right, about)
    offset = (-0.17, 0.0)
    return FittedSetup(
        file=str(path),
        checksum=write_fitted(path, wall),
        cell_m=0.01,
        target_offset_m=offset,
        ambient=0.1,
        sensor=SensorSize(*SHAPE),
    )


@pytest.fixture(params=["paper", "radiometric", "measured", "fitted"])
def setup(request: pytest.FixtureRequest, tmp_path: Path) -> Setup:
    """One setup of every kind, small: a new kind is one line here and gets every law."""
    return {
        "paper": lambda: PaperSetup(pitch_m=4e-3, field_of_view_m=0.4, tpsf_length_m=0.01).resized(SHAPE),
        "radiometric": lambda: RadiometricSetup(cell_m=0.01, ambient=0.1, sensor=SensorSize(*SHAPE)),
        "measured": lambda: _measured(tmp_path),
        "fitted": lambda: _fitted(tmp_path),
    }[request.param]()


def test_every_kind_of_the_package_is_tried() -> None:
    kinds = {kind for kind in Setup.registry if Setup.registry[kind].__module__.startswith("evnlos.")}
    # A room takes longer; tests/test_room_setup.py tries it.
    assert kinds == {"paper", "radiometric", "measured", "fitted", "room"}


def _scene(**pose: Any) -> Scene:
    return Scene(Target("square", np.ones((8, 8))), LineMotion((-0.01, 0.0), 0.02, **pose), 1.0)


def test_a_setup_survives_its_settings_file(setup: Setup, tmp_path: Path) -> None:
    assert from_dict(Setup, to_dict(setup)) == setup  # type: ignore[type-abstract]
    save_yaml(setup, tmp_path / "mine.yaml")
    assert load_setup(tmp_path / "mine.yaml") == setup
    save_yaml(Simulation(setup=setup), tmp_path / "simulation.yaml")
    assert load_setup(tmp_path / "simulation.yaml") == setup
    assert hash(setup) == hash(replace(setup))


def test_it_shows_a_scene_on_its_cameras(setup: Setup) -> None:
    light = setup.observe(_scene())
    assert light.shape == setup.shape == SHAPE
    frames = setup.frame_camera.capture(light, np.array([0.1, 0.9]), seed=1)
    assert frames.shape == (2, *SHAPE)
    assert setup.event_camera.record(light, 0.0, 0.1, seed=1).width == SHAPE[1]
    dark = setup.ambient_light()
    assert dark.shape == SHAPE
    assert bool((light.irradiance(0.5) >= dark - 1e-6).all())


def test_the_operator_is_what_observe_does(setup: Setup) -> None:
    if not setup.is_linear:
        with pytest.raises(ConfigError) as caught:
            setup.operator(PLANE)
        assert "not linear" in str(caught.value) and "radiometric" in str(caught.value)
        return
    cells = setup.target_cells()
    assert cells is not None
    scene = _scene()
    drawn = torch.from_numpy(scene.target.rasterise(cells, scene.motion.position_m(0.5))).double()
    seen = setup.operator(cells)(drawn) + setup.ambient_light()
    torch.testing.assert_close(seen.float(), setup.observe(scene).irradiance(0.5), rtol=1e-4, atol=1e-5)


def test_the_operator_and_its_adjoint_agree(setup: Setup) -> None:
    operator = setup.linear_part(PLANE)
    draw = torch.Generator().manual_seed(2)
    x = torch.rand(3, *PLANE.shape, generator=draw, dtype=torch.float64)
    y = torch.rand(3, *SHAPE, generator=draw, dtype=torch.float64)
    assert operator.source == PLANE and operator.shape == SHAPE
    assert float((operator(x) * y).sum()) == pytest.approx(float((x * operator.adjoint(y)).sum()), rel=1e-9)
    torch.testing.assert_close(operator(2 * x[0] - x[1]), 2 * operator(x[0]) - operator(x[1]))
    torch.testing.assert_close(operator.dense() @ x[0].flatten(), operator(x[0]).flatten())


def test_a_smaller_image_has_the_mean_light(setup: Setup) -> None:
    if setup.is_linear:
        x = torch.ones(PLANE.shape, dtype=torch.float64)
        full, small = setup.operator(PLANE)(x), setup.operator(PLANE, (5, 8))(x)
        assert float(small.mean()) == pytest.approx(float(full.mean()), rel=0.02)
        assert float(setup.resized((5, 8)).operator(PLANE)(x).mean()) > 0


def test_more_or_fewer_pixels_see_the_same(setup: Setup) -> None:
    x = torch.zeros(PLANE.shape, dtype=torch.float64)
    x[: PLANE.height // 2, PLANE.width // 3 :] = 1
    height, width = SHAPE
    seen = setup.linear_part(PLANE)(x)
    for shape in ((3 * height, width), (height, 3 * width), (3 * height, 3 * width)):
        other = setup.resized(shape)
        assert other.resized(SHAPE) == setup and other.seen_by(SHAPE) == setup
        if other.shape != shape:  # a scan has no more pixels than its camera
            continue
        assert other.sensor.pixel_aspect == pytest.approx(height / shape[0] * shape[1] / width)
        fine = other.linear_part(PLANE)(x).reshape(height, shape[0] // height, width, shape[1] // width)
        away = fine.mean(dim=(1, 3)) / fine.mean() - seen / seen.mean()
        assert float(away.norm() / (seen / seen.mean()).norm()) < 0.02, shape


def test_a_camera_of_another_ratio_has_square_pixels(setup: Setup) -> None:
    other = setup.seen_by((16, 16))
    if setup.kind == "measured":  # a scan knows no other camera than its own
        assert other.shape == setup.resized((16, 16)).shape
    else:
        assert other.sensor == SensorSize(16, 16)


def test_parameters_are_settings_that_can_be_moved(setup: Setup) -> None:
    parameters = setup.parameters()
    assert all(one.low <= one.value <= one.high and one.step > 0 for one in parameters)
    assert setup.with_parameters({}) == setup
    for one in parameters:
        other = one.value + 0.01
        moved = setup.with_parameters({one.name: other})
        assert {p.name: p.value for p in moved.parameters()}[one.name] == pytest.approx(other)
        assert one.name in setup.describe()
    with pytest.raises(ConfigError) as caught:
        setup.with_parameters({"colour": 1.0})
    assert "'colour'" in str(caught.value)


def test_what_follows_from_others_is_written_out_once_it_is_moved() -> None:
    moved = RadiometricSetup().with_parameters({"target_offset_m.1": 0.01})
    assert moved.target_offset_m == pytest.approx((-0.3 * math.tan(math.radians(30)), 0.01))


def test_the_scene_states_the_distance() -> None:
    near = RadiometricSetup(cell_m=0.01, sensor=SensorSize(*SHAPE))
    own = near.observe(_scene()).irradiance(0.5)
    assert torch.equal(near.observe(_scene(z_m=0.3)).irradiance(0.5), own)
    farther = near.observe(_scene(z_m=0.45)).irradiance(0.5)
    # Nothing but the target moved back: less of its light comes, with the same exposure.
    lit, dimmer = (one.double().sum() - near.ambient_light().double().sum() for one in (own, farther))
    operator = (
        near.at_distance(0.45).matrix(SHAPE, near.source()).sum() / near.matrix(SHAPE, near.source()).sum()
    )
    assert float(dimmer / lit) == pytest.approx(float(operator), rel=0.1)
    assert 0.2 < float(dimmer / lit) < 0.8
    paper = PaperSetup(pitch_m=4e-3).resized(SHAPE)
    there = replace(paper, distance_m=0.2).observe(_scene()).irradiance(0.5)
    assert torch.equal(paper.observe(_scene(z_m=0.2)).irradiance(0.5), there)


@dataclass(frozen=True)
class Turning(LineMotion):
    rate: float = 0.0
    retreat: float = 0.0

    def pose(self, t_s: Any) -> Pose:
        x, y = np.moveaxis(self.position_m(t_s), -1, 0)
        t = np.asarray(t_s, dtype=np.float64)
        return Pose(x, y, 0.3 + self.retreat * t, self.rate * t)


def test_a_pose_that_a_setup_cannot_show_is_refused_in_one_line(setup: Setup) -> None:
    target = _scene().target
    for motion, word in ((Turning(rate=0.1), "turns"), (Turning(retreat=0.1), "z_m")):
        if setup.kind == "radiometric":
            assert setup.observe(Scene(target, motion, 1.0)).irradiance(0.5).isfinite().all()
            continue
        with pytest.raises(ConfigError) as caught:
            setup.observe(Scene(target, motion, 1.0))
        assert word in str(caught.value) and "\n" not in str(caught.value)
    if setup.kind == "measured":
        with pytest.raises(ConfigError) as caught:
            setup.observe(_scene(z_m=0.3))
        assert "one target plane" in str(caught.value)


def test_motions_know_their_pose() -> None:
    for motion in (LineMotion(z_m=0.4), PathMotion((0.0, 1.0), ((0.0, 0.0), (0.1, 0.02)), 0.4)):
        pose = Scene(_scene().target, motion).pose([0.0, 0.5, 1.0])
        np.testing.assert_array_equal(np.stack([pose.x_m, pose.y_m], -1), motion.position_m([0.0, 0.5, 1.0]))
        assert pose.z_m.tolist() == [0.4] * 3 and not pose.rotation_rad.any()
        assert np.isnan(Scene(_scene().target, replace(motion, z_m=None)).pose(0.5).z_m)
    for wrong in (0.0, -1.0, math.nan):
        with pytest.raises(DataError):
            LineMotion(z_m=wrong)


def test_words_become_setups(tmp_path: Path) -> None:
    assert load_setup("hard-far") == RadiometricSetup(roughness=0.1, distance_m=0.5)
    assert {load_setup(name).kind for name in setup_names()} == {"radiometric"}
    assert load_setup("simulate-paper").shape == (600, 960)
    folder = tmp_path / "near"
    folder.mkdir()
    rough = RadiometricSetup(roughness=0.07, pixel=EventPixel(threshold_on=0.3))
    save_yaml(Simulation(setup=rough), folder / "setup.yaml")
    for word in (folder, folder / "setup.yaml"):
        found = named_setup(word)
        assert (found.setup, found.name, found.word) == (rough, "near", "near")
    measured = _measured(tmp_path)
    assert load_setup(measured.file) == replace(measured, gain=1.0)
    for word, says in (
        ("main-nera", "perhaps you meant 'main-near'"),
        ("worm", "perhaps you meant 'worn'"),
        ("nothing", "two-lobes"),
        ("", "the setup is ''; give a wall (mirror"),
        (None, "the setup is None; give a wall (mirror"),
        (3, "the setup is 3; give a wall (mirror"),
        (tmp_path / "none.yaml", "does not exist"),
        (tmp_path, "holds no setup.yaml"),
    ):
        with pytest.raises(ConfigError) as caught:
            load_setup(word)
        assert says in str(caught.value)


def test_files_of_older_versions_load(tmp_path: Path) -> None:
    old = {
        "transport": {"kind": "radiometric", "roughness": 0.08, "cell_m": 0.01},
        "sensor": {"height": 12, "width": 20},
        "frame_camera": {"full_well_e": 5000.0},
        "pixel": {"threshold_on": 0.25},
        "vary": {
            "transport.roughness": [0.05, 0.1],
            "pixel.cutoff_hz": [10, 20],
            "motion.speed_m_s": [0.01, 0.02],
        },
    }
    save_yaml(old, tmp_path / "old.yaml")
    today = RadiometricSetup(
        roughness=0.08,
        cell_m=0.01,
        sensor=SensorSize(12, 20),
        frame_camera=FrameCamera(full_well_e=5000.0),
        pixel=EventPixel(threshold_on=0.25),
    )
    loaded = load_yaml(Simulation, tmp_path / "old.yaml")
    assert loaded.setup == today == load_setup(tmp_path / "old.yaml")
    assert sorted(loaded.vary) == ["motion.speed_m_s", "setup.pixel.cutoff_hz", "setup.roughness"]
    save_yaml(
        {"lab": {"pixel": {"threshold_on": 0.2}}, "drawn": {"pixel": {"threshold_on": 0.22}}},
        tmp_path / "lab.yaml",
    )
    assert load_setup(tmp_path / "lab.yaml").pixel.threshold_on == 0.22
    lab = from_dict(Lab, {"transport": {"kind": "radiometric", "roughness": 0.2}})
    assert lab.setup.pixel == Lab().setup.pixel and lab.setup.frame_camera == Lab().setup.frame_camera


@pytest.mark.parametrize("make", [_measured, _fitted])
def test_a_setup_whose_folder_is_moved_loads(make: Any, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    (first / "targets").mkdir()
    setup = make(first)
    glyphs = HandwritingGlyphs(known=str(first / "targets"), redrawn=2)
    whole = Simulation(setup=setup, glyphs=glyphs)
    save_yaml(whole, first / "training.yaml")
    save_yaml(to_dict(whole), first / "older.yaml")  # with the absolute names of before
    save_yaml(setup, first / "setup.yaml")
    assert str(first) in (first / "older.yaml").read_text()
    assert str(first) not in (first / "training.yaml").read_text() + (first / "setup.yaml").read_text()
    for name in ("training.yaml", "older.yaml"):
        assert load_yaml(Simulation, first / name) == whole
    first.rename(second)
    for name in ("training.yaml", "older.yaml"):
        moved = load_yaml(Simulation, second / name)
        assert moved.setup == replace(setup, file=str(second / Path(setup.file).name))
        assert moved.glyphs == replace(glyphs, known=str(second / "targets"))
    for word in (second, second / "setup.yaml", second / "older.yaml"):
        assert load_setup(word) == moved.setup
        assert load_setup(word).ambient_light().shape == SHAPE  # from the file that was moved
    # A name that leads to nothing beside the file is left to the working directory, as before.
    (second / "other.yaml").write_text("kind: measured\nfile: elsewhere.safetensors\n")
    assert load_setup(second / "other.yaml") == MeasuredSetup(file="elsewhere.safetensors")


def test_another_file_under_the_name_of_a_fitted_wall_is_refused(tmp_path: Path) -> None:
    setup = _fitted(tmp_path)
    save_yaml(replace(setup, checksum="0" * 16), tmp_path / "setup.yaml")
    with pytest.raises(ConfigError, match=r"checksum|another"):
        load_setup(tmp_path).ambient_light()


def test_the_lab_takes_any_setup(tmp_path: Path) -> None:
    assert lab_of("hard-far").setup.gain == Lab().setup.gain  # a name states neither light nor cameras
    assert lab_of("hard-far").setup.pixel == Lab().setup.pixel
    own = RadiometricSetup(gain=0.4, pixel=EventPixel(threshold_on=0.3))
    save_yaml(own, tmp_path / "own.yaml")
    assert (lab_of(tmp_path / "own.yaml").setup, lab_of(tmp_path / "own.yaml").name) == (own, "own")


@Setup.registry.register
@dataclass(frozen=True)
class Dimmed(RadiometricSetup):
    """A wall that reflects less on its right, as a kind of its own."""

    is_linear: ClassVar[bool] = True
    kind: Literal["dimmed"] = "dimmed"  # type: ignore[assignment]
    right: float = 0.5

    def gain_map(self, shape: tuple[int, int]) -> torch.Tensor:
        """Return a ramp from 1 to `right`."""
        return torch.linspace(1.0, self.right, shape[1], dtype=torch.float64).expand(shape)


def test_a_part_of_the_radiometric_setup_is_replaced_by_itself(tmp_path: Path) -> None:
    save_yaml({"setup": {"kind": "dimmed", "right": 0.25, "cell_m": 0.01}}, tmp_path / "dimmed.yaml")
    dimmed = load_setup(tmp_path / "dimmed.yaml").resized(SHAPE)
    plain = RadiometricSetup(cell_m=0.01).resized(SHAPE)
    ratio = dimmed.matrix(SHAPE, PLANE) / plain.matrix(SHAPE, PLANE)
    torch.testing.assert_close(ratio[0], torch.ones_like(ratio[0]))
    torch.testing.assert_close(ratio[SHAPE[1] - 1], torch.full_like(ratio[0], 0.25))
    samples, _ = simulate_object(Simulation(setup=dimmed, positions=1), Simulation().glyphs.objects()[0])
    assert samples.frame.shape[0] == 1


def test_files_that_speak_of_rigs_and_plates_load(tmp_path: Path) -> None:
    folder = tmp_path / "near"
    folder.mkdir()
    (folder / "rig.yaml").write_text(
        "setup: {kind: radiometric, roughness: 0.07}\nrigs: 6\nglyphs: {kind: font, plate: {size_m: 0.05}}\n"
    )
    for word in (folder, folder / "rig.yaml"):
        found = named_setup(word)
        assert (found.setup, found.name, found.word) == (RadiometricSetup(roughness=0.07), "near", "near")
    assert load_yaml(Simulation, folder / "rig.yaml").setups == 6
    assert load_yaml(Simulation, folder / "rig.yaml").glyphs.target_plane.size_m == 0.05
    assert migrate("TargetInfo", {"name": "R", "plate_m": 0.05}) == {"name": "R", "size_m": 0.05}
    notes = {"camera": {"name": "c"}, "rig": {"distance_m": 0.3}}
    assert migrate("CaptureInfo", notes) == {"camera": {"name": "c"}, "setup": {"distance_m": 0.3}}
    assert migrate("Record", {"study": "captures", "rig": "near"}) == {"study": "captures", "setup": "near"}


def test_the_paper_s_setup_of_before_loads(tmp_path: Path) -> None:
    setup = "setup: {kind: paper, wave_pitch_m: 1.0e-5, taper: 0.5, rho_max: 6.0}\n"
    (tmp_path / "old.yaml").write_text(f"{setup}vary: {{setup.rho_max: [2.0, 5.0]}}\n")
    found = load_yaml(Simulation, tmp_path / "old.yaml")
    assert found.setup == PaperSetup(field_step_m=1e-5, window=0.5, kernel_radius=6.0)
    assert found.vary == {"setup.kernel_radius": (2.0, 5.0)}


def test_a_calibration_asks_any_setup_for_its_start_and_its_place(setup: Setup, tmp_path: Path) -> None:
    begin = setup.wall_start()
    assert (begin is not None) == (setup.kind == "radiometric")
    if begin is not None:
        pose, *roughness = begin
        assert (pose.distance_m, pose.target_offset_m) == (setup.distance_m, setup.offset_m())
        assert roughness == [setup.roughness, setup.roughness]
    (folder := tmp_path / "calibrated").mkdir()
    kept = setup.kept_in(folder, unexplained=0.1, frame_doubt=3.0)
    if setup.kind == "fitted":
        assert (kept.file, kept.unexplained, kept.frame_doubt) == (str(folder / "wall.safetensors"), 0.1, 3.0)
        assert kept.kept_in(folder) == kept and kept.checksum == setup.checksum
        assert torch.equal(kept.ambient_light(), setup.ambient_light())
    else:
        assert kept is setup and not list(folder.iterdir())
