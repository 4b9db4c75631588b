"""The reconstructor of whole sequences: all time steps seen from the target plane, pooled, one image of it."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from evnlos.data import InMemoryDataset, Modality, NlosDataset, Sampling, as_modality
from evnlos.errors import ConfigError, DataError
from evnlos.models.confidence import on_canvas
from evnlos.models.embedding import InputNormalization, LinearEmbeddings, fit_input
from evnlos.models.reconstructor import RECONSTRUCTORS, Drawn, Reconstructor
from evnlos.models.unet import PARTS, ResidualUNet, UNetConfig
from evnlos.types import Plane, derive_seed

PLANE_M = 0.1
"""Side of the square around the target plane's centre that is drawn, metres: 8 cm and a margin."""

FINER = 2
"""Pixels of that square per pixel of the canvas: positions between pixels tell more than one of them does."""

_CELLS = 4  # the square's side is a multiple of so many pixels
_MOST_PIXELS = 4096  # along the square's side


@RECONSTRUCTORS.register
@dataclass(frozen=True)
class SequenceConfig(UNetConfig):
    """A network of whole sequences, which pools the linear embedding over the time steps: kind `sequence`."""

    kind: str = "sequence"
    """Kind of the reconstructor."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rank:
            raise ConfigError(
                "SequenceConfig.rank is 0; a sequence network pools its linear embedding: give a rank"
            )

    def build(self, modality: str | Modality, sampling: Sampling) -> Reconstructor:
        """Return a reconstructor of whole sequences with random weights."""
        return SequenceReconstructor(as_modality(modality), self, sampling)


class TargetGrid:
    """The square around the target plane's centre, `FINER` than the canvas, and the way there and back.

    Args:
        sampling: Size of the maps and their pitch on the target's canvas.

    Raises:
        ConfigError: The pitch is too fine for the square of 10 cm.
    """

    def __init__(self, sampling: Sampling) -> None:
        pitch_m = sampling.pitch_m / FINER
        self.side = max(1, round(PLANE_M / pitch_m / _CELLS)) * _CELLS
        if self.side > _MOST_PIXELS:
            raise ConfigError(
                f"Sampling.pitch_m is {sampling.pitch_m}; a sequence network takes {PLANE_M / 2000:g} m or more"
            )
        # On the CPU wherever the layers are: the first arithmetic on the device "meta" imports for seconds.
        across = (torch.arange(self.side, device="cpu") + 0.5 - self.side / 2) * pitch_m
        self._place_m = torch.stack(torch.meshgrid(across, across, indexing="xy"), dim=-1)  # [P, P, 2]
        self._canvas_m = torch.tensor([sampling.width, sampling.height], device="cpu") * sampling.pitch_m
        self._side_m, self._canvas = self.side * pitch_m, sampling.canvas

    def seen(self, images: Tensor, position_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return images [N, S, H, W] as seen from the plane, [N, S, P, P], and where, bool [N, P, P].

        Args:
            images: Images of the canvas.
            position_m: The plane's centre on the canvas at each, (x, y) in metres, [N, 2].
        """
        place = self._place_m + position_m.float().cpu()[:, None, None]  # [N, P, P, 2]
        grid = (place / (self._canvas_m / 2)).to(images.device)  # -1..1 from edge to edge
        inside = (grid.abs() <= 1).all(dim=-1)  # [N, P, P]
        moved = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
        return moved * inside[:, None], inside

    def mean(self, images: Tensor, position_m: Tensor) -> Tensor:
        """Return the plane [P, P] that images [N, H, W] of all positions show: their mean."""
        light, inside = self.seen(images[:, None].float(), position_m)
        return light.sum(dim=0)[0] / inside.sum(dim=0).clamp_min(1)

    def on_canvas(self, plane: Tensor, position_m: Tensor) -> Tensor:
        """Return the target plane [P, P] on the canvas at each position [N, 2], metres: images [N, H, W].

        Each pixel is the mean of `FINER` x `FINER` samples.
        """
        canvas = self._canvas
        fine = Plane(canvas.height * FINER, canvas.width * FINER, canvas.pitch_m / FINER)
        return F.avg_pool2d(on_canvas(plane, fine, position_m, self._side_m), FINER)


def aligned_mean(images: Tensor, position_m: NDArray, names: NDArray, sampling: Sampling) -> Tensor:
    """Return images [N, H, W] of which each object's are replaced by their mean along the motion.

    What images of single time steps make of a whole sequence without a network of sequences.

    Args:
        images: Images of single time steps on the canvas, [N, H, W].
        position_m: The target's centre at each, (x, y) in metres, [N, 2].
        names: Object of each, [N].
        sampling: Size of the maps and their pitch on the target's canvas.
    """
    grid, found, places = TargetGrid(sampling), torch.zeros_like(images), torch.from_numpy(position_m)
    for name in np.unique(names):
        mine = torch.from_numpy(np.flatnonzero(names == name))
        found[mine] = grid.on_canvas(grid.mean(images[mine], places[mine]), places[mine])
    return found


class SequenceReconstructor(Reconstructor):
    """All time steps -> the target plane: embed each, look at it from the plane, take the mean, then a U-Net.

    The linear embedding of each time step is read at the plane's own pixels, wherever the plane was then. The
    mean over the time steps has less noise the more there are, so weaker ridges, sharper and noisier, become
    useful. What is trained by gradients is the U-Net behind the mean. Pooling over a set after Zaheer et al.,
    Deep Sets, NeurIPS 2017; the alignment is the known motion.

    Args:
        modality: What it sees.
        settings: U-Net and embedding.
        sampling: Size of the maps and their pitch on the target's canvas.

    Raises:
        ConfigError: The pitch is too fine for the square of 10 cm that is drawn.
    """

    sees_sequence = True
    parts = PARTS

    def __init__(self, modality: Modality, settings: SequenceConfig, sampling: Sampling) -> None:
        super().__init__(modality, settings, sampling)
        self.settings: SequenceConfig = settings
        size = (sampling.height, sampling.width)
        self.normalization = InputNormalization(modality, settings.scaling)
        solved = "surface" if sampling.surface == "likelihood" else ""
        self.embedding = LinearEmbeddings(modality, size, settings.rank, settings.ridge_multipliers, solved)
        self.scale = PooledScale(self.embedding.images)
        self.unet = ResidualUNet(self.embedding.images, settings)
        self.grid = TargetGrid(sampling)

    def forward(self, x: Tensor) -> Tensor:
        """Map pooled maps [B, S, P, P] to images of the target plane [B, 1, P, P], 0..1."""
        return self.unet(self.scale(x))

    def fit(self, subset: Callable[[int], Drawn], seed: int, *, is_new: bool, keep_normalization: bool) -> None:
        """Fit the normalization and, where the weights are random, the linear embedding."""
        fit_input(
            self.normalization,
            self.embedding,
            subset,
            seed,
            is_new=is_new,
            keep_normalization=keep_normalization,
        )

    def training_samples(
        self, samples: NlosDataset, augmentations: int, seed: int, *, is_new: bool
    ) -> InMemoryDataset:
        """Return pooled sequences: of each object all time steps, every other one, then random subsets.

        Subsets have other noise and fewer angles on the same target, so that short sequences are met too.

        Args:
            samples: The samples of single time steps.
            augmentations: Pooled maps of each object.
            seed: Seed of the subsets.
            is_new: Whether the scale of the pooled maps is taken from these samples.

        Returns:
            Inputs float16 [M, S, P, P], true images of the target plane float16 [M, P, P].

        Raises:
            DataError: The motion of an object is unknown.
        """
        inputs, truth, names = [], [], []
        draw = np.random.default_rng(derive_seed(seed, "views"))
        device = next(self.parameters()).device
        for name in dict.fromkeys(samples.names.tolist()):
            mine = np.flatnonzero(samples.names == name)
            if np.isnan(samples.position_m[mine]).any():
                raise DataError(
                    f"the motion of {name} is unknown, and a sequence network pools positions; give it in "
                    "capture.yaml, or train on single time steps (--network.kind unet)"
                )
            places = torch.from_numpy(samples.position_m[mine])
            plane = self.grid.mean(samples.truth[torch.from_numpy(mine)], places).half()
            kept = torch.zeros(augmentations, len(mine))
            for number in range(augmentations):
                kept[number, _subset(number, len(mine), draw)] = 1
            seen = samples.inputs[torch.from_numpy(mine)].to(device)
            inputs.append(self.pooled_subsets(seen, places, kept).half().cpu())
            truth += augmentations * [plane]
            names += augmentations * [name]
        found = InMemoryDataset(torch.cat(inputs), torch.stack(truth), np.array(names))
        if is_new:
            self.scale.fit(found.inputs)
        return found

    def draw(self, inputs: Tensor, position_m: Tensor, at_m: Tensor) -> Tensor:
        """Return images of one object at positions `at_m`, [M, H, W], from its sequence."""
        plane = self(self.pooled(inputs, position_m)[None])[0, 0]
        return self.grid.on_canvas(plane, at_m)

    def reduced(self, rank: int) -> Reconstructor:
        """Return a copy whose linear embedding has fewer components, the strongest."""
        copy = deepcopy(self)
        copy.embedding.keep(rank)
        copy.settings = replace(copy.settings, rank=rank)
        return copy

    def pooled(self, inputs: Tensor, position_m: Tensor) -> Tensor:
        """Return the mean of the embedded time steps as the target plane sees them, [S, P, P].

        Args:
            inputs: What was recorded at N time steps, [N, C, H, W].
            position_m: The plane's centre on the canvas, (x, y) in metres, [N, 2].

        Raises:
            DataError: The plane is off the canvas at all time steps.
        """
        return self.pooled_subsets(inputs, position_m, torch.ones(1, len(inputs)))[0]

    @torch.no_grad()
    def pooled_subsets(self, inputs: Tensor, position_m: Tensor, kept: Tensor) -> Tensor:
        """Return `pooled` of subsets of the time steps, [K, S, P, P]; each step is embedded once for all.

        Args:
            inputs: What was recorded at N time steps, [N, C, H, W].
            position_m: The plane's centre on the canvas, (x, y) in metres, [N, 2].
            kept: 1 where a subset has a time step, else 0, float32 [K, N].

        Raises:
            DataError: The plane is off the canvas at all time steps of a subset.
        """
        total = seen = torch.zeros((), device=inputs.device)
        for start in range(0, len(inputs), 64):
            part = slice(start, start + 64)
            embedded = self.embedding(self.normalization(inputs[part].float()))
            light, inside = self.grid.seen(embedded, position_m[part])
            weights = kept[:, part].to(light)
            total = total + torch.tensordot(weights, light, dims=1)
            seen = seen + torch.tensordot(weights, inside.to(light), dims=1)
        if not bool((seen > 0).flatten(1).any(dim=1).all()):
            raise DataError(
                "the target plane is off the canvas at every time step; give positions within the travel"
            )
        return total / seen[:, None].clamp_min(1)

    @classmethod
    def today(cls, name: str, modality: Modality) -> str:
        """Return today's name of a tensor; before, the scale of the pooled maps was the U-Net's own."""
        if name.startswith("unet.standardise."):
            return f"scale.{name.rpartition('.')[2]}"
        return InputNormalization.today(name, modality)


class PooledScale(nn.Module):
    """Bring each pooled map [B, S, P, P] to mean 0 and standard deviation 1 over a dataset.

    Args:
        images: Number of maps S.
    """

    mean: Tensor
    size: Tensor

    def __init__(self, images: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(images))
        self.register_buffer("size", torch.ones(images))

    @torch.no_grad()
    def fit(self, maps: Tensor) -> None:
        """Take mean and spread of each map from pooled maps [M, S, P, P]."""
        values = maps.float()
        self.mean.copy_(values.mean(dim=(0, 2, 3)))
        self.size.copy_(values.std(dim=(0, 2, 3)).clamp_min(1e-6))

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, S, P, P] to the same in units of the dataset's spread."""
        return (x - self.mean[:, None, None]) / self.size[:, None, None]


def _subset(number: int, steps: int, draw: np.random.Generator) -> NDArray[np.int64]:
    """Return the time steps of subset `number`: 0 all, 1 every other, then at least a quarter at random."""
    if number == 0 or steps == 1:
        return np.arange(steps)
    if number == 1:
        return np.arange(0, steps, 2)
    count = int(draw.integers(max(1, steps // 4), steps + 1))
    return np.sort(draw.permutation(steps)[:count])
