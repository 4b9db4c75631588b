"""A simulated dataset of an experiment: made, or gone on with, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from evnlos.dataset import Simulation, simulate
from evnlos.experiment.study import Step


def simulated_steps(config: Simulation, folder: Path, workers: int) -> Iterator[Step]:
    """Simulate what is missing of a dataset, yielding a step with each object.

    Args:
        config: The settings.
        folder: Where the dataset goes.
        workers: Processes; 0 = one for each core.
    """
    total, there = len(config.glyphs.objects()), sum(1 for _ in folder.glob("*.h5"))
    for k, _ in enumerate(simulate(config, folder, workers), start=there + 1):
        yield Step(f"simulate {folder.name}", k, total)
