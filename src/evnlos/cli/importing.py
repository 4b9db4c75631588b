"""`evnlos import`: capture folders in, dataset of shards out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.cli.console import Folders, progress
from evnlos.dataset import Sampling, import_captures, open_dataset


@dataclass(frozen=True)
class Command:
    """Turn captures (folders with capture.yaml, events and frames) into a dataset to train and test on."""

    captures: Folders
    """Capture folders."""
    out: Path
    """Folder of the dataset."""
    test: tuple[str, ...] = ()
    """Captures or characters that are held out for testing, e.g. G K 4 9."""
    validation: tuple[str, ...] = ()
    """Captures or characters that are held out for validation."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation."""

    def run(self) -> None:
        """Import, with a progress bar over the captures."""
        imported = import_captures(
            self.captures, self.out, self.sampling, test=self.test, validation=self.validation
        )
        for _ in progress(imported, len(self.captures), "captures", self.out):
            pass
        dataset = open_dataset(self.out)
        counts = ", ".join(f"{len(names)} {split}" for split, names in dataset.split.items())
        print(f"{self.out}: {len(dataset.objects())} captures ({counts})")
