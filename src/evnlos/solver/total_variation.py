"""Total variation with bounds on the brightness."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from evnlos.errors import ConfigError
from evnlos.solver._primal_dual import solve_primal_dual
from evnlos.solver._splitting import Splitting
from evnlos.solver._variation import Box, Settings
from evnlos.solver.cross_validation import block_folds, cross_validate
from evnlos.solver.operators import Gradient, LinearOperator
from evnlos.solver.problem import Background, Problem
from evnlos.solver.solution import Solution

_PATH = np.logspace(-1.5, -4, 6)  # of the lam above which the image is flat
_ROUGHER = 10.0  # the choice of lam needs less than the image


def total_variation(
    operator: LinearOperator,
    measurement: torch.Tensor,
    lam: float | None = None,
    *,
    rule: Literal["cv", "discrepancy"] = "cv",
    noise_sigma: float | None = None,
    box: Box = (0.0, math.inf),
    border: Literal["free", "dark"] = "free",
    nuisance: Background | None = None,
    weight: torch.Tensor | None = None,
    method: Literal["splitting", "primal-dual"] = "splitting",
    start: torch.Tensor | None = None,
    tolerance: float = 1e-4,
    max_iterations: int = 5000,
) -> Solution:
    """Return argmin over low <= x <= high of |P W (A x - y)|^2 / 2 + lam sum |grad x|, isotropic.

    Method "splitting" makes the matrix and alternates directions (Boyd et al., Found. Trends Mach. Learn. 3,
    2011), a few products with one inverse; "primal-dual" uses products with A only (Chambolle and Pock, J.
    Math. Imaging Vis. 40, 2011, algorithm 1; data term and variation both dual, steps balanced by their
    residuals as in Goldstein, Li and Yuan, NIPS 2015). Both stop when the primal-dual gap is below
    `tolerance` times half of |P W y|^2; without an upper bound it is the partial gap over images up to twice
    as bright as the present one.

    Args:
        operator: A, linear with an adjoint.
        measurement: y [..., H, W], float32 or float64.
        lam: Weight of the variation, unit of W A times that of W y, above 0; None: by `rule`.
        rule: "cv" leaves out blocks of the wall; "discrepancy": the residual is what `noise_sigma` explains.
        noise_sigma: Standard deviation of a weighted sample, for "discrepancy"; the estimate that `tikhonov`
            hands back will do.
        box: Lowest and highest brightness; infinite where there is no bound.
        border: "free", or "dark" where the image is known to be black outside.
        nuisance: Background to project out.
        weight: Factor on each sample's residual [H, W], one over its noise.
        method: "splitting" or "primal-dual".
        start: First guess [..., h, w]; None is black.
        tolerance: Relative gap at which to stop.
        max_iterations: Most iterations for one lam.

    Returns:
        The solution; its history holds the relative gap of every tenth iteration.

    Raises:
        ConfigError: lam is not positive, the box is empty, the rule is unknown or lacks its noise.
        DataError: A measurement of wrong size or type.

    Example:
        >>> from evnlos.transport import MatrixTransport
        >>> from evnlos.types import Plane
        >>> steps = torch.tensor([[0.0, 0.0, 1.0, 1.0]], dtype=torch.float64)
        >>> identity = MatrixTransport(torch.eye(4), Plane(1, 4, 0.01), (1, 4))
        >>> total_variation(identity, steps, lam=0.2, tolerance=1e-6).image.round(decimals=2)
        tensor([[0.1000, 0.1000, 0.9000, 0.9000]], dtype=torch.float64)
    """
    if lam is not None and not (math.isfinite(lam) and lam > 0):
        raise ConfigError(f"lam is {lam}; give a positive number, or None and a rule")
    if not box[0] < box[1]:
        raise ConfigError(f"box is {box}; give the lowest and then the highest brightness")
    if rule not in ("cv", "discrepancy"):
        raise ConfigError(f"rule is {rule!r}; give 'cv' or 'discrepancy'")
    if method not in ("splitting", "primal-dual"):
        raise ConfigError(f"method is {method!r}; give 'splitting' or 'primal-dual'")
    problem = Problem(operator, measurement, nuisance, weight)
    settings = Settings(box, Gradient(border), tolerance, max_iterations)
    if lam is None:
        start, lam = _chosen(problem, settings, method, rule, noise_sigma)
    return next(_path(problem, [lam], settings, method, start))


def _chosen(
    problem: Problem, settings: Settings, method: str, rule: str, noise_sigma: float | None
) -> tuple[torch.Tensor | None, float]:
    # Above about this weight no edge is worth its price.
    lams = (float(problem.adjoint(problem.target).abs().max()) * _PATH).tolist()
    if rule == "cv":
        height, width = problem.measurement.shape[-2:]
        rough = replace(settings, tolerance=_ROUGHER * settings.tolerance)

        def path(part: Problem) -> Iterator[torch.Tensor]:
            return (found.image for found in _path(part, lams, rough, method))

        return None, cross_validate(problem, path, lams, block_folds((height, width))).lam
    if noise_sigma is None or not noise_sigma > 0:
        raise ConfigError(f"noise_sigma is {noise_sigma}; the discrepancy rule needs a positive one")
    wanted = problem.samples * noise_sigma**2
    before: tuple[float, float] | None = None
    found = None
    for found in _path(problem, lams, settings, method):
        left = float(found.residual.square().mean())
        if left <= wanted and before is not None:
            # Between two neighbours of the path the logarithm of the residual runs nearly along a line.
            share = math.log(wanted / left) / math.log(before[1] / left)
            return found.image, float(found.lam * (before[0] / found.lam) ** share)
        if left <= wanted:
            break
        before = (found.lam, left)
    assert found is not None  # the path is not empty
    return found.image, found.lam


def _path(
    problem: Problem,
    lams: Sequence[float],
    settings: Settings,
    method: str,
    start: torch.Tensor | None = None,
) -> Iterator[Solution]:
    """Yield the solutions for falling lams, each starting from the one before."""
    splitting = Splitting(problem, settings) if method == "splitting" else None
    for lam in lams:
        if splitting is not None:
            found, start = splitting.solve(lam, start), None
        else:
            found = solve_primal_dual(problem, lam, settings, start)
            start = found.image
        yield found
