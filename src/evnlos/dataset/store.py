"""A dataset on disk: a folder with `dataset.yaml` and one shard an object; a shard that exists is done."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from evnlos.config import LONG_YAML, config_hash, differing_keys, from_dict, read_yaml, save_yaml, to_dict
from evnlos.dataset.sampling import Sampling
from evnlos.dataset.shard import SUFFIX
from evnlos.errors import DataError
from evnlos.files import claim, is_empty
from evnlos.version import __version__

SPLITS = ("train", "validation", "test")
PAGE = "dataset.yaml"
"""Name of the file that describes a dataset, in its folder."""
_DIGEST = "digest"


@dataclass(frozen=True)
class Dataset:
    """What `dataset.yaml` holds: where the samples come from, how they were made, and who is held out.

    Args:
        folder: Where the dataset lies.
        origin: "simulation" or "captures".
        sampling: Resolution and representation of the samples.
        split: Split name -> names of its objects; an object is in exactly one split.
        config: The settings that made the samples (resolved, complete).
        config_hash: Hash of these settings.
        optics: What diffraction and the wall do to the picture, by name; empty where nobody knows.
        version: Version of the package that made it.
    """

    folder: Path
    origin: str
    sampling: Sampling
    split: dict[str, list[str]]
    config: dict[str, Any] = field(default_factory=dict)
    config_hash: str = ""
    optics: dict[str, float] = field(default_factory=dict)
    version: str = __version__

    def shard(self, name: str) -> Path:
        """Return the path of an object's shard."""
        return self.folder / f"{name}{SUFFIX}"

    def objects(self, split: str = "all") -> list[str]:
        """Return the names of the objects of a split ("train", "validation", "test" or "all").

        Raises:
            DataError: There is no such split, or it is empty.
        """
        if split == "all":
            return [name for names in self.split.values() for name in names]
        if split not in self.split or not self.split[split]:
            there = ", ".join(f"{key} ({len(names)})" for key, names in self.split.items() if names)
            raise DataError(f"{self.folder} has no objects in split {split!r}; it has {there or 'none'}")
        return self.split[split]

    def missing(self) -> list[str]:
        """Return the objects whose shard is not there yet."""
        return [name for name in self.objects() if not self.shard(name).is_file()]


_KEYS = {item.name for item in fields(Dataset)} - {"folder"} | {_DIGEST}


def check_dataset(dataset: Dataset) -> bool:
    """Return whether the folder holds the dataset already, begun with the same settings; write nothing.

    Raises:
        DataError: The folder holds a dataset of other settings (the differing keys are named), or other files.
    """
    path = dataset.folder / PAGE
    if path.is_file():
        theirs = read_yaml(path, LONG_YAML)
        differing = differing_keys(_comparable(_content(dataset)), _comparable(theirs))
        if differing:
            shown = "; ".join(differing[:6]) + (
                f"; and {len(differing) - 6} more" if len(differing) > 6 else ""
            )
            raise DataError(f"{dataset.folder} holds a dataset of other settings ({shown}); give another --out")
        return True
    if not is_empty(dataset.folder):
        raise DataError(f"{dataset.folder} is not empty and holds no {PAGE}; give a new folder")
    return False


def create_dataset(dataset: Dataset) -> Dataset:
    """Create the folder and `dataset.yaml`, or take up a folder that was begun with the same settings.

    Raises:
        DataError: As `check_dataset`.
    """
    if not check_dataset(dataset):
        dataset.folder.mkdir(parents=True, exist_ok=True)
        content = _content(dataset)
        save_yaml(content | {_DIGEST: config_hash(content)}, dataset.folder / PAGE)
    return dataset


@contextmanager
def claim_dataset(dataset: Dataset, part: str = "") -> Iterator[None]:
    """Hold a dataset's folder for this process, and create the dataset there or take it up.

    Args:
        dataset: What is to be there.
        part: Name of the share of the work, as in `claim`.

    Raises:
        DataError: As `check_dataset`, and then the folder stays as it is; or another process holds it.
    """
    with claim(dataset.folder, part, check=lambda: check_dataset(dataset)):
        create_dataset(dataset)
        yield


def open_dataset(folder: str | Path) -> Dataset:
    """Open a dataset's folder.

    Args:
        folder: The folder that holds `dataset.yaml`.

    Raises:
        DataError: It is not a dataset, or its splits overlap.
    """
    folder = Path(folder)
    path = folder / PAGE
    if not path.is_file():
        raise DataError(
            f"{folder} is no dataset: {path.name} is missing; make one with `evnlos simulate` or `import`"
        )
    values = read_yaml(path, LONG_YAML)
    unknown = values.keys() - _KEYS
    if unknown:
        raise DataError(
            f"{path} holds an unknown entry {min(map(str, unknown))[:40]!r}; make the dataset again"
        )
    try:
        split = {str(key): list(names) for key, names in values["split"].items()}
        sampling = from_dict(Sampling, values["sampling"], source=str(path))
        origin, version = values["origin"], values["version"]
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} lacks or garbles {error}; make the dataset again") from None
    names = [name for group in split.values() for name in group]
    if not all(isinstance(name, str) for name in names):
        raise DataError(f"{path}: an object's name is no text; make the dataset again")
    if len(names) != len(set(names)):
        raise DataError(f"{path}: an object stands in two splits; each belongs to exactly one")
    if not all(_is_plain(name) for name in names):
        raise DataError(f"{path}: an object's name leads out of the folder; names are plain file names")
    settings, key, optics = values.get("config", {}), values.get("config_hash", ""), values.get("optics", {})
    plain = all(isinstance(text, str) for text in (origin, version, key))
    if not (plain and isinstance(settings, dict) and isinstance(optics, dict)):
        raise DataError(f"{path} garbles origin, version or settings; make the dataset again")
    return Dataset(folder, origin, sampling, split, settings, key, optics, version)


def is_page_changed(dataset: Dataset) -> bool:
    """Return whether a dataset's `dataset.yaml` is not as it was written: damaged, or edited by hand.

    Files of earlier versions have no digest; then the settings of a simulation are compared with their hash.

    Args:
        dataset: An open dataset.
    """
    values = read_yaml(dataset.folder / PAGE, LONG_YAML)
    stated = values.pop(_DIGEST, None)
    if stated is not None:
        return stated != config_hash(values)
    return dataset.origin == "simulation" and config_hash(dataset.config) != dataset.config_hash


def _is_plain(name: str) -> bool:
    """Return whether a name can only be a file of the folder itself: no path, no drive, nothing hidden."""
    return name.isprintable() and not (
        set(name[:200]) & set("/\\") or name[:1] in ("", ".") or name[1:2] == ":"
    )


def _content(dataset: Dataset) -> dict[str, Any]:
    values = to_dict(dataset)
    del values["folder"]
    return values


def _comparable(content: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value for key, value in content.items() if key not in ("version", "config_hash", "optics", _DIGEST)
    }
