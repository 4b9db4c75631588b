"""From light to the filter's output, some frames at a time, on flat tensors and without a copy of the video.

Light of 8 bits goes through tables of 256 entries, other light through the logarithm. What is computed, in
which order and in which precision is that of the numba kernels, so that a state of float64 has the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.cameras.event_camera import Irradiance
from evnlos.cameras.event_model import KNEE_DN, KNEE_SLOPE
from evnlos.cameras.streams import WHITE_DN
from evnlos.errors import DataError

_AHEAD = 32  # instants rendered at a time, at least
_AHEAD_PX = 1 << 22  # pixels of a wall's instants, about


class Blocks(Protocol):
    """Light in DN that pixels take block by block of time."""

    shape: tuple[int, int, int, int]
    """Clips, instants, rows and columns."""
    dtype: torch.dtype
    device: torch.device

    def block(self, first: int, last: int) -> Tensor:
        """Return the light at the instants first..last - 1, [clips, last - first, pixels]."""
        ...


class Clips:
    """Light that is there as a whole.

    Args:
        frames: Light in DN [clips, T, H, W], checked.
    """

    def __init__(self, frames: Tensor) -> None:
        clips, steps, height, width = frames.shape
        self.shape, self.dtype, self.device = (clips, steps, height, width), frames.dtype, frames.device
        self._flat = frames.flatten(2)

    def block(self, first: int, last: int) -> Tensor:
        """Return the light at the instants first..last - 1, [clips, last - first, pixels]."""
        return self._flat[:, first:last]


class WallLight:
    """Light that walls render when pixels ask for it, and forget: clips of any length in little memory.

    Args:
        walls: One wall a clip, of one size, on one device.
        times_s: Instants, float64 [T], seconds.

    Raises:
        DataError: A wall returned NaN, infinity or negative light; also by `block`.
    """

    dtype = torch.float32

    def __init__(self, walls: Sequence[Irradiance], times_s: NDArray[np.float64]) -> None:
        height, width = walls[0].shape
        self._walls, self._times_s = walls, times_s
        self.shape: tuple[int, int, int, int] = (len(walls), len(times_s), height, width)
        self._ahead = max(_AHEAD, _AHEAD_PX // (height * width))  # whatever the number of walls
        self._first, self._held = 0, self._rendered(0, 1)
        self.device = self._held.device

    def block(self, first: int, last: int) -> Tensor:
        """Return the light at the instants first..last - 1, [clips, last - first, pixels]."""
        if not self._first <= first <= last <= self._first + self._held.shape[1]:
            self._first, self._held = first, self._rendered(first, max(last, first + self._ahead))
        return self._held[:, first - self._first : last - self._first]

    def _rendered(self, first: int, last: int) -> Tensor:
        times_s = self._times_s[first:last]
        light = torch.stack([wall.irradiance(times_s).to(torch.float32) for wall in self._walls])
        light = light.flatten(2).mul_(WHITE_DN)
        check_range(light, "the wall's light")
        return light


def check_range(light: Tensor, name: str) -> None:
    """Refuse light in DN that is not finite, or below 0."""
    lowest, highest = torch.stack(light.aminmax()).tolist()
    if not (math.isfinite(lowest) and math.isfinite(highest)):
        raise DataError(f"{name} holds NaN or infinity; light must be finite, 255 = white")
    if lowest < 0:
        raise DataError(f"{name} holds {lowest:g}; light cannot be negative, black is 0")


def lin_log(light: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the logarithm of the light in DN, linear up to 20 DN, in float32, by way of `dtype`.

    By way of float64 with v2e's rounding to 1e-8, which float32 does not resolve.
    """
    light = light.to(dtype)
    logs = torch.where(light <= KNEE_DN, light * KNEE_SLOPE, light.clamp(min=KNEE_DN).log_())
    if dtype == torch.float32:
        return logs
    return logs.mul_(1e8).round_().div_(1e8).to(torch.float32)


def filter_weight(light: Tensor, rate: float | Tensor, dtype: torch.dtype) -> Tensor:
    """Return the weight min((I + 20) / 275 d 2 pi fc, 1) of new light; `rate` is d 2 pi fc, of all or each."""
    return (light.to(dtype) + 20.0).div_(275.0).mul_(rate).clamp_(max=1.0)


class Filter:
    """The low-pass filter over blocks of frames, for up to `capacity` pixels at a time.

    State of float64 follows P <- (1 - w) P + w L. State of float32 follows P <- P + w (L - L0 - P), relative to
    the log light L0 of the first frame, so that its rounding is that of changes. Without a filter P = L.

    Args:
        rates: d 2 pi fc of each step and clip, float64 [clips, steps]; no steps without a filter.
        is_bytes: Whether the light has 8 bits.
        dtype: float64 or float32; float32 without a filter.
        capacity: Most pixels that `advance` ever takes.
        device: Where all tensors live.
    """

    def __init__(
        self,
        rates: NDArray[np.float64],
        is_bytes: bool,
        dtype: torch.dtype,
        capacity: int,
        device: torch.device,
    ) -> None:
        self._is_bytes, self._device = is_bytes, device
        self.has_filter = rates.shape[1] > 0
        # one number per step where all clips have the same pixels; such light alone may have 8 bits
        self._rates: list[float] = rates[0].tolist()
        self._each = torch.from_numpy(rates.T).to(device, dtype) if (rates != rates[:1]).any() else None
        self.relative = self.has_filter and dtype == torch.float32
        self._index = torch.empty(capacity if is_bytes else 0, dtype=torch.int64, device=device)
        self._log = torch.empty(capacity if is_bytes else 0, dtype=dtype, device=device)
        self._weight = torch.empty_like(self._log)
        self._bytes = torch.arange(256 if is_bytes else 0, device=device)
        self._logs = lin_log(self._bytes)
        self._keep: list[Tensor] = []
        self._gain: list[Tensor] = []

    def start_block(self, first: int, last: int) -> None:
        """Prepare the steps first..last - 1, of which `advance` then takes each as 0, 1, ..."""
        self._first = first
        if not (self._is_bytes and self.has_filter):
            return
        rates = torch.tensor(self._rates[first:last], dtype=torch.float64, device=self._device)[:, None]
        weights = ((self._bytes + 20.0).to(torch.float64).div_(275.0) * rates).clamp_(max=1.0)  # [steps, 256]
        if self.relative:
            self._gain = list(weights.to(torch.float32).unbind())
        else:
            self._keep = list((1.0 - weights).unbind())
            self._gain = list(weights.mul_(self._logs.to(torch.float64)).unbind())

    def advance(self, lp: Tensor, light: Tensor, origin: Tensor, step: int, clip: Tensor | slice) -> None:
        """Move the output `lp` [n] by one step, in place.

        Args:
            lp: Output, [n].
            light: New light, [n], or [clips, n / clips] of whole clips.
            origin: L0, [n].
            step: Step of the block.
            clip: The clip of each row of `light`.
        """
        if self._is_bytes:
            self._advance_bytes(lp, light, origin, step)
            return
        if not self.has_filter:
            lp.copy_(lin_log(light.reshape(-1)))
            return
        rate: float | Tensor = self._rates[self._first + step]
        if self._each is not None:
            rate = self._each[self._first + step, clip]
            rate = rate[:, None] if light.ndim > 1 else rate
        weight = filter_weight(light, rate, lp.dtype).reshape(-1)
        logs = lin_log(light.reshape(-1), lp.dtype)
        if self.relative:
            lp.lerp_(logs.sub_(origin), weight)
        else:
            lp.mul_(1.0 - weight).add_(weight.mul_(logs))

    def _advance_bytes(self, lp: Tensor, light: Tensor, origin: Tensor, step: int) -> None:
        index, log, weight = self._index, self._log, self._weight
        if lp.numel() != index.numel():
            index, log, weight = (buffer[: lp.numel()] for buffer in (index, log, weight))
        index.view(light.shape).copy_(light)
        if not self.has_filter:
            torch.index_select(self._logs, 0, index, out=lp)
        elif self.relative:
            torch.index_select(self._logs, 0, index, out=log)
            torch.index_select(self._gain[step], 0, index, out=weight)
            lp.lerp_(log.sub_(origin), weight)
        else:
            torch.index_select(self._keep[step], 0, index, out=weight)
            torch.index_select(self._gain[step], 0, index, out=log)
            lp.mul_(weight).add_(log)
