"""What hidden targets look like: Gaussian priors of written characters, and others to test them on.

- Handwriting as a prior and as a test, on the cells of any plane.
- Mean target, and the patterns in which targets differ most: a target as a few numbers.
- The letters of the usual prior come with the package: drawing them takes ten seconds, and fonts.
- The target among many that explains a measurement best, bent until it fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.machine import note
from evnlos.scene import DIGITS, TRAIN_WRITERS, HandwritingGlyphs, Ink, Strokes, Target, pen_width
from evnlos.types import Plane
from evnlos.untrusted import open_image

Array = NDArray[np.float64]
Single = NDArray[np.float32]

TRACKED_ROOM = 1.25
"""Side of the plane of a target that was tracked over the target's: the light's middle need not be its own."""
TEST_CHARACTERS = "AGKS249"
"""Characters that the prior never sees, from writers that it never sees."""
TRAIN_CHARACTERS = "BCDEFHIJLMNOPQRTUVWXYZ0135678"
"""Characters of the prior."""
TYPICAL = "G"
"""The character whose Picard plot is shown."""
LETTERS = HandwritingGlyphs(characters=TRAIN_CHARACTERS, writers=11, strokes=Strokes(faces="both"))
"""Letters of the usual prior, as many writers as faces: handwriting, and print."""
LETTERS_FILE, LETTER_PX = Path(__file__).with_name("letters.png"), 64
"""They are drawn there, a row a writer, on squares of so many cells (`tools/draw_letters.py`)."""

_ROUNDS = ((64, 0.10), (32, 0.07), (16, 0.05), (16, 0.035), (8, 0.025), (8, 0.0175), (8, 0.01), (8, 0.007))
"""Of a search by `best_bent`: candidates that each round keeps, and the spread of its trials."""
_TRIALS = 48

_PEN_MARGIN = 0.1  # the pens' range is widened by this fraction at both ends
_TEST_WRITERS = 2
_RIDGE = 1e-3  # white part of the prior, share of its mean variance: no shape is impossible


@dataclass(frozen=True, eq=False)
class TargetPrior:
    """Targets to learn a prior from, and others to test on, drawn on the same cells.

    Args:
        mean: Mean training target, float64 [n], 0..1.
        root: R with R R^T their covariance and a small white part, float64 [n, n].
        test: Test targets, float64 [M, n].
        names: Their names, [M].
        stroke_m: Median stroke width of the test targets, metres.
    """

    mean: torch.Tensor
    root: torch.Tensor
    test: torch.Tensor
    names: tuple[str, ...]
    stroke_m: float

    @property
    def typical(self) -> int:
        """Number of the test target that stands for all."""
        return next(i for i, name in enumerate(self.names) if name.endswith(f"_{TYPICAL}"))


@lru_cache(maxsize=2)
def handwritten_targets(target_plane: Plane, writers: int = 6) -> TargetPrior:
    """Return NIST-like handwriting as prior and test.

    Training targets are also moved by a cell each way, so that the prior does not know the place to a cell.

    Args:
        target_plane: Cells of the target plane, square; the writers fill it.
        writers: Writers of the training targets.
    """
    mean, root = _gaussian_of(_drawn(writers), target_plane, Ink())
    testing = HandwritingGlyphs(characters=TEST_CHARACTERS, writers=_TEST_WRITERS, first_writer=TRAIN_WRITERS)
    targets = [replace(testing.target(name), size_m=target_plane.extent_m[1]) for name in testing.objects()]
    test = torch.from_numpy(np.stack([one.rasterise(target_plane) for one in targets])).double().flatten(1)
    stroke = float(np.median([stroke_width_m(one) for one in targets]))
    return TargetPrior(mean, root, test, tuple(testing.objects()), stroke)


@lru_cache(maxsize=1)  # planes of other cells ask for the same
def _drawn(writers: int) -> tuple[Target, ...]:
    """Return training targets in the hands of some writers."""
    training = HandwritingGlyphs(characters=TRAIN_CHARACTERS, writers=writers)
    found, names = [], training.objects()
    for k, name in enumerate(names, 1):
        note(f"handwritten target {k} of {len(names)}")
        found.append(training.target(name))
    return tuple(found)


def letters() -> tuple[Target, ...]:
    """Return `LETTERS` as they come with the package."""
    with open_image(LETTERS_FILE) as sheet:
        drawn = np.asarray(sheet, np.float32) / np.float32(255)
    squares = drawn.reshape(-1, LETTER_PX, drawn.shape[1] // LETTER_PX, LETTER_PX).swapaxes(1, 2)
    return tuple(Target("letter", one) for one in squares.reshape(-1, LETTER_PX, LETTER_PX))


def _gaussian_of(targets: Iterable[Target], target_plane: Plane, ink: Ink) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean [n] and root [n, n] of targets, also moved by a cell; shortest columns first."""
    sized = [replace(one, size_m=ink.size_m or target_plane.extent_m[1]) for one in targets]
    drawn = np.stack([one.rasterise(target_plane, ink.centre_m) for one in sized]).astype(np.float64)
    moved = [np.roll(drawn, (dy, dx), axis=(1, 2)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    samples = torch.from_numpy(np.concatenate(moved)).flatten(1)  # [9 N, n]
    variance, axes = torch.linalg.eigh(torch.cov(samples.mT))
    return samples.mean(dim=0), axes * (variance.clamp(min=0) + _RIDGE * variance.mean()).sqrt()


def written_alike(glyphs: HandwritingGlyphs, shown: Iterable[Target]) -> HandwritingGlyphs:
    """Return writers whose letters are as large as known ones, in their place, and with pens like theirs.

    The pens' range is a tenth wider at both ends, and the smallest hand no larger than it was. Digits have
    their own size where any is known, else they are to letters as they were.

    Args:
        glyphs: The writers.
        shown: Known targets on planes of one size, by their names; those without ink do not count.
    """
    sized = [(one, size_m) for one in shown if (size_m := Ink.of([one]).size_m)]
    if not sized:
        return glyphs
    inked, parts = [one for one, _ in sized], [(one.name in DIGITS, size / one.size_m) for one, size in sized]
    digits, others = ([part for digit, part in parts if digit is wanted] for wanted in (True, False))
    plane = glyphs.target_plane
    ratio = plane.digit_fraction / plane.letter_fraction
    letter = max(others) if others else min(1.0, max(digits) / ratio)
    digit = max(digits) if digits else letter * ratio
    smallest = min(part / (digit if is_digit else letter) for is_digit, part in parts)
    pens = [pen_width(one.mask) for one in inked]
    low, high = min(pens) * (1 - _PEN_MARGIN), max(pens) * (1 + _PEN_MARGIN)
    pen = max(0.02, round(low, 3)), min(0.4, round(high, 3))
    heights = max(0.1, round(min(glyphs.strokes.height[0], smallest), 3)), 1.0
    x, y = Ink.of(inked).centre_m
    return replace(
        glyphs,
        strokes=replace(glyphs.strokes, pen=pen, height=heights),
        target_plane=replace(plane, letter_fraction=round(letter, 3), digit_fraction=round(digit, 3)),
        centre=(round(x / inked[0].size_m, 3), round(y / inked[0].size_m, 3)),
    )


def stroke_width_m(target: Target) -> float:
    """Return the mean width of a target's strokes, metres: twice their area over the length of their border.

    A stroke of width w and length l has the area w l and, but for its ends, a border of 2 l. The border's
    length is the total variation of the mask.

    Example:
        >>> bar = np.zeros((100, 100)); bar[:, 40:50] = 1
        >>> round(stroke_width_m(Target("bar", bar, 0.1)), 4)
        0.01
    """
    mask = target.mask.astype(np.float64)
    pixel_m = target.size_m / mask.shape[0]
    border = float(np.hypot(*_slopes(mask)).sum())
    return 2 * float(mask.sum()) / max(border, 1e-12) * pixel_m


def _slopes(mask: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return forward differences along y and x, [S, S]."""
    return np.diff(mask, axis=0, append=mask[-1:]), np.diff(mask, axis=1, append=mask[:, -1:])


@dataclass(frozen=True, eq=False)
class PatternPrior:
    """Targets as mean + patterns @ z with z normal, independent and of variance 1.

    Args:
        target_plane: The target's cells.
        mean: Mean target, [n].
        patterns: One pattern a column, each as large as targets vary along it, [n, k].
        rest: Variance of what the patterns leave out, mean over the cells.
    """

    target_plane: Plane
    mean: Array
    patterns: Array
    rest: float

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self.patterns.shape[1]

    def coefficients(self, image: Array | Single) -> Array:
        """Return the coefficients of targets [..., h, w], [..., k]: the patterns are orthogonal."""
        cells = image.reshape(*image.shape[:-2], -1)
        return (cells - self.mean) @ (self.patterns / np.square(self.patterns).sum(axis=0))

    def image(self, z: Array) -> Array:
        """Return the targets of coefficients [..., k], [..., h, w]."""
        return (self.mean + z @ self.patterns.T).reshape(*z.shape[:-1], *self.target_plane.shape)

    def variance(self, covariance: Array) -> Array:
        """Return the variance of each cell [h, w] at a covariance [k, k] of the coefficients, rest included."""
        spread = np.einsum("nk,kl,nl->n", self.patterns, covariance, self.patterns, optimize=True)
        return spread.reshape(self.target_plane.shape) + self.rest

    def error(self, information: Array) -> float:
        """Return the expected mean squared error of a cell after measurements with this information [k, k]."""
        posterior = np.linalg.inv(np.eye(self.count) + information)
        return float((posterior * (self.patterns.T @ self.patterns)).sum()) / len(self.mean) + self.rest


@lru_cache(maxsize=2)
def handwritten_prior(
    target_plane: Plane,
    coefficients: int = 150,
    writers: int | None = None,
    ink: Ink | None = None,
) -> PatternPrior:
    """Return the Gaussian of written targets by its largest patterns.

    None of the targets shows A G K S 2 4 9.

    Args:
        target_plane: Cells of the target, square.
        coefficients: Patterns that are kept.
        writers: Writers of handwritten targets. None: the letters that come with the package, print among them,
            since a prior of handwriting alone takes broad strokes for noise.
        ink: How large the largest letters are, and where; None is as large as the target.

    Raises:
        ConfigError: More coefficients than cells, or none.
    """
    if not 1 <= coefficients <= target_plane.height * target_plane.width:
        raise ConfigError(
            f"coefficients is {coefficients}; give 1 to {target_plane.height * target_plane.width}, its cells"
        )
    if writers is None or ink is not None:
        drawn = letters() if writers is None else _drawn(writers)
        mean, root = _gaussian_of(drawn, target_plane, ink or Ink())
    else:
        known = handwritten_targets(target_plane, writers)
        mean, root = known.mean, known.root
    patterns = root.flip(1)
    rest = float(patterns[:, coefficients:].square().sum()) / len(patterns)
    return PatternPrior(target_plane, mean.numpy(), patterns[:, :coefficients].contiguous().numpy(), rest)


_NULL = 1e-10  # of the largest eigenvalue


def root_of(information: Array) -> Array:
    """Return the symmetric root R of information A, R R = A, [..., k, k]: the noise of a score b = A z* is R e.

    Args:
        information: A, [..., k, k], symmetric. What is below 1e-10 of its largest eigenvalue, or of the prior's
            own 1, is rounding, and counts as that much.
    """
    values, axes = np.linalg.eigh(information)
    roots = np.sqrt(np.maximum(values, _NULL * np.maximum(values[..., -1:], 1.0)))
    return (axes * roots[..., None, :]) @ np.swapaxes(axes, -1, -2)


@dataclass(frozen=True, eq=False)
class ScoreErrors:
    """What a setup gets wrong of scores b = A z*, learned from known targets z*: b - A z* = R (m + S e + n e').

    R is the root of A (`root_of`), so that what says little of the target errs little. e and e' are independent
    and of variance 1; S is what targets scatter by more than noise.

    Args:
        mean: m, what all share, float64 [k].
        spread: S, float64 [k, C].
        noise: n^2, variance of the noise where A counts it as 1.
    """

    mean: Array
    spread: Array
    noise: float

    @classmethod
    def of(cls, errors: Array, noise: float | None = None) -> ScoreErrors:
        """Return what known targets show; fewer than 2 show nothing but noise.

        Of mean and scatter what noise alone would leave is no error (James and Stein).

        Args:
            errors: R^-1 (b - A z*) of each, [C, k].
            noise: Variance of the noise; None: what the least of the scatter shows (Marchenko and Pastur), as
                where A counts errors of the light path as noise.
        """
        number, count = errors.shape
        if number < 2:
            return cls(np.zeros(count), np.zeros((count, 0)), 1.0 if noise is None else noise)
        seen = errors.T
        mean = seen.mean(axis=1)
        rest = seen - mean[:, None]
        total = float(np.square(rest).sum()) / (number - 1)
        if noise is None:
            free = min(number - 1, count)
            least = float(np.linalg.eigvalsh(rest.T @ rest)[number - free]) / max(number - 1, count)
            share = free / max(number - 1, count)
            noise = float(min(max(least, 0.0) / max(1.0 - math.sqrt(share), 0.1) ** 2, total / count))
        mean *= max(0.0, 1.0 - total / number / max(float(mean @ mean), 1e-12))
        rest *= np.sqrt(max(0.0, 1.0 - count * noise / max(total, 1e-12)) / (number - 1))
        return cls(mean, rest, noise)

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return errors R^-1 (b - A z*) of so many new targets, float64 [count, k]."""
        shape = (count, len(self.mean))
        own = torch.randn(count, self.spread.shape[1], generator=generator, dtype=torch.float64)
        noise = math.sqrt(self.noise) * torch.randn(shape, generator=generator, dtype=torch.float64)
        return torch.from_numpy(self.mean) + own @ torch.from_numpy(self.spread).T + noise


@torch.no_grad()
def best_bent(
    masks: torch.Tensor, shape: tuple[int, int], explained: Callable[[torch.Tensor], torch.Tensor]
) -> torch.Tensor:
    """Return the target that explains a measurement best, among given ones and affine images of them.

    The best of the given ones go through rounds of trials: each is shifted, scaled, turned and slanted at
    random (its affine matrix plus Gaussian numbers, in half sides), and the best of its trials takes its place;
    fewer candidates and smaller steps follow. The same call draws the same trials.

    Args:
        masks: Given targets, float [M, h, h], 0..1.
        shape: Cells on which `explained` sees them.
        explained: Maps targets [K, n n], float64, to how much of the measurement each explains, [K].

    Returns:
        A bent mask, float [h, h], 0..1.
    """
    given = F.interpolate(masks[:, None], shape, mode="area").flatten(1).double()
    scores, kept = explained(given), torch.arange(len(masks))
    affine = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], device=masks.device).repeat(len(masks), 1, 1)
    draw = torch.Generator().manual_seed(0)
    for count, spread in _ROUNDS:
        top = scores.topk(min(count, len(scores))).indices
        kept, affine = kept[top], affine[top]
        steps = spread * torch.randn(len(top), _TRIALS, 2, 3, generator=draw)
        steps[:, 0] = 0  # as it is: no round loses
        tried = (affine[:, None] + steps.to(affine)).flatten(0, 1)
        bent = _bent(masks[kept.repeat_interleave(_TRIALS)], tried)
        cells = F.interpolate(bent[:, None], shape, mode="area").flatten(1).double()
        scores, best = explained(cells).reshape(-1, _TRIALS).max(dim=1)
        affine = tried.reshape(-1, _TRIALS, 2, 3)[torch.arange(len(top)), best]
    first = scores.argmax()
    return _bent(masks[kept[first]][None], affine[first][None])[0].clamp(0, 1)


def _bent(masks: torch.Tensor, affine: torch.Tensor) -> torch.Tensor:
    """Return masks [K, h, h] through one affine matrix each, [K, 2, 3]; outside is dark."""
    grid = F.affine_grid(affine, [len(masks), 1, *masks.shape[1:]], align_corners=False)
    return F.grid_sample(masks[:, None], grid, align_corners=False)[:, 0]
