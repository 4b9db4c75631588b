"""What to pre-train on once a rig is known: its simulation, varied a little, with strokes like the targets'."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from evnlos.calibration.event_fit import PixelFit
from evnlos.calibration.frame_noise import FrameNoise
from evnlos.dataset.simulate import Simulation
from evnlos.scene import HandwritingGlyphs, Strokes, pen_width

_PEN_MARGIN = 0.1  # the pens' range is widened by this fraction at both ends
_SPREAD = {
    "setup.roughness": 0.04,
    "setup.slopes": 0.03,
    "setup.gain": 0.08,
    "setup.ambient": 0.08,
    "setup.frame_camera.full_well_e": 0.1,
    "setup.frame_camera.read_noise_e": 0.1,
    "setup.pixel.threshold_on": 0.05,
    "setup.pixel.threshold_off": 0.05,
    "setup.pixel.shot_noise_rate_hz": 0.1,
    "setup.pixel.photon_noise": 0.2,
    "setup.pixel.leak_rate_per_dn_hz": 0.1,
}
"""Relative half-widths: far more than the fit's own errors, because no wall is exactly its model."""

_SLACK_M = 0.0005  # of the place of the travel
_RIGS = 6  # different walls and cameras: each costs a light-transport matrix
_LEAK_HZ = 0.1  # captures of some seconds do not show a smaller leak


def pens_of(masks: Iterable[NDArray]) -> tuple[float, float]:
    """Return the thinnest and the thickest pen of some drawings, parts of their ink's longer side."""
    pens = [pen_width(mask) for mask in masks]
    return min(pens), max(pens)


def training_simulation(
    fitted: Simulation, noise: FrameNoise, pixel: PixelFit | None, pens: tuple[float, float]
) -> Simulation:
    """Return the simulation to pre-train on: the fitted one, varied from object to object.

    The frame camera has the fixed pattern that stays after correction, a new one for each object. The pens'
    range is that of the known targets, a tenth wider at both ends; their letters are not copied.

    Args:
        fitted: The simulation that matches the rig.
        noise: The frame camera's noise.
        pixel: The fitted event pixel; None where only frames were fitted.
        pens: Thinnest and thickest pen of the known targets.
    """
    prnu, dsnu = noise.remaining
    glyphs = fitted.glyphs
    if isinstance(glyphs, HandwritingGlyphs):
        low, high = pens[0] * (1 - _PEN_MARGIN), pens[1] * (1 + _PEN_MARGIN)
        strokes = Strokes("both", (max(0.02, round(low, 3)), min(0.4, round(high, 3))))
        glyphs = replace(glyphs, strokes=strokes)
    vary = dict(fitted.vary)
    for path, spread in _SPREAD.items():
        value: Any = fitted
        for name in path.split("."):
            value = getattr(value, name, None)
        if value is not None:
            vary[path] = (value * (1 - spread), value * (1 + spread))
    for one in fitted.setup.parameters():
        if one.role == "place":
            vary[f"setup.{one.name}"] = (one.value - _SLACK_M, one.value + _SLACK_M)
    if pixel is not None:
        if pixel.cutoff_range_hz is not None:
            vary["setup.pixel.cutoff_hz"] = pixel.cutoff_range_hz
        vary["setup.pixel.leak_rate_hz"] = (0.0, max(_LEAK_HZ, getattr(pixel.pixel, "leak_rate_hz", 0.0)))
    camera = replace(fitted.frame_camera, prnu=prnu, dsnu_e=dsnu, pattern_seed=None)
    return replace(
        fitted, glyphs=glyphs, setup=replace(fitted.setup, frame_camera=camera), vary=vary, rigs=_RIGS
    )
