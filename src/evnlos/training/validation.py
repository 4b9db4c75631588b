"""What a training is watched by, and how confidence is learned from samples that it does not learn from.

- Learn the confidence in a network's pictures from sequences that it was not trained on.
- What a training is watched by: samples that it does not learn from.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import TensorDataset

from evnlos.data import Dataset, LiveDataset, Modality, NlosDataset
from evnlos.errors import DataError
from evnlos.metrics import psnr
from evnlos.models import Confidence, Reconstructor, Weights, halves_of, on_target_plane
from evnlos.models.confidence import COVERAGE, GROUPS, LEVELS
from evnlos.types import Plane, derive_seed

FALSE_ALARM = 0.05
"""Share of sequences of which nothing was measured that are taken for measured."""
FEWEST = 8
"""Sequences that confidence can be learned from, at least."""
_MIXED = 60  # sequences without an object


@torch.inference_mode()
def fit_confidence(network: Reconstructor, samples: NlosDataset, canvas: Plane) -> Confidence:
    """Learn the confidence in a network's pictures from sequences that it was not trained on.

    Agreement. With d what tells a target from the network's empty answer (`Confidence.telling`), the agreement
    is <d1, d2> / E|t|^2: d1 and d2 from the two halves of a sequence, t the same of true targets. For a network
    that answers with the expectation of the truth, whose empty answer is the mean target, the law of total
    variance makes it the share of the objects' variance that the measurement explains; noise that the halves do
    not share cancels. Empty answer and threshold come from sequences in which each position saw another object:
    a network of sequences draws the same for all of them, and that is no sign of any object.

    Intervals. The central 90 % of the true levels of a target plane's pixels for each level that the network
    gave (split conformal, Mondrian by level and by agreement: Vovk et al., Algorithmic Learning in a Random
    World, 2005), so that the coverage holds for sequences like these whatever the network is.

    Args:
        network: The network.
        samples: The sequences, each object's positions in the order of time.
        canvas: Geometry of the pictures.

    Raises:
        DataError: There are fewer than 8 sequences, or a motion is unknown.
    """
    names, position_m = samples.names, samples.position_m
    objects = list(dict.fromkeys(names.tolist()))
    if len(objects) < FEWEST:
        raise DataError(f"{len(objects)} sequences to learn confidence from; give at least {FEWEST}")
    halves, shown, true = [], [], []
    for name in objects:
        mine = np.flatnonzero(names == name)
        rows, at = torch.from_numpy(mine), position_m[mine]
        halves.append(halves_of(network, samples.inputs[rows], at, canvas))
        shown.append(on_target_plane(network.infer(samples.inputs[rows], at), canvas, at)[:, 0])
        true.append(on_target_plane(samples.truth[rows].float(), canvas, at)[:, 0])
    objects_true = torch.stack([one.mean(dim=0) for one in true])
    mean = objects_true.mean(dim=0)
    blank = Confidence(mean, torch.zeros_like(mean), *(torch.ones(()) for _ in range(5)))
    mixed = [halves_of(network, samples.inputs[rows], position_m[rows], canvas) for rows in _mixed(names)]
    blank = replace(blank, empty=blank.telling(torch.cat(mixed)).mean(dim=0).unflatten(0, mean.shape))
    blank = replace(blank, power=blank.telling(objects_true).square().sum(dim=1).mean())
    strange = torch.stack([blank.agreement(one) for one in mixed])
    agreement = torch.stack([blank.agreement(one) for one in halves])
    edges = torch.quantile(agreement, torch.arange(1, GROUPS) / GROUPS)
    group = torch.searchsorted(edges, agreement)
    ends = [_ends([(shown[k], true[k]) for k in torch.nonzero(group == g)[:, 0]]) for g in range(GROUPS)]
    low, high = (torch.stack([pair[k] for pair in ends]) for k in (0, 1))
    threshold = torch.quantile(strange, 1 - FALSE_ALARM)
    return replace(blank, threshold=threshold, edges=edges, low=low, high=high)


def _mixed(names: NDArray, count: int = _MIXED) -> list[NDArray[np.int64]]:
    """Return the rows of sequences in which each position is of another object; always the same."""
    sequences = [np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())]
    draw = np.random.default_rng(derive_seed(0, "mixed passes"))
    length = min(len(one) for one in sequences)
    return [
        np.array([sequences[i][k] for k, i in enumerate(draw.integers(0, len(sequences), length))])
        for _ in range(count)
    ]


def _ends(sequences: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Return the ends of the intervals for each level, [L] and [L], from pairs of targets shown and true."""
    shown = torch.cat([one.flatten() for one, _ in sequences])
    true = torch.cat([one.flatten() for _, one in sequences])
    bins = (shown * LEVELS).long().clamp(0, LEVELS - 1)
    low, high = torch.zeros(LEVELS), torch.ones(LEVELS)
    for level in range(LEVELS):
        here = true[bins == level].sort().values
        if len(here) < 1 / (1 - COVERAGE):
            continue  # too few to tell: from black to white
        # The finite-sample rank of split conformal prediction, on either side.
        rank = int(np.floor((len(here) + 1) * (1 - COVERAGE) / 2))
        low[level], high[level] = here[max(rank - 1, 0)], here[min(len(here) - rank, len(here) - 1)]
    return low, high


HeldOut = NlosDataset | TensorDataset


def held_out_samples(dataset: Dataset, modality: Modality, device: torch.device) -> HeldOut | None:
    """Return the samples to validate on, or None where the dataset holds none out."""
    if not dataset.split.get("validation"):
        return None
    if isinstance(dataset, LiveDataset):
        made = dataset.stream(dataset.objects("validation"), 0, modality, device)
        return TensorDataset(*(torch.cat(parts) for parts in zip(*made, strict=True)))
    return NlosDataset(dataset, "validation", modality)


@torch.inference_mode()
def validate(
    network: Reconstructor,
    held_out: HeldOut,
    dataset: Dataset,
    device: torch.device,
    half: bool,
) -> dict[str, Any]:
    """Return psnr_db, zero_db (an all-black picture's) and collapsed of the samples that are held out."""
    if isinstance(held_out, NlosDataset):
        inputs, truth = held_out.inputs, held_out.truth.float().cpu()
        places, names = held_out.position_m, held_out.names
    else:
        inputs, truth = held_out.tensors[0], held_out.tensors[1][:, 0].cpu()
        places = names = None
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        images = network.infer(inputs.to(device), places, names).float().cpu()
    images, truth = (part[:, dataset.sampling.scored] for part in (images, truth))
    score, blank = psnr(images, truth).mean().item(), psnr(torch.zeros_like(truth), truth).mean().item()
    # A network that has collapsed answers the same to every input.
    collapsed = bool(images.flatten(1).std(dim=0).mean() < 1e-3) if len(images) > 1 else False
    return {"psnr_db": round(score, 3), "zero_db": round(blank, 3), "collapsed": collapsed}


def confidence_of(
    network: Reconstructor, held_out: HeldOut | None, dataset: Dataset, start: Weights | None
) -> Confidence | None:
    """Return the confidence in the pictures: of the validation, or of the weights that this began with."""
    if isinstance(held_out, NlosDataset):
        is_known = not np.isnan(held_out.position_m).any()
        if is_known and len(dataset.objects("validation")) >= FEWEST:
            return fit_confidence(network, held_out, dataset.sampling.canvas)
    return start.confidence if start else None
