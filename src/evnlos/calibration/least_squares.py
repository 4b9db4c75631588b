"""Nonlinear least squares with few parameters: Levenberg-Marquardt with forward differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

Residual = Callable[[NDArray[np.float64]], torch.Tensor]
"""From the parameters [P] to the residual, any shape."""


@dataclass(frozen=True)
class Minimum:
    """Where a search ended.

    Args:
        values: Parameters [P].
        error: Standard error of each parameter [P], from the residual's own variance; infinite where the data
            say nothing.
        rms: Root mean square of the residual.
        evaluations: How often the residual was computed.
    """

    values: NDArray[np.float64]
    error: NDArray[np.float64]
    rms: float
    evaluations: int


def levenberg_marquardt(
    residual: Residual,
    start: Sequence[float],
    steps: Sequence[float],
    bounds: Sequence[tuple[float, float]],
    *,
    iterations: int = 15,
    tolerance: float = 1e-4,
) -> Minimum:
    """Minimise the sum of squares of `residual`, staying within bounds.

    Each step solves (J^T J + damping diag(J^T J)) d = -J^T r (Marquardt 1963). J comes from forward
    differences, so that any simulator will do.

    Args:
        residual: The function; it must have the same length everywhere.
        start: First parameters [P], inside the bounds.
        steps: Step of the difference for each parameter [P], in its own unit, above 0.
        bounds: Lowest and highest value of each parameter [P].
        iterations: Most steps that are taken.
        tolerance: The search ends when a step lowers the root mean square by less than this fraction.

    Example:
        >>> t = torch.linspace(0, 1, 20, dtype=torch.float64)
        >>> truth = torch.exp(-3 * t)
        >>> found = levenberg_marquardt(lambda p: torch.exp(-p[0] * t) - truth, [1.0], [1e-4], [(0.1, 10.0)])
        >>> round(float(found.values[0]), 3)
        3.0
    """
    low, high = np.array(bounds, dtype=np.float64).T
    step = np.asarray(steps, dtype=np.float64)
    values = np.clip(np.asarray(start, dtype=np.float64), low, high)
    now = residual(values).flatten()
    damping, count = 1e-3, 1
    jacobian = now.new_zeros((len(now), len(values)))
    for _ in range(iterations):
        jacobian = forward_jacobian(residual, values, now, step, high)
        count += len(values)
        normal, slope = (jacobian.T @ jacobian).double().numpy(), (jacobian.T @ now).double().numpy()
        # A parameter that rests on a bound and wants to leave is not part of this step.
        inside = ~(((values <= low) & (slope > 0)) | ((values >= high) & (slope < 0)))
        before, better = float(now.square().mean().sqrt()), False
        for _ in range(6):
            move = np.zeros_like(values)
            part = normal[np.ix_(inside, inside)]
            damped = part + damping * np.diag(np.diag(part)) + 1e-30 * np.eye(len(part))
            move[inside] = -np.linalg.lstsq(damped, slope[inside], rcond=None)[0]
            trial = np.clip(values + move, low, high)
            after = residual(trial).flatten()
            count += 1
            if float(after.square().mean().sqrt()) < before:
                values, now, better = trial, after, True
                damping = max(damping * 0.2, 1e-9)
                break
            damping *= 6
        if not better or before - float(now.square().mean().sqrt()) < tolerance * before:
            break
    # The last Jacobian is that of the step before: good enough for an error bar.
    return Minimum(values, _standard_error(jacobian, now), float(now.square().mean().sqrt()), count)


def forward_jacobian(
    residual: Residual,
    values: NDArray[np.float64],
    now: torch.Tensor,
    step: NDArray[np.float64],
    high: NDArray[np.float64],
) -> torch.Tensor:
    """Return the derivatives of a residual by forward differences.

    Args:
        residual: The function.
        values: Where, [P].
        now: The residual there, [N].
        step: Step of each parameter [P]; one that would cross the upper bound goes down instead.
        high: Upper bounds [P].

    Returns:
        Derivatives [N, P].
    """
    columns = []
    for k in range(len(values)):
        h = step[k] if values[k] + step[k] <= high[k] else -step[k]
        moved = values.copy()
        moved[k] += h
        columns.append((residual(moved).flatten() - now) / h)
    return torch.stack(columns, dim=1)


def _standard_error(jacobian: torch.Tensor, now: torch.Tensor) -> NDArray[np.float64]:
    """Return the square root of the diagonal of s^2 (J^T J)^-1; infinite for a direction without curvature."""
    normal = (jacobian.T @ jacobian).double().numpy()
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    value, vector = np.linalg.eigh(normal / np.outer(scale, scale))
    variance = float(now.double().square().sum()) / max(1, len(now) - len(scale))
    with np.errstate(divide="ignore"):
        inverse = np.where(value > 1e-10 * value.max(), 1 / value, np.inf)
    weight = np.where(vector**2 < 1e-12, 0.0, vector**2)
    spread = np.array([(w[w > 0] * inverse[w > 0]).sum() for w in weight])
    return np.sqrt(variance * spread) / scale
