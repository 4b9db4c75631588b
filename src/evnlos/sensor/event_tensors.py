"""Events that stay on the device on which they were simulated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from evnlos.types import Events


@dataclass(frozen=True, eq=False)
class EventTensors:
    """A stream of events as tensors on one device, ordered by time, then pixel, then OFF before ON.

    Args:
        t_us: Times, int64 [N], microseconds.
        pixel: Flat pixels y width + x, int64 [N].
        on: Polarities, bool [N], True = brighter.
        height: Sensor height, pixels.
        width: Sensor width, pixels.
    """

    t_us: Tensor
    pixel: Tensor
    on: Tensor
    height: int
    width: int

    def __len__(self) -> int:
        return len(self.t_us)

    def to_events(self) -> Events:
        """Return the same events in main memory."""
        time_us, pixel, on = (column.cpu().numpy() for column in (self.t_us, self.pixel, self.on))
        y, x = np.divmod(pixel, self.width)
        return Events(time_us, x.astype(np.uint16), y.astype(np.uint16), on, self.width, self.height)
