"""What a report shows, collected from its runs, as a table.

- What a report shows: each run's evaluation, its training log, and what kind of training it was.
- The table in the shape of the paper's: objects x (near, far) x modality x (E2E, EPNP), as rows and as CSV.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from evnlos.analysis import BASELINES, Evaluation, Scores, available_lpips, evaluate
from evnlos.data import Dataset, Sampling, character_of, modality_order, open_dataset
from evnlos.data.pool import run_tasks
from evnlos.errors import DataError
from evnlos.machine import Progress, Step, silent
from evnlos.models import load_weights, published
from evnlos.registry import todays_weights

METHODS = ("simulation only", "E2E", "EPNP")


@dataclass(frozen=True, eq=False)
class RunResult:
    """One trained network, evaluated.

    Args:
        name: The run's folder name, a weights file's stem, or the name of published weights.
        modality: Name of what it sees.
        sees_sequence: Whether it sees whole sequences.
        method: "simulation only" (pre-trained, no capture seen), "E2E" (captures alone) or "EPNP" (both).
        evaluation: Images and scores on the split.
        log: One record per epoch.
        history: The trainings behind the weights, oldest first.
        is_published: Whether the weights are pretrained ones of this name.
        sampling: Size and kind of the maps that it sees.
    """

    name: str
    modality: str
    sees_sequence: bool
    method: str
    evaluation: Evaluation
    log: list[dict[str, Any]]
    history: list[dict[str, Any]]
    is_published: bool = False
    sampling: Sampling = field(default_factory=Sampling)

    @property
    def kind(self) -> str:
        """What is compared with its like: the modality, and whether whole sequences are seen."""
        return f"sequence {self.modality}" if self.sees_sequence else self.modality


def collect_results(
    runs: list[str | Path],
    data: str | Path | Sequence[Path],
    split: str = "test",
    workers: int = 1,
    progress: Progress = silent,
) -> tuple[Dataset, list[RunResult]]:
    """Evaluate runs on one split of a dataset, ordered by method and modality.

    Args:
        runs: Folders of runs, weights files, or names of published weights.
        data: The dataset's folder; or one for each run, where they see other maps of the same recordings: the
            last one is returned.
        split: "train", "validation", "test" or "all".
        workers: Processes, each with a network at a time; 0 = one for each core.
        progress: Called when the work begins and after each network.

    Raises:
        DataError: No run is given, a run has not ended, or a run was trained on objects of the split.
    """
    if not runs:
        raise DataError("no runs given; name at least one run's folder")
    folders = [Path(data)] * len(runs) if isinstance(data, str | Path) else list(data)
    datasets = {folder: open_dataset(folder) for folder in dict.fromkeys(folders)}
    results: dict[int, RunResult] = {}
    tasks = [
        (number, Path(run), datasets[folder], split)
        for number, (run, folder) in enumerate(zip(runs, folders, strict=True))
    ]
    progress(Step("evaluate", 0, len(runs), "networks"))
    with closing(run_tasks(_evaluated, tasks, workers)) as finished:
        for number, result in finished:
            results[number] = result
            progress(Step("evaluate", len(results), len(runs), "networks", result.name))
    ordered = [results[number] for number in range(len(runs))]
    ordered.sort(key=lambda r: (METHODS.index(r.method), r.sees_sequence, modality_order(r.modality)))
    return datasets[folders[-1]], ordered


def _evaluated(task: tuple[int, Path, Dataset, str]) -> tuple[int, RunResult]:
    """Evaluate the run of a number."""
    number, run, dataset, split = task
    weights = load_weights(run)
    name, is_published = named(run)
    lines = _log_of(run)
    refuse_seen(weights.history, dataset, split)
    evaluation = evaluate(weights, dataset, split, available_lpips())
    kind = (weights.modality.name, weights.network.sees_sequence, method_of(weights.history))
    history, sampling = weights.history, weights.network.sampling
    return number, RunResult(name, *kind, evaluation, lines, history, is_published, sampling)


def _log_of(run: Path) -> list[dict[str, Any]]:
    """Return the training log beside a run's weights; a weights file of another name has none."""
    folder = run if run.is_dir() else run.parent
    log = folder / "metrics.jsonl"
    if not log.is_file() or not (run.is_dir() or run.stem == "weights"):
        return []
    try:
        return [_record(json.loads(line)) for line in log.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{log} is not a training log ({' '.join(str(error).split())[:160]}); delete it"
        ) from None


def _record(line: object) -> dict[str, Any]:
    """Return one epoch of a training log.

    Raises:
        ValueError: It is none, or its epoch or a score is no finite number.
    """
    if not isinstance(line, dict) or "epoch" not in line:
        raise ValueError("a line without an epoch")
    for name in ("epoch", "loss", "learning_rate", "seconds", "psnr_db", "zero_db"):
        value = line.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
            raise ValueError(f"{name} is {str(value)[:40]!r}")
    return line


def named(run: Path) -> tuple[str, bool]:
    """Return what weights are called, without folders, and whether they are pretrained ones.

    A run is called by its folder, also where its `weights.safetensors` is given; any other file by its stem.

    Example:
        >>> named(Path("runs/epnp/weights.safetensors")), named(Path("shared/mine.safetensors"))
        (('epnp', False), ('mine', False))
    """
    if not run.exists() and (name := todays_weights(str(run))) in published():
        return name, True
    run = run.resolve()
    if run.is_dir():
        return run.name, False
    return (run.parent.name if run.stem == "weights" else run.stem), False


def method_of(history: list[dict[str, Any]]) -> str:
    """Return what kind of training the weights went through, from their history."""
    origins = [step["data"]["origin"] for step in history]
    if "captures" not in origins:
        return "simulation only"
    return "EPNP" if "simulation" in origins else "E2E"


def refuse_seen(history: list[dict[str, Any]], dataset: Dataset, split: str) -> None:
    """Refuse to test on objects that a training saw.

    Args:
        history: The trainings that weights state.
        dataset: The objects to test on.
        split: Name of the split.

    Raises:
        DataError: Names an object that was trained on.
    """
    seen = seen_in_training(history, dataset, split)
    if split == "test" and seen:
        raise DataError(
            f"{seen[0]} of the split {split!r} was in the training data of these weights; "
            "hold it out, or evaluate another split"
        )


def seen_in_training(history: list[dict[str, Any]], dataset: Dataset, split: str) -> list[str]:
    """Return the objects of a split that a training behind the weights saw, by origin and name.

    Args:
        history: The trainings that weights state.
        dataset: The objects to test on.
        split: Name of the split.
    """
    tested = set(dataset.objects(split))
    steps = [step["data"] for step in history if step["data"]["origin"] == dataset.origin]
    trained = [set(data.get("train", ())) for data in steps]  # layers of many walls name no objects
    return sorted(tested & set().union(*trained))


METRICS = {
    "psnr_db": ("PSNR", "dB", 2),
    "psnr_box_db": ("PSNR in the box", "dB", 2),
    "ssim": ("SSIM", "", 3),
    "ms_ssim": ("MS-SSIM", "", 3),
    "haarpsi": ("HaarPSI", "", 3),
    "gmsd": ("GMSD", "", 3),
}
_SMALLER_IS_BETTER = ("gmsd", "lpips")


def columns_of(results: list[RunResult]) -> list[str]:
    """Return the headings of the table: baselines, then a column for each run."""
    baselines = list(baselines_of(results))
    return [*(BASELINES[name] for name in baselines), *(label(r) for r in results)]


def baselines_of(results: list[RunResult]) -> dict[str, Scores]:
    """Return the baselines of the last run: its mean image is that of captures, where any run saw some."""
    return results[-1].evaluation.baselines


def label(result: RunResult) -> str:
    """Return the heading of a run's column."""
    return f"{result.method} {result.kind}"


def rows_of(results: list[RunResult], metric: str) -> list[tuple[str, str, list[float | None]]]:
    """Return (group, character, values) for each object, then the mean of each group and of all.

    The group is the object's name before its last underscore, e.g. `near` of `near_G`.
    """
    first = results[0].evaluation
    tables = [*baselines_of(results).values(), *(r.evaluation.scores for r in results)]
    rows = []
    groups: dict[str, list[str]] = {}
    for name in first.characters():
        groups.setdefault(_group(name), []).append(name)
    for group, names in groups.items():
        rows += [
            (group, character_of(name), [t.mean(first.names == name)[metric] for t in tables]) for name in names
        ]
        chosen = np.isin(first.names, names)
        rows.append((group, "mean", [t.mean(chosen)[metric] for t in tables]))
    if len(groups) > 1:
        rows.append(("all", "mean", [t.mean()[metric] for t in tables]))
    return rows


def available_metrics(results: list[RunResult]) -> dict[str, tuple[str, str, int]]:
    """Return the metrics that every run has: name -> (title, unit, decimals)."""
    every = METRICS | {"lpips": ("LPIPS (VGG)", "", 3)}
    scores = [r.evaluation.scores for r in results]
    return {name: about for name, about in every.items() if all(getattr(s, name) is not None for s in scores)}


def to_csv(results: list[RunResult]) -> str:
    """Return all metrics of all objects as CSV: metric, group, character, one column a method.

    Args:
        results: Runs of one dataset.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["metric", "group", "character", *columns_of(results)])
    for metric in available_metrics(results):
        for group, character, values in rows_of(results, metric):
            writer.writerow([metric, group, character, *values])
    return buffer.getvalue()


def to_text(results: list[RunResult], metric: str = "psnr_db") -> str:
    """Return one metric's table as aligned text for a terminal.

    Args:
        results: Runs of one dataset.
        metric: Name of the metric.
    """
    decimals = METRICS[metric][2]
    body: list[list[str]] = [["", *columns_of(results)]]
    for group, character, values in rows_of(results, metric):
        body.append([f"{group} {character}", *("-" if v is None else f"{v:.{decimals}f}" for v in values)])
    widths = [max(len(row[i]) for row in body) for i in range(len(body[0]))]
    return "\n".join("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in body)


def larger_is_better(metric: str) -> bool:
    """Return whether a larger value of the metric is the better one."""
    return metric not in _SMALLER_IS_BETTER


def best_two(values: list[float | None], skip: int) -> tuple[int | None, int | None]:
    """Return the positions of the largest and second largest value behind the first `skip` ones."""
    ranked = [(v, i) for i, v in enumerate(values) if v is not None and i >= skip]
    order = [i for _, i in sorted(ranked, key=lambda pair: -pair[0])]
    return (order[0] if order else None), (order[1] if len(order) > 1 else None)


def _group(name: str) -> str:
    return name.rsplit("_", 1)[0] if "_" in name else "all"
