"""Figures that several commands draw; axes carry units, and colour maps keep their order in grey print.

- An empty matplotlib figure, or one line that says what to install.
- Films of a sequence: one column per stage of the light path, one image per position; NumPy and Pillow.
- What a corner shows: the hidden side over bearing and time, and who moves there.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.errors import DataError, MissingDependencyError
from evnlos.files import write_atomically

if TYPE_CHECKING:
    from evnlos.inverse import CornerPicture, FloorSector
    from evnlos.tracking import BearingTracks


def new_figure(size: tuple[float, float]) -> Any:
    """Return an empty figure of `size` (width, height) inches whose parts keep clear of each other.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingDependencyError("figures need matplotlib: pip install 'evnlos[plot]'") from None
    return Figure(size, layout="constrained")


def save_figure(figure: Any, path: str | Path, *, dpi: int) -> Path:
    """Write a figure whole or not at all, in the format of the path's suffix, PNG without one; return the path.

    Raises:
        DataError: There is no such format.
    """
    path, drawn = Path(path), io.BytesIO()
    known = figure.canvas.get_supported_filetypes()
    kind = path.suffix.lower().removeprefix(".") or "png"
    if kind not in known:
        raise DataError(f"{path} is no picture of a known format; end its name in .png, .svg or .pdf")
    figure.savefig(drawn, dpi=dpi, format=kind)
    write_atomically(path, drawn.getvalue())
    return path


def signed_map() -> Any:
    """Return a colour map for values of either sign, dark blue below 0, grey at 0, light orange above.

    It grows lighter all the way, so the sign stays told in grey print, where a map with a pale middle loses it.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    new_figure((1.0, 1.0))  # or the line that says what to install
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("signed", ["#082060", "#8e8e92", "#ffdea0"])


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


_TRACKS = ("#d95f02", "#1b9e77", "#7570b3", "#e7298a")  # apart in hue, and drawn with other dashes


def draw_corner(
    path: str | Path,
    picture: CornerPicture,
    found: BearingTracks,
    floor: NDArray,
    sector: FloorSector,
    sentence: str,
    truth_deg: ArrayLike | None = None,
) -> Path:
    """Draw what a corner shows: the floor that was used, the hidden side over time, its certainty, the tracks.

    Args:
        path: The picture, PNG, SVG or PDF.
        picture: The hidden side over bearing and time.
        found: Who moves there.
        floor: A frame of the video, [H, W], any unit of light.
        sector: The part of it that was used.
        sentence: What is seen, in words.
        truth_deg: True bearings [walkers, T], degrees, where they are known.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure((11.0, 6.4))
    left, right = figure.subfigures(1, 2, width_ratios=(1, 2.15))
    above, below = left.subplots(2, 1, height_ratios=(1, 0.8))
    above.imshow(floor, cmap="gray", vmin=0, vmax=float(np.percentile(floor, 99)))
    turn = np.linspace(0, 1, 40)
    edge, wall, end = (np.array(point) for point in (sector.edge, sector.wall, sector.end))
    ends = [np.arctan2(*(point - edge)[::-1]) for point in (wall, end)]
    sweep = (ends[1] - ends[0] + np.pi) % (2 * np.pi) - np.pi
    arc = edge + sector.reach_px * np.stack([f(ends[0] + turn * sweep) for f in (np.cos, np.sin)], axis=1)
    above.fill(*np.concatenate([edge[None], arc]).T, facecolor="#2b7bba40", edgecolor="#2b7bba", lw=1.2)
    above.plot(*np.stack([edge, wall]).T, color="k", lw=2)
    above.plot(*edge, "o", color="#d95f02", ms=6)
    above.set(xlim=(-0.5, floor.shape[1] - 0.5), ylim=(floor.shape[0] - 0.5, -0.5), xticks=(), yticks=())
    above.set_title("floor used (blue), edge (dot), wall's foot (black)", fontsize=9)
    extent = (picture.times_s[0], picture.times_s[-1], picture.bearings_deg[0], picture.bearings_deg[-1])
    axes = right.subplots(2, 1, sharex=True, sharey=True)
    percent, sure = 100 * picture.mean.T, np.abs(picture.mean / picture.deviation).T
    top = max(float(np.percentile(np.abs(percent), 99.7)), 1e-9)
    how = {"origin": "lower", "aspect": "auto", "extent": extent}
    shown = axes[0].imshow(percent, **how, cmap=signed_map(), vmin=-top, vmax=top)
    right.colorbar(shown, ax=axes[0], label="% of the floor's light per degree", pad=0.01)
    axes[0].set_title("hidden side, most probable change of its light", fontsize=9)
    shown = axes[1].imshow(sure, **how, cmap="gray_r", vmin=0, vmax=6)
    right.colorbar(shown, ax=axes[1], label="standard deviations over 0", pad=0.01)
    axes[1].set_title("how sure that is, and who moves: tracks with 90 % intervals", fontsize=9)
    axes[1].set_xlabel("time, s")
    if truth_deg is not None:
        for k, row in enumerate(np.asarray(truth_deg)):
            label = "truth" if k == 0 else None
            axes[1].plot(picture.times_s, row, ":", color="#2b7bba", lw=1.8, label=label, zorder=4)
    for k, track in enumerate(found.tracks):
        colour, (low, high) = _TRACKS[k % len(_TRACKS)], track.interval_90
        axes[1].fill_between(picture.times_s, low, high, color=colour, alpha=0.4, lw=0)
        style = ("-", "--", "-.")[k % 3]
        axes[1].plot(picture.times_s, track.bearing_deg, style, color=colour, lw=1.4, label=f"person {k + 1}")
        below.plot(picture.times_s, 100 * np.where(track.there, track.brightness, np.nan), style, color=colour)
    for axis in axes:
        axis.set(ylabel="bearing about the edge, degrees", xlim=extent[:2], ylim=extent[2:])
    if found.tracks or truth_deg is not None:
        axes[1].legend(fontsize=8, loc="lower right", framealpha=0.9)
    below.set(xlabel="time, s", ylabel="% of the floor's light", xlim=(picture.times_s[0], picture.times_s[-1]))
    below.axhline(0, color="0.7", lw=0.8, zorder=0)
    below.set_title("what each adds to the floor" if found.tracks else "nobody is seen", fontsize=9)
    figure.suptitle("\n".join(textwrap.wrap(sentence, 130)), fontsize=10)
    return save_figure(figure, path, dpi=100)
