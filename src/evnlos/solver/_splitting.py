"""Total variation with the matrix at hand: alternating directions, each step one product with an inverse."""

from __future__ import annotations

import math

import torch

from evnlos.solver._variation import CHECK_EVERY, Settings, gap, shrunk
from evnlos.solver.operators import normal_matrix
from evnlos.solver.problem import Problem
from evnlos.solver.solution import Solution

_RELAXED = 1.6
_PENALTY = 10.0  # times the mean square of B's columns; measured on the photograph and on denoising


class Splitting:
    """Alternating direction method of multipliers (Boyd et al. 2011) for one problem and any lam.

    With z = grad x and v = x for the bounds, x solves (B^T B + rho (grad^T grad + 1)) x = ..., whose inverse is
    kept from one lam to the next.

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

    def solve(self, lam: float, start: torch.Tensor | None = None) -> Solution:
        """Return the minimiser for one lam; without a start the search goes on from the one before."""
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
            u = shrunk(moved, lam / self._rho)
            z = moved - u
            v = (x_mixed + w).clamp(low, high)
            w = w + x_mixed - v
            if iteration % CHECK_EVERY == 0 or iteration == self.settings.max_iterations:
                relative = self._gap(v, self._rho * u, lam) / scale
                history.append(relative)
        self._state = (v, z, w, u)
        image = v.reshape(*self._batch, *self._shape)
        squared = self._squared_residual(v)
        noise = float((squared.mean() / self.samples).sqrt())
        done = relative <= self.settings.tolerance
        residual = squared.sqrt().reshape(self._batch)
        return Solution(image, lam, iteration, done, residual, noise, history=tuple(history))

    def _squared_residual(self, v: torch.Tensor) -> torch.Tensor:
        flat = v.flatten(1)
        return (self._squares + ((flat @ self._normal - 2 * self._backward) * flat).sum(-1)).clamp(min=0)

    def _gap(self, v: torch.Tensor, p: torch.Tensor, lam: float) -> float:
        """Return the gap with q = B v - b as the data term's dual."""
        gradient, flat = self.settings.gradient, v.flatten(1)
        back = (flat @ self._normal - self._backward).unflatten(-1, self._shape) + gradient.adjoint(p)
        left = self._squared_residual(v)
        on_target = (flat * self._backward).sum(-1) - self._squares
        total = left.sum()
        return gap(v, total, gradient(v), total, on_target.sum(), back, lam, self.settings.box)
