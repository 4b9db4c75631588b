"""What a network knows before its first step.

- The scale of its inputs, and the light path undone linearly.
- The light path itself, on the samples' pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from evnlos.data import Modality, Sampling
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.models.reconstructor import LinearEstimate, fit_linear
from evnlos.setups import Setup
from evnlos.types import Plane

Scaling = Literal["dataset", "picture"]

MOST_SAMPLES = 16_384
"""Samples that the linear embedding is fitted to, at most."""

_SMALLEST = 1e-3
_AT_ONCE = 256  # samples: what is worked on stays in the cache


class InputNormalization(nn.Module):
    """Bring inputs [B, C, H, W] to mean 0 and size 1, each group of channels on its own.

    A group that is centred (a frame) loses its mean and is divided by its standard deviation; one whose 0 means
    "nothing here" (events) keeps it, and is divided by the root mean square of all its channels. With the
    scaling "dataset" these numbers are those of a whole dataset, so that the brightness of one image against
    another still counts; with "picture" they are each image's own, and gain and a constant ambient light drop
    out.

    Args:
        modality: What is seen.
        scaling: Whose mean and size.
    """

    mean: Tensor
    size: Tensor

    def __init__(self, modality: Modality, scaling: Scaling) -> None:
        super().__init__()
        self.modality, self.scaling = modality, scaling
        self.register_buffer("mean", torch.zeros(modality.channels))
        self.register_buffer("size", torch.ones(modality.channels))

    def fit(self, inputs: Tensor) -> None:
        """Take mean and size from the inputs of a dataset, [N, C, H, W], a part of it at a time."""
        parts = inputs.split(_AT_ONCE)
        sums = torch.stack([_sums(part.to(self.mean.device)) for part in parts]).sum(dim=0)  # [2, C], float64
        mean, square = sums / (len(inputs) * inputs.shape[2] * inputs.shape[3])
        for group, own in zip(self.modality.groups, self.modality.slices.values(), strict=True):
            middle = mean[own].mean() if group.centred else mean.new_zeros(())
            self.mean[own] = middle.float()
            self.size[own] = (square[own].mean() - middle**2).sqrt().float().clamp_min(_SMALLEST)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to normalized [B, C, H, W]."""
        if self.scaling == "picture":
            mean, size = self._measured(x, dims=(1, 2, 3))
            return (x - mean) / size
        return (x - self.mean[:, None, None]) / self.size[:, None, None]

    def of_surface(self, maps: Tensor) -> Tensor:
        """Map surfaces of events alone [B, C', H, W] to what they are among all that is seen."""
        groups = self.modality.groups
        (own,) = (self.modality.slices[group.name] for group in groups if group.maps == ("surface",))
        whole = maps.new_zeros(len(maps), self.modality.channels, *maps.shape[2:])
        whole[:, own] = maps
        return self(whole)[:, own]

    def in_units(self, maps: Tensor) -> Tensor:
        """Undo `of_surface` where the scale is the dataset's: surfaces in their own units, [B, C', H, W]."""
        groups = self.modality.groups
        (own,) = (self.modality.slices[group.name] for group in groups if group.maps == ("surface",))
        return maps * self.size[own, None, None] + self.mean[own, None, None]

    def _measured(self, x: Tensor, dims: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Return mean and size over `dims`, [B or 1, C, 1, 1] each, of every group of channels."""
        means, sizes = [], []
        for group, own in zip(self.modality.groups, self.modality.slices.values(), strict=True):
            part = x[:, own]
            mean = part.mean(dim=dims, keepdim=True, dtype=torch.float32)
            if not group.centred:
                mean = torch.zeros_like(mean)
            size = (part - mean).square().mean(dim=dims, keepdim=True).sqrt().clamp_min(_SMALLEST)
            means.append(mean.expand(-1, part.shape[1], -1, -1))
            sizes.append(size.expand(-1, part.shape[1], -1, -1))
        return torch.cat(means, dim=1), torch.cat(sizes, dim=1)

    @staticmethod
    def today(name: str, modality: Modality) -> str:
        """Return today's name of a tensor of an older file; embeddings had no groups where there was only one.

        Args:
            name: Its name in the file.
            modality: What the network sees.
        """
        first, _, rest = name.partition(".")
        if first == "standardise":
            return f"normalization.{rest}"
        if first != "embedding" or rest.startswith("groups."):
            return name
        only = f"{modality.groups[0].name}." if len(modality.groups) == 1 else ""
        return f"embedding.groups.{only}{rest}"


def _sums(part: Tensor) -> Tensor:
    """Return the sums of values and of their squares over samples [N, C, H, W] and pixels, float64 [2, C]."""
    values = part.float().transpose(0, 1).flatten(1)
    return torch.stack([values.sum(dim=1).double(), values.square().sum(dim=1).double()])


class LinearEmbedding(nn.Module):
    """The light path undone by ridge regressions of several weights: [B, C, H, W] -> [B, S, H, W].

    Fitted in closed form to simulated samples it carries the physics of their setup: it sees the whole wall at
    once, which convolutions would have to learn layer by layer. The weak ridge is sharp and noisy, the strong
    one smooth; what to believe where is left to the network behind it. All ridges share one basis and one
    matrix of weights (`LinearEstimate.shrinkage`). These numbers are not trained by gradients.

    Args:
        channels: Channels of the input.
        size: Its height and width, pixels.
        rank: Most components of the input.
        ridge_multipliers: Ridges in units of the one that is best on unseen objects.
    """

    mean_in: Tensor
    basis: Tensor
    shrinkage: Tensor
    weights: Tensor
    mean_out: Tensor

    def __init__(
        self, channels: int, size: tuple[int, int], rank: int, ridge_multipliers: tuple[float, ...]
    ) -> None:
        super().__init__()
        self.ridge_multipliers, self.shape = ridge_multipliers, (channels, *size)
        pixels = size[0] * size[1]
        rank = min(rank, channels * pixels)
        self.register_buffer("mean_in", torch.zeros(channels * pixels))
        self.register_buffer("basis", torch.zeros(channels * pixels, rank))
        self.register_buffer("shrinkage", torch.zeros(len(ridge_multipliers), rank))
        self.register_buffer("weights", torch.zeros(rank, pixels))
        self.register_buffer("mean_out", torch.zeros(pixels))

    @property
    def rank(self) -> int:
        """Most components of the input."""
        return self.basis.shape[1]

    @property
    def images(self) -> int:
        """Images that come out for each input."""
        return len(self.ridge_multipliers)

    def fit(self, seen: Tensor, truth: Tensor, objects: NDArray[np.str_], seed: int) -> None:
        """Fit the linear estimate to normalized samples and take its numbers; arguments of `fit_linear`."""
        self.take(fit_linear(seen, truth, objects, self.rank, seed))

    def take(self, estimate: LinearEstimate) -> None:
        """Take the numbers of a linear estimate; of lower rank, where there were fewer samples."""
        found = len(estimate.powers)
        for buffer in (self.basis, self.shrinkage, self.weights):
            buffer.zero_()
        self.mean_in.copy_(estimate.mean_in)
        self.basis[:, :found] = estimate.basis
        self.shrinkage[:, :found] = torch.stack([estimate.shrinkage(s) for s in self.ridge_multipliers])
        self.weights[:found] = estimate.weights
        self.mean_out.copy_(estimate.mean_out.flatten())

    def keep(self, rank: int) -> None:
        """Forget all but the `rank` strongest components; the estimate gives them in the order of their power.

        Raises:
            ConfigError: There are not as many.
        """
        if not 1 <= rank <= self.rank:
            raise ConfigError(
                f"the rank is to be {rank}; this embedding has {self.rank}: give 1 to {self.rank}"
            )
        self.basis, self.shrinkage = self.basis[:, :rank].clone(), self.shrinkage[:, :rank].clone()
        self.weights = self.weights[:rank].clone()

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to images [B, S, H, W], about 0..1; in float32 whatever surrounds it.

        Raises:
            DataError: The input has another size than this embedding was made for.
        """
        if tuple(x.shape[1:]) != self.shape:
            raise DataError(f"input is {tuple(x.shape)}; this network's embedding takes [B, {self._wanted}]")
        with torch.autocast(x.device.type, enabled=False):
            code = (x.float().flatten(1) - self.mean_in) @ self.basis  # [B, R]
            images = (code[:, None] * self.shrinkage) @ self.weights + self.mean_out
        return images.unflatten(2, self.shape[1:])

    @property
    def _wanted(self) -> str:
        return ", ".join(str(side) for side in self.shape)


class LinearEmbeddings(nn.Module):
    """Each group of channels undone by its own ridges: [B, C, H, W] -> [B, S, H, W], the first group's first.

    One regression on all would mix them by their noise in the samples that it was fitted to; apart, the
    network behind weighs them, image by image and place by place. A map that shows the target already (the
    surface `likelihood`) stays as it is, and one that is undone elsewhere gives no image.

    Args:
        modality: What is seen; each of its G groups has an embedding.
        size: Height and width of the input, pixels.
        rank: Most components of all groups together, at least one for each.
        ridge_multipliers: As in `LinearEmbedding`.
        solved: Name of a map that shows the target already; groups of it alone are not embedded.
        left_out: Name of a map that is undone elsewhere; groups of it alone give no image.

    Raises:
        ConfigError: The rank is less than the number of groups.
    """

    def __init__(
        self,
        modality: Modality,
        size: tuple[int, int],
        rank: int,
        ridge_multipliers: tuple[float, ...],
        solved: str = "",
        left_out: str = "",
    ) -> None:
        super().__init__()
        self.modality = modality
        self._shown = [group for group in modality.groups if group.maps != (left_out,)]
        embedded = [group for group in self._shown if group.maps != (solved,)]
        ranks = dict(zip(modality.layout, modality.ranks(rank), strict=True))
        self.groups = nn.ModuleDict(
            {
                group.name: LinearEmbedding(group.channels, size, ranks[group.name], ridge_multipliers)
                for group in embedded
            }
        )
        self.shape = (modality.channels, *size)
        self.images = sum(
            self.groups[group.name].images if group in embedded else group.channels  # type: ignore[misc]
            for group in self._shown
        )

    @property
    def _parts(self) -> list[tuple[slice, LinearEmbedding]]:
        slices = self.modality.slices
        return [(slices[name], part) for name, part in self.groups.items()]  # type: ignore[misc]

    @property
    def rank(self) -> int:
        """Most components of all groups together."""
        return sum(part.rank for _, part in self._parts)

    def fit(self, seen: Tensor, truth: Tensor, objects: NDArray[np.str_], seed: int) -> None:
        """Fit each group to normalized samples [N, C, H, W]; arguments as in `fit_linear`."""
        for own, part in self._parts:
            part.fit(seen[:, own], truth, objects, seed)

    def keep(self, rank: int) -> None:
        """Forget all but the strongest components; `rank` of all groups together.

        Args:
            rank: Components to keep.

        Raises:
            ConfigError: There are not as many, or a group would have none.
        """
        least = len(self.modality.groups)
        if not self.groups or not least <= rank <= self.rank:
            raise ConfigError(
                f"the rank is to be {rank}; this embedding has {self.rank}: give {least} to {self.rank}"
            )
        ranks = dict(zip(self.modality.layout, self.modality.ranks(rank), strict=True))
        for name, part in self.groups.items():
            part.keep(ranks[name])  # type: ignore[operator]

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to images [B, S, H, W].

        Raises:
            DataError: The input has another size than this embedding was made for.
        """
        if tuple(x.shape[1:]) != self.shape:
            wanted = ", ".join(str(side) for side in self.shape)
            raise DataError(f"input is {tuple(x.shape)}; this network's embedding takes [B, {wanted}]")
        slices, names = self.modality.slices, [group.name for group in self._shown]
        parts = [
            self.groups[name](x[:, slices[name]]) if name in self.groups else x[:, slices[name]].float()
            for name in names
        ]
        return torch.cat(parts, dim=1)


class FrameOperator:
    """What a calibrated setup makes of an image on the canvas: frame = A x + ambient, at the samples' size.

    Args:
        setup: The calibrated setup (`load_setup` of the calibrated folder).
        sampling: Size of samples and canvas.

    Attributes:
        matrix: A, float32 [h w, cells]: white levels per unit of brightness of a canvas cell.
        ambient: Ambient light, float32 [h w], white levels.
        rows: Rows of the canvas that hold cells; beyond them the target never is.
        sigma: Standard deviation of the noise of a sample pixel, white levels.

    Raises:
        ConfigError: The setup is not linear.
    """

    def __init__(self, setup: Setup, sampling: Sampling) -> None:
        self.size = (sampling.height, sampling.width)
        self.matrix, source = _matrix(setup, self.size, sampling.pitch_m)
        self.ambient = torch.from_numpy(reduce_by_area(setup.ambient_light().numpy(), self.size)).flatten()
        first = (sampling.height - source.height) // 2
        self.rows = slice(first, first + source.height)
        self._camera, shape = setup.frame_camera, setup.shape
        self._pixels = shape[0] * shape[1] / (self.size[0] * self.size[1])  # of the sensor, a sample pixel
        self.sigma = float(self.variance(self.ambient.mean() + 0.1 * setup.gain).sqrt())

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return the frames [N, h, w] that the setup makes of images [N, H, W]."""
        light = pictures[:, self.rows].flatten(1) @ self.matrix.T + self.ambient  # [N, h w]
        return light.unflatten(1, self.size)

    def variance(self, level: Tensor) -> Tensor:
        """Return the variance of a sample pixel at a level, white levels squared: light, reading, rounding."""
        return self._camera.noise_variance(level) / self._pixels


@lru_cache(maxsize=2)  # the networks of a setup ask one after the other
def _matrix(setup: Setup, size: tuple[int, int], pitch_m: float) -> tuple[Tensor, Plane]:
    """Return the matrix from canvas cells to sample pixels, and the cells: rows that the target reaches."""
    cells, height = setup.target_cells(), size[0]
    if cells is not None:
        height = min(height, 2 * round(cells.extent_m[0] / pitch_m / 2))
    plane = Plane(height, size[1], pitch_m)
    matrix = setup.operator(plane, dtype=torch.float32).dense(torch.float32)
    images = matrix.T.reshape(-1, *setup.shape).numpy()
    small = reduce_by_area(images, size).reshape(len(images), -1)
    return torch.from_numpy(small).T.contiguous(), plane


@torch.inference_mode()
def fit_input(
    normalization: InputNormalization,
    embedding: LinearEmbeddings | None,
    subset: Callable[[int], tuple[Tensor, Tensor, NDArray[np.str_]]],
    seed: int,
    *,
    is_new: bool,
    keep_normalization: bool,
) -> None:
    """Give a new network the scale of the data and its linear embedding; one with weights, at most the scale.

    Args:
        normalization: Changed in place; it need not be on the CPU.
        embedding: Changed in place where the network is new.
        subset: Returns at most so many samples: inputs, true images, objects.
        seed: Seed of the embedding's basis.
        is_new: Whether the network has random weights.
        keep_normalization: Whether a network with weights keeps the scale that it has.
    """
    measures = normalization.scaling == "dataset" and (is_new or not keep_normalization)
    embeds = is_new and embedding is not None and len(embedding.groups) > 0
    if not measures and not embeds:
        return
    inputs, truth, names = subset(MOST_SAMPLES)
    device = normalization.mean.device
    if measures:
        normalization.fit(inputs)
    if embeds:
        assert embedding is not None
        if len(np.unique(names)) < 2:  # one object: its time steps stand for objects
            names = np.arange(len(names)).astype(str)
        seen = torch.empty(inputs.shape)
        for start in range(0, len(inputs), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            seen[part] = normalization(inputs[part].float().to(device)).cpu()
        embedding.fit(seen, truth, names, seed)
