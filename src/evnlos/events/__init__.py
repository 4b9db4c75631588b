"""Event streams: files and representations."""

from evnlos.events.batch import event_batch, events_from_tensors, events_to_tensors
from evnlos.events.files import (
    CelexOptions,
    EventWriter,
    Frames,
    ReadReport,
    Stream,
    Triggers,
    iter_events,
    read_events,
    read_events_report,
    read_frames,
    read_timed_frames,
    read_triggers,
    write_aedat4,
    write_celex_frames,
    write_events,
)
from evnlos.events.grids import edges_from_count, edges_from_rate, keep_known_polarity, suggest_tau_us
from evnlos.events.surface import normalise_surface, time_surface
from evnlos.events.volume import (
    event_frame,
    event_histogram,
    intensity_map,
    threshold_ordinal_surface,
    voxel_grid,
)

__all__ = [
    "CelexOptions",
    "EventWriter",
    "Frames",
    "ReadReport",
    "Stream",
    "Triggers",
    "edges_from_count",
    "edges_from_rate",
    "event_batch",
    "event_frame",
    "event_histogram",
    "events_from_tensors",
    "events_to_tensors",
    "intensity_map",
    "iter_events",
    "keep_known_polarity",
    "normalise_surface",
    "read_events",
    "read_events_report",
    "read_frames",
    "read_timed_frames",
    "read_triggers",
    "suggest_tau_us",
    "threshold_ordinal_surface",
    "time_surface",
    "voxel_grid",
    "write_aedat4",
    "write_celex_frames",
    "write_events",
]
