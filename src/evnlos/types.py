"""Types that every stage shares: event streams, sampled planes, and seeds derived by name.

- Every random draw comes from a seed that is derived, by name, from the one the user gave.
"""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from evnlos.errors import DataError

if TYPE_CHECKING:
    import torch

OutFolder = Path
"""Type of a command's `out`: a folder that it makes, with the folders above it, or goes on with."""
OutFile = Path
"""The same: a file."""
OutImage = Path
"""The same: a file whose ending names a format of images."""

Evidence = Literal["frames", "events", "both"]  # what an estimate is made of
Colour = Literal["red", "green", "blue"]
COLOURS: tuple[Colour, ...] = ("red", "green", "blue")
"""Colours in the order of an image's channels."""
LUMA_601 = 299, 587, 114
"""What red, green and blue count in grey, thousandths: Rec. 601, as Pillow, OpenCV and v2e take it."""
Mosaic = Literal["rggb", "grbg", "gbrg", "bggr"]
"""Bayer's mosaic of colour filters: two pixels of the first row, then of the second, from the top left."""

_MAX_SIDE = 65_536  # x and y are uint16


def _column(values: ArrayLike, name: str, dtype: type, low: int, high: int) -> NDArray:
    """Return `values` as a contiguous 1-D column of `dtype`, refusing values outside [low, high]."""
    array = np.asarray(values)
    if array.ndim != 1:
        raise DataError(f"Events.{name} has {array.ndim} dimensions; give a 1-D column")
    if array.dtype.kind not in "iub" and array.size:
        raise DataError(f"Events.{name} has dtype {array.dtype}; give integers")
    if array.dtype != dtype and array.size:
        smallest, largest = int(array.min()), int(array.max())
        if smallest < low or largest > high:
            worst = smallest if smallest < low else largest
            raise DataError(f"Events.{name} holds {worst}, outside {low}..{high}")
    return np.ascontiguousarray(array, dtype=dtype)


def _polarity(values: ArrayLike) -> NDArray[np.bool_]:
    """Return polarities as bool; True, 1 and +1 are brighter, False, 0 and -1 darker."""
    array = np.asarray(values)
    if array.ndim != 1:
        raise DataError(f"Events.p has {array.ndim} dimensions; give a 1-D column")
    if array.dtype == np.bool_ or not array.size:
        return np.ascontiguousarray(array, dtype=np.bool_)
    wrong = (array != 1) & (array != 0) & (array != -1)
    if wrong.any():
        raise DataError(f"Events.p holds {array[wrong][0]}; a polarity is bool, 0/1 or -1/+1")
    return np.ascontiguousarray(array > 0)


@dataclass(frozen=True, eq=False)
class Events:
    """A stream of events in the order of time, as contiguous columns.

    Args:
        t_us: Times, int64 [N], microseconds, non-decreasing.
        x: Columns, uint16 [N], 0 on the left, below `width`.
        y: Rows, uint16 [N], 0 on top, below `height`.
        p: Polarities, bool [N], True = brighter (0/1 and -1/+1 are converted).
        width: Sensor width, pixels.
        height: Sensor height, pixels.
        adc: Optional intensity that came with each event, uint16 [N], digital numbers (CeleX EI mode).
        polarity_known: Optional bool [N]; False where the camera gave no polarity (`p` is False there).

    Raises:
        DataError: Columns of unequal length, coordinates outside the sensor, or times that run backwards.

    Example:
        >>> events = Events([10, 20], [0, 3], [1, 1], [True, False], width=4, height=2)
        >>> len(events), events.duration_us
        (2, 10)
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    width: int
    height: int
    adc: NDArray[np.uint16] | None = field(default=None, kw_only=True)
    polarity_known: NDArray[np.bool_] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for name, side in (("width", self.width), ("height", self.height)):
            if not 1 <= int(side) <= _MAX_SIDE:
                raise DataError(f"Events.{name} is {side}; give 1 to {_MAX_SIDE} pixels")
            object.__setattr__(self, name, int(side))
        put = object.__setattr__
        put(self, "t_us", _column(self.t_us, "t_us", np.int64, -(2**63), 2**63 - 1))
        put(self, "x", _column(self.x, "x", np.uint16, 0, _MAX_SIDE - 1))
        put(self, "y", _column(self.y, "y", np.uint16, 0, _MAX_SIDE - 1))
        put(self, "p", _polarity(self.p))
        if self.adc is not None:
            put(self, "adc", _column(self.adc, "adc", np.uint16, 0, _MAX_SIDE - 1))
        if self.polarity_known is not None:
            put(self, "polarity_known", _polarity(self.polarity_known))
        self._check()

    def _check(self) -> None:
        count = len(self.t_us)
        for name, column in self.columns().items():
            if len(column) != count:
                raise DataError(f"Events.{name} has {len(column)} entries, t_us has {count}; make them equal")
        if not count:
            return
        if int(self.x.max()) >= self.width:
            raise DataError(f"Events.x holds {int(self.x.max())}; the sensor is {self.width} pixels wide")
        if int(self.y.max()) >= self.height:
            raise DataError(f"Events.y holds {int(self.y.max())}; the sensor is {self.height} pixels high")
        backwards = np.flatnonzero(self.t_us[1:] < self.t_us[:-1])
        if len(backwards):
            i = int(backwards[0])
            raise DataError(
                f"Events.t_us runs backwards at event {i + 1}: {int(self.t_us[i + 1])} us after "
                f"{int(self.t_us[i])} us; sort the events by time first"
            )

    def columns(self) -> dict[str, NDArray]:
        """Return the columns that are present, by name."""
        named = {"t_us": self.t_us, "x": self.x, "y": self.y, "p": self.p}
        if self.adc is not None:
            named["adc"] = self.adc
        if self.polarity_known is not None:
            named["polarity_known"] = self.polarity_known
        return named

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, index: slice | NDArray) -> Events:
        """Return the events that a slice, a boolean mask or ascending indices select."""
        if isinstance(index, (int, np.integer)):
            raise DataError(f"Events[{index}] is one event; give a slice, a mask or an array of indices")
        chosen = {name: column[index] for name, column in self.columns().items()}
        return Events(width=self.width, height=self.height, **chosen)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray:
        """Return the events as one structured array with a field for each column: t_us, x, y, p, ...

        Args:
            dtype: Type to cast the array to, as in `np.asarray`.
            copy: False is refused: the columns lie apart in memory.

        Raises:
            ValueError: `copy` is False.
        """
        if copy is False:
            raise ValueError("the columns of Events lie apart; an array of them is a copy")
        columns = self.columns()
        found = np.empty(len(self), [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            found[name] = column
        return found if dtype is None else found.astype(dtype)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Events):
            return NotImplemented
        columns, others = self.columns(), other.columns()
        same_shape = (self.width, self.height) == (
            other.width,
            other.height,
        ) and columns.keys() == others.keys()
        return same_shape and all(np.array_equal(columns[name], others[name]) for name in columns)

    def __repr__(self) -> str:
        if not len(self):
            return f"Events(0 events, {self.width} x {self.height})"
        on = 100.0 * float(self.p.mean())
        return (
            f"Events({len(self):,} events, {self.width} x {self.height}, "
            f"{int(self.t_us[0]):,}..{int(self.t_us[-1]):,} us, {on:.0f} % ON)"
        )

    @property
    def duration_us(self) -> int:
        """Time from the first to the last event, microseconds; 0 without events."""
        return int(self.t_us[-1]) - int(self.t_us[0]) if len(self) else 0

    @property
    def shape(self) -> tuple[int, int]:
        """Sensor size as (height, width), pixels."""
        return self.height, self.width

    def between(self, start_us: int, stop_us: int) -> Events:
        """Return the events with start_us < t_us <= stop_us, the half-open interval of the position grids."""
        first, last = np.searchsorted(self.t_us, [start_us, stop_us], side="right")
        return self[int(first) : int(last)]

    @classmethod
    def concatenate(cls, parts: Sequence[Events]) -> Events:
        """Return streams of one sensor that follow each other in time as one.

        Raises:
            DataError: No part, parts of several sensors or with different columns, or times that run backwards.

        Example:
            >>> events = Events([10, 20], [0, 3], [1, 1], [True, False], width=4, height=2)
            >>> Events.concatenate([events[:1], events[1:]]) == events
            True
        """
        if not parts:
            raise DataError("no events to concatenate; give at least one part")
        kinds = {(part.width, part.height, tuple(part.columns())) for part in parts}
        if len(kinds) > 1:
            raise DataError(f"parts differ in sensor or columns: {sorted(kinds)}; concatenate one kind")
        names = parts[0].columns()
        columns = {name: np.concatenate([part.columns()[name] for part in parts]) for name in names}
        return cls(width=parts[0].width, height=parts[0].height, **columns)

    def to_tonic(self) -> NDArray:
        """Return the events as tonic's transforms take them: a structured array with the fields x, y, t, p."""
        found = np.empty(len(self), [("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
        found["x"], found["y"], found["t"], found["p"] = self.x, self.y, self.t_us, self.p
        return found

    @classmethod
    def from_tonic(cls, array: NDArray, sensor_size: tuple[int, ...]) -> Events:
        """Return the events of tonic's structured array.

        Args:
            array: Fields x, y, t (microseconds, ascending) and p.
            sensor_size: tonic's (width, height, polarities), or (width, height).

        Raises:
            DataError: A field is missing, or the values are no stream of this sensor.

        Example:
            >>> events = Events([10, 20], [0, 3], [1, 1], [True, False], width=4, height=2)
            >>> Events.from_tonic(events.to_tonic(), (4, 2, 2)) == events
            True
        """
        if missing := {"x", "y", "t", "p"} - set(array.dtype.names or ()):
            raise DataError(f"the array has no field {', '.join(sorted(missing))}; give x, y, t and p")
        return cls(array["t"], array["x"], array["y"], array["p"], sensor_size[0], sensor_size[1])

    @classmethod
    def _trusted(cls, columns: dict[str, NDArray], width: int, height: int) -> Events:
        """Return events of columns that a decoder has checked already; a second check costs as much again."""
        events = object.__new__(cls)
        vars(events).update(adc=None, polarity_known=None, width=width, height=height)
        vars(events).update(columns)
        return events

    @classmethod
    def empty(cls, width: int, height: int) -> Events:
        """Return a stream without events for a sensor of `width` x `height` pixels."""
        place = np.zeros(0, np.uint16)
        return cls(np.zeros(0, np.int64), place, place, np.zeros(0, np.bool_), width, height)


@dataclass(frozen=True)
class Plane:
    """A plane sampled on a square grid: row 0 on top, x to the right, y downwards.

    Args:
        height: Number of rows.
        width: Number of columns.
        pitch_m: Distance between sample centres, metres.
        center_m: Coordinates (x, y) of the middle of the grid, metres.

    Raises:
        DataError: A side below 1 sample or a pitch that is not positive and finite.

    Example:
        >>> Plane(64, 96, 0.0025).extent_m
        (0.16, 0.24)
    """

    height: int
    width: int
    pitch_m: float
    center_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise DataError(f"Plane is {self.height} x {self.width} samples; each side needs at least 1")
        if not (np.isfinite(self.pitch_m) and self.pitch_m > 0):
            raise DataError(f"Plane.pitch_m is {self.pitch_m}; give a positive number of metres")

    @property
    def shape(self) -> tuple[int, int]:
        """Grid size (rows, columns)."""
        return self.height, self.width

    @property
    def extent_m(self) -> tuple[float, float]:
        """Physical size (height, width), metres, from outer edge to outer edge."""
        return self.height * self.pitch_m, self.width * self.pitch_m

    @property
    def x_m(self) -> NDArray[np.float64]:
        """Horizontal coordinate of each column's centre, float64 [W], metres."""
        columns = np.arange(self.width, dtype=np.float64) - (self.width - 1) / 2
        return self.center_m[0] + columns * self.pitch_m

    @property
    def y_m(self) -> NDArray[np.float64]:
        """Vertical coordinate (downwards) of each row's centre, float64 [H], metres."""
        rows = np.arange(self.height, dtype=np.float64) - (self.height - 1) / 2
        return self.center_m[1] + rows * self.pitch_m


_USUAL_SIDE_M = 0.08


def target_side_m(canvas: Plane) -> float:
    """Return the side of the target plane that a canvas is made for, metres.

    On canvases of up to 25 cm across it is the usual 8 cm; on larger ones a third of their width.

    Example:
        >>> target_side_m(Plane(64, 96, 0.0025)), round(target_side_m(Plane(64, 96, 0.00375)), 6)
        (0.08, 0.12)
    """
    across = canvas.extent_m[1]
    return _USUAL_SIDE_M if across <= 0.25 else across / 3


def length_text(length: float, unit: str = "m", digits: int = 2) -> str:
    """Return a length in words: metres as mm, from 1 m on as m; another unit as it is.

    Example:
        >>> length_text(0.15979), length_text(1.5979), length_text(3.25, "px", 1)
        ('159.79 mm', '1.598 m', '3.2 px')
    """
    if unit == "m":
        return f"{length:.{digits + 1}f} m" if abs(length) >= 0.9999 else f"{1e3 * length:.{digits}f} mm"
    return f"{length:.{digits}f} {unit}"


def aligned(cells: list[list[str]]) -> str:
    """Return the rows of a table as text whose columns, all of the first row's, stand below each other."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in cells)


def matching_paths(given: Iterable[str | Path]) -> list[Path]:
    """Return paths in which a pattern, such as captures/*, stands for what it matches, as most shells have it.

    Args:
        given: Paths and patterns; what is there is no pattern, and a pattern that matches nothing stays.
    """
    found: list[Path] = []
    for word in given:
        is_pattern = glob.has_magic(str(word)) and not Path(word).exists()
        matches = sorted(glob.glob(str(word))) if is_pattern else []  # noqa: PTH207 - it may be absolute
        found += map(Path, matches or [word])
    return found


def derive_seed(seed: int, *names: str | int) -> int:
    """Return a seed in 0..2^63 - 1 for the named purpose; other names give independent seeds.

    Example:
        >>> derive_seed(0, "writer03_A", "events") == derive_seed(0, "writer03_A", "frames")
        False
    """
    text = "\x1f".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


@runtime_checkable
class Irradiance(Protocol):
    """The camera's image of the wall at every instant, before the sensor: no noise, no rounding."""

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        ...

    @property
    def speed_px_s(self) -> float:
        """Upper bound of the speed of the image on the sensor, pixels per second."""
        ...

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return the irradiance at times `t_s` (seconds, shape [] or [T]), float32 [H, W] or [T, H, W].

        The unit is the camera's white level (1.0 = 255 DN); gain and ambient light are included.
        """
        ...
