"""`evnlos convert`: an event file in, an event file of another format out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from evnlos.cli.console import Flat, result
from evnlos.cli.event_files import EventFile, Reading, Taking, amount, counted, refuse_existing
from evnlos.cli.notes import say
from evnlos.errors import ConfigError
from evnlos.events import EventWriter
from evnlos.events.io.report import OnError


@dataclass(frozen=True)
class ConvertCommand:
    """Convert an event file, block by block: the new file appears when it is complete."""

    file: EventFile
    """Event file of any format that is read; it may be larger than memory."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The file to write; its ending says the format: .h5, .npz, .raw (EVT3), .aedat4, .csv, ..._100M.bin."""
    format: str | None = None
    """Format to write where the ending does not say, e.g. EVT2 or EVT21 for .raw."""
    on_error: OnError = "strict"
    """strict: damage ends the conversion, and nothing is written; salvage: damage is left out and told."""
    reading: Flat[Reading] = field(default_factory=Reading)
    taking: Flat[Taking] = field(default_factory=Taking)
    keep_known_polarity: bool = False
    """Leave out events whose polarity the camera did not give; RAW formats cannot hold them."""
    force: bool = False
    """Replace the file where it exists."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Convert, with a progress bar over the events."""
        refuse_existing(self.out, self.force)
        if self.out.exists() and self.file.exists() and self.out.samefile(self.file):
            raise ConfigError(f"{self.out} is the file that is read; give another name")
        recording = self.reading.open(self.file, self.on_error)
        cut = self.taking.cut(self.keep_known_polarity)
        with EventWriter(self.out, format=self.format) as writer:
            for piece in counted(recording.pieces(cut), self.out.name):
                writer.write(piece)
            if not writer.events:
                writer.write(recording.blank(cut))
        report = recording.report
        if not report.clean:
            say(f"note: {report}")
        if report.geometry_from in ("assumed", "events"):
            say(f"note: the sensor size {report.width} x {report.height} is a guess; give --width and --height")
        size = self.out.stat().st_size
        about = {"out": str(self.out), "events": writer.events, "bytes": size, "faults": dict(report.faults)}
        about |= {"width": report.width, "height": report.height, "geometry_from": report.geometry_from}
        result(self.json, about, f"{self.out}: {writer.events:,} events, {amount(size, 'B')}")
