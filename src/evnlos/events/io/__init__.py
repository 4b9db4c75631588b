"""Event files: one format a file, found from the content."""

from evnlos.events.io.aedat4_write import write_aedat4
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.celex_write import write_celex_frames
from evnlos.events.io.frames import Frames, read_frames, read_timed_frames
from evnlos.events.io.read import read_events, read_events_report
from evnlos.events.io.registry import FORMATS
from evnlos.events.io.report import ReadReport
from evnlos.events.io.stream import iter_events
from evnlos.events.io.triggers import Triggers, read_triggers
from evnlos.events.io.write import EventWriter, write_events

__all__ = [
    "FORMATS",
    "CelexOptions",
    "EventWriter",
    "Frames",
    "ReadReport",
    "Triggers",
    "iter_events",
    "read_events",
    "read_events_report",
    "read_frames",
    "read_timed_frames",
    "read_triggers",
    "write_aedat4",
    "write_celex_frames",
    "write_events",
]
