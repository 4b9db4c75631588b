"""What decides a calibration.

- What to pre-train on once a setup is known: its simulation, varied a little, with strokes like the targets'.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from numpy.typing import NDArray

from evnlos.calibration.event_fit import PixelFit
from evnlos.calibration.frame_model import FrameNoise
from evnlos.data.simulate import Simulation
from evnlos.errors import ConfigError
from evnlos.scene import HandwritingGlyphs, Strokes, pen_width
from evnlos.setups import PaperSetup, RadiometricSetup


def _rough_metal() -> Simulation:
    return Simulation(
        glyphs=HandwritingGlyphs(characters="ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", writers=8),
        setup=RadiometricSetup(roughness=0.1),
    )


@dataclass(frozen=True)
class Calibration:
    """How captures of a setup become a simulation of it."""

    exclude: tuple[str, ...] = ()
    """Names of captures, or characters, that the calibration never reads: those that a network is tested on."""
    holdout: tuple[str, ...] = ()
    """Names of captures, or characters, to check the fit on; none draws `holdout_share` of the captures."""
    holdout_share: float = 0.25
    """Share of the captures that is drawn for the check, between 0 and 1."""
    targets: Literal["known", "unknown"] = "known"
    """Whether the captures' targets are known; where not, any handwriting is as likely, and what the files say
    of targets is not looked at."""
    wall: Literal["auto", "any", "formula"] = "auto"
    """Whether the wall may be of any kind (slopes of its facets, texture, bend; what shines along), or is rough
    metal by one formula; `auto` is the first where targets are known and five captures or more are fitted."""
    fit_distance: bool = False
    """Fit the distance of target and wall too; else that of the capture's notes is taken as measured."""
    events: bool = True
    """Fit the event pixel too."""
    columns: int = 64
    """Columns of the pictures that the optics are fitted to, pixels; more cost time."""
    event_captures: int = 3
    """Captures whose events are simulated for the fit, and as many for the check."""
    start: Simulation = field(default_factory=_rough_metal)
    """Where the search starts, and every setting that it leaves alone."""
    seed: int = 0
    """Seed of every draw."""

    def __post_init__(self) -> None:
        if not 0 < self.holdout_share < 1:
            raise ConfigError(
                f"Calibration.holdout_share is {self.holdout_share}; give a share between 0 and 1"
            )
        setup = self.start.setup
        if not setup.parameters():
            raise ConfigError(
                f"start.setup is {setup.kind}, which leaves no optics to fit; give paper or radiometric"
            )
        if self.targets == "unknown" and not setup.is_linear:
            raise ConfigError(
                f"start.setup is {setup.kind}, which is not linear; a fit to unknown targets needs radiometric"
            )
        if self.columns < 16:
            raise ConfigError(f"Calibration.columns is {self.columns}; give 16 pixels or more")
        if self.event_captures < 1:
            raise ConfigError(f"Calibration.event_captures is {self.event_captures}; give at least 1")


def rough_metal() -> Calibration:
    """Return the calibration of a rough metal wall: roughness, camera and place of the target are searched."""
    return Calibration()


def paper() -> Calibration:
    """Return the calibration of the paper's transport: tPSF length and shape, and an affine view."""
    start = _rough_metal()
    transport = PaperSetup(pitch_m=1e-3, kernel_radius=6.0, window=0.3, field_of_view_m=0.5)
    return Calibration(start=Simulation(glyphs=start.glyphs, setup=transport))


PRESETS: dict[str, Callable[[], Calibration]] = {"default": rough_metal, "paper": paper}
"""Calibrations by name."""


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
_SETUPS = 6  # different walls and cameras: each costs a light-transport matrix
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
        fitted: The simulation that matches the setup.
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
        fitted, glyphs=glyphs, setup=replace(fitted.setup, frame_camera=camera), vary=vary, setups=_SETUPS
    )
