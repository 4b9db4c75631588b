"""What an import costs: a room brings what it needs and no more, and a start can be interrupted at any time."""

import ast
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import evnlos
from evnlos.config import save_yaml

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


HEAVY = ("numpy", "torch", "numba", "scipy", "h5py", "PIL", "pydantic")
HELP_OF_ALL = """
import contextlib, importlib, io, json, sys
if {libraries}:
    import h5py, numba, pydantic, safetensors, scipy, torch
main = importlib.import_module("evnlos.cli.main")
said = {{}}
for verb in main.VERBS:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main.main([verb, "--help"])
    said[verb] = (out.getvalue(), [name for name in {heavy} if name in sys.modules])
print(json.dumps(said))
"""


def help_of_all(*, libraries: bool) -> dict[str, tuple[str, list[str]]]:
    code = HELP_OF_ALL.format(libraries=libraries, heavy=HEAVY)
    out = subprocess.check_output([sys.executable, "-c", code], text=True, env=os.environ | {"COLUMNS": "100"})
    return json.loads(out)


def test_help_needs_no_library_of_the_work_and_says_the_same() -> None:
    """What it takes is some half a second; what it loads is measured here, since a busy machine is slow."""
    alone, complete = help_of_all(libraries=False), help_of_all(libraries=True)
    assert {verb: heavy for verb, (_, heavy) in alone.items() if heavy} == {}
    for verb, (text, heavy) in complete.items():
        assert {"torch", "numba"} <= set(heavy)
        assert text.startswith("usage: evnlos " + verb), verb
        assert alone[verb][0] == text, verb


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["train", "--epoch-count", "3"], "--epoch-count"),
        (["simulate", "--preset", "nonsense", "--out", "d"], "nonsense"),
        (["simulate", "--out"], "--out"),
        (["train", "--out", "run", "--epochs", "many"], "many"),
        (["events", "clip.mp4", "--thresholdon", "0.2", "--out", "e.h5"], "--thresholdon"),
        (["trian"], "did you mean 'train'"),
        (["simulate", "--setup", "main-naer", "--out", "d"], "perhaps you meant 'main-near'"),
        (["lab", "--setup=nope", "--out", "d"], "'nope'"),
        (["identify", "main-near", "nope"], "'nope'"),
        (["invert", "capture", "--setup", "nope.yaml"], "nope.yaml does not exist"),
        (["report", "run", "--data", "d", "--setup", "simulate-papr"], "perhaps you meant 'simulate-paper'"),
        (["simulate", "--config", "nope.yaml", "--out", "d"], "nope.yaml does not exist"),
        (["simulate", "--setup.pixel.kind", "nope", "--out", "d"], "no event model of kind 'nope'"),
        (["train", "--network.kind", "senquence", "--out", "d"], "did you mean 'sequence'"),
        (["train", "--data", "nope", "--out", "d"], "nope is no dataset"),
        (["events", "pyproject.toml", "--pixel", "davis", "--out", "e.h5"], "did you mean 'davis346'"),
        (["reconstruct", "capture", "--weights", "nope"], "far-frame-sequence"),
        (["finetune", "--data", "d", "--out", "run", "--weights", "nope"], "far-frame-sequence"),
        (["weights", "nope"], "far-frame-sequence"),
        (["track", "nope"], "nope is not a folder"),
        (["calibrate", "nope", "--out", "d"], "nope is not a folder"),
        (["capture", "check", "nope"], "nope is not a folder"),
        (["capture", "init", "nope", "--camera", "evk5"], "did you mean evk4"),
        (["verify", "nope"], "nope is no dataset"),
        (["import", "docs", "--test", "Q", "--out", "d"], "named Q or shows it; hold out some of docs"),
        (["import", "--test", "Q", "docs", "--out", "d"], "no captures given; name a capture folder, before"),
        (["demo", "--captures", "nope/*"], "nope/* matches nothing"),
        (["capture", "check", "nope*"], "nope* matches nothing; give the folder of a capture"),
        (["import", "nope/*", "--out", "d"], "nope/* matches nothing; give the folder of a capture"),
        (["clean", "nope*.raw", "--out", "e.h5"], "nope*.raw matches nothing"),
        (["events", "nope*", "--out", "e.h5"], "nope* matches nothing"),
        (["invert", "captures/*x", "--setup", "main-near"], "captures/*x matches nothing"),
        (["experiment", "nope"], "mismatch"),
        (["experiment", "mismatch", "--setups", "nope"], "two-lobes"),
        (["live", "nope"], "centuryarks-vga"),
        (["live", "-", "--port", "99999"], "give 1 to 65535"),
        (["demo", "--test", "Q", "--out", "d"], "test has 'Q', and no capture shows it"),
        (["demo", "--modalities", "events", "--out", "d"], "did you mean 'event'"),
        (["experiment", "captures", "--captures", "d", "--seeds"], "--seeds is empty"),
        (["experiment", "mismatch", "--modalities", "frames"], "did you mean 'frame'"),
        (["experiment", "captures", "--captures", "d", "--arms", "nope"], "EPNP uncalibrated"),
        (["train", "--simulate", "nope.yaml", "--out", "d"], "nope.yaml does not exist"),
        (["invert", "nope", "--setup", "main-near"], "nope: no such file"),
        (["pixel", "fit", "nope", "--light", "sine", "10", "0.5", "--out", "d"], "nope: no such file"),
        (["events", "nope.mp4", "--out", "e.h5"], "nope.mp4: no such file"),
        (["clean", "nope.raw", "--out", "e.h5"], "nope.raw: no such file"),
        (["corner", "nope.mp4", "--edge", "9", "9", "--wall", "9", "0", "--end", "0", "9"], "no such file"),
    ],
)
def test_words_and_names_of_nothing_are_refused_before_any_library_is_loaded(
    words: list[str], says: str
) -> None:
    code = (
        "import sys\n"
        "from evnlos.__main__ import main\n"
        f"sys.argv = ['evnlos', *{words!r}]\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    print(end.code, *sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    exit_code, *modules = done.stdout.split()
    assert exit_code == "2"
    assert done.stderr.count("\n") == 1 and says in done.stderr and "Traceback" not in done.stderr
    assert not set(HEAVY) & set(modules)


def test_a_capture_is_begun_without_any_library(tmp_path) -> None:
    code = (
        "import sys\n"
        "from evnlos.__main__ import main\n"
        f"sys.argv = ['evnlos', 'capture', 'init', {str(tmp_path / 'shot')!r}, '--camera', 'evk4']\n"
        "main()\n"
        "print(*sorted(sys.modules))"
    )
    told, modules = subprocess.check_output([sys.executable, "-c", code], text=True).splitlines()
    assert told.startswith(f"{tmp_path / 'shot' / 'capture.yaml'}: edit it")
    assert "width: 1280" in (tmp_path / "shot" / "capture.yaml").read_text()
    assert not set(HEAVY) & set(modules.split())


def test_help_in_a_thread_gives_no_other_thread_a_library_that_is_none() -> None:
    """A command's help is printed without the work's libraries; what another thread imports is whole."""
    script = """
import threading
from evnlos.cli import main
def ask():
    try:
        main(["train", "--help"])
    except SystemExit:
        pass
asking = threading.Thread(target=ask)
asking.start()
import numpy
asking.join()
print("evnlos.doctor" not in type(numpy.ndarray).__module__, numpy.arange(3).sum())
"""
    told = subprocess.check_output([sys.executable, "-c", script], text=True)
    assert told.splitlines()[-1] == "True 3"


def test_what_stands_in_for_a_library_cannot_be_gone_through() -> None:
    """A show's order of patterns is drawn while its command is described: a loop over it took all memory."""
    code = (
        "from evnlos.doctor import without_work_libraries\n"
        "with without_work_libraries():\n"
        "    import numpy as np\n"
        "    drawn = np.random.default_rng(0).permutation(3).tolist()\n"
        "    for use in (iter, list, enumerate, lambda drawn: 3 in drawn):\n"
        "        try:\n            use(drawn)\n"
        "        except TypeError:\n            print('refused')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["refused"] * 4


def test_a_scan_with_a_show_is_planned(tmp_path: Path) -> None:
    words = "--plane 0.16 0.08 --pitch 0.02 --display 1920 1080 --show page --targets RK --target-m 0.08"
    command = [sys.executable, "-m", "evnlos", "scan", "plan", str(tmp_path / "tray"), *words.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and (tmp_path / "tray" / "show.html").is_file()


def cpu_s(words: list[str]) -> float:
    """Return the CPU time of a run, seconds; its bytecode is kept, as an installation keeps it."""
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize(
    "words",
    [
        ["demo", "--help"],
        ["calibrate", "--help"],
        ["train", "--lerning-rate", "1"],
        ["simulate", "--setup", "nope", "--out", "d"],
        ["reconstruct", "capture", "--weights", "nope"],
        ["experiment", "nope"],
    ],
)
def test_help_wrong_words_and_unknown_names_take_little_more_than_the_parser(words: list[str]) -> None:
    """Beside NumPy and the parser, run in turn with it: 0.3 s where these take 0.13."""
    cpu_s(["-m", "evnlos", *words])  # which compiles
    runs = [["-m", "evnlos", *words], ["-c", "import numpy, tyro, yaml"]]
    assert any(own < 3 * libraries for own, libraries in ([cpu_s(one) for one in runs] for _ in range(4)))


def test_what_was_described_without_libraries_runs_with_them(tiny, tmp_path) -> None:
    save_yaml(tiny, tmp_path / "tiny.yaml")
    code = (
        "import sys\n"
        "from evnlos.__main__ import main\n"
        f"sys.argv = ['evnlos', 'simulate', '--config', {str(tmp_path / 'tiny.yaml')!r}]\n"
        "sys.argv += ['--out', 'nowhere', '--dry-run']\n"
        "main()\n"
        "import torch, evnlos, evnlos.setups\n"
        "assert torch.ones(2).sum() == 2 and evnlos.setups is sys.modules['evnlos.setups']\n"
        "assert evnlos.cameras.EventPixel is sys.modules['evnlos.cameras.pixel'].EventPixel\n"
        "assert evnlos.cameras.EventPixel() == evnlos.cameras.EventPixel()  # whole again: it compares\n"
        "import dataclasses, inspect, unittest.mock\n"
        "assert dataclasses.dataclass.__module__ == 'dataclasses'\n"
        "assert inspect.getsource.__module__ == 'inspect'\n"
        "assert isinstance(unittest.mock.Mock(), unittest.mock.Mock)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
