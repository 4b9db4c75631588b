"""A scan's folder, and the patterns that it shows.

What a scan shows on the target's plane, and how cells are distinguished again: raster, points, Hadamard.

Multiplexing lights about half of the cells at a time (Harwit and Sloane, Hadamard Transform Optics, 1979).
Under noise that does not depend on the light, q patterns make the noise of a cell (q + 1) / (2 sqrt q) times
smaller; under shot noise alone they bring nothing.

- A scan's folder: `scan.yaml` says what was shown, `frames.csv` which image shows what.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from evnlos.config import load_yaml
from evnlos.data.capture_info import inside
from evnlos.data.frames import read_image
from evnlos.errors import ConfigError, DataError
from evnlos.types import Plane
from evnlos.untrusted import open_regular

Pattern = Literal["raster", "hadamard", "points"]


@dataclass(frozen=True)
class Patterns:
    """The patterns of a scan.

    Raster and points light one cell at a time. Hadamard: q is the smallest prime of the form 4 m - 1 that is
    not below the number of cells n; in pattern i cell k is lit when (i + k) mod q is 0 or a square modulo q
    (the quadratic-residue S-matrix of order q, of which n columns are used).

    Args:
        kind: "raster", "hadamard" or "points".
        cells: Number of cells that are measured, n: all of the plane, or the points.

    Raises:
        ConfigError: No cells, or more than 65,536.

    Example:
        >>> Patterns("hadamard", 3).lit.astype(int)
        array([[1, 1, 0],
               [1, 0, 1],
               [0, 1, 1]])
    """

    kind: Pattern
    cells: int

    def __post_init__(self) -> None:
        if not 1 <= self.cells <= 65_536:
            raise ConfigError(f"the scan has {self.cells} cells; give 1 to 65536, or a larger pitch")

    @cached_property
    def count(self) -> int:
        """Number of patterns."""
        return residue_order(self.cells) if self.kind == "hadamard" else self.cells

    def row(self, index: int) -> NDArray[np.bool_]:
        """Return which cells pattern `index` lights, [n]."""
        if self.kind == "hadamard":
            return self._residues[(index + np.arange(self.cells)) % self.count]
        return np.arange(self.cells) == index

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Which cells each pattern lights, [patterns, n]."""
        return np.stack([self.row(index) for index in range(self.count)])

    @property
    def noise_factor(self) -> float:
        """Noise of a cell over the noise of a frame, for noise that is the same in all frames.

        Example:
            >>> round(1 / Patterns("hadamard", 103).noise_factor, 3), round(104 / 2 / 103**0.5, 3)
            (5.124, 5.124)
        """
        if self.kind != "hadamard":
            return 1.0
        n = self.cells
        return math.sqrt(4 / (self.count + 1) * n / (n + 1))

    @property
    def offset_factor(self) -> float:
        """Error of a cell over an offset that all frames share, e.g. the error of the dark frame."""
        return 2 / (self.cells + 1) if self.kind == "hadamard" else 1.0

    def separate(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the light of each cell, [n, pixels], from the frames of the patterns, [patterns, pixels].

        Least squares: with P the patterns, P^T P = (q + 1) / 4 (I + J), whose inverse is known.
        """
        if self.kind != "hadamard":
            return frames
        back = self.lit.astype(np.float32).T @ frames  # [n, pixels]
        back -= back.sum(axis=0, dtype=np.float64) / (self.cells + 1)
        back *= 4 / (self.count + 1)
        return back

    @cached_property
    def _residues(self) -> NDArray[np.bool_]:
        found = np.zeros(self.count, np.bool_)
        found[np.arange(self.count, dtype=np.int64) ** 2 % self.count] = True
        return found


def residue_order(cells: int) -> int:
    """Return the smallest prime 4 m - 1 that is not below `cells`.

    Example:
        >>> [residue_order(n) for n in (1, 4, 8, 768)]
        [3, 7, 11, 787]
    """
    order = max(3, cells + (3 - cells) % 4)
    while not _is_prime(order):
        order += 4
    return order


def _is_prime(number: int) -> bool:
    return number > 1 and all(number % k for k in range(2, math.isqrt(number) + 1))


SCAN_FILE = "scan.yaml"
DARK = "dark"
_HEADER = ("pattern", "repeat", "exposure_s", "file")
_MOST_SCAN_FRAMES = 1_000_000


@dataclass(frozen=True)
class ScanInfo:
    """What `scan.yaml` holds."""

    plane: Plane
    """Cells of the target's plane that light up: height, width, pitch_m, center_m (x to the right, y down)."""
    pattern: Pattern = "raster"
    """raster: every cell alone, row by row; hadamard: half of the cells at a time; points: the cells listed."""
    cells: tuple[tuple[int, int], ...] = ()
    """points: (row, column) of each lit cell, in the order of the patterns; one is a point-spread function."""
    repeats: int = 2
    """How often every pattern was recorded; two or more tell the noise and let the import remove some of it."""
    exposure_s: float = 0.05
    """Exposure of a frame, seconds, where frames.csv states none."""
    white_dn: int | None = None
    """Digital number at which the camera saturates, e.g. 4095; none = the largest of the image's type."""
    frames: str = "frames.csv"
    """Table pattern,repeat,exposure_s,file: one line per image."""
    image_px_per_m: tuple[tuple[float, float], tuple[float, float]] | None = None
    """points: how far the image moves, pixels, when the light moves a metre: ((column by x, column by y),
    (row by x, row by y)); found from the points where three or more do not lie on a line."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Your notes: display, camera, lens, date."""

    def __post_init__(self) -> None:
        if not 1 <= self.repeats <= 1000:
            raise ConfigError(f"repeats is {self.repeats}; give 1 to 1000")
        if not 0 < self.exposure_s <= 3600:
            raise ConfigError(f"exposure_s is {self.exposure_s}; give more than 0 and at most 3600 s")
        if self.white_dn is not None and not 1 <= self.white_dn <= 65_535:
            raise ConfigError(f"white_dn is {self.white_dn}; give 1 to 65535")
        if (self.pattern == "points") != bool(self.cells):
            raise ConfigError(
                f"pattern is {self.pattern} with {len(self.cells)} cells; list cells for points, and only there"
            )
        for row, column in self.cells:
            if not (0 <= row < self.plane.height and 0 <= column < self.plane.width):
                raise ConfigError(
                    f"cells holds ({row}, {column}); the plane has {self.plane.height} x {self.plane.width} "
                    "cells"
                )
        if len(set(self.cells)) != len(self.cells):
            raise ConfigError("cells holds a cell twice; list each once, and use repeats")

    @property
    def patterns(self) -> Patterns:
        """What was shown."""
        count = len(self.cells) if self.pattern == "points" else self.plane.height * self.plane.width
        return Patterns(self.pattern, count)


@dataclass(frozen=True)
class ScanFrame:
    """One image of a scan.

    Args:
        pattern: Number of the pattern, or None for a dark frame.
        repeat: Number of the pass, from 0.
        exposure_s: Exposure, seconds.
        file: Name of the image in the folder.
    """

    pattern: int | None
    repeat: int
    exposure_s: float
    file: str


def measured_cells(info: ScanInfo) -> NDArray[np.int64]:
    """Return the number of each measured cell, row by row: all, or the points."""
    if info.pattern == "points":
        return np.array([row * info.plane.width + column for row, column in info.cells])
    return np.arange(info.plane.height * info.plane.width)


def lit_cells(info: ScanInfo, pattern: int) -> NDArray[np.bool_]:
    """Return which cells a pattern lights, [h, w].

    Args:
        info: The scan.
        pattern: Number of the pattern.
    """
    lit = np.zeros(info.plane.height * info.plane.width, np.bool_)
    lit[measured_cells(info)] = Patterns(info.pattern, info.patterns.cells).row(pattern)
    return lit.reshape(info.plane.shape)


def cell_edges(plane: Plane, display: tuple[int, int], display_pitch: float) -> tuple[NDArray, NDArray]:
    """Return the first display row of each row of cells and one more, and so the columns; middle on middle."""
    size = plane.pitch_m / display_pitch  # display pixels per cell, not whole in general
    edges = [np.round((np.arange(n + 1) - n / 2) * size).astype(int) for n in plane.shape]
    return edges[0] + display[1] // 2, edges[1] + display[0] // 2


def displayed(
    cells: NDArray, plane: Plane, display: tuple[int, int], display_pitch: float
) -> NDArray[np.uint8]:
    """Return the image of a display [rows, columns] that shows cells [h, w], of brightness 0 to 1."""
    width, height = display
    y, x = cell_edges(plane, display, display_pitch)
    shown = np.repeat(np.repeat(cells, np.diff(y), axis=0), np.diff(x), axis=1)
    top, left = max(int(y[0]), 0), max(int(x[0]), 0)
    cut = shown[: height - top, : width - left]
    picture = np.zeros((height, width), np.uint8)
    picture[top : top + cut.shape[0], left : left + cut.shape[1]] = np.round(255.0 * cut).astype(np.uint8)
    return picture


def read_scan_info(folder: str | Path) -> ScanInfo:
    """Read the `scan.yaml` of a folder.

    Args:
        folder: The scan's folder.

    Raises:
        ConfigError: Folder or file is missing, or it has an unknown key, a wrong type or a value out of range.
    """
    path = Path(folder) / SCAN_FILE
    if not path.is_file():
        what = "is not a folder" if Path(folder).exists() else "does not exist"
        what = f"holds no {SCAN_FILE}" if Path(folder).is_dir() else what
        raise ConfigError(f"{folder} {what}; give the folder that `evnlos scan plan` made")
    return load_yaml(ScanInfo, path)


def write_scan_frames(path: Path, scan_frames: list[ScanFrame]) -> None:
    """Write the table of images."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(_HEADER)
        for scan_frame in scan_frames:
            name = DARK if scan_frame.pattern is None else scan_frame.pattern
            table.writerow((name, scan_frame.repeat, f"{scan_frame.exposure_s:g}", scan_frame.file))


def read_scan_frames(folder: str | Path, info: ScanInfo) -> list[ScanFrame]:
    """Read and check the table of images: every pattern in every repeat, once, and dark frames.

    Args:
        folder: The scan's folder.
        info: The scan, as its `scan.yaml` says.

    Raises:
        DataError: The table is missing or garbled, or a pattern or the dark frames are missing.
    """
    folder = Path(folder)
    path = inside(folder, info.frames, SCAN_FILE)
    try:
        with open_regular(path) as opened, TextIOWrapper(opened, encoding="utf-8", newline="") as file:
            rows = list(_bounded(csv.DictReader(file), path))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} can't be read as a table: {error}") from None
    if not rows or not {"pattern", "file"} <= rows[0].keys():
        raise DataError(f"{path} holds no images; give a header {','.join(_HEADER)} and one line per image")
    scan_frames = [_scan_frame(path, number, row, info) for number, row in enumerate(rows, start=2)]
    _check_complete(path, scan_frames, info)
    return scan_frames


def is_main(scan_frame: ScanFrame, info: ScanInfo) -> bool:
    """Return whether an image has the scan's own exposure; the others serve the check of linearity."""
    return abs(scan_frame.exposure_s - info.exposure_s) <= 1e-6 * info.exposure_s


Reader = Callable[[ScanFrame], NDArray]
"""From a frame to its image, digital numbers [H, W]."""


def frame_reader(folder: str | Path, table: str = "frames.csv") -> Reader:
    """Return what reads the images of a folder, all of one size and type.

    Args:
        folder: The scan's folder.
        table: Table that names the images, for messages.

    Raises (when it reads):
        DataError: An image is missing, unreadable, outside the folder, or unlike the first one.
    """
    folder, first = Path(folder), {}

    def read(scan_frame: ScanFrame) -> NDArray:
        path = inside(folder, scan_frame.file, table)
        image = read_image(path)
        shape, kind = first.setdefault("like", (image.shape, image.dtype))
        if image.shape != shape or image.dtype != kind:
            raise DataError(
                f"{path} is {image.dtype} {image.shape}, the first image {kind} {shape}; give images of "
                "one "
                "camera and one format"
            )
        return image

    return read


def _bounded(rows: Iterator[dict[str, str]], path: Path) -> Iterator[dict[str, str]]:
    for number, row in enumerate(rows):
        if number >= _MOST_SCAN_FRAMES:
            raise DataError(f"{path} has more than {_MOST_SCAN_FRAMES} lines; split the scan")
        yield row


def _scan_frame(path: Path, line: int, row: dict[str, Any], info: ScanInfo) -> ScanFrame:
    text = str(row.get("pattern") or "").strip()
    try:
        pattern = None if text == DARK else int(text)
        repeat = int(row.get("repeat") or 0)
        exposure = float(row.get("exposure_s") or info.exposure_s)
    except ValueError:
        raise DataError(
            f"{path} line {line}: pattern {text[:40]!r}, repeat {row.get('repeat')!r} or exposure_s "
            f"{row.get('exposure_s')!r} is no number; write a number, or {DARK!r} for a dark frame"
        ) from None
    count = info.patterns.count
    if pattern is not None and not 0 <= pattern < count:
        raise DataError(f"{path} line {line}: pattern {pattern}; the scan has patterns 0 to {count - 1}")
    if not 0 <= repeat < info.repeats:
        raise DataError(
            f"{path} line {line}: repeat {repeat}; scan.yaml states repeats 0 to {info.repeats - 1}"
        )
    if not 0 < exposure <= 3600:
        raise DataError(f"{path} line {line}: exposure_s is {exposure}; give more than 0 and at most 3600 s")
    return ScanFrame(pattern, repeat, exposure, str(row.get("file") or ""))


def _check_complete(path: Path, scan_frames: list[ScanFrame], info: ScanInfo) -> None:
    main = [scan_frame for scan_frame in scan_frames if is_main(scan_frame, info)]
    found = {(s.pattern, s.repeat) for s in main if s.pattern is not None}
    lit = sum(s.pattern is not None for s in main)
    count = info.patterns.count
    wanted = count * info.repeats
    if lit != len(found):
        raise DataError(f"{path} lists {lit - len(found)} images twice; one line a pattern and repeat")
    if len(found) != wanted:
        every = ((k, r) for r in range(info.repeats) for k in range(count))
        pattern, repeat = next(pair for pair in every if pair not in found)
        raise DataError(
            f"{path} lists {len(found)} images of patterns, {info.pattern} on {info.plane.height} x "
            f"{info.plane.width} cells needs {count} x {info.repeats} repeats = {wanted}; the first missing is "
            f"pattern {pattern} of repeat {repeat}: record it, or correct scan.yaml"
        )
    dark = {s.repeat for s in main if s.pattern is None}
    if len(dark) != info.repeats:
        missing = min(set(range(info.repeats)) - dark)
        raise DataError(f"{path} lists no dark frame of repeat {missing}; record one with the display black")
