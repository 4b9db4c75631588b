"""Results of experiments as small JSON files that can be kept, compared and put into tables."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from evnlos.config import to_dict
from evnlos.errors import DataError
from evnlos.evaluation import Evaluation, Scores
from evnlos.experiment.study import Record
from evnlos.files import write_atomically
from evnlos.migrate import migrate
from evnlos.progress import Progress, Step


def scores_of(evaluation: Evaluation) -> tuple[dict, dict, dict]:
    """Return scores, PSNR a position and baselines of an evaluation, as plain numbers by object."""

    def table(scores: Scores) -> dict[str, dict[str, float]]:
        names = [item.name for item in fields(scores) if getattr(scores, item.name) is not None]
        objects = evaluation.characters()
        means = {name: scores.mean(evaluation.names == name) for name in objects}
        return {metric: {name: float(means[name][metric] or 0.0) for name in objects} for metric in names}

    positions = {
        name: np.round(evaluation.scores.psnr_db[evaluation.names == name], 3).tolist()
        for name in evaluation.characters()
    }
    baselines = {name: table(scores) for name, scores in evaluation.baselines.items()}
    return table(evaluation.scores), positions, baselines


def keep_scores(blank: Record, evaluation: Evaluation, folder: Path, progress: Progress) -> Record:
    """Fill a record with an evaluation's scores, write it, tell of it, and return it."""
    scores, positions, baselines = scores_of(evaluation)
    record = replace(blank, scores=scores, positions=positions, baselines=baselines, checks=evaluation.checks)
    write_record(record, folder)
    progress(Step(f"score {record.name}", 1, 1, "networks", record))
    return record


def names_there(folder: Path) -> set[str]:
    """Return the names of the records that a folder holds; none where it is not there."""
    return {record.name for record in read_records(folder)} if any(folder.glob("*.json")) else set()


def write_record(record: Record, folder: Path) -> Path:
    """Write a record as `folder`/NAME.json and return the path."""
    path = folder / f"{record.name}.json"
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(to_dict(record), indent=1).encode())
    return path


def read_records(folder: str | Path) -> list[Record]:
    """Read all records below a folder, in the order of their names.

    Raises:
        DataError: The folder holds none, or a file is no record.
    """
    paths = sorted(Path(folder).rglob("*.json"))
    if not paths:
        raise DataError(f"{folder} holds no records; run `evnlos experiment` first")
    records = []
    for path in paths:
        try:
            records.append(Record(**migrate("Record", json.loads(path.read_text()))))
        except (ValueError, TypeError) as error:
            raise DataError(f"{path} is no record of an experiment: {error}") from None
    return records
