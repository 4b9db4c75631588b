"""A planned scan recorded by the simulator instead of a camera: to try plan, exposure and import beforehand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from evnlos.calibration.scan.folder import Shot, read_scan_info, read_shots
from evnlos.calibration.scan.plan import lit_cells
from evnlos.errors import DataError
from evnlos.files import new_file
from evnlos.sensor import FrameCamera

Change = Callable[[NDArray[np.float64], Shot], NDArray[np.float64]]


def rehearse_scan(
    folder: str | Path,
    matrix: ArrayLike,
    shape: tuple[int, int],
    camera: FrameCamera,
    *,
    ambient: float = 0.02,
    seed: int = 0,
    change: Change | None = None,
) -> int:
    """Take the pictures of a planned scan with a known rig, and return their number.

    Args:
        folder: A folder that `write_plan` wrote.
        matrix: White levels a cell at the scan's exposure, [H W, cells of the plane].
        shape: Size (H, W) of the camera image, pixels.
        camera: Its frame camera; a picture at another exposure has light in proportion.
        ambient: Light that is always there, white levels.
        seed: Seed of the noise.
        change: Alters the light [H, W] of a shot before the exposure: a fault to rehearse.

    Raises:
        DataError: The matrix does not fit the plan and the size.
    """
    folder, matrix = Path(folder), np.asarray(matrix, np.float64)
    info = read_scan_info(folder)
    if matrix.shape != (shape[0] * shape[1], info.plane.height * info.plane.width):
        raise DataError(
            f"the matrix is {matrix.shape}; the plan and {shape[0]} x {shape[1]} pixels need "
            f"({shape[0] * shape[1]}, {info.plane.height * info.plane.width})"
        )
    shots = read_shots(folder, info)
    for number, shot in enumerate(shots):
        lit = np.zeros(info.plane.shape) if shot.pattern is None else lit_cells(info, shot.pattern)
        light = (matrix @ lit.ravel()).reshape(shape) + ambient
        if change is not None:
            light = change(light, shot)
        light = light * (shot.exposure_s / info.exposure_s)
        path = folder / shot.file
        path.parent.mkdir(parents=True, exist_ok=True)
        with new_file(path) as draft:
            Image.fromarray(camera.expose(light[None], seed=seed, first_frame=number)[0]).save(draft, "PNG")
    return len(shots)
