"""Time grids and colours: what every representation of events is made on.

- Edges of the time grids that a representation is made on: grid g holds edges[g] < t_us <= edges[g + 1].

The two colours of events, for every picture and page of the project.

Told apart with every common kind of colour blindness, and in grey print: fully opaque, ON is lighter than OFF
by 50 of 255 or more. Each stands out from white and from the dark grounds that are drawn on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.types import Events


def as_edges(edges_us: ArrayLike) -> NDArray[np.int64]:
    """Return edges as int64 [grids + 1], microseconds.

    Raises:
        DataError: Fewer than two edges, edges that are not whole microseconds, or that do not ascend.
    """
    given = np.asarray(edges_us)
    if given.ndim != 1 or len(given) < 2:
        raise DataError(f"edges_us has shape {given.shape}; give at least two edges in one row")
    if given.dtype.kind == "f":
        if not np.isfinite(given).all() or (given != np.round(given)).any():
            raise DataError("edges_us holds fractions or NaN; give whole microseconds")
    elif given.dtype.kind not in "iu":
        raise DataError(f"edges_us has dtype {given.dtype}; give whole microseconds")
    edges = given.astype(np.int64)
    backwards = np.flatnonzero(edges[1:] <= edges[:-1])
    if len(backwards):
        at = int(backwards[0])
        raise DataError(f"edges_us goes from {edges[at]} to {edges[at + 1]} us; edges must ascend")
    return edges


def edges_from_rate(start_us: int, stop_us: int, rate_hz: float) -> NDArray[np.int64]:
    """Return edges every 1 / `rate_hz` seconds from `start_us` to the last that does not pass `stop_us`.

    Args:
        start_us: First edge, microseconds.
        stop_us: End, microseconds, after the start.
        rate_hz: Grids a second, above 0 and at most 1e6.

    Raises:
        DataError: The rate is out of its range or not one grid fits.

    Example:
        >>> edges_from_rate(0, 1_000_000, 3.0)
        array([      0,  333333,  666667, 1000000])
    """
    if not 0 < rate_hz <= 1e6:
        raise DataError(f"rate_hz is {rate_hz}; give more than 0 and at most 1e6 grids a second")
    grids = int((stop_us - start_us) * rate_hz / 1e6 + 1e-9)
    if grids < 1:
        raise DataError(f"no grid of {1e6 / rate_hz:.0f} us fits {start_us}..{stop_us} us; raise the rate")
    return start_us + np.round(np.arange(grids + 1) * (1e6 / rate_hz)).astype(np.int64)


def edges_from_count(events: Events, count: int) -> NDArray[np.int64]:
    """Return edges between which `count` events lie each; events of one time stay in one grid.

    Args:
        events: The stream, not empty.
        count: Events a grid, at least 1; the last grid may hold fewer.

    Raises:
        DataError: No events, or a count below 1.
    """
    if count < 1:
        raise DataError(f"count is {count}; give at least one event a grid")
    if not len(events):
        raise DataError("no events to divide into grids; give explicit edges")
    last_of_grid = events.t_us[count - 1 :: count]
    return np.unique(np.concatenate([[events.t_us[0] - 1], last_of_grid, events.t_us[-1:]]))


def suggest_tau_us(stroke_width_m: float, speed_m_s: float) -> float:
    """Return the time constant, microseconds, in which the target moves by the width of its stroke.

    A shorter one forgets the stroke's leading edge before its trailing edge arrives; a longer one blurs
    neighbouring positions.

    Args:
        stroke_width_m: Width of the strokes of the hidden target, metres, above 0.
        speed_m_s: Its speed, metres per second, above 0.

    Raises:
        DataError: A width or speed that is not positive.

    Example:
        >>> suggest_tau_us(0.008, 0.02)
        400000.0
    """
    if not (stroke_width_m > 0 and speed_m_s > 0):
        raise DataError(f"stroke {stroke_width_m} m at {speed_m_s} m/s; both must be positive")
    return stroke_width_m / speed_m_s * 1e6


ON_RGB = (226, 120, 0)
"""Colour of events that are brighter: orange."""
OFF_RGB = (32, 87, 228)
"""Colour of events that are darker: blue."""
ON_HEX, OFF_HEX = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (ON_RGB, OFF_RGB))
WORDS = "orange brighter, blue darker"
"""What a caption says of them."""
