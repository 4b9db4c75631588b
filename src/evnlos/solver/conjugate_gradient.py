"""Conjugate gradients for a batch of symmetric systems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class Solved:
    """Solution of a linear system.

    Args:
        image: x [..., h, w].
        iterations: Number of products with the matrix.
        converged: Whether every system of the batch met the tolerance.
        history: Largest |rhs - H x| / |rhs| of the batch after each iteration.
    """

    image: torch.Tensor
    iterations: int
    converged: bool
    history: tuple[float, ...]


def conjugate_gradient(
    normal: Callable[[torch.Tensor], torch.Tensor],
    rhs: torch.Tensor,
    *,
    start: torch.Tensor | None = None,
    tolerance: float = 1e-8,
    max_iterations: int = 1000,
) -> Solved:
    """Solve H x = rhs for a symmetric, positive semi-definite H (Hestenes and Stiefel 1952).

    Args:
        normal: x -> H x on images [..., h, w]; acts on each image of the batch by itself.
        rhs: Right-hand sides [..., h, w].
        start: First guess; None is 0.
        tolerance: Relative residual |rhs - H x| / |rhs| at which to stop.
        max_iterations: Largest number of products with H.

    Example:
        >>> conjugate_gradient(lambda x: 4 * x, torch.tensor([[8.0]])).image
        tensor([[2.]])
    """
    x = torch.zeros_like(rhs) if start is None else start.clone()
    r = rhs.clone() if start is None else rhs - normal(x)
    scale = _dot(rhs, rhs).sqrt().clamp(min=torch.finfo(rhs.dtype).tiny)
    p, rr = r.clone(), _dot(r, r)
    history: list[float] = []
    worst = float((rr.sqrt() / scale).max())
    while worst > tolerance and len(history) < max_iterations:
        h = normal(p)
        # A system that is solved already has p = 0: its step is 0, not 0 / 0.
        step = rr / _dot(p, h).clamp(min=torch.finfo(rhs.dtype).tiny)
        x = x + step * p
        r = r - step * h
        before, rr = rr, _dot(r, r)
        p = r + rr / before.clamp(min=torch.finfo(rhs.dtype).tiny) * p
        worst = float((rr.sqrt() / scale).max())
        history.append(worst)
    return Solved(x, len(history), worst <= tolerance, tuple(history))


def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a * b).sum(dim=(-2, -1), keepdim=True)
