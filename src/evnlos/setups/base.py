"""What every setup is: wall, geometry, ambient light and cameras in one object, and the family of its kinds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.cameras import EventCamera, EventPixel, FrameCamera, FrameCameraSettings, PixelSettings
from evnlos.cameras.frame_camera import SensorSize
from evnlos.errors import ConfigError
from evnlos.optics import DepthTransport, LinearTransport, SeveralWall
from evnlos.optics.facets import Pose
from evnlos.optics.wall import ambient_plane
from evnlos.registry import Kinded, Registry
from evnlos.scene import Ink, Scene, SeveralTargets
from evnlos.setups.files import Layout, Measurement, OperatorNoise, Parameter
from evnlos.types import Irradiance, Plane

S = TypeVar("S", bound="Setup")

CAMERA_FIELDS = ("sensor", "frame_camera", "pixel", "time_step_s")
"""Settings of a setup that its cameras state: all but wall, geometry and light."""
LIGHT_FIELDS = ("gain", "ambient", "ambient_gradient")
"""Settings of a setup's light: they scale and add up, and change no geometry."""
_PROBES = 65  # instants at which a scene's pose is looked at
LEAST_ERROR = 0.01
"""Share of the light that any setup is taken to get wrong; no target is told by less of it."""
_WORSE = 2.0  # of one recording's share that its setup gets wrong, over that of all captures held out
_SAME_ASPECT = 0.03  # difference of logarithms: images of whole pixels hardly keep a sensor's ratio


@dataclass(frozen=True)
class Setup(Kinded, ABC):
    """Wall, geometry, ambient light and cameras: all that lies between a hidden scene and its recording.

    Derive a kind from it as a frozen dataclass with a literal field `kind`, give it `observe`, and
    `Setup.registry.register` it (or name it in a package's entry points, group `evnlos.setups`): all commands
    take it by its kind. `operator` makes solvers and identifiability work with it, `parameters` calibration.

    The distance of the target and its pose belong to the scene (`Motion.pose`). Where a scene states no
    distance, the setup's own, `default_distance_m`, holds.
    """

    registry: ClassVar[Registry[Any]] = Registry("evnlos.setups", "setup")
    default_kind: ClassVar[str] = "paper"
    is_linear: ClassVar[bool] = False
    """Whether the kind has an `operator`."""
    is_lit: ClassVar[bool] = False
    """Whether a setup of this kind that is called by its name states light and cameras, too."""
    artifact: ClassVar[str] = ""
    """What the kind's model adds to a real wall, in words; see `without_artifacts`."""
    unexplained: ClassVar[float] = 0.0
    """Share of the light that the setup gets wrong; 0 = not known. A calibrated setup has it as a setting."""
    frame_doubt: ClassVar[float] = 1.0
    """By how much the variance of the frames' noise is raised when they are solved; as a setting likewise."""
    ink: ClassVar[Ink] = Ink()
    """Where the known targets have their ink; likewise."""

    kind: str = ""
    """Kind of this setup."""
    gain: float = 1.0
    """White levels per unit of the target's light on the wall."""
    ambient: float = 0.05
    """Ambient light in the middle of the image, white levels."""
    ambient_gradient: tuple[float, float] = (0.0, 0.0)
    """Relative growth of the ambient light from the middle to the right and the lower border."""
    sensor: SensorSize = field(default_factory=SensorSize)
    """Size of the sensor."""
    frame_camera: FrameCameraSettings = field(default_factory=FrameCamera)
    """The frame camera."""
    pixel: PixelSettings = field(default_factory=EventPixel)
    """The event model and its parameters: kind continuous, v2e, or another that is registered."""
    time_step_s: float | None = None
    """Time step at which the event pixels see the light, seconds, for a model whose events depend on it (v2e);
    None = the event camera chooses its steps from the motion."""
    misfit: str = ""
    """What `evnlos calibrate` warned of when it fitted the setup; empty = nothing, or it was not fitted."""

    @abstractmethod
    def observe(self, scene: Scene) -> Irradiance:
        """Return the irradiance on the cameras' pixels while the scene's target moves, at any instant.

        Args:
            scene: The target and its motion; its pose states the distance, or leaves it to the setup.

        Returns:
            An object with `irradiance(t_s)` -> white levels, float32 [T, H, W], `shape` and `speed_px_s`.

        Raises:
            ConfigError: The setup can't show this scene, or a setting is out of range.
        """

    def observe_all(self, scene: Scene | SeveralTargets) -> Irradiance:
        """Return `observe` of a scene of one or several targets.

        Raises:
            ConfigError: As for `observe`; or targets cover each other, and the setup draws none on cells.
        """
        walls, operator = [self.observe(one) for one in scene.scenes], None
        if len(walls) == 1:
            return walls[0]
        assert isinstance(scene, SeveralTargets)
        if scene.cover:
            if (cells := self.target_cells()) is None:
                raise ConfigError(
                    f"the setup {self.kind!r} draws no targets on cells, so none covers another; let light "
                    f"add (cover: false), or give a setup of kind {' or '.join(linear_kinds())}"
                )
            operator = self.operator(cells, dtype=torch.float32)
        return SeveralWall(walls, scene, self.ambient_light(), operator)

    def operator(
        self, plane: Plane, shape: tuple[int, int] | None = None, dtype: torch.dtype = torch.float64
    ) -> LinearTransport:
        """Return the linear map from the brightness of target cells to white levels of pixels, with adjoint.

        Args:
            plane: Cells of the target plane, in the coordinates of the target's motion.
            shape: Size (H, W) of images to which the sensor's are reduced by area averaging; None: as they are.
            dtype: Floating-point type of the map.

        Returns:
            The map without ambient light, gain included: images [..., h, w] to [..., H, W].

        Raises:
            ConfigError: The setup is not linear, or does not reach these cells.
        """
        raise ConfigError(
            f"the setup {self.kind!r} is not linear: it has no operator; give one of kind "
            f"{' or '.join(linear_kinds())}"
        )

    def matrix(self, shape: tuple[int, int], source: Plane, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Return the matrix of `operator` up to one factor, [H W, h w]: enough for searches that fit the gain.

        Args:
            shape: Size (H, W) of the image, pixels.
            source: Cells of the target plane, in the coordinates of the target's motion.
            dtype: Floating-point type of the matrix.
        """
        return self.operator(source, shape, dtype).dense(dtype)

    def target_cells(self) -> Plane | None:
        """Return the cells on which `observe` draws targets; None where it draws them in another way."""
        return None

    def linear_part(self, plane: Plane) -> LinearTransport:
        """Return `operator`, or for a setup that is not linear its linear part, where it has one.

        Args:
            plane: Cells of the target plane, in the coordinates of the target's motion.

        Raises:
            ConfigError: The setup has no linear part.
        """
        return self.operator(plane)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the cameras' images, pixels."""
        return self.sensor.shape

    @property
    def event_camera(self) -> EventCamera:
        """The event camera: an array of these pixels, at this time step."""
        return EventCamera(self.pixel, time_step_s=self.time_step_s)

    @property
    def recording_error(self) -> float:
        """Share of the light of one recording that is taken to be wrong: twice `unexplained`, 1 % at least."""
        return max(_WORSE * self.unexplained, LEAST_ERROR)

    @property
    def default_distance_m(self) -> float | None:
        """Distance from target plane to wall where a scene states none, metres; None where nobody knows it."""
        return getattr(self, "distance_m", None)

    def ambient_light(self, shape: tuple[int, int] | None = None) -> torch.Tensor:
        """Return the light that is there without the target, white levels, float32 [H, W].

        Args:
            shape: Size (H, W) of the image, pixels; None is the sensor's.
        """
        return ambient_plane(self.ambient, self.ambient_gradient, self.shape if shape is None else shape)

    def companion_light(self, places_m: ArrayLike) -> torch.Tensor | None:
        """Return what moves along with a target at places [T, 2] adds, white levels [T, H, W], if any."""
        return None

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the numbers of wall and geometry that frames decide; none where a setup has none to fit."""
        return ()

    def with_parameters(self: S, values: Mapping[str, float]) -> S:
        """Return the setup with other values of some of its parameters, by their dotted names.

        Raises:
            ConfigError: A name is none of the setup's settings, or a value is out of range.
        """
        made: Any = self
        for name, value in values.items():
            made = _replaced(made, name.split("."), float(value), name)
        return made

    def describe(self) -> str:
        """Return kind, wall and parameters in one line."""
        numbers = (f"{one.name} {one.value:.4g} {one.unit}".rstrip() for one in self.parameters())
        return f"{self.kind}: {', '.join([self.wall_description(), *numbers])}"

    def warnings(self) -> list[str]:
        """Return what is known to be wrong with this setup, a line each; whoever uses it repeats them."""
        return [f"the calibration of this setup warns: {self.misfit}"] if self.misfit else []

    def steps(self) -> dict[str, tuple[float, bool]]:
        """Return what each step of the setup's fit explains, and whether it is kept, by name; here none."""
        return {}

    def wall_start(self) -> tuple[Pose, float, float] | None:
        """Return camera and target, and the wall's roughness along x and y, that a fit of any wall begins with.

        None where the kind states none.
        """
        return None

    def kept_in(self: S, folder: Path, **findings: Any) -> S:
        """Return the setup with its files in a folder, and with what a calibration found.

        Args:
            folder: The folder.
            findings: Settings by name; a kind that has none of them leaves them out.
        """
        return self

    def wall_description(self) -> str:
        """Return what the wall is, in a few words."""
        return f"wall of a {self.kind} setup"

    def layout(self) -> Layout | None:
        """Return where the parts are, for a drawing to scale; None where that is not known."""
        return None

    def optical_values(self, target_m: float) -> dict[str, float]:
        """Return what the optics do to a target of side `target_m` metres, by name; empty where not known."""
        return {}

    def at_distance(self: S, distance_m: float) -> S:
        """Return the setup with its target plane at another distance from the wall, nothing else moved.

        Args:
            distance_m: Distance from target plane to wall, metres.

        Raises:
            ConfigError: The setup knows one distance only.
        """
        raise ConfigError(
            f"the setup {self.kind!r} shows one target plane only, not one at {distance_m:g} m; "
            "leave the distance of the motion out, or give a setup of kind radiometric"
        )

    def at_distances(
        self, low_m: float, high_m: float, plane: Plane, shape: tuple[int, int] | None = None
    ) -> DepthTransport:
        """Return `operator` of the plane at any distance in a range, with the exposure of the setup's own.

        Args:
            low_m: Smallest distance, metres.
            high_m: Largest distance, metres.
            plane: Cells of the target plane, in the coordinates of the target's motion.
            shape: Size (H, W) of the images, pixels; None is the sensor's.
        """
        if self.default_distance_m is None:
            raise ConfigError(f"the setup {self.kind!r} states no distance; follow without depth")
        return _at_distances(self, low_m, high_m, plane, self.shape if shape is None else shape)

    def covering(self: S, size_m: tuple[float, float]) -> S:
        """Return the setup with room for a target that moves within a region (width, height), metres."""
        return self

    def coarsened(self: S, factor: float = 1.0) -> S:
        """Return the setup with the coarsest target cells that its blur allows, times a factor."""
        return self

    def without_artifacts(self: S) -> S | None:
        """Return the setup without what its model adds to a real wall; None where it adds nothing known."""
        return None

    def operator_noise(self, plane: Plane, seed: int = 0) -> OperatorNoise | None:
        """Return the noise of `operator`; None where the operator is computed, not measured.

        Args:
            plane: Cells of the target plane.
            seed: Seed of the draw.
        """
        return None

    def bytes_of_a_scene(self, target_m: float) -> int:
        """Return about how much memory `observe` takes for a target of side `target_m` metres, bytes."""
        return 16 * self.shape[0] * self.shape[1]

    def measurement(self) -> Measurement:
        """Return the scan that the setup was measured by; ConfigError where it was not."""
        raise ConfigError(
            f"the setup is of kind {self.kind!r}; images need a measured one (evnlos scan), captures are "
            "folders"
        )

    def resized(self: S, shape: tuple[int, int]) -> S:
        """Return the setup with another size (H, W) of its sensor, pixels, over the same part of the wall."""
        return replace(self, sensor=self.sensor.resized(shape))

    def seen_by(self: S, shape: tuple[int, int]) -> S:
        """Return the setup before a camera with images of a size (H, W), pixels; another one has square ones.

        Images whose sides have the ratio of the sensor's are taken for its own, averaged.
        """
        other = self.sensor.aspect_at(shape)
        is_own = abs(math.log(other / self.sensor.pixel_aspect)) < _SAME_ASPECT
        return self.resized(shape) if is_own else replace(self, sensor=SensorSize(*shape))

    def with_cameras_of(self: S, other: Setup) -> S:
        """Return this wall, geometry and light with the sensor and the cameras of another setup."""
        return replace(self, **{name: getattr(other, name) for name in CAMERA_FIELDS})

    def optics(self: S) -> S:
        """Return wall and geometry alone, with default light and cameras: equal where the light paths are."""
        fresh = type(self)()
        own = replace(self, **{k: getattr(fresh, k) for k in (*LIGHT_FIELDS, *CAMERA_FIELDS, "misfit")})
        return replace(own, sensor=self.sensor.resized(fresh.shape))


def is_camera(path: str) -> bool:
    """Return whether a dotted path, from a setup or from what holds it, names a setting of its cameras."""
    return path.removeprefix("setup.").partition(".")[0] in CAMERA_FIELDS


def linear_kinds() -> list[str]:
    """Return the kinds of setups that have an operator."""
    return [kind for kind in Setup.registry if Setup.registry[kind].is_linear]


def stated_distance_m(setup: Setup, scene: Scene) -> float | None:
    """Return the one distance that a scene states, for setups whose target plane rests; None: the setup's own.

    Args:
        setup: The setup, for the message.
        scene: The scene.

    Raises:
        ConfigError: The target turns, approaches or retreats.
    """
    pose = scene.pose(scene.instants(_PROBES))
    if np.any(pose.rotation_rad != 0):
        most = float(np.degrees(np.abs(pose.rotation_rad).max()))
        raise ConfigError(
            f"the motion turns the target by {most:.3g} degrees, which the setup {setup.kind!r} can't show; "
            "give one without rotation, or a setup of kind radiometric"
        )
    stated = pose.z_m[~np.isnan(pose.z_m)]
    if not len(stated):
        return None
    low, high = float(stated.min()), float(stated.max())
    if low != high or len(stated) != len(pose.z_m):
        raise ConfigError(
            f"the motion takes the target from {low:g} to {high:g} m from the wall, the setup {setup.kind!r} "
            "shows one target plane; give a constant z_m, or a setup of kind radiometric"
        )
    return low


@lru_cache(maxsize=4)
def _at_distances(
    setup: Setup, low_m: float, high_m: float, plane: Plane, shape: tuple[int, int]
) -> DepthTransport:
    cell, own = Plane(1, 1, plane.pitch_m, plane.center_m), setup.at_distance(setup.default_distance_m or 1.0)
    scale = own.operator(cell, shape).dense().sum() / own.matrix(shape, cell).sum()
    light = lambda z_m: scale * setup.at_distance(z_m).matrix(shape, plane)  # noqa: E731
    return DepthTransport(light, low_m, high_m, plane, shape)


def _replaced(node: Any, keys: list[str], value: float, name: str) -> Any:
    if not keys:
        return value
    key, rest = keys[0], keys[1:]
    if key.isdigit() and isinstance(node, tuple) and int(key) < len(node):
        items: Any = list(node)
        items[int(key)] = _replaced(node[int(key)], rest, value, name)
        return tuple(items)
    if not hasattr(node, key):
        raise ConfigError(f"the setup has no parameter {name!r}; its parameters() names them")
    settings: Any = node
    return replace(settings, **{key: _replaced(getattr(node, key), rest, value, name)})
