"""The search for a wall: a scan over cameras and plain walls, then refinement of the best few.

- From captures to a fitted setup: search, what the search leaves, and the setup's files.
- How far its frames are to be doubted, from targets of captures held out, and how curved their numbers are.
"""

from __future__ import annotations

import atexit
import difflib
import itertools
import math
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import CaptureSet
from evnlos.calibration.frame_model import FrameNoise
from evnlos.calibration.transport_fit import TransportFit
from evnlos.calibration.wall_fit import (
    FREEDOMS,
    Array,
    Freedom,
    Progress,
    WallData,
    WallState,
    evenly_lit,
    refine,
    start_at,
    uncertainty,
    wall_data,
)
from evnlos.calibration.wall_rest import WallRest, rest_of
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import FrameTerm, SequenceLights, handwritten_prior
from evnlos.machine import note
from evnlos.optics.facets import Pose
from evnlos.scene import Ink
from evnlos.setups import FittedSetup, SensorSize, Setup
from evnlos.setups.files import WALL_FILE, AboutWall, FittedWall, write_fitted
from evnlos.types import Plane


@dataclass(frozen=True, eq=False)
class WallSearch:
    """Where the search for a wall ended.

    Args:
        state: The wall.
        freedoms: The numbers of the pose that were searched, with what was known of them.
        error: Their standard errors, in their own units.
        left: Share of what differs between captures that the wall leaves, 0..1.
    """

    state: WallState
    freedoms: tuple[Freedom, ...]
    error: Array
    left: float


_ANGLES_DEG = (30.0, 15.0, 45.0, 0.0, -30.0)
_VIEWS = (1.0, 0.67, 1.5)
_DISTANCES = (1.0, 0.65, 1.5)
_ROUGH = {f.name: 0.6 * f.spread for f in FREEDOMS}  # a spread below it is a measurement, and is not scanned
_TRIED = 3  # of the scan's best are refined
_COARSE = 25  # columns of the working images of the scan
_CELLS_DOWN = 11  # of the target in the scan
_COARSE_FRAMES, _FINE_FRAMES = 90, 160
_MIRRORED, _LEAST = 0.6, 0.9
_TURNS = {
    "the other way round": ("mirror the frames, or turn the motion's direction", False, True),
    "upside down": ("turn the frames top for bottom", True, False),
    "turned by 180 degrees": ("turn the frames by 180 degrees", True, True),
}
"""How frames may be turned: what cures it, whether rows and whether columns run the other way."""
_CAUTION = 2.0  # on errors: slopes and pose make up for each other further than the linear estimate knows


def search_wall(
    capture_set: CaptureSet, known: Pose, freedoms: Sequence[Freedom], plane: Plane, *, columns: int = 60
) -> WallSearch:
    """Find the wall and the pose that explain the frames of captures with known targets.

    A scan over angles, views and distances with walls of GGX lobes gives the starts; each is refined on small
    images, the best on larger ones. Light that all captures share at a place takes no part: the ambient
    light, and whatever else moves along.

    Args:
        capture_set: The captures.
        known: What is known of the pose.
        freedoms: The numbers that are searched, with how well they are known.
        plane: Cells of the targets' images, over the whole travel.
        columns: Columns of the working images of the last stage, pixels.

    Raises:
        DataError: No pose explains more than a twentieth of the frames, or mirrored ones are explained better.
    """
    side = max(plane.pitch_m, plane.extent_m[0] / _CELLS_DOWN)
    rows = max(1, round(plane.extent_m[0] / side))
    side = plane.extent_m[0] / rows
    wide = Plane(rows, math.ceil(plane.extent_m[1] / side - 1e-9), side)
    frames = sum(len(capture.frames) for capture in capture_set.captures)
    coarse = wall_data(capture_set, _COARSE, wide, every=max(1, frames // _COARSE_FRAMES))
    quick: list[tuple[Progress, Pose]] = []
    first = [freedom for freedom in freedoms if not freedom.fine]
    for state in _scanned(coarse, known, freedoms)[:_TRIED]:
        prior = replace(known, target_offset_m=state.pose.target_offset_m)
        quick.append((refine(coarse, state, prior=prior, freedoms=first, iterations=8), prior))
    quick.sort(key=lambda one: one[0].cost())
    best, prior = quick[0]
    fine = wall_data(capture_set, columns, plane, every=max(1, frames // _FINE_FRAMES), checkered=True)
    found = refine(fine, best.state, prior=prior, freedoms=freedoms, iterations=12)
    error = uncertainty(fine, found.state, prior=prior, freedoms=freedoms)
    weights = np.array([math.exp(-0.5 * (one.cost() - best.cost())) for one, _ in quick])
    weights /= weights.sum()
    errors = []
    for freedom, e in zip(freedoms, error, strict=True):
        scale = freedom.read(found.state.pose) if freedom.log else 1.0
        away = np.array([freedom.read(one.state.pose) - freedom.read(best.state.pose) for one, _ in quick])
        errors.append(_CAUTION * math.hypot(e * scale, math.sqrt(float(weights @ away**2))))
    return WallSearch(found.state, tuple(freedoms), np.array(errors), found.left)


def _scanned(data: WallData, known: Pose, freedoms: Sequence[Freedom]) -> list[WallState]:
    """Return the walls of GGX lobes at all poses of the scan, the best first.

    What somebody has measured is not scanned: it stays at its value.
    """
    measured = {f.name for f in freedoms if f.spread < _ROUGH.get(f.name, 0.0)}
    angles = (known.camera_angle_deg,) if "camera_angle_deg" in measured else _ANGLES_DEG
    views = (1.0,) if "field_of_view_deg" in measured else _VIEWS
    distances = (1.0,) if "camera_distance_m" in measured else _DISTANCES
    turned = {how: replace(data, seen=data.seen[_turned(data, *sides)]) for how, (_, *sides) in _TURNS.items()}
    tried: list[tuple[float, WallState]] = []
    other = dict.fromkeys(turned, math.inf)
    for angle, view, away in itertools.product(angles, views, distances):
        note(f"camera at {angle:g} degrees, {view:g} x the view, {away:g} x the distance")
        middle = -known.distance_m * math.tan(math.radians(angle))
        if "target_offset_m.0" in measured:
            middle = known.target_offset_m[0]
        pose = replace(
            known,
            camera_angle_deg=angle,
            field_of_view_deg=known.field_of_view_deg * view,
            camera_distance_m=known.camera_distance_m * away,
            target_offset_m=(middle, known.target_offset_m[1]),
        )
        try:
            state, left = start_at(data, pose)
            for how in turned if view == away == 1.0 else ():
                other[how] = min(other[how], start_at(turned[how], pose)[1])
        except ConfigError:  # this camera sees past the wall
            continue
        tried.append((left, state))
    if not tried:
        raise DataError("no camera near the start sees the wall; give a start that is nearer to the setup")
    tried.sort(key=lambda one: one[0])
    least = tried[0][0]
    likeliest = min(other, key=lambda how: other[how])
    if other[likeliest] < _MIRRORED * least:
        raise DataError(f"the frames follow the targets {likeliest}; {_TURNS[likeliest][0]}")
    if least > _LEAST:
        raise DataError(
            f"the targets explain {100 * (1 - math.sqrt(least)):.0f} % of what differs between captures, below "
            f"{100 * (1 - math.sqrt(_LEAST)):.0f} %; check the motion's start, speed and direction, or start "
            "nearer to the setup"
        )
    return [state for _, state in tried]


def _turned(data: WallData, upside_down: bool, mirrored: bool) -> NDArray[np.int64]:
    """Return the pixel that each one is in a turned image; itself where that takes no part."""
    row, column = np.divmod(data.pixel, data.grid[1])
    row = data.grid[0] - 1 - row if upside_down else row
    column = data.grid[1] - 1 - column if mirrored else column
    wanted = row * data.grid[1] + column
    at = np.minimum(np.searchsorted(data.pixel, wanted), len(data.pixel) - 1)
    return np.where(data.pixel[at] == wanted, at, np.arange(len(at)))


_SEARCH_CELL_M = 0.005
_CELL_M = 0.0025
_FREE_DISTANCE = 0.3


@dataclass(frozen=True, eq=False)
class WallFit:
    """A fitted setup and how it came about.

    Args:
        optics: The setup, its start and its errors.
        search: Where the search ended.
        rest: What pose and slopes leave.
    """

    optics: TransportFit
    search: WallSearch
    rest: WallRest


def fit_wall(
    fit: CaptureSet,
    held: CaptureSet,
    start: Setup,
    *,
    fit_distance: bool = False,
    measured: Mapping[str, tuple[float, float]] | None = None,
    columns: int = 60,
) -> WallFit:
    """Fit a wall of any kind to captures with known targets.

    Args:
        fit: Captures to fit.
        held: Captures that decide which freedoms stay.
        start: Its `wall_start` is what is known of camera and target, and the start's roughness.
        fit_distance: Whether the distance of target and wall is hardly known; else to 3 %.
        measured: Name of a freedom -> its value and standard deviation, as somebody has measured them.
        columns: Columns of the working images of the search, pixels.
    """
    begin = start.wall_start()
    if begin is None:
        raise ConfigError(f"a wall of any kind is fitted from a setup of kind radiometric, not {start.kind!r}")
    known, *roughness = begin
    freedoms = tuple(
        replace(f, spread=_FREE_DISTANCE) if f.name == "distance_m" and fit_distance else f for f in FREEDOMS
    )
    known, freedoms = with_measured(known, freedoms, measured or {})
    plane = travelled(fit, held, _SEARCH_CELL_M)
    search = search_wall(fit, known, freedoms, plane, columns=columns)
    fit, held = (evenly_lit(one, search.state, plane) for one in (fit, held))
    rest = rest_of(fit, held, search.state, plane)
    folder = Path(tempfile.mkdtemp(prefix="evnlos-wall-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)  # the setup is read from it until it is saved
    strip = travelled(fit, held, _CELL_M).extent_m
    found = _setup(rest.wall, search.state.pose, rest.ambient, folder / WALL_FILE, strip, fit.shape)
    coarse = wall_data(fit, 25, plane, every=8)
    first, _ = start_at(coarse, known, np.array([roughness]))
    before = _setup(
        _plain(first, plane, fit.shape), known, rest.ambient, folder / "start.safetensors", strip, fit.shape
    )
    before = replace(before, cell_m=_SEARCH_CELL_M)  # what the fit is compared with, and nothing else
    every = {p.name: p for p in before.parameters()}
    searched = tuple(every[freedom.name] for freedom in freedoms)
    return WallFit(TransportFit(before, found, searched, search.error), search, rest)


def check_measured(measured: Mapping[str, tuple[float, float]]) -> None:
    """Refuse measurements of what is no freedom of a wall's pose, and values that cannot be.

    Args:
        measured: Name of a freedom -> its value and standard deviation, in its unit.

    Raises:
        ConfigError: A name is unknown (the nearest is named), or a value or deviation cannot be.
    """
    known = {freedom.name: freedom for freedom in FREEDOMS}
    for name, (value, error) in measured.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1) or list(known)
            raise ConfigError(f"measured.{name} is unknown; give {' or '.join(near)}")
        if not (math.isfinite(value) and math.isfinite(error) and error > 0):
            raise ConfigError(
                f"measured.{name} is {value} +- {error}; give a value and a standard deviation above 0"
            )
        if known[name].log and value <= 0:
            raise ConfigError(f"measured.{name} is {value} {known[name].unit}; give a value above 0")


def with_measured(
    known: Pose, freedoms: Sequence[Freedom], measured: Mapping[str, tuple[float, float]]
) -> tuple[Pose, tuple[Freedom, ...]]:
    """Return the pose and the freedoms with what somebody has measured as their priors.

    Args:
        known: What is known of the pose otherwise.
        freedoms: The numbers that are searched.
        measured: Name of a freedom -> its value and standard deviation, in its unit.

    Raises:
        ConfigError: A name is unknown, or a value or deviation cannot be.
    """
    check_measured(measured)
    spreads = {}
    for freedom in freedoms:
        if freedom.name in measured:
            value, error = measured[freedom.name]
            known = freedom.into(known, value)
            spreads[freedom.name] = error / value if freedom.log else error
    return known, tuple(replace(f, spread=spreads.get(f.name, f.spread)) for f in freedoms)


def travelled(fit: CaptureSet, held: CaptureSet, cell_m: float) -> Plane:
    """Return the cells that hold every target of the captures on its way."""
    reach = np.zeros(2)
    for capture_set in (fit, held):
        for k, scene in enumerate(capture_set.scenes):
            places = np.abs(scene.motion.position_m(capture_set.times_s(k))).max(axis=0)
            reach = np.maximum(reach, places + scene.target.size_m / 2)
    columns, rows = (max(1, math.ceil(2 * float(side) / cell_m - 1e-6)) for side in reach)
    return Plane(rows, columns, cell_m)


def _setup(
    wall: FittedWall,
    pose: Pose,
    ambient: float,
    path: Path,
    strip_m: tuple[float, float],
    shape: tuple[int, int],
) -> FittedSetup:
    return FittedSetup(
        file=str(path),
        checksum=write_fitted(path, wall),
        ambient=ambient,
        cell_m=_CELL_M,
        strip_m=(strip_m[1], strip_m[0]),
        sensor=SensorSize(*shape),
        **{name: getattr(pose, name) for name in pose.__dataclass_fields__},
    )


def _plain(state: WallState, plane: Plane, shape: tuple[int, int]) -> FittedWall:
    table = state.table
    one = np.ones(shape, np.float32)
    about = AboutWall(table.scale, table.step, table.matte, Plane(1, 1, 0.01), plane)
    empty = np.zeros((0, *shape), np.float32), np.zeros((0, plane.height * plane.width), np.float32)
    return FittedWall(table.log_density, one, one, np.zeros((1, 1), np.float32), *empty, about)


FACTORS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""By how much the variance of the frames' noise may be raised."""
_GRID, _CELLS = (50, 80), 32  # pixels on which captures are solved, and cells of the target


def frame_doubt(held: CaptureSet, setup: Setup, noise: FrameNoise) -> float:
    """Return by how much the variance of the frames' noise is to be raised when they are solved for a target.

    What a light path gets wrong moves with the target and does not average over frames and pixels, as noise
    does. The factor has the least squared error of the best linear estimate of targets of captures held out.

    Args:
        held: Captures with known targets, which the light path was not fitted to.
        setup: The fitted setup, linear.
        noise: The frame camera's noise and pattern.
    """
    grid = (min(held.shape[0], _GRID[0]), min(held.shape[1], _GRID[1]))
    together = held.shape[0] * held.shape[1] / (grid[0] * grid[1])  # pixels whose mean is one of the grid
    plane = Plane(_CELLS, _CELLS, held.target_size_m / _CELLS)
    prior = handwritten_prior(plane, ink=Ink.of(scene.target for scene in held.scenes))
    errors, lights = np.zeros(len(FACTORS)), SequenceLights()
    for k, (capture, scene) in enumerate(zip(held.captures, held.scenes, strict=True)):
        span_s = (float((times_s := held.times_s(k))[0]), float(times_s[-1]))
        light = lights.of(setup, prior, scene.motion, span_s, grid)
        frames = noise.pattern.correct(capture.frames, held.peak)
        values = np.asarray(reduce_by_area(frames, grid), np.float64).reshape(len(frames), -1)
        told = FrameTerm(light, values, times_s, noise.camera, known_pattern=True).normal
        truth = scene.target.rasterise(plane)
        for n, factor in enumerate(FACTORS):
            information = told.information * (together / factor)
            z: Any = np.linalg.solve(np.eye(prior.count) + information, told.score * (together / factor))
            errors[n] += float(np.square(prior.image(z) - truth).sum())
    return FACTORS[int(errors.argmin())]


def curvature(frames: NDArray, light: NDArray) -> tuple[float, float]:
    """Return how curved a camera's numbers are over light, and the share of the misfit that this explains.

    Of numbers y = g(E) it is c = E g'' / g': 0 of a linear camera, about -0.6 of sRGB, -1 of a logarithm. What
    a line of slope k leaves of a pixel's y is c k / (2 E) times what it leaves of (E - mean)^2. The half of the
    pixels whose light changes most count, as far as nothing of them is clipped.

    Args:
        frames: Numbers, 1 = white, [N, H, W].
        light: Light that a fit expects, [N, H, W], of any unit.
    """
    y, e = (np.asarray(one, np.float64).reshape(len(one), -1) for one in (frames, light))
    change, left = e - e.mean(axis=0), y - y.mean(axis=0)
    power = np.square(change).sum(axis=0)
    used = (power >= np.median(power)) & (power > 0) & (y.max(axis=0) < 0.98) & (e.mean(axis=0) > 0)
    change, left, power, level = change[:, used], left[:, used], power[used], e.mean(axis=0)[used]
    slope = (change * left).sum(axis=0) / power
    left -= slope * change
    square = np.square(change) - np.square(change).mean(axis=0)
    square -= (square * change).sum(axis=0) / power * change
    square *= slope / (2 * level)
    found = float((square * left).sum() / max(np.square(square).sum(), 1e-30))
    return found, found**2 * float(np.square(square).sum() / max(np.square(left).sum(), 1e-30))


def curve_warning(found: tuple[float, float]) -> list[str]:
    """Return what to state of frames whose numbers are curved over the light, a line; none where they are not.

    Args:
        found: What `curvature` returned.
    """
    if abs(bent := found[0]) < 0.4 or found[1] < 0.1:  # of linear frames -0.05 and 0.01 at most, in 5 rooms
        return []
    what = (
        f"frames: their numbers are curved over the light ({bent:+.1f}; linear is 0, sRGB -0.6, a logarithm -1)"
    )
    cure = "state camera: {tone: srgb} in capture.yaml, or camera.log of logarithmic pixels, or record raw"
    return [f"{what}; {cure if bent < 0 else 'leave camera.tone and camera.log out'}"]
