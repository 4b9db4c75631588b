"""`evnlos finetune`: run and dataset in, run out."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar

from evnlos.cli.console import Flat, Presets, result
from evnlos.cli.train import fit
from evnlos.dataset import open_dataset
from evnlos.progress import ProgressBars
from evnlos.training import (
    Training,
    alternatives,
    choose_and_finetune,
    finetuning,
    paper_finetuning,
    read_choice,
)


@dataclass(frozen=True)
class FinetuneCommand:
    """Fine-tune weights on few captures (EPNP): modality and network are those of the weights.

    After a simulation that was fitted to the setup, less is better: --epochs 3 --learning-rate 2e-4
    --keep-normalization. With --choose captures that are held out decide, and fine-tuning cannot lose much.
    """

    PRESETS: ClassVar[Presets[Training]] = {"default": finetuning, "paper": paper_finetuning}

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
    choose: bool = False
    """Try these settings, a fifth and five times the learning rate, keeping the normalization and not, on two
    halves of the training captures in turn; take the best, part of the way to it, or nothing."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Training] = field(default_factory=finetuning)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        dataset = open_dataset(self.data)
        if not self.choose:
            fit(dataset, self.settings, self.out, self.weights, self.json)
            return
        candidates = alternatives(self.settings)
        with ProgressBars() as progress:
            trained = choose_and_finetune(dataset, candidates, self.out, self.weights, progress=progress)
        choice = read_choice(self.out)
        assert choice is not None
        values = {"run": str(self.out), "weights": str(trained.file), **asdict(choice)}
        result(self.json, values, f"{self.out}: {choice.sentence()}; weights in {trained.file}")
