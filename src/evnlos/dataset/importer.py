"""Real recordings become the same kind of dataset as simulated ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from evnlos.config import config_hash, to_dict
from evnlos.dataset.capture import Capture, read_capture
from evnlos.dataset.capture_info import read_capture_info
from evnlos.dataset.fixed_pattern import FixedPattern
from evnlos.dataset.sampling import Samples, Sampling, make_samples
from evnlos.dataset.shard import write_shard
from evnlos.dataset.store import Dataset, claim_dataset
from evnlos.errors import DataError
from evnlos.progress import Progress, Step, silent


def capture_samples(capture: Capture, sampling: Sampling, pattern: FixedPattern | None = None) -> Samples:
    """Return one sample for each frame but the first: the frame, and the events since the frame before.

    Args:
        capture: The shot.
        sampling: Resolution and representation.
        pattern: Fixed pattern to take from the frames.

    Raises:
        DataError: The capture has fewer than two frames.
    """
    if len(capture.frames) < 2:
        raise DataError(
            f"{capture.name} has {len(capture.frames)} frame(s); a sample needs two, with events between"
        )
    frames, peak = capture.frames[1:], float(capture.peak)
    if pattern is not None:
        frames, peak = pattern.correct(frames, peak), 1.0
    known = {"motion": capture.motion, "target": capture.target}
    return make_samples(frames, peak, capture.events, capture.frame_times_us, sampling, **known)


def import_captures(
    folders: Iterable[str | Path],
    out: str | Path,
    sampling: Sampling = Sampling(),
    *,
    test: Iterable[str] = (),
    validation: Iterable[str] = (),
    pattern: FixedPattern | None = None,
    look: Callable[[Capture], None] | None = None,
    progress: Progress = silent,
) -> Dataset:
    """Import capture folders as a dataset, or what is missing of it, and return it.

    Args:
        folders: Capture folders; the folder's name becomes the object's name, the part behind the last
            underscore its character (`near_R` -> R).
        out: The dataset's folder; new, or begun with the same captures and settings.
        sampling: Resolution and representation.
        test: Names of captures, or characters, that are held out for testing.
        validation: The same for validation.
        pattern: Fixed pattern of the frame camera, to be taken from all frames.
        look: Called with each capture that was read, before its samples are made: to tell of it, or to draw it.
        progress: Called when the work begins and as each shard is in place, with the capture's name.

    Returns:
        The dataset.

    Raises:
        DataError: No folder, two captures of one name, or a held-out name that no capture has.
    """
    given = [Path(folder).resolve() for folder in folders]
    paths = {path.name: path for path in given}
    if not paths:
        raise DataError("no captures given; name at least one capture folder")
    if len(paths) != len(given):
        raise DataError(f"{len(given)} folders have {len(paths)} different names; rename those that share one")
    split = _split(list(paths), list(test), list(validation))
    # Read every description first: a wrong folder is an error before anything is written.
    for path in paths.values():
        if not (path / "capture.yaml").is_file():
            raise DataError(f"{path} is no capture: capture.yaml is missing; see `evnlos import --help`")
    described = {name: config_hash(read_capture_info(path)) for name, path in sorted(paths.items())}
    config = {"captures": described, "sampling": to_dict(sampling), "pattern": pattern and pattern.digest}
    dataset = Dataset(Path(out), "captures", sampling, split, config=config, config_hash=config_hash(sampling))
    first = next(iter(paths.values()))
    captures: dict[str, Capture] = {first.name: read_capture(first)}
    with claim_dataset(dataset):
        what, total, missing = f"import {dataset.folder.name}", len(paths), dataset.missing()
        progress(Step(what, total - len(missing), total, "captures"))
        for done, name in enumerate(missing, start=total - len(missing) + 1):
            capture = captures.pop(name, None) or read_capture(paths[name])
            if look is not None:
                look(capture)
            samples = capture_samples(capture, sampling, pattern)
            camera = capture.info.camera.name
            attributes = {"object": name, "config_hash": dataset.config_hash, "camera": camera}
            write_shard(dataset.shard(name), samples, attributes)
            progress(Step(what, done, total, "captures", name))
    return dataset


def character_of(name: str) -> str:
    """Return what an object shows, from its name: the part behind the last underscore.

    Example:
        >>> character_of("near_R"), character_of("writer03_A")
        ('R', 'A')
    """
    return name.rsplit("_", 1)[-1]


def _split(names: list[str], test: list[str], validation: list[str]) -> dict[str, list[str]]:
    split: dict[str, list[str]] = {"train": [], "validation": [], "test": []}
    for wanted in (*test, *validation):
        if not any(wanted in (name, character_of(name)) for name in names):
            raise DataError(
                f"no capture is named {wanted} or shows it; held-out names must be among the captures"
            )
    for name in names:
        keys = {name, character_of(name)}
        in_test, in_validation = bool(keys & set(test)), bool(keys & set(validation))
        if in_test and in_validation:
            raise DataError(f"{name} is held out for testing and for validation; choose one")
        split["test" if in_test else "validation" if in_validation else "train"].append(name)
    return split
