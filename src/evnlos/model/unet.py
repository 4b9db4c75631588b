"""The reconstruction network on one page: a U-Net of residual blocks behind the light path undone linearly."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from evnlos.errors import ConfigError, DataError
from evnlos.model.embedding import FusionEmbedding, LinearEmbedding, Scaling, Standardise, embedding_for


@dataclass(frozen=True)
class UNetConfig:
    """Size of a `ResidualUNet`."""

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
    strengths: tuple[float, ...] = (0.03, 1.0, 30.0)
    """Ridges of the linear embedding, in units of the best one; each gives the U-Net one picture, or one of the
    frame and one of the events."""

    def __post_init__(self) -> None:
        for name in ("width", "depth", "blocks", "shuffle", "groups"):
            if getattr(self, name) < 1:
                raise ConfigError(f"UNetConfig.{name} is {getattr(self, name)}; give at least 1")
        if self.rank < 0:
            raise ConfigError(f"UNetConfig.rank is {self.rank}; give 0 (no embedding) or more")
        if self.rank and not (self.strengths and all(0 < s < float("inf") for s in self.strengths)):
            raise ConfigError(f"UNetConfig.strengths is {self.strengths}; give one positive number or several")
        if self.width % self.groups:
            raise ConfigError(f"UNetConfig.groups is {self.groups}; give a divisor of the width {self.width}")


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
    """U-Net of residual blocks with skip connections: what the camera saw [B, C, H, W] -> picture [B, 1, H, W].

    The inputs are standardised and, where `config.rank` is not 0, turned into pictures by the linear embedding;
    both hold numbers of the training's dataset. The output is in 0..1 (a sigmoid). The network pads by
    repeating the border up to a multiple of shuffle * 2^depth and crops its output; without embedding it takes
    sides of any length. After Ronneberger, Fischer and Brox, MICCAI 2015 (U-Net) and He et al., ECCV 2016
    (pre-activation residual block).

    Args:
        channels: Channels of the input: frame 1, event 2, fusion 3.
        config: Width, depth, blocks, embedding.
        size: Height and width of the input, pixels; the embedding needs them.

    Raises:
        ConfigError: There is to be an embedding, and the size is missing.

    Example:
        >>> net = ResidualUNet(3, UNetConfig(width=8), size=(50, 75))
        >>> net(torch.zeros(1, 3, 50, 75)).shape
        torch.Size([1, 1, 50, 75])
    """

    def __init__(
        self, channels: int, config: UNetConfig = UNetConfig(), size: tuple[int, int] | None = None
    ) -> None:
        super().__init__()
        self.channels, self.config = channels, config
        self.standardise = Standardise(channels, config.scaling)
        self.embedding: LinearEmbedding | FusionEmbedding | None = None
        if config.rank:
            if size is None:
                raise ConfigError(f"UNetConfig.rank is {config.rank}; give the size of the inputs, or rank=0")
            self.embedding = embedding_for(channels, size, config.rank, config.strengths)
            channels = self.embedding.pictures
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
        # A picture is dark except for a few per cent of its pixels: start there.
        nn.init.constant_(self.head.bias, -2.0)  # type: ignore[arg-type]

    @property
    def multiple(self) -> int:
        """The length that the padded sides are a multiple of, pixels."""
        return self.config.shuffle * 2**self.config.depth

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to [B, 1, H, W] in 0..1.

        Raises:
            DataError: The input does not have the network's number of channels.
        """
        if x.ndim != 4 or x.shape[1] != self.channels:
            raise DataError(f"input is {tuple(x.shape)}; this network takes [B, {self.channels}, H, W]")
        height, width = x.shape[-2:]
        x = self.standardise(x)
        if self.embedding is not None:
            x = self.embedding(x)  # [B, pictures, H, W]
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
        return torch.sigmoid(x[..., :height, :width].float())
