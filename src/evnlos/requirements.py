"""What the package can't work without, and how an installation gets it back; needs none of it itself."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

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
