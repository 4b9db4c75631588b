"""Pretrained networks by name: in a folder of the user's, or in the distribution `evnlos-weights`."""

from __future__ import annotations

import hashlib
import importlib
import os
from importlib.metadata import entry_points
from pathlib import Path

from evnlos.errors import ConfigError, DataError

VARIABLE = "EVNLOS_WEIGHTS"
"""Environment variable with a folder of weights; it comes before what is installed."""
GROUP = "evnlos.weights"
"""Group of entry points; the object of each is a package whose folder holds weights."""

_CHECKOUT = Path(__file__).resolve().parents[3] / "packages" / "evnlos-weights" / "src" / "evnlos_weights"
_RIGS_M = {"near": 0.30, "far": 0.50}
"""Distance from hidden object to wall of each rig that there are weights for, metres."""
_PASS = "pass"


def weights_folders() -> list[Path]:
    """Return the folders with weights, first those to be preferred; nothing is downloaded.

    They are that of the variable `EVNLOS_WEIGHTS`, those of installed distributions with an entry point
    `evnlos.weights`, and that of the source checkout which this package runs from.

    Raises:
        ConfigError: The variable names no folder, or an installed distribution can't be imported.
    """
    found = []
    if named := os.environ.get(VARIABLE):
        if not Path(named).is_dir():
            raise ConfigError(f"{VARIABLE} is {named!r}, which is no folder; give one that holds weights")
        found.append(Path(named))
    for point in entry_points(group=GROUP):
        try:
            module = importlib.import_module(point.value)
        except ImportError as error:
            raise ConfigError(f"the weights of {point.value} can't be imported: {error}") from None
        found += [Path(folder) for folder in module.__path__]
    if _CHECKOUT.is_dir():
        found.append(_CHECKOUT)
    return found


def published() -> dict[str, Path]:
    """Return the weights that are installed: name, such as "near-frame", -> file.

    A name is rig and modality; one that ends in "-pass" sees all positions of a pass together.
    """
    found: dict[str, Path] = {}
    for folder in weights_folders():
        for path in sorted(folder.glob("*.safetensors")):
            found.setdefault(path.stem, path)
    return dict(sorted(found.items()))


def no_weights(what: str) -> DataError:
    """Return the error that names all ways to weights.

    Args:
        what: What was looked for.
    """
    known = ", ".join(published())
    names = f"a name of installed ones ({known})" if known else "install evnlos-weights for pretrained ones"
    return DataError(
        f"{what}; give a weights file, a run whose training has ended, or {names}, or set {VARIABLE} to a "
        "folder that holds them"
    )


def is_as_published(path: Path) -> bool:
    """Return whether a published file has the SHA-256 that is stated beside it.

    Args:
        path: One of the files of `published`.
    """
    try:
        lines = (path.parent / "SHA256SUMS").read_text(encoding="ascii").splitlines()
    except FileNotFoundError:
        return False
    stated = {name: digest for digest, name in (line.split() for line in lines)}
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == stated.get(path.name)


def published_rig(weights: str | Path) -> Path | None:
    """Return the calibrated rig that published weights were trained for, a `rig.yaml`; None for other weights.

    Args:
        weights: A name of `published`, or what else stands for weights.
    """
    name, known = str(weights), published()
    if name not in known:
        return None
    path = known[name].parent / f"{name.partition('-')[0]}.yaml"
    return path if path.is_file() else None


def published_single() -> list[str]:
    """Return the names of the published weights that see one position at a time.

    Example:
        >>> published_single()
        ['near-event', 'near-frame']
    """
    return [name for name in published() if not name.endswith(f"-{_PASS}")]


def published_for(distance_m: float | None, modality: str, *, is_motion_known: bool) -> str:
    """Return the name of the published weights that fit a capture best.

    Args:
        distance_m: From hidden object to wall, metres; None: unknown, taken for that of `near`.
        modality: What they shall see: "frame", "event" or "fusion".
        is_motion_known: Whether the whole pass can be seen together, which needs the motion.

    Raises:
        DataError: There are none for this modality.

    Example:
        >>> published_for(0.28, "frame", is_motion_known=False)
        'near-frame'
    """
    wanted = _RIGS_M["near"] if distance_m is None else distance_m
    names = published()
    rigs = sorted(_RIGS_M, key=lambda rig: abs(_RIGS_M[rig] - wanted))
    kinds = [f"{modality}-{_PASS}", modality] if is_motion_known else [modality]
    for name in (f"{rig}-{kind}" for rig in rigs for kind in kinds):
        if name in names:
            return name
    if not names:
        raise no_weights(f"there are no pretrained weights for {modality}")
    raise DataError(
        f"no weights for {modality} come with the package that need no motion; give the motion in capture.yaml "
        "(`evnlos track` finds it), or weights of your own"
    )
