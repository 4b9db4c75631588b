"""What the two total-variation methods share: their settings, the prox of the variation, the gap."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from evnlos.solver.operators import Gradient

Box = tuple[float, float]
CHECK_EVERY = 10


@dataclass(frozen=True)
class Settings:
    """Bounds of the brightness, the discrete gradient, and when to stop."""

    box: Box
    gradient: Gradient
    tolerance: float
    max_iterations: int


def shrunk(field: torch.Tensor, radius: float) -> torch.Tensor:
    """Return the vectors [..., 2, h, w], those longer than `radius` cut to it."""
    length = field.square().sum(dim=-3, keepdim=True).sqrt()
    return field / (length / radius).clamp(min=1)


def gap(
    x: torch.Tensor,
    squared_residual: torch.Tensor,
    edges: torch.Tensor,
    squared_dual: torch.Tensor,
    dual_on_target: torch.Tensor,
    back: torch.Tensor,
    lam: float,
    box: Box,
) -> float:
    """Return the primal less the dual objective; open bounds are taken at twice the image's largest value.

    Args:
        x: Image within the box, [..., h, w].
        squared_residual: |B x - b|^2, summed over the batch.
        edges: grad x.
        squared_dual: |q|^2 of the data term's dual.
        dual_on_target: <q, b>.
        back: B^T q + grad^T p, p the variation's dual, nowhere longer than lam.
        lam: Weight of the variation.
        box: Bounds.
    """
    reach = 2 * float(x.abs().max()) + torch.finfo(x.dtype).tiny
    low, high = max(box[0], -reach), min(box[1], reach)
    variation = edges.square().sum(dim=-3).sqrt().sum()
    # sup over the box of -<x, K^T u>
    worst = torch.maximum(-low * back, -high * back).sum()
    primal, dual = 0.5 * squared_residual + lam * variation, -0.5 * squared_dual - dual_on_target - worst
    return float(primal - dual)
