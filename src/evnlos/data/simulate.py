"""Simulated datasets: settings, their variation from object to object, and the shards that come of them.

- From settings to a dataset of shards: each object is a pure function of (settings, seed, name).
- Samples that are simulated as a training needs them: no dataset on disk, and each epoch another draw.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.cameras import FrameCameraSettings, PixelSettings
from evnlos.config import check_made, config_hash, to_dict
from evnlos.data.loader import Modality, as_modality
from evnlos.data.pool import Engine, processes, run_in_order, run_tasks
from evnlos.data.sampling import Samples, Sampling, edges_from, make_samples
from evnlos.data.store import Dataset, claim_dataset, write_shard
from evnlos.errors import ConfigError
from evnlos.machine import Progress, Step, cores, silent
from evnlos.scene import Glyphs, HandwritingGlyphs, LineMotion, Scene, character_name
from evnlos.setups import PaperSetup, SensorSize, Setup
from evnlos.setups.base import CAMERA_FIELDS, LIGHT_FIELDS, is_camera
from evnlos.types import Events, derive_seed
from evnlos.untrusted import check_memory

T = TypeVar("T")
Ranges = dict[str, tuple[float, float]]


def varied(config: T, ranges: Ranges, seed: int, name: str) -> T:
    """Return `config` with the named settings drawn uniformly from their ranges, for one object.

    Args:
        config: A nested frozen dataclass.
        ranges: Dotted name of a number (`setup.pixel.threshold_on`; `setup.offset_m.0` for the first entry of a
            tuple) -> (low, high), in the setting's own unit.
        seed: The run's seed.
        name: The object's name; the same seed and name draw the same settings.

    Raises:
        ConfigError: A name is unknown (the nearest is named) or is not a number.
    """
    draws = {}
    for path, (low, high) in ranges.items():
        draw = np.random.default_rng(derive_seed(seed, name, "vary", _seed_word(path))).uniform(low, high)
        draws[tuple(path.split("."))] = (float(draw), path)
    return _replaced(config, draws) if draws else config


def check_ranges(config: object, ranges: Ranges) -> None:
    """Try both ends of every range, so that a wrong name or value is an error at once.

    Raises:
        ConfigError: As for `varied`, or a value that the setting itself refuses.
    """
    for path, (low, high) in ranges.items():
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise ConfigError(f"vary.{path} is ({low}, {high}); give two ascending finite numbers")
        first, *rest = path.split(".")
        names = [f.name for f in dataclasses.fields(config)]  # type: ignore[arg-type]
        if first not in names:
            raise _unknown(path, first, names)
        for value in (low, high):
            _replaced(getattr(config, first), {tuple(rest): (value, path)})


def ranges_around(config: object, spreads: Mapping[str, float]) -> Ranges:
    """Return ranges about the settings' own values; settings that `config` does not have are passed over.

    Args:
        config: A nested dataclass.
        spreads: Dotted name of a number -> half-width of its range over its value.
    """
    ranges: Ranges = {}
    for path, spread in spreads.items():
        value: Any = config
        for name in path.split("."):
            value = getattr(value, name) if name in getattr(value, "__dataclass_fields__", ()) else None
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            ends = sorted((float(value) * (1 - spread), float(value) * (1 + spread)))
            ranges[path] = (ends[0], ends[1])
    return ranges


def _seed_word(path: str) -> str:
    """Return the word that a setting's draw is seeded with: it stays when settings move, and so do datasets."""
    section, _, rest = path.partition(".")
    if section != "setup":
        return path
    return rest if is_camera(rest) else f"transport.{rest}"


def _unknown(path: str, key: str, names: list[str]) -> ConfigError:
    near = difflib.get_close_matches(key, names, n=1)
    cure = f"perhaps you meant {near[0]!r}" if near else f"known here: {', '.join(names) or 'nothing'}"
    return ConfigError(f"vary.{path}: unknown setting {key!r}; {cure}")


def _replaced(node: Any, values: Mapping[tuple[str, ...], tuple[float, str]]) -> Any:
    """Return a node with numbers below it replaced, by their names: (value, dotted name from the top)."""
    if () in values:
        value, path = values[()]
        if isinstance(node, bool) or not isinstance(node, (int, float)):
            raise ConfigError(f"vary.{path} names {node!r}, which is no number; name a number")
        return value
    below: dict[str, dict[tuple[str, ...], tuple[float, str]]] = {}
    for (key, *rest), value in values.items():
        below.setdefault(key, {})[tuple(rest)] = value
    if isinstance(node, tuple) and all(key.isdigit() and int(key) < len(node) for key in below):
        return tuple(_replaced(old, below[str(i)]) if str(i) in below else old for i, old in enumerate(node))
    names = [f.name for f in dataclasses.fields(node)] if dataclasses.is_dataclass(node) else []
    for key, inner in below.items():
        if key not in names:
            raise _unknown(next(iter(inner.values()))[1], key, names)
    changes = {key: _replaced(getattr(node, key), inner) for key, inner in below.items()}
    return dataclasses.replace(node, **changes)  # type: ignore[type-var]


@dataclass(frozen=True)
class Simulation:
    """Everything that decides a simulated dataset."""

    glyphs: Glyphs = field(default_factory=HandwritingGlyphs)
    """What is hidden."""
    motion: LineMotion = field(default_factory=LineMotion)
    """How it moves."""
    duration_s: float = 8.0
    """Length of a sequence, seconds."""
    positions: int = 40
    """Equidistant positions of an object, one sample each."""
    setup: Setup = field(default_factory=PaperSetup)
    """Wall, geometry, ambient light and cameras: how the light becomes frames and events."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation of the stored samples."""
    vary: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Settings drawn for each object from a range: dotted name -> (low, high)."""
    setups: int = 0
    """Number of different walls and geometries that the ranges of the setup are drawn for, shared by the
    objects (each costs a light-transport matrix); 0 = one for each object."""
    validation: float = 0.05
    """Share of the objects that is held out for validation, 0..1."""
    held_out: str = ""
    """Characters whose objects are for testing alone, one after the other: GK49."""
    keep_events: bool = False
    """Store the events of each object beside the maps."""
    seed: int = 0
    """Seed of every draw."""

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ConfigError(f"Simulation.duration_s is {self.duration_s}; give a positive number of seconds")
        if self.positions < 1:
            raise ConfigError(f"Simulation.positions is {self.positions}; give at least 1")
        if self.setups < 0:
            raise ConfigError(
                f"Simulation.setups is {self.setups}; give 0 (one for each object) or a number of setups"
            )
        if not 0 <= self.validation < 1:
            raise ConfigError(f"Simulation.validation is {self.validation}; give a share from 0 to below 1")
        _ = self.setup.event_camera  # refuses a step that does not fit the model
        check_ranges(self, self.vary)
        check_made(self)

    def optics(self) -> dict[str, float]:
        """Return what diffraction and the wall do to the image: Fresnel number, blurs, sampling limit.

        Empty for a radiometric wall, whose blur `evnlos identify` measures.

        Example:
            >>> round(Simulation().optics()["fresnel_number"])
            6400
        """
        return self.setup.optical_values(self.glyphs.target_plane.size_m)

    def with_setup(self, **changes: Any) -> Simulation:
        """Return the simulation with some settings of its setup replaced, by name.

        Args:
            changes: Settings of the setup, e.g. `pixel=EventPixel(...)`.
        """
        return replace(self, setup=replace(self.setup, **changes))

    @property
    def frame_camera(self) -> FrameCameraSettings:
        """The setup's frame camera."""
        return self.setup.frame_camera

    @property
    def pixel(self) -> PixelSettings:
        """The setup's event model and its parameters."""
        return self.setup.pixel

    @property
    def sensor(self) -> SensorSize:
        """The size of the setup's sensor."""
        return self.setup.sensor


def drawn_for(config: Simulation, name: str) -> Simulation:
    """Return the settings that `vary` draws for an object; those of the optics are shared by `setups` groups.

    Gain and ambient light cost nothing, so they are always the object's own. What is returned varies no more.
    """
    optics = {path: ends for path, ends in config.vary.items() if config.setups and needs_a_matrix(path)}
    others = {path: ends for path, ends in config.vary.items() if path not in optics}
    drawn = dataclasses.replace(config, vary={})  # else the ends of all ranges would be tried at each draw
    if optics:
        group = _optics_of(config, name)
        drawn = varied(drawn, optics, config.seed, f"rig {group}")  # the word decides the seed, so it stays
    return varied(drawn, others, config.seed, name)


def _optics_of(config: Simulation, name: str) -> int:
    """Return the number of the optics that an object shares with others; 0 where each has its own."""
    return derive_seed(config.seed, name, "rig") % config.setups if config.setups else 0


def needs_a_matrix(path: str) -> bool:
    """Return whether a varied setting, by its dotted name, is one of the optics: each draw is prepared anew."""
    section, name, *_ = path.split(".")
    return section == "setup" and name not in (*LIGHT_FIELDS, *CAMERA_FIELDS)


def scene_of(config: Simulation, drawn: Simulation, name: str) -> Scene:
    """Return what an object's sequence shows, given the settings drawn for it: the glyph is not varied."""
    target = config.glyphs.target(name, derive_seed(config.seed, "glyph"))
    return Scene(target, drawn.motion, drawn.duration_s)


def simulate_object(config: Simulation, name: str) -> tuple[Samples, Events]:
    """Simulate one object's sequence: scene -> wall -> events and frames -> samples.

    Args:
        config: The settings.
        name: One of `config.glyphs.objects()`.

    Returns:
        The samples of all positions, and the events of the whole sequence.
    """
    drawn = drawn_for(config, name)
    scene = scene_of(config, drawn, name)
    setup, wall = drawn.setup, drawn.setup.observe(scene)
    times_s = scene.position_times_s(config.positions)
    seed = derive_seed(config.seed, name, "events")
    events = setup.event_camera.record(wall, 0.0, drawn.duration_s, seed=seed)
    frames = setup.frame_camera.capture(wall, times_s, seed=derive_seed(config.seed, name, "frames"))
    frames, known = setup.frame_camera.linear_levels(frames), {"motion": scene.motion, "target": scene.target}
    peak = setup.frame_camera.peak
    return make_samples(frames, peak, events, edges_from(times_s), config.sampling, **known), events


def sequence_bytes(setup: Setup, target_size_m: float, duration_s: float, frames: int, cells: int = 0) -> int:
    """Return the memory that simulating one sequence takes at least, bytes, without simulating anything.

    Counted are the wall's matrix, the states of the sensor's pixels, its frames, the maps, and the events that
    noise alone sends.

    Args:
        setup: Wall and cameras.
        target_size_m: Side of the target, metres.
        duration_s: Length of the sequence, seconds.
        frames: Frames.
        cells: Cells of the maps of each frame.
    """
    pixels = setup.sensor.height * setup.sensor.width
    kept = 100 * pixels + frames * (4 * pixels + 32 * cells) + 26 * pixels * duration_s * setup.pixel.noise_hz
    return int(setup.bytes_of_a_scene(target_size_m) + kept)


def object_bytes(config: Simulation) -> int:
    """Return the memory that simulating one object takes at least, bytes, without simulating anything.

    Args:
        config: The settings.
    """
    cells = config.sampling.height * config.sampling.width
    return sequence_bytes(
        config.setup, config.glyphs.target_plane.size_m, config.duration_s, config.positions, cells
    )


def check_sequences(needed: int, at_once: int) -> None:
    """Refuse sequences that take more memory together than there is.

    Args:
        needed: Bytes of each.
        at_once: How many are simulated at a time.

    Raises:
        DataError: They need more.
    """
    what = "an object" if at_once < 2 else f"simulating {at_once} objects at a time"
    fewer = "" if at_once < 2 else "use fewer --workers, or "
    cure = f"{fewer}take a smaller sensor, fewer positions or less time; or force it"
    check_memory(needed * at_once, what, cure)


def split_of(config: Simulation) -> dict[str, list[str]]:
    """Return the split by object: those held out for testing, a seeded share for validation, the others.

    Raises:
        ConfigError: No object shows one of the characters that are to be held out.
    """
    every = config.glyphs.objects()
    held_out = set()
    for char in config.held_out:
        shown = {name for name in every if name.endswith(f"_{character_name(char)}")}
        if not shown:
            raise ConfigError(
                f"held_out is {config.held_out!r}, and none of the {len(every)} objects shows {char!r}; give "
                "characters that the glyphs have, one after the other and nothing between"
            )
        held_out |= shown
    tested = [name for name in every if name in held_out]
    names = [name for name in every if name not in held_out]
    order = np.random.default_rng(derive_seed(config.seed, "split")).permutation(len(names))
    chosen = {names[i] for i in order[: round(config.validation * len(names))]}
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
    progress: Progress = silent,
    force: bool = False,
) -> Dataset:
    """Simulate a dataset, or what is missing of it, and return it.

    Shards that exist are not made again, so a run that was killed goes on where it was. The shards are
    the same bytes for any number of workers.

    Args:
        config: The settings.
        folder: Where the dataset goes; new, or begun with the same settings.
        workers: Processes; 0 means one for each core.
        share: (i, n): only every n-th object, beginning with the i-th; i from 1 to n. The n shares together,
            made anywhere and in any order, are the dataset.
        engine: What runs the tasks: processes here, or `run_on_dask`.
        progress: Called when the work begins and as each shard is in place, with the object's name.
        force: Whether to begin although the machine's memory will hardly do.

    Returns:
        The dataset; of a share, with the shards of the others still missing.

    Raises:
        ConfigError: The share is none, a number of workers below 0, or a held-out character that no
            object shows.
        DataError: An object takes more memory than there is, the folder holds something else, or another
            process is at work in it.
    """
    first, stride = share
    if not 1 <= first <= stride:
        raise ConfigError(f"share {first} of {stride} is none; give i/n with i from 1 to n")
    at_once = processes(workers, len(config.glyphs.objects()) // stride + 1)
    if not force:
        check_sequences(object_bytes(config), at_once)
    dataset = Dataset(
        Path(folder),
        "simulation",
        config.sampling,
        split_of(config),
        config=to_dict(config),
        config_hash=config_hash(config),
        optics=config.optics(),
    )
    with claim_dataset(dataset, f"{first}-of-{stride}" if stride > 1 else "", Simulation) as dataset:
        share_names = set(config.glyphs.objects()[first - 1 :: stride])
        # Objects of the same optics follow each other, so that a process makes each matrix once.
        missing = [name for name in dataset.missing() if name in share_names]
        missing.sort(key=lambda name: _optics_of(config, name))
        what, total = f"simulate {dataset.folder.name}", len(share_names)
        there = total - len(missing)
        progress(Step(what, there, total, "objects"))
        tasks = [(config, name, dataset.shard(name), dataset.config_hash) for name in missing]
        with closing(engine(_simulate_shard, tasks, workers)) as finished:
            for done, name in enumerate(finished, start=there + 1):
                progress(Step(what, done, total, "objects", name))
    return dataset


def _simulate_shard(task: tuple[Simulation, str, Path, str]) -> str:
    config, name, path, settings = task
    samples, events = simulate_object(config, name)
    attributes = {"object": name, "config_hash": settings, "seed": config.seed}
    write_shard(path, samples, attributes, events if config.keep_events else None)
    return name


@dataclass(frozen=True)
class LiveDataset(Dataset):
    """A simulation that takes the place of a dataset on disk; make it with `live_dataset`.

    Epoch 0 is the dataset that `simulate` would write; epoch n has other handwriting, settings from the same
    ranges and other noise, and is the same whenever it is requested.
    """

    simulation: Simulation = field(default_factory=Simulation)
    """The settings."""
    workers: int = 1
    """Processes that simulate; 1 = in this process, 0 = one for each core."""
    mix: int = 8
    """Objects whose samples are shuffled together."""

    def stream(
        self, names: Iterable[str], epoch: int, modality: str | Modality, device: torch.device
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield input [N, C, H, W] and truth [N, 1, H, W] of each object, in order, float32.

        The samples are those of `simulate_object`, bit for bit, and go to the device in half precision.
        """
        config, seen = epoch_settings(self.simulation, epoch), as_modality(modality)
        tasks = [(config, name) for name in names]
        # one process per core, shared by the processes that train on this machine
        workers = self.workers or max(1, cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
        made = (_tensors(samples) for samples in run_in_order(_samples_of, tasks, workers))
        for maps in made:
            # in half precision twice, as shards hold the maps and a loader the inputs
            frame, surface, truth = (part.half().to(device).float() for part in maps)
            yield seen.inputs(frame, surface).half().float(), truth[:, None]

    def truth(self, name: str) -> NDArray[np.float32]:
        """Return the true images of an object in the first epoch, float32 [N, H, W], 0..1."""
        config = self.simulation
        scene = scene_of(config, drawn_for(config, name), name)
        return scene.truth(config.sampling.canvas, scene.position_times_s(config.positions))


def live_dataset(config: Simulation, workers: int = 1, force: bool = False) -> LiveDataset:
    """Return a simulation as a dataset to train on.

    Args:
        config: The settings.
        workers: Processes that simulate; 0 means one for each core.
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
