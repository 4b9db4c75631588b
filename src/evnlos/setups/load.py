"""Setups by name, and the one way from a word to a setup.

- Rooms by name: walls, lenses, lamps and sensors that the simulator's models do not describe.
- Named setups: walls of metal and paint at two distances, and those of the simulation's presets.
- The one way from a word to a setup: a name, a settings file, a calibrated folder, or a measured file.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from evnlos.cameras import (
    BrownianPixel,
    CelexCamera,
    CelexPixel,
    CircuitPixel,
    EventPixel,
    FrameCamera,
    ReadoutPixel,
    V2ePixel,
)
from evnlos.config import from_dict
from evnlos.errors import ConfigError, UnknownNameError
from evnlos.lab import Lobe, Mount, Reflection, Torch
from evnlos.setups.base import CAMERA_FIELDS, SensorSize, Setup
from evnlos.setups.files import CALIBRATED_FILE, OLDER_FILE, calibrated_file, stated_setup
from evnlos.setups.measured import MeasuredSetup
from evnlos.setups.paper import as_in_the_paper, rough_paper
from evnlos.setups.radiometric import RadiometricSetup
from evnlos.setups.room import RoomSetup
from evnlos.tensor_file import SUFFIX

_PLACE = ("distance_m", "camera_distance_m", "camera_angle_deg", "field_of_view_deg")
_TEXTURE = ("texture_smooth", "texture_fine", "texture_seed")


def _set(names: tuple[str, ...], *values: float) -> dict[str, Any]:
    """Return settings by their names."""
    return dict(zip(names, values, strict=True))


TWO_LOBES = RoomSetup(
    reflection=Reflection((Lobe("ggx", 0.6, 0.05, 0.05), Lobe("ggx", 0.4, 0.07, 0.15)), matte=0.02),
    **_set(_TEXTURE, 0.045, 0.04, 11),
    vignetting=0.15,
    aperture_m=0.012,
    focus_m=0.47,
    frame_camera=FrameCamera(0.016, 9000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=11),
    pixel=BrownianPixel(0.18, 0.18, 0.007, 10.0, 0.05, 0.003, 0.036, 0.0036, pattern_seed=11),
)
"""A round lobe and one that is wider along y; 6 % of texture; a lens out of focus that darkens the corners."""

ONE_SIDED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.05, 0.05),), matte=0.0),
    ambient=0.05,
    ambient_gradient=(0.1, 0.1),
    frame_camera=FrameCamera(0.016, 10_000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=12),
    pixel=EventPixel(0.12, 1.4, 0.007, 40.0, 0.15, 0.02, 2e-3, pattern_seed=12, logarithm="true", dark_dn=1.0),
    **_set(_PLACE, 0.28, 0.55, 33.0, 32.0),
)
"""Plain aluminium; a sensor of which about 95 % of the events are ON."""

CURVED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.06, 0.06),), matte=0.05),
    **_set(_TEXTURE, 0.05, 0.05, 13),
    curvature=(0.9, 0.5),
    vignetting=0.08,
    mount=Mount(0.04),
    ripple=0.04,
    ambient=0.08,
    frame_camera=FrameCamera(0.020, 7000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=13),
    pixel=EventPixel(
        0.18, 0.20, 0.01, 70.0, 0.08, 0.1, 5e-4, 3e-4, pattern_seed=13, logarithm="true", dark_dn=0.4
    ),
    **_set(_PLACE, 0.33, 0.65, 26.0, 28.0),
)
"""A wall that bulges (radii of 1.1 and 2 m), with 7 % of texture; the mount shines; lamps ripple at 100 Hz."""

BRUSHED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.035, 0.11, turn_deg=12.0),), matte=0.03),
    **_set(_TEXTURE, 0.02, 0.05, 14),
    grain=8.0,
    distortion=(-0.05, 0.012),
    camera_roll_deg=1.5,
    camera_elevation_deg=4.0,
    frame_camera=FrameCamera(0.010, 12_000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=14),
    pixel=EventPixel(0.22, 0.19, 0.01, 120.0, 0.1, 0.1, 5e-4, pattern_seed=14, logarithm="true", dark_dn=0.5),
    **_set(_PLACE, 0.35, 0.55, 24.0, 35.0),
)
"""Brushed metal, not along the camera's axes, seen from above by a turned camera whose lens distorts."""

STREAKS = RoomSetup(
    reflection=Reflection(
        (
            Lobe("streak", 0.35, 0.09, 0.018, turn_deg=20.0),
            Lobe("streak", 0.25, 0.07, 0.018, turn_deg=-65.0),
            Lobe("ring", 0.25, 0.09, 0.07, shift=(0.01, -0.015)),
            Lobe("beckmann", 0.15, 0.04, 0.04),
        ),
        matte=0.02,
    ),
    **_set(_TEXTURE, 0.03, 0.04, 15),
    vignetting=0.1,
    frame_camera=FrameCamera(0.016, 8000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=15),
    pixel=BrownianPixel(0.20, 0.20, 0.01, 8.0, 0.08, 0.002, 0.04, 0.004, pattern_seed=15),
    **_set(_PLACE, 0.26, 0.70, 38.0, 25.0),
)
"""A reflection of two crossed streaks, a ring that is off its middle, and a core: no ellipse."""

TORCH = RoomSetup(
    reflection=Reflection((Lobe("beckmann", 0.7, 0.07, 0.07), Lobe("ggx", 0.3, 0.03, 0.03)), matte=0.06),
    **_set(_TEXTURE, 0.03, 0.03, 16),
    vignetting=0.12,
    mount=Mount(0.03),
    lamp=Torch((0.06, 0.09, 0.22), 0.012, 0.02, holder_m=(0.02, 0.058, 0.27, 0.009), spill=0.04),
    frame_camera=FrameCamera(0.016, 9000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=16),
    pixel=EventPixel(0.20, 0.24, 0.01, 50.0, 0.15, 0.1, 5e-4, pattern_seed=16, logarithm="true", dark_dn=0.5),
    **_set(_PLACE, 0.40, 0.6, 22.0, 30.0),
)
"""A satin wall and a target that a torch lights, whose body and holder cast shadows."""

CIRCUIT = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.05, 0.05),), matte=0.02),
    frame_camera=FrameCamera(0.020, 6000.0, 14.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=17),
    pixel=CircuitPixel(0.19, 0.23, 0.012, 1e-15, follower_a=2.5e-12, leak_rate_hz=0.1, pattern_seed=17),
    **_set(_PLACE, 0.31, 0.58, 28.0, 31.0),
)
"""Plain aluminium in dim light; a circuit whose pixels are slow there, and whose noise comes in pairs."""

STEPPED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.055, 0.055),), matte=0.02),
    frame_camera=FrameCamera(0.014, 10_000.0, 10.0, prnu=0.015, dsnu_e=8.0, black_level=4.0, pattern_seed=18),
    pixel=V2ePixel(0.20, 0.24, 0.03, 40.0, 0.1, 1.0, 5e-4, pattern_seed=18),
    time_step_s=0.005,
    **_set(_PLACE, 0.29, 0.62, 32.0, 29.0),
)
"""Plain aluminium; v2e's pixel, stepped every 5 ms with the noise of its parameter set for dim scenes."""

SLOW_BUS = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.045, 0.045),), matte=0.02),
    frame_camera=FrameCamera(0.016, 9000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=19),
    pixel=ReadoutPixel(
        EventPixel(0.15, 0.17, 0.01, 90.0, 0.1, 0.1, 5e-4, pattern_seed=19, logarithm="true", dark_dn=0.5),
        *("row", 2e-4, 2e-5),
        tick_s=1e-4,
        jitter_s=2e-4,
        hot_pixel_fraction=2e-3,
        hot_pixel_rate_hz=20.0,
        dead_pixel_fraction=5e-3,
        pattern_seed=19,
    ),
    **_set(_PLACE, 0.32, 0.60, 31.0, 30.0),
)
"""Plain aluminium; a row arbiter near its limit, which delays and loses events; hot and dead pixels."""

CELEX = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.05, 0.05),), matte=0.02),
    frame_camera=FrameCamera(0.010, 8000.0, 14.0, prnu=0.02, dsnu_e=15.0, black_level=4.0, pattern_seed=20),
    pixel=CelexPixel(CelexCamera(codes_per_efold=300.0)),
)
"""Plain aluminium; a CeleX-V whose software reads one polarity in fifty wrong from its noisy values."""

WORN = RoomSetup(
    reflection=Reflection(
        (Lobe("ggx", 0.6, 0.035, 0.08, turn_deg=-15.0), Lobe("beckmann", 0.4, 0.11, 0.11)), matte=0.04
    ),
    **_set(_TEXTURE, 0.05, 0.06, 21),
    grain=5.0,
    curvature=(-0.4, 0.8),
    distortion=(-0.03, 0.008),
    aperture_m=0.010,
    focus_m=0.52,
    vignetting=0.12,
    frame_camera=FrameCamera(0.020, 7000.0, 14.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=21),
    pixel=CircuitPixel(0.18, 0.20, 0.012, 2e-15, follower_a=2.5e-12, leak_rate_hz=0.15, pattern_seed=21),
    **_set(_PLACE, 0.31, 0.62, 27.0, 31.0),
)
"""Wall and sensor both: a scratched, bent plate of two lobes, 8 % of texture, a poor lens; a slow circuit."""

WORKSHOP = RoomSetup(
    reflection=Reflection((Lobe("ggx", 0.7, 0.045, 0.09), Lobe("ggx", 0.3, 0.1, 0.05)), matte=0.05),
    **_set(_TEXTURE, 0.04, 0.04, 22),
    curvature=(0.6, -0.3),
    vignetting=0.1,
    mount=Mount(0.03),
    lamp=Torch((0.05, 0.08, 0.21), 0.012, 0.02, holder_m=(0.02, 0.055, 0.26, 0.009), spill=0.04),
    ripple=0.03,
    frame_camera=FrameCamera(0.020, 8000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=22),
    pixel=ReadoutPixel(
        BrownianPixel(0.17, 0.2, 0.01, 6.0, 0.1, 0.004, 0.036, 0.004, pattern_seed=22),
        *("row", 1e-4, 1e-5),
        jitter_s=2e-4,
        hot_pixel_fraction=1e-3,
        hot_pixel_rate_hz=20.0,
        pattern_seed=22,
    ),
    **_set(_PLACE, 0.38, 0.60, 25.0, 29.0),
)
"""Wall and sensor both: a torch, a shining mount, rippling lamps, a bent wall; Brownian pixels, a slow bus."""

ROOMS = {
    "two-lobes": TWO_LOBES,
    "one-sided": ONE_SIDED,
    "curved": CURVED,
    "brushed": BRUSHED,
    "streaks": STREAKS,
    "torch": TORCH,
    "circuit": CIRCUIT,
    "stepped": STEPPED,
    "slow-bus": SLOW_BUS,
    "celex": CELEX,
    "worn": WORN,
    "workshop": WORKSHOP,
}
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
    **{name: partial(ROOMS.__getitem__, name) for name in ROOMS},
    "simulate-default": rough_paper,
    "simulate-page": page_setup,
    **{
        f"simulate-paper{test}": as_in_the_paper
        for test in ("", "-nist-test", "-comic-letters", "-comic-digits")
    },
}
"""Setups by name: walls with -near or -far, rooms, and the setups of the presets of `evnlos simulate`."""
_NAMES = f"a wall ({', '.join(_WALLS)}, with -near or -far), a room ({', '.join(ROOMS)})"


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
        raise ConfigError(f"the setup is {word!r}; give {_NAMES}, a settings file or a folder")
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
        raise UnknownNameError(f"{path} does not exist; give {_NAMES}, a settings file or a folder")
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
    near = difflib.get_close_matches(name, NAMED, n=1)
    hint = f"; perhaps you meant {near[0]!r}" if near else ""
    if name.startswith("simulate-"):
        presets = ", ".join(one for one in NAMED if one.startswith("simulate-"))
        raise UnknownNameError(f"simulate has no preset {name[9:]!r}; give one of {presets}{hint}")
    raise UnknownNameError(f"the setup {name!r} is unknown; give {_NAMES}, a settings file or a folder{hint}")


def _in_file(path: Path) -> Setup:
    values, drawn = stated_setup(path)
    # A lab's sensor is drawn once; what was drawn stands beside the ranges.
    values = {**values, **{name: drawn[name] for name in CAMERA_FIELDS if name in drawn}}
    return from_dict(Setup, values, source=str(path), folder=path.parent)  # type: ignore[type-abstract] - its kind is concrete
