"""`evnlos reconstruct`: capture and weights in, pictures out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Command:
    """Reconstruct all positions of a capture: pictures, a film strip and an animation."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder; its target may be unknown."""
    weights: Path
    """Weights file, or a run's folder."""
    out: Path = Path("reconstruction")
    """Folder for the pictures; new or empty."""
    pattern: Path | None = None
    """Fixed pattern to take from the frames: the file that `calibrate` wrote, or its folder."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Reconstruct and print where the pictures are."""
        from evnlos.dataset import load_pattern
        from evnlos.report import reconstruct_capture

        pattern = load_pattern(self.pattern) if self.pattern else None
        found = reconstruct_capture(self.capture, self.weights, self.out, pattern=pattern)
        if self.json:
            print(json.dumps(found | {"out": str(self.out)}))
            return
        print(f"{self.out}: {found['positions']} positions of {found['capture']} ({found['paradigm']})")
        if "scores" in found:
            print("  ".join(f"{name} {value}" for name, value in found["scores"].items() if value is not None))
