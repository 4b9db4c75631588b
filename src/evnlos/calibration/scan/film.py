"""From a phone's film of a show to the images of a scan, and to captures of the characters that moved.

The film is read once, at a small size. Its flashes tell where in the show each frame lies, images that
complete one another tell the tone curve, and what the patterns say twice tells exposure and shake.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.calibration.scan.show import CODE, PAIRS, Part, Show, read_show
from evnlos.cameras.video import Video, open_video
from evnlos.cameras.video_files import Tone
from evnlos.config import save_yaml
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.events import write_events
from evnlos.files import new_file, new_folder
from evnlos.machine import Progress, Step, silent
from evnlos.setups import MeasuredSetup
from evnlos.types import derive_seed

_WIDTH = 160  # columns to which a film is reduced, where nothing else is asked for
_CODED = 65_534  # a frame's light in 16 bits at white; one more is saturated
_SATURATED = 254.0 / 255.0
_GUARD = 0.2  # of a pattern's time, left out at both ends: the display, a rolling shutter, one frame
_AGREES = 0.8
_MOST_RATE = 0.005
_FINE_S = 0.001
_PASSES = 10
_FINE_ENOUGH = 80  # columns from which gain and movement are found
_MODES = 24
_GAIN_PRIOR, _SHIFT_PRIOR = 0.1, 2.0
_STEADY_GAIN, _STEADY_PX = 0.003, 0.05  # root mean squares below which nothing is corrected
_MOST_PX = 0.05  # of the width: beyond that the camera was moved
_LOCKED = 0.04  # compression alone makes up to 2.2 % of a small film, an exposure that follows the light -14 %
_LONGER, _USUAL_HZ = 180.0, 30.0
_MEAN = 1e-4
_ALIKE = 10.0  # neighbouring pixels of a film err alike
_CALM_S, _JITTER = 0.6, 1e-3  # seconds over which exposure and place stay alike; share that does not


@dataclass(frozen=True)
class FilmReading:
    """How a film becomes the images of a scan."""

    tone: Tone = "srgb"
    """Tone curve of the film's numbers; what it leaves is found from the show's own check."""
    fit_tone: bool = True
    """Correct what is left of the tone curve, by images whose light adds up."""
    steady: bool = True
    """Take out changes of the exposure and movement of the phone."""
    fps: float | None = None
    """Frames per second; none = the film's own times."""
    capture_hz: float = 10.0
    """Frames per second of the captures that are made of moving characters, hertz."""

    def __post_init__(self) -> None:
        if not 0.5 <= self.capture_hz <= 240:
            raise ConfigError(f"capture_hz is {self.capture_hz}; give 0.5 to 240 frames per second")


@dataclass(frozen=True)
class Clock:
    """Where the show lies in a film: film time = start_s + rate (show time).

    Args:
        start_s: The show's begin on the film's clock, seconds.
        rate: Seconds of the film in a second of the show.
        agreement: Correlation of the light with the flashes, of the worse of both codes; 1 is perfect.
    """

    start_s: float
    rate: float
    agreement: float

    def film_s(self, show_s: float) -> float:
        """Return the film's time of a time of the show."""
        return self.start_s + self.rate * show_s


@dataclass(frozen=True, eq=False)
class FilmResult:
    """What was found in a film.

    Args:
        clock: Where the show lies.
        shape: Size (H, W) of the images, pixels.
        tone: Exponent g and steepness a of the correction l^g exp(a (l - 1)) of light l; (1, 0) is none.
        misfit: By how much the light of halves differs from that of the whole before the correction, and after.
        exposure_locked: Whether an image is as bright after the brightest one as before.
        gain_rms: Root mean square of the exposure's changes.
        shift_px: Root mean square of the movement, pixels.
        corrected: Whether both were taken out.
        captures: Capture folders of the characters that moved.
        warnings: What to look at.
    """

    clock: Clock
    shape: tuple[int, int]
    tone: tuple[float, float]
    misfit: tuple[float, float]
    exposure_locked: bool
    gain_rms: float
    shift_px: float
    corrected: bool
    captures: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Film:
    """A film in memory's reach.

    Args:
        times_s: Time of each frame, float64 [T].
        frames: Light, uint16 [T, H, W], 65,534 = white; 65,535 where a pixel saturates.
        brightness: Mean light of each frame, white levels, float64 [T].
    """

    times_s: NDArray[np.float64]
    frames: NDArray[np.uint16]
    brightness: NDArray[np.float64]

    def mean(self, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the mean light of some frames [H, W], white levels, and where one of them saturates."""
        some = self.frames[chosen]
        light = some.mean(axis=0, dtype=np.float64).astype(np.float32) / _CODED
        return light, some.max(axis=0) > _CODED


def read_film(
    video: Video, shape: tuple[int, int], store: Any, longest_s: float, progress: Progress = silent
) -> Film:
    """Read a film once, reduced by area; its frames lie in a file.

    Args:
        video: The film.
        shape: Size (H, W), pixels.
        store: An open, empty, temporary file.
        longest_s: Length beyond which it is refused, seconds.
        progress: Called now and then.

    Raises:
        DataError: The film is too long, or larger images are asked for than it has.
    """
    if shape[0] > video.height or shape[1] > video.width:
        raise DataError(
            f"{shape[0]} x {shape[1]} pixels are requested, the film has {video.height} x {video.width}"
        )
    times, brightness = [], []
    total = video.frames or round(longest_s * _USUAL_HZ)
    progress(Step("read film", 0, total, "frames"))
    for time_s, light in video:
        if time_s > longest_s:
            raise DataError(
                f"{video.path} is longer than {longest_s:.0f} s, the show is over by then; cut it to the show"
            )
        full = light[None] / np.float32(255)
        level = reduce_by_area(full, shape)[0]
        coded = np.clip(np.rint(level * _CODED), 0, _CODED).astype(np.uint16)
        if (over := full >= _SATURATED).any():
            coded[reduce_by_area(over.astype(np.float32), shape)[0] > 0] = _CODED + 1
        store.write(coded.tobytes())
        times.append(time_s)
        brightness.append(float(level.mean()))
        if len(times) % 30 == 0:
            progress(Step("read film", min(len(times), total), total, "frames"))
    store.flush()
    progress(Step("read film", total, total, "frames"))
    if len(times) < 2:
        raise DataError(f"{video.path} has {len(times)} frames; film the whole show")
    frames = np.memmap(store, np.uint16, "r", shape=(len(times), *shape))
    return Film(np.array(times), frames, np.array(brightness))


def find_show(film: Film, show: Show) -> Clock:
    """Find where a show lies in a film, by the flashes at its begin and end.

    The mean light over each flash is compared with the code, for every begin; each code is then placed to a
    millisecond, and the clocks' ratio follows from both.

    Raises:
        DataError: The code is not there, or the film runs at another speed.
    """
    starts_s = [part.start_s for part in show.parts if (part.kind, part.number) == ("code", 0)]
    middle = (film.times_s[1:] + film.times_s[:-1]) / 2
    edges = np.r_[2 * film.times_s[0] - middle[0], middle, 2 * film.times_s[-1] - middle[-1]]
    total = np.r_[0.0, np.cumsum(film.brightness * np.diff(edges))]
    wanted = np.array(CODE) - np.mean(CODE)

    def agreement(starts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the correlation of the light with a code that begins at some times [N]."""
        chip = show.show.chip_s
        at = np.interp(starts[:, None] + chip * np.arange(len(CODE) + 1), edges, total)
        light = np.diff(at, axis=1) / chip
        light -= light.mean(axis=1, keepdims=True)
        size = np.linalg.norm(light, axis=1) * np.linalg.norm(wanted)
        return np.where(size > 1e-9, light @ wanted / np.maximum(size, 1e-9), 0.0)

    apart = starts_s[1] - starts_s[0]
    last = edges[-1] - apart - len(CODE) * show.show.chip_s
    if last <= edges[0]:
        length = f"the film lasts {edges[-1] - edges[0]:.1f} s, the show {show.duration_s:.1f} s"
        raise DataError(f"{length}; film the whole show")
    starts = np.arange(edges[0], last, 0.01)
    both = agreement(starts) + agreement(starts + apart)
    first = float(starts[int(np.argmax(both))])
    found, reach = [], _MOST_RATE * apart + 0.3
    for begin, wide in ((first, 0.3), (first + apart, reach)):
        near = np.arange(begin - wide, begin + wide, _FINE_S)
        value = agreement(near)
        best = int(np.argmax(value))
        top = near[value > value[best] - 1e-4]  # a plateau where frames are longer than a step
        found.append((float(top[np.abs(top - near[best]) < 0.05].mean()), float(value[best])))
    worst = min(value for _, value in found)
    if worst < _AGREES:
        raise DataError(
            f"the flashes at the show's begin and end are not in the film (they agree to {worst:.2f}, at least "
            f"{_AGREES:g} is needed): film from before the first to after the last, the lit wall in the "
            "image, with the exposure locked"
        )
    rate = (found[1][0] - found[0][0]) / apart
    if not abs(rate - 1) < _MOST_RATE:
        raise DataError(
            f"the film's clock runs {rate:.4f} times as fast as the show's; state the true frame rate (--fps)"
        )
    return Clock(found[0][0] - rate * starts_s[0], rate, worst)


def fit_tone(pictures: list[NDArray[np.float32]]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (g, a) of the curve l^g exp(a (l - 1)) that makes light add up, and the misfit before and after.

    The light of two images that complete one another, less the dark, is that of all cells: with f the curve,
    f(A) + f(B) = f(all) + f(none) at every pixel. The misfit is the root mean square of what is left of this
    over that of f(all) - f(none).

    Args:
        pictures: The check's images in the order of `CHECKS`, [H, W] each.
    """
    from scipy.optimize import minimize  # loads slowly

    none, whole = (pictures[0] + pictures[-1]) / 2, pictures[7]

    def misfit(curve: NDArray[np.float64]) -> float:
        low, high = (straightened(one, curve) for one in (none, whole))
        rest = [
            straightened(pictures[a], curve) + straightened(pictures[b], curve) - low - high for a, b in PAIRS
        ]
        return float(np.sqrt(np.mean(np.square(rest)) / max(float(np.mean((high - low) ** 2)), 1e-12)))

    start = np.array([1.0, 0.0])
    found = minimize(misfit, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-7})
    before, after = misfit(start), float(found.fun)
    curve = np.asarray(found.x) if after < 0.8 * before and found.x.min() > -3 else start
    if curve[0] <= 0 or curve[0] + min(curve[1], 0) <= 0.05:  # it would fall somewhere
        curve = start
    return (float(curve[0]), float(curve[1])), (before, misfit(curve))


def straightened(light: NDArray, curve: tuple[float, float] | NDArray[np.float64]) -> NDArray[np.float32]:
    """Return light l as l^g exp(a (l - 1)), for curve = (g, a)."""
    g, a = (float(value) for value in curve)
    if (g, a) == (1.0, 0.0):
        return np.asarray(light, np.float32)
    base = np.maximum(np.asarray(light, np.float64), 0.0)
    return (base**g * np.exp(a * (base - 1))).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Steadiness:
    """How exposure and place changed from image to image.

    Args:
        gain: Exposure of each image over the mean one, float64 [K].
        shift_px: Movement (down, right) of each, pixels, float64 [K, 2].
    """

    gain: NDArray[np.float64]
    shift_px: NDArray[np.float64]

    @property
    def gain_rms(self) -> float:
        """Root mean square change of the exposure."""
        return float(np.std(self.gain))

    @property
    def shift_rms_px(self) -> float:
        """Root mean square movement, pixels."""
        return float(np.sqrt(((self.shift_px - self.shift_px.mean(axis=0)) ** 2).sum(axis=1).mean()))


def find_steadiness(
    pictures: NDArray[np.float32],
    design: NDArray[np.float64],
    spacing_s: float,
    progress: Progress = silent,
) -> Steadiness:
    """Find exposure and movement of each image of a scan from what the patterns say twice.

    Without them image k is P_k = D + M p_k, D the dark, M the light of the cells, p_k the pattern, so that K
    images lie in the span of the n + 1 columns of the design. With them, to first order, F_k = P_k + B_k t_k,
    B_k the image and its slopes, t_k = (gain, down, right). With Q the projection off the design's span,
    Q F = Q (B t) holds whatever D and M are (variable projection, Golub and Pereyra 1973): least squares for
    all t at once. Their prior is a smooth Gaussian process of the size that the data have (expectation
    maximisation), so that what never moved stays where it is.

    Args:
        pictures: Light, float32 [K, H, W].
        design: Which cells each lights, and a column of ones for the dark, float64 [K, n + 1].
        spacing_s: Time from one image to the next, seconds.
        progress: Called after each round.
    """
    count = len(pictures)
    coarser = max(1, pictures.shape[2] // _FINE_ENOUGH)
    small = (pictures.shape[1] // coarser, pictures.shape[2] // coarser)
    pictures = reduce_by_area(pictures[:, : small[0] * coarser, : small[1] * coarser], small)
    off = np.eye(count) - design @ np.linalg.pinv(design)  # Q
    free = max(np.trace(off), 1.0)
    apart_s = spacing_s * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    calm = np.linalg.inv(np.exp(-0.5 * (apart_s / _CALM_S) ** 2) + _JITTER * np.eye(count))
    size = np.array([_GAIN_PRIOR, _SHIFT_PRIOR, _SHIFT_PRIOR]) ** 2
    no_mean = np.kron(np.eye(3), np.full((count, count), 1 / (count * _MEAN) ** 2))  # no data tell the means
    gain, moved = np.ones(count), np.zeros((count, 2))
    inside = (slice(None), slice(2, -2), slice(2, -2))
    for number in range(_PASSES):
        progress(Step("steady", number, _PASSES, "rounds"))
        straight = _steadied(pictures, gain, moved).astype(np.float64)
        rest = (off @ straight.reshape(count, -1)).reshape(pictures.shape)
        predicted = straight - rest
        parts = (predicted, *np.gradient(predicted, axis=(1, 2)))
        basis = np.concatenate([np.asarray(one)[inside].reshape(count, -1) for one in parts])  # [3 K, pixels]
        left = rest[inside].reshape(count, -1)
        noise = _ALIKE * float((left**2).sum()) / (left.shape[1] * free)
        prior = np.kron(np.diag(1 / size), calm) + no_mean
        normal = (basis @ basis.T) * np.tile(off, (3, 3)) / noise + prior
        right = (basis * np.tile(left, (3, 1))).sum(axis=1) / noise
        right -= prior @ np.concatenate([gain - 1, -moved[:, 0], -moved[:, 1]])
        spread = np.linalg.inv(normal)
        step = (spread @ right).reshape(3, count)
        gain *= 1 + np.clip(step[0], -0.3, 0.3)
        moved -= np.clip(step[1:].T, -1.0, 1.0)
        gain, moved = gain / gain.mean(), moved - moved.mean(axis=0)
        found = np.stack([gain - 1, -moved[:, 0], -moved[:, 1]])
        sure = [np.sum(calm * spread[k : k + count, k : k + count]) for k in range(0, 3 * count, count)]
        size = np.maximum((np.einsum("ik,kl,il->i", found, calm, found) + sure) / count, 1e-8)
    return Steadiness(gain, moved * coarser)


def _steadied(
    pictures: NDArray[np.float32], gain: NDArray[np.float64], moved: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return images [K, H, W] at the mean exposure and moved back."""
    return np.stack([_undone(*one) for one in zip(pictures, gain, moved, strict=True)])


def _undone(picture: NDArray[np.float32], gain: float, moved: NDArray) -> NDArray[np.float32]:
    """Return an image [H, W] divided by a gain and moved back by (down, right) pixels."""
    from scipy.ndimage import shift

    still = np.abs(moved).max() < 1e-3
    back = picture if still else shift(picture, -moved, order=3, mode="nearest")
    return (np.asarray(back) / gain).astype(np.float32)


def import_film(
    folder: str | Path,
    path: str | Path,
    reading: FilmReading | None = None,
    shape: tuple[int, int] | None = None,
    progress: Progress = silent,
) -> FilmResult:
    """Make the images of a scan of a film of its show: the files that frames.csv names.

    Args:
        folder: A scan's folder with show.yaml.
        path: The film: a video file.
        reading: How it is read; None is the default.
        shape: Size (H, W) of the images, pixels; None is 160 columns, or the film's.
        progress: Called as the work goes on.

    Raises:
        ConfigError: The folder holds no show.
        DataError: The film is no video, or does not show the show.
    """
    folder, reading = Path(folder), reading or FilmReading()
    show = read_show(folder)
    white, hold_s = show.info.white_dn, show.show.hold_s
    if white is not None:
        raise ConfigError(f"{folder}: scan.yaml states white_dn {white}; a film's images have 16 bits")
    video = open_video(path, tone=reading.tone, fps=reading.fps)
    if shape is None:
        columns = min(_WIDTH, video.width)
        shape = (max(1, round(video.height * columns / video.width)), columns)
    with tempfile.TemporaryFile(dir=folder) as store:
        film = read_film(video, shape, store, 1.2 * show.duration_s + _LONGER, progress)
        clock = find_show(film, show)
        stood = [part for part in show.parts if part.kind in ("pattern", "check")]
        pictures, clipped = _pictures(film, clock, stood)
        count = len(show.scan_frames)
        design = np.stack([np.r_[show.cells(part).ravel(), 1.0] for part in stood])
        checks = pictures[count:]
        again = [float((checks[k] + checks[k + 1] - 2 * checks[dark]).sum()) for k, dark in ((1, 0), (8, 10))]
        brighter = again[1] / max(again[0], 1e-9) - 1
        locked = abs(brighter) < _LOCKED
        curve, misfit = (1.0, 0.0), (math.nan, math.nan)
        if reading.fit_tone and locked:
            if reading.steady:
                moved = find_steadiness(pictures, design, hold_s, progress).shift_px[count:]
                checks = _steadied(checks, np.ones(len(checks)), moved)
            curve, misfit = fit_tone(list(checks))
        light, design = straightened(pictures[:count], curve), design[:count]
        found = find_steadiness(light, design, hold_s, progress)
        if found.shift_rms_px > _MOST_PX * shape[1]:
            raise DataError(
                f"the phone moved by {found.shift_rms_px:.1f} of {shape[1]} pixels, at most "
                f"{100 * _MOST_PX:g} % may be taken out; put it on something stiff and film again"
            )
        unsteady = found.gain_rms > _STEADY_GAIN or found.shift_rms_px > _STEADY_PX
        corrected = reading.steady and unsteady
        if corrected:
            light = _steadied(light, found.gain, found.shift_px)
        for scan_frame, picture, over in zip(show.scan_frames, light, clipped, strict=False):
            _save(folder / scan_frame.file, picture, over)
        steady = _Reference.of(light, design) if corrected else None
        captures = [
            _write_capture(
                folder, show, part, film, clock, reading, lambda one: straightened(one, curve), steady
            )
            for part in show.parts
            if part.kind == "target"
        ]
    warnings = []
    if not locked:
        warnings.append(
            f"after the brightest image the others are {100 * brighter:+.0f} % brighter than before: the "
            "exposure is not locked, so that the tone curve could not be checked; lock it and film again"
        )
    elif reading.fit_tone and misfit[1] > 0.05:
        warnings.append(
            f"the light of halves differs from that of the whole by {100 * misfit[1]:.0f} %: another tone "
            "curve, or light that changes; film with HDR and filters off, and try --tone rec709 or as-is"
        )
    if unsteady and not reading.steady:
        warnings.append("exposure or place changed and was left as it is (--no-steady)")
    return FilmResult(
        clock,
        shape,
        curve,
        misfit,
        locked,
        found.gain_rms,
        found.shift_rms_px,
        corrected,
        captures,
        warnings,
    )


def _pictures(film: Film, clock: Clock, parts: list[Part]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the mean light of the frames in the middle of each stretch, [K, H, W], and where it saturates."""
    found = []
    for part in parts:
        guard = _GUARD * (part.stop_s - part.start_s)
        first, last = clock.film_s(part.start_s + guard), clock.film_s(part.stop_s - guard)
        chosen = (film.times_s >= first) & (film.times_s <= last)
        if not chosen.any():
            raise DataError(
                f"no frame of the film lies between {first:.2f} and {last:.2f} s, while a pattern stood; "
                "film with more frames per second, or plan with a longer --hold-s"
            )
        found.append(film.mean(chosen))
    return np.stack([light for light, _ in found]), np.stack([over for _, over in found])


@dataclass(frozen=True, eq=False)
class _Reference:
    """What does not move while a target does: the dark and its slopes, beside all that the cells can give."""

    basis: NDArray[np.float64]  # [3 + modes, pixels]: dark, its slopes, the cells' light

    @classmethod
    def of(cls, light: NDArray[np.float32], design: NDArray[np.float64]) -> _Reference:
        columns = np.linalg.pinv(design) @ light.reshape(len(light), -1)  # [n + 1, pixels]
        dark = columns[-1].reshape(light.shape[1:]).astype(np.float64)
        slopes = [part.ravel() for part in np.gradient(dark)]
        _, _, modes = np.linalg.svd(columns[:-1], full_matrices=False)
        return cls(np.stack([dark.ravel(), *slopes, *modes[:_MODES]]))

    def steadied(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return an image at the scan's exposure and place."""
        found = np.linalg.lstsq(self.basis.T, picture.ravel().astype(np.float64), rcond=1e-6)[0]
        gain = float(np.clip(found[0], 0.5, 2.0))
        return _undone(picture, gain, -np.clip(found[1:3] / gain, -5, 5))  # F = D + u dD/dy: D moved by -u


def _write_capture(
    folder: Path,
    show: Show,
    part: Part,
    film: Film,
    clock: Clock,
    reading: FilmReading,
    straight: Callable[[NDArray], NDArray[np.float32]],
    steady: _Reference | None,
) -> Path:
    """Write the capture folder of a character that moved, still without events, and return it."""
    scene = show.scenes[part.number]
    out = folder / "captures" / scene.target.name
    out.parent.mkdir(exist_ok=True)
    if (out / "capture.yaml").is_file():  # of this film, or of one before it
        shutil.rmtree(out)
    count = max(2, math.floor((part.stop_s - part.start_s) * reading.capture_hz))
    edges = part.start_s + np.arange(count + 1) / reading.capture_hz
    rows = ["t_us,file"]
    with new_folder(out) as draft:
        (draft / "frames").mkdir()
        for k, (first, last) in enumerate(pairwise(edges.tolist())):
            chosen = (film.times_s >= clock.film_s(first)) & (film.times_s < clock.film_s(last))
            if not chosen.any():
                continue
            light, over = film.mean(chosen)
            light = straight(light)
            light = light if steady is None else steady.steadied(light)
            middle = (float(film.times_s[chosen].mean()) - clock.start_s) / clock.rate - part.start_s
            _save(draft / f"frames/{k:04d}.png", light, over)
            rows.append(f"{round(1e6 * middle)},frames/{k:04d}.png")
        (draft / "frames.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        Image.fromarray(np.round(255 * scene.target.mask).astype(np.uint8)).save(draft / "target.png")
        height, width = film.frames.shape[1:]
        motion = show.motion
        save_yaml(
            {
                "camera": {"name": "phone", "width": width, "height": height},
                "events": "simulated.h5",
                "frames": "frames.csv",
                "target": {"name": scene.target.name, "mask": "target.png", "size_m": show.show.target_m},
                "motion": {
                    "start_m": list(motion.start_m),
                    "speed_m_s": motion.speed_m_s,
                    "direction": list(motion.direction),
                    "start_us": 0,
                },
                "setup": {"events": "simulated from the measured transport: no event camera saw this"},
            },
            draft / "capture.yaml",
        )
    return out


def add_events(folder: str | Path, capture: Path, transport: str | Path, seed: int = 0) -> None:
    """Add to the capture of a moving character the events that this wall would have sent: simulated.h5.

    They are simulated from the measured transport and the known character, with the default pixel.

    Args:
        folder: The scan's folder.
        capture: The capture folder, named by its character.
        transport: The measured transport.
        seed: Seed of mismatch and noise.
    """
    show = read_show(folder)
    scene = show.scenes[show.show.targets.index(capture.name)]
    setup = MeasuredSetup(file=str(transport))
    setup = setup.resized(setup.measurement().shape)
    events = setup.event_camera.record(
        setup.observe(scene), 0.0, scene.duration_s, seed=derive_seed(seed, capture.name)
    )
    write_events(capture / "simulated.h5", events)


def _save(path: Path, light: NDArray[np.float32], over: NDArray[np.bool_]) -> None:
    """Write an image of 16 bits, saturated where the film was."""
    numbers = np.clip(np.rint(light * 65_535), 0, _CODED).astype(np.uint16)
    numbers[over] = 65_535
    with new_file(path) as draft:
        Image.fromarray(numbers).save(draft, "PNG")
