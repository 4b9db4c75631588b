"""`evnlos import`: capture folders in, dataset of shards out."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from evnlos.cli.console import Folders, result
from evnlos.dataset import Capture, Sampling, check_picture, import_captures, load_pattern
from evnlos.files import write_atomically
from evnlos.progress import ProgressBars


@dataclass(frozen=True)
class ImportCommand:
    """Turn captures (folders with capture.yaml, events and frames) into a dataset to train and test on."""

    captures: Folders
    """Capture folders."""
    out: Path
    """Folder of the dataset."""
    test: tuple[str, ...] = ()
    """Captures or characters that are held out for testing, e.g. G K 4 9."""
    validation: tuple[str, ...] = ()
    """Captures or characters that are held out for validation."""
    pattern: Path | None = None
    """Fixed pattern to take from the frames: the file that `calibrate` wrote, or its folder."""
    check_pictures: bool = True
    """Draw one picture a capture (frame, events, both, curves over time) into the folder checks of the
    dataset."""
    json: bool = False
    """Print one JSON object."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation."""

    def run(self) -> None:
        """Import, with a progress bar over the captures."""
        with ProgressBars() as progress:
            dataset = import_captures(
                self.captures,
                self.out,
                self.sampling,
                test=self.test,
                validation=self.validation,
                pattern=load_pattern(self.pattern) if self.pattern else None,
                look=self._look,
                progress=progress,
            )
        counts = ", ".join(f"{len(names)} {split}" for split, names in dataset.split.items())
        text = f"{self.out}: {len(dataset.objects())} captures ({counts})"
        result(self.json, {"out": str(self.out), "split": dataset.split}, text)
        if self.check_pictures and not self.json:
            print(f"check pictures: {self.out / 'checks'}")

    def _look(self, capture: Capture) -> None:
        """Tell what was done to a capture, and draw it."""
        tqdm.write(f"{capture.name}: {'; '.join(capture.notes)}", file=sys.stderr)
        if self.check_pictures:
            folder = self.out / "checks"
            folder.mkdir(exist_ok=True)
            drawn = io.BytesIO()
            check_picture(capture).save(drawn, "PNG")
            write_atomically(folder / f"{capture.name}.png", drawn.getvalue())
