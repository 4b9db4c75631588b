"""The site: each page has its place; every name, command and key is explained; a dead link ends the build."""

import dataclasses
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from evnlos.cameras.sensors import PRESETS
from evnlos.cli import VERBS
from evnlos.data import CaptureInfo

pytest.importorskip("mkdocs", reason="needs the extra `docs`")
import site_pages

ROOT = Path(__file__).resolve().parent.parent


def test_every_page_has_its_place_in_the_navigation() -> None:
    placed = re.findall(r"[\w]+\.md", (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2])
    assert len(placed) == len(set(placed))
    assert set(placed) == {page.name for page in ROOT.glob("docs/*.md")} | {"contributing.md"}


def test_every_room_shows_every_name_that_it_lists() -> None:
    for room in site_pages.rooms():
        text = site_pages.room_page(room)
        missing = [name for name, _ in site_pages.names_of(room) if not re.search(rf"\b{name}\b", text)]
        assert not missing, (room, missing)
    assert {"evnlos", "events", "optics", "cameras", "setups", "metrics"} <= set(site_pages.rooms())


def test_every_key_of_a_capture_is_explained() -> None:
    text = site_pages.settings_tables("evnlos.data.CaptureInfo")
    for field in dataclasses.fields(CaptureInfo):
        assert f"| `{field.name}` |" in text
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| (.*?) \|$", text, flags=re.MULTILINE)
    assert len(rows) > 50
    assert not [name for name, *_, meaning in rows if not meaning]


def test_presets_have_their_numbers() -> None:
    table = site_pages.presets_table()
    assert all(f"`{name}`" in table for name in PRESETS)
    assert f"| {PRESETS['davis346']().threshold_on:.4g} |" in table


def test_links_into_the_repository_lead_to_pages() -> None:
    found = site_pages.site_link
    pattern = r"\]\(([^)#\s]+)(#[^)]*)?\)"
    link = re.search(pattern, "[x](../examples/02_diffuse_kernel.py)")
    assert link and found(link, "README.md", "") == "](gallery/02_diffuse_kernel.md)"
    link = re.search(pattern, "[x](../benchmarks/results/live.md)")
    assert link and found(link, "README.md", "") == "](benchmarks/live.md)"
    link = re.search(pattern, "[x](nowhere.md)")
    assert link and found(link, "README.md", "") == link[0]


@pytest.mark.parametrize(
    ("text", "apart"),
    [
        ("Three:\n- one\n- two", "Three:\n\n- one\n- two"),
        ("## Head\n    code", "## Head\n\n    code"),
        ("```\na\n- b\n```", "```\na\n- b\n```"),
        ("- one\n  more\n- two", "- one\n  more\n- two"),
    ],
)
def test_lists_and_headings_stand_apart(text: str, apart: str) -> None:
    assert site_pages.lists_apart(text) == apart


@pytest.mark.slow
def test_the_site_builds_and_a_dead_link_ends_the_build(tmp_path) -> None:
    """`make site` builds all pages; here one, since the whole takes 20 s: whole, then with dead links."""
    docs = tmp_path / "docs"
    docs.mkdir()
    config = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[0]
    config = config.replace("hooks: [tools/site_pages.py]\n", "").replace("[src]", f"[{ROOT / 'src'}]")
    config = re.sub(r"extensions: \[tools/", f"extensions: [{ROOT}/tools/", config)
    (tmp_path / "mkdocs.yml").write_text(config)

    def built(page: str) -> subprocess.CompletedProcess[str]:
        (docs / "README.md").write_text(page)
        call = [sys.executable, "-m", "mkdocs", "build"]
        return subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=300)

    good = built("# Site\n\n[down](#below)\n\n## Below\n")
    assert good.returncode == 0, good.stderr
    assert (tmp_path / "build" / "site" / "index.html").exists()
    bad = built("# Site\n\n[x](nowhere.md) [x](#nowhere-here) ![x](nowhere.png)\n")
    assert bad.returncode != 0
    for dead in ("nowhere.md", "#nowhere-here", "nowhere.png"):
        assert [line for line in bad.stderr.splitlines() if line.startswith("WARNING") and dead in line], dead


def test_each_command_has_a_page() -> None:
    assert site_pages.verbs() == list(VERBS)
    page = site_pages.command_page("info")
    assert page.startswith("# evnlos info") and "--json" in page
    assert importlib.util.find_spec("mkdocstrings") is not None
