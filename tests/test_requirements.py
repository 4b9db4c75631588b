"""Where a required package is missing or broken: which one and the cure, in one line, from every command."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import evnlos
from evnlos.cli import VERBS, main
from evnlos.cli.main import command_of, summary_of
from evnlos.doctor import REQUIRED, faults

ROOT = Path(evnlos.__file__).parent.parent.parent
GONE = """
import sys
for name in sys.argv[1].split(","):
    sys.modules[name] = None  # its import fails as if it were not installed
from evnlos.cli import main
main(sys.argv[2:])
"""


def without(modules: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process in which modules can't be imported."""
    call = [sys.executable, "-c", GONE, modules, *words]
    return subprocess.run(call, capture_output=True, text=True, timeout=300)


def test_the_list_is_that_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert sorted(REQUIRED.values()) == sorted(project["dependencies"])
    assert faults() == []


def test_what_the_package_imports_is_declared() -> None:
    """Also where an import stands inside a function: a package for development is none for users."""
    of_extras = {
        "aedat",
        "av",
        "fontpkg",
        "matplotlib",
        "deepinv",
        "gradio",
        "starlette",
        "dask",
        "distributed",
        "lz4",
        "zstandard",
        "neuromorphic_drivers",
    }
    of_required = {"llvmlite": "numba", "pydantic_core": "pydantic"}  # they bring them
    undeclared = {}
    for path in sorted(Path(evnlos.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in (of_required.get(name.split(".")[0], name.split(".")[0]) for name in names):
                if name not in sys.stdlib_module_names | REQUIRED.keys() | of_extras | {"evnlos"}:
                    undeclared.setdefault(name, []).append(str(path))
    assert undeclared == {}


NOT_IN_ALL = {"all", "docs", "dev"}


def test_the_page_on_installing_gives_the_size_of_every_extra() -> None:
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    sizes = dict(re.findall(r"^\| `(\w+)` \| (\d+) \|", page, flags=re.MULTILINE))
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert sizes.keys() == declared.keys()
    parts = [int(size) for extra, size in sizes.items() if extra not in NOT_IN_ALL]
    assert max(parts) < int(sizes["all"]) <= sum(parts)  # what two of them share counts once


@pytest.mark.parametrize("module", REQUIRED)
def test_the_doctor_names_each_missing_package(module: str, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SystemExit) as stop:
        main(["doctor", "--json"])
    parts = json.loads(capsys.readouterr().out)["parts"]
    name = REQUIRED[module].partition(">")[0]
    found = next(part for part in parts if part["name"] == name)
    assert stop.value.code == 1
    assert found == {
        "name": name,
        "there": False,
        "found": "not installed",
        "cure": f"pip install '{REQUIRED[module]}'",
        "needed": True,
    }


@pytest.mark.parametrize("module", ["numpy", "torch", "tyro"])
def test_the_doctor_starts_without_what_others_import_first(module: str) -> None:
    done = without(module, "doctor")
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert f"! BROKEN  {module}: not installed; pip install '{REQUIRED[module]}'" in done.stdout
    if module == "numpy":
        assert "numba: needs numpy, which is not installed; pip install" in done.stdout


def test_version_and_help_need_nothing() -> None:
    everything = ",".join(REQUIRED)
    assert without(everything, "--version").stdout.strip() == evnlos.__version__
    shown = without(everything, "--help").stdout
    named = re.findall(r"^  (\S+)", shown, re.MULTILINE)  # flags that all share stand further right
    assert named == list(VERBS)
    # Neither is imported although it could be.
    call = "import sys; from evnlos.cli import main; main(['--version'])\n"
    call += "print({'torch', 'numpy'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize(("module", "verb"), [("numpy", "info"), ("tyro", "cite"), ("yaml", "cite")])
def test_a_command_without_a_package_is_one_line(module: str, verb: str) -> None:
    done = without(module, verb, "nowhere")
    name = REQUIRED[module].partition(">")[0]
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(
        f"evnlos {verb}: error: {name} is not installed; pip install '{REQUIRED[module]}'"
    )
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "error", ["OSError('libhdf5.so: cannot open')", "AttributeError('_ARRAY_API not found')"]
)
def test_a_broken_package_is_named(error: str, tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "h5py.py").write_text(f"raise {error}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "h5py", raising=False)
    (fault,) = faults()
    kind, text = error.rstrip("')").split("('")
    assert fault.name == "h5py" and fault.found == f"broken ({kind}: {text})"
    assert fault.cure == "pip install --force-reinstall 'h5py>=3.11'"
    monkeypatch.setattr(sys.modules["evnlos.cli.main"], "command_of", lambda _: __import__("h5py"))
    with pytest.raises(SystemExit) as stop:
        main(["info"])
    assert stop.value.code == 2 and "error: h5py is broken" in capsys.readouterr().err


def test_the_overview_says_what_each_command_says() -> None:
    for verb in VERBS:
        assert summary_of(verb) == command_of(verb).__doc__.splitlines()[0]
