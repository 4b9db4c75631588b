"""The README works as written: its Python prints what it says, its YAML loads, its commands and files exist."""

import contextlib
import io
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

import chromium
from evnlos.cli import VERBS, main
from evnlos.cli.main import command_of
from evnlos.cli.parsing import parse
from evnlos.config import from_dict
from evnlos.data import CaptureInfo, Simulation
from test_cli_events import moving_bar
from test_video import write_container

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", TEXT, flags=re.DOTALL)


def test_python_snippets_print_what_they_say() -> None:
    names: dict = {}
    compared = 0
    for (kind, code), (_, printed) in zip(BLOCKS, [*BLOCKS[1:], ("", "")], strict=True):
        if kind == "python":
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(code, names)
            assert out.getvalue() == printed
            compared += 1
    assert compared == 1


def test_yaml_snippets_load() -> None:
    page = (ROOT / "docs" / "quickstart.md").read_text()
    page = page[page.index("## A capture and settings in YAML") :]
    capture, settings = map(yaml.safe_load, re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL))
    assert from_dict(Simulation, settings).pixel.refractory_s == 0.001
    assert from_dict(CaptureInfo, capture).target.name == "R"


def test_every_command_is_listed() -> None:
    page = (ROOT / "docs" / "command_line.md").read_text()
    table = page[page.index("| command |") : page.index("## What goes where")]
    assert set(re.findall(r"`evnlos (\w+)", table)) == set(VERBS)


def test_the_readme_is_three_screens_with_three_doors(tmp_path) -> None:
    """In a column as wide as code hosts show it beside their margins, in letters as large as theirs."""
    assert "| I want events | I have a wall | I want to learn |" in TEXT
    assert "docs/figures/setup_paper.svg" in TEXT
    if chromium.missing():
        pytest.skip(f"{chromium.missing()}: apt-get install chromium chromium-driver")
    markdown = pytest.importorskip("markdown")
    body = markdown.markdown(TEXT.replace("docs/figures", f"{ROOT}/docs/figures"), extensions=["extra"])
    style = (
        "body{font:16px/1.5 Helvetica,Arial,sans-serif;width:838px;margin:0} img{max-width:100%}"
        "p,ul,table,pre{margin:0 0 16px} h1,h2{margin:24px 0 16px;padding-bottom:8px;border-bottom:1px solid}"
        "pre{padding:16px;font-size:13.6px;line-height:1.45} td,th{padding:6px 13px;border:1px solid}"
        "table{border-collapse:collapse} li+li{margin-top:4px}"
    )
    (tmp_path / "readme.html").write_text(f"<meta charset=utf-8><style>{style}</style>{body}")
    with chromium.Chromium(tmp_path / "profile") as browser:
        browser.open((tmp_path / "readme.html").as_uri())
        assert browser.run("return [...document.images].every(one => one.naturalWidth)")
        assert browser.run("return document.body.scrollHeight") <= 3 * 1080


def test_the_way_from_pip_to_an_image_is_short() -> None:
    """Three commands to events, five to a reconstructed image, and neither make nor a compiler."""
    text = TEXT[TEXT.index("## Install") : TEXT.index("## What it measures")]
    events, picture, *_ = re.findall(r"(?:^    .*\n)+", text, flags=re.MULTILINE)
    for commands, most in ((events, 3), (picture, 5)):
        lines = commands.strip().splitlines()
        assert len(lines) <= most and lines[0].strip().startswith("pip install") and "make" not in commands
    assert "evnlos invert" in picture and "evnlos events" in events


@pytest.mark.parametrize(
    "name", ["README.md", "CONTRIBUTING.md", *(f"docs/{p.name}" for p in ROOT.glob("docs/*.md"))]
)
def test_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    for target in re.findall(r"(?:\]\(|src=\")(?!https?:)([^)#\"]+)", page.read_text()):
        assert (page.parent / target).exists(), f"{name} links to {target}"


def test_make_targets_named_in_the_readme_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in set(re.findall(r"(?:^ +|`)make (\w+)", TEXT, flags=re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_the_commands_of_the_events_door_run(tmp_path, monkeypatch, capsys) -> None:
    """As they are written, on a video of the name that they use."""
    monkeypatch.chdir(tmp_path)
    write_container(tmp_path / "clip.mp4", moving_bar(), list(range(0, 480, 40)))
    text = TEXT[TEXT.index("## Install") :]
    lines = re.search(r"(?:^    .*\n)+", text, flags=re.MULTILINE)[0].strip().splitlines()
    commands = [shlex.split(line)[1:] for line in lines if line.strip().startswith("evnlos ")]
    assert [words[0] for words in commands] == ["events", "preview"]
    for words in commands:
        main(words)
    assert {path.name for path in tmp_path.iterdir()} == {"clip.mp4", "events.h5", "events.gif"}


@pytest.mark.slow
def test_the_commands_to_a_reconstructed_letter_run(tmp_path, monkeypatch, capsys) -> None:
    """As they are written; and a published network reconstructs the same capture."""
    monkeypatch.chdir(tmp_path)
    text = TEXT[TEXT.index("**a reconstructed letter**") :]
    lines = re.search(r"(?:^    .*\n)+", text, flags=re.MULTILINE)[0].strip().splitlines()
    assert lines[0].strip().startswith("pip install") and "evnlos-weights" in lines[0]
    commands = [shlex.split(line)[1:] for line in lines[1:]]
    assert [words[0] for words in commands] == ["lab", "invert", "identify"]
    for words in commands:
        main(words)
    shown = capsys.readouterr().out
    decibel = re.search(r"^ +40 +([\d.]+) dB +([\d.]+) dB$", shown, flags=re.MULTILINE)
    assert float(decibel[1]) > 18 and float(decibel[2]) > 18.5 and "patterns can be distinguished" in shown
    main(["reconstruct", "captures/lab_R", "--weights", "near-frame-sequence", "--out", "learned"])
    assert float(re.search(r"psnr_db ([\d.]+)", capsys.readouterr().out)[1]) > 20
    assert {"result.png", "summary.json"} <= {path.name for path in Path("learned").iterdir()}


def test_the_commands_behind_the_figures_are_whole() -> None:
    """Their words fit what the commands take; they need hours, so that only their words are read."""
    text = TEXT[TEXT.index("## What it measures") : TEXT.index("## In Python")]
    lines = re.findall(r"^    evnlos (.*)$", text, flags=re.MULTILINE)
    assert [line.split()[0] for line in lines] == ["experiment", "experiment", "identify"]
    for line in lines:
        verb, *words = shlex.split(line)
        command = parse(command_of(verb), words, verb)
        if verb == "experiment":
            command.check_names()
            assert command.captures == Path("captures") and command.captures_of == "near"
        else:
            assert command.bounds and all((ROOT / name).exists() for name in command.setups)


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
def test_make_says_that_it_sets_up_before_minutes_of_silence() -> None:
    call = ["make", "-n", "-B", ".venv/.ready"]
    shown = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "setting up .venv, some minutes" in shown.partition("pip install")[0]


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
def test_captures_and_results_of_the_demo_may_have_spaces_in_their_names() -> None:
    """`make demo CAPTURES="my shots/a"` handed over two words, `my` and `shots/a`."""
    call = ["make", "-n", "-o", ".venv/.ready", "demo", "CAPTURES=my shots/*", "DEMO=my demo"]
    said = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    words = shlex.split(next(line for line in said if "evnlos demo" in line))
    assert words[1:] == ["demo", "--out", "my demo", "--captures", "my shots/*"]
