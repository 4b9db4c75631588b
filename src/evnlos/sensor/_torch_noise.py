"""Leak and shot noise of a group of clips, as plain torch operations: functions of (seed, pixel, step)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from evnlos.sensor._random import (
    BLOCK,
    JITTER_SIZE,
    STREAM_LEAK_JITTER,
    STREAM_LEAK_RATE,
    STREAM_SHOT_CHOICE,
    STREAM_SHOT_GAP,
    jitter_table,
)
from evnlos.sensor._torch_random import fill, random_exponential, random_uniform, random_word, stream_word

_DIM_MAX = 1.0 - 0.75 * 20.0 / 275.0


class Leak:
    """The leak of the reference: each block of 256 pixels reads a random stretch of a jitter table a step.

    Args:
        seeds: Seed of each clip.
        patterns: Seed of each clip's sensor.
        on: ON thresholds, float64 [clips, pixels].
        scales: Leak rate times duration of each step, float32 [clips, steps].
    """

    def __init__(self, seeds: list[int], patterns: list[int], on: Tensor, scales: Tensor) -> None:
        clips, self._pixels = on.shape
        device = on.device
        factor = torch.empty(clips, self._pixels, dtype=torch.float32, device=device)
        fill(
            factor, "normal", patterns, STREAM_LEAK_RATE,
            lambda normal, clip, part: torch.pow(10.0, normal.mul_(0.1)).mul_(on[clip, part]),
        )  # fmt: skip
        self._factor = factor.view(-1)
        self._scales = scales
        self._ring = torch.from_numpy(jitter_table().copy()).to(device)
        self._stretches = self._ring.unfold(0, BLOCK, 1)[:JITTER_SIZE].contiguous()
        self._words = stream_word(seeds, STREAM_LEAK_JITTER, device)[:, None, None]
        self._blocks = torch.arange(-(-self._pixels // BLOCK), device=device)[:, None]

    def start_block(self, first: int, last: int) -> None:
        """Draw where each block of pixels reads the table in the steps first..last - 1."""
        steps = torch.arange(first, last, device=self._ring.device)
        words = random_word(self._words, self._blocks, steps)  # [clips, blocks, steps]
        self._offsets = words.bitwise_and_(JITTER_SIZE - 1)
        self._now = self._scales[:, first:last]

    def total(self, first: int, last: int) -> Tensor:
        """Return the leak of the flat pixels first..last - 1 over the block, float32 [last - first]."""
        clip, start = divmod(first, self._pixels)
        clips = max((last - first) // self._pixels, 1)
        width = min(last - first, self._pixels)
        blocks = slice(start // BLOCK, -(-(start + width) // BLOCK))
        offsets = self._offsets[clip : clip + clips, blocks]  # [clips, blocks, steps]
        weights = self._now[clip : clip + clips, None].expand(offsets.shape).flatten(0, 1).contiguous()
        sums = functional.embedding_bag(
            offsets.reshape(-1, offsets.shape[-1]), self._stretches, mode="sum", per_sample_weights=weights
        )  # [clips * blocks, 256]
        sums = sums.view(clips, -1)[:, :width].reshape(-1)
        return sums * self._factor[first:last]

    def steps(self, flat: Tensor) -> Tensor:
        """Return the leak of some flat pixels in each step of the block, float32 [steps, n]."""
        clip = flat // self._pixels
        pixel = flat - clip * self._pixels
        places = self._offsets[clip, pixel // BLOCK].t() + pixel % BLOCK  # [steps, n]
        return (self._now[clip].t() * self._factor[flat]).mul_(self._ring[places])


class ShotNoise:
    """Candidates of shot noise, an exponential gap of hazard apart, thinned to the rates of the moment.

    Args:
        seeds: Seed of each clip.
        nominal: Nominal thresholds (on, off) of each clip, float64 [clips, 2], log units.
        on: ON thresholds of the pixels, float64 [clips, pixels].
        off: The same for OFF.
        chance: Half the rate times the duration of each step, [clips, steps].
    """

    def __init__(
        self,
        seeds: list[int],
        nominal: NDArray[np.float64],
        on: Tensor,
        off: Tensor,
        chance: NDArray[np.float64],
    ) -> None:
        clips, self._pixels = on.shape
        device = on.device
        self._nominal, self._on, self._off = torch.from_numpy(nominal).to(device), on, off
        likely = self._nominal[:, :1] / on + self._nominal[:, 1:] / off
        most = likely.amax(1).cpu().numpy()[:, None]
        ceiling = np.minimum(chance * most * _DIM_MAX, 1.0 - 1e-9)
        spent = np.cumsum(np.concatenate([np.zeros((clips, 1)), -np.log1p(-ceiling)], 1), 1)[:, 1:]
        self._chance = torch.from_numpy(chance).to(device)
        self._ceiling, self._spent = (
            torch.from_numpy(x).to(device) for x in (ceiling, spent)
        )  # [clips, steps]
        self._gap_words = stream_word(seeds, STREAM_SHOT_GAP, device)
        self._choice_words = stream_word(seeds, STREAM_SHOT_CHOICE, device)
        hazard = torch.empty(clips, self._pixels, dtype=torch.float64, device=device)
        self._hazard = fill(hazard, "exponential", seeds, STREAM_SHOT_GAP).view(-1)
        self._drawn = torch.zeros(clips * self._pixels, dtype=torch.int32, device=device)

    def block(self, frames: Tensor, first: int, last: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return flat pixel, step in the block and sign (0: nothing) of the candidates in first..last - 1.

        `frames` is the light [clips, steps of the block, pixels] at the ends of these steps.
        """
        spent = self._spent[:, first:last].contiguous()
        due = self._hazard.view(len(spent), -1) <= spent[:, -1:]
        flat = due.view(-1).nonzero()[:, 0]
        earliest = torch.zeros_like(flat)
        found = [(flat[:0], flat[:0], flat[:0])]
        while len(flat):  # one round, unless a pixel has two candidates in a block
            clip, hazard = flat // self._pixels, self._hazard[flat]
            step = torch.maximum((spent[clip] < hazard[:, None]).sum(1), earliest)
            inside = step < last - first
            flat, clip, step = flat[inside], clip[inside], step[inside]
            found.append((flat, step, self._choose(frames, flat, clip, step, first)))
            self._drawn[flat] += 1
            pixel, counter = flat - clip * self._pixels, self._drawn[flat].to(torch.int64)
            gap = random_exponential(self._gap_words[clip], pixel, counter)
            self._hazard[flat] = gap.add_(spent[clip, step])
            again = (self._hazard[flat] <= spent[clip, -1]) & (step + 1 < last - first)
            flat, earliest = flat[again], step[again] + 1
        flat, step, sign = (torch.cat(column) for column in zip(*found, strict=True))
        return flat, step, sign

    def _choose(self, frames: Tensor, flat: Tensor, clip: Tensor, step: Tensor, first: int) -> Tensor:
        """Return +1, -1 or 0 for each candidate, int64."""
        pixel = flat - clip * self._pixels
        light = frames[clip, step, pixel].to(torch.float64)
        dim = 1.0 - 0.75 * ((light + 20.0) / 275.0)
        chance, ceiling = self._chance[clip, first + step], self._ceiling[clip, first + step]
        counter = self._drawn[flat].to(torch.int64)
        uniform = random_uniform(self._choice_words[clip], pixel, counter) * ceiling
        on = uniform < chance * dim * (self._nominal[clip, 0] / self._on[clip, pixel])
        off = uniform > ceiling - chance * dim * (self._nominal[clip, 1] / self._off[clip, pixel])
        return on.to(torch.int64) - (off & ~on).to(torch.int64)
