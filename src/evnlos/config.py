"""Settings as nested frozen dataclasses: to and from YAML, checked, hashed, never silently wrong."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
import os
import tempfile
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

import yaml
from yaml.composer import ComposerError

from evnlos.errors import ConfigError

T = TypeVar("T")


class _Loader(yaml.SafeLoader):
    """Plain YAML without aliases: with them, a few lines of a stranger's file stand for more than memory."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise ComposerError(None, None, "an alias (*name) stands here; write the value out", mark)
        return super().compose_node(parent, index)


class _Dumper(yaml.SafeDumper):
    """Writes a value that occurs twice twice, so that `_Loader` takes it."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def to_dict(config: Any) -> dict[str, Any]:
    """Return a configuration dataclass as plain nested dictionaries, lists and scalars.

    Example:
        >>> from evnlos.types import Plane
        >>> to_dict(Plane(64, 96, 0.0025))
        {'height': 64, 'width': 96, 'pitch_m': 0.0025, 'center_m': [0.0, 0.0]}
    """
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def from_dict(cls: type[T], values: dict[str, Any], *, source: str = "the configuration") -> T:
    """Build the dataclass `cls` from nested dictionaries, refusing unknown keys and wrong types.

    Args:
        cls: A (nested) frozen dataclass.
        values: Keys are field names; fields that are left out keep their defaults.
        source: What to call the values in an error, e.g. the file they came from.

    Raises:
        ConfigError: An unknown key (the nearest field is named), a wrong type, or a value outside its range.
    """
    from pydantic import TypeAdapter, ValidationError  # here: `import evnlos` stays quick

    if not isinstance(values, dict):
        raise ConfigError(
            f"{source} holds a {type(values).__name__}; give a mapping of setting names to values"
        )
    _refuse_unknown(cls, values, source, "")
    adapter = TypeAdapter(cls)
    try:
        return adapter.validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "(top level)"
        raise ConfigError(f"{source}: {place} = {first.get('input')!r}: {first['msg']}") from None


def load_yaml(cls: type[T], path: str | Path) -> T:
    """Read the dataclass `cls` from a YAML file.

    Raises:
        ConfigError: The file is missing, is not YAML, or its content does not fit `cls`.
    """
    return from_dict(cls, read_yaml(path), source=str(path))


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping.

    Raises:
        ConfigError: The file is missing, is not YAML, or holds something other than a mapping.
    """
    path = Path(path)
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; give the path of a YAML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} can't be read as a YAML file: {error}") from None
    except (yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} is not valid YAML: {reason}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds {type(values).__name__}; give a mapping of setting names to values")
    return values


def save_yaml(config: Any, path: str | Path) -> None:
    """Write a configuration dataclass (or a plain mapping) as YAML, atomically."""
    values = to_dict(config) if dataclasses.is_dataclass(config) else config
    text = yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    write_atomically(path, text.encode())


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file so that a reader sees either all of it or nothing: temporary file, fsync, rename."""
    path = Path(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def config_hash(config: Any) -> str:
    """Return a hash of a configuration's values: 16 hexadecimal digits, equal for equal settings.

    Args:
        config: A configuration dataclass, or a dictionary of plain values.
    """
    text = json.dumps(config if isinstance(config, dict) else to_dict(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def differing_keys(ours: dict[str, Any], theirs: dict[str, Any], prefix: str = "") -> list[str]:
    """Return 'key: theirs -> ours' for every leaf in which two nested mappings differ."""
    found = []
    for key in sorted(ours.keys() | theirs.keys(), key=str):
        mine, other = ours.get(key), theirs.get(key)
        if isinstance(mine, dict) and isinstance(other, dict):
            found += differing_keys(mine, other, f"{prefix}{key}.")
        elif mine != other:
            found.append(f"{prefix}{key}: {other!r} -> {mine!r}")
    return found


def _refuse_unknown(cls: Any, values: Any, source: str, prefix: str) -> None:
    """Walk dataclass and mapping together; pydantic's own message would not name the nearest field."""
    candidates = _dataclasses_in(cls)
    if not candidates or not isinstance(values, dict):
        return
    chosen = _tagged(candidates, values, source, prefix)
    hints = typing.get_type_hints(chosen)
    names = [field.name for field in dataclasses.fields(chosen)]
    for key, value in values.items():
        if key not in names:
            near = difflib.get_close_matches(str(key), names, n=1)
            cure = f"perhaps you meant {near[0]!r}" if near else f"known settings: {', '.join(names)}"
            raise ConfigError(f"{source}: unknown setting {prefix}{key!s}; {cure}")
        _refuse_unknown(hints[key], value, source, f"{prefix}{key}.")


def _dataclasses_in(cls: Any) -> list[type]:
    """Return the dataclass that a type hint names, or those of its union."""
    if typing.get_origin(cls) is typing.Annotated:
        return _dataclasses_in(typing.get_args(cls)[0])
    if typing.get_origin(cls) in (typing.Union, types.UnionType):
        return [found for part in typing.get_args(cls) for found in _dataclasses_in(part)]
    if isinstance(cls, type) and dataclasses.is_dataclass(cls):
        return [cls]
    return []


def _tagged(candidates: list[type], values: dict[str, Any], source: str, prefix: str) -> type:
    """Choose the member of a union by its literal field `kind`."""
    if len(candidates) == 1:
        return candidates[0]
    kinds = {
        field.default: cls for cls in candidates for field in dataclasses.fields(cls) if field.name == "kind"
    }
    kind = values.get("kind")
    if kind not in kinds:
        raise ConfigError(f"{source}: {prefix}kind is {kind!r}; give one of {', '.join(map(str, kinds))}")
    return kinds[kind]
