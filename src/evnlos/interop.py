"""Thin adapters to other packages, imported when they are used: Mitsuba 3 and deepinv.

- The same setup in Mitsuba 3: an independent path tracer to hold the light-transport matrix against.
- Our operators as physics of deepinv, so that its solvers and networks run on them.
- Thin adapters to other packages, imported when they are used.
"""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError, DataError, MissingDependencyError
from evnlos.inverse import LinearOperator
from evnlos.optics import GGX, Lambert, Occluder, View
from evnlos.optics.reflection import Brdf
from evnlos.types import Plane, derive_seed

_NEAR_CLIP_M = 1e-3
_BEYOND = 2.0  # the wall's rectangle reaches this many times farther than the view


def trace(
    view: View,
    source: Plane,
    brightness: ArrayLike,
    distance_m: float,
    brdf: Brdf,
    *,
    offset_m: tuple[float, float] = (0.0, 0.0),
    occluders: Sequence[Occluder] = (),
    samples: int = 128,
    repeats: int = 16,
    seed: int = 0,
    variant: str = "scalar_rgb",
) -> NDArray[np.float64]:
    """Render what the camera sees of the wall, several times with independent random numbers.

    One bounce on the wall, as in `light_transport_matrix`; each lit cell is an area emitter that faces the wall
    and is black otherwise. Mitsuba's axes are ours with y turned upwards.

    Args:
        view: The camera, made by `View.perspective`.
        source: The target's plane.
        brightness: Radiance of its cells, [h, w], 0 or more.
        distance_m: Distance from wall to target, metres.
        brdf: `Lambert`, or `GGX` (a rough conductor with the same n and k).
        offset_m: Where the target plane's origin lies over the wall (x, y), metres.
        occluders: Opaque polygons; the camera must see past them.
        samples: Paths a pixel, lit cell and render.
        repeats: Independent renders.
        seed: Seed of all of them.
        variant: Mitsuba's variant, e.g. "scalar_rgb"; "auto" takes an LLVM variant where that works.

    Returns:
        Radiance of the pixels, [repeats, H, W]; their mean over the repeats estimates matrix @ brightness.

    Raises:
        ConfigError: The view is no plain pin-hole, or the BRDF is of another kind.
        DataError: The brightness has another size than the source, or is negative.
        MissingDependencyError: Mitsuba is not installed.
    """
    mi = _mitsuba()
    light = np.asarray(brightness, np.float64)
    if light.shape != source.shape or not (light >= 0).all():
        raise DataError(f"brightness is {light.shape}; give {source.shape} values, 0 or more")
    total = np.zeros((repeats, *view.shape))
    known = mi.variant()
    mi.set_variant(usable_variant() if variant == "auto" else variant)
    try:
        # One emitter a scene: several are numbered anew in every run, so that the same seed draws differently.
        for row, column in np.argwhere(light > 0).tolist():
            scene = _scene(mi, view, source, (row, column), distance_m, brdf, offset_m, occluders)
            for k in range(repeats):
                draw = derive_seed(seed, row, column, k) % 2**32
                render = np.array(mi.render(scene, spp=samples, seed=draw))[..., 0]
                total[k] += light[row, column] * render
    finally:
        if known is not None:
            mi.set_variant(known)
    return total


@lru_cache(maxsize=1)
def usable_variant() -> str:
    """Return "llvm_ad_rgb" where it works and "scalar_rgb" elsewhere.

    A missing or wrong LLVM library ends the whole process, so another process tries it.
    """
    attempt = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); print(float(mi.Float(1) + mi.Float(2)))"
    try:
        found = subprocess.run([sys.executable, "-c", attempt], capture_output=True, timeout=120, check=False)
    except subprocess.TimeoutExpired:
        return "scalar_rgb"
    works = found.returncode == 0 and found.stdout.strip().startswith(b"3")
    return "llvm_ad_rgb" if works else "scalar_rgb"


def triangulate(corners: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """Cut a simple polygon into triangles by clipping its ears.

    Args:
        corners: Corners in order, [K, 2], either way round.

    Returns:
        K - 2 triples of corner numbers.

    Raises:
        ConfigError: The border crosses itself.

    Example:
        >>> triangulate(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
        [(3, 0, 1), (1, 2, 3)]
    """
    left = list(range(len(corners)))
    x, y = corners.T
    doubled = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())  # twice the area, signed
    if doubled < 0:
        left.reverse()

    def turn(a: int, b: int, c: int) -> float:
        return float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))

    found = []
    while len(left) > 3:
        for i in range(len(left)):
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            others = [p for p in left if p not in (a, b, c)]
            empty = all(min(turn(a, b, p), turn(b, c, p), turn(c, a, p)) < 0 for p in others)
            if turn(a, b, c) > 0 and empty:
                found.append((a, b, c))
                del left[i]
                break
        else:
            raise ConfigError("an occluder's border crosses itself; list its corners in order")
    found.append((left[0], left[1], left[2]))
    areas = [turn(*corner) for corner in found]
    if min(areas) <= 0 or not math.isclose(sum(areas), abs(doubled), rel_tol=1e-6):
        raise ConfigError("an occluder's border crosses itself; list its corners in order")
    return found


def _mitsuba() -> Any:
    try:
        return importlib.import_module("mitsuba")
    except ImportError:
        raise MissingDependencyError("the path tracer needs Mitsuba 3: pip install evnlos[lab]") from None


def _scene(
    mi: Any,
    view: View,
    source: Plane,
    cell: tuple[int, int],
    distance_m: float,
    brdf: Brdf,
    offset_m: tuple[float, float],
    occluders: Sequence[Occluder],
) -> Any:
    """Return the scene in which one cell (row, column) shines."""
    row, column = cell
    move = mi.ScalarTransform4f
    black = {"type": "diffuse", "reflectance": _grey(0.0)}
    reach = _BEYOND * float(view.wall_points_m().abs().max())
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": _sensor(mi, view),
        "wall": {"type": "rectangle", "to_world": move().scale([reach, reach, 1]), "bsdf": _bsdf(brdf)},
    }
    for number, occluder in enumerate(occluders):
        scene[f"occluder_{number}"] = _polygon(mi, occluder, black)
    half = source.pitch_m / 2
    place = [source.x_m[column] + offset_m[0], -(source.y_m[row] + offset_m[1]), distance_m]
    scene["cell"] = {
        "type": "rectangle",
        # A rectangle shines along +z; half a turn makes it face the wall.
        "to_world": move().translate(place).rotate([1, 0, 0], 180).scale([half, half, 1]),
        "emitter": {"type": "area", "radiance": _grey(1.0)},
        "bsdf": black,
    }
    return mi.load_dict(scene)


def _grey(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": value}


def _bsdf(brdf: Brdf) -> dict[str, Any]:
    if isinstance(brdf, Lambert):
        return {"type": "diffuse", "reflectance": _grey(float(brdf.albedo))}
    if isinstance(brdf, GGX):
        alpha_y = brdf.alpha if brdf.alpha_y is None else brdf.alpha_y
        roughness = {"alpha_u": float(brdf.alpha), "alpha_v": float(alpha_y)}
        metal = {"eta": _grey(float(brdf.n)), "k": _grey(float(brdf.k))}
        return {"type": "roughconductor", "distribution": "ggx", **roughness, **metal}
    raise ConfigError(f"Mitsuba has no wall like {type(brdf).__name__} here; give Lambert or GGX")


def _sensor(mi: Any, view: View) -> dict[str, Any]:
    if view.eye_m is None:
        raise ConfigError("the view has no pin-hole; build it with View.perspective")
    height, width = view.shape
    eye = np.array(view.eye_m)
    edges = torch.tensor([[u, (height - 1) / 2, 1.0] for u in ((width - 1) / 2, -0.5)], dtype=torch.float64)
    aim, left = (h[:2] / h[2] for h in edges @ torch.tensor(view.matrix, dtype=torch.float64).mT)
    ray, side = (np.array([*point.tolist(), 0.0]) - eye for point in (aim, left))
    half = math.acos(float(ray @ side / np.linalg.norm(ray) / np.linalg.norm(side)))
    angle = math.atan2(-ray[0], -ray[2])
    x, y = aim.tolist()
    plain = View.perspective(view.shape, float(np.linalg.norm(ray)), angle, 2 * half, (x, y))
    if not torch.allclose(plain.wall_points_m(), view.wall_points_m(), rtol=0, atol=1e-9):
        raise ConfigError("the view is no upright pin-hole with square pixels; build it with View.perspective")
    upright = mi.ScalarTransform4f().look_at(origin=[eye[0], -eye[1], eye[2]], target=[x, -y, 0], up=[0, 1, 0])
    return {
        "type": "perspective",
        "fov": math.degrees(2 * half),
        "fov_axis": "x",
        "near_clip": _NEAR_CLIP_M,
        "to_world": upright,
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
            "component_format": "float32",
        },
    }


def _polygon(mi: Any, occluder: Occluder, bsdf: dict[str, Any]) -> Any:
    corners = np.array(occluder.vertices_m) * (1, -1, 1)
    # Triangulate in the plane of the polygon: its two longest directions.
    axes = np.linalg.svd(corners - corners.mean(axis=0))[2][:2]
    faces = np.array(triangulate(corners @ axes.T))
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("occluder", len(corners), len(faces), properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners.ravel().tolist()
    parameters["faces"] = faces.ravel().tolist()
    parameters.update()
    return mesh


def as_physics(operator: LinearOperator, noise_sigma: float = 0.0) -> Any:
    """Return an operator as a `deepinv.physics.LinearPhysics`.

    deepinv works on batches [B, C, h, w]; every channel goes through the operator by itself. `A` and
    `A_adjoint` are those of the operator, in whatever dtype and on whatever device the images are.

    Args:
        operator: Linear, with an adjoint: any `LinearTransport`, or a `Problem` of the solver stage.
        noise_sigma: Standard deviation of the Gaussian noise that `physics(x)` adds, unit of the wall image.

    Returns:
        The physics.

    Raises:
        MissingDependencyError: deepinv is not installed.
        DataError: An image is not [B, C, h, w].
    """
    try:
        from deepinv.physics import GaussianNoise, LinearPhysics  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingDependencyError("this needs deepinv; pip install deepinv") from None

    class Transport(LinearPhysics):
        """The operator in deepinv's words."""

        def A(self, x: torch.Tensor, **_: Any) -> torch.Tensor:  # noqa: N802
            return operator(_batched(x))

        def A_adjoint(self, y: torch.Tensor, **_: Any) -> torch.Tensor:  # noqa: N802
            return operator.adjoint(_batched(y))

    return Transport(noise_model=GaussianNoise(sigma=noise_sigma)) if noise_sigma else Transport()


def _batched(image: torch.Tensor) -> torch.Tensor:
    if image.ndim != 4:
        raise DataError(f"the image is {tuple(image.shape)}; deepinv's physics takes [B, C, h, w]")
    return image


__all__: list[str] = []
