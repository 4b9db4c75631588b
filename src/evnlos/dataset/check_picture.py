"""One picture a capture, for the eye: do frames and events show the same thing at the same time?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.dataset.capture import Capture
from evnlos.dataset.sampling import reduce_by_area
from evnlos.events import event_histogram
from evnlos.events.colours import OFF_RGB, ON_RGB
from evnlos.types import Events

_PANEL_PX, _GAP_PX, _CAPTION_PX, _PLOT_PX = 320, 12, 24, 150
_INK, _PAPER, _LINE = (40, 42, 48), (255, 255, 255), (210, 212, 216)
_BINS = 200


def check_picture(capture: Capture) -> Image.Image:
    """Return the frame at the busiest moment, the events of its interval, both overlaid, and curves over time.

    The curves are the events a second and the mean change of the frames, each on its own scale: peaks of the
    one should stand above peaks of the other.

    Args:
        capture: A capture that was read.
    """
    times = capture.frame_times_us
    rates, centres_s = _event_rate(capture.events, times)
    changes = _frame_changes(capture.frames, capture.peak)
    edges = np.searchsorted(capture.events.t_us, times, side="right")
    chosen = int(np.argmax(np.diff(edges))) + 1 if len(times) > 1 else 0
    start, stop = (int(edges[chosen - 1]), int(edges[chosen])) if chosen else (0, len(capture.events))
    grey = _stretched(capture.frames[chosen].astype(np.float32))  # [H, W], 0..1
    tint = _events_tint(capture.events[start:stop])  # [H, W, 3], and how strong
    white, strength = np.full((*grey.shape, 3), 255.0), tint[1][..., None]
    pictures = [
        (f"frame {chosen} at {times[chosen] / 1e6:.3f} s", np.repeat(255 * grey[..., None], 3, axis=2)),
        (f"{stop - start:,} events before it", white * (1 - strength) + tint[0] * strength),
        ("overlay", 255 * grey[..., None] * (1 - strength) + tint[0] * strength),
    ]
    scale = _PANEL_PX / grey.shape[1]
    high = max(1, round(grey.shape[0] * scale))
    width = 3 * _PANEL_PX + 4 * _GAP_PX
    plot_top = 2 * _CAPTION_PX + high + 2 * _GAP_PX
    sheet = Image.new("RGB", (width, plot_top + _PLOT_PX + 2 * _CAPTION_PX), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    draw.text((_GAP_PX, 5), f"{capture.name}: {capture.info.camera.name}", _INK, font)
    how = Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX
    for k, (caption, picture) in enumerate(pictures):
        left = _GAP_PX + k * (_PANEL_PX + _GAP_PX)
        panel = Image.fromarray(np.round(picture).astype(np.uint8)).resize((_PANEL_PX, high), how)
        sheet.paste(panel, (left, 2 * _CAPTION_PX))
        draw.text((left, _CAPTION_PX + 4), caption, _INK, font)
    box = (_GAP_PX, plot_top, width - _GAP_PX, plot_top + _PLOT_PX)
    draw.rectangle(box, outline=_LINE)
    middles_s = (times[1:] + times[:-1]) / 2e6
    span = float(min(centres_s[0], times[0] / 1e6)), float(max(centres_s[-1], times[-1] / 1e6))
    _curve(draw, box, span, centres_s, rates, ON_RGB)
    _curve(draw, box, span, middles_s, changes, OFF_RGB)
    at = box[0] + (times[chosen] / 1e6 - span[0]) / max(span[1] - span[0], 1e-9) * (box[2] - box[0])
    draw.line((at, box[1], at, box[3]), _LINE)
    below = box[3] + 5
    draw.text((box[0], below), f"events a second, up to {rates.max():,.0f}", ON_RGB, font)
    peak = f"{100 * changes.max():.2f}" if len(changes) else "0"
    draw.text((box[0] + 260, below), f"change from frame to frame, up to {peak} % of white", OFF_RGB, font)
    draw.text((box[2] - 170, below), f"{span[0]:.2f} s to {span[1]:.2f} s", _INK, font)
    return sheet


def _event_rate(events: Events, times_us: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Return events a second in equal bins over events and frames, and the bins' middles in seconds."""
    low, high = min(events.t_us[0], times_us[0]), max(events.t_us[-1], times_us[-1]) + 1
    counts, edges = np.histogram(events.t_us, _BINS, (float(low), float(high)))
    return counts / (np.diff(edges) * 1e-6), (edges[1:] + edges[:-1]) / 2e6


def _frame_changes(frames: NDArray, peak: float) -> NDArray[np.float64]:
    """Return the mean absolute change from frame to frame, [N - 1], in parts of white.

    Of blocks of 8 x 8 pixels: noise that is independent from pixel to pixel would hide the rest.
    """
    small = reduce_by_area(frames, (max(1, frames.shape[1] // 8), max(1, frames.shape[2] // 8)))
    return np.abs(np.diff(small, axis=0)).mean(axis=(1, 2), dtype=np.float64) / peak


def _stretched(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    low, high = np.percentile(picture, [1, 99.5])
    return np.clip((picture - low) / max(high - low, 1e-6), 0, 1)


def _events_tint(events: Events) -> tuple[NDArray, NDArray]:
    """Return the colour of each pixel's prevailing sign, [H, W, 3], and its strength, [H, W], 0..1."""
    on, off = event_histogram(events)[0]
    both = on + off
    full = np.percentile(both[both > 0], 95) if both.any() else 1.0
    colour = np.where((on > off)[..., None], ON_RGB, OFF_RGB).astype(float)
    return colour, np.clip(both / full, 0, 1)


def _curve(draw: ImageDraw.ImageDraw, box, span, x: NDArray, y: NDArray, colour) -> None:
    if len(x) < 2 or not y.max() > 0:
        return
    left, top, right, bottom = box
    columns = left + (x - span[0]) / max(span[1] - span[0], 1e-9) * (right - left)
    rows = bottom - 4 - y / y.max() * (bottom - top - 8)
    draw.line([(float(a), float(b)) for a, b in zip(columns, rows, strict=True)], colour, 2)
