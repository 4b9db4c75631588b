"""Events from light that arrives in blocks of frames: bounded memory for recordings of any length."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.sensor._checks import check_light, check_times
from evnlos.sensor._order import Columns, join, sort_times
from evnlos.sensor._random import check_seed
from evnlos.sensor.event_model import PixelSettings
from evnlos.sensor.light import Frames, Light
from evnlos.sensor.pixel import Mode, in_mode
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
        >>> from evnlos.sensor import EventPixel
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
