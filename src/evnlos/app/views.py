"""From a pass and its reconstructions to the pictures that stand side by side on the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.app.recorded import Recorded
from evnlos.app.solving import Reconstruction
from evnlos.dataset import Sampling
from evnlos.events import time_surface
from evnlos.events.colours import WORDS
from evnlos.plot.event_views import (
    CloudSize,
    cloud_pictures,
    signed_pictures,
    slice_pictures,
    smaller,
    time_slices,
)
from evnlos.report.pictures import grey

_LONGEST_SIDE = 320  # of a picture of the wall or of events: a page shows no more


@dataclass(frozen=True, eq=False)
class View:
    """One place on the page: a picture for each position, or one with a cursor that runs through time.

    Args:
        title: What it shows.
        note: How to read it, with units.
        pictures: uint8, grey [N, h, w], RGBA [N, h, w, 4], or with `colours` numbers of colours [N, h, w].
        captions: A line for each position; empty where there is none.
        colours: RGBA, uint8 [K, 4].
        group: "seen", "found" or "events": where on the page it stands.
        cursor: Whether time runs to the right in the one picture.
        marks: Words at places of the picture: (text, left, top), shares of its sides.
    """

    title: str
    note: str
    pictures: NDArray[np.uint8]
    captions: tuple[str, ...] = ()
    colours: NDArray[np.uint8] | None = None
    group: str = "seen"
    cursor: bool = False
    marks: tuple[tuple[str, float, float], ...] = ()


def seen_views(recorded: Recorded) -> list[View]:
    """Return hidden object, wall, events and time surface."""
    views = []
    truth = recorded.truth(Sampling())
    if truth is not None:
        views.append(View("Hidden object", "24 cm x 12 cm around the corner; nobody sees this", grey(truth)))
    if recorded.frames is not None:
        views.append(_wall_view(recorded))
    events, edges = smaller(recorded.events, _LONGEST_SIDE), recorded.edges_us
    counts = np.diff(np.searchsorted(events.t_us, edges, side="right"))
    interval_ms = float(np.median(np.diff(edges))) / 1e3
    views.append(
        View(
            "Events",
            f"{WORDS}, of the last {interval_ms:.3g} ms",
            slice_pictures(events, edges),
            tuple(f"{count:,} events" for count in counts),
        )
    )
    tau_us = max(float(np.median(np.diff(edges))), 1.0)
    surface = time_surface(events, edges, tau_us)
    views.append(
        View(
            "Time surface",
            f"each pixel's newest event; it fades in {interval_ms:.3g} ms",
            signed_pictures(surface, 1.0, faintest=0.0),
        )
    )
    return views


def found_views(found: Sequence[Reconstruction]) -> list[View]:
    """Return a view of each reconstruction, with its PSNR beside that of an all-black picture."""
    views = []
    for one in found:
        captions: tuple[str, ...] = ()
        if one.psnr_db is not None and one.black_db is not None:
            captions = tuple(
                f"{own:.1f} dB, black {black:.1f}" for own, black in zip(one.psnr_db, one.black_db, strict=True)
            )
        views.append(
            View(one.name[:1].upper() + one.name[1:], one.note, grey(one.images), captions, group="found")
        )
    return views


def event_views(recorded: Recorded) -> list[View]:
    """Return the space-time cloud and the slices through its middle."""
    events, edges = smaller(recorded.events, _LONGEST_SIDE), recorded.edges_us
    size = CloudSize()
    pictures, colours = cloud_pictures(events, edges, size)
    begin, along, across, down = size.axes() / [size.width, size.height]
    seconds = (int(edges[-1]) - int(edges[0])) / 1e6
    foot = begin + across + down
    marks = (
        (f"time, {seconds:.3g} s", *(foot + 0.5 * along + [0, 0.03])),
        (f"x, {recorded.events.width} px", 0.01, float((begin + down + 0.62 * across)[1])),
        (f"y, {recorded.events.height} px", *(begin + 0.9 * down + [0.01, -0.06])),
    )
    drawn = min(len(events), size.most)
    note = f"{drawn:,} of {len(events):,} events; the frame stands at this instant, grey is still to come"
    views = [View("Space-time cloud", note, pictures, (), colours, "events", marks=marks)]
    for name, other, counts in zip("xy", ("rows", "columns"), time_slices(events, edges), strict=True):
        note = f"events of the middle {other}: {name} downwards, time to the right ({seconds:.3g} s)"
        picture = signed_pictures(counts)[None]
        views.append(View(f"Slice: {name} over time", note, picture, (), None, "events", cursor=True))
    return views


def _wall_view(recorded: Recorded) -> View:
    assert recorded.frames is not None  # asked by the caller
    levels = recorded.frames.astype(np.float32) / recorded.peak
    factor = -(-max(levels.shape[1:]) // _LONGEST_SIDE)
    levels = levels[:, ::factor, ::factor]
    low, high = np.percentile(levels, [0.5, 99.8])
    brightest = levels.max(axis=(1, 2))
    return View(
        "Wall",
        f"what the frame camera sees; black {low:.2f}, white {high:.2f} of full scale",
        grey(levels, low, high),
        tuple(f"brightest pixel {value:.2f}" for value in brightest),
    )
