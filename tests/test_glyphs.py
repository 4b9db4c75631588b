"""Fonts, glyphs, the readers of handwriting databases, and the sets of objects made from them."""

import gzip
import struct
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from evnlos import config, doctor
from evnlos.cli import main
from evnlos.data import read_capture
from evnlos.errors import ConfigError, DataError, EvnlosError, MissingDependencyError
from evnlos.scene import (
    EmnistGlyphs,
    FontGlyphs,
    HandwritingGlyphs,
    NistGlyphs,
    PictureGlyphs,
    TargetPlane,
    character_name,
    find_font,
    fit_to_target_plane,
    fonts,
    list_emnist,
    list_sd19,
    read_emnist_images,
    read_sd19_image,
    render_glyph,
)


def ink_box(mask):
    rows, columns = np.flatnonzero((mask > 0.5).any(1)), np.flatnonzero((mask > 0.5).any(0))
    return columns[0], rows[0], columns[-1] + 1, rows[-1] + 1


def comic_neue():
    font = find_font("Comic Neue Bold")
    if font.substituted_for:
        pytest.skip("Comic Neue is not installed (Debian package fonts-comic-neue)")
    return font


# Fonts


def test_packaged_families_are_found_by_name_and_weight():
    assert find_font("Caveat Bold").weight == 700
    assert find_font("kalam light").path.name == "Kalam-Light.ttf"
    assert find_font("Indie Flower").note is None


def test_a_weight_that_is_not_there_is_reported():
    font = find_font("Indie Flower Bold")
    assert (font.family, font.weight, font.substituted_for) == ("Indie Flower", 400, "Indie Flower Bold")
    assert "weight 400 stands in" in font.note


def test_variable_weights_reach_the_drawing():
    thin, bold = (render_glyph("H", find_font(name), 64) for name in ("Caveat", "Caveat Bold"))
    assert bold.sum() > 1.15 * thin.sum()


def test_comic_neue_bold_is_the_bold_file():
    assert "Bold" in comic_neue().path.stem
    assert "Italic" not in comic_neue().path.stem
    assert "Italic" in find_font("Comic Neue Bold Italic").path.stem


def test_a_comic_font_that_is_not_installed_is_replaced_and_said(monkeypatch):
    others = tuple(one for one in fonts.installed_fonts() if "comic" not in one.family.casefold())
    monkeypatch.setattr(fonts, "installed_fonts", lambda: others)
    font = find_font("Comic Neue Bold")
    assert (font.family, font.weight, font.substituted_for) == ("Kalam", 700, "Comic Neue Bold")
    assert "fonts-comic-neue" in font.note
    with pytest.raises(MissingDependencyError, match="fonts-comic-neue"):
        find_font("Comic Neue Bold", strict=True)
    assert any("fonts-comic-neue" in line for line in FontGlyphs().notes())


def test_without_the_open_families_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "fontpkg", None)
    monkeypatch.setattr(fonts, "which", lambda _: "fc-list")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(stdout=b""))  # it knows no font
    monkeypatch.setattr(fonts, "installed_fonts", fonts.installed_fonts.__wrapped__)
    with pytest.raises(MissingDependencyError, match=r"evnlos\[fonts\]"):
        find_font("Caveat")
    parts = [part for part in doctor.examine() if part.name in ("fonts", "comic face")]
    assert (
        len(parts) == 2 and not any(part.there or part.needed for part in parts) and "[fonts]" in parts[0].cure
    )


def test_a_font_file_is_taken_as_it_is(tmp_path):
    path = find_font("Kalam Bold").path
    assert find_font(path).weight == 700
    assert find_font(str(path)).family == "Kalam"
    (tmp_path / "bad.ttf").write_bytes(b"not a font")
    for bad in (tmp_path / "bad.ttf", tmp_path / "none.ttf", str(tmp_path / "none.otf")):
        with pytest.raises(ConfigError, match="font"):
            find_font(bad)


def test_an_unknown_family_names_the_nearest_one():
    with pytest.raises(ConfigError, match="'Indie Flower'"):
        find_font("Indy Flower")
    with pytest.raises(ConfigError, match="empty"):
        find_font(" ")


def test_folders_are_scanned_where_fontconfig_is_not_there(monkeypatch, tmp_path):
    path = find_font("Kalam Bold").path
    folder = tmp_path / ".fonts"
    (folder / "sub").mkdir(parents=True)
    (folder / "sub" / "k.ttf").write_bytes(path.read_bytes())
    (folder / "broken.ttf").write_bytes(b"x")
    monkeypatch.setattr(fonts, "which", lambda name: None)
    monkeypatch.setenv("HOME", str(tmp_path))
    found = [font for font in fonts.installed_fonts.__wrapped__() if folder in font.path.parents]
    assert [(font.family, font.weight) for font in found] == [("Kalam", 700)]


# Glyphs


@pytest.mark.parametrize("char", "AIMWgQ1-")
@pytest.mark.parametrize("fraction", [1.0, 0.6])
def test_a_glyph_fills_its_part_of_the_target_and_is_centred(char, fraction):
    mask = render_glyph(char, find_font("Kalam Bold"), 128, fraction)
    left, top, right, bottom = ink_box(mask)
    assert max(right - left, bottom - top) == pytest.approx(128 * fraction, abs=2)
    assert (left + right) / 2 == pytest.approx(64, abs=1)
    assert (top + bottom) / 2 == pytest.approx(64, abs=1)
    assert mask.dtype == np.float32
    assert 0 <= mask.min() <= mask.max() == 1


def test_a_glyph_is_antialiased_and_independent_of_resolution():
    small, large = (render_glyph("S", find_font("Kalam Bold"), size, 0.8) for size in (64, 512))
    assert ((small > 0.1) & (small < 0.9)).sum() > 50
    reduced = large.reshape(64, 8, 64, 8).mean((1, 3))
    assert np.abs(small - reduced).mean() < 0.01


def test_a_glyph_that_cannot_be_drawn_is_refused():
    font = find_font("Indie Flower")
    for char in ("中", " "):
        with pytest.raises(ConfigError, match="cannot draw"):
            render_glyph(char, font)
    for arguments in (("AB", font), ("A", font, 4), ("A", font, 64, 1.2), ("A", font, 64, 0.0)):
        with pytest.raises(DataError):
            render_glyph(*arguments)


def test_names_stay_distinct_when_case_is_ignored():
    everything = [chr(code) for code in range(33, 127)] + list("äÄé中")
    names = [character_name(char).lower() for char in everything]
    assert len(set(names)) == len(names)
    assert all(name.replace("_", "").isalnum() and name.isascii() for name in names)


def test_fit_to_target_plane_cuts_scales_and_centres():
    picture = np.zeros((40, 60))
    picture[3:13, 41:46] = 1
    left, top, right, bottom = ink_box(fit_to_target_plane(picture, 128, 0.75))
    assert bottom - top == pytest.approx(96, abs=1)
    assert right - left == pytest.approx(48, abs=1)
    assert (left + right, top + bottom) == (pytest.approx(128, abs=2), pytest.approx(128, abs=2))
    for bad in (np.zeros((4, 4)), np.ones(4), np.full((3, 3), np.nan)):
        with pytest.raises(DataError):
            fit_to_target_plane(bad)


# The user's own databases


def character_image(side):
    """A thick L: neither transposing nor inverting it goes unseen."""
    mask = np.zeros((side, side), np.float32)
    mask[side // 4 : 3 * side // 4, side // 3 : side // 3 + side // 8] = 1
    mask[5 * side // 8 : 3 * side // 4, side // 3 : 2 * side // 3] = 1
    return mask


@pytest.fixture
def sd19(tmp_path):
    """Three images of "A" and "l" in the official layout: 128 x 128 RGB, black on white."""
    ink = np.repeat((255 * (1 - character_image(128)))[..., None], 3, axis=2).astype(np.uint8)
    for code in ("41", "6c"):
        for partition in ("hsf_0", "hsf_4", f"train_{code}"):
            folder = tmp_path / "by_class" / code / partition
            folder.mkdir(parents=True)
            for number in range(3):
                Image.fromarray(ink).save(folder / f"{partition}_{number:05d}.png")
        (tmp_path / "by_class" / code / "hsf_0.mit").write_text("3\n")
    return tmp_path


def test_sd19_is_read_upright_and_bright_on_dark(sd19):
    found = list(list_sd19(sd19, "Al", "hsf_0"))
    assert [(char, source) for char, source, _ in found] == [
        (char, f"hsf_0_0000{number}") for char in "Al" for number in range(3)
    ]
    np.testing.assert_array_equal(read_sd19_image(found[0][2]), character_image(128))
    chosen = list_sd19(sd19 / "by_class", "A", "train", first=1, count=1)
    assert [source for _, source, _ in chosen] == ["train_41_00001"]


def test_sd19_says_what_is_missing(sd19):
    with pytest.raises(DataError, match="42/hsf_0"):
        list(list_sd19(sd19, "B"))
    with pytest.raises(DataError, match="holds 3 images"):
        list(list_sd19(sd19, "A", count=4))
    with pytest.raises(DataError, match="hsf_0 to hsf_8"):
        list(list_sd19(sd19, "A", partition="hsf_9"))
    _, _, first = next(iter(list_sd19(sd19, "A")))
    first.write_bytes(b"no image")
    with pytest.raises(DataError, match="no image"):
        read_sd19_image(first)
    Image.new("L", (2000, 10)).save(first)
    with pytest.raises(DataError, match="128 x 128"):
        read_sd19_image(first)


def test_sd19_objects_become_targets(sd19):
    glyphs = NistGlyphs(folder=str(sd19), characters="A", per_character=2, target_plane=TargetPlane(size_px=64))
    assert glyphs.objects() == ["nist_hsf_0_00000_A", "nist_hsf_0_00001_A"]
    later = NistGlyphs(folder=str(sd19), characters="A", first=2, per_character=1)
    assert not set(glyphs.objects()) & set(later.objects())
    left, top, right, bottom = ink_box(glyphs.target(glyphs.objects()[0]).mask)
    assert (top, bottom) == (0, 64)
    assert left + right == pytest.approx(64, abs=1)


def write_emnist(folder, labels=(10, 11, 10, 0), part="train", directory_lock=None):
    folder.mkdir(exist_ok=True)
    stored = np.stack([character_image(28).T * 255] * len(labels)).astype(np.uint8)
    stem = f"emnist-byclass-{part}"
    count = len(labels) if directory_lock is None else directory_lock
    with gzip.open(folder / f"{stem}-images-idx3-ubyte.gz", "wb") as file:
        file.write(struct.pack(">4I", 0x803, count, 28, 28) + stored.tobytes())
    with gzip.open(folder / f"{stem}-labels-idx1-ubyte.gz", "wb") as file:
        file.write(struct.pack(">2I", 0x801, len(labels)) + bytes(labels))
    (folder / "emnist-byclass-mapping.txt").write_text("0 48\n10 65\n11 66\n")
    return folder


def read_emnist(folder, characters):
    return dict(read_emnist_images(folder, [number for _, number in list_emnist(folder, characters)]))


def test_emnist_is_turned_upright(tmp_path):
    folder = write_emnist(tmp_path / "e")
    assert list_emnist(folder, "AB") == [("A", 0), ("B", 1), ("A", 2)]
    np.testing.assert_array_equal(read_emnist(folder, "AB")[0], character_image(28))
    assert list_emnist(folder, "A", first=1, count=1) == [("A", 2)]


def test_emnist_objects_become_targets(tmp_path):
    folder = write_emnist(tmp_path / "e")
    glyphs = EmnistGlyphs(
        folder=str(folder), characters="A0", per_character=1, target_plane=TargetPlane(size_px=128)
    )
    assert glyphs.objects() == ["emnist_byclass_train_000000_A", "emnist_byclass_train_000003_0"]
    letter, digit = (ink_box(glyphs.target(name).mask) for name in glyphs.objects())
    assert letter[3] - letter[1] == 128
    assert digit[3] - digit[1] == pytest.approx(96, abs=2)


def test_damaged_emnist_files_are_refused(tmp_path):
    folder = write_emnist(tmp_path / "e")
    images = folder / "emnist-byclass-train-images-idx3-ubyte.gz"
    with pytest.raises(DataError, match="holds 1 images of 'B'"):
        list_emnist(folder, "B", count=2)
    with pytest.raises(DataError, match="test-labels"):
        list_emnist(folder, "A", part="test")
    whole = images.read_bytes()
    images.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"damaged|ends early"):
        read_emnist(folder, "A")
    images.write_bytes(b"plain bytes")
    with pytest.raises(DataError, match="damaged"):
        read_emnist(folder, "A")
    write_emnist(folder, directory_lock=3_000_000_000)
    with pytest.raises(DataError, match="promises"):
        read_emnist(folder, "A")
    write_emnist(folder, directory_lock=5)
    with pytest.raises(DataError, match="ends early"):
        read_emnist(folder, "A")
    (folder / "emnist-byclass-mapping.txt").write_text("ten A\n")
    with pytest.raises(DataError, match="mapping"):
        list_emnist(folder, "A")


@pytest.mark.parametrize("seed", range(30))
def test_fuzzed_emnist_files_never_escape_as_another_error(tmp_path, seed):
    folder = write_emnist(tmp_path / "e")
    rng = np.random.default_rng(seed)
    for path in sorted(folder.iterdir()):
        content = bytearray(path.read_bytes())
        for place in rng.integers(0, len(content), 3):
            content[place] = rng.integers(0, 256)
        path.write_bytes(bytes(content))
    try:
        read_emnist(folder, "A")
    except EvnlosError as error:
        assert "\n" not in str(error)


# Sets of objects


def test_objects_are_unique_file_names_on_any_system():
    glyphs = HandwritingGlyphs(writers=3, characters="AaBb01")
    names = glyphs.objects()
    assert names[:2] == ["writer00_A", "writer00_lower_a"]
    assert len({name.lower() for name in names}) == len(names) == 18


def test_font_objects_and_the_smaller_digits():
    glyphs = FontGlyphs(family="Kalam Bold", characters="A7", target_plane=TargetPlane(size_px=128))
    letter, digit = (glyphs.target(name) for name in glyphs.objects())
    assert (letter.name, letter.size_m) == ("kalam_bold_A", 0.08)
    assert ink_box(letter.mask)[3] - ink_box(letter.mask)[1] == pytest.approx(128, abs=1)
    assert ink_box(digit.mask)[3] - ink_box(digit.mask)[1] == pytest.approx(96, abs=1)
    assert glyphs.notes() == []


def test_comic_glyphs_resemble_the_drawings_of_the_captures(shared_data):
    comic_neue()
    glyphs = FontGlyphs()
    for char in "AEIMTWXZ":
        drawing = np.asarray(Image.open(shared_data / f"captures/near_{char}/target.png")) / 255
        # The drawings are not centred by their ink and fill a little less than the target: fit both alike.
        ours, theirs = glyphs.target(f"comic_neue_bold_{char}").mask, fit_to_target_plane(drawing)
        assert np.minimum(ours, theirs).sum() / np.maximum(ours, theirs).sum() > 0.95


def test_sets_round_trip_through_a_settings_file(tmp_path):
    for glyphs in (
        HandwritingGlyphs(writers=2, characters="AB"),
        FontGlyphs(family="Kalam"),
        NistGlyphs(folder="x"),
        EmnistGlyphs(part="test", target_plane=TargetPlane(size_m=0.05)),
    ):
        config.save_yaml(glyphs, tmp_path / "glyphs.yaml")
        assert config.load_yaml(type(glyphs), tmp_path / "glyphs.yaml") == glyphs


@pytest.mark.parametrize(
    "build",
    [
        lambda: HandwritingGlyphs(characters=""),
        lambda: HandwritingGlyphs(characters="AA"),
        lambda: HandwritingGlyphs(writers=0),
        lambda: FontGlyphs(characters="A B"),
        lambda: NistGlyphs(per_character=0),
        lambda: EmnistGlyphs(first=-1),
        lambda: TargetPlane(size_m=-1),
        lambda: TargetPlane(digit_fraction=2),
        lambda: HandwritingGlyphs().target("writer99_A"),
        lambda: NistGlyphs(folder="/nowhere").objects(),
    ],
)
def test_bad_settings_are_refused(build):
    with pytest.raises(EvnlosError):
        build()


def test_pictures_of_any_size_and_depth_are_targets(tmp_path):
    ramp = np.tile(np.linspace(0, 255, 120).astype(np.uint8), (60, 1))
    Image.fromarray(ramp).save(tmp_path / "ramp.png")
    Image.fromarray(ramp.astype(np.uint16) * 257).save(tmp_path / "deep one.png")
    clear = np.zeros((5, 5, 4), np.uint8)
    clear[..., :3], clear[2, 2, 3] = 255, 255  # white, but transparent around its middle
    Image.fromarray(clear).save(tmp_path / "clear.png")
    (tmp_path / "notes.txt").write_text("no picture")
    glyphs = PictureGlyphs(folder=str(tmp_path), target_plane=TargetPlane(size_m=0.8, size_px=40))
    assert glyphs.objects() == ["clear", "deep_one", "ramp"]
    mask = glyphs.target("ramp").mask
    assert mask.shape == (40, 40) and glyphs.target("ramp").size_m == 0.8
    assert not mask[:10].any() and not mask[30:].any()  # as wide as the target, half as high
    np.testing.assert_allclose(mask[10:30].mean(axis=0), (np.arange(40) + 0.5) / 40, atol=0.01)
    np.testing.assert_allclose(glyphs.target("deep_one").mask, mask, atol=0.01)
    assert glyphs.target("clear").mask.sum() == pytest.approx(64, rel=0.05)  # 1 of 25 parts


def test_pictures_that_cannot_be_targets_are_named(tmp_path):
    def of(folder):
        return PictureGlyphs(folder=str(folder))

    with pytest.raises(ConfigError, match="is no folder"):
        of(tmp_path / "nowhere").objects()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="holds no pictures"):
        of(tmp_path / "empty").objects()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n torn")
    Image.new("L", (9, 9)).save(tmp_path / "bad" / "night.png")
    Image.new("F", (9, 9), 0.5).save(tmp_path / "bad" / "float.tif")
    for name, reason in (("torn", "torn.png"), ("night", "is black"), ("float", "floating-point")):
        with pytest.raises(DataError, match=reason):
            of(tmp_path / "bad").target(name)
    (tmp_path / "twice").mkdir()
    for name in ("a.png", "A.gif"):
        Image.new("L", (9, 9), 200).save(tmp_path / "twice" / name)
    with pytest.raises(ConfigError, match="rename one of them"):
        of(tmp_path / "twice").objects()


def test_the_commands_take_pictures_by_one_flag(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    Image.new("L", (30, 20), 200).save(tmp_path / "mine" / "slab.png")
    size = ["--setup.sensor.height", "24", "--setup.sensor.width", "36", "--duration-s", "0.6"]
    main(["lab", "--out", str(tmp_path / "out"), "--pictures", str(tmp_path / "mine"), *size])
    target = read_capture(tmp_path / "out" / "lab_slab").target
    assert target is not None and 0 < target.mask.mean() < 0.6
    main(["simulate", "--out", str(tmp_path / "data"), "--pictures", str(tmp_path / "mine"), "--dry-run"])
    capsys.readouterr()
    for word, reason in (("nowhere", "is no folder"), ("out", "holds no pictures")):
        for verb in ("lab", "simulate"):
            with pytest.raises(SystemExit):
                main([verb, "--out", str(tmp_path / verb), "--pictures", str(tmp_path / word)])
            assert reason in capsys.readouterr().err
