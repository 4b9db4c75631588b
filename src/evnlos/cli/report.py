"""`evnlos report`: runs in, one HTML page out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from evnlos.cli.console import Folders


@dataclass(frozen=True)
class Command:
    """Score runs on the same captures and write one self-contained HTML page, with a CSV beside it."""

    runs: Folders
    """Folders of the runs."""
    data: Path
    """Folder of the dataset to score on."""
    split: str = "test"
    """Split to score."""
    out: Path = Path("report.html")
    """The page."""

    def run(self) -> None:
        """Evaluate the runs and write the page."""
        from evnlos.report import gather, to_text, write_report

        dataset, results = gather(list(self.runs), self.data, self.split)
        path = write_report(self.out, dataset, results, [], self.split)
        print(to_text(results))
        print(f"report: {path}")
