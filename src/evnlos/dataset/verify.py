"""Is every shard whole, and the one that its settings say?"""

from __future__ import annotations

from dataclasses import dataclass

from evnlos.config import config_hash, from_dict
from evnlos.dataset.shard import read_shard
from evnlos.dataset.simulate import Simulation, simulate
from evnlos.dataset.store import PAGE, Dataset, claim_dataset, is_page_changed
from evnlos.errors import DataError
from evnlos.progress import Progress, Step, silent


@dataclass(frozen=True)
class Fault:
    """What is wrong with one object's shard."""

    name: str
    """The object."""
    reason: str
    """What was found."""


def find_faults(dataset: Dataset, progress: Progress = silent) -> list[Fault]:
    """Read every shard of a dataset, checksums and all, and return what is wrong.

    Found are: shards that are missing, cut short or changed (fletcher32), of another object, or made with
    other settings; and a `dataset.yaml` that is not as it was written.

    Args:
        dataset: The dataset on disk.
        progress: Called when the work begins and after each object, with its fault or None.
    """
    names, faults = dataset.objects(), []
    what = f"verify {dataset.folder.name}"
    progress(Step(what, 0, len(names), "objects"))
    for done, name in enumerate(names, start=1):
        fault = _fault(dataset, name)
        if fault is not None:
            faults.append(fault)
        progress(Step(what, done, len(names), "objects", fault))
    if is_page_changed(dataset):
        faults.append(Fault(PAGE, "it is not as it was written: damaged, or changed by hand"))
    return faults


def _fault(dataset: Dataset, name: str) -> Fault | None:
    path = dataset.shard(name)
    if not path.is_file():
        return Fault(name, "missing")
    try:
        _, attributes = read_shard(path)
    except DataError as error:
        return Fault(name, str(error).split(" is damaged (")[-1].split("); ")[0])
    if attributes.get("object") != name:
        return Fault(name, f"it holds the object {attributes.get('object')!r}")
    if attributes.get("config_hash") != dataset.config_hash:
        return Fault(name, "it was made with other settings")
    return None


def repair(dataset: Dataset, faults: list[Fault], workers: int = 0, progress: Progress = silent) -> Dataset:
    """Simulate the faulty objects of a dataset again; their shards are the same bytes as the first time.

    Args:
        dataset: The dataset on disk.
        faults: What `find_faults` returned.
        workers: Processes; 0 means one for each core.
        progress: As of `simulate`.

    Raises:
        DataError: The dataset holds captures (import them again), or its settings were changed by hand.
    """
    if dataset.origin != "simulation":
        raise DataError(
            f"{dataset.folder} holds captures; delete the {len(faults)} faulty shards and import again"
        )
    config = from_dict(Simulation, dataset.config, source=str(dataset.folder / PAGE))
    if config_hash(config) != dataset.config_hash or is_page_changed(dataset):
        raise DataError(
            f"{dataset.folder / PAGE} was changed: its settings no longer fit their hash "
            f"{dataset.config_hash}; restore it, or simulate into a new folder"
        )
    with claim_dataset(dataset):
        for fault in faults:
            dataset.shard(fault.name).unlink(missing_ok=True)
    return simulate(config, dataset.folder, workers, progress=progress)
