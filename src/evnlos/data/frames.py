"""The frames of a capture: read in whatever form they lie in its folder, as grey or one of their colours.

- A homography from points.
- A grid of bright dots, as a screen or a board of lamps shows it, found in a frame or in a map of events.
- Which pixels of the sensor a capture uses, and which of them see a colour by themselves.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from PIL import Image, UnidentifiedImageError

from evnlos.cameras.frame_camera import colour_filters, of_mosaic
from evnlos.cameras.video import open_video
from evnlos.cameras.video_files import Tone, to_light
from evnlos.data.capture_info import CaptureInfo, inside
from evnlos.errors import ConfigError, DataError
from evnlos.events import FrameReader, FrameStack, gather_frames, iter_frames, stride_for
from evnlos.types import COLOURS, Colour, Events, Mosaic
from evnlos.untrusted import check_memory, memory_left, open_image, open_regular

_FURTHEST_M, _LONG_AGO_US = 10.0, 3_600_000_000
_PLATEAU, _LEAST_CLIPPED = 5.0, 1e-4  # of pixels at the largest number: times those of the four below; of all
_RECORDINGS = (".aedat4", ".aedat", ".bag", ".db3", ".mcap", ".bin")


@dataclass(frozen=True, eq=False)
class FrameSeries:
    """Frames in the order of time.

    Args:
        images: uint8 or uint16 [N, H, W], digital numbers, held or read as they are asked for.
        times_us: Times on the frames' own clock, int64 [N], microseconds.
        what: What they were read from, for a message.
    """

    images: NDArray | FrameStack
    times_us: NDArray[np.int64]
    what: str


def read_image(
    path: Path,
    size: tuple[int, int] | None = None,
    colour: Colour | None = None,
    mosaic: Mosaic | None = None,
    tone: Tone | None = None,
) -> NDArray:
    """Read an image, or one colour of it, as uint8 or uint16 [H, W].

    Args:
        path: Its file.
        size: Rows and columns that it has to have.
        colour: The colour; None is grey. A grey image has the same of each.
        mosaic: Colour filters, where the file holds raw values behind them.
        tone: Tone curve of its numbers, which is undone, in uint16; None where they grow as the light.

    Raises:
        DataError: It can't be read, or has another size.
    """
    try:
        with open_image(path) as image:
            if size is not None and image.size != (size[1], size[0]):
                wide, high = image.size
                raise DataError(f"{path} is {wide} x {high} pixels; the camera has {size[1]} x {size[0]}")
            if image.mode == "F" and not np.isfinite(np.asarray(image)).all():
                raise DataError(f"{path} holds NaN or infinity; leave it out or mend it")
            if tone is not None:
                is_grey = image.mode == "L" or image.mode.startswith("I;16")
                codes = np.asarray(image if is_grey else image.convert("RGB"))
                light = to_light(codes, tone, float(np.iinfo(codes.dtype).max), colour)
                array = np.rint(light * (65_535 / 255)).astype(np.uint16)
            elif image.mode.startswith("I;16"):
                array = np.asarray(image)
            elif mosaic is not None or colour is None:
                if mosaic is not None and np.ptp(np.asarray(image.convert("RGB")), axis=-1).any():
                    raise DataError(f"{path} holds whole colours, no raw values; leave camera.mosaic out")
                array = np.asarray(image.convert("L"))
            else:
                array = np.asarray(image.convert("RGB"))[..., COLOURS.index(colour)]
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path} can't be read as an image: {error}") from None
    return array if mosaic is None else of_mosaic(array, mosaic, colour)


def read_frame_series(
    folder: Path, info: CaptureInfo, most_bytes: int | None = None, is_lazy: bool = False
) -> FrameSeries:
    """Read the frames that a capture names.

    Args:
        folder: The capture's folder.
        info: Its description.
        most_bytes: Memory that they may take, bytes; None = a quarter of what is free, at most 2 GiB.
        is_lazy: Whether frames of a recording or a video that take more become a `FrameStack`, in place of an
            error.

    Raises:
        DataError: A file is missing or unreadable, the frames take too much memory, or they carry no time and
            no rate is stated.
        EventFileError: A recording of the camera is damaged.
    """
    info.check_cameras(folder, frames=True, events=False)
    assert info.frames is not None
    path = inside(folder, info.frames)
    most = min(memory_left() // 4, 1 << 31) if most_bytes is None else most_bytes
    size = None if info.registration is not None else (info.camera.height, info.camera.width)
    if path.suffix.lower() == ".csv":
        return _from_table(folder, path, info, size, most)
    if path.suffix.lower() in _RECORDINGS:
        if info.camera.tone is not None:
            raise DataError(
                f"{path}: camera.tone is of images and videos; leave it out, or save the frames as such"
            )
        if info.camera.colour is not None or info.camera.mosaic is not None:
            raise DataError(f"{path}: its frames are read as grey; save them as images to take their colours")
        read = lambda: iter_frames(path, topic=info.frames_topic)  # noqa: E731
    else:
        read = _video_frames(folder, path, info, None if is_lazy else most)
    images, times_us = gather_frames(read, path, most, is_lazy)
    times = _at_rate(path, len(images), info) if times_us is None else times_us
    series = FrameSeries(images, times, path.name)
    _check_times(path, series.times_us)
    if size is not None and series.images.shape[1:] != size:
        high, wide = series.images.shape[1:]
        cure = "state a registration" if size != (wide, high) else "exchange width and height of camera"
        raise DataError(f"{path} is {wide} x {high} pixels; the camera has {size[1]} x {size[0]}: {cure}")
    return series


def from_start(
    folder: Path, info: CaptureInfo, events: Events, times_us: NDArray[np.int64]
) -> tuple[CaptureInfo, Events, NDArray[np.int64], list[str]]:
    """Return a capture on a clock of its own where the files' began an hour or more before, in 1970, say.

    Times and stated motions move by whole seconds, and a note says by how many.

    Args:
        folder: Its folder, for messages.
        info: What is known about it.
        events: Its events, or none.
        times_us: Times of its frames on the events' clock, [N], microseconds.

    Raises:
        DataError: By a stated motion the target is far away while frames are taken: a wrong clock, or unit.
    """
    for motion in (one.motion for one in (info, *info.others) if one.motion is not None and len(times_us)):
        since_us = [int(times_us[k]) - motion.start_us for k in (0, -1)]
        if (away_m := abs(motion.speed_m_s) * max(map(abs, since_us)) * 1e-6) > _FURTHEST_M:
            raise DataError(
                f"{folder}: by its motion the target is {away_m:.3g} m from start_m while frames are taken (at "
                f"most {_FURTHEST_M:g} m): mend speed_m_s, or start_us: the first frame is at {times_us[0]} us"
            )
    first_us = min(int(one[0]) for one in (events.t_us, times_us) if len(one)) // 1_000_000 * 1_000_000
    if first_us < _LONG_AGO_US:
        return info, events, times_us, []

    def moved(one: Any) -> Any:
        motion = one.motion
        return replace(one, motion=motion and replace(motion, start_us=motion.start_us - first_us))

    info = replace(moved(info), others=tuple(map(moved, info.others)))
    note = f"times count from {first_us // 1_000_000} s of the files' clock"
    return info, replace(events, t_us=events.t_us - first_us), times_us - first_us, [note]


def _rate(path: Path, info: CaptureInfo) -> float:
    rate = info.camera.frame_rate_hz
    if rate is None or not rate > 0:
        raise DataError(f"{path}: its frames carry no times; state camera.frame_rate_hz in capture.yaml")
    return rate


def _at_rate(path: Path, count: int, info: CaptureInfo) -> NDArray[np.int64]:
    return np.round(np.arange(count) * (1e6 / _rate(path, info))).astype(np.int64)


def _video_frames(folder: Path, path: Path, info: CaptureInfo, room: int | None) -> FrameReader:
    """Return what reads a video, animation, array or folder of images as 16 bits, in `room` bytes."""
    if path.is_dir():
        for one in path.iterdir():
            inside(folder, str(one.relative_to(folder.resolve())), f"{info.frames}")
    timed = path.is_file() and path.suffix.lower() != ".npy"
    camera = info.camera
    colour = camera.colour if camera.mosaic is None else None
    cure = "save whole numbers of 16 bits, of which 65535, or camera: {white_dn: ...} in capture.yaml, is white"
    video = open_video(
        path,
        fps=None if timed else _rate(path, info),
        colour=colour,
        tone=camera.tone or "as-is",
        white_cure=cure,
    )
    if room is not None:
        _check_size(path, (video.frames or 1) * video.width * video.height * 2, room)
    most, kind = (255, np.uint8) if camera.log and video.white <= 255 else (65_535, np.uint16)

    def frames() -> Iterator[tuple[int, NDArray]]:
        for k, (time_s, light) in enumerate(video):
            if not np.isfinite(light).all():
                raise DataError(f"{path}: frame {k} holds NaN or infinity; give finite values")
            levels = np.clip(np.round(light * (most / 255)), 0, most).astype(kind)
            told = levels if camera.mosaic is None else of_mosaic(levels, camera.mosaic, camera.colour)
            yield round(time_s * 1e6), told

    return frames


def _from_table(
    folder: Path, path: Path, info: CaptureInfo, size: tuple[int, int] | None, most: int
) -> FrameSeries:
    try:
        with open_regular(path) as opened, TextIOWrapper(opened, encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} can't be read as a table: {error}") from None
    if not rows or not {"t_us", "file"} <= rows[0].keys():
        raise DataError(f"{path} holds no frames; give a header 't_us,file' and one line per frame")
    try:
        times = np.array([int(row["t_us"]) for row in rows], dtype=np.int64)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{path} holds a time that is not a whole number of microseconds") from None
    _check_times(path, times)
    named: dict[str, int] = {}
    for k, row in enumerate(rows):
        before = named.setdefault(row["file"] or "", k)
        if before != k:
            raise DataError(f"{path}: frames {before} and {k} are both {row['file']}; name every image once")
    filters = size, info.camera.colour, info.camera.mosaic, info.camera.tone
    first = read_image(inside(folder, rows[0]["file"] or "", path.name), *filters)
    _check_size(path, len(rows) * first.nbytes, most)
    images = np.empty((len(rows), *first.shape), first.dtype)
    for k, row in enumerate(rows):
        image = read_image(inside(folder, row["file"] or "", path.name), *filters) if k else first
        if image.shape != first.shape or image.dtype != first.dtype:
            raise DataError(
                f"{path}: frame {k} is {image.dtype} {image.shape}, frame 0 {first.dtype} "
                f"{first.shape}; give frames of one camera"
            )
        images[k] = image
    return FrameSeries(images, times, path.name)


def _check_size(path: Path, needed: int, most: int) -> None:
    check_memory(needed, f"{path}: its frames", "leave frames out, or make them smaller", most)


def _check_times(path: Path, times: NDArray[np.int64]) -> None:
    if len(times) and max(abs(int(times[0])), abs(int(times[-1]))) > 2**62:
        raise DataError(f"{path}: times leave +-2^62 us; give microseconds")
    if (np.diff(times) <= 0).any():
        i = int(np.argmax(np.diff(times) <= 0))
        raise DataError(f"{path}: frame {i + 1} at {times[i + 1]} us follows {times[i]} us; times must ascend")


_FLAT = 1e-6  # ratio of singular values below which points lie on a line


def clipped_at(frames: NDArray, peak: int) -> int:
    """Return the digital number at which frames are clipped; `peak` where nothing says that it is lower.

    Where a sensor saturates below the file's white, or a video ends at 235, all brighter light is one number:
    the largest, and far more frequent than those below it.

    Args:
        frames: Frames, unsigned integers [N, H, W], digital numbers.
        peak: The file's white, the largest digital number.
    """
    counts = np.zeros(peak + 1, np.int64)
    for frame in frames:  # of all at once numpy makes numbers eight times as large
        counts += np.bincount(frame.ravel(), minlength=peak + 1)
    *_, last = there = np.flatnonzero(counts)
    usual = int(counts[there[-5:-1]].max(initial=0))
    is_clipped = len(there) > 4 and counts[last] > max(_PLATEAU * usual, _LEAST_CLIPPED * frames.size)
    return int(last) if is_clipped else peak


def homography_from_points(source: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix that maps points of one plane's image to those of another, by the normalised DLT.

    (x', y', 1) ~ H (x, y, 1), least squares of the algebraic error after both sets of points are shifted to
    their mean and scaled to a mean distance of sqrt 2 (Hartley, "In defense of the eight-point algorithm",
    TPAMI 1997).

    Args:
        source: Points (x, y), [N, 2], N at least 4, pixels.
        target: Where they are in the other image, [N, 2], pixels.

    Returns:
        float64 [3, 3], the last entry 1.

    Raises:
        DataError: Fewer than four points, unequal counts, or points on a line or twice the same.

    Example:
        >>> corners = [(0, 0), (10, 0), (10, 5), (0, 5)]
        >>> homography_from_points(corners, [(2 * x + 1, 2 * y) for x, y in corners]).round(6) + 0.0
        array([[2., 0., 1.], [0., 2., 0.], [0., 0., 1.]])
    """
    sources, targets = np.asarray(source, float), np.asarray(target, float)
    if sources.shape != targets.shape or sources.ndim != 2 or sources.shape[1:] != (2,) or len(sources) < 4:
        raise DataError(f"points of shapes {sources.shape} and {targets.shape}; give at least 4 pairs (x, y)")
    if not (np.isfinite(sources).all() and np.isfinite(targets).all()):
        raise DataError("a point of the registration is not finite; give pixels")
    a, b = _normaliser(sources), _normaliser(targets)
    p, q = map_points(a, sources), map_points(b, targets)
    zero, one = np.zeros(len(p)), np.ones(len(p))
    rows = np.concatenate(
        [
            np.stack([p[:, 0], p[:, 1], one, zero, zero, zero, *(-q[:, :1] * p).T, -q[:, 0]], axis=1),
            np.stack([zero, zero, zero, p[:, 0], p[:, 1], one, *(-q[:, 1:] * p).T, -q[:, 1]], axis=1),
        ]
    )  # [2 N, 9]
    _, values, vectors = np.linalg.svd(rows)
    if values[7] < _FLAT * values[0]:
        raise DataError("the points of the registration lie on a line or coincide; spread them over the image")
    found = np.linalg.inv(b) @ vectors[8].reshape(3, 3) @ a
    if abs(found[2, 2]) < 1e-12 or abs(np.linalg.det(found / found[2, 2])) < 1e-12:
        raise DataError("the points of the registration give no invertible homography; check their order")
    return found / found[2, 2]


def _normaliser(points: NDArray[np.float64]) -> NDArray[np.float64]:
    middle = points.mean(axis=0)
    distance = np.sqrt(((points - middle) ** 2).sum(axis=1)).mean()
    if distance == 0:
        raise DataError("the points of the registration coincide; spread them over the image")
    scale = np.sqrt(2) / distance
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])


def map_points(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a homography [3, 3] puts points (x, y), [N, 2] pixels."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return mapped[:, :2] / mapped[:, 2:]


def registration_error(matrix: NDArray, source: ArrayLike, target: ArrayLike) -> float:
    """Return the root mean square distance, target pixels, between mapped source points and their targets.

    Args:
        matrix: Homography, [3, 3].
        source: Points (x, y), [N, 2], pixels.
        target: Where they should be, [N, 2], pixels.
    """
    away = map_points(np.asarray(matrix, float), np.asarray(source, float)) - np.asarray(target, float)
    return float(np.sqrt((away**2).sum(axis=1).mean()))


_SMALLEST = 3  # pixels of a dot
_OFF_GRID = 0.3  # of a grid step: farther dots are no grid


@njit(cache=True)
def _blobs(bright, picture):
    """Return for each 8-connected set of bright pixels: weight, weighted sums of x and y, pixels."""
    height, width = bright.shape
    seen = np.zeros((height, width), np.bool_)
    stack = np.empty((height * width, 2), np.int64)
    found = []
    for row in range(height):
        for column in range(width):
            if not bright[row, column] or seen[row, column]:
                continue
            seen[row, column] = True
            stack[0, 0], stack[0, 1] = row, column
            size, weight, sum_x, sum_y, pixels = 1, 0.0, 0.0, 0.0, 0
            while size:
                size -= 1
                at_row, at_column = stack[size, 0], stack[size, 1]
                value = picture[at_row, at_column]
                weight += value
                sum_x += value * at_column
                sum_y += value * at_row
                pixels += 1
                for v in range(max(0, at_row - 1), min(height, at_row + 2)):
                    for u in range(max(0, at_column - 1), min(width, at_column + 2)):
                        if bright[v, u] and not seen[v, u]:
                            seen[v, u] = True
                            stack[size, 0], stack[size, 1] = v, u
                            size += 1
            found.append((weight, sum_x, sum_y, float(pixels)))
    return found


def find_dots(picture: NDArray, rows: int, columns: int) -> NDArray[np.float64]:
    """Return the centres of a grid of bright dots on a dark ground, row by row from the top left.

    Pixels above the middle between the ground (median) and the brightest (99.9th percentile) form dots; the
    `rows` x `columns` largest are taken, their centres of brightness fitted by a homography from their four
    corners. The grid may be tilted by less than 45 degrees and seen in perspective.

    Args:
        picture: [H, W], brighter dots; for a blinking grid the number of events per pixel.
        rows: Rows of dots, at least 2.
        columns: Dots per row, at least 2.

    Returns:
        Points (x, y), float64 [rows * columns, 2], pixels.

    Raises:
        DataError: Another number of dots, or dots that form no such grid.
    """
    if rows < 2 or columns < 2:
        raise DataError(f"a grid of {rows} x {columns} dots; give at least 2 x 2")
    picture = np.asarray(picture, np.float64)
    ground, top = np.median(picture), np.percentile(picture, 99.9)
    top = max(top, picture.max() * 0.5)  # dots may cover less than a thousandth
    above = np.clip(picture - ground, 0, None)
    blobs = [blob for blob in _blobs(above > (top - ground) / 2, above) if blob[3] >= _SMALLEST]
    count = rows * columns
    if top <= ground or len(blobs) < count:
        raise DataError(
            f"{len(blobs)} dots found where {rows} x {columns} are announced; check light and focus"
        )
    largest = np.array(sorted(blobs, key=lambda blob: -blob[0])[:count])
    if len(blobs) > count and sorted(blob[0] for blob in blobs)[-count - 1] > 0.5 * np.median(largest[:, 0]):
        raise DataError(f"{len(blobs)} dots found where {rows} x {columns} are announced; hide other lights")
    centres = largest[:, 1:3] / largest[:, :1]
    ends = centres.sum(axis=1), centres[:, 0] - centres[:, 1]
    corners = [np.argmin(ends[0]), np.argmax(ends[1]), np.argmax(ends[0]), np.argmin(ends[1])]
    steps = np.array([(0, 0), (columns - 1, 0), (columns - 1, rows - 1), (0, rows - 1)], float)
    if len(set(corners)) < 4:
        raise DataError("the dots have no four corners; turn the grid upright")
    to_grid = homography_from_points(centres[corners], steps)
    mapped = np.column_stack([centres, np.ones(count)]) @ to_grid.T
    place = mapped[:, :2] / mapped[:, 2:]
    nearest = np.round(place)
    away = np.abs(place - nearest).max()
    order = (nearest[:, 1] * columns + nearest[:, 0]).astype(int)
    if away > _OFF_GRID or sorted(order) != list(range(count)):
        raise DataError(f"the dots form no grid of {rows} x {columns}; check its rows and columns")
    return centres[np.argsort(order)]


_MANY_PIXELS, _ENOUGH_PIXELS = 300_000, 40_000


def stride_of(info: CaptureInfo, pixels: int) -> int:
    """Return of which so many rows and columns of a region of some pixels one is used.

    Args:
        info: What is known about the capture.
        pixels: Pixels of the region.
    """
    return info.every or (stride_for(pixels, _ENOUGH_PIXELS) if pixels > _MANY_PIXELS else 1)


def of_used(info: CaptureInfo, values: NDArray) -> NDArray:
    """Return what belongs to each pixel of a sensor, where a capture uses its events, [H, W] -> [h, w].

    Args:
        info: What is known about the capture.
        values: Of the whole sensor, [H, W].
    """
    if (roi := info.roi) is not None:
        values = values[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width]
    if (side := stride_of(info, values.size)) > 1:
        rows, columns = (length // side * side for length in values.shape)
        values = values[side // 2 : rows : side, side // 2 : columns : side]
    return values


def own_pixels(info: CaptureInfo, colour: Colour, kind: Literal["frames", "events"]) -> NDArray[np.bool_]:
    """Return which of the used pixels see a colour by themselves, bool [H, W].

    Behind a mosaic all others of frames are interpolated. Registered, turned or averaged frames have no such
    pixels; there one of four (of two for green) is taken.

    Args:
        info: What is known about the capture.
        colour: The colour.
        kind: Pixels of which camera; whole coloured frames have the colour everywhere.

    Raises:
        ConfigError: The event camera has no filters, or no used pixel has this one.
    """
    camera, seen = info.camera, np.ones((info.camera.height, info.camera.width), np.bool_)
    if (mosaic := camera.mosaic if kind == "frames" else camera.event_mosaic) is not None:
        seen = colour_filters(mosaic, seen.shape)[COLOURS.index(colour)]
    elif kind == "events":
        raise ConfigError("its events are grey; leave --colours or --from, or state camera.event_mosaic")
    seen = of_used(info, seen)
    if not seen.any():
        raise ConfigError(f"no pixel for {colour} among the rows and columns used; state an odd `every`")
    return seen
