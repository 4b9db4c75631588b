"""The pages are true: their Python prints what they say, their flags and error messages are the code's."""

import ast
import contextlib
import io
import json
import re
import shlex
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import evnlos
import evnlos.types
from evnlos.cli import VERBS, main
from evnlos.cli.main import command_of
from evnlos.config import save_yaml
from evnlos.setups import ROOMS, TRAINING_FILE
from test_tutorials import LEFT_OUT, commands_of, tutorials

SOURCE = Path(evnlos.__file__).parent
ROOT = SOURCE.parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", *DOCS.glob("*.md")])


NEEDS_A_CLUSTER = {"scale": "dask_jobqueue"}
"""Pages whose Python is only compiled, and what it needs."""


@pytest.mark.parametrize("name", sorted(page.stem for page in PAGES if "```python\n" in page.read_text()))
def test_python_on_a_page_runs_and_prints_what_it_says(name: str, tmp_path, monkeypatch) -> None:
    if name == "README":
        pytest.skip("tests/test_readme.py runs it")
    text = (DOCS / f"{name}.md").read_text()
    monkeypatch.chdir(tmp_path)
    write_recordings()
    names: dict = {"__name__": "page"}
    monkeypatch.setitem(sys.modules, "page", type(sys)("page"))
    blocks = re.findall(r"```python\n(.*?)```(?:\n```\n(.*?)```)?", text, flags=re.DOTALL)
    assert blocks
    for code, printed in blocks:
        out = io.StringIO()
        run = compile(code, f"{name}.md", "exec")
        if name in NEEDS_A_CLUSTER:
            assert f"from {NEEDS_A_CLUSTER[name]} import" in code
            continue
        with contextlib.redirect_stdout(out):
            exec(run, names)
        assert not printed or out.getvalue() == printed


def write_recordings() -> None:
    """Write the files that pages read: a recording of a tenth of a second, whole and cut."""
    rng = np.random.default_rng(0)
    t_us = np.sort(rng.integers(0, 100_000, 2000))
    events = evnlos.types.Events(
        t_us, rng.integers(0, 64, 2000), rng.integers(0, 48, 2000), rng.random(2000) < 0.5, 64, 48
    )
    evnlos.write_events("recording.raw", events)
    Path("damaged.raw").write_bytes(Path("recording.raw").read_bytes()[:-501])


def test_the_index_lists_every_page() -> None:
    listed = set(re.findall(r"\]\(([\w.]+\.md)\)", (DOCS / "README.md").read_text()))
    assert listed == {page.name for page in DOCS.glob("*.md")} - {"README.md"}
    examples = set(
        re.findall(r"\(\.\./(examples/\w+\.py|notebooks/\w+\.ipynb)\)", (DOCS / "README.md").read_text())
    )
    there = {*ROOT.glob("examples/[0-9]*.py"), *ROOT.glob("notebooks/*.ipynb")}
    assert examples == {str(path.relative_to(ROOT)) for path in there}


def test_the_home_of_the_site_shows_the_setup_and_the_film() -> None:
    shown = re.findall(r"!\[[^]]+\]\(figures/([\w.]+)\)", (DOCS / "README.md").read_text())
    assert {"setup_paper.svg", "learned_film.webp"} <= set(shown)


def test_headings_that_links_name_exist() -> None:
    for page in PAGES:
        for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#([^)]+)\)", page.read_text()):
            other = (page.parent / target) if target else page
            heads = re.findall(r"^#+ (.*)$", other.read_text(), flags=re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}
            assert anchor in slugs, f"{page.name} links to {target}#{anchor}"


def commands_on(page: Path) -> list[str]:
    """Return the commands that a page shows, in code set apart or in a line; continued lines joined."""
    return [command for command, _ in commands_and_parts(page)]


def commands_and_parts(page: Path) -> list[tuple[str, bool]]:
    """Return the commands that a page shows, and whether each stands in a line, perhaps in part."""
    text = re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))
    shown = [(line, False) for line in re.findall(r"^(?:    |> )?(evnlos [a-z-].*)$", text, flags=re.MULTILINE)]
    shown += [(" ".join(line.split()), True) for line in re.findall(r"`(evnlos [^`]*)`", text)]
    parts = [(part.strip(), within) for line, within in shown for part in re.split(r"&&|\||;|#| > ", line)]
    return [(part, within) for part, within in parts if part.startswith("evnlos ")]


STANDS_FOR = {
    "COMMAND": "train",
    "simulate ...": "simulate --out sim",
    " X Y": " 9 9",
    " --arms ARMS": "",
    "--scene NAME": "--scene colour",
    "experiment NAME": "experiment surface",
    "--precision P": "--precision bf16",
    "--trainings N": "--trainings 2",
}
"""By what a reader fills in with a number or one of some names: what the parser takes."""
NOT_HERE = r"[^; ]+: no such file; check the path|\S+ holds no folders of captures; .*?(?=; |$)"
"""What is said of files that a reader has, or makes before."""
A_PART = r"Missing (from|value)(\(.*?\)|[^;(])*|no captures given; [^;]*"
"""What is said of a command in a line that stands there in part."""


def test_every_command_of_every_page_parses(tmp_path, monkeypatch, capsys) -> None:
    """Else it has a verb, flag, choice, name of an arm or number of words that no command takes.

    Those that `test_tutorials.py` runs are left to it.
    """
    monkeypatch.chdir(tmp_path)
    kinds = {verb: command_of(verb) for verb in VERBS}
    for verb, kind in kinds.items():
        monkeypatch.setattr(kind, "run", kind.check_names if verb == "experiment" else lambda self: None)
    others = [ROOT / "CONTRIBUTING.md", *ROOT.glob("benchmarks/results/*.md"), *ROOT.glob("packages/*/*.md")]
    pages = {page: commands_and_parts(page) for page in [*PAGES, *others]}
    shown = {command: (page, within) for page, found in pages.items() for command, within in found}
    for command in {command for name in tutorials() for command in commands_of(name)} - set(LEFT_OUT):
        shown.pop(command, None)  # it runs there
    whole, wrong = 0, []
    for command, (page, within) in shown.items():
        text = command
        for asked, given in STANDS_FOR.items():
            text = text.replace(asked, given)
        words = shlex.split(text)[1:]
        for path in [Path(after) for flag, after in pairwise(words) if flag == "--config"]:
            settings = kinds[words[0]].PRESETS["default"]()
            if path.name == TRAINING_FILE:  # calibrate writes the targets of its captures beside it
                settings = replace(settings, glyphs=replace(settings.glyphs, known="targets"))
            path.parent.mkdir(exist_ok=True)
            save_yaml(settings, path)
        capsys.readouterr()
        try:
            main(words)
            whole += not within
        except SystemExit as end:
            said = capsys.readouterr().err.strip().partition("error: ")[2].partition("; see evnlos")[0]
            if end.code and re.sub(f"{NOT_HERE}|{A_PART}" if within else NOT_HERE, "", said).strip("; "):
                wrong.append(f"{page.name}: {command}: {said}")
    assert not wrong, "\n".join(wrong)
    assert whole > 100 and len(shown) > 200


def messages() -> list[str]:
    """Return all texts in the code; what an f-string fills in is '...'."""
    found = []
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(v.value if isinstance(v, ast.Constant) else "..." for v in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_the_messages_of_the_questions_are_those_of_the_code() -> None:
    known = set(messages())
    quoted = re.findall(r"^> (.*)$", (DOCS / "faq.md").read_text(), flags=re.MULTILINE)
    assert len(quoted) >= 15
    assert not [line for line in quoted if line not in known]
    # What questions and answers quote of a message is a part of it; numbers stand for what it fills in.
    page = " ".join((DOCS / "faq.md").read_text().split())
    parts = [re.sub(r"[\d.]+ %", "...", one) for one in re.findall(r'"([^"]+)"', page) if len(one.split()) > 3]
    assert len(parts) >= 2
    assert not [one for one in parts if not any(one in text for text in known)]


def test_files_that_pages_name_exist() -> None:
    there = {
        str(path.relative_to(ROOT))
        for part in ("src", "tests", "benchmarks", "examples", "tools")
        for path in (ROOT / part).rglob("*.py")
    }
    for page in PAGES:
        for name in re.findall(r"`([\w/]+\.py)`", page.read_text()):
            assert any(path == name or path.endswith(f"/{name}") for path in there), f"{page.name}: {name}"


def test_no_pattern_on_a_page_names_a_capture_that_the_page_only_began() -> None:
    """`import captures/*` takes every folder: what `capture init` makes there holds no recording yet."""
    begun, wrong = 0, []
    for page in PAGES:
        commands = [command.split()[1:] for command in commands_on(page)]
        folders = [words[2] for words in commands if words[:2] == ["capture", "init"] and len(words) > 2]
        begun += len(folders)
        wrong += [
            f"{page.name}: {words[0]} {word} names {folder}"
            for folder in folders
            for words in commands
            for word in words
            if "*" in word and Path(folder).match(word)
        ]
    assert begun >= 5
    assert not wrong


def test_a_page_on_recordings_that_nobody_can_have_says_how_to_make_their_like() -> None:
    pages = {path: path.read_text() for path in (*DOCS.glob("*.md"), DOCS.parent / "README.md")}
    cites = {path for path, text in pages.items() if re.search(r"captures/(near|far)_|--captures-of", text)}
    cites -= {DOCS / name for name in ("lab.md", "live.md")}  # that page itself; captures one records
    assert len(cites) >= 7
    for path in cites:
        assert re.search("lab.md#(published-captures|the-main-experiment-on-them)", pages[path]), path


def test_no_page_to_start_with_asks_for_a_compiler() -> None:
    """All that is needed comes as wheels (`tools/distributions.py` builds ours, which is pure Python)."""
    for page in (ROOT / "README.md", *(DOCS / f"{name}.md" for name in ("install", "tour", "quickstart"))):
        assert not re.search(r"\bgcc\b|\bclang\b|build-essential", page.read_text()), page.name
    assert "no compiler" in (DOCS / "install.md").read_text()


_ROWS = {
    "strongest E2E, its positions averaged": "e2e-single-positions-averaged",
    "simulation only, whole sequence": "simulation-only-sequence",
    "EPNP, whole sequence": "epnp-sequence",
}


def test_the_readme_has_the_scores_of_the_records() -> None:
    """Whole sequences, three seeds: records that are renewed need the page renewed."""
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    records = ROOT / "benchmarks" / "results" / "experiments" / "sequence"
    for row, arm in _ROWS.items():
        (line,) = [line for line in page.splitlines() if line.startswith(f"| {row} |")]
        told = [tuple(map(float, pair)) for pair in re.findall(r"([\d.]+) ± ([\d.]+)", line)]
        for (mean, spread), modality in zip(told, ("frame", "event", "fusion"), strict=True):
            files = [records / f"near-test-{arm}-{modality}-seed{seed}.json" for seed in range(3)]
            scores = [list(json.loads(file.read_text())["scores"]["psnr_db"].values()) for file in files]
            seeds = np.mean(scores, axis=1)
            assert seeds.mean() == pytest.approx(mean, abs=0.006), (row, modality)
            assert seeds.std(ddof=1) == pytest.approx(spread, abs=0.006), (row, modality)


@pytest.mark.parametrize("name", ["near", "far"])
def test_the_page_of_published_captures_has_the_scores_of_the_records(name: str) -> None:
    page = (DOCS / "lab.md").read_text(encoding="utf-8").partition(f"| `{name}`: G, K, 4, 9")[2]
    records = ROOT / "benchmarks" / "results" / "experiments" / "published"
    arms = (
        "E2E, single positions",
        "E2E, single positions, averaged",
        "simulation only sequence",
        "EPNP sequence",
    )
    for row in arms:
        line = page.partition(f"| {row} |")[2].partition("\n")[0]
        arm = row.lower().replace(",", "").replace(" ", "-")
        for told, modality in zip(line.split("|")[:3], ("frame", "event", "fusion"), strict=True):
            file = records / f"{name}-test-{arm}-{modality}-seed0.json"
            scores = json.loads(file.read_text())["scores"]["psnr_db"].values()
            assert np.mean(list(scores)) == pytest.approx(float(told), abs=0.006), (row, modality)


def test_the_figure_of_rooms_shows_the_table_of_its_page() -> None:
    """A table that is renewed needs its figure drawn anew: python tools/draw_results.py walls."""
    draw_results = pytest.importorskip("draw_results", reason="needs the extra `plot`")
    rows = draw_results.rows_of_rooms((ROOT / "docs" / "walls.md").read_text(encoding="utf-8"))
    assert len(rows) == 3 * len(ROOMS) and {room for room, _ in rows} == set(ROOMS)
    for e2e, _, epnp, lead, low, high in rows.values():
        assert low <= lead <= high and lead == pytest.approx(epnp - e2e, abs=0.02)
    with Image.open(ROOT / "docs" / "figures" / "walls.png") as figure:
        assert figure.info["Description"] == draw_results.digest_of(rows)
