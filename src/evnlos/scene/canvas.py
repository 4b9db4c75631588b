"""A square to draw shapes on, in units of the plate: from -1 to 1, x to the right and y down."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

_SUPERSAMPLING = 4
_ROUND = 48  # corners of a disc
_ARC_STEP = 0.15  # radians between the corners of an arc

Point = tuple[float, float]


class Canvas:
    """Shapes drawn one over the other, anti-aliased; each is turned, scaled and moved as the canvas says.

    Args:
        size_px: Side of the picture, pixels.
        angle: By how much the shapes are turned, radians.
        scale: By how much they are scaled.
        centre: Where their origin is.
        levels: Brightness range of a shape that is not black: a draw from it, or (1, 1) for white.
        draw: Where draws come from.
    """

    def __init__(
        self,
        size_px: int,
        draw: np.random.Generator,
        angle: float = 0.0,
        scale: float = 1.0,
        centre: Point = (0.0, 0.0),
        levels: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self._side = size_px * _SUPERSAMPLING
        self._image = Image.new("L", (self._side, self._side))
        self._pen = ImageDraw.Draw(self._image)
        self.draw = draw
        self.levels = levels
        self.place(angle, scale, centre)

    def place(self, angle: float, scale: float, centre: Point) -> None:
        """Turn, scale and move the shapes that follow."""
        c, s = np.cos(angle) * scale, np.sin(angle) * scale
        self._turn, self._centre = np.array([[c, -s], [s, c]]), np.array(centre)

    def polygon(self, points: ArrayLike, level: float | None = None) -> None:
        """Fill a polygon with corners [N, 2]; level 0 cuts a hole, None draws a brightness."""
        at = np.asarray(points, dtype=np.float64) @ self._turn.T + self._centre
        pixels = (at + 1) / 2 * self._side - 0.5
        if level is None:
            level = float(self.draw.uniform(*self.levels))
        self._pen.polygon([tuple(p) for p in pixels], fill=round(255 * level))

    def box(self, left: float, top: float, right: float, bottom: float, level: float | None = None) -> None:
        """Fill a rectangle."""
        self.polygon([(left, top), (right, top), (right, bottom), (left, bottom)], level)

    def disc(self, x: float, y: float, rx: float, ry: float | None = None, level: float | None = None) -> None:
        """Fill a disc, or an ellipse with two radii."""
        t = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
        self.polygon(np.stack([x + rx * np.cos(t), y + (ry or rx) * np.sin(t)], axis=1), level)

    def arc(self, x: float, y: float, r: float, start: float, stop: float, width: float) -> None:
        """Draw a part of a ring with middle radius r, from one angle to another (radians, clockwise)."""
        t = np.linspace(start, stop, max(3, int(abs(stop - start) / _ARC_STEP)))
        self.line(np.stack([x + r * np.cos(t), y + r * np.sin(t)], axis=1), width)

    def line(self, points: Sequence[Point] | NDArray, width: float, level: float | None = None) -> None:
        """Draw a line through points [N, 2] with round ends and joints."""
        at = np.asarray(points, dtype=np.float64)
        if level is None:
            level = float(self.draw.uniform(*self.levels))
        for a, b in pairwise(at):
            along = (b - a) / max(float(np.hypot(*(b - a))), 1e-9) * width / 2
            across = np.array([-along[1], along[0]])
            self.polygon([a + across, b + across, b - across, a - across], level)
        for point in at:
            self.disc(point[0], point[1], width / 2, level=level)

    def picture(self) -> NDArray[np.float32]:
        """Return what was drawn, float32 [size_px, size_px], 0..1."""
        return np.asarray(self._image.reduce(_SUPERSAMPLING), dtype=np.float32) / np.float32(255)
