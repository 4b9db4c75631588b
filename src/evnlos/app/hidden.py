"""The hidden object: a character picked, or a visitor's drawing."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from evnlos.errors import ConfigError, DataError
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, HandwritingGlyphs, Target
from evnlos.scene.glyph_sets import Plate

CHARACTERS = UPPER_CASE + DIGITS
"""What can be picked."""
_SIDE = 128  # of a mask, pixels: 26 a cell
INK_SIDE = 32
"""Pixels a side of a drawing."""
_LEAST_INK = 1e-3
_EMPTY = "the drawing is empty; draw something, or pick a character"


@lru_cache(maxsize=64)
def picked(character: str) -> Target:
    """Return a character in a hand that no training set holds, on the standard plate of 8 cm.

    Raises:
        ConfigError: It is none of `CHARACTERS`.
    """
    if len(character) != 1 or character not in CHARACTERS:
        raise ConfigError(f"the hidden character is {character[:20]!r}; give one of {CHARACTERS}")
    glyphs = HandwritingGlyphs(
        characters=character, writers=1, first_writer=TRAIN_WRITERS, plate=Plate(size_px=_SIDE)
    )
    return glyphs.target(glyphs.objects()[0])


def drawn(ink: str, size_m: float = 0.08) -> Target:
    """Return a drawing as a plate that shines where there is ink.

    Args:
        ink: `INK_SIDE` rows of as many values, row 0 on top, two hexadecimal digits each: 00 nothing, ff full.
        size_m: Side of the plate, metres.

    Raises:
        DataError: There is no ink, or the text is no drawing.

    Example:
        >>> drawn("00" * 512 + "ff" * 256 + "00" * 256).mask.mean()
        np.float32(0.25)
    """
    if not ink:
        raise DataError(_EMPTY)
    wanted = 2 * INK_SIDE**2
    if len(ink) != wanted or not set(ink) <= set("0123456789abcdef"):
        raise DataError(f"the drawing is a text of {len(ink)} characters; give {wanted} hexadecimal digits")
    values = np.frombuffer(bytes.fromhex(ink), np.uint8).reshape(INK_SIDE, INK_SIDE)
    mask = values.astype(np.float32) / np.float32(255)
    if mask.mean() < _LEAST_INK:
        raise DataError(_EMPTY)
    return Target("drawing", mask, size_m)
