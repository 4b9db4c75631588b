"""Event files: one format a file, found from the content."""

from evnlos.events.files.aedat4 import write_aedat4
from evnlos.events.files.celex import CelexOptions
from evnlos.events.files.columns import ReadReport, Stream
from evnlos.events.files.frames_triggers import (
    FrameReader,
    Frames,
    FrameStack,
    Triggers,
    frame_blocks,
    gather_frames,
    iter_frames,
    read_frames,
    read_timed_frames,
    read_triggers,
)
from evnlos.events.files.read import iter_events, read_events, read_events_report
from evnlos.events.files.registry import FORMATS, EventWriter, write_events
from evnlos.events.files.word_write import write_celex_frames

__all__ = [
    "FORMATS",
    "CelexOptions",
    "EventWriter",
    "FrameReader",
    "FrameStack",
    "Frames",
    "ReadReport",
    "Stream",
    "Triggers",
    "frame_blocks",
    "gather_frames",
    "iter_events",
    "iter_frames",
    "read_events",
    "read_events_report",
    "read_frames",
    "read_timed_frames",
    "read_triggers",
    "write_aedat4",
    "write_celex_frames",
    "write_events",
]
