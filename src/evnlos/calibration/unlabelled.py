"""Fitting a rig to passes of objects that nobody knows: what makes the frames likeliest for any handwriting."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
from evnlos.calibration.evidence import Explained, MovingLight
from evnlos.calibration.frame_model import FrameModel, working_shape
from evnlos.calibration.residual import Residual
from evnlos.calibration.transport_fit import (
    TransportFit,
    encoded,
    moved,
    parameters_of,
    rescaled,
    values_of,
)
from evnlos.dataset.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.scene import Target
from evnlos.setups import Parameter, Setup

CELLS = 12
"""Cells a side of the unknown plate."""
_COLUMNS = 32  # of the working pictures: a rough wall shows no finer detail
_MOST_FRAMES = 12  # of a pass
_SCANS = tuple((wider, rougher) for wider in (1.0, 0.7, 1.4) for rougher in (0.25, 0.5, 1.0, 2.0))
_SCALE = 20.0  # steps of a finite difference that a parameter may be off
_FAR = 1e3  # cost of a camera that can't be


@dataclass(frozen=True, eq=False)
class UnlabelledFit:
    """A rig fitted to passes of unknown objects.

    Args:
        optics: The fit; its errors are those of each number alone, the others held.
        fitted: The captures that were fitted, with the plates that are expected as their targets.
        held_out: The others, likewise.
        check: Held-out passes: what is predicted of every other frame from the rest, by the start and by the
            fit, over the spread of what moves.
    """

    optics: TransportFit
    fitted: Shots
    held_out: Shots
    check: Residual


def fit_unlabelled(
    fit: Shots, held: Shots, start: Setup, *, fixed: tuple[str, ...] = (), iterations: int = 25
) -> UnlabelledFit:
    """Fit a rig to passes of unknown objects with known motion, and check it on other passes.

    The numbers of the optics are those that make the frames likeliest when the plates are any handwriting
    (`MovingLight.explained`): first a scan over blur and magnification, then quasi-Newton steps (L-BFGS-B).

    Args:
        fit: The captures to fit.
        held: The captures to check on.
        start: Where the search starts.
        fixed: Names of settings that keep their values.
        iterations: Most quasi-Newton steps.

    Raises:
        DataError: The captures move in different ways, or no camera near the start explains them.
    """
    start = start.with_parameters(values_of(start))
    light = _moving(fit, slice(None))
    parameters = parameters_of(start, fixed)
    found = _search(light, _scanned(light, start), parameters, iterations)
    given, asked = _moving(held, slice(0, None, 2)), _moving(held, slice(1, None, 2))
    before, after = (_missed(given, asked, rig) for rig in (start, found))
    known = light.explained(found)
    unseen = _moving(held, slice(None)).explained_at(found, known.gain, known.noise)
    seen, other = _with_plates(fit, known), _with_plates(held, unseen)
    full = FrameModel(seen, fit.shape, max(1, len(fit.frames()) // 200))
    lit = [full.fit(full.light(rig.coarsened()))[0].into(rig.coarsened()) for rig in (start, found)]
    optics = TransportFit(lit[0], lit[1], parameters, _errors(light, found, parameters))
    return UnlabelledFit(optics, seen, other, Residual(before, after, known.noise / light.spread))


def _moving(shots: Shots, frames: slice) -> MovingLight:
    """Return what moves in some of the frames of all captures, at the working size."""
    times = [shots.times_s(k) for k in range(len(shots.captures))]
    places = [motion.position_m(t) for motion, t in zip(shots.motions, times, strict=True)]
    count = min(len(one) for one in places)
    every = max(1, -(-count // _MOST_FRAMES))
    chosen = np.arange(0, count, every)[frames]
    first = places[0][chosen]
    for name, other in zip(shots.names, places, strict=True):
        if not np.allclose(other[chosen], first, atol=1e-3):
            raise DataError(
                f"{name} moves in another way than {shots.names[0]}; calibrate one motion at a time"
            )
    shape = working_shape(shots.shape, _COLUMNS)
    pictures = [
        reduce_by_area(capture.frames[chosen] / np.float32(shots.peak), shape) for capture in shots.captures
    ]
    return MovingLight(torch.from_numpy(np.stack(pictures)), first, shots.plate_m, CELLS)


def _scanned(light: MovingLight, start: Setup) -> Setup:
    trials = (rescaled(start, magnification=a, blur=b) for a, b in _SCANS)
    return min(trials, key=lambda rig: _cost(light, rig))


def _search(light: MovingLight, start: Setup, parameters: tuple[Parameter, ...], iterations: int) -> Setup:
    from scipy.optimize import minimize  # scipy loads slowly

    here = values_of(start)
    middle = np.array([encoded(p, here[p.name]) for p in parameters])
    scale = np.array([_SCALE * p.step for p in parameters])

    def cost(at: NDArray[np.float64]) -> float:
        return _cost(light, moved(start, parameters, middle + at * scale))

    def slope(at: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        here, half = cost(at), 0.5 / _SCALE
        pairs = ((cost(at + one), cost(at - one)) for one in np.eye(len(at)) * half)
        return here, np.array([(up - down) / (2 * half) for up, down in pairs])

    bounds = [
        ((encoded(p, p.low) - m) / s, (encoded(p, p.high) - m) / s)
        for p, m, s in zip(parameters, middle, scale, strict=True)
    ]
    found = minimize(
        slope,
        np.zeros(len(middle)),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": iterations},
    )
    if not found.fun < _FAR:
        raise DataError("no camera near the start explains the frames; give a start that is nearer to the rig")
    return moved(start, parameters, middle + found.x * scale)


def _cost(light: MovingLight, rig: Setup) -> float:
    try:
        return light.explained(rig).cost
    except ConfigError:  # a camera that can't be, e.g. one that sees past the wall: the search turns back
        return _FAR


def _missed(given: MovingLight, asked: MovingLight, rig: Setup) -> float:
    """Return how far some frames are from what others predict of them, over the spread of what moves."""
    away = asked.moving - asked.predicted(rig, given.explained(rig))
    return float(away.square().mean().sqrt()) / asked.spread


def _with_plates(shots: Shots, found: Explained) -> Shots:
    """Return the captures with the expected plates as their targets."""
    return Shots(
        tuple(
            replace(capture, target=Target(capture.name, plate.clamp(0, 1).float().numpy(), shots.plate_m))
            for capture, plate in zip(shots.captures, found.plates, strict=True)
        )
    )


def _errors(light: MovingLight, rig: Setup, parameters: tuple[Parameter, ...]) -> NDArray[np.float64]:
    """Return the standard error of each number, the others held, from the evidence's curvature."""
    known = values_of(rig)
    values = np.array([encoded(p, known[p.name]) for p in parameters])
    count = light.moving.numel()
    here = _cost(light, rig) * count
    found: list[float] = []
    for k, p in enumerate(parameters):
        step = np.zeros(len(values))
        step[k] = p.step
        sides = [_cost(light, moved(rig, parameters, values + sign * step)) * count for sign in (1, -1)]
        bend = (sum(sides) - 2 * here) / p.step**2
        error = bend**-0.5 if bend > 0 else np.inf
        found.append(error * (known[p.name] if p.log else 1.0))
    return np.array(found)
