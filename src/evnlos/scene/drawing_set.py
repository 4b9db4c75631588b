"""Drawings as a set of objects: what a network that learned characters has never seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from evnlos.errors import ConfigError
from evnlos.scene.drawings import KINDS, drawing
from evnlos.scene.glyph_sets import EmnistGlyphs, FontGlyphs, HandwritingGlyphs, NistGlyphs, ObjectId, Plate
from evnlos.scene.target import Target


@dataclass(frozen=True)
class DrawingGlyphs:
    """Icons, people, vehicles, doodles, several things at once, and things in grey levels (see `drawing`).

    Args:
        kind: Names this kind of set in a settings file.
        kinds: Kinds of drawings.
        each: Number of objects of each kind.
        first: Number of the first object of each kind.
        plate: The plate that carries a drawing; its fractions are for characters only.
    """

    kind: Literal["drawings"] = "drawings"
    kinds: tuple[str, ...] = KINDS
    each: int = 12
    first: int = 0
    plate: Plate = field(default_factory=Plate)

    def __post_init__(self) -> None:
        unknown = [kind for kind in self.kinds if kind not in KINDS]
        if unknown or not self.kinds:
            raise ConfigError(f"kinds of drawings are {self.kinds}; give some of {', '.join(KINDS)}")
        if self.each < 1 or self.first < 0:
            raise ConfigError(f"drawings {self.first} + {self.each}; give 1 of each kind or more, from 0 on")

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects, kind by kind, e.g. "person_003"."""
        return [f"{kind}_{self.first + k:03d}" for kind in self.kinds for k in range(self.each)]

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return one drawing; the seed fixes the population."""
        kind, _, number = object_id.rpartition("_")
        if kind not in self.kinds or not number.isdecimal():
            raise ConfigError(f"object {object_id!r} is none of these drawings; give one of objects()")
        return Target(object_id, drawing(kind, int(number), seed, self.plate.size_px), self.plate.size_m)

    def notes(self) -> list[str]:
        """Return nothing: no font stands in for another."""
        return []


Glyphs: TypeAlias = HandwritingGlyphs | FontGlyphs | NistGlyphs | EmnistGlyphs | DrawingGlyphs
"""All kinds of sets, told apart by `kind` in a settings file."""
