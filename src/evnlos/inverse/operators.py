"""What a solver needs of an operator, its norm, its matrix, and the discrete gradient.

- Conjugate gradients for a batch of symmetric systems.
- What every solver hands back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Protocol

import torch

from evnlos.errors import ConfigError
from evnlos.optics import dense_matrix
from evnlos.types import derive_seed


class LinearOperator(Protocol):
    """A linear map from images [..., h, w] to images, with its transpose; every `LinearTransport` is one."""

    def __call__(self, scene: torch.Tensor, /) -> torch.Tensor:
        """Return A x."""
        ...

    def adjoint(self, image: torch.Tensor, /) -> torch.Tensor:
        """Return A^T y."""
        ...


@dataclass(frozen=True)
class Gradient:
    """Differences of neighbouring cells, [..., h, w] -> [..., 2, h + b, w + b]: along x, then along y.

    Args:
        border: "free" knows nothing of what lies outside the image (b = 0, the last difference is 0): constants
            cost nothing. "dark" takes it to be 0 (b = 1, one more difference each side): an image that is
            bright at its border has an edge there, and the operator is injective.

    Example:
        >>> Gradient("free")(torch.tensor([[1.0, 3.0]])).tolist()
        [[[2.0, 0.0]], [[0.0, 0.0]]]
    """

    border: Literal["free", "dark"] = "free"

    def __post_init__(self) -> None:
        if self.border not in ("free", "dark"):
            raise ConfigError(f"Gradient.border is {self.border!r}; give 'free' or 'dark'")

    def __call__(self, scene: torch.Tensor, /) -> torch.Tensor:
        """Return the differences [..., 2, h + b, w + b] of an image [..., h, w]."""
        if self.border == "dark":
            scene = torch.nn.functional.pad(scene, (1, 1, 1, 1))
            dx = scene[..., 1:, 1:] - scene[..., 1:, :-1]  # [..., h + 1, w + 1]
            dy = scene[..., 1:, 1:] - scene[..., :-1, 1:]
            return torch.stack([dx, dy], dim=-3)
        out = scene.new_zeros((*scene.shape[:-2], 2, *scene.shape[-2:]))
        out[..., 0, :, :-1] = scene[..., :, 1:] - scene[..., :, :-1]
        out[..., 1, :-1, :] = scene[..., 1:, :] - scene[..., :-1, :]
        return out

    def adjoint(self, image: torch.Tensor, /) -> torch.Tensor:
        """Return the negative divergence [..., h, w] of a field [..., 2, h + b, w + b]."""
        dx, dy = image.unbind(dim=-3)
        if self.border == "dark":
            along = dx[..., :-1, :-1] - dx[..., :-1, 1:]
            return along + dy[..., :-1, :-1] - dy[..., 1:, :-1]
        out = image.new_zeros(dx.shape)
        out[..., :, :-1] -= dx[..., :, :-1]
        out[..., :, 1:] += dx[..., :, :-1]
        out[..., :-1, :] -= dy[..., :-1, :]
        out[..., 1:, :] += dy[..., :-1, :]
        return out


def operator_norm(
    operator: LinearOperator,
    like: torch.Tensor,
    *,
    iterations: int = 100,
    tolerance: float = 1e-4,
    seed: int = 0,
) -> float:
    """Return the largest singular value of an operator by power iteration on A^T A: a bound from below.

    Args:
        operator: The operator.
        like: An image that it takes, [h, w]; its values are not used, its size and type are.
        iterations: At most so many products with A^T A.
        tolerance: Relative change of the estimate at which to stop.
        seed: Seed of the first image.

    Returns:
        The norm, in the operator's unit; 0 for the zero operator.

    Example:
        >>> round(operator_norm(Gradient(), torch.zeros(32, 32, dtype=torch.float64)), 2)  # below sqrt(8)
        2.8
    """
    generator = torch.Generator().manual_seed(derive_seed(seed, "operator norm"))
    x = torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like)
    x, norm = x / x.norm(), 0.0
    for _ in range(iterations):
        image = operator(x)
        before, norm = norm, float(image.norm())
        if norm == 0:
            return 0.0
        x = operator.adjoint(image)
        x = x / x.norm()
        if abs(norm - before) <= tolerance * norm:
            break
    return norm


def normal_matrix(operator: LinearOperator, like: torch.Tensor) -> torch.Tensor:
    """Return A^T A as a matrix [h w, h w]; that of a gradient is kept, since every fold and regularization asks
    for it.
    """
    if isinstance(operator, Gradient):
        height, width = like.shape
        return _gradient_normal(operator, (int(height), int(width)), like.dtype, like.device).clone()
    steps = dense_matrix(operator, like)
    return steps.mT @ steps


@lru_cache(maxsize=4)
def _gradient_normal(
    gradient: Gradient, shape: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> torch.Tensor:
    count = shape[0] * shape[1]
    units = torch.eye(count, dtype=dtype, device=device).reshape(count, *shape)
    return gradient.adjoint(gradient(units)).reshape(count, count)


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


@dataclass(frozen=True, eq=False)
class Solution:
    """A reconstruction and how it came about.

    Args:
        image: The hidden image [..., h, w], in the measurement's type.
        regularization: Weight of the prior, in the unit that the solver's equation gives it.
        iterations: Iterations of the last solve; 0 for a closed form.
        converged: Whether the stopping rule was met before the iterations ran out.
        residual: |P W (A x - y)| of each image of the batch, [...].
        noise_sigma: Standard deviation of one weighted sample's misfit, over its degrees of freedom where the
            solver knows them.
        dof: Degrees of freedom of the fit, the trace of the map from measurement to prediction; NaN where it is
            not known.
        history: Of each check of the stopping rule, its value: relative residual or relative gap.
    """

    image: torch.Tensor
    regularization: float
    iterations: int
    converged: bool
    residual: torch.Tensor
    noise_sigma: float
    dof: float = float("nan")
    history: tuple[float, ...] = ()
