"""Every transport in a small, odd-sized instance: the laws of the operator protocol are tested over this list.

A new operator is one line here and gets every test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from evnlos.optics import (
    GGX,
    Brdf,
    Diffraction,
    DiffuseReflection,
    Lambert,
    MatrixTransport,
    Occluder,
    Transport,
    View,
    ViewOperator,
    compose,
    lamp_radiance,
    light_transport_matrix,
    tpsf_kernel,
)
from evnlos.types import Plane

_SCENE = Plane(7, 10, 0.01)
_AFFINE = View.affine((9, 13), 110.0, rotation_rad=0.3, shear=0.1, offset_px=(0.7, -0.4), flip_x=True)
_OBLIQUE = View.perspective((9, 13), 0.6, math.radians(30), math.radians(20))


def _matrix(brdf: Brdf, seen: View | Plane = _OBLIQUE, **options: Any) -> MatrixTransport:
    return MatrixTransport(light_transport_matrix(seen, _SCENE, 0.3, brdf, **options), _SCENE, seen.shape)


def _reflection(source: Plane) -> DiffuseReflection:
    return DiffuseReflection(source, tpsf_kernel(source.pitch_m, 0.015, window=0.3))


def _chain(*steps: Callable[[Plane], Transport]) -> Transport:
    """Compose steps, each made for the plane that the one before it ends on."""
    made, plane = [], _SCENE
    for step in steps:
        made.append(step(plane))
        plane = made[-1].output or plane
    return compose(*made)


EXAMPLES: dict[str, Callable[[], Transport]] = {
    "diffraction": lambda: Diffraction(_SCENE, distance_m=0.005, field_step_m=2e-5),
    "diffraction of intensity": lambda: Diffraction(
        _SCENE, distance_m=0.005, field_step_m=2e-5, result="intensity"
    ),
    "diffuse reflection": lambda: _reflection(_SCENE),
    "lopsided kernel": lambda: DiffuseReflection(_SCENE, torch.arange(15.0, dtype=torch.float64).reshape(3, 5)),
    "affine view": lambda: ViewOperator(_SCENE, _AFFINE),
    "oblique view": lambda: ViewOperator(_SCENE, _OBLIQUE, samples=2),
    "matte wall": lambda: _matrix(Lambert()),
    "rough metal": lambda: _matrix(GGX(0.1)),
    "brushed metal": lambda: _matrix(GGX(0.05, 0.2)),
    "matte wall behind a post": lambda: _matrix(
        Lambert(), Plane(5, 8, 0.02), occluders=(Occluder.post(0.01, 0.1, 0.02),)
    ),
    "brushed metal, torch-lit": lambda: _matrix(
        GGX(0.1, 0.3), emission=lamp_radiance(_SCENE, 0.3, (0.1, 0.0, 0.1))
    ),
    "reflection, then view": lambda: _chain(_reflection, lambda plane: ViewOperator(plane, _AFFINE)),
    "the paper's steps": lambda: _chain(
        lambda plane: Diffraction(plane, distance_m=0.005, field_step_m=2e-5),
        _reflection,
        lambda plane: ViewOperator(plane, _OBLIQUE),
    ),
}
