"""Fitting a setup's parameters to frames: least squares, residuals, from coarse to fine.

- How far a model and a camera are apart, in one number that noise bounds from below.
- Nonlinear least squares with few parameters: Levenberg-Marquardt with forward differences.
- Fitting a setup's parameters to frames: coarse to fine, the light itself solved for at every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.captures import CaptureSet, working_shape
from evnlos.calibration.frame_model import FrameModel, fitting_strip
from evnlos.errors import ConfigError, DataError
from evnlos.machine import note
from evnlos.setups import Parameter, Setup


@dataclass(frozen=True)
class Residual:
    """Root mean square of camera minus model over the camera's standard deviation, over all pixels and images.

    Args:
        before: With the start's settings; frames with the gain and ambient light that suit them best.
        after: With the fit.
        noise: What noise alone makes: no model of the light can be better.
    """

    before: float
    after: float
    noise: float

    @property
    def unexplained(self) -> float:
        """What the fit leaves beside the noise, root mean square over the camera's standard deviation."""
        return math.sqrt(max(self.after**2 - self.noise**2, 0.0))


Array = NDArray[np.float64]
Residuals = Callable[[Array], torch.Tensor]
"""From the parameters [P] to the residual, any shape."""


@dataclass(frozen=True)
class Minimum:
    """Where a search ended.

    Args:
        values: Parameters [P].
        error: Standard error of each parameter [P], from the residual's own variance; infinite where the data
            say nothing.
        rms: Root mean square of the residual.
        evaluations: How often the residual was computed.
    """

    values: Array
    error: Array
    rms: float
    evaluations: int


def levenberg_marquardt(
    residual: Residuals,
    start: Sequence[float],
    steps: Sequence[float],
    bounds: Sequence[tuple[float, float]],
    *,
    iterations: int = 15,
    tolerance: float = 1e-4,
    most: Sequence[float] | None = None,
) -> Minimum:
    """Minimise the sum of squares of `residual`, staying within bounds.

    Each step solves (J^T J + damping diag(J^T J)) d = -J^T r (Marquardt 1963). J comes from forward
    differences, so that any simulator will do.

    Args:
        residual: The function; it must have the same length everywhere.
        start: First parameters [P], inside the bounds.
        steps: Step of the difference for each parameter [P], in its own unit, above 0.
        bounds: Lowest and highest value of each parameter [P].
        iterations: Most steps that are taken.
        tolerance: The search ends when a step lowers the root mean square by less than this fraction.
        most: How far a step may go along each parameter [P]; a longer one is shortened, in its direction.

    Example:
        >>> t = torch.linspace(0, 1, 20, dtype=torch.float64)
        >>> truth = torch.exp(-3 * t)
        >>> found = levenberg_marquardt(lambda p: torch.exp(-p[0] * t) - truth, [1.0], [1e-4], [(0.1, 10.0)])
        >>> round(float(found.values[0]), 3)
        3.0
    """
    low, high = np.array(bounds, dtype=np.float64).T
    step = np.asarray(steps, dtype=np.float64)
    values = np.clip(np.asarray(start, dtype=np.float64), low, high)
    now = residual(values).flatten()
    damping, count = 1e-3, 1
    jacobian = now.new_zeros((len(now), len(values)))
    for round_ in range(1, iterations + 1):
        jacobian = forward_jacobian(residual, values, now, step, high, f"round {round_}, ")
        count += len(values)
        normal, slope = (jacobian.T @ jacobian).double().numpy(), (jacobian.T @ now).double().numpy()
        # A parameter that rests on a bound and wants to leave is not part of this step.
        inside = ~(((values <= low) & (slope > 0)) | ((values >= high) & (slope < 0)))
        before, better = float(now.square().mean().sqrt()), False
        for _ in range(6):
            move = np.zeros_like(values)
            part = normal[np.ix_(inside, inside)]
            damped = part + damping * np.diag(np.diag(part)) + 1e-30 * np.eye(len(part))
            move[inside] = -np.linalg.lstsq(damped, slope[inside], rcond=None)[0]
            if most is not None:
                move /= max(1.0, float(np.abs(move / most).max()))
            trial = np.clip(values + move, low, high)
            note(f"round {round_}, trial {count}")
            after = residual(trial).flatten()
            count += 1
            if float(after.square().mean().sqrt()) < before:
                values, now, better = trial, after, True
                damping = max(damping * 0.2, 1e-9)
                break
            damping *= 6
        if not better or before - float(now.square().mean().sqrt()) < tolerance * before:
            break
    return Minimum(values, _standard_error(jacobian, now), float(now.square().mean().sqrt()), count)


def forward_jacobian(
    residual: Residuals, values: Array, now: torch.Tensor, step: Array, high: Array, what: str = ""
) -> torch.Tensor:
    """Return the derivatives of a residual by forward differences.

    Args:
        residual: The function.
        values: Where, [P].
        now: The residual there, [N].
        step: Step of each parameter [P]; one that would cross the upper bound goes down instead.
        high: Upper bounds [P].
        what: What progress shows before the number of the parameter.

    Returns:
        Derivatives [N, P].
    """
    columns = []
    for k in range(len(values)):
        h = step[k] if values[k] + step[k] <= high[k] else -step[k]
        moved = values.copy()
        moved[k] += h
        note(f"{what}slope {k + 1} of {len(values)}")
        columns.append((residual(moved).flatten() - now) / h)
    return torch.stack(columns, dim=1)


def _standard_error(jacobian: torch.Tensor, now: torch.Tensor) -> Array:
    """Return the square root of the diagonal of s^2 (J^T J)^-1; infinite for a direction without curvature."""
    normal = (jacobian.T @ jacobian).double().numpy()
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    value, vector = np.linalg.eigh(normal / np.outer(scale, scale))
    variance = float(now.double().square().sum()) / max(1, len(now) - len(scale))
    with np.errstate(divide="ignore"):
        inverse = np.where(value > 1e-10 * value.max(), 1 / value, np.inf)
    weight = np.where(vector**2 < 1e-12, 0.0, vector**2)
    spread = np.array([(w[w > 0] * inverse[w > 0]).sum() for w in weight])
    return np.sqrt(variance * spread) / scale


BLOCKS = 5  # of the image along either axis


def scatter_of(scores: Array, captures: NDArray[np.int64], block: NDArray[np.int64], few: float = 1.0) -> Array:
    """Return how the gradients of whole captures and of whole blocks of the image scatter about zero, [P, P].

    What a model gets wrong is alike over a capture and a part of the image, so its pixels are no independent
    samples (the sandwich estimator with two kinds of clusters; Cameron, Gelbach, Miller 2011).

    Args:
        scores: What each frame and pixel adds to the gradient [N, M, P].
        captures: Number of the capture of each frame [N].
        block: Number of the block of each pixel [M].
        few: Factor on the captures' part, for their small number.
    """
    scatter = np.zeros((scores.shape[-1], scores.shape[-1]))
    for weight, number, values in ((few, captures, scores.sum(axis=1)), (1.0, block, scores.sum(axis=0))):
        each = np.stack([values[number == k].sum(axis=0) for k in np.unique(number)])
        scatter += weight * (each.T @ each)
    return scatter


def clustered_error(jacobian: torch.Tensor, left: torch.Tensor, captures: NDArray[np.int64]) -> Array:
    """Return standard errors [P] that hold a model's misfit, none below that of independent samples.

    Args:
        jacobian: Derivatives of the residual [N h w, P].
        left: The residual at the minimum [N, h, w].
        captures: Number of the capture of each frame [N].
    """
    count, (height, width) = len(np.unique(captures)), left.shape[1:]
    row, column = (np.arange(n) * BLOCKS // n for n in (height, width))
    scores = (jacobian * left.flatten()[:, None]).double().unflatten(0, (len(left), height * width)).numpy()
    block = (row[:, None] * BLOCKS + column).ravel()
    scatter = scatter_of(scores, captures, block, count / max(count - 1, 1))
    alone = _standard_error(jacobian, left.flatten())
    inverse = np.linalg.pinv((jacobian.T @ jacobian).double().numpy(), hermitian=True)
    return np.maximum(alone, np.sqrt(np.diag(inverse @ scatter @ inverse)))


_FINE_STEPS = 3  # the coarse stage has done the way; every step of the fine one costs seconds
_EXPLAINED = 0.05
_REACH = 5.0


@dataclass(frozen=True)
class TransportFit:
    """A fitted setup.

    Args:
        before: The start, with the gain and ambient light that suit it best.
        setup: The fit, gain and ambient light included.
        parameters: The parameters that were searched for, with their values at the start.
        error: Standard error of each, in its own unit, from the residual of the last stage; see `raised`.
    """

    before: Setup
    setup: Setup
    parameters: tuple[Parameter, ...]
    error: Array

    def raised(self, left: Residual) -> TransportFit:
        """Return the fit with errors times a residual over its noise; infinite where one is on a bound."""
        factor = math.inf if self.on_bound else max(1, left.after / left.noise)
        return replace(self, error=self.error * factor)

    @property
    def on_bound(self) -> dict[str, float]:
        """Parameters that ended on a bound of the search, within half a step, and that bound in its unit."""
        at = values_of(self.setup)
        ends = ((p, bound) for p in self.parameters for bound in (p.low, p.high))
        return {p.name: end for p, end in ends if abs(encoded(p, at[p.name]) - encoded(p, end)) <= 0.5 * p.step}


def parameters_of(setup: Setup, fixed: tuple[str, ...] = ()) -> tuple[Parameter, ...]:
    """Return the parameters that the frames of a setup decide, without those that are known.

    Args:
        setup: The setup.
        fixed: Names of settings that keep their values, e.g. `distance_m`.
    """
    free = (p for p in setup.parameters() if p.name not in fixed and p.name.partition(".")[0] not in fixed)
    return tuple(_near(p) for p in free)


def values_of(setup: Setup) -> dict[str, float]:
    """Return the values of a setup's parameters by name."""
    return {p.name: p.value for p in setup.parameters()}


def encoded(parameter: Parameter, value: float) -> float:
    """Return a parameter's value as a search sees it: its logarithm where it says so."""
    return math.log(value) if parameter.log else value


def _near(parameter: Parameter) -> Parameter:
    """Return a parameter that stays near its start: far off, impossible cameras fit by chance."""
    if not parameter.log:
        return parameter
    low, high = max(parameter.low, parameter.value / _REACH), min(parameter.high, parameter.value * _REACH)
    return replace(parameter, low=low, high=high)


def fit_transport(
    capture_set: CaptureSet,
    start: Setup,
    *,
    fixed: tuple[str, ...] = (),
    columns: int = 64,
    iterations: int = 20,
) -> TransportFit:
    """Fit a setup to the frames of captures with known targets.

    The residual at given parameters is that after the best gain and ambient light (variable projection, Golub
    and Pereyra 1973), so only the optics are searched: first a scan over blur and magnification, then
    Levenberg-Marquardt on small images and coarse cells, then on larger ones.

    Args:
        capture_set: The captures to fit.
        start: Where the search starts; its kind is the kind that is fitted.
        fixed: Names of settings that keep their values.
        columns: Columns of the working images, pixels; half as many in the coarse stage.
        iterations: Most steps per stage.

    Raises:
        DataError: The frames do not follow the targets.
    """
    start = fitting_strip(start, capture_set)
    start = start.with_parameters(values_of(start))  # what follows from others moves by itself
    parameters = parameters_of(start, fixed)
    coarse = FrameModel(capture_set, working_shape(capture_set.shape, columns // 2), _every(capture_set, 400))
    fine = FrameModel(capture_set, working_shape(capture_set.shape, columns), _every(capture_set, 200))
    quick, _ = _search(coarse, _scanned(coarse, start.coarsened(2.0)), parameters, iterations)
    of = capture_set.frame_of(_every(capture_set, 200))
    found, error = _search(fine, quick.coarsened(), parameters, min(iterations, _FINE_STEPS), of)
    found = found.coarsened()
    full = FrameModel(capture_set, capture_set.shape, _every(capture_set, 200))
    before = start.coarsened()
    before = full.fit(full.light(before))[0].into(before)
    light, _ = full.fit(full.light(found))
    return TransportFit(before, light.into(found), parameters, error)


def _search(
    model: FrameModel,
    start: Setup,
    parameters: tuple[Parameter, ...],
    iterations: int,
    captures: NDArray[np.int64] | None = None,
) -> tuple[Setup, Array]:
    def residual(values: Array) -> torch.Tensor:
        try:
            light = model.light(moved(start, parameters, values))
        except ConfigError:  # a camera that can't be, e.g. one that sees past the wall: the search turns back
            return model.frames * model.weight
        return model.fit(light)[1]

    here, steps = values_of(start), [p.step for p in parameters]
    first = [encoded(p, here[p.name]) for p in parameters]
    bounds = [(encoded(p, p.low), encoded(p, p.high)) for p in parameters]
    found = levenberg_marquardt(residual, first, steps, bounds, iterations=iterations)
    result, error = moved(start, parameters, found.values), found.error
    if captures is not None:
        left, high = residual(found.values), np.array(bounds)[:, 1]
        slopes = forward_jacobian(residual, found.values, left.flatten(), np.array(steps), high, "errors, ")
        error = clustered_error(slopes, left, captures)
    scale = [values_of(result)[p.name] if p.log else 1.0 for p in parameters]
    return result, error * np.array(scale)


def _scanned(model: FrameModel, start: Setup) -> Setup:
    """Return the best of a few blurs and magnifications around the start: a search from afar loses its way.

    Raises:
        DataError: The targets explain the frames hardly better than darkness, or better when mirrored.
    """
    best, least, mirrored = start, math.inf, math.inf
    for wider in (1.0, 0.7, 1.4):
        for rougher in (0.25, 0.5, 1.0, 2.0):
            note(f"start with {rougher:g} x the blur, {wider:g} x the magnification")
            trial = rescaled(start, blur=rougher, magnification=wider)
            picture = model.light(trial)
            light, residual = model.fit(picture)
            rms = _rms(residual)
            if light.gain > 0 and rms < least:
                best, least = trial, rms
            mirrored = min(mirrored, _rms(model.fit(picture.flip(-1))[1]))
    if mirrored < 0.8 * least:
        raise DataError(
            "the frames follow the targets the other way round; mirror the frames, or turn the motion's "
            "direction"
        )
    explained = 1 - least / _rms(model.fit(torch.zeros_like(model.frames))[1])
    if explained < _EXPLAINED:
        raise DataError(
            f"the targets explain {100 * max(explained, 0):.0f} % of what moves in the frames, below "
            f"{100 * _EXPLAINED:.0f} %; check the motion's start, speed and direction, or start "
            "nearer to the setup"
        )
    return best


def _rms(residual: torch.Tensor) -> float:
    return float(residual.square().mean().sqrt())


def rescaled(setup: Setup, **factors: float) -> Setup:
    """Return the setup with its parameters of some roles multiplied, e.g. `blur=2.0`; others stay."""
    return setup.with_parameters(
        {p.name: p.value * factors[p.role] for p in setup.parameters() if p.role in factors}
    )


def moved(setup: Setup, parameters: tuple[Parameter, ...], values: Array) -> Setup:
    """Return the setup with the search's values, [len(parameters)], each as `encoded` gives it."""
    return setup.with_parameters(
        {p.name: math.exp(v) if p.log else float(v) for p, v in zip(parameters, values, strict=True)}
    )


def _every(capture_set: CaptureSet, frames: int) -> int:
    """Return the stride that leaves about this many frames."""
    return max(1, sum(len(capture.frames) for capture in capture_set.captures) // frames)
