"""How a report was made: machine and versions, the commands that make it again, all settings."""

from __future__ import annotations

import html
import platform
import shlex
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
import yaml

from evnlos.dataset import Dataset
from evnlos.report.gather import RunResult
from evnlos.report.tables import label
from evnlos.version import __version__

_PACKAGES = ("torch", "numpy", "numba", "h5py", "Pillow")


def origin_section(dataset: Dataset, results: list[RunResult], split: str) -> str:
    """Return the last section: environment, commands, settings."""
    about: dict[str, Any] = {"dataset": {"name": dataset.folder.resolve().name, "settings": dataset.config}}
    about["runs"] = {label(r): r.history for r in results}
    text = yaml.safe_dump(about, sort_keys=False, allow_unicode=True)
    return (
        f"<h2>How it was made</h2><p>{html.escape(environment())}</p>"
        "<p>To make it again, with the settings below in files of these names:</p>"
        f"<pre>{html.escape(chr(10).join(commands(dataset, results, split)))}</pre>"
        "<details><summary>Settings and versions of every training</summary>"
        f"<pre>{html.escape(text)}</pre></details>"
    )


def environment() -> str:
    """Return machine and versions in a line, without names of users, hosts or folders."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    parts = [f"evnlos {__version__}", f"Python {platform.python_version()}"]
    for name in _PACKAGES:
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    system = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads, {device}"
    return f"{', '.join(parts)}; {system}"


def commands(dataset: Dataset, results: list[RunResult], split: str) -> list[str]:
    """Return the commands behind the runs, trainings first, each once."""
    made: dict[str, None] = {}
    for r in results:
        before = None
        for number, step in enumerate(r.history, start=1):
            last = number == len(r.history)
            out = r.name if last else f"{r.name}-{number}"
            words = ["evnlos", "finetune" if before else "train", "--data", step["data"]["name"]]
            words += ["--weights", before] if before else []
            made[shlex.join([*words, "--config", f"{out}.yaml", "--out", out])] = None
            before = out
    words = ["evnlos", "report", *(r.name for r in results), "--data", dataset.folder.resolve().name]
    if dataset.origin == "captures":
        names = dataset.objects()
        held = [word for key in ("validation", "test") for word in _flag(key, dataset.split.get(key, []))]
        folder = dataset.folder.resolve().name
        return [shlex.join(["evnlos", "import", *names, "--out", folder, *held]), *made, _report(words, split)]
    return [*made, _report(words, split)]


def _flag(name: str, values: list[str]) -> list[str]:
    return [f"--{name}", *values] if values else []


def _report(words: list[str], split: str) -> str:
    return shlex.join([*words, "--split", split, "--out", "report.html"])
