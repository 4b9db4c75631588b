"""The pictures of a scan as light: dark frames taken off, saturation and linearity checked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.scan.folder import Reader, ScanInfo, Shot, is_main
from evnlos.dataset.sampling import reduce_by_area
from evnlos.errors import DataError

_SATURATED_SHARE = 1e-3
_LINEAR_WITHIN = 0.05
_ROOM_BYTES = 4 << 30
_MOST_BAD = 0.2


@dataclass(frozen=True, eq=False)
class Light:
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


def read_light(info: ScanInfo, shots: list[Shot], read: Reader, shape: tuple[int, int] | None = None) -> Light:
    """Read all pictures, one at a time.

    Args:
        info: What was shown.
        shots: The pictures.
        read: What reads one.
        shape: Size (H, W) to reduce them to by area averaging; None keeps the camera's.

    Raises:
        DataError: Frames are saturated, unlike each other or too many, or the camera is not linear.
    """
    first = read(shots[0])
    full = (int(first.shape[0]), int(first.shape[1]))
    shape = shape or full
    if shape[0] > full[0] or shape[1] > full[1] or min(shape) < 1:
        raise DataError(
            f"{shape[0]} x {shape[1]} pixels are asked for, the pictures have {full[0]} x {full[1]}"
        )
    white = info.white_dn or int(np.iinfo(first.dtype).max)
    count, pixels = info.patterns.count, shape[0] * shape[1]
    room = 4 * info.repeats * count * pixels
    if room > _ROOM_BYTES:
        raise DataError(
            f"the scan takes {room / 2**30:.1f} GiB at {shape[0]} x {shape[1]} pixels, above "
            f"{_ROOM_BYTES >> 30}; give a smaller --height and --width"
        )
    darks = [shot for shot in shots if shot.pattern is None and is_main(shot, info)]
    stacks: dict[int, list[NDArray[np.float32]]] = {}
    blind = np.zeros(full, np.bool_)
    for shot in darks:
        image = read(shot)
        blind |= image >= white
        stacks.setdefault(shot.repeat, []).append(_levels(image, white, shape))
    if blind.mean() > _MOST_BAD:
        raise DataError(
            f"{100 * blind.mean():.0f} % of the pixels are saturated ({white} DN) in the dark frames; "
            "shade the wall, or shorten the exposure"
        )
    means = {repeat: np.mean(stack, axis=0) for repeat, stack in stacks.items()}
    lit = np.empty((info.repeats, count, pixels), np.float32)
    clipped = np.zeros(full, np.bool_)
    for shot in shots:
        if shot.pattern is None or not is_main(shot, info):
            continue
        image = read(shot)
        over = (image >= white) & ~blind
        if (share := float(over.mean())) > _SATURATED_SHARE:
            raise DataError(
                f"{shot.file}: {100 * share:.1f} % of the pixels are saturated ({white} DN), at most "
                f"{100 * _SATURATED_SHARE:g} % may be; shorten exposure_s below {info.exposure_s:g} s or dim "
                "the light"
            )
        clipped |= over
        lit[shot.repeat, shot.pattern] = _levels(image, white, shape) - means[shot.repeat]
    bad = reduce_by_area((blind | clipped)[None].astype(np.float32), shape)[0].ravel() > 0
    linearity = _linearity(info, shots, read, white, shape)
    variance, residuals = np.full(pixels, np.nan), len(darks) - len(stacks)
    if residuals > 0:
        squares = sum(((np.stack(s) - means[r]).astype(np.float64) ** 2).sum(axis=0) for r, s in stacks.items())
        variance = np.asarray(squares) / residuals
    dark = np.stack(list(means.values())).mean(axis=0)
    return Light(lit, dark, variance, len(darks), bad, shape, linearity, white)


def _levels(image: NDArray, white: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return a picture as white levels, reduced, flat."""
    return reduce_by_area(image[None].astype(np.float32) / np.float32(white), shape)[0].ravel()


def _linearity(
    info: ScanInfo, shots: list[Shot], read: Reader, white: int, shape: tuple[int, int]
) -> float | None:
    """Return the light at another exposure over what a linear camera would have seen; refuse if far from 1.

    None where there is no such picture, or where noise leaves the ratio open.
    """
    others = [shot for shot in shots if shot.pattern is not None and not is_main(shot, info)]
    if not others:
        return None
    main: dict[tuple[int | None, int], list[NDArray[np.float32]]] = {}
    wanted = {None, *(shot.pattern for shot in others)}
    for shot in shots:
        if is_main(shot, info) and shot.pattern in wanted:
            main.setdefault((shot.pattern, shot.repeat), []).append(_levels(read(shot), white, shape))
    weights, expected, seen = [], [], []
    for shot in others:
        darks = [s for s in shots if s.pattern is None and abs(s.exposure_s - shot.exposure_s) < 1e-9]
        if not darks:
            raise DataError(
                f"{shot.file} was exposed for {shot.exposure_s:g} s, and no dark frame was; record one, or "
                "take the line out of frames.csv"
            )
        below = np.mean([_levels(read(s), white, shape) for s in darks], axis=0)
        seen.append(_levels(read(shot), white, shape) - below)
        # Expected from the same repeat: between repeats the light may have changed, which is another fault.
        dark = main[None, shot.repeat]
        full = np.mean(main[shot.pattern, shot.repeat], axis=0)
        # Weighted by pictures with noise of their own: weighted by itself, the slope would come out too low.
        other = (shot.repeat + 1) % info.repeats
        if other != shot.repeat:
            weights.append(np.mean(main[shot.pattern, other], axis=0) - np.mean(main[None, other], axis=0))
            half = dark
        elif len(dark) > 1:
            weights.append(full - np.mean(dark[::2], axis=0))
            half = dark[1::2]
        else:
            return None
        expected.append((full - np.mean(half, axis=0)) * (shot.exposure_s / info.exposure_s))
    if info.repeats == 1:
        weights = [np.sum(weights, axis=0) - own for own in weights] if len(weights) > 1 else weights
    ratio, error = _ratio(*(np.stack(one, dtype=np.float64) for one in (seen, expected, weights)))
    if error > _LINEAR_WITHIN:
        return None
    if not abs(ratio - 1) <= _LINEAR_WITHIN + 3 * error:
        raise DataError(
            f"at another exposure the camera shows {ratio:.2f} of the light that a linear one would, beyond "
            f"1 +- {_LINEAR_WITHIN:g}; save raw pictures without gamma, auto exposure or tone curve"
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
