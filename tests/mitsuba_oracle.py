"""The light-transport matrix and a path tracer side by side.

`python tests/mitsuba_oracle.py` renders small setups both ways and prints how far they are apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.interop import trace
from evnlos.optics import light_transport_matrix
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.types import Plane


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a matrix's image compares with independent renders of the same scene.

    Args:
        gain: Traced divided by computed brightness, least squares weighted by the tracer's noise.
        gain_sigma: Standard deviation of that gain by the tracer's noise.
        chi2: Mean over the pixels of the squared deviation after the gain, in units of its expectation: 1 where
            the tracer's noise is the only difference.
        chi2_sigma: Standard deviation of `chi2` under that hypothesis.
        noise: Mean over the pixels of the tracer's own relative standard error.
    """

    gain: float
    gain_sigma: float
    chi2: float
    chi2_sigma: float
    noise: float

    @property
    def agrees(self) -> bool:
        """Whether the gain and chi2 are 1 within 4 of their standard deviations."""
        gain = abs(self.gain - 1) < 4 * self.gain_sigma
        return gain and abs(self.chi2 - 1) < 4 * self.chi2_sigma


def compare(expected: ArrayLike, renders: NDArray[np.float64]) -> Agreement:
    """Hold an image against independent renders; the noise is estimated from their spread.

    Args:
        expected: Image of the matrix, [H, W].
        renders: Renders of the same scene, [repeats, H, W], repeats 6 or more.

    Raises:
        DataError: Too few renders to know their spread, or another image size.
    """
    image = np.asarray(expected, np.float64)
    repeats = len(renders)
    if repeats < 6 or renders.shape[1:] != image.shape:
        raise DataError(f"renders are {renders.shape}; give at least 6 of {image.shape}")
    mean = renders.mean(axis=0)
    error = renders.std(axis=0, ddof=1) / math.sqrt(repeats)
    lit = error > 0
    mean, error, image = mean[lit], error[lit], image[lit]
    halves = [_gain(image, renders[k::2][:, lit], renders[1 - k :: 2][:, lit]) for k in (0, 1)]
    gain = sum(value for value, _ in halves) / 2
    gain_sigma = math.hypot(*(sigma for _, sigma in halves)) / 2
    # Student's t with repeats - 1 degrees of freedom: mean square (n - 1) / (n - 3), and its fourth moment.
    t2 = ((mean - gain * image) / error) ** 2
    free = repeats - 1
    expectation = free / (free - 2)
    variance = expectation**2 * (2 * free - 2) / (free - 4)
    count = len(image)
    return Agreement(
        gain,
        gain_sigma,
        float(t2.mean() / expectation),
        math.sqrt(variance / count) / expectation,
        float((error / mean).mean()),
    )


def _gain(
    image: NDArray[np.float64], renders: NDArray[np.float64], others: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the weighted gain of some renders and its standard deviation.

    The weights come from the other renders: a pixel's own spread goes with its own mean and would bias it.
    """
    weight = 1 / others.var(axis=0, ddof=1)
    scale = (weight * image**2).sum()
    gain = (weight * image * renders.mean(axis=0)).sum() / scale
    variance = renders.var(axis=0, ddof=1) / len(renders)
    return float(gain), float(np.sqrt((weight**2 * image**2 * variance).sum()) / scale)


PATTERN = Plane(8, 8, 0.01)
"""Cells of the pattern that `check_walls` and the tests show."""


SHADOW_POINTS = (16, 8)
"""Quadrature points a side of a (pixel, cell) for the edges of shadows on such large pixels and cells."""


def pattern() -> NDArray[np.float64]:
    """Return five lit cells without any symmetry, [8, 8]: a mirrored axis or a wrong order shows."""
    brightness = np.zeros(PATTERN.shape)
    brightness[[1, 6, 3, 0, 7], [2, 1, 6, 7, 4]] = 1.0, 0.5, 0.7, 0.3, 0.9
    return brightness


def wall_image(
    setup: RadiometricSetup,
    shape: tuple[int, int],
    brightness: NDArray[np.float64],
    points: tuple[int, int] | None = None,
) -> NDArray[np.float64]:
    """Return the light-transport matrix times a pattern on the cells of `PATTERN`, [H, W].

    Args:
        setup: The setup.
        shape: Size (H, W) of the camera image, pixels.
        brightness: Radiance of the cells, [8, 8].
        points: Quadrature points a side of a (pixel, cell); None adapts them, which is too coarse for the edge
            of a shadow on the large pixels of a small image.
    """
    place = {"offset_m": setup.offset_m(), "occluders": setup.occluders()}
    matrix = light_transport_matrix(
        setup.view(shape), PATTERN, setup.distance_m, setup.brdf(), points=points, **place
    )
    return (matrix @ torch.as_tensor(brightness.copy()).flatten()).reshape(shape).numpy()


def trace_setup(
    setup: RadiometricSetup, shape: tuple[int, int], brightness: NDArray[np.float64], samples: int = 128
) -> NDArray[np.float64]:
    """Return 16 renders of a pattern on the cells of `PATTERN`, [16, H, W]; see `trace`."""
    place = {"offset_m": setup.offset_m(), "occluders": setup.occluders()}
    return trace(
        setup.view(shape), PATTERN, brightness, setup.distance_m, setup.brdf(), samples=samples, **place
    )


def _setup(**settings: Any) -> RadiometricSetup:
    """Return a setup before a camera of few, square pixels."""
    return RadiometricSetup(sensor=SensorSize(8, 12), **settings)


WALLS = {
    "Lambert": _setup(wall_material="lambert"),
    "GGX 0.3": _setup(roughness=0.3),
    "GGX 0.05": _setup(roughness=0.05),
    "GGX 0.05, far": _setup(roughness=0.05, distance_m=0.5),
    "brushed 0.05 x 0.2": _setup(roughness=0.05, roughness_y=0.2),
    "Lambert, post": _setup(wall_material="lambert", post_width_m=0.016),
    "GGX 0.3, post": _setup(roughness=0.3, post_width_m=0.016),
}
"""The setups that are rendered both ways."""


def check_walls(shape: tuple[int, int] = (8, 12), samples: int = 128) -> dict[str, Agreement]:
    """Compare both renderings of the pattern on all of `WALLS`, by name.

    Args:
        shape: Size (H, W) of the camera image, pixels.
        samples: Paths a pixel, lit cell and render.
    """
    found = {}
    for name, setup in ((name, setup.seen_by(shape)) for name, setup in WALLS.items()):
        points = SHADOW_POINTS if setup.occluders() else None
        image = wall_image(setup, shape, pattern(), points)
        found[name] = compare(image, trace_setup(setup, shape, pattern(), samples))
    return found


if __name__ == "__main__":
    print("wall                  traced / computed      chi2 (1 = noise only)   tracer's noise per pixel")
    for wall, one in check_walls().items():
        print(
            f"{wall:<20}  {one.gain:.5f} +- {one.gain_sigma:.5f}    {one.chi2:.2f} +- {one.chi2_sigma:.2f}"
            f"            {100 * one.noise:.2f} %"
        )
