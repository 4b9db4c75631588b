"""The search for a wall: a scan over cameras and plain walls, then refinement of the best few."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
from evnlos.calibration.wall_data import Array, WallData, wall_data
from evnlos.calibration.wall_fit import Freedom, Progress, WallState, refine, start_at, uncertainty
from evnlos.errors import ConfigError, DataError
from evnlos.transport.facets import Pose
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
_TRIED = 3  # of the scan's best are refined
_COARSE = 25  # columns of the working pictures of the scan
_CELLS_DOWN = 11  # of the plate in the scan
_COARSE_FRAMES, _FINE_FRAMES = 90, 160
_MIRRORED, _LEAST = 0.6, 0.9
_CAUTION = 2.0  # on errors: slopes and pose make up for each other further than the linear estimate knows


def search_wall(
    shots: Shots, known: Pose, freedoms: Sequence[Freedom], plane: Plane, *, columns: int = 60
) -> WallSearch:
    """Find the wall and the pose that explain the frames of captures with known targets.

    A scan over angles, views and distances with walls of GGX lobes gives the starts; each is refined on small
    pictures, the best on larger ones. Light that all captures share at a place takes no part: the ambient
    light, and whatever else moves along.

    Args:
        shots: The captures.
        known: What is known of the pose.
        freedoms: The numbers that are searched, with how well they are known.
        plane: Cells of the targets' pictures, over the whole travel.
        columns: Columns of the working pictures of the last stage, pixels.

    Raises:
        DataError: No pose explains more than a twentieth of the frames, or mirrored ones are explained better.
    """
    side = max(plane.pitch_m, plane.extent_m[0] / _CELLS_DOWN)
    rows = max(1, round(plane.extent_m[0] / side))
    side = plane.extent_m[0] / rows
    wide = Plane(rows, math.ceil(plane.extent_m[1] / side - 1e-9), side)
    frames = sum(len(capture.frames) for capture in shots.captures)
    coarse = wall_data(shots, _COARSE, wide, every=max(1, frames // _COARSE_FRAMES))
    quick: list[tuple[Progress, Pose]] = []
    for state in _scanned(coarse, known)[:_TRIED]:
        prior = replace(known, target_offset_m=state.pose.target_offset_m)
        quick.append((refine(coarse, state, prior=prior, freedoms=freedoms, iterations=8), prior))
    quick.sort(key=lambda one: one[0].cost())
    best, prior = quick[0]
    fine = wall_data(shots, columns, plane, every=max(1, frames // _FINE_FRAMES), checkered=True)
    found = refine(fine, best.state, prior=prior, freedoms=freedoms, iterations=8)
    error = uncertainty(fine, found.state, prior=prior, freedoms=freedoms)
    weights = np.array([math.exp(-0.5 * (one.cost() - best.cost())) for one, _ in quick])
    weights /= weights.sum()
    errors = []
    for freedom, e in zip(freedoms, error, strict=True):
        scale = freedom.read(found.state.pose) if freedom.log else 1.0
        away = np.array([freedom.read(one.state.pose) - freedom.read(best.state.pose) for one, _ in quick])
        errors.append(_CAUTION * math.hypot(e * scale, math.sqrt(float(weights @ away**2))))
    return WallSearch(found.state, tuple(freedoms), np.array(errors), found.left)


def _scanned(data: WallData, known: Pose) -> list[WallState]:
    """Return the walls of GGX lobes at all poses of the scan, the best first."""
    turned = replace(data, seen=data.seen[_mirrored(data)])
    tried: list[tuple[float, WallState]] = []
    mirrored = math.inf
    for angle, view, away in itertools.product(_ANGLES_DEG, _VIEWS, _DISTANCES):
        pose = replace(
            known,
            camera_angle_deg=angle,
            field_of_view_deg=known.field_of_view_deg * view,
            camera_distance_m=known.camera_distance_m * away,
            target_offset_m=(-known.distance_m * math.tan(math.radians(angle)), known.target_offset_m[1]),
        )
        try:
            state, left = start_at(data, pose)
            if view == away == 1.0:
                mirrored = min(mirrored, start_at(turned, pose)[1])
        except ConfigError:  # this camera sees past the wall
            continue
        tried.append((left, state))
    if not tried:
        raise DataError("no camera near the start sees the wall; give a start that is nearer to the rig")
    tried.sort(key=lambda one: one[0])
    least = tried[0][0]
    if mirrored < _MIRRORED * least:
        raise DataError(
            "the frames follow the targets the other way round; mirror the frames, or turn the motion's "
            "direction"
        )
    if least > _LEAST:
        raise DataError(
            f"the targets explain {100 * (1 - math.sqrt(least)):.0f} % of what differs between captures, below "
            f"{100 * (1 - math.sqrt(_LEAST)):.0f} %; check the motion's start, speed and direction, or start "
            "nearer to the rig"
        )
    return [state for _, state in tried]


def _mirrored(data: WallData) -> NDArray[np.int64]:
    """Return each pixel's mirror image, left for right; itself where that takes no part."""
    row, column = np.divmod(data.pixel, data.grid[1])
    wanted = (row + 1) * data.grid[1] - 1 - column
    at = np.minimum(np.searchsorted(data.pixel, wanted), len(data.pixel) - 1)
    return np.where(data.pixel[at] == wanted, at, np.arange(len(at)))
