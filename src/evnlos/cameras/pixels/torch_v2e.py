"""The frame-stepped pixel as plain torch operations: crossings, refractory period, events in order.

- From light to the filter's output, some frames at a time, on flat tensors. Light of 8 bits goes through tables
  of 256 entries, other light through the logarithm; order and precision are those of the numba kernels, so that
  a state of float64 has the same bits.
- From crossings on a device to events in order, without leaving it.
- The refractory period of the frame-stepped pixel, as plain torch operations, one step at a time.

The frame-stepped pixel (`mode="v2e"`) as plain torch operations: whole batches of clips, on any device.

Time runs in blocks of steps. In a first pass over all pixels, tile by tile so that a CPU keeps them in its
cache, only the filter moves and its extremes over the block are kept: about six operations per step. Pixels
whose extremes stay within the thresholds are done. Those few that may have crossed one, and those that are due
for shot noise, go through the block once more, step by step with all rules. The host waits for the device a few
times a block, to learn how many these are, and never within a step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.cameras.event_model import KNEE_DN, KNEE_SLOPE, MIN_THRESHOLD
from evnlos.cameras.pixel import V2ePixel
from evnlos.cameras.pixels.arrays import instants_within, pattern_key
from evnlos.cameras.pixels.torch_noise import Leak, ShotNoise, fill
from evnlos.cameras.random_numbers import BLOCK, STREAM_THRESHOLD_OFF, STREAM_THRESHOLD_ON
from evnlos.cameras.streams import EventTensors


class Blocks(Protocol):
    """Light in DN that pixels take block by block of time."""

    shape: tuple[int, int, int, int]
    """Clips, instants, rows and columns."""
    dtype: torch.dtype
    device: torch.device

    def block(self, first: int, last: int) -> Tensor:
        """Return the light at the instants first..last - 1, [clips, last - first, pixels]."""
        ...


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


class Sent(NamedTuple):
    """What pixels sent, unordered: int64 columns of one length."""

    step: Tensor
    flat: Tensor
    number: Tensor
    """Signed number of events that follow each other at successive sub-times; 0 = none."""
    place: Tensor
    """Index of the sub-time of the first of them; -1 = the last sub-time of the step, for shot noise."""

    @staticmethod
    def join(parts: list[Sent]) -> Sent:
        """Return all entries of one or more parts."""
        return Sent(*(torch.cat(column) for column in zip(*parts, strict=True)))


def events_in_order(
    sent: Sent, peaks: Tensor, times_s: NDArray[np.float64], shape: tuple[int, int]
) -> list[EventTensors]:
    """Return each clip's events by time, then pixel, then OFF before ON.

    `peaks` [clips, steps] is the number of thresholds that the busiest pixel crossed: it sets the sub-times.
    """
    pixels = shape[0] * shape[1]
    clip, order = torch.sort(sent.flat // pixels, stable=True)
    lengths = torch.bincount(clip, minlength=len(peaks)).tolist()
    columns = [column[order].split(lengths) for column in sent]
    return [
        _one_clip(Sent(step, flat - n * pixels, number, place), peak, times_s, shape)
        for n, (peak, step, flat, number, place) in enumerate(
            zip(peaks.clamp(min=1).cpu().numpy(), *columns, strict=True)
        )
    ]


def _one_clip(
    sent: Sent, peak: NDArray[np.int64], times_s: NDArray[np.float64], shape: tuple[int, int]
) -> EventTensors:
    """Return the events of one clip in order, given the peak of each step."""
    device, pixels = sent.step.device, shape[0] * shape[1]
    # equal time stamps are one place in the order
    stamps, ranks = np.unique(step_stamps(times_s, peak), return_inverse=True)
    stamp, rank, most, first = (
        torch.from_numpy(column).to(device) for column in (stamps, ranks, peak, np.cumsum(peak) - peak)
    )
    count = sent.number.abs()
    entry = torch.repeat_interleave(torch.arange(len(count), device=device), count)
    following = torch.arange(len(entry), device=device) - (torch.cumsum(count, 0) - count)[entry]
    step, pixel, number, place = (column[entry] for column in sent)
    place = torch.where(place < 0, most[step] - 1, place + following)
    key = rank[first[step] + place] * (2 * pixels) + 2 * pixel + (number > 0)
    key = torch.sort(key).values
    where = (key >> 1) % pixels
    return EventTensors(stamp[key // (2 * pixels)], where, (key & 1).bool(), shape[0], shape[1])


def step_stamps(times_s: NDArray[np.float64], peak: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the time stamps of all sub-steps in microseconds, ascending, int64 [sum of peak]."""
    start, delta = times_s[:-1], np.diff(times_s)
    seconds = np.repeat((start + delta).astype(np.float32), peak)
    first = np.cumsum(peak) - peak
    for step in np.flatnonzero(peak > 1).tolist():
        within = instants_within(start[step], delta[step], times_s[step + 1], int(peak[step]))
        seconds[first[step] : first[step] + peak[step]] = within
    return np.maximum.accumulate(np.rint(seconds.astype(np.float64) * 1e6).astype(np.int64))


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


STEPS = 32
_TILE_CPU, _TILE_DEVICE = 16_384, 1 << 22
_MARGIN = {torch.float64: 1e-9, torch.float32: 1e-5}
"""How far inside a threshold per pixel still counts as one that may have crossed: far above the rounding."""


def default_tile(device: torch.device) -> int:
    """Return how many pixels run together: what fits a cache, or what fills a device."""
    return _TILE_CPU if device.type == "cpu" else _TILE_DEVICE


class Pixels:
    """A group of clips and the state of all their pixels, flat: pixel n of clip c is c * pixels + n.

    Args:
        light: Light in DN, uint8, float32 or float64 [clips, T, H, W].
        times_s: Instants of the frames, float64 [T].
        kinds: Parameters of each clip's pixels; all have a filter or none, and the same refractory period.
        seeds: Seed of each clip.
        thresholds: Maps (on, off), float64 [clips, pixels] each; None draws them.
        dtype: Precision of the state, float64 or float32.
        tile_px: Pixels that run together.
    """

    def __init__(
        self,
        light: Blocks,
        times_s: NDArray[np.float64],
        kinds: Sequence[V2ePixel],
        seeds: list[int],
        thresholds: tuple[Tensor, Tensor] | None,
        dtype: torch.dtype,
        tile_px: int,
    ) -> None:
        self._light, self.times_s = light, times_s
        device, (clips, _, height, width) = light.device, light.shape
        pixels = height * width
        self.pixels, self._count = pixels, clips * pixels
        delta = np.diff(times_s)
        patterns = [int(pattern_key(kind, seed)) for kind, seed in zip(kinds, seeds, strict=True)]
        filtered = kinds[0].cutoff_hz > 0
        dtype = dtype if filtered else torch.float32
        if thresholds is None:
            each = list(zip(kinds, patterns, strict=True))
            on, off = (
                torch.cat([_thresholds(kind, sign, key, pixels, device) for kind, key in each])
                for sign in (True, False)
            )
        else:  # v2e keeps thresholds that differ in single precision, and equal ones as a double
            on, off = (values.to(torch.float32).to(torch.float64) for values in thresholds)
        self.step_on, self.step_off = on.to(torch.float32).view(-1), off.to(torch.float32).view(-1)
        self.leak = self.shot = None
        leaks = np.array([[kind.leak_rate_hz] for kind in kinds])  # [clips, 1]
        shots = np.array([[kind.shot_noise_rate_hz] for kind in kinds])
        if leaks.any():
            scales = torch.from_numpy((leaks * delta).astype(np.float32)).to(device)
            self.leak = Leak(seeds, patterns, on, scales)
        if shots.any():
            nominal = np.array([(kind.threshold_on, kind.threshold_off) for kind in kinds], np.float64)
            self.shot = ShotNoise(seeds, nominal, on, off, 0.5 * shots * delta)
        self.on, self.off = on.to(dtype).view(-1), off.to(dtype).view(-1)
        self._tiles = _tiles(clips, pixels, tile_px)
        capacity = max(last - first for first, last in self._tiles)
        rates = [delta / (1.0 / (math.pi * 2.0 * kind.cutoff_hz)) if filtered else delta[:0] for kind in kinds]
        self.filter = Filter(np.array(rates), light.dtype == torch.uint8, dtype, capacity, device)
        self._capacity = capacity
        self._low, self._high = (torch.empty(capacity, dtype=dtype, device=device) for _ in range(2))
        self._margin = _MARGIN[dtype]
        self._mask = torch.empty(self._count, dtype=torch.bool, device=device)
        origin = lin_log(light.block(0, 1).reshape(-1))
        self._origin = origin if self.filter.relative else origin[:0]
        self.lp = torch.zeros_like(self.on) if self.filter.relative else origin.to(dtype)
        self.base = self.lp.clone()
        self._start_lp, self._start_base = torch.empty_like(self.lp), torch.empty_like(self.base)
        self._peaks = torch.zeros(clips, len(delta), dtype=torch.int64, device=device)
        period_s = kinds[0].refractory_s
        self.refractory = Refractory(period_s, self.lp) if period_s > 0 else None
        # single precision keeps the rounding of each leak step, so every pixel goes step by step
        self._every_pixel = self.leak is not None and not filtered

    def run(self) -> list[EventTensors]:
        """Return the events of each clip in order."""
        steps = len(self.times_s) - 1
        length = STEPS if self.refractory is None else 1
        sent = [self._block(first, min(first + length, steps)) for first in range(0, steps, length)]
        none = torch.zeros(0, dtype=torch.int64, device=self._light.device)
        sent = Sent.join([Sent(none, none, none, none), *sent])
        return events_in_order(sent, self._peaks, self.times_s, self._light.shape[2:])

    def _block(self, first: int, last: int) -> Sent:
        """Run the steps first..last - 1 and return what was sent."""
        light = self._light.block(first + 1, last + 1)
        self.filter.start_block(first, last)
        if self.leak is not None:
            self.leak.start_block(first, last)
        shot = None if self.shot is None else self.shot.block(light, first, last)
        self._mask.fill_(self._every_pixel)
        if shot is not None:
            self._mask[shot[0]] = True
        found = [self._screen(light, *tile) for tile in self._tiles]
        flat = torch.cat([part[0] for part in found])
        rows = torch.cat([part[1] for part in found]).t().contiguous()  # [steps, n]
        parts = [slice(n, n + self._capacity) for n in range(0, len(flat), self._capacity)]
        sent = [self._resolve(rows[:, part], flat[part], first, shot) for part in parts]
        step, where, number = (
            torch.cat([flat[:0], *column]) for column in (zip(*sent, strict=True) if sent else ((), (), ()))
        )
        clip = where // self.pixels
        self._peaks.view(-1).scatter_reduce_(0, clip * self._peaks.shape[1] + step, number.abs(), "amax")
        if self.refractory is None:
            sent = [Sent(step, where, number, torch.zeros_like(step))]
        else:
            span = float(self.times_s[first]), float(self.times_s[last])
            sent, kept = self.refractory.settle(first, where, clip, number, self._peaks[:, first], *span)
            self._follow(where, number.sign() * kept, shot)
        if shot is not None:
            sent.append(Sent(first + shot[1], shot[0], shot[2], torch.full_like(shot[0], -1)))
        return Sent.join(sent)

    def _follow(self, flat: Tensor, number: Tensor, shot: tuple[Tensor, Tensor, Tensor] | None) -> None:
        """Let the references of some pixels follow the events that passed, unless shot noise has set them."""
        base = self.base[flat]
        moved = base + number.to(torch.float32) * torch.where(
            number > 0, self.step_on[flat], self.step_off[flat]
        )
        if shot is not None:
            moved = torch.where(self._shot_map(shot, flat, 1)[0], base, moved)
        self.base[flat] = moved

    def _screen(self, light: Tensor, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Move the filter of a tile through the block; return the pixels that may have crossed, and the light.

        The pixels are flat, the light is [n, steps]. Pixels that are in the mask already are among them.
        """
        lp, low, high = self.lp[first:last], self._low[: last - first], self._high[: last - first]
        base, origin = self.base[first:last], self._origin[first:last]
        self._start_lp[first:last] = lp
        self._start_base[first:last] = base
        block = self._part(light, first, last)
        clips = slice(first // self.pixels, first // self.pixels + len(block))
        for step, row in enumerate(block.unbind(1)):
            self.filter.advance(lp, row, origin, step, clips)
            if step == 0:
                low.copy_(lp)
                high.copy_(lp)
            else:
                torch.minimum(low, lp, out=low)
                torch.maximum(high, lp, out=high)
        low.sub_(base).add_(self.off[first:last])
        if self.leak is not None:
            base.sub_(self.leak.total(first, last))
        high.sub_(base).sub_(self.on[first:last])
        mask = self._mask[first:last].logical_or_(high >= -self._margin).logical_or_(low <= self._margin)
        flat = mask.nonzero()[:, 0]
        clip = flat // block.shape[2]
        return flat + first, block[clip, :, flat - clip * block.shape[2]]

    def _part(self, light: Tensor, first: int, last: int) -> Tensor:
        """Return the light of a tile, [clips, steps, pixels]: a part of one clip, or some whole clips."""
        clip, start = divmod(first, self.pixels)
        clips = max((last - first) // self.pixels, 1)
        return light[clip : clip + clips, :, start : start + (last - first) // clips]

    def _resolve(
        self, rows: Tensor, flat: Tensor, first: int, shot: tuple[Tensor, Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Take some pixels through a block, step by step; return step, flat pixel and crossings of each hit.

        `rows` is the pixels' light [steps, n] in the steps from `first`.
        """
        lp, base = self._start_lp[flat], self._start_base[flat]
        on, off, step_on, step_off = self.on[flat], self.off[flat], self.step_on[flat], self.step_off[flat]
        origin = self._origin[flat] if self.filter.relative else self._origin
        leaks = None if self.leak is None else self.leak.steps(flat)
        shots = self._shot_map(shot, flat, len(rows)) if shot is not None and len(shot[0]) else None
        crossings = torch.empty(rows.shape, dtype=torch.int64, device=flat.device)
        clip = flat // self.pixels
        for step, row in enumerate(rows.unbind()):
            self.filter.advance(lp, row, origin, step, clip)
            if leaks is not None:
                base.sub_(leaks[step])
            change = lp - base
            rising = change > 0
            count = torch.floor_divide(change.abs(), torch.where(rising, on, off)).copysign_(change)
            count = count.to(torch.float32)
            if self.refractory is None:
                base.add_(count * torch.where(rising, step_on, step_off))
            if shots is not None:
                base = torch.where(shots[step], lp, base)
            crossings[step] = count
        self.base[flat] = base
        step, column = crossings.nonzero(as_tuple=True)
        return first + step, flat[column], crossings[step, column]

    def _shot_map(self, shot: tuple[Tensor, Tensor, Tensor], flat: Tensor, steps: int) -> Tensor:
        """Return where shot noise sets the reference of some pixels, bool [steps, n]."""
        where, step, sign = shot
        if not len(flat):
            return torch.zeros(steps, 0, dtype=torch.bool, device=flat.device)
        column = torch.searchsorted(flat, where)
        mine = (sign != 0) & (column < len(flat)) & (flat[column.clamp(max=len(flat) - 1)] == where)
        hits = torch.zeros(steps, len(flat), dtype=torch.bool, device=flat.device)
        hits[step[mine], column[mine]] = True
        return hits


def _thresholds(kind: V2ePixel, on: bool, seed: int, pixels: int, device: torch.device) -> Tensor:
    """Return a clip's thresholds, float64 [1, pixels]: equal, or drawn, clamped and rounded to float32."""
    nominal, sigma = kind.threshold_on if on else kind.threshold_off, kind.threshold_sigma
    stream = STREAM_THRESHOLD_ON if on else STREAM_THRESHOLD_OFF
    if sigma == 0:
        return torch.full((1, pixels), nominal, dtype=torch.float64, device=device)
    return fill(
        torch.empty(1, pixels, dtype=torch.float64, device=device), "normal", [seed], stream,
        lambda normal, _, __: normal.mul_(sigma).add_(nominal).clamp_(min=MIN_THRESHOLD).to(torch.float32),
    )  # fmt: skip


def _tiles(clips: int, pixels: int, tile_px: int) -> list[tuple[int, int]]:
    """Return ranges of flat pixels: a part of one clip each, of whole random blocks, or some whole clips."""
    if pixels <= tile_px:
        size = tile_px // pixels * pixels
        return [(first, min(first + size, clips * pixels)) for first in range(0, clips * pixels, size)]
    size = -(-tile_px // BLOCK) * BLOCK
    return [
        (clip * pixels + first, clip * pixels + min(first + size, pixels))
        for clip in range(clips)
        for first in range(0, pixels, size)
    ]
