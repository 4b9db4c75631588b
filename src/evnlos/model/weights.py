"""Weights on disk: safetensors with the network's config in the metadata; nothing is unpickled."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from evnlos.config import from_dict, to_dict, write_atomically
from evnlos.dataset import CHANNELS
from evnlos.errors import DataError
from evnlos.model.unet import ResidualUNet, UNetConfig

_FORMAT = "evnlos-weights-1"
_MEAN = "baseline.mean_image"


@dataclass(frozen=True)
class Weights:
    """A network and what a user of it must know: its paradigm, its sampling, where it comes from.

    Args:
        network: The network, in evaluation mode.
        paradigm: What it sees: "frame", "event" or "fusion".
        sampling: Resolution and representation of the samples that it was trained on.
        history: The trainings behind it, oldest first: settings, data, version.
        mean_image: Mean of the true pictures of the last training, float32 [H, W]: the baseline to beat.
    """

    network: ResidualUNet
    paradigm: str
    sampling: dict[str, Any]
    history: list[dict[str, Any]]
    mean_image: torch.Tensor | None = None


def save_weights(path: str | Path, weights: Weights) -> None:
    """Write weights as one safetensors file, atomically."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.network.state_dict().items()}
    if weights.mean_image is not None:
        tensors[_MEAN] = weights.mean_image.contiguous()
    about = {
        "format": _FORMAT,
        "paradigm": weights.paradigm,
        "network": to_dict(weights.network.config),
        "sampling": weights.sampling,
        "history": weights.history,
    }
    write_atomically(path, save(tensors, metadata={"evnlos": json.dumps(about)}))


def load_weights(path: str | Path) -> Weights:
    """Read weights; a run's folder stands for the `weights.safetensors` in it.

    Args:
        path: A safetensors file, or the folder of a run whose training has ended.

    Raises:
        DataError: The file is missing, is not a weights file of this package, or does not fit its own config.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "weights.safetensors"
    if not path.is_file():
        raise DataError(f"{path} does not exist; give a weights file, or a run whose training has ended")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("evnlos", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError) as error:
        raise DataError(f"{path} is not a readable safetensors file: {' '.join(str(error).split())}") from None
    if about.get("format") != _FORMAT:
        raise DataError(f"{path} holds {about.get('format', 'no format')!r}; give weights of format {_FORMAT}")
    if about.get("paradigm") not in CHANNELS:
        raise DataError(
            f"{path} names the paradigm {about.get('paradigm')!r}; give one of {', '.join(CHANNELS)}"
        )
    config = from_dict(UNetConfig, about["network"], source=str(path))
    _refuse_oversized(config, tensors, path)
    mean_image = tensors.pop(_MEAN, None)
    network = ResidualUNet(CHANNELS[about["paradigm"]], config)
    try:
        network.load_state_dict({name: value.float() for name, value in tensors.items()})
    except RuntimeError as error:
        raise DataError(f"{path} does not fit its own config: {' '.join(str(error).split())[:160]}") from None
    return Weights(
        network.eval(), about["paradigm"], about.get("sampling", {}), about.get("history", []), mean_image
    )


def _refuse_oversized(config: UNetConfig, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """A stranger's config must not make us allocate more than its own tensors prove."""
    claimed, there = (
        config.width * min(2**config.depth, 8),
        max(max(t.shape, default=0) for t in tensors.values()),
    )
    if claimed > max(there, 1) or config.depth > 16 or config.blocks > 64:
        raise DataError(f"{path} claims {claimed} channels but holds at most {there}; the file is damaged")
