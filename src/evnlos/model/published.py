"""Weights that come with the package, by name."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).parent / "published"


def published() -> dict[str, Path]:
    """Return the weights that come with the package: name, such as "near-frame", -> file."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.safetensors"))}
