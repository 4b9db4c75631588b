"""Is every shard whole, and the one that its settings say?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from evnlos.claim import claim
from evnlos.config import config_hash, from_dict
from evnlos.dataset.shard import read_shard
from evnlos.dataset.simulate import Simulation, simulate
from evnlos.dataset.store import Dataset
from evnlos.errors import DataError


@dataclass(frozen=True)
class Fault:
    """What is wrong with one object's shard."""

    name: str
    """The object."""
    reason: str
    """What was found."""


def find_faults(dataset: Dataset) -> Iterator[Fault | None]:
    """Read every shard of a dataset, checksums and all; yield a fault, or None, for each object.

    Found are: shards that are missing, cut short or changed (fletcher32), of another object, or made with
    other settings.
    """
    for name in dataset.objects():
        path = dataset.shard(name)
        if not path.is_file():
            yield Fault(name, "missing")
            continue
        try:
            _, attributes = read_shard(path)
        except DataError as error:
            yield Fault(name, str(error).split(" is damaged (")[-1].split("); ")[0])
            continue
        if attributes.get("object") != name:
            yield Fault(name, f"it holds the object {attributes.get('object')!r}")
        elif attributes.get("config_hash") != dataset.config_hash:
            yield Fault(name, "it was made with other settings")
        else:
            yield None


def repair(dataset: Dataset, faults: list[Fault], workers: int = 0) -> Iterator[str]:
    """Simulate the faulty objects of a dataset again, yielding each name; the same bytes as the first time.

    Raises:
        DataError: The dataset holds captures (import them again), or its settings were changed by hand.
    """
    if dataset.origin != "simulation":
        raise DataError(
            f"{dataset.folder} holds captures; delete the {len(faults)} faulty shards and import again"
        )
    config = from_dict(Simulation, dataset.config, source=str(dataset.folder / "dataset.yaml"))
    if config_hash(config) != dataset.config_hash:
        raise DataError(
            f"{dataset.folder / 'dataset.yaml'} was changed: its settings no longer fit their hash "
            f"{dataset.config_hash}; restore it, or simulate into a new folder"
        )
    with claim(dataset.folder):
        for fault in faults:
            dataset.shard(fault.name).unlink(missing_ok=True)
    yield from simulate(config, dataset.folder, workers)
