"""Time stamps of a few rows of pixels, stream beside stream: layers show where a simulator counts in frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from evnlos.events.colours import OFF_HEX, ON_HEX
from evnlos.plot.figure import new_figure, save_figure
from evnlos.types import Events


def share_on_frame_times(events: Events, times_s: ArrayLike) -> float:
    """Return the share of events whose time stamp is that of a frame, to the microsecond; NaN without events.

    Args:
        events: The events of a simulated video.
        times_s: Times of its frames, [T], seconds.

    Example:
        >>> events = Events([1000, 1500, 2000, 2001], [0] * 4, [0] * 4, [1] * 4, width=1, height=1)
        >>> share_on_frame_times(events, [0.001, 0.002])
        0.5
    """
    frames_us = np.round(np.asarray(times_s, dtype=np.float64) * 1e6).astype(np.int64)
    return float(np.isin(events.t_us, frames_us).mean()) if len(events) else float("nan")


def draw_time_stamps(
    path: str | Path,
    streams: Mapping[str, Events],
    times_s: ArrayLike,
    *,
    rows: tuple[int, int],
    window_s: tuple[float, float],
) -> Path:
    """Draw column against time of the events of some rows, one panel a stream; needs matplotlib.

    Args:
        path: The picture, PNG or SVG.
        streams: Events of the same scene by title.
        times_s: Times of the frames that they were made from, [T], seconds: thin lines.
        rows: First row, and the row after the last.
        window_s: Begin and end of what is drawn, seconds.

    Returns:
        The path.
    """
    figure = new_figure((10.5, 3.6))
    panels = figure.subplots(1, len(streams), sharex=True, sharey=True, squeeze=False)[0]
    start, stop = window_s
    frames_ms = 1e3 * np.asarray(times_s, dtype=np.float64)
    frames_ms = frames_ms[(frames_ms >= 1e3 * start) & (frames_ms <= 1e3 * stop)]
    for axes, (title, events) in zip(panels, streams.items(), strict=True):
        shown = (events.y >= rows[0]) & (events.y < rows[1])
        shown &= (events.t_us >= 1e6 * start) & (events.t_us <= 1e6 * stop)
        for frame_ms in frames_ms:
            axes.axvline(frame_ms, color="#d8d8d8", linewidth=0.6, zorder=0)
        for sign, colour, name in ((True, ON_HEX, "ON"), (False, OFF_HEX, "OFF")):
            part = events[shown & (events.p == sign)]
            axes.scatter(part.t_us / 1e3, part.x, s=7, color=colour, linewidths=0, label=name)
        share = share_on_frame_times(events, times_s)
        axes.set_title(f"{title}: {100 * share:.3g} % of all events on frame times", fontsize=10)
        axes.set(xlabel="time, ms", xlim=(1e3 * start, 1e3 * stop))
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("column, pixels")
    panels[-1].legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=2)
    return save_figure(figure, path, dpi=110)
