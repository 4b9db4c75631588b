"""The intensities that some cameras send with their events, as a picture."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.events.grids import as_edges
from evnlos.types import Events


@njit(cache=True)
def _hold(x, y, adc, starts, peak, carry, empty, out):
    first = 0 if carry else starts[0]
    for grid in range(len(out)):
        if grid and carry:
            out[grid] = out[grid - 1]
        else:
            out[grid] = empty
        if not carry:
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            out[grid, y[index], x[index]] = np.float32(adc[index]) / peak
        first = starts[grid + 1]


def intensity_map(
    events: Events,
    edges_us: ArrayLike | None = None,
    *,
    peak: int = 4095,
    carry: bool = True,
    empty: float = 0.0,
) -> NDArray[np.float32]:
    """Return the last intensity of each pixel: the picture that a CeleX-V in EI mode sends along with its
    events.

    Args:
        events: A stream with the column `adc`; it is not changed.
        edges_us: Edges of the grids, [grids + 1], microseconds; one grid of all events without them.
        peak: Digital number that becomes 1: 4095 for 12 bits, 255 for event format 0.
        carry: Whether a pixel keeps its value from grid to grid, and that of events before the first edge.
        empty: Value of a pixel that has sent none yet; NaN tells it from black.

    Returns:
        float32 [grids, H, W], 0..1, at the instants edges_us[g + 1].

    Raises:
        DataError: The events have no intensities, the edges do not ascend, or the peak is not positive.

    Example:
        >>> events = Events([5, 6, 9], [0, 0, 1], [0, 0, 0], [0, 1, 0], 2, 1, adc=[819, 4095, 0])
        >>> intensity_map(events, [0, 5, 9], empty=0.5).tolist()
        [[[0.20000000298023224, 0.5]], [[1.0, 0.0]]]
    """
    if events.adc is None:
        raise DataError("these events have no intensities (adc); record in the mode EI, or use time_surface")
    if peak < 1:
        raise DataError(f"peak is {peak}; give the largest digital number, such as 4095")
    if edges_us is None:
        starts = np.array([0, len(events)], np.int64)
    else:
        starts = np.searchsorted(events.t_us, as_edges(edges_us), side="right")
    out = np.empty((len(starts) - 1, events.height, events.width), np.float32)
    _hold(events.x, events.y, events.adc, starts, np.float32(peak), carry, np.float32(empty), out)
    return out
