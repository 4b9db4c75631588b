"""How far a model and a camera are apart, in one number that noise bounds from below."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Residual:
    """Root mean square of camera minus model over the camera's standard deviation, over all pixels and images.

    Args:
        before: With the start's settings; frames with the gain and ambient light that suit them best.
        after: With the fit.
        noise: What noise alone makes: no model of the light can be better.
    """

    before: float
    after: float
    noise: float

    @property
    def unexplained(self) -> float:
        """What the fit leaves beside the noise, root mean square over the camera's standard deviation."""
        return math.sqrt(max(self.after**2 - self.noise**2, 0.0))
