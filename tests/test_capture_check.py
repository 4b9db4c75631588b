"""The protocol for the lab: a folder that explains itself, and faults that are named with their cure."""

import contextlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evnlos.cli import main
from evnlos.data import CaptureInfo, SensorSize, open_dataset, read_capture, read_shard
from evnlos.data.capture_check import Finding, check_capture, clock_offset, compare_clocks
from evnlos.data.capture_info import (
    CAMERAS,
    AlignmentInfo,
    CameraInfo,
    FilterInfo,
    begin_capture,
    read_capture_info,
)
from evnlos.data.clocks import expected_counts
from evnlos.data.frames import clipped_at, from_start
from evnlos.data.lab import Lab, render_captures
from evnlos.errors import ConfigError, DataError
from evnlos.scene import FontGlyphs
from evnlos.setups import RadiometricSetup
from evnlos.training import Training, train
from evnlos.types import Events


@pytest.fixture(scope="module")
def capture(tiny_captures):
    return read_capture(tiny_captures[0])


def levels(capture) -> dict[str, str]:
    return {one.what: one.level for one in check_capture(capture)}


def cures(capture) -> dict[str, str]:
    return {one.what: one.cure for one in check_capture(capture)}


def test_a_good_shot_is_called_good(capture) -> None:
    found = check_capture(capture)
    assert {one.what for one in found if one.level != "good"} == set()
    assert all(one.cure == "" for one in found)


def test_light_that_is_wrong_is_named(capture) -> None:
    bright = replace(capture, frames=np.maximum(capture.frames, 255).astype(np.uint8))
    assert levels(bright)["saturation"] == "bad" and "exposure" in cures(bright)["saturation"]
    top = int(np.percentile(capture.frames, 98))  # a sensor that saturates below the white of its files
    early = next(
        one
        for one in check_capture(replace(capture, frames=capture.frames.clip(max=top)))
        if one.level != "good"
    )
    assert early.what == "saturation" and early.found.endswith(f"clipped at {top}")
    assert clipped_at(capture.frames, 255) == clipped_at(bright.frames, 255) == 255
    dim = replace(capture, frames=(capture.frames // 100).astype(np.uint8))
    assert levels(dim)["brightness"] == "bad" and "lengthen" in cures(dim)["brightness"]


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_bits_that_were_not_scaled_are_named_and_the_line_mends_it(tiny_captures, tmp_path, bits) -> None:
    folder, white = tmp_path / "one", (1 << bits) - 1
    shutil.copytree(tiny_captures[0], folder)
    for path in (folder / "frames").glob("*.png"):
        levels_16 = np.round(np.asarray(Image.open(path)) * (white / 255)).astype(np.uint16)
        Image.fromarray(levels_16).save(path)
    found = {one.what: one for one in check_capture(read_capture(folder))}["white level"]
    assert found.level == "doubtful" and f"{bits} bits" in found.found and f"white_dn: {white}}}" in found.cure
    text = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text(text.replace("camera:\n", f"camera:\n  white_dn: {white}\n", 1))
    mended, before = read_capture(folder), read_capture(tiny_captures[0])
    assert "white level" not in levels(mended)
    np.testing.assert_allclose(mended.frames / mended.peak, before.frames / before.peak, atol=1 / white)
    assert any(str(white) in note for note in mended.notes)


def test_a_white_level_needs_frames_of_16_bits(tiny_captures, tmp_path, capture) -> None:
    shutil.copytree(tiny_captures[0], tmp_path / "one")
    path = tmp_path / "one" / "capture.yaml"
    path.write_text(path.read_text().replace("camera:\n", "camera:\n  white_dn: 4095\n", 1))
    with pytest.raises(DataError, match=r"white_dn is 4095, and frames have 8 bits"):
        read_capture(tmp_path / "one")
    with pytest.raises(ConfigError, match="256 to 65535"):
        CameraInfo(8, 8, white_dn=255)
    scaled = replace(capture, frames=capture.frames.astype(np.uint16) * 16)
    assert "white level" not in levels(scaled)  # 12 bits that a camera scaled, of a dim wall


def test_a_target_that_did_not_move_is_named(capture) -> None:
    draw = np.random.default_rng(0)
    still = (100 + 3 * draw.standard_normal(capture.frames.shape)).astype(np.uint8)
    found = levels(replace(capture, frames=still))
    assert found["movement"] == "bad" and found["wall contrast"] == "bad" and "region" not in found


def test_a_motion_that_is_not_that_of_the_light_is_named(capture) -> None:
    """The light goes where the target goes; how far, only the setup tells."""

    def found(**changes) -> Finding:
        motion = replace(capture.info.motion, **changes)
        one = replace(capture, info=replace(capture.info, motion=motion))
        return next(one for one in check_capture(one) if one.what == "motion")

    faster = found(speed_m_s=0.03)
    assert faster.level == "good" and "speed and start are not checked from one capture" in faster.found
    for direction, level in (((-1.0, 0.0), "bad"), ((0.0, 1.0), "bad"), ((0.87, 0.5), "doubtful")):
        assert found(direction=direction).level == level
    backwards = found(speed_m_s=-0.02)
    assert (
        backwards.level == "bad" and "speed_m_s is -0.02" in backwards.found and "direction" in backwards.cure
    )
    stops = np.minimum(np.arange(len(capture.frames)), len(capture.frames) // 4)
    halted = levels(replace(capture, frames=capture.frames[stops]))
    assert halted["motion"] != "good"


def test_light_that_leaves_the_image_is_named(capture) -> None:
    """All movement at the left border of a wall that is dark elsewhere."""
    frames = np.full((12, 48, 72), 100, np.uint8)
    frames += np.random.default_rng(0).integers(0, 3, frames.shape).astype(np.uint8)
    for k in range(12):
        frames[k, :, :5] += np.uint8(60 * (k % 2 if k < 6 else k / 12))
    times = np.arange(12) * 500_000
    found = check_capture(replace(capture, frames=frames, frame_times_us=times))
    assert {one.what: one.level for one in found}["region"] == "bad"


def test_events_that_are_wrong_are_named(capture) -> None:
    events = capture.events
    few = replace(capture, events=events[::2000])
    assert levels(few)["event rate"] == "bad" and "thresholds" in cures(few)["event rate"]
    assert levels(few)["silent pixels"] == "bad"
    columns = events.columns()
    one_sided = Events(
        width=events.width, height=events.height, **(columns | {"p": np.ones(len(events), bool)})
    )
    assert levels(replace(capture, events=one_sided))["polarity balance"] == "bad"
    few_off = replace(
        one_sided, p=np.arange(len(events)) % 20 > 0
    )  # 95 % ON: a sensor that calibration can fit
    assert levels(replace(capture, events=few_off))["polarity balance"] == "doubtful"
    at_one = np.sort(np.concatenate([np.arange(len(events)), np.full(len(events), 5)]))
    x, y = columns["x"][at_one].copy(), columns["y"][at_one].copy()
    x[at_one == 5], y[at_one == 5] = 7, 7
    hot = Events(np.sort(columns["t_us"][at_one]), x, y, columns["p"][at_one], events.width, events.height)
    found = replace(capture, events=hot)
    assert levels(found)["hot pixels"] == "bad" and "hot_pixel_factor" in cures(found)["hot pixels"]


def flicker(capture, places: np.ndarray, t_us: np.ndarray, on: np.ndarray, **filters) -> Finding:
    """Return what is found of the flicker in events at so many places of a sensor of 48 x 72 pixels."""
    order = np.argsort(t_us, kind="stable")
    x, y = (places % 72).astype(np.uint16), (places // 72).astype(np.uint16)
    events = Events(t_us[order].astype(np.int64), x[order], y[order], on[order], 72, 48)
    info = replace(capture.info, filters=FilterInfo(**filters))
    found = check_capture(replace(capture, events=events, info=info))
    return next(one for one in found if one.what == "flicker")


@pytest.mark.parametrize("hertz", [100, 120])
def test_lamps_on_mains_are_found_and_sunlight_is_not(capture, hertz) -> None:
    draw = np.random.default_rng(hertz)
    places, even, on = draw.integers(0, 3456, 40_000), draw.integers(0, 8_000_000, 40_000), draw.random(40_000)
    assert flicker(capture, places, even, on < 0.5).level == "good"
    # Forty half periods of a pixel, ON in the first half of each period.
    times = (np.arange(40) / 2 + draw.integers(0, 600, (1000, 1))) * 1e6 / hertz
    times += draw.normal(0, 300, times.shape) + 2000
    turning = np.repeat(draw.permutation(3456)[:1000], 40), times.ravel(), np.tile([True, False], 20_000)
    found = flicker(capture, *turning)
    assert (
        found.level == "bad"
        and f"{hertz}.0 Hz" in found.found
        and re.search(r"lamps make (9\d|100) %", found.found)
    )
    assert f"{{flicker_hz: {hertz}.0" in found.cure and "direct current" in found.cure
    assert re.search(r"not 50, takes (9\d|100) %", flicker(capture, *turning, flicker_hz=50.0).cure)


def test_a_ripple_that_only_times_events_is_harmless_and_no_filter_is_advised(capture) -> None:
    """Light below the thresholds makes no event, but the moment at which another light passes them is its."""
    draw = np.random.default_rng(3)
    crest_us = draw.integers(0, 800, 40_000) * 10_000 + draw.normal(0, 800, 40_000) + 5000
    timed = draw.integers(0, 3456, 40_000), crest_us, draw.random(40_000) < 0.8
    found = flicker(capture, *timed, flicker_hz=100.0)
    assert found.level == "good" and found.cure == "" and "below the thresholds" in found.found
    assert "10 ms" in found.found and "no filter mends" in found.found
    quick = replace(capture, frame_times_us=capture.frame_times_us // 100)
    found = flicker(quick, *timed)
    assert found.level == "doubtful" and "filters" not in found.cure and "direct current" in found.cure


def test_turns_that_the_filter_does_not_take_are_bad_and_it_is_not_advised(capture) -> None:
    """A ripple as large as the thresholds turns a pixel now and then, in no two periods that follow."""
    draw = np.random.default_rng(4)
    crest_us = np.repeat(draw.integers(0, 800, 20_000) * 10_000.0, 2) + np.tile([2000.0, 7000.0], 20_000)
    places = np.repeat(draw.integers(0, 3456, 20_000), 2)
    found = flicker(capture, places, crest_us + draw.normal(0, 300, 40_000), np.tile([True, False], 20_000))
    assert found.level == "bad" and "filters:" not in found.cure and "turn in each period" in found.cure


def test_clocks_that_do_not_meet_are_named(capture) -> None:
    late = replace(capture, frame_times_us=capture.frame_times_us + 6_000_000)
    assert levels(late)["clock"] == "bad" and "alignment" in cures(late)["clock"]
    times = capture.frame_times_us.copy()
    times[4:] += 700_000
    assert levels(replace(capture, frame_times_us=times))["frame times"] == "doubtful"


def test_events_of_mirrored_pixels_or_exchanged_polarity_are_named(capture) -> None:
    events = capture.events
    for changed, says in (
        ({"p": ~events.p}, "exchange ON and OFF"),
        ({"x": (events.width - 1 - events.x).astype(events.x.dtype)}, "left and right"),
    ):
        found = {one.what: one for one in check_capture(replace(capture, events=replace(events, **changed)))}
        assert found["pixels"].level == "bad" and says in found["pixels"].cure and "clock offset" not in found


def test_holes_in_the_events_and_repeated_frames_are_named(capture) -> None:
    t_us, frames = capture.events.t_us, capture.frame_times_us
    there = (t_us < frames[len(frames) // 2]) | (t_us > frames[len(frames) // 2 + 2])
    found = levels(replace(capture, events=capture.events[there]))
    assert found["holes"] in ("doubtful", "bad") and "holes" not in levels(capture)
    again = np.repeat(capture.frames[::2], 2, axis=0)[: len(capture.frames)]
    assert levels(replace(capture, frames=again))["repeated frames"] == "bad"


def test_a_path_that_is_nowhere_near_the_wall_is_named(tiny_captures, tmp_path, capture) -> None:
    away = replace(capture.info.motion, start_m=0.9)
    one = replace(capture, info=replace(capture.info, motion=away))
    found = next(one for one in check_capture(one) if one.what == "motion")
    assert found.level == "bad" and "start_us" in found.cure and "0.5 m is safe" in found.found
    shutil.copytree(tiny_captures[0], tmp_path / "one")
    path = tmp_path / "one" / "capture.yaml"
    text = path.read_text()
    assert "speed_m_s: 0.02" in text
    path.write_text(text.replace("speed_m_s: 0.02", "speed_m_s: 20.0"))
    with pytest.raises(DataError, match=r"from start_m while frames are taken.*mend speed_m_s, or start_us"):
        read_capture(tmp_path / "one")


def test_a_clock_that_counts_from_1970_is_read(capture, monkeypatch) -> None:
    """Live recordings are stamped so; a second then is a number that no motion was allowed to start at."""
    late_us = 1_753_870_845_000_000
    info = replace(capture.info, motion=replace(capture.info.motion, start_us=late_us + 250_000))
    events = replace(capture.events, t_us=capture.events.t_us + late_us)
    found = from_start(Path("here"), info, events, capture.frame_times_us + late_us)
    assert found[0].motion.start_us == 250_000 and "1753870845 s" in found[3][0]
    np.testing.assert_array_equal(found[1].t_us, capture.events.t_us)
    np.testing.assert_array_equal(found[2], capture.frame_times_us)
    same = from_start(Path("here"), capture.info, capture.events, capture.frame_times_us)
    assert same[1] is capture.events and same[3] == []


def test_digits_may_be_names_and_a_mask_has_to_shine(tiny_captures, tmp_path) -> None:
    shutil.copytree(tiny_captures[0], tmp_path / "one")
    path = tmp_path / "one" / "capture.yaml"
    text = path.read_text()
    before, _, after = text.partition("target:\n")
    path.write_text(f"{before}target:\n{re.sub(r'name: .*', 'name: 4', after, count=1)}")
    read = read_capture(tmp_path / "one")
    assert read.info.target.name == "4"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "one" / read.info.target.mask)
    with pytest.raises(DataError, match="black all over"):
        read_capture(tmp_path / "one")


@pytest.mark.parametrize("others", ["5", "{name: 4}", "[7]"])
def test_other_targets_that_are_none_are_one_line(tiny_captures, tmp_path, others) -> None:
    shutil.copytree(tiny_captures[0], tmp_path / "one")
    path = tmp_path / "one" / "capture.yaml"
    path.write_text(f"{path.read_text()}\nothers: {others}\n")
    with pytest.raises(ConfigError, match="others"):
        read_capture(tmp_path / "one")


def test_a_new_folder_explains_itself_and_is_read_back(tmp_path, capsys) -> None:
    main(
        [
            "capture",
            "init",
            str(tmp_path / "recording"),
            "--width",
            "640",
            "--height",
            "480",
            "--camera",
            "EVK: 4",
        ]
    )
    assert "evnlos capture check" in capsys.readouterr().out
    info = read_capture_info(tmp_path / "recording")
    assert (info.camera.width, info.camera.height, info.camera.name) == (640, 480, "EVK 4")
    text = (tmp_path / "recording" / "capture.yaml").read_text()
    # Every setting that is offered in a comment is one that the reader knows.
    offered = [line[2:] for line in text.splitlines() if line.startswith("# ") and ": {" in line]
    assert len(offered) >= 7
    for line in offered:
        (tmp_path / "capture.yaml").write_text("camera: {width: 640, height: 480}\n" + line + "\n")
        read_capture_info(tmp_path)
    with pytest.raises(DataError, match="exists"):
        begin_capture(tmp_path / "recording", 640, 480)
    with pytest.raises(DataError, match="0 x 480"):
        begin_capture(tmp_path / "other", 0, 480)
    (tmp_path / "file").touch()
    for folder in ("file", "file/recording"):
        with pytest.raises(DataError, match="file is a file; give a folder"):
            begin_capture(tmp_path / folder, 640, 480)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_folder_for_a_camera_by_its_name(name, tmp_path) -> None:
    main(["capture", "init", str(tmp_path / "a"), "--camera", name.upper()])
    info = read_capture_info(tmp_path / "a")
    said, width, height, events, frames = CAMERAS[name]
    camera = info.camera
    assert (camera.name, camera.width, camera.height) == (said, width, height)
    assert (info.events, info.frames) == (events, frames)


def test_a_camera_that_is_not_known_needs_its_size(tmp_path, capsys) -> None:
    for words, says in (
        ([], "no --camera; give one of davis346"),
        (["--camera", "davis34"], "did you mean davis346?"),
        (["--camera", "other", "--width", "64"], "--width and --height"),
    ):
        with pytest.raises(SystemExit):
            main(["capture", "init", str(tmp_path / "a"), *words])
        assert says in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_many_captures_are_a_table(tiny_captures, tmp_path, capsys) -> None:
    folders = [str(one) for one in tiny_captures[:2]]
    with pytest.raises(SystemExit) as stop:
        main(["capture", "check", *folders, str(tmp_path)])
    said = capsys.readouterr()
    assert stop.value.code == 2 and "1 of 3 captures can't be read" in said.err
    for folder in [*folders, str(tmp_path)]:
        assert [line for line in said.out.splitlines() if line.startswith(folder + " ")]
    assert "of 3 captures are good in all" in said.out and "can't be read" in said.out
    with contextlib.suppress(SystemExit):
        main(["capture", "check", *folders, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [one["capture"] for one in found] == [Path(one).name for one in folders]
    single = {one["what"]: one["level"] for one in found[0]["findings"]}
    assert single == levels(read_capture(folders[0]))


def test_the_command_prints_and_its_exit_code_tells(tiny_captures, tmp_path, capsys) -> None:
    main(["capture", "check", str(tiny_captures[0]), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert {one["what"] for one in found["findings"]} >= {"saturation", "movement", "flicker", "clock"}
    main(["capture", "check", str(tiny_captures[0])])
    assert "good   saturation" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        main(["capture", "check", str(tmp_path)])
    assert stop.value.code == 2 and "capture.yaml" in capsys.readouterr().err


STEADY = Lab(
    glyphs=FontGlyphs(family="kalam", characters="R"),
    setup=RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=SensorSize(48, 72)),
    frame_rate_hz=2.5,
)


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    """A rendered capture at 2.5 frames per second."""
    return read_capture(render_captures(STEADY, tmp_path_factory.mktemp("steady"))[0])


@pytest.mark.parametrize(("shift_us", "way"), [(400_000, "late"), (-400_000, "early"), (3_000_000, "late")])
def test_frames_on_a_shifted_clock_are_found_with_the_cure(steady, shift_us, way) -> None:
    found = {one.what: one for one in check_capture(steady)}["clock offset"]
    assert found.level == "good" and found.cure == ""
    shifted = replace(steady, frame_times_us=steady.frame_times_us + shift_us)
    found = {one.what: one for one in check_capture(shifted)}["clock offset"]
    assert found.level == "bad" and f"too {way}" in found.found
    stated = int(found.cure.split("offset_us: ")[1].split("}")[0])
    assert stated == pytest.approx(-shift_us, abs=200_000)


def test_a_little_beyond_the_usual_is_no_alarm_and_names_no_offset(steady) -> None:
    """Slow and noisy pixels are as far off with clocks that are one: the cure would set them apart."""
    (usual,) = clock_offset(steady)
    assert usual.lag_us is not None
    limit_us = 1e6 / STEADY.frame_rate_hz / 2
    shifted = replace(steady, frame_times_us=steady.frame_times_us + round(usual.lag_us + 1.2 * limit_us))
    (found,) = clock_offset(shifted)
    assert found.level == "doubtful" and "cannot be told from what pixels do" in found.found
    assert "offset_us" not in found.cure


@pytest.mark.parametrize(("off", "leak_hz", "rate_hz"), [(1.4, 0.0, 5.0), (1.4, 0.1, 5.0), (0.25, 0.1, 4.0)])
def test_a_polarity_of_a_higher_threshold_is_no_clock_offset(tmp_path, off, leak_hz, rate_hz) -> None:
    pixel = replace(STEADY.setup.pixel, threshold_on=0.12, threshold_off=off, leak_rate_hz=leak_hz)
    lab = replace(STEADY, setup=replace(STEADY.setup, pixel=pixel), frame_rate_hz=rate_hz, spread={})
    capture = read_capture(render_captures(lab, tmp_path)[0])
    assert capture.events.p.mean() > 0.8
    assert levels(capture)["clock offset"] == "good"
    for shift_us, way in ((500_000, "late"), (-500_000, "early")):
        shifted = replace(capture, frame_times_us=capture.frame_times_us + shift_us)
        found = {one.what: one for one in check_capture(shifted)}["clock offset"]
        assert found.level == "bad" and f"too {way}" in found.found


def offset_level(capture, shift_us: int = 0) -> str:
    """Return the level of the clock offset with the frames' times moved."""
    (found,) = clock_offset(replace(capture, frame_times_us=capture.frame_times_us + shift_us))
    return found.level


@pytest.mark.parametrize(("name", "level"), [("far_4", "doubtful"), ("far_0", "good"), ("near_1", "good")])
def test_what_pixels_do_by_themselves_is_no_bad_clock(shared_data, name, level) -> None:
    """The captures whose pixels are furthest from the expected ones: 0.11, 0.10, 0.06 s without an offset."""
    capture = read_capture(shared_data / "captures" / name)
    assert offset_level(capture) == level
    assert offset_level(capture, 350_000) == offset_level(capture, -350_000) == "bad"


def test_the_middle_course_says_that_it_cannot_be_told(shared_data) -> None:
    (found,) = clock_offset(read_capture(shared_data / "captures" / "far_4"))
    assert "cannot be told" in found.found and "offset_us" not in found.cure and "trigger_channel" in found.cure


def test_rates_of_false_alarms_and_of_shifts_that_are_found(shared_data, tmp_path) -> None:
    """No false alarm on any capture; the share of shifts that is not called good."""
    folders = sorted((shared_data / "captures").iterdir())
    captures = [read_capture(folder) for folder in folders]
    for name in ("two-lobes", "one-sided", "curved", "brushed", "streaks", "torch"):
        out = tmp_path / name
        main(["lab", "--out", str(out), "--setup", name, "--glyphs.characters", "GK4"])
        captures += [read_capture(folder) for folder in sorted(out.glob(f"{name}_*"))]
    assert [one.name for one in captures if offset_level(one) == "bad"] == []
    some = [one for one in captures if one.name[-1] in "04ABGKT"]
    for shift_us, not_good, bad in ((100_000, 0.4, 0.0), (200_000, 0.9, 0.3), (300_000, 0.95, 0.8)):
        found = [offset_level(one, sign * shift_us) for one in some for sign in (-1, 1)]
        shares = sum(level != "good" for level in found), sum(level == "bad" for level in found)
        print(f"{shift_us / 1e6:g} s: not good {shares[0]}, bad {shares[1]} of {len(found)}")
        assert shares[0] >= not_good * len(found) and shares[1] >= bad * len(found)


def beside(lags_us: list[int], info: CaptureInfo) -> list[str]:
    """Return the levels of captures whose lags are such, as one camera took them."""
    found = {str(n): [Finding("clock offset", "good", "", "", lag)] for n, lag in enumerate(lags_us)}
    out = compare_clocks(found, dict.fromkeys(found, info))
    return [one.level for several in out.values() for one in several]


def test_a_clock_that_differs_from_the_others_is_found_beside_them(steady) -> None:
    lags = [-38_000, -41_000, -35_000, -44_000, -40_000, -31_000, -43_000, 62_000]
    assert beside(lags, steady.info) == ["good"] * 7 + ["bad"]
    assert beside([*lags[:7], 10_000], steady.info) == ["good"] * 7 + ["doubtful"]
    assert beside(lags[1:], steady.info) == ["good"] * 7  # the middle of so few tells little
    found = {str(n): [Finding("clock offset", "good", "", "", lag)] for n, lag in enumerate(lags)}
    infos = dict.fromkeys(found, steady.info)
    (cured,) = compare_clocks(found, infos)["7"]
    assert "0.10 s too early" in cured.found and "7 other captures" in cured.found
    assert "offset_us: 102000" in cured.cure and "offset_us" not in found["7"][0].cure
    other = replace(steady.info, camera=replace(steady.info.camera, name="another"))
    assert compare_clocks(found, infos | {"7": other}) == found


@pytest.mark.parametrize(
    "name",
    ["near", *(pytest.param(name, marks=pytest.mark.thorough) for name in ("far", "brushed")), "one-sided"],
)
def test_a_tenth_of_a_second_is_found_beside_other_captures(name, shared_data, tmp_path) -> None:
    """No false alarm among captures of one camera; the share of shifts that are found.

    The thorough cases repeat on two more walls what a real wall and a simulated one show.
    """
    folders = sorted((shared_data / "captures").glob(f"{name}_*"))
    if not folders:
        quick = ["--setup.sensor.height", "60", "--setup.sensor.width", "96"] if name == "one-sided" else []
        main(["lab", "--out", str(tmp_path), "--setup", name, "--glyphs.characters", "ABCDEFGH", *quick])
        folders = sorted(tmp_path.glob(f"{name}_*"))
    captures = [read_capture(folder) for folder in folders]
    lags = [one.lag_us for capture in captures for one in clock_offset(capture) if one.lag_us is not None]
    assert len(lags) == len(captures)
    assert set(beside(lags, captures[0].info)) == {"good"}
    shifted = [
        beside([*lags[:k], lags[k] + shift, *lags[k + 1 :]], captures[0].info)
        for k in range(len(lags))
        for shift in (-100_000, 100_000)
    ]
    share = sum(levels.count("good") == len(lags) - 1 for levels in shifted) / len(shifted)
    print(f"{name}: {share:.2f} of shifts by 0.1 s found")
    assert share >= (0.95 if name == "near" else 0.35)


def test_frames_in_reversed_order_are_found(steady) -> None:
    found = {one.what: one for one in check_capture(replace(steady, frames=steady.frames[::-1]))}[
        "clock offset"
    ]
    assert found.level == "bad" and "reversed order" in found.found and "order" in found.cure


def test_frames_that_tell_no_offset_are_called_doubtful(steady) -> None:
    draw = np.random.default_rng(0)
    still = (100 + 3 * draw.standard_normal(steady.frames.shape)).astype(np.uint8)
    assert levels(replace(steady, frames=still))["clock offset"] == "doubtful"
    assert "clock offset" not in levels(replace(steady, frames=steady.frames[:, ::2]))


def test_pixels_without_noise_send_what_is_expected() -> None:
    """A light that rises and falls by ten thresholds: ten events each way, less the dead zone at the turn."""
    level = np.concatenate([np.linspace(0, 1, 11), np.linspace(1, 0, 11)[1:]])[:, None]
    sent = expected_counts(level, 0.1)
    assert sent[:10].sum() == pytest.approx(9.5, abs=0.51) and sent[1:10] == pytest.approx(1.0, abs=1e-6)
    assert sent[10:].sum() == pytest.approx(-9.0, abs=0.51) and abs(sent[10]) < 0.01


@pytest.fixture(scope="module", params=["frames", "events"])
def one_camera(request, tiny_captures, tmp_path_factory) -> tuple[Path, str]:
    """A capture without its frames or without its events, and which of them it lacks."""
    folder = tmp_path_factory.mktemp("one") / "one_A"
    shutil.copytree(tiny_captures[0], folder)
    path = folder / "capture.yaml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith(f"{request.param}:")]
    path.write_text("\n".join([*lines, f"{request.param}: null"]) + "\n")
    (folder / {"frames": "frames.csv", "events": "events.raw"}[request.param]).unlink()
    return folder, request.param


def test_a_capture_of_one_camera_is_checked_imported_and_reconstructed(one_camera, tmp_path, capsys) -> None:
    folder, lacking = one_camera
    main(["capture", "check", str(folder), "--json"])
    found = {one["what"]: one for one in json.loads(capsys.readouterr().out)["findings"]}
    assert found[lacking]["level"] == "doubtful" and "alone" in found[lacking]["found"]
    assert ("event rate" in found, "saturation" in found) == (lacking == "frames", lacking == "events")
    assert "clock offset" not in found
    main(["import", str(folder), "--out", str(tmp_path / "data")])
    with pytest.raises(DataError, match=f"one_A was recorded without {lacking}.* --modality"):
        train(open_dataset(tmp_path / "data"), Training(modality="fusion"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    samples, _ = read_shard(tmp_path / "data" / "one_A.h5")
    assert samples.frame.any() == (lacking == "events") and samples.surface.any() == (lacking == "frames")
    assert (samples.event_count.sum() > 0) == (lacking == "frames") and samples.truth is not None
    main(["reconstruct", str(folder), "--out", str(tmp_path / "out"), "--json"])
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert told["modality"] == {"frames": "event", "events": "frame"}[lacking]
    assert "light" not in told and (tmp_path / "out" / "result.png").is_file()


def test_what_a_capture_of_one_camera_lacks_is_named(one_camera, tmp_path, capsys) -> None:
    folder, lacking = one_camera
    weights = {"frames": "near-frame-sequence", "events": "near-event-sequence"}[lacking]
    with pytest.raises(SystemExit) as end:
        main(["reconstruct", str(folder), "--weights", weights, "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert end.value.code == 2 and f"{lacking}: null in capture.yaml" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()
    with pytest.raises(DataError, match=f"this needs {lacking}"):
        read_capture(folder)


def test_a_capture_without_any_camera_or_a_clock_of_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="state one of them"):
        CaptureInfo(CameraInfo(8, 8), events=None, frames=None)
    with pytest.raises(ConfigError, match=r"events is null; leave out .* alignment"):
        CaptureInfo(CameraInfo(8, 8), events=None, alignment=AlignmentInfo(offset_us="auto"))


@pytest.mark.parametrize(("spin_deg_s", "error"), [(0.0, 1e-4), (3.0, 5e-3)])
def test_the_light_of_a_capture_does_not_depend_on_when_its_clock_began(capture, spin_deg_s, error) -> None:
    """A camera's clock begins when it is switched on, not when the target sets out."""
    late_us = 1_000_345_678
    motion = replace(capture.info.motion, spin_deg_s=spin_deg_s)
    capture = replace(capture, info=replace(capture.info, motion=motion))
    motion = replace(motion, start_us=motion.start_us + late_us)
    late = replace(
        capture,
        info=replace(capture.info, motion=motion),
        frame_times_us=capture.frame_times_us + late_us,
    )
    setup = RadiometricSetup(sensor=SensorSize(12, 18), cell_m=0.01)
    assert late.scene.duration_s == pytest.approx(capture.scene.duration_s)
    times = capture.frame_times_us[[0, 3, -1]] * 1e-6
    soon, later = (setup.observe(one.scene) for one in (capture, late))
    expected = soon.irradiance(times).numpy()
    found = later.irradiance(times + late_us * 1e-6).numpy()
    np.testing.assert_allclose(found, expected, atol=error * expected.max())
    assert later.speed_px_s == pytest.approx(soon.speed_px_s, rel=1e-6)
