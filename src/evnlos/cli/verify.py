"""`evnlos verify`: a dataset in, the list of its faulty shards out, mended if asked."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from evnlos.cli.console import result
from evnlos.dataset import open_dataset
from evnlos.dataset.verify import find_faults, repair
from evnlos.errors import DataError


@dataclass(frozen=True)
class Command:
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
        found = tqdm(find_faults(dataset), total=total, unit=" objects", desc=self.dataset.name)
        faults = [fault for fault in found if fault is not None]
        about = {"dataset": str(self.dataset), "objects": total, "faults": {f.name: f.reason for f in faults}}
        if not self.json:
            for fault in faults:
                print(f"{dataset.shard(fault.name)}: {fault.reason}")
        if not faults:
            result(self.json, about | {"repaired": 0}, f"{self.dataset}: {total} objects, all whole")
        elif not self.repair:
            if self.json:
                print(json.dumps(about | {"repaired": 0}))
            raise DataError(
                f"{self.dataset}: {len(faults)} of {total} shards are faulty; --repair makes them again"
            )
        else:
            made = repair(dataset, faults, self.workers)
            count = sum(1 for _ in tqdm(made, total=len(faults), unit=" objects", desc="repair"))
            text = f"{self.dataset}: {count} of {len(faults)} faulty shards made again"
            result(self.json, about | {"repaired": count}, text)
