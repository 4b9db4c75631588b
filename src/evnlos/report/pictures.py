"""Arrays as images and curves, and the reconstructions of a capture as files.

- Curves as inline SVG: small, printable, with no requests.
- Arrays as images: grey and signed maps, film strips, animations; Pillow alone.
- The reconstructions of one capture as files: an image per position, a film strip, an animation.
"""

from __future__ import annotations

import base64
import html
import io
import json
import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from evnlos.analysis import load_model, score
from evnlos.analysis.confidence import confidence_values
from evnlos.analysis.identify import Verdict, verdict_on
from evnlos.analysis.model import setup_for_track
from evnlos.data import FixedPattern, read_capture
from evnlos.data.sampling import Samples, Sampling
from evnlos.events.volume import OFF_RGB, ON_RGB, WORDS
from evnlos.files import check_folder, new_folder, write_atomically
from evnlos.machine import Progress, Step, silent
from evnlos.models import ConfidenceReport, published_for
from evnlos.setups import Setup

_COLOURS = ("#0b5fa5", "#b23a12", "#2f7d32", "#7a3fa0", "#8a6d00", "#00788a", "#a02c5d", "#5b6470", "#3d4fc4")
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 980, 300, 60, 16, 40
_PEN, _LETTER = 44, 7.0  # room for a line of the legend, and for each letter of its name


def curves_svg(series: dict[str, list[tuple[float, float]]], x_label: str, y_label: str) -> str:
    """Return named curves of (x, y) points as one SVG drawing with axes and legend; empty ones are left out."""
    series = {name: points for name, points in series.items() if points}
    if not series:
        return ""
    xs = [x for points in series.values() for x, _ in points]
    ys = [y for points in series.values() for _, y in points]
    x0, x1 = min(xs), max(max(xs), min(xs) + 1)
    low, high = min(ys), max(ys)
    if high - low <= 1e-6 * max(abs(low), abs(high), 1.0):  # a run of one epoch
        low, high = low - 0.5, high + 0.5
    ticks = _ticks(low, high)
    y0, y1 = min(ticks[0], low), max(ticks[-1], high)
    wide, high = _WIDTH - _LEFT - _PEN - _LETTER * max(map(len, series)), _HEIGHT - _TOP - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        return _LEFT + (x - x0) / (x1 - x0) * wide, _TOP + (y1 - y) / (y1 - y0) * high

    parts = [
        f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' role=img aria-label='{html.escape(y_label)}' font-size=12>"
    ]
    for tick in ticks:
        y = place(x0, tick)[1]
        parts.append(f"<path d='M{_LEFT} {y:.1f}H{_LEFT + wide:.1f}' stroke='currentColor' opacity='.15'/>")
        parts.append(f"<text x={_LEFT - 6} y={y + 4:.1f} text-anchor=end fill=currentColor>{tick:g}</text>")
    for tick in _ticks(x0, x1):
        if x0 <= tick <= x1:
            x = place(tick, y0)[0]
            parts.append(
                f"<text x={x:.1f} y={_TOP + high + 16} text-anchor=middle fill=currentColor>{tick:g}</text>"
            )
    below = f"x={_LEFT + wide:.1f} y={_HEIGHT - 6} text-anchor=end"
    parts.append(f"<text {below} fill=currentColor>{html.escape(x_label)}</text>")
    parts.append(f"<text x={_LEFT} y=11 fill=currentColor>{html.escape(y_label)}</text>")
    for i, (name, points) in enumerate(series.items()):
        colour, dash = _COLOURS[i % len(_COLOURS)], ("", "6 3", "2 3")[i // 3 % 3]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*p) for p in points))
        pen = f"stroke='{colour}' stroke-width=1.8 stroke-dasharray='{dash}'"
        parts.append(f"<polyline points='{path}' fill=none {pen}/>")
        y = _TOP + 14 + 17 * i
        parts.append(f"<path d='M{_LEFT + wide + 12:.1f} {y - 4}h22' {pen}/>")
        parts.append(f"<text x={_LEFT + wide + 40:.1f} y={y} fill=currentColor>{html.escape(name)}</text>")
    return "".join(parts) + "</svg>"


def _ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers that span the range."""
    span = max(high - low, 1e-9)
    step = 10 ** math.floor(math.log10(span / 4))
    step *= next(f for f in (1, 2, 5, 10) if span / (step * f) <= 5)
    return [round(k * step, 10) for k in range(math.floor(low / step), math.ceil(high / step) + 1)]


def grey(image: ArrayLike, low: float = 0.0, high: float = 1.0) -> NDArray[np.uint8]:
    """Return an image [H, W] as 8-bit grey, `low` black and `high` white."""
    scaled = (np.asarray(image, dtype=np.float64) - low) / max(high - low, 1e-12)
    return np.round(255 * np.clip(scaled, 0, 1)).astype(np.uint8)


def stretched(image: ArrayLike) -> NDArray[np.uint8]:
    """Return an image [H, W] as 8-bit grey between its own 0.5 and 99.5 percentiles."""
    low, high = np.percentile(np.asarray(image, dtype=np.float64), [0.5, 99.5])
    return grey(image, low, high)


def polarity(surface: ArrayLike) -> NDArray[np.uint8]:
    """Return ON and OFF, the first of maps [2 or 4, H, W], as 8-bit RGB [H, W, 3]: orange, blue, on white."""
    maps = np.asarray(surface, dtype=np.float64)[:2]
    on, off = np.clip(maps / max(float(maps.max()), 1e-12), 0, 1)
    picture = 255 - on[..., None] * (255 - np.array(ON_RGB)) - off[..., None] * (255 - np.array(OFF_RGB))
    return np.clip(picture, 0, 255).astype(np.uint8)


def strip(pictures: Sequence[NDArray[np.uint8]], columns: int = 8) -> NDArray[np.uint8]:
    """Return images [H, W] or [H, W, 3] of one size side by side, `columns` a row, as one image."""
    rgb = [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=-1) for p in pictures]
    height, width = rgb[0].shape[:2]
    columns, gap = min(columns, len(rgb)), 2
    rows = -(-len(rgb) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 128, np.uint8)
    for i, picture in enumerate(rgb):
        y, x = (i // columns) * (height + gap), (i % columns) * (width + gap)
        sheet[y : y + height, x : x + width] = picture
    return sheet


def png(picture: NDArray[np.uint8], zoom: int = 1) -> bytes:
    """Return an image as PNG bytes, each pixel `zoom` pixels wide."""
    return _encoded([picture], "PNG", zoom)


def save_png(path: str | Path, picture: NDArray[np.uint8], zoom: int = 1) -> None:
    """Write an image as a PNG file, atomically."""
    write_atomically(path, png(picture, zoom))


def save_animation(
    path: str | Path, pictures: Sequence[NDArray[np.uint8]], rate_hz: float, zoom: int = 1
) -> None:
    """Write images as an animation that repeats, at most 50 images per second, atomically.

    A file that ends in .webp is a WebP, a few times smaller and not exact; any other a GIF.
    """
    write_atomically(path, animation(pictures, rate_hz, zoom, webp=Path(path).suffix.lower() == ".webp"))


def animation(
    pictures: Sequence[NDArray[np.uint8]], rate_hz: float, zoom: int = 1, webp: bool = False
) -> bytes:
    """Return images as the bytes of an animated GIF or WebP that repeats."""
    pause_ms = max(round(1000 / rate_hz), 20)
    if webp:
        return _encoded(pictures, "WEBP", zoom, duration=pause_ms, loop=0, quality=70, method=4)
    return _encoded(pictures, "GIF", zoom, duration=pause_ms, loop=0)


def data_uri(content: bytes, kind: str = "image/png") -> str:
    """Return bytes as a data URI for a page without requests."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _encoded(pictures: Sequence[NDArray[np.uint8]], kind: str, zoom: int, **options: int) -> bytes:
    images = [Image.fromarray(np.ascontiguousarray(p)) for p in pictures]
    if zoom > 1:
        images = [one.resize((zoom * one.width, zoom * one.height), Image.Resampling.NEAREST) for one in images]
    buffer = io.BytesIO()
    if len(images) > 1:
        options["save_all"] = True
        images[0].save(buffer, kind, append_images=images[1:], **options)
    else:
        images[0].save(buffer, kind, **options)
    return buffer.getvalue()


def reconstruct_capture(
    capture: str | Path,
    weights: str | Path | None,
    out: str | Path,
    zoom: int = 4,
    pattern: FixedPattern | None = None,
    setup: Setup | None = None,
    track: bool = False,
    so_far: bool = False,
    progress: Progress = silent,
    target_m: float | None = None,
) -> dict[str, Any]:
    """Reconstruct all positions of a capture and write them as images.

    Writes `position_00.png` and on, `strip.png`, `animation.gif` (frame, surface, image, truth if known) and
    `reconstruction.npy` (float32 [N, H, W], 0..1). Where the weights hold a confidence and the motion is known,
    also `interval.npy` (ends of the intervals, float32 [2, N, H, W]) and `unsure.png` (their lengths). Where
    all positions show one image, that in the middle stands for them. `result.png` shows all, in words, too.

    Args:
        capture: A capture folder; its target may be unknown.
        weights: A weights file, a run's folder or a name of `published`; None: the published weights for frames
            (for events where there are no frames) of the setup whose distance is nearest, of whole sequences
            where the motion is known or found.
        out: The folder for the images, new or empty; it is there with all of them, or not at all.
        zoom: Size of a pixel in the images.
        pattern: Fixed pattern of the frame camera, to be taken from the frames.
        setup: The calibrated setup; the images are then moved to where the wall agrees with the frames, if
            these are as bright as it makes them. Without one, the setup of the weights explains them, if known.
        track: Find the motion in the recording with the setup, also where it is stated; the truth, where it is
            known, stays where the capture states it.
        so_far: Whether each image is made of what was seen up to its position alone.
        progress: Called at each of three stages, and at the end.
        target_m: Side of the targets that the setup's file states, metres (`stated_target_m`).

    Returns:
        Capture, weights, modality, number of positions, and whether all of them show one image, which was
        made from the whole recording and is drawn where the motion was stated or found; where the truth is
        known, the mean scores; where it can be told, the confidence: support, threshold, measured, verdict and,
        where a setup is known, explained; else no_confidence, which says why. Where the frames were brought to
        the light that the weights know, brought_from. With a setup also `light`, the capture's brightness in
        that of the setup, and whether the images were moved; with `track` the warnings of the track.

    Raises:
        ConfigError: `track` without a setup.
        DataError: The capture or weights can't be used, the target can't be tracked, or `out` is not empty.
    """
    if track:
        setup_for_track(setup)  # before anything is read
    what = f"reconstruct {Path(capture).name}"
    progress(Step(what, 0, 3, "stages", within="read the capture"))
    recording = read_capture(capture, needs_frames=False, needs_events=False)
    if weights is None:
        distance_m = recording.distance_m or (None if setup is None else setup.default_distance_m)
        kind = "frame" if recording.has_frames else "event"
        weights = published_for(distance_m, kind, is_motion_known=track or recording.motion is not None)
    model = load_model(weights)
    sampling = model.weights.sampling
    check_folder(out := Path(out))
    progress(Step(what, 1, 3, "stages", within="reconstruct, compare with the wall"))
    made = model.reconstruct(recording, setup, pattern, track, so_far)
    images, samples, confidence = made.images, made.samples, made.confidence
    pictures, once = [grey(image) for image in images], model.weights.network.sees_sequence and not so_far
    own = slice(len(pictures) // 2, len(pictures) // 2 + 1) if once else slice(None)  # no copies of others
    progress(Step(what, 2, 3, "stages", within="draw, ask what the wall allows"))
    with new_folder(out) as draft:
        for k in range(len(pictures))[own]:
            save_png(draft / f"position_{k:02d}.png", pictures[k], zoom)
        save_png(draft / "strip.png", strip(pictures[own]), 2)
        shown = []
        for k, picture in enumerate(pictures):
            seen = [stretched(samples.frame[k]), polarity(samples.surface[k]), picture]
            shown.append(strip(seen + ([] if samples.truth is None else [grey(samples.truth[k])]), columns=4))
        rate_hz = 1e6 / float(np.median(np.diff(recording.frame_times_us)))
        save_animation(draft / "animation.gif", shown, rate_hz, 2)
        write_atomically(draft / "reconstruction.npy", _npy(images.numpy()))
        found: dict[str, Any] = {
            "capture": recording.name,
            "weights": str(weights),
            "modality": model.weights.modality.name,
            "positions": len(pictures),
            "one_picture": once,
        }
        if made.light is not None:
            found |= {"light": round(made.light, 4), "moved_by_the_setup": made.is_moved}
        if made.brought_from is not None:
            found["brought_from"] = made.brought_from
        if confidence is not None:
            width = strip([grey(one) for one in (confidence.high - confidence.low)[own]])
            save_png(draft / "unsure.png", width, 2)
            ends = torch.stack([confidence.low, confidence.high]).numpy()
            write_atomically(draft / "interval.npy", _npy(ends))
            found["confidence"] = confidence_values(confidence)
        else:
            found["no_confidence"] = made.no_confidence
        found |= {"warnings": made.warnings} if track else {}
        if samples.truth is not None:
            truth = torch.from_numpy(samples.truth)[:, sampling.scored].contiguous()
            found["scores"] = score(images[:, sampling.scored].contiguous(), truth).mean()
        of = (len(images) if model.weights.network.sees_sequence else 1), setup is not None
        wall, stated_m = model.known() if setup is None else (setup, target_m)
        verdict = verdict_on(wall, confidence, made.no_confidence, *of, stated_m)
        found |= {"verdict": asdict(verdict), "in_words": _in_words(found, verdict, track)}
        title = f"{recording.name}, reconstructed by {found['weights']}"
        sheet = result_sheet(title, images.numpy(), samples, sampling, confidence, found["in_words"])
        save_png(draft / "result.png", sheet)
        write_atomically(draft / "summary.json", (json.dumps(found, indent=2) + "\n").encode())
    progress(Step(what, 3, 3, "stages"))
    return found


def _in_words(found: dict[str, Any], verdict: Verdict, tracked: bool) -> list[str]:
    """Return in sentences what the images of `reconstruct_capture` are and what of them to believe."""
    lines = []
    if found["one_picture"]:
        lines.append(
            f"all positions show one image, made from the whole recording and drawn where the motion was "
            f"{'found' if tracked else 'stated'}"
        )
    if not found.get("moved_by_the_setup", True):
        lines.append(
            f"the light is {found['light']:.2f} x that of the setup: its gain is not this capture's, the "
            "images stay as the network draws them; calibrate at this exposure, on known targets"
        )
    if "brought_from" in found:
        lines.append(f"frames of {found['brought_from']:.2g} x the light that the weights know, brought to it")
    return [*lines, *verdict.lines]


_PANEL, _MARGIN, _TEXT_PX, _LINE_PX = 300, 16, 14, 19  # pixels
_INK, _FAINT, _PAPER, _PATH = (20, 24, 28), (120, 126, 132), (255, 255, 255), (11, 95, 165)
_BAR_M = 0.02


def result_sheet(
    title: str,
    images: NDArray[np.float32],
    samples: Samples,
    sampling: Sampling,
    confidence: ConfidenceReport | None,
    lines: Sequence[str],
) -> NDArray[np.uint8]:
    """Return one labelled image, uint8 [H', W', 3], of a reconstruction at the position in the middle.

    Args:
        title: First line.
        images: Reconstructions, float32 [N, H, W], 0..1.
        samples: What was seen at the positions, and the truth and the path where they are known.
        sampling: Size and pitch of the maps.
        confidence: Ends of each pixel's interval; None where they can't be told.
        lines: What it means, in sentences.
    """
    k = len(images) // 2
    panels: list[tuple[str, NDArray[np.uint8]]] = []
    at = f"position {k + 1} of {len(images)}"
    if samples.frame.any():
        panels.append((f"wall, {at} (contrast stretched)", stretched(samples.frame[k])))
    if samples.surface.any():
        panels.append((f"its events ({WORDS})", polarity(samples.surface[k])))
    seen = len(panels)
    panels.append((f"reconstruction, {at}", grey(images[k])))
    if confidence is not None:
        ends = ("lower", confidence.low[k]), ("upper", confidence.high[k])
        panels += [(f"90 % interval: {name} end", grey(end)) for name, end in ends]
    if samples.truth is not None:
        panels.append(("truth", grey(samples.truth[k])))
    height, width, columns = round(_PANEL * sampling.height / sampling.width), _PANEL, 3
    rows = -(-(len(panels) + 1) // columns)
    wide = _MARGIN + columns * (width + _MARGIN)
    wrapped = [part for line in lines for part in textwrap.wrap(f"{line[:1].upper()}{line[1:]}.", wide // 7)]
    row_height = height + _LINE_PX + _MARGIN
    top = _MARGIN + _LINE_PX + 8
    sheet = Image.new("RGB", (wide, top + rows * row_height + _LINE_PX * len(wrapped) + _MARGIN), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT_PX)
    draw.text((_MARGIN, _MARGIN), title, _INK, font)
    for i in range(len(panels) + 1):
        left, above = _MARGIN + i % columns * (width + _MARGIN), top + i // columns * row_height
        box = (left, above + _LINE_PX, left + width - 1, above + _LINE_PX + height - 1)
        if i == len(panels):
            _draw_path(draw, font, box, samples.position_m)
            continue
        name, picture = panels[i]
        draw.text((left, above), name, _INK, font)
        image = Image.fromarray(np.ascontiguousarray(picture)).convert("RGB")
        sheet.paste(image.resize((width, height), Image.Resampling.NEAREST), box[:2])
        if i >= seen:  # on the target's plane
            start, stop = box[2] - 10 - round(_BAR_M / sampling.pitch_m * width / sampling.width), box[2] - 10
            draw.rectangle((start, box[3] - 12, stop, box[3] - 9), _PAPER, _INK)
            text = f"{1e2 * _BAR_M:g} cm"
            draw.text((start, box[3] - 30), text, _PAPER, font, stroke_width=1, stroke_fill=_INK)
    for i, line in enumerate(wrapped):
        draw.text((_MARGIN, top + rows * row_height + i * _LINE_PX), line, _INK, font)
    return np.asarray(sheet)


def _draw_path(
    draw: ImageDraw.ImageDraw,
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
    box: tuple[int, int, int, int],
    position_m: NDArray[np.float64] | None,
) -> None:
    """Draw the path of the target's centre over its plane, y upwards, from a ring to a dot."""
    left, above, right, below = box
    if position_m is None:
        draw.text((left, above - _LINE_PX), "path: unknown", _FAINT, font)
        return
    ends = " to ".join(f"({100 * x:.1f}, {100 * y:.1f})" for x, y in (position_m[0], position_m[-1]))
    draw.text((left, above - _LINE_PX), f"path: {ends} cm", _INK, font)
    draw.rectangle(box, None, _FAINT)
    middle = (position_m.min(axis=0) + position_m.max(axis=0)) / 2
    extent = max(float(np.ptp(position_m, axis=0).max()), 1e-6)
    scale = 0.7 * min(right - left, below - above) / extent
    across = (left + right) / 2 + scale * (position_m[:, 0] - middle[0])
    down = (above + below) / 2 - scale * (position_m[:, 1] - middle[1])
    points = list(zip(across.tolist(), down.tolist(), strict=True))
    draw.line(points, _PATH, 2)
    for (x, y), fill in ((points[0], _PAPER), (points[-1], _PATH)):
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill, _PATH, 2)


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
