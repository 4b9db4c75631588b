"""Random numbers and the noise made of them as plain torch operations on any device.

The random numbers of `cameras.random_numbers` as plain torch operations on any device.

Words, uniform and exponential numbers are the same bits; normal numbers are those of the kernels within 2 ulp,
because torch's square root is not correctly rounded everywhere. Thresholds and leak factors are kept in single
precision, where this is lost.

- Leak and shot noise of a group of clips, as plain torch operations: functions of (seed, pixel, step).
- Electrons of a frame as plain torch operations: `fill_electrons` on any device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import count
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from evnlos.cameras.random_numbers import (
    BLOCK,
    FEW,
    G0,
    G1,
    G2,
    G3,
    G4,
    G5,
    G6,
    JITTER_SIZE,
    STREAM_FEW_PHOTONS,
    STREAM_LEAK_JITTER,
    STREAM_LEAK_RATE,
    STREAM_PHOTONS,
    STREAM_SHOT_CHOICE,
    STREAM_SHOT_GAP,
    jitter_table,
)

_GOLDEN = 0x9E3779B97F4A7C15
_FACTORS = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_WORD = (1 << 64) - 1
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10  # as in `random_numbers`
_CHUNK = 16_384

Finish = Callable[[Tensor, int, slice], Tensor]
"""What becomes of the numbers of some pixels of a clip, while a cache still holds them."""


def _signed(word: int) -> int:
    """Return 64 bits as the int64 that holds them."""
    word &= _WORD
    return word - (1 << 64) if word >> 63 else word


def _mix_word(word: int) -> int:
    """Return the SplitMix64 finaliser of a Python integer."""
    word = ((word ^ (word >> 30)) * _FACTORS[0]) & _WORD
    word = ((word ^ (word >> 27)) * _FACTORS[1]) & _WORD
    return word ^ (word >> 31)


def _mix_(word: Tensor) -> Tensor:
    """Apply the SplitMix64 finaliser to int64 words in place; their products wrap as unsigned ones do."""
    for shift, factor in zip((30, 27), _FACTORS, strict=True):
        word.bitwise_xor_((word >> shift).bitwise_and_((1 << (64 - shift)) - 1)).mul_(_signed(factor))
    return word.bitwise_xor_((word >> 31).bitwise_and_((1 << 33) - 1))


def stream_word(seeds: list[int], stream: int, device: torch.device) -> Tensor:
    """Return the part of the random words that depends on seed and stream, int64 [clips]."""
    words = [_signed(_mix_word((seed + _GOLDEN * stream) & _WORD)) for seed in seeds]
    return torch.tensor(words, dtype=torch.int64, device=device)


def _pixel_word(word: Tensor, pixel: Tensor) -> Tensor:
    """Return the part of the random words that depends on seed, stream and pixel."""
    return _mix_((pixel + 1).mul_(_signed(_GOLDEN)) + word)


def random_word(word: Tensor, pixel: Tensor, counter: Tensor) -> Tensor:
    """Return 64 random bits as int64, given `stream_word`, the pixel and the counter (broadcast)."""
    return _mix_((counter + 1).mul_(_signed(_GOLDEN)) + _pixel_word(word, pixel))


def _uniform(word: Tensor) -> Tensor:
    """Return uniform numbers in (0, 1) from random words, float64."""
    return (word >> 12).bitwise_and_((1 << 52) - 1).to(torch.float64).add_(0.5).mul_(2.0**-52)


def random_uniform(word: Tensor, pixel: Tensor, counter: Tensor) -> Tensor:
    """Return a uniform number in the open interval (0, 1) for each pixel, float64."""
    return _uniform(random_word(word, pixel, counter))


def _log(x: Tensor) -> Tensor:
    """Return `fast_log` of positive numbers, with its operations in its order, so that no bit differs."""
    bits = x.view(torch.int64)
    exponent = (bits - 0x3FE6A09E667F3BCD) >> 52
    f = (bits - (exponent << 52)).view(torch.float64).sub_(1.0)
    s = f / (f + 2.0)
    z = s * s
    z2 = z * z
    low = (z * G1).add_(G0).add_((z * G3).add_(G2).mul_(z2))
    high = (z * G5).add_(G4).add_(z2 * G6)
    series = low.add_((z2 * z2).mul_(high))
    e = exponent.to(torch.float64)
    tail = (z.mul_(s)).mul_(series).add_(e * _LN2_LOW)
    return (e * _LN2_HIGH).add_((2.0 * s).add_(tail))


def random_exponential(word: Tensor, pixel: Tensor, counter: Tensor) -> Tensor:
    """Return an exponential number of mean 1 for each pixel, float64."""
    return _log(random_uniform(word, pixel, counter)).neg_()


def _cos_turns(turns: Tensor) -> Tensor:
    """Return cos(2 pi turns), 0 <= turns <= 1, as `cos_turns` does."""
    x = (turns - 0.5).abs_().neg_().add_(0.25).mul_(2.0 * math.pi)
    z = x * x
    series = torch.ones_like(z)
    for n in (20, 18, 16, 14, 12, 10, 8, 6, 4, 2):
        series = 1.0 - series.mul_(z).div_(n * (n + 1.0))
    return x.neg_().mul_(series)


def random_normals(word: Tensor, pixel: Tensor, counter: Tensor) -> tuple[Tensor, Tensor]:
    """Return two independent normal numbers of mean 0 and variance 1 for each pixel, float64."""
    first, second = (random_uniform(word, pixel, 2 * counter + k) for k in (0, 1))
    length = _log(first).mul_(-2.0).sqrt_()
    quarter = torch.where(second >= 0.25, second - 0.25, second + 0.75)
    return length * _cos_turns(second), length * _cos_turns(quarter)


def _first_uniform(word: Tensor, pixel: Tensor) -> Iterator[Tensor]:
    """Yield the uniform numbers of the counters 0, 1, ... of each pixel."""
    word = _pixel_word(word, pixel)
    for counter in count(1):
        yield _uniform(_mix_(word + _signed(_GOLDEN * counter)))


def _exponential(word: Tensor, pixel: Tensor) -> Tensor:
    """Return the exponential number of each pixel with counter 0."""
    return _log(next(_first_uniform(word, pixel))).neg_()


def _normal(word: Tensor, pixel: Tensor) -> Tensor:
    """Return the normal number of each pixel with counter 0 (Box and Muller)."""
    uniform = _first_uniform(word, pixel)
    radius = _log(next(uniform)).mul_(-2.0).sqrt_()
    return radius.mul_(_cos_turns(next(uniform)))


def fill(
    out: Tensor,
    kind: Literal["normal", "exponential"],
    seeds: list[int],
    stream: int,
    finish: Finish | None = None,
) -> Tensor:
    """Fill `out` [clips, pixels] with one number per pixel, after `finish(numbers, clip, pixels)` if given."""
    words, pixels = stream_word(seeds, stream, out.device), out.shape[1]
    draw = _normal if kind == "normal" else _exponential
    chunk = _CHUNK if out.device.type == "cpu" else pixels
    for clip in range(len(out)):
        for start in range(0, pixels, chunk):
            part = slice(start, min(start + chunk, pixels))
            numbers = draw(words[clip], torch.arange(part.start, part.stop, device=out.device))
            out[clip, part] = numbers if finish is None else finish(numbers, clip, part)
    return out


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


_MOST = 2000
_UNASKED = 16  # steps between questions to the device whether any pixel still counts


def electrons(mean: Tensor, offset: Tensor, read_noise: float, seed: int, first: int) -> Tensor:
    """Return the electrons of some frames: Poisson numbers of `mean`, `offset`, and read noise.

    The numbers are those of `fill_electrons` but for pixels, one in millions, whose normal number lies within
    the last digits of a step.

    Args:
        mean: Electrons expected, float64 [frames, N], 0 or more.
        offset: Electrons added, float64 [N].
        read_noise: Standard deviation, electrons.
        seed: Seed of the capture.
        first: Number of the first frame; the others follow it.

    Returns:
        float64 [frames, N].
    """
    number, pixel = (torch.arange(side, device=mean.device) for side in mean.shape)
    number = number[:, None] + first
    shot, read = random_normals(stream_word([seed], STREAM_PHOTONS, mean.device), pixel, number)
    many = mean.clamp(min=FEW)
    root = many.sqrt()
    count = many + root * shot + (shot * shot - 1.0) / 6.0 + (shot - shot * shot * shot) / (72.0 * root)
    count = count.round_().clamp_(min=0.0)
    frame, few = (mean < FEW).nonzero(as_tuple=True)
    if len(few):
        word = stream_word([seed], STREAM_FEW_PHOTONS, mean.device)
        count[frame, few] = _few(mean[frame, few], random_uniform(word, few, frame + first))
    return count.add_(offset).add_(read.mul_(read_noise))


def _few(mean: Tensor, uniform: Tensor) -> Tensor:
    """Return the Poisson numbers of small means by inverting the distribution."""
    share = torch.exp(-mean)
    total, count = share.clone(), torch.zeros_like(mean)
    for step in range(1, _MOST + 1):
        going = total < uniform
        if step % _UNASKED == 1 and not bool(going.any()):
            break
        share = share * (mean / step)
        count += going
        total = torch.where(going, total + share, total)
    return count
