"""Does a network see, or does it remember? Reconstructions beside what the objects of its training show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from evnlos.dataset import Dataset, Modality, NlosDataset, read_shard, read_shard_index
from evnlos.errors import DataError
from evnlos.metrics import psnr

_TOGETHER = 128  # samples compared at a time
_SMALLEST = 1e-3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Reconstructions beside the training objects of their dataset.

    Args:
        nearest: For each sample the true image of the training object whose measurement is most like its own,
            float32 [N, H, W]: the answer of pure memory, with no network and no physics.
        nearer_to_truth: Whether each reconstruction is nearer to the truth than to every training image,
            bool [N].
    """

    nearest: Tensor
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
    rows, pitch_m = dataset.sampling.scored, dataset.sampling.pitch_m
    names = dataset.objects("train")
    tested = [read_shard_index(dataset.shard(name)).position_m for name in dataset.objects(split)]
    known = [read_shard_index(dataset.shard(name)).position_m for name in names]
    if any(where is None for where in (*tested, *known)):
        return None
    at_m = np.concatenate([where for where in tested if where is not None])  # [N, 2]
    nearest_of = [_nearest(where, at_m) for where in known if where is not None]
    parts = [slice(first, first + _TOGETHER) for first in range(0, len(images), _TOGETHER)]
    truth, spread = samples.truth[:, rows].float(), _Spread(samples.modality)
    closest_db = torch.full((len(images),), -torch.inf)
    difference = torch.empty(len(names), len(images), samples.modality.channels)  # mean squares, [G, N, C]
    for number, (name, (step, away_m)) in enumerate(zip(names, nearest_of, strict=True)):
        inputs, true = _read(dataset, name, samples.modality)
        for part in parts:
            seen = inputs[step[part]]
            spread.add(seen)
            difference[number, part] = (seen - samples.inputs[part].float()).square().mean(dim=(2, 3))
            moved = _shifted(true[step[part]], away_m[part] / pitch_m)[:, rows]
            closest_db[part] = torch.maximum(closest_db[part], psnr(images[part], moved))
    owner = (difference / spread.per_channel().square()).sum(dim=2).argmin(dim=0)  # [N]
    nearest = torch.empty_like(truth)
    for number in owner.unique().tolist():
        step, away_m = nearest_of[number]
        _, true = _read(dataset, names[number], samples.modality)
        for chosen in torch.nonzero(owner == number)[:, 0].split(_TOGETHER):
            nearest[chosen] = _shifted(true[step[chosen]], away_m[chosen] / pitch_m)[:, rows]
    return Comparison(nearest, (psnr(images, truth) > closest_db).numpy())


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


def _read(dataset: Dataset, name: str, modality: Modality) -> tuple[Tensor, Tensor]:
    """Return inputs [K, C, H, W] and true images [K, H, W] of a training object, float32."""
    samples, _ = read_shard(dataset.shard(name))
    if samples.truth is None:
        raise DataError(
            f"{dataset.shard(name)} has no truth (unknown target or motion), and {name} is learned from"
        )
    return modality.inputs(samples.frame, samples.surface), torch.from_numpy(samples.truth)


def _shifted(images: Tensor, shift_px: Tensor) -> Tensor:
    """Move images [N, H, W] by (x, y) pixels [N, 2], bilinear, zero beyond the border."""
    count, height, width = images.shape
    moves = torch.eye(2, 3).repeat(count, 1, 1)
    moves[:, :, 2] = -shift_px.float() * 2 / torch.tensor([width, height])
    grid = F.affine_grid(moves, [count, 1, height, width], align_corners=False)
    return F.grid_sample(images[:, None].float(), grid, align_corners=False)[:, 0]
