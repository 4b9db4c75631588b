"""How long a scan takes, and how noisy its matrix will be, before a display is mounted."""

from __future__ import annotations

import math
from dataclasses import dataclass

from evnlos.calibration.scan.patterns import Pattern, Patterns
from evnlos.errors import ConfigError


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
            raise ConfigError(
                f"full_well_e is {self.full_well_e}, read_noise_e {self.read_noise_e}; give a positive number "
                "of "
                "electrons, and 0 or more"
            )
        if not 8 <= self.bit_depth <= 16:
            raise ConfigError(f"bit_depth is {self.bit_depth}; give 8 to 16 bits")


@dataclass(frozen=True)
class ScanEstimate:
    """What a scan will cost and give.

    Args:
        shots: Pictures, dark frames and linearity check included.
        seconds: Time for them.
        cell_level: White levels of the brightest entry of the matrix.
        noise: Standard deviation of an entry of the brightest pixel over the brightest entry; others have less.
        other: The other pattern, raster or hadamard, with the same exposure and repeats.
        other_noise: Its noise over the brightest entry.
        notes: What to change.
    """

    shots: int
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
    shots: int,
    darks: int,
    seconds_a_shot: float,
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
        shots: Number of pictures.
        darks: Number of dark frames among them.
        seconds_a_shot: Exposure and what passes between two pictures, seconds.

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
    return ScanEstimate(shots, shots * seconds_a_shot, cell, noise[own], other, noise[other], tuple(notes))


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
