"""`evnlos simulate`: config in, dataset of shards out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.cli.console import Flat, progress, say
from evnlos.dataset import Simulation, open_dataset, simulate
from evnlos.dataset.presets import PRESETS

__all__ = ["PRESETS", "Command"]


@dataclass(frozen=True)
class Command:
    """Simulate a dataset: one shard a hidden object. Run it again to go on after an interruption."""

    out: Path
    """Folder of the dataset; new, or begun with the same settings."""
    preset: str = "default"
    """`default`, or `paper` for the paper's table of settings."""
    config: Path | None = None
    """YAML file with settings that replace the preset's."""
    workers: int = 0
    """Processes; 0 = one for each core."""
    settings: Flat[Simulation] = field(default_factory=Simulation)

    def run(self) -> None:
        """Simulate, with a progress bar over the objects."""
        config = self.settings
        for note in config.glyphs.notes():
            say(note)
        for name, value in config.optics().items():
            say(f"{name} {value:.3g}")
        total = len(config.glyphs.objects())
        for _ in progress(simulate(config, self.out, self.workers), total, "objects", self.out):
            pass
        dataset = open_dataset(self.out)
        print(
            f"{self.out}: {total} objects, {total * config.positions} samples, {len(dataset.missing())} missing"
        )
