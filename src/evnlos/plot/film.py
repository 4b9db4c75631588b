"""Films of a pass: one column a stage of the light path, one picture a position; NumPy and Pillow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.errors import DataError

Theme = Literal["dark", "light"]
_GROUND = {"dark": (14, 16, 20), "light": (255, 255, 255)}
_INK = {"dark": (226, 229, 235), "light": (29, 33, 38)}
_DIM = {"dark": (146, 153, 166), "light": (96, 104, 116)}
_GAP, _TITLE_PX, _NOTE_PX = 8, 15, 12


@dataclass(frozen=True, eq=False)
class Column:
    """One stage of a film.

    Args:
        title: What it shows, a word or two.
        note: How to read it, with units; one short line.
        pictures: uint8, grey [N, h, w] or RGBA [N, h, w, 4]; one a position.
    """

    title: str
    note: str
    pictures: NDArray[np.uint8]


def film(
    columns: Sequence[Column], width_px: int = 180, theme: Theme = "light", captions: Sequence[str] = ()
) -> list[NDArray[np.uint8]]:
    """Return the pictures of a film, RGB [H, W, 3] each: columns side by side under their titles.

    Args:
        columns: What stands side by side, from left to right; as many pictures in each.
        width_px: Width of a column, pixels; heights follow from the pictures' own sides.
        theme: "dark" or "light" ground.
        captions: A line below each picture of the film; none where empty.

    Raises:
        DataError: No columns, or columns of unequal length.

    Example:
        >>> hidden, wall = np.zeros((3, 12, 24), np.uint8), np.zeros((3, 10, 16, 4), np.uint8)
        >>> pictures = film([Column("hidden", "24 cm wide", hidden), Column("wall", "16 px", wall)], 96)
        >>> len(pictures), pictures[0].shape
        (3, (109, 216, 3))
    """
    lengths = sorted({len(column.pictures) for column in columns} | ({len(captions)} if captions else set()))
    if len(lengths) != 1:
        raise DataError(f"columns and captions have {lengths} pictures; give all of them the same number")
    rows = [round(width_px * c.pictures.shape[1] / c.pictures.shape[2]) for c in columns]
    top, deepest = _TITLE_PX + 12, max(rows)
    line = _NOTE_PX + 10
    height = top + deepest + line * (2 if captions else 1)
    width = _GAP + len(columns) * (width_px + _GAP)
    title, note = ImageFont.load_default(_TITLE_PX), ImageFont.load_default(_NOTE_PX)
    made = []
    for k in range(lengths[0]):
        sheet = Image.new("RGB", (width, height), _GROUND[theme])
        draw = ImageDraw.Draw(sheet)
        for i, (column, high) in enumerate(zip(columns, rows, strict=True)):
            left = _GAP + i * (width_px + _GAP)
            draw.text((left, 4), column.title, fill=_INK[theme], font=title)
            picture = _on_ground(column.pictures[k], theme).resize((width_px, high), _how(column, width_px))
            sheet.paste(picture, (left, top + (deepest - high) // 2))
            draw.text((left, top + deepest + 4), column.note, fill=_DIM[theme], font=note)
        if captions:
            draw.text((_GAP, height - line), captions[k], fill=_INK[theme], font=note)
        made.append(np.asarray(sheet))
    return made


def _on_ground(picture: NDArray[np.uint8], theme: Theme) -> Image.Image:
    """Return a picture as RGB; where it is transparent the ground shows."""
    if picture.ndim == 2:
        return Image.fromarray(picture).convert("RGB")
    ground = Image.new("RGBA", picture.shape[1::-1], _GROUND[theme])
    return Image.alpha_composite(ground, Image.fromarray(picture)).convert("RGB")


def _how(column: Column, width_px: int) -> Image.Resampling:
    """Blow pixels up as squares, and average where there are more of them than the column is wide."""
    return Image.Resampling.NEAREST if column.pictures.shape[2] <= width_px else Image.Resampling.BOX
