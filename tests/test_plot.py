"""Films of a sequence show what they should."""

import numpy as np
import pytest
from PIL import Image

from evnlos.errors import DataError
from evnlos.plot.figures import Column, film
from evnlos.report.pictures import save_animation

pytest.importorskip("matplotlib")


def test_what_cannot_be_drawn_is_one_line() -> None:
    pictures = np.zeros((3, 4, 6), np.uint8)
    with pytest.raises(DataError, match="same number"):
        film([Column("a", "", pictures), Column("b", "", pictures[:2])])


def test_a_film_shows_its_columns_and_moves(tmp_path) -> None:
    left, right = np.zeros((3, 4, 8), np.uint8), np.full((3, 4, 8, 4), (0, 0, 0, 0), np.uint8)
    left[1], right[2] = 255, (255, 0, 0, 255)
    pictures = film([Column("left", "", left), Column("right", "", right)], 80, "light", ["a", "b", "c"])
    middle = 27 + 20
    assert pictures[1][middle, 40].tolist() == [255, 255, 255] and pictures[0][middle, 40].tolist() == [0, 0, 0]
    assert pictures[2][middle, 130].tolist() == [255, 0, 0]
    assert pictures[0][middle, 130].tolist() == [255, 255, 255]  # transparent: the ground
    for name in ("film.gif", "film.webp"):
        save_animation(tmp_path / name, pictures, 10)
        with Image.open(tmp_path / name) as moving:
            assert moving.n_frames == 3 and moving.format == name[5:].upper()
