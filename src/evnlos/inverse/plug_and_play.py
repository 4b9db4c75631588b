"""A denoiser in the place of the prior's proximal step.

- A small denoiser for `plug_and_play`, trained on pictures of one's own in seconds.
- A denoiser in the place of the prior's proximal step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import LinearOperator, Solution, conjugate_gradient
from evnlos.inverse.problem import BackgroundModel, Problem
from evnlos.types import derive_seed


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


Denoiser = Callable[[torch.Tensor], torch.Tensor]
"""From noisy images [..., h, w] to clean ones."""
_INNER_TOLERANCE = 1e-10
_INNER_ITERATIONS = 500


def plug_and_play(
    operator: LinearOperator,
    measurement: torch.Tensor,
    denoiser: Denoiser,
    rho: float,
    *,
    background_model: BackgroundModel | None = None,
    weight: torch.Tensor | None = None,
    start: torch.Tensor | None = None,
    tolerance: float = 1e-4,
    max_iterations: int = 100,
) -> Solution:
    """Alternate between the data and a denoiser (Venkatakrishnan, Bouman and Wohlberg, GlobalSIP 2013).

    x = argmin |P W (A x - y)|^2 / 2 + rho |x - z + u|^2 / 2, z = denoiser(x + u), u = u + x - z, until x and z
    agree. Where the denoiser is the proximal map of a convex R over rho, the result minimises
    |P W (A x - y)|^2 / 2 + R(x); for any other denoiser nothing ensures that it converges: look at `converged`.

    Args:
        operator: A, linear with an adjoint.
        measurement: y [..., H, W].
        denoiser: From images [..., h, w] to images of the same size; for noise of standard deviation about
            sigma / sqrt(rho), sigma the noise of W y.
        rho: Weight of agreement with the denoised image, squared unit of W A, above 0; scaled with the inverse
            square of the denoiser's noise level.
        background_model: Background to project out.
        weight: Factor on each sample's residual [H, W], one over its noise.
        start: First guess of z; None is black.
        tolerance: |x - z| and the change of z over |z|, at which to stop.
        max_iterations: Most calls of the denoiser.

    Returns:
        The solution, its image the denoised one, z; regularization holds rho.

    Raises:
        ConfigError: rho is not positive.

    Example:
        >>> from evnlos.optics import MatrixTransport
        >>> from evnlos.types import Plane
        >>> identity = MatrixTransport(torch.eye(1), Plane(1, 1, 0.01), (1, 1))
        >>> y = torch.tensor([[1.0]], dtype=torch.float64)
        >>> plug_and_play(identity, y, lambda v: v / 2, 1.0, tolerance=1e-9).image.round(decimals=6)
        tensor([[0.5000]], dtype=torch.float64)
    """
    if not (math.isfinite(rho) and rho > 0):
        raise ConfigError(f"rho is {rho}; give a positive number")
    problem = Problem(operator, measurement, background_model, weight)
    data = problem.adjoint(problem.target)
    z = torch.zeros_like(data) if start is None else start.to(data)
    x, u = z, torch.zeros_like(z)
    history: list[float] = []
    apart = math.inf

    def normal(v: torch.Tensor) -> torch.Tensor:
        return problem.adjoint(problem(v)) + rho * v

    while apart > tolerance and len(history) < max_iterations:
        x = conjugate_gradient(
            normal,
            data + rho * (z - u),
            start=x,
            tolerance=_INNER_TOLERANCE if z.dtype == torch.float64 else 1e-6,
            max_iterations=_INNER_ITERATIONS,
        ).image
        before = z
        z = denoiser(x + u)
        u = u + x - z
        size = max(float(z.norm()), torch.finfo(z.dtype).tiny)
        apart = max(float((x - z).norm()), float((z - before).norm())) / size
        history.append(apart)
    residual = (problem(z) - problem.target).square().sum(dim=(-2, -1)).sqrt()
    noise = float((residual.square().mean() / problem.samples).sqrt())
    return Solution(z, rho, len(history), apart <= tolerance, residual, noise, history=tuple(history))
