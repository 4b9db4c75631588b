"""How far a model and a camera are apart, in one number that noise bounds from below."""

from __future__ import annotations

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
