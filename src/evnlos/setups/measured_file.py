"""A measured light-transport matrix on disk: safetensors with its geometry in the metadata."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from evnlos.errors import ConfigError, DataError
from evnlos.tensor_file import TensorFile
from evnlos.types import Plane


@dataclass(frozen=True)
class About:
    """What a measured matrix is about; the metadata of its file."""

    plane: Plane
    """Cells of the scanned plane, in the coordinates of the target's motion."""
    height: int
    """Rows of the camera image, pixels."""
    width: int
    """Columns of the camera image, pixels."""
    magnification_px_m: float
    """Upper bound of the image motion, pixels a metre of motion of a light on the plane."""
    exposure_s: float = 0.0
    """Exposure of the scan's frames, seconds; 0 = not stated."""
    repeats: int = 1
    """Times that every pattern was shown."""
    pattern: str = "raster"
    """What was shown: raster, hadamard, or points (a point-spread function)."""
    noise_cells: bool = True
    """Whether cells have independent noise: not after denoising, nor for a point-spread function."""
    white_dn: int | None = None
    """Digital number of white in the scan's pictures; none = the largest of their type."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Figures of the import: denoising, checks, date."""

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise ConfigError(f"the camera image is {self.height} x {self.width} pixels; each side needs 1")
        if not 0 <= self.magnification_px_m < 1e9:
            raise ConfigError(f"magnification_px_m is {self.magnification_px_m}; give 0 to 1e9 pixels a metre")


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measured light-transport matrix.

    Args:
        matrix: White levels a cell of brightness 1, that of the scan's light, float32 [H W, h w].
        noise: Standard deviation of an entry at each pixel, mean over the cells, float32 [H, W], white levels;
            infinity where the pixel can't be used (its row is filled in from its neighbours).
        dark: Mean frame without the scan's light, float32 [H, W], white levels: black level and ambient light.
        about: Geometry and origin.

    Raises:
        DataError: The arrays do not fit the geometry, or hold NaN.
    """

    matrix: torch.Tensor
    noise: torch.Tensor
    dark: torch.Tensor
    about: About

    def __post_init__(self) -> None:
        shape, plane = self.shape, self.about.plane
        wanted = {
            "matrix": (shape[0] * shape[1], plane.height * plane.width),
            "noise": shape,
            "dark": shape,
        }
        for name, size in wanted.items():
            value = getattr(self, name)
            if tuple(value.shape) != size or value.dtype != torch.float32:
                raise DataError(
                    f"{name} is {value.dtype} {tuple(value.shape)}; its geometry needs float32 {size}"
                )
        if not bool(torch.isfinite(self.matrix).all()) or not bool(torch.isfinite(self.dark).all()):
            raise DataError("matrix or dark holds NaN or infinity; measure or import again")
        if not bool((self.noise >= 0).all()):  # NaN fails, too
            raise DataError("noise holds NaN or negative values; measure or import again")

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.about.height, self.about.width

    @property
    def bad(self) -> torch.Tensor:
        """Pixels that can't be used, bool [H, W]."""
        return torch.isinf(self.noise)


MEASUREMENT = TensorFile(
    "evnlos-transport-1",
    ("matrix", "noise", "dark"),
    About,
    Measurement,
    "a measured transport",
    "the file that `evnlos scan import` wrote",
)
"""Measured matrices on disk."""


def write_measurement(path: str | Path, measurement: Measurement) -> str:
    """Write a measured matrix as one safetensors file, atomically, and return its checksum.

    Raises:
        ConfigError: The name does not end in .safetensors.
    """
    tensors = {name: getattr(measurement, name) for name in MEASUREMENT.names}
    return MEASUREMENT.write(path, tensors, measurement.about)
