"""Variation from object to object: settings drawn from ranges, so that no network learns one rig by heart."""

from __future__ import annotations

import dataclasses
import difflib
import math
from typing import Any, TypeVar

import numpy as np

from evnlos.errors import ConfigError
from evnlos.seeds import derive_seed
from evnlos.setups.base import is_camera

T = TypeVar("T")
Ranges = dict[str, tuple[float, float]]


def varied(config: T, ranges: Ranges, seed: int, name: str) -> T:
    """Return `config` with the named settings drawn uniformly from their ranges, for one object.

    Args:
        config: A nested frozen dataclass.
        ranges: Dotted name of a number (`setup.pixel.threshold_on`; `setup.offset_m.0` for the first entry of a
            tuple) -> (low, high), in the setting's own unit.
        seed: The run's seed.
        name: The object's name; the same seed and name draw the same settings.

    Raises:
        ConfigError: A name is unknown (the nearest is named) or is not a number.
    """
    for path, (low, high) in ranges.items():
        draw = np.random.default_rng(derive_seed(seed, name, "vary", _seed_word(path))).uniform(low, high)
        config = _replaced(config, path.split("."), float(draw), path)
    return config


def check_ranges(config: object, ranges: Ranges) -> None:
    """Try both ends of every range, so that a wrong name or value is an error at once.

    Raises:
        ConfigError: As for `varied`, or a value that the setting itself refuses.
    """
    for path, (low, high) in ranges.items():
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise ConfigError(f"vary.{path} is ({low}, {high}); give two ascending finite numbers")
        first, *rest = path.split(".")
        names = [f.name for f in dataclasses.fields(config)]  # type: ignore[arg-type]
        if first not in names:
            raise _unknown(path, first, names)
        for value in (low, high):
            _replaced(getattr(config, first), rest, value, path)


def _seed_word(path: str) -> str:
    """Return the word that a setting's draw is seeded with: it stays when settings move, and so do datasets."""
    section, _, rest = path.partition(".")
    if section != "setup":
        return path
    return rest if is_camera(rest) else f"transport.{rest}"


def _unknown(path: str, key: str, names: list[str]) -> ConfigError:
    near = difflib.get_close_matches(key, names, n=1)
    cure = f"perhaps you meant {near[0]!r}" if near else f"known here: {', '.join(names) or 'nothing'}"
    return ConfigError(f"vary.{path}: unknown setting {key!r}; {cure}")


def _replaced(node: Any, keys: list[str], value: float, path: str) -> Any:
    if not keys:
        if isinstance(node, bool) or not isinstance(node, (int, float)):
            raise ConfigError(f"vary.{path} names {node!r}, which is no number; name a number")
        return value
    key, rest = keys[0], keys[1:]
    if isinstance(node, tuple) and key.isdigit() and int(key) < len(node):
        i = int(key)
        return (*node[:i], _replaced(node[i], rest, value, path), *node[i + 1 :])
    if not dataclasses.is_dataclass(node) or isinstance(node, type):
        raise _unknown(path, key, [])
    names = [field.name for field in dataclasses.fields(node)]
    if key not in names:
        raise _unknown(path, key, names)
    return dataclasses.replace(node, **{key: _replaced(getattr(node, key), rest, value, path)})
