"""`evnlos reconstruct`: capture and weights in, pictures out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from evnlos.cli.notes import say


@dataclass(frozen=True)
class ReconstructCommand:
    """Reconstruct all positions of a capture: pictures, a film strip and an animation."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder; its target may be unknown."""
    weights: Path | None = None
    """Weights file, run's folder, or name of published weights (`evnlos weights` lists them); none takes the
    published ones for frames of the setup with the nearest distance, of whole passes if the motion is known or
    found (--track)."""
    out: Path = Path("reconstruction")
    """Folder for the pictures; new or empty."""
    pattern: Path | None = None
    """Fixed pattern to take from the frames: the file that `calibrate` wrote, or its folder."""
    setup: Path | None = None
    """The calibrated setup: the folder that `calibrate` wrote, or the settings file in it. Its fixed pattern is
    taken from the frames, the pictures are moved to where its wall agrees with the frames, and it is printed
    how much of the frames they explain. No name such as main-near: that needs the light and the camera of this
    very setup. Without it, published weights explain the frames by the setup that they were trained for."""
    track: bool = False
    """Find the motion in the recording, as `evnlos track` does, also where capture.yaml states it; needs
    --setup, and takes about a minute."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Reconstruct and print where the pictures are."""
        from evnlos.dataset import load_pattern
        from evnlos.report import reconstruct_capture
        from evnlos.setups import calibrated_folder, load_setup

        folder = calibrated_folder(self.setup) if self.setup else None
        source = self.pattern or folder
        pattern = load_pattern(source) if source else None
        setup = load_setup(folder) if folder else None
        found = reconstruct_capture(
            self.capture, self.weights, self.out, pattern=pattern, setup=setup, track=self.track
        )
        for warning in found.get("warnings", []):
            say(f"warning: {warning}")
        if self.json:
            print(json.dumps(found | {"out": str(self.out)}))
            return
        print(f"{self.out}: {found['positions']} positions of {found['capture']} by {found['weights']}")
        if not found.get("moved_by_the_rig", True):
            print(
                f"the light is {found['light']:.2f} x that of the setup: its gain is not this capture's, the "
                "pictures stay as the network draws them; calibrate at this exposure, on known targets"
            )
        print(_said(found["confidence"]) if "confidence" in found else found["no_confidence"])
        if "scores" in found:
            print("  ".join(f"{name} {value}" for name, value in found["scores"].items() if value is not None))


def _said(confidence: dict[str, Any]) -> str:
    """Return what there is to say of the pictures' worth, in one line."""
    words = [confidence["verdict"]]
    if "explained" not in confidence:
        words.append("not checked against the frames: give the calibrated --setup")
    elif confidence["measured"]:
        share = 100 * confidence["explained"]
        words.append(f"of what the average object leaves unexplained in the frames they explain {share:.0f} %")
    return "; ".join(words)
