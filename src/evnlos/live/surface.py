"""The time surface as a state that events change, in place of a map computed from all events anew."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.events import _surface_kernels as kernels
from evnlos.types import Events

_NEVER = -1
_NO_TIMES, _NO_PLACES, _NO_SIGNS = np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.bool_)
_NO_STARTS = np.zeros(2, np.int64)


@njit(cache=True)
def _remember(t_us, x, y, p, origin, newest):
    """Write the time of each event over that of its pixel and polarity; times ascend, so the last one stays."""
    height, width = newest.shape[1], newest.shape[2]
    flat = newest.reshape(-1)
    off = np.uint32(height * width)
    for index in range(len(t_us)):
        pixel = np.uint32(y[index]) * np.uint32(width) + np.uint32(x[index])
        flat[pixel + (np.uint32(0) if p[index] else off)] = t_us[index] - origin


class RunningSurface:
    """The surface of active events ("sae") of a stream so far, at any instant from its newest event on.

    It equals `time_surface(all events, [begin, t_us], tau_us)` bit for bit; an event costs one write, a map one
    exponential a pixel.

    Args:
        height: Sensor height, pixels.
        width: Sensor width, pixels.
        tau_us: Time constant, microseconds, above 0.

    Raises:
        DataError: The time constant is not positive.

    Example:
        >>> surface = RunningSurface(1, 2, tau_us=5.0)
        >>> surface.add(Events([5, 10], [0, 1], [0, 0], [True, False], width=2, height=1))
        >>> surface.at(10).round(3).tolist()
        [[[0.36800000071525574, 0.0]], [[0.0, 1.0]]]
    """

    def __init__(self, height: int, width: int, tau_us: float) -> None:
        if not (np.isfinite(tau_us) and tau_us > 0):
            raise DataError(f"tau_us is {tau_us}; give a positive number of microseconds")
        self.shape, self.tau_us = (height, width), float(tau_us)
        self._times = np.full((2, height, width), _NEVER, np.int64)
        self._origin: int | None = None
        self._newest = 0

    def add(self, events: Events) -> None:
        """Take the next events of the stream.

        Raises:
            DataError: They are of another sensor, or begin before the newest event taken.
        """
        if events.shape != self.shape:
            raise DataError(
                f"events of {events.width} x {events.height} pixels after those of {self.shape[1]} x "
                f"{self.shape[0]}; give one sensor a stream"
            )
        if not len(events):
            return
        first = int(events.t_us[0])
        if self._origin is None:
            self._origin = self._newest = first
        if first < self._newest:
            raise DataError(f"events from {first} us after one at {self._newest} us; give them in order")
        _remember(events.t_us, events.x, events.y, events.p, self._origin, self._times)
        self._newest = int(events.t_us[-1])

    def at(self, t_us: int) -> NDArray[np.float32]:
        """Return the surface at an instant, float32 [2, H, W], 0..1: ON, OFF.

        Raises:
            DataError: The instant is before the newest event taken.
        """
        out = np.zeros((1, 2, *self.shape), np.float32)
        if self._origin is None:
            return out[0]
        if t_us < self._newest:
            raise DataError(f"a surface at {t_us} us, with an event at {self._newest} us; ask for a later one")
        edges = np.array([t_us, t_us], np.int64)
        columns = (_NO_TIMES, _NO_PLACES, _NO_PLACES, _NO_SIGNS)
        kernels.sae(*columns, edges, _NO_STARTS, self.tau_us, True, self._times, _NEVER, self._origin, out)
        return out[0]
