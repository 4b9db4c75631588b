"""Event streams: files and representations."""

from evnlos.events.grids import edges_from_count, edges_from_rate, suggest_tau_us
from evnlos.events.io import (
    CelexOptions,
    ReadReport,
    iter_events,
    read_events,
    read_events_report,
    read_frames,
    write_celex_frames,
    write_events,
)
from evnlos.events.polarity import keep_known_polarity
from evnlos.events.surface import normalise_surface, time_surface
from evnlos.events.volume import event_frame, event_histogram, threshold_ordinal_surface, voxel_grid

__all__ = [
    "CelexOptions",
    "ReadReport",
    "edges_from_count",
    "edges_from_rate",
    "event_frame",
    "event_histogram",
    "iter_events",
    "keep_known_polarity",
    "normalise_surface",
    "read_events",
    "read_events_report",
    "read_frames",
    "suggest_tau_us",
    "threshold_ordinal_surface",
    "time_surface",
    "voxel_grid",
    "write_celex_frames",
    "write_events",
]
