"""A denoiser in the place of the prior's proximal step."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from evnlos.errors import ConfigError
from evnlos.solver.conjugate_gradient import conjugate_gradient
from evnlos.solver.operators import LinearOperator
from evnlos.solver.problem import Background, Problem
from evnlos.solver.solution import Solution

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
    nuisance: Background | None = None,
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
        nuisance: Background to project out.
        weight: Factor on each sample's residual [H, W], one over its noise.
        start: First guess of z; None is black.
        tolerance: |x - z| and the change of z over |z|, at which to stop.
        max_iterations: Most calls of the denoiser.

    Returns:
        The solution, its image the denoised one, z; lam holds rho.

    Raises:
        ConfigError: rho is not positive.

    Example:
        >>> from evnlos.transport import MatrixTransport
        >>> from evnlos.types import Plane
        >>> identity = MatrixTransport(torch.eye(1), Plane(1, 1, 0.01), (1, 1))
        >>> y = torch.tensor([[1.0]], dtype=torch.float64)
        >>> plug_and_play(identity, y, lambda v: v / 2, 1.0, tolerance=1e-9).image.round(decimals=6)
        tensor([[0.5000]], dtype=torch.float64)
    """
    if not (math.isfinite(rho) and rho > 0):
        raise ConfigError(f"rho is {rho}; give a positive number")
    problem = Problem(operator, measurement, nuisance, weight)
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
