"""What every solver hands back."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class Solution:
    """A reconstruction and how it came about.

    Args:
        image: The hidden image [..., h, w], in the measurement's type.
        lam: Weight of the prior, in the unit that the solver's equation gives it.
        iterations: Iterations of the last solve; 0 for a closed form.
        converged: Whether the stopping rule was met before the iterations ran out.
        residual: |P W (A x - y)| of each image of the batch, [...].
        noise_sigma: Standard deviation of one weighted sample's misfit, over its degrees of freedom where the
            solver knows them.
        dof: Degrees of freedom of the fit, the trace of the map from measurement to prediction; NaN where it is
            not known.
        history: Of each check of the stopping rule, its value: relative residual or relative gap.
    """

    image: torch.Tensor
    lam: float
    iterations: int
    converged: bool
    residual: torch.Tensor
    noise_sigma: float
    dof: float = float("nan")
    history: tuple[float, ...] = ()
