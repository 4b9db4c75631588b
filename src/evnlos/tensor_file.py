"""A sealed file of tensors: safetensors with a description, and a digest that shows every flipped byte."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from evnlos.config import from_dict, to_dict
from evnlos.errors import ConfigError, DataError
from evnlos.files import write_atomically
from evnlos.untrusted import open_regular

SUFFIX = ".safetensors"
Content = TypeVar("Content")

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
    return b"".join((len(text).to_bytes(8, "little"), text, memoryview(content)[8 + size :]))


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


def file_checksum(path: str | Path) -> str:
    """Return the first 16 hexadecimal digits of a file's SHA-256.

    Args:
        path: The file.
    """
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


@dataclass(frozen=True)
class TensorFile(Generic[Content]):
    """A kind of sealed file: named tensors and a description of one settings class.

    Args:
        format: Name and version of the format, as it stands in the file.
        names: The tensors.
        about: Settings class of the description.
        build: Makes the content of `about` and the tensors, by name; raises `DataError` or ValueError where
            they don't fit.
        thing: What it is ("a fitted wall").
        origin: Where it comes from ("the file that `evnlos calibrate` wrote").
        later: Tensors that files of before lack; `build` does without them.
    """

    format: str
    names: tuple[str, ...]
    about: type
    build: Callable[..., Content]
    thing: str
    origin: str
    later: tuple[str, ...] = ()

    def write(self, path: str | Path, tensors: dict[str, torch.Tensor], about: Any) -> str:
        """Write a file atomically and return its checksum.

        Raises:
            ConfigError: The name does not end in .safetensors.
        """
        path = Path(path)
        if path.suffix != SUFFIX:
            raise ConfigError(f"{path} ends in {path.suffix or 'nothing'!r}; give a name that ends in {SUFFIX}")
        content = sealed_bytes(
            {name: tensors[name].contiguous() for name in (*self.names, *self.later)},
            json.dumps({"format": self.format, "about": to_dict(about)}),
        )
        write_atomically(path, content)
        return hashlib.sha256(content).hexdigest()[:16]

    def read(self, path: str | Path) -> Content:
        """Read a file; nothing is unpickled, and no size is taken on trust.

        Raises:
            DataError: The file is missing, damaged, is no such file, or does not fit its own description.
        """
        path = Path(path)
        if not path.is_file():
            raise DataError(f"{path} does not exist; give {self.origin}")
        try:
            text, tensors, _ = read_sealed(path)
            found = json.loads(text)
        except (OSError, ValueError, RecursionError) as error:
            said = " ".join(str(error).split())
            raise DataError(f"{path} is not a readable safetensors file: {said}") from None
        is_ours = isinstance(found, dict) and found.get("format") == self.format
        if not is_ours or not tensors.keys() >= set(self.names):
            stated = found.get("format", "no format") if isinstance(found, dict) else found
            raise DataError(
                f"{path} holds {str(stated)[:40]!r}; give {self.thing} of format {self.format}, {self.origin}"
            )
        try:
            about = from_dict(self.about, found.get("about", {}), source=str(path))
            names = (*self.names, *(name for name in self.later if name in tensors))
            return self.build(about=about, **{name: tensors[name] for name in names})
        except (ConfigError, DataError, ValueError) as error:
            raise DataError(f"{path} garbles its description: {error}") from None

    def load(self, path: str | Path, checksum: str) -> Content:
        """Read the file that settings name; one that did not change is read once.

        Args:
            path: The file.
            checksum: Its checksum as the settings state it; empty: any.

        Raises:
            ConfigError: It is another file than the checksum says.
            DataError: As of `read`.
        """
        path = Path(path)
        if not path.is_file():
            raise DataError(f"{path} does not exist; give {self.origin}")
        state = path.stat()
        return _loaded(self, str(path.resolve()), state.st_mtime_ns, state.st_size, checksum)


@lru_cache(maxsize=4)
def _loaded(kind: TensorFile[Content], path: str, changed_ns: int, size: int, checksum: str) -> Content:
    if checksum and (found := file_checksum(path)) != checksum:
        raise ConfigError(f"{path} has the checksum {found}, the settings say {checksum}; name the file meant")
    return kind.read(path)
