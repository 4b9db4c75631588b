"""Fonts, and their characters drawn on a target plane.

- Find a font: a file, an installed family, or one of the open families that come with the package.
- One character drawn on a square target plane, and names of characters for any file system.
"""

from __future__ import annotations

import difflib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.errors import ConfigError, DataError, MissingDependencyError, UnknownNameError

FONT_SUFFIXES = (".ttf", ".otf", ".ttc", ".otc")
COMIC_FALLBACKS = ("Comic Neue", "Comic Sans MS", "Comic Relief", "Kalam", "Indie Flower", "Caveat")
"""Families that stand in for a comic-style family that is not installed, nearest first."""

DEBIAN_PACKAGES = {"comic neue": "fonts-comic-neue"}
"""Debian packages of families that the standard experiments use."""

_WEIGHTS = {
    "thin": 100, "hairline": 100, "extralight": 200, "ultralight": 200, "light": 300, "regular": 400,
    "normal": 400, "book": 400, "roman": 400, "medium": 500, "semibold": 600, "demibold": 600, "demi": 600,
    "bold": 700, "extrabold": 800, "ultrabold": 800, "black": 900, "heavy": 900,
}  # fmt: skip
_SLANTS = ("italic", "oblique")


@dataclass(frozen=True)
class Font:
    """A font face that was found.

    Args:
        family: Family name, as the font itself gives it.
        path: Font file.
        weight: Weight, 100 (thin) to 900 (black); 400 is regular, 700 bold.
        italic: Whether the face is italic or oblique.
        index: Number of the face in a collection file.
        variable: Whether `weight` has to be set on the font's weight axis.
        substituted_for: The name that was asked for where this face only stands in; None for an exact match.
    """

    family: str
    path: Path
    weight: int = 400
    italic: bool = False
    index: int = 0
    variable: bool = False
    substituted_for: str | None = None

    @property
    def note(self) -> str | None:
        """One line that says what stands in for what, and the cure; None for an exact match."""
        if self.substituted_for is None:
            return None
        family = _family_of(self.substituted_for)
        package = DEBIAN_PACKAGES.get(family.casefold())
        cure = f"install the Debian package {package}" if package else "install it or give a font file"
        face = f"{self.family} at weight {self.weight}" + (" italic" if self.italic else "")
        return f"font {self.substituted_for!r} is not installed: {face} stands in; {cure}"

    def load(self, size_px: float) -> ImageFont.FreeTypeFont:
        """Return the face ready to draw at `size_px` pixels an em."""
        # The basic layout engine is in every build of Pillow: the same image everywhere.
        loaded = ImageFont.truetype(
            str(self.path), size_px, index=self.index, layout_engine=ImageFont.Layout.BASIC
        )
        if self.variable:
            axes = loaded.get_variation_axes()
            wanted = [self.weight if _axis_name(axis) == "weight" else axis["default"] or 0 for axis in axes]
            loaded.set_variation_by_axes([float(value) for value in wanted])
        return loaded


def find_font(name: str | os.PathLike[str], *, strict: bool = False) -> Font:
    """Return the face that a file path or a name such as "Comic Neue Bold" means.

    Names are looked up first among the families of the package index (`fontpkg-*`), then among the system's. A
    family without the weight or slant that was asked for gives its nearest face; a comic-style family that is
    not there gives the first of `COMIC_FALLBACKS` that is. In both cases `substituted_for` holds the name that
    was asked for and `note` a line for the user.

    Args:
        name: Font file, or family name with optional weight and slant words; case does not matter.
        strict: Raise instead of substituting.

    Raises:
        ConfigError: The file is not there or no font, or no family has this name.
        MissingDependencyError: `strict` is set and only a stand-in is there, or no family has this name and the
            open families (`evnlos[fonts]`) are not installed.
    """
    text = os.fspath(name)
    if not text.strip():
        raise ConfigError("the font's name is empty; give a family such as 'Comic Neue Bold' or a font file")
    if isinstance(name, os.PathLike) or text.lower().endswith(FONT_SUFFIXES):
        return _font_of_file(Path(text).expanduser())
    faces = installed_fonts()
    found = _match(text, faces)
    if found is None and "comic" in text.casefold():
        style = text[len(_family_of(text)) :]
        candidates = (_match(family + style, faces) for family in COMIC_FALLBACKS)
        found = next((face for face in candidates if face is not None), None)
        found = _substitute(found, text) if found else None
    if found is None:
        if find_spec("fontpkg") is None:
            raise MissingDependencyError(f"{_unknown(text, faces)}; pip install evnlos[fonts] brings open ones")
        raise UnknownNameError(_unknown(text, faces))
    if strict and found.note:
        raise MissingDependencyError(found.note)
    return found


@lru_cache(maxsize=1)
def installed_fonts() -> tuple[Font, ...]:
    """Return all faces that can be asked for by name: the package index's families, then the system's."""
    return (*_packaged_fonts(), *_system_fonts())


def _match(name: str, faces: tuple[Font, ...]) -> Font | None:
    """Return the face of an installed family that is nearest to `name`, or None."""
    wanted_family, weight, italic = _split_name(name)
    # A family's own name may end in a style word ("Comic Neue Light"), so the whole name is tried first.
    for family, style in ((name.strip(), (400, False)), (wanted_family, (weight, italic))):
        of_family = [face for face in faces if _key(face.family) == _key(family)]
        if of_family:
            best = min(of_family, key=lambda face: _distance(face, *style))
            reachable = _at_weight(best, style[0])
            exact = (reachable.weight, reachable.italic) == style
            return reachable if exact else _substitute(reachable, name)
    return None


def _distance(face: Font, weight: int, italic: bool) -> tuple[bool, int]:
    return face.italic != italic, 0 if face.variable else abs(face.weight - weight)


def _at_weight(face: Font, weight: int) -> Font:
    """Return a variable face set to `weight` as far as its axis reaches, any other face as it is."""
    if not face.variable:
        return face
    axes = ImageFont.truetype(str(face.path), 16, index=face.index).get_variation_axes()
    low, high = next((a["minimum"], a["maximum"]) for a in axes if _axis_name(a) == "weight")
    return _replace(face, weight=int(min(max(weight, low or 0), high or 1000)))


def _substitute(face: Font, name: str) -> Font:
    return _replace(face, substituted_for=name)


def _replace(face: Font, **changes: object) -> Font:
    return Font(**{**face.__dict__, **changes})


def _unknown(name: str, faces: tuple[Font, ...]) -> str:
    families = sorted({face.family for face in faces})
    near = difflib.get_close_matches(_family_of(name), families, n=1, cutoff=0.5)
    hint = f"; the nearest installed family is {near[0]!r}" if near else ""
    return f"no font family {name!r} among the {len(families)} installed ones{hint}; or give a font file"


def _key(family: str) -> str:
    return re.sub(r"[\s_-]+", "", family).casefold()


def _family_of(name: str) -> str:
    return _split_name(name)[0]


def _split_name(name: str) -> tuple[str, int, bool]:
    """Split "Comic Neue Bold Italic" into its family, weight and slant."""
    words = name.split()
    weight, italic = 400, False
    while len(words) > 1:
        word = words[-1].casefold().replace("-", "")
        if word in _WEIGHTS:
            weight = _WEIGHTS[word]
        elif word in _SLANTS:
            italic = True
        else:
            break
        words.pop()
    return " ".join(words), weight, italic


def _axis_name(axis: Any) -> str:
    name = axis["name"]
    return (name.decode() if isinstance(name, bytes) else name or "").strip("\0").casefold()


def _font_of_file(path: Path) -> Font:
    if not path.is_file():
        raise ConfigError(f"no font file {path}; give an existing .ttf or .otf file, or a family name")
    try:
        family, style = ImageFont.truetype(str(path), 16).getname()
    except OSError as error:
        raise ConfigError(f"{path} is no font that can be read ({error}); give a .ttf or .otf file") from error
    _, weight, italic = _split_name(f"x {style or ''}")
    return Font(family or path.stem, path, weight, italic)


def _packaged_fonts() -> Iterator[Font]:
    """Yield the faces of the installed `fontpkg-*` packages."""
    try:
        import fontpkg  # lazily: it walks the metadata of all installed packages
    except ModuleNotFoundError:  # the extra `fonts` is not installed
        return
    for family in fontpkg.families().values():
        for file in family.files:
            weight = file.weight if file.weight is not None else 400
            yield Font(family.name, file.path, weight, file.style == "italic", variable=file.variable)


def _system_fonts() -> Iterator[Font]:
    """Yield the faces that fontconfig knows, or else those in the platform's font folders."""
    listing = _fontconfig_listing()
    if listing is None:
        for folder in _font_folders():
            for path in sorted(folder.rglob("*")) if folder.is_dir() else ():
                if path.suffix.lower() in FONT_SUFFIXES:
                    try:
                        yield _font_of_file(path)
                    except ConfigError:
                        continue  # a damaged font on the system is not this user's mistake
        return
    for line in sorted(set(listing.splitlines())):
        fields = line.split("\t")
        if len(fields) != 4 or not fields[0].lower().endswith(FONT_SUFFIXES):
            continue
        file, families, styles, index = fields
        _, weight, italic = _split_name(f"x {styles.split(',')[0]}")
        # fontconfig packs the number of a variable font's instance above bit 16.
        number = int(index) if index.isdigit() else 0
        if number < 1 << 16:
            yield Font(families.split(",")[0], Path(file), weight, italic, number)


def _fontconfig_listing() -> str | None:
    if which("fc-list") is None:
        return None
    form = "%{file}\t%{family}\t%{style}\t%{index}\n"
    try:
        done = subprocess.run(["fc-list", "--format", form], capture_output=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode("utf-8", "replace")


def _font_folders() -> list[Path]:
    """Return the folders where a system keeps its fonts."""
    home = Path.home()
    if sys.platform == "win32":
        return [
            Path(os.environ.get("WINDIR", "C:/Windows")) / "Fonts",
            home / "AppData/Local/Microsoft/Windows/Fonts",
        ]
    if sys.platform == "darwin":
        return [Path("/System/Library/Fonts"), Path("/Library/Fonts"), home / "Library/Fonts"]
    return [
        Path("/usr/share/fonts"),
        Path("/usr/local/share/fonts"),
        home / ".local/share/fonts",
        home / ".fonts",
    ]


UPPER_CASE = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
DIGITS = "0123456789"
_SUPERSAMPLING = 4
_MAX_SIZE_PX = 2048


def render_glyph(char: str, font: Font, size_px: int = 256, fraction: float = 1.0) -> NDArray[np.float32]:
    """Draw `char` as large as fits a centred square of `fraction` of the target, bright on dark, anti-aliased.

    The ink's bounding box is centred, and its longer side is `fraction` of the target's side: the shape counts,
    not the font's metrics.

    Args:
        char: One character.
        font: Face to draw with (see `find_font`).
        size_px: Side of the mask, pixels, 8 to 2048.
        fraction: Longer side of the ink as a part of the target plane's side, above 0 to 1.

    Returns:
        float32 [size_px, size_px], 0..1, row 0 on top.

    Raises:
        ConfigError: The font has no ink for this character.
        DataError: A size or fraction outside its range, or more than one character.
    """
    if len(char) != 1:
        raise DataError(f"char is {char!r}; give exactly one character")
    check_size(size_px, fraction)
    fine = size_px * _SUPERSAMPLING
    trial = font.load(256)
    if _is_missing(char, trial):
        raise ConfigError(
            f"the font {font.family} ({font.path.name}) cannot draw {char!r}; choose another font"
        )
    # Two steps: rounding makes the first guess of the size wrong by up to a pixel of the trial.
    size = 256.0
    for _ in range(2):
        left, top, right, bottom = _ink_box(char, font.load(size))
        size *= fraction * fine / max(right - left, bottom - top)
    loaded = font.load(size)
    left, top, right, bottom = _ink_box(char, loaded)
    canvas = Image.new("L", (fine, fine))
    corner = ((fine - left - right) // 2, (fine - top - bottom) // 2)
    ImageDraw.Draw(canvas).text(corner, char, fill=255, font=loaded)
    return np.asarray(canvas.reduce(_SUPERSAMPLING), dtype=np.float32) / np.float32(255)


def fit_to_target_plane(picture: NDArray, size_px: int = 256, fraction: float = 1.0) -> NDArray[np.float32]:
    """Cut an image of a character to its ink, scale the ink as `render_glyph` does and centre it.

    Args:
        picture: Bright ink on dark ground, [h, w], 0..1.
        size_px: Side of the mask, pixels, 8 to 2048.
        fraction: Longer side of the ink as a part of the target plane's side, above 0 to 1.

    Returns:
        float32 [size_px, size_px], 0..1.

    Raises:
        DataError: The image is not [h, w] or holds no ink.
    """
    check_size(size_px, fraction)
    image = np.asarray(picture, dtype=np.float32)
    if image.ndim != 2 or not np.isfinite(image).all():
        raise DataError(f"a character's image has shape {image.shape}; give finite values [h, w]")
    rows, columns = np.flatnonzero((image > 0.5).any(1)), np.flatnonzero((image > 0.5).any(0))
    if not len(rows):
        raise DataError("a character's image holds no ink (nothing above 0.5); leave it out")
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    # The square that becomes the target plane, in the image's pixels; a margin of zeros lets it reach
    # outside.
    side = max(bottom - top, right - left) / fraction
    margin = int(np.ceil(side)) + 2
    padded = Image.fromarray(np.pad(image, margin))
    x, y = margin + (left + right - side) / 2, margin + (top + bottom - side) / 2
    mask = padded.resize((size_px, size_px), Image.Resampling.BICUBIC, box=(x, y, x + side, y + side))
    return np.clip(np.asarray(mask, dtype=np.float32), 0, 1)


def check_size(size_px: int, fraction: float) -> None:
    """Raise DataError for a mask side (pixels) or a part of the target plane outside its range."""
    if not 8 <= size_px <= _MAX_SIZE_PX:
        raise DataError(f"size_px is {size_px}; give 8 to {_MAX_SIZE_PX} pixels")
    if not 0 < fraction <= 1:
        raise DataError(f"fraction is {fraction}; give a part of the target plane above 0 and up to 1")


def character_name(char: str) -> str:
    """Return a name for a character that is unique on any file system, whatever it does with case.

    Example:
        >>> [character_name(c) for c in "A7a?"]
        ['A', '7', 'lower_a', 'u003f']
    """
    if len(char) == 1 and char in UPPER_CASE + DIGITS:
        return char
    if len(char) == 1 and char in UPPER_CASE.lower():
        return f"lower_{char}"
    return "_".join(f"u{ord(c):04x}" for c in char)


def _ink_box(char: str, loaded: ImageFont.FreeTypeFont) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the ink from the drawing position, pixels."""
    # The font's own getbbox() counts the advance as ink.
    bitmap, (x, y) = loaded.getmask2(char, mode="L")
    left, top, right, bottom = bitmap.getbbox() or (0, 0, 0, 0)
    return left + x, top + y, right + x, bottom + y


def _is_missing(char: str, loaded: ImageFont.FreeTypeFont) -> bool:
    """Return whether the font has no ink for `char`, or draws it as it draws a code point that no font has."""
    drawn, absent = (_drawn(c, loaded) for c in (char, "\U0010fffe"))
    return drawn.getbbox() is None or drawn.tobytes() == absent.tobytes()


def _drawn(char: str, loaded: ImageFont.FreeTypeFont) -> Image.Image:
    image = Image.new("L", (512, 512))
    ImageDraw.Draw(image).text((128, 64), char, fill=255, font=loaded)
    return image
