"""Confidence: how much of a reconstruction the measurement supports, pixel by pixel and as a whole.

- The confidence in an image: how much of it the measurement supports, and where each pixel's level lies.
- How it is learned from sequences that the network was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.data import NlosDataset
from evnlos.errors import DataError
from evnlos.models.reconstructor import Reconstructor
from evnlos.types import Plane, derive_seed, target_side_m

SIDE = 32
"""Side of a target plane's image, pixels."""


def on_target_plane(images: Tensor, canvas: Plane, position_m: ArrayLike) -> Tensor:
    """Return the part of each image that shows the target, resampled to 32 x 32.

    Args:
        images: Images of the canvas, float [N, H, W].
        canvas: Their geometry.
        position_m: Centre (x, y) of the target in each image, [N, 2], metres.

    Returns:
        float32 [N, 1, 32, 32]; zero outside the canvas.
    """
    size_m = target_side_m(canvas)
    centre = torch.as_tensor(np.asarray(position_m), dtype=torch.float32)  # [N, 2]
    span = torch.tensor([canvas.width, canvas.height]) * (canvas.pitch_m / 2)
    ticks = (torch.arange(SIDE) + 0.5) / SIDE * size_m - size_m / 2
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    middle = torch.tensor(canvas.center_m, dtype=torch.float32)
    points = torch.stack([x, y], dim=-1) + (centre - middle)[:, None, None]  # [N, 32, 32, 2]
    return F.grid_sample(images[:, None].float(), points / span, align_corners=False)


def on_canvas(target: Tensor, canvas: Plane, position_m: ArrayLike, size_m: float | None = None) -> Tensor:
    """Return images of the canvas that show one target at each position; `on_target_plane` takes it out
    again.

    Args:
        target: Image of the target, float [P, P].
        canvas: Geometry of the images.
        position_m: Centre (x, y) of the target in each image, [N, 2], metres.
        size_m: Side of the target plane, metres; None: that which the canvas is made for.

    Returns:
        float32 [N, H, W]; zero beside the target plane.
    """
    size_m = target_side_m(canvas) if size_m is None else size_m
    centre = torch.as_tensor(position_m, dtype=torch.float32, device=target.device)
    y, x = (torch.from_numpy(at).float().to(target.device) for at in (canvas.y_m, canvas.x_m))
    place = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1)  # [H, W, 2]
    grid = (place - centre[:, None, None]) / (size_m / 2)
    return F.grid_sample(target.float().expand(len(grid), 1, -1, -1), grid, align_corners=False)[:, 0]


COVERAGE = 0.9
"""Share of a target plane's pixels whose true level the intervals are to hold."""
CONFIRMED = 0.7
"""Share of the frames that images have to explain where the setup is known (see
`ConfidenceReport.explained`).
"""
LEVELS = 16
"""Bins of a pixel's reconstructed level."""
GROUPS = 3
"""Groups of sequences, by agreement, with intervals of their own."""


@dataclass(frozen=True)
class ConfidenceReport:
    """How much of one sequence's images to believe.

    Args:
        agreement: Share of what tells this object from the average one that both halves of the sequence agree
            on: 1 = all that objects differ by, 0 = nothing.
        threshold: Agreement that one in 20 sequences shows in which each position saw another object, so that
            nothing of any one object was measured.
        low: Lower end of each pixel's interval, float32 [N, H, W], 0..1.
        high: Upper end.
        explained: Share of what the average object leaves unexplained in the frames that the images explain,
            where the setup is known; 0 or less is no better than the average object, and `CONFIRMED` is the
            least that is believed. By events: share of what the images show beyond it that the events hold.
        judged_by: What tells the share, frames or events.
    """

    agreement: float
    threshold: float
    low: Tensor
    high: Tensor
    explained: float | None = None
    judged_by: Literal["frames", "events"] = "frames"

    @property
    def support(self) -> float:
        """How much of this image the measurement supports, 0..1: the smaller of agreement and explained."""
        known = self.agreement if self.explained is None else min(self.agreement, self.explained)
        return min(max(known, 0.0), 1.0) if self.measured else 0.0

    @property
    def measured(self) -> bool:
        """Whether the measurement tells this object from others at all."""
        return self.agreement > self.threshold and (self.explained is None or self.explained > CONFIRMED)

    @property
    def verdict(self) -> str:
        """One sentence for a reader."""
        explained, by = 100 * min(max(self.explained or 0, 0), 1), self.judged_by
        if self.agreement > self.threshold and not self.measured:
            shares = {
                "frames": f"it explains {explained:.0f} % of what this object adds to the frames",
                "events": f"the events hold {explained:.0f} % of what it shows beyond an average object",
            }
            return (
                f"nothing measured, do not trust this reconstruction: {shares[by]} "
                f"({100 * CONFIRMED:.0f} % are required); check distance, light and wall, which may not be "
                "those of the weights or of the setup"
            )
        if not self.measured:
            return (
                "nothing measured, what you see is the network's guess: the two halves of the sequence "
                f"disagree, they share {100 * max(self.agreement, 0):.0f} % of what distinguishes objects, "
                f"where sequences without any object share up to {100 * self.threshold:.0f} %"
            )
        frames = f", and the images explain {explained:.0f} % of its frames"
        if by == "events":
            frames = f", and its events hold {explained:.0f} % of what the images show beyond an average one"
        if self.explained is None:
            frames = (
                "; whether the recording agrees with the images is not known, which takes the calibrated setup"
            )
        agreed = f"{100 * min(max(self.agreement, 0), 1):.0f} %"
        return f"both halves of the sequence agree on {agreed} of what distinguishes this object{frames}"


@dataclass(frozen=True, eq=False)
class Confidence:
    """What `fit_confidence` learned from sequences that the network was not trained on.

    Args:
        mean: Mean of the true targets, float32 [32, 32].
        empty: What the network shows where nothing of any one object was measured, as its mean difference from
            the mean target, [32, 32].
        power: Mean of |d|^2 over true targets, d what tells a target from an empty answer (see `telling`), [].
        threshold: See `ConfidenceReport.threshold`, [].
        edges: Agreements that separate the groups of sequences, ascending, [G - 1].
        low: Lower end of the interval for each group and level, [G, L].
        high: Upper end.
    """

    mean: Tensor
    empty: Tensor
    power: Tensor
    threshold: Tensor
    edges: Tensor
    low: Tensor
    high: Tensor

    def judge(
        self,
        pictures: Tensor,
        halves: Tensor,
        explained: float | None = None,
        judged_by: Literal["frames", "events"] = "frames",
    ) -> ConfidenceReport:
        """Return the confidence in the images of a sequence.

        Args:
            pictures: Images of all positions, float [N, H, W], 0..1.
            halves: What the two halves of the sequence show of the target, [2, 32, 32]: see `halves_of`.
            explained: How much of the frames the images explain, or of the images the events hold, where the
                setup is known.
            judged_by: Which of the two.
        """
        agreement, threshold = float(self.agreement(halves)), float(self.threshold)
        ends = torch.zeros_like(pictures), torch.ones_like(pictures)
        blank = ConfidenceReport(agreement, threshold, *ends, explained, judged_by)
        if not blank.measured:
            return blank
        group = int(torch.searchsorted(self.edges, torch.tensor(agreement)))
        # Halfway between the middles of two bins lies halfway between their intervals.
        at = (pictures * LEVELS - 0.5).clamp(0, LEVELS - 1)
        below = at.floor().long().clamp(max=LEVELS - 2)
        part = at - below
        low, high = (
            torch.lerp(ends[group][below], ends[group][below + 1], part) for ends in (self.low, self.high)
        )
        return replace(blank, low=low, high=high)

    def agreement(self, halves: Tensor) -> Tensor:
        """Return the agreement of a sequence, [], from its halves [2, 32, 32]."""
        first, second = self.telling(halves)
        return first @ second / self.power

    def telling(self, shown: Tensor) -> Tensor:
        """Return what tells targets [N, 32, 32] from the network's empty answer, [N, P].

        It is their difference from the mean target, without the mean target's own direction, so that neither a
        black target nor a paler one tells anything; less the same of what the network shows when it knows
        nothing, which would be in both halves of any sequence.
        """
        mean = F.normalize(self.mean.flatten(), dim=0)
        away = (shown - self.mean).flatten(1)
        return away - (away @ mean)[:, None] * mean - self.empty.flatten()

    def checked(self) -> Confidence:
        """Return this, whose tensors may be a stranger's.

        Raises:
            DataError: Their shapes do not belong together, or a number is none.
        """
        shapes = {item.name: tuple(getattr(self, item.name).shape) for item in fields(self)}
        table = (GROUPS, LEVELS)
        square = (SIDE, SIDE)
        wanted = {"mean": square, "empty": square, "power": (), "threshold": (), "edges": (GROUPS - 1,)}
        if shapes != wanted | {"low": table, "high": table}:
            raise DataError(f"its tensors have the shapes {shapes}")
        if not all(bool(torch.isfinite(one).all()) for one in self.tensors().values()) or self.power <= 0:
            raise DataError("its numbers are not finite, or its power is not positive")
        return self

    def tensors(self) -> dict[str, Tensor]:
        """Return all fields by name, for a file."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


@torch.inference_mode()
def halves_of(network: Reconstructor, inputs: Tensor, position_m: NDArray, canvas: Plane) -> Tensor:
    """Return what the first and the second half of a sequence show of the target, each on its own, [2, 32, 32].

    The object is the same in both halves and everything else is not: the noise, and where target, wall and
    camera are to one another. A pattern that stays where it is, or comes from nowhere, is not in both.

    Args:
        network: The network.
        inputs: What was measured, [N, C, H, W], in the order of time, N at least 2.
        position_m: The target's centre at each, (x, y) in metres, [N, 2].
        canvas: Geometry of the images.

    Raises:
        DataError: The motion is unknown, or there are fewer than two positions.
    """
    position_m = np.asarray(position_m)
    if len(inputs) < 2 or np.isnan(position_m).any():
        motion = "unknown" if np.isnan(position_m).any() else "known"
        raise DataError(
            f"{len(inputs)} positions, motion {motion}: confidence takes two positions and the motion; give it "
            "in capture.yaml (`evnlos track` finds it)"
        )
    parts = np.array_split(np.arange(len(inputs)), 2)
    return torch.stack(
        [
            on_target_plane(
                network.infer(inputs[torch.from_numpy(part)], position_m[part]), canvas, position_m[part]
            )
            .mean(dim=0)[0]
            .cpu()
            for part in parts
        ]
    )


FALSE_ALARM = 0.05
"""Share of sequences of which nothing was measured that are taken for measured."""
FEWEST = 8
"""Sequences that confidence can be learned from, at least."""
_MIXED = 60  # sequences without an object


@torch.inference_mode()
def fit_confidence(network: Reconstructor, samples: NlosDataset, canvas: Plane) -> Confidence:
    """Learn the confidence in a network's images from sequences that it was not trained on.

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
        canvas: Geometry of the images.

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


def _mixed(names: NDArray) -> list[NDArray[np.int64]]:
    """Return the rows of sequences in which each position is of another object; always the same."""
    sequences = [np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())]
    draw = np.random.default_rng(derive_seed(0, "mixed passes"))
    length = min(len(one) for one in sequences)
    return [
        np.array([sequences[i][k] for k, i in enumerate(draw.integers(0, len(sequences), length))])
        for _ in range(_MIXED)
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
