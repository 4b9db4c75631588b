"""A rig as a matrix with a noise: what every question about its limits starts from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from evnlos.errors import ConfigError
from evnlos.sensor import FrameCamera
from evnlos.transport import (
    DiffuseReflection,
    LinearTransport,
    MeasuredTransport,
    PaperTransport,
    RadiometricTransport,
    Viewing,
    tpsf_kernel,
)
from evnlos.transport.ambient import ambient_plane
from evnlos.types import Plane

AnyTransport = PaperTransport | RadiometricTransport | MeasuredTransport
_SAMPLES_A_RHO = 4  # samples of the plate to one unit of the tPSF's rho
_FINEST = 16  # samples a side of a cell, at most


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
class SeenRig:
    """The linear map from the plate's cells to the camera's pixels, and the light that is always there.

    Args:
        matrix: White levels of a pixel a unit of a cell's brightness, float64 [H W, n].
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
        """Light of the brightest pixel while the whole plate shines, ambient light apart, white levels."""
        return float(self.matrix.sum(dim=1).max())


def seen_rig(transport: AnyTransport, bench: Bench = Bench()) -> SeenRig:
    """Return the linear map of a rig for a plate in the middle of its travel.

    The paper's step A is left out: it changes an 8 cm target by a few per cent and is not linear.

    Args:
        transport: The rig.
        bench: Cells and pixels.

    Raises:
        ConfigError: The rig can't be, or the camera gets no light from the plate.

    Example:
        >>> rig = seen_rig(PaperTransport(gain=0.5), Bench(cells=8, height=12, width=20))
        >>> rig.matrix.shape, 0.2 < rig.white < 0.5
        (torch.Size([240, 64]), True)
    """
    if isinstance(transport, PaperTransport):
        matrix = _paper_matrix(transport, bench) * transport.gain
    elif isinstance(transport, MeasuredTransport):
        bench = within_scan(transport, bench)
        matrix = transport.matrix(bench.shape, bench.plate) * transport.gain
    else:
        matrix = transport.matrix(bench.shape, bench.plate)
        matrix = matrix * (transport.gain / _full_light(transport, bench, matrix))
    if not float(matrix.max()) > 0:
        raise ConfigError("the camera gets no light from the plate; move the target or the camera")
    if isinstance(transport, MeasuredTransport):
        ambient = transport.ambient_light(bench.shape)
    else:
        ambient = ambient_plane(transport.ambient, transport.ambient_gradient, bench.shape)
    return SeenRig(matrix, ambient.double().flatten(), bench.plate, bench.shape)


def within_scan(transport: MeasuredTransport, bench: Bench) -> Bench:
    """Return the bench with no more pixels than the scan has."""
    height, width = transport.measurement().shape
    return replace(bench, height=min(height, bench.height), width=min(width, bench.width))


def _full_light(rig: RadiometricTransport, bench: Bench, matrix: torch.Tensor) -> float:
    """Return the light that the rig's gain refers to: a square of the strip's height, the brightest pixel."""
    side = rig.strip_m[1]
    if not math.isclose(side, bench.plate_m, rel_tol=1e-6):
        count = max(1, round(side / rig.cell_m))
        matrix = rig.matrix(bench.shape, Plane(count, count, side / count))
    light = float(matrix.sum(dim=1).max())
    if not light > 0:
        raise ConfigError("the camera gets no light from the plate; move the target or the camera")
    return light


def _paper_matrix(transport: PaperTransport, bench: Bench) -> torch.Tensor:
    from evnlos.solver.operators import dense_matrix  # here: `import evnlos` stays quick

    plate = bench.plate
    fine = min(_FINEST, max(1, math.ceil(_SAMPLES_A_RHO * plate.pitch_m / transport.tpsf_length_m)))
    plane = Plane(plate.height * fine, plate.width * fine, plate.pitch_m / fine)
    kernel = tpsf_kernel(
        plane.pitch_m,
        transport.tpsf_length_m,
        t=transport.tpsf_t,
        mean_free_path=transport.mean_free_path,
        rho_max=transport.rho_max,
        taper=transport.taper,
    )
    reflection = DiffuseReflection(plane, kernel)
    chain = reflection.then(Viewing(reflection.output, transport.view(bench.shape)))
    assert isinstance(chain, LinearTransport)  # both steps are linear
    return dense_matrix(_Cells(chain, fine), torch.zeros(plate.shape, dtype=torch.float64))


@dataclass(frozen=True)
class _Cells:
    """A transport from finer samples, as one from the cells that hold them."""

    chain: LinearTransport
    fine: int

    def __call__(self, scene: torch.Tensor, /) -> torch.Tensor:
        return self.chain(scene.repeat_interleave(self.fine, -2).repeat_interleave(self.fine, -1))

    def adjoint(self, image: torch.Tensor, /) -> torch.Tensor:
        scene = self.chain.adjoint(image)
        height, width = (side // self.fine for side in scene.shape[-2:])
        return scene.unflatten(-1, (width, self.fine)).unflatten(-3, (height, self.fine)).sum(dim=(-3, -1))


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


def carried_on(transport: PaperTransport) -> PaperTransport:
    """Return the same tPSF four times as wide, faded out instead of cut: what it is without the kink."""
    return replace(transport, rho_max=4 * transport.rho_max, taper=0.5)
