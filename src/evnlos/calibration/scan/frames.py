"""The images of a scan: as light, compared between repeats, and rehearsed by the simulator.

- The images of a scan as light: dark frames taken off, saturation and linearity checked.
- Whether the repeats of a scan agree: a camera that moved, a light that faded, a frame that differs.
- A planned scan recorded by the simulator instead of a camera: to try plan, exposure and import beforehand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from evnlos.calibration.scan.folder import (
    Reader,
    ScanFrame,
    ScanInfo,
    is_main,
    lit_cells,
    read_scan_frames,
    read_scan_info,
)
from evnlos.cameras import FrameCamera
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import DataError
from evnlos.files import new_file

_SATURATED_SHARE = 1e-3
_LINEAR_WITHIN = 0.05
_ROOM_BYTES = 4 << 30
_MOST_BAD = 0.2


@dataclass(frozen=True, eq=False)
class ScanLight:
    """What the camera received from each pattern.

    Args:
        lit: Frames less the dark of their repeat, float32 [repeats, patterns, H W], white levels.
        dark: Mean dark frame, float32 [H W], white levels.
        dark_variance: Variance of a dark frame at each pixel, float64 [H W]; NaN where there are too few.
        darks: Number of dark frames, all repeats.
        bad: Pixels that saturate in the dark or in a few frames, bool [H W].
        shape: Size (H, W), pixels.
        linearity: Ratio of light over ratio of exposures, 1 for a linear camera; None where not recorded.
        white_dn: Digital number of white.
    """

    lit: NDArray[np.float32]
    dark: NDArray[np.float32]
    dark_variance: NDArray[np.float64]
    darks: int
    bad: NDArray[np.bool_]
    shape: tuple[int, int]
    linearity: float | None
    white_dn: int


def read_light(
    info: ScanInfo, scan_frames: list[ScanFrame], read: Reader, shape: tuple[int, int] | None = None
) -> ScanLight:
    """Read all images, one at a time.

    Args:
        info: What was shown.
        scan_frames: The images.
        read: What reads one.
        shape: Size (H, W) to reduce them to by area averaging; None keeps the camera's.

    Raises:
        DataError: Frames are saturated, unlike each other or too many, or the camera is not linear.
    """
    first = read(scan_frames[0])
    full = (int(first.shape[0]), int(first.shape[1]))
    shape = shape or full
    if shape[0] > full[0] or shape[1] > full[1] or min(shape) < 1:
        raise DataError(f"{shape[0]} x {shape[1]} pixels are requested, the images have {full[0]} x {full[1]}")
    white = info.white_dn or int(np.iinfo(first.dtype).max)
    count, pixels = info.patterns.count, shape[0] * shape[1]
    room = 4 * info.repeats * count * pixels
    if room > _ROOM_BYTES:
        raise DataError(
            f"the scan takes {room / 2**30:.1f} GiB at {shape[0]} x {shape[1]} pixels, above "
            f"{_ROOM_BYTES >> 30}; give a smaller --height and --width"
        )
    darks = [
        scan_frame for scan_frame in scan_frames if scan_frame.pattern is None and is_main(scan_frame, info)
    ]
    stacks: dict[int, list[NDArray[np.float32]]] = {}
    blind = np.zeros(full, np.bool_)
    for scan_frame in darks:
        image = read(scan_frame)
        blind |= image >= white
        stacks.setdefault(scan_frame.repeat, []).append(_levels(image, white, shape))
    if blind.mean() > _MOST_BAD:
        raise DataError(
            f"{100 * blind.mean():.0f} % of the pixels are saturated ({white} DN) in the dark frames; "
            "shade the wall, or shorten the exposure"
        )
    means = {repeat: np.mean(stack, axis=0) for repeat, stack in stacks.items()}
    lit = np.empty((info.repeats, count, pixels), np.float32)
    clipped = np.zeros(full, np.bool_)
    for scan_frame in scan_frames:
        if scan_frame.pattern is None or not is_main(scan_frame, info):
            continue
        image = read(scan_frame)
        over = (image >= white) & ~blind
        if (share := float(over.mean())) > _SATURATED_SHARE:
            raise DataError(
                f"{scan_frame.file}: {100 * share:.1f} % of the pixels are saturated ({white} DN), at most "
                f"{100 * _SATURATED_SHARE:g} % may be; shorten exposure_s below {info.exposure_s:g} s or dim "
                "the light"
            )
        clipped |= over
        lit[scan_frame.repeat, scan_frame.pattern] = _levels(image, white, shape) - means[scan_frame.repeat]
    bad = reduce_by_area((blind | clipped)[None].astype(np.float32), shape)[0].ravel() > 0
    linearity = _linearity(info, scan_frames, read, white, shape)
    variance, residuals = np.full(pixels, np.nan), len(darks) - len(stacks)
    if residuals > 0:
        squares = sum(((np.stack(s) - means[r]).astype(np.float64) ** 2).sum(axis=0) for r, s in stacks.items())
        variance = np.asarray(squares) / residuals
    dark = np.stack(list(means.values())).mean(axis=0)
    return ScanLight(lit, dark, variance, len(darks), bad, shape, linearity, white)


def _levels(image: NDArray, white: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return an image as white levels, reduced, flat."""
    return reduce_by_area(image[None].astype(np.float32) / np.float32(white), shape)[0].ravel()


def _linearity(
    info: ScanInfo, scan_frames: list[ScanFrame], read: Reader, white: int, shape: tuple[int, int]
) -> float | None:
    """Return the light at another exposure over what a linear camera would have seen; refuse if far from 1.

    None where there is no such image, or where noise leaves the ratio open.
    """
    others = [
        scan_frame
        for scan_frame in scan_frames
        if scan_frame.pattern is not None and not is_main(scan_frame, info)
    ]
    if not others:
        return None
    main: dict[tuple[int | None, int], list[NDArray[np.float32]]] = {}
    wanted = {None, *(scan_frame.pattern for scan_frame in others)}
    for scan_frame in scan_frames:
        if is_main(scan_frame, info) and scan_frame.pattern in wanted:
            main.setdefault((scan_frame.pattern, scan_frame.repeat), []).append(
                _levels(read(scan_frame), white, shape)
            )
    weights, expected, seen = [], [], []
    for scan_frame in others:
        darks = [
            s for s in scan_frames if s.pattern is None and abs(s.exposure_s - scan_frame.exposure_s) < 1e-9
        ]
        if not darks:
            raise DataError(
                f"{scan_frame.file} was exposed for {scan_frame.exposure_s:g} s, and no dark frame was; "
                "record one, or "
                "take the line out of frames.csv"
            )
        below = np.mean([_levels(read(s), white, shape) for s in darks], axis=0)
        seen.append(_levels(read(scan_frame), white, shape) - below)
        # Expected from the same repeat: between repeats the light may have changed, which is another fault.
        dark = main[None, scan_frame.repeat]
        full = np.mean(main[scan_frame.pattern, scan_frame.repeat], axis=0)
        # Weighted by images with noise of their own: weighted by itself, the slope would come out too low.
        other = (scan_frame.repeat + 1) % info.repeats
        if other != scan_frame.repeat:
            weights.append(
                np.mean(main[scan_frame.pattern, other], axis=0) - np.mean(main[None, other], axis=0)
            )
            half = dark
        elif len(dark) > 1:
            weights.append(full - np.mean(dark[::2], axis=0))
            half = dark[1::2]
        else:
            return None
        expected.append((full - np.mean(half, axis=0)) * (scan_frame.exposure_s / info.exposure_s))
    if info.repeats == 1:
        weights = [np.sum(weights, axis=0) - own for own in weights] if len(weights) > 1 else weights
    ratio, error = _ratio(*(np.stack(one, dtype=np.float64) for one in (seen, expected, weights)))
    if error > _LINEAR_WITHIN:
        return None
    if not abs(ratio - 1) <= _LINEAR_WITHIN + 3 * error:
        raise DataError(
            f"at another exposure the camera shows {ratio:.2f} of the light that a linear one would, beyond "
            f"1 +- {_LINEAR_WITHIN:g}; save raw images without gamma, auto exposure or tone curve"
        )
    return ratio


def _ratio(
    seen: NDArray[np.float64], expected: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the weighted slope of `seen` over `expected`, [n, pixels] each, and its standard error."""
    total = float((weight * expected).sum())
    if not total > 0:
        return float("nan"), float("inf")
    ratio = float((weight * seen).sum()) / total
    rest = seen - ratio * expected
    return ratio, float(np.sqrt((weight**2).sum() * (rest**2).mean())) / total


_MOST_SHIFT_PX = 0.3
_MOST_GAIN = 0.05
_MOST_DIFFERENCE = 0.1
_BLOCK = 6
_SIGMAS = 5


@dataclass(frozen=True)
class Agreement:
    """How repeats differ from the first one, at their worst.

    Args:
        shift_px: Movement of the image, pixels.
        gain: Relative change of the light.
        difference: Smooth difference of the worst pattern that noise does not explain, as a share of the
            brightest pattern's light.
        pattern: Number of that pattern.
    """

    shift_px: float
    gain: float
    difference: float
    pattern: int


def compare_repeats(lit: NDArray[np.float32], shape: tuple[int, int]) -> Agreement | None:
    """Compare every repeat with the first one.

    Movement and gain are fitted to all frames at once, F_r = (1 + g) F_0 + u dF/dx + v dF/dy; what is left of
    one pattern is averaged over blocks of pixels, in which noise averages out and a real difference does not.

    Args:
        lit: Light of the patterns, [repeats, patterns, H W].
        shape: Size (H, W), pixels.

    Returns:
        The comparison; None for a single repeat.

    Raises:
        DataError: The camera moved, the light changed, or a frame differs; the text names it.
    """
    if len(lit) < 2:
        return None
    frames = lit.reshape(len(lit), -1, *shape)
    worst = Agreement(0.0, 0.0, 0.0, 0)
    for repeat in range(1, len(lit)):
        one = _against_first(frames, repeat)
        worst = Agreement(
            max(worst.shift_px, one.shift_px),
            max(worst.gain, one.gain, key=abs),
            max(worst.difference, one.difference),
            one.pattern if one.difference >= worst.difference else worst.pattern,
        )
    return worst


def _against_first(frames: NDArray[np.float32], repeat: int) -> Agreement:
    shape = frames.shape[2:]
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for first, other in zip(frames[0], frames[repeat], strict=True):
        columns, difference = _columns(first, other), (other - first)[1:-1, 1:-1].ravel()
        normal += columns @ columns.T
        right += columns @ difference
    normal += 1e-9 * np.trace(normal) * np.eye(3)
    gain, du, dv = (float(value) for value in np.linalg.solve(normal, right))
    shift = float(np.hypot(du, dv))
    block = (min(_BLOCK, shape[0]), min(_BLOCK, shape[1]))
    scale = max(float(np.sqrt(np.mean(_blocks(f, block) ** 2))) for f in frames[0])
    excess = []
    for first, other in zip(frames[0], frames[repeat], strict=True):
        rest = other - first
        means = _blocks(rest, block)
        # Neighbours differ by noise alone where the light is smooth: what noise leaves in a block's mean.
        noise = float(np.mean(np.diff(rest, axis=1) ** 2)) / 2 / (block[0] * block[1])
        power, spread = float(np.mean(means**2)), noise * np.sqrt(2 / means.size)
        found = power - noise
        excess.append(np.sqrt(found) / max(scale, 1e-12) if found > _SIGMAS * spread else 0.0)
    pattern = int(np.argmax(excess))
    difference = float(excess[pattern])
    _refuse(shift, gain, difference, pattern, repeat)
    return Agreement(shift, gain, difference, pattern)


def _refuse(shift: float, gain: float, difference: float, pattern: int, repeat: int) -> None:
    if difference > _MOST_DIFFERENCE / 4 and shift > _MOST_SHIFT_PX:
        raise DataError(
            f"repeat {repeat} is shifted by {shift:.2f} pixels against repeat 0, at most {_MOST_SHIFT_PX:g} "
            "may be: "
            "the camera, the wall or the display moved; fix it and scan again, or leave the repeat out"
        )
    if difference > _MOST_DIFFERENCE / 4 and abs(gain) > _MOST_GAIN:
        raise DataError(
            f"repeat {repeat} has {100 * gain:+.0f} % of light against repeat 0, at most {100 * _MOST_GAIN:g} "
            "% may "
            "be: let display and lamps warm up, switch off automatic exposure, and scan again"
        )
    if difference > _MOST_DIFFERENCE:
        raise DataError(
            f"pattern {pattern} differs between repeats 0 and {repeat} by {100 * difference:.0f} % of the "
            "brightest "
            f"pattern's light beyond noise, at most {100 * _MOST_DIFFERENCE:g} % may be: a wrong or late "
            "image, or "
            "another light; record it again"
        )


def _columns(first: NDArray, other: NDArray) -> NDArray[np.float64]:
    """Return gain and shift columns [3, n]; slopes are those of both frames' mean, which halves their noise."""
    mean = (first.astype(np.float64) + other) / 2
    across = (mean[1:-1, 2:] - mean[1:-1, :-2]) / 2
    down = (mean[2:, 1:-1] - mean[:-2, 1:-1]) / 2
    return np.stack([mean[1:-1, 1:-1].ravel(), across.ravel(), down.ravel()])


def _blocks(image: NDArray, block: tuple[int, int]) -> NDArray[np.float64]:
    high, wide = image.shape[0] // block[0], image.shape[1] // block[1]
    cut = image[: high * block[0], : wide * block[1]].astype(np.float64)
    return cut.reshape(high, block[0], wide, block[1]).mean(axis=(1, 3))


Change = Callable[[NDArray[np.float64], ScanFrame], NDArray[np.float64]]


def rehearse_scan(
    folder: str | Path,
    matrix: ArrayLike,
    shape: tuple[int, int],
    camera: FrameCamera,
    *,
    ambient: float = 0.02,
    seed: int = 0,
    change: Change | None = None,
) -> int:
    """Take the images of a planned scan with a known setup, and return their number.

    Args:
        folder: A folder that `write_plan` wrote.
        matrix: White levels per cell at the scan's exposure, [H W, cells of the plane].
        shape: Size (H, W) of the camera image, pixels.
        camera: Its frame camera; an image at another exposure has light in proportion.
        ambient: Light that is always there, white levels.
        seed: Seed of the noise.
        change: Alters the light [H, W] of a frame before the exposure: a fault to rehearse.

    Raises:
        DataError: The matrix does not fit the plan and the size.
    """
    folder, matrix = Path(folder), np.asarray(matrix, np.float64)
    info = read_scan_info(folder)
    if matrix.shape != (shape[0] * shape[1], info.plane.height * info.plane.width):
        raise DataError(
            f"the matrix is {matrix.shape}; the plan and {shape[0]} x {shape[1]} pixels need "
            f"({shape[0] * shape[1]}, {info.plane.height * info.plane.width})"
        )
    scan_frames = read_scan_frames(folder, info)
    for number, scan_frame in enumerate(scan_frames):
        lit = np.zeros(info.plane.shape) if scan_frame.pattern is None else lit_cells(info, scan_frame.pattern)
        light = (matrix @ lit.ravel()).reshape(shape) + ambient
        if change is not None:
            light = change(light, scan_frame)
        light = light * (scan_frame.exposure_s / info.exposure_s)
        path = folder / scan_frame.file
        path.parent.mkdir(parents=True, exist_ok=True)
        with new_file(path) as draft:
            Image.fromarray(camera.expose(light[None], seed=seed, first_frame=number)[0]).save(draft, "PNG")
    return len(scan_frames)
