"""From captures to a fitted setup: search, what the search leaves, and the setup's files."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evnlos.calibration.captures import Shots
from evnlos.calibration.transport_fit import TransportFit
from evnlos.calibration.wall_data import wall_data
from evnlos.calibration.wall_fit import FREEDOMS, WallState, start_at
from evnlos.calibration.wall_rest import WallRest, rest_of
from evnlos.calibration.wall_search import WallSearch, search_wall
from evnlos.setups import FittedSetup, RadiometricSetup, SensorSize
from evnlos.setups.fitted_file import AboutWall, FittedWall, write_fitted
from evnlos.transport.facets import Pose
from evnlos.types import Plane

WALL_FILE = "wall.safetensors"
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
    fit: Shots, held: Shots, start: RadiometricSetup, *, fit_distance: bool = False, columns: int = 60
) -> WallFit:
    """Fit a wall of any kind to captures with known targets.

    Args:
        fit: Captures to fit.
        held: Captures that decide which freedoms stay.
        start: What is known of camera and target; its roughness is the start's.
        fit_distance: Whether the distance of target and wall is hardly known; else to 3 %.
        columns: Columns of the working pictures of the search, pixels.
    """
    known = Pose(
        camera_distance_m=start.camera_distance_m,
        camera_angle_deg=start.camera_angle_deg,
        field_of_view_deg=start.field_of_view_deg,
        distance_m=start.distance_m,
        target_offset_m=start.offset_m(),
    )
    freedoms = tuple(
        replace(f, spread=_FREE_DISTANCE) if f.name == "distance_m" and fit_distance else f for f in FREEDOMS
    )
    plane = travelled(fit, held, _SEARCH_CELL_M)
    search = search_wall(fit, known, freedoms, plane, columns=columns)
    rest = rest_of(fit, held, search.state, plane)
    folder = Path(tempfile.mkdtemp(prefix="evnlos-wall-"))
    strip = travelled(fit, held, _CELL_M).extent_m
    found = _setup(rest.wall, search.state.pose, rest.ambient, folder / WALL_FILE, strip, fit.shape)
    coarse = wall_data(fit, 25, plane, every=8)
    roughness = start.roughness
    first, _ = start_at(coarse, known, np.array([[roughness, start.roughness_y or roughness]]))
    before = _setup(
        _plain(first, plane, fit.shape), known, rest.ambient, folder / "start.safetensors", strip, fit.shape
    )
    every = {p.name: p for p in before.parameters()}
    searched = tuple(every[freedom.name] for freedom in freedoms)
    return WallFit(TransportFit(before, found, searched, search.error), search, rest)


def travelled(fit: Shots, held: Shots, cell_m: float) -> Plane:
    """Return the cells that hold every target of the captures on its way."""
    reach = np.zeros(2)
    for shots in (fit, held):
        for k, scene in enumerate(shots.scenes):
            places = np.abs(scene.motion.position_m(shots.times_s(k))).max(axis=0)
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
