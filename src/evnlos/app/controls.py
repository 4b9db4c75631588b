"""What the page lets a visitor choose, as settings of a small simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from evnlos.dataset import Simulation
from evnlos.dataset.presets import page
from evnlos.errors import ConfigError
from evnlos.sensor import EventPixel, FrameCamera
from evnlos.setups import RadiometricSetup, SensorSize

_PAGE = page()  # what the package's networks learned from: rig and samples here are the same
POSITIONS = _PAGE.positions
"""Positions of a pass, as in a dataset."""
TRAVEL_M = _PAGE.motion.speed_m_s * _PAGE.duration_s
"""Way of the hidden object, metres, as in a dataset."""
COARSE = _PAGE.sampling
"""The standard canvas of 24 cm x 16 cm in cells of the simulation: coarse, so that a new wall takes less than a
second."""

Wall = Literal["metal", "matte"]


@dataclass(frozen=True)
class Controls:
    """Rig and camera as the page's controls state them; hidden object apart.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> Controls(speed_m_s=0.04).duration_s
        4.0
    """

    wall: Wall = "metal"
    """Rough metal, or matte white paint that throws light everywhere alike."""
    roughness: float = 0.05
    """Roughness of the metal (GGX alpha), 0.01 to 0.3."""
    distance_m: float = 0.3
    """Distance from hidden object to wall, metres, 0.15 to 0.6."""
    speed_m_s: float = 0.02
    """Speed of the hidden object, metres a second, 0.005 to 0.2."""
    ambient: float = 0.05
    """Ambient light, white levels, 0 to 0.7."""
    frame_noise: float = 1.0
    """Noise of the frame camera in multiples of the default camera's, 0.2 to 10."""
    threshold_on: float = 0.15
    """Threshold of ON events, log intensity, 0.03 to 0.6."""
    threshold_off: float = 0.15
    """Threshold of OFF events, log intensity, 0.03 to 0.6."""
    event_noise_hz: float = 0.01
    """Noise events of a pixel in the dark, hertz, 0 to 2."""
    columns: int = 48
    """Columns of the camera, pixels, 16 to 320; it has five rows to eight columns."""
    seed: int = 1
    """Seed of all noise."""

    def __post_init__(self) -> None:
        if self.wall not in ("metal", "matte"):
            raise ConfigError(f"wall is {self.wall!r}; give metal or matte")
        for name, low, high in (
            ("roughness", 0.01, 0.3),
            ("distance_m", 0.15, 0.6),
            ("speed_m_s", 0.005, 0.2),
            ("ambient", 0.0, 0.7),
            ("frame_noise", 0.2, 10.0),
            ("threshold_on", 0.03, 0.6),
            ("threshold_off", 0.03, 0.6),
            ("event_noise_hz", 0.0, 2.0),
            ("columns", 16, 320),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ConfigError(f"{name} is {value!r}; give a number from {low:g} to {high:g}")
            if not low - 1e-9 <= value <= high + 1e-9:
                raise ConfigError(f"{name} is {value:g}; give {low:g} to {high:g}")

    @property
    def duration_s(self) -> float:
        """Length of the pass, seconds."""
        return TRAVEL_M / self.speed_m_s

    def simulation(self) -> Simulation:
        """Return the same as settings of `evnlos simulate`: a radiometric wall, both cameras, coarse samples.

        The noise of a pixel grows with the square root of the light over the full well, so that a well smaller
        by the noise squared gives that multiple of the noise in any light.
        """
        usual = FrameCamera()
        camera = FrameCamera(
            full_well_e=usual.full_well_e / self.frame_noise**2,
            read_noise_e=usual.read_noise_e / self.frame_noise,
            dsnu_e=usual.dsnu_e / self.frame_noise**2,
        )
        return Simulation(
            motion=replace(_PAGE.motion, speed_m_s=self.speed_m_s),
            duration_s=self.duration_s,
            positions=POSITIONS,
            setup=RadiometricSetup(
                wall_material="ggx" if self.wall == "metal" else "lambert",
                # A matte wall has no roughness: one value, so that its matrix is made once.
                roughness=self.roughness if self.wall == "metal" else 0.05,
                distance_m=self.distance_m,
                cell_m=COARSE.pitch_m,
                ambient=self.ambient,
                sensor=SensorSize(round(self.columns * 5 / 8), self.columns),
                frame_camera=camera,
                pixel=EventPixel(
                    threshold_on=self.threshold_on,
                    threshold_off=self.threshold_off,
                    shot_noise_rate_hz=self.event_noise_hz,
                ),
            ),
            sampling=COARSE,
            seed=self.seed,
        )
