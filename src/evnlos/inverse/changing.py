"""A hidden plane that changes: its film from the wall's frames, by a linear-Gaussian state-space model.

The plane is x(t) = s (r(t) + rho q), r what changes, q what rests; over the plane both have a mean variance
of 1 and the covariance (L^T L + 1 / length^2)^-1, L the gradient towards a dark border (`Gradient("dark")`).
A frame is y_t = A x(t) + b + noise, b a small unknown offset of each pixel. Nothing is taken to move as a
whole.

Prior and noise are whitened together once: in the basis V of the singular vectors of W A K^(1/2), with W one
over the noise and K the plane's covariance, the film falls apart into series of one number each. Each is a
random walk that forgets (Ornstein and Uhlenbeck's process), coarse modes slowly and fine ones fast: an edge
of speed v crosses a detail of wave number kappa in 1 / (kappa v). A Kalman filter and Rauch, Tung and
Striebel's smoother solve each series exactly. Symbols of the code:

| symbol | meaning | unit |
|---|---|---|
| z [T, K] | what frame t says of mode k, noise of variance 1 | 1 |
| g [K] | gain: how much z moves with a unit of r in mode k, s included | 1 |
| a [T, K] | exp(-dt kappa v), from frame t - 1 to t | 1 |
| kappa [K] | root mean square wave number of mode k on the plane | rad/m |
| rho | standard deviation of what rests over that of what changes | 1 |
| static | standard deviation of a pixel's offset over that of its noise | 1 |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import Gradient, normal_matrix
from evnlos.optics import LinearTransport
from evnlos.types import Plane

Array = NDArray[np.float64]

_KEPT = 1e-13  # of the largest squared gain; what lies below is rounding
_LENGTHS = (1 / 16, 1 / 4, 1)  # of correlation that are tried, over the plane's longer side
LEAST_FRAMES = 3
_EXPLAINED = 2.0  # times the camera's noise that frames may keep
_BRIGHTEST = 5.0  # by which cells of a plane may change that shines with 1
_LEAST_FREE = 30  # pixels more than modes, to tell what no plane explains


class FilmPrior(NamedTuple):
    """What is believed of a hidden plane before a frame is seen."""

    deviation: float
    """Standard deviation s of what changes in a cell, in units of its brightness."""
    resting: float
    """Standard deviation of what rests over that of what changes, rho."""
    length_m: float
    """Length of correlation over the plane, metres."""
    speed_m_s: float
    """Speed v at which details change places, metres per second."""


@dataclass(frozen=True, eq=False)
class FilmEstimate:
    """A film of the hidden plane with its uncertainty.

    Args:
        times_s: Times of the frames, [T], seconds.
        mean: Most probable brightness of each cell, [T, h, w]; it may be negative where nothing is known.
        deviation: Its standard deviation, [T, h, w].
        prior: The prior of the largest marginal likelihood, or the one that was given.
        evidence: Natural logarithm of the marginal likelihood over that of an empty plane; NaN with events.
        noise_factor: Standard deviation of the frames' noise over the one that was stated, by what no plane
            explains; 1 where there are too few pixels to tell.
        static: Standard deviation of a pixel's constant offset over that of its noise, given or found.
    """

    times_s: Array
    mean: Array
    deviation: Array
    prior: FilmPrior
    evidence: float
    noise_factor: float
    static: float

    @property
    def is_explained(self) -> bool:
        """Whether a plane explains the frames: they keep little noise, and no cell shines far above white."""
        return self.noise_factor <= _EXPLAINED and self.prior.deviation <= _BRIGHTEST

    def interval(self, deviations: float = 1.645) -> tuple[Array, Array]:
        """Return the lower and upper bound of each cell, [T, h, w] each; 1.645 deviations hold 90 %."""
        return self.mean - deviations * self.deviation, self.mean + deviations * self.deviation


def film_plane(sides_m: tuple[float, float], cells: int) -> Plane:
    """Return the hidden plane of a film, in square cells.

    Args:
        sides_m: Width and height, metres.
        cells: Along the longer side.

    Raises:
        ConfigError: A side that is not above 0 and finite, or fewer than 2 cells.

    Example:
        >>> film_plane((0.2, 0.1), 24).shape
        (12, 24)
    """
    if not (min(sides_m) > 0 and max(sides_m) < np.inf and cells >= 2):
        raise ConfigError(
            f"the plane that changes is {sides_m[0]:g} x {sides_m[1]:g} m of {cells} cells; give sides above 0 "
            "and 2 cells or more"
        )
    pitch = max(sides_m) / cells
    across, down = (max(1, round(side / pitch)) for side in sides_m)
    return Plane(down, across, pitch)


class ModeSeries(NamedTuple):
    """Smoothed series of a mode and their uncertainty."""

    mean: Array
    """Of r + rho q, [T, K]."""
    variance: Array
    """Its variance, [T, K]."""
    log_likelihood: float
    """Natural logarithm of the density of all z."""


def smooth_modes(z: Array, gain: Array, keep: Array, resting: float, static: float) -> ModeSeries:
    """Smooth z_t = g (r_t + rho q) + b + noise, r an AR(1) of unit variance, q and b constant in time.

    The constant m = g rho q + b is eliminated: beside z the filter runs over a series of ones.

    Args:
        z: Data of each mode, [T, K].
        gain: g, [K].
        keep: a, [T, K]; the first is not used.
        resting: rho, 0 or more.
        static: Standard deviation of b, 0 or more.
    """
    steps, modes = z.shape
    c, h = np.empty((steps, modes)), np.empty((steps, modes))
    p, ahead = np.empty((steps, modes)), np.empty((steps, modes))
    cz, ch, pp = np.zeros(modes), np.zeros(modes), np.ones(modes)
    szz, szh, shh, logs = (np.zeros(modes) for _ in range(4))
    for t in range(steps):
        if t > 0:
            a = keep[t]
            cz, ch, pp = a * cz, a * ch, a * a * pp + (1 - a * a)
        ahead[t] = pp
        f = gain * gain * pp + 1
        ez, eh = z[t] - gain * cz, 1 - gain * ch
        szz += ez * ez / f
        szh += ez * eh / f
        shh += eh * eh / f
        logs += np.log(f)
        kalman = pp * gain / f
        cz, ch, pp = cz + kalman * ez, ch + kalman * eh, pp / f
        c[t], h[t], p[t] = cz, ch, pp
    v = (resting * gain) ** 2 + static**2
    of_m = v / (1 + v * shh)
    m = of_m * szh
    log_likelihood = -0.5 * float(
        (szz - m * szh + logs + np.log1p(v * shh)).sum() + z.size * math.log(2 * math.pi)
    )
    for t in range(steps - 2, -1, -1):
        a = keep[t + 1]
        back = p[t] * a / ahead[t + 1]
        c[t] += back * (c[t + 1] - a * c[t])
        h[t] += back * (h[t + 1] - a * h[t])
        p[t] += back * back * (p[t + 1] - ahead[t + 1])
    share = resting**2 * gain / np.where(v > 0, v, 1.0)  # rho q = share m + what m does not tell of it
    variance = p + (share - h) ** 2 * of_m + np.maximum(resting**2 - share**2 * v, 0.0)
    return ModeSeries(c + (share - h) * m, variance, log_likelihood)


def film_modes(gram: Array, plane: Plane, length_m: float) -> tuple[Array, Array]:
    """Return squared gains of the modes of a plane, ascending, and cells of each mode, [C] and [C, C].

    Args:
        gram: A^T W^2 A of the cells, [C, C].
        plane: The plane.
        length_m: Length of correlation, metres.
    """
    smooth = normal_matrix(Gradient("dark"), torch.zeros(plane.shape, dtype=torch.float64)).numpy()
    covariance = np.linalg.inv(smooth + (plane.pitch_m / length_m) ** 2 * np.eye(len(smooth)))
    root = np.linalg.cholesky(covariance / covariance.diagonal().mean())
    values, vectors = np.linalg.eigh(root.T @ gram @ root)
    return values, root @ vectors


def wave_numbers(basis: Array, plane: Plane) -> Array:
    """Return the root mean square wave number of each mode, rad/m, [K].

    Args:
        basis: Cells of each mode, [C, K].
        plane: Their plane.
    """
    images = torch.from_numpy(basis.T.copy()).unflatten(1, plane.shape)
    slope = Gradient("dark")(images).square().sum(dim=(1, 2, 3)) / images.square().sum(dim=(1, 2))
    return slope.sqrt().numpy() / plane.pitch_m


class _Film:
    """The frames in the modes of a plane's covariance of one length."""

    def __init__(
        self,
        gram: Array,
        seen: Array,
        energy: float,
        rest: float,
        samples: int,
        plane: Plane,
        length_m: float,
        static: float | None,
    ) -> None:
        values, self.basis = film_modes(gram, plane, length_m)
        kept = values > _KEPT * values[-1]
        gain = np.sqrt(np.where(kept, values, 0.0))
        z = (seen @ self.basis) / np.where(kept, gain, np.inf)  # [T, C]
        steps = len(z)
        left = energy - float(((z - z.mean(axis=0)) ** 2).sum())
        freedom = (steps - 1) * (samples - int(kept.sum()))
        self.noise = math.sqrt(max(left / freedom, 1e-12)) if freedom >= steps - 1 else 1.0
        self.z, self.gain, self.length_m = z / self.noise, gain / self.noise, length_m
        # What rests and no plane explains has the variance 1 / T + static^2 per pixel, in units of the noise.
        outside = rest / self.noise**2 - float((self.z.mean(axis=0) ** 2).sum())
        free = samples - int(kept.sum())
        found = math.sqrt(max(outside / free - 1 / steps, 0.0)) if free >= _LEAST_FREE else 1.0
        self.static = found if static is None else static
        self.wave_number = wave_numbers(self.basis, plane)

    def smoothed(self, prior: FilmPrior, dt_s: Array) -> ModeSeries:
        keep = np.exp(-dt_s[:, None] * prior.speed_m_s * self.wave_number)
        return smooth_modes(self.z, prior.deviation * self.gain, keep, prior.resting, self.static)

    def evidence(self, prior: FilmPrior, dt_s: Array) -> float:
        empty = smooth_modes(self.z, 0 * self.gain, np.zeros_like(self.z), 0.0, self.static)
        return self.smoothed(prior, dt_s).log_likelihood - empty.log_likelihood


def estimate_film(
    operator: LinearTransport,
    frames: torch.Tensor,
    times_s: ArrayLike,
    noise_std: torch.Tensor,
    *,
    static: float | None = None,
    prior: FilmPrior | None = None,
) -> FilmEstimate:
    """Return the film of a hidden plane from frames of the wall: the exact posterior of the model above.

    Args:
        operator: A, from the plane's cells to white levels of the pixels (`Setup.operator`).
        frames: Frames without known ambient light, real [T, H, W], white levels.
        times_s: Times of the frames, [T], seconds, increasing.
        noise_std: Standard deviation of a pixel's noise, [H, W], white levels, above 0; one common factor is
            estimated from what no plane explains.
        static: Standard deviation of a pixel's constant offset over that of its noise, 0 or more: of the
            camera's pattern, and of unknown ambient light. None takes that of what rests and no plane explains.
        prior: The prior; None takes the one of the largest marginal likelihood.

    Raises:
        ConfigError: `static` is negative or not finite, a number of the prior is not positive, or the
            operator's plane has no square cells.
        DataError: Frames, times and noise do not fit each other, or hold what is no number.

    Example:
        >>> from evnlos.optics import MatrixTransport
        >>> eye = MatrixTransport(torch.eye(4).double(), Plane(2, 2, 0.01), (2, 2))
        >>> light = torch.ones(5, 2, 2).double()
        >>> slow = FilmPrior(1, 1, 0.01, 1e-4)
        >>> film = estimate_film(eye, light, range(5), 0.01 * torch.ones(2, 2), prior=slow)
        >>> bool(abs(film.mean - 1).max() < 0.01), film.deviation.shape
        (True, (5, 2, 2))
    """
    times = np.asarray(times_s, np.float64)
    check_film(operator, frames, times, noise_std, static, prior)
    plane = operator.source
    assert isinstance(plane, Plane)  # checked above
    weight = 1 / noise_std.double().flatten()
    matrix = weight[:, None] * operator.dense(torch.float64)  # [P, C]
    light = frames.double().flatten(1) * weight  # [T, P]
    gram, seen = (matrix.mT @ matrix).numpy(), (light @ matrix).numpy()
    middle = light.mean(dim=0)
    energy, rest = float((light - middle).square().sum()), float(middle.square().sum())
    dt = np.diff(times, prepend=times[0])
    lengths = [max(plane.extent_m) * share for share in _LENGTHS] if prior is None else [prior.length_m]
    best: tuple[float, FilmPrior, _Film] | None = None
    for length in lengths:
        film = _Film(gram, seen, energy, rest, matrix.shape[0], plane, length, static)
        found = prior or _likeliest(film, dt)
        evidence = film.evidence(found, dt)
        if best is None or evidence > best[0]:
            best = evidence, found, film
    assert best is not None
    evidence, chosen, film = best
    modes = film.smoothed(chosen, dt)
    basis = chosen.deviation * film.basis
    return FilmEstimate(
        times,
        (modes.mean @ basis.T).reshape(-1, *plane.shape),
        np.sqrt(modes.variance @ (basis**2).T).reshape(-1, *plane.shape),
        chosen,
        evidence,
        film.noise,
        film.static,
    )


def _likeliest(film: _Film, dt_s: Array) -> FilmPrior:
    """Return the prior of the largest marginal likelihood at one length of correlation.

    ln rho has the weak prior N(0, 1): behind large offsets the frames say nothing of what rests, and intervals
    have to be as wide as that.
    """
    from scipy.optimize import minimize

    step, seconds = float(np.median(dt_s[1:])), float(dt_s.sum())
    slowest, fastest = 0.1 / seconds / film.wave_number.max(), 10 / step / film.wave_number.min()
    low, high = np.log([1e-3, 1e-2, slowest]), np.log([1e2, 1e2, fastest])

    def prior_at(logs: ArrayLike) -> FilmPrior:
        deviation, resting, speed = np.exp(np.clip(logs, low, high)).tolist()
        return FilmPrior(deviation, resting, film.length_m, speed)

    start = np.array([math.log(0.3), 0.0, math.log(0.02 / step / float(np.median(film.wave_number)))])
    found = minimize(
        lambda logs: 0.5 * logs[1] ** 2 - film.smoothed(prior_at(logs), dt_s).log_likelihood,
        start,
        method="Nelder-Mead",
        options={"xatol": 0.05, "fatol": 0.1, "maxfev": 120, "initial_simplex": start + np.eye(4, 3, -1)},
    )
    return prior_at(found.x)


def check_film(
    operator: LinearTransport,
    frames: torch.Tensor,
    times: Array,
    noise_std: torch.Tensor,
    static: float | None,
    prior: FilmPrior | None,
) -> None:
    """Refuse what cannot be a film: the arguments of `estimate_film`, its errors.

    Args:
        operator: A.
        frames: [T, H, W].
        times: [T], seconds.
        noise_std: [H, W].
        static: None is to be found.
        prior: None is to be found.
    """
    if not isinstance(operator.source, Plane):
        raise ConfigError("the operator starts from patches; give one from a Plane of square cells")
    if static is not None and not (math.isfinite(static) and static >= 0):
        raise ConfigError(f"static is {static}; give 0 or more, finite")
    if prior is not None and not all(math.isfinite(value) and value > 0 for value in prior):
        raise ConfigError(f"the prior is {tuple(prior)}; give positive, finite numbers")
    shape = operator.shape
    if frames.ndim != 3 or tuple(frames.shape[1:]) != shape or not frames.is_floating_point():
        raise DataError(f"the frames are {frames.dtype} {tuple(frames.shape)}; give real [T, {shape}]")
    if len(frames) < LEAST_FRAMES or times.shape != (len(frames),) or not (np.diff(times) > 0).all():
        raise DataError(
            f"{len(frames)} frames at times {times.shape}; give {LEAST_FRAMES} or more, at increasing times"
        )
    if tuple(noise_std.shape) != shape or not bool((torch.isfinite(noise_std) & (noise_std > 0)).all()):
        raise DataError(f"noise_std is {tuple(noise_std.shape)}; give {shape} finite numbers above 0")
    if not bool(torch.isfinite(frames).all()):
        raise DataError("the frames hold NaN or infinity; leave such frames out")
