"""What a solver needs of an operator, its norm, its matrix, and the discrete gradient.

- Conjugate gradients for a batch of symmetric systems.
- What every solver hands back.
- The event form of the inverse problem: changes of log light as a linear function of the hidden scene.
- Errors of an operator, from samples of what it misses: ridge regression, groups left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.cameras.pixel import EventPixel
from evnlos.errors import ConfigError, DataError
from evnlos.events import event_histogram
from evnlos.optics import dense_matrix
from evnlos.types import Events, derive_seed


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


def unexplained(solution: Solution, samples: int, images: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Return the share of what changes along sequences that a solution leaves beside their noise, [B].

    Args:
        solution: What was found, with its degrees of freedom.
        samples: Samples of each sequence.
        images: The sequences, [B, N, H, W].
        noise: Standard deviation of a sample's noise in each, [B].
    """
    left = solution.residual.square() / (samples - solution.dof) - noise**2
    moving = (images - images.mean(dim=1, keepdim=True)).square().mean(dim=(1, 2, 3))
    return (left.clamp(min=0) / moving).sqrt()


class LogChange:
    """The change of the wall's log light, A dx / I0, for a change dx of the hidden scene.

    The paper writes E_map = A x^m + B_s, x^m the scene's change (Eq. event_fm1), and with x^m linear in x as
    A* x (Eq. event_fm2). With x^m = (T - 1) x for a shift T of a scene that moves as a whole, A* is A (T - 1) /
    I0. Log light is not linear: ln(I0 + d) - ln I0 = d / I0 up to (d / I0)^2 / 2.

    Args:
        operator: A, from scene to wall, in the unit of `irradiance`.
        irradiance: I0, the mean wall image with all ambient light, [H, W], above 0.
        shift_cells: Cells (x, y) by which the scene moves between the two instants; None: the operator takes
            dx itself. What leaves the image is lost.

    Raises:
        DataError: The irradiance is not above 0 everywhere.
        ConfigError: The shift is (0, 0).

    Example:
        >>> from evnlos.optics import MatrixTransport
        >>> from evnlos.types import Plane
        >>> identity = MatrixTransport(torch.eye(3), Plane(1, 3, 0.01), (1, 3))
        >>> event = LogChange(identity, torch.full((1, 3), 2.0), (1, 0))
        >>> event(torch.tensor([[0.2, 0.0, 0.0]]))
        tensor([[-0.1000,  0.1000,  0.0000]])
    """

    def __init__(
        self, operator: LinearOperator, irradiance: torch.Tensor, shift_cells: tuple[int, int] | None = None
    ) -> None:
        if not bool((torch.isfinite(irradiance) & (irradiance > 0)).all()):
            raise DataError("LogChange.irradiance holds values that are not above 0; add the ambient light")
        if shift_cells == (0, 0):
            raise ConfigError("LogChange.shift_cells is (0, 0); a scene at rest makes no events")
        self.operator, self.irradiance, self.shift_cells = operator, irradiance, shift_cells

    def __call__(self, scene: torch.Tensor, /) -> torch.Tensor:
        """Return the change of log light [..., H, W]."""
        moved = scene if self.shift_cells is None else shifted(scene, self.shift_cells) - scene
        return self.operator(moved) / self.irradiance.to(scene)

    def adjoint(self, image: torch.Tensor, /) -> torch.Tensor:
        """Return the transpose, [..., h, w]."""
        scene = self.operator.adjoint(image / self.irradiance.to(image))
        if self.shift_cells is None:
            return scene
        return shifted(scene, (-self.shift_cells[0], -self.shift_cells[1])) - scene


def shifted(image: torch.Tensor, cells: tuple[int, int]) -> torch.Tensor:
    """Return images [..., h, w] moved by (x, y) whole cells, dark where nothing moves in.

    Example:
        >>> shifted(torch.tensor([[1.0, 2.0, 3.0]]), (1, 0))
        tensor([[0., 1., 2.]])
    """
    x, y = cells
    height, width = image.shape[-2:]
    out = torch.zeros_like(image)
    if abs(x) < width and abs(y) < height:
        out[..., max(y, 0) : height + min(y, 0), max(x, 0) : width + min(x, 0)] = image[
            ..., max(-y, 0) : height + min(-y, 0), max(-x, 0) : width + min(-x, 0)
        ]
    return out


def log_change(events: Events, edges_us: ArrayLike, pixel: EventPixel) -> torch.Tensor:
    """Return the change of log light that the events count: ON times its threshold less OFF times its own.

    Each pixel's sum is within about a threshold of the true change, less what the low-pass filter holds back,
    plus what the leak adds.

    Args:
        events: The stream.
        edges_us: Edges of the intervals, [N + 1], microseconds.
        pixel: The thresholds.

    Returns:
        float32 [N, H, W], log units.

    Example:
        >>> events = Events([1, 2, 3], [0, 0, 1], [0, 0, 0], [True, True, False], 2, 1)
        >>> log_change(events, [0, 5], EventPixel(threshold_on=0.2, threshold_off=0.1))
        tensor([[[ 0.4000, -0.1000]]])
    """
    counts = torch.from_numpy(event_histogram(events, np.asarray(edges_us)))  # [N, 2, H, W]
    return pixel.threshold_on * counts[:, 0] - pixel.threshold_off * counts[:, 1]


def ridge_by_groups(
    known: torch.Tensor,
    wanted: torch.Tensor,
    group: torch.Tensor,
    penalties: Sequence[float] = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1),
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return weights W [P, R] of ridge regression, wanted = known W; groups left out choose the penalties.

    In the dual form W = X^T (X X^T + penalty mean |x|^2 N)^-1 Y, each group is left out in closed form: with H
    the inverse, what it misses of its own rows g is (H_gg)^-1 (H Y)_g (leave-out residuals of Gaussian
    process regression; Rasmussen and Williams 2006, section 5.4.2). Each column takes the penalty that misses
    least of the groups left out, or W = 0 where that misses less.

    Args:
        known: X, a row for each sample, [N, P].
        wanted: Y, [N, R].
        group: Number of each sample's group, int64 [N].
        penalties: Penalties, in units of N times the rows' mean square norm; each above 0.

    Returns:
        The weights, float32 [P, R], and what they miss of each group when it is left out, float64 [N, R].
    """
    target = wanted.double()
    values, axes = torch.linalg.eigh((known @ known.T).double())
    values = values.clamp_min(0)
    turned, size = axes.T @ target, values.sum().clamp_min(1e-30)  # N times the mean square norm
    missed, best = target.clone(), torch.zeros_like(target)
    for penalty in penalties:
        inverse = 1 / (values + penalty * size)
        dual, left = axes @ (inverse[:, None] * turned), torch.empty_like(target)
        for number in group.unique():
            own = axes[group == number]
            root = torch.linalg.cholesky((own * inverse) @ own.T)
            left[group == number] = torch.cholesky_solve(dual[group == number], root)
        better = left.square().sum(dim=0) < missed.square().sum(dim=0)
        best, missed = torch.where(better, dual, best), torch.where(better, left, missed)
    return known.T @ best.to(known), missed


def left_out_errors(
    gram: torch.Tensor,
    outer: torch.Tensor,
    left_gram: torch.Tensor,
    left_outer: torch.Tensor,
    penalties: Sequence[float],
) -> torch.Tensor:
    """Return the squared error on samples left out, less their sum |Y|^2, for each ridge, float64.

    In the eigenvectors of the other samples' Gram matrix each ridge is a diagonal, and ||C W - Y||^2 needs no
    more than matrices of the code's size.

    Args:
        gram: C^T C of the other samples, float64 [R, R].
        outer: Their C^T Y, float64 [R, H W].
        left_gram: C^T C of those left out.
        left_outer: Their C^T Y.
        penalties: The ridges, in units of the mean power of a component.
    """
    powers, turn = torch.linalg.eigh(gram)
    powers = powers.clamp_min(0)
    turned = turn.T @ outer  # [R, H W]
    aimed = (turned * (turn.T @ left_outer)).sum(dim=1)
    square = (turn.T @ left_gram @ turn) * (turned @ turned.T)
    ridges = torch.tensor(penalties, dtype=torch.float64) * powers.mean().clamp_min(1e-30)
    inverse = 1 / (powers + ridges[:, None])  # [ridges, R]
    return ((inverse @ square) * inverse).sum(dim=1) - 2 * inverse @ aimed
