"""Frames of logarithmic pixels: codes and light, their noise, captures that hold them, the lab, calibration."""

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from evnlos import FrameCamera
from evnlos.analysis.bounds import SequenceAnalysisSettings, frame_information
from evnlos.calibration import fit_frame_noise
from evnlos.cameras import CelexCamera, EventPixel, FrameCameraSettings, LogCodes, LogFrameCamera
from evnlos.cli import main
from evnlos.config import config_hash, from_dict, load_yaml, read_yaml, to_dict
from evnlos.data import Sampling, SensorSize, Simulation, read_capture, simulate_object
from evnlos.data.capture_check import check_capture
from evnlos.data.capture_info import CameraInfo, CaptureInfo, begin_capture, read_capture_info
from evnlos.data.lab import Lab, render_captures
from evnlos.errors import ConfigError, DataError
from evnlos.events import write_celex_frames
from evnlos.inverse import handwritten_prior, sequence_light
from evnlos.scene import FontGlyphs
from evnlos.setups import RadiometricSetup
from evnlos.types import Plane

CLEAN = LogFrameCamera(600.0, 2048.0, 60.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CODES = CLEAN.codes
RAMP = np.linspace(0.02, 0.95, 12 * 16).reshape(12, 16)


def light_of(code: int, bits: int) -> float:
    """Return the light in the middle of what a code stands for: the slow reference."""
    fine = code if bits == 12 else 16 * code + 7.5
    return math.exp((fine - 2048.0) / 600.0) * 60.0 / 255.0


@pytest.mark.parametrize("bits", [8, 12])
def test_codes_become_the_light_in_the_middle_of_what_they_stand_for(bits: int) -> None:
    codes = np.arange(1 << bits).astype(np.uint8 if bits == 8 else np.uint16)
    expected = np.array([light_of(int(code), bits) for code in codes])
    np.testing.assert_allclose(CODES.light(codes), expected, rtol=1e-12)
    np.testing.assert_array_equal(CODES.levels(codes), np.rint(np.minimum(expected, 1.0) * 65_535))
    assert CODES.light(np.uint16(round(CODES.white_code))) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("bits", [8, 12])
def test_light_to_codes_and_back_is_off_by_half_a_step(bits: int) -> None:
    camera = replace(CLEAN, bit_depth=bits)
    light = np.geomspace(0.009, 0.99, 30 * 40).reshape(1, 30, 40)
    codes = camera.expose(light)
    assert codes.dtype == (np.uint8 if bits == 8 else np.uint16)
    half = 2.0 ** (12 - bits) / 2 / 600
    assert np.abs(np.log(CODES.light(codes) / light)).max() <= half + 1e-9
    levels = camera.linear_levels(codes) / camera.peak
    assert np.abs(levels / light - 1).max() <= math.expm1(half) + 0.5 / (65_535 * 0.009)


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("level", [0.0, 0.02, 0.1, 0.6])
def test_the_noise_of_linear_levels_is_as_stated(bits: int, level: float) -> None:
    camera = replace(CLEAN, bit_depth=bits, noise_codes=10.0)
    draw = np.random.default_rng(0)
    light = level * np.exp(draw.uniform(-0.02, 0.02, (200, 20, 20)))  # over more than a step of 8 bits
    seen = camera.linear_levels(camera.expose(light, seed=4)) / camera.peak
    stated = float(camera.noise_variance(torch.tensor(level, dtype=torch.float64)))
    if level == 0.0:  # read as the darkest code's light, which counts as noisy
        assert (seen < 0.009).all() and 0 < stated < 0.0003**2
        return
    assert (seen - light).std() == pytest.approx(math.sqrt(stated), rel=0.02)
    assert abs((seen / light - 1).mean()) < 1e-3
    assert float(camera.noise_variance(torch.tensor(level), frames=4)) == pytest.approx(stated / 4)


@pytest.mark.parametrize("level", [0.05, 0.5])
def test_the_fixed_pattern_of_linear_levels_is_as_stated(level: float) -> None:
    camera = LogFrameCamera(
        gain_mismatch=0.01, pattern_codes=15.0, row_codes=6.0, column_codes=4.0, noise_codes=0.0
    )
    seen = camera.linear_levels(camera.expose(np.full((1, 300, 400), level))) / camera.peak
    own, pattern = (f(torch.tensor(level)) for f in (camera.noise_variance, camera.pattern_variance))
    assert seen.std() == pytest.approx(math.sqrt(own + pattern), rel=0.03)
    both = camera.noise_variance(torch.tensor(level), fpn_corrected=False)
    assert float(both) == pytest.approx(float(own + pattern))


def test_it_is_the_frame_of_a_celex_camera_whose_pixels_are_quick() -> None:
    pixel = EventPixel(0.1, 0.1, 0.0, 0.0, 0.0, 0.0, logarithm="true", dark_dn=1e-9)
    celex, camera = CelexCamera(pixel, noise_codes=0.0), LogFrameCamera(noise_codes=0.0)
    still = np.repeat(255 * RAMP[None], 2, axis=0)
    found = celex.capture(still, [0.0, 1.0], [0.5], bits=12)
    np.testing.assert_array_equal(camera.expose(RAMP[None]), found)
    np.testing.assert_array_equal(camera.fixed_pattern((12, 16)), celex.pattern((12, 16)))
    assert celex.codes == camera.codes


def test_frames_are_a_function_of_seed_and_number() -> None:
    camera, light = LogFrameCamera(), np.repeat(RAMP[None], 3, axis=0)
    whole = camera.expose(light, seed=1)
    np.testing.assert_array_equal(whole[1:], camera.expose(light[1:], seed=1, first_frame=1))
    assert (whole[0] != whole[1]).any() and (whole != camera.expose(light, seed=2)).any()
    free = replace(camera, pattern_seed=None)
    assert (free.fixed_pattern((12, 16), 1)[1] != free.fixed_pattern((12, 16), 2)[1]).all()


def test_what_the_linear_camera_is_and_makes_stays() -> None:
    light = np.linspace(0, 1, 4 * 6 * 8).reshape(4, 6, 8)
    digest = hashlib.sha256(FrameCamera().expose(light, seed=3).tobytes()).hexdigest()[:16]
    assert digest == "2c2ff7d0152ba299"
    frames = CelexCamera().capture(255 * light, [0, 1, 2, 3.0], [0.5, 2.0], bits=12, seed=4)
    assert hashlib.sha256(frames.tobytes()).hexdigest()[:16] == "105827441f8c9697"
    assert config_hash(FrameCamera()) == "1595686d5e006715"
    assert "kind" not in to_dict(FrameCamera())
    assert FrameCamera().linear_levels(frames) is frames and FrameCamera(bit_depth=12).peak == 4095


def test_a_setup_carries_either_kind() -> None:
    whole = to_dict(Simulation())
    assert from_dict(Simulation, whole).frame_camera == FrameCamera()
    whole["setup"]["frame_camera"]["kind"] = "linear"
    assert config_hash(from_dict(Simulation, whole)) == config_hash(Simulation())
    whole["setup"]["frame_camera"] = {"kind": "log", "bit_depth": 8}
    found = from_dict(Simulation, whole)
    assert found.frame_camera == LogFrameCamera(bit_depth=8)
    assert from_dict(Simulation, to_dict(found)) == found
    assert list(FrameCameraSettings.registry) == ["linear", "log"]


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"kind": "logg"}, "there is no frame camera of kind 'logg'; did you mean 'log'"),
        ({"kind": "log", "full_well_e": 1e4}, "unknown setting setup.frame_camera.full_well_e"),
        ({"kind": "log", "bit_depth": 10}, "LogFrameCamera.bit_depth is 10; give 8 or 12 bits"),
        ({"kind": "log", "noise_codes": -1.0}, "noise_codes is -1; give 0 to 4096"),
        ({"kind": "log", "mid_code": 4000.0}, "white_code is 4868.15; give 1 to 4095"),
        ({"kind": "log", "pattern_seed": -1}, "seed"),
    ],
)
def test_wrong_log_cameras_are_refused(wrong: dict, text: str) -> None:
    whole = to_dict(Simulation())
    whole["setup"]["frame_camera"] = wrong
    with pytest.raises(ConfigError, match=text) as caught:
        from_dict(Simulation, whole)
    assert "\n" not in str(caught.value)


def simulation(camera: FrameCameraSettings) -> Simulation:
    setup = RadiometricSetup(sensor=SensorSize(30, 48), cell_m=0.005, frame_camera=camera)
    sampling = Sampling(height=15, width=24, pitch_m=0.01, scored_rows=15)
    return Simulation(
        glyphs=FontGlyphs(characters="A"), setup=setup, sampling=sampling, positions=4, duration_s=8.0
    )


def test_a_simulated_object_has_linear_frames() -> None:
    (name,) = simulation(CLEAN).glyphs.objects()
    perfect = FrameCamera(0.0, 1e9, 0.0, 0.0, 0.0, bit_depth=16)
    linear, found = (simulate_object(simulation(one), name)[0].frame for one in (perfect, CLEAN))
    np.testing.assert_allclose(found, linear, rtol=1 / 600, atol=2 / 65_535)


def test_bounds_hold_for_log_frames() -> None:
    """Twice the noise is a fourth of the information; what is clipped tells nothing."""
    asked = SequenceAnalysisSettings(positions=2, counts=(2,), cells=8)
    setup = simulation(replace(CLEAN, noise_codes=20.0)).setup
    prior = handwritten_prior(Plane(8, 8, 0.01), 8, 1)
    light = sequence_light(setup, prior, asked.motion.position_m, (0.0, asked.duration_s), (10, 16))
    z = np.zeros(8)

    def told(camera: FrameCameraSettings, **how) -> float:
        return float(
            np.trace(frame_information(light, z, replace(setup, frame_camera=camera), replace(asked, **how))[0])
        )

    whole = told(replace(CLEAN, noise_codes=20.0))
    assert told(replace(CLEAN, noise_codes=40.0)) == pytest.approx(whole / 4, rel=0.01)
    assert told(replace(CLEAN, noise_codes=20.0, pattern_codes=300.0), fpn_corrected=False) < whole
    bright = replace(CLEAN, noise_codes=20.0, mid_dn=0.5, mid_code=300.0)  # white light is 7 e-folds brighter
    assert not bright.shows(torch.tensor([1.0, 1e-9])).any() and bright.shows(torch.tensor(0.01))


def capture_of(folder: Path, frames: np.ndarray, how: str, **more) -> Path:
    """Write a capture of frames alone, in one of the forms that its frames may have."""
    folder.mkdir()
    camera = {"width": frames.shape[2], "height": frames.shape[1], "frame_rate_hz": 5.0, "log": to_dict(CODES)}
    if how == "bin":
        write_celex_frames(folder / "a_F_100M.bin", frames)
    elif how == "npy":
        np.save(folder / "a.npy", frames)
    else:
        (folder / "pictures").mkdir()
        rows = ["t_us,file"]
        for k, frame in enumerate(frames):
            Image.fromarray(frame).save(folder / f"pictures/{k:02d}.png")
            rows.append(f"{200_000 * k},pictures/{k:02d}.png")
        (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    named = {"bin": "a_F_100M.bin", "npy": "a.npy", "folder": "pictures", "table": "frames.csv"}[how]
    content = {"camera": camera, "events": None, "frames": named} | more
    (folder / "capture.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("how", ["table", "folder", "npy"])
def test_a_capture_of_log_frames_reads_as_linear_light(tmp_path: Path, how: str, bits: int) -> None:
    camera = replace(CLEAN, bit_depth=bits)
    light = RAMP * np.array([1.0, 0.7, 0.4])[:, None, None]
    found = read_capture(capture_of(tmp_path / "a", camera.expose(light), how), needs_events=False)
    assert found.frames.dtype == np.uint16 and found.peak == 65_535
    half = 2.0 ** (12 - bits) / 2 / 600
    off = np.abs(found.frames / 65_535 / light - 1)[light > 0.009]
    assert off.max() <= math.expm1(half) + 0.5 / (65_535 * 0.009)
    assert "log frames made linear: 600 codes per e-fold, 2916.15 white" in found.notes


def test_frames_of_mode_f_read_as_linear_light(tmp_path: Path) -> None:
    light = np.linspace(0.01, 0.9, 800)[:, None] * np.ones((2, 1, 1280))
    frames = replace(CLEAN, bit_depth=8).expose(light)
    folder = capture_of(tmp_path / "a", frames, "bin", every=1)
    found = read_capture(folder, needs_events=False)
    np.testing.assert_array_equal(found.frames, CODES.levels(frames))
    assert "response" not in [one.what for one in check_capture(found)]
    plain = yaml.safe_load((folder / "capture.yaml").read_text())
    del plain["camera"]["log"]
    (folder / "capture.yaml").write_text(yaml.safe_dump(plain))
    (bad,) = [one for one in check_capture(read_capture(folder, needs_events=False)) if one.what == "response"]
    assert bad.level == "bad" and "state camera: {log: {codes_per_efold: 600" in bad.cure


def test_a_flat_field_of_log_frames_takes_their_pattern_off(tmp_path: Path) -> None:
    camera = replace(CLEAN, pattern_codes=100.0)
    light = np.repeat(RAMP[None] * 0.6, 2, axis=0)
    folder = capture_of(tmp_path / "a", camera.expose(light), "table", flat="flat.png")
    Image.fromarray(camera.expose(np.full((1, 12, 16), 0.4))[0]).save(folder / "flat.png")
    found = read_capture(folder, needs_events=False).frames / 65_535
    ratio = found / light
    assert (
        ratio.std() / ratio.mean()
        < 0.002
        < 0.1
        < (camera.linear_levels(camera.expose(light)) / light).std() / 65_535
    )


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"camera": {"log": {"codes_per_efold": 1.0, "white_code": 2916.0}}},
            "codes_per_efold is 1; give 10 to",
        ),
        (
            {"camera": {"log": {"codes_per_efold": 600.0, "white_code": 5000.0}}},
            "white_code is 5000; give 1 to 4095",
        ),
        (
            {"camera": {"log": {"codes_per_efold": 600.0, "white": 2916.0}}},
            "camera.log.white; perhaps you meant 'white_code'",
        ),
        ({"camera": {"mosaic": "rggb"}}, "camera.mosaic is rggb, and camera.log is of grey codes; leave one"),
        ({"camera": {"colour": "red"}}, "camera.colour is red, and camera.log"),
        ({"camera": {"white_dn": 4095}}, "camera.white_dn is 4095, and camera.log"),
        ({"dark": "pictures/00.png"}, "dark is pictures/00.png, and camera.log"),
    ],
)
def test_wrong_descriptions_are_refused_in_a_line(tmp_path: Path, changes: dict, text: str) -> None:
    folder = capture_of(tmp_path / "a", CLEAN.expose(RAMP[None]), "table")
    content = yaml.safe_load((folder / "capture.yaml").read_text())
    content["camera"] |= changes.get("camera", {})
    content |= {key: value for key, value in changes.items() if key != "camera"}
    (folder / "capture.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=text) as caught:
        read_capture(folder, needs_events=False)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_scaled_codes_are_refused(tmp_path: Path) -> None:
    folder = capture_of(tmp_path / "a", CLEAN.expose(RAMP[None]) * np.uint16(16), "table")
    with pytest.raises(
        DataError, match=r"a: a log frame holds the code \d{5}; codes of 12 bits end at 4095: save"
    ):
        read_capture(folder, needs_events=False)


def test_a_new_capture_of_a_celex_v_states_its_codes(tmp_path: Path) -> None:
    begin_capture(tmp_path / "celex", 1280, 800, "CelePixel CeleX-V")
    stated = read_capture_info(tmp_path / "celex").camera.log
    assert stated is not None
    assert stated == LogCodes(CODES.codes_per_efold, round(CODES.white_code))
    begin_capture(tmp_path / "other", 640, 480)
    assert read_capture_info(tmp_path / "other").camera.log is None
    assert CaptureInfo(CameraInfo(8, 8, log=CODES)).in_colour(None).camera.log == CODES


def lab(bits: int) -> Lab:
    camera = LogFrameCamera(bit_depth=bits)
    setup = replace(Lab().setup, sensor=SensorSize(20, 32), frame_camera=camera)
    return Lab(glyphs=FontGlyphs(characters="A"), duration_s=1.0, setup=setup)


@pytest.mark.parametrize("bits", [8, 12])
def test_the_lab_renders_log_frames(tmp_path: Path, bits: int) -> None:
    (folder,) = render_captures(lab(bits), tmp_path)
    record = read_yaml(tmp_path / "lab.yaml")
    drawn = record["drawn"]["frame_camera"]
    assert drawn["kind"] == record["lab"]["setup"]["frame_camera"]["kind"] == "log"
    assert drawn["noise_codes"] == 10.0 and record["drawn"]["pixel"]["threshold_on"] != 0.21
    with Image.open(folder / "frames/0000.png") as image:
        assert image.mode == {8: "L", 12: "I;16"}[bits]
    assert read_yaml(folder / "capture.yaml")["camera"]["log"] == to_dict(CODES)
    assert render_captures(lab(bits), tmp_path) == [folder]  # begun with the same settings
    seen, pattern = read_capture(folder).frames[0], from_dict(LogFrameCamera, drawn).fixed_pattern((20, 32))[1]
    rough = [np.diff(np.diff(one, axis=0), axis=1).ravel() for one in (600 * np.log(seen), pattern)]
    assert np.dot(*rough) > 0.95 * np.linalg.norm(rough[0]) * np.linalg.norm(rough[1])


def test_labs_of_other_depths_and_colours_are_refused() -> None:
    with pytest.raises(ConfigError, match="palette or mosaic, and frames of kind log are grey"):
        replace(lab(8), palette=("ff0000",))
    with pytest.raises(ConfigError, match="bit_depth is 12; captures hold 8 bits"):
        replace(lab(8), setup=replace(lab(8).setup, frame_camera=FrameCamera(bit_depth=12)))
    with pytest.raises(ConfigError, match=r"vary\.setup\.frame_camera\.prnu"):
        replace(lab(8), spread={"setup.frame_camera.prnu": (0.1, 0.2)})


def test_a_flag_chooses_the_kind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = "--setup.frame-camera.kind log --setup.frame-camera.noise-codes 5 --setup.sensor.height 12"
    words = f"lab {flags} --setup.sensor.width 16 --glyphs.characters A --duration-s 1 --out {tmp_path / 'l'}"
    main(words.split())
    camera = load_yaml(Lab, write_lab(tmp_path)).setup.frame_camera
    assert camera == LogFrameCamera(noise_codes=5.0)
    capsys.readouterr()


def write_lab(folder: Path) -> Path:
    path = folder / "alone.yaml"
    path.write_text(yaml.safe_dump(read_yaml(folder / "l" / "lab.yaml")["lab"]))
    return path


@pytest.mark.parametrize("bits", [8, 12])
def test_calibration_finds_noise_and_pattern(bits: int) -> None:
    rng = np.random.default_rng(0)
    camera = LogFrameCamera(gain_mismatch=0.0, row_codes=0.0, column_codes=0.0, bit_depth=bits)
    ramp = np.linspace(0.0, 0.5, 60)[None, :] * np.ones((40, 1))
    light = 0.05 + ramp * rng.permutation(np.linspace(0, 1, 150))[:, None, None]
    frames = camera.linear_levels(camera.expose(light, seed=3))
    about = type("I", (), {"camera": CameraInfo(60, 40, log=camera.codes)})

    class OneShot:
        peak = 65_535
        captures = (type("C", (), {"info": about}),)

        def frames(self):
            return frames

        def frame_of(self):
            return np.zeros(150, np.int64)

    found = fit_frame_noise(OneShot(), light.astype(np.float32), FrameCamera())  # type: ignore[arg-type]
    fitted = found.camera
    assert isinstance(fitted, LogFrameCamera) and fitted.bit_depth == bits
    assert fitted.noise_codes == pytest.approx(10.0, rel=0.05)
    assert fitted.pattern_codes == pytest.approx(100.0, rel=0.1)
    assert fitted.codes == camera.codes and found.remaining["pattern_codes"] < 10.0
    corrected = found.pattern.correct(frames, 65_535)
    assert (corrected / light - 1).std() < 1.3 * camera.relative_noise < (frames / 65_535 / light - 1).std() / 3
