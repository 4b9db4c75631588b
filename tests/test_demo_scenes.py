"""Scenes of the demo: their commands exist, run in their folder, go on, and end in a page."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import evnlos.demo
from evnlos.cli import VERBS, main
from evnlos.demo import Demo, HiddenScene, run_scene, scene_of
from evnlos.errors import ConfigError, DataError, UnknownNameError

NAMES = list(yaml.safe_load(Path(evnlos.demo.__file__).with_name("scenes.yaml").read_text()))
TINY = HiddenScene(
    "A <small> letter",
    "An L.",
    "Its place.",
    "Its strokes.",
    (
        "evnlos lab --config tiny.yaml --out made",
        "evnlos preview made/tiny_L/events.raw --out events.gif",
        "evnlos invert made/tiny_[L] --setup main-near --solver tikhonov --out found.png",
        "evnlos info made/tiny_L/events.raw",
    ),
    {"made/tiny_L/target.png": "hidden & known", "events.gif": "the events"},
    {
        "tiny.yaml": {
            "name": "tiny",
            "glyphs": {"kind": "font", "family": "kalam", "characters": "L"},
            "frame_rate_hz": 1.0,
            "setup": {"kind": "radiometric", "sensor": {"height": 24, "width": 36}, "cell_m": 0.01},
        }
    },
)


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_states_commands_that_are_there_and_pictures_that_they_make(name):
    scene = scene_of(name)
    words = [shlex.split(step) for step in scene.steps]
    assert all(one[0] == "evnlos" and one[1] in VERBS for one in words)
    for step in words:  # --help parses nothing of the rest; a wrong flag would be refused when it runs
        flags = [word for word in step if word.startswith("--")]
        assert len(set(flags)) == len(flags)
    written = " ".join(scene.steps)
    for file in scene.pictures:
        stem = Path(file).stem.rpartition("_")[0] or Path(file).stem
        assert stem in written or file.split("/")[0] in written or file == "corner/result.png"
    assert all(file in written for file in scene.files)


def test_the_gallery_shows_what_each_scene_finds():
    """A picture of each, and the name of the scene's file that it is, in the order of the table."""
    page = (Path(__file__).resolve().parent.parent / "docs" / "gallery.md").read_text(encoding="utf-8")
    parts = dict(re.findall(r"^### (\w+)\n(!\[[^]]+\]\(figures/[^)]+\)\n\n.*)$", page, flags=re.MULTILINE))
    assert [name.lower() for name in parts] == re.findall(r"^\| `(\w+)` \|", page, flags=re.MULTILINE) == NAMES
    for title, part in parts.items():
        assert re.findall(r"^`([^`]+)`", part, flags=re.MULTILINE)[0] in scene_of(title.lower()).pictures


def test_a_scene_runs_goes_on_and_shows_what_its_commands_said(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(evnlos.demo, "scene_of", lambda name: TINY)
    page = run_scene("tiny", tmp_path / "tiny").read_text()
    shown = capfd.readouterr().out
    assert "1 of 4: evnlos lab" in shown and "1 capture" in shown and "page: " in shown
    assert "A &lt;small&gt; letter" in page and "hidden &amp; known" in page and "http" not in page
    assert page.count("data:image/png") == 1 and page.count("data:image/gif") == 1
    assert "$ evnlos info made/tiny_L/events.raw\n" in page and "36 x 24" in page
    lacking = replace(TINY, pictures={**TINY.pictures, "undrawn.png": "nothing"})
    monkeypatch.setattr(evnlos.demo, "scene_of", lambda name: lacking)
    assert "undrawn.png is not there" in run_scene("tiny", tmp_path / "tiny").read_text()
    broken = replace(TINY, steps=(*TINY.steps, "evnlos info nowhere.raw"))
    monkeypatch.setattr(evnlos.demo, "scene_of", lambda name: broken)
    with pytest.raises(DataError, match=r"step 5 of the scene 'tiny' failed; the command again goes on there"):
        run_scene("tiny", tmp_path / "tiny")
    told = capfd.readouterr()
    assert "1 of 5" not in told.out and "5 of 5" in told.out and "nowhere.raw" in told.err


def test_a_scene_is_named_and_takes_nothing_beside_its_folder(tmp_path, capsys):
    with pytest.raises(UnknownNameError, match=f"give one of {', '.join(NAMES)}"):
        Demo(scene="moon")
    with pytest.raises(ConfigError, match="takes `out` alone"):
        Demo(scene=NAMES[0], writers=3)
    with pytest.raises(SystemExit):
        main(["demo", "--scene", "moon", "--out", str(tmp_path / "x")])
    assert "moon" in capsys.readouterr().err and not (tmp_path / "x").exists()
