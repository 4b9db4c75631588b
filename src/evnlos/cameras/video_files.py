"""Files of moving images, frame by frame as light.

- Numbers of an image as light: the tone curve undone, colours weighed.
- The four kinds of moving images that are read: containers, animations, single images, arrays.
- Light as numbers of an image, and frames as a video file.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from itertools import chain, count, pairwise
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from evnlos.errors import ConfigError, DataError, MissingDependencyError
from evnlos.files import new_file, new_folder
from evnlos.types import COLOURS, LUMA_601, Colour
from evnlos.untrusted import MOST_IMAGE_PIXELS, NUMPY_ERRORS, open_container, open_image, open_regular

Picture = NDArray
"""Grey [H, W] or colour [H, W, 3]: uint8, uint16 or floating point."""
Tone = Literal["as-is", "srgb", "rec709"]
"""What the numbers of an image mean: light as they are, or codes of a tone curve to undo."""

_OF_EVENTS = (".raw", ".h5", ".npz", ".aedat", ".aedat4", ".bag", ".db3", ".mcap", ".bin", ".csv", ".dat")
_GIF_FPS = 50  # viewers slow down images of less than two hundredths of a second
_LUMINANCE_709 = 0.2126, 0.7152, 0.0722


def to_light(
    picture: Picture, tone: Tone = "as-is", white: float = 255.0, colour: Colour | None = None
) -> NDArray[np.float32]:
    """Return an image as light in DN: 255 = white.

    With the value v = image / white, "as-is" gives 255 v; "srgb" gives 255 times v / 12.92 up to 0.04045 and
    ((v + 0.055) / 1.055)^2.4 above (IEC 61966-2-1); "rec709" v / 4.5 up to 0.081 and
    ((v + 0.099) / 1.099)^(1 / 0.45) above (ITU-R BT.709).

    Args:
        picture: Grey [H, W] or colour [H, W, 3]; uint8, uint16 or floating point.
        tone: Curve to undo.
        white: Value of white.
        colour: Colour to take; None weighs all of them.

    Example:
        >>> to_light(np.array([[0, 188, 255]], np.uint8), "srgb").round(1)
        array([[  0. , 128.2, 255. ]], dtype=float32)
    """
    if colour is not None and picture.ndim == 3:
        picture = picture[..., COLOURS.index(colour)]
    if tone == "as-is":
        if picture.ndim == 3:
            # In whole numbers: of a grey pixel the sum is exactly its value.
            weights = np.array(LUMA_601, np.int32 if picture.dtype.kind == "u" else np.float64)
            picture = (picture @ weights) / 1000.0  # [H, W]
        return (picture * (255.0 / white)).astype(np.float32)
    if picture.dtype.kind == "u":
        codes = np.arange(np.iinfo(picture.dtype).max + 1) / white
        linear = _decoded(codes, tone).astype(np.float32)[picture]
    else:
        linear = _decoded(picture / white, tone).astype(np.float32)
    if linear.ndim == 3:
        linear = linear @ np.array(_LUMINANCE_709, np.float32)
    return 255.0 * linear


def _decoded(codes: NDArray, tone: Tone) -> NDArray:
    """Return light in fractions of white of codes in fractions of white."""
    low, slope, offset, power = (
        (0.04045, 12.92, 0.055, 2.4) if tone == "srgb" else (0.081, 4.5, 0.099, 1 / 0.45)
    )
    return np.where(
        codes <= low, codes / slope, (np.maximum(codes, low) + offset) ** power / (1 + offset) ** power
    )


def coded(values: NDArray, tone: Tone) -> NDArray[np.float64]:
    """Return light as codes of a tone curve, both in fractions of white: the inverse of `to_light`.

    Example:
        >>> (255 * coded(np.array([0.0, 0.5, 1.0]), "srgb")).round(1)
        array([  0. , 187.5, 255. ])
    """
    v = np.clip(np.asarray(values, np.float64), 0.0, 1.0)
    if tone == "srgb":
        return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    return np.where(v <= 0.018, 4.5 * v, 1.099 * v**0.45 - 0.099) if tone == "rec709" else v


def from_light(light: NDArray, tone: Tone) -> NDArray[np.uint8]:
    """Return light in DN, 255 = white, as codes of a tone curve: the inverse of `to_light` up to rounding.

    Args:
        light: Any shape; what is outside 0..255 is clipped.
        tone: The curve.

    Example:
        >>> from_light(np.array([0.0, 128.2, 300.0]), "srgb")
        array([  0, 188, 255], dtype=uint8)
    """
    return np.rint(255 * coded(light / 255.0, tone)).astype(np.uint8)


def write_video(
    path: Path,
    frames: Iterable[NDArray[np.uint8]],
    fps: float,
    quality: int | None = None,
    effort: Literal["ultrafast", "fast", "medium"] = "medium",
) -> None:
    """Write frames as a video, one at a time: a file of FFmpeg's (.mp4, .mkv), a .gif, or a folder of PNG.

    Args:
        path: The file, or the folder to make.
        frames: Grey, uint8 [H, W], all of one size.
        fps: Frames per second; a folder does not keep it, a GIF (50 at most) rounds times to hundredths.
        quality: H.264's CRF, 1 (best) to 51, as cameras and phones compress; None = without loss. With it an
            odd last row or column is left out.
        effort: How long the encoder looks for a smaller file where there is loss.

    Raises:
        ConfigError: Another ending, a quality out of its range, or a GIF of more than 50 frames per second.
        DataError: No frames.
        MissingDependencyError: A file of FFmpeg's without PyAV.
    """
    suffix = path.suffix.lower()
    if suffix not in (".mp4", ".mkv", ".gif", ""):
        raise ConfigError(f"{path}: videos are written as .mp4, .mkv, .gif or a folder of PNG; end its name so")
    if quality is not None and (not 1 <= quality <= 51 or suffix not in (".mp4", ".mkv")):
        raise ConfigError(f"the quality is {quality}; give 1 to 51 for .mp4 or .mkv, none for other videos")
    if suffix == ".gif" and fps > _GIF_FPS:
        raise ConfigError(f"{path}: {fps:g} frames per second; a GIF has {_GIF_FPS} at most: write .mp4")
    shots = iter(frames)
    first = next(shots, None)
    if first is None:
        raise DataError(f"{path}: no frames to write; give at least one")
    if suffix == "":
        with new_folder(path) as folder:
            for number, frame in enumerate(chain([first], shots)):
                Image.fromarray(frame).save(folder / f"{number:06d}.png")
        return
    with new_file(path) as draft:
        if suffix == ".gif":
            images = _shown(chain([first], shots), fps)
            with draft.open("wb") as file:
                next(images).save(file, "GIF", save_all=True, append_images=images, loop=0)
            return
        av = _pyav()
        with av.open(str(draft), "w", format="mp4" if suffix == ".mp4" else "matroska") as container:
            codec = "libx264rgb" if quality is None else "libx264"
            stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(10_000))
            even = 1 if quality is None else 2  # colours at half the resolution
            height, width = (side - side % even for side in first.shape)
            stream.height, stream.width = height, width
            stream.pix_fmt = "rgb24" if quality is None else "yuv420p"
            stream.options = (
                {"qp": "0", "preset": "fast"} if quality is None else {"crf": str(quality), "preset": effort}
            )
            for frame in chain([first], shots):
                frame = np.ascontiguousarray(frame[:height, :width])
                if quality is None:
                    picture = av.VideoFrame.from_ndarray(
                        np.repeat(frame[:, :, None], 3, axis=2), format="rgb24"
                    )
                else:
                    picture = av.VideoFrame.from_ndarray(frame, format="gray")
                container.mux(stream.encode(picture))
            container.mux(stream.encode())


def _shown(frames: Iterable[NDArray[np.uint8]], fps: float) -> Iterator[Image.Image]:
    """Yield images of a GIF: each lasts to the hundredth of a second nearest to where the next one begins."""
    begins = (round(100 * number / fps) for number in count())
    for frame, (start, end) in zip(frames, pairwise(begins), strict=False):
        image = Image.fromarray(frame)
        image.info["duration"] = 10 * (end - start)
        yield image


class PictureSource(Protocol):
    """Moving images on disk."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        ...

    @property
    def frames(self) -> int | None:
        """Number of images, None where the file does not say."""
        ...

    @property
    def white(self) -> float | None:
        """Value of white where the type of the images says it; None for floating point."""
        ...

    @property
    def timed(self) -> bool:
        """Whether the file states the times of its images."""
        ...

    def pictures(self) -> Iterator[tuple[float | None, Picture]]:
        """Yield the time in seconds, None where it is not stated, and the image."""
        ...


class ContainerSource:
    """A video file, through PyAV (FFmpeg); images are turned as the file's rotation says."""

    def __init__(self, path: Path) -> None:
        self.path, self.timed = path, True
        with self._opened() as container:
            stream = container.streams.video[0]
            self.frames = stream.frames or None
            if stream.width * stream.height > MOST_IMAGE_PIXELS:
                claimed = f"it claims {stream.width} x {stream.height} pixels"
                raise DataError(f"{path}: {claimed}; at most {MOST_IMAGE_PIXELS:,} are read: make it smaller")
        pictures = self.pictures()
        try:
            time_s, first = next(pictures)
        except StopIteration:
            raise DataError(f"{path}: a video without frames; give another file") from None
        finally:
            pictures.close()
        self.timed = time_s is not None
        self.size = first.shape[1], first.shape[0]
        self.white = float(np.iinfo(first.dtype).max)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        av = _pyav()
        with ExitStack() as stack:
            try:
                container = stack.enter_context(open_container(self.path))
            except (av.error.FFmpegError, OSError, ValueError) as error:
                cure = "give MP4, MKV, AVI or another ordinary video file"
                if self.path.suffix.lower() in _OF_EVENTS:
                    cure += "; `evnlos info` tells what an event file holds"
                found = f"{self.path}: not a video that FFmpeg reads ({_reason(error)})"
                raise DataError(f"{found}; {cure}") from None
            if not container.streams.video:
                raise DataError(f"{self.path}: a media file without a video stream; give another file")
            yield container

    def pictures(self) -> Generator[tuple[float | None, Picture], None, None]:
        """Yield the presentation time and the image, 16 bits deep where the video has more than 8."""
        av = _pyav()
        count = 0
        with self._opened() as container:
            container.streams.video[0].thread_type = "AUTO"
            container.streams.video[0].codec_context.options = {"max_pixels": f"{MOST_IMAGE_PIXELS}"}
            try:
                for frame in container.decode(video=0):
                    deep = max(part.bits for part in frame.format.components) > 8
                    picture = frame.to_ndarray(format="rgb48le" if deep else "rgb24")  # [H, W, 3]
                    yield frame.time, np.rot90(picture, round(frame.rotation / 90))
                    count += 1
            except av.error.FFmpegError as error:
                raise DataError(
                    f"{self.path}: decoding failed after frame {count} ({_reason(error)}); "
                    "the file is damaged: copy or encode it again"
                ) from None


def _pyav() -> Any:
    try:
        import av
    except ImportError:
        raise MissingDependencyError(
            'reading video files needs PyAV: pip install "evnlos[video]" (GIF, images and .npy go without)'
        ) from None
    av.logging.set_level(None)  # pyright: ignore[reportPrivateImportUsage]  # FFmpeg's own remarks are no use to a reader of one line
    return av


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


class AnimationSource:
    """An animated GIF, PNG or WebP, through Pillow."""

    white, timed = 255.0, True

    def __init__(self, path: Path) -> None:
        self.path = path
        with _image(path) as image:
            self.frames = int(getattr(image, "n_frames", 1))
            self.size = image.size

    def pictures(self) -> Iterator[tuple[float | None, Picture]]:
        """Yield the sum of the durations before an image, and the image."""
        shown_ms = 0.0
        with _image(self.path) as image:
            for number in range(self.frames):
                picture = _seek(image, number, self.path)
                yield shown_ms / 1000, picture
                shown_ms += float(image.info.get("duration", 0))


class PicturesSource:
    """Single images in the order of their names; they carry no times."""

    timed = False

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = paths
        self.frames = len(paths)
        with _image(paths[0]) as image:
            self.size = image.size
            first = _array(image, paths[0])
        self._dtype, self.white = first.dtype, _white(first)

    def pictures(self) -> Iterator[tuple[float | None, Picture]]:
        """Yield the images without times."""
        for path in self.paths:
            with _image(path) as image:
                if image.size != self.size:
                    found, first = "{} x {}".format(*image.size), "{} x {}".format(*self.size)
                    raise DataError(f"{path} is {found}, {self.paths[0]} is {first}; give images of one size")
                picture = _array(image, path)
            if picture.dtype != self._dtype:
                kinds = f"{path} holds {picture.dtype}, {self.paths[0]} {self._dtype}"
                raise DataError(f"{kinds}; give images of one depth")
            yield None, picture


class ArraySource:
    """A NumPy file [T, H, W] or [T, H, W, 3], read through a memory map; it carries no times."""

    timed = False

    def __init__(self, path: Path) -> None:
        try:
            with open_regular(path):  # a pipe would be waited for
                self._array = np.load(path, mmap_mode="r", allow_pickle=False)
            if not isinstance(self._array, np.ndarray):
                raise ValueError("an archive of arrays")
        except NUMPY_ERRORS:
            found = "not a NumPy array of numbers, or cut short"
            raise DataError(f"{path}: {found}; save one with numpy.save, or copy it again") from None
        shape, dtype = self._array.shape, self._array.dtype
        if len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] != 3) or 0 in shape[1:]:
            raise DataError(f"{path}: an array of shape {shape}; give [T, H, W] or [T, H, W, 3]")
        if shape[1] * shape[2] > MOST_IMAGE_PIXELS:
            raise DataError(f"{path}: frames of {shape[2]} x {shape[1]}; at most {MOST_IMAGE_PIXELS:,} pixels")
        if dtype not in (np.uint8, np.uint16) and dtype.kind != "f":
            raise DataError(f"{path}: an array of {dtype}; give uint8, uint16 or floating point")
        self.frames, self.size = shape[0], (shape[2], shape[1])
        self.white = _white(self._array)

    def pictures(self) -> Iterator[tuple[float | None, Picture]]:
        """Yield the images without times."""
        for picture in self._array:
            yield None, np.asarray(picture)


def _white(pictures: NDArray) -> float | None:
    return float(np.iinfo(pictures.dtype).max) if pictures.dtype.kind == "u" else None


@contextmanager
def _image(path: Path) -> Iterator[Image.Image]:
    try:
        with open_image(path) as image:
            yield image
    except UnidentifiedImageError:
        raise DataError(f"{path}: not an image that is read; give PNG, TIFF, JPEG, GIF or WebP") from None
    except (OSError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: cannot be read ({error})") from None


def _seek(image: Image.Image, number: int, path: Path) -> Picture:
    try:
        image.seek(number)
    except (OSError, EOFError, SyntaxError) as error:
        raise DataError(f"{path}: image {number} cannot be read ({error}); copy the file again") from None
    return _array(image, path)


def _array(image: Image.Image, path: Path) -> Picture:
    """Return the current image: uint8, uint16 for 16-bit files, float32 for floating-point files."""
    try:
        if image.mode.startswith("I"):
            numbers = np.asarray(image)
            if numbers.min() < 0 or numbers.max() > 65_535:
                raise DataError(f"{path}: an image of more than 16 bits; save it as 16 bits or floating point")
            return numbers.astype(np.uint16)
        if image.mode in ("L", "RGB"):
            return np.asarray(image)
        return np.asarray(image if image.mode == "F" else image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: the image cannot be decoded ({error}); copy the file again") from None
