"""`evnlos lab`: a rig in, pseudo-real capture folders out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from evnlos.cli.console import Flat, progress
from evnlos.cli.notes import say
from evnlos.dataset.lab import Lab, lab_preset, render_captures
from evnlos.transport.rig import rig_names

PRESETS: dict[str, Callable[[], Lab]] = {"default": Lab}
PRESETS.update((name, partial(lab_preset, name)) for name in rig_names())


@dataclass(frozen=True)
class Command:
    """Render pseudo-real captures: a wall of metal or paint, other cameras than the training simulator's."""

    out: Path
    """Folder for the capture folders; a capture that is there is done."""
    preset: str = "default"
    """A named rig: mirror, easy, main, hard, matte or aperture, with -near or -far; `default` is main-near."""
    config: Path | None = None
    """Rig file: YAML with settings of the laboratory."""
    workers: int = 1
    """Processes; 0 = one for each core. The captures are the same for any number."""
    settings: Flat[Lab] = field(default_factory=Lab)

    def run(self) -> None:
        """Render, with a progress bar over the captures."""
        for note in self.settings.glyphs.notes():
            say(note)
        names = self.settings.glyphs.objects()
        rendered = render_captures(self.settings, self.out, workers=self.workers)
        for _ in progress(rendered, len(names), "captures", self.out):
            pass
        print(f"{self.out}: {len(names)} captures; settings and the drawn sensor in {self.out / 'lab.yaml'}")
