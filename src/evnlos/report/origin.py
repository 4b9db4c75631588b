"""How a report was made: machine and versions, the commands that make it again, all settings."""

from __future__ import annotations

import html
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
import yaml

from evnlos.dataset import Dataset
from evnlos.report.commands import Commands
from evnlos.report.gather import RunResult
from evnlos.setups import NamedSetup
from evnlos.version import __version__

_MOST_NAMES = 60  # of objects that are listed one by one; a simulation has hundreds
_PACKAGES = ("torch", "numpy", "numba", "h5py", "Pillow")


def origin_section(
    dataset: Dataset, results: list[RunResult], split: str, rig: NamedSetup | None = None
) -> str:
    """Return the section of environment, commands and settings; `rig` is the one that was named."""
    commands = Commands(dataset, results, split, rig)
    parts = [
        f"<h2>How it was made</h2><p>{html.escape(environment())}</p>"
        "<p>To make it again, where the folders of the captures lie, with the files of settings below:</p>"
        f"{_pre(chr(10).join(commands.again()))}"
    ]
    if behind := commands.published():
        parts.append(
            "<p>Weights of these names come with the package; the report needs no training of them. They were "
            f"trained so:</p>{_pre(chr(10).join(behind))}"
        )
    about: dict[str, Any] = {"dataset": {"name": dataset.folder.resolve().name, "settings": dataset.config}}
    about["runs"] = {r.name: [_without_settings(step) for step in r.history] for r in results}
    files = "".join(f"<h3>{html.escape(name)}</h3>{_pre(_yaml(one))}" for name, one in commands.files().items())
    return (
        "".join(parts) + f"<details><summary>Files of settings</summary>{files}</details>"
        f"<details><summary>Data and versions of every training</summary>{_pre(_yaml(about))}</details>"
    )


def _without_settings(step: dict[str, Any]) -> dict[str, Any]:
    """Return what a training was apart from its settings; of many objects their number and ends."""
    data = {key: _short(value) for key, value in step["data"].items()}
    return {key: value for key, value in step.items() if key != "settings"} | {"data": data}


def _short(value: Any) -> Any:
    if isinstance(value, list) and len(value) > _MOST_NAMES:
        return f"{len(value)}, {value[0]} to {value[-1]}"
    return value


def _yaml(value: Any) -> str:
    return yaml.safe_dump(value, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)


def _pre(text: str) -> str:
    return f"<pre>{html.escape(text)}</pre>"


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
