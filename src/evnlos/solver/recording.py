"""The frames of a recording made ready for the joint problem: the object's light alone, at a working size."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.dataset.fixed_pattern import FixedPattern
from evnlos.dataset.sampling import reduce_by_area
from evnlos.errors import ConfigError
from evnlos.setups import Setup


def object_light(
    frames: NDArray,
    peak: int,
    setup: Setup,
    shape: tuple[int, int],
    pattern: FixedPattern | None = None,
) -> torch.Tensor:
    """Return frames less the setup's ambient light, reduced by area averaging.

    Args:
        frames: Digital numbers [N, H, W].
        peak: Largest digital number.
        setup: The setup that says how much ambient light there is.
        shape: Size (h, w) of the result, pixels.
        pattern: The camera's fixed pattern, to be taken off first.

    Returns:
        White levels, float32 [N, h, w]; noise makes some of them negative.
    """
    levels = frames / np.float32(peak) if pattern is None else pattern.correct(frames, peak)
    size = (frames.shape[-2], frames.shape[-1])
    return torch.from_numpy(reduce_by_area(levels - setup.ambient_light(size).numpy(), shape))


def position_subsets(count: int, positions: int, subsets: int) -> list[NDArray[np.int64]]:
    """Return up to `subsets` different, equally spaced choices of `positions` out of `count`.

    Raises:
        ConfigError: Fewer than one position, or more than there are.

    Example:
        >>> [one.tolist() for one in position_subsets(40, 2, 2)]
        [[5, 25], [15, 35]]
    """
    if not 1 <= positions <= count or subsets < 1:
        raise ConfigError(
            f"{positions} positions of {count} in {subsets} subsets; give 1 to {count}, and 1 or more"
        )
    found: dict[tuple[int, ...], NDArray[np.int64]] = {}
    for k in range(subsets):
        chosen = np.floor((np.arange(positions) + (k + 0.5) / subsets) * count / positions).astype(np.int64)
        found.setdefault(tuple(chosen.tolist()), chosen)
    return list(found.values())
