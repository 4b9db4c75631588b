"""How light goes from the hidden scene over the wall to the camera."""

from evnlos.optics.angular_spectrum import (
    Diffraction,
    angular_spectrum,
    blur_radius_px,
    fresnel_number,
    rayleigh_sommerfeld_sum,
    sampling_limit_m,
)
from evnlos.optics.corner import (
    ONE_WALKER,
    TWO_WALKERS,
    CornerFloor,
    CornerScene,
    EdgeOperator,
    Walker,
    edge_irradiance,
    floor_bearing,
    strip_response,
)
from evnlos.optics.matrix_wall import MatrixWall, coarsest_keyframe_step_m
from evnlos.optics.operator import LinearTransport, MatrixTransport, Patches, Transport, compose, dense_matrix
from evnlos.optics.radiometric import LightTransport, light_transport_matrix
from evnlos.optics.reflection import (
    GGX,
    Brdf,
    DiffuseReflection,
    Lambert,
    tpsf_kernel,
    tpsf_profile,
    tpsf_truncation,
)
from evnlos.optics.view import Occluder, View, ViewOperator, lamp_radiance
from evnlos.optics.wall import Irradiance, SlidingWall

__all__ = [
    "GGX",
    "ONE_WALKER",
    "TWO_WALKERS",
    "Brdf",
    "CornerFloor",
    "CornerScene",
    "Diffraction",
    "DiffuseReflection",
    "EdgeOperator",
    "Irradiance",
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
    "ViewOperator",
    "Walker",
    "angular_spectrum",
    "blur_radius_px",
    "coarsest_keyframe_step_m",
    "compose",
    "dense_matrix",
    "edge_irradiance",
    "floor_bearing",
    "fresnel_number",
    "lamp_radiance",
    "light_transport_matrix",
    "rayleigh_sommerfeld_sum",
    "sampling_limit_m",
    "strip_response",
    "tpsf_kernel",
    "tpsf_profile",
    "tpsf_truncation",
]
