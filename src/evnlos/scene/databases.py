"""Images that a user has: pictures in a folder, NIST Special Database 19, EMNIST.

Read the user's own copy of NIST Special Database 19, in its official layout "by_class".

    by_class/41/hsf_0/hsf_0_00000.png      41 = hexadecimal ASCII of "A"; hsf_0 .. hsf_8: groups of writers
    by_class/41/train_41/train_41_00000.png   the forms that NIST suggests for training, together

`hsf_4` holds the writers that NIST suggests for testing; `train_XX` repeats images of other partitions, so one
data set should take one partition.

- Read the user's own copy of EMNIST: gzip-compressed idx files and a mapping from labels to characters.
"""

from __future__ import annotations

import gzip
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.scene.fonts import DIGITS, UPPER_CASE, check_size
from evnlos.untrusted import open_image

ObjectId: TypeAlias = str
"""Name of an object, e.g. "writer03_A": unique, stable, and a file name on any file system."""
_MAX_SIDE = 1024  # the official images have 128 pixels per side
_PICTURES = (".png", ".jpg", ".jpeg", ".gif", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
_DARK = 1 / 255  # below it a picture is black


def list_sd19(
    folder: str | Path,
    characters: str = UPPER_CASE + DIGITS,
    partition: str = "hsf_0",
    first: int = 0,
    count: int | None = None,
) -> Iterator[tuple[str, str, Path]]:
    """Yield (character, source, file) of a copy of NIST SD19 in the order of characters and file names.

    Args:
        folder: The folder `by_class`, or the one that holds it.
        characters: Characters to list.
        partition: "hsf_0" .. "hsf_8", or "train" for the folders train_XX.
        first: Number of images of each character to pass over.
        count: Images of each character to list after those; None for all.

    Raises:
        DataError: The folder does not have the official layout, or holds fewer images than asked for.
    """
    if not re.fullmatch(r"hsf_[0-8]|train", partition):
        raise DataError(f"partition is {partition!r}; NIST SD19 has hsf_0 to hsf_8 and train")
    root = Path(folder).expanduser()
    root = root / "by_class" if (root / "by_class").is_dir() else root
    for char in characters:
        name = f"{ord(char):02x}"
        images = root / name / (f"train_{name}" if partition == "train" else partition)
        if not images.is_dir():
            raise DataError(
                f"{images} is not there; NIST SD19 by_class keeps {char!r} in {name}/{images.name}/*.png: "
                "give the folder by_class of your copy"
            )
        files = sorted(path for path in images.iterdir() if path.suffix.lower() == ".png")
        chosen = files[first : None if count is None else first + count]
        if not chosen or (count is not None and len(chosen) < count):
            raise DataError(
                f"{images} holds {len(files)} images; {count or 'some'} from number {first} on were asked for: "
                "ask for fewer or take another partition"
            )
        for path in chosen:
            yield char, path.stem, path


def read_sd19_image(path: str | Path) -> NDArray[np.float32]:
    """Read one image, black ink on white, as bright ink on dark ground, float32 [h, w], 0..1.

    Args:
        path: The image file of a copy of NIST SD19.

    Raises:
        DataError: The file is no image, or larger than any of the database.
    """
    try:
        with open_image(path) as image:
            if max(image.size) > _MAX_SIDE:
                raise DataError(
                    f"{path} is {image.size[0]} x {image.size[1]} pixels; NIST SD19 images are 128 x 128"
                )
            grey = np.asarray(image.convert("L"), dtype=np.float32)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(
            f"{path} is no image that can be read ({error}); restore it from the database"
        ) from None
    return 1 - grey / np.float32(255)


_SIDE = 28
_BATCH = 4096  # images in memory at a time
_DEFLATE_LIMIT = 1032  # deflate never expands more than this


def list_emnist(
    folder: str | Path,
    characters: str = UPPER_CASE + DIGITS,
    subset: str = "byclass",
    part: str = "train",
    first: int = 0,
    count: int | None = None,
) -> list[tuple[str, int]]:
    """Return (character, number of the image in its file) in the order of the file; reads labels only.

    Args:
        folder: Folder with the official files, e.g. emnist-byclass-train-images-idx3-ubyte.gz, the labels
            beside it and emnist-byclass-mapping.txt.
        characters: Characters to list.
        subset: "byclass", "bymerge", "balanced", "letters" or "digits".
        part: "train" or "test".
        first: Number of images of each character to pass over.
        count: Images of each character to list after those; None for all.

    Raises:
        DataError: A file is missing, damaged or not what its header says, or has fewer images than asked for.
    """
    root = Path(folder).expanduser()
    mapping = _read_mapping(
        _file(root, f"emnist-{subset}-mapping.txt", "a text file of labels and ASCII codes")
    )
    labels_file = _file(root, f"emnist-{subset}-{part}-labels-idx1-ubyte.gz", "the official label file")
    with _idx(labels_file, dimensions=1) as (stream, (total,)):
        labels = _read_exactly(stream, total, labels_file)
    chosen: list[tuple[str, int]] = []
    for char in characters:
        numbers = [label for label, known in mapping.items() if char == known]
        places = np.flatnonzero(np.isin(labels, np.array(numbers, dtype=np.uint8)))
        wanted = places[first : None if count is None else first + count]
        if not len(wanted) or (count is not None and len(wanted) < count):
            raise DataError(
                f"{labels_file} holds {len(places)} images of {char!r}; {count or 'some'} from number {first} "
                "on were asked for: ask for fewer, or take another subset"
            )
        chosen += [(char, int(place)) for place in wanted]
    return sorted(chosen, key=lambda item: item[1])


def read_emnist_images(
    folder: str | Path, numbers: Sequence[int], subset: str = "byclass", part: str = "train"
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield (number, mask) of chosen images in the order of the file, in one pass, upright.

    Args:
        folder: As in `list_emnist`.
        numbers: Numbers of the images in the file.
        subset: As in `list_emnist`.
        part: As in `list_emnist`.

    Yields:
        The number and the mask, float32 [28, 28], 0..1, bright ink on dark ground. The official files hold the
        images transposed; this undoes it.

    Raises:
        DataError: The file is missing, damaged, or shorter than its header says.
    """
    path = _file(
        Path(folder).expanduser(), f"emnist-{subset}-{part}-images-idx3-ubyte.gz", "the official image file"
    )
    wanted = sorted(set(numbers))
    with _idx(path, dimensions=3) as (stream, (total, rows, columns)):
        if (rows, columns) != (_SIDE, _SIDE):
            raise DataError(f"{path} says {rows} x {columns} pixels; EMNIST images are {_SIDE} x {_SIDE}")
        if wanted and not 0 <= wanted[0] <= wanted[-1] < total:
            raise DataError(
                f"image {wanted[-1]} of {path} was asked for; it holds {total}: take its own label file"
            )
        for start in range(0, wanted[-1] + 1 if wanted else 0, _BATCH):
            size = min(_BATCH, total - start)
            batch = _read_exactly(stream, size * _SIDE * _SIDE, path).reshape(size, _SIDE, _SIDE)  # [b, 28, 28]
            for number in wanted[np.searchsorted(wanted, start) : np.searchsorted(wanted, start + size)]:
                yield number, batch[number - start].T.astype(np.float32) / np.float32(255)


def _file(root: Path, name: str, what: str) -> Path:
    path = root / name
    if not path.is_file():
        raise DataError(f"{path} is not there; it is {what} of EMNIST: give the folder of your copy")
    return path


def _read_mapping(path: Path) -> dict[int, str]:
    """Return label -> character; where two cases share a label, the first code on the line counts."""
    mapping: dict[int, str] = {}
    try:
        for line in path.read_text(encoding="ascii").splitlines():
            if line.strip():
                label, code, *_ = (int(field) for field in line.split())
                mapping[label] = chr(code)
    except (ValueError, OverflowError, OSError):
        raise DataError(f"{path} is no EMNIST mapping; each line holds a label and its ASCII code") from None
    if any(not 0 <= label <= 255 for label in mapping):
        raise DataError(f"{path} holds a label outside 0..255; restore it from the database")
    return mapping


@contextmanager
def _idx(path: Path, dimensions: int) -> Iterator[tuple[gzip.GzipFile, tuple[int, ...]]]:
    """Open a compressed idx file of bytes, check its header, and give the stream and the sizes."""
    try:
        with gzip.open(path, "rb") as stream:
            header = stream.read(4 + 4 * dimensions)
            if len(header) < 4 + 4 * dimensions or header[:4] != bytes((0, 0, 8, dimensions)):
                raise DataError(f"{path} is no idx file of bytes with {dimensions} dimensions; restore it")
            sizes = struct.unpack(f">{dimensions}I", header[4:])
            promised, possible = int(np.prod(sizes, dtype=object)), path.stat().st_size * _DEFLATE_LIMIT
            if promised > possible:
                raise DataError(
                    f"the header of {path} promises {promised} bytes; the file can hold {possible} at most"
                )
            yield stream, sizes
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path} is damaged ({error}); restore it from the database") from None


def _read_exactly(stream: gzip.GzipFile, size: int, path: Path) -> NDArray[np.uint8]:
    content = stream.read(size)
    if len(content) < size:
        raise DataError(f"{path} ends early: {len(content)} of {size} bytes; restore it from the database")
    return np.frombuffer(content, dtype=np.uint8)


@dataclass(frozen=True)
class TargetPlane:
    """The square that carries a character.

    Args:
        size_m: Side of the target plane, metres.
        size_px: Side of the mask, pixels.
        letter_fraction: Longer side of a letter as a part of the target plane's side, 0..1.
        digit_fraction: The same of a digit; smaller, as in the paper.
    """

    size_m: float = 0.08
    size_px: int = 256
    letter_fraction: float = 1.0
    digit_fraction: float = 0.75

    def __post_init__(self) -> None:
        if not (np.isfinite(self.size_m) and self.size_m > 0):
            raise ConfigError(f"size_m is {self.size_m}; give a positive number of metres")
        for fraction in (self.letter_fraction, self.digit_fraction):
            check_size(self.size_px, fraction)

    def fraction(self, char: str) -> float:
        """Return the part of the target plane's side that this character fills."""
        return self.digit_fraction if char in DIGITS else self.letter_fraction


def look_up(index: dict, object_id: ObjectId):
    """Return what an index knows of an object; refuse a name that is not in it."""
    if object_id not in index:
        raise ConfigError(
            f"{object_id!r} is not among the {len(index)} objects of this set; take a name it lists"
        )
    return index[object_id]


@lru_cache(maxsize=16)
def list_pictures(folder: str) -> dict[ObjectId, Path]:
    """Return the pictures of a folder by the names of their objects, in alphabetical order."""
    if not Path(folder).is_dir():
        raise ConfigError(f"{folder} is no folder; name the one that holds the pictures (glyphs.folder)")
    files = [path for path in sorted(Path(folder).iterdir()) if path.suffix.lower() in _PICTURES]
    if not files:
        raise ConfigError(f"{folder} holds no pictures; put images NAME.png, one an object, into it")
    found: dict[ObjectId, Path] = {}
    for path in files:
        name = re.sub(r"[^\w-]+", "_", path.stem)
        if name.lower() in map(str.lower, found):  # as folders of captures they would be one
            raise ConfigError(f"{path}: another picture is called {name}, too; rename one of them")
        found[name] = path
    return found


def read_picture(path: Path, size_px: int = 256, fraction: float = 1.0) -> NDArray[np.float32]:
    """Return a picture in grey in the middle of a dark square, float32 [size_px, size_px], 0..1.

    Args:
        path: An image file of any size.
        size_px: Side of the square, pixels, 8 to 2048.
        fraction: The picture's longer side as a part of the square's, above 0 to 1.

    Raises:
        DataError: The file can't be read, or is black.
    """
    from PIL import Image

    check_size(size_px, fraction)
    try:
        with open_image(path) as image:
            if image.mode == "F":
                raise OSError("its values are floating-point numbers, of no known white")
            if image.mode.startswith("I"):  # 16 bits: `convert` would clip them
                grey = np.asarray(image, np.float32) / 65535
            else:
                full = image.convert("RGBA")
                grey = np.asarray(
                    Image.alpha_composite(Image.new("RGBA", full.size, "black"), full).convert("L")
                )
                grey = grey.astype(np.float32) / 255
    except OSError as error:
        raise DataError(f"{path}: {error}; give an image file that can be opened, or take it away") from None
    if not grey.max() > _DARK:
        raise DataError(f"{path} is black, and black gives no light; draw bright on dark, or take it away")
    side = max(grey.shape) / fraction
    wide, high = (max(1, round(n / side * size_px)) for n in grey.shape[::-1])
    how = Image.Resampling.BOX if side > size_px else Image.Resampling.BILINEAR
    small = Image.fromarray(grey).resize((wide, high), how)
    mask, top, left = np.zeros((size_px, size_px), np.float32), (size_px - high) // 2, (size_px - wide) // 2
    mask[top : top + high, left : left + wide] = np.clip(np.asarray(small), 0, 1)
    return mask
