"""What a network knows before its first step: the scale of its inputs, and the light path undone linearly."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from evnlos.errors import ConfigError, DataError
from evnlos.model.linear import LinearEstimate, fit_linear, rank_of_events

Scaling = Literal["dataset", "picture"]

_SMALLEST = 1e-3


class Standardise(nn.Module):
    """Bring inputs [B, C, H, W] to mean 0 and size 1.

    A frame loses its mean and is divided by its standard deviation; the two maps of events keep 0 = "no event",
    and are divided by the root mean square of both. With the scaling "dataset" these numbers are those of a
    whole dataset, so that the brightness of one picture against another still counts; with "picture" they are
    each picture's own, and gain and a constant ambient light drop out.

    Args:
        channels: 1 (frame), 2 (event) or 3 (fusion, the frame first).
        scaling: Whose mean and size.
    """

    mean: Tensor
    size: Tensor

    def __init__(self, channels: int, scaling: Scaling) -> None:
        super().__init__()
        self.scaling = scaling
        self.frames = channels % 2
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("size", torch.ones(channels))

    def fit(self, inputs: Tensor) -> None:
        """Take mean and size from the inputs of a dataset, [N, C, H, W]."""
        mean, size = self._measured(inputs, dims=(0, 1, 2, 3))
        self.mean.copy_(mean[0, :, 0, 0])
        self.size.copy_(size[0, :, 0, 0])

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to standardised [B, C, H, W]."""
        if self.scaling == "picture":
            mean, size = self._measured(x, dims=(1, 2, 3))
            return (x - mean) / size
        return (x - self.mean[:, None, None]) / self.size[:, None, None]

    def _measured(self, x: Tensor, dims: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Return mean and size over `dims`, [B or 1, C, 1, 1] each, frame and events apart."""
        means, sizes = [], []
        for part in (x[:, : self.frames], x[:, self.frames :]):
            if not part.shape[1]:
                continue
            mean = part.mean(dim=dims, keepdim=True, dtype=torch.float32)
            if means or not self.frames:  # events
                mean = torch.zeros_like(mean)
            size = (part - mean).square().mean(dim=dims, keepdim=True).sqrt().clamp_min(_SMALLEST)
            means.append(mean.expand(-1, part.shape[1], -1, -1))
            sizes.append(size.expand(-1, part.shape[1], -1, -1))
        return torch.cat(means, dim=1), torch.cat(sizes, dim=1)


class LinearEmbedding(nn.Module):
    """The light path undone by ridge regressions of several strengths: [B, C, H, W] -> [B, S, H, W].

    Fitted in closed form to simulated samples it carries the physics of their rig: it sees the whole wall at
    once, which convolutions would have to learn layer by layer. The weak ridge is sharp and noisy, the strong
    one smooth; what to believe where is left to the network behind it. All strengths share one basis and one
    matrix of weights (`LinearEstimate.shrinkage`). These numbers are not trained by gradients.

    Args:
        channels: Channels of the input.
        size: Its height and width, pixels.
        rank: Most components of the input.
        strengths: Ridges in units of the one that is best on unseen objects.
    """

    mean_in: Tensor
    basis: Tensor
    shrinkage: Tensor
    weights: Tensor
    mean_out: Tensor

    def __init__(self, channels: int, size: tuple[int, int], rank: int, strengths: tuple[float, ...]) -> None:
        super().__init__()
        self.strengths, self.shape = strengths, (channels, *size)
        pixels = size[0] * size[1]
        rank = min(rank, channels * pixels)
        self.register_buffer("mean_in", torch.zeros(channels * pixels))
        self.register_buffer("basis", torch.zeros(channels * pixels, rank))
        self.register_buffer("shrinkage", torch.zeros(len(strengths), rank))
        self.register_buffer("weights", torch.zeros(rank, pixels))
        self.register_buffer("mean_out", torch.zeros(pixels))

    @property
    def rank(self) -> int:
        """Most components of the input."""
        return self.basis.shape[1]

    @property
    def pictures(self) -> int:
        """Pictures that come out for each input."""
        return len(self.strengths)

    def fit(self, seen: Tensor, truth: Tensor, objects: NDArray[np.str_], seed: int) -> None:
        """Fit the linear estimate to standardised samples and take its numbers; arguments of `fit_linear`."""
        self.take(fit_linear(seen, truth, objects, self.rank, seed))

    def take(self, estimate: LinearEstimate) -> None:
        """Take the numbers of a linear estimate; of lower rank, where there were fewer samples."""
        found = len(estimate.powers)
        for buffer in (self.basis, self.shrinkage, self.weights):
            buffer.zero_()
        self.mean_in.copy_(estimate.mean_in)
        self.basis[:, :found] = estimate.basis
        self.shrinkage[:, :found] = torch.stack([estimate.shrinkage(s) for s in self.strengths])
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
        """Map [B, C, H, W] to pictures [B, S, H, W], about 0..1; in float32 whatever surrounds it.

        Raises:
            DataError: The input has another size than this embedding was made for.
        """
        if tuple(x.shape[1:]) != self.shape:
            raise DataError(f"input is {tuple(x.shape)}; this network's embedding takes [B, {self._wanted}]")
        with torch.autocast(x.device.type, enabled=False):
            code = (x.float().flatten(1) - self.mean_in) @ self.basis  # [B, R]
            pictures = (code[:, None] * self.shrinkage) @ self.weights + self.mean_out
        return pictures.unflatten(2, self.shape[1:])

    @property
    def _wanted(self) -> str:
        return ", ".join(str(side) for side in self.shape)


class FusionEmbedding(nn.Module):
    """Frame and events undone each by its own ridges: [B, 3, H, W] -> [B, 2 S, H, W], the frame's first.

    One regression on both would mix them by their noise in the samples that it was fitted to; apart, the
    network behind weighs them, picture by picture and place by place.

    Args:
        size: Height and width of the input, pixels.
        rank: Most components of frame and events together, at least 2.
        strengths: As in `LinearEmbedding`.

    Raises:
        ConfigError: The rank is 1.
    """

    def __init__(self, size: tuple[int, int], rank: int, strengths: tuple[float, ...]) -> None:
        super().__init__()
        if rank < 2:
            raise ConfigError(f"the rank is {rank}; frame and events need one component each: give 2 or more")
        self.frame = LinearEmbedding(1, size, rank - rank_of_events(rank), strengths)
        self.events = LinearEmbedding(2, size, rank_of_events(rank), strengths)
        self.shape = (3, *size)

    @property
    def rank(self) -> int:
        """Most components of frame and events together."""
        return self.frame.rank + self.events.rank

    @property
    def pictures(self) -> int:
        """Pictures that come out for each input."""
        return self.frame.pictures + self.events.pictures

    def fit(self, seen: Tensor, truth: Tensor, objects: NDArray[np.str_], seed: int) -> None:
        """Fit both to standardised samples [N, 3, H, W]; arguments as in `fit_linear`."""
        self.frame.fit(seen[:, :1], truth, objects, seed)
        self.events.fit(seen[:, 1:], truth, objects, seed)

    def keep(self, rank: int) -> None:
        """Forget all but the strongest components; `rank` of frame and events together.

        Raises:
            ConfigError: There are not as many, or there would not be one of each.
        """
        if not 2 <= rank <= self.rank:
            raise ConfigError(
                f"the rank is to be {rank}; this embedding has {self.rank}: give 2 to {self.rank}"
            )
        self.frame.keep(rank - rank_of_events(rank))
        self.events.keep(rank_of_events(rank))

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, 3, H, W] to pictures [B, 2 S, H, W]."""
        return torch.cat([self.frame(x[:, :1]), self.events(x[:, 1:])], dim=1)


def embedding_for(
    channels: int, size: tuple[int, int], rank: int, strengths: tuple[float, ...]
) -> LinearEmbedding | FusionEmbedding:
    """Return an empty embedding for what a network sees: of frame (1), events (2) or both (3 channels)."""
    if channels == 3:
        return FusionEmbedding(size, rank, strengths)
    return LinearEmbedding(channels, size, rank, strengths)
