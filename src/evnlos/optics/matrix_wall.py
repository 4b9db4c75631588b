"""The wall under a shift-variant transport: a strip of cells on which the target is drawn, and a matrix.

- A target that moves as a whole, in its plane, or in space: away from the wall, and turning.
- A hidden plane that changes in place: a film.
- Several targets at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from evnlos.errors import ConfigError, DataError
from evnlos.optics.interpolation import spline_coefficients, spline_weights
from evnlos.optics.operator import DEPTH_STEP, DepthTransport, LinearTransport, MatrixTransport
from evnlos.optics.wall import ambient_map, check_gain, checked_times
from evnlos.scene import Film, LineMotion, Motion, Pose, Scene, SeveralTargets, Target
from evnlos.types import Irradiance, Plane

_CHUNK = 64  # positions drawn and carried over at a time
_KEYFRAME_ERROR = 1e-3  # of the light's standard deviation
_GUARD = 3  # keyframes beyond each end of the strip
_TAIL = 10  # keyframes beyond each end of a travel: the prefilter's tail, 0.268^n
_PROBES_S = np.linspace(-100.0, 100.0, 2001)  # does the target ever leave its row?


class MatrixWall:
    """What a light-transport matrix makes of a moving target, at any instant.

    irradiance(t) = gain A s(t) + ambient, with s(t) the target drawn on the strip's cells, each cell the exact
    mean of the mask over it, at any sub-cell position. For motion along the strip's rows the wall is known from
    keyframes: A s is computed at equally spaced positions once and a cubic spline runs between them (exact at
    the keyframes, two continuous derivatives in time); other motions multiply at every instant.

    Args:
        transport: Matrix from the strip to the camera image, in white levels per unit of the mask at gain 1.
        target: The target.
        motion: Where its centre is at every instant; positions off the strip leave the light they lost.
        magnification_px_m: Upper bound of the image motion, pixels per metre of target motion.
        gain: White levels, 0 or more.
        ambient: Light that is always there, white levels: a number or an array [H, W], 0 or more.
        keyframe_step_m: Distance between keyframes, metres; None is half a cell, 0 multiplies at every instant.
        travel_m: Smallest and largest x of the centre that are requested, metres: keyframes are made for these
            alone, and other places multiplied out; None is wherever the target touches the strip.
        along: What else moves with the target's centre and shines with it, and its own matrix.

    Raises:
        ConfigError: The gain, the ambient light or the step is negative or not finite.
        DataError: The ambient array does not have the image's size.
    """

    def __init__(
        self,
        transport: MatrixTransport,
        target: Target,
        motion: Motion,
        *,
        magnification_px_m: float,
        gain: float = 1.0,
        ambient: float | ArrayLike | torch.Tensor = 0.0,
        keyframe_step_m: float | None = None,
        travel_m: tuple[float, float] | None = None,
        along: tuple[MatrixTransport, Target] | None = None,
    ) -> None:
        check_gain(gain)
        strip = transport.source
        if not isinstance(strip, Plane):
            raise ConfigError("the matrix starts from patches; a moving target needs a Plane of square cells")
        step = strip.pitch_m / 2 if keyframe_step_m is None else keyframe_step_m
        if not (math.isfinite(step) and step >= 0):
            raise ConfigError(f"keyframe_step_m is {keyframe_step_m}; give 0 or more metres")
        self.transport = transport
        self._strip = strip
        self.target = target
        self.motion = motion
        self.gain = float(gain)
        self.ambient = ambient_map(ambient, transport.shape).to(transport.matrix.device)
        self._along = along
        self._magnification = magnification_px_m
        self._step = step
        self._keys: torch.Tensor | None = None
        probes = motion.position_m(_PROBES_S)[:, 1]
        self._height = float(probes[0]) if step > 0 and bool((probes == probes[0]).all()) else None
        reach = strip.extent_m[1] / 2 + target.size_m / 2
        everywhere = (strip.center_m[0] - reach, strip.center_m[0] + reach)
        self._everywhere = travel_m is None
        self._travel_m = everywhere if travel_m is None else travel_m

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.transport.shape

    @property
    def speed_px_s(self) -> float:
        """Upper bound of the speed of the image on the sensor, pixels per second."""
        return self.motion.speed_bound_m_s(-math.inf, math.inf) * self._magnification

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return the irradiance at times `t_s`.

        Args:
            t_s: Times, seconds, shape [] or [T].

        Returns:
            White levels, float32 [H, W] or [T, H, W].

        Raises:
            DataError: The times have more than one axis.
        """
        times = checked_times(t_s)
        positions = self.motion.position_m(times).reshape(-1, 2)  # [T, 2]
        light = self._between_keys(positions) if self._has_keys(positions) else self.light(positions)
        image = (self.ambient + self.gain * light.clamp(min=0)).to(torch.float32)  # [T, H, W]
        return image[0] if times.ndim == 0 else image

    def light(self, positions_m: ArrayLike) -> torch.Tensor:
        """Return A s for the target at positions (x, y) [T, 2], metres: the direct product, real [T, H, W]."""
        positions = np.asarray(positions_m, dtype=np.float64)
        matrix = self.transport.matrix
        image = matrix.new_zeros((len(positions), *self.shape))
        for start in range(0, len(positions), _CHUNK):
            drawn = self.target.rasterise(self._strip, positions[start : start + _CHUNK])
            image[start : start + _CHUNK] = self.transport(torch.as_tensor(drawn).to(matrix))
        if self._along is not None:
            image += self.light_along(positions)
        return image

    def light_along(self, positions_m: ArrayLike) -> torch.Tensor:
        """Return the light of what moves along with the target at positions (x, y) [T, 2], real [T, H, W]."""
        positions = np.asarray(positions_m, dtype=np.float64)
        image = self.transport.matrix.new_zeros((len(positions), *self.shape))
        if self._along is None:
            return image
        carry, other = self._along
        assert isinstance(carry.source, Plane)  # a moving image needs square cells
        for start in range(0, len(positions), _CHUNK):
            drawn = other.rasterise(carry.source, positions[start : start + _CHUNK])
            image[start : start + _CHUNK] = carry(torch.as_tensor(drawn).to(image))
        return image

    def _has_keys(self, positions: np.ndarray) -> bool:
        """Return whether keyframes tell the light at all of these places: beyond a strip it is dark."""
        low, high = self._travel_m
        inside = self._everywhere or bool(((positions[:, 0] >= low) & (positions[:, 0] <= high)).all())
        return self._height is not None and inside and bool((positions[:, 1] == self._height).all())

    def _between_keys(self, positions: np.ndarray) -> torch.Tensor:
        if self._keys is None:
            self._keys = self._make_keys()
        # Beyond the last keyframes the target has left the strip, and the wall stays dark.
        at = np.clip((positions[:, 0] - self._first_m) / self._step, 1, len(self._keys) - 3)
        whole = np.minimum(np.floor(at), len(self._keys) - 3).astype(np.int64)
        weight = spline_weights(torch.as_tensor(at - whole)).to(self._keys)  # [4, T]
        light = self._keys.new_zeros((len(positions), *self.shape))
        for k in range(4):
            light += weight[k][:, None, None] * self._keys[torch.as_tensor(whole - 1 + k)]
        return light

    def _make_keys(self) -> torch.Tensor:
        """Return the spline's coefficients at keyframes over all places that are requested."""
        low, high = self._travel_m
        guard = _GUARD if self._everywhere else _TAIL
        steps = math.ceil((high - low) / 2 / self._step) + guard
        self._first_m = (low + high) / 2 - steps * self._step
        x = self._first_m + np.arange(2 * steps + 1) * self._step
        frames = self.light(np.stack([x, np.full_like(x, self._height)], axis=-1))
        return spline_coefficients(frames, axes=(0,))  # periodic: both ends are dark, or far enough


def coarsest_keyframe_step_m(transport: MatrixTransport, size_m: float) -> float:
    """Return the largest distance between keyframes that a wall's blur allows, metres: 2, 1 or 1/2 cells.

    Between keyframes, splines through the light of a target of random squares, an eighth of its side each, may
    be off by 1e-3 of what the light changes by (root mean square); cells bring about half of that themselves.

    Args:
        transport: Matrix from a strip of square cells to the camera image.
        size_m: Side of the target plane, metres.
    """
    strip = transport.source
    assert isinstance(strip, Plane)
    draw = np.random.default_rng(0)
    squares = np.kron(draw.integers(0, 2, (8, 8)), np.ones((8, 8))).astype(np.float32)
    probe = Target("squares", squares, size_m)
    reach = max(0.0, (strip.extent_m[1] - size_m) / 2)
    x = strip.center_m[0] + draw.uniform(-reach, reach, 8)
    places = np.stack([x, np.full(8, strip.center_m[1])], axis=-1)
    for step in (2 * strip.pitch_m, strip.pitch_m):
        motion = LineMotion(start_m=(float(x[0]), strip.center_m[1]))
        wall = MatrixWall(transport, probe, motion, magnification_px_m=1.0, keyframe_step_m=step)
        direct = wall.light(places)
        if float((wall._between_keys(places) - direct).std()) <= _KEYFRAME_ERROR * float(direct.std()):
            return step
    return strip.pitch_m / 2


_TAPS = [math.sqrt(3) * (math.sqrt(3) - 2) ** abs(k) for k in range(-_TAIL, _TAIL + 1)]  # a spline's prefilter
_INSTANTS = 4096  # at which a motion's speed is looked at
_FASTER = 1.02  # what may happen between them


class SpaceWall:
    """What a wall makes of a target that moves in space: sideways, away from the wall, and turning.

    irradiance(t) = U c(t) + ambient, c(t) = C(d(t)) s(t), with s(t) the turned target drawn on the cells. c is
    made at instants between which no point of the target moves more than half a cell, and a cubic spline runs
    between them.

    Args:
        at_distances: The light of cells at any distance from the first to the second, white levels.
        scene: Target and motion.
        pitch_m: Side of the cells, metres.
        distance_m: Distance from target to wall where the motion states none, metres.
        magnification_px_m: Upper bound of the image motion, pixels per metre of target motion.
        ambient: Light that is always there, white levels: a number or an array [H, W], 0 or more.
    """

    def __init__(
        self,
        at_distances: Callable[[float, float, Plane], DepthTransport],
        scene: Scene,
        pitch_m: float,
        distance_m: float,
        magnification_px_m: float,
        ambient: float | ArrayLike | torch.Tensor = 0.0,
    ) -> None:
        self.scene, self._distance_m = scene, distance_m
        # The fastest point of the target; between the instants it may be a little faster.
        x, y, z, turn = self._pose(scene.instants(_INSTANTS))
        reach_m = scene.target.size_m / (math.sqrt(2) if turn.any() else 2)
        moved = np.linalg.norm(np.diff([x, y, z]), axis=0) + reach_m * np.abs(np.diff(turn))
        speed_m_s = _FASTER * float(moved.max()) * (_INSTANTS - 1) / scene.duration_s
        self.speed_px_s = speed_m_s * magnification_px_m
        """Upper bound of the speed of the image on the sensor, pixels per second."""
        self._key_s = min(0.5 * pitch_m / max(speed_m_s, 1e-12), scene.duration_s / 4)
        self._keys: dict[int, torch.Tensor] = {}
        self._samples: dict[int, torch.Tensor] = {}
        beyond_s = (_TAIL + 4) * self._key_s  # of the scene, where its spline's tail lies
        first_s, last_s = scene.instants(2)
        x, y, z, turn = self._pose(np.linspace(first_s - beyond_s, last_s + beyond_s, _INSTANTS))
        sides = [
            (math.floor((one.min() - reach_m) / pitch_m) - 1, math.ceil((one.max() + reach_m) / pitch_m) + 1)
            for one in (x, y)
        ]
        (left, right), (top, bottom) = sides
        middle = ((left + right) / 2 * pitch_m, (top + bottom) / 2 * pitch_m)
        # Whole steps of the distance: scenes alike share their matrices.
        low, high = (f(math.log(d) / DEPTH_STEP) for f, d in ((math.floor, z.min()), (math.ceil, z.max())))
        self.transport = at_distances(
            math.exp(low * DEPTH_STEP),
            math.exp(max(high, low + 1) * DEPTH_STEP),
            Plane(bottom - top, right - left, pitch_m, middle),
        )
        self.ambient = ambient_map(ambient, self.transport.shape)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.transport.shape

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return white levels at times `t_s`, seconds, [] or [T]: float32 [H, W] or [T, H, W].

        Raises:
            DataError: The times have more than one axis.
        """
        times = checked_times(t_s)
        at = times.reshape(-1) / self._key_s
        whole = np.floor(at).astype(np.int64)
        weights = spline_weights(torch.as_tensor(at - whole)).float()  # [4, T]
        found = self.ambient.new_zeros(len(at), self.transport.basis.shape[1])
        for k in range(4):
            if len(at):
                found += weights[k][:, None] * torch.stack([self._key(int(one) - 1 + k) for one in whole])
        light = (found @ self.transport.basis.mT).unflatten(-1, self.shape)
        image = self.ambient + light.clamp(min=0)
        return image[0] if times.ndim == 0 else image

    def light(self, t_s: float) -> torch.Tensor:
        """Return c, [r], at a time, seconds: the direct product."""
        x, y, z, turn = self._pose(t_s)
        drawn = self.scene.target.rasterise(self.transport.source, (float(x), float(y)), float(turn))
        return self.transport.coefficients(float(z)) @ torch.from_numpy(drawn).flatten()

    def _pose(self, t_s: ArrayLike) -> Pose:
        pose = self.scene.pose(t_s)
        return pose._replace(z_m=np.where(np.isnan(pose.z_m), self._distance_m, pose.z_m))

    def _key(self, k: int) -> torch.Tensor:
        """Return coefficient k of the spline in time, [r]."""
        if k not in self._keys:
            around = [self._sample(k + j) for j in range(-_TAIL, _TAIL + 1)]
            self._keys[k] = torch.stack([w * one for w, one in zip(_TAPS, around, strict=True)]).sum(dim=0)
        return self._keys[k]

    def _sample(self, k: int) -> torch.Tensor:
        if k not in self._samples:
            self._samples[k] = self.light(k * self._key_s)
        return self._samples[k]


class FilmWall:
    """What a linear transport makes of a hidden plane that changes in place, at any instant.

    irradiance(t) = A x(t) + ambient, with x(t) the film on the operator's cells.

    Args:
        operator: From the plane's cells [h, w] to white levels of the camera's pixels, gain included
            (`Setup.operator`).
        film: The plane, known at every instant.
        ambient: Light that is always there, white levels: a number or an array [H, W], 0 or more.
        speed_px_s: Upper bound of how fast edges move in the camera's image, pixels per second; an event camera
            chooses its steps by it, frames do not need it.

    Raises:
        ConfigError: The ambient light is negative or not finite.
        DataError: The film does not have the size of the operator's plane, or the ambient light not that of
            the image.
    """

    def __init__(
        self,
        operator: LinearTransport,
        film: Film,
        *,
        ambient: float | ArrayLike | torch.Tensor = 0.0,
        speed_px_s: float = 0.0,
    ) -> None:
        if film.images.shape[1:] != operator.source.shape:
            raise DataError(
                f"the film is {film.images.shape[1:]}, the plane has {operator.source.shape} cells; "
                "make them agree"
            )
        self.operator, self.film = operator, film
        self.ambient = ambient_map(ambient, operator.shape)
        self._speed = float(speed_px_s)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.operator.shape

    @property
    def speed_px_s(self) -> float:
        """Upper bound of the speed of edges in the image, pixels per second, as it was given."""
        return self._speed

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return white levels at times `t_s`, seconds, [] or [T]: float32 [H, W] or [T, H, W]."""
        times = checked_times(t_s)
        light = self.operator(torch.from_numpy(self.film.at(times).astype(np.float64)))
        return (self.ambient + light.clamp(min=0)).to(torch.float32)


class SeveralWall:
    """The light of several targets on the wall, at any instant: the sum of theirs, less what is hidden.

    Args:
        walls: The light of each target alone, with the ambient light.
        scene: The targets.
        ambient: Light that is always there, white levels: a number or an array [H, W], 0 or more.
        operator: Where targets cover each other: from cells of their plane to white levels.
    """

    def __init__(
        self,
        walls: Sequence[Irradiance],
        scene: SeveralTargets,
        ambient: float | ArrayLike | torch.Tensor = 0.0,
        operator: LinearTransport | None = None,
    ) -> None:
        self.walls, self.scene, self.shape, self._operator = walls, scene, walls[0].shape, operator
        self.ambient = ambient_map(ambient, self.shape)
        self.speed_px_s = max(one.speed_px_s for one in walls)
        """Upper bound of the speed of the image on the sensor, pixels per second."""

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        """Return white levels at times `t_s`, seconds, [] or [T]: float32 [H, W] or [T, H, W]."""
        times = checked_times(t_s)
        light = torch.stack([one.irradiance(times) - self.ambient for one in self.walls]).sum(dim=0)
        if self._operator is not None:
            assert isinstance(self._operator.source, Plane)  # whoever made it says so
            hidden = torch.from_numpy(self.scene.hidden(self._operator.source, times))
            light = light - self._operator(hidden).to(light)
        return self.ambient + light.clamp(min=0)
