"""The path of a hidden object and its speed; needs matplotlib."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.plot.figure import new_figure, save_figure
from evnlos.tracking import Track

_HEADROOM = 1.1  # of the speed's axis over the largest speed, so that no line lies on the frame


def draw_track(
    track: Track, path: str | Path, truth: NDArray[np.float64] | None = None, title: str = ""
) -> Path:
    """Draw the path, both coordinates, speed, and size or distance over time, with bands of two deviations.

    Args:
        track: The track.
        path: The picture, PNG or SVG.
        truth: The true position (x, y) at the track's instants, [T, 2], in its unit, where it is known.
        title: Heading of the figure.

    Returns:
        The path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    scale, unit = (100.0, "cm") if track.unit == "m" else (1.0, "px")
    figure = new_figure((11.0, 6.4))
    (plane, along), (speed, size) = figure.subplots(2, 2)
    if title:
        figure.suptitle(title)
    plane.plot(*(scale * track.frame_position.T), ".", color="0.6", label="frames")
    plane.plot(*(scale * track.position.T), color="C0", label="track")
    if truth is not None:
        plane.plot(*(scale * truth.T), "--", color="k", linewidth=1, label="truth")
    plane.set(xlabel=f"x, {unit}", ylabel=f"y, {unit} (downwards)", title="path")
    plane.invert_yaxis()
    plane.set_aspect("equal", adjustable="datalim")
    plane.legend()
    for axis, name in enumerate("xy"):
        middle, band = scale * track.position[:, axis], 2 * scale * track.position_sigma[:, axis]
        along.plot(track.time_s, middle, color=f"C{axis}", label=name)
        along.fill_between(track.time_s, middle - band, middle + band, color=f"C{axis}", alpha=0.3)
        if truth is not None:
            along.plot(track.time_s, scale * truth[:, axis], "--", color="k", linewidth=1)
    along.set(xlabel="time, s", ylabel=f"position, {unit}", title="position")
    along.legend()
    middle, band = scale * track.speed, 2 * scale * track.speed_sigma
    top = float((middle + band).max())
    speed.plot(track.time_s, middle, color="C2")
    speed.fill_between(track.time_s, middle - band, middle + band, color="C2", alpha=0.3)
    if truth is not None:
        rate = np.gradient(truth, track.time_s, axis=0)
        true = scale * np.hypot(rate[:, 0], rate[:, 1])
        top = max(top, float(true.max()))
        speed.plot(track.time_s, true, "--", color="k", linewidth=1)
    # An upper end of None would stay where it stood before and cut a band that has just been drawn.
    speed.set(xlabel="time, s", ylabel=f"speed, {unit}/s", title="speed", ylim=(0, _HEADROOM * top or None))
    if track.distance is None:
        size.errorbar(track.frame_time_s, track.size, 2 * track.size_sigma, fmt=".", color="C3")
        size.set(xlabel="time, s", ylabel="size over its mean", title="size of the picture")
    else:
        away = track.distance
        middle, band = scale * away.distance_m, 2 * scale * away.distance_sigma
        size.plot(away.time_s, middle, color="C3")
        size.fill_between(away.time_s, middle - band, middle + band, color="C3", alpha=0.3)
        size.set(xlabel="time, s", ylabel=f"distance, {unit}", title="distance from the wall")
    return save_figure(figure, path, dpi=80)
