"""Checks and division of a batch of clips for the torch path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.errors import ConfigError, DataError
from evnlos.seeds import derive_seed
from evnlos.sensor._checks import check_threshold_maps, check_times
from evnlos.sensor._random import check_seed
from evnlos.sensor._torch_light import Clips, check_range
from evnlos.sensor._torch_v2e import Pixels, default_tile
from evnlos.sensor.event_model import PixelSettings
from evnlos.sensor.pixel import EventPixel, V2ePixel, in_mode
from evnlos.types import Events

_GROUP_CPU, _GROUP_DEVICE = 1 << 20, 1 << 24
_LIGHT = (torch.uint8, torch.float32, torch.float64)


def check_clips(clips: ArrayLike | Tensor, device: torch.device | str | None) -> Tensor:
    """Return clips as a tensor [B, T, H, W] of uint8, float32 or float64, refusing what is not light."""
    light = clips.detach() if isinstance(clips, Tensor) else _tensor(np.asarray(clips))
    if light.ndim != 4 or 0 in light.shape[2:]:
        raise DataError(f"clips has shape {tuple(light.shape)}; give [B, T, H, W] with at least one pixel")
    if light.is_complex():
        raise DataError(f"clips has dtype {light.dtype}; give numbers, 255 = white")
    if device is not None:
        light = light.to(device)
    if light.dtype not in _LIGHT:
        light = light.to(torch.float32 if light.dtype in (torch.float16, torch.bfloat16) else torch.float64)
    if light.dtype != torch.uint8 and light.numel():
        check_range(light, "clips")
    return light


def _tensor(array: NDArray) -> Tensor:
    """Return an array as a tensor that shares its memory where torch allows that."""
    if array.dtype.kind not in "uifb":
        raise DataError(f"clips has dtype {array.dtype}; give numbers, 255 = white")
    if not array.flags.writeable or min(array.strides, default=0) < 0:
        array = array.copy()
    return torch.from_numpy(array)


def check_seeds(seeds: int | Sequence[int], count: int) -> list[int]:
    """Return one seed a clip: the given ones, or those derived from one seed and the clip's index."""
    if isinstance(seeds, (int, np.integer)) and not isinstance(seeds, bool):
        seed = check_seed(int(seeds))
        return [derive_seed(seed, "clip", n) for n in range(count)]
    if not isinstance(seeds, (Sequence, np.ndarray)) or isinstance(seeds, str) or len(seeds) != count:
        raise ConfigError(f"seeds is {seeds!r} for {count} clips; give one integer, or one a clip")
    return [check_seed(seed) for seed in seeds]


def run_batch(
    clips: ArrayLike | Tensor,
    times_s: ArrayLike | Tensor,
    pixel: EventPixel | V2ePixel,
    seeds: int | Sequence[int],
    thresholds: tuple[ArrayLike, ArrayLike] | None,
    device: torch.device | str | None,
    dtype: torch.dtype,
    tile_px: int | None,
) -> list[Events]:
    """Return the events of each clip; see `simulate_batch`."""
    pixel = stepped(pixel)
    if dtype not in (torch.float32, torch.float64):
        raise ConfigError(f"dtype is {dtype}; give torch.float64 or torch.float32")
    light = check_clips(clips, device)
    count, steps, height, width = light.shape
    times, keys = check_times(times_s, steps), check_seeds(seeds, count)
    if tile_px is None:
        tile_px = default_tile(light.device)
    if tile_px < 1:
        raise ConfigError(f"tile_px is {tile_px}; give at least 1 pixel")
    maps = None if thresholds is None else check_threshold_maps(thresholds, (height, width))
    group = max(1, (_GROUP_CPU if light.device.type == "cpu" else _GROUP_DEVICE) // (height * width))
    if steps < 2:
        return [Events.empty(width, height) for _ in range(count)]
    events = []
    with torch.no_grad():
        for first in range(0, count, group):
            some = Clips(light[first : first + group])
            fields = None
            if maps is not None:
                on, off = (
                    torch.from_numpy(m).to(light.device).flatten().expand(some.shape[0], -1) for m in maps
                )
                fields = on.contiguous(), off.contiguous()
            group_seeds = keys[first : first + group]
            kinds = [pixel] * some.shape[0]
            made = Pixels(some, times, kinds, group_seeds, fields, dtype, tile_px).run()
            events.extend(one.to_events() for one in made)
    return events


def stepped(pixel: PixelSettings) -> V2ePixel:
    """Return the pixel that is stepped here, refusing one that v2e has not."""
    found = in_mode(pixel, "v2e")
    assert isinstance(found, V2ePixel)
    return found
