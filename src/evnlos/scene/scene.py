"""A hidden object: a flat, square target with a mask of where it shines, and its drawing on a plane.

- What is hidden: a target and how it moves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.scene.motion import LineMotion, Motion, Pose, pose_of
from evnlos.types import Plane

_MAX_SIDE = 4096  # pixels; a drawing of 20 um a pixel on an 8 cm target


@dataclass(frozen=True, eq=False)
class Target:
    """A flat, square target that moves behind the corner.

    Args:
        name: Name of the object, not empty.
        mask: How bright each part of the target is, float32 [S, S], 0..1, row 0 on top; it covers the target.
        size_m: Side of the target plane, metres.

    Raises:
        DataError: The mask is not square, holds NaN or values outside 0..1, or the size is not positive.

    Example:
        >>> Target("square", np.ones((4, 4)), size_m=0.08)
        Target('square', 4 x 4 px, 0.08 m)
    """

    name: str
    mask: NDArray[np.float32]
    size_m: float = 0.08

    def __post_init__(self) -> None:
        if not self.name:
            raise DataError("Target.name is empty; give the object a name")
        mask = np.array(self.mask, dtype=np.float32)  # a copy: the caller's array stays his own
        if mask.ndim != 2 or mask.shape[0] != mask.shape[1] or not 1 <= mask.shape[0] <= _MAX_SIDE:
            raise DataError(
                f"Target.mask of {self.name} is {mask.shape}; give a square of 1 to {_MAX_SIDE} pixels"
            )
        # NaN fails both comparisons, so the range check finds it too.
        if not (mask.min() >= 0 and mask.max() <= 1):
            raise DataError(
                f"Target.mask of {self.name} holds {mask.min()}..{mask.max()}; give finite values from 0 to 1"
            )
        if not (np.isfinite(self.size_m) and self.size_m > 0):
            raise DataError(f"Target.size_m of {self.name} is {self.size_m}; give a positive number of metres")
        mask.setflags(write=False)
        object.__setattr__(self, "mask", mask)
        object.__setattr__(self, "size_m", float(self.size_m))

    def __repr__(self) -> str:
        side = self.mask.shape[0]
        return f"Target({self.name!r}, {side} x {side} px, {self.size_m:g} m)"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Target):
            return NotImplemented
        same = (self.name, self.size_m) == (other.name, other.size_m)
        return same and np.array_equal(self.mask, other.mask)

    def rasterise(self, plane: Plane, position_m: ArrayLike = (0.0, 0.0)) -> NDArray[np.float32]:
        """Draw the target on a sampled plane, exactly: each sample is the mean of the mask over its cell.

        With O_y [H, S] and O_x [W, S] the fractions of each cell that each mask pixel covers along one axis,
        the picture is O_y mask O_x^T (computed from running integrals). Light is conserved: where the whole
        target lies on the plane, picture.sum() pitch^2 = mask.mean() size^2, at any sub-pixel position.

        Args:
            plane: The plane to draw on.
            position_m: Target's centre (x, y) in the plane's coordinates, metres, [2], or [N, 2] for N places.

        Returns:
            float32 [H, W], or [N, H, W] for N places, 0..1; zero outside the target plane.

        Raises:
            DataError: The position is not finite or of another shape.

        Example:
            >>> Target("square", np.ones((2, 2)), size_m=0.03).rasterise(Plane(3, 4, 0.01), (0.005, 0.0))
            array([[0., 1., 1., 1.],
                   [0., 1., 1., 1.],
                   [0., 1., 1., 1.]], dtype=float32)
        """
        position = np.asarray(position_m, dtype=np.float64)
        if position.ndim not in (1, 2) or position.shape[-1] != 2:
            raise DataError(f"position_m has shape {position.shape}; give (x, y) or [N, 2] metres")
        if not np.isfinite(position).all():
            raise DataError("position_m holds NaN or infinity; give finite metres")
        places = position.reshape(-1, 2)  # [N, 2]
        x_edges = self._edges(plane.x_m, plane.pitch_m, places[:, 0])  # [N, W + 1]
        y_edges = self._edges(plane.y_m, plane.pitch_m, places[:, 1])  # [N, H + 1]
        picture = np.zeros((len(places), *plane.shape), np.float32)
        side = self.mask.shape[0]
        # Motion along a row is the usual case: places at one height share their vertical resampling.
        heights, group = np.unique(places[:, 1], return_inverse=True)
        integral = _integral(self.mask.astype(np.float64))  # [S + 1, S]
        for k in range(len(heights)):
            chosen = np.flatnonzero(group == k)
            y, x = _covered(y_edges[chosen[:1]], side), _covered(x_edges[chosen], side)
            rows = _cell_means(integral, y_edges[chosen[0], y.start : y.stop + 1])  # [h, S]
            columns = _cell_means(_integral(rows.T), x_edges[chosen, x.start : x.stop + 1])  # [n, w, h]
            picture[chosen, y, x] = columns.transpose(0, 2, 1)
        np.clip(picture, 0.0, 1.0, out=picture)
        return picture if position.ndim == 2 else picture[0]

    def _edges(
        self, centre_m: NDArray[np.float64], pitch_m: float, place_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the edges of a plane's cells, mask pixels from the target's edge, float64 [N, cells + 1]."""
        edge_m = np.append(centre_m - 0.5 * pitch_m, centre_m[-1] + 0.5 * pitch_m)
        side = self.mask.shape[0]
        return (edge_m[None, :] - place_m[:, None]) * (side / self.size_m) + 0.5 * side


def _covered(edges: NDArray[np.float64], side: int) -> slice:
    """Return the cells between edges [n, M + 1] (mask pixels) that touch 0..side in any of the n rows."""
    touched = np.flatnonzero(((edges[:, 1:] > 0) & (edges[:, :-1] < side)).any(axis=0))
    return slice(int(touched[0]), int(touched[-1]) + 1) if len(touched) else slice(0, 0)


def _integral(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the running integral of `image` [S, K] along its first axis, from 0, float64 [S + 1, K]."""
    return np.concatenate([np.zeros((1, image.shape[1])), np.cumsum(image, axis=0)])


def _cell_means(integral: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of an image over cells along its first axis, zero outside it, float64 [..., M, K].

    The integral of a piecewise constant image is piecewise linear: its value at each cell's edge is exact.

    Args:
        integral: Running integral of the image, float64 [S + 1, K]; image row s covers s..s + 1.
        edges: Edges of M cells of equal width, rows, float64 [..., M + 1].
    """
    side = len(integral) - 1
    if edges.shape[-1] < 2:
        return np.zeros((*edges.shape[:-1], 0, integral.shape[1]))
    inside = np.clip(edges, 0, side)
    row = np.minimum(inside.astype(np.intp), side - 1)
    part = (inside - row)[..., None]
    at_edge = (1 - part) * integral[row] + part * integral[row + 1]  # [..., M + 1, K]
    width = (edges[..., -1:] - edges[..., :1]) / (edges.shape[-1] - 1)  # [..., 1]
    return np.diff(at_edge, axis=-2) / width[..., None]


@dataclass(frozen=True)
class Scene:
    """A target, its motion, and for how long it is watched.

    Args:
        target: The hidden target.
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
