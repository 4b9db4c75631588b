"""Our operators as physics of deepinv, so that its solvers and networks run on them."""

from __future__ import annotations

from typing import Any

import torch

from evnlos.errors import DataError, MissingDependencyError
from evnlos.solver import LinearOperator


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
