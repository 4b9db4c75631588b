"""Settings as nested frozen dataclasses: to and from YAML, checked, hashed, never silently wrong."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
import numbers
import types
import typing
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import yaml

from evnlos.errors import ConfigError, UnknownNameError
from evnlos.files import write_atomically
from evnlos.registry import NESTED, UNSTATED, Kinded, migrate
from evnlos.untrusted import open_regular

T = TypeVar("T")

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast where it was built
_MOST_BYTES, _BYTES_A_NODE, _MOST_DEPTH = 1 << 20, 16, 100
RANGES = {
    "_px_m": (1e-9, 1e9),
    "_m_s": (1e-9, 1e4),
    "_us": (0, 2**62),
    "_hz": (1e-9, 1e9),
    "_mhz": (1e-3, 1e4),
    "_deg": (1e-12, 1e4),
    "_ms": (1e-6, 1e10),
    "_s": (1e-9, 1e7),
    "_m": (1e-12, 1e4),
    "_e": (1e-9, 1e12),
    "_mb": (1e-6, 1e6),
    "seed": (0, 2**63 - 1),
}
"""Smallest and largest size of a number that is not 0, by the unit that its name ends in."""
UNSIGNED = (
    "distance_m", "pitch_m", "cell_m", "wavelength_m", "view_m", "view_deg", "duration_s", "roughness",
    "albedo", "seed",
)  # fmt: skip
"""What the names of numbers end in that are never negative."""
_NO_UNIT, _MOST_COUNT = (1e-30, 1e30), 2**63 - 1
_CURES: dict[Any, str] = {  # in place of pydantic's words
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "give a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "give a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "give true or false") | {"string_type": "give a text"},
    **dict.fromkeys(("tuple_type", "list_type"), "give a list") | {"literal_error": "give {expected}"},
    **dict.fromkeys(("dict_type", "dataclass_type"), "give a mapping of names to values"),
    **{"too_long": "give at most {max_length} values", "missing": "a value is required here"},
}
BESIDE = types.MappingProxyType({"beside": True})
"""Metadata of a field that names a file or folder; in a YAML file it is relative to that file's folder."""
LONG_YAML = 1 << 26
"""Bytes of a YAML file that names every object of a dataset, at most."""


class _Dumper(yaml.SafeDumper):
    """Writes a value that occurs twice twice, so that `read_yaml` takes it."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def to_dict(config: Any) -> dict[str, Any]:
    """Return a configuration dataclass as plain nested dictionaries, lists and scalars.

    Example:
        >>> from evnlos.types import Plane
        >>> to_dict(Plane(64, 96, 0.0025))
        {'height': 64, 'width': 96, 'pitch_m': 0.0025, 'center_m': [0.0, 0.0]}
    """
    stated = dataclasses.asdict(config, dict_factory=lambda pairs: dict(p for p in pairs if p != UNSTATED))
    return json.loads(json.dumps(stated, default=str))


def from_dict(
    cls: type[T], values: dict[str, Any], *, source: str = "the configuration", folder: Path | None = None
) -> T:
    """Build the dataclass `cls` from nested dictionaries, refusing unknown keys and wrong types.

    Args:
        cls: A (nested) frozen dataclass.
        values: Keys are field names, today's or those of older versions (`evnlos.registry`); fields that are
            left out keep their defaults.
        source: What to call the values in an error, e.g. the file they came from.
        folder: Where names of files (fields marked `BESIDE`) are looked up; None leaves them as they are.

    Raises:
        ConfigError: An unknown key (the nearest field is named), a wrong type, or a value outside its range.
    """
    from pydantic import ValidationError  # here: `import evnlos` stays quick

    if not isinstance(values, dict):
        raise ConfigError(f"{source} holds a {type(values).__name__}; give a mapping of names to values")
    try:
        values = _migrated(cls, values, folder)
    except ConfigError as error:  # a kind that nobody knows
        raise ConfigError(f"{source}: {error}") from None
    _refuse_unknown(cls, values, source, "")
    try:
        found = _adapter(cls).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        loc, value, fault, text = tuple(first["loc"]), first.get("input"), first["type"], first["msg"]
        if fault == NESTED and "ctx" in first:
            loc, value, fault = (*loc, *first["ctx"]["loc"]), first["ctx"]["input"], first["ctx"]["fault"]
        place = ".".join(str(part) for part in loc) or "(top level)"
        cure = _CURES.get(fault, "").format(**first.get("ctx", {})) or text.removeprefix("Value error, ")
        what = place if fault == "missing" else f"{place} = {_shown(value)}"
        raise ConfigError(f"{source}: {what}: {cure}") from None
    except (ArithmeticError, MemoryError, TypeError, LookupError) as error:  # a range that only fits together
        raise ConfigError(f"{source}: its numbers do not fit together ({error})") from None
    return found


@lru_cache(maxsize=64)
def _adapter(cls: Any) -> Any:
    """Return what builds a settings class from a mapping; making one takes longer than using it."""
    from pydantic import TypeAdapter

    return TypeAdapter(cls)


def _shown(value: Any) -> str:
    """Return a value as it stands in a message; Python writes out no number of thousands of digits."""
    try:
        return repr(value)[:200]
    except ValueError:
        return "a number of thousands of digits"


def load_yaml(cls: type[T], path: str | Path) -> T:
    """Read the dataclass `cls` from a YAML file; names of files in it are relative to its folder.

    A name that is not found there may be relative to the working directory; an absolute one that is gone is
    looked for beside the YAML file, so that a folder may be moved.

    Raises:
        ConfigError: The file is missing, is not YAML, or its content does not fit `cls`.
    """
    return from_dict(cls, read_yaml(path), source=str(path), folder=Path(path).parent)


def read_yaml(path: str | Path, most_bytes: int = _MOST_BYTES) -> dict[str, Any]:
    """Read a YAML file that holds a mapping: plain values, no aliases, no tags.

    With aliases a few lines of a stranger's file stand for more than memory, and a file of many values takes
    minutes, so that a small file holds at most one value for every 16 bytes of `most_bytes`.

    Args:
        path: The file.
        most_bytes: Size of the file, bytes, at most.

    Raises:
        ConfigError: The file is missing, too large, is not YAML, or holds something other than a mapping.
    """
    path = Path(path)
    try:
        with open_regular(path) as file:
            content = file.read(most_bytes + 1)
        if len(content) > most_bytes:
            raise ConfigError(f"{path} is larger than {most_bytes / 1e6:.0f} MB; leave values out")
        text = content.decode("utf-8")
        _check_plain(text, most_bytes // _BYTES_A_NODE)
        values = yaml.load(text, _Loader)
    except FileNotFoundError:
        raise UnknownNameError(f"{path} does not exist; give the path of a YAML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} can't be read as a YAML file: {error}") from None
    except (yaml.YAMLError, RecursionError, ValueError, ArithmeticError, LookupError, TypeError) as error:
        # PyYAML hands on what Python says of impossible dates and of numbers without digits, or with thousands.
        reason = " ".join(str(error).replace(' in "<unicode string>",', " at").split())
        raise ConfigError(f"{path} is not valid YAML: {reason[:500]}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds {type(values).__name__}; give a mapping of setting names to values")
    return values


def _check_plain(text: str, most: int) -> None:
    """Refuse YAML with aliases, deep nesting or many values, before anything is built of it.

    Raises:
        ValueError: It holds one of these.
    """
    depth = 0
    for count, event in enumerate(yaml.parse(text, _Loader)):
        place = f"line {event.start_mark.line + 1}" if event.start_mark else "it"
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"{place}: an alias (*name) stands here; write the value out")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _MOST_DEPTH:
            raise ValueError(f"{place} is nested more than {_MOST_DEPTH} deep")
        if count > most:
            raise ValueError(f"{place}: more than {most} values; leave some out")


def save_yaml(config: Any, path: str | Path) -> None:
    """Write a configuration dataclass (or a plain mapping) as YAML, atomically.

    Files of a dataclass that lie in the YAML file's folder are named relative to it.
    """
    values = config
    if dataclasses.is_dataclass(config):
        values = _relative(config, to_dict(config), Path(path).parent.resolve())
    text = yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    write_atomically(path, text.encode())


def config_hash(config: Any) -> str:
    """Return a hash of a configuration's values: 16 hexadecimal digits, equal for equal settings.

    Args:
        config: A configuration dataclass, or a dictionary of plain values.
    """
    text = json.dumps(config if isinstance(config, dict) else to_dict(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def differing_keys(current: dict[str, Any], stored: dict[str, Any], prefix: str = "") -> list[str]:
    """Return 'key: stored -> current' for every leaf in which two nested mappings differ."""
    found = []
    for key in sorted(current.keys() | stored.keys(), key=str):
        one, other = current.get(key), stored.get(key)
        if isinstance(one, dict) and isinstance(other, dict):
            found += differing_keys(one, other, f"{prefix}{key}.")
        elif one != other:
            found.append(f"{prefix}{key}: {other!r} -> {one!r}")
    return found


def _relative(config: Any, values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a dataclass's mapping in which names of files in `folder` are relative to it."""
    found = dict(values)
    for field in dataclasses.fields(config):
        here = getattr(config, field.name)
        if dataclasses.is_dataclass(here):
            found[field.name] = _relative(here, values[field.name], folder)
        elif here and _names_file(field) and (path := Path(here).resolve()).is_relative_to(folder):
            found[field.name] = path.relative_to(folder).as_posix()
    return found


def _names_file(field: dataclasses.Field[Any]) -> bool:
    return field.metadata.get("beside", False)


def _found_from(folder: Path, name: Any) -> Any:
    """Return the absolute path of a file that a YAML file in `folder` names; else the name as it is."""
    if not isinstance(name, str) or not name or "\0" in name:
        return name
    path = Path(name)
    if path.is_absolute():
        beside = folder / path.name
        return name if _is_there(path) or not _is_there(beside) else str(beside.resolve())
    beside = folder / path
    return str(beside.resolve()) if _is_there(beside) else name


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return False


def _migrated(cls: Any, values: Any, folder: Path | None = None) -> Any:
    """Return the values with all nested mappings in the names of today, its files as seen from `folder`."""
    candidates = _dataclasses_in(cls, values)
    if not candidates or not isinstance(values, dict):
        return values
    chosen = candidates[0]
    if len(candidates) > 1:
        kind = values.get("kind")
        chosen = next((one for one in candidates if getattr(one, "kind", None) == kind), chosen)
    values = migrate(chosen.__name__, values)
    hints = typing.get_type_hints(chosen)
    if folder is not None and dataclasses.is_dataclass(chosen):
        files = {field.name for field in dataclasses.fields(chosen) if _names_file(field)}
        values = {key: _found_from(folder, value) if key in files else value for key, value in values.items()}
    return {
        key: _migrated(hints[key], value, folder) if key in hints else value for key, value in values.items()
    }


def _refuse_unknown(cls: Any, values: Any, source: str, prefix: str) -> None:
    """Walk dataclass and mapping together; pydantic's own message would not name the nearest field."""
    candidates = _dataclasses_in(cls, values)
    if not candidates or not isinstance(values, dict):
        return
    chosen = _tagged(candidates, values, source, prefix)
    hints = typing.get_type_hints(chosen)
    names = [field.name for field in dataclasses.fields(chosen)]
    for key, value in values.items():
        if key not in names:
            near = difflib.get_close_matches(str(key)[:100], names, n=1)
            cure = f"perhaps you meant {near[0]!r}" if near else f"known settings: {', '.join(names)}"
            raise ConfigError(f"{source}: unknown setting {prefix}{key!s}; {cure}")
        if not _is_free(hints[key]):
            check_numbers(value, f"{source}: {prefix}{key}", str(key))
        _refuse_unknown(hints[key], value, source, f"{prefix}{key}.")


def _is_free(hint: Any) -> bool:
    """Return whether a field holds notes of any kind, whose numbers nothing is computed with."""
    return any(part is Any for part in typing.get_args(hint))


def check_made(settings: Any) -> None:
    """Refuse numbers in settings that are just being made; their `__post_init__` calls it.

    Other than in a file, a number may be as small as it likes: an optimiser comes near 0.

    Args:
        settings: A dataclass.

    Raises:
        ConfigError: As of `check_numbers`.
    """
    check_numbers(settings, type(settings).__name__, may_be_tiny=True)


def check_numbers(value: Any, what: str, name: str = "", *, may_be_tiny: bool = False) -> None:
    """Refuse numbers outside the range of their unit, which the end of their name says (docs/units.md).

    Settings check their own, narrower ranges besides.

    Args:
        value: A number, a dataclass, or a tuple, list or mapping of these; anything else is left alone.
        what: What to call it in an error.
        name: Name of the setting.
        may_be_tiny: Leave the smallest size of the range out.

    Raises:
        ConfigError: A number is NaN or infinite, its size is outside the range, or it is negative and never is.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in _numbered_fields(type(value)):
            inner, place = getattr(value, field), f"{what}.{field}".lstrip(".")
            check_numbers(inner, place, field, may_be_tiny=may_be_tiny)
    elif isinstance(value, dict):
        for key, inner in value.items():
            last = str(key).rpartition(".")[2]
            check_numbers(inner, f"{what}.{str(key)[:80]}", last, may_be_tiny=may_be_tiny)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            check_numbers(inner, what, name, may_be_tiny=may_be_tiny)
    elif isinstance(value, numbers.Real) and not isinstance(value, bool):
        least, most = next((ends for unit, ends in RANGES.items() if name.endswith(unit)), _NO_UNIT)
        least = 0 if may_be_tiny else least
        if isinstance(value, numbers.Integral):
            least, most = 0, min(most, _MOST_COUNT)
        elif value == 0:
            return
        if value < 0 and name.endswith(UNSIGNED):
            raise ConfigError(f"{what} is {_shown(value)}; give 0 or a positive number")
        size: Any = abs(value)
        if not least <= size <= most:  # NaN, too
            ends = f"{least:g} to {most:g}, or 0" if least else f"at most {most:g}"
            raise ConfigError(f"{what} is {_shown(value)}; its size has to be {ends}")


@lru_cache(maxsize=256)
def _numbered_fields(cls: type) -> tuple[str, ...]:
    """Return the fields of a dataclass that may hold numbers something is computed with."""
    hints = typing.get_type_hints(cls)
    return tuple(item.name for item in dataclasses.fields(cls) if not _is_free(hints[item.name]))


def _dataclasses_in(cls: Any, values: Any) -> list[type]:
    """Return the dataclass that a type hint names for such values, or those of its union."""
    if typing.get_origin(cls) is typing.Annotated:
        return _dataclasses_in(typing.get_args(cls)[0], values)
    if typing.get_origin(cls) in (typing.Union, types.UnionType):
        return [found for part in typing.get_args(cls) for found in _dataclasses_in(part, values)]
    if isinstance(cls, type) and issubclass(cls, Kinded):
        return [cls.class_for(values)]
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
    if not isinstance(kind, str) or kind not in kinds:
        raise ConfigError(f"{source}: {prefix}kind is {_shown(kind)}; give one of {', '.join(map(str, kinds))}")
    return kinds[kind]
