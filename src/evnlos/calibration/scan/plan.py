"""A scan planned: `scan.yaml`, the table of pictures to take, and what to show for each of them."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.calibration.scan.estimate import ScanCamera, ScanEstimate, estimate_scan
from evnlos.calibration.scan.folder import SCAN_FILE, ScanInfo, Shot, write_shots
from evnlos.calibration.scan.patterns import Pattern, Patterns
from evnlos.config import save_yaml
from evnlos.errors import ConfigError
from evnlos.files import new_folder
from evnlos.progress import Progress, Step, silent
from evnlos.types import Plane

_CHECKS = 4
_MOST_DISPLAY = 16_384


@dataclass(frozen=True)
class ScanPlan:
    """What to scan, and with what."""

    plane: tuple[float, float] = (0.24, 0.08)
    """Width and height of the region in which the target will move, metres."""
    pitch: float = 0.01
    """Side of a cell, metres; details within a cell are not measured."""
    center: tuple[float, float] = (0.0, 0.0)
    """Middle of the region in the coordinates of the target's motion (x right, y down), metres."""
    pattern: Pattern = "raster"
    """raster: one cell at a time (a moving LED, or a display); hadamard: half of them (a display, an LED
    matrix); points: a few cells, for a point-spread function."""
    points: int = 5
    """points: number of cells, the middle one first, then outwards."""
    display: tuple[int, int] | None = None
    """Width and height of the display, pixels; none = a moving LED (places.csv) or one picture pixel a cell."""
    display_pitch: float = 0.00027
    """Side of a display pixel, metres."""
    repeats: int = 2
    """How often every pattern is recorded; 2 or more tell the noise."""
    exposure_s: float = 0.05
    """Exposure of a frame, seconds."""
    overhead_s: float = 0.1
    """Time between two pictures besides the exposure, seconds (an LED on a stage: how long a move takes)."""
    dark_every: int | None = None
    """A dark frame before every so many pictures, and one at the end of each repeat; none = 64 for hadamard, 4
    else: all cells of a raster share the error of the dark frame, and it adds up where many of them shine."""
    camera: ScanCamera = field(default_factory=ScanCamera)
    """Light and noise, for the estimate."""

    def __post_init__(self) -> None:
        for name in ("pitch", "display_pitch", "exposure_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name} is {value}; give a positive number")
        if not (math.isfinite(self.overhead_s) and self.overhead_s >= 0):
            raise ConfigError(f"overhead_s is {self.overhead_s}; give 0 or more seconds")
        if not all(math.isfinite(side) and side >= self.pitch * 0.999 for side in self.plane):
            raise ConfigError(f"plane is {self.plane} m, pitch {self.pitch} m; give a plane of a cell or more")
        if (self.dark_every is not None and self.dark_every < 1) or self.points < 1:
            raise ConfigError(f"dark_every is {self.dark_every}, points {self.points}; give 1 or more")
        if self.display is not None:
            if not all(1 <= side <= _MOST_DISPLAY for side in self.display):
                raise ConfigError(f"display is {self.display}; give 1 to {_MOST_DISPLAY} pixels a side")
            needed = [round(n * self.pitch / self.display_pitch) for n in reversed(self.cells.shape)]
            if self.pitch < self.display_pitch or needed[0] > self.display[0] or needed[1] > self.display[1]:
                raise ConfigError(
                    f"the plane takes {needed[0]} x {needed[1]} display pixels of {self.display_pitch:g} m, "
                    "the display "
                    f"has {self.display[0]} x {self.display[1]}; scan a smaller plane, or a pitch of a pixel "
                    "or more"
                )
        self.info()  # refuses what a scan.yaml could not hold

    @property
    def cells(self) -> Plane:
        """The cells of the plane."""
        width, height = (max(1, round(side / self.pitch)) for side in self.plane)
        return Plane(height, width, self.pitch, self.center)

    def info(self) -> ScanInfo:
        """Return the `scan.yaml` of this plan."""
        plane = self.cells
        listed = spread_points(plane, self.points) if self.pattern == "points" else ()
        return ScanInfo(plane, self.pattern, listed, self.repeats, self.exposure_s)

    def shots(self) -> list[Shot]:
        """Return the pictures in the order in which to take them."""
        count, found = self.info().patterns.count, []
        every = self.dark_every or (64 if self.pattern == "hadamard" else 4)
        for repeat in range(self.repeats):
            for k in range(count):
                if k % every == 0:
                    found.append((None, repeat, self.exposure_s))
                found.append((k, repeat, self.exposure_s))
            found.append((None, repeat, self.exposure_s))
        # Half of the exposure tells whether the camera is linear; cells near the middle are bright.
        half = self.exposure_s / 2
        middle = self.cells.height // 2 * self.cells.width + self.cells.width // 2
        checks = [0] if self.pattern == "points" else sorted({max(0, middle - k) for k in range(_CHECKS)})
        found += [(None, 0, half), *((k, 0, half) for k in checks)]
        return [Shot(p, r, e, f"frames/{number:05d}.png") for number, (p, r, e) in enumerate(found)]

    def estimate(self) -> ScanEstimate:
        """Return time and noise of the scan."""
        shots = self.shots()
        darks = sum(shot.pattern is None for shot in shots) - 1
        return estimate_scan(
            self.info().patterns,
            self.camera,
            self.pitch,
            self.repeats,
            len(shots),
            darks,
            self.exposure_s + self.overhead_s,
        )


def spread_points(plane: Plane, count: int) -> tuple[tuple[int, int], ...]:
    """Return cells to light for a point-spread function: the middle, then far from all before.

    Example:
        >>> spread_points(Plane(5, 9, 0.01), 3)
        ((2, 4), (0, 0), (0, 8))
    """
    rows, columns = np.divmod(np.arange(plane.height * plane.width), plane.width)
    places = np.stack([rows, columns], axis=1)
    chosen = [plane.height // 2 * plane.width + plane.width // 2]
    for _ in range(min(count, len(places)) - 1):
        distance = ((places[:, None] - places[chosen]) ** 2).sum(axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return tuple((int(rows[k]), int(columns[k])) for k in chosen)


def write_plan(plan: ScanPlan, folder: str | Path, progress: Progress = silent) -> list[Path]:
    """Write a scan's folder and return its files: scan.yaml, frames.csv, and places.csv or patterns/*.png.

    The folder gets its name when the last is written.

    Args:
        plan: The plan.
        folder: A new or empty folder.
        progress: Called when the work begins and after each file, with its path.

    Raises:
        DataError: The folder holds something already.
    """
    folder = Path(folder)
    info, shots = plan.info(), plan.shots()
    shows_places = plan.display is None and plan.pattern != "hadamard"
    total, written = 3 if shows_places else info.patterns.count + 2, list[Path]()

    def wrote(path: Path) -> None:
        written.append(path)
        progress(Step("plan", len(written), total, "files", path))

    progress(Step("plan", 0, total, "files"))
    with new_folder(folder) as draft:
        (draft / "frames").mkdir()
        write_shots(draft / info.frames, shots)
        wrote(folder / info.frames)
        if shows_places:
            _write_places(draft / "places.csv", info.plane, measured_cells(info))
            wrote(folder / "places.csv")
        else:
            (draft / "patterns").mkdir()
            _save(draft / "patterns" / "dark.png", plan, np.zeros(info.plane.shape, np.bool_))
            for k in range(info.patterns.count):
                name = f"patterns/{k:05d}.png"
                _save(draft / name, plan, lit_cells(info, k))
                wrote(folder / name)
        save_yaml(info, draft / SCAN_FILE)
        wrote(folder / SCAN_FILE)
    return written


def measured_cells(info: ScanInfo) -> NDArray[np.int64]:
    """Return the number of each measured cell, row by row: all, or the points."""
    if info.pattern == "points":
        return np.array([row * info.plane.width + column for row, column in info.cells])
    return np.arange(info.plane.height * info.plane.width)


def lit_cells(info: ScanInfo, pattern: int) -> NDArray[np.bool_]:
    """Return which cells a pattern lights, [h, w]."""
    lit = np.zeros(info.plane.height * info.plane.width, np.bool_)
    lit[measured_cells(info)] = Patterns(info.pattern, info.patterns.cells).row(pattern)
    return lit.reshape(info.plane.shape)


def _save(path: Path, plan: ScanPlan, lit: NDArray[np.bool_]) -> None:
    """Write a picture for the display, cells in its middle, or one pixel a cell."""
    if plan.display is None:
        Image.fromarray(lit.astype(np.uint8) * 255).convert("1").save(path)
        return
    width, height = plan.display
    size = plan.pitch / plan.display_pitch  # display pixels a cell, not whole in general
    edges = [np.round((np.arange(n + 1) - n / 2) * size).astype(int) for n in lit.shape]
    y, x = edges[0] + height // 2, edges[1] + width // 2
    picture = np.zeros((height, width), np.uint8)
    shown = np.repeat(np.repeat(lit, np.diff(y), axis=0), np.diff(x), axis=1)
    top, left = max(int(y[0]), 0), max(int(x[0]), 0)
    part = shown[: height - top, : width - left]
    picture[top : top + part.shape[0], left : left + part.shape[1]] = part * np.uint8(255)
    Image.fromarray(picture).convert("1").save(path)


def _write_places(path: Path, plane: Plane, cells: NDArray[np.int64]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("pattern", "x_m", "y_m"))
        for number, cell in enumerate(cells):
            row, column = divmod(int(cell), plane.width)
            table.writerow((number, f"{plane.x_m[column]:.6f}", f"{plane.y_m[row]:.6f}"))
