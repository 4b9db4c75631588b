"""Total variation without a matrix: the primal-dual method of Chambolle and Pock."""

from __future__ import annotations

import math

import torch

from evnlos.solver._variation import CHECK_EVERY, Settings, gap, shrunk
from evnlos.solver.operators import operator_norm
from evnlos.solver.problem import Problem
from evnlos.solver.solution import Solution

_MARGIN = 1.05  # power iteration bounds the norm from below
_GRADIENT_NORM = math.sqrt(8.0)


def solve_primal_dual(problem: Problem, lam: float, settings: Settings, start: torch.Tensor | None) -> Solution:
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
        p = shrunk(p_old + sigma * (2 * edges - edges_old), lam / ratio)
        back = problem.adjoint(q) + ratio * gradient.adjoint(p)
        if iteration % CHECK_EVERY == 0 or iteration == settings.max_iterations:
            left = (image - b).square().sum()
            found = gap(x, left, edges / ratio, q.square().sum(), (q * b).sum(), back, lam, settings.box)
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
    return Solution(x, lam, iteration, done, residual, noise, history=tuple(history))
