"""A network on a dataset: metrics a character and overall, with the baselines beside them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from evnlos.config import to_dict
from evnlos.dataset import (
    Dataset,
    NlosDataset,
    Sampling,
    character_of,
    read_shard,
)
from evnlos.errors import DataError
from evnlos.evaluation.classifier import CHARACTERS, read_characters
from evnlos.evaluation.consistency import FrameOperator
from evnlos.evaluation.memory import compare_with_training
from evnlos.evaluation.score import Perceptual, Scores, score
from evnlos.evaluation.worth import PassWorth, worth_of
from evnlos.model import Weights, plates
from evnlos.setups import Setup
from evnlos.types import Plane

BASELINES = {"zero": "all-black", "mean": "mean image", "nearest": "nearest shot"}
"""Heading of each baseline."""

CHECKS = {
    "read": "characters that an independent reader names rightly",
    "read_truth": "the same on the true pictures",
    "nearer_to_truth": "pictures nearer to the truth than to any training picture",
}
"""Meaning of each check."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores and pictures of one network (or baseline) on one split.

    Args:
        images: Reconstructions on the scored canvas, float32 [N, H, W], 0..1.
        truth: True pictures, the same shape.
        names: Object of each picture, [N].
        scores: Scores of each picture.
        baselines: Scores of the all-black picture ("zero"), of the mean training picture ("mean"), and of the
            true picture of the training object whose measurement is most like this one ("nearest").
        checks: Shares of the pictures: "read", whose character the independent reader names rightly;
            "read_truth", the same of the true pictures, its ceiling; "nearer_to_truth", which are nearer to
            the truth than to any training picture. Only what could be found out.
        worth: What the network's confidence said of each pass, beside what was true; empty where it has none,
            or a motion is unknown.
    """

    images: Tensor
    truth: Tensor
    names: np.ndarray
    scores: Scores
    baselines: dict[str, Scores]
    checks: dict[str, float] = field(default_factory=dict)
    worth: list[PassWorth] = field(default_factory=list)

    def characters(self) -> list[str]:
        """Return the objects in the order of the dataset."""
        return list(dict.fromkeys(self.names.tolist()))

    def summary(self) -> dict[str, Any]:
        """Return metrics overall and an object, for network and baselines, as plain numbers."""

        def table(scores: Scores) -> dict[str, Any]:
            objects = {
                name: {"character": character_of(name), **scores.mean(self.names == name)}
                for name in self.characters()
            }
            return {"overall": scores.mean(), "characters": objects}

        return {
            "images": len(self.images),
            **table(self.scores),
            "baselines": {name: table(scores) for name, scores in self.baselines.items()},
            "checks": self.checks,
            "confidence": [to_dict(one) for one in self.worth],
        }


def evaluate(
    weights: Weights,
    dataset: Dataset,
    split: str = "test",
    perceptual: Perceptual | None = None,
    setup: Setup | None = None,
) -> Evaluation:
    """Reconstruct a split of a dataset and score it.

    The baseline "mean" is the mean of the true pictures that the network was trained on last.

    Args:
        weights: The network.
        dataset: Where the samples are.
        split: "train", "validation", "test" or "all".
        perceptual: LPIPS, where its weights are at hand.
        setup: The calibrated setup that the confidence asks how much of the frames the pictures explain;
            weights of events alone see no frames, and are not asked.

    Raises:
        DataError: The split is empty, or its samples were made in another way than those of the training.
    """
    check_sampling(weights, dataset.sampling)
    samples = NlosDataset(dataset, split, weights.modality)
    images = weights.network.infer(samples.inputs, samples.position_m, samples.names)
    found = assess(images, samples, dataset, split, weights.mean_image, perceptual)
    if weights.confidence is None or np.isnan(samples.position_m).any():
        return found
    canvas = dataset.sampling.canvas
    checks_frames = setup is not None and "frame" in weights.modality.slices
    operator = FrameOperator(setup, dataset.sampling) if setup is not None and checks_frames else None
    worth = worth_of(weights.network, weights.confidence, samples, images, canvas, operator)
    return replace(found, worth=worth)


def assess(
    images: Tensor,
    samples: NlosDataset,
    dataset: Dataset,
    split: str,
    mean_image: Tensor | None = None,
    perceptual: Perceptual | None = None,
) -> Evaluation:
    """Score any pictures of a split, whoever made them, beside the same baselines.

    Args:
        images: Reconstructions on the whole canvas, float32 [N, H, W], 0..1, in the order of `samples`.
        samples: The samples of the split.
        dataset: Where they are from.
        split: "train", "validation", "test" or "all".
        mean_image: The baseline "mean", [H, W]; None leaves it out.
        perceptual: LPIPS, where its weights are at hand.
    """
    rows = dataset.sampling.scored
    truth = samples.truth.float()[:, rows].contiguous()
    images = images[:, rows].contiguous()
    blank = {"zero": torch.zeros_like(truth)}
    if mean_image is not None:
        blank["mean"] = mean_image.float()[rows].expand_as(truth).contiguous()
    checks = _reading(dataset, split, images, truth, samples.names)
    learned = dataset.split.get("train") and split in ("test", "validation")
    if learned and (found := compare_with_training(images, samples, dataset, split)) is not None:
        blank["nearest"] = found.nearest
        checks["nearer_to_truth"] = round(float(found.nearer_to_truth.mean()), 4)
    baselines = {name: score(image, truth, perceptual) for name, image in blank.items()}
    return Evaluation(images, truth, samples.names, score(images, truth, perceptual), baselines, checks)


def _reading(
    dataset: Dataset, split: str, images: Tensor, truth: Tensor, names: np.ndarray
) -> dict[str, float]:
    """Return how often the independent reader names the character, on reconstructions and on the truth."""
    answers = [character_of(name) for name in names]
    places = [read_shard(dataset.shard(name))[0].position_m for name in dataset.objects(split)]
    if not set(answers) <= set(CHARACTERS) or any(place is None for place in places):
        return {}
    scored = Plane(dataset.sampling.scored_rows, dataset.sampling.width, dataset.sampling.pitch_m)
    position = np.concatenate([place for place in places if place is not None])
    found = {}
    for key, pictures in (("read", images), ("read_truth", truth)):
        read = read_characters(plates(pictures, scored, position))
        found[key] = round(float(np.mean([a == b for a, b in zip(read, answers, strict=True)])), 4)
    return found


def reconstruct(
    weights: Weights, frame: np.ndarray, surface: np.ndarray, position_m: np.ndarray | None = None
) -> Tensor:
    """Reconstruct samples, also those without a truth.

    Args:
        weights: The network.
        frame: Frames, float32 [N, H, W], 0..1, as in `Samples`.
        surface: Time surfaces, float32 [N, 2, H, W].
        position_m: The target's centre, (x, y) in metres, [N, 2], which weights of whole sequences need.

    Returns:
        Pictures, float32 [N, H, W], 0..1.

    Raises:
        DataError: The weights see whole sequences, and the positions are unknown.
    """
    return weights.network.infer(weights.modality.inputs(frame, surface), position_m)


def check_sampling(weights: Weights, sampling: Sampling) -> None:
    """Refuse samples that were made in another way than those that a network was trained on.

    Raises:
        DataError: Names the settings that differ.
    """
    if weights.sampling != sampling:
        raise DataError(
            f"the weights were trained on samples of {weights.sampling}; these are {sampling}: make them alike"
        )
