"""Events of a video, and of a batch of videos: the functions most users need."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.errors import ConfigError, DataError
from evnlos.sensor.event_model import PixelSettings
from evnlos.sensor.pixel import EventPixel, Mode, V2ePixel, in_mode
from evnlos.sensor.stream import EventStream
from evnlos.types import Events

Backend = Literal["numba", "torch"]
"""What computes: compiled loops on the CPU, or torch operations where the light is."""


def simulate_events(
    frames: ArrayLike | torch.Tensor,
    times_s: ArrayLike | torch.Tensor,
    pixel: PixelSettings | None = None,
    mode: Mode = "exact",
    seed: int = 0,
    thresholds: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    backend: Backend = "numba",
    device: torch.device | str | None = None,
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
        pixel: Settings of the pixels: an `EventPixel`, or those of another event model, which then says what
            happens; None = the paper's.
        mode: "exact" solves for the instants in continuous time. "v2e" steps from frame to frame and gives the
            same multiset of events as v2e at commit cac6384 wherever no random number is involved.
        seed: Seed of mismatch and noise, 0 to 2**64 - 1: same seed, same bytes, for any threads and tiles.
        thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units; None draws them.
        backend: "numba" runs on the CPU. "torch" has mode "v2e" only, runs where the frames are, and gives the
            same events; `simulate_batch` is its function for many clips.
        device: Device of the torch backend; None = where the frames are.
        threads: Number of threads of the numba backend; None = as many as torch uses.
        tile_px: Pixels that run together; None = a size that fits the cache.

    Returns:
        Events ordered by time, then row, then column, OFF before ON.

    Raises:
        DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        ConfigError: Unknown mode, backend, seed, thread count or threshold maps out of range.

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
    if backend not in get_args(Backend):
        raise ConfigError(f'backend is {backend!r}; give "numba" or "torch"')
    if backend == "torch":
        stepped = in_mode(EventPixel() if pixel is None else pixel, mode)
        if not isinstance(stepped, V2ePixel):
            raise ConfigError(f'mode is {mode!r}; the torch backend has "v2e" only, the numba backend has both')
        light = frames if isinstance(frames, torch.Tensor) else np.asarray(frames)
        batch = simulate_batch(
            light[None], times_s, stepped, [seed], thresholds, device=device, tile_px=tile_px
        )
        return batch[0]
    if device is not None:
        raise ConfigError(f'device is {device}; the numba backend runs on the CPU, use backend="torch"')
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


def simulate_batch(
    clips: ArrayLike | torch.Tensor,
    times_s: ArrayLike | torch.Tensor,
    pixel: EventPixel | V2ePixel | None = None,
    seeds: int | Sequence[int] = 0,
    thresholds: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float64,
    tile_px: int | None = None,
) -> list[Events]:
    """Return the events of each clip of a batch, in mode "v2e", by torch operations on any device.

    Clip b alone gives the events that it gives in the batch: nothing depends on the other clips, on tiles or on
    the division of the work. With float64 they are those of `simulate_events(clips[b], times_s, pixel,
    mode="v2e", seed=seeds[b])`.

    Args:
        clips: Light in DN (255 = white), [B, T, H, W], at least 0; fastest with uint8. Not changed.
        times_s: Instants of the frames, [T], seconds, ascending, the same for all clips.
        pixel: Parameters of the pixels; None = the paper's.
        seeds: Seed of each clip, [B]; one integer s stands for `derive_seed(s, "clip", b)` with the index b.
        thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units, for all clips; None draws them.
        device: Where to compute; None = where the clips are.
        dtype: Precision of the filter. float64 gives the events of the numba kernels; float32 moves about one
            event in some ten thousand by a step, and is for devices on which float64 is slow.
        tile_px: Pixels that run together; None = a size that fits a CPU's cache, or fills a device.

    Returns:
        Events of each clip, ordered by time, then row, then column, OFF before ON.

    Raises:
        DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        ConfigError: Seeds, thresholds, dtype or tile out of range; hot pixels or jitter, which v2e has not.

    Example:
        >>> clips = torch.full((2, 3, 4, 5), 60, dtype=torch.uint8)
        >>> clips[1, 1:] = 200
        >>> pixel = EventPixel(threshold_sigma=0, cutoff_hz=0, leak_rate_hz=0, shot_noise_rate_hz=0)
        >>> [len(events) for events in simulate_batch(clips, [0.0, 0.1, 0.2], pixel)]
        [0, 160]
    """
    from evnlos.sensor._torch_batch import run_batch  # of no use to most, so not part of `import evnlos`

    pixel = EventPixel() if pixel is None else pixel
    return run_batch(clips, times_s, pixel, seeds, thresholds, device, dtype, tile_px)
