"""Frames and events in colour: filters on pixels, one colour of a capture, a coloured lab, its pictures."""

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
from evnlos.cameras import EventPixel, colour_filters, mosaicked, of_mosaic
from evnlos.cli import main
from evnlos.config import from_dict, save_yaml, to_dict
from evnlos.data import CaptureInfo
from evnlos.data.capture_check import check_capture
from evnlos.data.fixed_pattern import used_pixels
from evnlos.data.frames import own_pixels
from evnlos.data.lab import Lab, render_captures
from evnlos.errors import ConfigError, DataError
from evnlos.scene import FontGlyphs
from evnlos.types import COLOURS, LUMA_601, Events, Mosaic

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
        main(["invert", str(coloured["grey"]), *words[:2], "--colours", "--from", "frames", "--samples", "3"])
    assert "--colours takes captures with a --setup; leave --samples" in capsys.readouterr().err


QUIET = EventPixel(0.1, 0.1, 0.0, 0.0, 0.0, 0.0, initial_phase="rest", logarithm="true")


def event_lab(name: str, **changes) -> Lab:
    """Return a lab without noise of an event, whose instants do not depend on what is seen."""
    lab = lab_of()
    setup = replace(lab.setup, pixel=QUIET, ambient=0.1, gain=1.0, cell_m=0.01, time_step_s=0.02)
    setup = replace(setup, frame_camera=FrameCamera(exposure_s=0.016, full_well_e=1e5, read_noise_e=100.0))
    setup = replace(setup, sensor=replace(setup.sensor, height=36, width=54))
    given = {"name": name, "setup": setup, "mosaic": "grbg", "event_mosaic": "bggr", "duration_s": 8.0}
    return replace(lab, **{**given, **changes})


@pytest.fixture(scope="module")
def filtered(tmp_path_factory) -> dict[str, Path]:
    """Return captures of a letter before a grey event camera and one with filters, and their setup."""
    out = tmp_path_factory.mktemp("filtered")
    labs = {
        "grey": event_lab("grey", mosaic=None, event_mosaic=None),
        "white": event_lab("white"),
        "bands": event_lab("bands", palette=("ff0000", "0000ff")),
    }
    made = {name: render_captures(lab, out, record=f"{name}.yaml")[0] for name, lab in labs.items()}
    save_yaml(to_dict(labs["grey"].setup), out / "setup.yaml")
    return {**made, "setup": out / "setup.yaml"}


def of_pixels(events: Events, own: np.ndarray) -> np.ndarray:
    """Return instants, places and signs of the events of some pixels, [N, 4]."""
    kept = own[events.y, events.x]
    return np.stack([events.t_us, events.y, events.x, events.p], axis=1)[kept]


def test_an_event_pixel_sees_the_light_of_its_filter(filtered, tmp_path):
    """As on a sensor whose every pixel has this filter; nothing green moves, so that green says nothing."""
    lab = event_lab("one", palette=("ff0000", "0000ff"), mosaic=None, event_mosaic=None)
    seen, scene = read_capture(filtered["bands"]), lab.glyphs.objects()[0]
    assert seen.info.camera.event_mosaic == "bggr" and seen.info.camera.white_balance == lab.white_balance
    filters = colour_filters("bggr", (36, 54))
    white = np.array(lab.white_balance) / (WEIGHTS @ lab.white_balance)
    assert not len(of_pixels(seen.events, filters[1]))
    for k, length_m in ((0, 650e-9), (2, 450e-9)):
        shown = tuple(("ffffff" if int(one[2 * k : 2 * k + 2], 16) else "000000") for one in lab.palette)
        setup = replace(
            lab.setup, gain=white[k] * lab.setup.gain, ambient=white[k] * 0.1, wavelength_m=length_m
        )
        alone = replace(lab, setup=setup, palette=shown)
        whole = read_capture(render_captures(alone, tmp_path / COLOURS[k], [scene])[0]).events
        found, expected = of_pixels(seen.events, filters[k]), of_pixels(whole, filters[k])
        assert found.shape == expected.shape and len(found) > 100
        assert np.abs(found - expected).max() <= 1


def test_a_filter_changes_no_contrast(tmp_path):
    """A true logarithm knows no scale: a white letter on a wall without colour sends a grey camera's events."""
    setup = replace(event_lab("wall").setup, wall_material="lambert", distance_m=0.1)
    told = []
    for event_mosaic in (None, "rggb"):
        lab = event_lab("wall", setup=setup, mosaic=None, event_mosaic=event_mosaic)
        events = read_capture(render_captures(lab, tmp_path / str(event_mosaic))[0]).events
        told.append(of_pixels(events, np.ones((36, 54), bool)))
    order = [np.lexsort((one[:, 0], one[:, 2], one[:, 1])) for one in told]
    grey, behind = (one[by] for one, by in zip(told, order, strict=True))
    assert grey.shape == behind.shape and len(grey) > 1000
    assert (grey[:, 1:] == behind[:, 1:]).all() and np.abs(grey[:, 0] - behind[:, 0]).max() < 2000


def test_filters_are_those_of_the_pixels_that_are_used():
    """A region that begins at an odd row and every third pixel: as where each pixel sends its own number."""
    height, width = 14, 20
    roi = {"x": 3, "y": 1, "width": 15, "height": 12}
    said = {"camera": {"width": width, "height": height, "event_mosaic": "gbrg"}, "roi": roi}
    y, x = (one.ravel().astype(np.uint16) for one in np.mgrid[0:height, 0:width])
    events = Events(np.arange(height * width), x, y, np.ones(height * width, bool), width, height)
    filters = colour_filters("gbrg", (height, width)).reshape(3, -1)
    for every in (1, 3):
        info = from_dict(CaptureInfo, {**said, "every": every}, source="test")
        used, _, _ = used_pixels(info, events, np.zeros((1, height, width), np.uint8))
        for k, colour in enumerate(COLOURS):
            own = own_pixels(info, colour, "events")
            assert own.shape == used.shape
            np.testing.assert_array_equal(own[used.y, used.x], filters[k][used.t_us])
            assert own_pixels(info, colour, "frames").all()
    with pytest.raises(ConfigError, match=r"no pixel for .* state an odd `every`"):
        for colour in COLOURS:
            own_pixels(from_dict(CaptureInfo, {**said, "every": 2}, source="test"), colour, "events")


def test_events_give_a_picture_in_colour(filtered, tmp_path, capsys):
    words = ["--setup", str(filtered["setup"]), "--json", "--force", "--out", str(tmp_path / "found.png")]
    rows, images = {}, {}
    for name, evidence in (("grey", "events"), ("white", "events"), ("bands", "events"), ("bands", "both")):
        colours = [] if name == "grey" else ["--colours"]
        main(["invert", str(filtered[name]), *words, "--from", evidence, *colours])
        rows[name, evidence] = json.loads(capsys.readouterr().out)["rows"][0]
        images[name, evidence] = np.load(tmp_path / "found.npz")[filtered[name].name]
    for key in (("bands", "events"), ("bands", "both")):
        red, green, blue = images[key]
        upper, lower = slice(3, 14), slice(18, 29)
        assert red[upper].mean() > 10 * abs(blue[upper].mean())
        assert blue[lower].mean() > 10 * abs(red[lower].mean())
        assert abs(green).mean() < 0.5 * red.mean()  # in silence, or below the frames' noise
        assert rows[key]["psnr_db"] > rows["grey", "events"]["psnr_db"]
    grey, white = images["grey", "events"], images["white", "events"]
    for one in white:
        assert np.sqrt(np.mean((one - grey) ** 2)) < 0.1
    row = rows["white", "events"]
    np.testing.assert_allclose(row["level"], np.mean(row["level"]), rtol=0.03)  # white is white
    assert row["psnr_db"] > rows["grey", "events"]["psnr_db"] - 2


def test_what_is_of_no_colour_is_refused(filtered, coloured, tmp_path, capsys):
    words = ["--setup", str(filtered["setup"]), "--colours", "--out", str(tmp_path / "found.png")]
    for folder, evidence, told in (
        (filtered["grey"], "events", "its events are grey"),
        (filtered["grey"], "both", "its frames are grey"),
        (coloured["bands"], "both", "its events are grey"),
    ):
        with pytest.raises(SystemExit):
            main(["invert", str(folder), *words, "--from", evidence])
        assert told in capsys.readouterr().err
    for camera, told in (("event_mosaic", "rgbg"), ("event_mosaic", "rggb")):
        said = {"camera": {"width": 8, "height": 6, camera: told}, "events": None}
        with pytest.raises(ConfigError, match="event_mosaic"):
            from_dict(CaptureInfo, said, source="test")
