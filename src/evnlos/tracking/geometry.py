"""From the picture's motion to the target's: where a camera sees light from a place behind the corner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.setups import Setup
from evnlos.tracking.registration import middle_of_light
from evnlos.types import Plane

_REACH_M = (0.40, 0.28)  # region of the target's plane that the map is fitted on, (x, y)
_CELL_M = 0.02
_SEEN = 0.2  # of the brightest cell's light; darker cells lie partly outside the picture


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """A smooth map from the middle of the light on the sensor to a place on the target's plane.

    Args:
        coefficients: Of 1, u, v, u^2, u v, v^2 for x and y, [6, 2], metres; u, v in half widths.
        shape: Size (H, W) of the picture, pixels.
        error_m: Root mean square misfit of the map over the region, metres.
    """

    coefficients: NDArray[np.float64]
    shape: tuple[int, int]
    error_m: float

    def __call__(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places (x, y), metres, [..., 2], of pixels [..., 2]."""
        return _terms(self._scaled(place_px)) @ self.coefficients

    def slope(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return d(x, y) / d(column, row), metres a pixel, [..., 2, 2]."""
        half = 0.5
        steps = half * np.eye(2)
        return np.stack(
            [(self(place_px + step) - self(place_px - step)) / (2 * half) for step in steps], axis=-1
        )

    def _scaled(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        middle = np.array([(self.shape[1] - 1) / 2, (self.shape[0] - 1) / 2])
        return (place_px - middle) / (self.shape[1] / 2)


def plane_map(setup: Setup, shape: tuple[int, int]) -> PlaneMap:
    """Fit the map to the pictures of small cells all over the target's plane.

    Args:
        setup: The setup.
        shape: Size (H, W) of the picture, pixels.

    Raises:
        DataError: The middle of the light hardly moves with the cell: a matte wall shows no place that way.
    """
    cells = Plane(round(_REACH_M[1] / _CELL_M), round(_REACH_M[0] / _CELL_M), _CELL_M)
    pictures = setup.matrix(shape, cells).mT.reshape(-1, *shape).numpy()
    light = pictures.sum(axis=(1, 2))
    border = np.concatenate([pictures[:, 0], pictures[:, -1], pictures[:, :, 0], pictures[:, :, -1]], axis=1)
    whole = border.max(axis=1) < 0.1 * pictures.max(axis=(1, 2))
    used = (light > _SEEN * light.max()) & whole
    if used.sum() < 12:
        raise DataError(
            f"{int(used.sum())} of {len(used)} places of the target's plane make a bounded picture, 12 are the "
            "least: this wall does not show where its light comes from; track without the rig"
        )
    place = np.stack(np.meshgrid(cells.x_m, cells.y_m), axis=-1).reshape(-1, 2)[used]
    blank = PlaneMap(np.zeros((6, 2)), shape, 0.0)
    terms = _terms(blank._scaled(middle_of_light(pictures[used])))
    coefficients = np.linalg.lstsq(terms, place, rcond=None)[0].astype(np.float64)
    error = float(np.sqrt(np.mean(np.square(terms @ coefficients - place).sum(axis=1))))
    return PlaneMap(coefficients, shape, error)


def _terms(scaled: NDArray[np.float64]) -> NDArray[np.float64]:
    u, v = scaled[..., 0], scaled[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
