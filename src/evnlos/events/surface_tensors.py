"""Time surfaces of events that lie on a device, by sorting and scattering instead of event by event."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from evnlos.cameras.event_order import EventTensors
from evnlos.events.grids import as_edges
from evnlos.events.surface import Mode, check_surface

_NEVER = -(1 << 62)  # a time of which nothing is left
_UNIT = 2.0**40
"""Values are added up as whole multiples of 2^-40: the order of a device's additions then changes no bit."""


def time_surface_tensors(
    events: EventTensors, edges_us: ArrayLike, tau_us: float, mode: Mode = "sae", *, radius: int = 1
) -> Tensor:
    """Return what `time_surface` returns with its other defaults, on the device of the events.

    Where `time_surface` walks through the events and remembers, this looks up, for each event and each pixel of
    its neighbourhood at once, the last event before it: in the list of all events sorted by pixel, then order.

    Args:
        events: The stream, in order.
        edges_us: Ascending edges, [grids + 1], microseconds.
        tau_us: Time constant, microseconds, above 0.
        mode: "sae", "context" or "hots".
        radius: Radius of the neighbourhood (a box), pixels, 0 to 64; not for "sae".

    Returns:
        float32 [grids, 2, H, W], channel 0 brighter (ON), channel 1 darker (OFF); equal to `time_surface` to
        single precision.

    Raises:
        DataError: An argument is outside its range.
    """
    check_surface(tau_us, radius, mode)
    edges = as_edges(edges_us)
    grid = _grids(events, edges)
    if mode == "sae":
        return _newest(events, grid, edges, tau_us)
    per_event = _context if mode == "context" else _mean_decay
    value = per_event(events, tau_us, int(radius))
    inside = (grid >= 0) & (grid < len(edges) - 1)
    out = torch.zeros((len(edges) - 1) * 2 * _pixels(events), dtype=torch.int64, device=value.device)
    place = grid[inside] * (2 * _pixels(events)) + _places(events)[inside]
    out.scatter_add_(0, place, (value[inside] * _UNIT).round().to(torch.int64))
    return (out * (1 / _UNIT)).to(torch.float32).view(-1, 2, events.height, events.width)


def _pixels(events: EventTensors) -> int:
    return events.height * events.width


def _grids(events: EventTensors, edges: np.ndarray) -> Tensor:
    """Return each event's grid, int64 [N]: -1 before the first edge, the number of grids after the last."""
    return torch.searchsorted(torch.from_numpy(edges).to(events.t_us.device), events.t_us) - 1


def _places(events: EventTensors) -> Tensor:
    """Return where each event lies in a map [2, H, W], int64 [N]."""
    return events.pixel + (~events.on) * _pixels(events)


def _newest(events: EventTensors, grid: Tensor, edges: np.ndarray, tau_us: float) -> Tensor:
    """Return the surface of active events."""
    grids, size = len(edges) - 1, 2 * _pixels(events)
    device = events.t_us.device
    kept = grid < grids  # earlier events count in the first grid, and in all after it
    place = (grid.clamp(min=0) * size + _places(events))[kept]
    newest = torch.full((grids * size,), _NEVER, dtype=torch.int64, device=device)
    newest = newest.scatter_reduce_(0, place, events.t_us[kept], "amax").view(grids, size)
    out = torch.empty(grids, size, dtype=torch.float32, device=device)
    held = newest[0]
    for number, end_us in enumerate(edges[1:].tolist()):
        held = torch.maximum(held, newest[number])
        out[number] = ((held - end_us).to(torch.float64) / tau_us).to(torch.float32).exp_()
    return out.view(grids, 2, events.height, events.width)


class _Before:
    """For each event, the last one before it at any neighbour of its pixel.

    An event's key is (place, order) as one whole number; keys sorted, the one below (neighbour, order of the
    event) is that of the neighbour's last event before it, or of another place if there is none.
    """

    def __init__(self, events: EventTensors) -> None:
        self._events, self._count = events, len(events)
        self._order = torch.arange(len(events), device=events.t_us.device)
        self._place = _places(events)
        self._keys = torch.sort(self._place * self._count + self._order).values
        self._row = torch.div(events.pixel, events.width, rounding_mode="floor")
        self._column = events.pixel - self._row * events.width

    def at(self, down: int, right: int) -> tuple[Tensor, Tensor]:
        """Return that event's time [N], `_NEVER` if there is none, and whether the pixel is on the sensor."""
        events = self._events
        row, column = self._row + down, self._column + right
        on_sensor = (row >= 0) & (row < events.height) & (column >= 0) & (column < events.width)
        place = self._place + (down * events.width + right)
        found = torch.searchsorted(self._keys, place * self._count + self._order) - 1
        key = self._keys[found.clamp(min=0)]
        there = on_sensor & (found >= 0) & (torch.div(key, self._count, rounding_mode="floor") == place)
        return torch.where(there, events.t_us[key % self._count], _NEVER), on_sensor


def _box(radius: int) -> list[tuple[int, int]]:
    return [(down, right) for down in range(-radius, radius + 1) for right in range(-radius, radius + 1)]


def _context(events: EventTensors, tau_us: float, radius: int) -> Tensor:
    """Return exp(-(t_i - t*) / tau) of each event, float64 [N], t* the latest time in its neighbourhood."""
    if not len(events):
        return torch.zeros(0, dtype=torch.float64, device=events.t_us.device)
    before, latest = _Before(events), torch.full_like(events.t_us, _NEVER)
    for down, right in _box(radius):
        latest = torch.maximum(latest, before.at(down, right)[0])
    return torch.exp((latest - events.t_us).to(torch.float64) / tau_us)


def _mean_decay(events: EventTensors, tau_us: float, radius: int) -> Tensor:
    """Return the mean of exp(-(t_i - t) / tau) over the neighbours on the sensor, float64 [N]."""
    total = torch.zeros(len(events), dtype=torch.float64, device=events.t_us.device)
    if not len(events):
        return total
    before, pixels = _Before(events), torch.zeros_like(events.t_us)
    for down, right in _box(radius):
        time_us, on_sensor = before.at(down, right)
        total += torch.exp((time_us - events.t_us).to(torch.float64) / tau_us)
        pixels += on_sensor
    return total / pixels
