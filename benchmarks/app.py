"""How long the page lets a person wait, in a real Chromium: for the first image and for each control.

    python benchmarks/app.py
    python benchmarks/app.py --rounds 9 --write benchmarks/results/app.md

The page is started once and opened in a new browser; a control is moved by a key, and the clock runs until the
image of the new sequence stands in the page; of a plane that changes, until its film from frames does, and
until those with events do. Needs chromium and chromedriver.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import chromium
from machine import machine

CONTROLS = {
    "roughness of the wall (a new wall)": "Wall roughness",
    "distance of the object (a new wall)": "Distance from",
    "ambient light": "Ambient light",
    "speed": "Speed of",
}
LEFT, RIGHT = "\ue012", "\ue014"
SEQUENCE = "document.querySelector('.ev-sheet').dataset.sequence"


FIRST = "first images, from opening the address"
READY = "controls, from opening the address"
FILM, FILMS = "a plane that changes, ambient light: film from frames", "the same: films with events, too"


def opened(home: str, browser: chromium.Chromium, rows: dict[str, list[float]]) -> None:
    start = time.perf_counter()
    browser.open(home)
    for row, place in (FIRST, ".ev-image"), (READY, "gradio-app input[type=range]"):
        browser.wait(f"const p = document.querySelector('{place}'); return p && p.offsetWidth")
        rows[row].append(time.perf_counter() - start)


def settle(browser: chromium.Chromium) -> None:
    browser.wait("return !document.querySelector('.ev-verdict').textContent.includes('Looking at it')")


def answer(browser: chromium.Chromium, label: str, key: str) -> float:
    settle(browser)
    before = browser.run(f"return {SEQUENCE}")
    browser.run(f"document.querySelector('input[type=range][aria-label*=\"{label}\"]').focus()")
    start = time.perf_counter()
    browser.press(key)
    browser.wait(f"return {SEQUENCE} !== {json.dumps(before)}")
    return time.perf_counter() - start


def measure(folder: Path, rounds: int) -> dict[str, list[float]]:
    rows: dict[str, list[float]] = {FIRST: [], READY: []}
    with chromium.page(folder) as home:
        for k in range(2):
            with chromium.Chromium(folder / f"profile{k}") as browser:
                opened(home, browser, rows)
        with chromium.Chromium(folder / "profile") as browser:
            opened(home, browser, rows)
            for control, label in CONTROLS.items():
                answer(browser, label, RIGHT)
                rows[control] = [answer(browser, label, (LEFT, RIGHT)[turn % 2]) for turn in range(rounds)]
            browser.open(f"{home.rstrip('/')}/?film=closing+hand")
            browser.wait(f"return document.body.innerHTML.includes('>Film, both<') && {SEQUENCE}")
            answer(browser, "Ambient light", RIGHT)
            rows |= {FILM: [], FILMS: []}
            for turn in range(rounds):
                rows[FILM].append(answer(browser, "Ambient light", (LEFT, RIGHT)[turn % 2]))
                start = time.perf_counter()
                browser.wait("return document.body.innerHTML.includes('>Film, both<')")
                rows[FILMS].append(rows[FILM][-1] + time.perf_counter() - start)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", help="file for the table")
    arguments = parser.parse_args()
    if lacking := chromium.missing():
        sys.exit(f"{lacking}: apt-get install chromium chromium-driver")
    with tempfile.TemporaryDirectory() as name:
        rows = measure(Path(name), arguments.rounds)
    lines = [
        "# How long the page lets a person wait",
        "",
        f"{machine()}; load average at the end {os.getloadavg()[0]:.1f}.",
        "",
        "| | median, s | longest, s | times |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {what} | {statistics.median(times):.2f} | {max(times):.2f} | {len(times)} |"
        for what, times in rows.items()
    ]
    print("\n".join(lines))
    if arguments.write:
        Path(arguments.write).write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
