"""Frames in colour: filters on the pixels, one colour of a capture, a coloured lab, pictures in colour."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml
from PIL import Image

from evnlos import FrameCamera, read_capture
from evnlos.cameras import colour_filters, mosaicked, of_mosaic
from evnlos.cli import main
from evnlos.config import save_yaml, to_dict
from evnlos.data.capture_check import check_capture
from evnlos.data.lab import Lab, render_captures
from evnlos.errors import ConfigError, DataError
from evnlos.scene import FontGlyphs
from evnlos.types import COLOURS, LUMA_601, Mosaic

MOSAICS = get_args(Mosaic)
WEIGHTS = np.array(LUMA_601) / 1000


def bilinear(raw: np.ndarray, mosaic: Mosaic, colour: int) -> np.ndarray:
    """Return one colour at every pixel: its own, or the mean of the nearest that see it; mirrored."""
    height, width = raw.shape
    mirrored = lambda at, side: -at if at < 0 else 2 * side - 2 - at if at >= side else at  # noqa: E731
    seen = colour_filters(mosaic, raw.shape)[colour]
    out = np.zeros(raw.shape)
    for row in range(height):
        for column in range(width):
            near = [(row, column)]
            for distance in (1, 2):  # squared: neighbours beside it, then those at its corners
                if not any(seen[at] for at in near):
                    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i * i + j * j == distance]
                    near = [(mirrored(row + i, height), mirrored(column + j, width)) for i, j in steps]
            out[row, column] = np.mean([float(raw[at]) for at in near if seen[at]])
    return out


@pytest.mark.parametrize("mosaic", MOSAICS)
def test_a_colour_of_a_mosaic_is_what_its_definition_says(mosaic):
    raw = np.random.default_rng(1).integers(0, 65_536, (2, 5, 8)).astype(np.uint16)
    slow = np.array([[bilinear(one, mosaic, k) for one in raw] for k in range(3)])
    for k, colour in enumerate(COLOURS):
        np.testing.assert_allclose(of_mosaic(raw, mosaic, colour), slow[k], atol=0.51)
    raw = np.minimum(raw, 65_534)
    np.testing.assert_allclose(of_mosaic(raw, mosaic), np.tensordot(WEIGHTS, slow, 1), atol=1.52)
    raw[1, 2, 3] = 65_535  # a clipped pixel stays clipped, of whatever colour it is
    assert of_mosaic(raw, mosaic)[1, 2, 3] == 65_535 and (of_mosaic(raw, mosaic) == 65_535).sum() == 1


@pytest.mark.parametrize("mosaic", MOSAICS)
def test_pixels_keep_what_they_saw_and_even_colours_come_back(mosaic):
    pictures = np.random.default_rng(2).integers(0, 256, (3, 6, 7, 3)).astype(np.uint8)
    raw = mosaicked(pictures, mosaic)
    assert raw.shape == pictures.shape[:-1] and raw.dtype == np.uint8
    filters = colour_filters(mosaic, (6, 7))
    assert filters.sum(axis=0).min() == filters.sum(axis=0).max() == 1  # each pixel has one filter
    for k, colour in enumerate(COLOURS):
        np.testing.assert_array_equal(raw[:, filters[k]], pictures[..., k][:, filters[k]])
        np.testing.assert_array_equal(
            of_mosaic(raw, mosaic, colour)[:, filters[k]], 257 * raw[:, filters[k]].astype(int)
        )
    even = mosaicked(np.broadcast_to(np.array([200, 50, 9], np.uint8), (4, 4, 3)), mosaic)
    assert [int(of_mosaic(even, mosaic, one)[1, 2]) // 257 for one in COLOURS] == [200, 50, 9]
    with pytest.raises(DataError, match="1 x 4 pixels; give 2 x 2"):
        of_mosaic(even[:1], mosaic)


def recording(folder: Path, frames: list[Image.Image], frames_in: str, **camera) -> Path:
    """Write a capture of a frame camera alone, its frames as a table, a folder or an array."""
    folder.mkdir()
    (folder / "frames").mkdir()
    rows = ["t_us,file"]
    for k, image in enumerate(frames):
        image.save(folder / f"frames/{k}.png")
        rows.append(f"{200_000 * k},frames/{k}.png")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    np.save(folder / "frames.npy", np.stack([np.asarray(one) for one in frames]))
    said = {"width": frames[0].width, "height": frames[0].height, "frame_rate_hz": 5.0, **camera}
    content = {
        "camera": said,
        "events": None,
        "frames": frames_in,
        "target": {"name": "A", "mask": "target.png"},
    }
    (folder / "capture.yaml").write_text(yaml.safe_dump(content))
    Image.fromarray(np.tile(np.array([255, 0, 51], np.uint8), (4, 4, 1))).save(folder / "target.png")
    return folder


@pytest.mark.parametrize("frames", ["frames.csv", "frames", "frames.npy"])
def test_a_capture_is_read_in_one_colour(tmp_path, frames):
    numbers = np.random.default_rng(3).integers(0, 256, (4, 6, 8, 3)).astype(np.uint8)
    folder = recording(tmp_path / "shot_A", [Image.fromarray(one) for one in numbers], frames)
    grey = read_capture(folder, needs_events=False)
    white = float(grey.peak)
    np.testing.assert_allclose(grey.frames / white, numbers @ WEIGHTS / 255, atol=0.7 / 255)
    assert grey.target is not None and grey.target.mask[0, 0] == pytest.approx(WEIGHTS @ [1, 0, 0.2], abs=3e-3)
    for k, (colour, shown) in enumerate(zip(COLOURS, (1.0, 0.0, 0.2), strict=True)):
        one = read_capture(folder, needs_events=False, colour=colour)
        np.testing.assert_allclose(one.frames / white, numbers[..., k] / 255, atol=1e-4)
        assert one.target is not None and one.target.mask[0, 0] == pytest.approx(shown)
    said = yaml.safe_load((folder / "capture.yaml").read_text())
    said["camera"]["colour"] = "blue"
    (folder / "capture.yaml").write_text(yaml.safe_dump(said))
    np.testing.assert_array_equal(read_capture(folder, needs_events=False).frames, one.frames)


@pytest.mark.parametrize("frames", ["frames.csv", "frames", "frames.npy"])
def test_raw_values_behind_a_mosaic_are_read_in_one_colour(tmp_path, frames):
    raw = np.random.default_rng(4).integers(0, 256, (3, 6, 8)).astype(np.uint8)
    shots = [Image.fromarray(one) for one in raw]
    folder = recording(tmp_path / "shot_A", shots, frames, mosaic="grbg")
    Image.new("L", (8, 6), 10).save(folder / "dark.png")
    for colour in (None, *COLOURS):
        found = read_capture(folder, needs_events=False, colour=colour).frames
        np.testing.assert_allclose(found, of_mosaic(raw, "grbg", colour), atol=1)
    said = yaml.safe_load((folder / "capture.yaml").read_text()) | {"dark": "dark.png"}
    (folder / "capture.yaml").write_text(yaml.safe_dump(said))
    found = read_capture(folder, needs_events=False, colour="green").frames / 65_535
    expected = np.clip((of_mosaic(raw, "grbg", "green") - 10 * 257.0) / (65_535 - 10 * 257), 0, 1)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_filters_that_nobody_stated_are_told(coloured, tmp_path):
    """Raw values that are taken for grey draw a chequered wall; other captures raise no alarm."""
    folder = tmp_path / "raw_E"
    shutil.copytree(coloured["mosaic"], folder)
    said = yaml.safe_load((folder / "capture.yaml").read_text())
    for stated in (None, "rggb"):
        said["camera"]["mosaic"] = stated
        (folder / "capture.yaml").write_text(yaml.safe_dump(said))
        found = [one for one in check_capture(read_capture(folder)) if one.what == "colour filters"]
        assert [(one.level, "camera.mosaic" in one.cure) for one in found] == (
            [] if stated else [("bad", True)]
        )
    for name in ("grey", "bands"):
        assert all(one.what != "colour filters" for one in check_capture(read_capture(coloured[name])))


def test_bad_words_about_colour_are_refused(tmp_path):
    shots = [Image.new("RGB", (8, 6), (k, 20, 30)) for k in (10, 12)]
    for key, value, told in (
        ("mosaic", "rgbg", "mosaic"),
        ("colour", "yellow", "colour"),
        ("white_balance", [1.0, 0.0, 1.0], "three numbers above 0"),
    ):
        folder = recording(tmp_path / f"{key}_A", shots, "frames.csv", **{key: value})
        with pytest.raises(ConfigError, match=told):
            read_capture(folder, needs_events=False)
    folder = recording(tmp_path / "events_A", shots, "events.aedat4", colour="red")
    (folder / "events.aedat4").write_bytes(b"#!AER-DAT4.0\r\n")
    with pytest.raises(DataError, match="read as grey; save them as images"):
        read_capture(folder, needs_events=False)
    folder = recording(tmp_path / "whole_A", shots, "frames.csv", mosaic="rggb")
    with pytest.raises(DataError, match="holds whole colours, no raw values"):
        read_capture(folder, needs_events=False)
    for change, told in (
        ({"palette": ("red",)}, "six hexadecimal digits"),
        ({"white_balance": (1.0, -1.0, 1.0)}, "three numbers above 0"),
    ):
        with pytest.raises(ConfigError, match=told):
            Lab(**change)


def lab_of(**changes) -> Lab:
    """Return a lab without noise of a frame, whose captures take a second."""
    camera = FrameCamera(exposure_s=0.016, full_well_e=1e7, read_noise_e=0.0, prnu=0.0, dsnu_e=0.0)
    setup = replace(Lab().setup, cell_m=0.005, ambient=0.06, ambient_gradient=(0.0, 0.0), frame_camera=camera)
    setup = replace(setup, sensor=replace(setup.sensor, height=72, width=108))
    glyphs = FontGlyphs(family="kalam", characters="E")
    return Lab(**{"name": "in", "glyphs": glyphs, "frame_rate_hz": 3.0, "setup": setup, "spread": {}} | changes)


@pytest.fixture(scope="module")
def coloured(tmp_path_factory) -> dict[str, Path]:
    """Return captures of one letter: grey, red over blue, and white behind a mosaic; and their setup."""
    out = tmp_path_factory.mktemp("coloured")
    labs = {
        "grey": lab_of(),
        "bands": lab_of(palette=("ff0000", "0000ff")),
        "mosaic": lab_of(mosaic="rggb", white_balance=(0.7, 1.0, 0.5)),
    }
    made = {name: render_captures(lab, out / name)[0] for name, lab in labs.items()}
    save_yaml(to_dict(lab_of().setup), out / "setup.yaml")
    return {**made, "setup": out / "setup.yaml"}


def test_the_lab_renders_what_a_coloured_camera_sees(coloured):
    """White behind a mosaic is grey to the eye; of two bands red has the upper half, blue the lower."""
    grey = read_capture(coloured["grey"])
    behind = {one: read_capture(coloured["mosaic"], colour=one) for one in COLOURS}
    balance = np.array([one.info.camera.balance for one in behind.values()])
    assert WEIGHTS @ balance == pytest.approx(1.0) and balance[2] / balance[1] == pytest.approx(0.5)
    for one in behind.values():
        level = one.frames / (one.peak * one.info.camera.balance)
        np.testing.assert_allclose(level, grey.frames / 255, atol=0.02)  # n and k of the metal differ by colour
    red, green, blue = (read_capture(coloured["bands"], colour=one) for one in COLOURS)
    assert (
        red.target is not None
        and blue.target is not None
        and green.target is not None
        and grey.target is not None
    )
    half = len(grey.target.mask) // 2
    np.testing.assert_allclose(red.target.mask[:half], grey.target.mask[:half], atol=0.01)
    assert (
        not red.target.mask[half:].any() and not blue.target.mask[:half].any() and not green.target.mask.any()
    )
    still = green.frames.astype(float)  # nothing green moves
    assert np.ptp(still, axis=0).max() <= 2 < np.ptp(red.frames.astype(float), axis=0).max()
    assert len(read_capture(coloured["bands"]).events) > 0


def test_a_picture_in_colour(coloured, tmp_path, capsys):
    words = ["--setup", str(coloured["setup"]), "--solver", "tikhonov", "--cells", "12", "--json", "--force"]
    out = tmp_path / "found.png"
    main(["invert", str(coloured["bands"]), *words, "--colours", "--out", str(out)])
    told = json.loads(capsys.readouterr().out)
    image = np.load(out.with_suffix(".npz"))["in_E_tikhonov_24"]  # [3, 12, 12]
    upper, lower = image[:, 1:5].mean(axis=(1, 2)), image[:, 7:11].mean(axis=(1, 2))
    assert upper[0] - upper[2] > 0.1 and lower[2] - lower[0] > 0.1
    assert abs(image[1]).max() < 0.2 * image.max()
    main(["invert", str(coloured["grey"]), *words, "--out", str(out)])
    alone = json.loads(capsys.readouterr().out)["rows"][0]["psnr_db"]
    assert told["rows"][0]["psnr_db"] > alone  # two thirds of its colours are dark
    main(["invert", str(coloured["mosaic"]), *words, "--colours", "--out", str(out)])
    behind = json.loads(capsys.readouterr().out)["rows"][0]
    assert alone - 3 < behind["psnr_db"] < alone  # red and blue have a quarter of the pixels each
    np.testing.assert_allclose(behind["level"], np.mean(behind["level"]), rtol=0.05)  # white is white
    for given, told in (
        ([str(coloured["grey"])], "its frames are grey; leave it or --colours"),
        ([str(coloured["bands"]), "--track"], "--colours needs a motion that is known"),
    ):
        with pytest.raises(SystemExit):
            main(["invert", *given, *words, "--colours", "--out", str(tmp_path / "wrong.png")])
        assert told in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["invert", str(coloured["grey"]), *words[:2], "--colours", "--from", "frames"])
    assert "--colours takes captures, by the solvers" in capsys.readouterr().err
