"""Events of a video: the function most users need."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.errors import DataError
from evnlos.sensor.pixel import EventPixel
from evnlos.sensor.stream import EventStream, Mode
from evnlos.types import Events


def simulate_events(
    frames: ArrayLike | torch.Tensor,
    times_s: ArrayLike | torch.Tensor,
    pixel: EventPixel | None = None,
    mode: Mode = "exact",
    seed: int = 0,
    thresholds: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    threads: int | None = None,
    tile_px: int | None = None,
) -> Events:
    """Return the events that an array of event pixels sends while it watches a video.

    With L(I) = ln I above 20 DN and I ln(20) / 20 below, the filter's output P obeys
    dP/dt = 2 pi fc (I + 20) / 275 (L(I) - P), and a pixel sends an event whenever P has moved by a threshold
    away from its reference, which then follows by that threshold. The first frame gives the state at rest.

    Args:
        frames: Light in DN (255 = white; fractions and more than 255 allowed), [T, H, W], at least 0, numpy or
            torch; linear in time between the frames.
        times_s: Instants of the frames, [T], seconds, ascending; any spacing.
        pixel: Parameters of the pixels; None = the paper's.
        mode: "exact" solves for the instants in continuous time. "v2e" steps from frame to frame and gives the
            same multiset of events as v2e at commit cac6384 wherever no random number is involved.
        seed: Seed of mismatch and noise, 0 to 2**64 - 1: same seed, same bytes, for any threads and tiles.
        thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units; None draws them.
        threads: Number of threads; None = as many as torch uses.
        tile_px: Pixels that run together; None = a size that fits the cache.

    Returns:
        Events ordered by time, then row, then column, OFF before ON.

    Raises:
        DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        ConfigError: Unknown mode, seed, thread count or threshold maps out of range.

    Example:
        >>> times_s = np.linspace(0.0, 0.1, 11)
        >>> frames = 50.0 * np.exp(5.0 * times_s)[:, None, None] * np.ones((1, 1))
        >>> pixel = EventPixel(threshold_sigma=0, cutoff_hz=0, leak_rate_hz=0, shot_noise_rate_hz=0)
        >>> simulate_events(frames, times_s, pixel).t_us // 1000
        array([30, 60, 90])
    """
    shape = np.shape(frames)
    if len(shape) != 3 or 0 in shape[1:]:
        raise DataError(f"frames has shape {tuple(shape)}; give [T, H, W] with at least one pixel")
    stream = EventStream(
        EventPixel() if pixel is None else pixel,
        (int(shape[1]), int(shape[2])),
        mode=mode,
        seed=seed,
        thresholds=thresholds,
        threads=threads,
        tile_px=tile_px,
    )
    stream.push(frames, times_s)
    return stream.finish()
