"""The one way from a word to a setup: a name, a settings file, a calibrated folder, or a measured file."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from evnlos.config import from_dict, read_yaml
from evnlos.errors import ConfigError
from evnlos.migrate import migrate
from evnlos.setups.base import CAMERA_FIELDS, SensorSize, Setup
from evnlos.setups.measured import MeasuredSetup
from evnlos.setups.presets import NAMED, setup_names, setup_preset
from evnlos.tensor_file import SUFFIX

CALIBRATED_FILE = "rig.yaml"
"""The simulation that `evnlos calibrate` fits, in its folder."""
_TOLD_BY_FOLDER = ("rig", "lab", "dataset")  # files that are told apart by their folder


def load_setup(word: str | Path) -> Setup:
    """Return the setup that a word stands for; `--setup` of every command takes the same words.

    Args:
        word: A name ("main-near", "matte-far"; "simulate-paper" for the setup of a preset of `simulate`); a
            YAML file with a setup alone, or with the settings of `simulate` or `lab`, or a dataset's
            `dataset.yaml`, or the `lab.yaml` beside synthetic captures (what `vary` would draw stays as
            written); a folder that `evnlos calibrate` wrote; or the .safetensors file of `evnlos scan import`.

    Raises:
        ConfigError: There is no such name and no such file, or the file holds no setup.

    Example:
        >>> load_setup("hard-far").distance_m
        0.5
    """
    path = calibrated_file(Path(word))
    if path.suffix == SUFFIX:
        measured = MeasuredSetup(file=str(path))
        return replace(measured, sensor=SensorSize(*measured.measurement().shape))
    if path.is_file():
        return _in_file(path)
    if path.is_dir():
        raise ConfigError(
            f"{word} holds no {CALIBRATED_FILE}; give the folder that `calibrate` wrote, a file or a name"
        )
    if path.suffix in (".yaml", ".yml"):
        raise ConfigError(f"{path} does not exist; give a settings file or one of {', '.join(setup_names())}")
    return _named(str(word))


class NamedSetup(NamedTuple):
    """A setup, what pages and tables call it, and how a command line names it."""

    setup: Setup
    name: str
    word: str


def named_setup(word: str | Path) -> NamedSetup:
    """Return `load_setup(word)` with its name and with the word that stands for it in a command to repeat.

    Args:
        word: As for `load_setup`.
    """
    return NamedSetup(load_setup(word), setup_name(word), setup_word(word))


def is_name(word: str | Path) -> bool:
    """Return whether a word is the name of a setup: wall, geometry and light, with default cameras."""
    return str(word) in NAMED and not Path(word).exists()


def calibrated_file(path: Path) -> Path:
    """Return the settings file of a folder that `calibrate` wrote; any other path stays as it is.

    Example:
        >>> str(calibrated_file(Path("rig.yaml")))
        'rig.yaml'
    """
    return path / CALIBRATED_FILE if (path / CALIBRATED_FILE).is_file() else path


def calibrated_folder(word: str | Path) -> Path:
    """Return the folder that `calibrate` wrote, named by itself or by the settings file in it.

    Raises:
        ConfigError: The word names no such folder.
    """
    path = Path(word)
    folder = path.parent if path.name == CALIBRATED_FILE else path
    if not (folder / CALIBRATED_FILE).is_file():
        raise ConfigError(
            f"--setup is {word}, which holds no {CALIBRATED_FILE}; give the folder that `calibrate` wrote for "
            "this very setup (a name such as main-near knows neither its light nor its cameras), or none"
        )
    return folder


def setup_name(word: str | Path) -> str:
    """Return what a page or a table calls the setup of a word: its name, or that of its folder or file."""
    path = calibrated_file(Path(word))
    if not path.is_file():
        return str(word)
    return path.resolve().parent.name if path.stem in _TOLD_BY_FOLDER else path.stem


def setup_word(word: str | Path) -> str:
    """Return how a setup is named on a command line, without the folders above it."""
    path = calibrated_file(Path(word))
    if not path.is_file():
        return str(word)
    folder = path.resolve().parent.name
    if path.name == CALIBRATED_FILE:
        return folder
    return f"{folder}/{path.name}" if path.stem in _TOLD_BY_FOLDER else path.name


def _named(name: str) -> Setup:
    if name in NAMED:
        return NAMED[name]()
    if name.startswith("simulate-"):
        presets = [one for one in NAMED if one.startswith("simulate-")]
        near = difflib.get_close_matches(name, presets, n=1)
        hint = f"; perhaps you meant {near[0]!r}" if near else ""
        raise ConfigError(f"simulate has no preset {name[9:]!r}; give one of {', '.join(presets)}{hint}")
    return setup_preset(name)  # which refuses it


def _in_file(path: Path) -> Setup:
    values = read_yaml(path)
    drawn: Mapping[str, Any] = {}
    if isinstance(values.get("lab"), dict):
        known = values.get("drawn")
        drawn = known if isinstance(known, dict) else {}
        values = values["lab"]
    elif isinstance(values.get("config"), dict):
        values = values["config"]
    if "kind" not in values:
        values = migrate("Simulation", values)
        if "setup" not in values:
            near = difflib.get_close_matches("setup", [str(key) for key in values], n=1)
            hint = f"; perhaps {near[0]!r} is meant to be it" if near else ""
            raise ConfigError(
                f"{path} has no `setup`; give settings of `evnlos simulate` or `evnlos lab`, or a setup{hint}"
            )
        values = values["setup"]
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: setup is {values!r}; give a mapping with the kind of the setup")
    # A lab's sensor is drawn once; what was drawn stands beside the ranges.
    values = {**values, **{name: drawn[name] for name in CAMERA_FIELDS if name in drawn}}
    return from_dict(Setup, values, source=str(path))  # type: ignore[type-abstract] - its kind is concrete
