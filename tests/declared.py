"""Use package and published weights with no more than they declare: rooms, README, a command of each verb.

    make declared     # makes that environment (tools/distributions.py) and runs this in it

Each command is a small, whole job and has to end well. Where a job needs an extra, it has to end with exit code
2 and one line that names the extra. Exit code 1 where anything else happened.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import time
import tomllib
import traceback
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = ("matplotlib", "gradio", "av", "aedat", "lz4", "zstandard", "dask", "fontpkg", "pytest")
SETTINGS = """
glyphs: {kind: drawings, kinds: [icon, person], each: 4}
setup: {kind: radiometric, cell_m: 0.01, gain: 0.7, ambient: 0.06, sensor: {height: 48, width: 72}}
sampling: {height: 32, width: 48, pitch_m: 0.005, scored_rows: 24}
positions: 8
validation: 0.25
"""
NETWORK = "--network.width 8 --network.depth 2 --epochs 1"
JOBS = f"""
doctor --json
completion zsh
weights
simulate --config small.yaml --out made --workers 1
verify made
train --data made --modality frame --out run {NETWORK}
train --data made --modality fusion --out fused {NETWORK}
train --simulate small.yaml --modality event --out lively {NETWORK}
finetune --weights run --data made --out tuned --epochs 1
weights run
evaluate --weights tuned --data made --split validation --json
report tuned --data made --split validation --out page
cite tuned
capture init begun --camera davis346
capture check captures/lab_icon_000
import captures/lab_icon_000 captures/lab_icon_001 --out recorded --test lab_icon_001 {{sampling}}
reconstruct captures/lab_icon_000 --weights fused --out images
reconstruct near/lab_icon_000 --weights near-frame-sequence --out published
live near/lab_icon_000 --weights near-event --headless --out streamed --speed 8
live captures/lab_icon_000 --weights fused --headless --out watched --speed 8
track captures/lab_icon_000 --json
invert captures/lab_icon_000 --setup small.yaml --solver tikhonov --columns 24 --cells 8 --out solved.png
invert photograph.npz --out hidden.png
scan plan scan
scan plan tray --display 1920 1080 --pattern hadamard --show page
events video --fps 100 --out events.h5
pixel fit events.h5 --light unknown --out fitted
info events.h5
convert events.h5 --out events.raw
clean events.h5 --out clean.raw --background-ms auto
convert events.h5 --out events.npz
convert events.h5 --out events.csv
convert events.h5 --out events.mcap
convert events.h5 --out events.aedat4
info events.mcap
preview events.h5 --out events.gif
corner door.gif --simulate --scene.size 128 96 --scene.fps 10 --scene.seconds 8 --scene.contrast 0.05
corner door.gif --edge 44.3 44.9 --wall 12.9 86 --end 75.1 21.3
"""
"""A line a job, in the order in which they need each other."""

LACKING = {
    "app": "app",
    "info events.aedat4": "aedat",
    "identify small.yaml": "fonts",
    "events film.mp4 --out film.h5": "video",
    "lab --glyphs.family Kalam --out lab": "fonts",
    "simulate --config small.yaml --engine dask --out far": "cluster",
}
"""The extra that a job needs."""


class JobError(Exception):
    """A job ended otherwise than it should."""


def run(words: list[str]) -> tuple[int, str, str]:
    """Run a command in this process; return its exit code and what it said on stdout and stderr."""
    from evnlos.cli import main

    out, errors, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            main(words)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return code, out.getvalue(), errors.getvalue()


def job(line: str) -> None:
    code, out, errors = run(line.split())
    if code:
        raise JobError(f"exit code {code}: {(errors or out)[-600:].strip()}")


def lacks(line: str, extra: str) -> None:
    code, _, errors = run(line.split())
    said = [one for one in errors.splitlines() if one.startswith("evnlos")]
    if code != 2 or len(said) != 1 or f"evnlos[{extra}]" not in said[0]:
        raise JobError(f"exit code {code}, and not a line that names evnlos[{extra}]: {errors[-600:].strip()}")


def installed() -> None:
    """The package is that of the environment, its program is there, and no extra is."""
    import evnlos

    site = sysconfig.get_path("purelib")
    if not Path(evnlos.__file__).is_relative_to(site):
        raise JobError(f"evnlos is {evnlos.__file__}, not the wheel in {site}")
    if there := [name for name in MODULES if importlib.util.find_spec(name)]:
        raise JobError(f"{', '.join(there)}: more than what the package declares")
    program = Path(sysconfig.get_path("scripts")) / "evnlos"
    said = subprocess.run([program, "doctor"], capture_output=True, text=True)
    lost = [name for name in PROJECT["optional-dependencies"] if name not in ("all", "dev", "docs", "fonts")
            and f"evnlos[{name}]" not in said.stdout]  # fmt: skip
    if said.returncode or lost:
        raise JobError(f"doctor says {said.stdout}{said.stderr}; not a word of {lost}")


def rooms() -> None:
    """Every name that the package and its rooms offer, and every module, can be imported."""
    import evnlos

    folder = Path(evnlos.__file__).parent
    for name in evnlos.__all__:
        room = getattr(evnlos, name)
        if hasattr(room, "__path__"):
            for inner in room.__all__:
                getattr(room, inner)
    for path in sorted(folder.rglob("*.py")):
        if not path.name.endswith("_child.py") and path.name != "__main__.py":
            words = path.relative_to(folder.parent).with_suffix("").parts
            importlib.import_module(".".join(words).removesuffix(".__init__"))


def readme() -> None:
    """The Python of the README and of the event pixel prints what it says, or names the extra that it needs."""
    from evnlos.errors import MissingDependencyError

    pixel, _, _ = (ROOT / "docs" / "event_pixel.md").read_text().partition("## Parameters")
    blocks = re.findall(r"```(\w*)\n(.*?)```", (ROOT / "README.md").read_text() + pixel, flags=re.DOTALL)
    names: dict[str, object] = {}
    whole = 0
    for (kind, code), (_, printed) in zip(blocks, [*blocks[1:], ("", "")], strict=True):
        if kind != "python":
            continue
        out = io.StringIO()
        try:
            with contextlib.redirect_stdout(out):
                exec(code, names)
        except MissingDependencyError as error:
            if not re.search(r"evnlos\[\w+\]", str(error)):
                raise JobError(f"names no extra: {error}") from None
            continue
        if out.getvalue() != printed:
            raise JobError(f"prints {out.getvalue()!r}, not {printed!r}")
        whole += 1
    if not whole:
        raise JobError("no example runs without an extra")


def material() -> None:
    """Write what the jobs take: settings, captures, a video, a photograph of a wall."""
    import numpy as np
    from PIL import Image

    from evnlos.data.lab import Lab, render_captures
    from evnlos.scene import DrawingGlyphs
    from evnlos.setups import load_setup

    Path("small.yaml").write_text(SETTINGS)
    glyphs = DrawingGlyphs(kinds=("icon",), each=2)
    lab = Lab(glyphs=glyphs, setup=load_setup("small.yaml"), frame_rate_hz=1.0)  # type: ignore[arg-type]
    render_captures(lab, Path("captures"), workers=1)
    one = DrawingGlyphs(kinds=("icon",), each=1)  # before a wall that the published weights know
    render_captures(replace(lab, glyphs=one, setup=load_setup("main-near")), Path("near"), workers=1)
    Path("video").mkdir()
    bars = 120 + 100 * np.sign(np.sin(np.arange(32) / 3))
    for k in range(20):
        Image.fromarray(np.tile(np.roll(bars, k), (24, 1)).astype(np.uint8)).save(f"video/{k:02}.png")
    wall = {"wall": np.linspace(0, 1, 256).reshape(16, 16), "distance_m": np.array(0.4)}
    wall |= {"wall_x_m": np.linspace(0.1, 0.4, 16), "wall_z_m": np.linspace(0.4, 0, 16)}
    wall |= {"cell_x_m": np.linspace(0.4, 0.1, 6), "cell_z_m": np.linspace(0.35, 0.05, 5)}
    np.savez("photograph.npz", cell_size_m=np.array([0.054, 0.066]), **wall)
    Path("film.mp4").write_bytes(b"\0\0\0\x18ftypisom" + bytes(400))


def main() -> int:
    from evnlos.cli import VERBS

    for name in ("EVNLOS_WEIGHTS", "PYTHONPATH"):
        os.environ.pop(name, None)
    begun, faults = time.perf_counter(), 0
    steps = [(one.__doc__, one, ()) for one in (installed, rooms, readme, material)]
    sampling = "--sampling.height 32 --sampling.width 48 --sampling.pitch-m 0.005 --sampling.scored-rows 24"
    steps += [(f"evnlos {line}", job, (line,)) for line in JOBS.format(sampling=sampling).strip().splitlines()]
    steps += [(f"evnlos {line}: [{extra}]", lacks, (line, extra)) for line, extra in LACKING.items()]
    steps += [(f"evnlos {verb} --help", job, (f"{verb} --help",)) for verb in VERBS]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, step, arguments in steps:
            start = time.perf_counter()
            try:
                step(*arguments)
                fault = ""
            except JobError as error:
                fault = str(error)
            except Exception:
                fault = traceback.format_exc()
            faults += bool(fault)
            print(f"{time.perf_counter() - start:5.1f} s  {'FAULT' if fault else 'ok   '}  {name}", flush=True)
            if fault:
                print(f"    {fault}", flush=True)
    print(f"{len(steps)} steps, {faults} faults, {time.perf_counter() - begun:.0f} s")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
