"""What is hidden: a target and how it moves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.scene.motion import LineMotion, Motion, Pose, pose_of
from evnlos.scene.target import Target
from evnlos.types import Plane


@dataclass(frozen=True)
class Scene:
    """A target, its motion, and for how long it is watched.

    Args:
        target: The hidden plate.
        motion: Where its centre is at every instant.
        duration_s: Length of the recording that starts at 0 s, seconds.

    Raises:
        DataError: The duration is not positive and finite.

    Example:
        >>> scene = Scene(Target("square", np.ones((4, 4))))
        >>> scene.position_times_s(4)
        array([2., 4., 6., 8.])
    """

    target: Target
    motion: Motion = field(default_factory=LineMotion)
    duration_s: float = 8.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.duration_s) and self.duration_s > 0):
            raise DataError(f"Scene.duration_s is {self.duration_s}; give a positive number of seconds")

    def position_times_s(self, n: int = 40) -> NDArray[np.float64]:
        """Return the instants k duration / n, k = 1..n, of `n` equidistant positions, float64 [n], seconds."""
        if n < 1:
            raise DataError(f"n is {n}; ask for 1 position or more")
        return np.arange(1, n + 1) * self.duration_s / n

    def pose(self, t_s: ArrayLike) -> Pose:
        """Return x, y, z and rotation of the target at times `t_s` (seconds, any shape [...])."""
        return pose_of(self.motion, t_s)

    def truth(self, plane: Plane, t_s: ArrayLike) -> NDArray[np.float32]:
        """Return the target at times `t_s` (seconds, [] or [N]) on a plane, float32 [H, W] or [N, H, W]."""
        return self.target.rasterise(plane, self.motion.position_m(t_s))
