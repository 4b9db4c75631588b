"""A small denoiser for `plug_and_play`, trained on pictures of one's own in seconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from evnlos.errors import ConfigError, DataError
from evnlos.seeds import derive_seed


@dataclass(frozen=True)
class DenoiserTraining:
    """How `train_denoiser` trains."""

    width: int = 24
    """Channels of each layer."""
    layers: int = 5
    """Number of 3 x 3 convolutions, 2 or more."""
    sigma: tuple[float, float] = (0.02, 0.4)
    """Smallest and largest standard deviation of the noise, in units of white."""
    steps: int = 600
    """Gradient steps."""
    batch: int = 8
    """Pictures a step."""
    learning_rate: float = 2e-3
    """Step size of Adam at the start; it falls to 0 along a cosine."""

    def __post_init__(self) -> None:
        if min(self.width, self.steps, self.batch) < 1 or self.layers < 2:
            raise ConfigError("DenoiserTraining: give width, steps and batch of 1 or more and 2 layers or more")
        if not 0 < self.sigma[0] <= self.sigma[1]:
            raise ConfigError(f"DenoiserTraining.sigma is {self.sigma}; give 0 < smallest <= largest")


class ResidualDenoiser(nn.Module):
    """Predicts the noise in a picture from the picture and its noise level, and takes it away.

    A stack of 3 x 3 convolutions after Zhang et al., IEEE TIP 26 (2017), with the noise level as a second
    channel (Zhang, Zuo and Zhang, IEEE TIP 27, 2018).

    Args:
        width: Channels of each layer.
        layers: Number of convolutions.
    """

    def __init__(self, width: int = 24, layers: int = 5) -> None:
        super().__init__()
        sides = [2] + [width] * (layers - 1)
        inner = [part for a, b in pairwise(sides) for part in (nn.Conv2d(a, b, 3, padding=1), nn.ReLU())]
        self.body = nn.Sequential(*inner, nn.Conv2d(width, 1, 3, padding=1))

    def forward(self, image: Tensor, sigma: Tensor | float) -> Tensor:
        """Return pictures [..., h, w] without noise of standard deviation `sigma`, a number or [N]."""
        flat = image.reshape(-1, 1, *image.shape[-2:]).float()  # [N, 1, h, w]
        level = torch.as_tensor(sigma, dtype=torch.float32, device=flat.device).reshape(-1, 1, 1, 1)
        noise = self.body(torch.cat([flat, level.expand_as(flat)], dim=1))
        return (flat - noise).reshape(image.shape).to(image)

    def at(self, sigma: float, scale: float = 1.0) -> Callable[[Tensor], Tensor]:
        """Return the denoiser for noise `sigma` and images whose white is `scale`, for `plug_and_play`."""

        @torch.no_grad()
        def denoise(image: Tensor) -> Tensor:
            return scale * self(image / scale, sigma / scale)

        return denoise


def train_denoiser(
    pictures: Tensor, settings: DenoiserTraining | None = None, *, seed: int = 0
) -> ResidualDenoiser:
    """Train a denoiser on clean pictures with Gaussian noise of many strengths; same seed, same weights.

    Args:
        pictures: Clean pictures [N, h, w], 0..1.
        settings: How to train; None is the default, about 20 s for 32 x 32 cells on one core.
        seed: Seed of weights, choice of pictures and noise.

    Raises:
        DataError: The pictures are not real [N, h, w].

    Example:
        >>> squares = torch.zeros(1, 8, 8)
        >>> net = train_denoiser(squares, DenoiserTraining(width=4, layers=2, steps=1))
        >>> net(torch.zeros(3, 8, 8), 0.1).shape
        torch.Size([3, 8, 8])
    """
    settings = settings or DenoiserTraining()
    if pictures.ndim != 3 or not pictures.is_floating_point() or not len(pictures):
        raise DataError(f"pictures are {pictures.dtype} {tuple(pictures.shape)}; give real [N, h, w]")
    draw = torch.Generator().manual_seed(derive_seed(seed, "denoiser"))
    net = ResidualDenoiser(settings.width, settings.layers)
    with torch.no_grad():
        for layer in net.body:
            if isinstance(layer, nn.Conv2d):
                reach = (6.0 / (9 * layer.in_channels)) ** 0.5  # He's rule
                layer.weight.copy_((2 * torch.rand(layer.weight.shape, generator=draw) - 1) * reach)
                layer.bias.zero_()  # type: ignore[union-attr]
        last = net.body[-1]
        assert isinstance(last, nn.Conv2d)
        last.weight.mul_(0.1)  # begin near the identity
    optimiser = torch.optim.Adam(net.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
    low, high = settings.sigma
    clean = pictures.float()
    for _ in range(settings.steps):
        batch = clean[torch.randint(len(clean), (settings.batch,), generator=draw)]
        sigma = low * (high / low) ** torch.rand(settings.batch, generator=draw)
        noisy = batch + sigma[:, None, None] * torch.randn(batch.shape, generator=draw)
        # Over the noise's variance: otherwise only the strongest noise would count.
        loss = ((net(noisy, sigma) - batch).square().mean(dim=(1, 2)) / sigma.square()).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return net.eval()
