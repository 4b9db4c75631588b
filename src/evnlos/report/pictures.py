"""Arrays as pictures: grey and signed maps, film strips, animations; Pillow alone."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from evnlos.events.colours import OFF_RGB, ON_RGB
from evnlos.files import write_atomically


def grey(image: ArrayLike, low: float = 0.0, high: float = 1.0) -> NDArray[np.uint8]:
    """Return an image [H, W] as 8-bit grey, `low` black and `high` white."""
    scaled = (np.asarray(image, dtype=np.float64) - low) / max(high - low, 1e-12)
    return np.round(255 * np.clip(scaled, 0, 1)).astype(np.uint8)


def stretched(image: ArrayLike) -> NDArray[np.uint8]:
    """Return an image [H, W] as 8-bit grey between its own 0.5 and 99.5 percentiles."""
    low, high = np.percentile(np.asarray(image, dtype=np.float64), [0.5, 99.5])
    return grey(image, low, high)


def polarity(surface: ArrayLike) -> NDArray[np.uint8]:
    """Return a surface [2, H, W] (ON, OFF) as 8-bit RGB [H, W, 3]: ON orange, OFF blue, nothing white."""
    maps = np.asarray(surface, dtype=np.float64)
    on, off = np.clip(maps / max(float(maps.max()), 1e-12), 0, 1)
    picture = 255 - on[..., None] * (255 - np.array(ON_RGB)) - off[..., None] * (255 - np.array(OFF_RGB))
    return np.clip(picture, 0, 255).astype(np.uint8)


def strip(pictures: Sequence[NDArray[np.uint8]], columns: int = 8, gap: int = 2) -> NDArray[np.uint8]:
    """Return pictures [H, W] or [H, W, 3] of one size side by side, `columns` a row, as one picture."""
    rgb = [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=-1) for p in pictures]
    height, width = rgb[0].shape[:2]
    columns = min(columns, len(rgb))
    rows = -(-len(rgb) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 128, np.uint8)
    for i, picture in enumerate(rgb):
        y, x = (i // columns) * (height + gap), (i % columns) * (width + gap)
        sheet[y : y + height, x : x + width] = picture
    return sheet


def png(picture: NDArray[np.uint8], zoom: int = 1) -> bytes:
    """Return a picture as PNG bytes, each pixel `zoom` pixels wide."""
    return _encoded([picture], "PNG", zoom)


def save_png(path: str | Path, picture: NDArray[np.uint8], zoom: int = 1) -> None:
    """Write a picture as a PNG file, atomically."""
    write_atomically(path, png(picture, zoom))


def save_animation(
    path: str | Path, pictures: Sequence[NDArray[np.uint8]], rate_hz: float, zoom: int = 1
) -> None:
    """Write pictures as an animation that repeats, at most 50 pictures a second, atomically.

    A file that ends in .webp is a WebP, a few times smaller and not exact; any other a GIF.
    """
    write_atomically(path, animation(pictures, rate_hz, zoom, webp=Path(path).suffix.lower() == ".webp"))


def animation(
    pictures: Sequence[NDArray[np.uint8]], rate_hz: float, zoom: int = 1, webp: bool = False
) -> bytes:
    """Return pictures as the bytes of an animated GIF or WebP that repeats."""
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
        images = [
            image.resize((image.width * zoom, image.height * zoom), Image.Resampling.NEAREST)
            for image in images
        ]
    buffer = io.BytesIO()
    if len(images) > 1:
        options["save_all"] = True
        images[0].save(buffer, kind, append_images=images[1:], **options)
    else:
        images[0].save(buffer, kind, **options)
    return buffer.getvalue()
