"""The trainings of an experiment: one after the other, or several at a time on the cores of a CPU."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from evnlos.dataset import Dataset
from evnlos.dataset.pool import processes, run_tasks
from evnlos.experiment.study import Step
from evnlos.training import Training, train


@dataclass(frozen=True)
class Run:
    """One training.

    Args:
        data: What it learns from.
        settings: How.
        out: Its folder.
        start: Run whose weights it starts from; None: random ones.
    """

    data: Dataset
    settings: Training
    out: Path
    start: Path | None = None


def train_one(run: Run) -> Iterator[Step]:
    """Train what is not trained yet, yielding a step with each epoch."""
    for record in train(run.data, run.settings, run.out, run.start):
        yield Step(f"train {run.out.name}", record["epoch"], run.settings.epochs)


def train_together(runs: list[Run], at_a_time: int) -> Iterator[Step]:
    """Train several networks at a time, yielding a step with each that is done.

    A network of this size gains little from a second core, so that as many trainings as there are cores, each
    with its share of them, take less time than one after the other. On a GPU nothing is done here: there they
    go one by one.

    Args:
        runs: The trainings; one that is named twice, or was done before, is done once.
        at_a_time: Trainings at a time; 0 = one for each core.
    """
    todo = {run.out: run for run in runs if not (run.out / "weights.safetensors").is_file()}
    if torch.cuda.is_available() or not todo:
        return
    yield Step("train networks", 0, len(todo))
    done = 0
    # Pre-training and end-to-end training first: fine-tuning begins where they end.
    for stage in (True, False):
        some = [run for run in todo.values() if (run.start is None) == stage]
        at_once = max(1, processes(at_a_time, len(some)))
        tasks = [(run, max(1, torch.get_num_threads() // at_once)) for run in some]
        for _ in run_tasks(_trained, tasks, at_once):
            done += 1
            yield Step("train networks", done, len(todo))


def _trained(task: tuple[Run, int]) -> str:
    """Train one network to the end, with so many threads, and return its folder's name."""
    run, threads = task
    torch.set_num_threads(threads)
    for _ in train_one(run):
        pass
    return run.out.name
