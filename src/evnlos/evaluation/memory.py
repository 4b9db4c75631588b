"""Does a network see, or does it remember? Reconstructions beside the pictures of its training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from evnlos.dataset import Dataset, network_input, read_shard
from evnlos.metrics import psnr
from evnlos.model.embedding import Standardise


@dataclass(frozen=True, eq=False)
class Memory:
    """The training pictures of a dataset at the place of each test picture.

    Args:
        names: Training objects, [G].
        inputs: What the network saw of them at that position, float32 [G, N, C, H, W].
        truth: Their true pictures, moved to the test picture's place, float32 [G, N, H, W].
    """

    names: list[str]
    inputs: Tensor
    truth: Tensor


def recall(dataset: Dataset, split: str, paradigm: str) -> Memory | None:
    """Gather, for each sample of a split, the sample of each training object that lies nearest along the path.

    The true picture is moved by what is left, in fractions of a pixel; the input stays as it was measured.

    Returns:
        The memory, or None where the motion of an object is unknown.

    Raises:
        DataError: The dataset has no training objects.
    """
    tested = [read_shard(dataset.shard(name))[0] for name in dataset.objects(split)]
    names = dataset.objects("train")
    inputs, truth = [], []
    for name in names:
        known, _ = read_shard(dataset.shard(name))
        if known.truth is None or known.position_m is None or any(s.position_m is None for s in tested):
            return None
        seen = network_input(known.frame, known.surface, paradigm)  # type: ignore[arg-type]
        pictures = torch.from_numpy(known.truth)
        places, moved = [], []
        for samples in tested:
            away = samples.position_m[:, None] - known.position_m  # type: ignore[index,operator] # [N, K, 2]
            nearest = np.square(away).sum(axis=2).argmin(axis=1)
            places.append(nearest)
            moved.append(away[np.arange(len(nearest)), nearest])
        place = torch.from_numpy(np.concatenate(places))
        inputs.append(seen[place])
        truth.append(_shifted(pictures[place], np.concatenate(moved) / dataset.sampling.pitch_m))
    return Memory(names, torch.stack(inputs), torch.stack(truth))


def nearest_answer(memory: Memory, inputs: Tensor) -> Tensor:
    """Answer each measurement with the true picture of the training object whose measurement is most like it.

    The baseline of pure memory: no network, no physics.

    Args:
        memory: From `recall`, of G objects.
        inputs: What the network sees of the test samples, [N, C, H, W].

    Returns:
        Pictures, float32 [N, H, W].
    """
    scale = Standardise(inputs.shape[1], "dataset")  # frames and events in units that can be compared
    scale.fit(memory.inputs.flatten(0, 1))
    seen = scale(inputs.float())
    distance = torch.stack(
        [(scale(known) - seen).square().flatten(1).mean(dim=1) for known in memory.inputs]
    )  # [G, N]
    return memory.truth[distance.argmin(dim=0), torch.arange(len(inputs))]


def nearer_to_truth(images: Tensor, truth: Tensor, memory: Tensor) -> np.ndarray:
    """Return for each reconstruction whether it is nearer to the truth than to every training picture.

    Args:
        images: Reconstructions, [N, H, W].
        truth: True pictures, [N, H, W].
        memory: Training pictures at the same place, [G, N, H, W].

    Returns:
        bool [N].
    """
    remembered = torch.stack([psnr(images, pictures) for pictures in memory])  # [G, N]
    return (psnr(images, truth) > remembered.amax(dim=0)).numpy()


def _shifted(pictures: Tensor, shift_px: np.ndarray) -> Tensor:
    """Move pictures [N, H, W] by (x, y) pixels [N, 2], bilinear, zero beyond the border."""
    count, height, width = pictures.shape
    moves = torch.eye(2, 3).repeat(count, 1, 1)
    moves[:, :, 2] = -torch.from_numpy(shift_px).float() * 2 / torch.tensor([width, height])
    grid = F.affine_grid(moves, [count, 1, height, width], align_corners=False)
    return F.grid_sample(pictures[:, None].float(), grid, align_corners=False)[:, 0]
