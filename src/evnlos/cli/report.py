"""`evnlos report`: runs in, one HTML page out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evnlos.cli.console import Folders, result


@dataclass(frozen=True)
class Command:
    """Score runs on the same captures and write one self-contained HTML page, with a CSV beside it."""

    runs: Folders
    """Folders of the runs."""
    data: Path
    """Folder of the dataset to score on."""
    split: str = "test"
    """Split to score."""
    rig: str | None = None
    """Name of the rig, its file, or the folder that `calibrate` wrote, as `identify` takes it: it is drawn, and
    what it can show stands beside the results. The rig of a simulated dataset is known."""
    out: Path = Path("report.html")
    """The page."""
    json: bool = False
    """Print one JSON object: mean scores of each run and baseline."""

    def run(self) -> None:
        """Evaluate the runs and write the page."""
        from evnlos.evaluation.identify import identify
        from evnlos.evaluation.identify_source import described_rig
        from evnlos.report import gather, to_text, write_report
        from evnlos.report.tables import baselines_of

        dataset, results = gather(list(self.runs), self.data, self.split)
        rig = None if self.rig is None else described_rig(self.rig)
        limits = None if rig is None else identify(rig.transport, rig.camera, name=rig.name)
        if rig is None and dataset.origin == "simulation":
            rig = described_rig(self.data / "dataset.yaml")
        path = write_report(self.out, dataset, results, [], self.split, rig, limits)
        about: dict[str, Any] = {"report": str(path), "csv": str(path.with_suffix(".csv"))}
        about["runs"] = {r.name: r.evaluation.scores.mean() for r in results}
        about["baselines"] = {name: scores.mean() for name, scores in baselines_of(results).items()}
        result(self.json, about, f"{to_text(results)}\nreport: {path}")
