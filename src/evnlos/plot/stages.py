"""A figure for each stage of a pass: wall, events in space and time, surfaces, reconstructions.

They need matplotlib and take `theme` ("light" or "dark"); axes carry units, and colour maps keep their order
in grey print.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.events.colours import OFF_HEX, ON_HEX
from evnlos.plot.event_views import signed_pictures, time_slices
from evnlos.plot.figure import new_figure, save_figure, themed
from evnlos.plot.film import Theme
from evnlos.types import Events

_MOST = 20_000  # points that a cloud draws


def draw_wall(
    path: str | Path, frames: NDArray, times_s: ArrayLike, count: int = 4, theme: Theme = "light"
) -> Path:
    """Draw frames of the wall at a few instants, with their digital numbers.

    Args:
        path: The picture, PNG or SVG.
        frames: Digital numbers [N, H, W].
        times_s: Their times, [N], seconds.
        count: How many are drawn, evenly spread.
        theme: Ground.

    Raises:
        DataError: As many times as frames are needed.
        MissingDependencyError: matplotlib is not installed.
    """
    times = _times(times_s, len(frames))
    chosen = _spread(len(frames), count)
    with themed(theme):
        figure = new_figure((2.6 * len(chosen) + 0.8, 2.2))
        line = figure.subplots(1, len(chosen), squeeze=False, sharey=True)[0]
        shown = None
        for axes, k in zip(line, chosen, strict=True):
            shown = axes.imshow(
                frames[k], cmap="gray", vmin=0, vmax=float(frames.max()), interpolation="nearest"
            )
            axes.set(title=f"{times[k]:.2f} s", xlabel="x, pixels")
        line[0].set_ylabel("y, pixels")
        figure.colorbar(shown, ax=list(line), label="digital number")
        return save_figure(figure, path, dpi=100)


def draw_events(path: str | Path, events: Events, theme: Theme = "light") -> Path:
    """Draw events as a cloud in time, x and y, and two slices through its middle.

    Args:
        path: The picture, PNG or SVG.
        events: The events; at most 20,000 of them are drawn in the cloud, evenly taken.
        theme: Ground.

    Raises:
        DataError: There are no events.
        MissingDependencyError: matplotlib is not installed.
    """
    if not len(events):
        raise DataError("there are no events to draw; give at least one")
    part = events[:: max(1, -(-len(events) // _MOST))]
    start, stop = int(events.t_us[0]) - 1, int(events.t_us[-1])
    span = (start / 1e6, stop / 1e6)
    with themed(theme):
        figure = new_figure((10.5, 4.2))
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1))
        cloud = figure.add_subplot(grid[:, 0], projection="3d")
        for sign, colour, name in ((True, ON_HEX, "ON, brighter"), (False, OFF_HEX, "OFF, darker")):
            one = part[part.p == sign]
            cloud.scatter(
                one.t_us / 1e6, one.x, -one.y.astype(float), s=1, color=colour, linewidths=0, label=name
            )
        cloud.set(xlabel="time, s", ylabel="x, pixels", zlabel="-y, pixels")
        cloud.legend(frameon=False, markerscale=6, loc="upper left")
        counts = time_slices(events, np.array([start, stop]))
        for row, (name, one, side) in enumerate(zip("xy", counts, (events.width, events.height), strict=True)):
            axes = figure.add_subplot(grid[row, 1])
            axes.imshow(signed_pictures(one), aspect="auto", extent=(*span, side, 0), interpolation="nearest")
            axes.set(xlabel="time, s", ylabel=f"{name}, pixels")
        return save_figure(figure, path, dpi=100)


def draw_surfaces(
    path: str | Path, surface: NDArray, times_s: ArrayLike, count: int = 4, theme: Theme = "light"
) -> Path:
    """Draw time surfaces at a few instants: ON above, OFF below, 0 to their largest value.

    Args:
        path: The picture, PNG or SVG.
        surface: Maps [N, 2, H, W], ON first.
        times_s: End of each grid, [N], seconds.
        count: How many are drawn, evenly spread.
        theme: Ground.

    Raises:
        DataError: As many times as surfaces are needed.
        MissingDependencyError: matplotlib is not installed.
    """
    times = _times(times_s, len(surface))
    chosen = _spread(len(surface), count)
    with themed(theme):
        figure = new_figure((2.6 * len(chosen) + 0.8, 3.9))
        grid = figure.subplots(2, len(chosen), squeeze=False, sharex=True, sharey=True)
        shown, top = None, max(float(surface.max()), 1e-12)
        for column, k in enumerate(chosen):
            grid[0, column].set_title(f"{times[k]:.2f} s")
            grid[1, column].set_xlabel("x, pixels")
            for row in (0, 1):
                image = surface[k, row]
                shown = grid[row, column].imshow(
                    image, cmap="cividis", vmin=0, vmax=top, interpolation="nearest"
                )
        for row, name in enumerate(("ON", "OFF")):
            grid[row, 0].set_ylabel(f"{name}: y, pixels")
        figure.colorbar(shown, ax=list(grid.flat), label="time surface, 1 = just now")
        return save_figure(figure, path, dpi=100)


def draw_comparison(
    path: str | Path, pictures: Mapping[str, NDArray], extent_cm: tuple[float, float], theme: Theme = "light"
) -> Path:
    """Draw pictures of one position side by side, 0 black and 1 white, in centimetres of the canvas.

    Args:
        path: The picture, PNG or SVG.
        pictures: Pictures [H, W] by title, e.g. truth and what several methods made.
        extent_cm: Height and width of the canvas, centimetres.
        theme: Ground.

    Raises:
        DataError: No picture is given.
        MissingDependencyError: matplotlib is not installed.
    """
    if not pictures:
        raise DataError("there are no pictures to compare; give at least one")
    half_y, half_x = extent_cm[0] / 2, extent_cm[1] / 2
    with themed(theme):
        figure = new_figure((2.9 * len(pictures), 2.3))
        line = figure.subplots(1, len(pictures), squeeze=False, sharey=True)[0]
        for axes, (title, picture) in zip(line, pictures.items(), strict=True):
            axes.imshow(picture, cmap="gray", vmin=0, vmax=1, extent=(-half_x, half_x, half_y, -half_y))
            axes.set(title=title, xlabel="x, cm")
        line[0].set_ylabel("y, cm (downwards)")
        return save_figure(figure, path, dpi=100)


def _times(times_s: ArrayLike, count: int) -> NDArray[np.float64]:
    times = np.asarray(times_s, dtype=np.float64)
    if times.shape != (count,):
        raise DataError(f"there are {count} maps and times of shape {times.shape}; give one time a map")
    return times


def _spread(total: int, count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, total - 1, max(1, min(count, total)) + 2)[1:-1].round().astype(np.int64))
