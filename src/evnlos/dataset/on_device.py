"""One object's samples, made on a device from the light to the maps: nothing large passes main memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from evnlos.dataset.sampling import area_weights, edges_from
from evnlos.dataset.simulate import Simulation, drawn_for, scene_of
from evnlos.events.surface_tensors import time_surface_tensors
from evnlos.seeds import derive_seed
from evnlos.sensor.event_tensors import record_tensors
from evnlos.sensor.frame_tensors import capture_tensors


class DeviceSamples(NamedTuple):
    """All positions of one object, float32 on one device; as `Samples`."""

    frame: Tensor
    """[N, H, W], 0..1."""
    surface: Tensor
    """[N, 2, H, W]: ON, OFF."""
    truth: Tensor
    """[N, H, W], 0..1."""


def simulate_object_on(
    config: Simulation, name: str, device: torch.device | str, step_s: float
) -> DeviceSamples:
    """Simulate one object's pass on a device: wall, frames, event pixels, surfaces and maps.

    The glyph is drawn on the CPU. The pixels step from frame to frame (`mode="v2e"`) in steps of `step_s`;
    frames, surfaces and maps are those of `simulate_object` to single precision, given the same events.

    Args:
        config: The settings.
        name: One of `config.glyphs.objects()`.
        device: Where all else is computed, and stays.
        step_s: Time step, seconds.

    Raises:
        ConfigError: The pixel has hot pixels or jitter, which this mode has not.
    """
    drawn, sampling = drawn_for(config, name), config.sampling
    scene = scene_of(drawn, name)
    times_s = scene.position_times_s(config.positions)
    steps = max(1, round(drawn.duration_s / step_s))
    instants = np.linspace(0.0, drawn.duration_s, steps + 1)
    shape = (sampling.height, sampling.width)
    with torch.no_grad():
        wall = drawn.transport.wall(scene, (config.sensor.height, config.sensor.width), device)
        seed = derive_seed(config.seed, name, "events")
        events = record_tensors(wall, instants, drawn.pixel, seed)
        frames = capture_tensors(drawn.frame_camera, wall, times_s, derive_seed(config.seed, name, "frames"))
        surface = time_surface_tensors(
            events, edges_from(times_s), sampling.tau_s * 1e6, sampling.surface, radius=sampling.radius
        )
        return DeviceSamples(
            _reduced(frames / drawn.frame_camera.white, shape),
            _reduced(surface, shape),
            torch.from_numpy(scene.truth(sampling.canvas, times_s)).to(device),
        )


def _reduced(images: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return `reduce_by_area` of images [..., H, W].

    Sums are taken in float64: what a GPU calls float32 may be a product with ten bits.
    """
    over_y, over_x = (
        torch.from_numpy(area_weights(a, b)).to(images.device, torch.float64)
        for a, b in zip(images.shape[-2:], shape, strict=True)
    )
    return (over_y @ images.to(torch.float64) @ over_x.mT).to(torch.float32)
