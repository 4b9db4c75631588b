"""`evnlos simulate`: config in, dataset of shards out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

from evnlos.cli.console import Flat, Presets, result
from evnlos.cli.notes import say
from evnlos.dataset import Simulation, simulate
from evnlos.dataset.cluster import run_on_dask
from evnlos.dataset.estimate import estimate
from evnlos.dataset.pool import run_tasks
from evnlos.dataset.presets import PRESETS
from evnlos.errors import ConfigError
from evnlos.progress import ProgressBars
from evnlos.setups import load_setup
from evnlos.setups.base import is_camera
from evnlos.setups.load import is_name


@dataclass(frozen=True)
class SimulateCommand:
    """Simulate a dataset: one shard a hidden object. Run it again to go on after an interruption."""

    PRESETS: ClassVar[Presets[Simulation]] = PRESETS

    out: Path
    """Folder of the dataset; new, or begun with the same settings."""
    preset: str = "default"
    """`default`; `paper` for the paper's training set; `paper-nist-test`, `paper-comic-letters` or
    `paper-comic-digits` for its test sets."""
    config: Path | None = None
    """YAML file with settings that replace the preset's."""
    setup: str | None = None
    """The setup instead of the preset's: a name (main-near, matte-far, ...), a settings file, a folder that
    `evnlos calibrate` wrote, or a file of `evnlos scan import`. A name leaves the cameras to the preset; ranges
    over the preset's wall are dropped."""
    workers: int = 0
    """Processes; 0 = one for each core."""
    shard: str = "1/1"
    """Share of the objects to make here, i/n: run the shares 1/n to n/n anywhere, on one shared folder."""
    engine: Literal["local", "dask"] = "local"
    """Processes on this machine, or a Dask cluster (extra `cluster`) on a shared file system."""
    scheduler: str | None = None
    """Address of a running Dask scheduler, e.g. tcp://node1:8786; by default a cluster on this machine."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""
    dry_run: bool = False
    """Only simulate one object and print what the whole would take: time, disk, memory."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Simulation] = field(default_factory=Simulation)

    @staticmethod
    def with_setup(settings: Simulation, word: str) -> Simulation:
        """Return the simulation with the setup of `--setup`, without the ranges over the wall that it had."""
        setup = load_setup(word)
        if is_name(word):
            setup = setup.with_cameras_of(settings.setup)
        over_cameras = {
            path: ends
            for path, ends in settings.vary.items()
            if not path.startswith("setup.") or is_camera(path)
        }
        return replace(settings, setup=setup, vary=over_cameras)

    def run(self) -> None:
        """Simulate, with a progress bar over the objects."""
        config = self.settings
        for note in config.glyphs.notes():
            say(note)
        for line in config.setup.warnings():
            say(f"warning: {line}")
        for name, value in config.optics().items():
            say(f"{name} {value:.3g}")
        share = _share(self.shard)
        if self.scheduler and self.engine != "dask":
            raise ConfigError(f"--scheduler {self.scheduler} needs --engine dask")
        total = len(config.glyphs.objects())
        if self.dry_run:
            for line in estimate(config, self.workers, share).lines(self.out):
                print(line)
            return
        engine = run_tasks if self.engine == "local" else partial(run_on_dask, scheduler=self.scheduler)
        with ProgressBars() as progress:
            missing = simulate(config, self.out, self.workers, share, engine, progress, self.force).missing()
        about = {"out": str(self.out), "objects": total, "samples": total * config.positions}
        text = f"{self.out}: {total} objects, {total * config.positions} samples, {len(missing)} missing"
        result(self.json, about | {"missing": missing}, text)


def _share(text: str) -> tuple[int, int]:
    """Return (i, n) of "i/n"."""
    first, _, stride = text.partition("/")
    if not (first.isdigit() and stride.isdigit() and 1 <= int(first) <= int(stride)):
        raise ConfigError(f"--shard is {text!r}; give i/n with i from 1 to n, e.g. 3/16")
    return int(first), int(stride)
