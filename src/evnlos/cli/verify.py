"""`evnlos verify`: a dataset in, the list of its faulty shards out, mended if asked."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from evnlos.cli.console import result
from evnlos.dataset import open_dataset
from evnlos.dataset.store import PAGE
from evnlos.dataset.verify import find_faults, repair
from evnlos.errors import DataError
from evnlos.progress import ProgressBars


@dataclass(frozen=True)
class VerifyCommand:
    """Check every shard of a dataset against its checksums, its name and its settings."""

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    repair: bool = False
    """Simulate faulty and missing objects again."""
    workers: int = 0
    """Processes for the repair; 0 = one for each core."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Check, report, and repair where asked."""
        dataset = open_dataset(self.dataset)
        total = len(dataset.objects())
        with ProgressBars() as progress:
            faults = find_faults(dataset, progress)
        about = {"dataset": str(self.dataset), "objects": total, "faults": {f.name: f.reason for f in faults}}
        if not self.json:
            for fault in faults:
                place = dataset.folder / PAGE if fault.name == PAGE else dataset.shard(fault.name)
                print(f"{place}: {fault.reason}")
        if not faults:
            result(self.json, about | {"repaired": 0}, f"{self.dataset}: {total} objects, all whole")
        elif not self.repair:
            if self.json:
                print(json.dumps(about | {"repaired": 0}))
            shards = sum(fault.name != PAGE for fault in faults)
            page = f" and {PAGE} is not as it was written" if shards < len(faults) else ""
            raise DataError(
                f"{self.dataset}: {shards} of {total} shards are faulty{page}; --repair makes shards again"
            )
        else:
            with ProgressBars() as progress:
                repair(dataset, faults, self.workers, progress)
            text = f"{self.dataset}: {len(faults)} of {len(faults)} faulty shards made again"
            result(self.json, about | {"repaired": len(faults)}, text)
