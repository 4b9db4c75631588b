"""Figures that several commands draw; axes carry units, and colour maps keep their order in grey print.

- An empty matplotlib figure, or one line that says what to install; results with their intervals.
- Films of a sequence: one column per stage of the light path, one image per position; NumPy and Pillow.
- Events as images on any background: a space-time cloud, and slices through it; NumPy and Pillow.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.errors import DataError, MissingDependencyError
from evnlos.events import event_histogram
from evnlos.events.volume import OFF_RGB, ON_RGB
from evnlos.files import write_atomically
from evnlos.types import Events


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
        raise DataError(f"{path} is no image of a known format; end its name in .png, .svg or .pdf")
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


def draw_scores(records: Sequence[Any], metric: str, path: str | Path) -> Path:
    """Draw the mean of a metric with its 95 % interval over characters and seeds: a row an arm, no ensembles.

    Args:
        records: Of one study of `evnlos.experiment` on the same characters; each modality has a panel.
        metric: Name of a score.
        path: The image, PNG or SVG.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
        DataError: There is nothing to draw.
    """
    from evnlos.analysis.scores import paired_difference  # with PyTorch, which events alone do not need
    from evnlos.data import modality_order

    found: dict[str, dict[str, list[dict[str, float]]]] = {}
    for one in sorted(records, key=lambda one: modality_order(one.modality)):
        if one.seed >= 0:
            found.setdefault(one.modality, {}).setdefault(one.arm, []).append(one.scores[metric])
    names = list(dict.fromkeys(name for arms in found.values() for name in arms))
    if not names:
        raise DataError("there is no record of a network to draw; run the experiment first")
    figure = new_figure((2.2 + 2.8 * len(found), 1.0 + 0.28 * len(names)))
    panels = figure.subplots(1, len(found), sharey=True, sharex=True, squeeze=False)[0]
    for axes, (modality, arms) in zip(panels, found.items(), strict=True):
        for arm, seeds in arms.items():
            each = [list(seed.values()) for seed in seeds]
            mean = paired_difference(each, np.zeros(len(seeds[0])), list(seeds[0]))
            axes.hlines(names.index(arm), mean.low, mean.high, color="0.45")
            axes.plot(mean.mean, names.index(arm), "o", color="#1f5fa8", markersize=5)
            text = {"textcoords": "offset points", "ha": "center", "fontsize": 7}
            axes.annotate(f"{mean.mean:.1f}", (mean.mean, names.index(arm)), (0, 4), **text)
        axes.set_title(modality, fontsize=10)
        axes.set_xlabel(metric)
        axes.grid(axis="x", color="0.9")
    panels[0].set_yticks(range(len(names)), names, fontsize=8)
    panels[0].set_ylim(len(names) - 0.5, -0.7)
    return save_figure(figure, path, dpi=100)


def draw_regimes(findings: Sequence[Any], path: str | Path) -> Path:
    """Draw by how much events of a whole sequence lead its frames, dB, over light and speed.

    Args:
        findings: Of the conditions `evnlos.experiment.regimes`.
        path: The image, PNG or SVG.
    """
    db = {(one.condition.light, one.condition.speed_m_s): one.expected_db for one in findings}
    lights, speeds = (sorted({place[k] for place in db}) for k in (0, 1))
    lead = np.array([[db[a, b]["events"][-1] - db[a, b]["frames"][-1] for b in speeds] for a in lights])
    axes, most = (figure := new_figure((5.4, 3.6))).subplots(), float(abs(lead).max())
    axes.imshow(lead, cmap=signed_map(), vmin=-most, vmax=most, aspect="auto", origin="lower")
    for (row, column), value in np.ndenumerate(lead):
        axes.text(column, row, f"{value:+.1f}", ha="center", va="center", color="k" if value > 0 else "w")
    axes.set_xticks(range(len(speeds)), map("{:g}".format, speeds))
    axes.set_yticks(range(len(lights)), map("{:g}".format, lights))
    axes.set(xlabel="speed of the target, m/s", ylabel="light, share of the base's")
    axes.set_title("events less frames, expected PSNR, dB", fontsize=10)
    return save_figure(figure, path, dpi=100)


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
    """Return the images of a film, RGB [H, W, 3] each: columns side by side under their titles.

    Args:
        columns: What stands side by side, from left to right; as many images in each.
        width_px: Width of a column, pixels; heights follow from the images' own sides.
        theme: "dark" or "light" ground.
        captions: A line below each image of the film; none where empty.

    Raises:
        DataError: No columns, or columns of unequal length.

    Example:
        >>> hidden, wall = np.zeros((3, 12, 24), np.uint8), np.zeros((3, 10, 16, 4), np.uint8)
        >>> images = film([Column("hidden", "24 cm wide", hidden), Column("wall", "16 px", wall)], 96)
        >>> len(images), images[0].shape
        (3, (109, 216, 3))
    """
    lengths = sorted({len(column.pictures) for column in columns} | ({len(captions)} if captions else set()))
    if len(lengths) != 1:
        raise DataError(f"columns and captions have {lengths} images; give all of them the same number")
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
    """Return an image as RGB; where it is transparent the ground shows."""
    if picture.ndim == 2:
        return Image.fromarray(picture).convert("RGB")
    ground = Image.new("RGBA", picture.shape[1::-1], _GROUND[theme])
    return Image.alpha_composite(ground, Image.fromarray(picture)).convert("RGB")


def _how(column: Column, width_px: int) -> Image.Resampling:
    """Blow pixels up as squares, and average where there are more of them than the column is wide."""
    return Image.Resampling.NEAREST if column.pictures.shape[2] <= width_px else Image.Resampling.BOX


_FAINTEST = 0.35  # how strongly a single event is drawn where many are usual
_CLEAR, _BOX, _PLANE, _LATER, _ON, _OFF, _ON_NOW, _OFF_NOW = range(8)


@dataclass(frozen=True)
class CloudSize:
    """How large a cloud is drawn, pixels.

    Args:
        width: Columns of the image.
        height: Rows of the image.
        most: Events that are drawn, evenly taken from all.

    Raises:
        DataError: A side below 64 pixels.
    """

    width: int = 480
    height: int = 264
    most: int = 20_000

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 64 or self.most < 1:
            raise DataError(f"the cloud is {self.width} x {self.height}; give 64 x 64 pixels or more")

    def axes(self) -> NDArray[np.float64]:
        """Return where the box begins and where time, x and y lead, (column, row) each, [4, 2]."""
        wide, high = self.width - 8, self.height - 8
        return np.array(
            [[4, 4 + 0.13 * high], [0.74 * wide, -0.13 * high], [0.26 * wide, 0.33 * high], [0, 0.54 * high]]
        )


def cloud_images(
    events: Events, edges_us: NDArray[np.int64], size: CloudSize | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the events as points in time, x and y, once for each position: what was, what is, what comes.

    Time runs to the right, x towards the viewer, y downwards, all parallel. Events of the position shine, those
    before are fainter, those to come are grey; a frame stands at the position's instant.

    Args:
        events: The events.
        edges_us: N + 1 ascending instants, microseconds; position k has the events in (edge k, edge k + 1].
        size: Size of the images.

    Returns:
        Numbers of colours, uint8 [N, H, W], and the colours, uint8 [8, 4], RGBA; 0 is transparent.

    Example:
        >>> events = Events([5, 15], [0, 3], [1, 1], [True, False], width=4, height=2)
        >>> images, colours = cloud_images(events, np.array([0, 10, 20]))
        >>> images.shape, colours.shape, colours[0].tolist()
        ((2, 264, 480), (8, 4), [0, 0, 0, 0])
    """
    size = size or CloudSize()
    begin, along, across, down = size.axes()
    start_us, stop_us = int(edges_us[0]), int(edges_us[-1])
    shown = events.between(start_us, stop_us)
    shown = shown[:: max(1, -(-len(shown) // size.most))]
    share_t = (shown.t_us - start_us) / max(stop_us - start_us, 1)
    share_x, share_y = (shown.x + 0.5) / events.width, (shown.y + 0.5) / events.height
    place = begin + share_t[:, None] * along + share_x[:, None] * across + share_y[:, None] * down
    column, row = np.floor(place).astype(np.int64).T
    blank = Image.new("L", (size.width, size.height), _CLEAR)
    _edges(ImageDraw.Draw(blank), begin, along, across, down)
    base = np.array(blank)
    _dot(base, row, column, np.full(len(shown), _LATER, np.uint8))
    before = np.searchsorted(shown.t_us, edges_us, side="right")
    old, new = (
        np.where(shown.p, _ON, _OFF).astype(np.uint8),
        np.where(shown.p, _ON_NOW, _OFF_NOW).astype(np.uint8),
    )
    pictures = np.empty((len(edges_us) - 1, size.height, size.width), np.uint8)
    for k in range(len(pictures)):
        past = slice(before[max(k - 1, 0)], before[k])
        _dot(base, row[past], column[past], old[past])
        image = Image.fromarray(base)
        at = begin + (edges_us[k + 1] - start_us) / max(stop_us - start_us, 1) * along
        _frame(ImageDraw.Draw(image), at, across, down)
        picture = np.array(image)
        now = slice(before[k], before[k + 1])
        _dot(picture, row[now], column[now], new[now])
        _dot(picture, row[now] + 1, column[now], new[now])
        pictures[k] = picture
    colours = [(0, 0, 0, 0), (128, 134, 145, 120), (128, 134, 145, 255), (128, 134, 145, 56)]
    colours += [(*ON_RGB, 110), (*OFF_RGB, 110), (*ON_RGB, 255), (*OFF_RGB, 255)]
    return pictures, np.array(colours, np.uint8)


def signed_images(maps: NDArray, top: float | None = None, faintest: float = _FAINTEST) -> NDArray[np.uint8]:
    """Return maps of ON and OFF as RGBA images, transparent where there is nothing.

    Args:
        maps: [..., 2, H, W], ON first, 0 or more.
        top: Value that is drawn opaque; None: the 99th percentile of what is above 0.
        faintest: Opacity of the smallest value above 0, 0..1.

    Returns:
        uint8 [..., H, W, 4].

    Example:
        >>> signed_images(np.array([[[1.0, 0.0]], [[0.0, 0.0]]])).tolist()
        [[[226, 120, 0, 255], [0, 0, 0, 0]]]
    """
    maps = np.asarray(maps, np.float32)
    lit = maps[maps > 0]
    if top is None:
        top = float(np.percentile(lit, 99)) if len(lit) else 1.0
    total = maps.sum(axis=-3)
    share = np.where(total > 0, maps[..., 0, :, :] / np.maximum(total, 1e-12), 0.0)[..., None]
    strength = np.clip(maps.max(axis=-3) / max(top, 1e-12), 0, 1)
    alpha = np.where(total > 0, faintest + (1 - faintest) * strength, 0.0)[..., None]
    colour = share * np.array(ON_RGB) + (1 - share) * np.array(OFF_RGB)
    picture = np.concatenate([np.where(alpha > 0, colour, 0), 255 * alpha], axis=-1)
    return np.round(picture).astype(np.uint8)


def time_slices(events: Events, edges_us: NDArray[np.int64], bins: int = 240) -> tuple[NDArray, NDArray]:
    """Return slices through the middle of the cloud: x over time, and y over time.

    Each counts the events of the middle eighth of the other axis.

    Args:
        events: The events.
        edges_us: First and last of them bound the time, microseconds.
        bins: Columns: steps of time.

    Returns:
        Counts of ON and OFF, float32 [2, width, bins] and [2, height, bins].

    Raises:
        DataError: Fewer than one bin.
    """
    if bins < 1:
        raise DataError(f"bins is {bins}; give at least 1")
    start_us, stop_us = int(edges_us[0]), int(edges_us[-1])
    shown = events.between(start_us, stop_us)
    step = np.minimum((shown.t_us - start_us) * bins // max(stop_us - start_us, 1), bins - 1)
    slices = []
    for own, side, other, length in (
        (shown.x, events.width, shown.y, events.height),
        (shown.y, events.height, shown.x, events.width),
    ):
        half = max(length / 16, 0.5)
        inside = np.abs(other + 0.5 - length / 2) <= half
        index = ((~shown.p[inside]).astype(np.int64) * side + own[inside]) * bins + step[inside]
        counts = np.bincount(index, minlength=2 * side * bins)
        slices.append(counts.astype(np.float32).reshape(2, side, bins))
    return slices[0], slices[1]


def smaller(events: Events, side_px: int) -> Events:
    """Return events of a large sensor on one of at most `side_px` pixels per side; blocks of pixels become one.

    Example:
        >>> smaller(Events([1], [9], [3], [1], width=10, height=4), 5)
        Events(1 events, 5 x 2, 1..1 us, 100 % ON)
    """
    factor = -(-max(events.width, events.height) // side_px)
    if factor == 1:
        return events
    width, height = -(-events.width // factor), -(-events.height // factor)
    x, y = (np.asarray(one // factor, np.uint16) for one in (events.x, events.y))
    return Events(events.t_us, x, y, events.p, width, height)


def slice_images(events: Events, edges_us: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the events of each position where they happened, RGBA, uint8 [N, H, W, 4]."""
    return signed_images(event_histogram(events, edges_us))


def _dot(picture: NDArray[np.uint8], row: NDArray, column: NDArray, colour: NDArray[np.uint8]) -> None:
    """Paint dots two pixels wide; those beyond the image are cut."""
    for side in (0, 1):
        r, c = np.clip(row, 0, picture.shape[0] - 1), np.clip(column + side, 0, picture.shape[1] - 1)
        picture[r, c] = colour


def _edges(draw: ImageDraw.ImageDraw, begin: NDArray, along: NDArray, across: NDArray, down: NDArray) -> None:
    for a, b, edge in ((across, down, along), (along, down, across), (along, across, down)):
        for one in (0, 1):
            for other in (0, 1):
                corner = begin + one * a + other * b
                draw.line([*corner, *(corner + edge)], fill=_BOX)


def _frame(draw: ImageDraw.ImageDraw, at: NDArray, across: NDArray, down: NDArray) -> None:
    corners = [at, at + across, at + across + down, at + down, at]
    draw.line([tuple(corner) for corner in corners], fill=_PLANE, width=2)
