"""What pose and slopes leave: sensitivity and tilt of each pixel, light that travels along, a correction.

Each is fitted to the captures of the fit and kept only where captures that the fit has not seen get better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from evnlos.calibration.captures import CaptureSet
from evnlos.calibration.wall_fit import Array, WallData, WallState, wall_data
from evnlos.data.sampling import reduce_by_area
from evnlos.machine import note
from evnlos.optics.facets import MASKING, fill_facets, seen_points, target_cells
from evnlos.optics.radiometric import torchs_threads
from evnlos.setups.files import AboutWall, FittedWall
from evnlos.types import Plane

_COLUMNS = 160  # of the working images: finer texture is the fixed pattern's
_COARSE = 64  # of those that the correction of the operator is estimated on
_TEXTURE = 0.05  # standard deviation of a pixel's sensitivity about the smooth model
_SMOOTH_PX = (2.0, 5.0)  # of the map of sensitivities, working pixels
_TILT = 5e-3  # standard deviation of the wall's slope beside its bend
_TILT_STEP = 2e-3  # of the finite difference
_TILTED_PX = (1.0, 2.0)  # over which tilt and sensitivity are alike, working pixels
_AMBIENT_PX = 3.0
_LENGTHS_M = (0.01, 0.025)
_LEVELS = (1e-2, 3e-2, 1e-1, 3e-1)
_RANK = 32
_COMPANION = Plane(16, 16, 0.01)
_BRIGHTEST = 1.0


@dataclass(frozen=True, eq=False)
class WallRest:
    """A wall with what its pose and slopes leave, and how much each freedom explains.

    Args:
        wall: The fitted wall; its ambient light is divided by `ambient`.
        ambient: Mean ambient light, white levels.
        explained: By name of the freedom, the share of what was left on captures held out, beside their noise,
            that it takes away; negative where it made things worse.
        kept: The freedoms that are part of the wall.
    """

    wall: FittedWall
    ambient: float
    explained: dict[str, float]
    kept: tuple[str, ...]


def rest_of(fit: CaptureSet, held: CaptureSet, state: WallState, plane: Plane) -> WallRest:
    """Return the wall with what its pose and slopes leave, as the held-out captures want.

    Args:
        fit: Captures to fit.
        held: Captures to judge on.
        state: Pose and slopes.
        plane: Cells of the targets' images, over the whole travel.
    """
    from scipy.ndimage import gaussian_filter  # scipy loads slowly

    data, other = _both(fit, held, _COLUMNS, plane, 1)
    light, away = state.light(data), state.light(other)
    explained: dict[str, float] = {}
    kept: list[str] = []

    texture, error = np.ones(len(light)), _remaining_error(data, other, light, away)
    floor, best, rough = _noise(other, away), error, pixel_sensitivity(data, light)
    for smooth in _SMOOTH_PX:
        note(name := f"texture smooth over {smooth:g} pixels")
        trial = _smoothed(data, *rough, smooth)[:, None]
        after = _remaining_error(data, other, light * trial, away * trial)
        explained[name] = _share(error, after, floor)
        if _better(best, after):
            texture, best, kept = trial[:, 0], after, [name]
    shares, name, wavy, after, plain = uneven_wall(data, other, state, light, away)
    explained |= {one: _share(error, squares, floor) for one, squares in shares.items()}
    tilt = np.zeros((len(light), 2))
    if _better(best, after) and _better(plain, after):  # what is not as smooth is the fixed pattern's
        texture, tilt, kept = 1 + wavy[:, 0], wavy[:, 1:], [name]
    tilts = np.stack([data.image(part, 0.0) for part in tilt.T])
    sensitivity = texture * np.exp(data.monomials() @ state.sensitivity)

    coarse, behind = _both(fit, held, _COARSE, plane, 2)
    factor = _resized(data.image(texture, 1.0), coarse.grid).ravel()
    turned = _resized(tilts, coarse.grid).reshape(2, -1).T
    light, away = (state.light(d, tilt=turned[d.pixel]) * factor[d.pixel, None] for d in (coarse, behind))
    error, floor = _remaining_error(coarse, behind, light, away), _noise(behind, away)
    left, right, after = correction_of(coarse, light, behind, away)
    name = "correction of the operator"
    explained[name] = _share(error, after, floor)
    pictures = np.zeros((0, *coarse.grid))
    if _better(error, after):
        kept.append(name)
        pictures = np.stack([coarse.image(column, 0.0) for column in left.T])
        light, away = light + left @ (right @ _dense(coarse)), away + left @ (right @ _dense(behind))
    else:
        right = np.zeros((0, plane.height * plane.width))

    shared, there = _means(coarse, coarse.seen - light), _means(behind, behind.seen - away)
    picture, ambient = np.zeros(_COMPANION.shape), shared.mean(axis=1)
    if coarse.group.max() > 0 and coarse.group.max() == behind.group.max():
        places = np.stack(
            [coarse.places[coarse.group == g].mean(axis=0) for g in range(coarse.group.max() + 1)]
        )
        own = factor[coarse.pixel] * np.exp(coarse.monomials() @ state.sensitivity)
        found, carried = companion_of(coarse, state, shared, places, _COMPANION, own, turned[coarse.pixel])
        before = _moving(coarse, there)
        after = _moving(coarse, there - carried)
        noise = floor.sum() / behind.seen.shape[1] * (len(places) - 1) / len(np.unique(behind.capture))
        name = "light that travels along"
        explained[name] = _share(before, after, np.array([noise]))
        if _better(before, after):
            kept.append(name)
            picture, ambient = found, (shared - carried).mean(axis=1)
    ambient_map = gaussian_filter(coarse.image(ambient, float(ambient.mean())), _AMBIENT_PX, mode="nearest")
    level = max(float(ambient_map.mean()), 0.0)
    about = AboutWall(
        state.table.scale,
        state.table.step,
        state.table.matte,
        _COMPANION,
        plane,
        {"explained": {name: round(value, 4) for name, value in explained.items()}, "kept": kept},
    )
    wall = FittedWall(
        state.table.log_density,
        data.image(sensitivity, float(np.median(sensitivity))).astype(np.float32),
        (np.maximum(ambient_map, 0) / level if level > 1e-6 else np.ones(coarse.grid)).astype(np.float32),
        picture.astype(np.float32),
        pictures.astype(np.float32),
        right.astype(np.float32),
        about,
        tilts.astype(np.float32) if tilt.any() else np.zeros((2, 1, 1), np.float32),
    )
    return WallRest(wall, level, explained, tuple(kept))


def _both(
    fit: CaptureSet, held: CaptureSet, columns: int, plane: Plane, every: int
) -> tuple[WallData, WallData]:
    """Return the data of two sets of captures over the same pixels."""
    data, other = (
        wall_data(capture_set, columns, plane, every=every, first=every - 1) for capture_set in (fit, held)
    )
    return data.pixels(np.isin(data.pixel, other.pixel)), other.pixels(np.isin(other.pixel, data.pixel))


def _resized(pictures: Array, grid: tuple[int, int]) -> Array:
    """Return images [..., h, w] at another size."""
    before = pictures.shape[:-2]
    if pictures.shape[-2:] == grid or not pictures.size:
        return pictures.reshape(*before, *grid)
    flat = pictures.reshape(-1, *pictures.shape[-2:])
    if grid[1] < pictures.shape[-1]:
        return reduce_by_area(flat, grid).reshape(*before, *grid).astype(np.float64)
    large = torch.nn.functional.interpolate(
        torch.from_numpy(flat)[None], grid, mode="bilinear", align_corners=False
    )
    return large.numpy().reshape(*before, *grid)


def _remaining_error(data: WallData, other: WallData, light: Array, away: Array) -> Array:
    """Return the weighted squares left on each capture held out, less what the fitted ones share, [C]."""
    return _squares(other, other.seen - away - _expected(data, other, data.seen - light))


def _expected(data: WallData, other: WallData, values: Array) -> Array:
    """Return what the captures of the fit share, for the frames held out: [P, N] or [P, 1]."""
    shared = _means(data, values)
    return shared[:, other.group] if data.group.max() > 0 else shared


def _squares(data: WallData, values: Array) -> Array:
    """Return the weighted squares of each capture, [C]."""
    each = (values**2 * data.weight[:, None]).sum(axis=0)
    return np.bincount(data.capture, weights=each).astype(np.float64)


def _noise(data: WallData, light: Array) -> Array:
    """Return the weighted squares of the noise of each capture [C], from second differences in time."""
    left = data.seen - light
    inside = data.capture[2:] == data.capture[:-2]
    each = ((left[:, 2:] - 2 * left[:, 1:-1] + left[:, :-2]) ** 2 * data.weight[:, None]).sum(axis=0) / 6
    return np.bincount(data.capture).astype(np.float64) * float(each[inside].mean())


def _share(before: Array, after: Array, noise: Array) -> float:
    """Return the share of what was left beside the noise that a freedom takes away."""
    total = float(before.sum() - noise.sum())
    return float(before.sum() - after.sum()) / max(total, 1e-3 * float(before.sum()))


def _better(before: Array, after: Array) -> bool:
    """Return whether captures held out got better, by more than twice the scatter between them."""
    gain = before - after
    return bool(gain.sum() > 2 * np.sqrt(len(gain)) * gain.std() and gain.sum() > 5e-4 * before.sum())


def _moving(data: WallData, shared: Array) -> Array:
    """Return the weighted squares of what changes from place to place, by blocks of places, [4]."""
    each = ((shared - shared.mean(axis=1, keepdims=True)) ** 2 * data.weight[:, None]).sum(axis=0)
    return np.array([part.sum() for part in np.array_split(each, 4)])


def _means(data: WallData, values: Array) -> Array:
    """Return the means over the frames of each group, [P, G]."""
    return np.stack([values[:, data.group == g].mean(axis=1) for g in range(data.group.max() + 1)], axis=1)


def pixel_sensitivity(data: WallData, light: Array) -> tuple[Array, Array]:
    """Return each pixel's sensitivity beside the model's [P], and its precision over that of the prior [P].

    Least squares of what differs between captures.

    Args:
        data: Frames.
        light: The model's light [P, N].
    """
    model, seen = data.shared_removed(light), data.shared_removed(data.seen)
    power = (model * model).sum(axis=1)
    noise = float(np.mean((seen - model) ** 2))
    ratio = (model * seen).sum(axis=1) / np.maximum(power, 1e-12 * power.max())
    return ratio, power * (_TEXTURE**2 / noise)


def _smoothed(data: WallData, ratio: Array, precision: Array, smooth: float) -> Array:
    """Return the sensitivities averaged over neighbours by their precision, near 1 where nothing is known."""
    from scipy.ndimage import gaussian_filter  # scipy loads slowly

    # One pixel alone must not outweigh its neighbours: textures differ from pixel to pixel.
    weight = precision / (1 + precision)
    top, below = (gaussian_filter(data.image(v, 0.0), smooth) for v in (weight * (ratio - 1), weight))
    return 1 + (top / (below + 0.02)).ravel()[data.pixel]


def uneven_wall(
    data: WallData, other: WallData, state: WallState, light: Array, away: Array
) -> tuple[dict[str, Array], str, Array, Array, Array]:
    """Return how much brighter and how tilted the wall is where each pixel sees it; what that leaves.

    Around each pixel the residual is a linear function of three numbers, the relative sensitivity and the
    slopes along x and y beside those of the bend: s light + t_x d light / d t_x + t_y d light / d t_y.
    They are least squares over its neighbours, weighted by a Gaussian of some pixels, with priors of mean 0;
    the width is chosen on the captures held out.

    Args:
        data: Frames of the fit.
        other: Frames held out.
        state: Pose and slopes.
        light: The model's light of `data` [P, N].
        away: The model's light of `other`.

    Returns:
        The squares left of each capture held out [C], by the linear function, for each width by name; the best
        name; its three numbers of each pixel [P, 3]; what they leave by light that is computed again [C]; and
        what its sensitivities alone leave [C].
    """
    from scipy.ndimage import gaussian_filter  # scipy loads slowly

    both = []
    for one, seen in ((data, light), (other, away)):
        steps = _TILT_STEP * np.eye(2)
        turned = [state.light(one, tilt=np.tile(step, (len(seen), 1))) - seen for step in steps]
        both.append([seen, *(change / _TILT_STEP for change in turned)])
    own, beyond = both
    left = data.shared_removed(data.seen - light)
    parts = [data.shared_removed(part) for part in own]
    gram = [[(a * b).sum(axis=1) for b in parts] for a in parts]
    right = [(a * left).sum(axis=1) for a in parts]
    prior = np.mean(left**2) / np.array([_TEXTURE, _TILT, _TILT]) ** 2
    shares, changes = dict[str, Array](), dict[str, tuple[Array, Array]]()
    for width in _TILTED_PX:

        def around(values: Array, width: float = width) -> Array:
            return gaussian_filter(data.image(values, 0.0), width).ravel()[data.pixel]

        near = around(np.ones(len(light)))
        normal = np.moveaxis(np.array([[around(v) for v in row] for row in gram]) / near, 2, 0)
        found = np.array([around(v) for v in right]) / near
        # The neighbours are worth 4 pi width^2 pixels.
        normal += np.diag(prior / (4 * np.pi * width**2))
        change = np.asarray(np.linalg.solve(normal, found.T[..., None])[..., 0], np.float64)
        trial = [
            sum(change[:, k, None] * part for k, part in enumerate(basis)) + basis[0] for basis in (own, beyond)
        ]
        name = f"tilt and texture smooth over {width:g} pixels"
        shares[name] = _remaining_error(data, other, *trial)
        changes[name] = change, found[0] / normal[:, 0, 0]
    name = min(shares, key=lambda one: shares[one].sum())
    change, alone = changes[name]
    again = [state.light(one, tilt=change[:, 1:]) * (1 + change[:, :1]) for one in (data, other)]
    plain = [seen * (1 + alone[:, None]) for seen in (light, away)]
    after, textured = (_remaining_error(data, other, *one) for one in (again, plain))
    return shares, name, change, after, textured


def correction_of(data: WallData, light: Array, other: WallData, away: Array) -> tuple[Array, Array, Array]:
    """Return the correction of the operator that predicts held-out captures best; the squares it leaves [C].

    The correction is images of the camera image [P, R] times weights over target cells [R, Q].

    A residual pixel is a linear function of the target's image, with a Gaussian prior of smooth weights over
    the plane (Gaussian process regression); strength and smoothness are chosen on the captures held out,
    and the result is cut to its strongest singular vectors.

    Args:
        data: Frames of the fit.
        light: The model's light of them [P, N].
        other: Frames held out.
        away: The model's light of them.
    """
    pictures = [_dense(data), _dense(other)]
    means = np.stack(
        [pictures[0][:, data.group == g].mean(axis=1) for g in range(data.group.max() + 1)], axis=1
    )
    x = pictures[0] - means[:, data.group]
    xh = pictures[1] - (means[:, other.group] if data.group.max() > 0 else means)
    wanted = data.shared_removed(data.seen - light)
    left_out = other.seen - away - _expected(data, other, data.seen - light)
    grid = np.stack(np.meshgrid(data.plane.y_m, data.plane.x_m, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = ((grid[:, None] - grid[None]) ** 2).sum(axis=-1)
    best: tuple[Array, Array, Array] | None = None
    for length in _LENGTHS_M:
        kx = np.exp(-0.5 * distance / length**2) @ x  # [Q, N]
        values, vectors = np.linalg.eigh(x.T @ kx)
        turned, cross = wanted @ vectors, (xh.T @ kx) @ vectors
        for level in _LEVELS:
            gain = 1 / (np.maximum(values, 0) + level * values.max())
            after = _squares(other, left_out - (turned * gain) @ cross.T)
            if best is None or after.sum() < best[0].sum():
                best = after, turned * gain, kx @ vectors
    assert best is not None
    u, s, v = np.linalg.svd(best[1] @ best[2].T, full_matrices=False)
    rank = min(_RANK, int((s > 1e-3 * s[0]).sum()))
    return u[:, :rank] * s[:rank], v[:rank], best[0]


def companion_of(
    data: WallData,
    state: WallState,
    shared: Array,
    places: Array,
    plane: Plane,
    sensitivity: Array,
    tilt: Array | None = None,
) -> tuple[Array, Array]:
    """Return the image of what shines beside the target and moves along [h, w], and its light [P, S].

    The light that all captures share at each place is ambient light, the same everywhere, and what an image
    without negative values makes, drawn to be dark and smooth (non-negative least squares).

    Args:
        data: The pixels.
        state: The wall.
        shared: Light that all captures share at each place [P, S].
        places: These places (x, y) [S, 2], metres.
        plane: Cells of the image, about the target's middle.
        sensitivity: Of each pixel [P].
        tilt: Slopes of the wall there, beside its bend [P, 2].
    """
    from scipy.optimize import nnls  # scipy loads slowly

    seen = seen_points(state.pose, data.shape, data.columns, data.rows, tilt=tilt)
    here = target_cells(state.pose, plane)
    matrix = np.empty((len(data.columns), len(places), plane.height * plane.width))
    for k, (x, y) in enumerate(places):
        part = np.empty(matrix[:, k].shape)
        cells = here._replace(points=here.points + np.array([x, y, x * state.pose.travel_slope]))
        with torchs_threads():
            fill_facets(part, seen, cells, state.table, MASKING)
        matrix[:, k] = part * sensitivity[:, None]
    root = np.sqrt(data.weight)[:, None, None]
    a = ((matrix - matrix.mean(axis=1, keepdims=True)) * root).reshape(-1, matrix.shape[2])
    wanted = shared - shared.mean(axis=1, keepdims=True)
    gram, right = a.T @ a, a.T @ (wanted * root[..., 0]).ravel()
    level = 1e-3 * np.trace(gram) / len(right)
    rows, columns = np.eye(plane.height), np.eye(plane.width)
    steps = np.vstack([np.kron(np.diff(rows, axis=0), columns), np.kron(rows, np.diff(columns, axis=0))])
    normal = gram + level * (steps.T @ steps) + 0.1 * level * np.eye(len(right))
    factor = np.linalg.cholesky(normal).T
    picture = np.minimum(nnls(factor, np.linalg.solve(factor.T, right))[0], _BRIGHTEST)
    return picture.reshape(plane.shape), matrix @ picture


def _dense(data: WallData) -> Array:
    """Return the targets' images [Q, N]."""
    starts, cell, light = data.images
    out = np.zeros((data.plane.height * data.plane.width, len(starts) - 1))
    out[cell, np.repeat(np.arange(out.shape[1]), np.diff(starts))] = light
    return out
