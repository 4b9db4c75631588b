"""A monitor, a phone and a wall: a show is planned, filmed by a pretended phone, and becomes a transport."""

import json
import re
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evnlos.calibration.scan import (
    FilmReading,
    FilmResult,
    ScanPlan,
    import_film,
    import_scan,
    lit_cells,
    rehearse_film,
    write_plan,
)
from evnlos.calibration.scan.film import find_steadiness, fit_tone, straightened
from evnlos.calibration.scan.show import CHECKS, CODE, read_show
from evnlos.cameras.video import open_video
from evnlos.cameras.video_files import write_video
from evnlos.cli import main
from evnlos.data import read_capture
from evnlos.errors import ConfigError, DataError
from evnlos.lab import Phone
from evnlos.setups import setup_preset

pytest.importorskip("av")
SHAPE = (54, 96)  # pixels of the film
PLAN = ScanPlan(
    plane=(0.12, 0.06),
    pitch=0.02,
    pattern="hadamard",
    display=(1920, 1080),
    show="page",
    hold_s=0.2,
    targets="K",
    speed_m_s=0.06,
)
SETUP = setup_preset("main-near")


def filmed(folder: Path, phone: Phone, plan: ScanPlan = PLAN) -> Path:
    write_plan(plan, folder)
    return rehearse_film(folder, SETUP, phone, SHAPE)


def error_of(folder: Path) -> float:
    """Return the root mean square error of the imported matrix, of any gain, over that of the true one."""
    cells = PLAN.cells
    true = SETUP.seen_by(SHAPE).operator(cells, SHAPE).dense().numpy()
    found = import_scan(folder).measurement.matrix.numpy()
    gain = (found * true).sum() / (true * true).sum()
    return float(np.linalg.norm(found / gain - true) / np.linalg.norm(true))


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, FilmResult]]:
    """A film with another tone curve than the importer takes for granted, on a tripod, locked.

    It is hardly compressed: in a film of 54 x 96 pixels the usual loss is as large as the tone curve's.
    """
    folder = tmp_path_factory.mktemp("first") / "tray"
    film = filmed(folder, Phone(tone="rec709", contrast=0.15, clock_ppm=300.0, quality=12))
    yield folder, import_film(folder, film)


def test_the_flashes_tell_the_time(locked: tuple[Path, FilmResult]) -> None:
    _, found = locked
    assert found.clock.start_s == pytest.approx(1.5, abs=0.01)
    assert found.clock.rate == pytest.approx(1.0003, abs=4e-4)
    assert found.clock.agreement > 0.98


def test_light_that_adds_up_tells_the_tone_curve(locked: tuple[Path, FilmResult]) -> None:
    folder, found = locked
    assert found.exposure_locked and found.misfit[1] < 0.7 * found.misfit[0]
    straight = error_of(folder)
    import_film(folder, folder / "film.mp4", FilmReading(fit_tone=False))
    assert straight < 0.8 * error_of(folder)


def test_a_character_that_moved_becomes_a_capture(locked: tuple[Path, FilmResult], capsys) -> None:
    folder, _ = locked
    film = folder / "film.mp4"
    main(["scan", "import", str(folder), "--film", str(film), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["film"]["captures"] == [str(folder / "captures" / "K")]
    capture = read_capture(folder / "captures" / "K")
    assert capture.motion is not None and capture.scene is not None
    assert np.diff(capture.frame_times_us).mean() == pytest.approx(1e5, rel=0.02)
    assert "simulated" in (folder / "captures" / "K" / "capture.yaml").read_text()
    out = str(folder / "k.png")
    main(["invert", str(folder / "captures" / "K"), "--setup", told["transport"], "--out", out, "--json"])
    row = json.loads(capsys.readouterr().out)["rows"][0]
    blind = 10.0  # about the mean of all characters
    assert row["psnr_db"] > blind + 2


def test_a_shaking_hand_and_an_exposure_that_follows_are_taken_out(tmp_path: Path) -> None:
    folder = tmp_path / "hand"
    film = filmed(folder, Phone(shake_px=0.8, auto_exposure=0.4), replace(PLAN, targets=""))
    raw = import_film(folder, film, FilmReading(steady=False))
    assert len(raw.warnings) == 2 and not raw.corrected
    with pytest.raises(DataError, match=r"moved|light|differs between repeats"):
        import_scan(folder)
    found = import_film(folder, film)
    assert found.corrected and 0.4 < found.shift_px < 1.6 and found.gain_rms > 0.01
    assert not found.exposure_locked and "lock it" in found.warnings[0]
    assert error_of(folder) < 0.25  # the place of the whole image is that of the mean, not of the setup


def test_the_page_holds_every_pattern_and_its_time(tmp_path: Path) -> None:
    write_plan(PLAN, tmp_path / "tray")
    page = (tmp_path / "tray" / "show.html").read_text()
    data = json.loads(re.search(r"const show = (\{.*\});", page)[1])  # type: ignore[index]
    show = read_show(tmp_path / "tray")
    assert len(data["parts"]) == len(show.parts) and "http" not in page.replace("https://www.w3.org", "")
    for part, (start_s, number, *_) in zip(show.parts, data["parts"], strict=True):
        assert start_s == pytest.approx(part.start_s, abs=1e-4)
        if part.kind != "target":
            bits = np.unpackbits(np.frombuffer(b64decode(data["pictures"][number]), np.uint8))
            shown = bits[: show.info.plane.height * show.info.plane.width].reshape(show.info.plane.shape)
            np.testing.assert_array_equal(shown, show.cells(part))
    assert np.diff(data["columns"]) == pytest.approx(0.02 / 0.00027, abs=0.6)


def test_a_show_as_a_video_shows_its_cells(tmp_path: Path) -> None:
    plan = replace(PLAN, show="video", display=(480, 270), display_pitch=0.0005)
    write_plan(plan, tmp_path / "tray")
    show = plan.as_show()
    video = open_video(tmp_path / "tray" / "show.mp4")
    seen = 0
    for time_s, light in video:
        part = show.part_at(time_s + 0.025)
        if part.kind == "target" or part.stop_s - time_s < 0.1 or time_s - part.start_s < 0.05:
            continue
        middle = light[135 - 60 + 20 : 135 + 60 : 40, 240 - 120 + 20 : 240 + 120 : 40]
        np.testing.assert_array_equal(middle > 128, show.cells(part) > 0.5)
        seen += 1
    assert seen > 200


def test_patterns_come_in_another_order_each_time() -> None:
    shown = [frame.pattern for frame in PLAN.scan_frames() if frame.pattern is not None]
    first, second = shown[:19], shown[19:]
    assert sorted(first) == sorted(second) == list(range(19)) and first != second
    assert replace(PLAN, show="pictures", targets="").scan_frames()[1].pattern == 0


def test_the_tone_curve_is_found_where_light_adds_up() -> None:
    rng = np.random.default_rng(0)
    show = PLAN.as_show()
    matrix = rng.uniform(0, 1, (500, 18)) / 25
    light = [(matrix @ lit.ravel() + 0.02).reshape(20, 25) for lit in show.checks]
    bent = [one ** (1 / 1.3) for one in light]
    curve, (before, after) = fit_tone([one.astype(np.float32) for one in bent])
    assert after < 0.01 < before
    back = straightened(bent[7], curve) / straightened(bent[1], curve).mean()
    np.testing.assert_allclose(back, light[7] / light[1].mean(), rtol=0.03)


def test_gain_and_movement_of_each_image_are_found() -> None:
    rng = np.random.default_rng(0)
    show = PLAN.as_show()
    design = np.stack([np.r_[show.cells(p).ravel(), 1.0] for p in show.parts if p.kind == "pattern"])
    y, x = np.mgrid[:40, :60]
    places = rng.uniform((5, 5), (35, 55), (19, 2))
    columns = [np.exp(-((y - a) ** 2 + (x - b) ** 2) / 60) for a, b in places]
    time = np.arange(len(design))
    gain = 1 + 0.03 * np.sin(time / 4)
    moved = 0.7 * np.stack([np.sin(time / 5), np.cos(time / 6)], axis=1)
    from scipy.ndimage import shift

    light = np.tensordot(design, np.stack(columns), 1)
    seen = np.stack([g * shift(one, by, mode="nearest") for g, one, by in zip(gain, light, moved, strict=True)])
    seen += 0.003 * rng.standard_normal(seen.shape)
    found = find_steadiness(seen.astype(np.float32), design, 0.3)
    assert np.std(found.gain - gain / gain.mean()) < 0.15 * np.std(gain)
    assert np.abs(found.shift_px - (moved - moved.mean(axis=0))).mean() < 0.05


@pytest.mark.parametrize(
    ("keep", "words"), [(slice(0, 200), "film the whole show"), (slice(150, None), "flashes")]
)
def test_half_a_film_is_refused(
    tmp_path: Path, locked: tuple[Path, FilmResult], keep: slice, words: str
) -> None:
    frames = [light.astype(np.uint8) for _, light in open_video(locked[0] / "film.mp4")][keep]
    write_video(tmp_path / "half.mp4", frames, 30.0, 20, "fast")
    write_plan(PLAN, tmp_path / "tray")
    with pytest.raises(DataError, match=words):
        import_film(tmp_path / "tray", tmp_path / "half.mp4")
    assert not list((tmp_path / "tray" / "frames").iterdir())


def test_a_scan_without_a_show_is_refused(tmp_path: Path) -> None:
    write_plan(replace(PLAN, show="pictures", targets=""), tmp_path / "tray")
    cases = (
        (tmp_path / "nowhere", "does not exist"),
        (Path(__file__), "is not a folder"),
        (tmp_path, "holds no"),
    )
    for path, found in cases:
        with pytest.raises(
            ConfigError, match=f"{path} {found}.*; give the folder that `evnlos scan plan` made"
        ):
            import_film(path, tmp_path / "film.mp4")
    with pytest.raises(ConfigError, match=r"holds no show\.yaml.*--show page"):
        import_film(tmp_path / "tray", tmp_path / "film.mp4")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"display": None}, "give --display"),
        ({"target_m": 0.09}, "smaller characters"),
        ({"hold_s": 0.01}, "hold_s is 0.01; give 0.2"),
        ({"targets": "KK"}, "each once"),
        ({"show": "pictures"}, "give --show page"),
    ],
)
def test_a_show_that_cannot_be_is_refused(change: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        replace(PLAN, **change)


def test_the_code_looks_like_itself_at_one_place_only() -> None:
    signs = 2 * np.array(CODE) - 1
    round_about = [int(signs @ np.roll(signs, k)) for k in range(len(CODE))]
    assert round_about == [15, *[-1] * 14]
    show = PLAN.as_show()
    assert len(CHECKS) == len(show.checks) and lit_cells(PLAN.info(), 0).shape == (3, 6)
