"""Whether the repeats of a scan agree: a camera that moved, a light that faded, a shot that differs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError

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
        DataError: The camera moved, the light changed, or a shot differs; the text names it.
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
            "picture, or "
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
