"""The check picture of a calibration: held-out captures beside the fit."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from evnlos.calibration import RigFit
from evnlos.files import write_atomically
from evnlos.plot.figure import new_figure, signed_map
from evnlos.untrusted import open_image


def draw_calibration(fit: RigFit, path: str | Path) -> None:
    """Draw frame, model and residual of held-out captures, and the time surfaces where events were fitted.

    Args:
        fit: The calibration.
        path: PNG file to write.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    with_events = any(example.surface is not None for example in fit.example)
    signed = signed_map()
    columns, rows = (6 if with_events else 3), len(fit.example)
    figure = new_figure((2.6 * columns, 1.85 * rows + 0.4))
    axes = figure.subplots(rows, columns, squeeze=False)
    for line, example in zip(axes, fit.example, strict=True):
        top = max(float(example.frame.max()), float(example.model.max()))
        miss = example.frame - example.model
        pictures = [(example.frame, "frame", "gray", 0.0, top), (example.model, "model", "gray", 0.0, top)]
        pictures.append((miss, "frame - model, times 5", signed, -top / 5, top / 5))
        if example.surface is not None and example.model_surface is not None:
            seen, made = (s[0] - s[1] for s in (example.surface, example.model_surface))
            peak = float(np.abs(seen).max())
            pictures += [
                (seen, "events: ON - OFF", signed, -peak, peak),
                (made, "model", signed, -peak, peak),
                (seen - made, "difference", signed, -peak, peak),
            ]
        for axis in line:
            axis.set_axis_off()
        for axis, (picture, title, colours, low, high) in zip(line, pictures, strict=False):
            axis.imshow(picture, cmap=colours, vmin=low, vmax=high)
            axis.set_title(f"{example.name}: {title}" if title == "frame" else title, fontsize=8)
    figure.supxlabel("differences and events: light orange above 0, grey at 0, dark blue below", fontsize=8)
    # Noise hardly compresses: fewer colours keep the picture small.
    drawn = BytesIO()
    figure.savefig(drawn, dpi=60, format="png")
    with open_image(drawn) as picture:
        packed = BytesIO()
        picture.convert("RGB").quantize(200).save(packed, "PNG", optimize=True)
    write_atomically(path, packed.getvalue())
