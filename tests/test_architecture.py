"""The rules of the house: which stage may import which, what the core may not need, what names must say."""

import ast
import importlib
import importlib.metadata
import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

import evnlos

SOURCE = Path(evnlos.__file__).parent
FORBIDDEN = {"torchvision", "matplotlib", "gradio", "dask", "distributed", "scipy", "pandas", "cv2"}
CORE = {
    "PIL",
    "evnlos",
    "h5py",
    "lazy_loader",
    "llvmlite",
    "numba",
    "numpy",
    "safetensors",
    "threadpoolctl",
    "yaml",
}
CORE |= {"scipy", "colorama"}  # numba looks for them by itself and takes them where they are installed
STAGES = [
    "scene",
    "optics",
    "cameras",
    "events",
    "lab",
    "setups",
    "inverse",
    "data",
    "models",
    "tracking",
    "training",
    "analysis",
    "calibration",
    "plot",
    "report",
    "experiment",
]
LEAVES = {
    "machine",
    "registry",
    "types",
    "errors",
    "config",
    "files",
    "metrics",
    "tensor_file",
    "untrusted",
}
FILES = sorted(SOURCE.rglob("*.py"))
TESTS = Path(__file__).parent
MOST_DEEP_IMPORTS = 111
OF_NAMED_TUPLES = {"_asdict", "_fields", "_make", "_replace"}  # private by their look only
PRIVATE_TOUCHES = {
    ("test_capture_sources.py", "_BLOCK_BYTES"): "small: a block of 64 MB is not filled in seconds",
    ("test_capture_sources.py", "_HELD_BYTES"): "small: an import holds 64 MB of frames",
    ("test_comparison.py", "_TOGETHER"): "small: 128 samples are compared at a time",
    ("test_conditions.py", "_GAINS"): "small: each condition tries them all",
    ("test_conditions.py", "_SENSOR"): "small: each condition simulates all pixels",
    ("test_event_files_stream.py", "_BLOCK_BYTES"): "small: a decoder's state survives a cut at every word",
    ("test_event_files_stream.py", "_LOOK_AHEAD"): "small: 131,072 events are judged together",
    ("test_event_files_write.py", "_BLOCK_BYTES"): "small: a decoder's state survives a cut at every word",
    ("test_event_files_write.py", "_CHUNK"): "small: 65,536 events are copied at a time",
    ("test_event_files_write.py", "_PIECE"): "small: 65,536 events are put together",
    ("test_live.py", "_MOST_ANIMATED"): "small: 3000 images",
    ("test_live.py", "_SILENT_S"): "short: a silent viewer is let go after ten seconds",
    ("test_pretrained.py", "_CHECKOUT"): "place: as where the package is no checkout",
    ("test_progress.py", "_BEAT_S"): "short: two looks a second",
    ("test_sequence_network.py", "_POPULATIONS"): "small: thousands of targets",
    ("test_wall.py", "_shifted"): "kernel: the slow reference of the compiled shift",
    ("test_wall.py", "_write"): "kernel: the compiled shift",
}
"""Private names of the package that tests touch, and why: a kernel's own test, or a constant made small."""


def imported(path: Path, *, lazy: bool) -> set[str]:
    """Return the modules that a file imports; with `lazy`, also those inside functions."""
    tree = ast.parse(path.read_text())
    nodes = ast.walk(tree) if lazy else iter(tree.body)
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; name the package"
            names.add(node.module or "")
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_a_stage_imports_only_stages_to_its_left(path: Path) -> None:
    parts = path.relative_to(SOURCE).parts
    stage = parts[0].removesuffix(".py")
    for name in imported(path, lazy=True):
        if not name.startswith("evnlos."):
            continue
        other = name.split(".")[1]
        if stage in STAGES:
            assert other in LEAVES or STAGES.index(other) <= STAGES.index(stage), f"{path} imports {name}"
        elif stage in LEAVES:
            assert other in LEAVES, f"the leaf {path} imports {name}"


@pytest.mark.parametrize("path", sorted((SOURCE / "lab").glob("*.py")), ids=lambda p: p.name)
def test_the_second_renderer_shares_no_optics(path: Path) -> None:
    assert not [name for name in imported(path, lazy=True) if name.startswith("evnlos.optics")]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_the_core_imports_nothing_heavy(path: Path) -> None:
    assert not {name.split(".")[0] for name in imported(path, lazy=False)} & FORBIDDEN


WHOLE_CHAPTERS = {
    "analysis/confidence.py",
    "app/views.py",
    "calibration/fit.py",
    "calibration/frame_model.py",
    "calibration/scan/film.py",
    "calibration/wall_fit.py",
    "calibration/wall_search.py",
    "cameras/frame_camera.py",
    "cameras/pixels/brownian.py",
    "cameras/pixels/circuit.py",
    "cameras/pixels/readout.py",
    "data/frames.py",
    "data/simulate.py",
    "events/batch.py",
    "events/files/aedat.py",
    "doctor.py",
    "experiment/conditions.py",
    "inverse/corner.py",
    "inverse/event_images.py",
    "inverse/event_likelihood.py",
    "lab/light_path.py",
    "live/run.py",
    "models/drawn.py",
    "models/posterior.py",
    "models/sequence.py",
    "optics/corner.py",
    "optics/facets.py",
    "optics/radiometric.py",
    "scene/moving.py",
    "tracking/event_motion.py",
    "tracking/motion_fit.py",
}
"""One model, measurement or family of formats: cut in two, a reader would need both halves."""


def test_no_file_is_long() -> None:
    lengths = {str(path.relative_to(SOURCE)): len(path.read_text().splitlines()) for path in FILES}
    assert {name: n for name, n in lengths.items() if n > (600 if name in WHOLE_CHAPTERS else 400)} == {}


def test_modules_are_chapters() -> None:
    """Few and full: a new idea finds its chapter before it founds a file."""
    assert len(FILES) <= 230


def test_import_brings_only_what_the_core_needs() -> None:
    """What its import costs is measured by benchmarks/imports.py; here is what it may load beside PyTorch."""
    code = (
        "import json, sys, torch\n"
        "before = set(sys.modules)\nfrom evnlos import *\nprint(json.dumps(sorted(set(sys.modules) - before)))"
    )
    loaded = json.loads(subprocess.check_output([sys.executable, "-c", code]))
    brought = {name.split(".")[0] for name in loaded} & set(importlib.metadata.packages_distributions())
    assert {"evnlos", "numba"} <= brought <= CORE, brought - CORE


def test_rooms_are_names_of_the_package() -> None:
    assert all(getattr(evnlos, stage) is importlib.import_module(f"evnlos.{stage}") for stage in STAGES)


@pytest.mark.parametrize("name", evnlos.__all__)
def test_public_names_are_documented(name: str) -> None:
    thing = getattr(evnlos, name)
    if name.startswith("__"):
        return
    text = inspect.getdoc(thing) or ""
    assert text.split("\n\n")[0].rstrip().endswith("."), f"{name} needs a docstring of one sentence first"
    if inspect.isfunction(thing) and inspect.signature(thing).parameters:
        assert "Args:" in text, f"{name} needs its arguments with shapes and units"


WITHOUT_ARGS = {
    "cameras": {"pixel_preset"},
    "events": {"read_timed_frames"},
    "experiment": {
        "captures_of",
        "character_table",
        "difference",
        "generalization_table",
        "means_of",
        "read_records",
        "summary_table",
        "write_generalization",
        "write_record",
    },
    "models": {"find_weights"},
    "scene": {"character_name"},
    "tracking": {"straightened"},
}
"""Functions whose file has no line left for their arguments; may only shrink."""


OFFERED = (*STAGES, "calibration.scan", "live", "metrics", "studies", "tensor_file")


@pytest.mark.parametrize("room", OFFERED)
def test_functions_of_rooms_tell_their_arguments(room: str) -> None:
    module = importlib.import_module(f"evnlos.{room}")
    offered = {name: getattr(module, name) for name in getattr(module, "__all__", vars(module))}
    own = {
        name: one
        for name, one in offered.items()
        if inspect.isfunction(one) and not name.startswith("_") and one.__module__.startswith(f"evnlos.{room}")
    }
    untold = {
        name
        for name, one in own.items()
        if inspect.signature(one).parameters and "Args:" not in (inspect.getdoc(one) or "")
    }
    assert untold == WITHOUT_ARGS.get(room, set())


def test_the_project_names_no_machine() -> None:
    root = SOURCE.parent.parent
    words = ("/" + "work/", "/" + "root/", "/home/", "/" + "tmp/")
    for path in [*FILES, *root.glob("docs/*.md"), *root.glob("*.md")]:
        text = path.read_text()
        assert not [word for word in words if word in text], path


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_lists_what_it_offers(stage: str) -> None:
    module = importlib.import_module(f"evnlos.{stage}")
    constants_first = sorted(module.__all__, key=lambda n: (not n.isupper(), n[0].islower(), n))
    assert module.__all__ in (constants_first, sorted(module.__all__))  # of a list, or of a stub
    assert module.__doc__


def deep_imports(path: Path) -> set[str]:
    """Return the modules inside of stages that a test file imports, past the faces of the stages."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
            if node.module.startswith("evnlos.") and node.module.count(".") == 1:
                face = importlib.import_module(node.module)
                offered = getattr(face, "__all__", ())
                names += [f"{node.module}.{alias.name}" for alias in node.names if alias.name not in offered]
        for name in names:
            place = SOURCE.joinpath(*name.split(".")[1:])
            is_module = place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()
            if name.startswith("evnlos.") and name.count(".") > 1 and is_module:
                found.add(name)
    return found


def test_tests_speak_to_the_faces_of_stages() -> None:
    """How many modules inside of stages tests import may only shrink; a rename changes nothing."""
    found = set().union(*(deep_imports(path) for path in TESTS.glob("*.py")))
    assert len(found) <= MOST_DEEP_IMPORTS, f"import from the stages what these offer: {sorted(found)}"


def is_private(name: str) -> bool:
    """Return whether a name is private: one underscore in front, and no method of a named tuple."""
    return name.startswith("_") and not name.startswith("__") and name not in OF_NAMED_TUPLES


def private_touches(text: str) -> set[str]:
    """Return the private names of other modules that a test's source reads, imports, calls or replaces.

    What a class calls of itself is its own. A string counts where a function takes it for the name of an
    attribute, as `monkeypatch.setattr` does.
    """
    found = set[str]()
    for node in ast.walk(ast.parse(text)):
        names = list[str]()
        if isinstance(node, ast.Attribute):
            own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            names = [] if own else [node.attr]
        elif isinstance(node, ast.ImportFrom):
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [part for alias in node.names for part in alias.name.split(".")]
        elif isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("setattr", "getattr", "delattr", "hasattr", "attrgetter", "patch", "object"):
                parts = [part for one in node.args for part in ast.walk(one) if isinstance(part, ast.Constant)]
                names = [
                    name for part in parts if isinstance(part.value, str) for name in part.value.split(".")
                ]
        found |= {name for name in names if name.isidentifier() and is_private(name)}
    return found


def test_tests_touch_no_private_names() -> None:
    """What deserves a test has a name of its own; the table's entries go where they are no longer needed."""
    touched = {(path.name, name) for path in TESTS.glob("*.py") for name in private_touches(path.read_text())}
    assert touched - PRIVATE_TOUCHES.keys() == set(), "test through the public face"
    assert PRIVATE_TOUCHES.keys() - touched == set(), "no longer needed: take these out of the table"


@pytest.mark.parametrize(
    "text",
    [
        "room._thing",
        "from evnlos.room import _thing",
        "from evnlos._thing import other",
        "import evnlos._thing",
        'monkeypatch.setattr("evnlos.room._thing", 3)',
        'monkeypatch.setattr(f"{room}._thing", 3)',
        'monkeypatch.setattr(room, "_thing", 3)',
        'getattr(room, "_thing")',
    ],
)
def test_a_private_touch_is_seen(text: str) -> None:
    assert private_touches(text) == {"_thing"}
    assert private_touches(text.replace("_thing", "thing")) == set()
