"""One target seen at many positions: the operator from its cells to all images, and its Gram matrix.

- One object from its whole sequence: Tikhonov and total variation on the normal equations of all positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import Gradient, Solution, normal_matrix
from evnlos.inverse.problem import SeveralSequences
from evnlos.inverse.tikhonov import smallest
from evnlos.inverse.total_variation import total_variation
from evnlos.optics import LinearTransport, MatrixTransport
from evnlos.types import Plane


@dataclass(frozen=True, eq=False)
class SequenceOperator:
    """The linear map x -> (A S_1 x, ..., A S_N x), S_k the target plane's cells drawn on the strip at position
    k.

    A strip's cell gets the exact mean of the target over it, so positions need not fall on cells. Cells beyond
    the strip's border are lost.

    Args:
        transport: A, from the strip's cells to the camera, white levels per unit of brightness.
        target_plane: The target plane's cells, in coordinates relative to its centre.
        positions_m: Centre (x, y) of the target at each position, [N, 2], metres.

    Raises:
        DataError: The positions are not [N, 2] finite numbers, or the target never touches the strip.
        ConfigError: The transport starts from patches.
    """

    transport: MatrixTransport
    target_plane: Plane
    positions_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        positions = np.array(self.positions_m, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 2 or not len(positions):
            raise DataError(f"positions_m has shape {positions.shape}; give [N, 2], one (x, y) a position")
        if not np.isfinite(positions).all():
            raise DataError("positions_m holds NaN or infinity; give finite metres")
        if not isinstance(self.transport.source, Plane):
            raise ConfigError("the matrix starts from patches; a moving target needs a Plane of square cells")
        object.__setattr__(self, "positions_m", positions)
        if not any(bool(y.any() and x.any()) for y, x in self._shares):
            raise DataError("the target lies off the strip at every position; check the positions or the strip")

    def __len__(self) -> int:
        return len(self.positions_m)

    def __call__(self, target: torch.Tensor, /) -> torch.Tensor:
        """Return the images [..., N, H, W] of a target [..., n, n]."""
        return self.transport(self.drawn(target))

    def adjoint(self, images: torch.Tensor, /) -> torch.Tensor:
        """Return the transpose, [..., N, H, W] -> [..., n, n]."""
        strips = self.transport.adjoint(images)  # [..., N, h, w]
        back = strips.new_zeros((*strips.shape[:-3], *self.target_plane.shape))
        for k, (y, x) in enumerate(self._shares):
            back += y.to(strips).mT @ strips[..., k, :, :] @ x.to(strips)
        return back

    def matrix(self) -> torch.Tensor:
        """Return the dense map of each position, [N, H W, n n], in the transport's type."""
        height, width = self.transport.source.shape  # type: ignore[union-attr] - checked above
        cells = self.transport.matrix.unflatten(1, (height, width))  # [P, h, w]
        dense = []
        for y, x in self._shares:
            rows, columns = (torch.nonzero(share.any(dim=1)).flatten() for share in (y, x))
            near = cells[:, rows][:, :, columns] @ x[columns].to(cells)  # [P, h', n]
            dense.append((near.mT @ y[rows].to(cells)).mT.flatten(1))
        return torch.stack(dense)

    def drawn(self, target: torch.Tensor) -> torch.Tensor:
        """Return the strip at each position, [..., N, h, w], of a target [..., n, n]."""
        return torch.stack([y.to(target) @ target @ x.to(target).mT for y, x in self._shares], dim=-3)

    def gram(self, strip_gram: torch.Tensor, static: float = 0.0) -> torch.Tensor:
        """Return sum S_k^T G S_k - (1 - rho) N S^T G S with S the mean of S_k, rho = 1 / (1 + N static^2).

        That is the sequence's A^T C^-1 A where each camera pixel has independent noise of variance 1 and one
        unknown offset of variance static^2 in all positions. It costs N small products once G is known.

        Args:
            strip_gram: G = A^T A, [cells, cells], the same for every motion.
            static: Standard deviation of a pixel's constant offset over that of its noise, 0 or more; infinity
                ignores whatever does not move.

        Returns:
            float64 [n n, n n].
        """
        total = self.cross_gram(self, strip_gram, static)
        return (total + total.mT) / 2

    def cross_gram(
        self, other: SequenceOperator, strip_gram: torch.Tensor, static: float = 0.0
    ) -> torch.Tensor:
        """Return A^T C^-1 B, [n n, m m], with B the map of another target over the same strip; see `gram`."""
        strip, pairs = self.transport.source.shape, zip(self._shares, other._shares, strict=True)
        total = reduce(torch.add, (_sandwich(strip_gram, strip, one, beside) for one, beside in pairs))
        if (kept := mean_weight(len(self), static)) < 1:
            total -= (1 - kept) * len(self) * (self._mean.mT @ (strip_gram.double() @ other._mean))
        return total

    @property
    def canvas(self) -> tuple[int, ...]:
        """Size (n, n) of what is looked for."""
        return self.target_plane.shape

    @cached_property
    def _mean(self) -> torch.Tensor:
        """Return the mean of S_k, [strip cells, target cells]."""
        return reduce(torch.add, (torch.kron(y, x) for y, x in self._shares)) / len(self)

    @cached_property
    def _shares(self) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return of each position how much of a strip's row, column each row, column of the target plane
        covers.
        """
        strip = self.transport.source
        assert isinstance(strip, Plane)  # checked above
        return [
            (
                _share(strip.y_m, strip.pitch_m, self.target_plane.y_m + y, self.target_plane.pitch_m),
                _share(strip.x_m, strip.pitch_m, self.target_plane.x_m + x, self.target_plane.pitch_m),
            )
            for x, y in self.positions_m
        ]


def mean_weight(positions: int, static: float) -> float:
    """Return what the mean over the positions still counts, 1 / (1 + N static^2).

    Raises:
        ConfigError: `static` is negative.

    Example:
        >>> mean_weight(4, 0.5), mean_weight(40, float("inf"))
        (0.5, 0.0)
    """
    if not static >= 0:
        raise ConfigError(f"static is {static}; give 0 or more, infinity to ignore all that rests")
    return 1 / (1 + positions * static**2)


def strip_of(positions_m: ArrayLike, target_plane: Plane) -> Plane:
    """Return the strip of cells, of the target's pitch, that holds the target at all positions [N, 2], metres.

    Example:
        >>> strip_of([(-0.08, 0.0), (0.08, 0.0)], Plane(32, 32, 0.0025)).extent_m
        (0.08, 0.24)
    """
    places = np.asarray(positions_m, dtype=np.float64)
    low, high = places.min(axis=0), places.max(axis=0)
    width, height = (
        side + math.ceil(reach / target_plane.pitch_m - 1e-6)
        for side, reach in zip((target_plane.width, target_plane.height), (high - low).tolist(), strict=True)
    )
    middle_x, middle_y = ((low + high) / 2 + target_plane.center_m).tolist()
    return Plane(height, width, target_plane.pitch_m, (middle_x, middle_y))


def matrix_of(operator: LinearTransport) -> MatrixTransport:
    """Return a linear map by its matrix, float64: what a sequence multiplies many times."""
    return MatrixTransport(operator.dense(), operator.source, operator.shape)


def strip_gram_of(transport: MatrixTransport) -> torch.Tensor:
    """Return A^T A, float64 [cells, cells]: its small eigenvalues would drown in float32's rounding."""
    matrix = transport.matrix.double()
    return matrix.mT @ matrix


def _share(
    strip_m: NDArray[np.float64], strip_pitch: float, cell_m: NDArray[np.float64], cell_pitch: float
) -> torch.Tensor:
    """Return the share of each of the strip's cells that each of the target's covers, [strip, target]."""
    low = np.maximum(strip_m[:, None] - strip_pitch / 2, cell_m - cell_pitch / 2)
    high = np.minimum(strip_m[:, None] + strip_pitch / 2, cell_m + cell_pitch / 2)
    return torch.from_numpy(np.maximum(high - low, 0.0) / strip_pitch)


def _sandwich(
    gram: torch.Tensor,
    shape: tuple[int, int],
    left: tuple[torch.Tensor, torch.Tensor],
    right: tuple[torch.Tensor, torch.Tensor],
) -> torch.Tensor:
    """Return (y kron x)^T G (v kron u); only cells that the targets touch are looked at."""
    sides = [
        (y, x, torch.nonzero(y.any(dim=1)).flatten(), torch.nonzero(x.any(dim=1)).flatten())
        for y, x in (left, right)
    ]
    index = [(rows[:, None] * shape[1] + columns).flatten() for _, _, rows, columns in sides]
    product = gram[index[0]][:, index[1]].double()  # [r c, m]
    for y, x, rows, columns in sides:
        parts = product.unflatten(0, (len(rows), len(columns)))  # [r, c, m]
        product = torch.einsum("rcm,rj->jcm", parts, y[rows])
        product = torch.einsum("jcm,ci->jim", product, x[columns]).flatten(0, 1).mT  # [m, n n]
    return product


_GRID = torch.logspace(-12, 0, 97, dtype=torch.float64)
_KEPT = 1e-12  # of the largest eigenvalue; what lies below is rounding


class SequenceProblem:
    """Find the target x behind N images y_k = A S_k x + b + noise, b unknown and the same in all of them.

    With R = A^T C^-1 A accumulated over the positions (`SequenceOperator.gram`) the images are looked at
    once, and every regularization costs a product of the target's size. C holds independent noise and, of
    standard deviation `static` times the noise, a constant offset of each pixel: the camera's fixed pattern and
    ambient light.

    Args:
        sight: The sequence of one target, or of several at once: they are solved for together.
        static: Standard deviation of the offsets over that of the noise, 0 or more; infinity: whatever does not
            move says nothing about the target.
        strip_gram: A^T A, where it is at hand; sequences over one strip share it.

    Raises:
        ConfigError: `static` is negative.
        DataError: The sequence shows nothing of the target.
    """

    def __init__(
        self,
        sight: SequenceOperator | SeveralSequences,
        static: float = 0.0,
        strip_gram: torch.Tensor | None = None,
    ) -> None:
        self.sight, self.static = sight, static
        strip_gram = strip_gram_of(sight.transport) if strip_gram is None else strip_gram
        self.gram = sight.gram(strip_gram, static)
        self._kept = mean_weight(len(sight), static)
        self.samples = len(sight) * sight.transport.matrix.shape[0]
        # What a difference of equal matrices leaves is rounding.
        if float(self.gram.diagonal().max()) <= _KEPT * float(strip_gram.diagonal().max()):
            raise DataError(
                "the sequence shows nothing of the target; give positions that differ, or a lower static"
            )

    @property
    def scale(self) -> float:
        """The natural unit of regularization: the largest eigenvalue of the Gram matrix over that of the prior,
        8.
        """
        return float(self._eigen[0][-1]) / 8

    def tikhonov(self, images: torch.Tensor, regularization: float | None = None) -> Solution:
        """Return argmin |C^-1/2 (A S x - y)|^2 + regularization |grad x|^2, the target's border counted as an
        edge.

        Args:
            images: y without known ambient light, [..., N, H, W]; leading axes are a batch, which shares
                regularization.
            regularization: Weight of the prior, squared white levels; None: by generalised cross-validation,
                which takes the errors of all images' samples to be independent.

        Raises:
            ConfigError: regularization is not 0 or more.
            DataError: The images are not those of the sequence.
        """
        if regularization is not None and not (math.isfinite(regularization) and regularization >= 0):
            raise ConfigError(
                f"regularization is {regularization}; give 0 or more, or None for generalised cross-validation"
            )
        back, energy = self._seen(images)
        values, basis = self._spectrum
        seen = torch.where(values > _KEPT * values[-1], back @ basis, 0.0)  # [B, C]

        def residual(weight: float) -> torch.Tensor:
            explained = seen.square() * (values + 2 * weight) / (values + weight).square()
            return (energy - explained.sum(dim=-1)).clamp(min=0)  # [B]

        def freedom(weight: float) -> float:
            return max(self.samples - float((values / (values + weight)).sum()), 1e-9)

        if regularization is None:
            grid = (float(values[-1]) * _GRID).numpy()
            regularization = smallest(lambda weight: float(residual(weight).sum()) / freedom(weight) ** 2, grid)
        image = (seen / (values + regularization)) @ basis.mT
        left = residual(regularization)
        sigma = float((left.mean() / freedom(regularization)).sqrt())
        image = image.reshape(*images.shape[:-3], *self.sight.canvas)
        left = left.sqrt().reshape(images.shape[:-3])
        return Solution(image, regularization, 0, True, left, sigma, self.samples - freedom(regularization))

    def total_variation(
        self,
        images: torch.Tensor,
        regularization: float,
        box: tuple[float, float] = (0.0, 1.0),
        tolerance: float = 1e-4,
    ) -> Solution:
        """Return argmin over low <= x <= high of |C^-1/2 (A S x - y)|^2 / 2 + regularization sum |grad x|.

        Args:
            images: y without known ambient light, [..., N, H, W].
            regularization: Weight of the variation, squared white levels, above 0.
            box: Lowest and highest brightness of a cell.
            tolerance: Relative primal-dual gap at which to stop.

        Raises:
            ConfigError: regularization is not positive, the box is empty, or there are several targets.
            DataError: The images are not those of the sequence.
        """
        if isinstance(self.sight, SeveralSequences):
            raise ConfigError(f"{self.sight.canvas[0]} targets; total variation takes one: give tikhonov")
        back, energy = self._seen(images)
        target_plane, (values, vectors) = self.sight.target_plane, self._eigen
        root = values.sqrt()
        # |F x - f|^2 with F^T F = R and F^T f = A^T C^-1 y differs from the sequence's misfit by a constant.
        compressed = MatrixTransport((vectors * root).mT, target_plane, target_plane.shape)
        target = torch.where(root > 0, back @ vectors / root, 0.0)  # [B, C]
        batch = images.shape[:-3]
        found = total_variation(
            compressed,
            target.reshape(*batch, *target_plane.shape),
            regularization,
            box=box,
            border="dark",
            tolerance=tolerance,
        )
        image = found.image.flatten(-2)
        left = energy.reshape(batch) + ((image @ self.gram - 2 * back.reshape(image.shape)) * image).sum(-1)
        left = left.clamp(min=0)
        sigma = float((left.mean() / self.samples).sqrt())
        return Solution(
            found.image,
            regularization,
            found.iterations,
            found.converged,
            left.sqrt(),
            sigma,
            history=found.history,
        )

    def _seen(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return A^T C^-1 y [B, C] and y^T C^-1 y [B]."""
        wanted = (len(self.sight), *self.sight.transport.shape)
        if tuple(images.shape[-3:]) != wanted or not images.is_floating_point():
            raise DataError(f"the images are {images.dtype} {tuple(images.shape)}; give real [..., {wanted}]")
        if not bool(torch.isfinite(images).all()):
            raise DataError("the images hold NaN or infinity")
        flat = images.double().reshape(-1, *wanted)
        whitened = flat - (1 - self._kept) * flat.mean(dim=1, keepdim=True)
        return self.sight.adjoint(whitened).reshape(len(flat), -1), (whitened * flat).sum(dim=(1, 2, 3))

    @cached_property
    def _eigen(self) -> tuple[torch.Tensor, torch.Tensor]:
        values, vectors = torch.linalg.eigh(self.gram)
        return torch.where(values > _KEPT * values[-1], values, 0.0), vectors

    @cached_property
    def _spectrum(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return s^2 and B with B^T R B = diag(s^2), B^T L^T L B = 1."""
        blank = torch.zeros(self.sight.canvas[-2:], dtype=torch.float64)
        lower = torch.linalg.cholesky(normal_matrix(Gradient("dark"), blank))
        lower = torch.block_diag(*[lower] * math.prod(self.sight.canvas[:-2]))
        half = torch.linalg.solve_triangular(lower, self.gram, upper=False)
        values, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(lower, half.mT, upper=False))
        basis = torch.linalg.solve_triangular(lower.mT, vectors, upper=True)
        return values.clamp(min=0), basis


def position_subsets(count: int, positions: int, subsets: int) -> list[NDArray[np.int64]]:
    """Return up to `subsets` different, equally spaced choices of `positions` out of `count`.

    Raises:
        ConfigError: Fewer than one position, or more than there are.

    Example:
        >>> [one.tolist() for one in position_subsets(40, 2, 2)]
        [[5, 25], [15, 35]]
    """
    if not 1 <= positions <= count or subsets < 1:
        raise ConfigError(
            f"{positions} positions of {count} in {subsets} subsets; give 1 to {count}, and 1 or more"
        )
    found: dict[tuple[int, ...], NDArray[np.int64]] = {}
    for k in range(subsets):
        chosen = np.floor((np.arange(positions) + (k + 0.5) / subsets) * count / positions).astype(np.int64)
        found.setdefault(tuple(chosen.tolist()), chosen)
    return list(found.values())
