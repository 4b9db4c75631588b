"""Is a shot worth a day of recordings? What was recorded, in plain words, and how to mend it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from evnlos.dataset.capture import Capture
from evnlos.dataset.cleaning import find_hot_pixels
from evnlos.dataset.sampling import reduce_by_area

Level = Literal["good", "doubtful", "bad"]

_DARK_DN, _BORDER = 3, 0.08
_BLOCK = 6  # pixels: single ones tell nothing of the light
_FLICKER_HZ = ((99.0, 101.0), (119.0, 121.0))  # twice the mains' frequency
_FLICKER_BIN_S = 0.001
_FEWEST_EVENTS = 2_000
_FEWEST_S = 0.5  # a shorter recording tells no line in its spectrum


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Args:
        what: Name of the check.
        level: "good", "doubtful" (look at it) or "bad" (a reconstruction will suffer).
        found: What was measured, with its unit and the limit.
        cure: What to do; empty where nothing is to do.
    """

    what: str
    level: Level
    found: str
    cure: str = ""


def check_capture(capture: Capture) -> list[Finding]:
    """Return what a capture is worth, check by check: light, contrast, movement, place, events, clock.

    Args:
        capture: A capture that could be read.
    """
    return [
        *_light(capture),
        *_movement(capture),
        *_events(capture),
        *_flicker(capture),
        *_clock(capture),
    ]


def _light(capture: Capture) -> Iterator[Finding]:
    frames, peak = capture.frames, capture.peak
    clipped = float((frames >= peak).mean())
    cure = "" if clipped < 1e-3 else "shorten the exposure, close the aperture, or dim the ambient light"
    level: Level = "good" if clipped < 1e-3 else "doubtful" if clipped < 0.02 else "bad"
    yield Finding("saturation", level, f"{100 * clipped:.2f} % of the frames' pixels are clipped", cure)
    share = float(np.median(frames) / peak)
    dark = float((frames <= _DARK_DN).mean())
    level = "good" if dark < 0.05 else "doubtful" if dark < 0.5 else "bad"
    cure = "" if level == "good" else "lengthen the exposure, open the aperture, or bring the wall nearer"
    yield Finding(
        "brightness",
        level,
        f"the middle pixel is at {100 * share:.0f} % of the range; {100 * dark:.0f} % are darker than "
        f"{_DARK_DN + 1} digital numbers",
        cure,
    )


def _movement(capture: Capture) -> Iterator[Finding]:
    """Look at what changes in the frames beyond their noise, and where."""
    frames = capture.frames.astype(np.float32)
    if len(frames) < 5:
        yield Finding("movement", "doubtful", f"{len(frames)} frames tell nothing of a movement", "record more")
        return
    noise = float(np.sqrt(np.mean((frames[2:] - 2 * frames[1:-1] + frames[:-2]) ** 2) / 6))
    height, width = (max(1, round(side / _BLOCK)) for side in frames.shape[1:])
    variance = reduce_by_area(frames.var(axis=0, ddof=1), (height, width))
    # Of noise alone the block's variance is this sure, as a fraction; three times that is no movement.
    sure = np.sqrt(2 / ((len(frames) - 1) * frames[0].size / (height * width)))
    moved = np.sqrt(np.maximum(variance - noise**2 * (1 + 3 * sure), 0.0))
    ratio = float(np.quantile(moved, 0.95) / max(noise, 1e-6))
    level: Level = "good" if ratio > 1.0 else "doubtful" if ratio > 0.25 else "bad"
    cure = (
        "" if level == "good" else "check that the target moved and is lit, dim the ambient light, roughen less"
    )
    yield Finding(
        "movement", level, f"the wall's light changes by {ratio:.2f} times the frames' noise (1 is safe)", cure
    )
    contrast = float(np.quantile(moved, 0.95) / max(float(np.median(frames)), 1.0))
    level = "good" if contrast > 0.05 else "doubtful" if contrast > 0.01 else "bad"
    cure = "" if level == "good" else "dim the ambient light, light the target more, take a shinier wall"
    yield Finding(
        "wall contrast",
        level,
        f"the light that moves is {contrast:.2f} times the wall's own (0.05 is safe)",
        cure,
    )
    if ratio <= 0.25:
        return
    v, u = max(1, round(_BORDER * height)), max(1, round(_BORDER * width))
    if height < 3 * v or width < 3 * u:
        return
    inner = moved[v:-v, u:-u]
    edge = np.concatenate([moved[:v].ravel(), moved[-v:].ravel(), moved[:, :u].ravel(), moved[:, -u:].ravel()])
    outside = float(edge.mean() / max(inner.mean(), 1e-6))
    level = "good" if outside < 0.7 else "doubtful" if outside < 1.2 else "bad"
    cure = "" if level == "good" else "turn the camera to where the light moves, or take a wider lens or region"
    yield Finding(
        "region",
        level,
        f"the border changes {outside:.2f} times as much as the inside (below 0.7 is safe)",
        cure,
    )


def _events(capture: Capture) -> Iterator[Finding]:
    events = capture.events
    span_s = max(float(events.t_us[-1] - events.t_us[0]) * 1e-6, 1e-6)
    pixels = events.width * events.height
    rate = len(events) / span_s / pixels
    level: Level = "good" if 0.05 <= rate <= 50 else "doubtful" if 0.01 <= rate <= 200 else "bad"
    cure = ""
    if rate < 0.05:
        cure = "lower the thresholds, dim the ambient light, light the target more, or move it faster"
    elif rate > 50:
        cure = "raise the thresholds, or look for flicker and a camera that shakes"
    yield Finding("event rate", level, f"{rate:.2f} events a pixel and second (0.05 to 50 is safe)", cure)
    on = float(events.p.mean())
    level = "good" if 0.25 < on < 0.75 else "doubtful" if 0.1 < on < 0.9 else "bad"
    cure = (
        "" if level == "good" else "set the thresholds of both polarities alike; a leak makes ON events alone"
    )
    yield Finding(
        "polarity balance", level, f"{100 * on:.0f} % of the events are ON (25 to 75 % is safe)", cure
    )
    counts = np.bincount(events.y.astype(np.int64) * events.width + events.x, minlength=pixels)
    silent = float((counts == 0).mean())
    level = "good" if silent < 0.5 else "doubtful" if silent < 0.9 else "bad"
    cure = "" if level == "good" else "lower the thresholds; a linear map of so few events shows little"
    yield Finding(
        "silent pixels", level, f"{100 * silent:.0f} % of the pixels sent nothing (below 50 % is safe)", cure
    )
    hot = find_hot_pixels(events)
    share = float(counts.reshape(events.shape)[hot].sum() / len(events))
    level = "good" if share < 0.02 else "doubtful" if share < 0.2 else "bad"
    cure = "" if level == "good" else "set filters: {hot_pixel_factor: 10} in capture.yaml"
    yield Finding(
        "hot pixels",
        level,
        f"{int(hot.sum())} pixels send {100 * share:.1f} % of the events (2 % is safe)",
        cure,
    )


def _flicker(capture: Capture) -> Iterator[Finding]:
    """Look for a line at twice the mains' frequency in the rate of events."""
    t_s = (capture.events.t_us - capture.events.t_us[0]) * 1e-6
    bins = int(t_s[-1] / _FLICKER_BIN_S)
    if len(t_s) < _FEWEST_EVENTS or bins * _FLICKER_BIN_S < _FEWEST_S:
        yield Finding("flicker", "doubtful", f"{len(t_s)} events are too few to tell", "record longer")
        return
    counts, _ = np.histogram(t_s, bins, (0.0, bins * _FLICKER_BIN_S))
    power = np.abs(np.fft.rfft(counts - counts.mean())) ** 2
    frequency = np.fft.rfftfreq(bins, _FLICKER_BIN_S)
    around = np.median(power[(frequency > 80) & (frequency < 140)])
    found = {}
    for low, high in _FLICKER_HZ:
        line = power[(frequency >= low) & (frequency <= high)].max(initial=0.0)
        found[round((low + high) / 2)] = float(line / max(around, 1e-12))
    worst = max(found, key=lambda hertz: found[hertz])
    # The power of noise is exponential: a line 30 times its median has a chance of 1e-9 a bin.
    level: Level = "good" if found[worst] < 30 else "doubtful" if found[worst] < 300 else "bad"
    cure = "" if level == "good" else "light with direct current, or with daylight; mains lamps flicker"
    yield Finding(
        "flicker",
        level,
        f"the rate's line at {worst} Hz is {found[worst]:.0f} times its surroundings (30 is safe)",
        cure,
    )


def _clock(capture: Capture) -> Iterator[Finding]:
    frames, events = capture.frame_times_us, capture.events.t_us
    both = min(frames[-1], events[-1]) - max(frames[0], events[0])
    share = float(max(both, 0) / max(frames[-1] - frames[0], 1))
    level: Level = "good" if share > 0.95 else "doubtful" if share > 0.5 else "bad"
    cure = "" if level == "good" else "check alignment in capture.yaml: offset_us, auto, or a trigger_channel"
    yield Finding("clock", level, f"events cover {100 * share:.0f} % of the frames' time (95 % is safe)", cure)
    steps = np.diff(frames)
    uneven = float(np.abs(steps - np.median(steps)).max() / max(float(np.median(steps)), 1.0))
    level = "good" if uneven < 0.2 else "doubtful"
    cure = (
        "" if level == "good" else "frames were dropped or the rate changed; a position is as long as its step"
    )
    yield Finding(
        "frame times", level, f"the most uneven step is off by {100 * uneven:.0f} % (20 % is safe)", cure
    )
