"""What `from evnlos import *` costs beside `import torch`, in processor time of a fresh process.

python benchmarks/imports.py --write benchmarks/results/imports.md
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from machine import machine

PROGRAM = """
import json, sys, time
a = time.process_time()
import torch
b = time.process_time()
from evnlos import *
c = time.process_time()
print(json.dumps([b - a, c - b, len(sys.modules)]))
"""


def main() -> None:
    """Print the table, and write it where asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=9, help="processes that are started")
    parser.add_argument("--write", type=Path, help="file for the table")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        # As for a user at the second start: Python keeps what it compiled.
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = folder
        program = [sys.executable, "-c", PROGRAM]
        first, *rest = (
            json.loads(subprocess.check_output(program, env=environment)) for _ in range(options.repeats + 1)
        )
    shares = [ours / torch for torch, ours, _ in rest]
    lines = [
        "| | torch, s | evnlos, s | ratio |",
        "|---|---|---|---|",
        f"| a start | {median(t for t, _, _ in rest):.2f} | {median(o for _, o, _ in rest):.2f} "
        f"| {median(shares):.2f} ({min(shares):.2f} to {max(shares):.2f}) |",
        f"| the first start, which compiles both to bytecode | {first[0]:.2f} | {first[1]:.2f} "
        f"| {first[1] / first[0]:.2f} |",
    ]
    command = "python benchmarks/imports.py --write benchmarks/results/imports.md"
    text = "\n".join([f"`{command}`: processor time of imports, medians of {len(rest)} starts", "", *lines])
    text += f"\n\n{machine('torch')}\n"
    print(text)
    if options.write is not None:
        options.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
