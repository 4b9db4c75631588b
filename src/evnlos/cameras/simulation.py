"""Events of a video, and of light that arrives in blocks of frames.

- Events from light that arrives in blocks of frames: bounded memory for recordings of any length.
- Events of a video: the function most users need.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import PixelSettings
from evnlos.cameras.pixel import EventPixel, Mode, in_mode
from evnlos.cameras.random_numbers import check_seed
from evnlos.cameras.streams import Columns, Frames, Light, check_light, check_times, join, sort_times
from evnlos.errors import ConfigError, DataError
from evnlos.types import Events

_BLOCK_STEPS = 256


class EventStream:
    """An array of event pixels that takes light block by block and keeps its state in between.

    The events are the same bytes for any division of the frames into blocks, any number of threads and any
    size of tile.

    Args:
        pixel: Settings of the pixels: an `EventPixel`, or those of any other event model.
        shape: Sensor size (height, width), pixels.
        mode: "v2e" steps an `EventPixel` from frame to frame as v2e does; "exact" runs the model that the
            settings name.
        seed: Seed of mismatch and noise, 0 to 2**64 - 1.
        thresholds: Thresholds (on, off) of each pixel, [H, W] each, log units; None draws them.
        threads: Number of threads; None = as many as torch uses.
        tile_px: Pixels that run through a block together; None = a size that fits the cache.

    Raises:
        ConfigError: Unknown mode, seed, thread count or threshold maps out of range.

    Example:
        >>> from evnlos.cameras import EventPixel
        >>> stream = EventStream(EventPixel(leak_rate_hz=0, shot_noise_rate_hz=0), (2, 3))
        >>> stream.push(np.full((1, 2, 3), 50.0), [0.0])
        >>> stream.push(np.full((2, 2, 3), 50.0), [0.1, 0.2])
        >>> stream.finish()
        Events(0 events, 3 x 2)
    """

    def __init__(
        self,
        pixel: PixelSettings,
        shape: tuple[int, int],
        *,
        mode: Mode = "exact",
        seed: int = 0,
        thresholds: tuple[ArrayLike, ArrayLike] | None = None,
        threads: int | None = None,
        tile_px: int | None = None,
    ) -> None:
        pixel = in_mode(pixel, mode)
        if len(shape) != 2 or min(shape) < 1:
            raise ConfigError(f"shape is {tuple(shape)}; give (height, width), at least 1 pixel each")
        self.shape, self._disordered = shape, pixel.disorder_s > 0
        self._array = pixel.model(shape, check_seed(seed), thresholds, tile_px=tile_px, threads=threads)
        self._blocks: list[Columns] = []
        self._last_s = -np.inf

    def push(self, frames: ArrayLike | torch.Tensor, times_s: ArrayLike | torch.Tensor) -> None:
        """Take the next frames; the first frame ever is the light to which all pixels have settled.

        Args:
            frames: Light in DN (255 = white; fractions and more than 255 allowed), [T, H, W], at least 0.
            times_s: Instants of the frames, [T], seconds, ascending, after those of the block before.

        Raises:
            DataError: Wrong shapes, NaN, negative light, or times that do not ascend.
        """
        light = check_light(frames)
        if light.shape[1:] != tuple(self.shape):
            raise DataError(f"frames are {light.shape[1]} x {light.shape[2]}; the sensor is {self.shape}")
        self.push_light(Frames(np.ascontiguousarray(light).reshape(len(light), math.prod(self.shape))), times_s)

    def push_light(self, light: Light, times_s: ArrayLike | torch.Tensor) -> None:
        """Take the next light, in whatever form.

        Args:
            light: Light in DN at the instants.
            times_s: Its instants, [T], seconds, ascending, after those before.

        Raises:
            DataError: Not one time an instant, times that do not ascend, or what `light` raises.
        """
        times_s = check_times(times_s, len(light), self._last_s)
        if not len(times_s):
            return
        first = 0
        if np.isneginf(self._last_s):
            frames, _ = light[:1].pixels(0, self.shape[0] * self.shape[1])
            self._array.start(frames[0], float(times_s[0]))
            first = 1
        self._last_s = float(times_s[-1])
        for k in range(first, len(times_s), _BLOCK_STEPS):
            block = slice(k, k + _BLOCK_STEPS)
            self._blocks.append(self._array.advance(light[block], times_s[block]))

    def finish(self) -> Events:
        """Return all events since the last call, in order; the pixels keep their state."""
        time_us, where, on = join(self._blocks)
        if self._disordered:
            time_us, where, on = sort_times(time_us, where, on)
        x, y = _coordinates(where, self.shape[1])
        return Events(time_us, x, y, on, self.shape[1], self.shape[0])


def _coordinates(where: NDArray[np.int32], width: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Return columns and rows of flat pixel indices."""
    y = where // width
    return (where - y * width).astype(np.uint16), y.astype(np.uint16)


def simulate_events(
    frames: ArrayLike | torch.Tensor,
    times_s: ArrayLike | torch.Tensor,
    pixel: PixelSettings | None = None,
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
        pixel: Settings of the pixels: an `EventPixel`, or those of another event model, which then says what
            happens; None = the paper's.
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
