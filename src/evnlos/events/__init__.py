"""Event streams: files and representations."""

from evnlos.events.grids import edges_from_count, edges_from_rate, suggest_tau_us
from evnlos.events.io import ReadReport, read_events, read_events_report, write_events
from evnlos.events.surface import normalise_surface, time_surface
from evnlos.events.volume import event_frame, event_histogram, threshold_ordinal_surface, voxel_grid

__all__ = [
    "ReadReport",
    "edges_from_count",
    "edges_from_rate",
    "event_frame",
    "event_histogram",
    "normalise_surface",
    "read_events",
    "read_events_report",
    "suggest_tau_us",
    "threshold_ordinal_surface",
    "time_surface",
    "voxel_grid",
    "write_events",
]
