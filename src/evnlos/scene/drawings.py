"""Drawings: a square to draw shapes on, from -1 to 1, and objects that are no characters.

- Things to hide that are no characters: icons, people, vehicles, doodles, several at once, in grey levels.
- Films: images of a hidden plane that is known at every instant while it changes; a hand that closes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from evnlos.errors import ConfigError, DataError
from evnlos.types import derive_seed

_SUPERSAMPLING = 4
_ROUND = 48  # corners of a disc
_ARC_STEP = 0.15  # radians between the corners of an arc

Point = tuple[float, float]


class Canvas:
    """Shapes drawn one over the other, anti-aliased; each is turned, scaled and moved as the canvas says.

    Args:
        size_px: Side of the image, pixels.
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

    def image(self) -> NDArray[np.float32]:
        """Return what was drawn, float32 [size_px, size_px], 0..1."""
        return np.asarray(self._image.reduce(_SUPERSAMPLING), dtype=np.float32) / np.float32(255)


Drawing = Callable[[Canvas], None]


def drawing(kind: str, number: int, seed: int = 0, size_px: int = 256) -> NDArray[np.float32]:
    """Draw one object of a kind; every number is another one.

    Args:
        kind: "icon", "person", "vehicle", "doodle", "several" (two or three smaller ones beside one another) or
            "grey" (any of the first three, its parts of different brightness).
        number: Number of the object, from 0 on.
        seed: Fixes the whole population.
        size_px: Side of the image, pixels.

    Returns:
        float32 [size_px, size_px], 0..1.

    Raises:
        ConfigError: The kind is unknown.
    """
    if kind not in KINDS:
        raise ConfigError(f"kind of drawing {kind!r} is unknown; give one of {', '.join(KINDS)}")
    draw = np.random.default_rng(derive_seed(seed, "drawing", kind, number))
    canvas = Canvas(size_px, draw, levels=(0.25, 1.0) if kind == "grey" else (1.0, 1.0))
    if kind == "several":
        _several(canvas, number)
    else:
        shapes = [*_ICONS, _person, *_VEHICLES] if kind == "grey" else _SHAPES[kind]
        canvas.place(draw.uniform(-0.2, 0.2), draw.uniform(0.75, 0.9), (0, 0))
        shapes[number % len(shapes)](canvas)
    return canvas.image()


def _several(canvas: Canvas, number: int) -> None:
    draw, count = canvas.draw, 2 + number % 2
    start = draw.uniform(0, 2 * np.pi)
    for k in range(count):
        angle = start + 2 * np.pi * k / count
        canvas.place(draw.uniform(-0.3, 0.3), 0.42, (0.5 * np.cos(angle), 0.5 * np.sin(angle)))
        _ICONS[int(draw.integers(len(_ICONS)))](canvas)


def _house(c: Canvas) -> None:
    wide = c.draw.uniform(0.6, 0.85)
    c.box(-wide, -0.1, wide, 0.9)
    c.polygon([(-wide - 0.12, -0.1), (0, -0.9), (wide + 0.12, -0.1)])
    c.box(-0.15, 0.4, 0.2, 0.9, 0)
    if c.draw.random() < 0.5:
        c.box(0.3, 0.1, 0.55, 0.35, 0)


def _tree(c: Canvas) -> None:
    c.box(-0.1, 0.4, 0.1, 0.95)
    if c.draw.random() < 0.5:
        for top in (-0.95, -0.55, -0.15):
            wide = 0.45 + 0.15 * (top + 0.95)
            c.polygon([(-wide, top + 0.65), (0, top), (wide, top + 0.65)])
    else:
        for _ in range(5):
            x, y = c.draw.uniform(-0.35, 0.35, 2)
            c.disc(x, y - 0.25, c.draw.uniform(0.25, 0.45))


def _heart(c: Canvas) -> None:
    t = np.linspace(0, 2 * np.pi, 60)
    x, y = 16 * np.sin(t) ** 3, -(13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t))
    c.polygon(np.stack([x, y], axis=1) / 17)


def _star(c: Canvas) -> None:
    points, inner = int(c.draw.integers(4, 8)), c.draw.uniform(0.35, 0.5)
    t = np.arange(2 * points) * np.pi / points - np.pi / 2
    r = np.where(np.arange(2 * points) % 2, inner, 0.95)
    c.polygon(np.stack([r * np.cos(t), r * np.sin(t)], axis=1))


def _arrow(c: Canvas) -> None:
    half, neck = c.draw.uniform(0.12, 0.25), c.draw.uniform(-0.1, 0.3)
    c.box(-0.95, -half, neck, half)
    c.polygon([(neck, -0.6), (0.95, 0), (neck, 0.6)])


def _cup(c: Canvas) -> None:
    c.polygon([(-0.7, -0.6), (0.4, -0.6), (0.3, 0.75), (-0.6, 0.75)])
    c.arc(0.4, 0.0, 0.35, -1.4, 1.5, 0.17)


def _key(c: Canvas) -> None:
    c.arc(-0.5, 0.0, 0.33, 0, 2 * np.pi, 0.2)
    c.box(-0.2, -0.1, 0.95, 0.1)
    for x in (0.55, 0.8):
        c.box(x, 0.0, x + 0.13, c.draw.uniform(0.3, 0.45))


def _umbrella(c: Canvas) -> None:
    t = np.linspace(np.pi, 2 * np.pi, 30)
    c.polygon(np.stack([0.95 * np.cos(t), 0.9 * np.sin(t)], axis=1))
    c.line([(0, 0), (0, 0.7)], 0.14)
    c.arc(0.15, 0.72, 0.15, np.pi, 0, 0.14)


def _moon(c: Canvas) -> None:
    c.disc(0, 0, 0.9)
    c.disc(c.draw.uniform(0.3, 0.5), -0.1, c.draw.uniform(0.65, 0.8), level=0)


def _bolt(c: Canvas) -> None:
    c.polygon([(0.1, -0.95), (-0.55, 0.15), (-0.08, 0.15), (-0.2, 0.95), (0.55, -0.25), (0.05, -0.25)])


def _fish(c: Canvas) -> None:
    c.disc(-0.15, 0, 0.65, c.draw.uniform(0.3, 0.45))
    c.polygon([(0.35, 0), (0.95, -0.45), (0.8, 0), (0.95, 0.45)])
    c.disc(-0.5, -0.08, 0.08, level=0)


def _scissors(c: Canvas) -> None:
    for side in (-1, 1):
        c.arc(-0.55, 0.45 * side, 0.25, 0, 2 * np.pi, 0.14)
        c.line([(-0.35, 0.3 * side), (0.9, -0.35 * side)], 0.15)


def _person(c: Canvas) -> None:
    """A standing, walking or waving person: head, trunk, two arms and two legs with a joint each."""
    draw, lean = c.draw, c.draw.uniform(-0.15, 0.15)
    hip, neck = np.array([0.0, 0.15]), np.array([lean, -0.45])
    c.disc(neck[0] + lean / 2, neck[1] - 0.27, 0.19)
    c.line([tuple(neck), tuple(hip)], draw.uniform(0.26, 0.36))
    stride, swing = draw.uniform(0.05, 0.6), draw.uniform(-0.4, 0.9)
    waves = draw.random() < 0.3
    for side in (-1, 1):
        thigh = side * stride
        knee = hip + 0.4 * np.array([np.sin(thigh), np.cos(thigh)])
        shin = thigh - (draw.uniform(0, 0.5) if side < 0 else draw.uniform(0, 0.2))
        c.line([tuple(hip), tuple(knee), tuple(knee + 0.4 * np.array([np.sin(shin), np.cos(shin)]))], 0.17)
        upper = -side * swing if not (waves and side > 0) else draw.uniform(2.0, 2.7)
        shoulder = neck + np.array([0.05 * side, 0.06])
        elbow = shoulder + 0.3 * np.array([np.sin(upper), np.cos(upper)])
        lower = upper + draw.uniform(0.0, 0.8) * (1 if side > 0 else -1)
        hand = elbow + 0.3 * np.array([np.sin(lower), np.cos(lower)])
        c.line([tuple(shoulder), tuple(elbow), tuple(hand)], 0.12)


def _car(c: Canvas) -> None:
    c.box(-0.95, -0.05, 0.95, 0.35)
    roof = c.draw.uniform(-0.55, -0.4)
    c.polygon([(-0.65, -0.05), (-0.4, roof), (0.3, roof), (0.6, -0.05)])
    c.polygon([(-0.45, -0.08), (-0.3, roof + 0.1), (-0.08, roof + 0.1), (-0.08, -0.08)], 0)
    c.polygon([(0.05, -0.08), (0.05, roof + 0.1), (0.25, roof + 0.1), (0.43, -0.08)], 0)
    _wheels(c, (-0.55, 0.55), 0.35, c.draw.uniform(0.2, 0.26))


def _lorry(c: Canvas) -> None:
    c.box(-0.95, -0.6, 0.35, 0.35)
    c.polygon([(0.42, 0.35), (0.42, -0.3), (0.75, -0.3), (0.95, 0.0), (0.95, 0.35)])
    c.polygon([(0.55, 0.0), (0.55, -0.2), (0.72, -0.2), (0.83, 0.0)], 0)
    _wheels(c, (-0.65, -0.25, 0.68), 0.4, 0.2)


def _bus(c: Canvas) -> None:
    c.box(-0.95, -0.5, 0.95, 0.4)
    for x in np.linspace(-0.8, 0.5, int(c.draw.integers(3, 5))):
        c.box(x, -0.35, x + 0.26, 0.0, 0)
    _wheels(c, (-0.55, 0.55), 0.42, 0.19)


def _bicycle(c: Canvas) -> None:
    for x in (-0.55, 0.55):
        c.arc(x, 0.3, 0.36, 0, 2 * np.pi, 0.1)
    c.line([(-0.55, 0.3), (-0.2, -0.3), (0.35, -0.3), (0.0, 0.3), (-0.55, 0.3)], 0.09)
    c.line([(0.0, 0.3), (-0.2, -0.3), (-0.25, -0.45)], 0.09)
    c.line([(0.55, 0.3), (0.35, -0.3), (0.3, -0.5), (0.5, -0.55)], 0.09)


def _wheels(c: Canvas, places: tuple[float, ...], y: float, radius: float) -> None:
    for x in places:
        c.disc(x, y, radius)
        c.disc(x, y, radius / 3, level=0)


def _doodle(c: Canvas) -> None:
    """Two or three smooth strokes of a pen, sums of a few slow waves, that fill the target plane."""
    t, waves, width = np.linspace(0, 1, 40), np.arange(3), c.draw.uniform(0.1, 0.18)
    count = int(c.draw.integers(2, 4))
    sizes = c.draw.normal(size=(count, 2, 3)) / (1 + waves)
    phases = c.draw.uniform(0, np.pi, (count, 2, 3))
    at = (sizes[:, None] * np.cos(np.pi * t[:, None, None] * waves + phases[:, None])).sum(
        axis=-1
    )  # [K, 40, 2]
    low, high = at.min(axis=(0, 1)), at.max(axis=(0, 1))
    for stroke in (at - (low + high) / 2) * (1.8 / (high - low).max()):
        c.line(stroke, width)


_ICONS: list[Drawing] = [
    _house, _tree, _heart, _star, _arrow, _cup, _key, _umbrella, _moon, _bolt, _fish, _scissors,
]  # fmt: skip
_VEHICLES: list[Drawing] = [_car, _lorry, _bus, _bicycle]
_SHAPES: dict[str, list[Drawing]] = {
    "icon": _ICONS,
    "person": [_person],
    "vehicle": _VEHICLES,
    "doodle": [_doodle],
}
KINDS = (*_SHAPES, "several", "grey")
"""Kinds of drawings."""


@dataclass(frozen=True, eq=False)
class Film:
    """A hidden plane that changes in place, known at every instant: linear between its images.

    Args:
        images: Brightness of the plane's samples, float32 [N, h, w], 0 or more.
        times_s: Instants of the images, [N], seconds, increasing; before the first and after the last the film
            rests.

    Raises:
        DataError: No images, times that do not increase or fit them, or brightness that is negative or NaN.

    Example:
        >>> film = Film(np.stack([np.zeros((1, 2)), np.ones((1, 2))]), [0.0, 1.0])
        >>> film.at([0.25, 3.0]).tolist()
        [[[0.25, 0.25]], [[1.0, 1.0]]]
    """

    images: NDArray
    times_s: ArrayLike

    def __post_init__(self) -> None:
        images = np.array(self.images, np.float32)  # a copy: the caller's array stays his own
        times = np.array(self.times_s, np.float64)
        if images.ndim != 3 or times.shape != images.shape[:1] or not images.size:
            raise DataError(f"Film has images {images.shape} at times {times.shape}; give [N, h, w] and [N]")
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise DataError("Film.times_s do not increase; give finite seconds in order")
        if not (images.min() >= 0 and images.max() < np.inf):
            raise DataError(f"Film.images hold {images.min()}..{images.max()}; give finite values from 0")
        object.__setattr__(self, "images", images)
        object.__setattr__(self, "times_s", times)

    def at(self, t_s: ArrayLike) -> NDArray[np.float32]:
        """Return the plane at times `t_s`, seconds, [] or [T]: float32 [h, w] or [T, h, w]."""
        times = np.asarray(self.times_s)
        place = np.interp(np.asarray(t_s, np.float64), times, np.arange(len(times)))
        before = np.minimum(place.astype(np.intp), max(len(times) - 2, 0))
        share = (place - before)[..., None, None].astype(np.float32)
        after = np.minimum(before + 1, len(times) - 1)
        return (1 - share) * self.images[before] + share * self.images[after]


def closing_hand(closed: float, size_px: int = 96) -> NDArray[np.float32]:
    """Draw a hand: palm, thumb and four fingers, which draw in one after the other as it closes.

    Args:
        closed: 0 is the open hand, 1 the fist.
        size_px: Side of the image, pixels.

    Returns:
        float32 [size_px, size_px], 0..1.

    Raises:
        ConfigError: `closed` is outside 0..1.
    """
    if not 0 <= closed <= 1:
        raise ConfigError(f"closed is {closed}; give 0 (open) to 1 (fist)")
    c = Canvas(size_px, np.random.default_rng(0))
    c.disc(0.0, 0.38, 0.42, 0.46, level=1.0)
    for finger, (x, lean, reach) in enumerate(
        ((-0.33, -0.28, 0.62), (-0.12, -0.09, 0.82), (0.11, 0.07, 0.8), (0.32, 0.24, 0.66))
    ):
        left = reach * (1 - float(np.clip(1.6 * closed - 0.2 * finger, 0, 1)))
        c.line([(x, 0.1), (x + lean * left, 0.1 - left)], 0.17, level=1.0)
    out = 1 - closed
    c.line([(0.3, 0.5), (0.4 + 0.36 * out, 0.3 - 0.18 * out)], 0.19, level=1.0)
    return c.image()
