"""Scores of an arm: each network, their ensemble, both after data consistency, and what needs no network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from evnlos.config import load_yaml
from evnlos.dataset import Dataset, NlosDataset, Paradigm, Sampling, Simulation, read_shard
from evnlos.evaluation import Evaluation, assess, available_lpips, check_sampling, infer
from evnlos.evaluation.consistency import FrameOperator, consistent
from evnlos.evaluation.linear import fit_linear
from evnlos.experiment.records import read_records, scores_of, write_record
from evnlos.experiment.study import Arm, Place, Record, Step, Study
from evnlos.model import load_weights

TRUST = 1.0
"""How far the frames may move the pictures of `+ consistency`: the variance that a probability itself has."""

ENSEMBLE = -1
"""Seed of a record that belongs to all seeds together."""


def score_arm(
    study: Study,
    arm: Arm,
    paradigm: Paradigm,
    runs: list[tuple[Path, dict[str, Any]]],
    made: Dataset | None,
    shots: Dataset,
    place: Place,
) -> Iterator[Step]:
    """Score what an arm gave, yielding a step with each new record; records that are there are kept.

    Args:
        study: The study.
        arm: The arm.
        paradigm: What its networks see.
        runs: Each seed's run and what decided it.
        made: The simulated dataset of the pre-training, where there is one.
        shots: The captures.
        place: Where records are kept.
    """
    folder = place.out / "records" / study.name
    there = {record.name for record in read_records(folder)} if any(folder.glob("*.json")) else set()
    samples = NlosDataset(shots, study.split, paradigm)
    means = NlosDataset(shots, "train", paradigm).truth.float().mean(dim=0)
    refined = study.refine and study.correct_pattern and paradigm != "event" and arm.source == "calibrated"

    def record(name: str, seed: int, settings: dict[str, Any]) -> Record:
        return Record(study.name, study.rig, name, paradigm, seed, study.split, {}, {}, {}, {}, settings)

    def scored(blank: Record, images: Tensor, mean_image: Tensor | None) -> Step:
        found = assess(images, samples, shots, study.split, paradigm, mean_image, available_lpips())
        return _written(blank, found, folder)

    def variants(name: str, images: Tensor) -> Iterator[tuple[str, Tensor]]:
        yield name, images
        if refined:
            operator = _operator(place.out / "rigs" / study.rig / "rig.yaml", arm.sampling)
            yield f"{name} + consistency", consistent(images, _frames(shots, study.split), operator, TRUST)

    pictures = []
    for (run, settings), seed in zip(runs, study.seeds, strict=True):
        weights = load_weights(run)
        check_sampling(weights, shots.sampling)
        pictures.append(infer(weights.network, samples.inputs))
        for name, images in variants(arm.name, pictures[-1]):
            blank = record(name, seed, settings | {"run": run.name})
            if blank.name not in there:
                yield scored(blank, images, weights.mean_image)
    if len(runs) > 1:
        for name, images in variants(arm.name, torch.stack(pictures).mean(dim=0)):
            blank = record(name, ENSEMBLE, {"runs": [run.name for run, _ in runs]})
            if blank.name not in there:
                yield scored(blank, images, means)
    for name, images in _without_network(study, arm, paradigm, samples, means, made, shots, place, there):
        yield scored(record(name, 0, {"captures": shots.folder.name}), images, means)


def _without_network(
    study: Study,
    arm: Arm,
    paradigm: Paradigm,
    samples: NlosDataset,
    mean_image: Tensor,
    made: Dataset | None,
    shots: Dataset,
    place: Place,
    there: set[str],
) -> Iterator[tuple[str, Tensor]]:
    """Yield name and pictures of the baselines that belong to an arm: linear estimates, classical inversion."""
    if study.name != "captures":
        return
    prefix = f"{study.rig}-{study.split}"
    if arm.pretraining is None and f"{prefix}-linear-captures-{paradigm}-seed0" not in there:
        yield "linear, captures", _linear(shots, paradigm, samples)
    if arm.finetuning is None and made is not None:
        if f"{prefix}-linear-simulation-{paradigm}-seed0" not in there:
            yield "linear, simulation", _linear(made, paradigm, samples)
        if paradigm == "frame" and f"{prefix}-classical-inversion-frame-seed0" not in there:
            operator = _operator(place.out / "rigs" / study.rig / "rig.yaml", arm.sampling)
            start = mean_image.expand(len(samples), -1, -1)
            yield "classical inversion", consistent(start, _frames(shots, study.split), operator, TRUST)


def _linear(data: Dataset, paradigm: Paradigm, samples: NlosDataset) -> Tensor:
    known = NlosDataset(data, "train", paradigm)
    return fit_linear(known.inputs, known.truth, known.names)(samples.inputs)


def _written(blank: Record, found: Evaluation, folder: Path) -> Step:
    scores, positions, baselines = scores_of(found)
    record = replace(blank, scores=scores, positions=positions, baselines=baselines, checks=found.checks)
    write_record(record, folder)
    return Step(f"score {record.name}", 1, 1, record)


@lru_cache(maxsize=2)
def _operator(rig: Path, sampling: Sampling) -> FrameOperator:
    return FrameOperator(load_yaml(Simulation, rig), sampling)


def _frames(shots: Dataset, split: str) -> Tensor:
    return torch.cat([torch.from_numpy(read_shard(shots.shard(n))[0].frame) for n in shots.objects(split)])
