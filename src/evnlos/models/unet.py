"""The U-Net of residual blocks, and the reconstructor of single time steps that stands on it."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from evnlos.data import Modality, Sampling, as_modality
from evnlos.errors import ConfigError, DataError
from evnlos.models.embedding import InputNormalization, LinearEmbeddings, Scaling, fit_input
from evnlos.models.reconstructor import RECONSTRUCTORS, Drawn, Reconstructor, ReconstructorSettings

PARTS = {
    "encoder": ("unet.stem", "unet.encoder", "unet.down"),
    "latent": ("unet.latent",),
    "decoder": ("unet.up", "unet.decoder", "unet.head"),
}
"""Parts of a U-Net that a fine-tuning may keep."""


@RECONSTRUCTORS.register
@dataclass(frozen=True)
class UNetConfig(ReconstructorSettings):
    """A U-Net of single time steps behind a linear embedding: kind `unet`."""

    kind: str = "unet"
    """Kind of the reconstructor."""
    width: int = 48
    """Channels at the finest level; they double at each level down, up to 8 times."""
    depth: int = 2
    """Number of levels below the finest one; each halves the sides."""
    blocks: int = 1
    """Residual blocks at each level, on the way down and on the way up."""
    shuffle: int = 4
    """Side of the input cells that are folded into channels before the first level, pixels (1 = none)."""
    groups: int = 4
    """Groups of each group normalisation; divides `width`."""
    scaling: Scaling = "dataset"
    """Whose mean and size the inputs are divided by: the `dataset`'s, or each `picture`'s own."""
    rank: int = 256
    """Components of the linear embedding in front of the U-Net (0 = none: the U-Net sees the maps)."""
    ridge_multipliers: tuple[float, ...] = (0.03, 1.0, 30.0)
    """Ridges of the linear embedding, in units of the best one; each gives the U-Net one image for each
    group of channels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("width", "depth", "blocks", "shuffle", "groups"):
            if getattr(self, name) < 1:
                raise ConfigError(f"UNetConfig.{name} is {getattr(self, name)}; give at least 1")
        if self.rank < 0:
            raise ConfigError(f"UNetConfig.rank is {self.rank}; give 0 (no embedding) or more")
        if self.rank and not (
            self.ridge_multipliers and all(0 < s < float("inf") for s in self.ridge_multipliers)
        ):
            raise ConfigError(
                f"UNetConfig.ridge_multipliers is {self.ridge_multipliers}; give one positive number or several"
            )
        if self.width % self.groups:
            raise ConfigError(f"UNetConfig.groups is {self.groups}; give a divisor of the width {self.width}")

    @property
    def least_tensors(self) -> int:
        """Each block has more than one tensor."""
        return self.depth * self.blocks

    def build(self, modality: str | Modality, sampling: Sampling) -> Reconstructor:
        """Return a reconstructor of single time steps with random weights."""
        return UNetReconstructor(as_modality(modality).seeing(sampling.surface), self, sampling)


class ResidualBlock(nn.Module):
    """Two normalised 3 x 3 convolutions beside the identity (1 x 1 where the channels change)."""

    def __init__(self, inside: int, outside: int, groups: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, inside)
        self.conv1 = nn.Conv2d(inside, outside, 3, padding=1)
        self.norm2 = nn.GroupNorm(groups, outside)
        self.conv2 = nn.Conv2d(outside, outside, 3, padding=1)
        self.skip = nn.Conv2d(inside, outside, 1) if inside != outside else nn.Identity()
        nn.init.zeros_(self.conv2.weight)  # each block starts as the identity

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, inside, H, W] to [B, outside, H, W]."""
        if torch.is_grad_enabled() and not x.requires_grad:
            # Behind frozen layers: on a CPU torch 2.13 crashes in the backward pass of a group norm, in
            # channels-last layout, whose input needs no gradient.
            x = x.detach().requires_grad_()
        y = self.conv1(F.silu(self.norm1(x)))
        y = self.conv2(F.silu(self.norm2(y)))
        return self.skip(x) + y


class ResidualUNet(nn.Module):
    """U-Net of residual blocks with skip connections: maps [B, C, H, W] -> image [B, 1, H, W], 0..1 (sigmoid).

    It pads by repeating the border up to a multiple of shuffle * 2^depth and crops its output, so that it takes
    sides of any length. After Ronneberger, Fischer and Brox, MICCAI 2015 (U-Net) and He et al., ECCV 2016
    (pre-activation residual block).

    Args:
        channels: Channels of the input.
        config: Width, depth, blocks, shuffle and groups; the rest is for what stands in front of it.

    Example:
        >>> net = ResidualUNet(5, UNetConfig(width=8))
        >>> net(torch.zeros(1, 5, 50, 75)).shape
        torch.Size([1, 1, 50, 75])
    """

    def __init__(self, channels: int, config: UNetConfig = UNetConfig()) -> None:
        super().__init__()
        self.channels, self.config = channels, config
        cell, groups, blocks = config.shuffle**2, config.groups, config.blocks
        widths = [config.width * min(2**level, 8) for level in range(config.depth + 1)]

        def stage(inside: int, outside: int) -> nn.Sequential:
            sides = [inside] + [outside] * blocks
            return nn.Sequential(*(ResidualBlock(a, b, groups) for a, b in pairwise(sides)))

        self.stem = nn.Conv2d(channels * cell, widths[0], 3, padding=1)
        self.encoder = nn.ModuleList(stage(w, w) for w in widths[:-1])
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, 2) for a, b in pairwise(widths))
        self.latent = nn.Sequential(stage(widths[-1], widths[-1]), stage(widths[-1], widths[-1]))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(widths))
        self.decoder = nn.ModuleList(stage(2 * w, w) for w in widths[:-1])
        self.head = nn.Conv2d(widths[0], cell, 3, padding=1)
        # An image is dark except for a few per cent of its pixels: start there.
        nn.init.constant_(self.head.bias, -2.0)  # type: ignore[arg-type]

    @property
    def multiple(self) -> int:
        """The length that the padded sides are a multiple of, pixels."""
        return self.config.shuffle * 2**self.config.depth

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to [B, 1, H, W] in 0..1; raises as `log_odds` does."""
        return torch.sigmoid(self.log_odds(x))

    def log_odds(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to what the sigmoid is taken of, float32 [B, 1, H, W].

        Raises:
            DataError: The input does not have the network's number of channels.
        """
        if x.ndim != 4 or x.shape[1] != self.channels:
            raise DataError(f"input is {tuple(x.shape)}; this network takes [B, {self.channels}, H, W]")
        height, width = x.shape[-2:]
        x = F.pad(x, (0, -width % self.multiple, 0, -height % self.multiple), mode="replicate")
        x = self.stem(F.pixel_unshuffle(x, self.config.shuffle))  # [B, width, H/s, W/s]
        skips = []
        for encode, down in zip(self.encoder, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)  # [B, 2 width, H/2, W/2]
        x = self.latent(x)
        for up, decode, skip in zip(self.up[::-1], self.decoder[::-1], skips[::-1], strict=True):
            x = F.interpolate(up(x), scale_factor=2, mode="nearest")
            x = decode(torch.cat([x, skip], dim=1))
        x = F.pixel_shuffle(self.head(x), self.config.shuffle)  # [B, 1, H, W]
        return x[..., :height, :width].float()


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


class UNetReconstructor(Reconstructor):
    """One time step -> one image: normalization, linear embedding (where `settings.rank` is not 0), U-Net.

    Normalization and embedding hold numbers of the training's dataset, fitted in closed form; the U-Net is
    trained by gradients. Without an embedding, inputs of any size are taken.

    Args:
        modality: What it sees.
        settings: U-Net and embedding.
        sampling: Size of the samples, which the embedding is made for.

    Example:
        >>> sampling = Sampling(height=50, width=75, scored_rows=40)
        >>> network = UNetConfig(width=8).build("fusion", sampling)
        >>> network(torch.zeros(1, 3, 50, 75)).shape
        torch.Size([1, 1, 50, 75])
    """

    parts = PARTS

    def __init__(self, modality: Modality, settings: UNetConfig, sampling: Sampling) -> None:
        super().__init__(modality, settings, sampling)
        self.settings: UNetConfig = settings
        self.normalization = InputNormalization(modality, settings.scaling)
        self.embedding: LinearEmbeddings | None = None
        channels = modality.channels
        if settings.rank:
            size = (sampling.height, sampling.width)
            self.embedding = LinearEmbeddings(modality, size, settings.rank, settings.ridge_multipliers)
            channels = self.embedding.images
        self.unet = ResidualUNet(channels, settings)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to [B, 1, H, W] in 0..1.

        Raises:
            DataError: The input does not have the modality's channels, or not the size of the embedding.
        """
        if x.ndim != 4 or x.shape[1] != self.modality.channels:
            raise DataError(
                f"input is {tuple(x.shape)}; this network takes [B, {self.modality.channels}, H, W]"
            )
        x = self.normalization(x)
        return self.unet(x if self.embedding is None else self.embedding(x))

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

    def reduced(self, rank: int) -> Reconstructor:
        """Return a copy whose linear embedding has fewer components, the strongest."""
        if self.embedding is None:
            return super().reduced(rank)
        copy = deepcopy(self)
        assert copy.embedding is not None
        copy.embedding.keep(rank)
        copy.settings = replace(copy.settings, rank=rank)
        return copy

    @classmethod
    def today(cls, name: str, modality: Modality) -> str:
        """Return today's name of a tensor; before, the layers of the U-Net stood beside the embedding."""
        first = name.split(".")[0]
        if first in ("stem", "encoder", "down", "latent", "up", "decoder", "head"):
            return f"unet.{name}"
        return InputNormalization.today(name, modality)
