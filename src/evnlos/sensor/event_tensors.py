"""Events that are simulated on a device and stay there."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.sensor._checks import check_times
from evnlos.sensor._random import check_seed
from evnlos.sensor._torch_batch import check_pixel
from evnlos.sensor._torch_light import WallLight
from evnlos.sensor._torch_v2e import Pixels, default_tile
from evnlos.sensor.event_camera import Wall
from evnlos.sensor.pixel import EventPixel
from evnlos.sensor.tensors import EventTensors


def record_tensors(
    wall: Wall, times_s: NDArray[np.float64], pixel: EventPixel, seed: int, dtype: torch.dtype = torch.float32
) -> EventTensors:
    """Return the events of a wall, simulated in mode "v2e" on the device where it renders, and left there.

    They are those of `simulate_batch` on the wall's frames in DN; the frames never exist all at once.

    Args:
        wall: The light: `shape` and `irradiance(t_s)`.
        times_s: Instants of the steps, [T], seconds, ascending.
        pixel: Parameters of the pixels.
        seed: Seed of mismatch and noise, 0 to 2**64 - 1.
        dtype: Precision of the filter, as in `simulate_batch`.

    Raises:
        DataError: Fewer than two times, times that do not ascend, or a wall with NaN or negative light.
        ConfigError: Hot pixels or jitter, which this mode has not.
    """
    check_pixel(pixel)
    times = check_times(times_s, len(times_s))
    if len(times) < 2:
        raise DataError(f"times_s has {len(times)} instants; give at least 2")
    with torch.no_grad():
        light = WallLight(wall, times)
        tile_px = default_tile(light.device)
        (events,) = Pixels(light, times, pixel, [check_seed(seed)], None, dtype, tile_px).run()
    return events
