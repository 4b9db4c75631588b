"""The list of verbs, in the order of the work."""

from __future__ import annotations

import ast
import importlib
from importlib.resources import files
from typing import Any

VERBS: dict[str, str] = {
    "demo": "experiment.DemoCommand",
    "simulate": "datasets.SimulateCommand",
    "capture": "datasets.CaptureCommand",
    "import": "datasets.ImportCommand",
    "verify": "datasets.VerifyCommand",
    "lab": "datasets.LabCommand",
    "calibrate": "calibration.CalibrateCommand",
    "scan": "calibration.ScanCommand",
    "pixel": "pixel.PixelCommand",
    "train": "learning.TrainCommand",
    "finetune": "learning.FinetuneCommand",
    "weights": "learning.WeightsCommand",
    "evaluate": "learning.EvaluateCommand",
    "experiment": "experiment.ExperimentCommand",
    "identify": "results.IdentifyCommand",
    "reconstruct": "results.ReconstructCommand",
    "live": "apps.LiveCommand",
    "invert": "invert.InvertCommand",
    "track": "results.TrackCommand",
    "report": "results.ReportCommand",
    "events": "events.EventsCommand",
    "info": "recordings.InfoCommand",
    "convert": "recordings.ConvertCommand",
    "preview": "recordings.PreviewCommand",
    "app": "apps.AppCommand",
    "cite": "about.CiteCommand",
    "doctor": "doctor.DoctorCommand",
    "completion": "about.CompletionCommand",
}
"""The command of each verb, as module in `evnlos.cli` and class. A class whose settings have presets names them
in `PRESETS`; one whose settings have a setup says in `with_setup` where it goes."""


def command_of(verb: str) -> type[Any]:
    """Return the command of a verb."""
    module, _, name = VERBS[verb].partition(".")
    return getattr(importlib.import_module(f"evnlos.cli.{module}"), name)


def summary_of(verb: str) -> str:
    """Return the first line of a command's description, without importing what the command needs."""
    module, _, name = VERBS[verb].partition(".")
    source = (files("evnlos.cli") / f"{module}.py").read_text(encoding="utf-8")
    command = next(
        node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == name
    )
    return (ast.get_docstring(command) or "").partition("\n")[0]
