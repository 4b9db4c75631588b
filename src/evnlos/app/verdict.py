"""What the chosen rig can show at all, in plain words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

from evnlos.dataset import Simulation
from evnlos.evaluation import Bench, Identification, identify
from evnlos.sensor import EventPixel
from evnlos.setups import Setup

_CELLS, _WRITERS = 16, 2  # a coarse question, answered while one waits; `evnlos identify` asks the fine one


@dataclass(frozen=True)
class Verdict:
    """The verdict in words.

    Args:
        meaning: What a reconstruction would be, a sentence.
        reason: What was found, a sentence.
        figures: The same in decibels, a sentence.
    """

    meaning: str
    reason: str
    figures: str


@lru_cache(maxsize=64)
def _identified(setup: Setup) -> Identification:
    height, width = setup.shape
    return identify(setup, Bench(cells=_CELLS, height=height, width=width, writers=_WRITERS))


def verdict_on(simulation: Simulation) -> Verdict:
    """Return what one frame of this rig and camera can show of a plate at a known place, whatever the method.

    Raises:
        ConfigError: The rig can't be, or the camera gets no light.
    """
    # The event pixel is no part of the question: one answer for all of its settings.
    found = _identified(replace(simulation.setup, pixel=EventPixel()))
    reason, _, meaning = found.verdict.partition(": ")
    figures = (
        f"On handwriting, the best linear picture from one frame reaches {found.at_camera.psnr_db:.1f} dB; "
        f"a mean character {found.mean_db:.1f} dB, an all-black picture {found.zero_db:.1f} dB."
    )
    return Verdict(f"From one frame, {meaning}", f"{reason}.", figures)
