"""A measurement with its operator, its noise weights and the background that is to be ignored.

- The weight of a prior by leaving out blocks of the wall: no truth, and no belief in independent errors.
- Several targets at once.
- Our operators as physics of deepinv, so that its solvers and networks run on them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch

from evnlos.errors import ConfigError, DataError, MissingDependencyError
from evnlos.inverse.operators import LinearOperator
from evnlos.optics import MatrixTransport, dense_matrix

if TYPE_CHECKING:
    from evnlos.inverse.sequence_problem import SequenceOperator

_MAX_DEGREE = 12


@dataclass(frozen=True)
class BackgroundModel:
    """Light that the model does not hold: a polynomial in the wall's coordinates, fitted and thrown away.

    All solvers project it out of measurement and operator, so they see only what no such polynomial explains.
    That costs (degree + 1)(degree + 2) / 2 numbers of the measurement, and whatever of the hidden scene is as
    smooth as that.

    Args:
        degree: Total degree, 0 (a constant) to 12.

    Raises:
        ConfigError: A degree outside that range.

    Example:
        >>> BackgroundModel(degree=2).polynomials((4, 5)).shape
        torch.Size([6, 4, 5])
    """

    degree: int = 2

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= _MAX_DEGREE:
            raise ConfigError(f"Background.degree is {self.degree}; give 0 to {_MAX_DEGREE}")

    def polynomials(self, shape: tuple[int, int]) -> torch.Tensor:
        """Return the products of Legendre polynomials up to the degree, float64 [K, H, W]."""
        v, u = (
            torch.linspace(-1, 1, n, dtype=torch.float64) if n > 1 else torch.zeros(1).double() for n in shape
        )
        along_x, along_y = _legendre(u, self.degree), _legendre(v, self.degree)
        return torch.stack(
            [
                along_y[j][:, None] * along_x[i]
                for i in range(self.degree + 1)
                for j in range(self.degree + 1 - i)
            ]
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """Find x with A x + background = y up to noise: as an operator, P W A with the target P W y.

    W weighs the residual of each sample, P projects the weighted background out; so min |P W (A x - y)| is the
    weighted least-squares fit over x and the background together.

    Args:
        operator: A, linear with an adjoint.
        measurement: y, real [..., H, W]; leading axes are a batch (colours, frames).
        background_model: Background to project out.
        weight: Factor on each sample's residual, [H, W], 0 or more, one over its noise; 0 leaves a sample out.

    Raises:
        DataError: The measurement or the weight is not finite, has the wrong size or type, or fewer samples
            are left than the background has coefficients.
    """

    operator: LinearOperator
    measurement: torch.Tensor
    background_model: BackgroundModel | None = None
    weight: torch.Tensor | None = None

    def __post_init__(self) -> None:
        y, weight = self.measurement, self.weight
        if y.ndim < 2 or not y.is_floating_point():
            raise DataError(f"the measurement is {y.dtype} {tuple(y.shape)}; give real numbers [..., H, W]")
        if not bool(torch.isfinite(y).all()):
            raise DataError(
                "the measurement holds NaN or infinity; set the weight of such samples and them to 0"
            )
        if weight is not None:
            if weight.shape != y.shape[-2:] or not bool((torch.isfinite(weight) & (weight >= 0)).all()):
                raise DataError(
                    f"weight is {tuple(weight.shape)}; give {tuple(y.shape[-2:])} finite numbers, 0 or more"
                )
            object.__setattr__(self, "weight", weight.to(y))
        if self.samples < 1:
            raise DataError(f"{self.samples} samples are left after the background; give more samples")

    @cached_property
    def samples(self) -> int:
        """Number of samples that count, less the background's coefficients."""
        counted = self.measurement[..., 0, 0].new_ones(self.measurement.shape[-2:])
        counted = counted if self.weight is None else self.weight
        degree = -1 if self.background_model is None else self.background_model.degree
        return int((counted > 0).sum()) - (degree + 1) * (degree + 2) // 2

    @cached_property
    def scene_shape(self) -> tuple[int, int]:
        """Size (h, w) of the hidden image."""
        height, width = self.operator.adjoint(torch.zeros_like(self.measurement[..., :, :])).shape[-2:]
        return int(height), int(width)

    @cached_property
    def blank(self) -> torch.Tensor:
        """A black hidden image [h, w]."""
        return self.measurement.new_zeros(self.scene_shape)

    @cached_property
    def target(self) -> torch.Tensor:
        """P W y, [..., H, W]."""
        return self._project(self._weigh(self.measurement))

    @cached_property
    def matrix(self) -> torch.Tensor:
        """P W A as a matrix [H W, h w]."""
        matrix = dense_matrix(self.operator, self.blank)
        if self.weight is not None:
            matrix = self.weight.flatten()[:, None] * matrix
        return matrix if self._basis is None else matrix - self._basis @ (self._basis.mT @ matrix)

    def __call__(self, scene: torch.Tensor, /) -> torch.Tensor:
        """Return P W A x, [..., H, W]."""
        return self._project(self._weigh(self.operator(scene)))

    def adjoint(self, image: torch.Tensor, /) -> torch.Tensor:
        """Return A^T W P y, [..., h, w]."""
        return self.operator.adjoint(self._weigh(self._project(image)))

    def reweighted(self, factor: torch.Tensor) -> Problem:
        """Return the problem with its weights times `factor` [H, W]."""
        factor = factor.to(self.measurement)
        return replace(self, weight=factor if self.weight is None else self.weight * factor)

    def held_out_error(self, scene: torch.Tensor, held: torch.Tensor) -> float:
        """Return the sum of squared, weighted misfits of A x + background on the samples `held` (bool [H, W]).

        The background is fitted to the other samples.
        """
        rest = self._weigh(self.measurement - self.operator(scene)).flatten(-2)  # [..., H W]
        out = held.flatten()
        if self.background_model is not None:
            columns = self._columns
            known = torch.linalg.lstsq(
                columns[~out], rest[..., ~out].reshape(-1, int((~out).sum())).mT
            ).solution
            rest = rest - (columns @ known).mT.reshape(rest.shape)
        return float(rest[..., out].square().sum())

    @cached_property
    def _basis(self) -> torch.Tensor | None:
        return None if self.background_model is None else torch.linalg.qr(self._columns).Q  # [H W, K]

    @cached_property
    def _columns(self) -> torch.Tensor:
        assert self.background_model is not None
        shape = self.measurement.shape
        columns = self.background_model.polynomials((shape[-2], shape[-1])).to(self.measurement)
        return self._weigh(columns).flatten(1).mT  # [H W, K]

    def _weigh(self, image: torch.Tensor) -> torch.Tensor:
        return image if self.weight is None else image * self.weight

    def _project(self, image: torch.Tensor) -> torch.Tensor:
        if self._basis is None:
            return image
        flat = image.flatten(-2)  # [..., H W]
        return (flat - (flat @ self._basis) @ self._basis.mT).unflatten(-1, image.shape[-2:])


def _legendre(u: torch.Tensor, degree: int) -> list[torch.Tensor]:
    found = [torch.ones_like(u), u]
    for n in range(1, degree):
        found.append(((2 * n + 1) * u * found[n] - n * found[n - 1]) / (n + 1))
    return found[: degree + 1]


_HOPELESS = 1.1

Path = Callable[[Problem], Iterable[torch.Tensor]]
"""From a problem to its images [..., h, w], one for each regularization."""


@dataclass(frozen=True)
class Choice:
    """What cross-validation found.

    Args:
        regularization: The best regularization.
        errors: Mean squared misfit of a left-out sample for each regularization tried, in the squared weighted
            unit.
    """

    regularization: float
    errors: tuple[float, ...]


def block_folds(shape: tuple[int, int], *, blocks: int = 6, folds: int = 4) -> torch.Tensor:
    """Return the fold 0..folds - 1 of each sample: blocks x blocks rectangles, spread over the wall.

    Args:
        shape: Size (H, W) of the measurement.
        blocks: Blocks a side; their size must exceed the length over which the model's errors are alike.
        folds: Number of folds.

    Raises:
        ConfigError: Fewer than two folds, or more blocks a side than samples.

    Example:
        >>> block_folds((2, 4), blocks=2, folds=2)
        tensor([[0, 0, 1, 1],
                [1, 1, 0, 0]])
    """
    if folds < 2 or not 2 <= blocks <= min(shape):
        raise ConfigError(
            f"{blocks} blocks in {folds} folds on {shape}; give 2 or more, fewer than samples per side"
        )
    by, bx = (torch.arange(n) * blocks // n for n in shape)
    # A stride that shares no factor with the folds would put whole columns into few folds.
    stride = 1 if folds < 4 else 2
    return (by[:, None] + stride * bx + (by[:, None] // folds)) % folds


def cross_validate(
    problem: Problem, path: Path, regularizations: Sequence[float], folds: torch.Tensor
) -> Choice:
    """Return the regularization whose images, made from all blocks but a fold's, predict that fold best.

    The search ends early once the error is a tenth above the least one seen.

    Args:
        problem: The problem.
        path: From a problem to the images for `lams`, in their order; only those that are requested are made.
        regularizations: Weights of the prior to try, from the strongest to the weakest.
        folds: Fold of each sample, integers [H, W].
    """
    helds = [folds == fold for fold in range(int(folds.max()) + 1)]
    kept = [problem.reweighted((~held).to(problem.measurement)) for held in helds]
    errors: list[float] = []
    for images in zip(*(path(part) for part in kept), strict=True):
        misfits = [problem.held_out_error(image, held) for image, held in zip(images, helds, strict=True)]
        errors.append(sum(misfits) / problem.measurement.numel())
        if errors[-1] > _HOPELESS * min(errors):
            break
    best = errors.index(min(errors))
    return Choice(float(regularizations[best]), tuple(errors))


@dataclass(frozen=True, eq=False)
class SeveralSequences:
    """The linear map of several targets, each in its own frame: (x, y, ...) -> A x + B y + ...

    Args:
        parts: The map of each target, over one strip and of as many positions.

    Raises:
        DataError: There is none, or they differ in strip or positions.
    """

    parts: tuple[SequenceOperator, ...]

    def __post_init__(self) -> None:
        if len({(id(one.transport), len(one), one.target_plane.shape) for one in self.parts}) != 1:
            raise DataError(f"{len(self.parts)} targets differ in strip, positions or cells; give them alike")

    def __len__(self) -> int:
        return len(self.parts[0])

    def __call__(self, targets: torch.Tensor, /) -> torch.Tensor:
        """Return the images [..., N, H, W] of targets [..., K, n, n]."""
        lights = [one(targets[..., k, :, :]) for k, one in enumerate(self.parts)]
        return torch.stack(lights).sum(dim=0)

    def adjoint(self, images: torch.Tensor, /) -> torch.Tensor:
        """Return the transpose, [..., N, H, W] -> [..., K, n, n]."""
        return torch.stack([one.adjoint(images) for one in self.parts], dim=-3)

    def gram(self, strip_gram: torch.Tensor, static: float = 0.0) -> torch.Tensor:
        """Return A^T C^-1 A, float64 [K n n, K n n]: a block for each pair; see `SequenceOperator.gram`."""
        rows = [[one.cross_gram(other, strip_gram, static) for other in self.parts] for one in self.parts]
        total = torch.cat([torch.cat(row, dim=1) for row in rows])
        return (total + total.mT) / 2

    @property
    def transport(self) -> MatrixTransport:
        """The map from the strip to the camera."""
        return self.parts[0].transport

    @property
    def canvas(self) -> tuple[int, ...]:
        """Size (K, n, n) of what is looked for."""
        return len(self.parts), *self.parts[0].canvas


def as_physics(operator: LinearOperator, noise_sigma: float = 0.0) -> Any:
    """Return an operator as a `deepinv.physics.LinearPhysics`.

    deepinv works on batches [B, C, h, w]; every channel goes through the operator by itself. `A` and
    `A_adjoint` are those of the operator, in whatever dtype and on whatever device the images are.

    Args:
        operator: Linear, with an adjoint: any `LinearTransport`, or a `Problem` of the solver stage.
        noise_sigma: Standard deviation of the Gaussian noise that `physics(x)` adds, unit of the wall image.

    Returns:
        The physics.

    Raises:
        MissingDependencyError: deepinv is not installed.
        DataError: An image is not [B, C, h, w].
    """
    try:
        from deepinv.physics import GaussianNoise, LinearPhysics  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingDependencyError("this needs deepinv; pip install deepinv") from None

    class Transport(LinearPhysics):
        """The operator in deepinv's words."""

        def A(self, x: torch.Tensor, **_: Any) -> torch.Tensor:  # noqa: N802
            return operator(_batched(x))

        def A_adjoint(self, y: torch.Tensor, **_: Any) -> torch.Tensor:  # noqa: N802
            return operator.adjoint(_batched(y))

    return Transport(noise_model=GaussianNoise(sigma=noise_sigma)) if noise_sigma else Transport()


def _batched(image: torch.Tensor) -> torch.Tensor:
    if image.ndim != 4:
        raise DataError(f"the image is {tuple(image.shape)}; deepinv's physics takes [B, C, h, w]")
    return image
