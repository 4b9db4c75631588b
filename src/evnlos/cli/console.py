"""What the commands share: flat settings, progress bars, notes on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tqdm import tqdm

from evnlos.dataset import open_dataset
from evnlos.training import Training, train

T = TypeVar("T")
Folders = Annotated[tuple[Path, ...], tyro.conf.Positional]
"""One or more folders, given without a flag."""
Flat = Annotated[T, tyro.conf.arg(name="")]
"""Settings whose flags carry no prefix."""


def say(text: str) -> None:
    """Print a note on stderr, so that stdout stays for results."""
    print(text, file=sys.stderr)


def progress(steps: Iterable[T], total: int, unit: str, out: Path) -> Iterator[T]:
    """Yield the steps under a progress bar that counts the shards already in `out`."""
    done = 0
    if (out / "dataset.yaml").is_file():
        done = total - len(open_dataset(out).missing())
    with tqdm(steps, total=total, initial=done, unit=f" {unit}", desc=out.name) as bar:
        yield from bar


def train_with_bar(data: Path, settings: Training, out: Path, weights: Path | None) -> None:
    """Train with a progress bar over the epochs, and warn of a network that ignores its input."""
    dataset = open_dataset(data)
    record: dict[str, Any] = {}
    with tqdm(
        train(dataset, settings, out, weights), total=settings.epochs, desc=out.name, unit="epoch"
    ) as bar:
        for record in bar:
            bar.set_postfix({key: record[key] for key in ("loss", "psnr_db") if key in record})
    if record.get("collapsed"):
        say(
            f"warning: the network answers the same to every input ({record['psnr_db']} dB; all-black has "
            f"{record['zero_db']} dB): it has collapsed; use --loss balanced, or train for more epochs"
        )
    print(f"{out}: {record['epoch']} epochs, loss {record['loss']}, weights in {out / 'weights.safetensors'}")
