"""The refractory period of the frame-stepped pixel, as plain torch operations, one step at a time."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from evnlos.sensor._torch_order import Sent
from evnlos.sensor._v2e_array import instants_within


class Refractory:
    """Remembers when each pixel sent its last event and holds back what comes too soon.

    What is held back is deferred: it does not move the reference, so that it may come in a later step. As in
    v2e, steps whose sub-times are further apart than the period pass unfiltered.

    Args:
        period_s: Refractory period, seconds.
        like: Any tensor [pixels of all clips], for its size and device.
    """

    def __init__(self, period_s: float, like: Tensor) -> None:
        self._period_s = period_s
        self._last = torch.full_like(like, -period_s, dtype=torch.float32)

    def settle(
        self, step: int, flat: Tensor, clip: Tensor, number: Tensor, peak: Tensor, start_s: float, stop_s: float
    ) -> tuple[list[Sent], Tensor]:
        """Return what passes of the crossings `number` [n] of the pixels `flat` [n], and how many a pixel [n].

        `peak` [clips] is the number of crossings of each clip's busiest pixel; the host waits for it.
        """
        delta_s = stop_s - start_s
        grids = [instants_within(start_s, delta_s, stop_s, most) for most in peak.tolist()]
        table = np.zeros((len(grids), max(len(grid) for grid in grids)), np.float32)
        for row, grid in zip(table, grids, strict=True):
            row[: len(grid)] = grid
        filtered = torch.tensor([self._period_s > delta_s / len(grid) for grid in grids], device=flat.device)[
            clip
        ]
        times = torch.from_numpy(table).to(flat.device)[clip]  # [n, sub-times]
        period, last = float(np.float32(self._period_s)), self._last[flat]
        kept, sent = torch.zeros_like(number), []
        for place in range(table.shape[1]):
            late = ~filtered | (times[:, place] - last > period)
            passes = (number.abs() > place) & late
            last = torch.where(passes & filtered, times[:, place], last)
            kept += passes
            now = flat[passes]
            sent.append(
                Sent(torch.full_like(now, step), now, number[passes].sign(), torch.full_like(now, place))
            )
        self._last[flat] = last
        return sent, kept
