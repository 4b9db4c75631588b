"""Images of an event stream, window by window, in memory that does not grow with it; Pillow alone.

- One image per capture, for the eye: do frames and events show the same thing at the same time?
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.errors import ConfigError, DataError
from evnlos.events import event_histogram, frame_blocks
from evnlos.events.recording import Summary
from evnlos.events.volume import OFF_RGB, ON_RGB
from evnlos.types import Events
from evnlos.untrusted import MOST_SENSOR_PIXELS

if TYPE_CHECKING:
    from evnlos.data import Capture

Style = Literal["polarity", "surface"]
"""Events of each window by sign, or the newest event of each pixel, fading."""
Background = Literal["dark", "light"]

# Background, text and events without a polarity, bar.
_GROUNDS = {
    "dark": ((14, 16, 20), (205, 208, 214), (52, 56, 64)),
    "light": ((255, 255, 255), (60, 64, 72), (224, 226, 230)),
}
_FAINTEST = 0.3  # how strongly a single event is drawn where many are usual
_CAPTION_PX = 26
_FILL = 0.05  # of the pixels that an automatic window shows as having sent an event
_MAX_FRAMES = 500


@dataclass(frozen=True)
class PreviewOptions:
    """How a preview looks.

    Args:
        style: "polarity" counts the events of each window by sign, "surface" shows each pixel's newest event,
            fading with the length of a window.
        background: "dark" or "light".
        frames: Number of windows, spread evenly over the recording, 1 to 500.
        window_ms: Length of a window, milliseconds; None = as long as it takes to show something, at most up to
            the next window.
        side_px: About the longest side of an image, pixels: larger sensors are added up, smaller magnified.

    Raises:
        ConfigError: A value outside its range.
    """

    style: Style = "polarity"
    background: Background = "dark"
    frames: int = 40
    window_ms: float | None = None
    side_px: int = 480

    def __post_init__(self) -> None:
        for name, kinds in (("style", get_args(Style)), ("background", get_args(Background))):
            if getattr(self, name) not in kinds:
                raise ConfigError(f"{name} is {getattr(self, name)!r}; give one of {', '.join(kinds)}")
        if not 1 <= self.frames <= _MAX_FRAMES:
            raise ConfigError(f"frames is {self.frames}; give 1 to {_MAX_FRAMES}")
        if self.window_ms is not None and not 1e-3 <= self.window_ms < np.inf:
            raise ConfigError(f"window_ms is {self.window_ms}; give at least 0.001 ms")
        if not 64 <= self.side_px <= 2048:
            raise ConfigError(f"side_px is {self.side_px}; give 64 to 2048 pixels")


def preview_images(
    pieces: Iterable[Events], summary: Summary, look: PreviewOptions | None = None
) -> list[NDArray[np.uint8]]:
    """Return images [H, W, 3] of a recording with a line of text below: time, events, length of the window.

    Args:
        pieces: The events in the order of time, as `iter_events` yields them.
        summary: What they hold (`summarise`).
        look: How it looks; None = the defaults.

    Example:
        >>> from evnlos.events.recording import summarise
        >>> events = Events([0, 900], [0, 3], [1, 1], [1, 0], width=4, height=2)
        >>> images = preview_images([events], summarise([events]), PreviewOptions(frames=2))
        >>> len(images), images[0].shape, images[0][-30, 0].tolist()
        (2, (266, 480, 3), [226, 120, 0])
    """
    look = look or PreviewOptions()
    if summary.width * summary.height > MOST_SENSOR_PIXELS:
        raise DataError(
            f"a sensor of {summary.width} x {summary.height} pixels is too large to draw; give --width and "
            "--height if the file is wrong, or cut a part out with --box"
        )
    windows = _windows(summary, look)
    factor = max(1, round(max(summary.width, summary.height) / look.side_px))
    shape = -(-summary.height // factor), -(-summary.width // factor)
    draw = _polarity_maps if look.style == "polarity" else _surface_maps
    shown = list(draw(pieces, windows, shape, factor))
    strength = np.arange(256) / 255.0  # of what a map holds
    if look.style == "polarity":  # few events at a place stay visible beside many
        part = np.log1p(np.arange(256)) / np.log1p(_full_scale(maps for maps, _ in shown))
        strength = np.where(part > 0, _FAINTEST + (1 - _FAINTEST) * np.minimum(part, 1.0), 0.0)
    zoom = max(1, look.side_px // max(shape))
    pictures = []
    for (maps, count), (_, start, stop) in zip(shown, windows, strict=True):
        pixels = np.kron(_coloured(strength[maps], look.background), np.ones((zoom, zoom, 1), np.uint8))
        text = f"{(stop - summary.first_us) / 1e6:.{_decimals(summary)}f} s"
        detail = f"{count:,} events in {(stop - start) / 1e3:.3g} ms"
        done = (stop - summary.first_us) / max(summary.duration_us, 1)
        pictures.append(
            np.concatenate([pixels, _caption(pixels.shape[1], text, detail, done, look.background)])
        )
    return pictures


def _windows(summary: Summary, look: PreviewOptions) -> list[tuple[int, int, int]]:
    """Return (end of the window before, begin, end) of each window, microseconds; begin < t <= end."""
    span = max(summary.duration_us, look.frames)
    ends = summary.first_us + np.linspace(0, span, look.frames + 1).round().astype(np.int64)
    if look.window_ms is not None:
        length = round(1e3 * look.window_ms)
    else:
        step = span / look.frames
        wanted = _FILL * summary.width * summary.height / max(summary.rate_hz, 1e-9) * 1e6
        length = round(max(min(step, max(wanted, 1000.0)), 1.0))
    starts = ends[1:] - max(length, 1)
    starts = np.where(starts <= summary.first_us, summary.first_us - 1, starts)  # the first event is inside
    befores = np.concatenate([[summary.first_us - 1], ends[1:-1]])
    return [(int(b), int(s), int(e)) for b, s, e in zip(befores, starts, ends[1:], strict=True)]


def _slices(pieces: Iterable[Events], ends: list[int]) -> Iterator[tuple[int, Events]]:
    """Yield (number of a window, events up to its end that are later than the end before)."""
    number = 0
    for events in pieces:
        done = 0
        while number < len(ends):
            stop = int(np.searchsorted(events.t_us, ends[number], "right"))
            if stop > done:
                yield number, events[done:stop]
            done = stop
            if stop == len(events):
                break
            number += 1


def _places(events: Events, factor: int, width: int) -> NDArray[np.int64]:
    return (events.y // factor).astype(np.int64) * width + events.x // factor


Shown = tuple[NDArray[np.uint8], int]
"""A map for each sign [3, H, W] (ON, OFF, unknown), and the number of events."""


def _signs(events: Events) -> NDArray[np.uint8]:
    """Return 0 for ON, 1 for OFF, 2 where the camera gave no polarity."""
    signs = (~events.p).astype(np.uint8)
    if events.polarity_known is not None:
        signs[~events.polarity_known] = 2
    return signs


def _polarity_maps(
    pieces: Iterable[Events], windows: list[tuple[int, int, int]], shape: tuple[int, int], factor: int
) -> Iterator[Shown]:
    """Yield the number of events of each sign at each place, up to 255, for each window."""
    # Windows longer than their distance overlap: an event then counts in every window that holds it.
    held: list[Events] = []
    for number, events in _with_gaps(_slices(pieces, [end for _, _, end in windows]), len(windows)):
        _, start, end = windows[number]
        held = [one for one in (*held, *events) if len(one) and int(one.t_us[-1]) > start]
        area = shape[0] * shape[1]
        counts = np.zeros(3 * area, np.int64)
        for one in held:
            inside = one.between(start, end)
            counts += np.bincount(
                _places(inside, factor, shape[1]) + _signs(inside).astype(np.int64) * area, minlength=3 * area
            )
        yield np.minimum(counts, 255).astype(np.uint8).reshape(3, *shape), int(counts.sum())


def _surface_maps(
    pieces: Iterable[Events], windows: list[tuple[int, int, int]], shape: tuple[int, int], factor: int
) -> Iterator[Shown]:
    """Yield 255 exp(-age / length of the window) of the newest event at each place, on the map of its sign."""
    newest = np.full(shape[0] * shape[1], -np.inf)
    signs = np.zeros(shape[0] * shape[1], np.uint8)
    for number, slices in _with_gaps(_slices(pieces, [end for _, _, end in windows]), len(windows)):
        _, start, end = windows[number]
        total = 0
        for events in slices:
            where = _places(events, factor, shape[1])
            newest[where], signs[where] = (
                events.t_us,
                _signs(events),
            )  # of several at a place the last one stays
            total += len(events.between(start, end))
        fresh = np.floor(255 * np.exp((newest - end) / (end - start)))
        maps = np.where(signs == np.arange(3)[:, None], fresh, 0)
        yield maps.astype(np.uint8).reshape(3, *shape), total


def _with_gaps(slices: Iterator[tuple[int, Events]], count: int) -> Iterator[tuple[int, list[Events]]]:
    """Yield every window's number with its events, those without events too."""
    here = next(slices, None)
    for number in range(count):
        found = []
        while here is not None and here[0] == number:
            found.append(here[1])
            here = next(slices, None)
        yield number, found


def _full_scale(maps: Iterable[NDArray[np.uint8]]) -> float:
    """Return the number of events that is drawn in full colour, the same for all windows: no flicker."""
    tally = np.zeros(256, np.int64)
    for one in maps:
        tally += np.bincount(one.ravel(), minlength=256)
    tally[0] = 0
    if not tally.any():
        return 1.0
    return max(float(np.searchsorted(np.cumsum(tally), 0.95 * tally.sum())), 1.0)


def _coloured(strength: NDArray[np.float64], background: Background) -> NDArray[np.uint8]:
    """Return strengths from 0 to 1 [3, H, W] as an image [H, W, 3]."""
    ground, ink, _ = _GROUNDS[background]
    share = strength / np.maximum(strength.sum(axis=0), 1e-9)
    colour = np.tensordot(share, np.array([ON_RGB, OFF_RGB, ink], np.float64), axes=(0, 0))  # [H, W, 3]
    opacity = strength.max(axis=0)[..., None]
    return np.round(ground + opacity * (colour - np.array(ground))).astype(np.uint8)


def _decimals(summary: Summary) -> int:
    return 3 if summary.duration_us >= 200_000 else 4 if summary.duration_us >= 20_000 else 6


def _caption(width: int, time: str, detail: str, done: float, background: Background) -> NDArray[np.uint8]:
    """Return a line of text on the recording's position: its time, what is shown, which colour is which."""
    ground, ink, bar = _GROUNDS[background]
    image = Image.new("RGB", (width, _CAPTION_PX), ground)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, width - 1, 1), fill=bar)
    draw.rectangle((0, 0, round(done * (width - 1)), 1), fill=ink)
    font = ImageFont.load_default(13)
    measure: Callable[[str], float] = lambda text: draw.textlength(text, font=font)  # noqa: E731
    draw.text((6, 6), time, fill=ink, font=font)
    right = width - 6.0
    for text, colour in (("OFF", OFF_RGB), ("ON", ON_RGB)):
        right -= measure(text)
        draw.text((right, 6), text, fill=colour, font=font)
        right -= 10
    left = 18 + measure(time)
    if left + measure(detail) < right:
        draw.text((left, 6), detail, fill=ink, font=font)
    return np.asarray(image)


_PANEL_PX, _GAP_PX, _LINE_PX, _PLOT_PX = 320, 12, 24, 150
_INK, _PAPER, _LINE = (40, 42, 48), (255, 255, 255), (210, 212, 216)
_BINS = 200


def check_image(capture: Capture) -> Image.Image:
    """Return the frame at the busiest moment, the events of its interval, both overlaid, and curves over time.

    The curves are the events per second and the mean change of the frames, each on its own scale: peaks of the
    one should stand above peaks of the other.

    Args:
        capture: A capture that was read.
    """
    times = capture.frame_times_us
    rates, centres_s = _event_rate(capture.events, times)
    changes = _frame_changes(capture.frames if capture.has_frames else capture.frames[:, :8, :8], capture.peak)
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
    plot_top = 2 * _LINE_PX + high + 2 * _GAP_PX
    sheet = Image.new("RGB", (width, plot_top + _PLOT_PX + 2 * _LINE_PX), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    draw.text((_GAP_PX, 5), f"{capture.name}: {capture.info.camera.name}", _INK, font)
    how = Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX
    for k, (caption, picture) in enumerate(pictures):
        left = _GAP_PX + k * (_PANEL_PX + _GAP_PX)
        panel = Image.fromarray(np.round(picture).astype(np.uint8)).resize((_PANEL_PX, high), how)
        sheet.paste(panel, (left, 2 * _LINE_PX))
        draw.text((left, _LINE_PX + 4), caption, _INK, font)
    box = (_GAP_PX, plot_top, width - _GAP_PX, plot_top + _PLOT_PX)
    draw.rectangle(box, outline=_LINE)
    middles_s = (times[1:] + times[:-1]) / 2e6
    span = float(min(centres_s[0], times[0] / 1e6)), float(max(centres_s[-1], times[-1] / 1e6))
    _curve(draw, box, span, centres_s, rates, ON_RGB)
    _curve(draw, box, span, middles_s, changes, OFF_RGB)
    at = box[0] + (times[chosen] / 1e6 - span[0]) / max(span[1] - span[0], 1e-9) * (box[2] - box[0])
    draw.line((at, box[1], at, box[3]), _LINE)
    below = box[3] + 5
    draw.text((box[0], below), f"events per second, up to {rates.max():,.0f}", ON_RGB, font)
    peak = f"{100 * changes.max():.2f}" if len(changes) else "0"
    draw.text((box[0] + 260, below), f"change from frame to frame, up to {peak} % of white", OFF_RGB, font)
    draw.text((box[2] - 170, below), f"{span[0]:.2f} s to {span[1]:.2f} s", _INK, font)
    return sheet


def _event_rate(events: Events, times_us: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Return events per second in equal bins over events and frames, and the bins' middles in seconds."""
    ends = np.concatenate([events.t_us[:1], events.t_us[-1:], times_us[[0, -1]]])
    low, high = ends.min(), ends.max() + 1
    counts, edges = np.histogram(events.t_us, _BINS, (float(low), float(high)))
    return counts / (np.diff(edges) * 1e-6), (edges[1:] + edges[:-1]) / 2e6


def _frame_changes(frames: NDArray, peak: float) -> NDArray[np.float64]:
    """Return the mean absolute change from frame to frame, [N - 1], in parts of white.

    Of blocks of 8 x 8 pixels: noise that is independent from pixel to pixel would hide the rest.
    """
    from evnlos.data.sampling import reduce_by_area  # which a preview of events needs nothing of

    shape = max(1, frames.shape[1] // 8), max(1, frames.shape[2] // 8)
    small = np.concatenate([reduce_by_area(block, shape) for block in frame_blocks(frames)])
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
