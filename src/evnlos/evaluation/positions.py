"""How the image of a sequence network grows with the number of positions that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from evnlos.dataset import Dataset, NlosDataset
from evnlos.errors import DataError
from evnlos.evaluation.evaluate import check_sampling
from evnlos.metrics import psnr
from evnlos.model import Weights

_MOST_SUBSETS = 8


@dataclass(frozen=True)
class PositionsPoint:
    """Scores of a sequence network that saw a part of each pass.

    Args:
        positions: Positions that it saw.
        subsets: Choices of so many positions that the scores are a mean over, at most.
        psnr_db: Mean PSNR over the pictures of all positions of the split, the scored canvas, dB.
        objects: The same of each object, dB.
    """

    positions: int
    subsets: int
    psnr_db: float
    objects: dict[str, float]


@torch.inference_mode()
def curve_over_positions(
    weights: Weights, dataset: Dataset, split: str = "test", counts: tuple[int, ...] = (1, 2, 5, 10, 20, 40)
) -> list[PositionsPoint]:
    """Reconstruct each pass from some of its positions and score the picture at all of them.

    The choices of n of N positions are equally spaced: begun at the first, the second and so on, up to 8
    choices spread over the N // n that there are. What is scored is the same for every n: the picture drawn
    at all N positions, whose places are known.

    Args:
        weights: Those of a network of whole sequences.
        dataset: Where the samples are.
        split: "train", "validation", "test" or "all".
        counts: Numbers of positions, each from 1 to the positions of a pass.

    Raises:
        DataError: The network sees single time steps, the motion of an object is unknown, a count is more than
            a pass has, or the samples were made in another way than those of the training.
    """
    network = weights.network
    if not network.sees_sequence:
        raise DataError(
            "these weights see single time steps; give those of a network of whole sequences (train with "
            "--network.kind sequence)"
        )
    check_sampling(weights, dataset.sampling)
    samples = NlosDataset(dataset, split, weights.modality)
    if np.isnan(samples.position_m).any():
        raise DataError("the motion of an object is unknown; give it in capture.yaml (`evnlos track` finds it)")
    passes = {name: np.flatnonzero(samples.names == name) for name in dict.fromkeys(samples.names.tolist())}
    # All of them before the first reconstruction, so that a count that is too large costs no time.
    chosen = {count: {name: choices(len(mine), count) for name, mine in passes.items()} for count in counts}
    network.eval()
    rows = dataset.sampling.scored
    found = []
    for count, parts_of in chosen.items():
        means = {}
        for name, mine in passes.items():
            places = torch.from_numpy(samples.position_m[mine].astype(np.float32))
            inputs, truth = (part[torch.from_numpy(mine)].float() for part in (samples.inputs, samples.truth))
            decibel = []
            for part in parts_of[name]:
                some = torch.from_numpy(part)
                drawn = network.draw(inputs[some], places[some], places)
                decibel.append(psnr(drawn[:, rows].contiguous(), truth[:, rows].contiguous()).mean())
            means[name] = float(torch.stack(decibel).mean())
        subsets = max(len(parts) for parts in parts_of.values())
        found.append(PositionsPoint(count, subsets, float(np.mean(list(means.values()))), means))
    return found


def choices(positions: int, count: int) -> list[np.ndarray]:
    """Return up to 8 choices of `count` equally spaced ones of `positions`.

    Raises:
        DataError: There are not so many.

    Example:
        >>> [part.tolist() for part in choices(6, 3)]
        [[0, 2, 4], [1, 3, 5]]
    """
    if not 1 <= count <= positions:
        raise DataError(f"{count} positions are asked for; a pass has {positions}: give 1 to {positions}")
    stride = positions // count
    starts = np.unique(np.linspace(0, stride - 1, min(stride, _MOST_SUBSETS)).round().astype(int))
    return [start + stride * np.arange(count) for start in starts]
