"""Finding the posterior of a few numbers from simulations: an ensemble to come near, a polynomial to be exact.

- Ensemble Kalman updates drive a cloud of positions towards what was observed.
- A quadratic polynomial stands for the simulation around the result; a random walk draws from the posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from evnlos.calibration.pixel_statistics import Array

NEAR = 1.5
"""Standard deviations of the posterior by which the last simulations scatter."""
_REACH = 3.0  # standard deviations of these simulations beyond which the polynomial is not believed
_CHAINS, _SWEEPS = 64, 240
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
        # What the polynomial misses counts as noise of each statistic: on the safe side, as many are alike.
        missed = np.maximum(np.diag(self.residual) - np.diag(covariance), 0.0)
        error = (covariance + np.diag(missed)) * (1.0 + self.error)
        white = np.linalg.inv(np.linalg.cholesky(error)).T
        aim, terms = target @ white, self.terms @ white
        full = len(terms) > 1 + 2 * len(self.centre)

        size, freedom = len(self.centre), max(len(target) - len(self.centre), 1)

        def miss_of(u: Array) -> Array:
            v = np.linalg.solve(self.root, (u - self.centre).T).T
            powers = _powers(v) if full else np.concatenate([np.ones((len(v), 1)), v, v * v], axis=1)
            return aim - powers @ terms

        def score(u: Array, widening: float) -> Array:
            far = np.linalg.norm(np.linalg.solve(self.root, (u - self.centre).T), axis=0) / math.sqrt(size)
            outside = np.maximum(far - _REACH, 0.0) ** 2 + np.maximum(abs(u) - 3.5, 0.0).sum(axis=1)
            distance = (miss_of(u) ** 2).sum(axis=1)
            return -0.5 * distance / widening - 0.5 * (u**2).sum(axis=1) - 1e3 * outside

        best, slope = self._best(miss_of, score)
        misfit = float((miss_of(best[None]) ** 2).sum()) / freedom
        widening = max(1.0, misfit)
        step = np.linalg.cholesky(np.linalg.inv(slope.T @ slope / widening + np.eye(size)))
        at = best + draw.standard_normal((_CHAINS, size)) @ step.T
        kept: list[Array] = []
        for _ in range(2):
            now, kept = score(at, widening), []
            for sweep in range(_SWEEPS):
                factor = 2.4 / math.sqrt(size) * math.exp(draw.normal(-0.3, 0.7))
                trial = at + factor * draw.standard_normal(at.shape) @ step.T
                value = score(trial, widening)
                taken = np.log(draw.random(len(at))) < value - now
                at, now = np.where(taken[:, None], trial, at), np.where(taken, value, now)
                if sweep >= _SWEEPS // 3:
                    kept.append(at.copy())
            every = np.concatenate(kept)
            step = np.linalg.cholesky(np.cov(every.T) + 1e-10 * np.eye(size))
        every = np.concatenate(kept)
        return every[:: max(1, len(every) // _KEPT)], misfit

    def _best(
        self, miss_of: Callable[[Array], Array], score: Callable[[Array, float], Array]
    ) -> tuple[Array, Array]:
        """Return the likeliest position by Gauss and Newton, and the slope of what is missed there, [K, P]."""
        at, damping = self.centre.copy(), 1e-2
        small = 1e-3 * self.root

        def slope_at(u: Array) -> Array:
            change = miss_of(u + small.T) - miss_of(u - small.T)  # along the scatter's axes
            return np.linalg.solve(2.0 * small.T, change).T

        for _ in range(40):
            slope, miss = slope_at(at), miss_of(at[None])[0]
            curve = slope.T @ slope + np.eye(len(at))
            step = np.linalg.solve(curve + damping * np.diag(np.diag(curve)), -slope.T @ miss - at)
            if score((at + step)[None], 1.0)[0] > score(at[None], 1.0)[0]:
                at, damping = at + step, max(damping / 5, 1e-9)
            else:
                damping = min(damping * 6, 1e9)
        return at, slope_at(at)


def _powers(v: Array) -> Array:
    """Return 1, v, and all products of two of v, [S, T]."""
    rows, columns = np.triu_indices(v.shape[1])
    return np.concatenate([np.ones((len(v), 1)), v, v[:, rows] * v[:, columns]], axis=1)
