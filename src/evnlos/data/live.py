"""On-the-fly simulation: samples made as a training needs them, by processes or on a device.

- Samples of objects, made on a device from the light to the maps; only the target is drawn on the CPU.
- Samples that are simulated as a training needs them: no dataset on disk, and each epoch another draw.
- Time surfaces of events that lie on a device, by sorting and scattering instead of event by event.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.cameras.on_device import capture_tensors
from evnlos.cameras.streams import EventTensors
from evnlos.config import config_hash, to_dict
from evnlos.data.loader import Modality, as_modality
from evnlos.data.pool import processes, run_in_order
from evnlos.data.sampling import Samples, area_weights, edges_from, surface_of
from evnlos.data.simulate import (
    Simulation,
    check_sequences,
    drawn_for,
    object_bytes,
    scene_of,
    simulate_object,
    split_of,
)
from evnlos.data.store import Dataset
from evnlos.errors import ConfigError
from evnlos.events.surface import Mode, check_surface
from evnlos.events.volume import as_edges
from evnlos.machine import cores
from evnlos.optics import Irradiance
from evnlos.scene import Scene
from evnlos.types import derive_seed


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
    """Simulate some objects' sequences on a device: walls, frames, event pixels, surfaces and maps.

    The targets are drawn on the CPU. The event pixels are those of the settings, run by the torch backend of
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
    return config.setup.bytes_of_a_scene(config.glyphs.target_plane.size_m)


def _samples(
    drawn: Simulation, scene: Scene, wall: Irradiance, events: EventTensors, name: str, config: Simulation
) -> DeviceSamples:
    """Return an object's maps, given its events."""
    sampling, device = config.sampling, events.t_us.device
    times_s = scene.position_times_s(config.positions)
    edges_us = edges_from(times_s)
    frames = capture_tensors(drawn.frame_camera, wall, times_s, derive_seed(config.seed, name, "frames"))
    kind = sampling.surface
    if kind == "trace" or kind == "likelihood":  # the CPU's work, and what is refused
        surface = torch.from_numpy(surface_of(events.to_events(), edges_us, sampling)).to(device)
    else:
        surface = time_surface_tensors(events, edges_us, sampling.tau_s * 1e6, kind, radius=sampling.radius)
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


Place = Literal["device", "cpu"]
_MOST_BYTES = 4 << 30  # of walls that a GPU holds at a time


@dataclass(frozen=True)
class LiveDataset(Dataset):
    """A simulation that takes the place of a dataset on disk; make it with `live_dataset`.

    Epoch 0 is the dataset that `simulate` would write; epoch n has other handwriting, settings from the same
    ranges and other noise, and is the same whenever it is requested. The settings alone decide the physics: a
    GPU simulates where the event model has a torch backend, else the CPU does.
    """

    simulation: Simulation = field(default_factory=Simulation)
    """The settings."""
    workers: int = 1
    """Processes that simulate on the CPU; 1 = in this process, 0 = one for each core."""
    mix: int = 8
    """Objects whose samples are shuffled together."""
    where: Place = "device"
    """Simulate on the device of the training, where the event model can, or on the CPU also beside a GPU."""
    together: int = 16
    """Objects that a GPU simulates at a time."""

    def stream(
        self, names: Iterable[str], epoch: int, modality: str | Modality, device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield input [N, C, H, W] and truth [N, 1, H, W] of each object, in order, float32.

        Simulated on a CPU the samples are those of `simulate_object`, bit for bit. On a GPU all but the drawing
        of the target happens there; see `simulate_objects_on`.
        """
        config, seen = epoch_settings(self.simulation, epoch), as_modality(modality)
        made: Iterator[tuple[Tensor, Tensor, Tensor]]
        if self._uses(device):
            made = self._on_device(config, list(names), device)
        else:
            tasks = [(config, name) for name in names]
            # one process per core, shared by the processes that train on this machine
            workers = self.workers or max(1, cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
            made = (_tensors(samples) for samples in run_in_order(_samples_of, tasks, workers))
        for maps in made:
            # in half precision twice, as shards hold the maps and a loader the inputs
            frame, surface, truth = (part.half().to(device).float() for part in maps)
            yield seen.inputs(frame, surface).half().float(), truth[:, None]

    def note(self, device: torch.device) -> str:
        """Return one line on why the CPU simulates beside a GPU; "" where it does not, or was asked to."""
        if self.where == "cpu" or device.type == "cpu" or self._uses(device):
            return ""
        return no_backend(self.simulation)

    def _uses(self, device: torch.device) -> bool:
        has_backend = self.simulation.pixel.torch_backend() is not None
        return self.where == "device" and device.type != "cpu" and has_backend

    def _on_device(
        self, config: Simulation, names: list[str], device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        together = max(1, min(self.together, _MOST_BYTES // bytes_of_a_wall(config)))
        for first in range(0, len(names), together):
            yield from simulate_objects_on(config, names[first : first + together], device)

    def truth(self, name: str) -> NDArray[np.float32]:
        """Return the true images of an object in the first epoch, float32 [N, H, W], 0..1."""
        config = self.simulation
        scene = scene_of(config, drawn_for(config, name), name)
        return scene.truth(config.sampling.canvas, scene.position_times_s(config.positions))


def live_dataset(
    config: Simulation, workers: int = 1, where: Place = "device", force: bool = False
) -> LiveDataset:
    """Return a simulation as a dataset to train on.

    Args:
        config: The settings.
        workers: Processes that simulate on the CPU; 0 means one for each core.
        where: "device" simulates where the network trains if the event model has a torch backend, "cpu" on the
            CPU also beside a GPU.
        force: Whether to go on although the machine's memory will hardly do.

    Raises:
        ConfigError: No object is left to train on.
        DataError: The objects that are simulated at a time take more memory than there is.
    """
    if not force:
        check_sequences(object_bytes(config), processes(workers, len(config.glyphs.objects())))
    split = split_of(config)
    if not split["train"]:
        raise ConfigError(
            f"the simulation has {len(config.glyphs.objects())} objects, none to train on; add some"
        )
    return LiveDataset(
        Path("live"),
        "simulation",
        config.sampling,
        split,
        to_dict(config),
        config_hash(config),
        config.optics(),
        simulation=config,
        workers=workers,
        where=where,
    )


def epoch_settings(config: Simulation, epoch: int) -> Simulation:
    """Return the settings of an epoch (from 0): those of the first are the simulation's own."""
    return replace(config, seed=derive_seed(config.seed, "epoch", epoch)) if epoch else config


def _samples_of(task: tuple[Simulation, str]) -> Samples:
    return simulate_object(*task)[0]


def _tensors(samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    assert samples.truth is not None  # a simulation knows its target
    frame, surface, truth = map(torch.from_numpy, (samples.frame, samples.surface, samples.truth))
    return frame, surface, truth


_NEVER = -(1 << 62)  # a time of which nothing is left
_UNIT = 2.0**40
"""Values are added up as whole multiples of 2^-40: the order of a device's additions then changes no bit."""


def time_surface_tensors(
    events: EventTensors, edges_us: ArrayLike, tau_us: float, mode: Mode = "sae", *, radius: int = 1
) -> Tensor:
    """Return what `time_surface` returns with its other defaults, on the device of the events.

    Where `time_surface` walks through the events and remembers, this looks up, for each event and each pixel of
    its neighbourhood at once, the last event before it: in the list of all events sorted by pixel, then order.

    Args:
        events: The stream, in order.
        edges_us: Ascending edges, [grids + 1], microseconds.
        tau_us: Time constant, microseconds, above 0.
        mode: "sae", "context" or "hots".
        radius: Radius of the neighbourhood (a box), pixels, 0 to 64; not for "sae".

    Returns:
        float32 [grids, 2, H, W], channel 0 brighter (ON), channel 1 darker (OFF); equal to `time_surface` to
        single precision.

    Raises:
        DataError: An argument is outside its range.
    """
    check_surface(tau_us, radius, mode)
    edges = as_edges(edges_us)
    grid = _grids(events, edges)
    if mode == "sae":
        return _newest(events, grid, edges, tau_us)
    per_event = _context if mode == "context" else _mean_decay
    value = per_event(events, tau_us, int(radius))
    inside = (grid >= 0) & (grid < len(edges) - 1)
    out = torch.zeros((len(edges) - 1) * 2 * _pixels(events), dtype=torch.int64, device=value.device)
    place = grid[inside] * (2 * _pixels(events)) + _places(events)[inside]
    out.scatter_add_(0, place, (value[inside] * _UNIT).round().to(torch.int64))
    return (out * (1 / _UNIT)).to(torch.float32).view(-1, 2, events.height, events.width)


def _pixels(events: EventTensors) -> int:
    return events.height * events.width


def _grids(events: EventTensors, edges: np.ndarray) -> Tensor:
    """Return each event's grid, int64 [N]: -1 before the first edge, the number of grids after the last."""
    return torch.searchsorted(torch.from_numpy(edges).to(events.t_us.device), events.t_us) - 1


def _places(events: EventTensors) -> Tensor:
    """Return where each event lies in a map [2, H, W], int64 [N]."""
    return events.pixel + (~events.on) * _pixels(events)


def _newest(events: EventTensors, grid: Tensor, edges: np.ndarray, tau_us: float) -> Tensor:
    """Return the surface of active events."""
    grids, size = len(edges) - 1, 2 * _pixels(events)
    device = events.t_us.device
    kept = grid < grids  # earlier events count in the first grid, and in all after it
    place = (grid.clamp(min=0) * size + _places(events))[kept]
    newest = torch.full((grids * size,), _NEVER, dtype=torch.int64, device=device)
    newest = newest.scatter_reduce_(0, place, events.t_us[kept], "amax").view(grids, size)
    out = torch.empty(grids, size, dtype=torch.float32, device=device)
    held = newest[0]
    for number, end_us in enumerate(edges[1:].tolist()):
        held = torch.maximum(held, newest[number])
        out[number] = ((held - end_us).to(torch.float64) / tau_us).to(torch.float32).exp_()
    return out.view(grids, 2, events.height, events.width)


class _Before:
    """For each event, the last one before it at any neighbour of its pixel.

    An event's key is (place, order) as one whole number; keys sorted, the one below (neighbour, order of the
    event) is that of the neighbour's last event before it, or of another place if there is none.
    """

    def __init__(self, events: EventTensors) -> None:
        self._events, self._count = events, len(events)
        self._order = torch.arange(len(events), device=events.t_us.device)
        self._place = _places(events)
        self._keys = torch.sort(self._place * self._count + self._order).values
        self._row = torch.div(events.pixel, events.width, rounding_mode="floor")
        self._column = events.pixel - self._row * events.width

    def at(self, down: int, right: int) -> tuple[Tensor, Tensor]:
        """Return that event's time [N], `_NEVER` if there is none, and whether the pixel is on the sensor."""
        events = self._events
        row, column = self._row + down, self._column + right
        on_sensor = (row >= 0) & (row < events.height) & (column >= 0) & (column < events.width)
        place = self._place + (down * events.width + right)
        found = torch.searchsorted(self._keys, place * self._count + self._order) - 1
        key = self._keys[found.clamp(min=0)]
        there = on_sensor & (found >= 0) & (torch.div(key, self._count, rounding_mode="floor") == place)
        return torch.where(there, events.t_us[key % self._count], _NEVER), on_sensor


def _box(radius: int) -> list[tuple[int, int]]:
    return [(down, right) for down in range(-radius, radius + 1) for right in range(-radius, radius + 1)]


def _context(events: EventTensors, tau_us: float, radius: int) -> Tensor:
    """Return exp(-(t_i - t*) / tau) of each event, float64 [N], t* the latest time in its neighbourhood."""
    if not len(events):
        return torch.zeros(0, dtype=torch.float64, device=events.t_us.device)
    before, latest = _Before(events), torch.full_like(events.t_us, _NEVER)
    for down, right in _box(radius):
        latest = torch.maximum(latest, before.at(down, right)[0])
    return torch.exp((latest - events.t_us).to(torch.float64) / tau_us)


def _mean_decay(events: EventTensors, tau_us: float, radius: int) -> Tensor:
    """Return the mean of exp(-(t_i - t) / tau) over the neighbours on the sensor, float64 [N]."""
    total = torch.zeros(len(events), dtype=torch.float64, device=events.t_us.device)
    if not len(events):
        return total
    before, pixels = _Before(events), torch.zeros_like(events.t_us)
    for down, right in _box(radius):
        time_us, on_sensor = before.at(down, right)
        total += torch.exp((time_us - events.t_us).to(torch.float64) / tau_us)
        pixels += on_sensor
    return total / pixels
