"""Total variation with bounds on the brightness, by two methods.

- What the two total-variation methods share: their settings, the prox of the variation, the gap.
- Total variation without a matrix: the primal-dual method of Chambolle and Pock.
- Total variation with the matrix at hand: alternating directions, each step one product with an inverse.
- Total variation with bounds on the brightness.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from evnlos.errors import ConfigError
from evnlos.inverse.operators import Gradient, LinearOperator, Solution, normal_matrix, operator_norm
from evnlos.inverse.problem import BackgroundModel, Problem, block_folds, cross_validate

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
    regularization: float,
    box: Box,
) -> float:
    """Return the primal less the dual objective; open bounds are taken at twice the image's largest value.

    Args:
        x: Image within the box, [..., h, w].
        squared_residual: |B x - b|^2, summed over the batch.
        edges: grad x.
        squared_dual: |q|^2 of the data term's dual.
        dual_on_target: <q, b>.
        back: B^T q + grad^T p, p the variation's dual, nowhere longer than regularization.
        regularization: Weight of the variation.
        box: Bounds.
    """
    reach = 2 * float(x.abs().max()) + torch.finfo(x.dtype).tiny
    low, high = max(box[0], -reach), min(box[1], reach)
    variation = edges.square().sum(dim=-3).sqrt().sum()
    # sup over the box of -<x, K^T u>
    worst = torch.maximum(-low * back, -high * back).sum()
    primal, dual = (
        0.5 * squared_residual + regularization * variation,
        -0.5 * squared_dual - dual_on_target - worst,
    )
    return float(primal - dual)


_MARGIN = 1.05  # power iteration bounds the norm from below
_GRADIENT_NORM = math.sqrt(8.0)


def solve_primal_dual(
    problem: Problem, regularization: float, settings: Settings, start: torch.Tensor | None
) -> Solution:
    """Return the solution by the primal-dual method, from `start` or a blank image."""
    low, high = settings.box
    gradient, b = settings.gradient, problem.target
    norm = max(_MARGIN * operator_norm(problem, problem.blank), torch.finfo(b.dtype).tiny)
    # Both halves of K = [B; ratio grad] get the same norm, so that one step size fits both.
    ratio = norm / _GRADIENT_NORM
    x = torch.zeros((*b.shape[:-2], *problem.scene_shape), dtype=b.dtype, device=b.device)
    x = (x if start is None else start.to(x)).clamp(low, high)
    image, edges = problem(x), ratio * gradient(x)
    q, p = image - b, torch.zeros_like(edges)
    back = problem.adjoint(q)
    tau = sigma = 1 / (math.sqrt(2) * norm)
    pace, relative, history = 0.5, math.inf, []
    scale = max(0.5 * float(b.square().sum()), torch.finfo(b.dtype).tiny)
    iteration = 0
    while relative > settings.tolerance and iteration < settings.max_iterations:
        iteration += 1
        x_old, image_old, edges_old, q_old, p_old, back_old = x, image, edges, q, p, back
        x = (x_old - tau * back_old).clamp(low, high)
        image, edges = problem(x), ratio * gradient(x)
        q = (q_old + sigma * (2 * image - image_old - b)) / (1 + sigma)
        p = shrunk(p_old + sigma * (2 * edges - edges_old), regularization / ratio)
        back = problem.adjoint(q) + ratio * gradient.adjoint(p)
        if iteration % CHECK_EVERY == 0 or iteration == settings.max_iterations:
            left = (image - b).square().sum()
            found = gap(
                x, left, edges / ratio, q.square().sum(), (q * b).sum(), back, regularization, settings.box
            )
            relative = found / scale
            history.append(relative)
        # The residuals of the two optimality conditions; the larger one gets the longer step.
        primal = float(((x_old - x) / tau - (back_old - back)).abs().sum())
        dual = float(((q_old - q) / sigma - (image_old - image)).abs().sum())
        dual += float(((p_old - p) / sigma - (edges_old - edges)).abs().sum())
        if primal > 1.5 * dual:
            tau, sigma, pace = tau / (1 - pace), sigma * (1 - pace), pace * 0.95
        elif dual > 1.5 * primal:
            tau, sigma, pace = tau * (1 - pace), sigma / (1 - pace), pace * 0.95
    residual = (image - b).square().sum(dim=(-2, -1)).sqrt()
    noise = float((residual.square().mean() / problem.samples).sqrt())
    done = relative <= settings.tolerance
    return Solution(x, regularization, iteration, done, residual, noise, history=tuple(history))


_RELAXED = 1.6
_PENALTY = 10.0  # times the mean square of B's columns; measured on the photograph and on denoising


class Splitting:
    """Alternating direction method of multipliers (Boyd et al. 2011) for one problem and any regularization.

    With z = grad x and v = x for the bounds, x solves (B^T B + rho (grad^T grad + 1)) x = ..., whose inverse is
    kept from one regularization to the next.

    Args:
        problem: The problem; its matrix is made.
        settings: Bounds, gradient, stopping rule.
    """

    def __init__(self, problem: Problem, settings: Settings) -> None:
        self.settings, self.samples = settings, problem.samples
        self._shape = problem.scene_shape
        matrix, b = problem.matrix, problem.target
        self._batch = b.shape[:-2]
        flat = b.reshape(-1, matrix.shape[0])  # [N, H W]
        self._normal, self._backward = matrix.mT @ matrix, flat @ matrix  # [C, C], [N, C]
        self._state: tuple[torch.Tensor, ...] | None = None
        self._squares = flat.square().sum(dim=-1)  # [N]
        smooth = normal_matrix(settings.gradient, problem.blank)
        smooth.diagonal().add_(1)
        mean = float(self._normal.diagonal().mean())
        self._rho = max(_PENALTY * mean, torch.finfo(b.dtype).tiny)
        self._inverse = torch.cholesky_inverse(torch.linalg.cholesky(self._normal + self._rho * smooth))

    def solve(self, regularization: float, start: torch.Tensor | None = None) -> Solution:
        """Return the minimiser for one weight; without a start the search goes on from the one before."""
        gradient, (low, high) = self.settings.gradient, self.settings.box
        if start is not None or self._state is None:
            x = self._backward.new_zeros((*self._batch, *self._shape)) if start is None else start
            v = x.to(self._backward).clamp(low, high).reshape(-1, *self._shape)  # [N, h, w]
            z = gradient(v)
            self._state = (v, z, torch.zeros_like(v), torch.zeros_like(z))
        v, z, w, u = self._state
        scale = max(0.5 * float(self._squares.sum()), torch.finfo(v.dtype).tiny)
        relative, history, iteration = math.inf, [], 0
        while relative > self.settings.tolerance and iteration < self.settings.max_iterations:
            iteration += 1
            right = self._backward + self._rho * (gradient.adjoint(z - u) + v - w).flatten(1)
            x = (right @ self._inverse).unflatten(-1, self._shape)
            moved = _RELAXED * gradient(x) + (1 - _RELAXED) * z + u
            x_mixed = _RELAXED * x + (1 - _RELAXED) * v
            u = shrunk(moved, regularization / self._rho)
            z = moved - u
            v = (x_mixed + w).clamp(low, high)
            w = w + x_mixed - v
            if iteration % CHECK_EVERY == 0 or iteration == self.settings.max_iterations:
                relative = self._gap(v, self._rho * u, regularization) / scale
                history.append(relative)
        self._state = (v, z, w, u)
        image = v.reshape(*self._batch, *self._shape)
        squared = self._squared_residual(v)
        noise = float((squared.mean() / self.samples).sqrt())
        done = relative <= self.settings.tolerance
        residual = squared.sqrt().reshape(self._batch)
        return Solution(image, regularization, iteration, done, residual, noise, history=tuple(history))

    def _squared_residual(self, v: torch.Tensor) -> torch.Tensor:
        flat = v.flatten(1)
        return (self._squares + ((flat @ self._normal - 2 * self._backward) * flat).sum(-1)).clamp(min=0)

    def _gap(self, v: torch.Tensor, p: torch.Tensor, regularization: float) -> float:
        """Return the gap with q = B v - b as the data term's dual."""
        gradient, flat = self.settings.gradient, v.flatten(1)
        back = (flat @ self._normal - self._backward).unflatten(-1, self._shape) + gradient.adjoint(p)
        left = self._squared_residual(v)
        on_target = (flat * self._backward).sum(-1) - self._squares
        total = left.sum()
        return gap(v, total, gradient(v), total, on_target.sum(), back, regularization, self.settings.box)


_PATH = np.logspace(-1.5, -4, 6)  # of the regularization above which the image is flat
_ROUGHER = 10.0  # the choice of regularization needs less than the image


def total_variation(
    operator: LinearOperator,
    measurement: torch.Tensor,
    regularization: float | None = None,
    *,
    rule: Literal["cv", "discrepancy"] = "cv",
    noise_sigma: float | None = None,
    box: Box = (0.0, math.inf),
    border: Literal["free", "dark"] = "free",
    background_model: BackgroundModel | None = None,
    weight: torch.Tensor | None = None,
    method: Literal["splitting", "primal-dual"] = "splitting",
    start: torch.Tensor | None = None,
    tolerance: float = 1e-4,
    max_iterations: int = 5000,
) -> Solution:
    """Return argmin over low <= x <= high of |P W (A x - y)|^2 / 2 + regularization sum |grad x|, isotropic.

    Method "splitting" makes the matrix and alternates directions (Boyd et al., Found. Trends Mach. Learn. 3,
    2011), a few products with one inverse; "primal-dual" uses products with A only (Chambolle and Pock, J.
    Math. Imaging Vis. 40, 2011, algorithm 1; data term and variation both dual, steps balanced by their
    residuals as in Goldstein, Li and Yuan, NIPS 2015). Both stop when the primal-dual gap is below
    `tolerance` times half of |P W y|^2; without an upper bound it is the partial gap over images up to twice
    as bright as the present one.

    Args:
        operator: A, linear with an adjoint.
        measurement: y [..., H, W], float32 or float64.
        regularization: Weight of the variation, unit of W A times that of W y, above 0; None: by `rule`.
        rule: "cv" leaves out blocks of the wall; "discrepancy": the residual is what `noise_sigma` explains.
        noise_sigma: Standard deviation of a weighted sample, for "discrepancy"; the estimate that `tikhonov`
            hands back will do.
        box: Lowest and highest brightness; infinite where there is no bound.
        border: "free", or "dark" where the image is known to be black outside.
        background_model: Background to project out.
        weight: Factor on each sample's residual [H, W], one over its noise.
        method: "splitting" or "primal-dual".
        start: First guess [..., h, w]; None is black.
        tolerance: Relative gap at which to stop.
        max_iterations: Most iterations for one regularization.

    Returns:
        The solution; its history holds the relative gap of every tenth iteration.

    Raises:
        ConfigError: regularization is not positive, the box is empty, the rule is unknown or lacks its noise.
        DataError: A measurement of wrong size or type.

    Example:
        >>> from evnlos.optics import MatrixTransport
        >>> from evnlos.types import Plane
        >>> steps = torch.tensor([[0.0, 0.0, 1.0, 1.0]], dtype=torch.float64)
        >>> identity = MatrixTransport(torch.eye(4), Plane(1, 4, 0.01), (1, 4))
        >>> total_variation(identity, steps, regularization=0.2, tolerance=1e-6).image.round(decimals=2)
        tensor([[0.1000, 0.1000, 0.9000, 0.9000]], dtype=torch.float64)
    """
    if regularization is not None and not (math.isfinite(regularization) and regularization > 0):
        raise ConfigError(f"regularization is {regularization}; give a positive number, or None and a rule")
    if not box[0] < box[1]:
        raise ConfigError(f"box is {box}; give the lowest and then the highest brightness")
    if rule not in ("cv", "discrepancy"):
        raise ConfigError(f"rule is {rule!r}; give 'cv' or 'discrepancy'")
    if method not in ("splitting", "primal-dual"):
        raise ConfigError(f"method is {method!r}; give 'splitting' or 'primal-dual'")
    problem = Problem(operator, measurement, background_model, weight)
    settings = Settings(box, Gradient(border), tolerance, max_iterations)
    if regularization is None:
        start, regularization = _chosen(problem, settings, method, rule, noise_sigma)
    return next(_path(problem, [regularization], settings, method, start))


def _chosen(
    problem: Problem, settings: Settings, method: str, rule: str, noise_sigma: float | None
) -> tuple[torch.Tensor | None, float]:
    # Above about this weight no edge is worth its price.
    regularizations = (float(problem.adjoint(problem.target).abs().max()) * _PATH).tolist()
    if rule == "cv":
        height, width = problem.measurement.shape[-2:]
        rough = replace(settings, tolerance=_ROUGHER * settings.tolerance)

        def path(part: Problem) -> Iterator[torch.Tensor]:
            return (found.image for found in _path(part, regularizations, rough, method))

        return None, cross_validate(problem, path, regularizations, block_folds((height, width))).regularization
    if noise_sigma is None or not noise_sigma > 0:
        raise ConfigError(f"noise_sigma is {noise_sigma}; the discrepancy rule needs a positive one")
    wanted = problem.samples * noise_sigma**2
    before: tuple[float, float] | None = None
    found = None
    for found in _path(problem, regularizations, settings, method):
        left = float(found.residual.square().mean())
        if left <= wanted and before is not None:
            # Between two neighbours of the path the logarithm of the residual runs nearly along a line.
            share = math.log(wanted / left) / math.log(before[1] / left)
            return found.image, float(found.regularization * (before[0] / found.regularization) ** share)
        if left <= wanted:
            break
        before = (found.regularization, left)
    assert found is not None  # the path is not empty
    return found.image, found.regularization


def _path(
    problem: Problem,
    regularizations: Sequence[float],
    settings: Settings,
    method: str,
    start: torch.Tensor | None = None,
) -> Iterator[Solution]:
    """Yield the solutions for falling regularizations, each starting from the one before."""
    splitting = Splitting(problem, settings) if method == "splitting" else None
    for regularization in regularizations:
        if splitting is not None:
            found, start = splitting.solve(regularization, start), None
        else:
            found = solve_primal_dual(problem, regularization, settings, start)
            start = found.image
        yield found
