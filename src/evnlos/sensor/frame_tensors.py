"""Frames that are simulated on a device and stay there."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.errors import DataError
from evnlos.sensor._random import check_seed
from evnlos.sensor._torch_photons import electrons
from evnlos.sensor.event_camera import Wall
from evnlos.sensor.frame_camera import FrameCamera, check_extremes

Pattern = tuple[Tensor, Tensor]
_TOGETHER_PX = 1 << 22  # pixels of frames that are made in one operation


def capture_tensors(camera: FrameCamera, wall: Wall, times_s: ArrayLike, seed: int = 0) -> Tensor:
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


def _exposed(camera: FrameCamera, wall: Wall, times_s: NDArray[np.float64]) -> Tensor:
    """Return the light averaged over each exposure, float64 [N, H, W]."""
    moments = [camera.instants(time) for time in times_s.tolist()]
    light = wall.irradiance(np.concatenate([instants for instants, _ in moments])).to(torch.float64)
    weights = light.new_tensor(moments[0][1])
    mean = torch.einsum("q,nqhw->nhw", weights, light.unflatten(0, (len(moments), -1)))
    check_extremes(*torch.stack(mean.aminmax()).tolist())
    return mean


@lru_cache(maxsize=4)
def _pattern(camera: FrameCamera, shape: tuple[int, int], seed: int, device: torch.device) -> Pattern:
    """Return electrons a unit of light, and the offset in electrons, float64 [H, W] each, on a device."""
    sensitivity, offset_e = (torch.from_numpy(part).to(device) for part in camera.fixed_pattern(shape, seed))
    return camera.white_e * sensitivity, offset_e
