"""A sealed file of tensors: safetensors with a description, and a digest that shows every flipped byte."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from evnlos.untrusted import open_regular

_ABOUT, _DIGEST = "evnlos", "sha256"
_OTHERS = {"format"}  # what other programs add when they copy a file


def sealed_bytes(tensors: dict[str, torch.Tensor], about: str) -> bytes:
    """Return the content of a file of tensors with its digest.

    Args:
        tensors: Contiguous tensors in main memory, by name.
        about: Description, such as JSON.
    """
    metadata = {_ABOUT: about, _DIGEST: digest_of(tensors, about)}
    content = save(tensors, metadata=metadata)
    # safetensors writes its metadata in an order that changes from call to call; a run gives the same bytes.
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size]) | {"__metadata__": metadata}
    text = json.dumps(header, separators=(",", ":"), sort_keys=True).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


def digest_of(tensors: dict[str, torch.Tensor], about: str) -> str:
    """Return the SHA-256 of a description and of all tensors: names, types, shapes, and their bytes.

    Args:
        tensors: Contiguous tensors in main memory, by name; their order does not matter.
        about: The description.
    """
    found = hashlib.sha256(f"{len(about)}:{about}".encode("utf-8", "surrogatepass"))
    for name, value in sorted(tensors.items()):
        found.update(f"|{len(name)}:{name}:{value.dtype}:{tuple(value.shape)}|".encode())
        found.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def read_sealed(path: str | Path) -> tuple[str, dict[str, torch.Tensor], bool]:
    """Return description and tensors of a file, and whether a digest vouches for them.

    Files of earlier versions have no digest; damage to their numbers goes unseen.

    Args:
        path: The file.

    Raises:
        ValueError: It is no safetensors file, or its content does not fit its digest.
        OSError: It can't be opened, or is no plain file.
    """
    with open_regular(path):
        pass
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except SafetensorError as error:
        raise ValueError(str(error)) from None
    unknown = metadata.keys() - {_ABOUT, _DIGEST} - _OTHERS
    if unknown:
        raise ValueError(f"unknown metadata {min(unknown)[:40]!r}")
    about, stated = metadata.get(_ABOUT, "{}"), metadata.get(_DIGEST)
    if stated is not None and stated != digest_of(tensors, about):
        raise ValueError("its content does not fit its digest, so it was damaged or changed; copy it again")
    return about, tensors, stated is not None


def check_floats(tensors: dict[str, torch.Tensor]) -> None:
    """Refuse tensors that are no finite real numbers.

    Args:
        tensors: Tensors by name.

    Raises:
        ValueError: One is of another type, or holds NaN or infinity.
    """
    for name, value in tensors.items():
        if not value.dtype.is_floating_point:
            raise ValueError(f"{name[:80]} holds {value.dtype}; floating-point numbers belong there")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(
                f"{name[:80]} holds NaN or infinity; the training diverged, or the file is damaged"
            )
