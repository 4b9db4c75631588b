"""The commands on event streams, as a user types them: events, info, convert, preview."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evnlos import Events, read_events, write_events
from evnlos.cameras import EventPixel, pixel_preset, simulate_events
from evnlos.cameras.video import open_video
from evnlos.cli.events import PixelChanges
from evnlos.config import to_dict
from evnlos.events import EventWriter, keep_known_polarity
from evnlos.events.files.registry import FORMATS
from evnlos.events.recording import Box, CropOptions, Recording, summarise
from test_cli import call, fails
from test_video import write_animation, write_container


def moving_bar(count: int = 12) -> list[np.ndarray]:
    """Return grey images [24, 32, 3] of a bright bar that moves to the right."""
    pictures = []
    for number in range(count):
        picture = np.full((24, 32, 3), 60, np.uint8)
        picture[6:18, 2 * number : 2 * number + 5] = 210
        pictures.append(picture)
    return pictures


def random_events(count: int = 40_000, *, width: int = 40, height: int = 30, adc: bool = False) -> Events:
    rng = np.random.default_rng(7)
    t_us = np.sort(rng.integers(10_000_000, 12_000_000, count))
    x, y = rng.integers(0, width, count), rng.integers(0, height, count)
    extra = {}
    if adc:
        known = rng.random(count) < 0.5
        extra = {"adc": rng.integers(0, 4096, count), "polarity_known": known}
    on = rng.random(count) < 0.6
    return Events(t_us, x, y, on & extra.get("polarity_known", True), width, height, **extra)


def left_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# ---- events


def test_events_of_a_video_file(tmp_path: Path, capsys) -> None:
    clip = write_container(tmp_path / "clip.mp4", moving_bar(), list(range(0, 480, 40)))
    out = tmp_path / "events.h5"
    call("events", clip, "--pixel", "davis346", "--out", out, "--preview", tmp_path / "look.png")
    shown = capsys.readouterr().out
    times_s, light = zip(*open_video(clip), strict=True)
    expected = simulate_events(np.stack(light), times_s, pixel_preset("davis346"))
    assert read_events(out) == expected
    ratio = expected.p.sum() / (~expected.p).sum()
    assert f"{len(expected):,} events" in shown and f"ON/OFF {ratio:.2f}" in shown and "0.44 s" in shown
    with Image.open(tmp_path / "look.png") as picture:
        assert picture.width > 500


def test_events_of_a_part_of_a_video_and_their_instants(tmp_path: Path, capsys) -> None:
    clip = write_animation(tmp_path / "clip.gif", moving_bar(), [30] * 12)
    quiet = ["--pixel", "v2e_clean"]
    call("events", clip, "--out", tmp_path / "part.npz", "--start", 0.09, "--stop", 0.21, *quiet, "--json")
    found = json.loads(capsys.readouterr().out)
    frames = np.stack(moving_bar())[3:8, ..., 0]
    expected = simulate_events(frames, np.arange(3, 8) * 0.03, pixel_preset("v2e_clean"))
    assert read_events(tmp_path / "part.npz") == expected and len(expected)
    assert found["frames"] == 5 and found["duration_s"] == pytest.approx(0.12)
    assert found["instants"] == len(np.unique(expected.t_us))
    call("events", clip, "--out", tmp_path / "v2e.npz", "--mode", "v2e", *quiet)
    assert " different times per 100 events" in capsys.readouterr().out
    assert "later stop" in fails(capsys, "events", clip, "--out", tmp_path / "x.npz", "--start", 2, "--stop", 1)


def test_events_of_a_folder_of_videos(tmp_path: Path, capsys) -> None:
    (tmp_path / "clips").mkdir()
    for name in "ab":
        write_animation(tmp_path / "clips" / f"{name}.gif", moving_bar(), [30] * 12)
    call("events", tmp_path / "clips", "--out", tmp_path / "events")
    assert left_in(tmp_path / "events") == {"a.gif.h5", "b.gif.h5"}
    before = (tmp_path / "events" / "b.gif.h5").read_bytes()
    (tmp_path / "events" / "a.gif.h5").unlink()
    call("events", tmp_path / "clips", "--out", tmp_path / "events", "--seed", 9)  # goes on where it was
    assert len(read_events(tmp_path / "events" / "a.gif.h5")) > 0
    assert (tmp_path / "events" / "b.gif.h5").read_bytes() == before


@pytest.mark.parametrize("ending", [".h5", ".raw", ".npz", ".csv"])
def test_events_of_an_animation_in_both_modes(tmp_path: Path, capsys, ending: str) -> None:
    clip = write_animation(tmp_path / "clip.gif", moving_bar(), [30] * 12)
    frames = np.stack(moving_bar())[..., 0]
    mode = "v2e" if ending == ".raw" else "exact"
    pixel = EventPixel(0.3, pixel_preset("v2e_noisy").threshold_off, 0.05, 30.0, 0.1, 5.0)
    changes = ["--pixel", "v2e_noisy", "--pixel.threshold-on", 0.3]
    call("events", clip, "--out", tmp_path / f"e{ending}", "--mode", mode, "--seed", 4, *changes, "--json")
    found = json.loads(capsys.readouterr().out)
    expected = simulate_events(frames, np.arange(12) * 0.03, pixel, mode=mode, seed=4)
    assert read_events(tmp_path / f"e{ending}") == expected
    assert found["events"] == len(expected) and found["on"] == expected.p.sum()
    assert found["duration_s"] == pytest.approx(0.33) and found["frames"] == 12
    assert found["rate_hz"] == pytest.approx(len(expected) / 0.33)
    assert found["pixel"] == to_dict(pixel)


def test_events_of_images_and_arrays(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    for number, picture in enumerate(moving_bar()):
        Image.fromarray(picture).save(folder / f"{number}.png")
    np.save(tmp_path / "clip.npy", np.stack(moving_bar()))
    found = []
    for video in ([folder], sorted(folder.glob("*.png")), [folder / "*.png"], [tmp_path / "clip.npy"]):
        out = tmp_path / f"{len(found)}.npz"
        call("events", *video, "--fps", 50, "--out", out, "--tone", "srgb", "--scale", "16x12")
        found.append(read_events(out))
    assert found[0].shape == (12, 16) and len(found[0]) > 100
    assert all(events == found[0] for events in found)
    # 50 Hz played 10 times slower than life are 500 Hz.
    call(
        "events",
        folder,
        "--fps",
        50,
        "--slow-motion",
        10,
        "--out",
        tmp_path / "slow.npz",
        "--pixel",
        "v2e_clean",
    )
    call("events", folder, "--fps", 500, "--out", tmp_path / "fast.npz", "--pixel", "v2e_clean")
    assert read_events(tmp_path / "slow.npz") == read_events(tmp_path / "fast.npz")
    capsys.readouterr()


def test_a_pixel_from_a_file(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine.yaml").write_text("threshold_on: 0.4\nthreshold_off: 0.4\ncutoff_hz: 0\n")
    np.save(tmp_path / "clip.npy", np.stack(moving_bar()))
    options = ["--fps", 100, "--out", tmp_path / "e.npz", "--json"]
    call("events", tmp_path / "clip.npy", "--pixel", tmp_path / "mine.yaml", *options, "--pixel.cutoff-hz", 7)
    found = json.loads(capsys.readouterr().out)["pixel"]
    assert (found["threshold_on"], found["cutoff_hz"], found["leak_rate_hz"]) == (0.4, 7.0, 0.01)


def test_the_flags_of_the_pixel_are_its_parameters() -> None:
    assert [*to_dict(PixelChanges()), "kind"] == list(to_dict(EventPixel()))
    assert PixelChanges().applied(EventPixel(cutoff_hz=3)) == EventPixel(cutoff_hz=3)


def test_contrasts_of_data_sheets_become_thresholds() -> None:
    davis, gen4 = pixel_preset("davis346"), pixel_preset("prophesee_gen4")
    assert davis.threshold_on == pytest.approx(np.log(1.143), abs=1e-4)
    assert davis.threshold_off == pytest.approx(-np.log(1 - 0.225), abs=1e-4)
    # The maker counts from the darker light, up and down.
    assert gen4.threshold_on == gen4.threshold_off == pytest.approx(np.log(1.11), abs=1e-4)


def test_the_example_of_layered_time_stamps(tmp_path: Path, capsys, monkeypatch) -> None:
    pytest.importorskip("matplotlib")
    example = Path(__file__).parent.parent / "examples" / "03_layered_time_stamps.py"
    monkeypatch.setattr("sys.argv", [str(example), str(tmp_path / "layers.png")])
    runpy.run_path(str(example))  # asserts the two shares
    assert "100.00 % exactly on frame times" in capsys.readouterr().out
    with Image.open(tmp_path / "layers.png") as picture:
        assert picture.width > 1000


def test_a_still_video_has_no_events_and_still_a_file(tmp_path: Path, capsys) -> None:
    np.save(tmp_path / "clip.npy", np.full((5, 4, 6), 90, np.uint8))
    quiet = ["--pixel", "v2e_clean", "--preview", tmp_path / "look.png"]
    call("events", tmp_path / "clip.npy", "--fps", 10, "--out", tmp_path / "e.h5", *quiet)
    shown = capsys.readouterr()
    assert "0 events" in shown.out and "no events" in shown.err
    assert read_events(tmp_path / "e.h5").shape == (4, 6)
    assert not (tmp_path / "look.png").exists()


def test_wrong_videos_and_settings_leave_nothing(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", np.stack(moving_bar()))
    np.save("one.npy", np.stack(moving_bar(1)))
    broken = np.stack(moving_bar(80)).astype(np.float32)
    broken[75, 3, 4] = np.nan
    np.save("broken.npy", broken)
    Path("text.mp4").write_text("no video")
    Path("empty").mkdir()
    Path("there.h5").write_bytes(b"precious")
    before = left_in(tmp_path)

    def refuses(match: str, *arguments: object) -> None:
        line = fails(capsys, "events", *arguments)
        assert match in line, line
        assert left_in(tmp_path) == before

    good = ["clip.npy", "--fps", 30, "--out", "e.h5"]
    refuses("no such file", "absent.mp4", "--out", "e.h5")
    refuses("empty holds neither videos nor images; give a folder of videos, or", "empty", "--out", "e.h5")
    refuses("text.mp4: not a video", "text.mp4", "--out", "e.h5")
    refuses("1 frame", "one.npy", "--fps", 30, "--out", "e.h5")
    refuses("give --fps", "clip.npy", "--out", "e.h5")
    refuses("--start 100 leaves 0 of the frames of a video that ends at", *good, "--start", 100)
    refuses("davis346", *good, "--pixel", "davis364")
    refuses("does not exist", *good, "--pixel", "absent.yaml")
    refuses("threshold_on", *good, "--pixel.threshold-on", 0)
    refuses("events: cannot write a name without suffix; end its", "clip.npy", "--fps", 30, "--out", "events")
    refuses("or give --format, one of HDF5", "clip.npy", "--fps", 30, "--out", "events")
    refuses("suffix '.xyz'", "clip.npy", "--fps", 30, "--out", "e.xyz")
    refuses("give --fps", "clip.npy", "--out", "absent/e.h5")
    refuses("clip.npy is not an image; several files", "clip.npy", "text.mp4", "--fps", 30, "--out", "e.h5")
    refuses("--force", "clip.npy", "--fps", 30, "--out", "there.h5")
    refuses("scale", *good, "--scale", "large")
    refuses(".gif or .png", *good, "--preview", "look.jpg")
    refuses("NaN", "broken.npy", "--fps", 30, "--white", 255, "--out", "e.h5")  # events had been written
    refuses("no video", "--out", "e.h5")
    call("events", *good[:-1], "there.h5", "--force")
    assert len(read_events("there.h5")) > 100
    call("events", *good[:-1], "made/for/it.h5", "--preview", "and/look.png")
    assert read_events("made/for/it.h5") == read_events("there.h5") and Path("and/look.png").is_file()


def test_arrays_in_a_folder_are_videos(tmp_path: Path, capsys) -> None:
    (tmp_path / "arrays").mkdir()
    for name in ("a", "b"):
        np.save(tmp_path / f"arrays/{name}.npy", np.stack(moving_bar()))
    call("events", tmp_path / "arrays", "--fps", 30, "--out", tmp_path / "made/of/them")
    first, second = (read_events(tmp_path / f"made/of/them/{name}.npy.h5") for name in ("a", "b"))
    assert first == second and len(first) > 100


# ---- info


def test_info_says_what_a_recording_holds(tmp_path: Path, capsys) -> None:
    events = random_events(adc=True)
    write_events(tmp_path / "a.h5", events)
    call("info", tmp_path / "a.h5", "--json")
    found = json.loads(capsys.readouterr().out)
    assert (found["format"], found["width"], found["height"], found["geometry_from"]) == (
        "HDF5",
        40,
        30,
        "header",
    )
    assert (found["events"], found["first_us"], found["last_us"]) == (40_000, events.t_us[0], events.t_us[-1])
    assert found["rate_hz"] == pytest.approx(1e6 * 40_000 / events.duration_us, rel=1e-6)
    since = events.t_us - events.t_us[0]
    windows = np.bincount(since // 10_000)
    assert found["peak_10ms_hz"] == 100 * windows.max()
    assert found["peak_at_us"] == 10_000 * windows.argmax()
    assert found["on_fraction"] == pytest.approx(events.p.sum() / events.polarity_known.sum(), abs=1e-6)
    assert found["polarity_known_fraction"] == pytest.approx(events.polarity_known.mean(), abs=1e-6)
    gaps = np.diff(since)
    assert found["longest_silence_us"] == gaps.max()
    assert found["longest_silence_at_us"] == since[gaps.argmax()]
    counts = np.zeros((30, 40), int)
    np.add.at(counts, (events.y, events.x), 1)
    assert found["busiest_pixel"]["events"] == counts.max()
    assert counts[found["busiest_pixel"]["y"], found["busiest_pixel"]["x"]] == counts.max()
    assert found["active_pixel_fraction"] == 1.0
    assert found["columns"] == ["t_us", "x", "y", "p", "adc", "polarity_known"]
    assert found["memory_bytes"] == sum(column.nbytes for column in events.columns().values())
    assert found["faults"] == {}
    call("info", tmp_path / "a.h5")
    shown = capsys.readouterr().out
    assert "40 x 30 (from the file)" in shown and "40,000 in" in shown and "also adc" in shown
    assert "faults    none" in shown


def test_a_summary_does_not_depend_on_the_pieces() -> None:
    events = random_events(3000)
    whole = summarise([events])
    for size in (1, 7, 1000, 2999):
        pieces = [events[start : start + size] for start in range(0, 3000, size)]
        assert summarise([events[:0], *pieces]) == whole
    still = Events([5, 5, 30_005], [0, 0, 1], [0, 0, 0], [1, 1, 0], 2, 1)
    assert summarise([still]).silences == 1
    assert summarise([]).events == summarise([]).peak_hz == 0


def test_info_shows_damage_and_never_refuses_it(tmp_path: Path, capsys) -> None:
    write_events(tmp_path / "a.raw", random_events(), format="EVT2")
    (tmp_path / "cut.raw").write_bytes((tmp_path / "a.raw").read_bytes()[:-3])
    call("info", tmp_path / "cut.raw")
    shown = capsys.readouterr().out
    assert "1 truncated" in shown and "39,999 in" in shown
    said = fails(capsys, "convert", tmp_path / "cut.raw", "--out", tmp_path / "cut.h5")
    assert "or read it with evnlos convert --on-error salvage" in said and "on_error" not in said
    call("info", tmp_path / "cut.raw", "--json")
    assert json.loads(capsys.readouterr().out)["faults"] == {"truncated": 1}
    write_events(tmp_path / "none.h5", Events.empty(4, 3))
    call("info", tmp_path / "none.h5")
    assert "events    none" in capsys.readouterr().out
    (tmp_path / "text.h5").write_text("no recording")
    told = fails(capsys, "info", tmp_path / "text.h5")
    assert "text.h5 is text that begins with 'no recording', of no known event format; give a recording" in told
    (tmp_path / "text.h5").write_bytes(bytes(range(40)))
    assert "is binary data that begin with the bytes 00 01 02" in fails(capsys, "info", tmp_path / "text.h5")
    assert "no such file" in fails(capsys, "info", tmp_path / "absent.h5")
    assert f"{tmp_path} is a folder; give a file in it" in fails(capsys, "info", tmp_path)
    assert "is not a regular file but a device or a pipe" in fails(capsys, "info", "/dev/null")
    assert "both or neither" in fails(capsys, "info", tmp_path / "a.raw", "--width", 40)


def test_info_reads_piece_by_piece(tmp_path: Path, capsys, monkeypatch) -> None:
    """Whatever the length of the file, no piece is longer than a block."""
    with EventWriter(tmp_path / "long.raw", format="EVT2") as writer:
        for number in range(20):
            part = random_events()
            writer.write(Events(part.t_us + number * 2_000_000, part.x, part.y, part.p, 40, 30))
    lengths = [len(piece) for piece in Recording(tmp_path / "long.raw").pieces()]
    assert sum(lengths) == 800_000 and max(lengths) <= 262_144
    call("info", tmp_path / "long.raw", "--json")
    assert json.loads(capsys.readouterr().out)["events"] == 800_000


# ---- convert

# CeleX has no time zero, one sensor and its own clock: tests/test_event_files.py looks at it.
WRITTEN = [format for format in FORMATS if format.create and not format.name.startswith("CELEX")]


@pytest.mark.parametrize("format", WRITTEN, ids=lambda format: format.name)
def test_every_format_becomes_hdf5_and_comes_back(tmp_path: Path, capsys, format) -> None:
    if format.name == "AEDAT4":
        pytest.importorskip("aedat")
    events = random_events()
    write_events(tmp_path / "a.npz", events)
    there, back = tmp_path / f"b{format.suffixes[0]}", tmp_path / "c.h5"
    call("convert", tmp_path / "a.npz", "--out", there, "--format", format.name)
    assert "40,000 events" in capsys.readouterr().out
    call("convert", there, "--out", back)
    assert read_events(back) == events
    assert left_in(tmp_path) == {"a.npz", there.name, "c.h5"}


def test_a_part_of_a_recording(tmp_path: Path, capsys) -> None:
    events = random_events(adc=True)
    write_events(tmp_path / "a.h5", events)
    cut = ["--start", 0.5, "--stop", 1.25, "--box", 5, 10, 20, 12]
    call("convert", tmp_path / "a.h5", "--out", tmp_path / "b.h5", *cut)
    since = events.t_us - events.t_us[0]
    chosen = (since >= 500_000) & (since < 1_250_000)
    chosen &= (events.x >= 5) & (events.x < 25) & (events.y >= 10) & (events.y < 22)
    part = read_events(tmp_path / "b.h5")
    assert part.shape == (12, 20)
    for name, column in events.columns().items():
        shift = {"x": 5, "y": 10}.get(name, 0)
        np.testing.assert_array_equal(part.columns()[name], column[chosen] - shift if shift else column[chosen])
    call("convert", tmp_path / "a.h5", "--out", tmp_path / "c.raw", "--keep-known-polarity")
    kept = keep_known_polarity(events)
    assert read_events(tmp_path / "c.raw") == Events(kept.t_us, kept.x, kept.y, kept.p, 40, 30)
    call("convert", tmp_path / "a.h5", "--out", tmp_path / "none.h5", "--start", 100)
    assert read_events(tmp_path / "none.h5").shape == (30, 40)
    capsys.readouterr()


def test_the_sensor_size_can_be_given(tmp_path: Path, capsys) -> None:
    (tmp_path / "a.csv").write_text("x,y,p,t\n1,2,1,10\n3,0,0,20\n")
    call("convert", tmp_path / "a.csv", "--out", tmp_path / "b.h5")
    shown = capsys.readouterr()
    assert read_events(tmp_path / "b.h5").shape == (3, 4) and "--width" in shown.err
    call("convert", tmp_path / "a.csv", "--out", tmp_path / "b.h5", "--width", 8, "--height", 6, "--force")
    assert read_events(tmp_path / "b.h5").shape == (6, 8)
    assert "--width" not in capsys.readouterr().err


def test_damage_ends_a_conversion_unless_it_is_to_be_left_out(tmp_path: Path, capsys) -> None:
    events = random_events()
    write_events(tmp_path / "a.raw", events, format="EVT2")
    (tmp_path / "cut.raw").write_bytes((tmp_path / "a.raw").read_bytes()[:-3])
    before = left_in(tmp_path)
    assert "copy it again" in fails(capsys, "convert", tmp_path / "cut.raw", "--out", tmp_path / "b.h5")
    assert left_in(tmp_path) == before
    call("convert", tmp_path / "cut.raw", "--out", tmp_path / "b.h5", "--on-error", "salvage")
    assert "1 truncated" in capsys.readouterr().err
    assert read_events(tmp_path / "b.h5") == events[:-1]


def test_wrong_conversions_leave_nothing(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_events("a.h5", random_events(adc=True))
    Path("there.npz").write_bytes(b"precious")
    before = left_in(tmp_path)
    for match, *arguments in (
        ("--force", "a.h5", "--out", "there.npz"),
        ("the file that is read", "a.h5", "--out", "a.h5", "--force"),
        ("a name without suffix", "a.h5", "--out", "b"),
        ("format 'EVT9'", "a.h5", "--out", "b.raw", "--format", "EVT9"),
        ("no such file", "absent.h5", "--out", "b.h5"),
        ("leaves the sensor", "a.h5", "--out", "absent/b.h5", "--box", 30, 0, 20, 10),
        ("unknown polarity", "a.h5", "--out", "b.raw"),
        ("leaves the sensor", "a.h5", "--out", "b.h5", "--box", 30, 0, 20, 10),
        ("sides >= 1", "a.h5", "--out", "b.h5", "--box", 0, 0, 0, 10),
        ("after the start", "a.h5", "--out", "b.h5", "--start", 2, "--stop", 1),
        ("0 or more", "a.h5", "--out", "b.h5", "--start", -1),
        ("the sensor is 20 x 20", "a.h5", "--out", "b.h5", "--width", 20, "--height", 20),
    ):
        line = fails(capsys, "convert", *arguments)
        assert match in line, line
        assert left_in(tmp_path) == before
    assert Path("there.npz").read_bytes() == b"precious"


@pytest.mark.parametrize("size", [3, 1000, 70_000])
def test_a_cut_does_not_depend_on_the_blocks(tmp_path: Path, size: int, monkeypatch) -> None:
    events = random_events(6000)
    write_events(tmp_path / "a.h5", events)
    from evnlos.events.files.hdf5 import Hdf5Source

    blocks = Hdf5Source.blocks
    monkeypatch.setattr(Hdf5Source, "blocks", lambda self: blocks(self, size))
    cut = CropOptions(0.4, 0.5, Box(0, 3, 40, 20))
    pieces = list(Recording(tmp_path / "a.h5").pieces(cut))
    since = events.t_us - events.t_us[0]
    chosen = (since >= 400_000) & (since < 500_000) & (events.y >= 3) & (events.y < 23)
    np.testing.assert_array_equal(np.concatenate([piece.t_us for piece in pieces]), events.t_us[chosen])


# ---- preview


@pytest.mark.parametrize("style", ["polarity", "surface"])
@pytest.mark.parametrize("background", ["dark", "light"])
def test_preview_animates_or_prints(tmp_path: Path, capsys, style: str, background: str) -> None:
    write_events(tmp_path / "a.h5", random_events(5000, adc=True))
    look = ["--style", style, "--background", background]
    call("preview", tmp_path / "a.h5", "--out", tmp_path / "a.gif", *look, "--frames", 5)
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 5 and animation.width == 480
    call("preview", tmp_path / "a.h5", "--out", tmp_path / "a.png", *look, "--window-ms", 2, "--side", 80)
    with Image.open(tmp_path / "a.png") as sheet:
        assert sheet.size == (4 * 80 + 3 * 2, 2 * (60 + 26) + 2)
        corner = sheet.convert("RGB").getpixel((3, 60 + 24))
    assert (max(corner) < 30) == (background == "dark")
    capsys.readouterr()


def test_preview_takes_its_name_from_the_file(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_events("a.h5", random_events(500))
    call("preview", "a.h5", "--frames", 2)
    assert "a.gif: 2 images" in capsys.readouterr().out
    assert left_in(tmp_path) == {"a.h5", "a.gif"}


def test_wrong_previews_leave_nothing(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_events("a.h5", random_events(500))
    write_events("none.h5", Events.empty(4, 3))
    before = left_in(tmp_path)
    for match, *arguments in (
        (".gif or .png", "a.h5", "--out", "a.jpg"),
        ("no events to show", "none.h5", "--out", "absent/a.png"),
        ("no such file", "absent.h5"),
        ("no events to show", "none.h5"),
        ("no events to show", "a.h5", "--start", 99),
        ("frames", "a.h5", "--frames", 0),
        ("window_ms", "a.h5", "--window-ms", 0),
        ("side_px", "a.h5", "--side", 5),
    ):
        assert match in fails(capsys, "preview", *arguments)
        assert left_in(tmp_path) == before


def test_a_window_shows_each_event_at_its_place_in_its_colour() -> None:
    from evnlos.plot.preview import PreviewOptions, preview_images

    # Two windows of 10 ms: ON at (0, 0) and OFF at (3, 1); then an event without a polarity at (2, 0).
    known = [True, True, False]
    events = Events([0, 9_000, 20_000], [0, 3, 2], [0, 1, 0], [1, 0, 0], 4, 2, polarity_known=known)
    summary = summarise([events])
    for style in ("polarity", "surface"):
        look = PreviewOptions(style=style, frames=2, window_ms=10, side_px=64, background="light")
        first, second = (
            picture[:32].reshape(2, 16, 4, 16, 3) for picture in preview_images([events], summary, look)
        )
        for picture in (first, second):
            assert (picture == picture[:, :1, :, :1]).all()  # places of 16 x 16 pixels
        red, blue = first[0, 0, 0, 0].astype(int), first[1, 0, 3, 0].astype(int)
        assert red[0] > red[2] + 50 and blue[2] > blue[0] + 50
        grey = second[0, 0, 2, 0].astype(int)
        assert np.ptp(grey) < 20 and grey.max() < 100
        white = (first == 255).all(axis=-1)[:, 0, :, 0]
        np.testing.assert_array_equal(white, [[False, True, True, True], [True, True, True, False]])
        if style == "polarity":
            assert (second[1] == 255).all()


def test_large_sensors_are_added_up(tmp_path: Path) -> None:
    from evnlos.plot.preview import PreviewOptions, preview_images

    events = random_events(20_000, width=1280, height=720)
    pictures = preview_images([events], summarise([events]), PreviewOptions(frames=3, side_px=320))
    assert {picture.shape for picture in pictures} == {(180 + 26, 320, 3)}


def test_a_folder_in_place_of_a_recording_is_refused(tmp_path: Path, capsys, monkeypatch) -> None:
    """`preview .` ended in a traceback."""
    monkeypatch.chdir(tmp_path)
    for words in (
        ("preview", "."),
        ("clean", ".", "--out", "e.h5"),
        ("convert", ".", "--out", "e.h5"),
        ("info", "."),
    ):
        assert ". is a folder; give a file in it" in fails(capsys, *words)
    assert not left_in(tmp_path)


def test_what_a_damaged_array_lacks_is_named(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("cut.npy", np.zeros((9, 40, 60), np.uint8))
    Path("cut.npy").write_bytes(Path("cut.npy").read_bytes()[:4000])
    said = fails(capsys, "events", "cut.npy", "--fps", 5, "--out", "e.h5")
    assert "cut.npy: not a NumPy array of numbers, or cut short; save one" in said
    np.savez("float.npz", t=np.array([0.1, np.nan]), x=[1, 2], y=[1, 2], p=[1, 0])
    said = fails(capsys, "convert", "float.npz", "--out", "e.h5")
    assert "array t has dtype float64; give whole numbers, times in microseconds" in said
    assert left_in(tmp_path) == {"cut.npy", "float.npz"}
