"""Commands on event files: `convert`, `info`, `preview`, and what commands share.

- What all commands share: flat settings, presets, results as JSON, figures of several objects.
- What the commands on event files share: how a file is read, what is taken of it, numbers in words.
- `evnlos convert`: an event file in, an event file of another format out.
- `evnlos info`: what an event file holds, and what is wrong with it.
- `evnlos preview`: an event file in, an animation or a sheet of images out.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from evnlos.cli.parsing import refuse_existing, say
from evnlos.errors import ConfigError, DataError, printable
from evnlos.events import CelexOptions, EventWriter, ReadReport
from evnlos.events.files.columns import OnError
from evnlos.events.recording import WINDOW_US, Box, CropOptions, Recording, Summary, summarise
from evnlos.machine import ProgressBars, Step
from evnlos.plot.preview import Background, PreviewOptions, Style, preview_images
from evnlos.types import Events, OutFile, length_text, matching_paths

T = TypeVar("T")
_PATHS = tyro.constructors.PrimitiveConstructorSpec(
    "*",
    "PATH [PATH ...]",
    lambda words: tuple(path for path in matching_paths(words) if not f".{path.name}".endswith(".lab.yaml")),
    lambda value: isinstance(value, tuple),
    lambda paths: [str(path) for path in paths],
)
_SOME = tyro.conf.arg(metavar="PATH...", help_behavior_hint="(required)")  # to the parser none would do
Folders = Annotated[tuple[Path, ...], tyro.conf.Positional, _SOME, _PATHS]
"""One or more folders, or patterns that match some, without a flag; the record of `lab` is left out."""
Flat = Annotated[T, tyro.conf.arg(name="")]
"""Settings whose flags carry no prefix."""
Presets = Mapping[str, Callable[[], T]]
"""Settings by the name that `--preset` gives."""
EventFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
"""An event file, given without a flag."""
Force = Annotated[bool, tyro.conf.arg(help="Replace files of these names that exist.")]
"""Whether results may be replaced; without it no command does."""


def result(as_json: bool, values: Mapping[str, Any], text: str) -> None:
    """Print a command's result on stdout: its values as one JSON object, or a line for people."""
    print(json.dumps(values, default=str) if as_json else text)


@dataclass(frozen=True)
class ReadOptions:
    """What a file does not say about itself."""

    width: int | None = None
    """Sensor width, pixels, where the file does not say or is wrong; give both or neither."""
    height: int | None = None
    """Sensor height, pixels."""
    topic: str | None = None
    """Stream to read, of a file with several topics or cameras; `evnlos info` lists them."""
    celex: CelexOptions = field(default_factory=CelexOptions)
    """What a CeleX-V recording does not say."""

    def open(self, path: Path, on_error: OnError) -> Recording:
        """Return the recording, its start checked."""
        celex = None if self.celex == CelexOptions() else self.celex
        return Recording(path, on_error, width=self.width, height=self.height, celex=celex, topic=self.topic)


@dataclass(frozen=True)
class SelectionOptions:
    """Which events are taken."""

    start: float = 0.0
    """Begin, seconds after the first event."""
    stop: float | None = None
    """End, seconds after the first event; by default the last event."""
    box: tuple[int, int, int, int] | None = None
    """Part of the sensor: X Y WIDTH HEIGHT, pixels; its corner becomes pixel (0, 0)."""

    def cut(self, known_polarity: bool = False) -> CropOptions:
        """Return the cut."""
        return CropOptions(self.start, self.stop, Box(*self.box) if self.box else None, known_polarity)


def events_counted(pieces: Iterable[Events], name: str, total: int | None = None) -> Iterator[Events]:
    """Yield the pieces, and show how many events have gone by."""
    done = 0
    with ProgressBars() as progress:
        progress(Step(name, 0, total or 0, "events"))
        for piece in pieces:
            yield piece
            done += len(piece)
            progress(Step(name, done, total or 0, "events"))


def say_of(report: ReadReport, out: Path) -> None:
    """Tell what was wrong with a file, and what of it the new file does not hold."""
    if not report.clean:
        say(f"note: {report}")
    if report.beside:
        say(f"note: {out} holds events alone, not the {' nor the '.join(report.beside)} of {report.path}")


def amount(value: float, unit: str) -> str:
    """Return a number with a prefix: 12.3 kev/s.

    Example:
        >>> amount(12_345.0, "ev/s"), amount(999.99, "B")
        ('12.3 kev/s', '1000 B')
    """
    for prefix in ("", "k", "M", "G"):
        if abs(value) < 1000 or prefix == "G":
            break
        value /= 1000
    return f"{value:.3g} {prefix}{unit}" if value < 999.5 else f"{value:.0f} {prefix}{unit}"


@dataclass(frozen=True)
class ConvertCommand:
    """Convert an event file, block by block: the new file appears when it is complete."""

    file: EventFile
    """Event file of any format that is read; it may be larger than memory."""
    out: OutFile
    """The file to write; its ending says the format: .h5, .npz, .raw (EVT3), .mcap, .aedat4, .csv,
    ..._100M.bin."""
    format: str | None = None
    """Format to write where the ending does not say, e.g. EVT2 or EVT21 for .raw."""
    on_error: OnError = "strict"
    """strict: damage ends the conversion, and nothing is written; salvage: damage is left out and told."""
    reading: Flat[ReadOptions] = field(default_factory=ReadOptions)
    taking: Flat[SelectionOptions] = field(default_factory=SelectionOptions)
    keep_known_polarity: bool = False
    """Leave out events whose polarity the camera did not give; RAW formats cannot hold them."""
    force: Force = False
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Convert, with a progress bar over the events."""
        if self.out.exists() and self.file.exists() and self.out.samefile(self.file):
            raise ConfigError(f"{self.out} is the file that is read; give another name")
        recording = self.reading.open(self.file, self.on_error)
        cut = self.taking.cut(self.keep_known_polarity)
        with EventWriter(self.out, format=self.format) as writer:
            for piece in events_counted(recording.pieces(cut), self.out.name):
                writer.write(piece)
            if not writer.events:
                writer.write(recording.blank(cut))
        report = recording.report
        say_of(report, self.out)
        if report.geometry_from in ("assumed", "events"):
            say(f"note: the sensor size {report.width} x {report.height} is a guess; give --width and --height")
        size = self.out.stat().st_size
        about = {"out": str(self.out), "events": writer.events, "bytes": size, "faults": dict(report.faults)}
        about |= {"width": report.width, "height": report.height, "geometry_from": report.geometry_from}
        result(self.json, about, f"{self.out}: {writer.events:,} events, {amount(size, 'B')}")


_SOURCES = {
    "caller": "as given",
    "header": "from the file",
    "camera": "from the camera that the file names",
    "format": "of this format's only sensor",
    "events": "from the largest coordinates: the sensor may be larger",
    "assumed": "assumed, the file does not say: give --width and --height",
}


@dataclass(frozen=True)
class InfoCommand:
    """Show what an event file holds: sensor, rates, polarity, silences. Damage is shown, not refused."""

    file: EventFile
    """Event file of any format that is read; it may be larger than memory."""
    reading: Flat[ReadOptions] = field(default_factory=ReadOptions)
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Read the file once and print."""
        recording = self.reading.open(self.file, "salvage")
        summary = summarise(events_counted(recording.pieces(), self.file.name))
        found = describe(self.file.stat().st_size, recording.report, summary)
        print(json.dumps(found) if self.json else to_text(str(self.file), found))


def describe(size: int, report: ReadReport, summary: Summary) -> dict[str, Any]:
    """Return everything that is shown, as plain values.

    Args:
        size: Length of the file, bytes.
        report: What reading it found.
        summary: What it holds.
    """
    known = summary.events - summary.unknown
    busiest = summary.busiest
    return {
        "file": str(report.path),
        "format": report.format,
        "topic": report.topic or None,
        "streams": [asdict(stream) for stream in report.streams],
        "bytes": size,
        "width": report.width,
        "height": report.height,
        "geometry_from": report.geometry_from,
        "events": summary.events,
        "first_us": summary.first_us,
        "last_us": summary.last_us,
        "duration_us": summary.duration_us,
        "rate_hz": round(summary.rate_hz, 3),
        "peak_10ms_hz": summary.peak_hz,
        "peak_at_us": summary.peak_us,
        "on_fraction": round(summary.on / known, 6) if known else None,
        "polarity_known_fraction": round(known / summary.events, 6) if summary.events else None,
        "active_pixel_fraction": round(summary.active_pixels / max(summary.width * summary.height, 1), 6),
        "busiest_pixel": {"x": busiest[0], "y": busiest[1], "events": busiest[2]} if busiest else None,
        "longest_silence_us": summary.longest_silence.length_us,
        "longest_silence_at_us": summary.longest_silence.start_us,
        "silences_over_10ms": summary.silences,
        "columns": list(summary.columns),
        "triggers": report.triggers,
        "frames": report.frames,
        "skipped": report.skipped,
        "memory_bytes": summary.memory_bytes,
        "faults": dict(report.faults),
        "first_faults": list(report.first.values()),
        "bytes_left_over": report.bytes_left_over,
    }


def to_text(name: str, found: dict[str, Any]) -> str:
    """Return the found values as lines for people."""
    rows = [("sensor", f"{found['width']} x {found['height']} ({_SOURCES[found['geometry_from']]})")]
    if not found["events"]:
        rows.append(("events", "none"))
    else:
        rows += _event_rows(found)
    if found["triggers"]:
        rows.append(("triggers", f"{found['triggers']:,} edges"))
    if found["frames"]:
        rows.append(("frames", f"{found['frames']:,} images"))
    if found["skipped"]:
        rows.append(("skipped", f"{found['skipped']:,} events before the first row or time: no fault"))
    rows.append(("memory", f"{amount(found['memory_bytes'], 'B')} as arrays"))
    tally = ", ".join(f"{count:,} {kind.replace('_', ' ')}" for kind, count in found["faults"].items())
    left = f"; {found['bytes_left_over']:,} bytes of no use" if found["bytes_left_over"] else ""
    rows.append(("faults", tally + left if tally else "none"))
    rows += [
        ("", f"first at {line.removeprefix(f'{name}: ').split('; ')[0]}") for line in found["first_faults"]
    ]
    rows = [*_stream_rows(found), *rows]
    lines = [f"{name}: {found['format']}, {amount(found['bytes'], 'B')}"]
    return "\n".join(map(printable, lines + [f"  {title:<10}{text}" for title, text in rows]))


def _stream_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Return one row for each stream of the file; that which the other rows are about has a mark."""
    rows = []
    for stream in found["streams"]:
        count = "" if stream["count"] is None else f", {stream['count']:,} messages"
        mark = ", read here" if stream["name"] == found["topic"] else ""
        text = f"{stream['name']}: {stream['kind']} ({stream['type']}{count}){mark}"
        rows.append(("" if rows else "streams", text))
    return rows


def _event_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    first, length = found["first_us"] / 1e6, found["duration_us"] / 1e6
    busiest, window_ms = found["busiest_pixel"], WINDOW_US // 1000
    rate = f"{amount(found['rate_hz'], 'ev/s')} on average"
    if found["duration_us"] > WINDOW_US:
        peak = amount(found["peak_10ms_hz"], "ev/s")
        rate += f", {peak} in the busiest {window_ms} ms ({_at(found['peak_at_us'])})"
    share = 100 * busiest["events"] / found["events"]
    silence = f"the longest {_length(found['longest_silence_us'])}, {_at(found['longest_silence_at_us'])}"
    rows = [
        ("events", f"{found['events']:,} in {length:.6g} s, from {first:.6f} s on the file's clock"),
        ("rate", rate),
        ("polarity", _polarity(found)),
        (
            "pixels",
            f"{100 * found['active_pixel_fraction']:.3g} % sent events; the busiest is x {busiest['x']}, "
            f"y {busiest['y']}: {busiest['events']:,} events ({share:.2g} %)",
        ),
        ("silence", f"{silence}; {found['silences_over_10ms']:,} of more than {window_ms} ms"),
    ]
    extra = [name for name in found["columns"] if name not in ("t_us", "x", "y", "p")]
    return rows + ([("columns", f"also {', '.join(extra)}")] if extra else [])


def _at(time_us: int) -> str:
    return f"{time_us / 1e6:.6g} s after the first event"


def _length(time_us: int) -> str:
    return f"{time_us / 1e3:.3g} ms" if time_us < 1_000_000 else f"{time_us / 1e6:.6g} s"


def _polarity(found: dict[str, Any]) -> str:
    on, known = found["on_fraction"], found["polarity_known_fraction"]
    if on is None:
        return "unknown: the file gives none"
    part = f"{100 * on:.1f} % ON, {100 * (1 - on):.1f} % OFF"
    return part if known == 1 else f"{part} of the {100 * known:.1f} % of events whose polarity is known"


_RATE_HZ = 12.5  # images a second of an animation
_FRAMES = {".gif": 40, ".png": 8}
_COLUMNS = 4


@dataclass(frozen=True)
class PreviewCommand:
    """Show an event file as an animation (.gif) or as a sheet of images (.png)."""

    file: EventFile
    """Event file of any format that is read; it may be larger than memory. Damage is left out."""
    out: Path | None = None
    """The image, .gif or .png; by default the file's name with .gif, in the current folder."""
    style: Style = "polarity"
    """polarity: the events of each window by sign; surface: each pixel's newest event, fading."""
    frames: int | None = None
    """Number of windows, spread evenly over the recording; by default 40 (.gif) or 8 (.png)."""
    window_ms: float | None = None
    """Length of a window, milliseconds; by default as long as it takes to show something."""
    background: Background = "dark"
    """dark or light."""
    side: int = 480
    """About the longest side of an image, pixels; larger sensors are added up, smaller ones magnified."""
    reading: Flat[ReadOptions] = field(default_factory=ReadOptions)
    taking: Flat[SelectionOptions] = field(default_factory=SelectionOptions)
    force: Force = False

    def run(self) -> None:
        """Read the file twice, to see how much it holds and to draw it, and write the image."""
        out = self.out or Path(self.file.name or "events").with_suffix(".gif")
        refuse_existing(self.force, out)
        look = look_of(out, self.style, self.background, self.frames, self.window_ms, self.side)
        recording = self.reading.open(self.file, "salvage")
        size = write_preview(recording, self.taking.cut(), out, look)
        print(f"{out}: {look.frames} images, {amount(size, 'B')}")


def look_of(
    out: Path,
    style: Style = "polarity",
    background: Background = "dark",
    frames: int | None = None,
    window_ms: float | None = None,
    side_px: int = 480,
) -> PreviewOptions:
    """Return the look of a preview, checked against the ending of its file."""
    if out.suffix.lower() not in _FRAMES:
        raise ConfigError(f"{out}: a preview ends in {' or '.join(_FRAMES)}; give such a name")
    return PreviewOptions(
        style, background, _FRAMES[out.suffix.lower()] if frames is None else frames, window_ms, side_px
    )


def write_preview(recording: Recording, cut: CropOptions, out: Path, look: PreviewOptions) -> int:
    """Write the preview of a recording and return the size of the file, bytes."""
    from evnlos.report.pictures import save_animation, save_png, strip

    summary = summarise(events_counted(recording.pieces(cut), out.name))
    if not summary.events:
        raise DataError(f"{recording.path}: no events to show; see evnlos info {recording.path}")
    pieces = events_counted(recording.pieces(cut), out.name, summary.events)
    pictures = preview_images(pieces, summary, look)
    if out.suffix.lower() == ".gif":
        save_animation(out, pictures, _RATE_HZ)
    else:
        save_png(out, strip(pictures, _COLUMNS))
    return out.stat().st_size


def tracks_text(told: dict[str, Any]) -> str:
    """Return the figures of several objects as lines for people."""
    lines = [f"{told['capture']}: {told['targets']} moving object{'s' * (told['targets'] != 1)}"]
    for k, gain in enumerate(told["evidence_gains"]):
        error = " and the setup's own error" if k else ""
        lines.append(f"evidence    ln {gain:+.0f} for {k + 1} over {k}{error}")
    for k, row in enumerate(told["objects"]):
        travel, speed, sigma = (length_text(row[name]) for name in ("travel", "mean_speed", "position_sigma"))
        lines.append(f"object {k + 1}    travel {travel}, {speed}/s, position +- {sigma}")
        if row["target"] is not None:
            x, y, error = (length_text(one) for one in (*row["position_offset"], row["position_error"]))
            lines[-1] += f"; {row['target']}: error {error} rms about ({x}, {y})"
    return "\n".join([*lines, *told["pictures"]])
