"""A matrix from a point-spread function: one measured column, moved to where every other cell's would be."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

from evnlos.calibration.least_squares import levenberg_marquardt
from evnlos.errors import DataError
from evnlos.types import Plane

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
    """Return a picture [H, W] moved by (columns, rows) [n, 2], pixels: [n, H, W]; borders go on outside."""
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
    largest = float(np.hypot(*shape)) / reach  # pixels a metre: across the whole image in one step

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
