"""What happens when a control moves or a file arrives: pictures and words as HTML, piece by piece."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path

from evnlos.app.controls import Controls
from evnlos.app.networks import Networks
from evnlos.app.recorded import Recorded, simulate_pass
from evnlos.app.sheet import message_box, sheet, verdict_box, waiting_box
from evnlos.app.solving import Reconstruction, from_each_frame, from_weights, from_whole_pass
from evnlos.app.upload import read_upload_apart
from evnlos.app.verdict import verdict_on
from evnlos.app.views import View, event_views, found_views, seen_views
from evnlos.errors import EvnlosError
from evnlos.scene import Target

UPLOADS_AT_ONCE = 4
"""Uploads that are read at the same time, each in a process of its own."""
_drawing = threading.Lock()  # what was read and checked takes seconds, and the cores are the page's


def simulated(controls: Controls, target: Target, networks: Networks) -> Iterator[tuple[str, str]]:
    """Yield (sheet, verdict) of a simulated pass three times: without networks, with them, with the verdict.

    Args:
        controls: Rig and camera.
        target: What is hidden.
        networks: The page's networks.

    Raises:
        EvnlosError: The settings can't be.
    """
    recorded = simulate_pass(controls, target)
    before, after = seen_views(recorded), event_views(recorded)
    found = [from_whole_pass(recorded), from_each_frame(recorded)]
    assert recorded.simulation is not None  # it was simulated
    yield _sheet(recorded, before, found, after), waiting_box()
    wall = networks.wall_of(recorded)
    found += [from_weights(recorded, name, one, wall) for name, one in networks.of(recorded).items()]
    pictures = _sheet(recorded, before, found, after)
    yield pictures, waiting_box()
    yield pictures, verdict_box(verdict_on(recorded.simulation))


def opening_verdict(controls: Controls) -> str:
    """Return the verdict on the rig that the page opens with."""
    return verdict_box(verdict_on(controls.simulation()))


def uploaded(path: str | None, scratch: Path, limit_bytes: int, networks: Networks) -> tuple[str, str]:
    """Return (sheet, message) of an uploaded file; whatever is wrong with it is a message of one line.

    Args:
        path: The file, or None where there is none.
        scratch: Folder to unpack in.
        limit_bytes: Largest file, bytes.
        networks: The page's networks.
    """
    if not path:
        return "", message_box("no file yet: choose a recording, or a capture folder as a zip", wrong=False)
    try:
        recorded = read_upload_apart(path, scratch, limit_bytes)
        found, refused = [], []
        with _drawing:
            known, wall = networks.of(recorded), networks.wall_of(recorded)
            for name, one in known.items():
                try:
                    found.append(from_weights(recorded, name, one, wall))
                except EvnlosError as error:
                    refused.append(str(error))
            pictures = _sheet(recorded, seen_views(recorded), found, event_views(recorded))
    except (EvnlosError, OSError, MemoryError) as error:
        return "", message_box(_without_folder(str(error) or "the file needs too much memory", path, scratch))
    notes = [*recorded.notes, *refused]
    if not known:
        notes.append(
            "no network to reconstruct with: those of the package need a capture folder that states the "
            "motion; or start the page with --weights"
        )
    return pictures, message_box("; ".join(notes), wrong=False)


def _sheet(recorded: Recorded, before: list[View], found: list[Reconstruction], after: list[View]) -> str:
    views = [*before, *found_views(found), *after]
    return sheet(views, recorded.times_s - recorded.edges_us[0] * 1e-6, recorded.name)


def _without_folder(text: str, path: str, scratch: Path) -> str:
    """Return a message without the folders of this machine."""
    folders = {scratch, scratch.resolve(), Path(path).parent, Path(path).resolve().parent}
    for folder in sorted(folders, key=lambda one: len(str(one)), reverse=True):  # the inner ones first
        text = re.sub(re.escape(str(folder)) + r"/(unpacked-[^/]*/)*", "", text)
    return text
