"""`evnlos cite`: BibTeX for what was used."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class CiteCommand:
    """Print BibTeX for exactly what a settings file, a dataset or a run uses; for everything without one."""

    used: Annotated[Path | None, tyro.conf.Positional] = None
    """Settings file, dataset's folder or run's folder."""
    json: bool = False
    """Print one JSON object: BibTeX by what it is for."""

    def run(self) -> None:
        """Print the entries, each under what it is for."""
        from evnlos.cite import entries_for

        entries = entries_for(self.used)
        if self.json:
            print(json.dumps(entries))
            return
        for name, text in entries.items():
            print(f"% {name}\n{text}\n")
