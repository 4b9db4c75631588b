"""Numbers of a picture as light: the tone curve undone, colours weighed."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Picture = NDArray
"""Grey [H, W] or colour [H, W, 3]: uint8, uint16 or floating point."""
Tone = Literal["as-is", "srgb", "rec709"]
"""What the numbers of a picture mean: light as they are, or codes of a tone curve to undo."""

_LUMA_601 = 299, 587, 114  # thousandths: of a grey pixel the sum is exactly its value
_LUMINANCE_709 = 0.2126, 0.7152, 0.0722


def to_light(picture: Picture, tone: Tone = "as-is", white: float = 255.0) -> NDArray[np.float32]:
    """Return a picture as light in DN: 255 = white.

    With the value v = picture / white, "as-is" gives 255 v; "srgb" gives 255 times v / 12.92 up to 0.04045 and
    ((v + 0.055) / 1.055)^2.4 above (IEC 61966-2-1); "rec709" v / 4.5 up to 0.081 and
    ((v + 0.099) / 1.099)^(1 / 0.45) above (ITU-R BT.709).

    Args:
        picture: Grey [H, W] or colour [H, W, 3]; uint8, uint16 or floating point.
        tone: Curve to undo.
        white: Value of white.

    Example:
        >>> to_light(np.array([[0, 188, 255]], np.uint8), "srgb").round(1)
        array([[  0. , 128.2, 255. ]], dtype=float32)
    """
    if tone == "as-is":
        if picture.ndim == 3:
            weights = np.array(_LUMA_601, np.int32 if picture.dtype.kind == "u" else np.float64)
            picture = (picture @ weights) / 1000.0  # [H, W]
        return (picture * (255.0 / white)).astype(np.float32)
    if picture.dtype.kind == "u":
        codes = np.arange(np.iinfo(picture.dtype).max + 1) / white
        linear = _decoded(codes, tone).astype(np.float32)[picture]
    else:
        linear = _decoded(picture / white, tone).astype(np.float32)
    if linear.ndim == 3:
        linear = linear @ np.array(_LUMINANCE_709, np.float32)
    return 255.0 * linear


def _decoded(codes: NDArray, tone: Tone) -> NDArray:
    """Return light in fractions of white of codes in fractions of white."""
    low, slope, offset, power = (
        (0.04045, 12.92, 0.055, 2.4) if tone == "srgb" else (0.081, 4.5, 0.099, 1 / 0.45)
    )
    return np.where(
        codes <= low, codes / slope, (np.maximum(codes, low) + offset) ** power / (1 + offset) ** power
    )
