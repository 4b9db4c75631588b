"""What the commands share: flat settings, progress bars, results as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

T = TypeVar("T")
Folders = Annotated[tuple[Path, ...], tyro.conf.Positional]
"""One or more folders, given without a flag."""
Flat = Annotated[T, tyro.conf.arg(name="")]
"""Settings whose flags carry no prefix."""
Presets = Mapping[str, Callable[[], T]]
"""Settings by the name that `--preset` gives."""


def result(as_json: bool, values: Mapping[str, Any], text: str) -> None:
    """Print a command's result on stdout: its values as one JSON object, or a line for people."""
    print(json.dumps(values, default=str) if as_json else text)
