"""Figures of every stage: on both grounds, with what they should show."""

import numpy as np
import pytest
from PIL import Image

from evnlos import Events
from evnlos.errors import DataError
from evnlos.plot.figures import Column, draw_comparison, draw_events, draw_surfaces, draw_wall, film
from evnlos.report.pictures import save_animation

pytest.importorskip("matplotlib")
DRAW = np.random.default_rng(0)
TIMES = np.arange(5.0)


@pytest.fixture
def events() -> Events:
    t = np.sort(DRAW.integers(0, 5_000_000, 400))
    x, y = DRAW.integers(0, 12, 400), DRAW.integers(0, 8, 400)
    return Events(t, x, y, DRAW.random(400) > 0.5, width=12, height=8)


@pytest.mark.parametrize(("theme", "ground"), [("light", (255, 255, 255)), ("dark", (14, 16, 20))])
def test_maps_are_drawn_on_both_grounds(theme, ground, tmp_path) -> None:
    if theme == "light":
        path = draw_wall(tmp_path / "wall.png", DRAW.integers(0, 255, (5, 8, 12)), TIMES, 2, theme=theme)
    else:
        path = draw_surfaces(tmp_path / "surfaces.png", DRAW.random((5, 2, 8, 12)), TIMES, 2, theme=theme)
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert tuple(pixels[0, 0]) == ground
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_labels_carry_units(events, tmp_path) -> None:
    cloud = draw_events(tmp_path / "events.svg", events, "dark").read_text()
    pair = draw_comparison(
        tmp_path / "pictures.svg", {"truth": np.eye(4), "found": np.eye(4)}, (12, 24)
    ).read_text()
    for text, labels in ((cloud, ("time, s", "x, pixels", "y, pixels")), (pair, ("x, cm", "truth", "found"))):
        for label in labels:
            assert f"<!-- {label} -->" in text
    assert "fill: #0e1014" in cloud and "fill: #ffffff" in pair


def test_what_cannot_be_drawn_is_one_line(events, tmp_path) -> None:
    with pytest.raises(DataError, match="one time a map"):
        draw_wall(tmp_path / "a.png", np.zeros((3, 4, 4)), [0.0])
    with pytest.raises(DataError, match="no events"):
        draw_events(tmp_path / "a.png", events[:0])
    with pytest.raises(DataError, match="no pictures"):
        draw_comparison(tmp_path / "a.png", {}, (12, 24))
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
