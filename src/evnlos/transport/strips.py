"""Light of a sliding wall for any of its pixels: no more of an image than is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Strips:
    """A sliding wall's light at some instants, of which any pixels can be had without the others.

    Args:
        band: Spline coefficients at the camera's rows, float32 or float64 [H, C]; zero outside.
        starts: Column of the band that the first tap of a row's pixel 0 reads at each instant, [T].
        taps: The four weights at each instant, float32 [T, 4].
        gain: White levels a unit of the band.
        ambient: Ambient light, float32 [H, W], white levels.
    """

    band: NDArray
    """Spline coefficients at the camera's rows [H, C]."""
    starts: NDArray[np.int64]
    """Column of the band under each row's first pixel, [T]."""
    taps: NDArray[np.float32]
    """The four weights [T, 4]."""
    gain: float
    """White levels a unit of the band."""
    ambient: NDArray[np.float32]
    """Ambient light [H, W], white levels."""

    def __len__(self) -> int:
        """Number of instants."""
        return len(self.starts)

    def __getitem__(self, instants: slice) -> Strips:
        """Return the light at some of the instants."""
        return Strips(self.band, self.starts[instants], self.taps[instants], self.gain, self.ambient)

    def write(self, first: int, out: NDArray[np.float32], white: float = 1.0) -> None:
        """Write the irradiance of the pixels first, first + 1, ..., counted along the rows, to `out` [T, N].

        `white` is the number that stands for a white level.
        """
        from evnlos.transport.shift_kernel import expose_shifted  # numba loads slowly

        expose_shifted(out, first, self.band, self.starts, self.taps, self.gain, self.ambient, white)
