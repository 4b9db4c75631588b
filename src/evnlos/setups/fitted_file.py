"""A fitted wall on disk: its facets' slopes, maps of the image, light that moves along."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from evnlos.config import from_dict, to_dict
from evnlos.errors import ConfigError, DataError
from evnlos.files import write_atomically
from evnlos.transport.facets import SlopeTable
from evnlos.types import Plane

FORMAT = "evnlos-wall-1"
SUFFIX = ".safetensors"
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
    """Cells of the picture of what shines beside the target and moves along, about the target's middle."""
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
        ambient: Light without the target over its mean, float32 [h, w], a picture of any size.
        companion: Brightness of what moves along, float32 [h, w]; the target's is 1.
        left: Correction of the operator, float32 [R, h, w]: R pictures of the camera image, any size.
        right: Their weights over the cells of `about.corrected`, float32 [R, h w].
        about: Geometry of the arrays, and notes.

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
                f"{self.log_density.shape}; give two pictures and "
                "an odd number of nodes from 5"
            )
        for name in _ARRAYS:
            if not np.isfinite(getattr(self, name)).all():
                raise DataError(f"{name} holds NaN or infinity; calibrate again")

    @property
    def table(self) -> SlopeTable:
        """The density of the facets' slopes."""
        return SlopeTable(self.log_density, self.about.scale, self.about.step, self.about.matte)

    def image(self, name: str, shape: tuple[int, int]) -> torch.Tensor:
        """Return `sensitivity`, `ambient` or `left` for an image of `shape` (H, W), float32 [..., H, W]."""
        picture = torch.from_numpy(getattr(self, name))
        if tuple(picture.shape[-2:]) == tuple(shape) or not picture.numel():
            return picture.reshape(*picture.shape[:-2], *shape)
        flat = picture.reshape(1, -1, *picture.shape[-2:])
        shrinks = shape[0] < picture.shape[-2] or shape[1] < picture.shape[-1]
        resized = torch.nn.functional.interpolate(
            flat, shape, mode="bilinear", align_corners=False, antialias=shrinks
        )
        return resized.reshape(*picture.shape[:-2], *shape)


def write_fitted(path: str | Path, wall: FittedWall) -> str:
    """Write a fitted wall as one safetensors file, atomically, and return its checksum.

    Raises:
        ConfigError: The name does not end in .safetensors.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path} ends in {path.suffix or 'nothing'!r}; give a name that ends in {SUFFIX}")
    arrays = {name: np.ascontiguousarray(getattr(wall, name)) for name in _ARRAYS}
    content = save(arrays, metadata={"evnlos": json.dumps({"format": FORMAT, "about": to_dict(wall.about)})})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)
    return hashlib.sha256(content).hexdigest()[:16]


def read_fitted(path: str | Path) -> FittedWall:
    """Read a fitted wall; nothing is unpickled, and no size is taken on trust.

    Raises:
        DataError: The file is missing, is not such a file, or does not fit its own geometry.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path} does not exist; give the file that `evnlos calibrate` wrote beside rig.yaml")
    try:
        with safe_open(path, framework="np") as file:
            found = json.loads((file.metadata() or {}).get("evnlos", "{}"))
            names = set(file.keys())
            arrays = {name: file.get_tensor(name) for name in _ARRAYS if name in names}
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} is not a readable safetensors file: {' '.join(str(error).split())}") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT or len(arrays) != len(_ARRAYS):
        stated = found.get("format", "no format") if isinstance(found, dict) else found
        raise DataError(f"{path} holds {str(stated)[:40]!r}; give a fitted wall of format {FORMAT}")
    try:
        about = from_dict(AboutWall, found.get("about"), source=str(path))  # type: ignore[arg-type]
        arrays["log_density"] = arrays["log_density"].astype(np.float64)
        return FittedWall(about=about, **arrays)
    except (ConfigError, DataError) as error:
        raise DataError(f"{path} garbles its geometry: {error}") from None
