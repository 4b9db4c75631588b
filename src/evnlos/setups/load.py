"""Setups by name, and the one way from a word to a setup.

- Rooms by name: walls, lenses, lamps and sensors that the simulator's models do not describe.
- Named setups: walls of metal and paint at two distances, and those of the simulation's presets.
- The one way from a word to a setup: a name, a settings file, a calibrated folder, or a measured file.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

from evnlos.cameras import PixelMaps, load_pixel, load_pixel_maps
from evnlos.config import from_dict, read_yaml
from evnlos.errors import ConfigError, UnknownNameError
from evnlos.scene import Glyphs
from evnlos.setups.base import CAMERA_FIELDS, SensorSize, Setup, linear_kinds
from evnlos.setups.files import CALIBRATED_FILE, OLDER_FILE, calibrated_file, stated_setup
from evnlos.setups.measured import MeasuredSetup
from evnlos.setups.paper import as_in_the_paper, rough_paper
from evnlos.setups.radiometric import RadiometricSetup
from evnlos.setups.room import RoomSetup
from evnlos.tensor_file import SUFFIX


class Rooms(Mapping[str, RoomSetup]):
    """Rooms by name, of a YAML file that is read when the first is asked for.

    Args:
        file: The file: a mapping of names to settings of `RoomSetup`.
    """

    def __init__(self, file: Path) -> None:
        self.file = file

    @cached_property
    def _stated(self) -> dict[str, Any]:
        return read_yaml(self.file)

    def __getitem__(self, name: str) -> RoomSetup:
        return from_dict(RoomSetup, self._stated[name], source=f"{self.file}: {name}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._stated)

    def __len__(self) -> int:
        return len(self._stated)

    def __contains__(self, name: object) -> bool:
        return name in self._stated


ROOMS = Rooms(Path(__file__).with_name("rooms.yaml"))
"""Rooms by name; each has light, cameras and a geometry of its own."""

NEAR_M, FAR_M = 0.30, 0.50

_WALLS = {
    "mirror": RadiometricSetup(roughness=0.005),
    "easy": RadiometricSetup(roughness=0.02),
    "main": RadiometricSetup(roughness=0.05),
    "hard": RadiometricSetup(roughness=0.1),
    "matte": RadiometricSetup(wall_material="lambert"),
    "aperture": RadiometricSetup(wall_material="lambert", post_width_m=0.016),
}
_DISTANCES = {"near": NEAR_M, "far": FAR_M}


def setup_names() -> list[str]:
    """Return the names of all walls with their distances, e.g. "main-near"."""
    return [f"{name}-{place}" for name in _WALLS for place in _DISTANCES]


def setup_preset(name: str, distance_m: float | None = None) -> RadiometricSetup:
    """Return one of the named walls in its geometry, with default light and cameras.

    Args:
        name: "mirror" (polished, for alignment; sharp to about a cell), "easy", "main" or "hard" (rough
            aluminium of roughness 0.02, 0.05, 0.1), "matte" (a plain white wall, the control on which every
            method must fail), or "aperture" (a white wall and a 16 mm post halfway); with "-near" (0.30 m) or
            "-far" (0.50 m) behind it, or near.
        distance_m: Distance from target to wall, metres, instead of the one that the name says.

    Raises:
        ConfigError: The name is unknown.

    Example:
        >>> setup_preset("hard").roughness, setup_preset("hard-far").distance_m
        (0.1, 0.5)
    """
    wall, _, place = name.partition("-")
    if wall not in _WALLS or (place or "near") not in _DISTANCES:
        near = difflib.get_close_matches(name, setup_names(), n=1)
        hint = f"; perhaps you meant {near[0]!r}" if near else ""
        raise UnknownNameError(
            f"the setup {name!r} is unknown; choose one of {', '.join(_WALLS)} with -near or -far{hint}"
        )
    return replace(_WALLS[wall], distance_m=_DISTANCES[place or "near"] if distance_m is None else distance_m)


def page_setup() -> RadiometricSetup:
    """Return the setup of `evnlos app` as its controls first stand."""
    return RadiometricSetup(cell_m=0.005, ambient=0.05, sensor=SensorSize(30, 48))


NAMED: dict[str, Callable[[], Setup]] = {
    **{name: partial(setup_preset, name) for name in [*_WALLS, *setup_names()]},
    "simulate-default": rough_paper,
    "simulate-page": page_setup,
    **{
        f"simulate-paper{test}": as_in_the_paper
        for test in ("", "-nist-test", "-comic-letters", "-comic-digits")
    },
}
"""Setups by name, beside the rooms: walls with -near or -far, and those of the presets of `evnlos simulate`."""


def _names() -> str:
    return f"a wall ({', '.join(_WALLS)}, with -near or -far), a room ({', '.join(ROOMS)})"


@dataclass(frozen=True)
class _Targets:
    """What of the settings of a simulation says how large its targets are."""

    glyphs: Glyphs


_TOLD_BY_FOLDER = ("setup", "training", "transport", "rig", "lab", "dataset")  # a folder has one of each


def load_setup(word: str | Path) -> Setup:
    """Return the setup that a word stands for; `--setup` of every command takes the same words.

    Args:
        word: A name ("main-near", "matte-far"; "simulate-paper" for the setup of a preset of `simulate`); a
            YAML file with a setup alone, or with the settings of `simulate` or `lab`, or a dataset's
            `dataset.yaml`, or the `lab.yaml` beside synthetic captures (what `vary` would draw stays as
            written); a folder that `evnlos calibrate` wrote; or the .safetensors file of `evnlos scan import`.

    Raises:
        ConfigError: The word is empty or no text, there is no such name and no such file, or the file holds
            no setup.

    Example:
        >>> load_setup("hard-far").distance_m
        0.5
    """
    if not isinstance(word, str | Path) or not str(word).strip():
        raise ConfigError(f"the setup is {word!r}; give {_names()}, a settings file or a folder")
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
        raise UnknownNameError(f"{path} does not exist; give {_names()}, a settings file or a folder")
    return _named(str(word))


def linear_setup(word: str | Path) -> Setup:
    """Return the setup that a word stands for, which has to be linear.

    Args:
        word: As `load_setup` takes it.

    Raises:
        ConfigError: It is of another kind, or there is none.
    """
    setup = load_setup(word)
    if not setup.is_linear:
        raise ConfigError(
            f"{word} holds a setup of kind {setup.kind}, which is not linear; give one of kind "
            f"{' or '.join(linear_kinds())}"
        )
    return setup


def measured_setup(word: str | Path, pixel: str | None = None) -> tuple[Setup, PixelMaps | None]:
    """Return a linear setup, and what was measured of each pixel of its event camera, if anything was.

    Args:
        word: As `load_setup` takes it; measured thresholds lie in its folder.
        pixel: The event pixel instead of the setup's, as `load_pixel` takes it; they lie beside its file.

    Raises:
        ConfigError: As of `linear_setup`, or of `load_pixel`.
        DataError: The file of the thresholds is damaged.
    """
    setup = linear_setup(word)
    if pixel is None:
        return setup, load_pixel_maps(word)
    return replace(setup, pixel=load_pixel(pixel)), load_pixel_maps(pixel)


class NamedSetup(NamedTuple):
    """A setup, what pages and tables call it, how a command line names it, and the side of its targets."""

    setup: Setup
    name: str
    word: str
    target_m: float | None = None
    """As `stated_target_m` of its word, metres."""


def named_setup(word: str | Path) -> NamedSetup:
    """Return `load_setup(word)` with its name, the word for it in a command to repeat, and its targets' side.

    Args:
        word: As for `load_setup`.
    """
    return NamedSetup(load_setup(word), setup_name(word), setup_word(word), stated_target_m(word))


def stated_target_m(word: str | Path) -> float | None:
    """Return the side of the targets that a file states beside its setup, metres.

    Those are the settings of `simulate` and `lab`, of a dataset, and the folder of a calibration.

    Args:
        word: As for `load_setup`.

    Returns:
        None for a name, a scan, and a setup alone.

    Raises:
        ConfigError: The file holds no setup, or no targets can be made of what it states.
    """
    path = calibrated_file(Path(word))
    if path.suffix == SUFFIX or not path.is_file() or (glyphs := stated_setup(path).glyphs) is None:
        return None
    targets = from_dict(_Targets, {"glyphs": glyphs}, source=str(path), folder=path.parent)
    return targets.glyphs.target_plane.size_m


def is_name(word: str | Path) -> bool:
    """Return whether a word is the name of a setup: wall, geometry and light, with default cameras."""
    return (str(word) in NAMED or str(word) in ROOMS) and not Path(word).exists()


def lit_setup(word: str | Path) -> Setup:
    """Return `load_setup(word)` where it states the light and the cameras of a recording.

    Args:
        word: As for `load_setup`.

    Raises:
        ConfigError: As for `load_setup`, or the word names a wall, whose light and cameras are defaults.
    """
    setup = load_setup(word)
    if is_name(word) and not setup.is_lit:
        raise ConfigError(
            f"--setup {word} states neither the light nor the cameras of a recording; give the folder that "
            f"`calibrate` wrote for this very setup, a settings file, a room ({', '.join(ROOMS)}), or none"
        )
    return setup


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
    if path.name in (CALIBRATED_FILE, OLDER_FILE):
        return folder
    return f"{folder}/{path.name}" if path.stem in _TOLD_BY_FOLDER else path.name


def _named(name: str) -> Setup:
    if name in NAMED:
        return NAMED[name]()
    if name in ROOMS:
        return ROOMS[name]
    near = difflib.get_close_matches(name, [*NAMED, *ROOMS], n=1)
    hint = f"; perhaps you meant {near[0]!r}" if near else ""
    if name.startswith("simulate-"):
        presets = ", ".join(one for one in NAMED if one.startswith("simulate-"))
        raise UnknownNameError(f"simulate has no preset {name[9:]!r}; give one of {presets}{hint}")
    raise UnknownNameError(f"the setup {name!r} is unknown; give {_names()}, a settings file or a folder{hint}")


def _in_file(path: Path) -> Setup:
    values, drawn, _ = stated_setup(path)
    # A lab's sensor is drawn once; what was drawn stands beside the ranges.
    values = {**values, **{name: drawn[name] for name in CAMERA_FIELDS if name in drawn}}
    return from_dict(Setup, values, source=str(path), folder=path.parent)  # type: ignore[type-abstract] - its kind is concrete
