"""Light on its way to an array of pixels, and checks of light and instants that come in from outside.

- Checks of the light and the instants that come in from outside.
- Light on its way to an array of pixels: whole frames, or strips that are rendered when they are needed.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import MIN_THRESHOLD
from evnlos.errors import ConfigError, DataError

_LIGHT_DTYPES = (np.uint8, np.float32, np.float64)


def check_light(frames: ArrayLike | torch.Tensor) -> NDArray:
    """Return a video as an array [T, H, W] of uint8, float32 or float64, refusing what is not light."""
    if isinstance(frames, torch.Tensor):
        frames = frames.detach().cpu().numpy()
    light = np.asarray(frames)
    if light.ndim != 3 or 0 in light.shape[1:]:
        raise DataError(f"frames has shape {light.shape}; give [T, H, W] with at least one pixel")
    if light.dtype.kind not in "uif" and light.dtype != np.bool_:
        raise DataError(f"frames has dtype {light.dtype}; give numbers, 255 = white")
    if light.dtype not in _LIGHT_DTYPES:
        light = light.astype(np.float32 if light.dtype == np.float16 else np.float64)
    if light.dtype != np.uint8 and light.size and not _is_light(light):
        lowest, highest = float(light.min()), float(light.max())
        if not (np.isfinite(lowest) and np.isfinite(highest)):
            raise DataError("frames holds NaN or infinity; light must be finite, 255 = white")
        if lowest < 0:
            raise DataError(f"frames holds {lowest:g}; light cannot be negative, black is 0")
    return light


def _is_light(light: NDArray) -> bool:
    """Return whether all numbers are finite and without a minus sign, by one pass over their bits."""
    word = np.uint32 if light.dtype == np.float32 else np.uint64
    return light.flags.c_contiguous and bool(light.view(word).max() < np.array(np.inf, light.dtype).view(word))


def check_times(times_s: ArrayLike | torch.Tensor, count: int, after_s: float = -np.inf) -> NDArray[np.float64]:
    """Return instants as float64 [T], refusing a wrong number, NaN, and times that do not ascend."""
    if isinstance(times_s, torch.Tensor):
        times_s = times_s.detach().cpu().numpy()
    try:
        times = np.asarray(times_s, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"times_s is not a list of numbers ({error}); give seconds") from None
    if times.shape != (count,):
        raise DataError(
            f"times_s has shape {times.shape} for {count} frames; give one time in seconds per frame"
        )
    if not np.isfinite(times).all():
        raise DataError("times_s holds NaN or infinity; give finite seconds")
    behind = np.flatnonzero(np.diff(times, prepend=after_s) <= 0)
    if len(behind):
        k = int(behind[0])
        before = times[k - 1] if k else after_s
        raise DataError(f"times_s[{k}] is {times[k]:.9g} s after {before:.9g} s; times must ascend")
    return times


def check_threshold_maps(thresholds: object, shape: tuple[int, int]) -> tuple[NDArray, NDArray]:
    """Return the threshold maps (on, off) as float64 [H, W], refusing other shapes and values below 0.01."""
    if not isinstance(thresholds, (tuple, list)) or len(thresholds) != 2:
        raise ConfigError("thresholds must be a pair (on, off) of maps [H, W] in log units, or None")
    maps = []
    for name, values in zip(("on", "off"), thresholds, strict=True):
        if isinstance(values, torch.Tensor):
            values = values.detach().cpu().numpy()
        field = np.asarray(values, dtype=np.float64)
        if field.shape != shape:
            raise ConfigError(
                f"thresholds[{name}] has shape {field.shape}; the sensor is {shape[0]} x {shape[1]}"
            )
        lowest = float(field.min())
        if not (np.isfinite(field).all() and lowest >= MIN_THRESHOLD * (1 - 1e-6)):
            raise ConfigError(f"thresholds[{name}] holds {lowest:g}; give at least {MIN_THRESHOLD} log units")
        maps.append(field)
    return maps[0], maps[1]


WHITE_DN = 255.0
"""The white level of a wall (irradiance 1.0) in the pixel's digital numbers."""

_STRIP_BYTES = 2 << 20  # of light at once: it is made and used while the cache still holds it


class Light(Protocol):
    """Light in DN at some instants [T], of which an array of pixels takes what it works on."""

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def __getitem__(self, instants: slice) -> Light:
        """Return the light at some of the instants."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers: uint8, float32 or float64."""
        ...

    @property
    def most_px(self) -> int | None:
        """How many pixels should be taken at once; None = any number."""
        ...

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return light [T, M] that holds the pixels first..last - 1, and which pixel its first column is."""
        ...


class Frames:
    """Light that is there as a whole.

    Args:
        rows: Light in DN, [T, H * W], checked.
    """

    most_px = None

    def __init__(self, rows: NDArray) -> None:
        self._rows = rows.view()
        self._rows.flags.writeable = False  # one type of input: the kernels compile once, not twice
        self.dtype = rows.dtype

    def __len__(self) -> int:
        """Number of instants."""
        return len(self._rows)

    def __getitem__(self, instants: slice) -> Frames:
        """Return the frames at some of the instants."""
        return Frames(self._rows[instants])

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return all frames."""
        return self._rows, 0


class ImageStrips(Protocol):
    """A wall's light at some instants, of which any pixels can be had without the others."""

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def __getitem__(self, instants: slice) -> ImageStrips:
        """Return the light at some of the instants."""
        ...

    def write(self, first: int, out: NDArray[np.float32], white: float) -> None:
        """Write the irradiance of the pixels first, first + 1, ... to `out` [T, N]; 1.0 becomes `white`."""
        ...


class StripLight:
    """Light that is rendered for the pixels that are requested, and forgotten.

    Args:
        strips: The wall's light.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, strips: ImageStrips) -> None:
        self._strips = strips
        self.most_px = max(1, _STRIP_BYTES // (4 * max(1, len(strips))))

    def __len__(self) -> int:
        """Number of instants."""
        return len(self._strips)

    def __getitem__(self, instants: slice) -> StripLight:
        """Return the light at some of the instants."""
        return StripLight(self._strips[instants])

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return the light of these pixels alone.

        Raises:
            DataError: The wall returned NaN or negative light.
        """
        light = np.empty((len(self._strips), last - first), np.float32)
        self._strips.write(first, light, WHITE_DN)
        check_light(light[None])
        light.flags.writeable = False
        return light, first
