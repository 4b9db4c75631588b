"""`evnlos info`: what an event file holds, and what is wrong with it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

from evnlos.cli.console import Flat
from evnlos.cli.event_files import EventFile, Reading, amount, counted
from evnlos.errors import printable
from evnlos.events import ReadReport
from evnlos.events.summary import WINDOW_US, Summary, summarise

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
    reading: Flat[Reading] = field(default_factory=Reading)
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Read the file once and print."""
        recording = self.reading.open(self.file, "salvage")
        summary = summarise(counted(recording.pieces(), self.file.name))
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
    if found["skipped"]:
        rows.append(("skipped", f"{found['skipped']:,} events before the first row or time: no fault"))
    rows.append(("memory", f"{amount(found['memory_bytes'], 'B')} as arrays"))
    tally = ", ".join(f"{count:,} {kind.replace('_', ' ')}" for kind, count in found["faults"].items())
    left = f"; {found['bytes_left_over']:,} bytes of no use" if found["bytes_left_over"] else ""
    rows.append(("faults", tally + left if tally else "none"))
    rows += [
        ("", f"first at {line.removeprefix(f'{name}: ').split('; ')[0]}") for line in found["first_faults"]
    ]
    lines = [f"{name}: {found['format']}, {amount(found['bytes'], 'B')}"]
    return "\n".join(map(printable, lines + [f"  {title:<10}{text}" for title, text in rows]))


def _event_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    first, length = found["first_us"] / 1e6, found["duration_us"] / 1e6
    busiest, window_ms = found["busiest_pixel"], WINDOW_US // 1000
    rate = f"{amount(found['rate_hz'], 'ev/s')} on average"
    if found["duration_us"] > WINDOW_US:
        peak = amount(found["peak_10ms_hz"], "ev/s")
        rate += f", {peak} in the busiest {window_ms} ms (from {_at(found['peak_at_us'])})"
    share = 100 * busiest["events"] / found["events"]
    silence = (
        f"the longest {found['longest_silence_us'] / 1e3:.3g} ms, from {_at(found['longest_silence_at_us'])}"
    )
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
    return f"{time_us / 1e6:.6g} s"


def _polarity(found: dict[str, Any]) -> str:
    on, known = found["on_fraction"], found["polarity_known_fraction"]
    if on is None:
        return "unknown: the file gives none"
    part = f"{100 * on:.1f} % ON, {100 * (1 - on):.1f} % OFF"
    return part if known == 1 else f"{part} of the {100 * known:.1f} % of events whose polarity is known"
