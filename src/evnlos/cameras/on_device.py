"""Frames and events that are simulated on a device and stay there.

- Frames that are simulated on a device and stay there.
- Light of clips and walls, block by block; checks and division of a batch of clips.
- Events that are simulated on a device and stay there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.cameras.event_camera import Irradiance
from evnlos.cameras.event_model import PixelSettings
from evnlos.cameras.frame_camera import FrameCamera, check_extremes
from evnlos.cameras.pixel import EventPixel, V2ePixel, in_mode
from evnlos.cameras.pixels.torch_noise import electrons
from evnlos.cameras.pixels.torch_v2e import Pixels, default_tile
from evnlos.cameras.random_numbers import check_seed
from evnlos.cameras.streams import WHITE_DN, EventTensors, check_threshold_maps, check_times
from evnlos.errors import ConfigError, DataError
from evnlos.types import Events, derive_seed

Pattern = tuple[Tensor, Tensor]
_TOGETHER_PX = 1 << 22  # pixels of frames that are made in one operation
_AHEAD = 32  # instants rendered at a time, at least
_AHEAD_PX = 1 << 22  # pixels of a wall's instants, about


class Clips:
    """Light that is there as a whole.

    Args:
        frames: Light in DN [clips, T, H, W], checked.
    """

    def __init__(self, frames: Tensor) -> None:
        clips, steps, height, width = frames.shape
        self.shape, self.dtype, self.device = (clips, steps, height, width), frames.dtype, frames.device
        self._flat = frames.flatten(2)

    def block(self, first: int, last: int) -> Tensor:
        """Return the light at the instants first..last - 1, [clips, last - first, pixels]."""
        return self._flat[:, first:last]


class WallLight:
    """Light that walls render when pixels ask for it, and forget: clips of any length in little memory.

    Args:
        walls: One wall a clip, of one size, on one device.
        times_s: Instants, float64 [T], seconds.

    Raises:
        DataError: A wall returned NaN, infinity or negative light; also by `block`.
    """

    dtype = torch.float32

    def __init__(self, walls: Sequence[Irradiance], times_s: NDArray[np.float64]) -> None:
        height, width = walls[0].shape
        self._walls, self._times_s = walls, times_s
        self.shape: tuple[int, int, int, int] = (len(walls), len(times_s), height, width)
        self._ahead = max(_AHEAD, _AHEAD_PX // (height * width))  # whatever the number of walls
        self._first, self._held = 0, self._rendered(0, 1)
        self.device = self._held.device

    def block(self, first: int, last: int) -> Tensor:
        """Return the light at the instants first..last - 1, [clips, last - first, pixels]."""
        if not self._first <= first <= last <= self._first + self._held.shape[1]:
            self._first, self._held = first, self._rendered(first, max(last, first + self._ahead))
        return self._held[:, first - self._first : last - self._first]

    def _rendered(self, first: int, last: int) -> Tensor:
        times_s = self._times_s[first:last]
        light = torch.stack([wall.irradiance(times_s).to(torch.float32) for wall in self._walls])
        light = light.flatten(2).mul_(WHITE_DN)
        check_range(light, "the wall's light")
        return light


def check_range(light: Tensor, name: str) -> None:
    """Refuse light in DN that is not finite, or below 0."""
    lowest, highest = torch.stack(light.aminmax()).tolist()
    if not (math.isfinite(lowest) and math.isfinite(highest)):
        raise DataError(f"{name} holds NaN or infinity; light must be finite, 255 = white")
    if lowest < 0:
        raise DataError(f"{name} holds {lowest:g}; light cannot be negative, black is 0")


def capture_tensors(camera: FrameCamera, wall: Irradiance, times_s: ArrayLike, seed: int = 0) -> Tensor:
    """Return the frames of `FrameCamera.capture` on the device where the wall renders.

    Args:
        camera: The frame camera.
        wall: The light: `shape` and `irradiance(t_s)`.
        times_s: Middles of the exposures, [N], seconds.
        seed: Seed of the noise, 0 to 2**64 - 1.

    Returns:
        Digital numbers, whole float32 [N, H, W].

    Raises:
        DataError: Times that are not finite, or a wall with NaN or negative light.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or not len(times) or not np.isfinite(times).all():
        raise DataError(f"times_s has shape {times.shape}; give a 1-D array of finite seconds, at least one")
    seed = check_seed(seed)
    height, width = wall.shape
    most = max(1, _TOGETHER_PX // (height * width))
    made = []
    with torch.no_grad():
        for first in range(0, len(times), most):
            mean = _exposed(camera, wall, times[first : first + most])
            own = seed if camera.pattern_seed is None else 0
            sensitivity, offset_e = _pattern(camera, wall.shape, own, mean.device)
            expected = (sensitivity * mean).flatten(1)
            if camera.electrons_per_s is not None:
                expected.clamp_(max=camera.full_well_e)
            levels = electrons(expected, offset_e.flatten(), camera.read_noise_e, seed, first)
            levels.mul_(camera.dn_per_electron).add_(camera.black_level).round_().clamp_(0, camera.white)
            made.append(levels.to(torch.float32).view(mean.shape))
    return torch.cat(made)


def _exposed(camera: FrameCamera, wall: Irradiance, times_s: NDArray[np.float64]) -> Tensor:
    """Return the light averaged over each exposure, float64 [N, H, W]."""
    moments = [camera.instants(time) for time in times_s.tolist()]
    light = wall.irradiance(np.concatenate([instants for instants, _ in moments])).to(torch.float64)
    weights = light.new_tensor(moments[0][1])
    mean = torch.einsum("q,nqhw->nhw", weights, light.unflatten(0, (len(moments), -1)))
    check_extremes(*torch.stack(mean.aminmax()).tolist())
    return mean


@lru_cache(maxsize=4)
def _pattern(camera: FrameCamera, shape: tuple[int, int], seed: int, device: torch.device) -> Pattern:
    """Return electrons per unit of light, and the offset in electrons, float64 [H, W] each, on a device."""
    sensitivity, offset_e = (torch.from_numpy(part).to(device) for part in camera.fixed_pattern(shape, seed))
    return camera.white_e * sensitivity, offset_e


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


def record_tensors(
    walls: Sequence[Irradiance],
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
