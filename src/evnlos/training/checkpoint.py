"""The whole state of a training in one safetensors file, so that a killed run goes on bit for bit."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from evnlos.errors import DataError
from evnlos.files import write_atomically
from evnlos.model import Reconstructor, describe_network
from evnlos.tensor_file import read_sealed, sealed_bytes


def save_checkpoint(
    path: str | Path,
    network: Reconstructor,
    optimiser: torch.optim.Adam,
    epoch: int,
    log: list[dict],
    key: str,
) -> None:
    """Write weights, optimiser state, number of finished epochs and the log so far, atomically."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        for name, value in state.items():
            tensors[f"optimiser.{index}.{name}"] = torch.as_tensor(value)
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    about = json.dumps({"epoch": epoch, "log": log, "key": key, **describe_network(network)})
    write_atomically(path, sealed_bytes(tensors, about))


def load_checkpoint(
    path: str | Path, network: Reconstructor, optimiser: torch.optim.Adam, key: str
) -> tuple[int, list[dict]]:
    """Restore a training in place; return the number of finished epochs and the log.

    Raises:
        DataError: The file is damaged, or belongs to a training with other settings.
    """
    try:
        text, tensors, _ = read_sealed(path)
        about = json.loads(text)
        if any(value.is_complex() for value in tensors.values()):
            raise ValueError("complex numbers belong to no training")
        epoch, log, their_key = int(about["epoch"]), [dict(line) for line in about["log"]], about["key"]
        if their_key == key:
            weights = {
                network.today(name[8:], network.modality): value
                for name, value in tensors.items()
                if name.startswith("network.")
            }
            state = _optimiser_state(tensors, optimiser)
            network.load_state_dict(weights)
            optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        RuntimeError,
    ) as error:
        raise DataError(
            f"{path} is damaged ({' '.join(str(error).split())[:160]}); delete it to start afresh"
        ) from None
    if their_key != key:
        raise DataError(f"{path} belongs to a training with other settings; give another --out")
    return epoch, log


def _optimiser_state(
    tensors: dict[str, torch.Tensor], optimiser: torch.optim.Adam
) -> dict[int, dict[str, torch.Tensor]]:
    """Return the optimiser's state, each tensor laid out in memory as its parameter is.

    Another layout would be added up in another order, and the training would not end with the same bytes.
    """
    trained = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if not name.startswith("optimiser."):
            continue
        _, index, field = name.split(".")
        parameter = trained[int(index)]
        if value.ndim and value.shape != parameter.shape:
            raise ValueError(f"{name} is {tuple(value.shape)}, not {tuple(parameter.shape)}")
        if value.ndim:
            value = torch.empty_like(parameter, requires_grad=False).copy_(value)
        state.setdefault(int(index), {})[field] = value
    return state
