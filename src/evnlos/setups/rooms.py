"""Rooms by name: walls, lenses, lamps and sensors that the simulator's models do not describe."""

from __future__ import annotations

from evnlos.lab import Lobe, Mount, Reflection, Torch
from evnlos.sensor import BrownianPixel, EventPixel, FrameCamera
from evnlos.setups.room import RoomSetup

TWO_LOBES = RoomSetup(
    reflection=Reflection((Lobe("ggx", 0.6, 0.05, 0.05), Lobe("ggx", 0.4, 0.07, 0.15)), matte=0.02),
    texture_smooth=0.045,
    texture_fine=0.04,
    texture_seed=11,
    vignetting=0.15,
    aperture_m=0.012,
    focus_m=0.47,
    frame_camera=FrameCamera(0.016, 9000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=11),
    pixel=BrownianPixel(0.18, 0.18, 0.007, 10.0, 0.05, 0.003, 0.036, 0.0036, pattern_seed=11),
)
"""A round lobe and one that is wider along y; 6 % of texture; a lens out of focus that darkens the corners."""

ONE_SIDED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.05, 0.05),), matte=0.0),
    distance_m=0.28,
    camera_distance_m=0.55,
    camera_angle_deg=33.0,
    field_of_view_deg=32.0,
    ambient=0.05,
    ambient_gradient=(0.1, 0.1),
    frame_camera=FrameCamera(0.016, 10_000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=12),
    pixel=EventPixel(0.12, 1.4, 0.007, 40.0, 0.15, 0.02, 2e-3, pattern_seed=12, logarithm="true", dark_dn=1.0),
)
"""Plain aluminium; a sensor of which about 95 % of the events are ON."""

CURVED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.06, 0.06),), matte=0.05),
    texture_smooth=0.05,
    texture_fine=0.05,
    texture_seed=13,
    curvature=(0.9, 0.5),
    vignetting=0.08,
    distance_m=0.33,
    camera_distance_m=0.65,
    camera_angle_deg=26.0,
    field_of_view_deg=28.0,
    mount=Mount(0.04),
    ripple=0.04,
    ambient=0.08,
    frame_camera=FrameCamera(0.020, 7000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=13),
    pixel=EventPixel(
        0.18, 0.20, 0.01, 70.0, 0.08, 0.1, 5e-4, 3e-4, pattern_seed=13, logarithm="true", dark_dn=0.4
    ),
)
"""A wall that bulges (radii of 1.1 and 2 m), with 7 % of texture; the mount shines; lamps ripple at 100 Hz."""

BRUSHED = RoomSetup(
    reflection=Reflection((Lobe("ggx", 1.0, 0.035, 0.11, turn_deg=12.0),), matte=0.03),
    texture_smooth=0.02,
    texture_fine=0.05,
    texture_seed=14,
    grain=8.0,
    distortion=(-0.05, 0.012),
    camera_roll_deg=1.5,
    camera_elevation_deg=4.0,
    distance_m=0.35,
    camera_distance_m=0.55,
    camera_angle_deg=24.0,
    field_of_view_deg=35.0,
    frame_camera=FrameCamera(0.010, 12_000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=14),
    pixel=EventPixel(0.22, 0.19, 0.01, 120.0, 0.1, 0.1, 5e-4, pattern_seed=14, logarithm="true", dark_dn=0.5),
)
"""Brushed metal, not along the camera's axes, seen from above by a turned camera whose lens distorts."""

STREAKS = RoomSetup(
    reflection=Reflection(
        (
            Lobe("streak", 0.35, 0.09, 0.018, turn_deg=20.0),
            Lobe("streak", 0.25, 0.07, 0.018, turn_deg=-65.0),
            Lobe("ring", 0.25, 0.09, 0.07, shift=(0.01, -0.015)),
            Lobe("beckmann", 0.15, 0.04, 0.04),
        ),
        matte=0.02,
    ),
    texture_smooth=0.03,
    texture_fine=0.04,
    texture_seed=15,
    vignetting=0.1,
    distance_m=0.26,
    camera_distance_m=0.70,
    camera_angle_deg=38.0,
    field_of_view_deg=25.0,
    frame_camera=FrameCamera(0.016, 8000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=15),
    pixel=BrownianPixel(0.20, 0.20, 0.01, 8.0, 0.08, 0.002, 0.04, 0.004, pattern_seed=15),
)
"""A reflection of two crossed streaks, a ring that is off its middle, and a core: no ellipse."""

TORCH = RoomSetup(
    reflection=Reflection((Lobe("beckmann", 0.7, 0.07, 0.07), Lobe("ggx", 0.3, 0.03, 0.03)), matte=0.06),
    texture_smooth=0.03,
    texture_fine=0.03,
    texture_seed=16,
    vignetting=0.12,
    distance_m=0.40,
    camera_angle_deg=22.0,
    mount=Mount(0.03),
    lamp=Torch((0.06, 0.09, 0.22), 0.012, 0.02, holder_m=(0.02, 0.058, 0.27, 0.009), spill=0.04),
    frame_camera=FrameCamera(0.016, 9000.0, 12.0, prnu=0.015, dsnu_e=10.0, black_level=4.0, pattern_seed=16),
    pixel=EventPixel(0.20, 0.24, 0.01, 50.0, 0.15, 0.1, 5e-4, pattern_seed=16, logarithm="true", dark_dn=0.5),
)
"""A satin wall and a target that a torch lights, whose body and holder cast shadows."""

ROOMS = {
    "two-lobes": TWO_LOBES,
    "one-sided": ONE_SIDED,
    "curved": CURVED,
    "brushed": BRUSHED,
    "streaks": STREAKS,
    "torch": TORCH,
}
"""Rooms by name; each has light, cameras and a geometry of its own."""
