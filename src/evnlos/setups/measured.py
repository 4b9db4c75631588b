"""A setup whose light transport was measured cell by cell, instead of computed from its geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.config import BESIDE
from evnlos.errors import ConfigError
from evnlos.optics import MatrixTransport, MatrixWall
from evnlos.optics.wall import ambient_plane
from evnlos.scene import Scene
from evnlos.setups.base import OperatorNoise, Setup, stated_distance_m
from evnlos.setups.files import MEASUREMENT, Measurement
from evnlos.types import Plane


@Setup.registry.register
@dataclass(frozen=True)
class MeasuredSetup(Setup):
    """The light-transport matrix of a scan (`evnlos scan import`), as a setup like any other."""

    is_linear: ClassVar[bool] = True

    kind: Literal["measured"] = "measured"
    """Kind of this setup."""
    gain: float = 1.0
    """Brightness and exposure of the hidden object over those of the scan's light; 1 = the same."""
    ambient: float = 0.0
    """Ambient light on top of the dark frames' in the middle of the image, white levels."""
    file: str = field(default="", metadata=BESIDE)
    """The measured matrix, a .safetensors file of `evnlos scan import`."""
    checksum: str = ""
    """First 16 digits of the file's SHA-256, as the import prints them; empty = not checked."""
    dark_frames: bool = True
    """Whether the light of the scan's dark frames (black level, ambient light) is part of the wall."""

    def measurement(self) -> Measurement:
        """Return what was measured; the file is read once.

        Raises:
            ConfigError: No file is named, or it is another one than the checksum says.
            DataError: The file is missing or damaged.
        """
        if not self.file:
            raise ConfigError("setup.file is empty; give the .safetensors file of `evnlos scan import`")
        return MEASUREMENT.load(self.file, self.checksum)

    def target_cells(self) -> Plane:
        """Return the scanned cells, in the coordinates of the target's motion."""
        return self.source()

    def source(self) -> Plane:
        """Return the scanned cells, in the coordinates of the target's motion."""
        return self.measurement().about.plane

    def transport(self, shape: tuple[int, int] | None = None) -> MatrixTransport:
        """Return the matrix from the scanned cells to a camera image, without `gain`.

        Args:
            shape: Size (H, W) of the image, pixels; None is the sensor's.

        Raises:
            ConfigError: The scan has fewer pixels than that.
        """
        measured, shape = self.measurement(), self.shape if shape is None else shape
        matrix = _matrix(measured, shape)
        return MatrixTransport(matrix, measured.about.plane, shape)

    def matrix(self, shape: tuple[int, int], source: Plane, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Return the matrix from other cells of the same plane to the camera, without `gain`, [H W, h w].

        A cell gets from each scanned cell the share of it that it covers: what lies within one scanned cell
        can't be distinguished.

        Args:
            shape: Size (H, W) of the camera image, pixels; at most those of the scan.
            source: Cells, in the coordinates of the target's motion.
            dtype: Floating-point type of the result.

        Raises:
            ConfigError: The cells reach beyond the scanned plane, or the scan has fewer pixels.
        """
        return self._resampled(self.measurement().matrix, shape, source).to(dtype)

    def operator(
        self, plane: Plane, shape: tuple[int, int] | None = None, dtype: torch.dtype = torch.float64
    ) -> MatrixTransport:
        """Return the matrix from cells of the scanned plane to the camera, gain included.

        Args:
            plane: Cells, in the coordinates of the target's motion.
            shape: Size (H, W) of images to which the sensor's are reduced by area averaging; None: as they are.
            dtype: Floating-point type of the matrix.

        Raises:
            ConfigError: As for `matrix`.
        """
        shape = self.shape if shape is None else shape
        return MatrixTransport(self.matrix(shape, plane, dtype) * self.gain, plane, shape)

    def operator_noise(self, plane: Plane, seed: int = 0) -> OperatorNoise:
        """Return one draw of the noise of `operator`, as if cells were independent, and what is known of it.

        Args:
            plane: Cells, in the coordinates of the target's motion.
            seed: Seed of the draw.
        """
        measured = self.measurement()
        sigma = torch.where(measured.bad, 0.0, measured.noise).flatten()
        draw = torch.Generator().manual_seed(seed)
        noise = torch.randn(measured.matrix.shape, generator=draw) * sigma[:, None]
        matrix = self._resampled(noise, self.shape, plane).double() * self.gain
        return OperatorNoise(matrix, measured.about.noise_cells, measured.about.plane.pitch_m)

    def ambient_light(self, shape: tuple[int, int] | None = None) -> torch.Tensor:
        """Return the light that is there without the hidden object, white levels, float32 [H, W].

        Args:
            shape: Size (H, W) of the image, pixels; None is the sensor's.
        """
        shape = self.shape if shape is None else shape
        light = ambient_plane(self.ambient, self.ambient_gradient, shape)
        if not self.dark_frames:
            return light
        measured = self.measurement()
        return light + averaged(measured.dark.reshape(-1, 1), measured.shape, shape).reshape(shape).clamp(min=0)

    def observe(self, scene: Scene) -> MatrixWall:
        """Return the irradiance on the sensor while the scene's target moves.

        Args:
            scene: The target and its motion; the scanned plane has one distance, so the motion states none.

        Raises:
            ConfigError: The target leaves the scanned plane, the motion states a distance or a rotation, or a
                setting is out of range.
        """
        distance_m = stated_distance_m(self, scene)
        if distance_m is not None:
            return self.at_distance(distance_m).observe(scene)
        about = self.measurement().about
        self._check_travel(scene, about.plane)
        height, width = self.shape
        return MatrixWall(
            self.transport(self.shape),
            scene.target,
            scene.motion,
            magnification_px_m=about.magnification_px_m * max(height / about.height, width / about.width),
            gain=self.gain,
            ambient=self.ambient_light(),
        )

    def wall_description(self) -> str:
        """Return where the measurement is from."""
        return f"measured cell by cell, {Path(self.file).name or 'no file'}"

    def resized(self, shape: tuple[int, int]) -> MeasuredSetup:
        """Return the setup with another size (H, W) of its sensor, at most that of the scan, pixels."""
        most = self.measurement().shape
        return super().resized((min(most[0], shape[0]), min(most[1], shape[1])))

    def seen_by(self, shape: tuple[int, int]) -> MeasuredSetup:
        """Return it at another size (H, W), pixels: the camera is the one of the scan."""
        return self.resized(shape)

    def bytes_of_a_scene(self, target_m: float) -> int:
        """Return the size of the matrix and of the keyframes, bytes."""
        source = self.source()
        keyframes = 2 * (source.extent_m[1] + target_m) / source.pitch_m
        return 4 * self.shape[0] * self.shape[1] * (source.height * source.width + round(keyframes))

    def _resampled(self, matrix: torch.Tensor, shape: tuple[int, int], source: Plane) -> torch.Tensor:
        measured = self.measurement()
        plane = measured.about.plane
        for axis, have, want in (("x", plane.x_m, source.x_m), ("y", plane.y_m, source.y_m)):
            low, high = (float(have[k] + s * plane.pitch_m / 2) for k, s in ((0, -1), (-1, 1)))
            first, last = (float(want[k] + s * source.pitch_m / 2) for k, s in ((0, -1), (-1, 1)))
            if first < low - plane.pitch_m or last > high + plane.pitch_m:
                raise ConfigError(
                    f"the scan covers {axis} = {low:.3f} to {high:.3f} m, {first:.3f} to {last:.3f} m are "
                    "needed; "
                    "scan a larger plane, or ask for less"
                )
        rows = averaged(matrix, measured.shape, shape).double()
        y = covered(plane.y_m, plane.pitch_m, source.y_m, source.pitch_m)  # [h scan, h]
        x = covered(plane.x_m, plane.pitch_m, source.x_m, source.pitch_m)  # [w scan, w]
        cells = rows.unflatten(1, plane.shape)  # [H W, h scan, w scan]
        return torch.einsum("pij,ik,jl->pkl", cells, y, x).flatten(1)

    def _check_travel(self, scene: Scene, plane: Plane) -> None:
        positions = scene.motion.position_m(scene.instants(65))
        half = scene.target.size_m / 2
        for k, axis in enumerate(("width", "height")):
            reach = np.abs(positions[:, k] - plane.center_m[k]).max() + half
            side = plane.extent_m[1 - k]
            if reach > side / 2 + plane.pitch_m:
                raise ConfigError(
                    f"the target reaches {reach:.3f} m from the middle of a scanned plane of {axis} {side:.3f} "
                    "m; "
                    f"scan at least {2 * reach:.3f} m there, or shorten the travel"
                )


@lru_cache(maxsize=2)
def _matrix(measured: Measurement, shape: tuple[int, int]) -> torch.Tensor:
    """Return the matrix for a camera image of `shape`: one for all objects."""
    return averaged(measured.matrix, measured.shape, shape)


def averaged(matrix: torch.Tensor, have: tuple[int, int], want: tuple[int, int]) -> torch.Tensor:
    """Return the rows of a matrix [H W, n] averaged over the area of fewer pixels, [h w, n].

    Raises:
        ConfigError: More pixels are wanted than there are.
    """
    if tuple(have) == tuple(want):
        return matrix
    if want[0] > have[0] or want[1] > have[1] or min(want) < 1:
        raise ConfigError(
            f"the scan has {have[0]} x {have[1]} pixels, {want[0]} x {want[1]} are requested; ask for at most "
            "those"
        )
    y, x = (_area_share(a, b).to(matrix) for a, b in zip(have, want, strict=True))
    image = matrix.reshape(have[0], -1)
    image = (y @ image).reshape(want[0], have[1], -1)  # [h, W, n]
    return torch.einsum("hwn,vw->hvn", image, x).flatten(0, 1)


def covered(
    have_m: NDArray[np.float64], have_pitch: float, want_m: NDArray[np.float64], want_pitch: float
) -> torch.Tensor:
    """Return the share of each of some cells that each of other cells covers, float64 [have, want].

    Example:
        >>> covered(np.array([0.0, 1.0]), 1.0, np.array([0.25]), 1.0)
        tensor([[0.7500],
                [0.2500]], dtype=torch.float64)
    """
    low = np.maximum(have_m[:, None] - have_pitch / 2, want_m - want_pitch / 2)
    high = np.minimum(have_m[:, None] + have_pitch / 2, want_m + want_pitch / 2)
    return torch.from_numpy(np.maximum(high - low, 0.0) / have_pitch)


def image_motion_px_m(matrix: torch.Tensor, plane: Plane, shape: tuple[int, int]) -> float:
    """Return a bound of how far the image moves when a light on the plane does, pixels per metre.

    The middle of the light of each row and column of cells is followed; twice the largest steady motion is
    taken, and never less than a pixel per cell, so that no cell is stepped over.

    Args:
        matrix: The measured matrix, [H W, h w].
        plane: Its cells.
        shape: Its camera image (H, W), pixels.
    """
    light = matrix.double().clamp(min=0).reshape(*shape, *plane.shape)
    v, u = (torch.arange(n, dtype=torch.float64) for n in shape)
    steps = [1.0]
    for axis in (2, 3):  # along y, along x
        lines = light.sum(dim=5 - axis)  # [H, W, cells]
        cells = lines.shape[2]
        total = lines.sum(dim=(0, 1))
        if cells < 2 or not bool((total > 0).all()):
            continue
        middle = [torch.einsum("hwc,h->c", lines, v) / total, torch.einsum("hwc,w->c", lines, u) / total]
        reach = math.hypot(*(float(m.max() - m.min()) for m in middle))
        steps.append(2 * reach / (cells - 1))
    return max(steps) / plane.pitch_m


def _area_share(inside: int, outside: int) -> torch.Tensor:
    """Return the fraction of each of `outside` equal cells that each of `inside` equal cells covers."""
    cell = inside / outside
    low = np.maximum(np.arange(outside)[:, None] * cell, np.arange(inside))
    high = np.minimum(np.arange(1, outside + 1)[:, None] * cell, np.arange(1, inside + 1))
    return torch.from_numpy(np.maximum(high - low, 0.0) / cell)
