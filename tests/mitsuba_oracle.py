"""The light-transport matrix and a path tracer side by side: the same setup in Mitsuba 3.

`python tests/mitsuba_oracle.py` renders small setups both ways and prints how far they are apart; it needs
`pip install mitsuba`.
"""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import ConfigError, DataError, MissingDependencyError
from evnlos.optics import GGX, Lambert, Occluder, View, light_transport_matrix
from evnlos.optics.reflection import Brdf
from evnlos.setups import RadiometricSetup, SensorSize
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
        raise MissingDependencyError("the path tracer needs Mitsuba 3: pip install mitsuba") from None


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


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a matrix's image compares with independent renders of the same scene.

    Args:
        gain: Traced divided by computed brightness, least squares weighted by the tracer's noise.
        gain_sigma: Standard deviation of that gain by the tracer's noise.
        chi2: Mean over the pixels of the squared deviation after the gain, in units of its expectation: 1 where
            the tracer's noise is the only difference.
        chi2_sigma: Standard deviation of `chi2` under that hypothesis.
        noise: Mean over the pixels of the tracer's own relative standard error.
    """

    gain: float
    gain_sigma: float
    chi2: float
    chi2_sigma: float
    noise: float

    @property
    def agrees(self) -> bool:
        """Whether the gain and chi2 are 1 within 4 of their standard deviations."""
        gain = abs(self.gain - 1) < 4 * self.gain_sigma
        return gain and abs(self.chi2 - 1) < 4 * self.chi2_sigma


def compare(expected: ArrayLike, renders: NDArray[np.float64]) -> Agreement:
    """Hold an image against independent renders; the noise is estimated from their spread.

    Args:
        expected: Image of the matrix, [H, W].
        renders: Renders of the same scene, [repeats, H, W], repeats 6 or more.

    Raises:
        DataError: Too few renders to know their spread, or another image size.
    """
    image = np.asarray(expected, np.float64)
    repeats = len(renders)
    if repeats < 6 or renders.shape[1:] != image.shape:
        raise DataError(f"renders are {renders.shape}; give at least 6 of {image.shape}")
    mean = renders.mean(axis=0)
    error = renders.std(axis=0, ddof=1) / math.sqrt(repeats)
    lit = error > 0
    mean, error, image = mean[lit], error[lit], image[lit]
    halves = [_gain(image, renders[k::2][:, lit], renders[1 - k :: 2][:, lit]) for k in (0, 1)]
    gain = sum(value for value, _ in halves) / 2
    gain_sigma = math.hypot(*(sigma for _, sigma in halves)) / 2
    # Student's t with repeats - 1 degrees of freedom: mean square (n - 1) / (n - 3), and its fourth moment.
    t2 = ((mean - gain * image) / error) ** 2
    free = repeats - 1
    expectation = free / (free - 2)
    variance = expectation**2 * (2 * free - 2) / (free - 4)
    count = len(image)
    return Agreement(
        gain,
        gain_sigma,
        float(t2.mean() / expectation),
        math.sqrt(variance / count) / expectation,
        float((error / mean).mean()),
    )


def _gain(
    image: NDArray[np.float64], renders: NDArray[np.float64], others: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the weighted gain of some renders and its standard deviation.

    The weights come from the other renders: a pixel's own spread goes with its own mean and would bias it.
    """
    weight = 1 / others.var(axis=0, ddof=1)
    scale = (weight * image**2).sum()
    gain = (weight * image * renders.mean(axis=0)).sum() / scale
    variance = renders.var(axis=0, ddof=1) / len(renders)
    return float(gain), float(np.sqrt((weight**2 * image**2 * variance).sum()) / scale)


PATTERN = Plane(8, 8, 0.01)
"""Cells of the pattern that `check_walls` and the tests show."""


SHADOW_POINTS = (16, 8)
"""Quadrature points a side of a (pixel, cell) for the edges of shadows on such large pixels and cells."""


def pattern() -> NDArray[np.float64]:
    """Return five lit cells without any symmetry, [8, 8]: a mirrored axis or a wrong order shows."""
    brightness = np.zeros(PATTERN.shape)
    brightness[[1, 6, 3, 0, 7], [2, 1, 6, 7, 4]] = 1.0, 0.5, 0.7, 0.3, 0.9
    return brightness


def wall_image(
    setup: RadiometricSetup,
    shape: tuple[int, int],
    brightness: NDArray[np.float64],
    points: tuple[int, int] | None = None,
) -> NDArray[np.float64]:
    """Return the light-transport matrix times a pattern on the cells of `PATTERN`, [H, W].

    Args:
        setup: The setup.
        shape: Size (H, W) of the camera image, pixels.
        brightness: Radiance of the cells, [8, 8].
        points: Quadrature points a side of a (pixel, cell); None adapts them, which is too coarse for the edge
            of a shadow on the large pixels of a small image.
    """
    place = {"offset_m": setup.offset_m(), "occluders": setup.occluders()}
    matrix = light_transport_matrix(
        setup.view(shape), PATTERN, setup.distance_m, setup.brdf(), points=points, **place
    )
    return (matrix @ torch.as_tensor(brightness.copy()).flatten()).reshape(shape).numpy()


def trace_setup(
    setup: RadiometricSetup, shape: tuple[int, int], brightness: NDArray[np.float64], samples: int = 128
) -> NDArray[np.float64]:
    """Return 16 renders of a pattern on the cells of `PATTERN`, [16, H, W]; see `trace`."""
    place = {"offset_m": setup.offset_m(), "occluders": setup.occluders()}
    return trace(
        setup.view(shape), PATTERN, brightness, setup.distance_m, setup.brdf(), samples=samples, **place
    )


def _setup(**settings: Any) -> RadiometricSetup:
    """Return a setup before a camera of few, square pixels."""
    return RadiometricSetup(sensor=SensorSize(8, 12), **settings)


WALLS = {
    "Lambert": _setup(wall_material="lambert"),
    "GGX 0.3": _setup(roughness=0.3),
    "GGX 0.05": _setup(roughness=0.05),
    "GGX 0.05, far": _setup(roughness=0.05, distance_m=0.5),
    "brushed 0.05 x 0.2": _setup(roughness=0.05, roughness_y=0.2),
    "Lambert, post": _setup(wall_material="lambert", post_width_m=0.016),
    "GGX 0.3, post": _setup(roughness=0.3, post_width_m=0.016),
}
"""The setups that are rendered both ways."""


def check_walls(shape: tuple[int, int] = (8, 12), samples: int = 128) -> dict[str, Agreement]:
    """Compare both renderings of the pattern on all of `WALLS`, by name.

    Args:
        shape: Size (H, W) of the camera image, pixels.
        samples: Paths a pixel, lit cell and render.
    """
    found = {}
    for name, setup in ((name, setup.seen_by(shape)) for name, setup in WALLS.items()):
        points = SHADOW_POINTS if setup.occluders() else None
        image = wall_image(setup, shape, pattern(), points)
        found[name] = compare(image, trace_setup(setup, shape, pattern(), samples))
    return found


if __name__ == "__main__":
    print("wall                  traced / computed      chi2 (1 = noise only)   tracer's noise per pixel")
    for wall, one in check_walls().items():
        print(
            f"{wall:<20}  {one.gain:.5f} +- {one.gain_sigma:.5f}    {one.chi2:.2f} +- {one.chi2_sigma:.2f}"
            f"            {100 * one.noise:.2f} %"
        )
