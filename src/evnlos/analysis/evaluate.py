"""Evaluating a network on a dataset: metrics, baselines, and a check against memorized training objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from evnlos.analysis.confidence import ConfidenceCheck, check_confidence
from evnlos.analysis.scores import CHARACTERS, Perceptual, Scores, read_characters, score, score_once
from evnlos.config import to_dict
from evnlos.data import Dataset, Modality, NlosDataset, Sampling, character_of, read_shard, read_shard_index
from evnlos.errors import DataError
from evnlos.machine import Progress, Step, silent
from evnlos.metrics import psnr
from evnlos.models import FrameOperator, Weights, on_target_plane
from evnlos.models.confidence import SIDE, on_canvas
from evnlos.setups import Setup
from evnlos.setups.files import same_setup
from evnlos.types import Plane

_TOGETHER = 128  # samples compared at a time
_MOST_KEPT_BYTES = 1 << 26  # of what training objects would have shown, for the next network
_SMALLEST = 1e-3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Reconstructions beside the training objects of their dataset.

    Args:
        nearest: For each sample the true image of the training object whose measurement is most like its own,
            float32 [N, H, W]: the answer of pure memory, with no network and no physics.
        placed: The mean target of the training objects, drawn where the target is, float32 [N, H, W]: what the
            known motion alone tells.
        nearer_to_truth: Whether each reconstruction is nearer to the truth than to every training image,
            bool [N].
    """

    nearest: Tensor
    placed: Tensor
    nearer_to_truth: NDArray[np.bool_]


def compare_with_training(
    images: Tensor, samples: NlosDataset, dataset: Dataset, split: str
) -> Comparison | None:
    """Compare reconstructions with what each training object would have shown in their place.

    Each training object is represented by its sample nearest along the path; its true image is moved by what
    is left, in fractions of a pixel, and its input stays as it was measured. Measurements are compared by their
    mean square difference, each group of channels in units of its own spread in the training data. The objects
    are read one after the other, so that the memory does not depend on their number.

    Args:
        images: Reconstructions on the scored rows of the canvas, float32 [N, H, W], 0..1.
        samples: The samples of the split, in the same order.
        dataset: Where they are from.
        split: Their split: "test" or "validation".

    Returns:
        The comparison, or None where the motion of an object is unknown.

    Raises:
        DataError: The dataset has no training objects, or a shard is damaged.
    """
    names, rows = dataset.objects("train"), dataset.sampling.scored
    shards = [dataset.shard(name) for name in (*names, *dataset.objects(split))]
    stands = tuple((path, path.stat().st_mtime_ns if path.is_file() else 0) for path in shards)
    key = (samples.modality.name, split, dataset.config_hash, stands)
    if key not in _SHOWN:
        if len(_SHOWN) >= _MOST_SHOWN:
            _SHOWN.clear()
        _SHOWN[key] = _shown(samples, dataset, split)
    shown, truth = _SHOWN[key], samples.truth[:, rows].float()
    if shown is None:
        return None
    closest_db = torch.full((len(images),), -torch.inf)
    for part, moved in shown.moved or _moved(dataset, shown.nearest_of):
        closest_db[part] = torch.maximum(closest_db[part], psnr(images[part], moved))
    return Comparison(shown.nearest, shown.placed, (psnr(images, truth) > closest_db).numpy())


class _Shown(NamedTuple):
    """What of a comparison is the same for all images of a split; `moved` where it is small."""

    nearest: Tensor
    placed: Tensor
    nearest_of: list[tuple[Tensor, Tensor]]
    moved: list[tuple[Tensor, Tensor]]


_SHOWN: dict[tuple, _Shown | None] = {}  # of the last datasets and modalities
_MOST_SHOWN = 4


def _moved(dataset: Dataset, nearest_of: list[tuple[Tensor, Tensor]]) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield numbers of samples, and what each training object would have shown there, [n, H, W]."""
    for name, (step, away_m) in zip(dataset.objects("train"), nearest_of, strict=True):
        true = _read(dataset, name)[1]
        for part in torch.arange(len(step)).split(_TOGETHER):
            moved = _shifted(true[step[part]], away_m[part] / dataset.sampling.pitch_m)
            yield part, moved[:, dataset.sampling.scored]


def _shown(samples: NlosDataset, dataset: Dataset, split: str) -> _Shown | None:
    names, rows = dataset.objects("train"), dataset.sampling.scored
    tested = [read_shard_index(dataset.shard(name)).position_m for name in dataset.objects(split)]
    known = [where for name in names if (where := read_shard_index(dataset.shard(name)).position_m) is not None]
    if any(where is None for where in tested) or len(known) < len(names):
        return None
    at_m = np.concatenate([where for where in tested if where is not None])  # [N, 2]
    nearest_of = [_nearest(where, at_m) for where in known]
    spread, count = _Spread(samples.modality), len(at_m)
    target = torch.zeros(SIDE, SIDE)  # mean of the training objects
    difference = torch.empty(len(names), count, samples.modality.channels)  # mean squares, [G, N, C]
    for number, (name, (step, _), seen_m) in enumerate(zip(names, nearest_of, known, strict=True)):
        inputs, true = _read(dataset, name, samples.modality)
        target += on_target_plane(true, dataset.sampling.canvas, seen_m).mean(dim=(0, 1)) / len(names)
        for part in torch.arange(count).split(_TOGETHER):
            seen = inputs[step[part]]
            spread.add(seen)
            difference[number, part] = (seen - samples.inputs[part].float()).square().mean(dim=(2, 3))
    owner = (difference / spread.per_channel().square()).sum(dim=2).argmin(dim=0)  # [N]
    nearest = torch.empty_like(samples.truth[:, rows].float())
    for number in owner.unique().tolist():
        step, away_m = nearest_of[number]
        true = _read(dataset, names[number])[1]
        for chosen in torch.nonzero(owner == number)[:, 0].split(_TOGETHER):
            nearest[chosen] = _shifted(true[step[chosen]], away_m[chosen] / dataset.sampling.pitch_m)[:, rows]
    placed = on_canvas(target, dataset.sampling.canvas, at_m)[:, rows].contiguous()
    small = len(names) * nearest.nbytes <= _MOST_KEPT_BYTES
    return _Shown(nearest, placed, nearest_of, list(_moved(dataset, nearest_of)) if small else [])


class _Spread:
    """Spread of the inputs in each group of channels, from parts: standard deviation, or root mean square."""

    def __init__(self, modality: Modality) -> None:
        self._modality, self._count = modality, 0
        self._sum, self._squares = torch.zeros(2, modality.channels, dtype=torch.float64)

    def add(self, inputs: Tensor) -> None:
        """Take further inputs, [n, C, H, W]."""
        self._count += inputs[:, 0].numel()
        self._sum += inputs.sum(dim=(0, 2, 3), dtype=torch.float64)
        self._squares += inputs.square().sum(dim=(0, 2, 3), dtype=torch.float64)

    def per_channel(self) -> Tensor:
        """Return the spread of each channel's group, float32 [C]."""
        spread = torch.empty(self._modality.channels)
        for group in self._modality.groups:
            mine = self._modality.slices[group.name]
            mean = self._sum[mine].sum() / (self._count * group.channels) if group.centred else 0.0
            power = self._squares[mine].sum() / (self._count * group.channels)
            spread[mine] = float((power - mean**2).clamp_min(0).sqrt())
        return spread.clamp_min(_SMALLEST)


def _nearest(known_m: NDArray[np.float64], at_m: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    """Return the time step of a training object nearest to each place, [N], and the way left, metres [N, 2]."""
    away = at_m[:, None] - known_m  # [N, K, 2]
    step = np.square(away).sum(axis=2).argmin(axis=1)
    return torch.from_numpy(step), torch.from_numpy(away[np.arange(len(step)), step])


def _read(dataset: Dataset, name: str, modality: Modality | None = None) -> tuple[Tensor, Tensor]:
    """Return inputs [K, C, H, W] of a training object (none without a modality), and true images [K, H, W]."""
    samples, _ = read_shard(dataset.shard(name))
    if samples.truth is None:
        lacks = "has no truth (unknown target or motion)"
        raise DataError(f"{dataset.shard(name)} {lacks}, and {name} is learned from")
    inputs = torch.empty(0) if modality is None else modality.inputs(samples.frame, samples.surface)
    return inputs, torch.from_numpy(samples.truth)


def _shifted(images: Tensor, shift_px: Tensor) -> Tensor:
    """Move images [N, H, W] by (x, y) pixels [N, 2], bilinear, zero beyond the border."""
    count, height, width = images.shape
    moves = torch.eye(2, 3).repeat(count, 1, 1)
    moves[:, :, 2] = -shift_px.float() * 2 / torch.tensor([width, height])
    grid = F.affine_grid(moves, [count, 1, height, width], align_corners=False)
    return F.grid_sample(images[:, None].float(), grid, align_corners=False)[:, 0]


BASELINES = {
    "zero": "all-black",
    "mean": "mean image",
    "placed": "mean target at its place",
    "nearest": "nearest neighbour",
}
"""Heading of each baseline."""

CHECKS = {
    "read": "characters that an independent reader names correctly",
    "read_truth": "the same on the true images",
    "nearer_to_truth": "images nearer to the truth than to any training image",
}
"""Meaning of each check."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores and images of one network (or baseline) on one split.

    Args:
        images: Reconstructions on the scored canvas, float32 [N, H, W], 0..1.
        truth: True images, the same shape.
        names: Object of each image, [N].
        scores: Scores of each image.
        baselines: Scores of the all-black image ("zero"), of the mean training image ("mean"), of the mean
            target of the training objects where the target is ("placed"), and of the true image of the
            training object whose measurement is most like this one ("nearest").
        checks: Shares of the images: "read", whose character the independent reader names correctly;
            "read_truth", the same of the true images, its ceiling; "nearer_to_truth", which are nearer to
            the truth than to any training image. Only what could be found out.
        read_as: Object -> character -> how many of its images the reader takes for it; empty where nothing
            could be read.
        confidence_checks: What the network's confidence said of each sequence, beside what was true; empty
            where it has none, or a motion is unknown.
    """

    images: Tensor
    truth: Tensor
    names: np.ndarray
    scores: Scores
    baselines: dict[str, Scores]
    checks: dict[str, float] = field(default_factory=dict)
    read_as: dict[str, dict[str, int]] = field(default_factory=dict)
    confidence_checks: list[ConfidenceCheck] = field(default_factory=list)

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
            "read_as": self.read_as,
            "confidence": [to_dict(one) for one in self.confidence_checks],
        }


def evaluate(
    weights: Weights,
    dataset: Dataset,
    split: str = "test",
    perceptual: Perceptual | None = None,
    setup: Setup | None = None,
    progress: Progress = silent,
) -> Evaluation:
    """Reconstruct a split of a dataset and score it.

    The baseline "mean" is the mean of the true images that the network was trained on last.

    Args:
        weights: The network.
        dataset: Where the samples are.
        split: "train", "validation", "test" or "all".
        perceptual: LPIPS, where its weights are at hand.
        setup: The calibrated setup that the confidence asks how much of the frames the images explain;
            weights of events alone see no frames, and are not asked.
        progress: Called as each of three stages begins and as the last has ended.

    Raises:
        DataError: The split is empty, or its samples were made in another way than those of the training.
    """
    check_sampling(weights, dataset.sampling)
    samples = NlosDataset(dataset, split, weights.modality)
    progress(Step("evaluate", 0, 3, "stages", within=f"reconstruct {len(samples)} images"))
    network = weights.network.seeing(dataset.sampling)
    images = network.infer(samples.inputs, samples.position_m, samples.names)
    progress(Step("evaluate", 1, 3, "stages", within="scores and baselines"))
    found = assess(images, samples, dataset, split, weights.mean_image, perceptual)
    progress(Step("evaluate", 2, 3, "stages", within="confidence"))
    if weights.confidence is None or np.isnan(samples.position_m).any():
        progress(Step("evaluate", 3, 3, "stages"))
        return found
    canvas = dataset.sampling.canvas
    checks_frames = setup is not None and "frame" in weights.modality.slices
    operator = FrameOperator(setup, dataset.sampling) if setup is not None and checks_frames else None
    confidence_checks = check_confidence(network, weights.confidence, samples, images, canvas, operator)
    progress(Step("evaluate", 3, 3, "stages"))
    return replace(found, confidence_checks=confidence_checks)


def assess(
    images: Tensor,
    samples: NlosDataset,
    dataset: Dataset,
    split: str,
    mean_image: Tensor | None = None,
    perceptual: Perceptual | None = None,
) -> Evaluation:
    """Score any images of a split, whoever made them, beside the same baselines.

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
    checks, read_as = _reading(dataset, split, images, truth, samples.names)
    learned = dataset.split.get("train") and split in ("test", "validation")
    if learned and (found := compare_with_training(images, samples, dataset, split)) is not None:
        blank |= {"placed": found.placed, "nearest": found.nearest}
        checks["nearer_to_truth"] = round(float(found.nearer_to_truth.mean()), 4)
    baselines = {name: score_once(image, truth, perceptual) for name, image in blank.items()}
    scores = score(images, truth, perceptual)
    return Evaluation(images, truth, samples.names, scores, baselines, checks, read_as)


def _reading(
    dataset: Dataset, split: str, images: Tensor, truth: Tensor, names: np.ndarray
) -> tuple[dict[str, float], dict[str, dict[str, int]]]:
    """Return how often the reader names the character, of reconstructions and truth, and what it names."""
    answers = [character_of(name) for name in names]
    places = [read_shard(dataset.shard(name))[0].position_m for name in dataset.objects(split)]
    if not set(answers) <= set(CHARACTERS) or any(place is None for place in places):
        return {}, {}
    scored = Plane(dataset.sampling.scored_rows, dataset.sampling.width, dataset.sampling.pitch_m)
    position = np.concatenate([place for place in places if place is not None])
    found, named = {}, list[str]()
    for key, pictures in (("read_truth", truth), ("read", images)):
        named = read_characters(on_target_plane(pictures, scored, position))
        found[key] = round(float(np.mean([a == b for a, b in zip(named, answers, strict=True)])), 4)
    read_as: dict[str, dict[str, int]] = {}
    for (name, character), count in Counter(zip(names.tolist(), named, strict=True)).most_common():
        read_as.setdefault(name, {})[character] = count
    return found, read_as


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
        Images, float32 [N, H, W], 0..1.

    Raises:
        DataError: The weights see whole sequences, and the positions are unknown.
    """
    return weights.network.infer(weights.modality.inputs(frame, surface), position_m)


def check_sampling(weights: Weights, sampling: Sampling) -> None:
    """Refuse samples that were made in another way than those that a network was trained on.

    Args:
        weights: The network.
        sampling: How the samples were made.

    Raises:
        DataError: Names the settings that differ.
    """
    made_for, these = weights.sampling, sampling if weights.modality.needs_events else sampling.of_frames()
    # Only this surface is made through the setup, which may have been moved. Its maps are alike whether errors
    # are taken from them.
    is_known = not made_for.is_solved or same_setup(made_for.setup, these.setup)
    asked, these = replace(made_for, setup=these.setup) if is_known else made_for, these.shown_as(made_for)
    if not is_known or asked != these:
        differ = [name for name, value in vars(asked).items() if value != getattr(these, name)]
        trained, given = (", ".join(f"{n} {vars(s)[n] or 'none'}" for n in differ) for s in (asked, these))
        cure = " ".join(f"--sampling.{n.replace('_', '-')} {getattr(asked, n)}" for n in differ)
        what = f"the weights were trained on samples of {trained}, and these have {given}"
        raise DataError(f"{what}; make them alike: a dataset made with {cure}, or other weights")
