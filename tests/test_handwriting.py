"""NIST-like handwriting: consistent hands, the same on every run, different from writer to writer."""

import dataclasses
import hashlib
import subprocess
import sys

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.ndimage import distance_transform_edt

from evnlos.errors import ConfigError, DataError
from evnlos.inverse import best_bent, handwritten_prior
from evnlos.inverse.prior import letters, written_alike
from evnlos.scene import (
    TRAIN_WRITERS,
    HandwritingGlyphs,
    Ink,
    Strokes,
    Target,
    TargetPlane,
    find_font,
    hand,
    nist_like,
    pen_width,
    redrawn,
    render_glyph,
)
from evnlos.scene.handwriting import ink_box, signed_distance
from evnlos.types import Plane

STEMS = "BDEFHIKLPRT"  # letters whose upright strokes show the slant


def slant(mask):
    """Tangent of the slant: the shear that makes the columns of ink sharpest."""
    y, x = np.nonzero(mask > 0.5)
    shears = np.linspace(-0.8, 0.8, 161)
    middle = (len(mask) - 1) / 2
    columns = [np.histogram(x + s * (y - middle), bins=np.arange(-60, 2 * len(mask)))[0] for s in shears]
    return shears[np.argmax([np.square(c.astype(float)).sum() for c in columns])]


@pytest.mark.parametrize("seed", range(6))
def test_signed_distance_is_that_of_a_search_over_all_pixels(seed):
    draw = np.random.default_rng(seed)
    mask = draw.random(draw.integers(3, 14, size=2)) < draw.random() if seed else np.zeros((4, 5))
    inside = np.asarray(mask) >= 0.5
    places = np.argwhere(np.ones_like(inside))

    def to(chosen):
        away = np.linalg.norm(places[:, None] - np.argwhere(chosen)[None], axis=-1)
        return np.minimum(away.min(axis=1, initial=5), 5).reshape(inside.shape)

    expected = np.where(inside, 0.5 - to(~inside), to(inside) - 0.5)
    np.testing.assert_allclose(signed_distance(mask, 5), expected, atol=1e-6)


def test_signed_distance_of_nothing_and_everything():
    assert signed_distance(np.zeros((5, 5)), 3).min() == 2.5
    assert signed_distance(np.ones((5, 5)), 3).max() == -2.5


def test_a_glyph_depends_on_seed_writer_and_character_only():
    first = nist_like(3, "R", 7, 64)
    nist_like(4, "Q", 1, 64)
    hand(5, 7)
    np.testing.assert_array_equal(first, nist_like(3, "R", 7, 64))
    for other in (nist_like(4, "R", 7, 64), nist_like(3, "R", 8, 64), nist_like(3, "P", 7, 64)):
        assert np.abs(first - other).mean() > 0.01


def test_another_process_draws_the_same_bytes():
    program = (
        "import hashlib; from evnlos.scene import nist_like; "
        "print(hashlib.sha256(nist_like(2, 'K', 5, 64).tobytes()).hexdigest())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == hashlib.sha256(nist_like(2, "K", 5, 64).tobytes()).hexdigest()


def test_every_training_letter_fits_the_target_and_has_ink():
    for writer in range(0, TRAIN_WRITERS, 3):
        for char in "AMQWI8":
            mask = nist_like(writer, char, 0, 64)
            assert mask.shape == (64, 64)
            assert mask.dtype == np.float32
            assert 0 <= mask.min() <= mask.max() <= 1
            rows, columns = np.flatnonzero((mask > 0.5).any(1)), np.flatnonzero((mask > 0.5).any(0))
            longer = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
            assert 0.72 * 64 <= longer <= 64
            assert rows[0] + rows[-1] == pytest.approx(63, abs=2)
            assert columns[0] + columns[-1] == pytest.approx(63, abs=2)
            assert 0.02 < mask.mean() < 0.6


def test_a_hand_keeps_its_slant_from_letter_to_letter():
    writers = range(14)
    measured = np.array(
        [[slant(nist_like(w, char, 0, 128)) for char in STEMS] for w in writers]
    )  # [W, letters]
    between = measured.mean(axis=1).var()
    within = measured.var(axis=1).mean() / len(STEMS)
    assert between > 10 * within
    # The hand's own slant adds to that of its base face, which its widening stretches.
    hands = [hand(w, 0) for w in writers]
    face = np.array([h.aspect * np.mean([slant(render_glyph(c, h.font, 128)) for c in STEMS]) for h in hands])
    asked = np.tan(np.radians([h.slant_deg for h in hands]))
    assert np.corrcoef(asked + face, measured.mean(axis=1))[0, 1] > 0.9


def test_a_hand_keeps_its_pen_from_letter_to_letter():
    def pen(mask):
        distance = distance_transform_edt(mask > 0.5)
        return 4 * distance[distance > 0].mean() / 128

    writers = range(14)
    measured = np.array([[pen(nist_like(w, char, 0, 128)) for char in "AEHKLOTX"] for w in writers])
    assert measured.std(axis=1).mean() < 0.5 * measured.mean(axis=1).std()
    asked = np.array([hand(w, 0).pen for w in writers])
    assert np.corrcoef(asked, measured.mean(axis=1))[0, 1] > 0.85
    assert measured.mean(axis=1).max() > 1.8 * measured.mean(axis=1).min()


def test_a_few_writers_already_span_the_range_and_share_no_hand():
    hands = [hand(w, 0) for w in range(TRAIN_WRITERS + 5)]
    pens, slants = np.array([h.pen for h in hands]), np.array([h.slant_deg for h in hands])
    assert np.ptp(pens[:8]) > 0.07
    assert np.ptp(slants[:8]) > 18
    assert len({h.font for h in hands[:7]}) == 7
    distance = np.hypot(pens[:, None] - pens, (slants[:, None] - slants) / 300)
    np.fill_diagonal(distance, 1)
    assert distance.min() > 1e-4
    # Faces do not follow from slant: every face meets upright and slanted writers.
    for face in {h.font for h in hands}:
        assert np.ptp([h.slant_deg for h in hands if h.font == face]) > 8


def test_held_out_writers_share_no_object_with_the_training_set():
    train = HandwritingGlyphs()
    test = HandwritingGlyphs(writers=2, first_writer=TRAIN_WRITERS)
    assert len(train.objects()) == 39 * 26 == 1014
    assert not set(train.objects()) & set(test.objects())
    target = test.target("writer39_B", seed=4)
    np.testing.assert_array_equal(target.mask, nist_like(39, "B", 4))


def test_bad_arguments_are_refused():
    for arguments in ((-1, "A", 0), (0, "A", 0, 4), (0, "A", 0, 64, 0.0), (0, "AB", 0)):
        with pytest.raises(DataError):
            nist_like(*arguments)


def test_strokes_have_the_faces_and_pens_that_are_asked_for():
    bold = Strokes("both", (0.12, 0.2))
    hands = [hand(writer, 0, bold) for writer in range(22)]
    assert {h.font.family for h in hands} >= {"Fredoka", "Nunito", "Quicksand", "Varela Round", "Caveat"}
    assert all(0.12 <= h.pen <= 0.2 for h in hands)
    widths = [pen_width(nist_like(writer, "H", 0, 128, strokes=bold)) for writer in range(11)]
    assert min(widths) > 0.1 and max(widths) < 0.26
    set_ = HandwritingGlyphs(writers=2, strokes=bold)
    np.testing.assert_array_equal(set_.target("writer01_B", 4).mask, nist_like(1, "B", 4, strokes=bold))
    # The default population is what it always was.
    np.testing.assert_array_equal(nist_like(1, "B", 4), nist_like(1, "B", 4, strokes=Strokes()))


def test_a_pen_is_measured_as_it_was_drawn():
    mask = np.zeros((100, 100), np.float32)
    mask[10:90, 40:52] = 1.0  # a bar of 12 pixels, 80 long
    assert pen_width(mask) == pytest.approx(12 / 80, rel=0.1)
    with pytest.raises(DataError, match="no ink"):
        pen_width(np.zeros((9, 9), np.float32))


@pytest.mark.parametrize(("arguments", "word"), [(("script",), "faces"), (("hand", (0.2, 0.1)), "pen")])
def test_wrong_strokes_are_refused(arguments, word):
    with pytest.raises(ConfigError, match=word):
        Strokes(*arguments)


def test_a_known_drawing_is_drawn_again_as_by_another_hand() -> None:
    known = render_glyph("R", find_font("kalam"), 128, 0.8)
    drawn = [redrawn(known, "R", number, 0) for number in range(4)]
    assert all(one.shape == known.shape and one.dtype == np.float32 for one in drawn)
    assert np.array_equal(drawn[1], redrawn(known, "R", 1, 0))
    size = max(np.ptp(np.nonzero(known > 0.5), axis=1))
    for one in drawn:
        assert np.abs(one - known).mean() > 0.01 and one.min() >= 0 and one.max() <= 1
        assert 0.8 * size < max(np.ptp(np.nonzero(one > 0.5), axis=1)) <= 1.02 * size
        assert pen_width(one) == pytest.approx(
            pen_width(known), rel=0.4
        )  # a quarter by itself, and proportions
    with pytest.raises(DataError, match="no ink"):
        redrawn(np.zeros((64, 64), np.float32), "R", 0, 0)


def test_redrawn_targets_are_objects_of_the_set(tmp_path) -> None:
    known = render_glyph("R", find_font("kalam"), 128, 0.8)
    Image.fromarray((255 * known).astype(np.uint8)).save(tmp_path / "lab_R.png")
    glyphs = HandwritingGlyphs(characters="A", writers=1, known=str(tmp_path), redrawn=2)
    assert glyphs.objects() == ["writer00_A", "redrawn00_lab_R", "redrawn01_lab_R"]
    target = glyphs.target("redrawn01_lab_R", seed=3)
    assert target.mask.shape == (128, 128) and target.size_m == glyphs.target_plane.size_m
    with pytest.raises(ConfigError, match="redrawn is 2"):
        HandwritingGlyphs(redrawn=2)
    (tmp_path / "lab_R.png").write_bytes(b"no image")
    other = tmp_path / "other"
    other.mkdir()
    for folder in (tmp_path / "none", other):
        with pytest.raises(ConfigError, match="holds no images"):
            HandwritingGlyphs(known=str(folder), redrawn=1).objects()


def test_hands_are_as_large_as_asked_and_where_asked():
    small = nist_like(3, "R", 0, 128, 0.7, Strokes(height=(0.5, 0.5)), (0.1, -0.15))
    box = ink_box(small) / 128
    assert max(box[2:] - box[:2]) == pytest.approx(0.7 * 0.5, rel=0.1)
    np.testing.assert_allclose((box[2:] + box[:2]) / 2, [0.1, -0.15], atol=0.02)
    with pytest.raises(ConfigError, match="ascending"):
        Strokes(height=(0.5, 1.2))
    with pytest.raises(ConfigError, match="centre is"):
        HandwritingGlyphs(centre=(0.0, 0.7))
    again = redrawn(small, "R", 2, 0)
    np.testing.assert_allclose(ink_box(again).reshape(2, 2).mean(axis=0) / 128, [0.1, -0.15], atol=0.02)


def test_the_ink_of_targets_is_found():
    mask = np.zeros((40, 40), np.float32)
    mask[10:20, 4:34] = 1
    one, empty = Target("bar", mask, 0.08), Target("nothing", np.zeros((8, 8)), 0.08)
    assert Ink.of([one, empty]) == Ink(0.06, (-0.002, -0.01))
    assert Ink.of([empty]) == Ink()


def test_writers_write_as_the_known_targets_are_written():
    plane = TargetPlane(size_m=0.1, size_px=128)
    known = HandwritingGlyphs(
        characters="ABC27",
        writers=2,
        strokes=Strokes("print", (0.1, 0.12), (0.9, 1.0)),
        target_plane=dataclasses.replace(plane, letter_fraction=0.5, digit_fraction=0.4),
        centre=(0.05, 0.1),
    )
    shown = [dataclasses.replace(known.target(name), name=name[-1]) for name in known.objects()]
    alike = written_alike(HandwritingGlyphs(target_plane=plane), shown)
    assert alike.target_plane.letter_fraction == pytest.approx(0.5, abs=0.03)
    assert alike.target_plane.digit_fraction == pytest.approx(0.4, abs=0.03)
    np.testing.assert_allclose(alike.centre, known.centre, atol=0.02)
    assert alike.strokes.height == (0.85, 1.0) and 0.05 < alike.strokes.pen[0] < alike.strokes.pen[1] < 0.2
    alone = written_alike(HandwritingGlyphs(target_plane=plane), [one for one in shown if one.name in "27"])
    assert alone.target_plane.letter_fraction == pytest.approx(0.53, abs=0.04)
    assert written_alike(known, [Target("nothing", np.zeros((8, 8)), 0.1)]) == known


def test_the_prior_has_the_size_and_the_place_of_the_ink():
    plane = Plane(32, 32, 0.002)
    whole, part = handwritten_prior(plane, 50), handwritten_prior(plane, 50, ink=Ink(0.03, (0.01, 0.0)))
    truth = dataclasses.replace(letters()[0], size_m=0.03).rasterise(plane, (0.01, 0.0))
    left = [np.square(p.image(p.coefficients(truth)) - truth).mean() for p in (whole, part)]
    assert left[1] < left[0] / 3
    ys, xs = np.nonzero(part.mean.reshape(32, 32) > 0.1)
    assert np.ptp(xs) * 0.002 < 0.04 and xs.mean() == pytest.approx(15.5 + 5, abs=1.5) and np.ptp(ys) < 20


def test_a_search_bends_the_right_letter_until_it_explains_a_measurement() -> None:
    """A letter seen through a random matrix, larger, turned and shifted: found, and close to as it is."""
    draw = np.random.default_rng(3)
    masks = torch.from_numpy(np.stack([one.mask for one in letters()[:200]])).float()
    angle, size = np.deg2rad(7), 0.9
    turn = size * torch.tensor([[np.cos(angle), -np.sin(angle), 0.06], [np.sin(angle), np.cos(angle), -0.04]])
    grid = F.affine_grid(turn.float()[None], [1, 1, 64, 64], align_corners=False)
    shown = F.grid_sample(masks[40][None, None], grid, align_corners=False)
    light = torch.from_numpy(draw.standard_normal((300, 32 * 32)))
    seen = light @ F.interpolate(shown, (32, 32), mode="area").flatten().double()

    def explained(targets: torch.Tensor) -> torch.Tensor:
        drawn = targets @ light.T
        return (drawn @ seen).clamp_min(0) ** 2 / drawn.square().sum(dim=1).clamp_min(1e-9)

    found = best_bent(masks, (32, 32), explained)
    assert (found - shown[0, 0]).square().mean() < 0.1 * (masks[40] - shown[0, 0]).square().mean()
    assert torch.equal(found, best_bent(masks, (32, 32), explained))
