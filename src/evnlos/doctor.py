"""Is this installation whole? What the package needs, what was found, and how an installation gets it back.

- What the package can't work without, and how an installation gets it back; needs none of it itself.
- Is this installation whole? Each part, what was found, and what to do where it is missing.
- A command described without the libraries that its work needs, so that help comes at once; what is said where
  these take long to load.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.metadata
import importlib.util
import inspect
import linecache
import os
import platform
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evnlos.errors import EvnlosError
from evnlos.machine import ProgressBars, Step
from evnlos.registry import __version__

REQUIRED = {
    "numpy": "numpy>=1.26",
    "torch": "torch>=2.6",
    "numba": "numba>=0.61",
    "scipy": "scipy>=1.12",
    "h5py": "h5py>=3.11",
    "safetensors": "safetensors>=0.4.5",
    "filelock": "filelock>=3.12",
    "PIL": "Pillow>=10.4",
    "yaml": "PyYAML>=6.0",
    "pydantic": "pydantic>=2.9",
    "tyro": "tyro>=1.0",
    "tqdm": "tqdm>=4.66",
    "threadpoolctl": "threadpoolctl>=3.5",
    "lazy_loader": "lazy-loader>=0.6",
}
"""Requirement as pip takes it by the module to import, those that others need first."""


@dataclass(frozen=True)
class Fault:
    """A required package that can't be imported.

    Args:
        name: Its name for pip.
        found: What is wrong with it, in one line.
        cure: What to do.
    """

    name: str
    found: str
    cure: str


def faults() -> list[Fault]:
    """Import every required package, and return those that can't be."""
    found: dict[str, Fault] = {}
    for module in REQUIRED:
        try:
            importlib.import_module(module)
        except Exception as error:
            fault = fault_behind(error) or _broken(module, error)
            found.setdefault(fault.name, fault)
    return list(found.values())


def fault_behind(error: BaseException) -> Fault | None:
    """Return the required package whose import raised an error; None where it came from elsewhere."""
    if isinstance(error, ModuleNotFoundError) and error.name in REQUIRED:
        requirement = REQUIRED[error.name]
        return Fault(_pip_name(error.name), "not installed", f"pip install '{requirement}'")
    # An import runs the module's own code: the innermost required package that was at it is the broken one.
    trace, culprit = error.__traceback__, None
    while trace is not None:
        module = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
        if trace.tb_frame.f_code.co_name == "<module>" and module in REQUIRED:
            culprit = module
        trace = trace.tb_next
    if culprit is None and isinstance(error, ImportError) and error.name:
        culprit = error.name.partition(".")[0]
    return _broken(culprit, error) if culprit in REQUIRED else None


def _broken(module: str, error: BaseException) -> Fault:
    lines = str(error).strip().splitlines() or [""]
    cure = f"pip install --force-reinstall '{REQUIRED[module]}'"
    return Fault(_pip_name(module), f"broken ({type(error).__name__}: {lines[0][:200]})", cure)


def _pip_name(module: str) -> str:
    return REQUIRED[module].partition(">")[0]


@dataclass(frozen=True)
class Part:
    """One part of the installation.

    Args:
        name: What it is.
        there: Whether it works.
        found: What was found.
        cure: What to do; empty where it works.
        needed: Whether the package is broken without it; else it is optional.
    """

    name: str
    there: bool
    found: str
    cure: str = ""
    needed: bool = False


_EXTRAS = {
    "aedat": ("aedat", "reads AEDAT4 recordings"),
    "neuromorphic_drivers": ("camera", "reads event cameras on a cable"),
    "zstandard": ("ros", "reads packed ROS recordings"),
    "av": ("video", "reads and writes videos"),
    "matplotlib": ("plot", "draws figures"),
    "gradio": ("app", "opens the page to play with"),
    "distributed": ("cluster", "simulates on a Dask cluster"),
}


def examine() -> list[Part]:
    """Return all parts, needed ones first."""
    checks = {"torch": _torch, "numba": _numba, "hdf5": _hdf5, "fonts": _fonts}
    checks |= {"reader": _reader, "GPU": _gpu, "LPIPS": _lpips, "comic face": _comic, "disk": _disk}
    first = [_python(), *_packages()]
    named = {part.name for part in first}
    rest = [_tried(*check) for check in checks.items() if check[0] not in named]
    return [*first, *rest, *(_extra(module) for module in _EXTRAS)]


def _tried(name: str, check: Callable[[], Part]) -> Part:
    """Return what a check finds; one that fails itself is a part that is broken."""
    try:
        return check()
    except Exception as error:
        fault = fault_behind(error)
        if fault is not None:
            return Part(name, False, f"needs {fault.name}, which is {fault.found}", fault.cure, needed=True)
        cure = "reinstall evnlos and what it needs: pip install --force-reinstall evnlos"
        return Part(name, False, f"{type(error).__name__}: {error}", cure, needed=True)


def _python() -> Part:
    good = sys.version_info >= (3, 11)
    found = f"evnlos {__version__}, Python {platform.python_version()} on {platform.machine()}"
    return Part("python", good, found, "" if good else "install Python 3.11 or newer", needed=True)


def _packages() -> list[Part]:
    """Return the required packages that can't be imported, one part each; one part for all where all can."""
    wrong = [Part(fault.name, False, fault.found, fault.cure, needed=True) for fault in faults()]
    found = f"all {len(REQUIRED)} that evnlos needs can be imported"
    return wrong or [Part("packages", True, found, needed=True)]


def _torch() -> Part:
    import torch

    capability = torch.backends.cpu.get_cpu_capability()
    value = float(torch.ones(3, 3).matmul(torch.ones(3, 3)).sum())
    found = f"torch {torch.__version__}, CPU {capability}, {torch.get_num_threads()} threads"
    return Part("torch", value == 27.0, found, "" if value == 27.0 else "reinstall torch", needed=True)


def _numba() -> Part:
    """Compile a small kernel and see that the folder where numba keeps those of the package can be written."""
    import numba

    from evnlos.cameras import streams

    compiled = numba.njit(lambda x: x + 1)(1) == 2
    cache = Path(next(kernel.stats.cache_path for kernel in vars(streams).values() if hasattr(kernel, "stats")))
    cache.mkdir(parents=True, exist_ok=True)
    writable = _can_write(cache)
    cure = (
        "" if writable else "set NUMBA_CACHE_DIR to a folder that you may write: kernels compile anew each run"
    )
    if not compiled:
        cure = "reinstall numba and llvmlite"
    found = f"numba {numba.__version__}, kernels {'are kept' if writable else 'cannot be kept'} between runs"
    return Part("numba", compiled and writable, found, cure, needed=not compiled)


def _hdf5() -> Part:
    import h5py

    good = h5py.h5z.filter_avail(h5py.h5z.FILTER_FLETCHER32)
    found = (
        f"h5py {h5py.__version__}, HDF5 {h5py.version.hdf5_version}, checksums {'on' if good else 'missing'}"
    )
    return Part("hdf5", good, found, "" if good else "reinstall h5py from its wheel", needed=True)


def _fonts() -> Part:
    from evnlos.scene.fonts import find_font
    from evnlos.scene.handwriting import FACES

    try:
        missing = [name for name in FACES["both"] if find_font(name).substituted_for is not None]
    except EvnlosError as error:
        return Part("fonts", False, str(error).split(";")[0], "pip install evnlos[fonts]")
    found = f"{len(FACES['both']) - len(missing)} of {len(FACES['both'])} faces of the simulated characters"
    cure = f"pip install evnlos[fonts]: {', '.join(missing)} is missing" if missing else ""
    return Part("fonts", not missing, found, cure)


def _reader() -> Part:
    """Load the weights that the package brings: those of the reader of characters."""
    from evnlos.analysis.scores import load_reader

    try:
        size = sum(values.numel() for values in load_reader().parameters())
    except EvnlosError as error:
        return Part("reader", False, str(error), "reinstall evnlos: its weights are damaged", needed=True)
    return Part("reader", True, f"{size:,} weights that tell whether an image can be read")


def _gpu() -> Part:
    import torch

    if not torch.cuda.is_available():
        cure = "needed for long trainings only: install a driver, and torch's build for it"
        return Part("GPU", False, "none that torch can use; the CPU does everything", cure)
    name = torch.cuda.get_device_name()
    try:
        value = float(torch.ones(3, 3, device="cuda").matmul(torch.ones(3, 3, device="cuda")).sum())
    except RuntimeError as error:
        value, name = 0.0, f"{name}: {str(error).splitlines()[0]}"
    good = value == 27.0
    cure = "" if good else "install torch's build for this GPU and driver, or hide it: CUDA_VISIBLE_DEVICES=''"
    return Part("GPU", good, name, cure)


def _lpips() -> Part:
    from evnlos.analysis import load_lpips

    try:
        load_lpips(os.environ.get("EVNLOS_VGG16"))
    except EvnlosError as error:
        cure = "put the trunk into torch's hub cache or name it in EVNLOS_VGG16; pip install lpips"
        return Part("LPIPS", False, str(error).split("; give")[0].removeprefix("LPIPS: "), cure)
    return Part("LPIPS", True, "trunk and heads are there")


def _comic() -> Part:
    from evnlos.scene.fonts import find_font

    try:
        font = find_font("Comic Neue Bold")
    except EvnlosError as error:
        return Part("comic face", False, str(error).split(";")[0], "install fonts-comic-neue (Debian)")
    if font.substituted_for is None:
        return Part("comic face", True, f"{font.family} at weight {font.weight}: the paper's test face")
    return Part(
        "comic face", False, f"{font.family} stands in for Comic Neue", "install fonts-comic-neue (Debian)"
    )


def _disk() -> Part:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    good = free > 2
    return Part(
        "disk", good, f"{free:.0f} GiB free here", "" if good else "free some: a dataset takes about 1 GiB"
    )


def _extra(module: str) -> Part:
    extra, use = _EXTRAS[module]
    if importlib.util.find_spec(module) is None:
        return Part(f"[{extra}]", False, f"not installed; {use}", f"pip install evnlos[{extra}]")
    try:
        version = importlib.metadata.version(module)
    except importlib.metadata.PackageNotFoundError:
        cure = f"pip install --force-reinstall evnlos[{extra}]"
        return Part(f"[{extra}]", False, f"{module} is there without its metadata; {use}", cure)
    return Part(f"[{extra}]", True, f"{use} ({module} {version})")


def _can_write(folder: Path) -> bool:
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return True
    except OSError:
        return False


WORK_LIBRARIES = (
    "numpy",
    "torch",
    "numba",
    "llvmlite",
    "scipy",
    "h5py",
    "PIL",
    "safetensors",
    "pydantic",
    "threadpoolctl",
    "unittest",  # typeguard asks whether a value is a mock, and mocks bring asyncio
)
"""What takes most of a start, or brings that along, and describes no flag."""


class _StandIn:
    """What a name of a library that is not imported stands for, as far as a module's top level uses it.

    It decorates without effect, is a base class of nothing, and stands in annotations. It holds nothing to go
    through: by `__getitem__` alone it would never end.
    """

    __iter__ = None

    def __init__(self, name: str) -> None:
        self._name = name

    def __repr__(self) -> str:
        return self._name

    def __getattr__(self, name: str) -> _StandIn:
        if name.startswith("__"):
            raise AttributeError(name)
        return _StandIn(f"{self._name}.{name}")

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if len(arguments) == 1 and not named and callable(arguments[0]):
            return arguments[0]  # what it decorates
        return _StandIn(f"{self._name}()")

    def __getitem__(self, _: Any) -> _StandIn:
        return self

    def __or__(self, *_: Any) -> Any:
        return self

    __ror__ = __neg__ = __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __or__
    __truediv__ = __rtruediv__ = __floordiv__ = __pow__ = __matmul__ = __lshift__ = __invert__ = __or__

    def __mro_entries__(self, _: tuple[Any, ...]) -> tuple[type, ...]:
        return ()

    def __instancecheck__(self, _: object) -> bool:
        return False


class _StandInLibraries(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Import modules of `WORK_LIBRARIES` as modules that hold a `_StandIn` under every name."""

    def find_spec(
        self, name: str, path: Any = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a module of nothing for a library that takes long, and leave all others to Python."""
        if name.partition(".")[0] not in WORK_LIBRARIES:
            return None
        return importlib.machinery.ModuleSpec(name, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> Any:
        """Return the module that Python makes itself."""

    def exec_module(self, module: Any) -> None:
        """Let the module have every name."""
        stand_in = _StandIn(module.__name__)
        module.__getattr__ = stand_in.__getattr__


@contextlib.contextmanager
def without_work_libraries() -> Iterator[None]:
    """Import modules of this package without `WORK_LIBRARIES`: enough to describe a command, not to run it.

    Its dataclasses have no comparison, hash, text or guard against change meanwhile, and the source of a class
    is found by its first line. Afterwards what was imported is forgotten, as far as it is of this package or of
    those libraries.
    """
    finder, before, collects = _StandInLibraries(), set(sys.modules), gc.isenabled()
    kept = {name: dict(vars(module)) for name, module in sys.modules.items() if _is_ours(name)}
    ways = dataclasses.dataclass, inspect.getsource
    sys.meta_path.insert(0, finder)
    gc.disable()  # a tenth of the time, and next to nothing to collect
    dataclasses.dataclass, inspect.getsource = _bare_dataclass(ways[0]), _quick_source(ways[1])
    try:
        yield
    finally:
        dataclasses.dataclass, inspect.getsource = ways
        if collects:
            gc.enable()
        sys.meta_path.remove(finder)
        for name in set(sys.modules) - before:
            if _is_ours(name) or name.partition(".")[0] in WORK_LIBRARIES:
                del sys.modules[name]
        for name, names in kept.items():  # a package holds its modules as attributes, too
            for added in set(vars(sys.modules[name])) - set(names):
                delattr(sys.modules[name], added)


@contextlib.contextmanager
def told_while_loading(after_s: float | None = None) -> Iterator[None]:
    """Show progress while libraries are imported, where that takes long.

    Args:
        after_s: How long no progress begins, seconds. None: four on a terminal, where a bar shows at once and
            most starts need none; else half of one, since lines wait by themselves.
    """
    if after_s is None:
        after_s = 4.0 if hasattr(sys.stderr, "isatty") and sys.stderr.isatty() else 0.5
    what, within = "start", "loading PyTorch and other libraries"
    with contextlib.ExitStack() as stack:
        shown = list[ProgressBars]()

        def begin() -> None:
            shown.append(stack.enter_context(ProgressBars()))
            shown[0](Step(what, 0, 1, "stages", within=within))

        later = threading.Timer(after_s, begin)
        later.daemon = True
        later.start()
        try:
            yield
        finally:
            later.cancel()
            later.join()
            for progress in shown:
                progress(Step(what, 1, 1, "stages"))


def _bare_dataclass(usual: Any) -> Any:
    """Return a decorator that makes of this package's classes dataclasses of fields and `__init__` alone.

    Each other method is a text that Python compiles: a fifth of what the description of a command took.
    """

    def decorate(cls: Any = None, /, **how: Any) -> Any:
        if cls is None:
            return functools.partial(decorate, **how)
        bare = {"frozen": False, "eq": False, "repr": False} if _is_ours(cls.__module__) else {}
        return usual(cls, **how | bare)

    return decorate


def _quick_source(usual: Any) -> Any:
    """Return a function that finds the source of a class of ours; Python parses a whole module for it."""

    def source(thing: Any) -> str:
        name = getattr(thing, "__qualname__", ".")
        if not inspect.isclass(thing) or "." in name or not _is_ours(thing.__module__):
            return usual(thing)
        text = "".join(linecache.getlines(inspect.getfile(thing)))
        found = re.search(rf"^class {name}\b.*\n(?:[ \t].*\n|\n|\).*\n)*", text, re.MULTILINE)
        return found[0] if found else usual(thing)

    return source


def _is_ours(name: str) -> bool:
    return name.partition(".")[0] == "evnlos"
