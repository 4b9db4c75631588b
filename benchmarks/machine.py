"""What a table was measured on, in one line: processor, cores, and the versions that matter."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path


def machine(*packages: str) -> str:
    """Return the processor, the number of cores, and the versions of Python, numba and other packages.

    Args:
        packages: Names of distributions; those that are not installed are left out.
    """
    fields: dict[str, str] = {}
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = (line.split(":", 1) for line in info.read_text().splitlines() if ":" in line)
        fields = {key.strip(): value.strip() for key, value in lines}
    name = fields.get("model name") or platform.processor() or platform.machine()
    if "cpu family" in fields:
        name += f" (family {fields['cpu family']}, model {fields.get('model')})"
    versions = [f"Python {platform.python_version()}"]
    for package in ("numba", *packages):
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return f"{name}, {os.cpu_count()} cores; {', '.join(versions)}"
