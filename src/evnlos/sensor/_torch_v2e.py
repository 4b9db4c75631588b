"""The frame-stepped pixel (`mode="v2e"`) as plain torch operations: whole batches of clips, on any device.

Time runs in blocks of steps. In a first pass over all pixels, tile by tile so that a CPU keeps them in its
cache, only the filter moves and its extremes over the block are kept: about six operations a step. Pixels whose
extremes stay within the thresholds are done. Those few that may have crossed one, and those that are due for
shot noise, go through the block once more, step by step with all rules. The host waits for the device a few
times a block, to learn how many these are, and never within a step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.sensor._random import BLOCK, STREAM_THRESHOLD_OFF, STREAM_THRESHOLD_ON
from evnlos.sensor._tiles import pattern_key
from evnlos.sensor._torch_light import Blocks, Filter, lin_log
from evnlos.sensor._torch_noise import Leak, ShotNoise
from evnlos.sensor._torch_order import Sent, events_in_order
from evnlos.sensor._torch_random import fill
from evnlos.sensor._torch_refractory import Refractory
from evnlos.sensor.event_model import MIN_THRESHOLD
from evnlos.sensor.event_tensors import EventTensors
from evnlos.sensor.pixel import V2ePixel

STEPS = 32
_TILE_CPU, _TILE_DEVICE = 16_384, 1 << 22
_MARGIN = {torch.float64: 1e-9, torch.float32: 1e-5}
"""How far inside a threshold a pixel still counts as one that may have crossed: far above the rounding."""


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
