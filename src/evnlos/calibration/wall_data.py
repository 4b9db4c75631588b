"""What the fit of a wall works on: some pixels of some frames, and the targets as sparse pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
from evnlos.dataset.sampling import reduce_by_area
from evnlos.types import Plane

Array = NDArray[np.float64]

_SATURATED = 0.995


@dataclass(frozen=True, eq=False)
class WallData:
    """What the fit works on: some pixels of some frames, and the targets as sparse pictures.

    Args:
        shape: Size (H, W) of the camera image, pixels.
        columns: Columns of the pixels [P] in that image.
        rows: Their rows [P].
        seen: White levels [P, N].
        capture: Capture of each frame [N].
        group: Place of the target of each frame [N]: light that all captures share there is left out.
        weight: Weight of each pixel's squares [P].
        grid: Size (h, w) of the working pictures.
        pixel: Number of each pixel in them [P].
        places: Place (x, y) of the target in each frame [N, 2], metres.
        plane: Cells of the targets' pictures.
        starts: Where each picture's entries begin [N + 1].
        index: Cell of each entry.
        light: Brightness of each entry.
    """

    shape: tuple[int, int]
    columns: Array
    rows: Array
    seen: Array
    capture: NDArray[np.int64]
    group: NDArray[np.int64]
    weight: Array
    grid: tuple[int, int]
    pixel: NDArray[np.int64]
    places: Array
    plane: Plane
    starts: NDArray[np.int64]
    index: NDArray[np.int64]
    light: Array

    def shared_removed(self, values: NDArray) -> NDArray:
        """Return values [P, N, ...] without what the frames of a group share."""
        out = np.array(values)
        for g in range(int(self.group.max()) + 1):
            rows = np.flatnonzero(self.group == g)
            out[:, rows] -= out[:, rows].mean(axis=1, keepdims=True)
        return out

    def pixels(self, chosen: NDArray) -> WallData:
        """Return the data of some of the pixels."""
        names = ("columns", "rows", "seen", "weight", "pixel")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def image(self, values: Array, fill: float) -> Array:
        """Return values of the pixels [P] as a working picture [h, w], `fill` where a pixel takes no part."""
        out = np.full(self.grid[0] * self.grid[1], fill)
        out[self.pixel] = values
        return out.reshape(self.grid)

    def monomials(self) -> Array:
        """Return x, y, x^2, x y, y^2 over the image, [P, 5], each from -1 to 1."""
        x = 2 * self.columns / (self.shape[1] - 1) - 1
        y = 2 * self.rows / (self.shape[0] - 1) - 1
        return np.stack([x, y, x * x, x * y, y * y], axis=1)


def wall_data(
    shots: Shots,
    columns: int,
    plane: Plane,
    *,
    every: int = 4,
    first: int | None = None,
    checkered: bool = False,
) -> WallData:
    """Return the frames of captures at a working size, and their targets as pictures on a plane's cells.

    Args:
        shots: The captures.
        columns: Columns of the working pictures, at most the sensor's.
        plane: Cells, over the whole travel.
        every: Only every n-th frame of a capture takes part.
        first: The first of them; None is the middle of the first n.
        checkered: Whether only every second pixel takes part, in the pattern of a chessboard.
    """
    height, width = shots.shape
    columns = min(columns, width)
    grid = (max(8, round(columns * height / width)), columns) if columns < width else (height, width)
    begin = every // 2 if first is None else first
    frames, pictures, capture, places = [], [], [], []
    for k, one in enumerate(shots.captures):
        picked = np.arange(begin, len(one.frames), every)
        frames.append(reduce_by_area(one.frames[picked] / np.float32(shots.peak), grid))
        scene = shots.scenes[k]
        place = scene.motion.position_m(shots.times_s(k)[picked])
        pictures.append(scene.target.rasterise(plane, place).reshape(len(picked), -1))
        capture.append(np.full(len(picked), k))
        places.append(place)
    seen, drawn = np.concatenate(frames), np.concatenate(pictures)
    v, u = np.meshgrid(np.arange(grid[0]), np.arange(grid[1]), indexing="ij")
    keep = ((u + v) % 2 == 0).ravel() if checkered else np.ones(u.size, bool)
    keep &= (seen < _SATURATED).all(axis=0).ravel()
    light = np.ascontiguousarray(seen.reshape(len(seen), -1).T[keep], dtype=np.float64)
    level = light.mean(axis=1)
    weight = 1 / (level + 0.05 * level.max() + 1e-9)
    frame, index = np.nonzero(drawn)
    return WallData(
        shots.shape,
        ((u.ravel() + 0.5) * width / grid[1] - 0.5)[keep],
        ((v.ravel() + 0.5) * height / grid[0] - 0.5)[keep],
        light,
        np.concatenate(capture),
        grouped(np.concatenate(places), np.concatenate(capture)),
        weight * (len(weight) / weight.sum()),
        grid,
        np.flatnonzero(keep),
        np.concatenate(places),
        plane,
        np.searchsorted(frame, np.arange(len(drawn) + 1)).astype(np.int64),
        index.astype(np.int64),
        drawn[frame, index].astype(np.float64),
    )


def grouped(places: Array, capture: NDArray[np.int64], tolerance_m: float = 1e-3) -> NDArray[np.int64]:
    """Return the group of each frame: frames whose targets are at one place, where most captures share places.

    Args:
        places: Places of the targets [N, 2], metres.
        capture: Capture of each frame [N].
        tolerance_m: Places nearer than that are one, metres.
    """
    keys = np.round(places / tolerance_m).astype(np.int64)
    _, group, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    captures = len(np.unique(capture))
    if captures < 4 or count.min() < max(3, captures / 2):
        return np.zeros(len(places), np.int64)
    return group.reshape(-1).astype(np.int64)
