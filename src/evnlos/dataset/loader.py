"""Samples in memory, ready for a network: the three paradigms are one switch."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.dataset.shard import read_shard
from evnlos.dataset.store import Dataset
from evnlos.errors import DataError

Paradigm = Literal["frame", "event", "fusion"]
PARADIGMS: tuple[Paradigm, ...] = ("frame", "event", "fusion")
CHANNELS: dict[Paradigm, int] = {"frame": 1, "event": 2, "fusion": 3}


def network_input(frame: NDArray | Tensor, surface: NDArray | Tensor, paradigm: Paradigm) -> Tensor:
    """Return what a network of a paradigm sees: frame [N, H, W] and surface [N, 2, H, W] -> [N, C, H, W].

    The levels stay as they were measured, 0..1; a network brings them to its own scale. Fusion is the frame and
    the two polarities of the surface.

    Raises:
        DataError: The paradigm is unknown.
    """
    if paradigm not in CHANNELS:
        raise DataError(f"paradigm is {paradigm!r}; give one of {', '.join(PARADIGMS)}")
    parts = []
    if paradigm in ("frame", "fusion"):
        parts.append(torch.as_tensor(frame, dtype=torch.float32)[:, None])  # [N, 1, H, W]
    if paradigm in ("event", "fusion"):
        parts.append(torch.as_tensor(surface, dtype=torch.float32))  # [N, 2, H, W]
    return torch.cat(parts, dim=1)


class HeldSamples(torch.utils.data.Dataset):
    """Samples in memory: item i is (input [C, h, w], picture [1, h, w]), float32.

    Args:
        inputs: What the network sees, float16 [N, C, h, w].
        truth: True pictures, float16 [N, h, w].
        names: The object of each sample, [N].
    """

    def __init__(self, inputs: Tensor, truth: Tensor, names: NDArray[np.str_]) -> None:
        self.inputs, self.truth, self.names = inputs, truth, names

    def __len__(self) -> int:
        return len(self.inputs)

    def bytes(self) -> int:
        """Return the size of inputs and truth, bytes."""
        return self.inputs.nbytes + self.truth.nbytes

    def to(self, device: torch.device) -> None:
        """Move inputs and truth to a device, where batches are then cut without a copy from main memory."""
        self.inputs, self.truth = self.inputs.to(device), self.truth.to(device)

    def __getitem__(self, index: int | Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return one sample, or a batch for a tensor of indices."""
        return self.inputs[index].float(), self.truth[index].unsqueeze(-3).float()


class NlosDataset(HeldSamples):
    """The samples of a split in memory: item i is (input [C, H, W], truth [1, H, W]), float32.

    Args:
        dataset: The dataset on disk.
        split: "train", "validation", "test" or "all".
        paradigm: "frame", "event" or "fusion".

    Attributes:
        inputs: float16 [N, C, H, W].
        truth: float16 [N, H, W].
        names: The object of each sample, [N].
        position_m: The target's centre, (x, y) in metres, float32 [N, 2]; NaN where it is unknown.

    Raises:
        DataError: A shard is missing or damaged, or an object has no truth to learn from.
    """

    def __init__(self, dataset: Dataset, split: str, paradigm: Paradigm) -> None:
        inputs, truth, names, places = [], [], [], []
        for name in dataset.objects(split):
            samples, _ = read_shard(dataset.shard(name))
            if samples.truth is None:
                raise DataError(
                    f"{dataset.shard(name)} has no truth (unknown target or motion); reconstruct it instead"
                )
            inputs.append(network_input(samples.frame, samples.surface, paradigm).half())
            truth.append(torch.from_numpy(samples.truth).half())
            names += [name] * len(samples)
            unknown = np.full((len(samples), 2), np.nan, dtype=np.float32)
            places.append(unknown if samples.position_m is None else samples.position_m.astype(np.float32))
        super().__init__(torch.cat(inputs), torch.cat(truth), np.array(names))
        self.position_m = np.concatenate(places)
