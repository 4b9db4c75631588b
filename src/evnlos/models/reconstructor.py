"""The interface of every reconstructor: what it sees, what it learns in closed form, how it draws images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from evnlos.data import InMemoryDataset, Modality, NlosDataset, Sampling
from evnlos.errors import ConfigError, DataError
from evnlos.registry import Kinded, Registry

Drawn = tuple[Tensor, Tensor, NDArray[np.str_]]
"""Some samples: inputs [n, C, H, W], true images [n, H, W], and the object of each [n]."""


class ReconstructorSettings(Kinded):
    """Base of the settings of a reconstructor; the kind of the settings is the kind of the reconstructor.

    Derive a frozen dataclass with a field `kind` from it, write `build`, and register it with
    `RECONSTRUCTORS.register`, or offer it as an entry point of the group `evnlos.models`.
    """

    registry: ClassVar[Registry] = Registry("evnlos.models", "reconstructor")
    default_kind: ClassVar[str] = "unet"
    kind: str

    @property
    def least_tensors(self) -> int:
        """A number of tensors that every such network has at least; a file with fewer is not even built."""
        return 1

    def build(self, modality: str | Modality, sampling: Sampling) -> Reconstructor:
        """Return a reconstructor with random weights.

        Args:
            modality: What it sees, or its name.
            sampling: Resolution and representation of the samples, and the geometry of the images.
        """
        raise NotImplementedError


RECONSTRUCTORS = ReconstructorSettings.registry
"""Settings of every kind of reconstructor, by kind."""


class Reconstructor(nn.Module, ABC):
    """What turns recorded maps into images of the hidden object; trainer, evaluation and apps know this alone.

    A kind that sees single time steps writes `forward`: inputs [B, C, H, W] to images [B, 1, H, W], 0..1. One
    that sees whole sequences sets `sees_sequence`, and writes `draw` and `training_samples` too; its `forward`
    takes the inputs of its training samples.

    Args:
        modality: What it sees.
        settings: Its settings.
        sampling: The samples that it is made for.
    """

    sees_sequence: ClassVar[bool] = False
    """Whether all time steps of an object together give its images; the motion must then be known."""
    parts: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parts whose weights a training may keep: name -> names of the submodules."""

    def __init__(self, modality: Modality, settings: ReconstructorSettings, sampling: Sampling) -> None:
        super().__init__()
        self.modality, self.settings, self.sampling = modality, settings, sampling

    @property
    def kind(self) -> str:
        """The kind, as it stands in settings and files."""
        return self.settings.kind

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """Map the inputs of training samples [B, c, h, w] to images [B, 1, h, w], 0..1."""

    def fit(self, subset: Callable[[int], Drawn], seed: int, *, is_new: bool, keep_normalization: bool) -> None:
        """Take from the data what is learned in closed form, before the first step of a training.

        Args:
            subset: Returns at most so many samples of single time steps.
            seed: Seed of every random draw.
            is_new: Whether the weights are random; otherwise they come from an earlier training.
            keep_normalization: Whether a reconstructor with weights keeps the scale of the earlier data.
        """

    def training_samples(
        self, samples: NlosDataset, augmentations: int, seed: int, *, is_new: bool
    ) -> InMemoryDataset:
        """Return what `forward` learns from: by default the samples of single time steps.

        Args:
            samples: The samples of single time steps.
            augmentations: Samples of each sequence, where whole sequences are seen.
            seed: Seed of every random draw.
            is_new: Whether nothing was learned yet, so that inner scales are taken from these samples.
        """
        return samples

    def draw(self, inputs: Tensor, position_m: Tensor, at_m: Tensor) -> Tensor:
        """Return images of one object, [M, H, W], 0..1, from its sequence; only where `sees_sequence`.

        Args:
            inputs: What was recorded, [N, C, H, W].
            position_m: Centre of the target plane at each, (x, y) in metres, [N, 2].
            at_m: Centres at which to draw it, [M, 2].
        """
        raise NotImplementedError

    @torch.inference_mode()
    def infer(
        self,
        inputs: Tensor,
        position_m: NDArray | None = None,
        names: NDArray | None = None,
        batch_size: int = 40,
    ) -> Tensor:
        """Return images of samples; the module goes over to evaluation mode.

        Args:
            inputs: What was recorded, [N, C, H, W].
            position_m: Centre of the target plane at each sample, (x, y) in metres, [N, 2]; only a
                reconstructor of sequences needs it.
            names: Object of each sample, [N]; None: all are of one.
            batch_size: Samples at a time.

        Returns:
            Images on the canvas, float32 [N, H, W], 0..1.

        Raises:
            DataError: A reconstructor of sequences is given no positions.
        """
        self.eval()
        if not self.sees_sequence:
            return torch.cat([self(part.float())[:, 0] for part in inputs.split(batch_size)])
        if position_m is None or np.isnan(position_m).any():
            raise DataError(
                "a network of whole sequences has to know where the target was; give the motion in "
                "capture.yaml (`evnlos track` finds it)"
            )
        places = torch.from_numpy(np.asarray(position_m, dtype=np.float32))
        owners = np.zeros(len(inputs), dtype=np.int64)
        if names is not None:
            owners = np.unique(names, return_inverse=True)[1]
        images = inputs.new_zeros((len(inputs), *inputs.shape[-2:]), dtype=torch.float32)
        for owner in range(int(owners.max()) + 1):
            mine = torch.from_numpy(np.flatnonzero(owners == owner)).to(inputs.device)
            at = places[mine.cpu()]
            images[mine] = self.draw(inputs[mine], at, at)
        return images

    def freeze(self, parts: tuple[str, ...]) -> None:
        """Keep the weights of some parts as they are.

        Args:
            parts: Names of `parts`.

        Raises:
            ConfigError: There is no such part, or nothing would be left to train.
        """
        for part in parts:
            if part not in self.parts:
                there = f"give some of {', '.join(self.parts)}" if self.parts else "it has no named parts"
                raise ConfigError(f"freeze names {part!r}; {there} of the kind {self.kind!r}")
            for name in self.parts[part]:
                self.get_submodule(name).requires_grad_(False)
        if not any(parameter.requires_grad for parameter in self.parameters()):
            raise ConfigError(f"freeze is {parts}; leave at least one part of the network to train")

    @torch.no_grad()
    def take_layers(self, other: Reconstructor) -> None:
        """Take what gradients trained from another reconstructor, and leave what is fitted in closed form.

        Args:
            other: One of the same kind, modality and layers; its linear embedding may have another rank.

        Raises:
            ConfigError: Kind, modality or the size of a layer differ.
        """
        given, own = dict(other.named_parameters()), dict(self.named_parameters())
        if (other.kind, other.modality.name) != (self.kind, self.modality.name):
            raise ConfigError(
                f"the weights to start from are of kind {other.kind!r} and see {other.modality.name}; this "
                f"network is of kind {self.kind!r} and sees {self.modality.name}: give weights like it"
            )
        unlike = [n for n in own if n not in given or given[n].shape != own[n].shape]
        if unlike or len(given) != len(own):
            raise ConfigError(
                f"the weights to start from have other layers ({(unlike or ['more of them'])[0]}); give the "
                "network their width, depth, blocks, shuffle, groups and number of ridges"
            )
        for name, value in own.items():
            value.copy_(given[name])

    def reduced(self, rank: int) -> Reconstructor:
        """Return a copy whose closed-form part has fewer components, the strongest.

        Args:
            rank: Components to keep.

        Raises:
            ConfigError: There is no such part, or it has fewer components.
        """
        raise ConfigError(
            f"the rank is to be {rank}, and these weights have no linear embedding; leave it away"
        )

    @classmethod
    def today(cls, name: str, modality: Modality) -> str:
        """Return what a tensor of an older weights file or checkpoint is called in `state_dict` now.

        Args:
            name: Its name in the file.
            modality: What the network sees.
        """
        return name
