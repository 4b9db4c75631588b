"""Weights on disk: safetensors with the network's config in the metadata; nothing is unpickled."""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from evnlos.config import from_dict, to_dict, write_atomically
from evnlos.dataset import CHANNELS
from evnlos.errors import ConfigError, DataError
from evnlos.model.confidence import Confidence
from evnlos.model.joint import JointNetwork, new_network
from evnlos.model.published import published
from evnlos.model.unet import ResidualUNet, UNetConfig

_FORMAT = "evnlos-weights-3"
_MEAN = "baseline.mean_image"
_CONFIDENCE = "confidence."


@dataclass(frozen=True)
class Weights:
    """A network and what a user of it must know: its paradigm, its sampling, where it comes from.

    Args:
        network: The network, in evaluation mode; of single positions, or a joint one of whole passes.
        paradigm: What it sees: "frame", "event" or "fusion".
        sampling: Resolution and representation of the samples that it was trained on.
        history: The trainings behind it, oldest first: settings, data, version.
        mean_image: Mean of the true pictures of the last training, float32 [H, W]: the baseline to beat.
        confidence: What its pictures are worth, learned from passes that no training saw; None where there
            were none.
        scores: How good it was found to be, for published weights: data, metrics, baselines.
    """

    network: ResidualUNet | JointNetwork
    paradigm: str
    sampling: dict[str, Any]
    history: list[dict[str, Any]]
    mean_image: torch.Tensor | None = None
    confidence: Confidence | None = None
    scores: dict[str, Any] = field(default_factory=dict)


def save_weights(path: str | Path, weights: Weights, dtype: torch.dtype = torch.float32) -> None:
    """Write weights as one safetensors file, atomically.

    Args:
        path: The file.
        weights: What to write.
        dtype: Precision on disk; `torch.float16` halves the file.
    """
    state = weights.network.state_dict()
    tensors = {name: value.detach().cpu().to(dtype).contiguous() for name, value in state.items()}
    if weights.mean_image is not None:
        tensors[_MEAN] = weights.mean_image.contiguous()
    if weights.confidence is not None:
        tensors |= {f"{_CONFIDENCE}{name}": one for name, one in weights.confidence.tensors().items()}
    about = {
        "format": _FORMAT,
        "paradigm": weights.paradigm,
        "joint": isinstance(weights.network, JointNetwork),
        "network": to_dict(weights.network.config),
        "sampling": weights.sampling,
        "history": weights.history,
        "scores": weights.scores,
    }
    write_atomically(path, save(tensors, metadata={"evnlos": json.dumps(about)}))


def with_rank(weights: Weights, rank: int) -> Weights:
    """Return a copy of weights whose linear embedding has fewer components, the strongest.

    Args:
        weights: The weights; unchanged.
        rank: Components to keep.

    Raises:
        ConfigError: There is no embedding, or it has fewer components.
    """
    network = deepcopy(weights.network)
    if network.embedding is None:
        raise ConfigError(
            f"the rank is to be {rank}, and these weights have no linear embedding; leave it away"
        )
    network.embedding.keep(rank)
    network.config = replace(network.config, rank=rank)
    return replace(weights, network=network)


def load_weights(path: str | Path) -> Weights:
    """Read weights; a run's folder stands for the `weights.safetensors` in it.

    Args:
        path: A safetensors file, the folder of a run whose training has ended, or a name of `published`.

    Raises:
        DataError: The file is missing, is not a weights file of this package, or does not fit its own config.
    """
    known = published()
    path = Path(path) if Path(path).exists() else known.get(str(path), Path(path))
    if path.is_dir():
        path = path / "weights.safetensors"
    if not path.is_file():
        names = f", or one of {', '.join(known)}" if known else ""
        raise DataError(f"{path} does not exist; give a weights file, a run whose training has ended{names}")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("evnlos", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} is not a readable safetensors file: {' '.join(str(error).split())}") from None
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        found = about.get("format", "no format") if isinstance(about, dict) else about
        raise DataError(f"{path} holds {str(found)[:40]!r}; give weights of format {_FORMAT}")
    paradigm, sampling, history = about.get("paradigm"), about.get("sampling", {}), about.get("history", [])
    scores = about.get("scores", {})
    if not isinstance(paradigm, str) or paradigm not in CHANNELS:
        raise DataError(f"{path} names the paradigm {str(paradigm)[:40]!r}; give one of {', '.join(CHANNELS)}")
    mean_image = tensors.pop(_MEAN, None)
    learned = [name for name in tensors if name.startswith(_CONFIDENCE)]
    confidence = _confidence({name.removeprefix(_CONFIDENCE): tensors.pop(name) for name in learned}, path)
    if not (
        isinstance(sampling, dict)
        and isinstance(history, list)
        and all(isinstance(step, dict) for step in history)
        and isinstance(scores, dict)
        and (mean_image is None or mean_image.ndim == 2)
    ):
        raise DataError(
            f"{path} garbles its sampling, its history, its scores or its mean picture; the file is damaged"
        )
    config = from_dict(UNetConfig, about.get("network"), source=str(path))  # type: ignore[arg-type]
    size: Any = (sampling.get("height"), sampling.get("width"))
    pitch_m: Any = sampling.get("pitch_m")
    make = partial(new_network, CHANNELS[paradigm], config, size, pitch_m, joint=bool(about.get("joint")))
    network = _matching_network(make, config, tensors, path)
    network.load_state_dict({name: value.float() for name, value in tensors.items()})
    return Weights(network.eval(), paradigm, sampling, history, mean_image, confidence, scores)


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


def _matching_network(
    make: Callable[[], ResidualUNet | JointNetwork],
    config: UNetConfig,
    tensors: dict[str, torch.Tensor],
    path: Path,
) -> ResidualUNet | JointNetwork:
    """Return an empty network of the size that the tensors have; a stranger's config alone takes no memory.

    Raises:
        DataError: The config does not describe the tensors.
    """
    wanted: dict[str, tuple[int, ...]] = {}
    try:
        if config.depth * config.blocks <= len(tensors):  # each block has more than one tensor
            with torch.device("meta"):
                wanted = {name: tuple(value.shape) for name, value in make().state_dict().items()}
    except (RuntimeError, OverflowError, MemoryError, TypeError, LookupError, ConfigError):
        pass
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    if not wanted or wanted != found:
        raise DataError(f"{path} does not fit its own config ({config}); the file is damaged")
    return make()
