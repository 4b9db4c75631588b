"""Quadratic regularisation, in closed form from singular values or matrix-free.

- The singular values of a problem: with them every Tikhonov solution costs next to nothing.
- Quadratic regularisation: in closed form from singular values, or matrix-free by conjugate gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import (
    LinearOperator,
    Solution,
    Solved,
    conjugate_gradient,
    normal_matrix,
    operator_norm,
)
from evnlos.inverse.problem import BackgroundModel, Choice, Problem, block_folds, cross_validate
from evnlos.types import derive_seed

_GRID = np.logspace(-14, 2, 129)
_GOLDEN = (np.sqrt(5) - 1) / 2


class Spectrum:
    """Singular value decomposition of B = P W A, or of B R^-1 with |R x| = |L x| where a prior L is given.

    Args:
        problem: The problem; its matrix is made.
        prior: L, injective; None is the identity.

    Raises:
        ConfigError: L has a null space, so the standard form does not exist.
    """

    def __init__(self, problem: Problem, prior: LinearOperator | None = None) -> None:
        matrix, self._upper = standard_form(problem, prior)
        u, self.values, self._vt = torch.linalg.svd(matrix, full_matrices=False)
        target = problem.target
        self._batch, self._shape = target.shape[:-2], problem.scene_shape
        flat = target.reshape(-1, matrix.shape[0]).mT  # [H W, B]
        self._seen = u.mT @ flat  # [r, B]
        # What no image explains; by projection, since a difference of squares would cancel.
        self._unseen = (flat - u @ self._seen).square().sum(dim=0)  # [B]
        self.samples = problem.samples
        if float(self.values[0]) == 0:
            raise DataError("the operator is zero after the background is projected out; lower the degree")

    @property
    def scale(self) -> float:
        """The largest squared singular value, the natural unit of regularization."""
        return float(self.values[0]) ** 2

    def image(self, regularization: float) -> torch.Tensor:
        """Return argmin |B x - b|^2 + regularization |L x|^2, [..., h, w]."""
        z = self._vt.mT @ ((self.values / (self.values.square() + regularization))[:, None] * self._seen)
        if self._upper is not None:
            z = torch.linalg.solve_triangular(self._upper, z, upper=True)
        return z.mT.reshape(*self._batch, *self._shape)

    def squared_residual(self, regularization: float) -> torch.Tensor:
        """Return |B x - b|^2 of each image, [...]."""
        left = (regularization / (self.values.square() + regularization))[:, None] * self._seen
        return (self._unseen + left.square().sum(dim=0)).reshape(self._batch)

    def dof(self, regularization: float) -> float:
        """Return the degrees of freedom, sum s^2 / (s^2 + regularization)."""
        return float((self.values.square() / (self.values.square() + regularization)).sum())

    def gcv(self, regularization: float) -> float:
        """Return n sum |B x - b|^2 / (n - dof)^2, summed over the batch (Golub, Heath and Wahba 1979)."""
        freedom = self.samples - self.dof(regularization)
        return self.samples * float(self.squared_residual(regularization).sum()) / max(freedom, 1e-9) ** 2

    def noise_sigma(self, regularization: float) -> float:
        """Return the standard deviation of a sample's misfit, sqrt(|B x - b|^2 / (n - dof)), over the batch."""
        freedom = max(self.samples - self.dof(regularization), 1e-9)
        return float((self.squared_residual(regularization).mean() / freedom).sqrt())

    def best_gcv(self) -> float:
        """Return the regularization at which `gcv` is smallest."""
        return smallest(self.gcv, self.scale * _GRID)

    def at_discrepancy(self, noise_sigma: float) -> float:
        """Return the regularization whose mean squared residual is samples * noise_sigma^2 (Morozov 1966)."""
        return matching(
            lambda regularization: float(self.squared_residual(regularization).mean()),
            self.samples * noise_sigma**2,
            self.scale,
        )


def standard_form(problem: Problem, prior: LinearOperator | None) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return B R^-1 and R with |R x| = |L x|, upper triangular; B and None without a prior.

    Raises:
        ConfigError: L has a null space.
    """
    matrix = problem.matrix
    if prior is None:
        return matrix, None
    lower, info = torch.linalg.cholesky_ex(normal_matrix(prior, problem.blank))
    if int(info) or float(lower.diagonal().min()) <= 1e-7 * float(lower.diagonal().max()):
        raise ConfigError("the prior has a null space; use Gradient('dark'), or method='cg'")
    return torch.linalg.solve_triangular(lower.mT, matrix, upper=True, left=False), lower.mT


def smallest(function: Callable[[float], float], grid: np.ndarray) -> float:
    """Return where a function of regularization > 0 is smallest: the best grid point, then golden sections in
    log regularization.
    """
    best = int(np.argmin([function(float(regularization)) for regularization in grid]))
    low, high = np.log(grid[max(best - 1, 0)]), np.log(grid[min(best + 1, len(grid) - 1)])
    for _ in range(30):
        width = _GOLDEN * (high - low)
        if function(float(np.exp(high - width))) <= function(float(np.exp(low + width))):
            high = low + width
        else:
            low = high - width
    return float(np.exp((low + high) / 2))


def matching(
    squared_residual: Callable[[float], float], wanted: float, scale: float, *, relative: float = 1e-6
) -> float:
    """Return the regularization at which a residual that grows with regularization reaches `wanted`, by
    bisection in log regularization.

    Raises:
        DataError: No regularization reaches it: the model leaves more than the noise, or the noise explains
            everything.
    """
    low, high = np.log(scale * 1e-14), np.log(scale * 1e6)
    least, most = squared_residual(float(np.exp(low))), squared_residual(float(np.exp(high)))
    if not least <= wanted <= most:
        side = "more" if least > wanted else "less"
        limit = least if least > wanted else most
        raise DataError(
            f"the noise asks for a squared residual of {wanted:.3g}, the model leaves {side} ({limit:.3g}); "
            "give another noise_sigma, or choose regularization by gcv or cv"
        )
    while high - low > relative:
        middle = (low + high) / 2
        low, high = (middle, high) if squared_residual(float(np.exp(middle))) < wanted else (low, middle)
    return float(np.exp((low + high) / 2))


Rule = Literal["gcv", "discrepancy", "cv"]
_CV_GRID = np.logspace(0, -8, 25)  # in units of the largest squared singular value
_CG_GRID = np.logspace(-7, 1, 17)
_PROBES = 8


def tikhonov(
    operator: LinearOperator,
    measurement: torch.Tensor,
    regularization: float | None = None,
    *,
    rule: Rule = "gcv",
    noise_sigma: float | None = None,
    prior: LinearOperator | None = None,
    background_model: BackgroundModel | None = None,
    weight: torch.Tensor | None = None,
    method: Literal["svd", "cg"] = "svd",
    tolerance: float = 1e-8,
    max_iterations: int = 2000,
    seed: int = 0,
) -> Solution:
    """Return argmin over x of |P W (A x - y)|^2 + regularization |L x|^2, with regularization given or chosen
    without the truth.

    One regularization serves the whole batch: the rules look at its residuals together.

    Args:
        operator: A, linear with an adjoint.
        measurement: y [..., H, W], float32 or float64; the solver works in its type.
        regularization: Weight of the prior, squared unit of W A, 0 or more; None: by `rule`.
        rule: "gcv", generalised cross-validation: supposes that the errors of the samples are independent;
            "discrepancy": the residual is what `noise_sigma` explains; "cv": leaves out blocks of the wall, for
            errors that neighbours share.
        noise_sigma: Standard deviation of a weighted sample, for "discrepancy".
        prior: L; None is the identity. `Gradient("dark")` asks for smooth images.
        background_model: Background to project out.
        weight: Factor on each sample's residual [H, W], one over its noise.
        method: "svd" makes the matrix (every regularization is then free), "cg" uses products only.
        tolerance: Relative residual of the normal equations at which "cg" stops.
        max_iterations: Most iterations of "cg" for one regularization.
        seed: Seed of the probes with which "cg" estimates the degrees of freedom for "gcv" (Hutchinson 1990).

    Returns:
        The solution.

    Raises:
        ConfigError: A negative regularization, an unknown rule or method, "discrepancy" without a noise, "cv"
            with "cg", or a prior with a null space and "svd".
        DataError: A measurement of wrong size or type, or a noise that no regularization explains.

    Example:
        >>> from evnlos.optics import MatrixTransport
        >>> from evnlos.types import Plane
        >>> halves = MatrixTransport(0.5 * torch.eye(4), Plane(2, 2, 0.01), (2, 2))
        >>> tikhonov(halves, torch.ones(2, 2), regularization=0.25).image
        tensor([[1., 1.],
                [1., 1.]])
    """
    _check(regularization, rule, noise_sigma, method)
    problem = Problem(operator, measurement, background_model, weight)
    if method == "cg":
        return _by_products(problem, regularization, rule, noise_sigma, prior, tolerance, max_iterations, seed)
    spectrum = Spectrum(problem, prior)
    if regularization is None:
        regularization = _chosen(problem, spectrum, prior, rule, noise_sigma)
    residual = spectrum.squared_residual(regularization).sqrt()
    return Solution(
        spectrum.image(regularization),
        regularization,
        0,
        True,
        residual,
        spectrum.noise_sigma(regularization),
        spectrum.dof(regularization),
    )


def tikhonov_cv_error(
    operator: LinearOperator,
    measurement: torch.Tensor,
    *,
    prior: LinearOperator | None = None,
    background_model: BackgroundModel | None = None,
    weight: torch.Tensor | None = None,
) -> float:
    """Return the smallest mean squared error of left-out blocks over all regularization: to compare models by.

    It is in the squared unit of W y, and comparable between operators, priors and backgrounds for one
    measurement and weight. Arguments as in `tikhonov`.

    Args:
        operator: A, linear with an adjoint.
        measurement: y [H, W], float32 or float64.
        prior: L; None is the identity.
        background_model: Background to project out.
        weight: Factor on each sample's residual, [H, W].
    """
    problem = Problem(operator, measurement, background_model, weight)
    matrix, _ = standard_form(problem, prior)
    small = matrix @ matrix.mT if matrix.shape[0] < matrix.shape[1] else matrix.mT @ matrix
    return min(_cross_validated(problem, prior, float(torch.linalg.eigvalsh(small)[-1])).errors)


def _check(regularization: float | None, rule: str, noise_sigma: float | None, method: str) -> None:
    if regularization is not None and not (np.isfinite(regularization) and regularization >= 0):
        raise ConfigError(f"regularization is {regularization}; give 0 or more, or None and a rule")
    if method not in ("svd", "cg"):
        raise ConfigError(f"method is {method!r}; give 'svd' or 'cg'")
    if rule not in ("gcv", "discrepancy", "cv"):
        raise ConfigError(f"rule is {rule!r}; give 'gcv', 'discrepancy' or 'cv'")
    if regularization is None and rule == "discrepancy" and not (noise_sigma is not None and noise_sigma > 0):
        raise ConfigError(f"noise_sigma is {noise_sigma}; the discrepancy rule needs a positive one")
    if regularization is None and rule == "cv" and method == "cg":
        raise ConfigError("rule 'cv' would solve hundreds of systems by 'cg'; use method='svd', or rule='gcv'")


def _chosen(
    problem: Problem, spectrum: Spectrum, prior: LinearOperator | None, rule: Rule, noise_sigma: float | None
) -> float:
    if rule == "gcv":
        return spectrum.best_gcv()
    if rule == "discrepancy":
        assert noise_sigma is not None  # checked above
        return spectrum.at_discrepancy(noise_sigma)
    return _cross_validated(problem, prior, spectrum.scale).regularization


def _cross_validated(problem: Problem, prior: LinearOperator | None, scale: float) -> Choice:
    regularizations = scale * _CV_GRID
    height, width = problem.measurement.shape[-2:]

    def path(part: Problem) -> Iterator[torch.Tensor]:
        # The normal equations lose what lies below 1e-8 of the scale; the grid does not go there.
        matrix, upper = standard_form(part, prior)
        target = part.target.reshape(-1, matrix.shape[0]).mT  # [H W, N]
        wide = matrix.shape[0] < matrix.shape[1]
        values, vectors = torch.linalg.eigh(matrix @ matrix.mT if wide else matrix.mT @ matrix)
        seen = vectors.mT @ (target if wide else matrix.mT @ target)
        onto = matrix.mT @ vectors if wide else vectors  # [C, r]
        onto = onto if upper is None else torch.linalg.solve_triangular(upper, onto, upper=True)
        for regularization in regularizations.tolist():
            image = onto @ (seen / (values.clamp(min=0) + regularization)[:, None])
            yield image.mT.reshape(*part.target.shape[:-2], *part.scene_shape)

    return cross_validate(problem, path, regularizations.tolist(), block_folds((height, width)))


def _by_products(
    problem: Problem,
    regularization: float | None,
    rule: Rule,
    noise_sigma: float | None,
    prior: LinearOperator | None,
    tolerance: float,
    max_iterations: int,
    seed: int,
) -> Solution:
    def solve(weight: float, rhs: torch.Tensor, start: torch.Tensor | None = None) -> Solved:
        def normal(x: torch.Tensor) -> torch.Tensor:
            return problem.adjoint(problem(x)) + weight * (x if prior is None else prior.adjoint(prior(x)))

        return conjugate_gradient(normal, rhs, start=start, tolerance=tolerance, max_iterations=max_iterations)

    rhs = problem.adjoint(problem.target)

    def squared_residual(weight: float) -> float:
        return float(_squared(problem(solve(weight, rhs).image) - problem.target).mean())

    if regularization is None:
        scale = operator_norm(problem, problem.blank) ** 2
        if rule == "discrepancy":
            assert noise_sigma is not None  # checked by the caller
            wanted = problem.samples * noise_sigma**2
            regularization = matching(squared_residual, wanted, scale * 1e4, relative=1e-3)
        else:
            regularization = _stochastic_gcv(problem, solve, rhs, scale, seed)
    solved = solve(regularization, rhs)
    residual = _squared(problem(solved.image) - problem.target).sqrt()
    sigma = float((residual.square().mean() / problem.samples).sqrt())
    return Solution(
        solved.image,
        regularization,
        solved.iterations,
        solved.converged,
        residual,
        sigma,
        history=solved.history,
    )


def _stochastic_gcv(
    problem: Problem,
    solve: Callable[..., Solved],
    rhs: torch.Tensor,
    scale: float,
    seed: int,
) -> float:
    """Return the regularization with the least GCV; the trace is a mean over random signs z of z . B x(z)
    (Hutchinson).
    """
    generator = torch.Generator().manual_seed(derive_seed(seed, "gcv probes"))
    height, width = problem.measurement.shape[-2:]
    signs = torch.randint(0, 2, (_PROBES, height, width), generator=generator).to(problem.measurement) * 2 - 1
    backward = problem.adjoint(signs)
    known: dict[float, float] = {}

    def gcv(regularization: float) -> float:
        if regularization not in known:
            left = float(_squared(problem(solve(regularization, rhs).image) - problem.target).sum())
            dof = float((solve(regularization, backward).image * backward).sum()) / _PROBES
            known[regularization] = problem.samples * left / max(problem.samples - dof, 1e-9) ** 2
        return known[regularization]

    grid = scale * _CG_GRID
    values = [gcv(float(regularization)) for regularization in grid]
    best = int(np.argmin(values))
    fine = np.geomspace(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], 9)
    return float(min(fine, key=lambda regularization: gcv(float(regularization))))


def _squared(image: torch.Tensor) -> torch.Tensor:
    return image.square().sum(dim=(-2, -1))
