"""The site: each page has its place and fits a phone; names, commands and keys are explained; no dead link."""

import dataclasses
import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import chromium
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


COLUMNS = " a column | " * 14
PAGE = f"""# Site

[down](#below)

## Below

|{COLUMNS}
|{"---|" * 14}
|{COLUMNS}

| `evnlos {"--a-flag " * 20}` | what it does |
|---|---|

    evnlos {"--another-flag " * 30}

`{"a_name_without_a_space" * 8}`

![a wide figure](wide.svg)
"""


def built(folder: Path, page: str) -> subprocess.CompletedProcess[str]:
    """Build a site of one page in a folder as `make site` builds all, which takes 20 s."""
    docs = folder / "docs"
    docs.mkdir(exist_ok=True)
    shutil.copy(ROOT / "docs" / "site.css", docs)
    (docs / "wide.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg" width="2000" height="9"/>')
    config = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[0]
    config = config.replace("hooks: [tools/site_pages.py]\n", "").replace("[src]", f"[{ROOT / 'src'}]")
    config = re.sub(r"extensions: \[tools/", f"extensions: [{ROOT}/tools/", config)
    (folder / "mkdocs.yml").write_text(config)
    (docs / "README.md").write_text(page)
    call = [sys.executable, "-m", "mkdocs", "build"]
    return subprocess.run(call, cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """A page with all that is wide."""
    folder = tmp_path_factory.mktemp("site")
    done = built(folder, PAGE)
    assert done.returncode == 0, done.stderr
    return folder / "build" / "site" / "index.html"


@pytest.mark.slow
def test_the_site_builds_and_a_dead_link_ends_the_build(page, tmp_path) -> None:
    assert page.exists()
    bad = built(tmp_path, "# Site\n\n[x](nowhere.md) [x](#nowhere-here) ![x](nowhere.png)\n")
    assert bad.returncode != 0
    for dead in ("nowhere.md", "#nowhere-here", "nowhere.png"):
        assert [line for line in bad.stderr.splitlines() if line.startswith("WARNING") and dead in line], dead


@pytest.mark.slow
@pytest.mark.skipif(bool(chromium.missing()), reason=f"{chromium.missing()}: apt-get install chromium-driver")
def test_what_is_wide_scrolls_within_a_page_on_a_phone(page, tmp_path) -> None:
    with chromium.Chromium(tmp_path / "profile") as browser:
        browser.devtools(
            "Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True
        )
        browser.open(page.as_uri())
        assert browser.run("return document.querySelectorAll('main table, main pre, main img').length") == 4
        assert browser.run("return [innerWidth, document.documentElement.scrollWidth]") == [390, 390]


def test_each_command_has_a_page() -> None:
    assert site_pages.verbs() == list(VERBS)
    page = site_pages.command_page("info")
    assert page.startswith("# evnlos info") and "--json" in page
    assert importlib.util.find_spec("mkdocstrings") is not None
