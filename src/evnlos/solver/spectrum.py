"""The singular values of a problem: with them every Tikhonov solution costs next to nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.solver.operators import LinearOperator, normal_matrix
from evnlos.solver.problem import Problem

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
        """The largest squared singular value, the natural unit of lam."""
        return float(self.values[0]) ** 2

    def image(self, lam: float) -> torch.Tensor:
        """Return argmin |B x - b|^2 + lam |L x|^2, [..., h, w]."""
        z = self._vt.mT @ ((self.values / (self.values.square() + lam))[:, None] * self._seen)
        if self._upper is not None:
            z = torch.linalg.solve_triangular(self._upper, z, upper=True)
        return z.mT.reshape(*self._batch, *self._shape)

    def squared_residual(self, lam: float) -> torch.Tensor:
        """Return |B x - b|^2 of each image, [...]."""
        left = (lam / (self.values.square() + lam))[:, None] * self._seen
        return (self._unseen + left.square().sum(dim=0)).reshape(self._batch)

    def dof(self, lam: float) -> float:
        """Return the degrees of freedom, sum s^2 / (s^2 + lam)."""
        return float((self.values.square() / (self.values.square() + lam)).sum())

    def gcv(self, lam: float) -> float:
        """Return n sum |B x - b|^2 / (n - dof)^2, summed over the batch (Golub, Heath and Wahba 1979)."""
        freedom = self.samples - self.dof(lam)
        return self.samples * float(self.squared_residual(lam).sum()) / max(freedom, 1e-9) ** 2

    def noise_sigma(self, lam: float) -> float:
        """Return the standard deviation of a sample's misfit, sqrt(|B x - b|^2 / (n - dof)), over the batch."""
        freedom = max(self.samples - self.dof(lam), 1e-9)
        return float((self.squared_residual(lam).mean() / freedom).sqrt())

    def best_gcv(self) -> float:
        """Return the lam at which `gcv` is smallest."""
        return smallest(self.gcv, self.scale * _GRID)

    def at_discrepancy(self, noise_sigma: float) -> float:
        """Return the lam whose mean squared residual is samples * noise_sigma^2 (Morozov 1966)."""
        return matching(
            lambda lam: float(self.squared_residual(lam).mean()), self.samples * noise_sigma**2, self.scale
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
    """Return where a function of lam > 0 is smallest: the best grid point, then golden sections in log lam."""
    best = int(np.argmin([function(float(lam)) for lam in grid]))
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
    """Return the lam at which a residual that grows with lam reaches `wanted`, by bisection in log lam.

    Raises:
        DataError: No lam reaches it: the model leaves more than the noise, or the noise explains everything.
    """
    low, high = np.log(scale * 1e-14), np.log(scale * 1e6)
    least, most = squared_residual(float(np.exp(low))), squared_residual(float(np.exp(high)))
    if not least <= wanted <= most:
        side = "more" if least > wanted else "less"
        limit = least if least > wanted else most
        raise DataError(
            f"the noise asks for a squared residual of {wanted:.3g}, the model leaves {side} ({limit:.3g}); "
            "give another noise_sigma, or choose lam by gcv or cv"
        )
    while high - low > relative:
        middle = (low + high) / 2
        low, high = (middle, high) if squared_residual(float(np.exp(middle))) < wanted else (low, middle)
    return float(np.exp((low + high) / 2))
