"""A whole pass as one measurement: all positions seen from the plate, pooled, and one picture of it."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from evnlos.errors import ConfigError, DataError
from evnlos.model.embedding import Standardise, embedding_for
from evnlos.model.plates import on_canvas
from evnlos.model.unet import ResidualUNet, UNetConfig
from evnlos.types import Plane

PLATE_M = 0.1
"""Side of the square around the plate's centre that a joint network draws, metres: 8 cm and a margin."""

FINER = 2
"""Pixels of that square to a pixel of the canvas: positions between pixels tell more than one of them does."""

_CELLS = 4  # the plate's side is a multiple of so many pixels


class JointNetwork(nn.Module):
    """All positions of a pass -> the plate: embed each, look at it from the plate, take the mean, then a U-Net.

    The linear embedding of each position is read at the plate's own pixels, wherever the plate was then. The
    mean over the positions has less noise the more there are, so weaker ridges, sharper and noisier, become
    useful. What is trained by gradients is the U-Net behind the mean. Pooling over a set after Zaheer et al.,
    Deep Sets, NeurIPS 2017; the alignment is the known motion.

    Args:
        channels: Channels of the maps: frame 1, event 2, fusion 3.
        config: The U-Net and the embedding; its rank is not 0.
        size: Height and width of the maps, pixels.
        pitch_m: Pixel of the maps on the target's canvas, metres.

    Raises:
        ConfigError: There is no embedding.
    """

    def __init__(self, channels: int, config: UNetConfig, size: tuple[int, int], pitch_m: float) -> None:
        super().__init__()
        if not config.rank:
            raise ConfigError("UNetConfig.rank is 0; a joint network pools its linear embedding: give a rank")
        self.channels, self.config, self.size = channels, config, size
        self.standardise = Standardise(channels, config.scaling)
        self.embedding = embedding_for(channels, size, config.rank, config.strengths)
        self.unet = ResidualUNet(self.embedding.pictures, replace(config, rank=0, scaling="dataset"))
        fine_m = pitch_m / FINER
        side = max(1, round(PLATE_M / fine_m / _CELLS)) * _CELLS
        across = (torch.arange(side) + 0.5 - side / 2) * fine_m
        self._place_m = torch.stack(torch.meshgrid(across, across, indexing="xy"), dim=-1)  # [P, P, 2]
        self._canvas_m = torch.tensor([size[1], size[0]]) * pitch_m
        self._pitch_m, self._side_m = pitch_m, side * fine_m

    @torch.no_grad()
    def pooled(self, inputs: Tensor, position_m: Tensor) -> Tensor:
        """Return the mean of the embedded positions as the plate sees them, [S, P, P].

        Args:
            inputs: What was measured at N positions, [N, C, H, W].
            position_m: The plate's centre on the canvas, (x, y) in metres, [N, 2].

        Raises:
            DataError: The plate is off the canvas at all positions.
        """
        total = seen = torch.zeros((), device=inputs.device)
        for part, at in zip(inputs.split(64), position_m.split(64), strict=True):
            light, count = self._from_plate(self.embedding(self.standardise(part.float())), at)
            total, seen = total + light, seen + count
        if not bool(seen.any()):
            raise DataError("the plate is off the canvas at every position; give positions within the travel")
        return total / seen.clamp_min(1)

    @torch.no_grad()
    def fit_scale(self, maps: Tensor) -> None:
        """Take mean and spread of each map from pooled maps [M, S, P, P]."""
        values = maps.float()
        self.unet.standardise.mean.copy_(values.mean(dim=(0, 2, 3)))
        self.unet.standardise.size.copy_(values.std(dim=(0, 2, 3)).clamp_min(1e-6))

    def forward(self, maps: Tensor) -> Tensor:
        """Map pooled maps [B, S, P, P] to pictures of the plate [B, 1, P, P], 0..1."""
        return self.unet(maps)

    def drawn(self, plate: Tensor, position_m: Tensor) -> Tensor:
        """Return the plate on the canvas at each position.

        Args:
            plate: Picture of the plate, [P, P].
            position_m: Its centre, (x, y) in metres, [N, 2].

        Returns:
            Pictures [N, H, W]; each pixel is the mean of `FINER` x `FINER` samples.
        """
        height, width = self.size
        canvas = Plane(height * FINER, width * FINER, self._pitch_m / FINER)
        return F.avg_pool2d(on_canvas(plate, canvas, position_m, self._side_m), FINER)

    def plate_of(self, pictures: Tensor, position_m: Tensor) -> Tensor:
        """Return the plate [P, P] that pictures [N, H, W] of all positions show, their mean: what to learn."""
        light, seen = self._from_plate(pictures[:, None].float(), position_m)
        return light[0] / seen.clamp_min(1)

    @torch.inference_mode()
    def see(self, inputs: Tensor, position_m: Tensor) -> Tensor:
        """Return the picture of the plate, [P, P], 0..1, from `inputs` [N, C, H, W] at `position_m` [N, 2]."""
        return self(self.pooled(inputs, position_m)[None])[0, 0]

    def _from_plate(self, pictures: Tensor, position_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sum of pictures [N, S, H, W] as the plate sees them, [S, P, P], and how many, [P, P]."""
        place = self._place_m + position_m.float().cpu()[:, None, None]  # [N, P, P, 2]
        grid = (place / (self._canvas_m / 2)).to(pictures.device)  # -1..1 from edge to edge
        inside = (grid.abs() <= 1).all(dim=-1)  # [N, P, P]
        moved = F.grid_sample(pictures, grid, padding_mode="border", align_corners=False)
        return (moved * inside[:, None]).sum(dim=0), inside.sum(dim=0)


def new_network(
    channels: int, config: UNetConfig, size: tuple[int, int], pitch_m: float, *, joint: bool
) -> ResidualUNet | JointNetwork:
    """Return a network with random weights: of single positions, or a joint one of whole passes.

    Args:
        channels: Channels of the maps: frame 1, event 2, fusion 3.
        config: The U-Net and the embedding.
        size: Height and width of the maps, pixels.
        pitch_m: Pixel of the maps on the target's canvas, metres; only a joint network needs it.
        joint: Which of the two.
    """
    return JointNetwork(channels, config, size, pitch_m) if joint else ResidualUNet(channels, config, size)
