"""Time surfaces: pictures of how recently, and in what company, each pixel saw its events."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.events import _surface_kernels as kernels
from evnlos.events.grids import as_edges
from evnlos.types import Events

Mode = Literal["sae", "context", "hots"]
Shape = Literal["box", "disc"]
Border = Literal["crop", "zero"]
Projection = Literal["sum", "last", "max"]

_PROJECTIONS = {"sum": kernels.SUM, "last": kernels.LAST, "max": kernels.MAX}


def _choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise DataError(f"{name} is {value!r}; give one of {', '.join(choices)}")


def check_surface(tau_us: float, radius: int, mode: str) -> None:
    """Refuse a time constant, a radius or a kind of surface outside its range."""
    if not (np.isfinite(tau_us) and tau_us > 0):
        raise DataError(f"tau_us is {tau_us}; give a positive number of microseconds")
    if not 0 <= radius <= 64 or int(radius) != radius:
        raise DataError(f"radius is {radius}; give 0 to 64 pixels")
    _choice("mode", mode, ("sae", "context", "hots"))


def _spans(radius: int, shape: str) -> NDArray[np.int64]:
    """Return the half width of each row of the neighbourhood, from its top to its bottom."""
    rows = np.arange(-radius, radius + 1)
    if shape == "box":
        return np.full(len(rows), radius, np.int64)
    return np.array([int(np.sqrt(radius**2 - row**2 + 1e-9)) for row in rows], np.int64)


def _time_map(events: Events, edges: NDArray[np.int64], margin: int) -> tuple[NDArray, int, int]:
    """Return an empty map of newest times, its mark for "never" and its zero; 32 bits where they suffice."""
    origin = int(min(events.t_us[0], edges[0])) if len(events) else int(edges[0])
    shape = (2, events.height + 2 * margin, events.width + 2 * margin)
    latest = int(max(events.t_us[-1], edges[-1])) if len(events) else int(edges[-1])
    dtype, never = (np.int32, -1) if latest - origin < 2**31 else (np.int64, -1)
    return np.full(shape, never, dtype), never, origin


def time_surface(
    events: Events,
    edges_us: ArrayLike,
    tau_us: float,
    mode: Mode = "sae",
    *,
    radius: int = 1,
    shape: Shape = "box",
    border: Border = "crop",
    projection: Projection = "sum",
    include_self: bool = False,
    carry: bool = True,
) -> NDArray[np.float32]:
    """Return one surface a grid and polarity.

    Grid g holds the events with edges_us[g] < t_us <= edges_us[g + 1].

    - "sae", surface of active events: exp(-(edges_us[g + 1] - t) / tau) with t the time of the pixel's last
      event of that polarity; 0 where there was none.
    - "context", equations ts1, ts2 and tsmap of the paper: every event has S = exp(-(t_i - t*) / tau) with t*
      the latest time of the same polarity within `radius`, 0 where there is none; `projection` puts the
      events of a pixel together.
    - "hots" (Lagorce et al., TPAMI 2017): S is the mean of exp(-(t_i - t) / tau) over the neighbourhood, with
      t the last time of each of its pixels, 0 where a pixel has none.

    Args:
        events: The stream; it is not changed.
        edges_us: Ascending edges, [grids + 1], microseconds.
        tau_us: Time constant, microseconds, above 0; `suggest_tau_us` has a rule.
        mode: The kind of surface.
        radius: Radius of the neighbourhood, pixels, 0 to 64; not for "sae".
        shape: "box" (2 radius + 1)^2 or "disc" (pixel centres within the radius); not for "sae".
        border: For "hots": "crop" takes the mean over the neighbours on the sensor, "zero" counts those beyond
            as pixels without events. "sae" and "context" meet no border: neighbours beyond it have no events.
        projection: "sum", "last" or "max" of the events of a pixel; not for "sae".
        include_self: Let an event find itself (j <= i as printed in the paper): "context" is then a count.
        carry: Whether earlier events, also those before the first edge, count; else each grid starts blank.

    Returns:
        float32 [grids, 2, H, W], channel 0 brighter (ON), channel 1 darker (OFF).

    Raises:
        DataError: An argument is outside its range.

    Example:
        >>> events = Events([5, 10], [0, 1], [0, 0], [True, False], width=2, height=1)
        >>> time_surface(events, [0, 10], tau_us=5.0).round(3).tolist()
        [[[[0.36800000071525574, 0.0]], [[0.0, 1.0]]]]
    """
    edges = as_edges(edges_us)
    check_surface(tau_us, radius, mode)
    _choice("shape", shape, ("box", "disc"))
    _choice("border", border, ("crop", "zero"))
    _choice("projection", projection, tuple(_PROJECTIONS))
    starts = np.searchsorted(events.t_us, edges, side="right")
    newest, never, origin = _time_map(events, edges, int(radius) if mode == "context" else 0)
    out = np.zeros((len(edges) - 1, 2, events.height, events.width), np.float32)
    columns = (events.t_us, events.x, events.y, events.p)
    if mode == "sae":
        kernels.sae(*columns, edges, starts, float(tau_us), carry, newest, never, origin, out)
        return out
    spans = _spans(int(radius), shape)
    chosen = (*columns, edges, starts, float(tau_us), carry, _PROJECTIONS[projection], include_self, spans)
    if mode == "context":
        kernels.context(*chosen, shape == "box", newest, never, origin, out)
    else:
        whole_area = int((2 * spans + 1).sum()) if border == "zero" else 0
        kernels.hots(*chosen, whole_area, newest, never, origin, out)
    return out


def normalise_surface(surface: NDArray, how: Literal["signed", "joint"] = "joint") -> NDArray[np.float32]:
    """Return surfaces scaled to one maximum for both polarities; a blank surface stays blank.

    Args:
        surface: Surfaces [..., 2, H, W], not negative; not changed.
        how: "signed" gives [..., 1, H, W] = (ON - OFF) / max|ON - OFF|, within -1..1; "joint" gives
            [..., 2, H, W], both channels divided by the maximum over both, within 0..1.

    Raises:
        DataError: The shape has no two channels.
    """
    _choice("how", how, ("signed", "joint"))
    if surface.ndim < 3 or surface.shape[-3] != 2:
        raise DataError(f"surface has shape {surface.shape}; give [..., 2, H, W]")
    values = surface.astype(np.float32)  # a copy
    if how == "signed":
        values = values[..., :1, :, :] - values[..., 1:, :, :]  # [..., 1, H, W]
    largest = np.abs(values).max(axis=(-3, -2, -1), keepdims=True)
    return np.divide(values, largest, out=np.zeros_like(values), where=largest > 0)
