"""`evnlos lab`: a rig in, pseudo-real capture folders out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.cli.console import Flat, progress, say
from evnlos.dataset.lab import Lab, render_captures

PRESETS = {"default": Lab}


@dataclass(frozen=True)
class Command:
    """Render pseudo-real captures: rough aluminium, other cameras than the training simulator's."""

    out: Path
    """Folder for the capture folders."""
    config: Path | None = None
    """YAML file with settings of the laboratory."""
    settings: Flat[Lab] = field(default_factory=Lab)

    def run(self) -> None:
        """Render, with a progress bar over the captures."""
        for note in self.settings.glyphs.notes():
            say(note)
        names = self.settings.glyphs.objects()
        for _ in progress(render_captures(self.settings, self.out), len(names), "captures", self.out):
            pass
        print(f"{self.out}: {len(names)} captures")
