"""`evnlos capture`: begin a capture folder, and check what was recorded into it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

_MARKS = {"good": "  good   ", "doubtful": "? look   ", "bad": "! BAD    "}


@dataclass(frozen=True)
class CaptureCommand:
    """Begin a capture folder with a commented capture.yaml (init), or say what a recording is worth (check)."""

    action: Annotated[Literal["init", "check"], tyro.conf.Positional]
    """init writes capture.yaml; check reads the recording and tells what is wrong and how to mend it."""
    folder: Annotated[Path, tyro.conf.Positional]
    """The folder of the shot."""
    width: int = 1280
    """init: columns of the event camera's sensor, pixels."""
    height: int = 800
    """init: rows of the event camera's sensor, pixels; the defaults are those of the CeleX-V."""
    camera: str = "CeleX-V"
    """init: maker and model."""
    json: bool = False
    """check: print one JSON object."""

    def run(self) -> None:
        """Write the file, or print the findings; exit code 1 where one of them is bad."""
        if self.action == "init":
            from evnlos.dataset.capture_template import begin_capture

            path = begin_capture(self.folder, self.width, self.height, self.camera)
            print(f"{path}: edit it, put the recordings beside it, then: evnlos capture check {self.folder}")
            return
        from evnlos.dataset import read_capture
        from evnlos.dataset.capture_check import check_capture

        capture = read_capture(self.folder)
        found = check_capture(capture)
        if self.json:
            print(json.dumps({"capture": capture.name, "findings": [asdict(one) for one in found]}))
        else:
            print("\n".join(capture.notes))
            for one in found:
                print(f"{_MARKS[one.level]}{one.what}: {one.found}" + (f"; {one.cure}" if one.cure else ""))
        if any(one.level == "bad" for one in found):
            raise SystemExit(1)
