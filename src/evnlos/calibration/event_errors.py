"""What a calibrated setup gets wrong of the events of its own captures, for all that are solved after them."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
import torch

from evnlos.data import read_capture
from evnlos.errors import ConfigError
from evnlos.inverse.event_images import (
    EVENT_ERRORS,
    EVENT_ERRORS_FILE,
    AboutErrors,
    EventErrors,
    event_statistic,
)
from evnlos.machine import Progress, Step, silent

_MOST = 16  # captures: a second or two each


def write_event_errors(
    setup: Path, captures: Iterable[Path], names: Collection[str], progress: Progress = silent
) -> EventErrors | None:
    """Find what captures with known targets show of the errors of a setup's events, and write it to its folder.

    `event_images` takes it into account: for a capture that is among these, what the others showed.

    Args:
        setup: Folder of a calibrated setup.
        captures: Capture folders.
        names: Names of the captures that the setup was calibrated with; of more than 16 every so many are
            taken. Those without events, of unknown or several targets, or of unknown motion, are passed over.
        progress: Called as the captures are read.

    Returns:
        The errors; None, and nothing is written, where no capture shows them, or no law of the setup's event
        model is known.
    """
    learned = [folder for folder in captures if folder.resolve().name in names]
    learned = learned[:: max(1, -(-len(learned) // _MOST))]
    found, scores, information = list[str](), [], []
    what = "errors of the events"
    for number, folder in enumerate(learned):
        progress(Step(what, number, len(learned), "captures"))
        capture = read_capture(folder, needs_frames=False)
        target = capture.target
        if not capture.has_events or capture.motion is None or target is None or capture.several is not None:
            continue
        try:
            statistic, prior, _ = event_statistic(
                capture.events, capture.frame_times_us, capture.motion, str(setup)
            )
        except ConfigError:
            return None
        z = prior.coefficients(target.rasterise(prior.target_plane))
        found.append(capture.name)
        scores.append(statistic.score - statistic.information @ z)
        information.append(statistic.information)
    if not found:
        return None
    tensors = {
        "scores": torch.from_numpy(np.stack(scores)).float(),
        "information": torch.from_numpy(np.mean(information, axis=0)).float(),
    }
    about = AboutErrors(tuple(found))
    EVENT_ERRORS.write(setup / EVENT_ERRORS_FILE, tensors, about)
    progress(Step(what, len(learned), len(learned), "captures"))
    return EventErrors(about, **tensors)
