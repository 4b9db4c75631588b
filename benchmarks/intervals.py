"""Which interval of a pixel holds the truth, and which is the shortest that does?

    python benchmarks/intervals.py --weights RUN [RUN ...] --calibration DATASET --test DATASET [DATASET ...]

Six ways to give each pixel of a target an interval that shall hold its true level nine times in ten, all of
them set on the validation split of `--calibration`, which none of the networks was trained on, and scored on
`--test`:

    levels         our own: by the level that the network gave and the support of the sequence (`Confidence`)
    one width      one half-width for all pixels (split conformal)
    unsure         in proportion to sqrt(p (1 - p) + 0.003), p the network's level (normalised split conformal)
    ensemble       mean of the networks +- 1.645 standard deviations among them, as a Gaussian would have it
    ensemble, set  the same in proportion to that deviation (normalised split conformal)
    quantiles      a small network that learns the 5 % and the 95 % point from the images around a pixel
                   (pinball loss), moved to cover (conformalised quantile regression: Romano et al., 2019)

Coverage and mean length; then the interval score (Gneiting and Raftery, JASA 2007), the length plus 20 times
what the truth is outside by, of which less is better. The ensemble's intervals stand around the mean of its
images, all others around the first network's.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from evnlos.data import NlosDataset, open_dataset
from evnlos.models import Confidence, Weights, halves_of, load_weights, on_target_plane
from evnlos.models.confidence import COVERAGE, fit_confidence

_GAUSSIAN = 1.645  # standard deviations that hold nine tenths
_FLOOR = 0.003  # of the variance of an unsure pixel, as data consistency has it
_SAME = 0.005  # deviation among networks that happen to agree
_STEPS, _TARGETS = 1500, 32  # of the training of the network of quantiles: steps, targets per step
Interval = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Seen:
    """Targets of some sequences.

    Args:
        drawn: What the networks drew, [E, N, 32, 32], 0..1.
        true: The truth, [N, 32, 32], 0..1.
        owner: Sequence of each target, [N].
        halves: What the halves of each sequence show to the first network, [P, 2, 32, 32].
    """

    drawn: Tensor
    true: Tensor
    owner: Tensor
    halves: Tensor


@torch.inference_mode()
def look(networks: list[Weights], folder: Path, split: str) -> Seen:
    """Return what the networks make of a dataset."""
    dataset = open_dataset(folder)
    data = NlosDataset(dataset, split, networks[0].modality)
    canvas, at = dataset.sampling.canvas, data.position_m
    drawn = [
        on_target_plane(one.network.infer(data.inputs, at, data.names), canvas, at)[:, 0].clamp(0, 1)
        for one in networks
    ]
    names = list(dict.fromkeys(data.names.tolist()))
    rows = [np.flatnonzero(data.names == name) for name in names]
    halves = [halves_of(networks[0].network, data.inputs[mine], at[mine], canvas) for mine in rows]
    owner = torch.from_numpy(np.array([names.index(name) for name in data.names]))
    true = on_target_plane(data.truth.float(), canvas, at)[:, 0].clamp(0, 1)
    return Seen(torch.stack(drawn), true, owner, torch.stack(halves))


def rank(scores: Tensor) -> float:
    """Return the least score that nine tenths of new ones stay below (split conformal, finite sample)."""
    ordered = scores.flatten().sort().values
    return float(ordered[min(int(np.ceil((len(ordered) + 1) * COVERAGE)), len(ordered)) - 1])


def scaled(
    seen: Seen, middle: Callable[[Seen], Tensor], scale: Callable[[Seen], Tensor]
) -> Callable[[Seen], Interval]:
    """Return middle +- q scale, with q from the calibration sequences."""
    q = rank((seen.true - middle(seen)).abs() / scale(seen))
    return lambda new: (middle(new) - q * scale(new), middle(new) + q * scale(new))


def by_levels(confidence: Confidence, new: Seen) -> Interval:
    """Return our own intervals, whatever the verdict on the sequence is."""
    willing = replace(confidence, threshold=torch.tensor(-torch.inf))
    low, high = torch.zeros_like(new.true), torch.ones_like(new.true)
    for k, halves in enumerate(new.halves):
        mine = new.owner == k
        said = willing.judge(new.drawn[0, mine], halves)
        low[mine], high[mine] = said.low, said.high
    return low, high


class Quantiles(nn.Module):
    """The 5 % and the 95 % point of a pixel's level, from the image around it and that of the sequence."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.Conv2d(2, width, 3, padding=1), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1), nn.SiLU()),
            *(nn.Conv2d(width, width, 3, padding=1), nn.SiLU(), nn.Conv2d(width, 2, 3, padding=1)),
        )

    def forward(self, picture: Tensor, of_sequence: Tensor) -> Interval:
        """Return both ends [N, 32, 32] for an image and the mean image of its sequence."""
        away = self.layers(torch.stack([picture, of_sequence], dim=1))
        middle = torch.logit(picture.clamp(0.01, 0.99)) + away[:, 0]
        spread = nn.functional.softplus(away[:, 1])
        return torch.sigmoid(middle - spread), torch.sigmoid(middle + spread)


def of_sequences(seen: Seen) -> Tensor:
    """Return the mean target of each image's sequence, [N, 32, 32]."""
    sequences = torch.stack([seen.drawn[0, seen.owner == k].mean(dim=0) for k in range(len(seen.halves))])
    return sequences[seen.owner]


def learned_quantiles(seen: Seen) -> Callable[[Seen], Interval]:
    """Train on half of the calibration sequences and move the ends to cover on the other half."""
    torch.manual_seed(0)
    network = Quantiles()
    optimiser = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, _STEPS)
    to_learn, average = torch.nonzero(seen.owner % 2 == 0)[:, 0], of_sequences(seen)
    for _ in range(_STEPS):
        some = to_learn[torch.randint(len(to_learn), (_TARGETS,))]
        loss = torch.zeros(())
        for end, share in zip(network(seen.drawn[0, some], average[some]), (0.05, 0.95), strict=True):
            miss = seen.true[some] - end
            loss = loss + torch.maximum(share * miss, (share - 1) * miss).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()

    @torch.inference_mode()
    def ends(new: Seen) -> Interval:
        parts = zip(new.drawn[0].split(200), of_sequences(new).split(200), strict=True)
        low, high = zip(*(network(*part) for part in parts), strict=True)
        return torch.cat(low), torch.cat(high)

    rest = seen.owner % 2 == 1
    low, high = (end[rest] for end in ends(seen))
    moved = rank(torch.maximum(low - seen.true[rest], seen.true[rest] - high))

    def covering(new: Seen) -> Interval:
        low, high = ends(new)
        return low - moved, high + moved

    return covering


def methods(networks: list[Weights], calibration: Path) -> dict[str, Callable[[Seen], Interval]]:
    """Return all ways to make intervals, set on the validation split of a dataset."""
    seen, dataset = look(networks, calibration, "validation"), open_dataset(calibration)
    data = NlosDataset(dataset, "validation", networks[0].modality)
    confidence = fit_confidence(networks[0].network, data, dataset.sampling.canvas)

    def first(one: Seen) -> Tensor:
        return one.drawn[0]

    def unsure(one: Seen) -> Tensor:
        return (one.drawn[0] * (1 - one.drawn[0]) + _FLOOR).sqrt()

    found = {
        "levels": lambda new: by_levels(confidence, new),
        "one width": scaled(seen, first, lambda one: torch.ones_like(one.true)),
        "unsure": scaled(seen, first, unsure),
        "quantiles": learned_quantiles(seen),
    }
    if len(networks) > 1:

        def mean(one: Seen) -> Tensor:
            return one.drawn.mean(dim=0)

        def deviation(one: Seen) -> Tensor:
            return one.drawn.std(dim=0) + _SAME

        found["ensemble"] = lambda new: (
            mean(new) - _GAUSSIAN * deviation(new),
            mean(new) + _GAUSSIAN * deviation(new),
        )
        found["ensemble, set"] = scaled(seen, mean, deviation)
    return found


def figures(new: Seen, interval: Interval) -> tuple[float, float, float, float]:
    """Return coverage, the coverage that nine sequences in ten have, mean length, and interval score."""
    low, high = (end.clamp(0, 1) for end in interval)
    held = (new.true >= low - 1e-3) & (new.true <= high + 1e-3)
    sequences = [float(held[new.owner == k].float().mean()) for k in range(len(new.halves))]
    beyond = (low - new.true).clamp_min(0) + (new.true - high).clamp_min(0)
    score = (high - low) + 2 / (1 - COVERAGE) * beyond
    return (
        float(np.mean(sequences)),
        float(np.quantile(sequences, 0.1)),
        float((high - low).mean()),
        float(score.mean()),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Intervals of pixels, compared.")
    parser.add_argument(
        "--weights", type=Path, nargs="+", required=True, help="runs; the first is the one judged"
    )
    parser.add_argument("--calibration", type=Path, required=True, help="simulation that they were trained on")
    parser.add_argument("--test", type=Path, nargs="+", required=True, help="datasets with truth")
    asked = parser.parse_args()
    networks = [load_weights(one) for one in asked.weights]
    ways = methods(networks, asked.calibration)
    print(
        "| set | way | coverage | nine sequences in ten | length | interval score |\n|---|---|---|---|---|---|"
    )
    for folder in asked.test:
        new = look(networks, folder, "test" if open_dataset(folder).split.get("test") else "all")
        for name, way in ways.items():
            held, most, length, score = figures(new, way(new))
            print(
                f"| {folder.name} | {name} | {held:.0%} | {most:.0%} | {length:.3f} | {score:.3f} |", flush=True
            )


if __name__ == "__main__":
    main()
