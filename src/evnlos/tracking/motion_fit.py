"""Fitting a motion: positions, and distances where they change, by the calibrated operator.

- Positions by the calibrated operator: places and distances that make the frames of one target likeliest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.inverse import SequenceOperator
from evnlos.inverse.operators import Gradient, normal_matrix
from evnlos.inverse.sequence_problem import matrix_of, mean_weight, strip_of
from evnlos.optics import MatrixTransport
from evnlos.setups import Setup
from evnlos.tracking.registration import middle_of_light
from evnlos.types import Plane

REACH = 0.3
"""Largest change of the distance's logarithm that is looked for: 0.74 to 1.35 of the setup's own distance."""
_STEP = 0.05  # of the logarithm between two matrices: the light moves by less than any wall's blur
_NODES = np.linspace(-REACH, REACH, round(2 * REACH / _STEP) + 1)
_NEAR = 4  # matrices that one in between is made of
# Coefficients of Lagrange's cubics over the steps -1, 0, 1, 2, [power, matrix]
_BASIS = np.linalg.inv(np.vander(np.arange(-1.0, _NEAR - 1.0), increasing=True))


class Depths:
    """Matrices from the target's plane at any distance, by Lagrange's cubics in its logarithm.

    Nothing else of the setup moves. What is further away is smaller in the image, more blurred, dimmer and
    seen elsewhere: all four tell the distance.

    Args:
        setup: The setup.
        own: Its matrix from the strip, whose scale those of other distances share.
    """

    def __init__(self, setup: Setup, own: MatrixTransport) -> None:
        strip, shape = own.source, own.shape
        assert isinstance(strip, Plane)
        here_m = setup.default_distance_m
        if here_m is None:
            raise ConfigError(f"the setup {setup.kind!r} states no distance; follow without depth")
        self._strip, self._shape = strip, shape
        self._nodes = torch.stack(
            [setup.at_distance(here_m * float(np.exp(node))).matrix(shape, strip).float() for node in _NODES]
        )  # [G, H W, cells]
        self._scale = float(own.matrix.sum() / self._nodes[len(_NODES) // 2].double().sum())

    def at(self, log_distance: float) -> MatrixTransport:
        """Return the matrix at a distance, ln(distance / setup's distance) within +- `REACH`."""
        first, along = _place(log_distance)
        weights = np.power(along, np.arange(_NEAR)) @ _BASIS
        return MatrixTransport(self._sum(weights, self._nodes[first : first + _NEAR]), self._strip, self._shape)

    def slope(self, log_distance: float, light: torch.Tensor) -> torch.Tensor:
        """Return the derivative by the distance's logarithm, [H W], of the image of shining cells, [h, w]."""
        first, along = _place(log_distance)
        powers = np.arange(1, _NEAR)
        weights = np.concatenate([[0.0], powers * np.power(along, powers - 1)]) @ _BASIS / _STEP
        near = self._nodes[first : first + _NEAR]
        return self._sum(weights, near @ light.flatten().to(near))

    def _sum(self, weights: NDArray[np.floating], values: torch.Tensor) -> torch.Tensor:
        return torch.einsum("g,g...->...", torch.from_numpy(self._scale * weights).to(values), values)


def _place(log_distance: float) -> tuple[int, float]:
    """Return the first of the matrices around a distance, and its place between the middle two, in steps."""
    steps = (log_distance + REACH) / _STEP
    first = min(max(int(steps) - 1, 0), len(_NODES) - _NEAR)
    return first, steps - first - 1


_ROUNDS = 16
_HALF_STEP = 0.25  # cells
_STATIC = 1.0  # a pixel's constant offset over its noise
_PRIOR = 3.0  # weight of the target's smoothness, in units of the noise's variance
_MARGIN_M = 0.02
_LONGEST_M = 0.01  # step of one round
_ENOUGH = 0.1  # of a place's standard deviation: a step below it changes nothing that is known
_UNTOLD = 1e-3  # share of a direction's information that the target leaves, below which it is not told


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Positions of the target and the target itself.

    Args:
        position_m: Middle of the object's light (x, y), float64 [N, 2], metres.
        covariance: Of each position, [N, 2, 2], squared metres.
        target: The object, its light's middle in the array's middle, float64 [n, n].
        log_distance: ln(distance to the wall / the setup's), [N]; its mean is 0, as a target that is nearer and
            one that is larger and dimmer look much the same. None where it was not looked for.
        log_distance_sigma: Its standard deviation, [N].
        misfit: What the target leaves of the frames' changes, over their noise, root mean square; 1 is a setup
            that explains all.
    """

    position_m: NDArray[np.float64]
    covariance: NDArray[np.float64]
    target: torch.Tensor
    log_distance: NDArray[np.float64] | None = None
    log_distance_sigma: NDArray[np.float64] | None = None
    misfit: float = 1.0


def fit_motion(
    light: torch.Tensor,
    setup: Setup,
    start_m: NDArray[np.float64],
    noise: float,
    target_size_m: float,
    cells: int = 20,
    *,
    depth: bool = False,
) -> MotionFit:
    """Find the places of a target, and the target, that explain the frames best: Gauss and Newton's method.

    The target is eliminated (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973): a
    step of the places knows that the target follows, as it does where a path is stretched or a target comes
    nearer on its way. A target and a path are only known together up to a shift; the target's middle of light
    is the reference.

    Args:
        light: Frames without ambient light, white levels, [N, h, w].
        setup: The setup.
        start_m: First guess of the positions, [N, 2], metres.
        noise: Standard deviation of a sample's noise, white levels.
        target_size_m: Side of a target plane that surely holds the object, metres.
        cells: Cells a side of it.
        depth: Find the distance to the wall in each frame too.
    """
    target_plane = Plane(cells, cells, target_size_m / cells)
    shape = (int(light.shape[1]), int(light.shape[2]))
    reach = np.concatenate([start_m + _MARGIN_M, start_m - _MARGIN_M])
    # The gain's exact meaning does not matter for places.
    transport = matrix_of(setup.resized(shape).operator(strip_of(reach, target_plane)))
    depths = Depths(setup, transport) if depth else None
    blank = torch.zeros(target_plane.shape, dtype=torch.float64)
    prior = _PRIOR * noise**2 * normal_matrix(Gradient("dark"), blank)
    distance_m = setup.default_distance_m or 1.0  # only a scale, where no depth is looked for
    state = np.zeros((len(start_m), 3 if depth else 2))  # x, y, and R ln(distance / R), metres
    state[:, :2] = start_m
    image, covariance, misfit = blank, np.zeros((len(state), state.shape[1], state.shape[1])), 1.0
    for _ in range(_ROUNDS):
        fit = Fit(target_plane, transport, depths, state, distance_m)
        image, step, covariance, misfit = fit.step(light.double(), prior, noise)
        state = state + step * min(1.0, _LONGEST_M / np.abs(step).max())
        # The place of the light's middle: the target is drawn around it the next time.
        state[:, :2] += _middle(image.numpy()) * target_plane.pitch_m
        state[:, 2:] -= state[:, 2:].mean(axis=0)
        state[:, 2:] = np.clip(state[:, 2:], -REACH * distance_m, REACH * distance_m)
        if (np.abs(step) < _ENOUGH * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).all():
            break
    if not depth:
        return MotionFit(state, covariance, image, misfit=misfit)
    sigma = np.sqrt(covariance[:, 2, 2]) / distance_m
    return MotionFit(state[:, :2], covariance[:, :2, :2], image, state[:, 2] / distance_m, sigma, misfit)


def _middle(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far the middle of an image's light is from the image's, (x, y), pixels."""
    bright = np.where(image > 0.1 * image.max(), image, 0.0)
    return np.array(middle_of_light(bright)) - (np.array(image.shape[::-1]) - 1) / 2


class Fit:
    """The frames as a function of target and places, around one state.

    Args:
        target_plane: The target plane's cells.
        transport: The setup's matrix from the strip.
        depths: The matrices of other distances, where those are looked for.
        state: x, y and, with `depths`, R ln(distance / R) of each frame, [N, K], metres.
        distance_m: R, the setup's distance, metres.
    """

    def __init__(
        self,
        target_plane: Plane,
        transport: MatrixTransport,
        depths: Depths | None,
        state: NDArray[np.float64],
        distance_m: float,
    ) -> None:
        self._depths, self._state, self._distance_m = depths, state, distance_m
        self._sights = [
            SequenceOperator(
                transport if depths is None else depths.at(float(place[2]) / distance_m),
                target_plane,
                place[None, :2],
            )
            for place in state
        ]
        self._maps = torch.stack([sight.matrix()[0].float() for sight in self._sights])  # [N, P, n n]
        self._total = self._maps.sum(dim=0).double()
        self._still = (1 - mean_weight(len(state), _STATIC)) / len(state)

    def step(
        self, light: torch.Tensor, prior: torch.Tensor, noise: float
    ) -> tuple[torch.Tensor, NDArray[np.float64], NDArray[np.float64], float]:
        """Return the target, the step of all frames [N, K], the covariance of each [N, K, K], and the misfit.

        Args:
            light: Frames, float64 [N, h, w].
            prior: Matrix of the target's prior, [n n, n n].
            noise: Standard deviation of a sample's noise.
        """
        seen = light.flatten(1)  # [N, P]
        normal = prior + self._squared()
        root = torch.linalg.cholesky(normal)
        image = torch.cholesky_solve(self._back(self._moving(seen))[:, None], root)[:, 0]
        left = seen - (self._maps @ image.float()).double()
        target = image.reshape(self._sights[0].target_plane.shape)
        slope = self._slopes(target)  # [N, K, P]
        frames, kinds = slope.shape[:2]
        # Coordinates in which each frame alone would know its place equally well in all directions.
        lower = torch.linalg.cholesky(slope @ slope.mT)
        even = torch.linalg.solve_triangular(lower, slope, upper=False)
        pull = (even @ self._moving(left)[..., None]).flatten()
        flat = even.flatten(0, 1)  # [N K, P]
        back = (even.float() @ self._maps).double().flatten(0, 1)  # [N K, n n]
        back -= self._still * flat @ self._total
        shared = torch.linalg.solve_triangular(root, back.mT, upper=False)
        one = torch.eye(len(flat), dtype=flat.dtype)
        own = one - self._still * flat @ flat.mT
        # A step that is the same in all frames is the target's own: it is left out.
        alike = torch.linalg.qr(lower.mT.flatten(0, 1))[0]  # [N K, K]
        apart = one - alike @ alike.mT
        told, ways = torch.linalg.eigh(apart @ (own - shared.mT @ shared) @ apart)
        inverse = (ways * torch.where(told > _UNTOLD, 1 / told, 0.0)) @ ways.mT
        step = (inverse @ pull).unflatten(0, (frames, kinds))
        each = inverse.unflatten(0, (frames, kinds)).unflatten(2, (frames, kinds)).diagonal(dim1=0, dim2=2)
        up = torch.linalg.inv(lower).mT  # [N, K, K]
        misfit = left.square().mean(dim=1).clamp(min=noise**2)
        covariance = misfit[:, None, None] * (up @ each.movedim(-1, 0) @ up.mT)
        unexplained = float(self._moving(left).square().mean().sqrt()) / noise
        return target, (up @ step[..., None])[..., 0].numpy(), covariance.numpy(), unexplained

    def _moving(self, frames: torch.Tensor) -> torch.Tensor:
        """Return frames [N, P] without what stands still in them, as far as it is not known."""
        return frames - self._still * frames.sum(dim=0)

    def _back(self, frames: torch.Tensor) -> torch.Tensor:
        """Return the target's gradient, [n n], of frames [N, P]."""
        return torch.einsum("npc,np->c", self._maps, frames.float()).double()

    def _squared(self) -> torch.Tensor:
        """Return the target's normal matrix, [n n, n n]."""
        squares = torch.zeros(self._maps.shape[2], self._maps.shape[2], dtype=torch.float64)
        for one in self._maps:
            squares += (one.mT @ one).double()
        return squares - self._still * self._total.mT @ self._total

    def _slopes(self, image: torch.Tensor) -> torch.Tensor:
        """Return the frames' derivatives by x, y and R ln(distance), [N, K, P], a metre."""
        slopes = []
        for sight, place in zip(self._sights, self._state, strict=True):
            half = _HALF_STEP * sight.target_plane.pitch_m
            own = []
            for axis in range(2):
                shift = np.zeros(2)
                shift[axis] = half
                ahead, behind = (
                    SequenceOperator(sight.transport, sight.target_plane, sight.positions_m + way).drawn(image)
                    for way in (shift, -shift)
                )
                own.append(sight.transport((ahead - behind) / (2 * half)).flatten())
            if self._depths is not None:
                slope = self._depths.slope(float(place[2]) / self._distance_m, sight.drawn(image)[0])
                own.append(slope / self._distance_m)
            slopes.append(torch.stack([one.double() for one in own]))
        return torch.stack(slopes)
