"""A second renderer, for captures that the simulator's own models of a setup do not describe."""

from evnlos.lab.light_path import (
    LitCells,
    Lobe,
    Optics,
    Rays,
    Reflection,
    cast,
    fill_throughput,
    texture,
    tilted,
    waves,
)
from evnlos.lab.room import FilmedLight, Mount, Phone, RenderedWall, Torch, brightness, covered_plane

__all__ = [
    "FilmedLight",
    "LitCells",
    "Lobe",
    "Mount",
    "Optics",
    "Phone",
    "Rays",
    "Reflection",
    "RenderedWall",
    "Torch",
    "brightness",
    "cast",
    "covered_plane",
    "fill_throughput",
    "texture",
    "tilted",
    "waves",
]
