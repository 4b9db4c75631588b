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
from evnlos.transport import Wall


class DeviceSamples(NamedTuple):
    """All positions of one object, float32 on one device; as `Samples`."""

    frame: Tensor
    """[N, H, W], 0..1."""
    surface: Tensor
    """[N, 2, H, W]: ON, OFF."""
    truth: Tensor
    """[N, H, W], 0..1."""


def simulate_objects_on(
    config: Simulation, names: Sequence[str], device: torch.device | str
) -> list[DeviceSamples]:
    """Simulate some objects' passes on a device: walls, frames, event pixels, surfaces and maps.

    The plates are drawn on the CPU. The event pixels are those of the settings, run by the torch backend of
    their model, those of all objects together where they can. The samples are those of `simulate_object` but
    for what the last bits of the light decide: about one digital number in a hundred thousand, and the events
    of pixels that stop within rounding of a threshold. An object's samples do not depend on the others.

    Args:
        config: The settings.
        names: Some of `config.glyphs.objects()`.
        device: Where all else is computed, and stays.

    Raises:
        ConfigError: The event model has no torch backend.
    """
    run = config.pixel.torch_backend()
    if run is None:
        raise ConfigError(no_backend(config))
    device = torch.device(device)
    if device.type == "cuda" and device.index is None:  # one name for one device: matrices are kept by it
        device = torch.device("cuda", torch.cuda.current_device())
    drawn = [drawn_for(config, name) for name in names]
    if not drawn:
        return []
    pixels = [one.pixel for one in drawn]
    if len({one.duration_s for one in drawn}) > 1 or not drawn[0].pixel.can_run_together(pixels):
        return [simulate_objects_on(config, [name], device)[0] for name in names]
    scenes = [scene_of(config, one, name) for one, name in zip(drawn, names, strict=True)]
    camera = drawn[0].setup.event_camera
    instants = np.append(0.0, camera.fixed_instants(0.0, drawn[0].duration_s))
    with torch.no_grad():
        walls = [one.setup.observe(scene, device) for one, scene in zip(drawn, scenes, strict=True)]
        seeds = [derive_seed(config.seed, name, "events") for name in names]
        events = run(walls, instants, pixels, seeds)
        return [_samples(*one, config) for one in zip(drawn, scenes, walls, events, names, strict=True)]


def no_backend(config: Simulation) -> str:
    """Return one line on an event model that only the CPU runs."""
    kind = getattr(config.pixel, "kind", type(config.pixel).__name__)
    return (
        f"the event model {kind!r} has no torch backend, so the CPU simulates it; give it several workers, or "
        "take setup.pixel.kind v2e with a setup.time_step_s"
    )


def bytes_of_a_wall(config: Simulation) -> int:
    """Return about how much an object's wall takes on a device, bytes: its matrix and keyframes, if any."""
    return config.setup.bytes_of_a_scene(config.glyphs.plate.size_m)


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
