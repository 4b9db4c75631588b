"""What a live run did: pictures, latencies, drops, rates; as numbers and as a table."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from evnlos.live.chunk import Source
from evnlos.live.engine import Picture
from evnlos.live.queue import ChunkQueue

_KEPT = 100_000  # pictures whose times are kept: half an hour at 50 a second, 6 MB
_RECENT = 100
_PERCENTILES = (50, 90, 99)

ROWS = {
    "oldest_event": "oldest new event to picture",
    "newest_event": "newest event to picture",
    "wait": "of the oldest: waiting",
    "surface": "of both: surface and maps",
    "network": "of both: network",
}
"""What is measured of each picture, in words."""


class Tally:
    """Counts what a run does, while it runs and afterwards.

    Args:
        source: Where the events come from.
        queue: The queue behind it.
    """

    def __init__(self, source: Source, queue: ChunkQueue) -> None:
        self._source, self._queue = source, queue
        self._times: deque[tuple[float, ...]] = deque(maxlen=_KEPT)
        self._recent: deque[tuple[float, int, float]] = deque(maxlen=_RECENT)
        self.pictures = self.events = 0
        self._first: tuple[float, int] | None = None  # instant and events of the first picture
        self._last_s = 0.0

    def add(self, picture: Picture) -> None:
        """Count a picture."""
        t = picture.timing
        self._times.append((t.oldest_s, t.newest_s, t.wait_s, t.surface_s, t.network_s))
        self._recent.append((picture.made_s, picture.events, t.oldest_s))
        self.pictures += 1
        self.events += picture.events
        self._first = self._first or (picture.made_s, picture.events)
        self._last_s = picture.made_s

    def now(self) -> dict[str, Any]:
        """Return how it goes: rates of the last 100 pictures, their median latency, drops."""
        recent = list(self._recent)
        span = recent[-1][0] - recent[0][0] if len(recent) > 1 else 0.0
        times = np.array([oldest_s * 1e3 for _, _, oldest_s in recent if np.isfinite(oldest_s)])
        return {
            "pictures": self.pictures,
            "pictures_hz": round((len(recent) - 1) / span, 1) if span else 0.0,
            "events_hz": round(sum(n for _, n, _ in recent[1:]) / span) if span else 0,
            "latency_ms": [round(float(v), 1) for v in np.percentile(times, [50, 99])] if len(times) else [],
            **self._losses(),
        }

    def _losses(self) -> dict[str, Any]:
        queue = self._queue
        dropped = {"events": queue.dropped_events, "chunks": queue.dropped_chunks}
        return {"dropped": dropped, "faults": self._source.faults()}

    def summary(self) -> dict[str, Any]:
        """Return everything: counts, rates, percentiles of the last 100,000 pictures in milliseconds.

        Seconds and rates are from the first picture to the last.
        """
        begun_s, first_events = self._first or (self._last_s, 0)
        seconds = self._last_s - begun_s
        times = np.array(self._times).reshape(-1, len(ROWS)) * 1e3  # [pictures, rows]
        return {
            "source": self._source.name,
            "seconds": round(seconds, 3),
            "pictures": self.pictures,
            "pictures_hz": round((self.pictures - 1) / seconds, 2) if seconds else 0.0,
            "events": self.events,
            "events_hz": round((self.events - first_events) / seconds) if seconds else 0,
            **self._losses(),
            "latency_ms": {name: _spread(times[:, k]) for k, name in enumerate(ROWS)},
        }


def _spread(values: np.ndarray) -> dict[str, float] | None:
    """Return percentiles, maximum and mean of the values that are finite; None where there is none."""
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    found = {f"p{q}": float(np.percentile(values, q)) for q in _PERCENTILES}
    found |= {"max": float(values.max()), "mean": float(values.mean())}
    return {name: round(value, 3) for name, value in found.items()}


def latency_table(summary: dict[str, Any]) -> str:
    """Return a summary as lines of text: percentiles, rates, what was lost."""
    names = ("p50", "p90", "p99", "max")
    lines = [f"{'latency, ms':<32}{''.join(f'{name:>9}' for name in names)}"]
    for row, title in ROWS.items():
        spread = summary["latency_ms"][row]
        cells = (f"{spread[name]:9.1f}" if spread else f"{'-':>9}" for name in names)
        lines.append(f"{title:<32}{''.join(cells)}")
    pictures = f"{summary['pictures']:,} pictures ({summary['pictures_hz']:.1f} a second)"
    events = f"{summary['events']:,} events ({summary['events_hz']:,} a second)"
    lines.append(f"{pictures} of {events} in {summary['seconds']:.1f} s")
    dropped, faults = summary["dropped"], _listed(summary["faults"].items())
    lines.append(f"dropped by the queue: {dropped['events']:,} events in {dropped['chunks']:,} chunks")
    return "\n".join([*lines, *([f"left out by the source: {faults}"] if faults else [])])


def _listed(faults: Iterable[tuple[str, int]]) -> str:
    return ", ".join(f"{count:,} {name}" for name, count in faults if count)
