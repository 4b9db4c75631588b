"""What the commands share: flat settings, progress bars, results as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

T = TypeVar("T")
Folders = Annotated[tuple[Path, ...], tyro.conf.Positional]
"""One or more folders, given without a flag."""
Flat = Annotated[T, tyro.conf.arg(name="")]
"""Settings whose flags carry no prefix."""


def result(as_json: bool, values: Mapping[str, Any], text: str) -> None:
    """Print a command's result on stdout: its values as one JSON object, or a line for people."""
    print(json.dumps(values, default=str) if as_json else text)


def progress(steps: Iterable[T], total: int, unit: str, out: Path) -> Iterator[T]:
    """Yield the steps under a progress bar that counts the shards already in `out`."""
    from tqdm import tqdm

    from evnlos.dataset import open_dataset

    done = 0
    if (out / "dataset.yaml").is_file():
        done = total - len(open_dataset(out).missing())
    with tqdm(steps, total=total, initial=done, unit=f" {unit}", desc=out.name) as bar:
        yield from bar
