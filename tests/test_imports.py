"""What an import costs: a room brings what it needs and no more, and a start can be interrupted at any time."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import evnlos

ROOMS = (
    "analysis",
    "calibration",
    "data",
    "inverse",
    "models",
    "optics",
    "scene",
    "setups",
    "tracking",
    "training",
)


def loaded(code: str) -> set[str]:
    """Return the modules that a new process holds after some code, as `a` and `a.b`."""
    run = f"import sys\n{code}\nprint(*sorted(sys.modules))"
    names = subprocess.check_output([sys.executable, "-c", run], text=True).split()
    return {".".join(name.split(".")[:2]) for name in names} | {name.split(".")[0] for name in names}


def test_the_package_alone_brings_next_to_nothing() -> None:
    found = loaded("import evnlos")
    assert {name for name in found if name.startswith("evnlos")} == {"evnlos"}
    assert not found & {"numpy", "numba", "torch", "h5py", "yaml", "PIL"}


def test_events_need_neither_torch_nor_optics_nor_networks(tmp_path) -> None:
    found = loaded(
        "import numpy as np\n"
        "from evnlos.events import read_events, time_surface, voxel_grid, write_events\n"
        "from evnlos.types import Events\n"
        "events = Events(np.arange(9), np.arange(9) % 4, np.arange(9) % 3, np.arange(9) % 2 == 0, 4, 3)\n"
        f"write_events({str(tmp_path / 'a.raw')!r}, events)\n"
        f"same = read_events({str(tmp_path / 'a.raw')!r})\n"
        "time_surface(same, [0, 9], tau_us=5), voxel_grid(same, bins=2, start_us=0, stop_us=9)\n"
    )
    assert "torch" not in found
    assert not found & {f"evnlos.{room}" for room in (*ROOMS, "cameras")}


def test_the_pixel_needs_neither_optics_nor_networks() -> None:
    found = loaded("from evnlos.cameras import EventPixel, simulate_events\nEventPixel()")
    assert not found & {f"evnlos.{room}" for room in ROOMS}


def test_no_module_needs_what_windows_lacks_to_be_imported() -> None:
    posix = {"fcntl", "grp", "pwd", "resource", "termios"}
    for path in Path(evnlos.__file__).parent.rglob("*.py"):
        for node in ast.parse(
            path.read_text(encoding="utf-8")
        ).body:  # not what stands in functions and in `try`
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not posix & set(names), path


@pytest.mark.parametrize("delay_s", [0.15, 0.4, 0.8])
def test_a_start_that_is_interrupted_says_so(delay_s: float) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", "print(); from evnlos.__main__ import main; main()", "train", "--help"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode in (0, 130), said  # 0: it was through
    assert "Traceback" not in said


def test_names_come_when_they_are_asked_for() -> None:
    assert set(evnlos.__all__) <= set(dir(evnlos))
    for name in dir(evnlos):
        assert getattr(evnlos, name) is not None
    for wrong in ("nonsense", "_nonsense"):
        with pytest.raises(AttributeError, match=wrong):
            getattr(evnlos, wrong)
