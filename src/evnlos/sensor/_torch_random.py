"""The random numbers of `_random` as plain torch operations on any device.

Words, uniform and exponential numbers are the same bits; normal numbers are those of `_random` within 2 ulp,
because torch's square root is not correctly rounded everywhere. Thresholds and leak factors are kept in single
precision, where this is lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import count
from typing import Literal

import torch
from torch import Tensor

from evnlos.sensor._fast_math import G0, G1, G2, G3, G4, G5, G6

_GOLDEN = 0x9E3779B97F4A7C15
_FACTORS = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_WORD = (1 << 64) - 1
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10  # as in `_fast_math`
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
    """Fill `out` [clips, pixels] with one number a pixel, after `finish(numbers, clip, pixels)` if given."""
    words, pixels = stream_word(seeds, stream, out.device), out.shape[1]
    draw = _normal if kind == "normal" else _exponential
    chunk = _CHUNK if out.device.type == "cpu" else pixels
    for clip in range(len(out)):
        for start in range(0, pixels, chunk):
            part = slice(start, min(start + chunk, pixels))
            numbers = draw(words[clip], torch.arange(part.start, part.stop, device=out.device))
            out[clip, part] = numbers if finish is None else finish(numbers, clip, part)
    return out
