"""One object from its whole pass: Tikhonov and total variation on the normal equations of all positions."""

from __future__ import annotations

import math
from functools import cached_property

import torch

from evnlos.errors import ConfigError, DataError
from evnlos.solver.operators import Gradient, normal_matrix
from evnlos.solver.plate_pass import PlatePass, mean_weight, strip_gram_of
from evnlos.solver.solution import Solution
from evnlos.solver.spectrum import smallest
from evnlos.solver.total_variation import total_variation
from evnlos.transport import MatrixTransport

_GRID = torch.logspace(-12, 0, 97, dtype=torch.float64)
_KEPT = 1e-12  # of the largest eigenvalue; what lies below is rounding


class JointProblem:
    """Find the plate x behind N pictures y_k = A S_k x + b + noise, b unknown and the same in all of them.

    With R = A^T C^-1 A accumulated over the positions (`PlatePass.gram`) the pictures are looked at once, and
    every lam costs a product of the plate's size. C holds independent noise and, of standard deviation `static`
    times the noise, a constant offset of each pixel: the camera's fixed pattern and ambient light.

    Args:
        sight: The pass.
        static: Standard deviation of the offsets over that of the noise, 0 or more; infinity: whatever does not
            move says nothing about the plate.
        strip_gram: A^T A, where it is at hand; passes over one strip share it.

    Raises:
        ConfigError: `static` is negative.
        DataError: The pass shows nothing of the plate.
    """

    def __init__(self, sight: PlatePass, static: float = 0.0, strip_gram: torch.Tensor | None = None) -> None:
        self.sight, self.static = sight, static
        strip_gram = strip_gram_of(sight.transport) if strip_gram is None else strip_gram
        self.gram = sight.gram(strip_gram, static)
        self._kept = mean_weight(len(sight), static)
        self.samples = len(sight) * sight.transport.matrix.shape[0]
        # What a difference of equal matrices leaves is rounding.
        if float(self.gram.diagonal().max()) <= _KEPT * float(strip_gram.diagonal().max()):
            raise DataError(
                "the pass shows nothing of the plate; give positions that differ, or a lower static"
            )

    @property
    def scale(self) -> float:
        """The natural unit of lam: the largest eigenvalue of the Gram matrix over that of the prior, 8."""
        return float(self._eigen[0][-1]) / 8

    def tikhonov(self, images: torch.Tensor, lam: float | None = None) -> Solution:
        """Return argmin |C^-1/2 (A S x - y)|^2 + lam |grad x|^2, the plate's border counted as an edge.

        Args:
            images: y without known ambient light, [..., N, H, W]; leading axes are a batch, which shares lam.
            lam: Weight of the prior, squared white levels; None: by generalised cross-validation, which takes
                the errors of all pictures' samples to be independent.

        Raises:
            ConfigError: lam is not 0 or more.
            DataError: The pictures are not those of the pass.
        """
        if lam is not None and not (math.isfinite(lam) and lam >= 0):
            raise ConfigError(f"lam is {lam}; give 0 or more, or None for generalised cross-validation")
        back, energy = self._seen(images)
        values, basis = self._spectrum
        seen = torch.where(values > _KEPT * values[-1], back @ basis, 0.0)  # [B, C]

        def residual(weight: float) -> torch.Tensor:
            explained = seen.square() * (values + 2 * weight) / (values + weight).square()
            return (energy - explained.sum(dim=-1)).clamp(min=0)  # [B]

        def freedom(weight: float) -> float:
            return max(self.samples - float((values / (values + weight)).sum()), 1e-9)

        if lam is None:
            grid = (float(values[-1]) * _GRID).numpy()
            lam = smallest(lambda weight: float(residual(weight).sum()) / freedom(weight) ** 2, grid)
        image = (seen / (values + lam)) @ basis.mT
        left = residual(lam)
        sigma = float((left.mean() / freedom(lam)).sqrt())
        image = image.reshape(*images.shape[:-3], *self.sight.plate.shape)
        left = left.sqrt().reshape(images.shape[:-3])
        return Solution(image, lam, 0, True, left, sigma, self.samples - freedom(lam))

    def total_variation(
        self, images: torch.Tensor, lam: float, box: tuple[float, float] = (0.0, 1.0), tolerance: float = 1e-4
    ) -> Solution:
        """Return argmin over low <= x <= high of |C^-1/2 (A S x - y)|^2 / 2 + lam sum |grad x|.

        Args:
            images: y without known ambient light, [..., N, H, W].
            lam: Weight of the variation, squared white levels, above 0.
            box: Lowest and highest brightness of a cell.
            tolerance: Relative primal-dual gap at which to stop.

        Raises:
            ConfigError: lam is not positive, or the box is empty.
            DataError: The pictures are not those of the pass.
        """
        back, energy = self._seen(images)
        plate, (values, vectors) = self.sight.plate, self._eigen
        root = values.sqrt()
        # |F x - f|^2 with F^T F = R and F^T f = A^T C^-1 y differs from the pass's misfit by a constant.
        compressed = MatrixTransport((vectors * root).mT, plate, plate.shape)
        target = torch.where(root > 0, back @ vectors / root, 0.0)  # [B, C]
        batch = images.shape[:-3]
        found = total_variation(
            compressed, target.reshape(*batch, *plate.shape), lam, box=box, border="dark", tolerance=tolerance
        )
        image = found.image.flatten(-2)
        left = energy.reshape(batch) + ((image @ self.gram - 2 * back.reshape(image.shape)) * image).sum(-1)
        left = left.clamp(min=0)
        sigma = float((left.mean() / self.samples).sqrt())
        return Solution(
            found.image, lam, found.iterations, found.converged, left.sqrt(), sigma, history=found.history
        )

    def _seen(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return A^T C^-1 y [B, C] and y^T C^-1 y [B]."""
        wanted = (len(self.sight), *self.sight.transport.shape)
        if tuple(images.shape[-3:]) != wanted or not images.is_floating_point():
            raise DataError(f"the pictures are {images.dtype} {tuple(images.shape)}; give real [..., {wanted}]")
        if not bool(torch.isfinite(images).all()):
            raise DataError("the pictures hold NaN or infinity")
        flat = images.double().reshape(-1, *wanted)
        whitened = flat - (1 - self._kept) * flat.mean(dim=1, keepdim=True)
        return self.sight.adjoint(whitened).flatten(1), (whitened * flat).sum(dim=(1, 2, 3))

    @cached_property
    def _eigen(self) -> tuple[torch.Tensor, torch.Tensor]:
        values, vectors = torch.linalg.eigh(self.gram)
        return torch.where(values > _KEPT * values[-1], values, 0.0), vectors

    @cached_property
    def _spectrum(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return s^2 and B with B^T R B = diag(s^2), B^T L^T L B = 1."""
        blank = torch.zeros(self.sight.plate.shape, dtype=torch.float64)
        lower = torch.linalg.cholesky(normal_matrix(Gradient("dark"), blank))
        half = torch.linalg.solve_triangular(lower, self.gram, upper=False)
        values, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(lower, half.mT, upper=False))
        basis = torch.linalg.solve_triangular(lower.mT, vectors, upper=True)
        return values.clamp(min=0), basis
