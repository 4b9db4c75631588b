"""Simulations by name, what they will take, and whether their shards are whole.

- Named simulations: Python functions, so that a preset can say why each of its values is what it is;
  and simulations with sensors and walls drawn from wide ranges.
- What a simulation will take, from one object that is really simulated.
- Is every shard whole, and the one that its settings say?
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from evnlos.cameras import FrameCamera
from evnlos.config import config_hash, from_dict
from evnlos.data.pool import processes
from evnlos.data.sampling import Sampling
from evnlos.data.simulate import Simulation, needs_a_matrix, ranges_around, simulate, simulate_object
from evnlos.data.store import PAGE, Dataset, claim_dataset, is_page_changed, read_shard, write_shard
from evnlos.errors import ConfigError, DataError
from evnlos.machine import Progress, Step, silent
from evnlos.scene import (
    DIGITS,
    TRAIN_WRITERS,
    UPPER_CASE,
    FontGlyphs,
    HandwritingGlyphs,
    LineMotion,
    PictureGlyphs,
)
from evnlos.setups.load import page_setup
from evnlos.setups.paper import as_in_the_paper, rough_paper
from evnlos.types import target_side_m

if TYPE_CHECKING:
    from evnlos.data.lab import Lab

S = TypeVar("S", Simulation, "Lab")
_LEAST_S = 0.5  # of CPU to prepare a wall: less is not told


def with_pictures(settings: S, folder: str) -> S:
    """Return settings whose objects are the pictures of a folder, on a target as large as it was."""
    return replace(settings, glyphs=PictureGlyphs(folder=folder, target_plane=settings.glyphs.target_plane))


def default() -> Simulation:
    """Return the simulation to pre-train on when little is known of the setup: the paper's transport, varied.

    Blur, light, noise and thresholds are drawn for each object from wide ranges, the magnification from a
    narrow one around a target 0.3 m from the wall and a camera 0.6 m from it; the camera aims at the middle
    of the travel. A view that varied more would make the place of the target unknowable from one image.
    """
    return Simulation(
        glyphs=HandwritingGlyphs(characters="ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", writers=8),
        setup=rough_paper(),
        vary={
            "setup.field_of_view_m": (0.55, 0.62),
            "setup.tpsf_length_m": (0.006, 0.03),
            "setup.kernel_radius": (2.0, 5.0),
            "setup.stretch": (1.0, 1.2),
            "setup.gain": (0.8, 2.4),
            "setup.ambient": (0.02, 0.1),
            "setup.ambient_gradient.0": (-0.4, 0.4),
            "setup.ambient_gradient.1": (-0.4, 0.4),
            "setup.pixel.threshold_on": (0.1, 0.35),
            "setup.pixel.threshold_off": (0.1, 0.35),
            "setup.pixel.cutoff_hz": (10.0, 200.0),
            "setup.pixel.shot_noise_rate_hz": (0.0, 1.0),
        },
    )


_WIDE = {
    "setup.roughness": 0.2,
    "setup.slopes": 0.12,
    "setup.tpsf_length_m": 0.2,
    "setup.gain": 0.2,
    "setup.ambient": 0.3,
    "setup.companion": 0.5,
    "setup.frame_camera.full_well_e": 0.3,
    "setup.frame_camera.read_noise_e": 0.3,
    "setup.frame_camera.noise_codes": 0.3,
    "setup.pixel.threshold_on": 0.25,
    "setup.pixel.threshold_off": 0.25,
    "setup.pixel.threshold_sigma": 0.5,
    "setup.pixel.cutoff_hz": 0.5,
    "setup.pixel.shot_noise_rate_hz": 0.7,
    "setup.pixel.leak_rate_hz": 0.7,
    "setup.pixel.leak_rate_per_dn_hz": 0.7,
    "setup.pixel.photon_noise": 0.5,
    "setup.pixel.photocurrent_a_per_dn": 0.3,
    "setup.pixel.noise_factor": 0.5,
}
_WIDE_PLACE_M, _WIDE_SETUPS = 0.002, 6


def randomized(simulation: Simulation, walls: bool = True) -> Simulation:
    """Return a simulation whose sensors and walls are drawn from wide ranges around those that it has.

    What a network learns from it depends less on how well the setup is known (domain randomization; Tobin et
    al., IROS 2017): event thresholds within 25 %, noise within 30 to 70 %, slopes of the wall's facets within
    12 %, light within 20 to 30 %, the place of the travel within 2 mm. A range that is wider already stays.

    Args:
        simulation: The simulation, as a rule that of a calibrated setup.
        walls: Whether walls, light and frame cameras are drawn, too, or event pixels alone.
    """
    chosen = {name: spread for name, spread in _WIDE.items() if walls or name.startswith("setup.pixel.")}
    ranges, setup, setups = ranges_around(simulation, chosen), simulation.setup, simulation.setups
    if walls:
        places = {p.name: p.value for p in setup.parameters() if p.role == "place"}
        setup = setup.with_parameters(places)  # what follows from other numbers is written out
        ranges |= {f"setup.{name}": (v - _WIDE_PLACE_M, v + _WIDE_PLACE_M) for name, v in places.items()}
        setups = max(setups, _WIDE_SETUPS) if setups else setups
    for path, (low, high) in simulation.vary.items():
        wide = ranges.get(path, (low, high))
        ranges[path] = (min(low, wide[0]), max(high, wide[1]))
    return replace(simulation, setup=setup, vary=ranges, setups=setups)


def paper() -> Simulation:
    """Return the paper's simulated training set: 39 x 26 handwritten letters, 0.5 m, 500 nm, 960 x 600 pixels.

    NIST-like handwriting stands in for NIST; give `--glyphs.kind nist-sd19` and the folder of your own copy.
    """
    return Simulation(
        glyphs=HandwritingGlyphs(),
        setup=as_in_the_paper(),
    )


def paper_nist_test() -> Simulation:
    """Return the paper's first simulated test set: 1 x 26 letters of a writer that the training never saw."""
    return _tested_on(HandwritingGlyphs(writers=1, first_writer=TRAIN_WRITERS))


def paper_comic_letters() -> Simulation:
    """Return the paper's second simulated test set: the 26 letters of the Comic face."""
    return _tested_on(FontGlyphs(characters=UPPER_CASE))


def paper_comic_digits() -> Simulation:
    """Return the paper's third simulated test set: the 10 digits of the Comic face, smaller than letters."""
    return _tested_on(FontGlyphs(characters=DIGITS))


def _tested_on(glyphs: HandwritingGlyphs | FontGlyphs) -> Simulation:
    """Return the paper's simulation of other objects, none of them for training."""
    return replace(paper(), glyphs=glyphs, validation=0.0)


def page() -> Simulation:
    """Return the simulation that the networks of `evnlos app` learn from: the page's setup, its sliders moved.

    Metal from smooth to rough, the distances, lights, noises and thresholds around the page's first setting;
    outside that range, where even the best linear image shows next to nothing, the networks are unreliable.
    """
    well_e, read_e = FrameCamera.full_well_e, FrameCamera.read_noise_e
    return Simulation(
        glyphs=HandwritingGlyphs(characters=UPPER_CASE + DIGITS, writers=44),
        motion=LineMotion((-0.08, 0.0), 0.02),
        setup=page_setup(),
        sampling=Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24),
        vary={
            "setup.roughness": (0.02, 0.09),
            "setup.distance_m": (0.2, 0.4),
            "setup.ambient": (0.0, 0.3),
            "setup.frame_camera.full_well_e": (well_e / 4, 2 * well_e),
            "setup.frame_camera.read_noise_e": (read_e / 2, 2 * read_e),
            "setup.pixel.threshold_on": (0.08, 0.3),
            "setup.pixel.threshold_off": (0.08, 0.3),
            "setup.pixel.shot_noise_rate_hz": (0.0, 0.2),
        },
        setups=200,
    )


PRESETS: dict[str, Callable[[], Simulation]] = {
    "default": default,
    "page": page,
    "paper": paper,
    "paper-nist-test": paper_nist_test,
    "paper-comic-letters": paper_comic_letters,
    "paper-comic-digits": paper_comic_digits,
}
"""Simulations by name; `paper` is the paper's training set, the others of its name are its test sets."""


@dataclass(frozen=True)
class Estimate:
    """Cost of a simulation.

    Args:
        objects: Objects to simulate here.
        cpu_s: CPU time of one object, seconds, preparation left out.
        preparation_s: CPU time to prepare one wall (its light path), seconds; 0 where that is hardly any.
        walls: Walls to prepare, each process its own.
        shard_bytes: Size of one shard.
        worker_bytes: Peak memory of the process that simulated it; 0 where the system does not say.
        workers: Processes.
        events: Events of the object.
    """

    objects: int
    cpu_s: float
    preparation_s: float
    walls: int
    shard_bytes: int
    worker_bytes: int
    workers: int
    events: int

    def lines(self, out: Path) -> list[str]:
        """Return what a user wants to know before the start."""
        place = next(path for path in (out, *out.resolve().parents) if path.is_dir())
        free = shutil.disk_usage(place).free
        seconds = (self.objects * self.cpu_s + self.walls * self.preparation_s) / self.workers
        prepared = f"walls: {self.walls} to prepare, {self.preparation_s:.2f} s of CPU each"
        memory = _size(self.workers * self.worker_bytes) if self.worker_bytes else "not known on this system"
        return [
            f"objects: {self.objects}, {self.cpu_s:.2f} s of CPU and {self.events:,} events each",
            *([prepared] if self.walls else []),
            f"time: about {_clock(seconds)} with {self.workers} processes of one thread on as many free cores",
            f"disk: about {_size(self.objects * self.shard_bytes)}; {_size(free)} are free",
            f"memory: {'about ' if self.worker_bytes else ''}{memory}",
        ]


def estimate(config: Simulation, workers: int = 0, share: tuple[int, int] = (1, 1)) -> Estimate:
    """Simulate the middle object of a share twice, the first time to compile and to fill caches.

    It is simulated before another wall, too, to see what that one takes: of another draw where `vary` draws
    walls, else hardly further away, as each process renders the light path of the one wall for itself.

    Args:
        config: The settings.
        workers: Processes; 0 means one for each core.
        share: (i, n), as in `simulate`.

    Raises:
        ConfigError: A number of workers below 0, or a share without an object.
    """
    names = config.glyphs.objects()[share[0] - 1 :: share[1]]
    if not names:
        objects = len(config.glyphs.objects())
        raise ConfigError(f"share {share[0]}/{share[1]} of {objects} objects is empty; give fewer shares")
    at_once = processes(workers, len(names))
    name = names[len(names) // 2]
    simulate_object(config, name)
    walls, held, away_m = _walls(config, len(names), at_once), 0, config.setup.default_distance_m
    is_one, fresh, other = not walls and away_m is not None, 0.0, replace(config, seed=config.seed + 1)
    if is_one:
        other = replace(config, setup=config.setup.at_distance((away_m or 1.0) * (1 + 1e-6)))
        walls, held = at_once, _peak_bytes()  # before there are two
    if walls:
        began = time.process_time()
        simulate_object(other, name)
        fresh = time.process_time() - began
        simulate_object(config, name)  # which the other wall may have pushed out of the caches
    began = time.process_time()
    samples, events = simulate_object(config, name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object.h5"
        write_shard(path, samples, {"object": name}, events if config.keep_events else None)
        size = path.stat().st_size
    spent = time.process_time() - began
    prepared = max(fresh - spent, 0.0) if walls else 0.0
    walls = 0 if is_one and prepared < _LEAST_S else walls
    return Estimate(len(names), spent, prepared, walls, size, held or _peak_bytes(), at_once, len(events))


def _walls(config: Simulation, objects: int, workers: int) -> int:
    """Return how many walls that `vary` draws all processes together prepare, at most."""
    if not any(needs_a_matrix(path) for path in config.vary):
        return 0
    return min(config.setups * workers, objects) if config.setups else objects


def _peak_bytes() -> int:
    """Return the most memory that this process has held, bytes; 0 where the system does not say."""
    try:
        import resource  # not on Windows
    except ImportError:
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _clock(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _size(count: float) -> str:
    return f"{count / 1e6:.0f} MB" if count < 1e9 else f"{count / 1e9:.1f} GB"


@dataclass(frozen=True)
class Fault:
    """What is wrong with one object's shard."""

    name: str
    """The object."""
    reason: str
    """What was found."""


def find_faults(dataset: Dataset, progress: Progress = silent) -> list[Fault]:
    """Read every shard of a dataset, checksums and all, and return what is wrong.

    Found are: shards that are missing, cut short or changed (fletcher32), of another object, or made with
    other settings; and a `dataset.yaml` that is not as it was written.

    Args:
        dataset: The dataset on disk.
        progress: Called when the work begins and after each object, with its fault or None.
    """
    names, faults = dataset.objects(), []
    what = f"verify {dataset.folder.name}"
    progress(Step(what, 0, len(names), "objects"))
    for done, name in enumerate(names, start=1):
        fault = _fault(dataset, name)
        if fault is not None:
            faults.append(fault)
        progress(Step(what, done, len(names), "objects", fault))
    if is_page_changed(dataset):
        faults.append(Fault(PAGE, "it is not as it was written: damaged, or changed by hand"))
    return faults


def _fault(dataset: Dataset, name: str) -> Fault | None:
    path = dataset.shard(name)
    if not path.is_file():
        return Fault(name, "missing")
    try:
        _, attributes = read_shard(path)
    except DataError as error:
        return Fault(name, str(error).split(" is damaged (")[-1].split("); ")[0])
    if attributes.get("object") != name:
        return Fault(name, f"it holds the object {attributes.get('object')!r}")
    if attributes.get("config_hash") != dataset.config_hash:
        return Fault(name, "it was made with other settings")
    return None


def repair(
    dataset: Dataset,
    faults: list[Fault],
    workers: int = 0,
    progress: Progress = silent,
    force: bool = False,
) -> Dataset:
    """Simulate the faulty objects of a dataset again; their shards are the same bytes as the first time.

    Args:
        dataset: The dataset on disk.
        faults: What `find_faults` returned.
        workers: Processes; 0 means one for each core.
        progress: As of `simulate`.
        force: As of `simulate`.

    Raises:
        DataError: The dataset holds captures (import them again), or its settings were changed by hand.
    """
    if dataset.origin != "simulation":
        what = f"{dataset.folder} holds captures"
        raise DataError(f"{what}; delete the {len(faults)} faulty shards and import again")
    config = from_dict(Simulation, dataset.config, source=str(dataset.folder / PAGE))
    if config_hash(dataset.config) != dataset.config_hash or is_page_changed(dataset):
        what = f"{dataset.folder / PAGE} was changed: its settings do not fit their hash {dataset.config_hash}"
        raise DataError(f"{what}; restore it, or simulate into a new folder")
    with claim_dataset(dataset):
        for fault in faults:
            dataset.shard(fault.name).unlink(missing_ok=True)
    return simulate(config, dataset.folder, workers, progress=progress, force=force)


def fitting(sampling: Sampling, size_m: float, travel_m: tuple[float, float]) -> Sampling:
    """Return the sampling with a canvas for larger targets, or a longer way, than it is made for.

    Targets that are up to a sixteenth larger than its target plane keep it.

    Args:
        sampling: A sampling; its pitch changes.
        size_m: Side of the targets, metres.
        travel_m: Way of their centres across and down, metres.
    """
    side, rows_m = target_side_m(sampling.canvas), sampling.scored_rows * sampling.pitch_m
    own = size_m / side if size_m / side > 1.0625 else 1.0
    needed = max((travel_m[0] + size_m) / sampling.canvas.extent_m[1], (travel_m[1] + size_m) / rows_m)
    scale = needed if needed > 1.04 * own else own
    return sampling if scale == 1.0 else replace(sampling, pitch_m=round(scale * sampling.pitch_m, 6))
