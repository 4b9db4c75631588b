"""The list of verbs, in the order of the work."""

from __future__ import annotations

import ast
import importlib
from importlib.resources import files
from types import ModuleType

VERBS: dict[str, str] = {
    "demo": "demo",
    "simulate": "simulate",
    "capture": "capture",
    "import": "importing",
    "verify": "verify",
    "lab": "lab",
    "calibrate": "calibrate",
    "scan": "scan",
    "train": "train",
    "finetune": "finetune",
    "weights": "weights",
    "evaluate": "evaluate",
    "experiment": "experiment",
    "identify": "identify",
    "reconstruct": "reconstruct",
    "live": "live",
    "invert": "invert",
    "track": "track",
    "report": "report",
    "events": "events",
    "info": "info",
    "convert": "convert",
    "preview": "preview",
    "app": "app",
    "cite": "cite",
    "doctor": "doctor",
    "completion": "completion",
}
"""The module of each verb in `evnlos.cli`; it holds `Command`, and `PRESETS` where settings have presets."""


def module_of(verb: str) -> ModuleType:
    """Return the module of a verb."""
    return importlib.import_module(f"evnlos.cli.{VERBS[verb]}")


def summary_of(verb: str) -> str:
    """Return the first line of a command's description, without importing what the command needs."""
    source = (files("evnlos.cli") / f"{VERBS[verb]}.py").read_text(encoding="utf-8")
    classes = [node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)]
    command = next(node for node in classes if node.name == "Command")
    return (ast.get_docstring(command) or "").partition("\n")[0]
