"""How long the page lets a person wait, in a real Chromium: for the first picture and for each control.

    python benchmarks/app.py
    python benchmarks/app.py --rounds 9 --write benchmarks/results/app.md

The page is started once and opened in a new browser; a control is moved by a key, and the clock runs until the
picture of the new pass stands in the page. Needs chromium and chromedriver.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import chromium
from event_pixel import machine

CONTROLS = {
    "roughness of the wall (a new wall)": "Wall roughness",
    "distance of the object (a new wall)": "Distance from",
    "ambient light": "Ambient light",
    "speed": "Speed of",
}
PASS = "document.querySelector('.ev-sheet').dataset.pass"


def first_picture(home: str, browser: chromium.Chromium) -> float:
    start = time.perf_counter()
    browser.open(home)
    browser.wait(
        "const p = document.querySelector('.ev-picture'); return p && p.complete !== false && p.offsetWidth"
    )
    return time.perf_counter() - start


def answer(browser: chromium.Chromium, label: str, key: str) -> float:
    before = browser.run(f"return {PASS}")
    browser.run(f"document.querySelector('input[type=range][aria-label*=\"{label}\"]').focus()")
    start = time.perf_counter()
    browser.press(key)
    browser.wait(f"return {PASS} !== {json.dumps(before)}")
    took = time.perf_counter() - start
    browser.wait("return !document.querySelector('.ev-verdict').textContent.includes('Looking at it')")
    return took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", help="file for the table")
    arguments = parser.parse_args()
    if lacking := chromium.missing():
        sys.exit(f"{lacking}: apt-get install chromium chromium-driver")
    rows: dict[str, list[float]] = {"first picture, from opening the address": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        said = folder / "said"
        with said.open("w") as log:
            page = subprocess.Popen(
                [sys.executable, "-m", "evnlos", "app", "--port", "0"], stdout=log, stderr=subprocess.STDOUT
            )
        try:
            while not (found := re.search(r"http://\S+", said.read_text())):
                time.sleep(0.1)
            for k in range(3):
                with chromium.Chromium(folder / f"profile{k}") as browser:
                    rows["first picture, from opening the address"].append(
                        first_picture(found.group(), browser)
                    )
                    if k < 2:
                        continue
                    browser.wait(
                        "return !document.querySelector('.ev-verdict').textContent.includes('Looking at it')"
                    )
                    for control, label in CONTROLS.items():
                        answer(browser, label, "\ue014")
                        rows[control] = [
                            answer(browser, label, "\ue014" if turn % 2 else "\ue012")
                            for turn in range(arguments.rounds)
                        ]
        finally:
            page.terminate()
            page.wait(20)
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
