"""A setup as a matrix with a noise: what every question about its limits starts from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from evnlos.errors import ConfigError
from evnlos.sensor import FrameCamera
from evnlos.setups import Setup
from evnlos.setups.base import dense_matrix
from evnlos.types import Plane


@dataclass(frozen=True)
class Bench:
    """How the question is put: cells of the plate, pixels of the camera, noise."""

    plate_m: float = 0.08
    """Side of the plate, in the middle of its travel, metres."""
    cells: int = 32
    """Cells a side of the plate."""
    height: int = 60
    """Rows of the camera, pixels."""
    width: int = 96
    """Columns of the camera, pixels."""
    fixed_noise: float = 0.01
    """Standard deviation of the fixed noise, share of the brightest pixel while the whole plate shines."""
    frames: int = 1
    """Frames that are averaged, all of the plate in the same place."""
    known_pattern: bool = True
    """Whether the camera's fixed pattern was measured and taken off."""
    writers: int = 6
    """Writers whose characters are the linear estimator's prior."""

    def __post_init__(self) -> None:
        for name, least in (("cells", 8), ("height", 4), ("width", 4), ("frames", 1), ("writers", 1)):
            if getattr(self, name) < least:
                raise ConfigError(f"Bench.{name} is {getattr(self, name)}; give {least} or more")
        if self.cells > 64:
            raise ConfigError(f"Bench.cells is {self.cells}; give at most 64, the matrix grows with its square")
        for name in ("plate_m", "fixed_noise"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"Bench.{name} is {value}; give a positive number")

    @property
    def plate(self) -> Plane:
        """The cells of the plate."""
        return Plane(self.cells, self.cells, self.plate_m / self.cells)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.height, self.width


@dataclass(frozen=True, eq=False)
class LinearizedSetup:
    """The linear map from the target's cells to the camera's pixels, and the light that is always there.

    Args:
        matrix: White levels of a pixel per unit of a cell's brightness, float64 [H W, n].
        ambient: Ambient light, white levels, float64 [H W].
        plate: The cells.
        shape: Size (H, W) of the camera image, pixels.
    """

    matrix: torch.Tensor
    ambient: torch.Tensor
    plate: Plane
    shape: tuple[int, int]

    @property
    def white(self) -> float:
        """Light of the brightest pixel while the whole target shines, ambient light apart, white levels."""
        return float(self.matrix.sum(dim=1).max())


def linearized(setup: Setup, bench: Bench = Bench()) -> LinearizedSetup:
    """Return the linear map of a setup for a target in the middle of its path.

    Of a setup that is not linear it is the linear part (`Setup.linear_part`). A setup that has fewer pixels
    than the bench asks for keeps its own.

    Args:
        setup: The setup.
        bench: Cells and pixels.

    Raises:
        ConfigError: The setup is geometrically impossible, has no linear part, or gets no light.

    Example:
        >>> from evnlos.setups import PaperSetup
        >>> seen = linearized(PaperSetup(gain=0.5), Bench(cells=8, height=12, width=20))
        >>> seen.matrix.shape, 0.2 < seen.white < 0.5
        (torch.Size([240, 64]), True)
    """
    setup = setup.resized(bench.shape)
    matrix = dense_matrix(setup.linear_part(bench.plate))
    if not float(matrix.max()) > 0:
        raise ConfigError("the camera gets no light from the target; move the target or the camera")
    return LinearizedSetup(matrix, setup.ambient_light().double().flatten(), bench.plate, setup.shape)


def camera_variance(
    light: torch.Tensor, camera: FrameCamera, frames: int = 1, known_pattern: bool = True
) -> torch.Tensor:
    """Return the variance of the frame camera's noise at a mean light: shot, read, rounding, fixed pattern.

    var(E) = (E / N + (r / N)^2 + q^2) / frames + pattern, N the full well, r the read noise, q the rounding to
    digital numbers over sqrt(12), in white levels; the pattern (sensitivity and offset) does not average out.

    Args:
        light: Mean light, white levels, [...].
        camera: The camera.
        frames: Frames that are averaged.
        known_pattern: Whether the fixed pattern was measured and taken off.

    Returns:
        Variance, white levels squared, [...].

    Example:
        >>> camera = FrameCamera(full_well_e=10_000.0, read_noise_e=0.0, bit_depth=16)
        >>> round(float(camera_variance(torch.tensor(0.25), camera)) ** 0.5, 4)
        0.005
    """
    well = camera.full_well_e
    rounding = 1 / ((camera.white - camera.black_level) * camera.gain) ** 2 / 12
    variance = (light.clamp(min=0) / well + (camera.read_noise_e / well) ** 2 + rounding) / frames
    if not known_pattern:
        variance = variance + (camera.prnu * light) ** 2 + (camera.dsnu_e / well) ** 2
    return variance
