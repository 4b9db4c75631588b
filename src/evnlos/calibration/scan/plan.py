"""How long a scan takes, and how noisy its matrix will be, before a display is mounted.

- A scan planned: `scan.yaml`, the table of images to take, and what to show for each of them.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.calibration.scan.folder import (
    SCAN_FILE,
    Pattern,
    Patterns,
    ScanFrame,
    ScanInfo,
    displayed,
    lit_cells,
    measured_cells,
    write_scan_frames,
)
from evnlos.calibration.scan.show import SHOW_FILE, Show, ShowInfo, show_images, show_page
from evnlos.cameras.video_files import write_video
from evnlos.config import save_yaml
from evnlos.errors import ConfigError
from evnlos.files import new_folder
from evnlos.machine import Progress, Step, silent
from evnlos.types import Plane, derive_seed


@dataclass(frozen=True)
class ScanCamera:
    """What decides the noise of a scan; a guess within a factor of two will do."""

    full_level: float = 0.8
    """White levels of the brightest pixel, less the dark, while the whole plane is lit at this exposure."""
    lobe_m: float | None = None
    """Width of the part of the plane whose light one pixel receives, metres; none = all of it (matte wall)."""
    full_well_e: float = 15_000.0
    """Electrons at white."""
    read_noise_e: float = 6.0
    """Standard deviation of the read noise, electrons."""
    bit_depth: int = 8
    """Bits a pixel, 8 to 16."""

    def __post_init__(self) -> None:
        if not 0 < self.full_level <= 10:
            raise ConfigError(f"full_level is {self.full_level}; give more than 0 and at most 10 white levels")
        if self.lobe_m is not None and not self.lobe_m > 0:
            raise ConfigError(f"lobe_m is {self.lobe_m}; give a positive number of metres")
        if not self.full_well_e > 0 or not self.read_noise_e >= 0:
            given = f"full_well_e is {self.full_well_e}, read_noise_e {self.read_noise_e}"
            raise ConfigError(f"{given}; give a positive number of electrons, and 0 or more")
        if not 8 <= self.bit_depth <= 16:
            raise ConfigError(f"bit_depth is {self.bit_depth}; give 8 to 16 bits")


@dataclass(frozen=True)
class ScanEstimate:
    """What a scan will cost and give.

    Args:
        scan_frames: Images, dark frames and linearity check included.
        seconds: Time for them.
        cell_level: White levels of the brightest entry of the matrix.
        noise: Standard deviation of an entry of the brightest pixel over the brightest entry; others have less.
        other: The other pattern, raster or hadamard, with the same exposure and repeats.
        other_noise: Its noise over the brightest entry.
        notes: What to change.
    """

    scan_frames: int
    seconds: float
    cell_level: float
    noise: float
    other: Pattern
    other_noise: float
    notes: tuple[str, ...]


def estimate_scan(
    patterns: Patterns,
    camera: ScanCamera,
    pitch_m: float,
    repeats: int,
    scan_frames: int,
    darks: int,
    seconds_per_frame: float,
) -> ScanEstimate:
    """Return time and noise of a scan.

    A frame's variance is E / N + (r / N)^2 + q^2 / 12 at light E (white levels), N the full well, r the read
    noise, q a digital number. A raster's frame has the light of one cell, a Hadamard frame half of the whole
    plane's; the noise of an entry follows from `Patterns.noise_factor`.

    Args:
        patterns: What is shown.
        camera: Light and noise.
        pitch_m: Side of a cell, metres.
        repeats: How often.
        scan_frames: Number of images.
        darks: Number of dark frames among them.
        seconds_per_frame: Exposure and what passes between two images, seconds.

    Example:
        >>> camera = ScanCamera(full_level=0.8, full_well_e=1e9, read_noise_e=1e6, bit_depth=16)
        >>> found = estimate_scan(Patterns("hadamard", 787), camera, 0.01, 2, 3200, 1600, 0.1)
        >>> round(found.other_noise / found.noise, 1)  # dark frames known, (q + 1) / (2 sqrt q) = 14.05
        14.1
    """
    cell = camera.full_level / effective_cells(patterns.cells, camera.lobe_m, pitch_m)
    kinds: dict[str, tuple[Patterns, float]] = {
        "raster": (Patterns("raster", patterns.cells), cell),
        "hadamard": (Patterns("hadamard", patterns.cells), camera.full_level / 2),
    }
    own = "hadamard" if patterns.kind == "hadamard" else "raster"
    other: Pattern = "raster" if own == "hadamard" else "hadamard"
    noise = {name: _noise(one, light, camera, repeats, darks) / cell for name, (one, light) in kinds.items()}
    notes, step = [], 1 / (2**camera.bit_depth - 1)
    if own == "raster" and cell < 2 * step:
        notes.append(
            f"one cell moves the brightest pixel by {cell / step:.2f} digital numbers: rounding will distort "
            "it; "
            "take hadamard patterns, more bits, a longer exposure or larger cells"
        )
    if noise[other] < noise[own] / 1.5:
        notes.append(f"{other} patterns would have {noise[own] / noise[other]:.1f} times less noise")
    if noise[own] > 0.1:
        need = math.ceil(repeats * (noise[own] / 0.1) ** 2)
        notes.append(
            f"for a noise of 0.1 of the brightest entry: {need} repeats, or more light or larger cells"
        )
    light = kinds[own][1]
    if light > 0.95:
        notes.append(f"a pattern's brightest pixel reaches {light:.2f} white levels; shorten the exposure")
    return ScanEstimate(
        scan_frames, scan_frames * seconds_per_frame, cell, noise[own], other, noise[other], tuple(notes)
    )


def effective_cells(cells: int, lobe_m: float | None, pitch_m: float) -> float:
    """Return how many cells' light adds up in a pixel when all are lit: a disc of width `lobe_m`."""
    return (
        float(cells) if lobe_m is None else min(float(cells), max(1.0, math.pi / 4 * (lobe_m / pitch_m) ** 2))
    )


def _noise(patterns: Patterns, light: float, camera: ScanCamera, repeats: int, darks: int) -> float:
    """Return the standard deviation of an entry, white levels."""
    step = 1 / (2**camera.bit_depth - 1)
    dark = (camera.read_noise_e / camera.full_well_e) ** 2 + step**2 / 12
    lit = dark + light / camera.full_well_e
    return math.sqrt(
        lit / repeats * patterns.noise_factor**2 + dark / max(darks, 1) * patterns.offset_factor**2
    )


_CHECKS = 4
_MOST_DISPLAY = 16_384
_SHOWN_HZ = 20.0  # of a show as a video


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
    """Width and height of the display, pixels; none = a moving LED (places.csv) or one image pixel per cell.
    """
    display_pitch: float = 0.00027
    """Side of a display pixel, metres."""
    repeats: int = 2
    """How often every pattern is recorded; 2 or more tell the noise."""
    exposure_s: float = 0.05
    """Exposure of a frame, seconds."""
    overhead_s: float = 0.1
    """Time between two images besides the exposure, seconds (an LED on a stage: how long a move takes)."""
    dark_every: int | None = None
    """A dark frame before every so many images, and one at the end of each repeat; none = 64 for hadamard, 4
    else: all cells of a raster share the error of the dark frame, and it adds up where many of them shine."""
    show: Literal["pictures", "page", "video"] = "pictures"
    """images: one file a pattern, for a camera that takes images. page or video: the whole scan as one show
    on the display, to be filmed (`import --film`)."""
    hold_s: float = 0.5
    """page, video: how long a pattern stands, seconds."""
    targets: str = ""
    """page, video: characters that move over the plane after the scan, e.g. RK."""
    target_m: float = 0.06
    """page, video: side of such a character's square, metres."""
    speed_m_s: float = 0.02
    """page, video: its speed, metres per second."""
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
                raise ConfigError(f"display is {self.display}; give 1 to {_MOST_DISPLAY} pixels per side")
            needed = [round(n * self.pitch / self.display_pitch) for n in reversed(self.cells.shape)]
            if self.pitch < self.display_pitch or needed[0] > self.display[0] or needed[1] > self.display[1]:
                raise ConfigError(
                    f"the plane takes {needed[0]} x {needed[1]} display pixels of {self.display_pitch:g} m, "
                    "the display "
                    f"has {self.display[0]} x {self.display[1]}; scan a smaller plane, or a pitch of a pixel "
                    "or more"
                )
        self.info()  # refuses what a scan.yaml could not hold
        if self.show != "pictures":
            if self.display is None:
                raise ConfigError(f"show is {self.show}, and no display is stated; give --display WIDTH HEIGHT")
            _ = self.as_show()
        elif self.targets:
            raise ConfigError(
                f"targets is {self.targets!r}; characters move in a show: give --show page or video"
            )

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

    def scan_frames(self) -> list[ScanFrame]:
        """Return the images in the order in which to take them."""
        count, found = self.info().patterns.count, []
        every = self.dark_every or (64 if self.pattern == "hadamard" else 4)
        for repeat in range(self.repeats):
            # A film's exposure and place drift: in another order each time, what drifts is told from patterns.
            mixed = np.random.default_rng(derive_seed(repeat, "order")).permutation(count).tolist()
            for number, k in enumerate(range(count) if self.show == "pictures" else mixed):
                if number % every == 0:
                    found.append((None, repeat, self.exposure_s))
                found.append((k, repeat, self.exposure_s))
            found.append((None, repeat, self.exposure_s))
        # Half of the exposure tells whether the camera is linear; cells near the middle are bright.
        half = self.exposure_s / 2
        middle = self.cells.height // 2 * self.cells.width + self.cells.width // 2
        checks = [0] if self.pattern == "points" else sorted({max(0, middle - k) for k in range(_CHECKS)})
        if self.show == "pictures":  # a phone keeps its exposure, and the show has a check of its own
            found += [(None, 0, half), *((k, 0, half) for k in checks)]
        return [ScanFrame(p, r, e, f"frames/{number:05d}.png") for number, (p, r, e) in enumerate(found)]

    def as_show(self) -> Show:
        """Return the scan as what a display shows."""
        times = ShowInfo(
            self.hold_s,
            targets=self.targets,
            target_m=self.target_m,
            speed_m_s=self.speed_m_s,
            display=self.display,
            display_pitch=self.display_pitch,
        )
        return Show(self.info(), tuple(self.scan_frames()), times)

    def estimate(self) -> ScanEstimate:
        """Return time and noise of the scan."""
        scan_frames = self.scan_frames()
        darks = sum(scan_frame.pattern is None for scan_frame in scan_frames) - (self.show == "pictures")
        seconds = self.exposure_s + self.overhead_s
        if self.show != "pictures":
            seconds = self.as_show().duration_s / len(scan_frames)
        return estimate_scan(
            self.info().patterns,
            self.camera,
            self.pitch,
            self.repeats,
            len(scan_frames),
            darks,
            seconds,
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
    """Write a scan's folder and return its files: scan.yaml, frames.csv, and what to show.

    That is places.csv for a lamp, patterns/*.png for a display, or show.yaml with show.html or show.mp4.

    The folder gets its name when the last is written.

    Args:
        plan: The plan.
        folder: A new or empty folder.
        progress: Called when the work begins and after each file, with its path.

    Raises:
        DataError: The folder holds something already.
    """
    folder = Path(folder)
    info, scan_frames = plan.info(), plan.scan_frames()
    shows_places = plan.display is None and plan.pattern != "hadamard"
    one_file = shows_places or plan.show != "pictures"
    total, written = 3 + (plan.show != "pictures") if one_file else info.patterns.count + 2, list[Path]()

    def wrote(path: Path) -> None:
        written.append(path)
        progress(Step("plan", len(written), total, "files", path))

    progress(Step("plan", 0, total, "files"))
    with new_folder(folder) as draft:
        (draft / "frames").mkdir()
        write_scan_frames(draft / info.frames, scan_frames)
        wrote(folder / info.frames)
        if plan.show != "pictures":
            show = plan.as_show()
            save_yaml(show.show, draft / SHOW_FILE)
            wrote(folder / SHOW_FILE)
            if plan.show == "page":
                (draft / "show.html").write_text(show_page(show), encoding="utf-8")
                wrote(folder / "show.html")
            else:
                _write_show(draft / "show.mp4", show, progress)
                wrote(folder / "show.mp4")
        elif shows_places:
            _write_places(draft / "places.csv", info.plane, measured_cells(info))
            wrote(folder / "places.csv")
        else:
            (draft / "patterns").mkdir()
            for k in (None, *range(info.patterns.count)):
                name = "patterns/dark.png" if k is None else f"patterns/{k:05d}.png"
                lit = np.zeros(info.plane.shape, np.bool_) if k is None else lit_cells(info, k)
                if plan.display is not None:  # otherwise one pixel per cell
                    lit = displayed(lit, info.plane, plan.display, plan.display_pitch) > 0
                Image.fromarray(lit.astype(np.uint8) * 255).convert("1").save(draft / name)
                if k is not None:
                    wrote(folder / name)
        save_yaml(info, draft / SCAN_FILE)
        wrote(folder / SCAN_FILE)
    return written


def _write_show(path: Path, show: Show, progress: Progress) -> None:
    total = math.ceil(show.duration_s * _SHOWN_HZ)

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for number, picture in enumerate(show_images(show, _SHOWN_HZ)):
            if number % 20 == 0:
                progress(Step("draw show", number, total, "frames"))
            yield picture

    write_video(path, pictures(), _SHOWN_HZ, 12, "ultrafast")


def _write_places(path: Path, plane: Plane, cells: NDArray[np.int64]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("pattern", "x_m", "y_m"))
        for number, cell in enumerate(cells):
            row, column = divmod(int(cell), plane.width)
            table.writerow((number, f"{plane.x_m[column]:.6f}", f"{plane.y_m[row]:.6f}"))
