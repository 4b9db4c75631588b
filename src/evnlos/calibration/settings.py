"""What decides a calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from evnlos.dataset.simulate import Simulation
from evnlos.errors import ConfigError
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import PaperSetup, RadiometricSetup


def _rough_metal() -> Simulation:
    return Simulation(
        glyphs=HandwritingGlyphs(characters="ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", writers=8),
        setup=RadiometricSetup(roughness=0.1),
    )


@dataclass(frozen=True)
class Calibration:
    """How captures of a rig become a simulation of it."""

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
    transport = PaperSetup(pitch_m=1e-3, rho_max=6.0, taper=0.3, field_of_view_m=0.5)
    return Calibration(start=Simulation(glyphs=start.glyphs, setup=transport))


PRESETS: dict[str, Callable[[], Calibration]] = {"default": rough_metal, "paper": paper}
"""Calibrations by name."""
