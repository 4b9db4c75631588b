"""Streams of events in, one tensor out: what a network is fed, on the device where it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.events.surface import time_surface
from evnlos.events.volume import (
    event_frame,
    event_histogram,
    intensity_map,
    threshold_ordinal_surface,
    voxel_grid,
)
from evnlos.types import Events

if TYPE_CHECKING:
    import torch

Representation = Literal["histogram", "frame", "voxel", "surface", "ordinal", "intensity"]


def _surface(events: Events, *, tau_us: float, stop_us: int | None = None, **options: Any) -> NDArray:
    """Return the surface [2, H, W] at `stop_us`, by default at the last event."""
    if stop_us is None:
        stop_us = int(events.t_us[-1]) if len(events) else 1
    start_us = min(int(events.t_us[0]), stop_us) - 1 if len(events) else stop_us - 1
    return time_surface(events, [start_us, stop_us], tau_us, **options)[0]


_MAKERS: dict[str, Callable[..., NDArray]] = {
    "histogram": lambda events: event_histogram(events)[0],
    "frame": lambda events, **options: event_frame(events, **options),
    "voxel": lambda events, **options: voxel_grid(events, **options),
    "surface": _surface,
    "ordinal": lambda events, **options: threshold_ordinal_surface(events, **options)[None],
    "intensity": lambda events, **options: intensity_map(events, **options),
}

_NEEDED = {"voxel": {"bins": 5}, "surface": {"tau_us": 30_000}}
"""Options without a default, with an example of each."""


def event_batch(
    streams: Sequence[Events],
    representation: Representation = "histogram",
    *,
    device: str | torch.device | None = None,
    **options: Any,
) -> torch.Tensor:
    """Return one map a stream as a tensor [B, C, H, W].

    Args:
        streams: Streams of one sensor size, at least one; they are not changed and may be empty of events.
        representation: "histogram" (2 channels: ON, OFF), "frame" (1), "voxel" (`bins=`), "surface" (2;
            `tau_us=`, and `stop_us=`, `mode=`, `radius=`, ...), "ordinal" (1) or "intensity" (1); options are
            those of `event_frame`, `voxel_grid`, `time_surface`, `threshold_ordinal_surface`, `intensity_map`.
        device: Where the tensor goes, by default it stays in main memory.
        **options: Options of the representation, the same for all streams.

    Returns:
        float32 [B, C, H, W], "ordinal" uint8.

    Raises:
        DataError: No stream, streams of several sensors, or an option that the representation does not have.

    Example:
        >>> one = Events([5, 6], [0, 1], [0, 0], [True, False], width=2, height=1)
        >>> event_batch([one, one[:1]]).tolist()
        [[[[1.0, 0.0]], [[0.0, 1.0]]], [[[1.0, 0.0]], [[0.0, 0.0]]]]
    """
    import torch

    if representation not in _MAKERS:
        raise DataError(f"representation is {representation!r}; give one of {', '.join(_MAKERS)}")
    if not streams:
        raise DataError("no streams of events; give at least one")
    for events in streams:
        if events.shape != streams[0].shape:
            raise DataError(f"sensors of {streams[0].shape} and {events.shape} pixels; batch one size")
    make = _MAKERS[representation]
    lacking = [name for name in _NEEDED.get(representation, {}) if name not in options]
    if lacking:
        example = ", ".join(f"{name}={_NEEDED[representation][name]}" for name in lacking)
        raise DataError(f"{representation} needs {'= and '.join(lacking)}=; give e.g. {example}")
    batch: torch.Tensor | None = None
    for number, events in enumerate(streams):
        try:
            maps = make(events, **options)  # [C, H, W]
        except TypeError as error:
            raise DataError(f"{representation} cannot be made with {sorted(options)}: {error}") from None
        if batch is None:
            batch = torch.empty((len(streams), *maps.shape), dtype=torch.from_numpy(maps).dtype)
        batch[number] = torch.from_numpy(maps)
    assert batch is not None
    return batch if device is None else batch.to(device)


def events_from_tensors(
    t_us: torch.Tensor | ArrayLike,
    x: torch.Tensor | ArrayLike,
    y: torch.Tensor | ArrayLike,
    p: torch.Tensor | ArrayLike,
    *,
    width: int,
    height: int,
) -> Events:
    """Return events of columns that may be tensors on any device; those in main memory are not copied.

    Args:
        t_us: Times, whole numbers [N], microseconds, non-decreasing.
        x: Columns, whole numbers [N].
        y: Rows, whole numbers [N].
        p: Polarities [N]: bool, 0/1 or -1/+1.
        width: Sensor width, pixels.
        height: Sensor height, pixels.

    Raises:
        DataError: As `Events`.

    Example:
        >>> import torch
        >>> events_from_tensors(torch.tensor([3]), torch.tensor([1]), [0], [-1], width=2, height=1)
        Events(1 events, 2 x 1, 3..3 us, 0 % ON)
    """
    return Events(*map(_array, (t_us, x, y, p)), width=width, height=height)


def _array(column: Any) -> NDArray:
    """Return a column that may be a tensor on any device."""
    return np.asarray(column.detach().cpu() if hasattr(column, "detach") else column)


def events_to_tensors(events: Events, device: str | torch.device | None = None) -> dict[str, torch.Tensor]:
    """Return the columns as tensors by name: t_us int64, x and y int32, p bool, adc int32 where present.

    Args:
        events: The stream.
        device: Where the tensors go, by default main memory.

    Example:
        >>> events_to_tensors(Events([3], [1], [0], [1], width=2, height=1))["p"]
        tensor([True])
    """
    import torch

    wide = {
        name: column.astype(np.int32) if column.dtype == np.uint16 else column.copy()
        for name, column in events.columns().items()
    }
    return {name: torch.from_numpy(column).to(device or "cpu") for name, column in wide.items()}
