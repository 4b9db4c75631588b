"""Samples of objects, made on a device from the light to the maps; only the plate is drawn on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from evnlos.dataset.sampling import area_weights, edges_from
from evnlos.dataset.simulate import Simulation, drawn_for, scene_of
from evnlos.errors import ConfigError
from evnlos.events.surface_tensors import time_surface_tensors
from evnlos.scene import Scene
from evnlos.seeds import derive_seed
from evnlos.sensor.event_tensors import EventTensors
from evnlos.sensor.frame_tensors import capture_tensors
from evnlos.sensor.record_tensors import can_share, record_tensors
from evnlos.transport import PaperTransport, Wall


class DeviceSamples(NamedTuple):
    """All positions of one object, float32 on one device; as `Samples`."""

    frame: Tensor
    """[N, H, W], 0..1."""
    surface: Tensor
    """[N, 2, H, W]: ON, OFF."""
    truth: Tensor
    """[N, H, W], 0..1."""


def simulate_objects_on(
    config: Simulation, names: Sequence[str], device: torch.device | str, step_s: float
) -> list[DeviceSamples]:
    """Simulate some objects' passes on a device: walls, frames, event pixels, surfaces and maps.

    The plates are drawn on the CPU. The pixels step from frame to frame (`mode="v2e"`) in steps of `step_s`,
    those of all objects together where they can. Surfaces and maps are those of `simulate_object` to single
    precision, given the same events; frames are its frames but for digital numbers, about one in a hundred
    thousand, that the last bits of the light decide. An object's samples do not depend on the others.

    Args:
        config: The settings.
        names: Some of `config.glyphs.objects()`.
        device: Where all else is computed, and stays.
        step_s: Time step, seconds.

    Raises:
        ConfigError: The pixel has hot pixels or jitter, which this mode has not.
    """
    device = torch.device(device)
    if device.type == "cuda" and device.index is None:  # one name for one device: matrices are kept by it
        device = torch.device("cuda", torch.cuda.current_device())
    drawn = [drawn_for(config, name) for name in names]
    for one in drawn:
        if one.pixel.hot_pixel_fraction > 0 or one.pixel.jitter_s > 0:
            raise ConfigError(
                f"hot_pixel_fraction is {one.pixel.hot_pixel_fraction}, jitter_s {one.pixel.jitter_s}; a GPU "
                "simulates neither: set both to 0, or simulate on the CPU (`evnlos train --simulate-on cpu`)"
            )
    if not drawn:
        return []
    if len({one.duration_s for one in drawn}) > 1 or not can_share([one.pixel for one in drawn]):
        return [simulate_objects_on(config, [name], device, step_s)[0] for name in names]
    scenes = [scene_of(config, one, name) for one, name in zip(drawn, names, strict=True)]
    steps = max(1, round(drawn[0].duration_s / step_s))
    instants = np.linspace(0.0, drawn[0].duration_s, steps + 1)
    with torch.no_grad():
        shape = config.sensor.height, config.sensor.width
        walls = [one.transport.wall(scene, shape, device) for one, scene in zip(drawn, scenes, strict=True)]
        seeds = [derive_seed(config.seed, name, "events") for name in names]
        events = record_tensors(walls, instants, [one.pixel for one in drawn], seeds)
        return [_samples(*one, config) for one in zip(drawn, scenes, walls, events, names, strict=True)]


def bytes_of_a_wall(config: Simulation) -> int:
    """Return about how much an object's wall takes on a device, bytes: its matrix and keyframes, if any."""
    pixels = config.sensor.height * config.sensor.width
    if isinstance(config.transport, PaperTransport):
        return 4 * 4 * pixels
    source = config.transport.source()
    keyframes = 2 * (source.extent_m[1] + config.glyphs.plate.size_m) / source.pitch_m
    return 4 * pixels * (source.height * source.width + round(keyframes))


def _samples(
    drawn: Simulation, scene: Scene, wall: Wall, events: EventTensors, name: str, config: Simulation
) -> DeviceSamples:
    """Return an object's maps, given its events."""
    sampling, device = config.sampling, events.t_us.device
    times_s = scene.position_times_s(config.positions)
    edges_us = edges_from(times_s)
    frames = capture_tensors(drawn.frame_camera, wall, times_s, derive_seed(config.seed, name, "frames"))
    surface = time_surface_tensors(
        events, edges_us, sampling.tau_s * 1e6, sampling.surface, radius=sampling.radius
    )
    shape = sampling.height, sampling.width
    return DeviceSamples(
        _reduced(frames / drawn.frame_camera.white, shape),
        _reduced(surface, shape),
        torch.from_numpy(scene.truth(sampling.canvas, edges_us[1:] * 1e-6)).to(device),
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
