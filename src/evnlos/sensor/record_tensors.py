"""Events that are simulated on a device and stay there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.errors import ConfigError, DataError
from evnlos.sensor._checks import check_times
from evnlos.sensor._random import check_seed
from evnlos.sensor._torch_batch import stepped
from evnlos.sensor._torch_light import WallLight
from evnlos.sensor._torch_v2e import Pixels, default_tile
from evnlos.sensor.event_camera import Wall
from evnlos.sensor.event_tensors import EventTensors
from evnlos.sensor.pixel import EventPixel, V2ePixel


def record_tensors(
    walls: Sequence[Wall],
    times_s: ArrayLike,
    pixels: Sequence[EventPixel | V2ePixel],
    seeds: Sequence[int],
    dtype: torch.dtype = torch.float64,
) -> list[EventTensors]:
    """Return the events of several walls, simulated together on the device where they render, and left there.

    They are those of `simulate_batch` on each wall's frames in DN, whatever the other walls are; the frames
    never exist all at once. A GPU is given as many orders for many small sensors as for one.

    Args:
        walls: The light: `shape` and `irradiance(t_s)`; of one size, on one device.
        times_s: Instants of the steps, [T], seconds, ascending.
        pixels: Parameters of each wall's pixels; see `V2ePixel.can_run_together`.
        seeds: Seed of each wall's mismatch and noise, 0 to 2**64 - 1.
        dtype: Precision of the filter, as in `simulate_batch`.

    Raises:
        DataError: Fewer than two times, times that do not ascend, or a wall with NaN or negative light.
        ConfigError: Pixels that cannot run together; hot pixels or jitter, which this mode has not.
    """
    kinds = [stepped(pixel) for pixel in pixels]
    if not walls or not len(walls) == len(pixels) == len(seeds):
        raise ConfigError(
            f"{len(walls)} walls, {len(pixels)} pixels and {len(seeds)} seeds; give one of each a clip"
        )
    if any(wall.shape != walls[0].shape for wall in walls) or not kinds[0].can_run_together(kinds):
        raise ConfigError("the walls differ in size, or their pixels in kind; record them one by one")
    times = check_times(times_s, len(np.atleast_1d(times_s)))
    if len(times) < 2:
        raise DataError(f"times_s has {len(times)} instants; give at least 2")
    with torch.no_grad():
        light = WallLight(walls, times)
        tile_px = default_tile(light.device)
        return Pixels(light, times, kinds, [check_seed(seed) for seed in seeds], None, dtype, tile_px).run()
