"""One character of a font drawn on a square target plane, and names of characters for any file system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.errors import ConfigError, DataError
from evnlos.scene.fonts import Font

UPPER_CASE = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
DIGITS = "0123456789"
_SUPERSAMPLING = 4
_MAX_SIZE_PX = 2048


def render_glyph(char: str, font: Font, size_px: int = 256, fraction: float = 1.0) -> NDArray[np.float32]:
    """Draw `char` as large as fits a centred square of `fraction` of the target, bright on dark, anti-aliased.

    The ink's bounding box is centred, and its longer side is `fraction` of the target's side: the shape counts,
    not the font's metrics.

    Args:
        char: One character.
        font: Face to draw with (see `find_font`).
        size_px: Side of the mask, pixels, 8 to 2048.
        fraction: Longer side of the ink as a part of the target plane's side, above 0 to 1.

    Returns:
        float32 [size_px, size_px], 0..1, row 0 on top.

    Raises:
        ConfigError: The font has no ink for this character.
        DataError: A size or fraction outside its range, or more than one character.
    """
    if len(char) != 1:
        raise DataError(f"char is {char!r}; give exactly one character")
    check_size(size_px, fraction)
    fine = size_px * _SUPERSAMPLING
    trial = font.load(256)
    if _is_missing(char, trial):
        raise ConfigError(
            f"the font {font.family} ({font.path.name}) cannot draw {char!r}; choose another font"
        )
    # Two steps: rounding makes the first guess of the size wrong by up to a pixel of the trial.
    size = 256.0
    for _ in range(2):
        left, top, right, bottom = _ink_box(char, font.load(size))
        size *= fraction * fine / max(right - left, bottom - top)
    loaded = font.load(size)
    left, top, right, bottom = _ink_box(char, loaded)
    canvas = Image.new("L", (fine, fine))
    corner = ((fine - left - right) // 2, (fine - top - bottom) // 2)
    ImageDraw.Draw(canvas).text(corner, char, fill=255, font=loaded)
    return np.asarray(canvas.reduce(_SUPERSAMPLING), dtype=np.float32) / np.float32(255)


def fit_to_target_plane(picture: NDArray, size_px: int = 256, fraction: float = 1.0) -> NDArray[np.float32]:
    """Cut a picture of a character to its ink, scale the ink as `render_glyph` does and centre it.

    Args:
        picture: Bright ink on dark ground, [h, w], 0..1.
        size_px: Side of the mask, pixels, 8 to 2048.
        fraction: Longer side of the ink as a part of the target plane's side, above 0 to 1.

    Returns:
        float32 [size_px, size_px], 0..1.

    Raises:
        DataError: The picture is not [h, w] or holds no ink.
    """
    check_size(size_px, fraction)
    image = np.asarray(picture, dtype=np.float32)
    if image.ndim != 2 or not np.isfinite(image).all():
        raise DataError(f"a character's picture has shape {image.shape}; give finite values [h, w]")
    rows, columns = np.flatnonzero((image > 0.5).any(1)), np.flatnonzero((image > 0.5).any(0))
    if not len(rows):
        raise DataError("a character's picture holds no ink (nothing above 0.5); leave it out")
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    # The square that becomes the target plane, in the picture's pixels; a margin of zeros lets it reach
    # outside.
    side = max(bottom - top, right - left) / fraction
    margin = int(np.ceil(side)) + 2
    padded = Image.fromarray(np.pad(image, margin))
    x, y = margin + (left + right - side) / 2, margin + (top + bottom - side) / 2
    mask = padded.resize((size_px, size_px), Image.Resampling.BICUBIC, box=(x, y, x + side, y + side))
    return np.clip(np.asarray(mask, dtype=np.float32), 0, 1)


def check_size(size_px: int, fraction: float) -> None:
    """Raise DataError for a mask side (pixels) or a part of the target plane outside its range."""
    if not 8 <= size_px <= _MAX_SIZE_PX:
        raise DataError(f"size_px is {size_px}; give 8 to {_MAX_SIZE_PX} pixels")
    if not 0 < fraction <= 1:
        raise DataError(f"fraction is {fraction}; give a part of the target plane above 0 and up to 1")


def character_name(char: str) -> str:
    """Return a name for a character that is unique on any file system, whatever it does with case.

    Example:
        >>> [character_name(c) for c in "A7a?"]
        ['A', '7', 'lower_a', 'u003f']
    """
    if len(char) == 1 and char in UPPER_CASE + DIGITS:
        return char
    if len(char) == 1 and char in UPPER_CASE.lower():
        return f"lower_{char}"
    return "_".join(f"u{ord(c):04x}" for c in char)


def _ink_box(char: str, loaded: ImageFont.FreeTypeFont) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the ink from the drawing position, pixels."""
    # The font's own getbbox() counts the advance as ink.
    bitmap, (x, y) = loaded.getmask2(char, mode="L")
    left, top, right, bottom = bitmap.getbbox() or (0, 0, 0, 0)
    return left + x, top + y, right + x, bottom + y


def _is_missing(char: str, loaded: ImageFont.FreeTypeFont) -> bool:
    """Return whether the font has no ink for `char`, or draws it as it draws a code point that no font has."""
    drawn, absent = (_drawn(c, loaded) for c in (char, "\U0010fffe"))
    return drawn.getbbox() is None or drawn.tobytes() == absent.tobytes()


def _drawn(char: str, loaded: ImageFont.FreeTypeFont) -> Image.Image:
    image = Image.new("L", (512, 512))
    ImageDraw.Draw(image).text((128, 64), char, fill=255, font=loaded)
    return image
