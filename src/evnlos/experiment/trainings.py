"""The trainings of an experiment: one after the other, or several at a time on the cores of a CPU."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import torch

from evnlos.dataset import Dataset
from evnlos.dataset.pool import processes, run_tasks
from evnlos.progress import Progress, Step, silent
from evnlos.training import Training, choose_and_finetune, train


@dataclass(frozen=True)
class Run:
    """One training.

    Args:
        data: What it learns from.
        settings: How.
        out: Its folder.
        start: Run whose weights it starts from; None: random ones.
        alternatives: Further settings of a fine-tuning: captures held out choose the best of all, or none.
    """

    data: Dataset
    settings: Training
    out: Path
    start: Path | None = None
    alternatives: tuple[Training, ...] = ()


def train_one(run: Run, progress: Progress = silent) -> None:
    """Train what is not trained yet; `progress` is that of `train`."""
    if run.alternatives and run.start is not None:
        candidates = (run.settings, *run.alternatives)
        choose_and_finetune(run.data, candidates, run.out, run.start, progress=progress)
        return
    train(run.data, run.settings, run.out, run.start, progress)


def train_together(runs: list[Run], at_a_time: int, progress: Progress = silent) -> None:
    """Train several networks at a time.

    A network of this size gains little from a second core, so that as many trainings as there are cores, each
    with its share of them, take less time than one after the other. On a GPU nothing is done here: there they
    go one by one.

    Args:
        runs: The trainings; one that is named twice, or was done before, is done once.
        at_a_time: Trainings at a time; 0 = one for each core.
        progress: Called when the work begins and after each training, with its folder's name.
    """
    todo = {run.out: run for run in runs if not (run.out / "weights.safetensors").is_file()}
    if torch.cuda.is_available() or not todo:
        return
    progress(Step("train networks", 0, len(todo), "networks"))
    done = 0
    # Pre-training and end-to-end training first: fine-tuning begins where they end.
    for stage in (True, False):
        some = [run for run in todo.values() if (run.start is None) == stage]
        at_once = max(1, processes(at_a_time, len(some)))
        tasks = [(run, max(1, torch.get_num_threads() // at_once)) for run in some]
        with closing(run_tasks(_trained, tasks, at_once)) as finished:
            for name in finished:
                done += 1
                progress(Step("train networks", done, len(todo), "networks", name))


def _trained(task: tuple[Run, int]) -> str:
    """Train one network to the end, with so many threads, and return its folder's name."""
    run, threads = task
    torch.set_num_threads(threads)
    train_one(run)
    return run.out.name
