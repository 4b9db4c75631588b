"""From a photograph of a relay wall to an image of the hidden screen.

- A photograph of a relay wall with its geometry: an NPZ file, light, screen and occluders.
- From a wall photograph to an image of the hidden screen, every choice made without the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.inverse.operators import Gradient, Solution
from evnlos.inverse.problem import BackgroundModel
from evnlos.inverse.tikhonov import Rule, tikhonov, tikhonov_cv_error
from evnlos.inverse.total_variation import total_variation
from evnlos.optics import Lambert, MatrixTransport, Occluder, Patches, light_transport_matrix
from evnlos.types import Plane
from evnlos.untrusted import NUMPY_ERRORS, check_memory, open_regular

_FINEST = 48  # wall patches a side that carry what a matte wall knows
_NEEDED = ("wall_x_m", "wall_z_m", "cell_x_m", "cell_z_m", "cell_size_m", "distance_m")


@dataclass(frozen=True, eq=False)
class Photograph:
    """A matte wall's photograph and where wall, hidden screen and occluders stand.

    Args:
        wall: Radiance of the wall, [channels, H, W], any linear unit.
        patches: Where on the wall each pixel looks.
        screen: Cells of the hidden screen, in the wall's x and y (downwards).
        distance_m: Distance from wall to screen, metres.
        occluders: What stands between them.
        emission_exponent: Extra fall of the screen's light, cos_x^a cos_y^b (`light_transport_matrix`).
        truth: What the screen showed, [channels, h, w], where it is known; no solver looks at it.
    """

    wall: torch.Tensor
    patches: Patches
    screen: Patches
    distance_m: float
    occluders: tuple[Occluder, ...] = ()
    emission_exponent: tuple[float, float] = (0.0, 0.0)
    truth: torch.Tensor | None = None

    def binned(self, factor: int | None = None) -> Photograph:
        """Return the photograph with factor x factor pixels averaged; None leaves at most 48 a side."""
        height, width = self.patches.shape
        if factor is None:
            factor = math.ceil(max(height, width) / _FINEST)
        if not 1 <= factor <= min(height, width):
            raise ConfigError(f"the binning is {factor}; give 1 to {min(height, width)} pixels")
        rows, columns = height // factor, width // factor
        wall = self.wall[:, : rows * factor, : columns * factor]
        wall = wall.reshape(-1, rows, factor, columns, factor).mean(dim=(2, 4))  # [channels, rows, columns]
        x, y = (
            middles[: count * factor].reshape(count, factor).mean(axis=1)
            for middles, count in ((self.patches.x_m, columns), (self.patches.y_m, rows))
        )
        size = (self.patches.size_m[0] * factor, self.patches.size_m[1] * factor)
        return replace(self, wall=wall, patches=Patches(x, y, size))

    def matrix(self, screen: Plane | Patches | None = None, *, occluded: bool = True) -> torch.Tensor:
        """Return the light-transport matrix from a screen to the wall, float64 [wall patches, cells].

        Args:
            screen: Cells in the place of the photograph's own.
            occluded: With the occluders, or without.
        """
        return light_transport_matrix(
            self.patches,
            self.screen if screen is None else screen,
            self.distance_m,
            Lambert(1.0),
            occluders=self.occluders if occluded else (),
            emission_exponent=self.emission_exponent,
            # Measured: r of the published photograph is 0.01 lower with the adapted (2, 4).
            points=(3, 6) if occluded and self.occluders else None,
        )

    def transport(self, *, occluded: bool = True) -> MatrixTransport:
        """Return the operator from screen to wall, of norm 1, with or without the occluders."""
        matrix = self.matrix(occluded=occluded)
        norm = torch.linalg.eigvalsh(matrix.mT @ matrix)[-1].sqrt()
        return MatrixTransport(matrix / norm, self.screen, self.patches.shape)

    def plane_of_screen(self, pitch_m: float) -> Plane:
        """Return a plane of square cells whose outermost centres are those of the screen."""
        x, y = np.asarray(self.screen.x_m), np.asarray(self.screen.y_m)
        height, width = (round(float(np.ptp(middles)) / pitch_m) + 1 for middles in (y, x))
        return Plane(height, width, pitch_m, (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2))

    def at_cells(self, images: torch.Tensor, plane: Plane) -> torch.Tensor:
        """Return images of a plane [..., H, W] at the samples nearest to the screen's cells, [..., h, w]."""
        x, y = np.asarray(self.screen.x_m), np.asarray(self.screen.y_m)
        rows = np.abs(y[:, None] - plane.y_m).argmin(axis=1)
        columns = np.abs(x[:, None] - plane.x_m).argmin(axis=1)
        return images[..., rows, :][..., columns]

    def measurement(self) -> torch.Tensor:
        """Return the wall over its largest value, float64 [channels, H, W]."""
        return self.wall.double() / float(self.wall.max())


def read_photograph(path: str | Path, emission_exponent: tuple[float, float] | None = None) -> Photograph:
    """Read a wall photograph and its geometry from an NPZ file.

    The axes are the room's: x to the right in the image, z up, y from the hidden screen (y = 0) to the wall
    (y = distance_m). Keys, lengths in metres: `wall` [H, W] or `wall_rgb` [H, W, 3], linear; `wall_x_m` [W],
    `wall_z_m` [H], equally spaced; `cell_x_m` [w], `cell_z_m` [h] and `cell_size_m` (width, height) of the
    screen's cells; `distance_m`. May be left out: `occluder_polygons_m` [N, K, 3], convex, corners (x, y, z)
    in any order; `emission_exponent` (a, b), horizontal and vertical; `truth` [h, w] or `truth_rgb` [h, w, 3].
    The published file of Saunders et al. (Nature 2019) has `lcd_exponent` instead: (1, lcd_exponent).

    Args:
        path: The file.
        emission_exponent: Takes the place of the file's.

    Raises:
        DataError: A key is missing or its array has the wrong shape.
    """
    try:
        return _photograph(path, _load(path), emission_exponent)
    except (ValueError, TypeError, IndexError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:
        reason = " ".join(str(error).split())[:160]
        raise DataError(
            f"{path} garbles an array ({reason}); docs/inversion.md lists what it must hold"
        ) from None


def _photograph(
    path: str | Path, data: dict[str, Any], emission_exponent: tuple[float, float] | None
) -> Photograph:
    """Return the photograph of the arrays of a file.

    Raises:
        DataError: An array is missing, misshapen, or holds no finite numbers.
    """
    for key, value in data.items():
        if value.dtype.kind not in "fiu" or not np.isfinite(value).all():
            raise DataError(f"{path}: {key[:80]} is no array of finite real numbers; see docs/inversion.md")
    missing = [key for key in _NEEDED if key not in data]
    if missing or not ({"wall", "wall_rgb"} & data.keys()):
        raise DataError(f"{path} lacks {', '.join(missing) or 'wall or wall_rgb'}; see docs/inversion.md")
    wall = _channels(data, "wall")
    assert wall is not None  # one of the keys is there
    x, z = data["wall_x_m"], data["wall_z_m"]
    if wall.shape[1:] != (z.size, x.size) or min(x.size, z.size) < 2:
        raise DataError(
            f"{path}: the wall is {tuple(wall.shape[1:])}, its axes {z.size} x {x.size}; make them agree"
        )
    pitch = (float(np.abs(np.diff(x)).mean()), float(np.abs(np.diff(z)).mean()))
    cells = np.asarray(data["cell_size_m"], np.float64).reshape(-1)
    screen = Patches(data["cell_x_m"], -data["cell_z_m"], (float(cells[0]), float(cells[-1])))
    truth = _channels(data, "truth")
    if truth is not None and truth.shape[1:] != screen.shape:
        raise DataError(f"{path}: the truth is {tuple(truth.shape[1:])}, the screen {screen.shape} cells")
    distance = float(data["distance_m"])
    polygons = data.get("occluder_polygons_m", np.zeros((0, 4, 3)))
    exponent = emission_exponent or _exponent(data)
    if not all(0 <= value <= _STEEPEST for value in exponent):
        raise ConfigError(f"the emission's exponents are {exponent}; give two numbers from 0 to {_STEEPEST}")
    return Photograph(
        wall, Patches(x, -z, pitch), screen, distance, convex_occluders(polygons, distance), exponent, truth
    )


def convex_occluders(polygons_m: np.ndarray, distance_m: float) -> tuple[Occluder, ...]:
    """Return convex polygons [N, K, 3], (x, y, z) in the axes of `read_photograph`, as occluders.

    The corners are put in order round their middle: one of the published file's quadrilaterals crosses itself
    as it is written.
    """
    found = []
    for polygon in np.asarray(polygons_m, np.float64):
        spread = polygon - polygon.mean(axis=0)
        plane = np.linalg.svd(spread)[2][:2]
        u, v = plane @ spread.T
        ordered = polygon[np.argsort(np.arctan2(v, u))]
        found.append(Occluder(tuple((float(x), float(-z), float(distance_m - y)) for x, y, z in ordered)))
    return tuple(found)


def _load(path: str | Path) -> dict[str, Any]:
    try:
        with open_regular(path) as opened, np.load(opened, allow_pickle=False) as file:
            sizes = {info.filename: info.file_size for info in file.zip.infolist()}  # type: ignore[union-attr]
            check_memory(4 * sum(sizes.values()), f"{path}", "give a smaller photograph")
            found = dict(file)
            if not all(isinstance(value, np.ndarray) for value in found.values()):
                raise ValueError("a member that does not begin as an array is given as its bytes")
            return found
    except FileNotFoundError:
        raise DataError(f"{path} does not exist; give an NPZ file") from None
    except NUMPY_ERRORS:
        raise DataError(
            f"{path} is not an NPZ file of plain numbers; docs/inversion.md lists what it must hold"
        ) from None


def _channels(data: dict[str, Any], name: str) -> torch.Tensor | None:
    if name in data:
        return torch.as_tensor(np.asarray(data[name], np.float32))[None]
    if f"{name}_rgb" in data:
        return torch.as_tensor(np.asarray(data[f"{name}_rgb"], np.float32)).permute(2, 0, 1).contiguous()
    return None


_STEEPEST = 100  # fall of a screen's light with the angle


def _exponent(data: dict[str, Any]) -> tuple[float, float]:
    if "emission_exponent" in data:
        a, b = np.asarray(data["emission_exponent"], np.float64).reshape(2)
        return float(a), float(b)
    return (1.0, float(data["lcd_exponent"])) if "lcd_exponent" in data else (0.0, 0.0)


DEGREES = range(7)
"""Degrees of the background to choose from."""
_ALIKE = 1.05


@dataclass(frozen=True, eq=False)
class Inversion:
    """A photograph's operator and what was decided for it.

    Args:
        operator: From screen to wall, largest singular value 1.
        measurement: The wall, its largest value 1, [channels, H, W].
        degree: Degree of the background polynomial.
        cv_errors: Mean squared cross-validation error of each degree tried; empty where it was given.
    """

    operator: MatrixTransport
    measurement: torch.Tensor
    degree: int
    cv_errors: tuple[float, ...] = ()

    def solve(
        self,
        solver: Literal["tikhonov", "tv"],
        regularization: float | None = None,
        rule: Rule = "cv",
        noise_sigma: float | None = None,
    ) -> Solution:
        """Return the screen's image, [channels, h, w], in units of the wall's largest value over the norm.

        Args:
            solver: "tikhonov" with the gradient towards a dark border as prior, or "tv", total variation with
                brightness 0 or more.
            regularization: Weight of the prior, without unit here; None: by `rule`.
            rule: "cv", "discrepancy", and for "tikhonov" also "gcv".
            noise_sigma: Noise of a wall sample in units of the largest, for "discrepancy"; None estimates it
                from the misfit of Tikhonov's GCV solution.

        Raises:
            ConfigError: The rule is not one of the solver's.
        """
        background_model = BackgroundModel(self.degree)
        if regularization is None and rule == "discrepancy" and noise_sigma is None:
            first = tikhonov(
                self.operator, self.measurement, prior=Gradient("dark"), background_model=background_model
            )
            noise_sigma = first.noise_sigma
        if solver == "tikhonov":
            return tikhonov(
                self.operator,
                self.measurement,
                regularization,
                rule=rule,
                noise_sigma=noise_sigma,
                prior=Gradient("dark"),
                background_model=background_model,
            )
        if regularization is None and rule == "gcv":
            raise ConfigError("rule 'gcv' needs a linear solver; with 'tv' use 'cv', 'discrepancy' or a number")
        return total_variation(
            self.operator,
            self.measurement,
            regularization,
            rule="discrepancy" if rule == "discrepancy" else "cv",
            noise_sigma=noise_sigma,
            background_model=background_model,
        )


def prepare_inversion(
    photograph: Photograph, *, degree: int | None = None, occluded: bool = True, bin: int | None = None
) -> Inversion:
    """Return the operator and the background of a photograph.

    Args:
        photograph: The photograph as taken.
        degree: Degree of the background; None takes the smallest whose cross-validation error is
            within 5 % of the least.
        occluded: Whether the operator knows of the occluders.
        bin: Wall pixels a side that are averaged; None leaves at most 48 a side.
    """
    photograph = photograph.binned(bin)
    operator, measurement = photograph.transport(occluded=occluded), photograph.measurement()
    if degree is not None:
        return Inversion(operator, measurement, degree)
    errors = background_errors(operator, measurement)
    return Inversion(operator, measurement, _smallest_alike(errors), errors)


def chosen_degree(operator: MatrixTransport, measurement: torch.Tensor) -> int:
    """Return the smallest degree of the background whose cross-validation error is within 5 % of the least.

    Args:
        operator: From the hidden cells to the wall.
        measurement: The wall, [channels, H, W].
    """
    return _smallest_alike(background_errors(operator, measurement))


def _smallest_alike(errors: tuple[float, ...]) -> int:
    # Where errors are alike the smaller background is the better guess: it takes less from the scene.
    return next(d for d, error in zip(DEGREES, errors, strict=True) if error <= _ALIKE * min(errors))


def background_errors(operator: MatrixTransport, measurement: torch.Tensor) -> tuple[float, ...]:
    """Return the cross-validation error of each of `DEGREES` on pairs of rows and columns averaged.

    Half the resolution is enough to tell smooth backgrounds apart, and an eighth of the work.
    """
    height, width = (side // 2 for side in measurement.shape[-2:])

    def halved(image: torch.Tensor) -> torch.Tensor:
        image = image[..., : 2 * height, : 2 * width].unflatten(-2, (height, 2)).unflatten(-1, (width, 2))
        return image.mean(dim=(-3, -1))

    cells = operator.matrix.shape[1]
    rows = halved(operator.matrix.mT.reshape(cells, *operator.shape)).flatten(1).mT
    coarse = MatrixTransport(rows, operator.source, (height, width))
    return tuple(
        tikhonov_cv_error(
            coarse, halved(measurement), prior=Gradient("dark"), background_model=BackgroundModel(degree)
        )
        for degree in DEGREES
    )
