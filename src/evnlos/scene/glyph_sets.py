"""Which objects a data set is made of: settings that list objects by name and make the target of each."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evnlos.config import BESIDE
from evnlos.errors import ConfigError
from evnlos.scene.databases import (
    ObjectId,
    TargetPlane,
    list_emnist,
    list_pictures,
    list_sd19,
    look_up,
    read_emnist_images,
    read_picture,
    read_sd19_image,
)
from evnlos.scene.drawings import KINDS, drawing
from evnlos.scene.fonts import (
    DIGITS,
    FONT_SUFFIXES,
    UPPER_CASE,
    Font,
    character_name,
    find_font,
    fit_to_target_plane,
    render_glyph,
)
from evnlos.scene.handwriting import Strokes, nist_like, redrawn
from evnlos.scene.moving import LineMotion, Scene, SeveralTargets, Target
from evnlos.untrusted import open_image


class GlyphSet(Protocol):
    """Anything that lists objects and makes their targets."""

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects; cheap, nothing is drawn."""
        ...

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return the target of one object; it depends on the settings, the name and the seed only."""
        ...

    def notes(self) -> list[str]:
        """Return lines that the user should see, e.g. which font stands in for which."""
        ...


@dataclass(frozen=True)
class HandwritingGlyphs:
    """NIST-like handwriting: the stand-in that needs no data (see `nist_like`).

    Args:
        kind: Names this kind of set in a settings file.
        writers: Number of writers.
        first_writer: Number of the first writer; 39 and above are held out for testing.
        characters: Characters that each writer writes.
        strokes: Base faces and pens.
        target_plane: The target plane that carries a character.
        centre: Middle of the writers' ink (x to the right, y downwards), parts of the target plane's side.
        known: Folder with images of known targets of this target's size, NAME.png; "" = none.
        redrawn: How often each known target is drawn again, as by another hand (see `redrawn`); these objects
            come after those of the writers.
    """

    kind: Literal["nist-like"] = "nist-like"
    writers: int = 39
    first_writer: int = 0
    characters: str = UPPER_CASE
    strokes: Strokes = field(default_factory=Strokes)
    target_plane: TargetPlane = field(default_factory=TargetPlane)
    centre: tuple[float, float] = (0.0, 0.0)
    known: str = field(default="", metadata=BESIDE)
    redrawn: int = 0

    def __post_init__(self) -> None:
        _check_characters(self.characters)
        if self.redrawn < 0 or (self.redrawn and not self.known):
            raise ConfigError(f"redrawn is {self.redrawn}; give 0, or a number and a folder of `known` targets")
        if self.writers < 1 or self.first_writer < 0:
            raise ConfigError(f"writers {self.first_writer} + {self.writers}; give 1 writer or more, from 0 on")
        if not all(abs(one) < 0.5 for one in self.centre):
            raise ConfigError(f"centre is {self.centre}; give two parts of the side, each within +-0.5")

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects, writer by writer, e.g. "writer03_A", then e.g. "redrawn03_A"."""
        known = _known_targets(self.known) if self.redrawn else {}
        again = [f"redrawn{k:02d}_{name}" for k in range(self.redrawn) for name in known]
        return [*_handwriting_index(self), *again]

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return one writer's character; the seed fixes the population of writers."""
        hand, _, name = object_id.partition("_")
        if self.redrawn and hand.startswith("redrawn"):
            drawing = look_up(_known_targets(self.known), name)
            return Target(object_id, redrawn(drawing, name, int(hand[7:]), seed), self.target_plane.size_m)
        writer, char = look_up(_handwriting_index(self), object_id)
        plane = self.target_plane
        mask = nist_like(writer, char, seed, plane.size_px, plane.fraction(char), self.strokes, self.centre)
        return Target(object_id, mask, self.target_plane.size_m)

    def notes(self) -> list[str]:
        """Return a line that says what stands in for NIST's handwriting."""
        return ["handwriting is NIST-like: drawn from open fonts, not NIST Special Database 19"]


@dataclass(frozen=True)
class FontGlyphs:
    """Characters of one font.

    Args:
        kind: Names this kind of set in a settings file.
        family: Family with optional weight and slant, or a font file.
        characters: Characters to draw.
        target_plane: The target plane that carries a character.
    """

    kind: Literal["font"] = "font"
    family: str = "Comic Neue Bold"
    characters: str = UPPER_CASE + DIGITS
    target_plane: TargetPlane = field(default_factory=TargetPlane)

    def __post_init__(self) -> None:
        _check_characters(self.characters)

    def font(self) -> Font:
        """Return the face that draws the characters; its `note` tells whether it stands in for another."""
        return find_font(self.family)

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects, e.g. "comic_neue_bold_A"."""
        return list(_font_index(self))

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return one character; the seed has no part in it."""
        char = look_up(_font_index(self), object_id)
        mask = render_glyph(char, self.font(), self.target_plane.size_px, self.target_plane.fraction(char))
        return Target(object_id, mask, self.target_plane.size_m)

    def notes(self) -> list[str]:
        """Return a line for the user where another font stands in for this one."""
        note = self.font().note
        return [note] if note else []


class _AsNamed:
    """Sets whose images are what their names say."""

    def notes(self) -> list[str]:
        """Return nothing: nothing stands in for another."""
        return []


class _Copied(_AsNamed):
    """Characters of the user's copy of a database, cut to their ink."""

    characters: str
    first: int
    per_character: int
    target_plane: TargetPlane

    def __post_init__(self) -> None:
        _check_characters(self.characters)
        if self.first < 0 or self.per_character < 1:
            raise ConfigError(
                f"first is {self.first}, per_character {self.per_character}; give 0 or more and 1 or more"
            )

    def _fitted(self, object_id: ObjectId, char: str, image: NDArray) -> Target:
        plane = self.target_plane
        mask = fit_to_target_plane(image, plane.size_px, plane.fraction(char))
        return Target(object_id, mask, plane.size_m)


@dataclass(frozen=True)
class NistGlyphs(_Copied):
    """Characters of the user's own copy of NIST Special Database 19.

    Args:
        kind: Names this kind of set in a settings file.
        folder: The folder `by_class` of the copy, or the one that holds it.
        characters: Characters to take.
        partition: Group of writers: hsf_0 to hsf_8, or train; hsf_4 is NIST's own choice for testing.
        first: Number of images of each character to pass over.
        per_character: Number of images of each character to take.
        target_plane: The target plane that carries a character.
    """

    kind: Literal["nist-sd19"] = "nist-sd19"
    folder: str = "by_class"
    characters: str = UPPER_CASE
    partition: str = "hsf_0"
    first: int = 0
    per_character: int = 39
    target_plane: TargetPlane = field(default_factory=TargetPlane)

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects, e.g. "nist_hsf_0_00012_A"."""
        return list(_nist_index(self))

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return one scanned character, cut to its ink and centred; the seed has no part in it."""
        char, path = look_up(_nist_index(self), object_id)
        return self._fitted(object_id, char, read_sd19_image(path))


@dataclass(frozen=True)
class EmnistGlyphs(_Copied):
    """Characters of the user's own copy of EMNIST.

    Args:
        kind: Names this kind of set in a settings file.
        folder: Folder with the official gzip files.
        characters: Characters to take.
        subset: Subset of EMNIST: byclass, bymerge, balanced, letters or digits.
        part: Part of the subset: train or test.
        first: Number of images of each character to pass over.
        per_character: Number of images of each character to take.
        target_plane: The target plane that carries a character.
    """

    kind: Literal["emnist"] = "emnist"
    folder: str = "emnist"
    characters: str = UPPER_CASE
    subset: Literal["byclass", "bymerge", "balanced", "letters", "digits"] = "byclass"
    part: Literal["train", "test"] = "train"
    first: int = 0
    per_character: int = 39
    target_plane: TargetPlane = field(default_factory=TargetPlane)

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects, e.g. "emnist_byclass_train_000123_A"."""
        return list(_emnist_index(self))

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return one character, cut to its ink, enlarged and centred; the seed has no part in it."""
        char, number = look_up(_emnist_index(self), object_id)
        return self._fitted(object_id, char, _emnist_images(self)[number])


@lru_cache(maxsize=16)
def _handwriting_index(glyphs: HandwritingGlyphs) -> dict[ObjectId, tuple[int, str]]:
    writers = range(glyphs.first_writer, glyphs.first_writer + glyphs.writers)
    return {f"writer{w:02d}_{character_name(c)}": (w, c) for w in writers for c in glyphs.characters}


@lru_cache(maxsize=4)
def _known_targets(folder: str) -> dict[str, NDArray[np.float32]]:
    found = {}
    for path in sorted(Path(folder).glob("*.png")):
        try:
            with open_image(path) as image:
                found[path.stem] = np.asarray(image.convert("L"), np.float32) / 255
        except OSError as error:
            raise ConfigError(f"{path}: {error}; give images of known targets") from None
    if not found:
        raise ConfigError(f"{folder} holds no images NAME.png of known targets; name the folder that does")
    return found


@lru_cache(maxsize=16)
def _font_index(glyphs: FontGlyphs) -> dict[ObjectId, str]:
    is_file = glyphs.family.lower().endswith(FONT_SUFFIXES)
    slug = re.sub(r"[^a-z0-9]+", "_", (Path(glyphs.family).stem if is_file else glyphs.family).lower()).strip(
        "_"
    )
    return {f"{slug or 'font'}_{character_name(c)}": c for c in glyphs.characters}


@lru_cache(maxsize=16)
def _nist_index(glyphs: NistGlyphs) -> dict[ObjectId, tuple[str, Path]]:
    listed = list_sd19(glyphs.folder, glyphs.characters, glyphs.partition, glyphs.first, glyphs.per_character)
    return {f"nist_{source}_{character_name(char)}": (char, path) for char, source, path in listed}


@lru_cache(maxsize=16)
def _emnist_index(glyphs: EmnistGlyphs) -> dict[ObjectId, tuple[str, int]]:
    listed = list_emnist(
        glyphs.folder, glyphs.characters, glyphs.subset, glyphs.part, glyphs.first, glyphs.per_character
    )
    stem = f"emnist_{glyphs.subset}_{glyphs.part}"
    return {f"{stem}_{number:06d}_{character_name(char)}": (char, number) for char, number in listed}


@lru_cache(maxsize=2)
def _emnist_images(glyphs: EmnistGlyphs) -> dict[int, NDArray[np.float32]]:
    # A gzip file has no random access: one pass takes all images of the set, 3 kB each.
    numbers = [number for _, number in _emnist_index(glyphs).values()]
    return dict(read_emnist_images(glyphs.folder, numbers, glyphs.subset, glyphs.part))


def _check_characters(characters: str) -> None:
    if not characters or len(set(characters)) < len(characters) or any(c.isspace() for c in characters):
        raise ConfigError(f"characters is {characters!r}; give each character once, and no spaces")


@dataclass(frozen=True)
class DrawingGlyphs(_AsNamed):
    """Icons, people, vehicles, doodles, several things at once, and things in grey levels (see `drawing`).

    Args:
        kind: Names this kind of set in a settings file.
        kinds: Kinds of drawings.
        each: Number of objects of each kind.
        first: Number of the first object of each kind.
        target_plane: The target plane that carries a drawing; its fractions are for characters only.
    """

    kind: Literal["drawings"] = "drawings"
    kinds: tuple[str, ...] = KINDS
    each: int = 12
    first: int = 0
    target_plane: TargetPlane = field(default_factory=TargetPlane)

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
        return Target(
            object_id, drawing(kind, int(number), seed, self.target_plane.size_px), self.target_plane.size_m
        )


@dataclass(frozen=True)
class PictureGlyphs(_AsNamed):
    """The user's own pictures: each image of a folder is an object, of any size, taken in grey.

    White shines, black is dark, values between are shares of light; transparent pixels are black. The longer
    side fills the target plane, what is left of it is dark.

    Args:
        kind: Names this kind of set in a settings file.
        folder: Folder with the images, NAME.png and so on.
        target_plane: What carries a picture; `letter_fraction` is the part of it that the longer side fills.
    """

    kind: Literal["pictures"] = "pictures"
    folder: str = "pictures"
    target_plane: TargetPlane = field(default_factory=TargetPlane)

    def objects(self) -> list[ObjectId]:
        """Return the names of all objects, those of the files in alphabetical order."""
        return list(list_pictures(self.folder))

    def target(self, object_id: ObjectId, seed: int = 0) -> Target:
        """Return one picture, as `read_picture` does; the seed has no part in it."""
        path, plane = look_up(list_pictures(self.folder), object_id), self.target_plane
        return Target(object_id, read_picture(path, plane.size_px, plane.letter_fraction), plane.size_m)


Glyphs: TypeAlias = HandwritingGlyphs | FontGlyphs | NistGlyphs | EmnistGlyphs | DrawingGlyphs | PictureGlyphs
"""All kinds of sets, distinguished by `kind` in a settings file."""


@dataclass(frozen=True)
class OtherTarget:
    """A target beside the object of a recording: the first object of a set, on a path of its own."""

    glyphs: Glyphs = field(default_factory=FontGlyphs)
    """What it is: the first object of this set."""
    motion: LineMotion = field(default_factory=LineMotion)
    """How it moves."""


def with_others(
    scene: Scene, others: tuple[OtherTarget, ...], cover: bool, seed: int
) -> Scene | SeveralTargets:
    """Return a scene with other targets beside its own, or itself where there are none.

    Args:
        scene: The scene.
        others: Targets beside its own, with motions of theirs.
        cover: Whether a later target hides earlier ones.
        seed: Seed of their drawing.
    """
    drawn = [(one.glyphs.target(one.glyphs.objects()[0], seed), one.motion) for one in others]
    scenes = (scene, *(replace(scene, target=target, motion=motion) for target, motion in drawn))
    return SeveralTargets(scenes, cover) if others else scene
