"""What a reconstructor is, and the linear one that every network starts from, and has to beat.

- The interface of every reconstructor: what it sees, what it learns in closed form, how it draws images.
- The best linear reconstruction, learned in closed form.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from evnlos.data import InMemoryDataset, Modality, NlosDataset, Sampling
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import left_out_errors
from evnlos.registry import Kinded, Registry
from evnlos.types import derive_seed

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
    of sequences sets `sees_sequence`, writes `draw` and `training_samples` too, and its `forward` takes these.

    Args:
        modality: What it sees.
        settings: Its settings.
        sampling: The samples that it is made for; how events are shown matters where they are seen.
    """

    sees_sequence: ClassVar[bool] = False
    """Whether all time steps of an object together give its images; the motion must then be known."""
    draws_sequences = False
    """Whether it learns from newly drawn sequences, as all that it sees is solved (`SequenceReconstructor`)."""
    parts: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parts whose weights a training may keep: name -> names of the submodules."""

    def __init__(self, modality: Modality, settings: ReconstructorSettings, sampling: Sampling) -> None:
        super().__init__()
        self.modality, self.settings = modality, settings
        self.sampling = sampling if modality.needs_events else sampling.of_frames()

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

    def check_samples(self, samples: NlosDataset, *, is_new: bool) -> None:
        """Raise what `training_samples`, with these arguments, would refuse; no sample is read."""

    def training_samples(
        self, samples: NlosDataset, augmentations: int, seed: int, *, is_new: bool
    ) -> InMemoryDataset:
        """Return what `forward` learns from: by default the samples of single time steps.

        Args:
            samples: The samples of single time steps.
            augmentations: Samples of each sequence, where whole sequences are seen.
            seed: Seed of every random draw.
            is_new: Whether inner scales are taken from these samples, as nothing was learned yet.
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
        *,
        so_far: bool = False,
    ) -> Tensor:
        """Return images of samples; the module goes over to evaluation mode.

        Args:
            inputs: What was recorded, [N, C, H, W].
            position_m: Centre of the target plane at each sample, (x, y) in metres, [N, 2]; only a
                reconstructor of sequences needs it.
            names: Object of each sample, [N]; None: all are of one.
            batch_size: Samples at a time.
            so_far: Whether each image is made of an object's samples up to its own, in their order, and of no
                later one; those of single time steps always are.

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
        owners = np.zeros(len(inputs), np.int64) if names is None else np.unique(names, return_inverse=True)[1]
        images = inputs.new_zeros((len(inputs), *inputs.shape[-2:]), dtype=torch.float32)
        for owner in range(int(owners.max()) + 1):
            mine = torch.from_numpy(np.flatnonzero(owners == owner)).to(inputs.device)
            seen, at = inputs[mine], places[mine.cpu()]
            if so_far:
                each = [self.draw(seen[:n], at[:n], at[n - 1 : n]) for n in range(1, len(at) + 1)]
                images[mine] = torch.cat(each)
            else:
                images[mine] = self.draw(seen, at, at)
        return images

    def seeing(self, sampling: Sampling) -> Reconstructor:
        """Return this reconstructor, weights shared, for samples that show what events say as others do.

        Args:
            sampling: How the others were made, see `Sampling.shown_as`.
        """
        same = copy(self)
        same.sampling = self.sampling.shown_as(sampling)
        return same

    def freeze(self, parts: tuple[str, ...]) -> None:
        """Keep the weights of some parts, by their names in `parts`, as they are.

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
            other: One of the same kind and layers; its linear embedding may have another rank. Groups of this
                modality behind those that it sees begin with weights of 0.

        Raises:
            ConfigError: Kind, modality or the size of a layer differ.
        """
        given, own = dict(other.named_parameters()), dict(self.named_parameters())
        seen, every = list(other.modality.layout), list(self.modality.layout)
        if other.kind != self.kind or seen != every[: len(seen)]:
            raise ConfigError(
                f"the weights to start from are of kind {other.kind!r} and see {other.modality.name}; this "
                f"network is of kind {self.kind!r} and sees {self.modality.name}: give weights like it"
            )
        part = own
        if seen != every:
            part = {n: v[:, : given[n].shape[1]] if v.ndim > 1 and n in given else v for n, v in own.items()}
        unlike = [n for n, v in part.items() if n not in given or given[n].shape != v.shape]
        if unlike or len(given) != len(own):
            which = (unlike or ["more of them"])[0]
            raise ConfigError(f"the weights to start from have other layers ({which}); give some like them")
        for name, value in part.items():
            own[name].zero_()
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


RIDGES = tuple(10.0 ** (k / 2) for k in range(-12, 5))  # in units of the mean power of a component
_FOLDS = 5
_EXTRA = 20  # columns of the random probe beyond the rank
_POWERS = 2
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class LinearEstimate:
    """y = mean_out + (x - mean_in) basis weights: a ridge regression on the main components of the input.

    Args:
        mean_in: Mean input, [D], D = C H W.
        basis: Main directions of the inputs, [D, R], orthogonal, their coefficients uncorrelated.
        powers: Power of each coefficient, summed over the samples, [R].
        weights: From the coefficients to the image, [R, H W].
        mean_out: Mean image, [H, W].
        regularization: Weight of the ridge that was chosen, in units of the mean power of a component.
    """

    mean_in: Tensor
    basis: Tensor
    powers: Tensor
    weights: Tensor
    mean_out: Tensor
    regularization: float

    def shrinkage(self, strength: float) -> Tensor:
        """Return the factors of the coefficients, [R], that make the ridge `strength` times as strong.

        Along uncorrelated coefficients a ridge regression is one division each, so that those of all ridges
        share basis and weights: W(s) = diag((p + l) / (p + s l)) W(1), p the powers, l the ridge.
        """
        ridge = self.regularization * self.powers.mean().clamp_min(_TINY)
        return (self.powers + ridge) / (self.powers + strength * ridge)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return images [N, H, W], 0..1, for inputs [N, C, H, W]."""
        code = (inputs.float().flatten(1) - self.mean_in) @ self.basis  # [N, R]
        return (self.mean_out + (code @ self.weights).unflatten(1, tuple(self.mean_out.shape))).clamp(0, 1)


def fit_linear(
    inputs: Tensor,
    truth: Tensor,
    objects: NDArray[np.str_],
    rank: int = 256,
    seed: int = 0,
    modality: Modality | None = None,
) -> LinearEstimate:
    """Fit the linear estimate with the least mean squared error on unseen objects.

    The basis comes from a randomised singular value decomposition (Halko, Martinsson and Tropp, SIAM Review
    53, 2011); the ridge is the best of a grid when one fold of the objects at a time is left out. The
    groups of channels of a modality have a basis each, in units of their own noise.

    Args:
        inputs: What the network would see, [N, C, H, W].
        truth: True images, [N, H, W], 0..1.
        objects: Object of each sample, [N].
        rank: Most components of the input.
        seed: Seed of the random probe and of the folds.
        modality: Which channels belong together; None: all do.

    Raises:
        DataError: The lengths differ, or there are fewer than two objects.
    """
    names = np.unique(objects)
    if not len(inputs) == len(truth) == len(objects):
        raise DataError(f"{len(inputs)} inputs, {len(truth)} images and {len(objects)} names; give as many")
    if len(names) < 2:
        raise DataError(f"{len(names)} object(s); a ridge is chosen on objects left out: give at least two")
    order = np.random.default_rng(derive_seed(seed, "folds")).permutation(len(names))
    fold_of = dict(zip(names[order], np.arange(len(names)) % min(_FOLDS, len(names)), strict=True))
    folds = torch.tensor([int(fold_of[name]) for name in objects])
    y = truth.float().flatten(1)  # [N, H W]
    mean_out = y.mean(dim=0)
    parts = [(slice(None), rank)]
    if modality is not None:
        parts = list(zip(modality.slices.values(), modality.ranks(rank), strict=True))
    found = [_fit(inputs[:, own].float().flatten(1), y - mean_out, folds, r, seed) for own, r in parts]
    shape = tuple(truth.shape[1:])
    if len(found) == 1:
        return LinearEstimate(*found[0][:4], mean_out.unflatten(0, shape), found[0][4])
    # Each part in units of its own noise, as its own best ridge tells it: else the noise of the events would
    # hide the fine detail of the frames.
    scales = torch.tensor(
        [
            float(regularization * powers.mean().clamp_min(_TINY)) ** -0.5
            for _, _, powers, _, regularization in found
        ]
    )
    scales = scales / scales.log().mean().exp()
    basis = torch.block_diag(*(one[1] * scale for one, scale in zip(found, scales, strict=True)))
    mean_in = torch.cat([one[0] for one in found])
    # One part at a time: frame and events side by side in float32 would fill the memory once more.
    codes = [
        (inputs[:, own].float().flatten(1) - one[0]) @ one[1] * scale
        for (own, _), one, scale in zip(parts, found, scales, strict=True)
    ]
    turned, powers, weights, regularization = _regress(torch.cat(codes, dim=1), y - mean_out, folds)
    return LinearEstimate(
        mean_in, basis @ turned, powers, weights, mean_out.unflatten(0, shape), regularization
    )


def _fit(
    x: Tensor, y: Tensor, folds: Tensor, rank: int, seed: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, float]:
    """Return mean input [D], basis [D, R], powers [R], weights [R, H W] and ridge of one part of the input."""
    mean_in = x.mean(dim=0)
    x = x - mean_in
    basis = _main_directions(x, min(rank, *x.shape), seed)
    turned, powers, weights, regularization = _regress(x @ basis, y, folds)
    return mean_in, basis @ turned, powers, weights, regularization


def _regress(code: Tensor, y: Tensor, folds: Tensor) -> tuple[Tensor, Tensor, Tensor, float]:
    """Return what makes the code [N, R] uncorrelated [R, R], its powers [R], weights [R, H W] and ridge."""
    powers, turn = torch.linalg.eigh((code.T @ code).double())
    powers, turn = powers.clamp_min(0).float().flip(0), turn.float().flip(1)
    code = code @ turn
    parts = []  # of each fold: C^T C [R, R] and C^T Y [R, H W]
    for fold in folds.unique():
        own = folds == fold
        part = code[own]
        parts.append(((part.T @ part).double(), (part.T @ y[own]).double()))
    gram, outer = (torch.stack(column).sum(dim=0) for column in zip(*parts, strict=True))
    errors = sum(left_out_errors(gram - own, outer - aim, own, aim, RIDGES) for own, aim in parts)
    regularization = RIDGES[int(torch.as_tensor(errors).argmin())]
    weights = outer.float() / (powers + regularization * powers.mean().clamp_min(_TINY))[:, None]
    return turn, powers, weights, regularization


def _main_directions(x: Tensor, rank: int, seed: int) -> Tensor:
    """Return the main right singular directions of x [N, D], orthonormal [D, R]."""
    draw = torch.Generator().manual_seed(derive_seed(seed, "probe") % 2**63)
    probe = torch.randn(x.shape[1], min(rank + _EXTRA, *x.shape), generator=draw)
    reached, _ = torch.linalg.qr(x @ probe)
    for _ in range(_POWERS):
        back, _ = torch.linalg.qr(x.T @ reached)
        reached, _ = torch.linalg.qr(x @ back)
    _, _, right = torch.linalg.svd(reached.T @ x, full_matrices=False)
    return right[:rank].T.contiguous()
