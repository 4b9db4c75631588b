"""`evnlos finetune`: run and dataset in, run out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.cli.console import Flat
from evnlos.cli.train import fit
from evnlos.dataset import open_dataset
from evnlos.training import Training, finetuning, paper_finetuning

PRESETS = {"default": finetuning, "paper": paper_finetuning}


@dataclass(frozen=True)
class Command:
    """Fine-tune weights on few captures (EPNP): paradigm and network are those of the weights.

    After a simulation that was fitted to the rig, less is better: --epochs 3 --learning-rate 2e-4
    --no-restandardise.
    """

    weights: Path
    """Weights file, or the run to start from."""
    data: Path
    """Folder of the dataset of captures."""
    out: Path
    """Folder of the run; new, or begun with the same settings."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 100 epochs at 1e-5 with its loss."""
    config: Path | None = None
    """YAML file with settings."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Training] = field(default_factory=finetuning)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        fit(open_dataset(self.data), self.settings, self.out, self.weights, self.json)
