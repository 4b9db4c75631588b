"""`evnlos train`: dataset in, run out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.cli.console import Flat, train_with_bar
from evnlos.training import Training, paper_pretraining

PRESETS = {"default": Training, "paper": paper_pretraining}


@dataclass(frozen=True)
class Command:
    """Train a network from random weights: pre-training on a simulation, or end to end (E2E) on captures."""

    data: Path
    """Folder of the dataset."""
    out: Path
    """Folder of the run; new, or begun with the same settings."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 200 epochs, step sizes and loss."""
    config: Path | None = None
    """YAML file with settings."""
    settings: Flat[Training] = field(default_factory=Training)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        train_with_bar(self.data, self.settings, self.out, None)
