"""The virtual laboratory: captures in the format of real ones, from a setup's file, with their own sensor."""

import dataclasses
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from evnlos.cli import main
from evnlos.config import from_dict, load_yaml, read_yaml, save_yaml
from evnlos.data import Sampling, SensorSize, capture_samples, read_capture
from evnlos.data.lab import (
    SENSOR_SPREAD,
    Lab,
    lab_of,
    published_lab,
    render_captures,
)
from evnlos.data.simulations import default
from evnlos.errors import ConfigError, DataError
from evnlos.events import write_events
from evnlos.optics import Diffraction
from evnlos.report.provenance import PUBLISHED, compare_published, content_digest
from evnlos.scene import FontGlyphs, HandwritingGlyphs, LineMotion, OtherTarget, Scene, SeveralTargets
from evnlos.setups import PaperSetup, RadiometricSetup, setup_names, setup_preset
from evnlos.types import Plane
from watching import stopped


def small(**changes) -> Lab:
    """Return a lab that renders a capture in a second or so."""
    setup = replace(Lab().setup, cell_m=0.01, gain=0.7, ambient=0.06, ambient_gradient=(0.0, 0.0))
    cameras = {name: changes.pop(name) for name in ("sensor", "frame_camera", "pixel") if name in changes}
    setup = replace(setup, **{"sensor": SensorSize(24, 36), **cameras, **changes.pop("setup", {})})
    settings = {
        "glyphs": FontGlyphs(family="kalam", characters="AL"),
        "frame_rate_hz": 1.0,
        "setup": setup,
    }
    return Lab(**settings | changes)


def content(folder: Path) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("lab") / "near"
    assert [path.name for path in render_captures(small(name="near"), out)] == ["near_A", "near_L"]
    return out


def test_sensor_is_drawn_from_the_stated_ranges():
    seen = {path: [] for path in SENSOR_SPREAD}
    for seed in range(40):
        lab = Lab(seed=seed).drawn()
        for path, (low, high) in SENSOR_SPREAD.items():
            _, part, name = path.split(".")
            value = getattr(getattr(lab.setup, part), name)
            assert low <= value <= high
            seen[path].append(value)
    for path, (low, high) in SENSOR_SPREAD.items():
        assert np.ptp(seen[path]) > 0.8 * (high - low), f"{path} does not fill its range"


def test_a_setup_keeps_its_sensor_and_another_setup_has_its_own():
    assert Lab(seed=3).drawn() == Lab(seed=3).drawn() == Lab(seed=3).drawn().drawn()
    assert Lab(seed=3).drawn().setup.pixel != Lab(seed=4).drawn().setup.pixel
    assert Lab(name="other", seed=3).drawn().setup.pixel != Lab(seed=3).drawn().setup.pixel
    assert (
        Lab(seed=3).drawn().setup.frame_camera.pattern_seed
        != Lab(seed=4).drawn().setup.frame_camera.pattern_seed
    )
    fixed = Lab(spread={})
    assert fixed.drawn() == fixed


def test_the_sensor_is_not_the_training_simulators():
    training = default()
    for path, (low, high) in SENSOR_SPREAD.items():
        _, part, name = path.split(".")
        if path not in training.vary and path != "setup.pixel.hot_pixel_fraction":
            used = getattr(getattr(training.setup, part), name)
            assert not low < used < high, path


def test_a_capture_reads_like_a_recording(rendered):
    capture = read_capture(rendered / "near_A")
    assert (capture.name, capture.target.name, capture.info.target.size_m) == ("near_A", "A", 0.08)
    assert capture.frames.shape == (9, 24, 36)
    assert capture.frame_times_us.tolist() == [1_000_000 * k for k in range(9)]
    assert len(capture.events) > 100
    assert capture.scene.motion == LineMotion()


def test_what_was_drawn_is_written_down(rendered):
    lab, notes = small(name="near"), read_yaml(rendered / "lab.yaml")
    drawn = lab.drawn()
    assert from_dict(Lab, notes["lab"]) == lab
    assert from_dict(type(drawn.setup.pixel), notes["drawn"]["pixel"]) == drawn.setup.pixel
    about = read_capture(rendered / "near_L").info.setup["rendered"]
    assert from_dict(RadiometricSetup, about["setup"]) == drawn.setup


def test_a_run_is_taken_up_again(rendered, tmp_path):
    """A killed run leaves a draft; what is done is kept, what is missing comes out the same."""
    out = tmp_path / "near"
    lab = small(name="near")
    (first,) = stopped(render_captures, lab, out, after=1)
    draft = out / f".near_L.{socket.gethostname()}.4194304.0123abcd.part"  # of a process that is dead
    (draft / "frames").mkdir(parents=True)
    (draft / "events.raw").write_bytes(b"half")
    stamp = (first / "capture.yaml").stat().st_mtime_ns
    assert [path.name for path in render_captures(lab, out)] == ["near_A", "near_L"]
    assert (first / "capture.yaml").stat().st_mtime_ns == stamp
    assert content(out) == content(rendered)


def test_more_characters_may_be_added_but_no_other_setup(rendered):
    more = small(name="near", glyphs=FontGlyphs(family="kalam", characters="ALI"))
    with pytest.raises(DataError, match=r"begun with other settings.*seed: 0 -> 1"):
        render_captures(dataclasses.replace(more, seed=1), rendered)
    before = content(rendered / "near_A")
    assert len(render_captures(more, rendered)) == 3
    assert content(rendered / "near_A") == before


OLD_LAB = """\
lab:
  name: near
  glyphs:
    kind: font
    family: kalam
    characters: L
    plate: {size_m: 0.08, size_px: 256}
  frame_rate_hz: 1.0
  transport: {kind: radiometric, cell_m: 0.01, gain: 0.7, ambient: 0.06, ambient_gradient: [0.0, 0.0]}
  sensor: {height: 24, width: 36}
  spread:
    pixel.threshold_on: [0.18, 0.28]
"""


def test_a_folder_of_an_older_version_is_taken_up(tmp_path):
    lab = small(
        name="near",
        glyphs=FontGlyphs(family="kalam", characters="L"),
        spread={"setup.pixel.threshold_on": (0.18, 0.28)},
    )
    (tmp_path / "lab.yaml").write_text(OLD_LAB)
    with pytest.raises(DataError, match=r"begun with other settings \(seed: 0 -> 1\)"):
        render_captures(dataclasses.replace(lab, seed=1), tmp_path, [])
    assert render_captures(lab, tmp_path, []) == []


def test_other_glyphs_keep_their_whole_name(tmp_path):
    lab = small(glyphs=HandwritingGlyphs(characters="A", writers=1))
    assert [path.name for path in render_captures(lab, tmp_path / "o")] == ["lab_writer00_A"]


CALIBRATED_FILE = """
name: bench
seed: 5
glyphs: {kind: font, family: kalam, characters: L}
sensor: {height: 24, width: 36}
frame_rate_hz: 1.0
transport:
  wall_material: lambert
  distance_m: 0.4
  cell_m: 0.01
  ambient: 0.2
  ambient_gradient: [0.5, 0.0]
  lamp_m: [-0.5, 0.1, 0.05]
  occluders_m:
    - [[-0.14, -0.05, 0.25], [-0.11, -0.05, 0.25], [-0.11, 0.05, 0.25], [-0.14, 0.05, 0.25]]
spread:
  pixel.threshold_on: [0.3, 0.4]
"""


def test_a_setup_file_reaches_every_option(tmp_path):
    path = tmp_path / "setup.yaml"
    path.write_text(CALIBRATED_FILE)
    lab = load_yaml(Lab, path)
    assert len(lab.setup.occluders()) == 1
    assert 0.3 <= lab.drawn().setup.pixel.threshold_on <= 0.4
    (folder,) = render_captures(lab, tmp_path / "o")
    capture = read_capture(folder)
    assert "1 occluder(s), torch-lit target" in capture.info.setup["wall"]
    # Each option changes what the camera sees.
    scene = Scene(lab.glyphs.target("kalam_L"), lab.motion, lab.duration_s)
    seen = lab.setup.resized((24, 36)).observe(scene).irradiance(4.0)
    for change in (
        {"lamp_m": None},
        {"occluders_m": ()},
        {"ambient": 0.1},
        {"ambient_gradient": (0.0, 0.0)},
        {"wall_material": "ggx"},
    ):
        other = dataclasses.replace(lab.setup, **change).resized((24, 36)).observe(scene).irradiance(4.0)
        assert float((other - seen).abs().max()) > 1e-3, change


def test_the_documents_setup_file():
    text = (Path(__file__).parent.parent / "docs" / "lab.md").read_text()
    lab = from_dict(Lab, yaml.safe_load(text.split("```yaml")[1].split("```")[0]))
    assert (lab.name, lab.setup.lamp_m, lab.spread) == (
        "bench",
        (-0.5, 0.1, 0.05),
        {"setup.pixel.threshold_on": (0.18, 0.28)},
    )
    coarse = dataclasses.replace(lab.setup, cell_m=0.01)
    assert coarse.resized((6, 9)).observe(scene()).irradiance(4.0).shape == (6, 9)


@pytest.mark.parametrize("name", ["matte-near", "aperture-far"])
def test_named_setups_render(name, tmp_path):
    lab = lab_of(name)
    lab = dataclasses.replace(
        lab,
        setup=dataclasses.replace(dataclasses.replace(lab.setup, cell_m=0.01), sensor=SensorSize(24, 36)),
        glyphs=FontGlyphs(family="kalam", characters="T"),
        frame_rate_hz=0.5,
    )
    (folder,) = render_captures(lab, tmp_path / "o")
    capture = read_capture(folder)
    assert folder.name == f"{name}_T"
    assert capture.frames.mean() > 1.3 * 255 * lab.setup.ambient
    assert capture.info.setup["distance_m"] == (0.5 if name.endswith("far") else 0.3)


def test_all_names():
    assert setup_names()[:3] == ["mirror-near", "mirror-far", "easy-near"]
    for name in setup_names():
        assert lab_of(name).setup.gain == 0.7
    assert setup_preset("main-far").distance_m == 0.5
    assert setup_preset("main-far", 0.4).distance_m == 0.4


def test_occluders_of_a_setup_are_those_of_its_matrix():
    """A target-sized screen right before the target leaves only what passes beside it."""
    wide = ((-0.4, -0.3, 0.29), (0.0, -0.3, 0.29), (0.0, 0.3, 0.29), (-0.4, 0.3, 0.29))
    setup = RadiometricSetup(wall_material="lambert", cell_m=0.01, occluders_m=(wide,))
    with pytest.raises(ConfigError, match="no light"):
        setup.transport((6, 9))
    half = tuple((min(x, -0.173), y, z) for x, y, z in wide)
    left = RadiometricSetup(wall_material="lambert", cell_m=0.01, occluders_m=(half,))
    matrix = left.matrix((6, 9), Plane(2, 2, 0.04))
    assert float(matrix[:, 0].sum()) < 0.2 * float(matrix[:, 1].sum())
    assert torch.isfinite(matrix).all()


def scene() -> Scene:
    return Scene(FontGlyphs(family="kalam", characters="A").target("kalam_A"), LineMotion(), 8.0)


BAD = [
    ("does not see the wall", lambda: RadiometricSetup(camera_angle_deg=80.0).resized((6, 9)).observe(scene())),
    (
        "must stand before the wall",
        lambda: RadiometricSetup(camera_angle_deg=95.0).resized((6, 9)).observe(scene()),
    ),
    ("distance_m is -0.3", lambda: RadiometricSetup(distance_m=-0.3).resized((6, 9)).observe(scene())),
    ("distance_m is nan", lambda: RadiometricSetup(distance_m=float("nan")).resized((6, 9)).observe(scene())),
    (
        "crosses the wall",
        lambda: RadiometricSetup(occluders_m=(((0, 0, -0.1), (0, 0.1, 0.1), (0.1, 0, 0.1)),)).occluders(),
    ),
    (
        "reaches z = 0.35 m and the target's plane at 0.3 m",
        lambda: (
            RadiometricSetup(occluders_m=(((-0.2, 0, 0.35), (-0.2, 0.1, 0.2), (-0.1, 0, 0.2)),))
            .resized((6, 9))
            .observe(scene())
        ),
    ),
    (
        r"hides the wall from \d+ % of the camera's pixels",
        lambda: (
            RadiometricSetup(
                occluders_m=(((0.1, -0.1, 0.2), (0.2, -0.1, 0.2), (0.2, 0.1, 0.2), (0.1, 0.1, 0.2)),)
            )
            .resized((6, 9))
            .observe(scene())
        ),
    ),
    (
        "needs 4 cells per side to show any shape: give at most 0.005 m",
        lambda: small(setup={}).setup.resized((6, 9)).observe(tiny_target()),
    ),
    ("cell_m is 0", lambda: RadiometricSetup(cell_m=0.0).resized((6, 9)).observe(scene())),
    ("strip_height_m is 0", lambda: RadiometricSetup(strip_m=(0.24, 0.0)).resized((6, 9)).observe(scene())),
    ("set strip_m to at least", lambda: RadiometricSetup(strip_m=(0.1, 0.08)).resized((6, 9)).observe(scene())),
    (
        "samples of 1e-06 m carry a field no farther than",
        lambda: PaperSetup(field_step_m=1e-6).resized((6, 9)).observe(scene()),
    ),
    ("pitch_m is 0", lambda: PaperSetup(pitch_m=0.0).resized((6, 9)).observe(scene())),
    ("perhaps you meant 'matte-near'", lambda: setup_preset("mate-near")),
    ("setup 'main-close' is unknown", lambda: setup_preset("main-close")),
    ("Lab.name", lambda: Lab(name="a/b")),
    ("duration_s is 0", lambda: Lab(duration_s=0.0)),
    ("needs two frames", lambda: Lab(duration_s=1.0, frame_rate_hz=0.5)),
    (
        "captures hold 8 bits",
        lambda: Lab(
            setup=dataclasses.replace(
                Lab().setup, frame_camera=dataclasses.replace(Lab().setup.frame_camera, bit_depth=12)
            )
        ),
    ),
    ("threshold_on", lambda: Lab(spread={"setup.pixel.threshold_on": (0.0, 0.2)})),
    ("treshold", lambda: Lab(spread={"setup.pixel.treshold_on": (0.1, 0.2)})),
    ("size_m", lambda: FontGlyphs(target_plane=dataclasses.replace(FontGlyphs().target_plane, size_m=0.0))),
]


def tiny_target() -> Scene:
    target_plane = dataclasses.replace(FontGlyphs().target_plane, size_m=0.02)
    return Scene(
        FontGlyphs(family="kalam", characters="A", target_plane=target_plane).target("kalam_A"),
        LineMotion(),
        8.0,
    )


@pytest.mark.parametrize(("match", "make"), BAD, ids=[match for match, _ in BAD])
def test_bad_setups(match, make):
    with pytest.raises(ConfigError, match=match):
        make()


def test_a_wrong_setup_writes_nothing(tmp_path):
    lab = small(setup={"camera_angle_deg": 80.0})
    with pytest.raises(ConfigError, match="does not see the wall"):
        render_captures(lab, tmp_path / "o")
    assert not (tmp_path / "o").exists()


def test_a_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "o" / "lab_A").mkdir(parents=True)
    with pytest.raises(DataError, match=r"without a capture.yaml"):
        render_captures(small(), tmp_path / "o")
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="is a file"):
        render_captures(small(), tmp_path / "file")


def test_a_pitch_at_the_limit_still_propagates():
    """Sixteen sampling limits: the band limit leaves a sixteenth of the frequencies, and energy is kept."""
    plane = Plane(64, 64, 1e-5)
    limit = 128 * 1e-10 / 500e-9
    scene_image = torch.zeros(64, 64, dtype=torch.float64)
    scene_image[16:48, 16:48] = 1.0
    assert float(Diffraction(plane, distance_m=15.9 * limit)(scene_image).max()) > 0
    with pytest.raises(ConfigError, match="raise the pitch"):
        Diffraction(plane, distance_m=16.1 * limit)


def test_settings_survive_a_file(tmp_path):
    lab = small(setup={"occluders_m": (((-0.14, 0.0, 0.2), (-0.1, 0.0, 0.2), (-0.1, 0.05, 0.2)),)})
    save_yaml(lab, tmp_path / "lab.yaml")
    assert load_yaml(Lab, tmp_path / "lab.yaml") == lab


def test_a_published_set_is_rendered_and_compared_with_its_checksums(tmp_path, capsys) -> None:
    """Bytes are those of one kind of processor; the number of events is the same to a hundredth everywhere."""
    words = ["lab", "--set", "near", "--glyphs.characters", "J", "--out", str(tmp_path)]
    main(words)
    shown = capsys.readouterr()
    same = "1 of them have the published SHA-256" in shown.out
    assert same or "near_J: " in shown.err
    folder = tmp_path / "near_J"
    capture = read_capture(folder)
    digest, events = read_yaml(PUBLISHED)["near"]["J"]
    assert abs(len(capture.events) - events) <= 0.01 * events and (content_digest(capture) == digest) == same
    assert compare_published("near", [folder]).keys() == (set() if same else {"near_J"})
    brighter = Image.fromarray(np.asarray(Image.open(folder / "frames" / "0003.png")) + np.uint8(1))
    brighter.save(folder / "frames" / "0003.png")
    assert compare_published("near", [folder]).keys() == {"near_J"}
    write_events(folder / "events.raw", capture.events[:1000])
    with pytest.raises(DataError, match="it is another capture"):
        compare_published("near", [folder])


def test_published_sets_are_listed_whole_and_state_all_settings(tmp_path) -> None:
    listed = read_yaml(PUBLISHED)
    for name, captures in listed.items():
        lab = published_lab(name)
        assert {one[-1] for one in lab.glyphs.objects()} == set(captures)
        assert all(len(digest) == 64 and events > 0 for digest, events in captures.values())
        with pytest.raises(ConfigError, match="states all settings"):
            published_lab(name, Lab(seed=1))
    with pytest.raises(ConfigError, match="near, far"):
        published_lab("middle")
    assert set(listed) == {"near", "far"}


@pytest.mark.parametrize("cover", [False, True])
def test_a_capture_of_several_targets_states_each_path_and_image(tmp_path, cover) -> None:
    back = LineMotion((0.07, 0.02), 0.018, (-1.0, -0.2))
    other = OtherTarget(FontGlyphs(family="kalam", characters="S"), back)
    lab = small(glyphs=FontGlyphs(family="kalam", characters="L"), others=(other,), cover=cover, spread={})
    lab = replace(lab, setup=replace(lab.setup, strip_m=(0.24, 0.14)))
    assert from_dict(Lab, read_yaml_of(lab, tmp_path)) == lab
    (folder,) = render_captures(lab, tmp_path / "lab")
    capture = read_capture(folder)
    several = capture.several
    assert several is not None and several.cover == cover
    first, second = several.scenes
    assert [one.target.name for one in (first, second)] == ["L", "S"]
    assert second.motion == back and first.motion == lab.motion
    exact = SeveralTargets(
        (
            Scene(lab.glyphs.target(lab.glyphs.objects()[0]), lab.motion),
            Scene(other.glyphs.target(other.glyphs.objects()[0]), back),
        ),
        cover,
    )
    light = lab.setup.observe_all(exact).irradiance(capture.frame_times_us * 1e-6).numpy()
    noise = capture.frames / 255 - light
    assert np.abs(noise.mean(axis=0)).mean() < 0.01 and noise.std() < 0.03
    alone = lab.setup.observe(first).irradiance(capture.frame_times_us * 1e-6).numpy()
    assert (capture.frames / 255 - alone).std() > 2 * noise.std()  # the other one is there
    sampling = Sampling()
    truth = capture_samples(capture, sampling).truth
    np.testing.assert_array_equal(truth, several.truth(sampling.canvas, capture.frame_times_us[1:] * 1e-6))


def read_yaml_of(lab: Lab, folder: Path) -> dict:
    """Return the settings of a lab as they stand in a file."""
    save_yaml(dataclasses.asdict(lab), folder / "lab.yaml")
    return read_yaml(folder / "lab.yaml")
