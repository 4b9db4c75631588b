"""Datasets on disk: a folder of shards, each one HDF5 file for one object.

- One HDF5 file per object: written whole or not at all, checksummed, read in one go or by position.
- A dataset on disk: a folder with `dataset.yaml` and one shard per object; a shard that exists is done.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from evnlos.config import LONG_YAML, config_hash, differing_keys, from_dict, read_yaml, save_yaml, to_dict
from evnlos.data.sampling import Samples, Sampling
from evnlos.errors import DataError, UnknownNameError
from evnlos.events.files.container_write import Storage
from evnlos.files import LOCK, directory_lock, is_empty, new_file
from evnlos.machine import undisturbed
from evnlos.registry import __version__
from evnlos.types import Events
from evnlos.untrusted import open_hdf5, stored

SUFFIX = ".h5"
_MAPS = ("frame", "surface", "truth")
_AXES = {"frame": 3, "surface": 4, "truth": 3, "time_s": 1, "position_m": 2, "event_count": 1}
_DEFLATE = 1032  # no compressed byte holds more
_MOST_BYTES = 4 << 30


def write_shard(
    path: str | Path,
    samples: Samples | Iterable[Samples],
    attributes: dict,
    events: Events | None = None,
    count: int | None = None,
) -> None:
    """Write the samples of one object as an HDF5 shard: temporary file, fsync, rename; fletcher32 throughout.

    Maps are stored as float16 (11 bits of mantissa; frames have 8 to 12), one chunk a position, so that a
    loader can fetch a single position. The same samples in the same blocks give the same bytes.

    Args:
        path: The shard's final name.
        samples: What to store; or its blocks in the order of time, of which one is held at a time.
        attributes: Provenance of the shard: strings, numbers.
        events: The whole recording, stored as `events/{x, y, t, p}` where given.
        count: How many time steps the blocks have together; needed for blocks alone.
    """
    if isinstance(samples, Samples):
        samples, count = (samples,), len(samples)
    with new_file(path) as temporary, closing(Storage(temporary)) as storage:
        with undisturbed():
            file = h5py.File(storage, "w", libver=("v110", "v110"), track_order=True)
            file.attrs.update(attributes)
            if events is not None:
                file.create_group("events").attrs.update({"width": events.width, "height": events.height})
        try:
            for part in _parts(samples, events, count):  # made between the writing, where Ctrl-C is heard
                with undisturbed():
                    for row in part:
                        _put(file, *row)
                if storage.failure is not None:
                    break
        finally:
            with undisturbed():
                file.close()
                del file  # while no signal can strike in what frees it
        if storage.failure is not None:
            raise storage.failure


def _parts(samples: Iterable[Samples], events: Events | None, count: int | None) -> Iterator[list[tuple]]:
    """Yield what each block adds to the datasets, and the events: the arguments of `_put`."""
    at = 0
    for block in samples:
        found = {name: getattr(block, name) for name in _AXES if getattr(block, name) is not None}
        maps = {name: found.pop(name).astype(np.float16) for name in _MAPS if name in found}
        rows = [(name, values, (1, *values.shape[1:]), at, count) for name, values in maps.items()]
        yield rows + [(name, values, True, at, count) for name, values in found.items()]
        at += len(block)
    if events is not None:
        columns = {"x": events.x, "y": events.y, "t": events.t_us, "p": events.p.astype(np.uint8)}
        yield [(f"events/{name}", column, (65_536,), 0, len(column)) for name, column in columns.items()]


def _put(file: h5py.File, name: str, values: np.ndarray, chunks: Any, at: int, count: int) -> None:
    """Store rows of a dataset from row `at` on, of `count` rows in all."""
    if not values.size:
        file.create_dataset(name, data=values)
        return
    if name not in file:
        chunks = (min(chunks[0], count), *chunks[1:]) if isinstance(chunks, tuple) else chunks
        how = {"fletcher32": True, "compression": "gzip", "compression_opts": 1, "chunks": chunks}
        file.create_dataset(name, (count, *values.shape[1:]), values.dtype, **how)
    dataset = cast(h5py.Dataset, file[name])
    dataset[at : at + len(values)] = values
    # Else chunks go to the file when the object is collected, in an order that a debugger would change.
    dataset.flush()


def read_shard(path: str | Path, steps: slice | NDArray[np.int64] | None = None) -> tuple[Samples, dict]:
    """Read a shard's samples and its attributes; every checksum of what is read is verified on the way.

    A shard may be a stranger's: no other file is read, and memory is taken only for what this one can hold.

    Args:
        path: The shard.
        steps: Time steps to read, a slice or ascending indices; None is all. Others are not even decompressed.

    Raises:
        DataError: The file is missing, is not a shard, or a checksum does not fit.
    """
    with _damage(path), open_hdf5(path) as file:
        found = {name: _array(file, name, axes, steps) for name, axes in _AXES.items()}
        attributes = {key: _plain(value) for key, value in file.attrs.items()}
    frame, surface, time_s, count = (found[name] for name in ("frame", "surface", "time_s", "event_count"))
    if frame is None or surface is None or time_s is None or count is None:
        raise DataError(f"{path} is not a shard: it lacks a map or times; delete it and run the command again")
    truth, position_m = found["truth"], found["position_m"]
    maps = (len(time_s), *frame.shape[1:])
    is_whole = frame.shape == maps == (*surface.shape[:1], *surface.shape[2:]) and count.shape == time_s.shape
    is_whole &= (truth is None or truth.shape == maps) and surface.shape[1] in (2, 4)
    if not is_whole or (position_m is not None and position_m.shape != (maps[0], 2)):
        what = "its maps are of different numbers or sizes"
        raise DataError(f"{path} contradicts itself: {what}; make the dataset again")
    truth = None if truth is None else truth.astype(np.float32)
    maps = frame.astype(np.float32), surface.astype(np.float32), truth
    return Samples(*maps, time_s, position_m, count), attributes


class ShardIndex(NamedTuple):
    """What a shard holds, without its maps."""

    length: int
    """Time steps."""
    shape: tuple[int, int]
    """Height and width of the maps, pixels."""
    has_truth: bool
    """Whether the true images are known."""
    position_m: NDArray[np.float64] | None
    """Target's centre (x, y), [N, 2], metres; None where the motion is unknown."""


def read_shard_index(path: str | Path) -> ShardIndex:
    """Read how much a shard holds and where its target was; the maps are left on disk.

    Args:
        path: The shard.

    Raises:
        DataError: The file is missing or is not a shard.
    """
    with _damage(path), open_hdf5(path) as file:
        position_m, frame, truth = _array(file, "position_m", 2), stored(file, "frame"), stored(file, "truth")
        if not isinstance(frame, h5py.Dataset) or frame.ndim != 3:
            raise ValueError("it has no frames")
        return ShardIndex(len(frame), frame.shape[1:], truth is not None, position_m)


@contextmanager
def _damage(path: str | Path) -> Iterator[None]:
    """Turn what HDF5 says of a file that is missing or damaged into one line, a `DataError`."""
    try:
        yield
    except FileNotFoundError:
        raise DataError(f"{path} does not exist; run the command that made the dataset again") from None
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
        found = f"{path} is damaged ({_one_line(error)})"
        raise DataError(f"{found}; delete it and run the command again") from None


def _array(
    file: h5py.File, name: str, axes: int, steps: slice | NDArray[np.int64] | None = None
) -> NDArray | None:
    """Return a dataset's values at some time steps, None where there is none; `ValueError` of odd ones."""
    node = stored(file, name)
    if node is None:
        return None
    if not isinstance(node, h5py.Dataset):
        raise ValueError(f"{name} is no dataset")
    if node.dtype.kind not in "fiu" or node.ndim != axes:
        raise ValueError(f"{name} is {node.dtype} with {node.ndim} axes")
    size, held = node.size * node.dtype.itemsize, node.id.get_storage_size()
    if size > min(_DEFLATE * held, _MOST_BYTES):
        raise ValueError(f"{name} claims {size} bytes and stores {held}")
    return node[()] if steps is None else node[steps]


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


PAGE, CHECKS = "dataset.yaml", "checks"
"""Names, in a dataset's folder, of the file that describes it and of the folder of pictures of its captures."""
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
        optics: What diffraction and the wall do to the image, by name; empty where nobody knows.
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


def check_dataset(dataset: Dataset, settings: type[Any] | None = None) -> bool:
    """Return whether the folder holds the dataset already, begun with the same settings; write nothing.

    Args:
        dataset: What is to be there.
        settings: Class of its settings, so that those of an older version are compared in today's words.

    Raises:
        DataError: The folder holds a dataset of other settings (the differing keys are named), or other files.
    """
    path = dataset.folder / PAGE
    if path.is_file():
        stored = read_yaml(path, LONG_YAML)
        if settings is not None and isinstance(stored.get("config"), dict):
            stored["config"] = to_dict(from_dict(settings, stored["config"], source=str(path)))
        if isinstance(stored.get("sampling"), dict):
            stored["sampling"] = to_dict(from_dict(Sampling, stored["sampling"], source=str(path)))
        differing = differing_keys(_comparable(_content(dataset)), _comparable(stored))
        if differing:
            more = [f"and {len(differing) - 6} more"] if len(differing) > 6 else []
            shown = "; ".join(differing[:6] + more)
            raise DataError(f"{dataset.folder} holds a dataset of other settings ({shown}); give another --out")
        return True
    if not is_empty(dataset.folder):
        raise DataError(f"{dataset.folder} is not empty and holds no {PAGE}; give a new folder")
    return False


def create_dataset(dataset: Dataset, settings: type[Any] | None = None) -> Dataset:
    """Create the folder and `dataset.yaml`, or take up a folder that was begun with the same settings.

    Args:
        dataset: What is to be there.
        settings: As of `check_dataset`.

    Returns:
        The dataset, with the hash that the folder was begun with, maybe by an older version.

    Raises:
        DataError: As `check_dataset`.
    """
    if check_dataset(dataset, settings):
        return replace(dataset, config_hash=open_dataset(dataset.folder).config_hash)
    content = _content(dataset)
    save_yaml(content | {_DIGEST: config_hash(content)}, dataset.folder / PAGE)
    return dataset


@contextmanager
def claim_dataset(dataset: Dataset, part: str = "", settings: type[Any] | None = None) -> Iterator[Dataset]:
    """Hold a dataset's folder, and create the dataset there or take it up; an error before any shard undoes it.

    Args:
        dataset: What is to be there.
        part: Name of the share of the work, as in `directory_lock`.
        settings: As of `check_dataset`.

    Yields:
        The dataset, as of `create_dataset`.

    Raises:
        DataError: As `check_dataset`, and then the folder stays as it is; or another process holds it.
    """
    page, checks = dataset.folder / PAGE, dataset.folder / CHECKS
    with directory_lock(dataset.folder, part, check=lambda: check_dataset(dataset, settings)):
        is_new = not (part or page.is_file())
        try:
            yield create_dataset(dataset, settings)
        except Exception:
            if is_new and not {*dataset.folder.glob("*")} - {dataset.folder / LOCK, page, checks}:
                page.unlink(missing_ok=True)
                shutil.rmtree(checks, ignore_errors=True)
            raise


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
        raise UnknownNameError(f"{folder} is no dataset: {PAGE} is missing; run `evnlos simulate` or `import`")
    values = read_yaml(path, LONG_YAML)
    unknown = values.keys() - _KEYS
    if unknown:
        entry = min(map(str, unknown))[:40]
        raise DataError(f"{path} holds an unknown entry {entry!r}; make the dataset again")
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
    return {k: v for k, v in content.items() if k not in ("version", "config_hash", "optics", _DIGEST)}
