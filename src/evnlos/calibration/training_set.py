"""What to pre-train on once a rig is known: its simulation, varied a little, with strokes like the targets'."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from numpy.typing import NDArray

from evnlos.calibration.event_fit import PixelFit
from evnlos.calibration.frame_noise import FrameNoise
from evnlos.dataset.simulate import Simulation
from evnlos.scene import HandwritingGlyphs, Strokes, pen_width
from evnlos.transport import RadiometricTransport

_PEN_MARGIN = 0.1  # the pens' range is widened by this fraction at both ends
_SPREAD = {
    "transport.roughness": 0.04,
    "transport.gain": 0.08,
    "transport.ambient": 0.08,
    "frame_camera.full_well_e": 0.1,
    "frame_camera.read_noise_e": 0.1,
    "pixel.threshold_on": 0.05,
    "pixel.threshold_off": 0.05,
    "pixel.shot_noise_rate_hz": 0.1,
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
        section, name = path.split(".")
        if hasattr(getattr(fitted, section), name):
            value = getattr(getattr(fitted, section), name)
            vary[path] = (value * (1 - spread), value * (1 + spread))
    transport = fitted.transport
    if isinstance(transport, RadiometricTransport) and transport.target_offset_m is not None:
        for axis, value in enumerate(transport.target_offset_m):
            vary[f"transport.target_offset_m.{axis}"] = (value - _SLACK_M, value + _SLACK_M)
    if pixel is not None:
        vary["pixel.cutoff_hz"] = pixel.cutoff_range_hz
        vary["pixel.leak_rate_hz"] = (0.0, max(_LEAK_HZ, fitted.pixel.leak_rate_hz))
    camera = replace(fitted.frame_camera, prnu=prnu, dsnu_e=dsnu, pattern_seed=None)
    return replace(fitted, glyphs=glyphs, frame_camera=camera, vary=vary, rigs=_RIGS)
