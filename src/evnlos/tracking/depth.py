"""Approach and retreat: the rig with its target's plane at other distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.transport import MatrixTransport, RadiometricTransport
from evnlos.types import Plane

REACH = 0.3
"""Largest change of the distance's logarithm that is looked for: 0.74 to 1.35 of the rig's own distance."""
_NODES = -REACH * np.cos(
    np.pi * np.arange(13) / 12
)  # Chebyshev's: between even ones the polynomials would swing
_BASIS = np.linalg.inv(
    np.vander(_NODES, increasing=True)
)  # coefficients of Lagrange's polynomials, [power, node]


class Depths:
    """Matrices from the target's plane at any distance, by Lagrange's polynomials in the distance's logarithm.

    Nothing else of the rig moves. What is further away is smaller in the picture, more blurred, dimmer and seen
    elsewhere: all four tell the distance.

    Args:
        rig: The rig.
        own: Its matrix from the strip, whose scale those of other distances share.
    """

    def __init__(self, rig: RadiometricTransport, own: MatrixTransport) -> None:
        strip, shape = own.source, own.shape
        assert isinstance(strip, Plane)
        fixed = replace(
            rig,
            target_offset_m=rig.offset_m(),
            occluders_m=tuple(one.vertices_m for one in rig.occluders()),
            post_width_m=0.0,
        )
        self._strip, self._shape = strip, shape
        self._scale = float(own.matrix.double().sum() / rig.matrix(shape, strip).sum())
        self._nodes = torch.stack(
            [
                replace(fixed, distance_m=rig.distance_m * float(np.exp(node))).matrix(shape, strip).float()
                for node in _NODES
            ]
        )  # [G, H W, cells]

    def at(self, log_distance: float) -> MatrixTransport:
        """Return the matrix at a distance, ln(distance / rig's distance) within +- `REACH`."""
        weights = _weights(np.power(log_distance, np.arange(len(_NODES))))
        return MatrixTransport(self._sum(weights, self._nodes), self._strip, self._shape)

    def slope(self, log_distance: float, light: torch.Tensor) -> torch.Tensor:
        """Return the derivative by the distance's logarithm, [H W], of the picture of shining cells, [h, w]."""
        powers = np.arange(1, len(_NODES))
        weights = _weights(np.concatenate([[0.0], powers * np.power(log_distance, powers - 1)]))
        return self._sum(weights, self._nodes @ light.flatten().to(self._nodes))

    def _sum(self, weights: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return self._scale * torch.einsum("g,g...->...", weights.to(values), values)


def _weights(powers: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(powers @ _BASIS)
