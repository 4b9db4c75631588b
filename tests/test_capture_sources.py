"""Loose recordings as a laboratory produces them become captures: every source of frames, clock and pixels."""

import re
import shutil
import struct
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from evnlos import EvnlosError, import_captures, open_dataset, read_capture
from evnlos.cameras.video_files import from_light, to_light
from evnlos.cli import main
from evnlos.data import Capture, FixedPattern, Sampling, read_shard
from evnlos.data.capture_info import CameraInfo
from evnlos.data.frames import homography_from_points, read_image
from evnlos.errors import ConfigError
from evnlos.events import FrameStack, write_aedat4, write_celex_frames, write_events
from evnlos.plot.preview import check_image
from evnlos.types import Events
from ros_files import IMAGE, PACKET, Cdr, Recording, Ros1, event_array, image, write_bag, write_mcap

WIDTH, HEIGHT = 64, 48


def stream(
    width: int = WIDTH, height: int = HEIGHT, span_us: int = 2_000_000, count: int = 4_000, **extra
) -> Events:
    draw = np.random.default_rng(11)
    t = np.sort(draw.integers(0, span_us, count))
    return Events(
        t, draw.integers(0, width, count), draw.integers(0, height, count), draw.integers(0, 2, count),
        width, height, **extra,
    )  # fmt: skip


def pictures(count: int = 6, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    x = np.arange(width)
    rows = [np.exp(-((x - width * (0.3 + 0.05 * k)) ** 2) / 50) for k in range(count)]
    return np.round(200 * np.array(rows)[:, None, :] * np.ones((1, height, 1)) + 20).astype(np.uint8)


def folder_of(tmp_path: Path, name: str = "shot_A", **settings) -> Path:
    folder = tmp_path / name
    folder.mkdir()
    content = {"camera": {"width": WIDTH, "height": HEIGHT, "frame_rate_hz": 5.0}} | settings
    (folder / "capture.yaml").write_text(yaml.safe_dump(content))
    return folder


def test_a_celex_pair(tmp_path):
    """EI events and F images: one pixel grid; the images carry no time, the offset ties the clocks."""
    folder = folder_of(
        tmp_path,
        camera={"width": 1280, "height": 800, "frame_rate_hz": 10.0},
        events="shot_EI_100M.bin",
        frames="shot_F_100M.bin",
        alignment={"offset_us": 30_000},
        every=1,
    )
    events = stream(1280, 800, 500_000, adc=np.random.default_rng(0).integers(0, 4096, 4_000))
    write_events(folder / "shot_EI_100M.bin", events)
    frames = np.random.default_rng(1).integers(0, 255, (3, 800, 1280)).astype(np.uint8)
    write_celex_frames(folder / "shot_F_100M.bin", frames)
    recording = read_capture(folder)
    np.testing.assert_array_equal(recording.frames, frames)
    assert recording.frame_times_us.tolist() == [30_000, 130_000, 230_000]
    assert recording.events.polarity_known is None and len(recording.events) < len(events)
    assert any("without polarity left out" in note for note in recording.notes)
    import_captures([folder], tmp_path / "d")
    samples, _ = read_shard(open_dataset(tmp_path / "d").shard("shot_A"))
    assert samples.frame.shape == (2, 64, 96) and samples.truth is None
    # By default a million pixels are more than are used: the middle ones of squares of 5 x 5.
    usual = (folder / "capture.yaml").read_text().replace("every: 1\n", "")
    (folder / "capture.yaml").write_text(usual)
    fewer, whole = read_capture(folder), recording.events
    assert "every 5 rows and columns: 256 x 160 pixels" in fewer.notes
    assert fewer.frames.shape == (3, 160, 256) and fewer.frames.dtype == np.uint16
    means = frames.reshape(3, 160, 5, 256, 5).mean(axis=(2, 4)) / 255
    np.testing.assert_allclose(fewer.frames / fewer.peak, means, atol=1e-5)
    kept = (whole.x % 5 == 2) & (whole.y % 5 == 2)
    assert kept.any() and fewer.events.shape == (160, 256)
    for name, values in (("t_us", whole.t_us), ("x", whole.x // 5), ("y", whole.y // 5), ("p", whole.p)):
        np.testing.assert_array_equal(getattr(fewer.events, name), values[kept])


@pytest.mark.parametrize("every", [2, 3])
def test_each_second_or_third_row_and_column_is_used_of_a_region(tmp_path, every: int):
    """Rows and columns beyond the last whole square are left out."""
    folder = folder_of(
        tmp_path, events="e.npz", frames="frames", roi={"x": 3, "y": 1, "width": 11, "height": 7}
    )
    write_events(folder / "e.npz", stream(WIDTH, HEIGHT, 900_000))
    (folder / "frames").mkdir()
    frames = np.random.default_rng(1).integers(0, 255, (3, HEIGHT, WIDTH)).astype(np.uint8)
    for number, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / "frames" / f"{number}.png")
    whole = read_capture(folder)
    (folder / "capture.yaml").write_text((folder / "capture.yaml").read_text() + f"every: {every}\n")
    part, rows, columns = read_capture(folder), 7 // every, 11 // every
    assert part.frames.shape[1:] == part.events.shape == (rows, columns)
    squares = whole.frames[:, : rows * every, : columns * every].reshape(3, rows, every, columns, every)
    np.testing.assert_allclose(part.frames / part.peak, squares.mean(axis=(2, 4)) / whole.peak, atol=1e-5)
    middle, seen = every // 2, whole.events
    inside = (seen.x < columns * every) & (seen.y < rows * every)
    kept = inside & (seen.x % every == middle) & (seen.y % every == middle)
    np.testing.assert_array_equal(part.events.t_us, seen.t_us[kept])
    np.testing.assert_array_equal(part.events.x, seen.x[kept] // every)
    for wrong, words in ((0, "every is 0; give 1"), (17, "every is 17; give 1"), (9, "11 x 7 pixels are used")):
        text = (folder / "capture.yaml").read_text().replace(f"every: {every}", f"every: {wrong}")
        (folder / "capture.yaml").write_text(text)
        every = wrong
        with pytest.raises(EvnlosError, match=words):
            read_capture(folder)


def test_frames_of_0_to_1_are_told_what_a_capture_takes(tmp_path):
    folder = folder_of(tmp_path, events="e.h5", frames="f.npy")
    write_events(folder / "e.h5", stream())
    np.save(folder / "f.npy", pictures() / pictures().max())
    with pytest.raises(EvnlosError, match=r"is 1; save whole numbers of 16 bits.*white_dn") as caught:
        read_capture(folder)
    assert "--white" not in str(caught.value)
    np.save(folder / "f.npy", np.rint(4095 * (pictures() / pictures().max())).astype(np.uint16))
    text = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text(text.replace("width:", "white_dn: 4095\n  width:", 1))
    assert read_capture(folder).frames.max() == 65_535


def test_frames_that_are_not_finite_are_refused(tmp_path):
    folder = folder_of(tmp_path, events="e.h5", frames="f.npy")
    write_events(folder / "e.h5", stream())
    images = pictures().astype(np.float32)
    images[2, 3, 4] = np.nan
    np.save(folder / "f.npy", images)
    with pytest.raises(EvnlosError, match=r"f\.npy: frame 2 holds NaN or infinity"):
        read_capture(folder)


def test_an_aedat4_with_frames_and_events(tmp_path):
    pytest.importorskip("aedat")
    folder = folder_of(tmp_path, events="davis.aedat4", frames="davis.aedat4")
    write_aedat4(folder / "davis.aedat4", stream(), pictures(), np.arange(6) * 200_000 + 9)
    recording = read_capture(folder)
    np.testing.assert_array_equal(recording.frames, pictures())
    assert (
        recording.events == stream()
        and recording.frame_times_us.tolist() == (np.arange(6) * 200_000 + 9).tolist()
    )


def davis_bag(path: Path, topics=("/davis/events", "/davis/image_raw")) -> None:
    """Write a ROS 1 bag of a DAVIS: 2 s of events, 6 frames."""
    events, frames = stream(), pictures()
    messages: Recording = []
    for start in range(0, len(events), 500):
        one = events[start : start + 500]
        data = event_array((one.t_us * 1000).tolist(), one.x.tolist(), one.y.tolist(), one.p.tolist())
        messages.append((topics[0], "dvs_msgs/EventArray", int(one.t_us[-1]) * 1000, data))
    for k, frame in enumerate(frames):
        stamp = (k * 200_000 + 9) * 1000
        messages.append((topics[1], "sensor_msgs/Image", stamp, image(stamp, frame, make=Ros1)))
    write_bag(path, sorted(messages, key=lambda message: message[2]))


@pytest.mark.parametrize("name", ["shot_A.bag", "shot_A.aedat4"])
def test_one_file_of_events_and_frames_is_imported_by_one_command(name, tmp_path, capsys):
    path = tmp_path / name
    if name.endswith(".bag"):
        davis_bag(path)
    else:
        pytest.importorskip("aedat")
        write_aedat4(path, stream(), pictures(), np.arange(6) * 200_000 + 9)
    recording = read_capture(path)
    assert recording.name == "shot_A" and recording.events == stream()
    np.testing.assert_array_equal(recording.frames, pictures())
    assert recording.frame_times_us.tolist() == (np.arange(6) * 200_000 + 9).tolist()
    main(["import", str(path), "--out", str(tmp_path / "d"), "--no-check-images"])
    samples, _ = read_shard(open_dataset(tmp_path / "d").shard("shot_A"))
    assert samples.frame.shape == (5, 64, 96)
    main(["import", str(path), "--out", str(tmp_path / "d"), "--no-check-images"])  # nothing is left to do


def long_bag(path: Path, count: int, size=(96, 128)) -> Path:
    """Write a bag of as many events whatever the number of images, 1 ms apart."""
    draw = np.random.default_rng(1)
    t_us = np.sort(draw.integers(0, 40_000, 2_000))
    events = Events(t_us, draw.integers(0, 128, 2_000), draw.integers(0, 96, 2_000), t_us % 2 == 0, 128, 96)
    data = event_array(
        (t_us * 1000).tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), (128, 96)
    )
    messages: Recording = [("/events", "dvs_msgs/EventArray", 0, data)]
    for k in range(count):
        stamp = k * 1_000_000
        frame = draw.integers(0, 256, size).astype(np.uint8)
        messages.append(("/image", "sensor_msgs/Image", stamp, image(stamp, frame, make=Ros1)))
    return write_bag(path, messages)


@pytest.fixture
def little_held(monkeypatch):
    monkeypatch.setattr("evnlos.data.capture._HELD_BYTES", 1 << 17)
    monkeypatch.setattr("evnlos.data.sampling._BLOCK_BYTES", 1 << 21)
    # Columns are begun for as many events as a file has bytes; pages that no event reaches are never used.
    monkeypatch.setattr("evnlos.events.files.columns.memory_left", lambda: 0)


def test_the_memory_of_an_import_does_not_grow_with_the_frames(tmp_path, little_held):
    import_captures([long_bag(tmp_path / "first.bag", 4)], tmp_path / "d0")  # what is imported once, is
    peaks = []
    for count in (60, 600):
        path = long_bag(tmp_path / f"of{count}.bag", count)
        tracemalloc.start()
        import_captures([path], tmp_path / f"d{count}", look=check_image)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    held = 540 * 96 * 128  # of the frames that are more, as bytes
    assert peaks[1] - peaks[0] < 0.25 * held


def test_an_import_that_reads_frames_twice_makes_the_same_dataset(tmp_path, little_held, monkeypatch):
    path = long_bag(tmp_path / "shot_A.bag", 150)
    dark = np.zeros((96, 128), np.float32)
    how = {"sampling": Sampling(), "pattern": FixedPattern(dark + 1.5, dark + 0.1)}
    found: list[Capture] = []
    import_captures([path], tmp_path / "lazy", **how, look=found.append)
    monkeypatch.undo()
    import_captures([path], tmp_path / "held", **how, look=found.append)
    lazy, held = (read_shard(open_dataset(tmp_path / name).shard("shot_A"))[0] for name in ("lazy", "held"))
    for name in ("frame", "surface", "time_s", "event_count"):
        np.testing.assert_array_equal(getattr(lazy, name), getattr(held, name))
    assert isinstance(found[0].frames, FrameStack) and isinstance(found[1].frames, np.ndarray)
    stack, whole = found[0].frames, found[1].frames
    np.testing.assert_array_equal(stack, whole)
    np.testing.assert_array_equal(stack[3:7], whole[3:7])
    np.testing.assert_array_equal(stack[-1], whole[-1])
    np.testing.assert_array_equal(stack[[5, 9]], whole[[5, 9]])
    assert stack.mean() == whole.mean() and len(stack[7:7].shape) == 3 and not list(stack[7:7].blocks())


def test_frames_of_a_file_that_changed_meanwhile_are_refused(tmp_path):
    path = long_bag(tmp_path / "a.bag", 9)
    stack = read_capture(path, 1 << 14, lazy_frames=True).frames
    with pytest.raises(EvnlosError, match=r"its frames needs .* GB of memory"):
        read_capture(path, 1 << 14)
    for count in (6, 12):
        long_bag(path, count)
        with pytest.raises(EvnlosError, match="has changed while it was read"):
            np.asarray(stack)


def test_convert_tells_what_the_new_file_does_not_hold(tmp_path, capsys):
    davis_bag(tmp_path / "a.bag")
    main(["convert", str(tmp_path / "a.bag"), "--out", str(tmp_path / "a.h5")])
    told = capsys.readouterr().err
    assert (
        "a.h5 holds events alone, not the frames (/davis/image_raw; evnlos import" in told
        and "trigger" not in told
    )
    main(["clean", str(tmp_path / "a.bag"), "--out", str(tmp_path / "b.h5")])
    assert "b.h5 holds events alone" in capsys.readouterr().err


def test_a_file_that_is_not_there_is_told_so(tmp_path):
    with pytest.raises(EvnlosError, match=r"none\.bag: no such file; check the path"):
        import_captures([tmp_path / "none.bag"], tmp_path / "out")


def test_topics_of_a_capture_are_chosen(tmp_path):
    folder = folder_of(tmp_path, events="a.bag", frames="a.bag", events_topic="/davis/events")
    davis_bag(folder / "a.bag")
    assert read_capture(folder).events == stream()
    other = folder_of(tmp_path, "shot_B", events="a.bag", frames="a.bag", frames_topic="/none")
    davis_bag(other / "a.bag")
    with pytest.raises(EvnlosError, match="give one of: /davis/image_raw"):
        read_capture(other)


def test_frames_beside_evt3_come_on_the_clock_of_the_sensor(tmp_path):
    """The packets' stamps say how ROS time becomes the sensor's: EVT3 has a clock of its own."""
    events, frames = stream(), pictures()
    write_events(tmp_path / "words.raw", events)
    data = (tmp_path / "words.raw").read_bytes()
    words = np.frombuffer(data[data.index(b"% end\n") + 6 :], "<u2")
    starts = [*np.flatnonzero(words >> 12 == 8)[::20].tolist(), len(words)]
    offset_us = 1_700_000_000_000_000
    messages: Recording = []
    for seq, (start, stop) in enumerate(pairwise(starts)):
        part = words[start:stop]
        low = int(part[np.flatnonzero(part >> 12 == 6)[0]] & 0xFFF)
        stamp = (offset_us + (int(part[0] & 0xFFF) << 12 | low)) * 1000
        head = Cdr().header(stamp, "cam").put("I", HEIGHT).put("I", WIDTH).put("Q", seq).put("Q", 0)
        message = head.text("evt3").put("B", 0).data(part.tobytes()).message()
        messages.append(("/events", PACKET, stamp, message))
    for k, frame in enumerate(frames):
        stamp = (offset_us + k * 200_000 + 9) * 1000
        messages.append(("/image", IMAGE, stamp, image(stamp, frame)))
    write_mcap(tmp_path / "shot_C.mcap", messages)
    recording = read_capture(tmp_path / "shot_C.mcap")
    assert recording.events == events
    assert recording.frame_times_us.tolist() == (np.arange(6) * 200_000 + 9).tolist()


def test_a_raw_beside_a_folder_an_animation_or_an_array(tmp_path):
    frames = pictures()

    def save_images(path: Path) -> None:
        path.mkdir()
        for k, frame in enumerate(frames):
            Image.fromarray(frame).save(path / f"{k}.png")

    write = {
        "pictures": save_images,
        "video.gif": lambda path: Image.fromarray(frames[0]).save(
            path, save_all=True, append_images=[Image.fromarray(f) for f in frames[1:]], duration=200
        ),
        "frames.npy": lambda path: np.save(path, frames),
    }  # fmt: skip
    for name, save in write.items():
        folder = folder_of(tmp_path, name.split(".")[0], frames=name, alignment={"offset_us": 5_000})
        write_events(folder / "events.raw", stream())
        save(folder / name)
        recording = read_capture(folder)
        np.testing.assert_allclose(recording.frames / 65_535, frames / 255, atol=1e-4)
        np.testing.assert_array_equal(recording.frame_times_us, np.arange(6) * 200_000 + 5_000)
        assert recording.peak == 65_535


def test_a_video_with_times_of_its_own(tmp_path):
    av = pytest.importorskip("av")
    folder = folder_of(tmp_path, frames="clip.mkv")
    write_events(folder / "events.raw", stream())
    with av.open(str(folder / "clip.mkv"), "w") as container:
        video = container.add_stream("ffv1", rate=10)
        video.width, video.height, video.pix_fmt = WIDTH, HEIGHT, "gray"
        for picture in pictures():
            for packet in video.encode(av.VideoFrame.from_ndarray(picture, format="gray")):
                container.mux(packet)
        for packet in video.encode():
            container.mux(packet)
    recording = read_capture(folder)
    np.testing.assert_allclose(recording.frames / 65_535, pictures() / 255, atol=2e-3)
    np.testing.assert_allclose(recording.frame_times_us, np.arange(6) * 100_000, atol=1_000)


def test_frame_times_from_a_trigger(tmp_path):
    folder = folder_of(tmp_path, frames="frames.npy", alignment={"trigger_channel": 2, "offset_us": 7})
    words = [0x8000]
    for k in range(6):
        words += [0x6000 | (100 + 500 * k), 0xA201, 0x0005, 0x2807, 0x6000 | (110 + 500 * k), 0xA200, 0xA101]
    (folder / "events.raw").write_bytes(
        f"% evt 3.0\n% geometry {WIDTH}x{HEIGHT}\n".encode() + struct.pack(f"<{len(words)}H", *words)
    )
    np.save(folder / "frames.npy", pictures())
    assert read_capture(folder).frame_times_us.tolist() == [107 + 500 * k for k in range(6)]
    np.save(folder / "frames.npy", pictures(5))
    with pytest.raises(EvnlosError, match="6 rising edges on channel 2 for 5 frames"):
        read_capture(folder)


def test_a_camera_of_its_own_with_a_grid_of_dots(tmp_path):
    """Frames of 150 x 120 through a homography; both cameras saw 3 x 4 dots; a dark frame is taken away."""
    from test_capture_alignment import dots_image, project

    to_frame = np.array([[2.0, 0.1, 8.0], [-0.08, 2.1, 6.0], [1e-4, 2e-4, 1.0]])  # event pixels to frame pixels
    dark = np.random.default_rng(3).integers(5, 15, (120, 150)).astype(np.uint8)
    events_grid = np.array([[0.5, 0, -10], [0, 0.5, -8], [0, 0, 1]])  # of `dots_image` to event pixels
    on_events, _ = dots_image(events_grid, (HEIGHT, WIDTH), 3, 4, 24.0, 1.2)
    on_frame, _ = dots_image(to_frame @ events_grid, (120, 150), 3, 4, 24.0, 2.5)
    folder = folder_of(
        tmp_path,
        frames="frames.npy",
        registration={"dots": {"rows": 3, "columns": 4, "frame": "dots.png", "events": "dots.raw"}},
        dark="dark.png",
    )
    Image.fromarray((dark + 200 * on_frame).astype(np.uint8)).save(folder / "dots.png")
    Image.fromarray(dark).save(folder / "dark.png")
    counts = np.round(30 * on_events).astype(int)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    xs, ys = np.repeat(x, counts.ravel()), np.repeat(y, counts.ravel())
    write_events(folder / "dots.raw", Events(np.arange(len(xs)), xs, ys, np.ones(len(xs), bool), WIDTH, HEIGHT))
    # A light spot at the event pixel (40, 20).
    spot = project(to_frame, np.array([[40.0, 20.0]]))[0]
    v, u = np.mgrid[:120, :150]
    light = np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / (2 * 4.0**2))
    np.save(folder / "frames.npy", np.stack([(dark + 180 * light).astype(np.uint8)] * 3))
    write_events(folder / "events.raw", stream())
    recording = read_capture(folder)
    assert recording.frames.shape == (3, HEIGHT, WIDTH)
    weight = np.clip(recording.frames[0].astype(float) - recording.frames[0].max() * 0.2, 0, None)
    centre = (weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()
    np.testing.assert_allclose(centre, (40, 20), atol=0.3)
    assert any("3 x 4 dots (rms error 0." in note for note in recording.notes)
    assert any("dark.png" in note for note in recording.notes)


def test_points_region_and_filters(tmp_path):
    matrix = np.array([[0.5, 0.0, 2.0], [0.0, 0.5, 1.0], [0.0, 0.0, 1.0]])
    corners = [(0, 0), (120, 0), (120, 90), (0, 90)]
    points = [[*map(float, c), 0.5 * c[0] + 2, 0.5 * c[1] + 1] for c in corners]
    np.testing.assert_allclose(
        homography_from_points([p[:2] for p in points], [p[2:] for p in points]), matrix, atol=1e-9
    )
    recordings = []
    for name, registration in (("p", {"points": points}), ("h", {"homography": matrix.tolist()})):
        folder = folder_of(
            tmp_path, name, frames="frames.npy", registration=registration,
            roi={"x": 8, "y": 4, "width": 40, "height": 30},
            filters={"hot_pixel_factor": 5, "background_us": 100_000},
        )  # fmt: skip
        np.save(folder / "frames.npy", pictures(6, 128, 96))
        events = stream()
        hot = Events(
            np.arange(300) * 5_000, np.full(300, 20), np.full(300, 9), np.ones(300, bool), WIDTH, HEIGHT
        )
        order = np.argsort(np.concatenate([events.t_us, hot.t_us]), kind="stable")
        columns = (
            np.concatenate([events.columns()[n], hot.columns()[n]])[order] for n in ("t_us", "x", "y", "p")
        )
        write_events(folder / "events.raw", Events(*columns, WIDTH, HEIGHT))
        recordings.append(read_capture(folder))
    recording = recordings[0]
    assert recording.frames.shape == (6, 30, 40) and recording.events.shape == (30, 40)
    np.testing.assert_allclose(recording.frames, recordings[1].frames, atol=1)
    assert not ((recording.events.x == 12) & (recording.events.y == 5)).any()
    text = "; ".join(recording.notes)
    for said in (
        "1 hot pixels",
        "without support within 100 ms",
        "4 points (rms error 0.00",
        "region 40 x 30",
    ):
        assert said in text


def test_turned_frames_and_unknown_polarity(tmp_path):
    folder = folder_of(tmp_path, frames="frames.npy", frames_turned=True, events="events.h5")
    np.save(folder / "frames.npy", pictures()[:, ::-1, ::-1])
    write_events(folder / "events.h5", stream(polarity_known=np.zeros(4_000, bool)))
    recording = read_capture(folder)
    np.testing.assert_allclose(recording.frames / 65_535, pictures() / 255, atol=1e-4)
    assert len(recording.events) == 4_000 and any("no polarity" in note for note in recording.notes)


def test_the_check_image_shows_frame_events_and_curves(tmp_path):
    folder = folder_of(tmp_path, frames="frames.npy")
    np.save(folder / "frames.npy", pictures())
    write_events(folder / "events.raw", stream())
    sheet = np.asarray(check_image(read_capture(folder)))
    high = round(HEIGHT * 320 / WIDTH)
    panels = [sheet[48 : 48 + high, 12 + k * 332 : 332 + k * 332] for k in range(3)]
    assert (panels[0][..., 0] == panels[0][..., 1]).all()  # grey
    warmth = panels[1][..., 0].astype(int) - panels[1][..., 2]
    assert (warmth > 60).sum() > 1_000 and (warmth < -60).sum() > 1_000
    assert 200 < len(sheet) < 600


WRONG = {
    "no rate": ({"frames": "frames.npy", "camera": {"width": WIDTH, "height": HEIGHT}}, "frame_rate_hz"),
    "no registration": (
        {"frames": "frames.npy", "camera": {"width": 60, "height": 40, "frame_rate_hz": 5}},
        "registration",
    ),
    "two ways": ({"frames": "frames.npy", "registration": {"points": [], "homography": []}}, "points"),
    "few points": ({"frames": "frames.npy", "registration": {"points": [[0.0, 0.0, 0.0, 0.0]]}}, "at least 4"),
    "region": ({"frames": "frames.npy", "roi": {"x": 40, "y": 0, "width": 40, "height": 9}}, "leaves"),
    "uncertain clock": ({"frames": "frames.npy", "alignment": {"offset_us": "auto"}}, "uncertain"),
    "both clocks": (
        {"frames": "frames.npy", "alignment": {"offset_us": "auto", "trigger_channel": 1}},
        "one of them",
    ),
    "no trigger": ({"frames": "frames.npy", "alignment": {"trigger_channel": 1}}, "0 rising edges"),
    "missing dark": ({"frames": "frames.npy", "dark": "dark.png"}, "dark.png"),
    "missing frames": ({"frames": "clip.mp4"}, "clip.mp4"),
    "outside": ({"frames": "../clip.mp4"}, "outside"),
    "offset text": ({"frames": "frames.npy", "alignment": {"offset_us": "soon"}}, "offset_us"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_what_does_not_fit_is_one_line(what, tmp_path):
    settings, says = WRONG[what]
    folder = folder_of(tmp_path, **settings)
    np.save(folder / "frames.npy", pictures())
    write_events(
        folder / "events.raw",
        stream(60 if "60" in str(settings) else WIDTH, 40 if "60" in str(settings) else HEIGHT),
    )
    with pytest.raises(EvnlosError, match=says) as caught:
        read_capture(folder)
    assert "\n" not in str(caught.value)


def test_the_example_of_the_manual_is_a_description():
    from evnlos.config import from_dict
    from evnlos.data import CaptureInfo

    text = (Path(__file__).parent.parent / "docs" / "own_camera.md").read_text()
    info = from_dict(CaptureInfo, yaml.safe_load(text.split("```yaml")[1].split("```")[0]))
    assert info.alignment.offset_us == "auto" and len(info.registration.points) == 4
    assert info.roi.width == 560 and info.filters.background_us == 20_000 and info.motion.start_us == 1_250_000


def test_the_command_tells_what_it_did_and_draws_it(tmp_path, capsys):
    from evnlos.cli import main

    folder = folder_of(tmp_path, frames="frames.npy", alignment={"offset_us": 40_000})
    np.save(folder / "frames.npy", pictures())
    write_events(folder / "events.raw", stream())
    main(["import", str(folder), "--out", str(tmp_path / "d")])
    said = capsys.readouterr()
    assert "6 frames from frames.npy" in said.err and "shifted by 40000 us" in said.err
    assert str(tmp_path / "d" / "checks") in said.out
    with Image.open(tmp_path / "d" / "checks" / "shot_A.png") as sheet:
        assert sheet.size[0] > 900
    main(["import", str(folder), "--out", str(tmp_path / "e"), "--no-check-images"])
    assert not (tmp_path / "e" / "checks").exists()


def test_a_capture_that_was_recorded_anew_is_not_taken_for_the_old_one(tiny_captures, tmp_path, capsys) -> None:
    folder, other = tmp_path / "shot_A", next(one for one in tiny_captures if one.name != "lab_A")
    shutil.copytree(next(one for one in tiny_captures if one.name == "lab_A"), folder)
    (tmp_path / "lab.yaml").write_text("evnlos: rendered")  # the record beside captures is none
    words = ["import", str(tmp_path / "*"), "--out", str(tmp_path / "out" / "d"), "--no-check-images"]
    main(words)
    first = read_shard(tmp_path / "out" / "d" / "shot_A.h5")[0]
    assert "1 capture (1 train" in capsys.readouterr().out
    shutil.copy(other / "events.raw", folder / "events.raw")
    with pytest.raises(SystemExit) as stop:
        main([word.replace(str(tmp_path / "*"), str(folder)) for word in words])
    assert stop.value.code == 2 and "captures" in capsys.readouterr().err
    again = read_shard(tmp_path / "out" / "d" / "shot_A.h5")[0]
    np.testing.assert_array_equal(first.surface, again.surface)


@pytest.mark.parametrize("tone", ["srgb", "rec709"])
def test_frames_with_a_tone_curve_are_read_as_light(tiny_captures, tmp_path, tone) -> None:
    plain = read_capture(tiny_captures[0], needs_events=False)
    folder = shutil.copytree(tiny_captures[0], tmp_path / "phone")
    named = [line.split(",")[1] for line in (folder / "frames.csv").read_text().split()[1:]]
    for name, frame in zip(named, plain.frames, strict=True):
        Image.fromarray(from_light(frame.astype(float), tone)).save(folder / name)
    text = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text(text.replace("camera:\n", f"camera:\n  tone: {tone}\n", 1))
    found = read_capture(folder, needs_events=False)
    assert found.frames.dtype == np.uint16 and any(f"{tone} undone" in note for note in found.notes)
    light = to_light(np.arange(256, dtype=np.uint8), tone)  # steps between codes are what rounding costs
    off = np.abs(found.frames / 257.0 - plain.frames)
    assert off.max() <= np.diff(light).max() / 2 + 0.01
    coloured = np.stack([found.frames[0] >> 8] * 3, axis=-1).astype(np.uint8)
    Image.fromarray(coloured).save(tmp_path / "grey.png")  # of grey pixels, the same in any colour
    grey = read_image(tmp_path / "grey.png", tone=tone)
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png", colour="red", tone=tone), grey)
    raw = dict.fromkeys(("mosaic", "white_dn"))
    for key, value in (("mosaic", "rggb"), ("white_dn", 4095)):
        with pytest.raises(ConfigError, match=rf"camera.tone is {tone}.*{value}.*leave one out"):
            CameraInfo(8, 8, tone=tone, **(raw | {key: value}))


def test_a_video_with_a_tone_curve_is_read_as_light(tiny_captures, tmp_path) -> None:
    plain = read_capture(tiny_captures[0], needs_events=False)
    folder = shutil.copytree(tiny_captures[0], tmp_path / "phone")
    np.save(folder / "film.npy", from_light(plain.frames.astype(float), "srgb"))
    text = (folder / "capture.yaml").read_text().replace("frames: frames.csv", "frames: film.npy")
    (folder / "capture.yaml").write_text(text.replace("camera:\n", "camera:\n  tone: srgb\n", 1))
    found = read_capture(folder, needs_events=False)
    assert np.abs(found.frames / 257.0 - plain.frames).max() < 1.2
    (folder / "shots").mkdir()
    for k, frame in enumerate(plain.frames):
        Image.fromarray(frame).save(folder / "shots" / f"{k:03d}.jpg", quality=95)
    rate = 1e6 / np.diff(plain.frame_times_us).mean()
    for tone, told in (("srgb", "srgb undone"), ("null", "taken as linear: most need camera: {tone: srgb}")):
        about = text.replace("film.npy", "shots").replace("camera:\n", f"camera:\n  tone: {tone}\n", 1)
        about = re.sub(r"frame_rate_hz: .*", f"frame_rate_hz: {rate}", about)
        (folder / "capture.yaml").write_text(about)
        assert [note for note in read_capture(folder, needs_events=False).notes if told in note]
