"""`evnlos report`: runs in, one HTML page out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evnlos.cli.console import Folders, result


@dataclass(frozen=True)
class ReportCommand:
    """Score runs on the same captures and write one self-contained HTML page, with a CSV beside it."""

    runs: Folders
    """Folders of the runs."""
    data: Path
    """Folder of the dataset to score on."""
    split: str = "test"
    """Split to score."""
    setup: str | None = None
    """The setup: a name, a settings file, or the folder that `calibrate` wrote, as `identify` takes it: it is
    drawn, and what it can show stands beside the results. The setup of a simulated dataset is known."""
    out: Path = Path("report.html")
    """The page."""
    json: bool = False
    """Print one JSON object: mean scores of each run and baseline."""

    def run(self) -> None:
        """Evaluate the runs and write the page."""
        from evnlos.evaluation.identify import identify
        from evnlos.report import gather, to_text, write_report
        from evnlos.report.tables import baselines_of
        from evnlos.setups import named_setup

        dataset, results = gather(list(self.runs), self.data, self.split)
        setup = None if self.setup is None else named_setup(self.setup)
        limits = None if setup is None else identify(setup.setup, name=setup.name)
        if setup is None and dataset.origin == "simulation":
            setup = named_setup(self.data / "dataset.yaml")
        path = write_report(self.out, dataset, results, [], self.split, setup, limits)
        about: dict[str, Any] = {"report": str(path), "csv": str(path.with_suffix(".csv"))}
        about["runs"] = {r.name: r.evaluation.scores.mean() for r in results}
        about["baselines"] = {name: scores.mean() for name, scores in baselines_of(results).items()}
        result(self.json, about, f"{to_text(results)}\nreport: {path}")
