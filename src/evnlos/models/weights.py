"""Weights: pretrained ones by name, and files on disk.

- Pretrained networks by name: in a folder of the user's, or in the distribution `evnlos-weights`.
- Weights on disk: safetensors with the network's settings in the metadata; nothing is unpickled.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import torch

from evnlos.config import from_dict, to_dict
from evnlos.data import MODALITIES, STANDARD_MODALITIES, Modality, Sampling
from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.files import write_atomically
from evnlos.models.confidence import Confidence
from evnlos.models.reconstructor import Reconstructor, ReconstructorSettings
from evnlos.registry import migrate, todays_weights
from evnlos.setups.files import calibrated_file
from evnlos.tensor_file import check_floats, read_sealed, sealed_bytes

VARIABLE = "EVNLOS_WEIGHTS"
"""Environment variable with a folder of weights; it comes before what is installed."""
GROUP = "evnlos.weights"
"""Group of entry points; the object of each is a package whose folder holds weights."""

_CHECKOUT = Path(__file__).resolve().parents[3] / "packages" / "evnlos-weights" / "src" / "evnlos_weights"
_SETUPS_M = {"near": 0.30, "far": 0.50}
"""Distance from hidden object to wall of each setup that there are weights for, metres."""
_SEQUENCE = "sequence"

GENERIC = "generic"
"""First part of the names of weights of many walls, whose layers a training may begin with."""


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

    A name is setup and modality; one that ends in "-sequence" sees all positions of a sequence together.
    """
    found: dict[str, Path] = {}
    for folder in weights_folders():
        for path in sorted(folder.glob("*.safetensors")):
            found.setdefault(todays_weights(path.stem), path)
    return dict(sorted(found.items()))


def no_weights(what: str) -> UnknownNameError:
    """Return the error that names all ways to weights.

    Args:
        what: What was looked for.
    """
    names = "install evnlos-weights for pretrained ones"
    if known := list(published()):
        near = difflib.get_close_matches(what.partition(" ")[0], known, cutoff=0.5) or known[:3]
        names = f"one of {len(known)} names that `evnlos weights` lists, such as {', '.join(near)}"
    return UnknownNameError(
        f"{what}; give a weights file, a run's folder, or {names}, or set {VARIABLE} to their folder"
    )


def is_as_published(path: Path) -> bool | None:
    """Return whether a published file has the SHA-256 that is stated beside it; None where none is.

    Args:
        path: One of the files of `published`.
    """
    try:
        lines = (path.parent / "SHA256SUMS").read_text(encoding="ascii").splitlines()
    except FileNotFoundError:
        return None
    stated = {name: digest for digest, name in (line.split() for line in lines)}
    if path.name not in stated:
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == stated[path.name]


def published_setup(weights: str | Path) -> Path | None:
    """Return the calibrated setup of published weights whose samples name none; None for other weights.

    Args:
        weights: A name of `published`, or what else stands for weights.
    """
    name, known = todays_weights(str(weights)), published()
    if name not in known:
        return None
    path = known[name].parent / f"{name.partition('-')[0]}.yaml"
    return path if path.is_file() else None


def _setup_beside(weights: Path) -> Path | None:
    """Return the folder `near` of a calibrated setup beside a file `near-....safetensors`, if it is there."""
    folder = weights.parent / weights.stem.partition("-")[0]
    return folder if calibrated_file(folder) != folder else None


def layers_of(setup: str, *modalities: str) -> list[str]:
    """Return the names of the weights of whole sequences that were trained for a setup.

    Args:
        setup: First part of the names; "generic" are those of many walls, for trainings to begin with.
        modalities: What they see; by default frame, event and fusion.

    Example:
        >>> layers_of("generic", "frame")
        ['generic-frame-sequence']
    """
    return [f"{setup}-{modality}-{_SEQUENCE}" for modality in modalities or STANDARD_MODALITIES]


def published_single() -> list[str]:
    """Return the names of the published weights that see one position at a time.

    Example:
        >>> published_single()
        ['near-event', 'near-frame']
    """
    return [name for name in published() if not name.endswith(f"-{_SEQUENCE}")]


def published_for(distance_m: float | None, modality: str, *, is_motion_known: bool) -> str:
    """Return the name of the published weights that fit a capture best.

    Args:
        distance_m: From hidden object to wall, metres; None: unknown, taken for that of `near`.
        modality: What they shall see: "frame", "event" or "fusion".
        is_motion_known: Whether the whole sequence can be seen together, which needs the motion.

    Raises:
        DataError: There are none for this modality.

    Example:
        >>> published_for(0.28, "frame", is_motion_known=False)
        'near-frame'
    """
    wanted = _SETUPS_M["near"] if distance_m is None else distance_m
    names = published()
    setups = sorted(_SETUPS_M, key=lambda setup: abs(_SETUPS_M[setup] - wanted))
    kinds = [f"{modality}-{_SEQUENCE}", modality] if is_motion_known else [modality]
    for name in (f"{setup}-{kind}" for setup in setups for kind in kinds):
        if name in names:
            return name
    if not names:
        raise no_weights(f"there are no pretrained weights for {modality}")
    raise DataError(
        f"no weights for {modality} come with the package that need no motion; give the motion in capture.yaml "
        "(`evnlos track` finds it), or weights of your own"
    )


_FORMAT = "evnlos-weights-4"
_MEAN = "baseline.mean_image"
_CONFIDENCE = "confidence."


@dataclass(frozen=True)
class Weights:
    """A network and what a user of it must know: where it comes from, how good it is.

    Args:
        network: The reconstructor, in evaluation mode; it knows its modality and its sampling.
        history: The trainings behind it, oldest first: settings, data, version.
        mean_image: Mean of the true images of the last training, float32 [H, W]: the baseline to beat.
        confidence: The confidence in its images, learned from sequences that no training saw; None where there
            were none.
        scores: How good it was found to be, for published weights: data, metrics, baselines.
        is_sealed: Whether a digest vouches for the file that they were read from; not of earlier versions.
    """

    network: Reconstructor
    history: list[dict[str, Any]] = field(default_factory=list)
    mean_image: torch.Tensor | None = None
    confidence: Confidence | None = None
    scores: dict[str, Any] = field(default_factory=dict)
    is_sealed: bool = True

    @property
    def modality(self) -> Modality:
        """What the network sees."""
        return self.network.modality

    @property
    def sampling(self) -> Sampling:
        """Resolution and representation of the samples that it was trained on."""
        return self.network.sampling


def save_weights(path: str | Path, weights: Weights, dtype: torch.dtype = torch.float32) -> None:
    """Write weights as one safetensors file, atomically.

    Args:
        path: The file.
        weights: What to write.
        dtype: Precision on disk; `torch.float16` halves the file.

    Raises:
        DataError: A number is not finite, or does not fit the precision.
    """
    state = weights.network.state_dict()
    tensors = {name: value.detach().cpu().to(dtype).contiguous() for name, value in state.items()}
    if weights.mean_image is not None:
        tensors[_MEAN] = weights.mean_image.contiguous()
    if weights.confidence is not None:
        tensors |= {f"{_CONFIDENCE}{name}": one for name, one in weights.confidence.tensors().items()}
    about = {"format": _FORMAT, **describe_network(weights.network)}
    about |= {"history": weights.history, "scores": weights.scores}
    try:
        check_floats(tensors)
    except ValueError as error:
        raise DataError(f"the weights are not written to {path}: {error}") from None
    write_atomically(path, sealed_bytes(tensors, json.dumps(about)))


def describe_network(network: Reconstructor) -> dict[str, Any]:
    """Return what a file says of a network, so that it can be built again: settings, modality, sampling.

    Args:
        network: The network.
    """
    return {
        "network": to_dict(network.settings),
        "modality": network.modality.name,
        "channels": network.modality.layout,
        "sampling": to_dict(network.sampling),
    }


def find_weights(word: str | Path) -> Path:
    """Return the file that `load_weights` reads.

    Raises:
        DataError: There is none, or there are weights here that have a published name.
    """
    known, given = published(), Path(word)
    if not given.exists() and (name := todays_weights(str(given))) in known:
        given = Path(name)
    path = given / "weights.safetensors" if given.is_dir() else given
    if str(given) in known:
        if path.is_file():
            raise DataError(
                f"{given} is a name of published weights and also lies in this folder; "
                f"give {given.absolute()} for that, or rename it"
            )
        path = known[str(given)]
    if not path.is_file():
        raise no_weights(f"{path} does not exist")
    return path


def load_weights(path: str | Path) -> Weights:
    """Read weights; a run's folder stands for the `weights.safetensors` in it.

    Args:
        path: A safetensors file, the folder of a run whose training has ended, or a name of `published`.

    Raises:
        DataError: As of `find_weights`; or the file is not a weights file of this package, or does not fit its
            own config or its digest.
    """
    path = find_weights(path)
    is_known = path in published().values()
    try:
        text, tensors, is_sealed = read_sealed(path)
        about = json.loads(text)
        check_floats(tensors)
        if is_known:  # what is stated beside a file comes before what it says of itself
            as_stated = is_as_published(path)
            is_sealed = is_sealed if as_stated is None else as_stated
            if not is_sealed:
                raise ValueError("its SHA-256 is not the one in SHA256SUMS beside it")
    except (OSError, ValueError, RecursionError) as error:
        why = " ".join(str(error).split()) + ("; install the weights again" if is_known else "")
        raise DataError(f"{path} is not a readable safetensors file: {why}") from None
    about = migrate("weights", about) if isinstance(about, dict) else about
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        found = about.get("format", "no format") if isinstance(about, dict) else about
        raise DataError(f"{path} holds {str(found)[:40]!r}; give weights of format {_FORMAT}")
    history, scores = about.get("history", []), about.get("scores", {})
    mean_image = tensors.pop(_MEAN, None)
    learned = [name for name in tensors if name.startswith(_CONFIDENCE)]
    confidence = _confidence({name.removeprefix(_CONFIDENCE): tensors.pop(name) for name in learned}, path)
    if not (
        isinstance(history, list)
        and all(isinstance(step, dict) for step in history)
        and isinstance(scores, dict)
        and (mean_image is None or mean_image.ndim == 2)
    ):
        raise DataError(f"{path} garbles its history, its scores or its mean image; the file is damaged")
    network = _network(about, tensors, path)
    return Weights(network.eval(), history, mean_image, confidence, scores, is_sealed)


def _confidence(tensors: dict[str, torch.Tensor], path: Path) -> Confidence | None:
    """Return what a file says of confidence, where it says anything.

    Raises:
        DataError: It is not whole.
    """
    if not tensors:
        return None
    try:
        return Confidence(**tensors).checked()
    except (TypeError, DataError) as error:
        raise DataError(f"{path} garbles its confidence ({error}); the file is damaged") from None


def _network(about: dict[str, Any], tensors: dict[str, torch.Tensor], path: Path) -> Reconstructor:
    """Return the network that a file describes, with the tensors in it.

    Raises:
        ConfigError: Its kind or its modality is unknown, or a setting is outside its range.
        DataError: The description does not fit the tensors or the modality.
    """
    modality, sampling = about.get("modality"), about.get("sampling")
    if not isinstance(modality, str) or modality not in MODALITIES:
        raise DataError(
            f"{path} names the modality {str(modality)[:40]!r}; give one of {', '.join(MODALITIES)}"
        )
    seen = MODALITIES[modality]
    made_for: Sampling = from_dict(Sampling, sampling, source=f"{path}: sampling")  # type: ignore[arg-type]
    if about.get("channels", seen.layout) not in (seen.layout, seen.seeing(made_for.surface).layout):
        raise DataError(
            f"{path} sees the channels {str(about['channels'])[:80]}; the modality {modality!r} has "
            f"{seen.layout}: register the modality that it was trained with"
        )
    # Weights that were handed on bring their setup along, which comes before the folder that it once was.
    if made_for.setup and (beside := _setup_beside(path)):
        made_for = replace(made_for, setup=str(beside))
    values = about.get("network")
    settings_class = ReconstructorSettings.class_for(values)
    settings: ReconstructorSettings = from_dict(settings_class, values, source=str(path))  # type: ignore[arg-type]
    network = _matching(partial(settings.build, seen, made_for), settings, tensors, path)
    names = {network.today(name, seen): name for name in tensors}
    network.load_state_dict({name: tensors[old].float() for name, old in names.items()})
    return network


def _matching(
    build: Callable[[], Reconstructor],
    settings: ReconstructorSettings,
    tensors: dict[str, torch.Tensor],
    path: Path,
) -> Reconstructor:
    """Return an empty network of the size that the tensors have; a stranger's settings alone take no memory.

    Raises:
        DataError: The settings do not describe the tensors.
    """
    fits = False
    try:
        if settings.least_tensors <= len(tensors):
            with torch.device("meta"):
                empty = build()
            wanted = {name: tuple(value.shape) for name, value in empty.state_dict().items()}
            found = {empty.today(name, empty.modality): tuple(value.shape) for name, value in tensors.items()}
            fits = wanted == found
    except (RuntimeError, OverflowError, MemoryError, TypeError, LookupError, ConfigError):
        pass
    if not fits:
        raise DataError(f"{path} does not fit its own settings ({settings}); the file is damaged")
    return build()
