"""`evnlos lab`: a setup in, pseudo-real capture folders out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from evnlos.cli.console import Flat, Presets
from evnlos.cli.notes import say
from evnlos.dataset.lab import Lab, lab_of, render_captures
from evnlos.progress import ProgressBars


@dataclass(frozen=True)
class LabCommand:
    """Render pseudo-real captures: a wall of metal or paint, other cameras than the training simulator's."""

    PRESETS: ClassVar[Presets[Lab]] = {"default": Lab}

    out: Path
    """Folder for the capture folders; a capture that is there is done."""
    setup: str | None = None
    """The setup: a name (mirror, easy, main, hard, matte or aperture, with -near or -far), a room (two-lobes,
    one-sided, curved, brushed, streaks, torch: outside the simulator's model), a settings file, or a folder
    that `evnlos calibrate` wrote; by default main-near. A name but a room's leaves light and cameras to the
    lab."""
    config: Path | None = None
    """YAML file with settings of the laboratory."""
    workers: int = 1
    """Processes; 0 = one for each core. The captures are the same for any number."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""
    settings: Flat[Lab] = field(default_factory=Lab)

    @staticmethod
    def with_setup(settings: Lab, word: str) -> Lab:
        """Return the lab with the setup of `--setup`."""
        return lab_of(word, settings)

    def run(self) -> None:
        """Render, with a progress bar over the captures."""
        for note in self.settings.glyphs.notes():
            say(note)
        with ProgressBars() as progress:
            rendered = render_captures(
                self.settings, self.out, workers=self.workers, progress=progress, force=self.force
            )
        print(f"{self.out}: {len(rendered)} captures; settings and the drawn sensor in {self.out / 'lab.yaml'}")
