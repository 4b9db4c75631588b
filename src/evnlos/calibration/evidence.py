"""How likely frames are where nobody knows what was hidden: the plate is integrated out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.setups import Setup
from evnlos.solver import PlatePass
from evnlos.solver.glyph_prior import handwritten_plates
from evnlos.solver.plate_pass import strip_gram_of, strip_of
from evnlos.transport import MatrixTransport
from evnlos.types import Plane

WRITERS = 3
"""Writers of the prior's handwriting."""
_SHARE = 0.1  # of what moves that is noise, at the start of the search
_REACH = 12.0  # of the search for gain and noise, in units of their logarithms


@dataclass(frozen=True, eq=False)
class Explained:
    """How a rig explains the passes of unknown objects.

    Args:
        cost: Negative log evidence over the number of samples; lower is better.
        gain: White levels a unit of the rig's light.
        noise: Standard deviation of a sample's noise, white levels; what the model cannot do counts as noise.
        plates: Expected plate of each pass, float64 [P, n, n]; noise makes some values leave 0..1.
    """

    cost: float
    gain: float
    noise: float
    plates: torch.Tensor


@dataclass(frozen=True, eq=False)
class EvidenceTerms:
    """The evidence of one rig for any gain g and noise variance v.

    y = g B x + e with B the rig's light from the plate's cells to all frames, less its mean over the pass,
    x ~ N(m, C) handwritten plates, and e ~ N(0, v). With C = R R^T and R^T B^T B R = V diag(l) V^T,

        -2 log p(y) = n log v + sum log(1 + g^2 l / v) + (|z|^2 - c^T (v + g^2 l)^-1 c) / v,

    z = y - g B m and c = g V^T R^T B^T z, up to a constant: the evidence of MacKay (Neural Computation, 1992)
    by Woodbury's identity, which leaves two numbers to search once B^T B is decomposed.

    Args:
        power: |y|^2 of each pass, [P].
        both: m^T B^T y, [P].
        lit: |B m|^2.
        seen: V^T R^T B^T y, [P, n].
        shown: V^T R^T B^T B m, [n].
        strength: l, [n].
        turn: V, [n, n].
        samples: Samples of a pass whose noise is independent: without the means that were taken off.
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
        """Return the expected plates, as coefficients of R V, [P, n]."""
        return self._told(gain) / (variance + gain**2 * self.strength)

    def _told(self, gain: float) -> torch.Tensor:
        return gain * (self.seen - gain * self.shown)


class MovingLight:
    """What moves in the frames of passes with one known motion: each pixel's mean over the pass is taken off.

    Ambient light and the camera's fixed pattern rest, so they go with the mean, whatever they look like.

    Args:
        frames: Frames at a working size, white levels, [P, N, h, w].
        position_m: The plate's centre in each, (x, y) in metres, [N, 2].
        size_m: Side of the plate, metres.
        cells: Cells a side of it.
    """

    def __init__(self, frames: torch.Tensor, position_m: NDArray, size_m: float, cells: int) -> None:
        frames = frames.double()
        self.moving = frames - frames.mean(dim=1, keepdim=True)
        self.position_m = np.asarray(position_m, dtype=np.float64)
        self.plate = Plane(cells, cells, size_m / cells)
        self._strip = strip_of(self.position_m, self.plate)
        self._prior = handwritten_plates(self.plate, WRITERS)

    @property
    def spread(self) -> float:
        """Standard deviation of what moves, white levels."""
        return float(self.moving.square().mean().sqrt())

    def explained(self, rig: Setup) -> Explained:
        """Return how a rig explains the frames at its best gain and noise."""
        from scipy.optimize import minimize  # scipy loads slowly

        terms = self.terms(rig)
        # The gain at which the mean plate alone moves as much as the frames, and a tenth of that as noise.
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
        plates = self._plates(terms, gain, variance)
        return Explained(float(found.fun), gain, math.sqrt(variance), plates)

    def explained_at(self, rig: Setup, gain: float, noise: float) -> Explained:
        """Return how a rig explains the frames at a gain and a noise that other passes told."""
        terms, variance = self.terms(rig), noise**2
        return Explained(terms.cost(gain, variance), gain, noise, self._plates(terms, gain, variance))

    def _plates(self, terms: EvidenceTerms, gain: float, variance: float) -> torch.Tensor:
        plates = self._prior.mean + terms.code(gain, variance) @ terms.turn.mT @ self._prior.root.mT
        return plates.unflatten(1, self.plate.shape)

    def terms(self, rig: Setup) -> EvidenceTerms:
        """Return what the evidence of a rig is made of, all but gain and noise."""
        sight = self.sight(rig)
        gram = sight.gram(strip_gram_of(sight.transport), static=math.inf)
        mean, root = self._prior.mean, self._prior.root
        strength, turn = torch.linalg.eigh(root.mT @ gram @ root)
        back = sight.adjoint(self.moving).flatten(1)  # B^T y, [P, n n]
        return EvidenceTerms(
            power=self.moving.square().sum(dim=(1, 2, 3)),
            both=back @ mean,
            lit=float(mean @ gram @ mean),
            seen=back @ root @ turn,
            shown=mean @ gram @ root @ turn,
            strength=strength.clamp(min=0),
            turn=turn,
            samples=self.moving[0].numel() - self.moving[0, 0].numel(),
        )

    def predicted(self, rig: Setup, known: Explained) -> torch.Tensor:
        """Return what moves in the frames that a rig makes of known plates, [P, N, h, w]."""
        frames = known.gain * self.sight(rig)(known.plates)
        return frames - frames.mean(dim=1, keepdim=True)

    def sight(self, rig: Setup) -> PlatePass:
        """Return the operator from a plate to all frames, at gain 1."""
        shape = (int(self.moving.shape[2]), int(self.moving.shape[3]))
        matrix = rig.matrix(shape, self._strip)
        return PlatePass(MatrixTransport(matrix, self._strip, shape), self.plate, self.position_m)
