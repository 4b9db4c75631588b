"""From a wall photograph to a picture of the hidden screen, every choice made without the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from evnlos.errors import ConfigError
from evnlos.solver.operators import Gradient
from evnlos.solver.photograph import Photograph
from evnlos.solver.problem import Background
from evnlos.solver.solution import Solution
from evnlos.solver.tikhonov import Rule, tikhonov, tikhonov_cv_error
from evnlos.solver.total_variation import total_variation
from evnlos.transport import MatrixTransport

DEGREES = range(7)
"""Degrees of the background to choose from."""
_ALIKE = 1.05


@dataclass(frozen=True, eq=False)
class Inversion:
    """A photograph's operator and what was decided for it.

    Args:
        operator: From screen to wall, largest singular value 1.
        measurement: The wall, its largest value 1, [channels, H, W].
        degree: Degree of the background polynomial.
        cv_errors: Mean squared cross-validation error of each degree tried; empty where it was given.
    """

    operator: MatrixTransport
    measurement: torch.Tensor
    degree: int
    cv_errors: tuple[float, ...] = ()

    def solve(
        self,
        solver: Literal["tikhonov", "tv"],
        lam: float | None = None,
        rule: Rule = "cv",
        noise_sigma: float | None = None,
    ) -> Solution:
        """Return the screen's picture, [channels, h, w], in units of the wall's largest value over the norm.

        Args:
            solver: "tikhonov" with the gradient towards a dark border as prior, or "tv", total variation with
                brightness 0 or more.
            lam: Weight of the prior, without unit here; None: by `rule`.
            rule: "cv", "discrepancy", and for "tikhonov" also "gcv".
            noise_sigma: Noise of a wall sample in units of the largest, for "discrepancy"; None estimates it
                from the misfit of Tikhonov's GCV solution.

        Raises:
            ConfigError: The rule is not one of the solver's.
        """
        nuisance = Background(self.degree)
        if lam is None and rule == "discrepancy" and noise_sigma is None:
            first = tikhonov(self.operator, self.measurement, prior=Gradient("dark"), nuisance=nuisance)
            noise_sigma = first.noise_sigma
        if solver == "tikhonov":
            return tikhonov(
                self.operator,
                self.measurement,
                lam,
                rule=rule,
                noise_sigma=noise_sigma,
                prior=Gradient("dark"),
                nuisance=nuisance,
            )
        if lam is None and rule == "gcv":
            raise ConfigError("rule 'gcv' needs a linear solver; with 'tv' use 'cv', 'discrepancy' or a number")
        return total_variation(
            self.operator,
            self.measurement,
            lam,
            rule="discrepancy" if rule == "discrepancy" else "cv",
            noise_sigma=noise_sigma,
            nuisance=nuisance,
        )


def prepare_inversion(
    photograph: Photograph, *, degree: int | None = None, occluded: bool = True, bin: int | None = None
) -> Inversion:
    """Return the operator and the background of a photograph.

    Args:
        photograph: The photograph as taken.
        degree: Degree of the background; None takes the smallest whose cross-validation error is
            within 5 % of the least.
        occluded: Whether the operator knows of the occluders.
        bin: Wall pixels a side that are averaged; None leaves at most 48 a side.
    """
    photograph = photograph.binned(bin)
    operator, measurement = photograph.transport(occluded=occluded), photograph.measurement()
    if degree is not None:
        return Inversion(operator, measurement, degree)
    errors = background_errors(operator, measurement)
    return Inversion(operator, measurement, _smallest_alike(errors), errors)


def chosen_degree(operator: MatrixTransport, measurement: torch.Tensor) -> int:
    """Return the smallest degree of the background whose cross-validation error is within 5 % of the least.

    Args:
        operator: From the hidden cells to the wall.
        measurement: The wall, [channels, H, W].
    """
    return _smallest_alike(background_errors(operator, measurement))


def _smallest_alike(errors: tuple[float, ...]) -> int:
    # Where errors are alike the smaller background is the better guess: it takes less from the scene.
    return next(d for d, error in zip(DEGREES, errors, strict=True) if error <= _ALIKE * min(errors))


def background_errors(operator: MatrixTransport, measurement: torch.Tensor) -> tuple[float, ...]:
    """Return the cross-validation error of each of `DEGREES` on pairs of rows and columns averaged.

    Half the resolution is enough to tell smooth backgrounds apart, and an eighth of the work.
    """
    height, width = (side // 2 for side in measurement.shape[-2:])

    def halved(image: torch.Tensor) -> torch.Tensor:
        image = image[..., : 2 * height, : 2 * width].unflatten(-2, (height, 2)).unflatten(-1, (width, 2))
        return image.mean(dim=(-3, -1))

    cells = operator.matrix.shape[1]
    rows = halved(operator.matrix.mT.reshape(cells, *operator.shape)).flatten(1).mT
    coarse = MatrixTransport(rows, operator.source, (height, width))
    return tuple(
        tikhonov_cv_error(coarse, halved(measurement), prior=Gradient("dark"), nuisance=Background(degree))
        for degree in DEGREES
    )
