"""Event files: one format a file, found from the content."""

from evnlos.events.io.read import read_events, read_events_report
from evnlos.events.io.registry import FORMATS
from evnlos.events.io.report import ReadReport
from evnlos.events.io.write import write_events

__all__ = ["FORMATS", "ReadReport", "read_events", "read_events_report", "write_events"]
