"""Approach and retreat: the rig with its target's plane at other distances."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.setups import Setup
from evnlos.transport import MatrixTransport
from evnlos.types import Plane

REACH = 0.3
"""Largest change of the distance's logarithm that is looked for: 0.74 to 1.35 of the rig's own distance."""
_STEP = 0.05  # of the logarithm between two matrices: the light moves by less than any wall's blur
_NODES = np.linspace(-REACH, REACH, round(2 * REACH / _STEP) + 1)
_NEAR = 4  # matrices that one in between is made of
# Coefficients of Lagrange's cubics over the steps -1, 0, 1, 2, [power, matrix]
_BASIS = np.linalg.inv(np.vander(np.arange(-1.0, _NEAR - 1.0), increasing=True))


class Depths:
    """Matrices from the target's plane at any distance, by Lagrange's cubics in its logarithm.

    Nothing else of the rig moves. What is further away is smaller in the picture, more blurred, dimmer and seen
    elsewhere: all four tell the distance.

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
        """Return the matrix at a distance, ln(distance / rig's distance) within +- `REACH`."""
        first, along = _place(log_distance)
        weights = np.power(along, np.arange(_NEAR)) @ _BASIS
        return MatrixTransport(self._sum(weights, self._nodes[first : first + _NEAR]), self._strip, self._shape)

    def slope(self, log_distance: float, light: torch.Tensor) -> torch.Tensor:
        """Return the derivative by the distance's logarithm, [H W], of the picture of shining cells, [h, w]."""
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
