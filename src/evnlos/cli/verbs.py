"""The list of verbs, in the order of the work."""

from __future__ import annotations

import importlib
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
