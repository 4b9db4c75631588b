"""Which networks look at a pass: the user's own, or those that come with the package and know its rig."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

from evnlos.app.recorded import Recorded
from evnlos.dataset import STANDARD_MODALITIES, Sampling, as_modality
from evnlos.evaluation.consistency import FrameOperator
from evnlos.model import Weights, load_weights, published, published_for, published_rig
from evnlos.setups import load_setup

_PAGE = "page-{}-pass"  # trained on the simulation `page`
_TITLES = {"frame": "network, frames", "event": "network, events", "fusion": "network, both"}


@dataclass(frozen=True)
class Networks:
    """The networks of a page.

    Args:
        own: The user's, by name; empty: those of the package.
    """

    own: Mapping[str, Weights] = field(default_factory=dict)

    def of(self, recorded: Recorded) -> Mapping[str, Weights]:
        """Return the networks for a pass, by the name to show.

        Those of the package see whole passes, so they need the motion; of a simulated pass they are the page's,
        of a capture those of the published rig whose distance is nearest.
        """
        if self.own:
            return self.own
        if recorded.motion is None:
            return {}
        is_simulated = recorded.simulation is not None
        found = {}
        for modality in STANDARD_MODALITIES:
            name = _PAGE.format(modality)
            if not is_simulated:
                name = published_for(recorded.distance_m, modality, is_motion_known=True)
            if name in published() and (recorded.frames is not None or not as_modality(modality).needs_frames):
                found[_TITLES[modality]] = _loaded(name)
        return found

    def wall_of(self, recorded: Recorded) -> Callable[[Sampling], FrameOperator] | None:
        """Return the wall that has to turn the pictures into the frames: the pass's own, or the networks'.

        None where there are no frames, or where the networks are the user's and so is the recording.
        """
        rig = None if recorded.simulation is None else recorded.simulation.setup
        if rig is None and not self.own and recorded.motion is not None:
            known = published_rig(published_for(recorded.distance_m, "frame", is_motion_known=True))
            rig = load_setup(known) if known else None
        return None if rig is None or recorded.frames is None else cache(partial(FrameOperator, rig))


@cache
def _loaded(name: str) -> Weights:
    return load_weights(name)


def own_networks(paths: Iterable[Path]) -> Networks:
    """Return the user's networks by a short name each: that of the run's folder or of the file.

    Raises:
        DataError: One of them is missing or is no weights file.
    """
    found: dict[str, Weights] = {}
    for path in paths:
        name = path.resolve().name if path.is_dir() or path.stem != "weights" else path.resolve().parent.name
        name = name.removesuffix(".safetensors")
        found[name if name not in found else f"{name} ({len(found) + 1})"] = load_weights(path)
    return Networks(found)
