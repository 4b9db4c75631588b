"""Positions by the calibrated operator: the places that make the frames of one plate likeliest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.solver import JointProblem, PlatePass
from evnlos.solver.plate_pass import strip_gram_of, strip_of, strip_transport
from evnlos.tracking.registration import middle_of_light
from evnlos.transport import RadiometricTransport
from evnlos.types import Plane

_ROUNDS = 12
_HALF_STEP = 0.25  # cells
_PRIOR = 3.0  # weight of the plate's smoothness, in units of the noise's variance
_MARGIN_M = 0.02


@dataclass(frozen=True, eq=False)
class RigShift:
    """Positions of the plate and the plate itself.

    Args:
        position_m: Middle of the object's light (x, y), float64 [N, 2], metres.
        covariance: Of each position, [N, 2, 2], squared metres.
        plate: The object, its light's middle in the array's middle, float64 [n, n].
    """

    position_m: NDArray[np.float64]
    covariance: NDArray[np.float64]
    plate: torch.Tensor


def rig_shift(
    light: torch.Tensor,
    rig: RadiometricTransport,
    start_m: NDArray[np.float64],
    noise: float,
    plate_m: float,
    cells: int = 20,
) -> RigShift:
    """Alternate between the plate that all frames share (`JointProblem`) and the place of each frame.

    A plate and a path are only known together up to a shift; the plate's middle of light is the reference.

    Args:
        light: Frames without ambient light, white levels, [N, h, w].
        rig: The rig.
        start_m: First guess of the positions, [N, 2], metres.
        noise: Standard deviation of a sample's noise, white levels.
        plate_m: Side of a plate that surely holds the object, metres.
        cells: Cells a side of it.
    """
    plate = Plane(cells, cells, plate_m / cells)
    shape = (int(light.shape[1]), int(light.shape[2]))
    reach = np.concatenate([start_m + _MARGIN_M, start_m - _MARGIN_M])
    # The gain's exact meaning does not matter for places.
    transport = strip_transport(rig, shape, shape, strip_of(reach, plate))
    gram = strip_gram_of(transport)
    light = light.double()
    place, image = start_m.copy(), torch.zeros(plate.shape, dtype=torch.float64)
    rest = torch.zeros(shape, dtype=torch.float64)
    covariance = np.zeros((len(place), 2, 2))
    for _ in range(_ROUNDS):
        sight = PlatePass(transport, plate, place)
        image = JointProblem(sight, 1.0, gram).tikhonov(light, _PRIOR * noise**2).image
        bright = image.clamp(min=0).numpy()
        bright = np.where(bright > 0.1 * bright.max(), bright, 0.0)
        column, row = middle_of_light(bright)
        offset = (np.array([column, row]) - (cells - 1) / 2) * plate.pitch_m
        left = light - sight(image) - rest
        step, covariance = _steps(sight, image, left, noise)
        rest = rest + left.mean(dim=0)
        # The place of the light's middle: the plate is drawn around it the next time.
        place = place + np.clip(step, -0.01, 0.01) + offset
    return RigShift(place, covariance, image)


def _steps(
    sight: PlatePass, image: torch.Tensor, left: torch.Tensor, noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gauss-Newton step of every position, [N, 2], metres, and its covariance."""
    half = _HALF_STEP * sight.plate.pitch_m
    slopes = []
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = half
        ahead = PlatePass(sight.transport, sight.plate, sight.positions_m + shift).drawn(image)
        behind = PlatePass(sight.transport, sight.plate, sight.positions_m - shift).drawn(image)
        slopes.append(sight.transport((ahead - behind) / (2 * half)).flatten(1))
    slope = torch.stack(slopes, dim=1)  # [N, 2, P]
    normal = slope @ slope.mT
    step = torch.linalg.solve(normal, (slope @ left.flatten(1)[..., None]))[..., 0]
    misfit = left.square().mean(dim=(1, 2)).clamp(min=noise**2)
    return step.numpy(), (misfit[:, None, None] * torch.linalg.inv(normal)).numpy()
