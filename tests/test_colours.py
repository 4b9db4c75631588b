"""The colours of events, and of maps of either sign: for the colour-blind, in grey print, on every ground."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import evnlos
from evnlos import Events
from evnlos.events.recording import summarise
from evnlos.events.volume import OFF_RGB, ON_HEX, ON_RGB, WORDS
from evnlos.plot.figures import signed_images
from evnlos.plot.preview import PreviewOptions, preview_images
from evnlos.report.pictures import polarity

SOURCE = Path(evnlos.__file__).parent
GROUNDS = {"paper": (255, 255, 255), "report": (20, 23, 27), "preview": (14, 16, 20), "black": (0, 0, 0)}
# Linear RGB as people without red or green cones see it (Viénot, Brettel and Mollon 1999).
BLIND = {
    "protan": [[0.11238, 0.88762, 0], [0.11238, 0.88762, 0], [0.00401, -0.00401, 1]],
    "deutan": [[0.29275, 0.70725, 0], [0.29275, 0.70725, 0], [-0.02234, 0.02234, 1]],
}


def grey(colour) -> int:
    """Return the grey that a print shows, as Pillow converts it."""
    return int(Image.new("RGB", (1, 1), tuple(int(v) for v in colour)).convert("L").getpixel((0, 0)))


def linear(colour) -> np.ndarray:
    share = np.asarray(colour) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def contrast(one, other) -> float:
    low, high = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (one, other))
    return (high + 0.05) / (low + 0.05)


def test_on_and_off_are_told_apart_in_grey_and_by_the_colour_blind() -> None:
    assert grey(ON_RGB) - grey(OFF_RGB) >= 50
    for name, matrix in BLIND.items():
        seen = [255 * np.clip(np.array(matrix) @ linear(c), 0, 1) ** (1 / 2.2) for c in (ON_RGB, OFF_RGB)]
        assert np.abs(seen[0] - seen[1]).max() > 120, name
    for ground in GROUNDS.values():
        assert min(contrast(ON_RGB, ground), contrast(OFF_RGB, ground)) >= 2.95, ground


def test_images_of_events_keep_the_grey_difference() -> None:
    maps = np.array([[[1.0, 0.0]], [[0.0, 1.0]]])  # an ON pixel beside an OFF pixel
    on, off = polarity(maps)[0]
    assert grey(on) - grey(off) >= 50
    on, off = signed_images(maps)[0, :, :3]
    assert grey(on) - grey(off) >= 50
    events = Events([0, 0], [0, 1], [0, 0], [1, 0], 2, 1)
    for background in ("dark", "light"):
        look = PreviewOptions(frames=1, side_px=64, background=background)
        (picture,) = preview_images([events], summarise([events]), look)
        assert grey(picture[0, 0]) - grey(picture[0, -1]) >= 50


def test_maps_of_either_sign_grow_lighter_all_the_way() -> None:
    pytest.importorskip("matplotlib")
    from evnlos.plot.figures import signed_map

    greys = [grey(255 * np.array(colour[:3])) for colour in signed_map()(np.linspace(0, 1, 41))]
    assert np.all(np.diff(greys) > 0)
    assert greys[20] - greys[0] >= 50 and greys[-1] - greys[20] >= 50


def test_pages_and_modules_use_the_one_pair() -> None:
    assert ON_HEX in (SOURCE / "app" / "page.js").read_text()
    assert WORDS in (SOURCE / "live" / "page.html").read_text()
    pages = [path for path in SOURCE.rglob("*") if path.suffix in (".py", ".html", ".js", ".css")]
    texts = {path: path.read_text() for path in pages}
    assert not [path for path, text in texts.items() if "RdBu" in text]
    own = re.compile(r"\bred (brighter|is ON)|\b_?ON(_RGB)? = (\(|np)")
    assert len([path for path, text in texts.items() if own.search(text)]) == 1


def test_a_calibration_is_drawn_with_the_signed_map(tmp_path) -> None:
    pytest.importorskip("matplotlib")
    from evnlos.calibration import Example
    from evnlos.plot.results import draw_calibration

    frame, draw = np.ones((8, 12)), np.random.default_rng(0)
    surfaces = draw.random((2, 2, 8, 12))
    example = Example("near_G", frame, 0.9 * frame, surfaces[0], surfaces[1])
    draw_calibration(SimpleNamespace(example=(example,)), tmp_path / "check.png")  # type: ignore[arg-type]
    with Image.open(tmp_path / "check.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    below, above = np.array([8, 32, 96]), np.array([255, 222, 160])  # the ends of the map
    assert all(np.abs(pixels.astype(int) - one).sum(axis=1).min() < 30 for one in (below, above))
