"""Captures: the shared ones under the standard sample, rendered ones, all that can be wrong with a folder."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from evnlos import EvnlosError, import_captures, open_dataset, read_capture
from evnlos.config import from_dict
from evnlos.data import (
    Capture,
    CaptureInfo,
    Sampling,
    capture_samples,
    character_of,
    read_shard,
    reduce_by_area,
)
from evnlos.errors import ConfigError, DataError
from watching import Watch, stopped


@pytest.fixture
def capture(tiny_captures, tmp_path) -> Path:
    return Path(shutil.copytree(tiny_captures[0], tmp_path / "near_A"))


def test_a_rendered_capture_reads_back(tiny_captures) -> None:
    recording = read_capture(tiny_captures[0])
    assert (recording.name, recording.target.name) == ("lab_A", "A")
    assert recording.frames.shape == (9, 48, 72)
    np.testing.assert_array_equal(recording.frame_times_us, np.arange(9) * 1_000_000)
    assert recording.events.shape == (48, 72)
    assert len(recording.events) > 1000
    np.testing.assert_allclose(recording.scene.motion.position_m(4.0), (0.0, 0.0), atol=1e-12)


def test_the_standard_sample_of_a_shared_capture(shared_data) -> None:
    folder = shared_data / "captures" / "near_F"
    recording = read_capture(folder)
    samples = capture_samples(recording, Sampling())
    assert samples.frame.shape == (40, 64, 96)
    np.testing.assert_allclose(samples.time_s, np.arange(1, 41) * 0.2)
    np.testing.assert_allclose(samples.position_m[:, 0], -0.08 + 0.004 * np.arange(1, 41), atol=1e-9)
    picture = np.asarray(Image.open(folder / "frames" / "0007.png"), dtype=np.float64) / 255
    np.testing.assert_allclose(samples.frame[6], reduce_by_area(picture, (64, 96)), atol=1e-6)
    # The definition of the surface, pixel by pixel: last event of each polarity up to the frame's time.
    t, x, y, p = recording.events.t_us, recording.events.x, recording.events.y, recording.events.p
    expected = np.zeros((2, 100, 160))
    for i in range(int(np.searchsorted(t, 1_400_000, side="right"))):
        expected[0 if p[i] else 1, y[i], x[i]] = np.exp(-(1.4e6 - t[i]) / 0.2e6)
    np.testing.assert_allclose(samples.surface[6], reduce_by_area(expected, (64, 96)), atol=2e-6)
    # The truth is the target: 8 cm of a canvas of 24 cm, in the middle at 4 s.
    target = np.asarray(Image.open(folder / "target.png"), dtype=np.float64) / 255
    np.testing.assert_allclose(
        samples.truth[19, 16:48, 32:64], target.reshape(32, 8, 32, 8).mean(axis=(1, 3)), atol=1e-6
    )
    assert samples.truth[19].sum() == pytest.approx(target.mean() * 32 * 32, rel=1e-5)


def test_every_shared_capture_imports(shared_data, tmp_path) -> None:
    pytest.importorskip("aedat", reason="the far captures need the extra [aedat]")
    folders = [shared_data / "captures" / name for name in ("near_G", "near_S", "far_G", "far_S")]
    import_captures(folders, tmp_path / "d", test=["G"])
    dataset = open_dataset(tmp_path / "d")
    assert dataset.split == {"train": ["near_S", "far_S"], "validation": [], "test": ["near_G", "far_G"]}
    for name in dataset.objects():
        samples, _ = read_shard(dataset.shard(name))
        assert len(samples) == 40
        assert samples.event_count.min() > 100


def test_import_is_resumable_and_refuses_other_captures(tiny_captures, tmp_path) -> None:
    stopped(import_captures, tiny_captures, tmp_path / "d", test=["4"], after=1)
    assert len(open_dataset(tmp_path / "d").missing()) == 3
    watch = Watch()
    assert import_captures(tiny_captures, tmp_path / "d", test=["4"], progress=watch).missing() == []
    assert len(watch.results) == 3
    with pytest.raises(EvnlosError, match="other settings"):
        import_captures(tiny_captures[:3], tmp_path / "d")


def test_a_changed_description_is_another_dataset(capture, tmp_path) -> None:
    import_captures([capture], tmp_path / "d")
    import_captures([capture], tmp_path / "d")
    _edit("capture.yaml", "events: events.raw", "events: events.raw\nfilters: {background_us: 5000}")(capture)
    with pytest.raises(EvnlosError, match="other settings"):
        import_captures([capture], tmp_path / "d")


def test_held_out_names_must_exist_and_not_overlap(tiny_captures, tmp_path) -> None:
    with pytest.raises(EvnlosError, match="no capture is named Z"):
        import_captures(tiny_captures, tmp_path / "d", test=["Z"])
    with pytest.raises(EvnlosError, match="choose one"):
        import_captures(tiny_captures, tmp_path / "d", test=["A"], validation=["lab_A"])
    assert not (tmp_path / "d").exists()


def test_events_are_not_solved_without_a_setup(tiny_captures, tmp_path) -> None:
    with pytest.raises(ConfigError):
        import_captures(tiny_captures, tmp_path / "d", Sampling(surface="likelihood"))
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("kind", [list, tuple, iter, lambda folders: (folder for folder in folders)])
def test_two_captures_of_one_name_are_refused_however_they_are_given(kind, tiny_captures, tmp_path) -> None:
    twin = tmp_path / "other" / tiny_captures[0].name
    shutil.copytree(tiny_captures[0], twin)
    with pytest.raises(DataError):
        import_captures(kind([tiny_captures[0], twin]), tmp_path / "d")
    with pytest.raises(DataError):
        import_captures(kind([tiny_captures[0], tiny_captures[0]]), tmp_path / "d")
    with pytest.raises(DataError):
        import_captures(kind([]), tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_an_unknown_target_gives_samples_without_truth_but_its_motion_counts(capture) -> None:
    text = (capture / "capture.yaml").read_text()
    (capture / "capture.yaml").write_text(text.replace("  mask: target.png\n", ""))
    recording = read_capture(capture)
    samples = capture_samples(recording, Sampling())
    assert samples.truth is None and samples.frame.shape == (8, 64, 96)
    np.testing.assert_array_equal(samples.position_m, recording.motion.position_m(samples.time_s))
    still = replace(recording, info=replace(recording.info, motion=None))
    assert capture_samples(still, Sampling()).position_m is None


def _edit(name: str, old: str, new: str):
    def edit(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return edit


DAMAGE = {
    "no capture.yaml": (lambda f: (f / "capture.yaml").unlink(), "capture.yaml"),
    "unknown key": (_edit("capture.yaml", "size_m", "side_m"), "size_m"),
    "wrong type": (_edit("capture.yaml", "width: 72", "width: wide"), "camera.width"),
    "missing events": (lambda f: (f / "events.raw").unlink(), "events.raw"),
    "empty events": (lambda f: (f / "events.raw").write_bytes(b""), "events.raw"),
    "cut events": (
        lambda f: (f / "events.raw").write_bytes((f / "events.raw").read_bytes()[:-1]),
        "events.raw",
    ),
    "outside": (_edit("capture.yaml", "mask: target.png", "mask: ../../secret.png"), "outside"),
    "missing frame": (lambda f: (f / "frames/0003.png").unlink(), "0003.png"),
    "no image": (lambda f: (f / "frames/0003.png").write_text("hello"), "as an image"),
    "small frame": (lambda f: Image.new("L", (70, 48)).save(f / "frames/0003.png"), "70 x 48"),
    "times": (_edit("frames.csv", "3000000", "2000000"), "ascend"),
    "time text": (_edit("frames.csv", "3000000", "three"), "whole number"),
    "no frames": (lambda f: (f / "frames.csv").write_text("t_us,file\n"), "no frames"),
    "too wide": (_edit("capture.yaml", "width: 72", "width: 71"), "71"),
    "nan": (_edit("capture.yaml", "speed_m_s: 0.02", "speed_m_s: .nan"), "speed_m_s"),
    "none": (_edit("capture.yaml", "events: events.raw", "events: none"), "takes none for the name of a file"),
    "nothing": (
        _edit("capture.yaml", "events: events.raw\nframes: frames.csv", "events: null\nframes: null"),
        r"capture\.yaml: events and frames are null; state one of them",
    ),
    "no distance": (
        _edit("capture.yaml", "distance_m: 0.3", "distance_m: -0.3"),
        r"capture\.yaml: setup\.distance_m is -0\.3; give a finite number of metres above 0, or null",
    ),
    "nan distance": (_edit("capture.yaml", "distance_m: 0.3", "distance_m: .nan"), "distance_m is nan; give a"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_capture_is_a_one_line_error_and_writes_nothing(damage: str, capture, tmp_path) -> None:
    break_it, says = DAMAGE[damage]
    break_it(capture)
    with pytest.raises(EvnlosError, match=says) as caught:
        import_captures([capture], tmp_path / "d")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("kept", [(), ("notes.txt",)])
def test_an_import_on_a_full_disk_leaves_what_was_there(kept, tiny_captures, tmp_path, monkeypatch) -> None:
    (out := tmp_path / "a" / "d").mkdir(parents=True)

    def full(path, *_, **__):
        (out / "checks").mkdir()
        (out / "checks" / "drawn.png").write_bytes(b"")
        for name in kept:
            (out / name).write_text("mine")
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("evnlos.data.capture.write_shard", full)
    with pytest.raises(OSError, match="No space left"):
        import_captures(tiny_captures[:1], out)
    left = {one.name for one in out.iterdir()}
    assert left == ({"notes.txt", "checks", "dataset.yaml", ".lock"} if kept else set())


def test_an_import_that_fails_later_goes_on(tiny_captures, tmp_path, monkeypatch) -> None:
    from evnlos.data.store import write_shard

    def fails(path, *args, **more):
        if "first" in done:
            raise OSError(28, "No space left on device", str(path))
        done.append("first")
        write_shard(path, *args, **more)

    done: list[str] = []
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr("evnlos.data.capture.write_shard", fails)
        import_captures(tiny_captures[:2], tmp_path / "d")
    assert len(list((tmp_path / "d").glob("*.h5"))) == 1 and (tmp_path / "d" / "dataset.yaml").is_file()
    assert not import_captures(tiny_captures[:2], tmp_path / "d").missing()


def test_a_capture_without_events_is_refused(capture, tmp_path) -> None:
    from evnlos import Events, write_events

    write_events(capture / "events.raw", Events.empty(72, 48))
    with pytest.raises(EvnlosError, match="no event"):
        read_capture(capture)


def test_characters_of_names() -> None:
    assert [character_of(n) for n in ("near_R", "writer03_A", "plain")] == ["R", "A", "plain"]


def test_a_capture_states_a_motion_in_space() -> None:
    motion = {"start_m": -0.05, "speed_m_s": 0.02, "retreat_m_s": 0.01, "spin_deg_s": 5.0, "start_us": 500_000}
    info = from_dict(
        CaptureInfo, {"camera": {"width": 8, "height": 4}, "motion": motion, "setup": {"distance_m": 0.3}}
    )
    pose = Capture.motion.fget(SimpleNamespace(info=info, distance_m=0.3)).pose(1.5)
    assert float(pose.z_m) == pytest.approx(0.31) and float(pose.rotation_rad) == pytest.approx(np.radians(5))
