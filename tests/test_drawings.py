"""Things to hide that are no characters."""

import numpy as np
import pytest

from evnlos.config import from_dict, to_dict
from evnlos.data import Simulation, simulate_object
from evnlos.errors import ConfigError
from evnlos.scene import DrawingGlyphs, drawing
from evnlos.scene.drawings import KINDS, Canvas


@pytest.mark.parametrize("kind", KINDS)
def test_every_drawing_is_on_the_target_and_like_no_other(kind: str) -> None:
    pictures = [drawing(kind, number, size_px=64) for number in range(16)]
    for image in pictures:
        assert image.shape == (64, 64) and image.min() == 0
        assert 0.02 < image.mean() < 0.7  # strokes or surfaces, neither a speck nor a blank sheet
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert border.max() == 0  # nothing is cut off
    flat = np.stack(pictures).reshape(16, -1)
    apart = np.square(flat[:, None] - flat).mean(axis=2)[~np.eye(16, dtype=bool)]
    assert apart.min() > 0.002
    np.testing.assert_array_equal(drawing(kind, 3, size_px=64), pictures[3])
    assert not np.array_equal(drawing(kind, 3, seed=1, size_px=64), pictures[3])


def test_only_grey_drawings_are_grey() -> None:
    inside = {kind: drawing(kind, 0)[2:-2, 2:-2] for kind in ("icon", "grey")}
    share = {kind: ((one > 0.05) & (one < 0.95)).sum() / (one > 0.05).sum() for kind, one in inside.items()}
    assert share["icon"] < 0.1 < 0.9 < share["grey"]


def test_a_canvas_draws_to_scale() -> None:
    canvas = Canvas(100, np.random.default_rng(0))
    canvas.box(-0.5, -0.5, 0.5, 0.5)
    assert canvas.image().mean() == pytest.approx(0.25, rel=0.02)
    canvas.disc(0, 0, 0.25, level=0)
    assert canvas.image().mean() == pytest.approx(0.25 - np.pi / 64, rel=0.03)
    canvas = Canvas(100, np.random.default_rng(0), angle=np.pi / 4, scale=0.5, centre=(0.2, -0.3))
    canvas.box(-0.5, -0.5, 0.5, 0.5)
    image = canvas.image()
    rows, columns = np.indices(image.shape)
    assert image.mean() == pytest.approx(0.0625, rel=0.05)
    assert (image * columns).sum() / image.sum() == pytest.approx(59.5, abs=0.3)
    assert (image * rows).sum() / image.sum() == pytest.approx(34.5, abs=0.3)


def test_drawings_are_simulated_like_characters(tiny) -> None:
    glyphs = DrawingGlyphs(kinds=("person", "several"), each=2, first=5)
    assert glyphs.objects() == ["person_005", "person_006", "several_005", "several_006"]
    from dataclasses import replace

    config = replace(tiny, glyphs=glyphs)
    assert from_dict(Simulation, to_dict(config)) == config
    samples, events = simulate_object(config, "person_006")
    assert samples.truth is not None and samples.truth.max() > 0.5 and len(events)


def test_strange_drawings_are_one_line() -> None:
    for wrong in ({"kinds": ("cloud",)}, {"kinds": ()}, {"each": 0}, {"first": -1}):
        with pytest.raises(ConfigError):
            DrawingGlyphs(**wrong)
    for name in ("cloud_001", "icon_x", "icon"):
        with pytest.raises(ConfigError, match="none of these drawings"):
            DrawingGlyphs().target(name)
    with pytest.raises(ConfigError, match="cloud"):
        drawing("cloud", 0)
