"""The matrix of a scan: denoised, or made from a point-spread function.

Denoising of a measured matrix, chosen by repeats that it has not seen, and left out where it does not help.

The repeats are split in halves A and B. A denoiser D of A is held against the raw B, and the other way round:
what is missed is bias^2 + var(D A) + var(B). The difference of D A and D B tells var(D A), the difference of A
and B var(B); so the error that D would have on the mean of all repeats follows, no truth needed.

- A matrix from a point-spread function: one measured column, moved to where every other cell's would be.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

from evnlos.calibration.transport_fit import levenberg_marquardt
from evnlos.errors import DataError
from evnlos.types import Plane

_SMOOTHING = (0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
_RANKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)
_LEAST_GAIN = 1.1
_MOST_CELLS = 4096


@dataclass(frozen=True)
class Denoising:
    """What was done to a matrix.

    Args:
        smoothing_cells: Standard deviation of the Gaussian over neighbouring cells, cells; 0 = none.
        rank: Number of singular values kept; None = all.
        gain: Root mean square error of the plain mean of the repeats over that of the denoised one, estimated
            from the held-out repeats; 1 = left as it was.
        reason: Why it was left as it was, or an empty text.
    """

    smoothing_cells: float = 0.0
    rank: int | None = None
    gain: float = 1.0
    reason: str = ""

    @property
    def applied(self) -> bool:
        """Whether the matrix was changed."""
        return self.smoothing_cells > 0 or self.rank is not None


@dataclass(frozen=True, eq=False)
class _Halves:
    """Gram matrices of two halves [n, n]: everything that acts on the cells can be judged from them alone."""

    aa: torch.Tensor
    bb: torch.Tensor
    ab: torch.Tensor
    share_a: float  # repeats in A, in B: what the noise of each half is to that of all
    share_b: float

    @property
    def noise(self) -> float:
        """|A - B|^2."""
        return float(torch.trace(self.aa) + torch.trace(self.bb) - 2 * torch.trace(self.ab))

    def risk(self, missed_ab: float, missed_ba: float, between: float) -> float:
        """Return the expected squared error on all repeats, from |D A - B|^2, |D B - A|^2 and |D A - D B|^2."""
        bias = max((missed_ab + missed_ba) / 2 - between / 2 - self.noise / 2, 0.0)
        return bias + self.scale * between

    @property
    def scale(self) -> float:
        """Noise power of the mean of all repeats over that of A - B."""
        return 1 / ((1 / self.share_a + 1 / self.share_b) * (self.share_a + self.share_b))


def choose_denoising(
    first: torch.Tensor, second: torch.Tensor, plane: Plane, share: tuple[int, int]
) -> Denoising:
    """Choose rank and smoothing on two independent halves of a scan.

    Args:
        first: Matrix of some repeats, in units of each pixel's noise, [pixels, cells].
        second: Matrix of the others.
        plane: The cells.
        share: Number of repeats in each half.

    Returns:
        The best of all candidates; none of them unless it takes a tenth off the error and both halves agree.
    """
    if first.shape[1] > _MOST_CELLS:
        return Denoising(reason=f"{first.shape[1]} cells, above the {_MOST_CELLS} that it serves")
    a, b = first.double(), second.double()
    halves = _Halves(a.mT @ a, b.mT @ b, a.mT @ b, *map(float, share))
    plain = halves.scale * halves.noise
    smoothings = [s for s in _SMOOTHING if s <= max(plane.shape) / 2]
    found = [_smoothed(halves, plane, sigma) for sigma in (0.0, *smoothings)]
    best_sigma = min(found, key=lambda one: one[0])[1].smoothing_cells
    for sigma in {0.0, best_sigma}:
        found += _ranked(halves, plane, sigma)
    risk, chosen, agreed = min(found, key=lambda one: one[0])
    gain = (plain / max(risk, 1e-300)) ** 0.5
    if not chosen.applied or gain < _LEAST_GAIN or not agreed:
        return Denoising(reason=f"no candidate takes a tenth off the error (best {gain:.2f} x)")
    return Denoising(chosen.smoothing_cells, chosen.rank, gain)


def denoised(matrix: torch.Tensor, plane: Plane, how: Denoising, weight: torch.Tensor) -> torch.Tensor:
    """Return a matrix [pixels, cells] smoothed over neighbouring cells and cut to a rank.

    Args:
        matrix: The matrix.
        plane: Its cells.
        how: What to do.
        weight: One over the noise of each pixel, [pixels]; 0 leaves a pixel out of the choice of directions.
    """
    if not how.applied:
        return matrix
    work = matrix.double()
    if how.smoothing_cells > 0:
        work = _over_cells(work, plane, how.smoothing_cells, 1)
    if how.rank is not None:
        weighted = work * weight.double()[:, None]
        axes = torch.linalg.eigh(weighted.mT @ weighted).eigenvectors[:, -how.rank :]
        work = (work @ axes) @ axes.mT
    return work.to(matrix)


def _smoothed(halves: _Halves, plane: Plane, sigma: float) -> tuple[float, Denoising, bool]:
    aa, bb, ab = _both(halves, plane, sigma)
    half_a, half_b = (
        _over_cells(g, plane, sigma, 0) for g in (halves.ab, halves.ab.mT)
    )  # (D A)^T B, (D B)^T A
    tr = torch.trace
    missed_ab = float(tr(aa) - 2 * tr(half_a) + tr(halves.bb))
    missed_ba = float(tr(bb) - 2 * tr(half_b) + tr(halves.aa))
    between = float(tr(aa) + tr(bb) - 2 * tr(ab))
    agreed = max(missed_ab, missed_ba) <= halves.noise
    return halves.risk(missed_ab, missed_ba, between), Denoising(smoothing_cells=sigma), agreed


def _ranked(halves: _Halves, plane: Plane, sigma: float) -> list[tuple[float, Denoising, bool]]:
    """Return risk and agreement of all ranks after one smoothing: sums over the leading directions."""
    aa, bb, ab = _both(halves, plane, sigma)
    half_a, half_b = (_over_cells(g, plane, sigma, 0) for g in (halves.ab, halves.ab.mT))
    axes_a, axes_b = (torch.linalg.eigh(gram).eigenvectors.flip(1) for gram in (aa, bb))
    kept_a, kept_b = (((g @ v) * v).sum(0).cumsum(0) for g, v in ((aa, axes_a), (bb, axes_b)))
    seen_a, seen_b = (((v * (g @ v)).sum(0)).cumsum(0) for g, v in ((half_a.mT, axes_a), (half_b.mT, axes_b)))
    overlap = (axes_a.mT @ ab @ axes_b) * (axes_a.mT @ axes_b)
    crossed = overlap.cumsum(0).cumsum(1).diagonal()
    found = []
    for rank in (r for r in _RANKS if r < aa.shape[0]):
        k = rank - 1
        missed_ab = float(kept_a[k] - 2 * seen_a[k] + torch.trace(halves.bb))
        missed_ba = float(kept_b[k] - 2 * seen_b[k] + torch.trace(halves.aa))
        between = float(kept_a[k] + kept_b[k] - 2 * crossed[k])
        agreed = max(missed_ab, missed_ba) <= halves.noise
        found.append((halves.risk(missed_ab, missed_ba, between), Denoising(sigma, rank), agreed))
    return found


def _both(halves: _Halves, plane: Plane, sigma: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the Gram matrices after smoothing over the cells."""
    grams = (halves.aa, halves.bb, halves.ab)
    aa, bb, ab = (_over_cells(_over_cells(g, plane, sigma, 0), plane, sigma, 1) for g in grams)
    return aa, bb, ab


def _over_cells(array: torch.Tensor, plane: Plane, sigma: float, axis: int) -> torch.Tensor:
    """Smooth one axis of an array, whose entries are the plane's cells, by a Gaussian; borders reflect."""
    if sigma <= 0:
        return array
    y, x = (_gaussian(n, sigma).to(array) for n in plane.shape)
    cells = array.movedim(axis, -1)
    cells = y @ cells.unflatten(-1, plane.shape) @ x.mT
    return cells.flatten(-2).movedim(-1, axis)


def _gaussian(count: int, sigma: float) -> torch.Tensor:
    """Return the smoothing matrix [count, count], rows of sum 1, mirrored at the borders."""
    at = torch.arange(count, dtype=torch.float64)
    images = torch.cat([at, -1 - at, 2 * count - 1 - at])  # the cells and their mirror images
    weight = torch.exp(-((at[:, None] - images) ** 2) / (2 * sigma**2))
    weight = weight.reshape(count, 3, count).sum(dim=1)
    return weight / weight.sum(dim=1, keepdim=True)


PxPerM = tuple[tuple[float, float], tuple[float, float]]
_MOST_CHECKED = 24


@dataclass(frozen=True)
class PsfCheck:
    """How well one column, moved, stands for the others.

    Args:
        center: (row, column) of the cell whose column is moved.
        image_px_per_m: How far the image moves, pixels, when the light moves a metre along x and along y.
        checked: Number of other columns that it was compared with; 0 = the assumption was not checked.
        error: Root mean square difference to them over their own root mean square; NaN when not checked.
        unmoved_error: The same if nothing were moved: what a shift must beat.
        border: Largest light at the image's border over the peak: what lies beyond is guessed.
    """

    center: tuple[int, int]
    image_px_per_m: PxPerM
    checked: int
    error: float
    unmoved_error: float
    border: float


def matrix_from_psf(
    columns: NDArray[np.float32],
    cells: list[tuple[int, int]],
    plane: Plane,
    shape: tuple[int, int],
    image_px_per_m: PxPerM | None = None,
) -> tuple[torch.Tensor, PsfCheck]:
    """Return the matrix [H W, h w] of a shift-invariant wall.

    Args:
        columns: Light of the measured cells, [n, H W], white levels.
        cells: Their (row, column).
        plane: All cells.
        shape: Size (H, W) of the camera image, pixels.
        image_px_per_m: How far the image moves; None finds it from the columns.

    Raises:
        DataError: It is not stated, and the cells do not tell it: fewer than three, or all on a line.
    """
    places = np.array([(plane.x_m[c], plane.y_m[r]) for r, c in cells])  # [n, 2]
    middle = int(np.argmin(((places - plane.center_m) ** 2).sum(axis=1)))
    kernel = torch.from_numpy(columns[middle].astype(np.float64)).reshape(shape)
    others = [k for k in range(len(cells)) if k != middle]
    if len(others) > _MOST_CHECKED:
        others = [others[i] for i in np.linspace(0, len(others) - 1, _MOST_CHECKED).round().astype(int)]
    steps = places[others] - places[middle]  # [m, 2]
    seen = torch.from_numpy(columns[others].astype(np.float64)).reshape(-1, *shape)
    if image_px_per_m is None:
        image_px_per_m = _fitted(kernel, seen, steps, shape)
    jacobian = np.array(image_px_per_m)
    error = unmoved = float("nan")
    if others:
        power = float(seen.square().mean())
        error = (float((moved(kernel, steps @ jacobian.T) - seen).square().mean()) / power) ** 0.5
        unmoved = (float((kernel - seen).square().mean()) / power) ** 0.5
    everywhere = np.array([(x, y) for y, x in product(plane.y_m, plane.x_m)]) - places[middle]
    image = moved(kernel, everywhere @ jacobian.T)  # [h w, H, W]
    edge = torch.cat([kernel[0], kernel[-1], kernel[:, 0], kernel[:, -1]])
    border = float(edge.abs().max() / kernel.max().clamp(min=1e-12))
    (a, b), (c, d) = jacobian.tolist()
    check = PsfCheck(cells[middle], ((a, b), (c, d)), len(others), error, unmoved, border)
    return image.flatten(1).mT.to(torch.float32).contiguous(), check


def moved(kernel: torch.Tensor, shift_px: NDArray[np.float64]) -> torch.Tensor:
    """Return an image [H, W] moved by (columns, rows) [n, 2], pixels: [n, H, W]; borders go on outside."""
    height, width = kernel.shape
    shift = torch.from_numpy(np.ascontiguousarray(shift_px, dtype=np.float64))
    u = torch.arange(width, dtype=torch.float64) - shift[:, :1]  # [n, W]
    v = torch.arange(height, dtype=torch.float64) - shift[:, 1:]  # [n, H]
    x, y = (2 * u + 1) / width - 1, (2 * v + 1) / height - 1
    grid = torch.stack(
        [x[:, None, :].expand(-1, height, -1), y[:, :, None].expand(-1, -1, width)], dim=-1
    )  # [n, H, W, 2]
    source = kernel[None, None].expand(len(shift), 1, height, width)
    return grid_sample(source, grid, mode="bicubic", padding_mode="border", align_corners=False)[:, 0]


def _fitted(
    kernel: torch.Tensor, seen: torch.Tensor, steps: NDArray[np.float64], shape: tuple[int, int]
) -> PxPerM:
    if len(steps) < 2 or np.linalg.matrix_rank(steps, tol=1e-9) < 2:
        raise DataError(
            f"{len(steps) + 1} points do not tell how the image moves with the light; state image_px_per_m in "
            "scan.yaml, or measure three cells that do not lie on a line"
        )
    reach = float(np.abs(steps).max())
    largest = float(np.hypot(*shape)) / reach  # pixels per metre: across the whole image in one step

    def residual(p: NDArray[np.float64]) -> torch.Tensor:
        return (moved(kernel, steps @ p.reshape(2, 2).T) - seen).flatten()

    # The first guess comes from the columns' middles of light; a search around it takes out their bias.
    u, v = torch.arange(shape[1], dtype=torch.float64), torch.arange(shape[0], dtype=torch.float64)

    def middle(images: torch.Tensor) -> NDArray[np.float64]:
        light = (images - images.amin(dim=(-2, -1), keepdim=True)) ** 2
        total = light.sum(dim=(-2, -1))
        return torch.stack(
            [(light.sum(-2) * u).sum(-1) / total, (light.sum(-1) * v).sum(-1) / total], -1
        ).numpy()

    guess = np.linalg.lstsq(steps, middle(seen) - middle(kernel[None]), rcond=None)[0].T
    guess = np.clip(guess, -0.99 * largest, 0.99 * largest)
    found = levenberg_marquardt(
        residual, guess.ravel().tolist(), [0.05 / reach] * 4, [(-largest, largest)] * 4, iterations=30
    )
    (a, b), (c, d) = found.values.reshape(2, 2).tolist()
    return (a, b), (c, d)
