"""Finding the posterior of a few numbers from simulations: an ensemble to come near, a polynomial to be exact.

- Ensemble Kalman updates drive a cloud of positions towards what was observed.
- A quadratic polynomial stands for the simulation around the result, and a random walk draws from the posterior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evnlos.calibration.pixel_statistics import Array

NEAR = 1.5
"""Standard deviations of the posterior by which the last simulations scatter."""
_REACH = 3.0  # standard deviations of these simulations beyond which the polynomial is not believed
_CHAINS, _SWEEPS = 64, 400
_KEPT = 2048  # posterior draws


def updated(ensemble: Array, made: Array, target: Array, error: Array, draw: np.random.Generator) -> Array:
    """Return an ensemble after a Kalman update towards the target."""
    u, z = ensemble - ensemble.mean(axis=0), made - made.mean(axis=0)
    gain = np.linalg.solve(z.T @ z / (len(u) - 1) + error, z.T @ u / (len(u) - 1)).T
    noise = draw.standard_normal(made.shape) @ np.linalg.cholesky(error).T
    after = ensemble + (target + noise - made) @ gain.T
    spread = after.std(axis=0)
    after = after.mean(axis=0) + (after - after.mean(axis=0)) * np.maximum(1.0, 0.06 / np.maximum(spread, 1e-9))
    return np.clip(after, -3.0, 3.0)


def clipped(covariance: Array, least: float, most: float) -> Array:
    """Return a covariance whose principal standard deviations lie between two bounds."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.clip(np.sqrt(np.maximum(values, 0)), least, most) ** 2) @ vectors.T


@dataclass(frozen=True, eq=False)
class Surface:
    """What a model makes of the statistics around a point: a quadratic polynomial.

    Args:
        centre: The point [P].
        root: Cholesky factor of the scatter of the simulations, [P, P].
        terms: Coefficients [T, K]: of 1, of each number, and of its square or of all products.
        error: Covariance of the polynomial within, as a share of one simulation's.
        residual: Covariance of a simulation about it, [K, K].
    """

    centre: Array
    root: Array
    terms: Array
    error: float
    residual: Array

    @classmethod
    def fitted(cls, design: Array, made: Array, centre: Array, scatter: Array) -> Surface:
        """Return the polynomial through simulations: positions [M, P], scaled means [M, K]."""
        root = np.linalg.cholesky(scatter)
        bare = _powers(np.linalg.solve(root, (design - centre).T).T)
        size = design.shape[1]
        if len(design) < 2.5 * bare.shape[1]:  # too few simulations for the products
            rows, columns = np.triu_indices(size)
            bare = bare[:, np.concatenate([np.ones(1 + size, np.bool_), rows == columns])]
        terms = np.linalg.lstsq(bare, made, rcond=None)[0]
        miss = made - bare @ terms
        residual = miss.T @ miss / max(len(design) - bare.shape[1], 1)
        return cls(centre, root, terms, bare.shape[1] / len(design), residual)

    def posterior(self, target: Array, covariance: Array, draw: np.random.Generator) -> tuple[Array, float]:
        """Return posterior draws [S, P], and the misfit: squared distance over its degrees of freedom."""
        missed = np.maximum(np.diag(self.residual) - np.diag(covariance), 0.0)
        error = covariance * (1.0 + self.error) + np.diag(missed) * (1.0 + self.error)
        white = np.linalg.inv(np.linalg.cholesky(error)).T
        aim, terms = target @ white, self.terms @ white
        full = len(terms) > 1 + 2 * len(self.centre)

        def score(u: Array, widening: float) -> tuple[Array, Array]:
            v = np.linalg.solve(self.root, (u - self.centre).T).T
            powers = _powers(v) if full else np.concatenate([np.ones((len(v), 1)), v, v * v], axis=1)
            distance = ((aim - powers @ terms) ** 2).sum(axis=1)
            far = np.linalg.norm(v, axis=1) / math.sqrt(u.shape[1])
            outside = np.where(far > _REACH, 1e3 * (far - _REACH) ** 2, 0.0) + 1e3 * np.maximum(
                abs(u) - 3.5, 0
            ).sum(1)
            return -0.5 * distance / widening - 0.5 * (u**2).sum(axis=1) - outside, distance

        size = len(self.centre)
        at = self.centre + 0.5 * draw.standard_normal((_CHAINS, size)) @ self.root.T
        widening, step = 1.0, self.root * (2.4 / math.sqrt(size) / NEAR)
        kept: list[Array] = []
        freedom = max(len(target) - size, 1)
        for phase in range(4):
            now, distance = score(at, widening)
            kept = []
            for sweep in range(_SWEEPS):
                factor = math.exp(draw.normal(-0.5, 0.8))
                trial = at + factor * draw.standard_normal(at.shape) @ step.T
                value, far = score(trial, widening)
                taken = np.log(draw.random(len(at))) < value - now
                at, now = np.where(taken[:, None], trial, at), np.where(taken, value, now)
                distance = np.where(taken, far, distance)
                if sweep >= _SWEEPS // 2:
                    kept.append(at.copy())
            every = np.concatenate(kept)
            step = np.linalg.cholesky(np.cov(every.T) + 1e-8 * np.eye(size)) * (2.4 / math.sqrt(size))
            if phase < 2:  # the best point decides whether the model explains the statistics
                widening = max(1.0, float(distance.min()) / freedom)
                at = (
                    at[draw.integers(0, len(at), len(at))]
                    if phase
                    else at[np.argsort(-now)[np.arange(len(at)) % 16]]
                )
        every = np.concatenate(kept)
        return every[:: max(1, len(every) // _KEPT)], float(distance.min()) / freedom


def _powers(v: Array) -> Array:
    """Return 1, v, and all products of two of v, [S, T]."""
    rows, columns = np.triu_indices(v.shape[1])
    return np.concatenate([np.ones((len(v), 1)), v, v[:, rows] * v[:, columns]], axis=1)
