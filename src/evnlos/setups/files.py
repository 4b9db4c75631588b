"""What setups hand over, and setups on disk: a measured matrix, a fitted wall, the folder of a calibration.

- Where the parts of a setup are, and how well a measured operator is known.
- A measured light-transport matrix on disk: safetensors with its geometry in the metadata.
- A fitted wall on disk: its facets' slopes, maps of the image, light that moves along.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from evnlos.config import read_yaml
from evnlos.errors import ConfigError, DataError
from evnlos.optics.facets import SlopeTable
from evnlos.registry import migrate
from evnlos.tensor_file import TensorFile, check_floats
from evnlos.types import Plane


class Layout(NamedTuple):
    """Where the parts of a setup are, seen from above: x along the wall, z away from it, metres."""

    target: tuple[float, float]
    """Middle of the target's path (x, z)."""
    wall: str
    """What the wall is, in words."""
    camera: tuple[float, float] | None = None
    """Pin-hole (x, z); None where the setup states none."""
    camera_words: str = ""
    """Distance and angle of the camera, in words."""
    seen_m: tuple[float, float] | None = None
    """Ends of the part of the wall that the camera sees (x)."""
    occluders: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Corners (x, z) of each opaque polygon."""
    lamp: tuple[float, float] | None = None
    """A torch that lights the target (x, z)."""


class OperatorNoise(NamedTuple):
    """How well an operator that was measured is known."""

    matrix: torch.Tensor
    """One draw of its noise, float64 [H W, h w], in white levels per unit of a cell."""
    is_independent: bool
    """Whether cells have independent noise: not after denoising, nor for a point-spread function."""
    pitch_m: float
    """Side of the cells that were measured, metres."""


@dataclass(frozen=True)
class Parameter:
    """A number of a setup that frames decide: what a calibration fits and a report prints.

    Args:
        name: Dotted name in the setup's settings, e.g. `roughness` or `offset_m.0`.
        unit: Its unit; empty where it has none.
        value: Its value, in the unit.
        low: Smallest value that a search may take.
        high: Largest value.
        step: Step of a finite difference, in the unit, or relative to the value where `log`.
        log: Whether a search runs over its logarithm.
        role: "blur" or "magnification" for the two that a search scans before all others, "place" for the
            place of the target's path; else empty.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    step: float
    log: bool = False
    role: Literal["", "blur", "magnification", "place"] = ""


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
    """Upper bound of the image motion, pixels per metre of motion of a light on the plane."""
    exposure_s: float = 0.0
    """Exposure of the scan's frames, seconds; 0 = not stated."""
    repeats: int = 1
    """Times that every pattern was shown."""
    pattern: str = "raster"
    """What was shown: raster, hadamard, or points (a point-spread function)."""
    noise_cells: bool = True
    """Whether cells have independent noise: not after denoising, nor for a point-spread function."""
    white_dn: int | None = None
    """Digital number of white in the scan's images; none = the largest of their type."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Figures of the import: denoising, checks, date."""

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise ConfigError(f"the camera image is {self.height} x {self.width} pixels; each side needs 1")
        if not 0 <= self.magnification_px_m < 1e9:
            raise ConfigError(
                f"magnification_px_m is {self.magnification_px_m}; give 0 to 1e9 pixels per metre"
            )


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measured light-transport matrix.

    Args:
        matrix: White levels per cell of brightness 1, that of the scan's light, float32 [H W, h w].
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


_ARRAYS = ("log_density", "sensitivity", "ambient", "companion", "left", "right")
_LARGEST = 4096


@dataclass(frozen=True)
class AboutWall:
    """What a fitted wall is about; the metadata of its file."""

    scale: float
    """Slope at which the spacing of the slopes' table turns from even to logarithmic."""
    step: float
    """Distance of the table's nodes in asinh(slope / scale)."""
    matte: float
    """Albedo of the matte part."""
    companion: Plane
    """Cells of the image of what shines beside the target and moves along, about the target's middle."""
    corrected: Plane
    """Cells of the correction of the operator, in the coordinates of the target's motion."""
    notes: dict[str, Any] = field(default_factory=dict)
    """What each freedom of the fit explains."""

    def __post_init__(self) -> None:
        for name in ("scale", "step"):
            if not 1e-6 < getattr(self, name) < 1e3:
                raise ConfigError(f"{name} is {getattr(self, name)}; give 1e-6 to 1e3")
        if not 0 <= self.matte < 1e12:
            raise ConfigError(f"matte is {self.matte}; give 0 or more")


@dataclass(frozen=True, eq=False)
class FittedWall:
    """A wall that was fitted to captures, without the pose of camera and target.

    Args:
        log_density: Table of the facets' slopes, float64 [K, K], see `SlopeTable`; white levels included.
        sensitivity: Sensitivity of the pixels (texture, vignetting), float32 [H, W].
        ambient: Light without the target over its mean, float32 [h, w], an image of any size.
        companion: Brightness of what moves along, float32 [h, w]; the target's is 1.
        left: Correction of the operator, float32 [R, h, w]: R images of the camera image, any size.
        right: Their weights over the cells of `about.corrected`, float32 [R, h w].
        about: Geometry of the arrays, and notes.
        tilt: Slopes of the wall along x and y at the pixels, beside its bend, float32 [2, h, w], of any
            size.

    Raises:
        DataError: The arrays do not fit each other, or hold NaN.
    """

    log_density: np.ndarray
    sensitivity: np.ndarray
    ambient: np.ndarray
    companion: np.ndarray
    left: np.ndarray
    right: np.ndarray
    about: AboutWall
    tilt: np.ndarray = field(default_factory=lambda: np.zeros((2, 1, 1), np.float32))

    def __post_init__(self) -> None:
        nodes, plane = len(self.log_density), self.about.corrected
        rank = len(self.left) if self.left.ndim == 3 else -1
        wanted = {
            "log_density": (nodes, nodes),
            "companion": self.about.companion.shape,
            "right": (rank, plane.height * plane.width),
        }
        for name, size in wanted.items():
            if getattr(self, name).shape != size:
                raise DataError(f"{name} is {getattr(self, name).shape}; its geometry needs {size}")
        if self.sensitivity.ndim != 2 or self.ambient.ndim != 2 or not 5 <= nodes <= _LARGEST or nodes % 2 == 0:
            raise DataError(
                f"sensitivity is {self.sensitivity.shape}, ambient {self.ambient.shape}, log_density "
                f"{self.log_density.shape}; give two images and "
                "an odd number of nodes from 5"
            )
        if self.tilt.ndim != 3 or len(self.tilt) != 2 or not self.tilt.size:
            raise DataError(f"tilt is {self.tilt.shape}; give two images")
        for name in (*_ARRAYS, "tilt"):
            if not np.isfinite(getattr(self, name)).all():
                raise DataError(f"{name} holds NaN or infinity; calibrate again")

    @property
    def table(self) -> SlopeTable:
        """The density of the facets' slopes."""
        return SlopeTable(self.log_density, self.about.scale, self.about.step, self.about.matte)

    def image(self, name: str, shape: tuple[int, int]) -> torch.Tensor:
        """Return `sensitivity`, `ambient`, `left` or `tilt` for an image of `shape` (H, W), [..., H, W]."""
        picture = torch.from_numpy(getattr(self, name))
        if tuple(picture.shape[-2:]) == tuple(shape) or not picture.numel():
            return picture.reshape(*picture.shape[:-2], *shape)
        flat = picture.reshape(1, -1, *picture.shape[-2:])
        shrinks = shape[0] < picture.shape[-2] or shape[1] < picture.shape[-1]
        resized = torch.nn.functional.interpolate(
            flat, shape, mode="bilinear", align_corners=False, antialias=shrinks
        )
        return resized.reshape(*picture.shape[:-2], *shape)


def _wall(about: AboutWall, **tensors: torch.Tensor) -> FittedWall:
    check_floats(tensors)
    log_density = tensors.pop("log_density").double().numpy()
    return FittedWall(log_density, about=about, **{name: one.float().numpy() for name, one in tensors.items()})


WALL = TensorFile(
    "evnlos-wall-1",
    _ARRAYS,
    AboutWall,
    _wall,
    "a fitted wall",
    "the file that `evnlos calibrate` wrote beside setup.yaml",
    ("tilt",),
)
"""Fitted walls on disk."""
WALL_FILE = "wall.safetensors"
"""Name of a fitted wall's file in the folder of `evnlos calibrate`."""


def write_fitted(path: str | Path, wall: FittedWall) -> str:
    """Write a fitted wall as one safetensors file, atomically, and return its checksum.

    Raises:
        ConfigError: The name does not end in .safetensors.
    """
    arrays = {name: torch.tensor(getattr(wall, name)) for name in (*WALL.names, *WALL.later)}
    return WALL.write(path, arrays, wall.about)


CALIBRATED_FILE = "setup.yaml"
"""The simulation that `evnlos calibrate` fits, in its folder."""
TRAINING_FILE = "training.yaml"
"""The same, varied, to pre-train on."""
OLDER_FILE = "rig.yaml"  # its name in folders of before


def calibrated_file(path: Path) -> Path:
    """Return the settings file of a folder that `calibrate` wrote; any other path stays as it is.

    Args:
        path: Folder or file.

    Example:
        >>> str(calibrated_file(Path("setup.yaml")))
        'setup.yaml'
    """
    files = (path / name for name in (CALIBRATED_FILE, OLDER_FILE))
    return next((file for file in files if file.is_file()), path)


def same_setup(first: str, second: str) -> bool:
    """Return whether two words name one setup: they are alike, or files or folders of the same settings.

    Example:
        >>> same_setup("main-near", "main-far")
        False
    """
    if first == second:
        return True
    files = [calibrated_file(Path(word)) for word in (first, second)]
    return all(file.is_file() for file in files) and len({file.read_bytes() for file in files}) == 1


class StatedSetup(NamedTuple):
    """Settings of a setup in a file, those of a lab that were drawn from its ranges, and its targets'."""

    values: dict[str, Any]
    drawn: Mapping[str, Any]
    glyphs: dict[str, Any] | None
    """None where the file states none."""


def stated_setup(path: Path) -> StatedSetup:
    """Return the settings of the setup in a file, and what stands beside it.

    Args:
        path: YAML file with a setup, or with what holds one.

    Raises:
        ConfigError: The file holds no setup.
    """
    values = read_yaml(path)
    drawn: Mapping[str, Any] = {}
    glyphs = None
    if isinstance(values.get("lab"), dict):
        known = values.get("drawn")
        drawn = known if isinstance(known, dict) else {}
        values = values["lab"]
    elif isinstance(values.get("config"), dict):
        values = values["config"]
    if "kind" not in values:
        values = migrate("Simulation", values)
        if "setup" not in values:
            near = difflib.get_close_matches("setup", [str(key) for key in values], n=1)
            hint = f"; perhaps {near[0]!r} is meant to be it" if near else ""
            raise ConfigError(
                f"{path} has no `setup`; give settings of `evnlos simulate` or `evnlos lab`, or a setup{hint}"
            )
        glyphs, values = values.get("glyphs"), values["setup"]
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: setup is {values!r}; give a mapping with the kind of the setup")
    return StatedSetup(values, drawn, glyphs if isinstance(glyphs, dict) else None)
