"""A setup as a matrix with a noise, and the best linear estimate that it allows.

- A setup as a matrix with a noise: what every question about its limits starts from, of a target of its size.
- The best linear estimate of a target from one image of the wall, and how wrong it is on average.
- What they say of a setup, in words, and what a matrix can't: what its model adds to a wall, a scan's noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch

from evnlos.errors import ConfigError, DataError
from evnlos.machine import note
from evnlos.setups import OperatorNoise, Setup
from evnlos.types import Plane, length_text

_EXTRA_MODES = 1.1
_USUAL_SIZE_M = 0.08


class AskedSize(NamedTuple):
    """Side of the target plane that a question about a setup is of, metres, and who says so, in words."""

    size_m: float
    source: str

    @classmethod
    def of(cls, setup: Setup, asked_m: float | None = None, stated_m: float | None = None) -> AskedSize:
        """Return the side that the caller names, or that of the setup's targets, the strip's, or 8 cm.

        Args:
            setup: The setup; the largest square that its cells of targets hold counts where no side is given.
            asked_m: Side that the caller names, metres; None: the setup's.
            stated_m: Side of the targets that the setup's file states beside it, metres; None: it states none.

        Example:
            >>> from evnlos.setups import RadiometricSetup
            >>> AskedSize.of(RadiometricSetup(cell_m=0.05, strip_m=(4.8, 1.6)))
            AskedSize(size_m=1.6, source="the largest that the setup's strip holds")
        """
        if asked_m is not None:
            return cls(asked_m, "as asked")
        if stated_m is not None:
            return cls(stated_m, "as the setup's file states of its targets")
        cells = setup.target_cells()
        if cells is None:
            return cls(_USUAL_SIZE_M, "taken for granted, as the setup states none")
        return cls(round(min(cells.extent_m), 6), "the largest that the setup's strip holds")

    @property
    def words(self) -> str:
        """The side alone, in words."""
        return length_text(self.size_m, digits=0)


@dataclass(frozen=True)
class AnalysisSettings:
    """How the question is put: cells of the target plane, pixels of the camera, noise."""

    target_size_m: float | None = None
    """Side of the target plane, in the middle of its travel, metres; none = that of the targets in the setup's
    file, else the largest that its strip holds, 0.08 where it has none."""
    cells: int = 32
    """Cells a side of the target plane."""
    height: int = 60
    """Rows of the camera, pixels."""
    width: int = 96
    """Columns of the camera, pixels."""
    noise_std: float = 0.01
    """Standard deviation of the fixed noise, share of the brightest pixel while the whole target shines."""
    frames: int = 1
    """Frames that are averaged, all of the target in the same place."""
    fpn_corrected: bool = True
    """Whether the camera's fixed pattern was measured and taken off."""
    writers: int = 6
    """Writers whose characters are the linear estimator's prior."""

    def __post_init__(self) -> None:
        for name, least in (("cells", 8), ("height", 4), ("width", 4), ("frames", 1), ("writers", 1)):
            if getattr(self, name) < least:
                raise ConfigError(f"AnalysisSettings.{name} is {getattr(self, name)}; give {least} or more")
        if self.cells > 64:
            raise ConfigError(
                f"AnalysisSettings.cells is {self.cells}; give at most 64, the matrix grows with its square"
            )
        for name in ("target_size_m", "noise_std"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ConfigError(f"AnalysisSettings.{name} is {value}; give a positive number")

    @property
    def target_plane(self) -> Plane:
        """The cells of the target plane, of 8 cm where nobody says its side."""
        return Plane(self.cells, self.cells, (self.target_size_m or _USUAL_SIZE_M) / self.cells)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.height, self.width


_SHAPE = 4  # bars of a quarter of the target plane tell where a letter is filled and where it is open


def verdict(
    patterns: int, finest_m: tuple[float | None, float | None], stroke_m: float, target_size_m: float
) -> str:
    """Return in a sentence what a reconstruction with this setup would be.

    Strokes are measured where bars of their width are resolved in both directions; the rough shape where bars
    of a quarter of the target plane are.

    Args:
        patterns: Patterns in which handwritten targets differ by more than the noise.
        finest_m: Width of the finest upright and lying bars that are resolved, metres; None where none are.
        stroke_m: Typical stroke of the targets, metres.
        target_size_m: Side of the target plane, metres.

    Example:
        >>> verdict(3, (None, None), 0.008, 0.08).split(": ")[1]
        'a legible reconstruction would come from the training data, not from the measurement.'
    """
    upright, lying = finest_m
    resolved = [width for width in finest_m if width is not None]
    if not resolved:
        bars = "no bars at all"
    elif len(resolved) == 1:
        there, missing = ("upright", "lying") if lying is None else ("lying", "upright")
        bars = f"{there} bars down to {1e3 * resolved[0]:.1f} mm, {missing} ones not at all"
    else:
        bars = f"bars down to {1e3 * max(resolved):.1f} mm"
    finest = None if upright is None or lying is None else max(upright, lying)
    if finest is not None and finest <= stroke_m:
        meaning = (
            f"strokes of {1e3 * stroke_m:.1f} mm are measured; finer detail would come from the training data"
        )
    elif finest is not None and finest <= target_size_m / _SHAPE:
        fine = f"strokes of {1e3 * stroke_m:.1f} mm are too fine for this wall"
        meaning = f"the rough shape is measured, {fine}: their detail would come from the training data"
    else:
        meaning = "a legible reconstruction would come from the training data, not from the measurement"
    size = length_text(target_size_m, digits=0)
    return (
        f"From one frame of this wall {patterns} patterns can be distinguished of a target of {size}, "
        f"and {bars}: {meaning}."
    )


@dataclass(frozen=True, eq=False)
class LinearizedSetup:
    """The linear map from the target's cells to the camera's pixels, and the light that is always there.

    Args:
        matrix: White levels of a pixel per unit of a cell's brightness, float64 [H W, n].
        ambient: Ambient light, white levels, float64 [H W].
        target_plane: The cells.
        shape: Size (H, W) of the camera image, pixels.
    """

    matrix: torch.Tensor
    ambient: torch.Tensor
    target_plane: Plane
    shape: tuple[int, int]

    @property
    def white(self) -> float:
        """Light of the brightest pixel while the whole target shines, ambient light apart, white levels."""
        return float(self.matrix.sum(dim=1).max())


def linearized(setup: Setup, settings: AnalysisSettings = AnalysisSettings()) -> LinearizedSetup:
    """Return the linear map of a setup for a target in the middle of its path.

    Of a setup that is not linear it is the linear part (`Setup.linear_part`). A setup that has fewer pixels
    than the settings ask for keeps its own.

    Args:
        setup: The setup.
        settings: Cells and pixels.

    Raises:
        ConfigError: The setup is geometrically impossible, has no linear part, or gets no light.

    Example:
        >>> from evnlos.setups import PaperSetup
        >>> seen = linearized(PaperSetup(gain=0.5), AnalysisSettings(cells=8, height=12, width=20))
        >>> seen.matrix.shape, 0.2 < seen.white < 0.5
        (torch.Size([240, 64]), True)
    """
    size = AskedSize.of(setup, settings.target_size_m)
    setup, settings = setup.resized(settings.shape), replace(settings, target_size_m=size.size_m)
    note("light path")
    matrix = setup.linear_part(settings.target_plane).dense()
    if not float(matrix.max()) > 0:
        raise ConfigError("the camera gets no light from the target; move the target or the camera")
    return LinearizedSetup(matrix, setup.ambient_light().double().flatten(), settings.target_plane, setup.shape)


_STEPS_AN_OCTAVE = 8
_PHASES = 4
RESOLVED = 0.5
"""Bars count as resolved when the expected error is at most this share of an even grey's."""


class LinearEstimator:
    """The linear minimum mean-square error estimator of x from y = A x + noise (Wiener; LMMSE).

    x^ = m + C A^T (A C A^T + D)^-1 (y - A m), with m and C the mean and the covariance of the targets and D
    that of the noise. In the basis T of patterns in which C = T T^T and T^T A^T D^-1 A T = diag(snr), pattern k
    is seen with a signal-to-noise ratio snr_k in power, and x^ = m + T (snr + 1)^-1 T^T A^T D^-1 (y - A m).

    Args:
        gram: A^T D^-1 A, [n, n]: the information that the image carries.
        mean: m, [n], 0..1.
        patterns: T, [n, n].
        snr: Signal-to-noise ratio of each pattern, [n], descending.
    """

    def __init__(
        self, gram: torch.Tensor, mean: torch.Tensor, patterns: torch.Tensor, snr: torch.Tensor
    ) -> None:
        self.mean, self.snr = mean, snr
        self._patterns = patterns
        self._gain = patterns / (snr + 1)
        self._kept = self._gain @ (patterns.mT @ gram)  # what the estimate keeps of x - m, [n, n]
        share = snr / (snr + 1).square()
        self.noise_error = float((share * patterns.square().sum(dim=0)).sum() / len(mean))

    @classmethod
    def known(cls, gram: torch.Tensor, mean: torch.Tensor, root: torch.Tensor) -> LinearEstimator:
        """Return the estimator for targets of mean m and covariance C = R R^T.

        Args:
            gram: A^T D^-1 A, [n, n].
            mean: m, [n].
            root: R, [n, n].

        Raises:
            DataError: The sizes do not belong together.
        """
        count = len(mean)
        if gram.shape != (count, count) or root.shape != (count, count):
            raise DataError(
                f"gram is {tuple(gram.shape)}, root {tuple(root.shape)}; both need {count} x {count} entries"
            )
        snr, turn = torch.linalg.eigh(root.mT @ gram @ root)
        return cls(gram, mean, (root @ turn).flip(1), snr.flip(0).clamp(min=0))

    @classmethod
    def white(cls, gram: torch.Tensor, power: torch.Tensor, axes: torch.Tensor) -> LinearEstimator:
        """Return the estimator that knows no shapes: cells are independent, as often bright as dark.

        Args:
            gram: A^T D^-1 A, [n, n].
            power: Its eigenvalues, [n], descending.
            axes: Its eigenvectors, [n, n].
        """
        mean = torch.full_like(power, 0.5)
        return cls(gram, mean, axes / 2, power / 4)  # variance 1/4

    @property
    def patterns_seen(self) -> int:
        """Number of patterns in which these targets differ by more than the noise: snr above 1."""
        return int((self.snr > 1).sum())

    def expected(self, targets: torch.Tensor) -> torch.Tensor:
        """Return the estimate without its noise: its mean over many images of each target [..., n]."""
        return self.mean + (targets - self.mean) @ self._kept.mT

    def expected_error(self, targets: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error a cell, over the noise, for given targets [..., n] -> [...]."""
        return (self.expected(targets) - targets).square().mean(dim=-1) + self.noise_error

    def estimate(self, backprojected: torch.Tensor) -> torch.Tensor:
        """Return x^ from A^T D^-1 (y - A m), [..., n]."""
        return self.mean + (backprojected @ self._patterns) @ self._gain.mT


def bars(cells: int, width: float, phase: float, upright: bool = True) -> torch.Tensor:
    """Return bright bars on a dark target, each cell the exact mean over its area.

    Args:
        cells: Cells a side.
        width: Width of a bar and of a gap, cells, above 0.
        phase: Where the first bar begins, cells.
        upright: Whether the bars run along y; they then follow each other along x.

    Returns:
        Brightness, float64 [cells, cells], 0..1.

    Example:
        >>> bars(4, 1.0, 0.5)[0]
        tensor([0.5000, 0.5000, 0.5000, 0.5000], dtype=torch.float64)
    """
    edge = torch.arange(cells + 1, dtype=torch.float64) - phase
    periods = torch.floor(edge / (2 * width))
    filled = periods * width + (edge - 2 * width * periods).clamp(max=width)
    profile = filled.diff()
    return (profile if upright else profile[:, None]).expand(cells, cells).clone()


def finest_bars(estimator: LinearEstimator, cells: int, upright: bool = True) -> float | None:
    """Return the width of the finest bars that one image resolves, in cells; None where none are.

    Bars of full contrast fill the target plane. They are resolved when the expected squared error of the
    estimate, averaged over their phase, is at most half of what an even grey of their mean would have (a
    quarter of the all-black image's), and so are all wider bars. Widths go from half of the target plane down
    to one cell in steps of 9 %.

    Args:
        estimator: The estimator, `LinearEstimator.white` for one without any knowledge of shapes.
        cells: Cells a side of the target plane.
        upright: Whether the bars run along y.
    """
    octaves = math.log2(cells / 2)
    steps = round(_STEPS_AN_OCTAVE * octaves)
    found = None
    for step in range(steps + 1):
        width = cells / 2 * 2 ** (-octaves * step / steps)
        note(f"bars of {width:.1f} cells, {'upright' if upright else 'lying'}")
        targets = torch.stack(
            [bars(cells, width, 2 * width * k / _PHASES, upright).flatten() for k in range(_PHASES)]
        ).to(estimator.mean)
        grey = (targets - targets.mean(dim=-1, keepdim=True)).square().mean()
        if float(estimator.expected_error(targets).mean()) > RESOLVED * float(grey):
            break
        found = width
    return found


def artifact_note(setup: Setup, plain: Setup, cut: int, whole: int, level: float) -> str | None:
    """Return a warning where what a setup's model adds to a real wall shows modes that the wall does not have.

    Args:
        setup: The setup.
        plain: The same without that (`Setup.without_artifacts`), e.g. a tPSF without its hard edge.
        cut: Singular values of the setup above `level`.
        whole: The same without the artifact.
        level: Share of the largest singular value.
    """
    if cut <= _EXTRA_MODES * whole:
        return None
    changed = [item.name for item in fields(setup) if getattr(setup, item.name) != getattr(plain, item.name)]
    here, there = (", ".join(f"{name} {getattr(one, name):g}" for name in changed) for one in (setup, plain))
    return (
        f"{setup.wall_description()} with {here}: {cut} singular values lie above {level:g} of the largest, "
        f"{whole} with {there}; {setup.artifact} makes the operator look better conditioned than a wall is"
    )


def scan_notes(noise: OperatorNoise, seen: LinearizedSetup, singular: torch.Tensor, level: float) -> list[str]:
    """Return what makes a measured setup look better or worse than it is.

    The noise of the measurement has singular values of its own; those of the matrix that are not above its
    largest can't be told from it, however well conditioned they look.

    Args:
        noise: One draw of the noise of the measured operator, and what is known of it.
        seen: The linear map of the setup.
        singular: Singular values of that map over the largest, descending.
        level: Share of the largest above which a mode is called usable.
    """
    floor = float(torch.linalg.matrix_norm(noise.matrix, 2) / torch.linalg.matrix_norm(seen.matrix, 2))
    above, usable = int((singular > floor).sum()), int((singular > level).sum())
    found = []
    if above < usable:
        found.append(
            f"the scan's own noise reaches {floor:.2g} of the largest singular value: {above} of the {usable} "
            "modes "
            f"above {level:g} are surely measured, the others may be noise; repeat the scan more often"
        )
    if not noise.is_independent:
        found.append(
            "the matrix was denoised or made from a point-spread function: its noise is not independent from "
            "cell "
            "to cell, and modes that were cut off count as absent"
        )
    if noise.pitch_m > 1.01 * seen.target_plane.pitch_m:
        found.append(
            f"the scan's cells are {1e3 * noise.pitch_m:.1f} mm: bars narrower than that were not measured, "
            "whatever the wall"
        )
    return found
