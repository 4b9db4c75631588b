"""`evnlos train`: dataset or simulation in, run out."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch

from evnlos.cli.console import Flat, Presets, result
from evnlos.cli.notes import say
from evnlos.config import load_yaml
from evnlos.dataset import Dataset, Simulation, live_dataset, open_dataset
from evnlos.dataset.live import Place
from evnlos.errors import ConfigError
from evnlos.progress import ProgressBars
from evnlos.training import Training, paper_pretraining, train


@dataclass(frozen=True)
class TrainCommand:
    """Train a network from random weights: pre-training on a simulation, or end to end (E2E) on captures."""

    PRESETS: ClassVar[Presets[Training]] = {"default": Training, "paper": paper_pretraining}

    out: Path
    """Folder of the run; new, or begun with the same settings."""
    data: Path | None = None
    """Folder of the dataset."""
    simulate: Path | None = None
    """YAML file with the settings of a simulation, instead of --data: samples are made while the network
    trains, other ones in each epoch, and nothing is stored."""
    workers: int = 1
    """Processes that simulate beside the training on the CPU, for --simulate; 0 = one for each core."""
    simulate_on: Place = "device"
    """Where --simulate works beside a GPU: `device` = on it, where the event model can (v2e, with a time step);
    `cpu` = in --workers processes, of which it then wants several. The physics is the same."""
    force: bool = False
    """Begin --simulate although the machine's memory will hardly do."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 200 epochs, step sizes and loss."""
    config: Path | None = None
    """YAML file with settings."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Training] = field(default_factory=Training)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        if (self.data is None) == (self.simulate is None):
            raise ConfigError("give --data DATASET or --simulate SETTINGS.yaml, one of the two")
        if self.data is not None:
            fit(open_dataset(self.data), self.settings, self.out, None, self.json)
        else:
            assert self.simulate is not None
            settings = load_yaml(Simulation, self.simulate)
            dataset = live_dataset(settings, self.workers, self.simulate_on, self.force)
            if note := dataset.note(torch.device("cuda" if torch.cuda.is_available() else "cpu")):
                say(f"note: {note}")
            fit(dataset, self.settings, self.out, None, self.json)


def fit(dataset: Dataset, settings: Training, out: Path, weights: Path | None, as_json: bool) -> None:
    """Train with a progress bar over the epochs, and warn of a network that ignores its input.

    Of several processes that `torchrun` started, only the first speaks.
    """
    quiet = int(os.environ.get("RANK", "0")) > 0
    if not quiet and (misfit := dataset.config.get("setup", {}).get("misfit")):
        say(f"warning: the simulation's setup does not fit its captures: {misfit}")
    with ProgressBars(quiet) as progress:
        trained = train(dataset, settings, out, weights, progress)
    if quiet:
        return
    record = trained.records[-1]
    if record.get("collapsed"):
        say(
            f"warning: the network answers the same to every input ({record['psnr_db']} dB; all-black has "
            f"{record['zero_db']} dB): it has collapsed; use --loss balanced, or train for more epochs"
        )
    text = f"{out}: {record['epoch']} epochs, loss {record['loss']}, weights in {trained.file}"
    result(as_json, {"run": str(out), "weights": str(trained.file), **record}, text)
