"""How light goes from the hidden scene over the wall to the camera."""

from evnlos.transport.angular_spectrum import (
    angular_spectrum,
    blur_radius_px,
    fresnel_number,
    rayleigh_sommerfeld_sum,
    sampling_limit_m,
)
from evnlos.transport.brdf import GGX, Brdf, Lambert
from evnlos.transport.diffraction import Diffraction
from evnlos.transport.lamp import lamp_radiance
from evnlos.transport.light_transport import LightTransport
from evnlos.transport.matrix_wall import MatrixWall, coarsest_keyframe_step_m
from evnlos.transport.occluder import Occluder
from evnlos.transport.operator import LinearTransport, MatrixTransport, Transport, compose
from evnlos.transport.patches import Patches
from evnlos.transport.radiometric import light_transport_matrix
from evnlos.transport.reflection import DiffuseReflection
from evnlos.transport.tpsf import tpsf_kernel, tpsf_profile, tpsf_truncation
from evnlos.transport.view import View
from evnlos.transport.viewing import Viewing
from evnlos.transport.wall import SlidingWall, Wall

__all__ = [
    "GGX",
    "Brdf",
    "Diffraction",
    "DiffuseReflection",
    "Lambert",
    "LightTransport",
    "LinearTransport",
    "MatrixTransport",
    "MatrixWall",
    "Occluder",
    "Patches",
    "SlidingWall",
    "Transport",
    "View",
    "Viewing",
    "Wall",
    "angular_spectrum",
    "blur_radius_px",
    "coarsest_keyframe_step_m",
    "compose",
    "fresnel_number",
    "lamp_radiance",
    "light_transport_matrix",
    "rayleigh_sommerfeld_sum",
    "sampling_limit_m",
    "tpsf_kernel",
    "tpsf_profile",
    "tpsf_truncation",
]
