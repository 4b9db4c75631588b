"""Handwriting made up: strokes, their ink, and many writers, each with one consistent hand.

A stand-in for scanned forms, made from openly licensed handwriting fonts; none of it comes from NIST. A hand is
a base face, a slant, proportions, a pen and an elastic deformation; each glyph adds a little variation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.errors import ConfigError, DataError, MissingDependencyError
from evnlos.scene.fonts import Font, check_size, find_font, render_glyph
from evnlos.scene.moving import Target
from evnlos.types import derive_seed


def signed_distance(mask: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Return the distance of each pixel to the mask's edge, negative inside, exact up to `reach`.

    Args:
        mask: Coverage, [H, W], 0..1; a pixel belongs to the mask from 0.5 on.
        reach: Distances are cut at +-`reach`, pixels, 1 or more.

    Returns:
        float32 [H, W], pixels: centre of the pixel to the edge between pixels.

    Example:
        >>> signed_distance(np.array([[0, 0, 1, 1, 0]]), 3)
        array([[ 1.5,  0.5, -0.5, -0.5,  0.5]], dtype=float32)
    """
    inside = np.asarray(mask) >= 0.5
    out = np.full(inside.shape, reach - 0.5, np.float32)
    if inside.any():
        near = tuple(slice(max(0, one.min() - reach), one.max() + reach + 1) for one in inside.nonzero())
        part = inside[near]
        out[near] = np.where(part, 0.5 - _distance_to(~part, reach), _distance_to(part, reach) - 0.5)
    return out


def _distance_to(chosen: NDArray[np.bool_], reach: int) -> NDArray[np.float64]:
    """Return the distance of each pixel to the nearest one that is chosen, at most `reach`."""
    from scipy.ndimage import distance_transform_edt  # scipy loads slowly

    if not chosen.any():
        return np.full(chosen.shape, float(reach))
    return np.minimum(np.asarray(distance_transform_edt(~chosen)), reach)


def pen_width(mask: NDArray[np.float32]) -> float:
    """Return the mean width of a drawing's strokes as a part of the longer side of its ink, 0..1.

    Args:
        mask: Bright ink on dark ground, [H, W], 0..1.

    Raises:
        DataError: The image has no ink.
    """
    left, top, right, bottom = ink_box(mask)
    return pen_px(mask) / max(right - left, bottom - top)


def pen_px(ink: NDArray[np.float32]) -> float:
    """Return the mean width of the strokes, pixels: four times the mean distance of the ink to its edge."""
    inside = np.asarray(ink) >= 0.5
    if not inside.any():
        return 1.0
    # No pixel of the ink is nearer to the ground than one beside the ink's box.
    near = tuple(slice(max(0, one.min() - 1), one.max() + 2) for one in inside.nonzero())
    distance = (_distance_to(~inside[near], reach=40) - 0.5).astype(np.float32)
    return 4.0 * float(distance[inside[near]].mean())


def ink_box(ink: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return left, top, right, bottom of the ink, pixels from the centre, [4]."""
    rows, columns = np.flatnonzero((ink > 0.5).any(1)), np.flatnonzero((ink > 0.5).any(0))
    if not len(rows):
        raise DataError("a glyph has no ink (no pixel above 0.5); choose another base face or drawing")
    half = len(ink) / 2
    return np.array([columns[0] - half, rows[0] - half, columns[-1] + 1 - half, rows[-1] + 1 - half])


@dataclass(frozen=True)
class Ink:
    """Where targets have their ink."""

    size_m: float = 0.0
    """Longer side of the largest one's ink, metres; 0 = as large as the target plane."""
    centre_m: tuple[float, float] = (0.0, 0.0)
    """Middle of the ink's bounding box (x, y) beside the target plane's middle, metres; mean over targets."""

    @classmethod
    def of(cls, targets: Iterable[Target]) -> Ink:
        """Return it for targets; the default where none of them has any."""
        boxes = [ink_box(one.mask) * one.size_m / len(one.mask) for one in targets if (one.mask > 0.5).any()]
        if not boxes:
            return cls()
        low, high = np.split(np.array(boxes), 2, axis=1)  # left and top, right and bottom
        x, y = ((low + high) / 2).mean(axis=0)
        return cls(round(float((high - low).max()), 5), (round(float(x), 5), round(float(y), 5)))


BASE_FACES = (
    "Caveat", "Kalam Light", "Shadows Into Light", "Indie Flower", "Kalam Bold", "Permanent Marker",
    "Caveat Bold",
)  # fmt: skip
PRINT_FACES = ("Fredoka SemiBold", "Nunito Black", "Quicksand Bold", "Varela Round")
FACES = {"hand": BASE_FACES, "print": PRINT_FACES, "both": BASE_FACES + PRINT_FACES}
"""Base faces by name: pens, the rounded faces of signs and cut plates, or all of them."""

TRAIN_WRITERS = 39
"""Writers for training; later ones share their faces, but neither slant, proportions, pen nor deformation."""
PEN = (0.06, 0.18)
"""Pen width as a part of the glyph's longer side: from a ball-point pen to a marker."""

_SLANT_DEG = (-18.0, 14.0)  # the base faces lean to the right themselves, by 0 to 10 degrees
_REDRAWN_SLANT_DEG = (-14.0, 14.0)
HEIGHT = (0.85, 1.0)  # longer side of the ink, parts of the room for it
_ASPECT = (0.80, 1.25)
_WAVES = 4  # cosines a direction and axis of the elastic deformation
_HAND_BEND, _GLYPH_BEND = 0.045, 0.018  # amplitudes, as parts of the glyph's height
_WORK_PX = 192
_CANVAS_PX = 272  # room for strokes that are drawn before they are thinned


@dataclass(frozen=True, eq=False)
class Hand:
    """How one writer writes.

    Args:
        font: Base face.
        slant_deg: Slant to the right that is added to the base face's, degrees.
        tilt_deg: Rotation of the base line, degrees, positive clockwise.
        aspect: Widening of the base face, 1 = as drawn.
        height: Longer side of the ink as a part of the room for it, 0..1.
        pen: Pen width as a part of the ink's longer side, 0..1.
        waves: Coefficients of the elastic deformation, float64 [2, K, K], as parts of the ink's height.
    """

    font: Font
    slant_deg: float
    tilt_deg: float
    aspect: float
    height: float
    pen: float
    waves: NDArray[np.float64]


@dataclass(frozen=True)
class Strokes:
    """Range of the writers' strokes."""

    faces: Literal["hand", "print", "both"] = "hand"
    """Base faces: handwriting, rounded printed letters as on signs and cut plates, or both."""
    pen: tuple[float, float] = PEN
    """Thinnest and thickest pen, parts of the glyph's longer side; a bold face has 0.12 to 0.2."""
    height: tuple[float, float] = HEIGHT
    """Longer side of the smallest and the largest hand's ink, parts of the room for it."""

    def __post_init__(self) -> None:
        if self.faces not in FACES:
            raise ConfigError(f"Strokes.faces is {self.faces!r}; give one of {', '.join(FACES)}")
        low, high = self.pen
        if not 0.02 <= low <= high <= 0.4:
            raise ConfigError(f"Strokes.pen is ({low}, {high}); give two ascending numbers from 0.02 to 0.4")
        low, high = self.height
        if not 0.1 <= low <= high <= 1:
            raise ConfigError(f"Strokes.height is ({low}, {high}); give two ascending numbers from 0.1 to 1")


def hand(writer: int, seed: int, strokes: Strokes = Strokes()) -> Hand:
    """Return the hand of a writer; the same for every character and in any order of calls.

    Slant, proportions and pen follow a low-discrepancy sequence over the writers, so that a few writers already
    span the whole range.

    Args:
        writer: Number of the writer, 0 or more; `TRAIN_WRITERS` and above are held out for testing.
        seed: Seed of the whole population of writers.
        strokes: Base faces and pens that the population has.

    Raises:
        DataError: The writer is negative.
        MissingDependencyError: A font package of the base faces is not installed.
    """
    if writer < 0:
        raise DataError(f"writer is {writer}; writers are numbered from 0")
    # Roots of x^5 = x + 1: Roberts' generalisation of the golden ratio to four dimensions.
    steps = 1.1673039782614187 ** -np.arange(1.0, 5.0)
    start = _random(seed, "population").random(4)
    slant, aspect, height, pen = (start + (writer + 1) * steps) % 1.0
    # Faces are dealt out in shuffled rounds: a fixed cycle would tie each face to a few slants and pens.
    faces = FACES[strokes.faces]
    deal, turn = divmod(writer, len(faces))
    order = np.argsort(_random(seed, "faces", deal).random(len(faces)))
    rng = _random(seed, "hand", writer)
    return Hand(
        font=_base_font(faces[order[turn]]),
        slant_deg=_between(_SLANT_DEG, slant),
        tilt_deg=_between((-4.0, 4.0), rng.random()),
        aspect=_between(_ASPECT, aspect),
        height=_between(strokes.height, height),
        pen=_between(strokes.pen, pen),
        waves=_waves(rng, _HAND_BEND),
    )


def nist_like(
    writer: int,
    char: str,
    seed: int,
    size_px: int = 256,
    fraction: float = 1.0,
    strokes: Strokes = Strokes(),
    centre: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float32]:
    """Write one character in a writer's hand on a square target plane: a stand-in for NIST's scanned
    handwriting.

    Args:
        writer: Number of the writer, 0 or more; those from `TRAIN_WRITERS` on are for testing.
        char: One character, A-Z, a-z or 0-9.
        seed: Seed of the population; the image depends on (seed, writer, char) and on nothing else.
        size_px: Side of the mask, pixels, 8 to 2048.
        fraction: Room for the ink as a part of the target plane's side, above 0 to 1.
        strokes: Base faces and pens of the population of writers.
        centre: Middle of the ink's bounding box (x to the right, y downwards), parts of the side.

    Returns:
        float32 [size_px, size_px], 0..1, bright ink on dark ground.

    Raises:
        DataError: An argument is outside its range.
        ConfigError: The base face cannot draw the character.
        MissingDependencyError: A font package of the base faces is not installed.
    """
    check_size(size_px, fraction)
    style = hand(writer, seed, strokes)
    rng = _random(seed, "glyph", writer, char)
    slant = np.tan(np.radians(style.slant_deg + _between((-2.0, 2.0), rng.random())))
    tilt = np.radians(style.tilt_deg + _between((-2.0, 2.0), rng.random()))
    aspect = style.aspect * _between((0.95, 1.05), rng.random())
    room = fraction * style.height * _between((0.95, 1.0), rng.random()) * _WORK_PX
    waves = style.waves + _waves(rng, _GLYPH_BEND)
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    shape = (
        turn @ np.array([[1.0, -slant], [0.0, 1.0]]) @ np.diag([aspect, 1.0])
    )  # (x, y) of base -> of the page

    base = _base_glyph(char, style.font)
    # A smaller draft shows how large the deformed ink and its pen come out; the second drawing fits the room.
    draft = _deform(base, 0.5 * shape, waves, (0.0, 0.0), _CANVAS_PX // 2)
    (left, top, right, bottom), drawn_pen = ink_box(draft), pen_px(draft)
    pen = style.pen * room
    growth = (room - pen) / max(right - left - drawn_pen, bottom - top - drawn_pen, 1.0)
    middle = growth * np.array([(left + right) / 2, (top + bottom) / 2])
    drawn = _deform(base, 0.5 * growth * shape, waves, (-middle[0], -middle[1]), _CANVAS_PX)
    now = pen_px(drawn)
    # Thinning stops early: beyond it the thin parts of a stroke would break.
    thicken = max((pen - now) / 2, -0.22 * now)
    distance = signed_distance(drawn, reach=int(np.ceil(abs(thicken))) + 3)
    return _to_target_plane(np.clip(thicken - distance + 0.5, 0.0, 1.0), size_px, room, centre)


def redrawn(drawing: NDArray[np.float32], name: str, number: int, seed: int) -> NDArray[np.float32]:
    """Draw a known drawing again as another hand might: other slant, proportions, bend and pen.

    Args:
        drawing: Bright ink on dark ground, square [S, S], 0..1.
        name: Its name.
        number: Number of the hand; the image depends on (seed, name, number) and on the drawing alone.
        seed: Seed of the population.

    Returns:
        float32 [S, S], 0..1, in the drawing's place by its bounding box, and at most as large.

    Raises:
        DataError: The drawing has no ink.
    """
    rng = _random(seed, "redrawn", name, number)
    page = Image.fromarray(np.asarray(drawing, np.float32)).resize((_WORK_PX, _WORK_PX))
    base = np.asarray(page, dtype=np.float32)
    slant = np.tan(np.radians(_between(_REDRAWN_SLANT_DEG, rng.random())))
    tilt = np.radians(_between((-6.0, 6.0), rng.random()))
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    shape = turn @ np.array([[1.0, -slant], [0.0, 1.0]]) @ np.diag([_between(_ASPECT, rng.random()), 1.0])
    waves = _waves(rng, _HAND_BEND)
    left, top, right, bottom = ink_box(base)
    centre = (left + right) / (2 * _WORK_PX), (top + bottom) / (2 * _WORK_PX)
    room = max(right - left, bottom - top) * _between((0.88, 1.0), rng.random())
    left, top, right, bottom = ink_box(_deform(base, 0.5 * shape, waves, (0.0, 0.0), _CANVAS_PX))
    growth = 0.5 * room / max(right - left, bottom - top)
    middle = 2 * growth * np.array([(left + right) / 2, (top + bottom) / 2])
    drawn = _deform(base, growth * shape, waves, (-middle[0], -middle[1]), _CANVAS_PX)
    thicken = pen_px(drawn) * _between((-0.12, 0.12), rng.random())
    distance = signed_distance(drawn, reach=int(np.ceil(abs(thicken))) + 3)
    return _to_target_plane(np.clip(thicken - distance + 0.5, 0.0, 1.0), len(drawing), room, centre)


def _to_target_plane(
    ink: NDArray[np.float32], size_px: int, room: float, centre: tuple[float, float]
) -> NDArray[np.float32]:
    """Put the ink at `centre`, shrink it to `room` where it came out larger, and sample it at `size_px`."""
    left, top, right, bottom = ink_box(ink)
    excess = max((right - left) / room, (bottom - top) / room, 1.0)
    side = _WORK_PX * excess
    margin = _WORK_PX
    x = margin + _CANVAS_PX / 2 + (left + right - side) / 2 - centre[0] * side
    y = margin + _CANVAS_PX / 2 + (top + bottom - side) / 2 - centre[1] * side
    padded = Image.fromarray(np.pad(ink.astype(np.float32), margin))
    mask = padded.resize((size_px, size_px), Image.Resampling.BILINEAR, box=(x, y, x + side, y + side))
    return np.clip(np.asarray(mask, dtype=np.float32), 0.0, 1.0)


def _deform(
    base: NDArray[np.float32],
    shape: NDArray[np.float64],
    waves: NDArray[np.float64],
    middle: tuple[float, float],
    canvas_px: int,
) -> NDArray[np.float32]:
    """Return `base` mapped by `shape` about its centre, bent by `waves` and moved to `middle` (pixels)."""
    side = len(base)
    axis = np.arange(canvas_px) - (canvas_px - 1) / 2
    inverse = np.linalg.inv(shape)
    x, y = axis[None, :] - middle[0], axis[:, None] - middle[1]
    from_x = inverse[0, 0] * x + inverse[0, 1] * y  # [C, C], C = canvas
    from_y = inverse[1, 0] * x + inverse[1, 1] * y
    # The bend lives on the base glyph's own square, so it is the same at every size.
    bend_x, bend_y = _bend(waves, from_x / side + 0.5, from_y / side + 0.5)
    x, y = from_x + side * bend_x + (side - 1) / 2, from_y + side * bend_y + (side - 1) / 2
    return _sample(base[None], x, y)[0]


def _bend(waves: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64]) -> tuple:
    """Return a smooth displacement at (u, v), the cosine series sum of waves[j, i] cos(pi j v) cos(pi i u)."""
    # A table and a look-up: the field is so smooth that 65 nodes per side leave errors below 1e-4 of the glyph.
    nodes = np.linspace(0, 1, 65)
    cosine = np.cos(np.pi * np.arange(waves.shape[-1])[:, None] * nodes)  # [K, 65]
    table = np.einsum("cji,jy,ix->cyx", waves, cosine, cosine)  # [2, 65, 65]
    column = np.clip(u * 64, 0, 64)
    row = np.clip(v * 64, 0, 64)
    return _sample(table, column, row)


def _sample(images: NDArray, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray, ...]:
    """Return `images` [N, H, W] at columns `x` and rows `y`, bilinear, zero outside."""
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)))
    height, width = padded.shape[1:]
    x = np.clip(x + 1, 0, width - 1.001)
    y = np.clip(y + 1, 0, height - 1.001)
    column, row = x.astype(np.intp), y.astype(np.intp)
    right, below = (x - column).astype(np.float32), (y - row).astype(np.float32)
    start, found = row * width + column, []
    for flat in padded.reshape(len(padded), -1):
        upper = flat[start] * (1 - right) + flat[start + 1] * right
        lower = flat[start + width] * (1 - right) + flat[start + width + 1] * right
        found.append(upper * (1 - below) + lower * below)
    return tuple(found)


def _waves(rng: np.random.Generator, amplitude: float) -> NDArray[np.float64]:
    """Draw a deformation: [2, K, K] coefficients up to `amplitude` that fall with the frequency.

    Shift, slant and stretch (the lowest orders) are left out: they have parameters of their own.
    """
    order = np.arange(_WAVES)
    falling = 2.0 / (order[:, None] ** 2 + order[None, :] ** 2 + 1e-9)
    falling[order[:, None] + order[None, :] < 2] = 0.0
    return amplitude * falling * (2.0 * rng.random((2, _WAVES, _WAVES)) - 1.0)


def _between(limits: tuple[float, float], part: float) -> float:
    return float(limits[0] + (limits[1] - limits[0]) * part)


def _random(seed: int, *names: str | int) -> np.random.Generator:
    """Return a generator for one named purpose; only its uniform draws are used, the same on every platform."""
    return np.random.Generator(np.random.Philox(key=derive_seed(seed, "handwriting", *names)))


@lru_cache(maxsize=64)
def _base_font(name: str) -> Font:
    found = find_font(name)
    if found.substituted_for is not None:
        raise MissingDependencyError(f"{found.note}; reinstall the package's font dependencies")
    return found


@lru_cache(maxsize=512)
def _base_glyph(char: str, font: Font) -> NDArray[np.float32]:
    glyph = render_glyph(char, font, _WORK_PX, 1.0)
    glyph.setflags(write=False)
    return glyph
