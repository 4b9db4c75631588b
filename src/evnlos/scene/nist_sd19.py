"""Read the user's own copy of NIST Special Database 19, in its official layout "by_class".

    by_class/41/hsf_0/hsf_0_00000.png      41 = hexadecimal ASCII of "A"; hsf_0 .. hsf_8: groups of writers
    by_class/41/train_41/train_41_00000.png   the forms that NIST suggests for training, together

`hsf_4` holds the writers that NIST suggests for testing; `train_XX` repeats images of other partitions, so one
data set should take one partition.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.scene.glyphs import DIGITS, UPPER_CASE
from evnlos.untrusted import open_image

_MAX_SIDE = 1024  # the official images have 128 pixels a side


class Handwritten(NamedTuple):
    """One scanned character.

    Args:
        char: The character.
        source: Where it comes from, unique within the database, e.g. "hsf_0_00012".
        mask: Bright ink on dark ground, float32 [h, w], 0..1.
    """

    char: str
    source: str
    mask: NDArray[np.float32]


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


def read_sd19(
    folder: str | Path,
    characters: str = UPPER_CASE + DIGITS,
    partition: str = "hsf_0",
    first: int = 0,
    count: int | None = None,
) -> Iterator[Handwritten]:
    """Yield the scanned characters that `list_sd19` lists, one image in memory at a time."""
    for char, source, path in list_sd19(folder, characters, partition, first, count):
        yield Handwritten(char, source, read_sd19_image(path))
