"""Light on its way to an array of pixels: whole frames, or strips that are rendered when they are needed."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evnlos.sensor._checks import check_light

WHITE_DN = 255.0
"""The white level of a wall (irradiance 1.0) in the pixel's digital numbers."""

_STRIP_BYTES = 2 << 20  # of light at once: it is made and used while the cache still holds it


class Light(Protocol):
    """Light in DN at some instants [T], of which an array of pixels takes what it works on."""

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def __getitem__(self, instants: slice) -> Light:
        """Return the light at some of the instants."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers: uint8, float32 or float64."""
        ...

    @property
    def most_px(self) -> int | None:
        """How many pixels should be taken at once; None = any number."""
        ...

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return light [T, M] that holds the pixels first..last - 1, and which pixel its first column is."""
        ...


class Frames:
    """Light that is there as a whole.

    Args:
        rows: Light in DN, [T, H * W], checked.
    """

    most_px = None

    def __init__(self, rows: NDArray) -> None:
        self._rows = rows.view()
        self._rows.flags.writeable = False  # one type of input: the kernels compile once, not twice
        self.dtype = rows.dtype

    def __len__(self) -> int:
        """Number of instants."""
        return len(self._rows)

    def __getitem__(self, instants: slice) -> Frames:
        """Return the frames at some of the instants."""
        return Frames(self._rows[instants])

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return all frames."""
        return self._rows, 0


class Strips(Protocol):
    """A wall's light at some instants, of which any pixels can be had without the others."""

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def __getitem__(self, instants: slice) -> Strips:
        """Return the light at some of the instants."""
        ...

    def write(self, first: int, out: NDArray[np.float32], white: float) -> None:
        """Write the irradiance of the pixels first, first + 1, ... to `out` [T, N]; 1.0 becomes `white`."""
        ...


class StripLight:
    """Light that is rendered for the pixels that are asked for, and forgotten.

    Args:
        strips: The wall's light.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, strips: Strips) -> None:
        self._strips = strips
        self.most_px = max(1, _STRIP_BYTES // (4 * max(1, len(strips))))

    def __len__(self) -> int:
        """Number of instants."""
        return len(self._strips)

    def __getitem__(self, instants: slice) -> StripLight:
        """Return the light at some of the instants."""
        return StripLight(self._strips[instants])

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return the light of these pixels alone.

        Raises:
            DataError: The wall returned NaN or negative light.
        """
        light = np.empty((len(self._strips), last - first), np.float32)
        self._strips.write(first, light, WHITE_DN)
        check_light(light[None])
        light.flags.writeable = False
        return light, first
