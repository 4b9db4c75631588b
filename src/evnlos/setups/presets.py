"""Named setups: walls of metal and paint at two distances, and those of the simulation's presets."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from evnlos.errors import ConfigError
from evnlos.sensor import EventPixel
from evnlos.setups.base import SensorSize, Setup
from evnlos.setups.paper import PaperSetup
from evnlos.setups.radiometric import RadiometricSetup
from evnlos.setups.rooms import ROOMS

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
        raise ConfigError(
            f"the setup {name!r} is unknown; choose one of {', '.join(_WALLS)} with -near or -far{hint}"
        )
    return replace(_WALLS[wall], distance_m=_DISTANCES[place or "near"] if distance_m is None else distance_m)


def rough_paper() -> PaperSetup:
    """Return the paper's wall around a target 0.3 m and a camera 0.6 m from it: what `default` varies."""
    return PaperSetup(field_of_view_m=0.585, tpsf_length_m=0.02)


def as_in_the_paper() -> PaperSetup:
    """Return the paper's simulated setup: 0.5 m, 500 nm, 960 x 600 pixels."""
    return PaperSetup(
        distance_m=0.5,
        wavelength_m=500e-9,
        tpsf_t=2.0,
        mean_free_path=0.8,
        rho_max=2.0,
        sensor=SensorSize(600, 960),
        pixel=EventPixel(0.15, 0.15, 0.03, 15.0, 0.01, 0.0015, 0.0),
    )


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
