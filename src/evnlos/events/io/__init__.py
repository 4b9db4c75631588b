"""Event files: one format a file, found from the content."""

from evnlos.events.io.celex_frames import read_frames
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.celex_write import write_celex_frames
from evnlos.events.io.read import read_events, read_events_report
from evnlos.events.io.registry import FORMATS
from evnlos.events.io.report import ReadReport
from evnlos.events.io.stream import iter_events
from evnlos.events.io.write import write_events

__all__ = [
    "FORMATS",
    "CelexOptions",
    "ReadReport",
    "iter_events",
    "read_events",
    "read_events_report",
    "read_frames",
    "write_celex_frames",
    "write_events",
]
