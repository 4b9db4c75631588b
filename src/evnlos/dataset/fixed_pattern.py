"""A camera's fixed pattern, known pixel by pixel: what it does to every frame can be taken away."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.files import write_atomically
from evnlos.tensor_file import check_floats, read_sealed, sealed_bytes

_LEAST = 0.1  # sensitivity below which a pixel is dead: nothing is divided by less


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What each pixel of a frame camera makes of the light: DN / peak = sensitivity * light + offset.

    Args:
        sensitivity: Relative sensitivity, about 1, float32 [H, W].
        offset: Offset, white levels, float32 [H, W].
    """

    sensitivity: NDArray[np.float32]
    offset: NDArray[np.float32]

    def correct(self, frames: NDArray, peak: float) -> NDArray[np.float32]:
        """Return the light that frames [N, H, W] (digital numbers up to `peak`) saw, white levels.

        Noise can make a dark pixel slightly negative; nothing is clipped.

        Raises:
            DataError: The frames have another size than the pattern.
        """
        if frames.shape[1:] != self.offset.shape:
            height, width = self.offset.shape
            raise DataError(
                f"the fixed pattern is of {width} x {height} pixels, the frames have {frames.shape[2]} x "
                f"{frames.shape[1]}; calibrate the camera that took them"
            )
        light = frames.astype(np.float32) / np.float32(peak) - self.offset
        return (light / np.maximum(self.sensitivity, _LEAST)).astype(np.float32)

    @property
    def digest(self) -> str:
        """Hash of the pattern: datasets that were corrected by different patterns are not alike."""
        return hashlib.sha256(self.sensitivity.tobytes() + self.offset.tobytes()).hexdigest()[:16]


def save_pattern(pattern: FixedPattern, path: str | Path) -> None:
    """Write a fixed pattern as a safetensors file, atomically."""
    tensors = {"sensitivity": pattern.sensitivity, "offset": pattern.offset}
    content = {name: torch.tensor(value, dtype=torch.float32) for name, value in tensors.items()}
    write_atomically(Path(path), sealed_bytes(content, "fixed pattern"))


def load_pattern(path: str | Path) -> FixedPattern:
    """Read a fixed pattern.

    Args:
        path: The file, or the folder of a calibrated rig that holds it.

    Raises:
        DataError: There is no such file, it is damaged, or it holds something else.
    """
    path = Path(path)
    if path.is_dir():
        path = path / PATTERN_FILE
    if not path.is_file():
        raise DataError(f"{path} does not exist; `evnlos calibrate` writes the fixed pattern of a rig's camera")
    try:
        _, tensors, _ = read_sealed(path)
        check_floats(tensors)
        sensitivity, offset = (tensors[name].float().numpy() for name in ("sensitivity", "offset"))
    except (OSError, ValueError, LookupError) as error:
        raise DataError(f"{path} holds no fixed pattern: {' '.join(str(error).split())}") from None
    if sensitivity.ndim != 2 or sensitivity.shape != offset.shape:
        raise DataError(
            f"{path}: sensitivity {sensitivity.shape} and offset {offset.shape} are no pictures of one size"
        )
    return FixedPattern(sensitivity, offset)


PATTERN_FILE = "pattern.safetensors"
"""Name of the file in a rig's folder."""
