"""What a report shows: each run's evaluation, its training log, and what kind of training it was."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evnlos.dataset import Dataset, modality_order, open_dataset
from evnlos.errors import DataError
from evnlos.evaluation import Evaluation, available_lpips, evaluate
from evnlos.model import load_weights, published

METHODS = ("simulation only", "E2E", "EPNP")


@dataclass(frozen=True, eq=False)
class RunResult:
    """One trained network, evaluated.

    Args:
        name: The run's folder name, a weights file's stem, or the name of published weights.
        modality: Name of what it sees.
        sees_sequence: Whether it sees whole sequences.
        method: "simulation only" (pre-trained, no capture seen), "E2E" (captures alone) or "EPNP" (both).
        evaluation: Pictures and scores on the split.
        log: One record an epoch.
        history: The trainings behind the weights, oldest first.
        is_published: Whether the weights come with the package, by this name.
    """

    name: str
    modality: str
    sees_sequence: bool
    method: str
    evaluation: Evaluation
    log: list[dict[str, Any]]
    history: list[dict[str, Any]]
    is_published: bool = False

    @property
    def kind(self) -> str:
        """What is compared with its like: the modality, and whether whole sequences are seen."""
        return f"sequence {self.modality}" if self.sees_sequence else self.modality


def gather(runs: list[str | Path], data: str | Path, split: str = "test") -> tuple[Dataset, list[RunResult]]:
    """Evaluate runs on one split of a dataset, ordered by method and modality.

    Raises:
        DataError: No run is given, a run has not ended, or a run was trained on objects of the split.
    """
    if not runs:
        raise DataError("no runs given; name at least one run's folder")
    dataset = open_dataset(data)
    results = []
    for run in map(Path, runs):
        weights = load_weights(run)
        name, is_published = named(run)
        lines = _log_of(run)
        refuse_seen(weights.history, dataset, split)
        evaluation = evaluate(weights, dataset, split, available_lpips())
        kind = (weights.modality.name, weights.network.sees_sequence, method_of(weights.history))
        results.append(RunResult(name, *kind, evaluation, lines, weights.history, is_published))
    results.sort(key=lambda r: (METHODS.index(r.method), r.sees_sequence, modality_order(r.modality)))
    return dataset, results


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
    """Return what weights are called, without folders, and whether they come with the package.

    A run is called by its folder, also where its `weights.safetensors` is given; any other file by its stem.

    Example:
        >>> named(Path("runs/epnp/weights.safetensors")), named(Path("shared/mine.safetensors"))
        (('epnp', False), ('mine', False))
    """
    if not run.exists() and str(run) in published():
        return str(run), True
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
    """Return the objects of a split that a training behind the weights saw, by origin and name."""
    tested = set(dataset.objects(split))
    trained = [set(step["data"]["train"]) for step in history if step["data"]["origin"] == dataset.origin]
    return sorted(tested & set().union(*trained))
