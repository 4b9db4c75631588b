"""A setup that was fitted to captures: a wall of any slopes and texture, and light that moves along."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.config import BESIDE
from evnlos.errors import ConfigError
from evnlos.files import write_atomically
from evnlos.optics import MatrixTransport, MatrixWall, coarsest_keyframe_step_m
from evnlos.optics.angular_spectrum import check_lengths
from evnlos.optics.facets import Pose, SlopeTable, facet_matrix, seen_points
from evnlos.optics.wall import ambient_map, ambient_plane
from evnlos.scene import Ink, Scene, Target
from evnlos.setups.base import Layout, Parameter, Setup, stated_distance_m
from evnlos.setups.files import WALL, WALL_FILE, FittedWall
from evnlos.setups.measured import covered
from evnlos.types import Plane

_COMPANION_CELL_M = 0.01
_FASTER = 1.3  # on a hollow wall a reflection may outrun the target


@Setup.registry.register
@dataclass(frozen=True)
class FittedSetup(Setup):
    """A wall, a camera and a target's way that `evnlos calibrate` fitted to captures."""

    is_linear: ClassVar[bool] = True

    kind: Literal["fitted"] = "fitted"
    """Kind of this setup."""
    file: str = field(default="", metadata=BESIDE)
    """The fitted wall, a .safetensors file of `evnlos calibrate`."""
    checksum: str = ""
    """First 16 digits of the file's SHA-256; empty = not checked."""
    gain: float = 1.0
    """Brightness and exposure of the hidden object over those of the captures; 1 = the same."""
    ambient: float = 0.0
    """Ambient light, mean over the image, white levels."""
    ambient_gradient: tuple[float, float] = (0.0, 0.0)
    """Relative growth of the ambient light to the right and the lower border, on top of the fitted map."""
    slopes: float = 1.0
    """Factor on the slopes of the wall's facets; above 1 = a rougher wall than the fitted one."""
    companion: float = 1.0
    """Factor on the light of what shines beside the target and moves along; 0 = without it."""
    correction: float = 1.0
    """Factor on the correction of the operator that no geometry explains; 0 = without it."""
    camera_distance_m: float = 0.6
    """Distance from camera to the wall's middle, metres."""
    camera_angle_deg: float = 30.0
    """Angle between the optical axis and the wall's normal, towards +x, degrees."""
    camera_elevation_deg: float = 0.0
    """The same towards +y, degrees."""
    camera_roll_deg: float = 0.0
    """Turn of the camera about its axis, degrees."""
    field_of_view_deg: float = 30.0
    """Horizontal field of view, degrees."""
    distortion: float = 0.0
    """Relative growth of a ray's tangent at the image's left and right border."""
    distance_m: float = 0.3
    """Distance from the wall to the middle of the travel, metres."""
    target_offset_m: tuple[float, float] = (0.0, 0.0)
    """Middle of the travel over the wall (x, y), metres."""
    travel_slope: float = 0.0
    """Growth of the target's distance along x, metres per metre."""
    curvature_per_m: tuple[float, float] = (0.0, 0.0)
    """Curvatures of the wall along x and y, 1 / metres; above 0 the borders come nearer."""
    cell_m: float = 0.0025
    """Side of a target cell, metres."""
    strip_m: tuple[float, float] = (0.24, 0.08)
    """Width and height of the region in which the target moves, metres."""
    unexplained: float = 0.0  # pyright: ignore[reportIncompatibleVariableOverride]
    """Share of the light of captures held out that the calibration left beside the noise; 0 = not known."""
    frame_doubt: float = 1.0  # pyright: ignore[reportIncompatibleVariableOverride]
    """By how much the variance of the frames' noise is raised when they are solved for a target, at least 1."""
    ink: Ink = field(default_factory=Ink)  # pyright: ignore[reportIncompatibleVariableOverride]
    """Where the known targets have their ink, which the priors of estimates take over."""

    def fitted(self) -> FittedWall:
        """Return the fitted wall; the file is read once.

        Raises:
            ConfigError: No file is named, or it is another one than the checksum says.
            DataError: The file is missing or damaged.
        """
        if not self.file:
            raise ConfigError("setup.file is empty; give the .safetensors file of `evnlos calibrate`")
        return WALL.load(self.file, self.checksum)

    def kept_in(self, folder: Path, **findings: Any) -> FittedSetup:
        """Return the setup with the wall's file in a folder, and what was found."""
        path = (folder / WALL_FILE).resolve()
        if Path(self.file).resolve() != path:
            write_atomically(path, Path(self.file).read_bytes())
        return replace(self, file=str(path), **findings)

    def pose(self) -> Pose:
        """Return where camera, wall and target are."""
        return Pose(**{one.name: getattr(self, one.name) for one in fields(Pose)})

    def table(self) -> SlopeTable:
        """Return the density of the facets' slopes."""
        table = self.fitted().table
        if not self.slopes > 0:
            raise ConfigError(f"setup.slopes is {self.slopes}; give a factor above 0")
        # Slopes s times as large have the density P(slope / s) / s^2.
        shifted = table.log_density - 2 * math.log(self.slopes)
        return table._replace(log_density=shifted, scale=table.scale * self.slopes)

    def source(self) -> Plane:
        """Return the strip of cells, in the coordinates of the target's motion."""
        check_lengths(cell_m=self.cell_m, strip_width_m=self.strip_m[0], strip_height_m=self.strip_m[1])
        width, height = (max(1, round(side / self.cell_m)) for side in self.strip_m)
        return Plane(height, width, self.cell_m)

    def target_cells(self) -> Plane:
        """Return the cells on which `observe` draws targets."""
        return self.source()

    def transport(self, shape: tuple[int, int] | None = None) -> MatrixTransport:
        """Return the matrix from the strip to a camera image, without `gain`; cached.

        Args:
            shape: Size (H, W) of the image, pixels; None is the sensor's.
        """
        return _transport(self._key(), self.shape if shape is None else shape)

    def operator(
        self, plane: Plane, shape: tuple[int, int] | None = None, dtype: torch.dtype = torch.float64
    ) -> MatrixTransport:
        """Return the matrix from target cells to the camera, gain included.

        Args:
            plane: Cells, in the coordinates of the target's motion.
            shape: Size (H, W) of images to which the sensor's are reduced by area averaging; None: as they are.
            dtype: Floating-point type of the matrix.
        """
        shape = self.shape if shape is None else shape
        if plane == self.source() and dtype == torch.float32:
            kept = self.transport(shape).matrix
            return MatrixTransport(kept if self.gain == 1 else kept * self.gain, plane, shape)
        return MatrixTransport(self.matrix(shape, plane, dtype) * self.gain, plane, shape)

    def matrix(self, shape: tuple[int, int], source: Plane, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Return the matrix from any cells of the target's plane to the camera, without `gain`, [H W, h w].

        Args:
            shape: Size (H, W) of the camera image, pixels.
            source: Cells, in the coordinates of the target's motion.
            dtype: Floating-point type of the result.
        """
        fitted = self.fitted()
        kind = np.float32 if dtype == torch.float32 else np.float64
        aspect = self.sensor.aspect_at(shape)
        tilt = fitted.image("tilt", shape).flatten(1).T.double().numpy() if fitted.tilt.any() else None
        made = facet_matrix(self.pose(), self.table(), shape, source, kind, aspect, tilt)
        matrix = torch.from_numpy(made)
        matrix *= fitted.image("sensitivity", shape).flatten().to(matrix)[:, None]
        if len(fitted.left) and self.correction:
            plane = fitted.about.corrected
            y = covered(plane.y_m, plane.pitch_m, source.y_m, source.pitch_m)
            x = covered(plane.x_m, plane.pitch_m, source.x_m, source.pitch_m)
            weights = torch.from_numpy(fitted.right).double().unflatten(1, plane.shape)
            right = torch.einsum("rij,ik,jl->rkl", weights, y, x).flatten(1)
            left = fitted.image("left", shape).flatten(1)
            matrix += self.correction * (left.T.to(matrix) @ right.to(matrix))
        return matrix

    def ambient_light(self, shape: tuple[int, int] | None = None) -> torch.Tensor:
        """Return the light that is there without the hidden object, white levels, float32 [H, W].

        Args:
            shape: Size (H, W) of the image, pixels; None is the sensor's.
        """
        shape = self.shape if shape is None else shape
        picture = self.fitted().image("ambient", shape).clamp(min=0)
        return ambient_map(picture * ambient_plane(self.ambient, self.ambient_gradient, shape), shape)

    def companion_light(self, places_m: ArrayLike) -> torch.Tensor | None:
        """Return the light of what moves along with the target, where its centre is at places [T, 2], metres.

        White levels, gain included, float32 [T, H, W]; None where nothing shines beside the target.
        """
        along = self._along(self.shape)
        if along is None:
            return None
        carry, picture = along
        assert isinstance(carry.source, Plane)  # it is made from one
        drawn = picture.rasterise(carry.source, np.asarray(places_m, dtype=np.float64))
        return self.gain * carry(torch.from_numpy(drawn))

    def observe(self, scene: Scene) -> MatrixWall:
        """Return the irradiance on the sensor while the scene's target moves.

        Args:
            scene: The target and its motion.

        Raises:
            ConfigError: The target leaves the strip or turns, or a setting is out of range.
        """
        distance_m = stated_distance_m(self, scene)
        if distance_m is not None and distance_m != self.distance_m:
            return self.at_distance(distance_m).observe(scene)
        x = self._check_travel(scene)[:, 0]
        return MatrixWall(
            self.transport(self.shape),
            scene.target,
            scene.motion,
            magnification_px_m=self.magnification_px_m(self.shape),
            gain=self.gain,
            ambient=self.ambient_light(),
            along=self._along(self.shape),
            keyframe_step_m=_keyframe_step_m(self._key(), self.shape, scene.target.size_m),
            travel_m=(float(x.min()) - self.cell_m, float(x.max()) + self.cell_m),  # exposures end later
        )

    def at_distance(self, distance_m: float) -> FittedSetup:
        """Return the setup with its target plane at another distance; what was fitted to one alone is left out.

        Args:
            distance_m: Distance from target plane to wall, metres.
        """
        return replace(self, distance_m=distance_m, correction=0.0)

    def covering(self, size_m: tuple[float, float]) -> FittedSetup:
        """Return the setup with room for a target that moves within a region (width, height), metres."""
        width, height = (max(s, round(float(w), 9)) for s, w in zip(self.strip_m, size_m, strict=True))
        return replace(self, strip_m=(width, height))

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the place of camera and target, the lens's distortion, and the wall's bend."""
        found = [
            Parameter("camera_distance_m", "m", self.camera_distance_m, 0.05, 20.0, 0.005, log=True),
            Parameter("camera_angle_deg", "deg", self.camera_angle_deg, -75.0, 75.0, 0.2),
            Parameter("camera_elevation_deg", "deg", self.camera_elevation_deg, -45.0, 45.0, 0.2),
            Parameter("camera_roll_deg", "deg", self.camera_roll_deg, -45.0, 45.0, 0.2),
            Parameter(
                "field_of_view_deg", "deg", self.field_of_view_deg, 2.0, 120.0, 0.005, True, "magnification"
            ),
            Parameter("distance_m", "m", self.distance_m, 0.02, 20.0, 0.005, log=True),
            Parameter("slopes", "", self.slopes, 0.1, 10.0, 0.02, True, "blur"),
        ]
        for k, axis in enumerate(self.target_offset_m):
            found.append(Parameter(f"target_offset_m.{k}", "m", axis, -10.0, 10.0, 5e-4, role="place"))
        for k, bend in enumerate(self.curvature_per_m):
            found.append(Parameter(f"curvature_per_m.{k}", "1/m", bend, -5.0, 5.0, 0.02))
        found.append(Parameter("distortion", "", self.distortion, -0.3, 0.3, 0.005))
        found.append(Parameter("travel_slope", "m/m", self.travel_slope, -0.5, 0.5, 0.005))
        return tuple(found)

    def steps(self) -> dict[str, tuple[float, bool]]:
        """Return what each step of the fit after pose and slopes took away, and whether it is kept, by name.

        A share of what was left of captures held out, beside their noise; negative where a step did harm.
        """
        notes = self.fitted().about.notes
        kept = notes.get("kept", ())
        return {name: (float(share), name in kept) for name, share in notes.get("explained", {}).items()}

    def wall_description(self) -> str:
        """Return where the wall is from."""
        return f"fitted to captures, {Path(self.file).name or 'no file'}"

    def layout(self) -> Layout:
        """Return where the parts are."""
        angle = math.radians(self.camera_angle_deg)
        camera = (self.camera_distance_m * math.sin(angle), self.camera_distance_m * math.cos(angle))
        columns = np.array([-0.5, self.shape[1] - 0.5])
        rows = np.full(2, (self.shape[0] - 1) / 2)
        ends = seen_points(self.pose(), self.shape, columns, rows).points[:, 0]
        return Layout(
            (self.target_offset_m[0], self.distance_m),
            self.wall_description(),
            camera,
            f"{self.camera_distance_m:.2f} m, {self.camera_angle_deg:.0f} degrees",
            (float(ends.min()), float(ends.max())),
        )

    def bytes_of_a_scene(self, target_m: float) -> int:
        """Return the size of the matrix and of the keyframes, bytes."""
        source = self.source()
        keyframes = 2 * (source.extent_m[1] + target_m) / source.pitch_m
        return 4 * self.shape[0] * self.shape[1] * (source.height * source.width + round(keyframes))

    def magnification_px_m(self, shape: tuple[int, int]) -> float:
        """Return an upper bound of the image motion, pixels per metre of the target's."""
        return _magnification_px_m(self.pose(), shape, self.sensor.aspect_at(shape))

    def _along(self, shape: tuple[int, int]) -> tuple[MatrixTransport, Target] | None:
        """Return matrix and image of what moves along; None where nothing shines beside the target."""
        picture = self.fitted().companion * self.companion
        if not picture.any():
            return None
        side = self.fitted().about.companion.pitch_m * len(picture)
        shown = Target("companion", np.clip(picture, 0, 1).astype(np.float32), side)
        return _companion_transport(self._key(), shape), shown

    def _key(self) -> FittedSetup:
        return replace(self.optics(), companion=1.0, unexplained=0.0, frame_doubt=1.0, ink=Ink())

    def _check_travel(self, scene: Scene) -> NDArray[np.float64]:
        """Return centres along the motion [65, 2], metres; refuse those off the strip."""
        positions = scene.motion.position_m(scene.instants(65))
        reach = np.abs(positions).max(axis=0) + scene.target.size_m / 2
        for name, needed, side in zip(("width", "height"), reach, self.strip_m, strict=True):
            if needed > side / 2 + self.cell_m:
                raise ConfigError(
                    f"the target reaches {needed:.3f} m from the middle of a strip of {name} {side} m; "
                    f"set strip_m to at least {2 * needed:.3f} m there"
                )
        return positions


@lru_cache(maxsize=4)
def _transport(setup: FittedSetup, shape: tuple[int, int]) -> MatrixTransport:
    source = setup.source()
    matrix = setup.matrix(shape, source, torch.float32)
    if not float(matrix.max()) > 0:
        raise ConfigError("the camera receives no light from the target; calibrate again")
    return MatrixTransport(matrix, source, shape)


@lru_cache(maxsize=8)
def _magnification_px_m(pose: Pose, shape: tuple[int, int], pixel_aspect: float) -> float:
    v, u = np.meshgrid(np.arange(shape[0], dtype=float), np.arange(shape[1], dtype=float), indexing="ij")
    sides = []
    for du, dv in ((0.5, 0.0), (0.0, 0.5)):
        after, before = (
            seen_points(pose, shape, u.ravel() + s * du, v.ravel() + s * dv, pixel_aspect) for s in (1, -1)
        )
        sides.append((after.points - before.points)[:, :2])
    smallest = np.linalg.svd(np.stack(sides, axis=-1), compute_uv=False)[:, -1].min()
    bent = any(pose.curvature_per_m)
    return float((_FASTER if bent else 1.0) / smallest)


@lru_cache(maxsize=8)
def _keyframe_step_m(setup: FittedSetup, shape: tuple[int, int], size_m: float) -> float:
    return coarsest_keyframe_step_m(_transport(setup, shape), size_m)


@lru_cache(maxsize=4)
def _companion_transport(setup: FittedSetup, shape: tuple[int, int]) -> MatrixTransport:
    """Return the matrix for light beside the target: larger cells over a larger region."""
    side = setup.fitted().about.companion.pitch_m * len(setup.fitted().companion)
    width, height = setup.strip_m[0] + side, setup.strip_m[1] + side
    rows, columns = (max(1, math.ceil(n / _COMPANION_CELL_M)) for n in (height, width))
    cells = Plane(rows, columns, _COMPANION_CELL_M)
    matrix = replace(setup, correction=0.0).matrix(shape, cells, torch.float32)
    return MatrixTransport(matrix, cells, shape)
