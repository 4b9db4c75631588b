"""Scores of an arm: each network, their ensemble, both after data consistency, and what needs no network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from evnlos.calibration import RIG_FILE
from evnlos.dataset import Dataset, NlosDataset, Sampling, as_modality, read_shard
from evnlos.evaluation import assess, available_lpips, check_sampling
from evnlos.evaluation.consistency import FrameOperator, consistent
from evnlos.experiment.records import keep_scores, names_there
from evnlos.experiment.study import Arm, Place, Record, Study
from evnlos.model import fit_linear, load_weights
from evnlos.progress import Progress
from evnlos.setups import load_setup

TRUST = 1.0
"""How far the frames may move the pictures of `+ consistency`: the variance that a probability itself has."""

ENSEMBLE = -1
"""Seed of a record that belongs to all seeds together."""


def score_arm(
    study: Study,
    arm: Arm,
    modality: str,
    runs: list[tuple[Path, dict[str, Any]]],
    made: Dataset | None,
    shots: Dataset,
    place: Place,
    progress: Progress,
) -> list[Record]:
    """Score what an arm gave, and return the new records; records that are there are kept.

    Args:
        study: The study.
        arm: The arm.
        modality: What its networks see.
        runs: Each seed's run and what decided it.
        made: The simulated dataset of the pre-training, where there is one.
        shots: The captures.
        place: Where records are kept.
        progress: Called with each new record.
    """
    folder = place.out / "records" / study.name
    there, new = names_there(folder), list[Record]()
    samples = NlosDataset(shots, study.split, modality)
    means = NlosDataset(shots, "train", modality).truth.float().mean(dim=0)
    refined = (
        study.refine
        and study.correct_pattern
        and "frame" in as_modality(modality).slices
        and arm.source == "calibrated"
    )

    def record(name: str, seed: int, settings: dict[str, Any]) -> Record:
        return Record(study.name, study.rig, name, modality, seed, study.split, {}, {}, {}, {}, settings)

    def score(blank: Record, images: Tensor, mean_image: Tensor | None) -> None:
        found = assess(images, samples, shots, study.split, mean_image, available_lpips())
        new.append(keep_scores(blank, found, folder, progress))

    def score_variants(images: Tensor, seed: int, settings: dict[str, Any], mean_image: Tensor | None) -> None:
        plain = record(arm.name, seed, settings)
        if plain.name not in there:
            score(plain, images, mean_image)
        moved = record(f"{arm.name} + consistency", seed, settings)
        if refined and moved.name not in there:
            score(moved, _consistent(study, arm, shots, place, images), mean_image)

    pictures = []
    for (run, settings), seed in zip(runs, study.seeds, strict=True):
        weights = load_weights(run)
        check_sampling(weights, shots.sampling)
        pictures.append(weights.network.infer(samples.inputs, samples.position_m, samples.names))
        score_variants(pictures[-1], seed, settings | {"run": run.name}, weights.mean_image)
    if len(runs) > 1:
        together = torch.stack(pictures).mean(dim=0)
        score_variants(together, ENSEMBLE, {"runs": [run.name for run, _ in runs]}, means)
    if study.name != "captures":
        return new
    for name, make in _without_network(study, arm, modality, samples, means, made, shots, place):
        blank = record(name, 0, {"captures": shots.folder.name})
        if blank.name not in there:
            score(blank, make(), means)
    return new


def _without_network(
    study: Study,
    arm: Arm,
    modality: str,
    samples: NlosDataset,
    mean_image: Tensor,
    made: Dataset | None,
    shots: Dataset,
    place: Place,
) -> Iterator[tuple[str, Callable[[], Tensor]]]:
    """Yield the baselines that belong to an arm, each with what makes its pictures: linear, classical."""
    if arm.pretraining is None:
        yield "linear, captures", lambda: _linear(shots, modality, samples)
    if arm.finetuning is None and made is not None:
        yield "linear, simulation", lambda: _linear(made, modality, samples)
        if modality == "frame":
            start = mean_image.expand(len(samples), -1, -1)
            yield "classical inversion", lambda: _consistent(study, arm, shots, place, start)


def _linear(data: Dataset, modality: str, samples: NlosDataset) -> Tensor:
    known = NlosDataset(data, "train", modality)
    return fit_linear(known.inputs, known.truth, known.names, modality=known.modality)(samples.inputs)


def _consistent(study: Study, arm: Arm, shots: Dataset, place: Place, images: Tensor) -> Tensor:
    """Return pictures of the scored split after data consistency with the calibrated rig."""
    operator = _operator(place.out / "rigs" / study.rig / RIG_FILE, arm.sampling)
    names = shots.objects(study.split)
    frames = torch.cat([torch.from_numpy(read_shard(shots.shard(name))[0].frame) for name in names])
    return consistent(images, frames, operator, TRUST)


@lru_cache(maxsize=2)
def _operator(rig: Path, sampling: Sampling) -> FrameOperator:
    return FrameOperator(load_setup(rig), sampling)
