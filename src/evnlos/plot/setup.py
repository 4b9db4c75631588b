"""The setup to scale, what it can show, and what a corner shows.

- A setup, to scale, seen from above; SVG in the colours of the page that it stands on.
- What a setup can show, drawn: singular values, Picard plot, modes, and the best linear image.
- What a corner shows: the hidden side over bearing and time, and who moves there.
"""

from __future__ import annotations

import html
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.plot.figures import new_figure, save_figure, signed_map
from evnlos.setups import Setup

if TYPE_CHECKING:
    from evnlos.analysis.bounds import Bounds
    from evnlos.analysis.identify import Identification
    from evnlos.inverse import CornerImage, FloorSector
    from evnlos.tracking import BearingTracks

_WIDTH, _HEIGHT, _MARGIN = 620, 400, 46
_LIGHT, _SIGHT = "#c9760b", "#2f7bd6"  # distinguished with every common kind of colour blindness
PARTITION = "hides the object (sketch)"
"""What stands beside the line that no setup's settings state."""
_SCALES_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


def scale_bar(most_m: float) -> tuple[float, str]:
    """Return the length of a scale bar, metres, and the words for it: a round one.

    Args:
        most_m: Its length at most, from a centimetre on.

    Example:
        >>> scale_bar(0.03)
        (0.02, '2 cm')
    """
    length = max((one for one in _SCALES_M if one <= most_m), default=_SCALES_M[0])
    return length, f"{100 * length:g} cm"


@dataclass(frozen=True)
class Drawing:
    """An SVG drawing; a notebook shows it as an image.

    Args:
        svg: The drawing.
    """

    svg: str

    def _repr_svg_(self) -> str:
        return self.svg


def setup_drawing(setup: Setup, travel_m: float = 0.16, target_size_m: float = 0.08) -> Drawing | None:
    """Return the setup from above, to scale: wall, object and its way, cameras and their view, what is between.

    Where the setup has no place of the camera, none is drawn. Occluders stand where they are; what hides the
    object from the camera is in no setup, so a dotted line sketches it.

    Args:
        setup: The setup.
        travel_m: Way of the object's middle, metres.
        target_size_m: Side of the target plane, metres.

    Returns:
        The drawing; None for a setup that does not know where its parts are.

    Example:
        >>> from evnlos.setups import load_setup
        >>> setup_drawing(load_setup("main-near")).svg[:4]
        '<svg'
    """
    layout = setup.layout()
    if layout is None:
        return None
    parts, around = [], []  # drawn in metres first: (kind, points, style or words)
    middle, deep = layout.target
    half = (travel_m + target_size_m) / 2
    parts.append(
        ("line", [(middle - half, deep), (middle + half, deep)], f"stroke='{_LIGHT}' stroke-dasharray='2 3'")
    )
    parts.append(
        (
            "line",
            [(middle - target_size_m / 2, deep), (middle + target_size_m / 2, deep)],
            f"stroke='{_LIGHT}' stroke-width='4'",
        )
    )
    parts.append(
        ("text", [(middle, deep)], f"object {100 * target_size_m:.3g} cm, way {100 * travel_m:.3g} cm")
    )
    reach = max(half + abs(middle) + 0.04, 0.2)
    around += [(middle - half, deep), (middle + half, deep)]
    if layout.camera is not None:
        eye = layout.camera
        seen = [(x, 0.0) for x in layout.seen_m or ()]
        reach = max(reach, *(abs(x) + 0.02 for x, _ in seen))
        parts += [("line", [eye, one], f"stroke='{_SIGHT}' stroke-width='1'") for one in seen]
        parts.append(("disc", [eye], f"fill='{_SIGHT}'"))
        parts.append(("text", [eye], f"cameras, {layout.camera_words}"))
        for polygon in layout.occluders:
            corners = np.asarray(polygon)
            parts.append(
                ("line", [tuple(c) for c in (*corners, corners[0])], "stroke='currentColor' stroke-width='3'")
            )
            parts.append(("text", [tuple(corners.mean(axis=0))], "occluder"))
        hidden = _partition(eye, seen, (middle - half, middle + half), deep)
        if hidden is not None:
            dotted = "stroke='currentColor' stroke-width='3' stroke-dasharray='2 4' data-part='partition'"
            parts += [("line", list(hidden), dotted), ("text", [hidden[1]], PARTITION)]
            around += list(hidden)
        if layout.lamp is not None:
            lamp = layout.lamp
            parts += [("disc", [lamp], f"fill='{_LIGHT}'"), ("text", [lamp], "lamp")]
            around.append(lamp)
        parts.append(
            (
                "line",
                [(middle, deep), (0.0, 0.0), eye],
                f"stroke='{_LIGHT}' stroke-width='.8' stroke-dasharray='6 4'",
            )
        )
        around += [eye, *seen]
    parts.append(("line", [(-reach, 0.0), (reach, 0.0)], "stroke='currentColor' stroke-width='5'"))
    around += [(-reach, 0.0), (reach, 0.0)]
    return Drawing(_svg(parts, np.array(around), layout.wall, deep))


def _partition(
    eye: tuple[float, float], seen: list[tuple[float, float]], way: tuple[float, float], deep: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return a line that hides the object's whole way from the camera and leaves light and sight free.

    It stands between the object's way and the camera's nearer line of sight, upright on the wall.

    Returns:
        Its ends (x, z), metres, from the object's depth on; None where the camera is no deeper than the object,
        or there is no gap.
    """
    if eye[1] <= deep:
        return None
    side = 1.0 if eye[0] > (way[0] + way[1]) / 2 else -1.0
    near, far = max(way, key=lambda x: side * x), min(way, key=lambda x: side * x)
    share = deep / eye[1]
    sight = min((x + share * (eye[0] - x) for x, _ in seen), key=lambda x: side * x)
    if side * (sight - near) <= 0:
        return None
    x = (near + sight) / 2
    steepest = deep + (x - far) / (eye[0] - far) * (eye[1] - deep)  # where the line to the far end passes
    end = deep + 1.15 * (steepest - deep)
    return (x, deep), (x, end)


def _svg(parts: list, around: NDArray[np.float64], wall: str, deep: float) -> str:
    low, high = around.min(axis=0), around.max(axis=0)
    scale = min(
        (_WIDTH - 2 * _MARGIN) / (high[0] - low[0]), (_HEIGHT - 2 * _MARGIN - 26) / max(high[1] - low[1], 1e-9)
    )

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return _MARGIN + (point[0] - low[0]) * scale, _MARGIN + (point[1] - low[1]) * scale

    drawn = []
    for kind, points, style in parts:
        at = [place(point) for point in points]
        if kind == "line":
            drawn.append(
                f"<polyline points='{' '.join(f'{x:.1f},{y:.1f}' for x, y in at)}' fill='none' {style}/>"
            )
        elif kind == "disc":
            drawn.append(f"<circle cx='{at[0][0]:.1f}' cy='{at[0][1]:.1f}' r='6' {style}/>")
        else:
            x = min(max(at[0][0], 90), _WIDTH - 110)
            drawn.append(_text(x, at[0][1] + 20, style))
    drawn.append(_text(place((0.0, 0.0))[0], _MARGIN - 16, wall))
    x, top, bottom = place((low[0], 0.0))[0] + 12, place((0.0, 0.0))[1] + 4, place((0.0, deep))[1]
    drawn.append(f"<path d='M{x:.1f} {top:.1f}V{bottom:.1f}' stroke='currentColor' stroke-width='.8' />")
    drawn.append(_text(x + 5, (top + bottom) / 2, f"{100 * deep:.3g} cm", "start"))
    step, length = scale_bar(150 / scale)
    left, foot = _MARGIN, _HEIGHT - 14
    drawn.append(f"<path d='M{left} {foot - 4}v4h{step * scale:.1f}v-4' fill='none' stroke='currentColor' />")
    drawn.append(_text(left + step * scale + 8, foot, f"{length}; seen from above, to scale", "start"))
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {_WIDTH} {_HEIGHT}' width='{_WIDTH}' role='img' "
        f"aria-label='setup, to scale' font-family='sans-serif' font-size='12'>{''.join(drawn)}</svg>"
    )


def _text(x: float, y: float, words: str, anchor: str = "middle") -> str:
    return (
        f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}' fill='currentColor'>{html.escape(words)}</text>"
    )


_TRACKS = ("#d95f02", "#1b9e77", "#7570b3", "#e7298a")  # apart in hue, and drawn with other dashes


def draw_corner(
    path: str | Path,
    picture: CornerImage,
    found: BearingTracks,
    floor: NDArray,
    sector: FloorSector,
    sentence: str,
    truth_deg: ArrayLike | None = None,
) -> Path:
    """Draw what a corner shows: the floor that was used, the hidden side over time, its certainty, the tracks.

    Args:
        path: The image, PNG, SVG or PDF.
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


def draw_identification(found: Identification, path: str | Path, limits: Bounds | None = None) -> Path:
    """Draw singular values, the Picard plot of a typical target, the first modes, truth and linear image.

    Args:
        found: What `identify` returned.
        path: The image, PNG or SVG.
        limits: What `sequence_bounds` returned: a panel more, expected PSNR over the number of positions.

    Returns:
        The path.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
    """
    figure = new_figure((10.5, 6.2) if limits is None else (12.8, 6.6))
    grid = figure.add_gridspec(2, 1, height_ratios=(1.5, 1))
    curves = grid[0].subgridspec(1, 2 if limits is None else 3)
    pictures = grid[1].subgridspec(2, 6)
    _singular_values(figure.add_subplot(curves[0]), [found])
    _picard(figure.add_subplot(curves[1]), found)
    if limits is not None:
        _over_positions(figure.add_subplot(curves[2]), limits)
    at = found.at_camera
    for row, (image, title) in enumerate(((found.truth, "truth"), (at.picture, "best linear"))):
        _image_of(figure.add_subplot(pictures[row, 0]), image, title)
    for k, mode in enumerate(at.modes):
        place = figure.add_subplot(pictures[k // 4, 1 + k % 4])
        _image_of(place, mode, f"mode {k + 1}", signed_map(), float(mode.abs().max()))
    words = figure.add_subplot(pictures[:, 5])
    words.set_axis_off()
    strokes = " x ".join("none" if w is None else f"{1e3 * w:.1f}" for w in at.stroke_m)
    words.text(
        0.0,
        0.5,
        f"{found.modes} modes > 1e-2\n{at.patterns} patterns > noise\nbars {strokes} mm\n"
        f"linear {at.psnr_db:.1f} dB\nmean {found.mean_db:.1f} dB\nblack {found.zero_db:.1f} dB\n"
        "modes: light > 0 > dark",
        va="center",
        fontsize=9,
    )
    figure.suptitle(found.name)
    return save_figure(figure, path, dpi=100)


def draw_setups(found: Sequence[Identification], path: str | Path) -> Path:
    """Draw the singular values of several setups in one plot.

    Args:
        found: The setups.
        path: The image, PNG or SVG.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
    """
    figure = new_figure((8.0, 4.6))
    _singular_values(figure.add_subplot(), found)
    return save_figure(figure, path, dpi=100)


def _singular_values(axes: Any, found: Sequence[Identification]) -> None:
    walls = list(dict.fromkeys(one.name.partition("-")[0] for one in found))
    for one in found:
        values = one.singular.numpy()
        wall, _, place = one.name.partition("-")
        style = {"color": f"C{walls.index(wall)}", "linestyle": "--" if place == "far" else "-", "lw": 1.2}
        axes.semilogy(np.arange(1, len(values) + 1), _above(values, 1e-7), label=one.name, **style)
    axes.axhline(1e-2, color="k", lw=0.7, ls=":")
    axes.set(xlabel="mode", ylabel="singular value / largest", ylim=(1e-7, 1.5), xscale="log")
    axes.legend(frameon=False, fontsize=8, ncols=2 if len(found) > 6 else 1)


def _picard(axes: Any, found: Identification) -> None:
    at = found.at_camera
    mode = np.arange(1, len(at.spectrum) + 1)
    axes.semilogy(mode, _above(at.spectrum.numpy(), 1e-3), label="singular value / noise", lw=1.2)
    axes.semilogy(mode, _above(at.picard.numpy(), 1e-3), ".", ms=3, label="a letter's coefficient / noise")
    axes.axhline(1.0, color="k", lw=0.7, ls=":", label="noise")
    axes.set(xlabel="mode", xscale="log", ylim=(1e-3, None))
    axes.legend(frameon=False, fontsize=8)


def _over_positions(axes: Any, limits: Bounds) -> None:
    """Draw expected PSNR over the number of positions; of other errors and models only what events tell."""
    counts, own = np.array(limits.settings.counts), limits.events[0] if limits.events else None
    axes.plot(counts, limits.frames_db, "o-", color="C0", lw=1.6, ms=4, label="frames")
    if own is not None:
        what = f"{own.kind}, {100 * own.noise:.1f} %"
        axes.plot(counts, own.both_db, "x--", color="k", lw=1.2, ms=5, label=f"both, {what}")
        axes.plot(counts, own.events_db, "s-", color="C1", lw=1.6, ms=4, label=f"events, {what}")
        others = [one for one in limits.events[1:] if one.kind != own.kind]
        errors = [one for one in limits.events[1:] if one.kind == own.kind]
        for k, one in enumerate(errors):
            label = None if k else "events, other errors of a crossing"
            axes.plot(counts, one.events_db, ":", color="C1", lw=1.2, label=label)
            place = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "fontsize": 7}
            axes.annotate(f"{100 * one.noise:.0f} %", (counts[-1], one.events_db[-1]), **place)
        for k, one in enumerate(others):
            label = None if k else f"events, {', '.join(other.kind for other in others)}"
            axes.plot(counts, one.events_db, "-.", color="0.5", lw=0.9, label=label)
    axes.axhline(limits.prior_db, color="k", lw=0.7, ls=":", label="prior alone")
    axes.set(xlabel="positions", ylabel="expected PSNR, dB", xscale="log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set_xlim(0.85 * counts.min(), 1.35 * counts.max())  # what stands beside the last points is inside
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.5 * (high - low))  # the legend's own room
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _above(values: Any, floor: float) -> Any:
    """Return the values with NaN, which is not drawn, below a floor."""
    return np.where(values > floor, values, np.nan)


def _image_of(axes: Any, image: Any, title: str, cmap: Any = "gray", largest: float | None = None) -> None:
    low, high = (0.0, 1.0) if largest is None else (-largest, largest)
    axes.imshow(image.numpy(), cmap=cmap, vmin=low, vmax=high)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()
