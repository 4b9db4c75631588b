"""Calibration from sequences of unknown targets: what makes the frames likeliest.

- How likely frames are where nobody knows what was hidden: the target is integrated out.
- Fitting a setup to sequences of objects that nobody knows: what makes the frames likeliest for any
handwriting.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.captures import CaptureSet, working_shape
from evnlos.calibration.frame_model import FrameModel
from evnlos.calibration.transport_fit import (
    Residual,
    TransportFit,
    encoded,
    moved,
    parameters_of,
    rescaled,
    values_of,
)
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import SequenceOperator
from evnlos.inverse.prior import handwritten_targets
from evnlos.inverse.sequence_problem import strip_gram_of, strip_of
from evnlos.machine import note
from evnlos.optics import MatrixTransport
from evnlos.scene import Target
from evnlos.setups import Parameter, Setup
from evnlos.types import Plane

WRITERS = 3
"""Writers of the prior's handwriting."""
_SHARE = 0.1  # of what moves that is noise, at the start of the search
_REACH = 12.0  # of the search for gain and noise, in units of their logarithms


@dataclass(frozen=True, eq=False)
class Explained:
    """How a setup explains the sequences of unknown objects.

    Args:
        cost: Negative log evidence over the number of samples; lower is better.
        gain: White levels per unit of the setup's light.
        noise: Standard deviation of a sample's noise, white levels; what the model cannot do counts as noise.
        targets: Expected target of each sequence, float64 [P, n, n]; noise makes some values leave 0..1.
    """

    cost: float
    gain: float
    noise: float
    targets: torch.Tensor


@dataclass(frozen=True, eq=False)
class MarginalLikelihoodTerms:
    """The evidence of one setup for any gain g and noise variance v.

    y = g B x + e with B the setup's light from the target plane's cells to all frames, less its mean over the
    sequence, x ~ N(m, C) handwritten targets, and e ~ N(0, v). With C = R R^T and R^T B^T B R = V diag(l) V^T,

        -2 log p(y) = n log v + sum log(1 + g^2 l / v) + (|z|^2 - c^T (v + g^2 l)^-1 c) / v,

    z = y - g B m and c = g V^T R^T B^T z, up to a constant: the evidence of MacKay (Neural Computation, 1992)
    by Woodbury's identity, which leaves two numbers to search once B^T B is decomposed.

    Args:
        power: |y|^2 of each sequence, [P].
        both: m^T B^T y, [P].
        lit: |B m|^2.
        seen: V^T R^T B^T y, [P, n].
        shown: V^T R^T B^T B m, [n].
        strength: l, [n].
        turn: V, [n, n].
        samples: Samples of a sequence whose noise is independent: without the means that were taken off.
    """

    power: torch.Tensor
    both: torch.Tensor
    lit: float
    seen: torch.Tensor
    shown: torch.Tensor
    strength: torch.Tensor
    turn: torch.Tensor
    samples: int

    def cost(self, gain: float, variance: float) -> float:
        """Return -log p(y) over the number of samples, the constant left out."""
        left = self.power - 2 * gain * self.both + gain**2 * self.lit
        told = (self._told(gain).square() / (variance + gain**2 * self.strength)).sum(dim=1)
        spread = self.samples * math.log(variance) + torch.log1p(gain**2 * self.strength / variance).sum()
        return float(((left - told) / variance + spread).mean()) / (2 * self.samples)

    def code(self, gain: float, variance: float) -> torch.Tensor:
        """Return the expected targets, as coefficients of R V, [P, n]."""
        return self._told(gain) / (variance + gain**2 * self.strength)

    def _told(self, gain: float) -> torch.Tensor:
        return gain * (self.seen - gain * self.shown)


class FrameResiduals:
    """What moves in the frames of sequences with one known motion: each pixel's mean over the sequence is taken
    off.

    Ambient light and the camera's fixed pattern rest, so they go with the mean, whatever they look like.

    Args:
        frames: Frames at a working size, white levels, [P, N, h, w].
        position_m: The target's centre in each, (x, y) in metres, [N, 2].
        size_m: Side of the target plane, metres.
        cells: Cells a side of it.
    """

    def __init__(self, frames: torch.Tensor, position_m: NDArray, size_m: float, cells: int) -> None:
        frames = frames.double()
        self.moving = frames - frames.mean(dim=1, keepdim=True)
        self.position_m = np.asarray(position_m, dtype=np.float64)
        self.target_plane = Plane(cells, cells, size_m / cells)
        self._strip = strip_of(self.position_m, self.target_plane)
        self._prior = handwritten_targets(self.target_plane, WRITERS)

    @property
    def spread(self) -> float:
        """Standard deviation of what moves, white levels."""
        return float(self.moving.square().mean().sqrt())

    def explained(self, setup: Setup) -> Explained:
        """Return how a setup explains the frames at its best gain and noise."""
        from scipy.optimize import minimize  # scipy loads slowly

        terms = self.terms(setup)
        # The gain at which the mean target alone moves as much as the frames, and a tenth of that as noise.
        power = float(terms.power.mean())
        start = np.log([math.sqrt(power / terms.lit), _SHARE * power / terms.samples])
        found = minimize(
            lambda at: terms.cost(math.exp(at[0]), math.exp(at[1])),
            start,
            method="Nelder-Mead",
            bounds=[(value - _REACH, value + _REACH) for value in start],
            options={"xatol": 1e-3, "fatol": 1e-9, "initial_simplex": start - np.eye(3, 2)},
        )
        gain, variance = math.exp(found.x[0]), math.exp(found.x[1])
        targets = self._targets(terms, gain, variance)
        return Explained(float(found.fun), gain, math.sqrt(variance), targets)

    def explained_at(self, setup: Setup, gain: float, noise: float) -> Explained:
        """Return how a setup explains the frames at a gain and a noise that other sequences told."""
        terms, variance = self.terms(setup), noise**2
        return Explained(terms.cost(gain, variance), gain, noise, self._targets(terms, gain, variance))

    def _targets(self, terms: MarginalLikelihoodTerms, gain: float, variance: float) -> torch.Tensor:
        targets = self._prior.mean + terms.code(gain, variance) @ terms.turn.mT @ self._prior.root.mT
        return targets.unflatten(1, self.target_plane.shape)

    def terms(self, setup: Setup) -> MarginalLikelihoodTerms:
        """Return what the evidence of a setup is made of, all but gain and noise."""
        sight = self.sight(setup)
        gram = sight.gram(strip_gram_of(sight.transport), static=math.inf)
        mean, root = self._prior.mean, self._prior.root
        strength, turn = torch.linalg.eigh(root.mT @ gram @ root)
        back = sight.adjoint(self.moving).flatten(1)  # B^T y, [P, n n]
        return MarginalLikelihoodTerms(
            power=self.moving.square().sum(dim=(1, 2, 3)),
            both=back @ mean,
            lit=float(mean @ gram @ mean),
            seen=back @ root @ turn,
            shown=mean @ gram @ root @ turn,
            strength=strength.clamp(min=0),
            turn=turn,
            samples=self.moving[0].numel() - self.moving[0, 0].numel(),
        )

    def predicted(self, setup: Setup, known: Explained) -> torch.Tensor:
        """Return what moves in the frames that a setup makes of known targets, [P, N, h, w]."""
        frames = known.gain * self.sight(setup)(known.targets)
        return frames - frames.mean(dim=1, keepdim=True)

    def sight(self, setup: Setup) -> SequenceOperator:
        """Return the operator from a target to all frames, at gain 1."""
        shape = (int(self.moving.shape[2]), int(self.moving.shape[3]))
        matrix = setup.matrix(shape, self._strip)
        return SequenceOperator(MatrixTransport(matrix, self._strip, shape), self.target_plane, self.position_m)


CELLS = 12
"""Cells a side of the unknown target."""
_COLUMNS = 32  # of the working images: a rough wall shows no finer detail
_MOST_FRAMES = 12  # of a sequence
_SCANS = tuple((wider, rougher) for wider in (1.0, 0.7, 1.4) for rougher in (0.25, 0.5, 1.0, 2.0))
_SCALE = 20.0  # steps of a finite difference that a parameter may be off
_FAR = 1e3  # cost of a camera that can't be


@dataclass(frozen=True, eq=False)
class UnlabelledFit:
    """A setup fitted to sequences of unknown objects.

    Args:
        optics: The fit; its errors are those of each number alone, the others held.
        fitted: The captures that were fitted, with the targets that are expected as their targets.
        held_out: The others, likewise.
        check: Held-out sequences: what is predicted of every other frame from the rest, by the start and by the
            fit, over the spread of what moves.
    """

    optics: TransportFit
    fitted: CaptureSet
    held_out: CaptureSet
    check: Residual


def fit_blind(
    fit: CaptureSet, held: CaptureSet, start: Setup, *, fixed: tuple[str, ...] = (), iterations: int = 25
) -> UnlabelledFit:
    """Fit a setup to sequences of unknown objects with known motion, and check it on other sequences.

    The numbers of the optics are those that make the frames likeliest when the targets are any handwriting
    (`FrameResiduals.explained`): first a scan over blur and magnification, then quasi-Newton steps (L-BFGS-B).

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
    before, after = (_missed(given, asked, setup) for setup in (start, found))
    known = light.explained(found)
    unseen = _moving(held, slice(None)).explained_at(found, known.gain, known.noise)
    seen, other = _with_targets(fit, known), _with_targets(held, unseen)
    full = FrameModel(seen, fit.shape, max(1, len(fit.frames()) // 200))
    lit = [full.fit(full.light(setup.coarsened()))[0].into(setup.coarsened()) for setup in (start, found)]
    optics = TransportFit(lit[0], lit[1], parameters, _errors(light, found, parameters))
    return UnlabelledFit(optics, seen, other, Residual(before, after, known.noise / light.spread))


def _moving(capture_set: CaptureSet, frames: slice) -> FrameResiduals:
    """Return what moves in some of the frames of all captures, at the working size."""
    times = [capture_set.times_s(k) for k in range(len(capture_set.captures))]
    places = [motion.position_m(t) for motion, t in zip(capture_set.motions, times, strict=True)]
    count = min(len(one) for one in places)
    every = max(1, -(-count // _MOST_FRAMES))
    chosen = np.arange(0, count, every)[frames]
    first = places[0][chosen]
    for name, other in zip(capture_set.names, places, strict=True):
        if not np.allclose(other[chosen], first, atol=1e-3):
            raise DataError(
                f"{name} moves in another way than {capture_set.names[0]}; calibrate one motion at a time"
            )
    shape = working_shape(capture_set.shape, _COLUMNS)
    pictures = [
        reduce_by_area(capture.frames[chosen] / np.float32(capture_set.peak), shape)
        for capture in capture_set.captures
    ]
    return FrameResiduals(torch.from_numpy(np.stack(pictures)), first, capture_set.target_size_m, CELLS)


def _scanned(light: FrameResiduals, start: Setup) -> Setup:
    trials = (rescaled(start, magnification=a, blur=b) for a, b in _SCANS)
    return min(trials, key=lambda setup: _cost(light, setup))


def _search(light: FrameResiduals, start: Setup, parameters: tuple[Parameter, ...], iterations: int) -> Setup:
    from scipy.optimize import minimize  # scipy loads slowly

    here = values_of(start)
    middle = np.array([encoded(p, here[p.name]) for p in parameters])
    scale = np.array([_SCALE * p.step for p in parameters])

    tried = itertools.count(1)

    def cost(at: NDArray[np.float64]) -> float:
        note(f"trial {next(tried)}")
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
        raise DataError(
            "no camera near the start explains the frames; give a start that is nearer to the setup"
        )
    return moved(start, parameters, middle + found.x * scale)


def _cost(light: FrameResiduals, setup: Setup) -> float:
    try:
        return light.explained(setup).cost
    except ConfigError:  # a camera that can't be, e.g. one that sees past the wall: the search turns back
        return _FAR


def _missed(given: FrameResiduals, asked: FrameResiduals, setup: Setup) -> float:
    """Return how far some frames are from what others predict of them, over the spread of what moves."""
    away = asked.moving - asked.predicted(setup, given.explained(setup))
    return float(away.square().mean().sqrt()) / asked.spread


def _with_targets(capture_set: CaptureSet, found: Explained) -> CaptureSet:
    """Return the captures with the expected targets as their targets."""
    return CaptureSet(
        tuple(
            replace(
                capture,
                target=Target(capture.name, target.clamp(0, 1).float().numpy(), capture_set.target_size_m),
            )
            for capture, target in zip(capture_set.captures, found.targets, strict=True)
        )
    )


def _errors(light: FrameResiduals, setup: Setup, parameters: tuple[Parameter, ...]) -> NDArray[np.float64]:
    """Return the standard error of each number, the others held, from the evidence's curvature."""
    known = values_of(setup)
    values = np.array([encoded(p, known[p.name]) for p in parameters])
    count = light.moving.numel()
    here = _cost(light, setup) * count
    found: list[float] = []
    for k, p in enumerate(parameters):
        step = np.zeros(len(values))
        step[k] = p.step
        sides = [_cost(light, moved(setup, parameters, values + sign * step)) * count for sign in (1, -1)]
        bend = (sum(sides) - 2 * here) / p.step**2
        error = bend**-0.5 if bend > 0 else np.inf
        found.append(error * (known[p.name] if p.log else 1.0))
    return np.array(found)
