"""The rig of a report: its drawing to scale, and what it can show at all."""

from __future__ import annotations

import html

import numpy as np
import torch

from evnlos.evaluation.identify import Identification
from evnlos.plot.rig import PARTITION, setup_drawing
from evnlos.report.curves import curves_svg
from evnlos.report.pictures import data_uri, grey, png
from evnlos.setups import Setup

_LOWEST = 1e-3


def setup_section(name: str, rig: Setup | None, travel_m: float = 0.16, plate_m: float = 0.08) -> str:
    """Return the section that shows the rig; without one, how to have it shown."""
    head = "<h2>The set-up</h2>"
    if rig is None:
        said = "The rig is not known to this page; <code>evnlos report --rig RIG.yaml</code> draws it."
        return f"{head}<p class=dim>{said}</p>"
    drawing = setup_drawing(rig, travel_m, plate_m)
    if drawing is None:
        words = html.escape(f"{name}: {rig.describe()}")
        return f"{head}<p>{words}. Where its parts stand is not known, so it has no drawing.</p>"
    told = (
        "An object moves around the corner. Its light falls on the relay wall, which scatters it; two cameras "
        "watch the wall and never see the object."
    )
    drawn = drawing.svg
    hides = (
        " What hides the object is not among the settings of the rig: the dotted line is a sketch."
        if PARTITION in drawn
        else " What hides the object is not among the settings of the rig, and is not drawn."
    )
    return f"{head}<p>{told} Rig: {html.escape(name)}.</p><div class=rig>{drawn}</div><p class=dim>{hides}</p>"


def limits_section(found: Identification | None) -> str:
    """Return the section that says what any method can make of one picture; nothing without a rig."""
    if found is None:
        return ""
    at = found.at_camera
    spectrum, picard = _points(at.spectrum), _points(at.picard)
    noise = [(1.0, 0.0), (max(x for x, _ in [(2.0, 0.0), *spectrum, *picard]), 0.0)]
    series = {"singular value / noise": spectrum, "a letter's coefficient / noise": picard, "noise": noise}
    pictures = "".join(
        f"<figure><img class=large alt='{words}' src='{data_uri(png(grey(image.numpy())))}'>"
        f"<figcaption>{words}</figcaption></figure>"
        for image, words in ((found.truth, "a typical plate"), (at.picture, "best linear picture"))
    )
    warned = "".join(f"<p>{html.escape(words)}</p>" for words in found.warnings)
    return (
        "<h2>What this rig can show at all</h2>"
        f"<p><b>{html.escape(found.verdict)}</b></p>{warned}<p class=dim>One picture of the wall, the object "
        "at a known place, the rig known exactly; patterns whose value lies above 0 stand above the noise. On "
        f"the plate itself: best linear picture {at.psnr_db:.1f} dB, mean plate {found.mean_db:.1f} dB, "
        f"all-black {found.zero_db:.1f} dB. What a network draws beyond that it knows from its training.</p>"
        f"<div class=pair>{pictures}</div>{curves_svg(series, 'pattern', 'log10 of value over noise')}"
    )


def _points(values: torch.Tensor) -> list[tuple[float, float]]:
    """Return number and logarithm of each value up to the last one that stands above the lowest drawn."""
    above = np.flatnonzero(values.numpy() > _LOWEST)
    last = int(above[-1]) + 1 if len(above) else 0
    logs = np.log10(np.maximum(values.numpy()[:last], _LOWEST))
    return [(float(k), float(v)) for k, v in enumerate(logs, start=1)]
