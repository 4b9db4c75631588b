"""Videos as light: times, tone curves, sizes, kinds of files; their events are those of all frames at once."""

import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evnlos.cameras import EventPixel, simulate_events
from evnlos.cameras.video import open_video, to_light, video_events
from evnlos.errors import ConfigError, DataError, MissingDependencyError


def greys(values: list[int], shape: tuple[int, int] = (48, 64)) -> list[np.ndarray]:
    """Return one even colour image [H, W, 3] for each value."""
    return [np.full((*shape, 3), value, np.uint8) for value in values]


def write_container(path: Path, pictures: list[np.ndarray], times_ms: list[int], rotation: int = 0) -> Path:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=1000)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        if rotation:
            if not hasattr(stream, "set_display_rotation"):
                pytest.skip("this PyAV cannot write a rotation")
            stream.set_display_rotation(rotation)
        for picture, time_ms in zip(pictures, times_ms, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_animation(path: Path, pictures: list[np.ndarray], durations_ms: list[int]) -> Path:
    images = [Image.fromarray(picture) for picture in pictures]
    lossless = {"lossless": True} if path.suffix == ".webp" else {}
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations_ms, **lossless)
    return path


def read(*args: object, **kwargs: object) -> tuple[list[float], np.ndarray]:
    times_s, light = zip(*open_video(*args, **kwargs), strict=True)
    return list(times_s), np.stack(light)


@pytest.mark.parametrize(("ending", "first_ms"), [(".mp4", 5), (".mkv", 5), (".avi", 0)])
def test_a_video_file_gives_its_own_times_whatever_their_spacing(
    tmp_path: Path, ending: str, first_ms: int
) -> None:
    values, times_ms = [16, 90, 200, 235, 255], [first_ms, 20, 30, 71, 200]
    path = write_container(tmp_path / f"clip{ending}", greys(values), times_ms)
    video = open_video(path)
    assert (video.width, video.height) == (64, 48)
    times_s, light = read(path)
    np.testing.assert_allclose(times_s, (np.array(times_ms) - first_ms) / 1000, atol=1e-9)
    assert light.dtype == np.float32
    np.testing.assert_allclose(light.mean(axis=(1, 2)), values, atol=4)  # the encoder loses a little


@pytest.mark.parametrize(("degrees", "corner"), [(0, "top left"), (90, "bottom left"), (-90, "top right")])
def test_a_video_is_turned_as_its_file_says(tmp_path: Path, degrees: int, corner: str) -> None:
    """A mark on the top left: turned by 90 degrees counterclockwise it is on the bottom left."""
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:16, :16] = 255
    path = write_container(tmp_path / "clip.mp4", [picture] * 2, [0, 40], degrees)
    light = read(path)[1][0]
    assert light.shape == ((32, 64) if degrees == 0 else (64, 32))
    marked = {
        "top left": light[:16, :16],
        "bottom left": light[-16:, :16],
        "top right": light[:16, -16:],
        "bottom right": light[-16:, -16:],
    }
    assert max(marked, key=lambda name: marked[name].mean()) == corner


def test_fps_and_slow_motion_set_the_times(tmp_path: Path) -> None:
    path = write_container(tmp_path / "clip.mp4", greys([10, 20, 30]), [0, 40, 80])
    assert read(path, fps=10)[0] == pytest.approx([0, 0.1, 0.2])
    assert read(path, slow_motion=8)[0] == pytest.approx([0, 0.005, 0.010])
    assert read(path, fps=10, slow_motion=0.5)[0] == pytest.approx([0, 0.2, 0.4])


@pytest.mark.parametrize("ending", [".gif", ".png", ".webp"])
def test_an_animation_gives_the_sums_of_its_durations(tmp_path: Path, ending: str) -> None:
    values = [10, 60, 250, 0]
    path = write_animation(tmp_path / f"clip{ending}", greys(values), [40, 120, 80, 40])
    times_s, light = read(path)
    assert times_s == pytest.approx([0, 0.04, 0.16, 0.24])
    np.testing.assert_array_equal(light[:, 0, 0], values)


def test_images_are_ordered_by_the_numbers_in_their_names(tmp_path: Path) -> None:
    for number in (1, 2, 10, 9):
        Image.fromarray(np.full((4, 6), number, np.uint8)).save(tmp_path / f"frame_{number}.png")
    (tmp_path / "notes.txt").write_text("no image")
    given = sorted(tmp_path.glob("*.png"))
    for path in (tmp_path, str(tmp_path / "*.png"), given):
        times_s, light = read(path, fps=4)
        assert times_s == [0, 0.25, 0.5, 0.75]
        np.testing.assert_array_equal(light[:, 0, 0], [1, 2, 9, 10])


def test_deep_images_keep_their_fractions(tmp_path: Path) -> None:
    ramp = np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000
    for number in range(2):
        Image.fromarray(ramp + number).save(tmp_path / f"{number}.png")
    np.testing.assert_allclose(read(tmp_path, fps=1)[1][1], (ramp + 1) / 257, rtol=1e-6)
    Image.fromarray(ramp.astype(np.uint8)).save(tmp_path / "2.png")
    with pytest.raises(DataError, match="one depth"):
        read(tmp_path, fps=1)
    wide = tmp_path / "wide"
    wide.mkdir()
    for number in range(2):
        Image.fromarray(ramp.astype(np.int32) * 10).save(wide / f"{number}.tif")
    with pytest.raises(DataError, match="16 bits"):
        read(wide, fps=1)


def test_arrays_of_every_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    grey = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    colour = np.repeat(grey[..., None], 3, axis=-1)
    for array, options in (
        (grey, {}),
        (colour, {}),
        (grey.astype(np.uint16) * 257, {}),
        (grey.astype(np.float64), {}),
        (grey / 255.0, {"white": 1.0}),
        ((colour / 255.0).astype(np.float32), {"white": 1.0}),
        (grey.astype(np.uint16) * 4, {"white": 1020}),
    ):
        np.save(path, array)
        np.testing.assert_allclose(read(path, fps=30, **options)[1], grey, atol=1e-4)


def encoded(light: np.ndarray, tone: str) -> np.ndarray:
    """Return the codes of light, both in fractions of white: the curves as their standards state them."""
    if tone == "srgb":
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)


@pytest.mark.parametrize("tone", ["srgb", "rec709"])
def test_a_tone_curve_is_undone(tone: str) -> None:
    light = np.linspace(0, 1, 101)[None]
    found = to_light(encoded(light, tone).astype(np.float64), tone, white=1.0)
    np.testing.assert_allclose(found / 255, light, atol=3e-4)  # the standards' constants are rounded
    codes = np.arange(256, dtype=np.uint8)[None]
    eight = to_light(codes, tone)
    assert eight[0, 0] == 0 and eight[0, 255] == pytest.approx(255)
    np.testing.assert_allclose(eight, to_light(codes / 255.0, tone, white=1.0), rtol=1e-5)
    assert (np.diff(eight) > 0).all()


def test_colours_are_weighed_by_luma_or_luminance() -> None:
    primaries = 255 * np.eye(3, dtype=np.uint8)[None]  # red, green, blue
    np.testing.assert_allclose(to_light(primaries), 255 * np.array([[0.299, 0.587, 0.114]]), rtol=1e-6)
    np.testing.assert_allclose(
        to_light(primaries, "srgb"), 255 * np.array([[0.2126, 0.7152, 0.0722]]), rtol=1e-5
    )
    grey = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=-1)
    np.testing.assert_array_equal(to_light(grey)[0], np.arange(256))


def test_light_is_averaged_where_it_shrinks(tmp_path: Path) -> None:
    array = np.random.default_rng(1).uniform(0, 255, (2, 12, 20)).astype(np.float32)
    np.save(tmp_path / "a.npy", array)
    blocks = array.reshape(2, 3, 4, 5, 4).mean(axis=(2, 4))
    for scale in ("5x3", "0.25"):
        np.testing.assert_allclose(read(tmp_path / "a.npy", fps=1, scale=scale)[1], blocks, rtol=1e-4)
    assert read(tmp_path / "a.npy", fps=1, scale="40x30")[1].shape == (2, 30, 40)


@pytest.mark.parametrize(("mode", "jitter_s"), [("exact", 0.0), ("exact", 0.004), ("v2e", 0.0)])
def test_the_pieces_are_the_events_of_all_frames_at_once(mode: str, jitter_s: float) -> None:
    rng = np.random.default_rng(3)
    walk = 120 + 40 * np.cumsum(rng.normal(size=(150, 6, 7)), axis=0) / np.arange(1, 151)[:, None, None]
    frames = np.maximum(walk, 0).astype(np.float32)
    times_s = np.cumsum(rng.uniform(0.005, 0.02, 150))
    pixel = EventPixel(shot_noise_rate_hz=20, leak_rate_hz=2, jitter_s=jitter_s, cutoff_hz=200)
    whole = simulate_events(frames, times_s, pixel, mode=mode, seed=5)  # type: ignore[arg-type]
    before = frames.copy()
    pieces = list(video_events(zip(times_s, frames, strict=True), pixel, mode, 5))  # type: ignore[arg-type]
    assert len(pieces) == 4 and len(pieces[0]) and len(pieces[1])
    for name, column in whole.columns().items():
        np.testing.assert_array_equal(np.concatenate([piece.columns()[name] for piece in pieces]), column)
    np.testing.assert_array_equal(frames, before)


def test_a_piece_comes_before_the_video_ends() -> None:
    seen = []

    def endless():
        for number in range(10**9):
            seen.append(number)
            yield number * 0.01, np.full((8, 8), 60.0 + 50 * (number % 2), np.float32)

    pieces = video_events(endless())
    assert len(next(pieces)) > 0
    assert len(seen) <= 64
    next(pieces)
    assert len(seen) <= 128


def test_what_is_no_video_is_refused_in_one_sentence(tmp_path: Path, monkeypatch) -> None:
    def refuses(path: object, match: str, error: type = DataError, **kwargs: object) -> None:
        with pytest.raises(error, match=match) as caught:
            list(open_video(path, **kwargs))  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)

    picture = Image.fromarray(np.zeros((4, 6), np.uint8))
    picture.save(tmp_path / "one.png")
    refuses(tmp_path / "absent.mp4", "no such file")
    refuses(tmp_path / "*.gif", "matches nothing")
    refuses(tmp_path / "one.png", "1 frame;")
    refuses([tmp_path / "one.png", tmp_path / "two.png"], "two.png: no such file", fps=1)
    refuses([], "no video")
    (tmp_path / "empty").mkdir()
    refuses(tmp_path / "empty", "without images")
    (tmp_path / "text.gif").write_text("no image")
    refuses(tmp_path / "text.gif", "not an image")
    (tmp_path / "text.npy").write_text("no array")
    refuses(tmp_path / "text.npy", "not a NumPy array", fps=1)
    Image.fromarray(np.zeros((5, 6), np.uint8)).save(tmp_path / "two.png")
    refuses(tmp_path, "one size", fps=1)
    refuses(tmp_path, "give fps")
    for array, match in (
        (np.zeros((4, 6)), "shape"),
        (np.zeros((3, 4, 6, 4)), "shape"),
        (np.zeros((3, 4, 6), complex), "complex128"),
        (np.zeros((1, 4, 6)), "1 frame"),
        (np.full((3, 4, 6), 0.5), "white=1"),
    ):
        np.save(tmp_path / "a.npy", array)
        refuses(tmp_path / "a.npy", match, fps=1)
    np.save(tmp_path / "a.npy", np.zeros((3, 4, 6), np.uint8))
    for options in ({"fps": 0}, {"fps": np.nan}, {"slow_motion": -1}, {"white": 0}, {"tone": "gamma"}):
        refuses(tmp_path / "a.npy", next(iter(options)), ConfigError, **{"fps": 1, **options})
    for scale in ("x", "0x4", "12x", "0", "-1", "1e9", "nan"):
        refuses(tmp_path / "a.npy", "scale", ConfigError, fps=1, scale=scale)
    still = write_animation(tmp_path / "still.gif", greys([0, 9, 20], (4, 6)), [0, 0, 0])
    refuses(still, "frame 1 is at 0.000000 s")
    assert read(still, fps=5)[0] == pytest.approx([0, 0.2, 0.4])
    with pytest.raises(DataError, match="at least two"):
        list(video_events([(0.0, np.zeros((2, 2)))]))
    with pytest.raises(DataError, match="one size"):
        list(video_events([(0.0, np.zeros((2, 2))), (1.0, np.zeros((2, 3)))]))
    (tmp_path / "text.mp4").write_text("no video")
    monkeypatch.setitem(sys.modules, "av", None)
    refuses(tmp_path / "text.mp4", r'pip install "evnlos\[video\]"', MissingDependencyError)


def test_a_damaged_video_file_is_refused_in_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("av")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(DataError, match="not a video"):
        open_video(tmp_path / "text.mp4")
    noise = np.random.default_rng(0).integers(0, 255, (12, 48, 64, 3), dtype=np.uint8)
    whole = write_container(tmp_path / "clip.mp4", list(noise), list(range(0, 480, 40))).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"cut\.mp4"):
        list(open_video(tmp_path / "cut.mp4"))
