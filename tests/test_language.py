"""Plain English: words and turns that readers had to decode stand in no page, help or message any more."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
UNITS = (
    "(?:second|pixel|position|step|image|(?:hidden )?object|capture|shot|frame|sample|event|sequence|setup|row"
    "|unit)"
)
RATES = (
    "(?:events?|Hz|hertz|metres?|seconds?|[mun]?s|mm|chi2|noise|[kMG]B|dB|bytes|steps|frames|samples|dots"
    "|shard)"
)
BANNED = {
    "rightly": "correctly",
    "told apart": "distinguished",
    "tells? objects apart": "distinguishes objects",
    r"\bshots/": "captures/",
    r"(?:is|are) asked(?! for| of|\b.{0,3}(?:to|again))": "is required",
    "not at home": "unreliable",
    "of those that": "name them",
    "so it may": "the same happens",
    "which it never saw": "held out from ...",
    "what was said here": "delete it; the changelog tells what changed",
    r"\" a second\"": "per",
    r"\bit were\b": "it was, or it is",
    "takes no look": "is skipped",
    r"nor does the": "say what it does",
    r"the price\**:": "a limitation:",
    "whole pass": "whole sequence",
    "not ours to": "not licensed",
    "by heart": "memorizes",
    r"\b(?:is|be) memory\b|network's memory": "comes from the training data",
    "can't be told from none": "the resolution of the test",
    "only calibration can tell": "the simulator has to estimate",
    r"half as \w+ again": "1.5 times",
    "a second and pixel": "per pixel per second",
    rf"\b{RATES} an? {UNITS}\b(?! and the)": "per",
}
"""What is banned, as a regular expression, and what to write."""
ROOMS = ("src", "benchmarks", "tools", "examples")


def messages() -> list[tuple[str, str]]:
    """Return every text of the code with its place: messages, help and docstrings."""
    found = []
    for path in sorted(one for room in ROOMS for one in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found += [(f"{path.name}:{node.lineno}", node.value)]
    return found


def pages() -> list[tuple[str, str]]:
    """Return README and pages, paragraph by paragraph, without code."""
    found = []
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]:
        text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        found += [(path.name, one) for one in text.split("\n\n")]
    return found


def screens() -> list[tuple[str, str]]:
    """Return the lines of what a browser shows, of templates and of settings, with their places."""
    found = []
    for ending in ("html", "js", "css", "yaml"):
        for path in sorted((ROOT / "src").rglob(f"*.{ending}")):
            lines = path.read_text(encoding="utf-8").splitlines()
            found += [(f"{path.name}:{number}", line) for number, line in enumerate(lines, 1)]
    return found


@pytest.mark.parametrize("where", [pages, messages, screens])
def test_banned_words_stand_nowhere(where) -> None:
    ban = {re.compile(word, re.IGNORECASE): cure for word, cure in BANNED.items()}
    wrong = []
    for place, text in where():
        flat = " ".join(text.split())
        for word, cure in ban.items():
            wrong += [f"{place}: {found[0]!r}; write {cure}" for found in word.finditer(flat)]
    assert not wrong, "\n".join(wrong)


def test_the_ban_finds_what_it_is_for() -> None:
    sentences = [
        "named 81 % rightly",
        "0.01 events a second",
        "70 are asked",
        "it were 0.5 dB ahead",
        "3 ms a position",
        "2 mm a pixel",
        "chi2 a pixel",
        "one shard a hidden object",
        "what tells objects apart",
        "import shots/lab_*",
    ]
    for sentence in sentences:
        assert any(re.search(word, sentence, re.IGNORECASE) for word in BANNED), sentence
    for sentence in ["where nothing else is asked for", "events per second", "a frame a and the next"]:
        assert not any(re.search(word, sentence, re.IGNORECASE) for word in BANNED), sentence
