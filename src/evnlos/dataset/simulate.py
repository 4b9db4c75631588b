"""From settings to a dataset of shards: each object is a pure function of (settings, seed, name)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from evnlos.claim import claim
from evnlos.config import config_hash, to_dict
from evnlos.dataset.pool import Engine, run_tasks
from evnlos.dataset.sampling import Samples, Sampling, edges_from, make_samples
from evnlos.dataset.shard import write_shard
from evnlos.dataset.store import Dataset, create_dataset
from evnlos.dataset.variation import check_ranges, varied
from evnlos.errors import ConfigError
from evnlos.scene import (
    Glyphs,
    HandwritingGlyphs,
    LineMotion,
    Scene,
)
from evnlos.seeds import derive_seed
from evnlos.sensor import EventCamera, EventPixel, FrameCamera
from evnlos.transport import MeasuredTransport, PaperTransport, RadiometricTransport
from evnlos.types import Events


@dataclass(frozen=True)
class SensorSize:
    """Pixels of the sensor that carries both the frame and the event pixels."""

    height: int = 100
    """Rows, pixels."""
    width: int = 160
    """Columns, pixels."""

    def __post_init__(self) -> None:
        for name in ("height", "width"):
            if not 8 <= getattr(self, name) <= 8192:
                raise ConfigError(f"SensorSize.{name} is {getattr(self, name)}; give 8 to 8192 pixels")


@dataclass(frozen=True)
class Simulation:
    """Everything that decides a simulated dataset."""

    glyphs: Glyphs = field(default_factory=HandwritingGlyphs)
    """What is hidden."""
    motion: LineMotion = field(default_factory=LineMotion)
    """How it moves."""
    duration_s: float = 8.0
    """Length of a pass, seconds."""
    positions: int = 40
    """Equidistant positions of an object, one sample each."""
    transport: PaperTransport | RadiometricTransport | MeasuredTransport = field(default_factory=PaperTransport)
    """How its light reaches the wall and the camera."""
    sensor: SensorSize = field(default_factory=SensorSize)
    """Size of the sensor."""
    frame_camera: FrameCamera = field(default_factory=FrameCamera)
    """The frame camera."""
    pixel: EventPixel = field(default_factory=EventPixel)
    """The event pixel."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation of the stored samples."""
    vary: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Settings drawn for each object from a range: dotted name -> (low, high)."""
    rigs: int = 0
    """Number of different walls and cameras that the ranges of the transport are drawn for, shared by the
    objects (each costs a light-transport matrix); 0 = one for each object."""
    validation: float = 0.05
    """Share of the objects that is held out for validation, 0..1."""
    held_out: str = ""
    """Characters whose objects are for testing alone."""
    keep_events: bool = False
    """Store the events of each object beside the maps."""
    seed: int = 0
    """Seed of every draw."""

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ConfigError(f"Simulation.duration_s is {self.duration_s}; give a positive number of seconds")
        if self.positions < 1:
            raise ConfigError(f"Simulation.positions is {self.positions}; give at least 1")
        if self.rigs < 0:
            raise ConfigError(
                f"Simulation.rigs is {self.rigs}; give 0 (one for each object) or a number of rigs"
            )
        if not 0 <= self.validation < 1:
            raise ConfigError(f"Simulation.validation is {self.validation}; give a share from 0 to below 1")
        check_ranges(self, self.vary)

    def optics(self) -> dict[str, float]:
        """Return what diffraction and the wall do to the picture: Fresnel number, blurs, sampling limit.

        Empty for a radiometric wall, whose blur `evnlos identify` measures.

        Example:
            >>> round(Simulation().optics()["fresnel_number"])
            6400
        """
        if not isinstance(self.transport, PaperTransport):
            return {}
        return self.transport.figures(self.glyphs.plate.size_m, (self.sensor.height, self.sensor.width))


def drawn_for(config: Simulation, name: str) -> Simulation:
    """Return the settings that `vary` draws for an object; those of the optics are shared by `rigs` groups.

    Gain and ambient light cost nothing, so they are always the object's own.
    """
    optics = {path: ends for path, ends in config.vary.items() if config.rigs and _needs_a_matrix(path)}
    others = {path: ends for path, ends in config.vary.items() if path not in optics}
    if optics:
        group = derive_seed(config.seed, name, "rig") % config.rigs
        config = varied(config, optics, config.seed, f"rig {group}")
    return varied(config, others, config.seed, name)


def _needs_a_matrix(path: str) -> bool:
    section, name, *_ = path.split(".")
    return section == "transport" and name not in ("gain", "ambient", "ambient_gradient")


def scene_of(config: Simulation, drawn: Simulation, name: str) -> Scene:
    """Return what an object's pass shows, given the settings drawn for it: the glyph is not varied."""
    target = config.glyphs.target(name, derive_seed(config.seed, "glyph"))
    return Scene(target, drawn.motion, drawn.duration_s)


def simulate_object(config: Simulation, name: str) -> tuple[Samples, Events]:
    """Simulate one object's pass: scene -> wall -> events and frames -> samples.

    Args:
        config: The settings.
        name: One of `config.glyphs.objects()`.

    Returns:
        The samples of all positions, and the events of the whole pass.
    """
    drawn = drawn_for(config, name)
    scene = scene_of(config, drawn, name)
    wall = drawn.transport.wall(scene, (config.sensor.height, config.sensor.width))
    times_s = scene.position_times_s(config.positions)
    events = EventCamera(drawn.pixel).record(
        wall, 0.0, drawn.duration_s, seed=derive_seed(config.seed, name, "events")
    )
    frames = drawn.frame_camera.capture(wall, times_s, seed=derive_seed(config.seed, name, "frames"))
    edges_us = edges_from(times_s)
    peak = 2**drawn.frame_camera.bit_depth - 1
    return make_samples(
        frames, peak, events, edges_us, config.sampling, motion=scene.motion, target=scene.target
    ), events


def split_of(config: Simulation) -> dict[str, list[str]]:
    """Return the split by object: those held out for testing, a seeded share for validation, the others."""
    every = config.glyphs.objects()
    tested = [name for name in every if name.rsplit("_", 1)[-1] in config.held_out]
    names = [name for name in every if name not in set(tested)]
    count = round(config.validation * len(names))
    order = np.random.default_rng(derive_seed(config.seed, "split")).permutation(len(names))
    chosen = {names[i] for i in order[:count]}
    return {
        "train": [name for name in names if name not in chosen],
        "validation": [name for name in names if name in chosen],
        "test": tested,
    }


def simulate(
    config: Simulation,
    folder: str | Path,
    workers: int = 1,
    share: tuple[int, int] = (1, 1),
    engine: Engine = run_tasks,
) -> Iterator[str]:
    """Simulate a dataset, yielding the name of each object as its shard is in place.

    Shards that exist are not made again, so a run that was killed goes on where it was. The shards are
    the same bytes for any number of workers.

    Args:
        config: The settings.
        folder: Where the dataset goes; new, or begun with the same settings.
        workers: Processes; 0 means one for each core.
        share: (i, n): only every n-th object, beginning with the i-th; i from 1 to n. The n shares together,
            made anywhere and in any order, are the dataset.
        engine: What runs the tasks: processes here, or `run_on_dask`.

    Raises:
        ConfigError: The share is none.
        DataError: The folder holds something else, or another process is at work in it.
    """
    first, stride = share
    if not 1 <= first <= stride:
        raise ConfigError(f"share {first} of {stride} is none; give i/n with i from 1 to n")
    values = to_dict(config)
    dataset = Dataset(
        Path(folder),
        "simulation",
        config.sampling,
        split_of(config),
        config=values,
        config_hash=config_hash(config),
        optics=config.optics(),
    )
    with claim(folder, f"{first}-of-{stride}" if stride > 1 else ""):
        create_dataset(dataset)
        ours = set(config.glyphs.objects()[first - 1 :: stride])
        missing = [name for name in dataset.missing() if name in ours]
        tasks = [(config, name, dataset.shard(name), dataset.config_hash) for name in missing]
        yield from engine(_simulate_shard, tasks, workers)


def _simulate_shard(task: tuple[Simulation, str, Path, str]) -> str:
    config, name, path, settings = task
    samples, events = simulate_object(config, name)
    attributes = {"object": name, "config_hash": settings, "seed": config.seed}
    write_shard(path, samples, attributes, events if config.keep_events else None)
    return name
