"""`evnlos train`: dataset or simulation in, run out."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from evnlos.cli.console import Flat, result
from evnlos.cli.notes import say
from evnlos.config import load_yaml
from evnlos.dataset import Dataset, Simulation, live_dataset, open_dataset
from evnlos.dataset.live import Place
from evnlos.errors import ConfigError
from evnlos.training import Training, paper_pretraining, train

PRESETS = {"default": Training, "paper": paper_pretraining}


@dataclass(frozen=True)
class Command:
    """Train a network from random weights: pre-training on a simulation, or end to end (E2E) on captures."""

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
    """Where --simulate works beside a GPU: `device` = on it, in steps of 2 ms; `cpu` = in --workers processes,
    of which it then wants several."""
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
            config = load_yaml(Simulation, self.simulate)
            fit(live_dataset(config, self.workers, self.simulate_on), self.settings, self.out, None, self.json)


def fit(dataset: Dataset, settings: Training, out: Path, weights: Path | None, as_json: bool) -> None:
    """Train with a progress bar over the epochs, and warn of a network that ignores its input.

    Of several processes that `torchrun` started, only the first speaks.
    """
    quiet = int(os.environ.get("RANK", "0")) > 0
    record: dict[str, Any] = {}
    records = train(dataset, settings, out, weights)
    with tqdm(records, total=settings.epochs, desc=out.name, unit="epoch", disable=quiet) as bar:
        for record in bar:
            bar.set_postfix({key: record[key] for key in ("loss", "psnr_db") if key in record})
    if quiet:
        return
    if record.get("collapsed"):
        say(
            f"warning: the network answers the same to every input ({record['psnr_db']} dB; all-black has "
            f"{record['zero_db']} dB): it has collapsed; use --loss balanced, or train for more epochs"
        )
    file = out / "weights.safetensors"
    text = f"{out}: {record['epoch']} epochs, loss {record['loss']}, weights in {file}"
    result(as_json, {"run": str(out), "weights": str(file), **record}, text)
