"""`evnlos preview`: an event file in, an animation or a sheet of pictures out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from evnlos.cli.console import Flat
from evnlos.cli.event_files import EventFile, Reading, Taking, amount, counted
from evnlos.errors import ConfigError, DataError
from evnlos.events.recording import Cut, Recording
from evnlos.events.summary import summarise
from evnlos.plot.preview import Background, Look, Style, preview_pictures

_RATE_HZ = 12.5  # pictures a second of an animation
_FRAMES = {".gif": 40, ".png": 8}
_COLUMNS = 4


@dataclass(frozen=True)
class PreviewCommand:
    """Show an event file as an animation (.gif) or as a sheet of pictures (.png)."""

    file: EventFile
    """Event file of any format that is read; it may be larger than memory. Damage is left out."""
    out: Path | None = None
    """The picture, .gif or .png; by default the file's name with .gif, in the current folder."""
    style: Style = "polarity"
    """polarity: the events of each window by sign; surface: each pixel's newest event, fading."""
    frames: int | None = None
    """Number of windows, spread evenly over the recording; by default 40 (.gif) or 8 (.png)."""
    window_ms: float | None = None
    """Length of a window, milliseconds; by default as long as it takes to show something."""
    background: Background = "dark"
    """dark or light."""
    side: int = 480
    """About the longest side of a picture, pixels; larger sensors are added up, smaller ones magnified."""
    reading: Flat[Reading] = field(default_factory=Reading)
    taking: Flat[Taking] = field(default_factory=Taking)

    def run(self) -> None:
        """Read the file twice, to see how much it holds and to draw it, and write the picture."""
        out = self.out or Path(self.file.name).with_suffix(".gif")
        look = look_of(out, self.style, self.background, self.frames, self.window_ms, self.side)
        recording = self.reading.open(self.file, "salvage")
        size = write_preview(recording, self.taking.cut(), out, look)
        print(f"{out}: {look.frames} pictures, {amount(size, 'B')}")


def look_of(
    out: Path,
    style: Style = "polarity",
    background: Background = "dark",
    frames: int | None = None,
    window_ms: float | None = None,
    side_px: int = 480,
) -> Look:
    """Return the look of a preview, checked against the ending of its file."""
    if out.suffix.lower() not in _FRAMES:
        raise ConfigError(f"{out}: a preview ends in {' or '.join(_FRAMES)}; give such a name")
    if not out.parent.is_dir():
        raise ConfigError(f"{out}: no such folder {out.parent}; create it first")
    return Look(
        style, background, _FRAMES[out.suffix.lower()] if frames is None else frames, window_ms, side_px
    )


def write_preview(recording: Recording, cut: Cut, out: Path, look: Look) -> int:
    """Write the preview of a recording and return the size of the file, bytes."""
    from evnlos.report.pictures import save_animation, save_png, strip

    summary = summarise(counted(recording.pieces(cut), out.name))
    if not summary.events:
        raise DataError(f"{recording.path}: no events to show; see evnlos info {recording.path}")
    pieces = counted(recording.pieces(cut), out.name, summary.events)
    pictures = preview_pictures(pieces, summary, look)
    if out.suffix.lower() == ".gif":
        save_animation(out, pictures, _RATE_HZ)
    else:
        save_png(out, strip(pictures, _COLUMNS))
    return out.stat().st_size
