"""A hidden plane that changes, from the wall's events: the model of `changing`, seen through a logarithm.

How much events say of a mode changes with the film, so modes do not fall apart. The strongest ones alone are
asked for, at instants ("nodes") between which the light is a line. A row of the likelihood of events is the
change of one pixel i from one instant to another: J = a_i (x) tau, a_i [K] what the pixel sees of each mode,
tau [T] the slope of the logarithm at the nodes about both instants. All rows of a pixel together are one matrix
of the nodes,

    N = sum_i a_i a_i^T (x) M_i,    M_i = sum of w tau tau^T less what its thresholds differ by,

so that Gauss and Newton's method needs each pixel once, however many events it has. Frames are one more sum of
the same form. Events tell changes of a logarithm: the mean brightness of the plane is that of the prior, and no
cell is darker than black, as a plane that takes light away would make small changes large ones.

| symbol | meaning | unit |
|---|---|---|
| w [T, K] | the film: strength of each mode at each node | |
| a [P, K] | what a pixel sees of each mode | white levels |
| M [P, T, T] | what the events of a pixel say of its light at the nodes | |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras import CrossingLaw
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.changing import LEAST_FRAMES, FilmEstimate, FilmPrior, check_film, film_modes, wave_numbers
from evnlos.inverse.event_likelihood import EventRows, LikelihoodSettings, rows_of
from evnlos.inverse.event_record import EventRecord
from evnlos.inverse.sequence_light import Array, NormalEquations, SequenceLight
from evnlos.machine import Progress, counted, silent
from evnlos.optics import LinearTransport
from evnlos.types import Plane


@dataclass(frozen=True, eq=False)
class FilmLight(SequenceLight):
    """Light of a film of K modes between T nodes: I(i, t_j) = still(i, t_j) + left(i) w_j, white levels.

    `left` [P, K] is what a pixel sees of each mode; `right` holds no target.
    """

    @classmethod
    def of(cls, left: Array, still: Array, times_s: Array, shape: tuple[int, int]) -> FilmLight:
        """Return the light of a film.

        Args:
            left: What each pixel sees of each mode, white levels [P, K].
            still: Light without these modes, white levels [P, T].
            times_s: Nodes, [T], seconds, equally spaced.
            shape: Size (H, W) of the images, P = H W.
        """
        right = np.zeros((len(times_s), left.shape[1], 1))
        return cls(left, right, still.astype(np.float32), times_s, shape)

    def __call__(self, z: Array) -> Array:
        """Return the light of a film w, [T K], white levels, [P, T]."""
        return self.left @ z.reshape(len(self.times_s), -1).T + self.still


class FilmRows(NamedTuple):
    """Rows of the normal equations of a film, by pixel, then by group: a change between two instants each."""

    pixel: NDArray[np.int64]
    """Pixel of each row, [N]."""
    node: NDArray[np.int64]
    """First of the two nodes about the later and about the earlier instant, [N, 2]."""
    slope: Array
    """What the light at these four nodes changes in the row, log units per white level, [N, 4]."""
    weight: Array
    """1 / variance, [N]."""
    residual: Array
    """[N]."""
    group: NDArray[np.int64]
    """Rows of one number share an unknown threshold, [N]; -1: of none."""


class NodeSums(NamedTuple):
    """What all rows of pixels say of the nodes."""

    matrix: Array
    """M of each pixel, [P, T, T]."""
    score: Array
    """Sum of w tau y less the thresholds' share, [P, T]."""


@njit(cache=True, error_model="numpy")
def add_rows(rows: FilmRows, first: int, spread: Array, out: NodeSums):
    """Add rows to the sums of their pixels: M += w tau tau^T, of each group less s^2 / (1 + s^2 sum w) g g^T.

    | symbol | meaning |
    |---|---|
    | rows | rows of the pixels from `first` on, each pixel's and each group's side by side |
    | spread | s, standard deviation of what is not known of the threshold of each group, log units |
    | g, total, seen | sum of w tau, of w and of w y over the rows of a group |
    | out | sums of these pixels |
    """
    nodes = out.score.shape[1]
    g = np.zeros(nodes)
    total, seen = 0.0, 0.0
    for n in range(len(rows.pixel)):
        i, w = rows.pixel[n] - first, rows.weight[n]
        for a in range(4):
            j = rows.node[n, a // 2] + a % 2
            ws = w * rows.slope[n, a]
            if rows.group[n] >= 0:
                g[j] += ws
            out.score[i, j] += ws * rows.residual[n]
            for b in range(4):
                out.matrix[i, j, rows.node[n, b // 2] + b % 2] += ws * rows.slope[n, b]
        if rows.group[n] < 0:
            continue
        total += w
        seen += w * rows.residual[n]
        if n + 1 < len(rows.pixel) and rows.group[n + 1] == rows.group[n]:
            continue
        variance = spread[rows.group[n]] ** 2
        share = variance / (1.0 + variance * total)
        for j in range(nodes):
            if g[j] != 0.0:
                out.score[i, j] -= share * seen * g[j]
                for k in range(nodes):
                    out.matrix[i, j, k] -= share * g[j] * g[k]
        g[:] = 0.0
        total, seen = 0.0, 0.0


class FilmFrames(NamedTuple):
    """Frames beside the events of a film."""

    operator: LinearTransport
    """From the plane's cells to white levels of their pixels [H, W]."""
    frames: torch.Tensor
    """White levels without known ambient light, [N, H, W]."""
    noise_std: torch.Tensor
    """Standard deviation of a pixel's noise, white levels, [H, W], before the film's `noise_factor`."""
    film: FilmEstimate
    """What they tell alone, on the clock of the events (`estimate_film`): the prior, and the modes left out."""


MOST_MODES = 64
"""Strongest modes of a film that events are asked for, at most."""
QUICK_MODES = 24
"""The same where an image may take seconds and not minutes."""
_MOST, _FEWEST = 5000, 16  # unknowns of a film: what bounds the time; modes that are worth it
_PIXELS = 256  # of a block
_BRIGHT = 0.25  # mean brightness of the plane
_DEVIATION, _RESTING = 0.35, 0.6  # of brightness of 0 or 1, and what rests over what changes, of events alone
_LENGTH, _SPEED = 1 / 4, 1 / 20  # of the plane's side: correlation, and by how much of it details move a second
_BLACK = 0.05  # standard deviation of a brightness below 0
_STEP = 1.5  # longest step of a mode in an iteration, standard deviations of its prior
_SETTLED = 3  # iterations at the end with the final error of a crossing


def estimate_event_film(
    operator: LinearTransport,
    still: torch.Tensor,
    record: EventRecord,
    law: CrossingLaw,
    times_s: ArrayLike,
    *,
    frames: FilmFrames | None = None,
    prior: FilmPrior | None = None,
    modes: int = MOST_MODES,
    settings: LikelihoodSettings | None = None,
    progress: Progress = silent,
) -> FilmEstimate:
    """Return the film of a hidden plane from the events of the wall, and from frames beside them.

    At most `modes` of the strongest modes are asked for; the others are those of the frames alone, on a line
    from one to the next, and what they may hold is part of the deviation.

    Args:
        operator: A, from the plane's cells to white levels of the event camera's pixels, [H, W].
        still: Light of these without the plane, white levels, [H, W].
        record: The events, with silences (`record_of`, `gap_s`).
        law: Constants of the event model.
        times_s: Nodes: times of the images, [T], seconds, increasing, equally spaced.
        frames: Frames beside them; None = events alone.
        prior: The prior; None: that of the frames, or of bright shapes on black that move by a twentieth of the
            plane's side in a second. Its mean is a brightness of 0.25.
        modes: Most modes, 1 or more; fewer where there are many nodes. Time grows with their cube.
        settings: What the likelihood of events takes for granted; None is the default.
        progress: Called with each iteration.

    Raises:
        ConfigError: The operator's plane has no square cells, a number of the prior is not positive, or there
            are no modes.
        DataError: Times are not equally spaced or more than 312, or images do not fit their operators.
    """
    from scipy.linalg import cho_factor, cho_solve  # scipy loads slowly

    if modes < 1:
        raise ConfigError(f"modes is {modes}; give 1 or more")
    times, settings = np.asarray(times_s, np.float64), settings or LikelihoodSettings()
    steps = np.diff(times)
    if len(times) < LEAST_FRAMES or not (np.ptp(steps) <= 1e-6 * steps.max() and steps.min() > 0):
        raise DataError(
            f"{len(times)} times of images; give {LEAST_FRAMES} or more, increasing, equally spaced"
        )
    dark = still.double()
    check_film(operator, dark.expand(len(times), *dark.shape), times, torch.ones_like(dark), None, prior)
    plane = operator.source
    assert isinstance(plane, Plane)  # checked above
    matrix = operator.dense(torch.float64).numpy()
    ambient = dark.flatten().numpy()
    relative = matrix / np.maximum(ambient + _BRIGHT * matrix.sum(axis=1), 1e-9)[:, None]
    side = max(plane.extent_m)
    if prior is None and frames is not None:
        prior = frames.film.prior
    found = prior or FilmPrior(_DEVIATION, _RESTING, side * _LENGTH, side * _SPEED)
    values, basis = film_modes(relative.T @ relative, plane, found.length_m)
    modes = min(modes, _MOST // len(times), len(values))
    if _MOST // len(times) < min(_FEWEST, len(values)):
        raise DataError(
            f"{len(times)} images; give at most {_MOST // _FEWEST}: fewer a second, or a shorter recording"
        )
    kept = np.argsort(values)[::-1][:modes]
    hidden = np.square(np.delete(basis, kept, axis=1)).sum(axis=1)
    count, cells, shape = len(times), basis[:, kept], (dark.shape[0], dark.shape[1])
    inverse = np.asarray(np.linalg.inv(basis)[kept], np.float64)  # [K, C]: from cells to modes
    flat = np.full((count, len(basis)), _BRIGHT)
    middle, begun = (flat @ inverse.T).ravel(), flat
    if frames is not None:
        alone = frames.film.mean.reshape(len(frames.film.times_s), -1)
        begun = _on_line(frames.film.times_s, alone, times)
    w = (begun @ inverse.T).ravel()
    rest = begun - w.reshape(count, -1) @ cells.T  # the modes left out
    light = FilmLight.of(matrix @ cells, ambient[:, None] + matrix @ rest.T, times, shape)
    own = _precision(found, times, wave_numbers(cells, plane))
    known = None if frames is None else _of_frames(frames, cells, rest, times)
    law = law.doubted(settings.least_noise)
    trust, annealed = np.ones(len(record)), max(settings.iterations - _SETTLED, 1)
    factor = np.empty((0, 0)), True
    turns, spread = range(settings.iterations), found.deviation * math.hypot(1.0, found.resting)
    for turn in counted(turns, progress, "estimate the film", len(turns), "turns"):
        least = float(settings.noise_in(turn, annealed))
        rows = rows_of(light, law, record, w, least, trust)
        total = film_equations(film_rows(light, record, rows), light, law.thresholds(len(light.left))[1])
        if known is None:
            _hold_up(total, w, cells, rest)
        else:
            total.information += known.information
            total.score += known.score - known.information @ w
        factor = cho_factor(total.information + own, lower=True, overwrite_a=True)
        step = cho_solve(factor, total.score - own @ (w - middle))
        w = w + step * min(1.0, _STEP * spread / max(float(np.abs(step).max()), 1e-12))
    covariance = cho_solve(factor, np.eye(len(w)))
    blocks = covariance.reshape(count, modes, count, modes)[np.arange(count), :, np.arange(count)]
    variance = np.einsum("ck,tkl,cl->tc", cells, blocks, cells, optimize=True)
    variance += spread**2 * hidden
    images = (w.reshape(count, modes) @ cells.T + rest).reshape(-1, *plane.shape)
    deviation = np.sqrt(np.maximum(variance, 0.0)).reshape(-1, *plane.shape)
    static = 0.0 if frames is None else frames.film.static
    return FilmEstimate(times, images, deviation, found, math.nan, 1.0, static)


def film_rows(light: FilmLight, record: EventRecord, rows: EventRows) -> FilmRows:
    """Return what the events say of a film as rows over its nodes: changes, then rates, by pixel.

    Args:
        light: The light.
        record: The events.
        rows: What they say about the present estimate.
    """
    step, slopes = light.times_s[1] - light.times_s[0], rows.levels.slope

    def instants(at: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array, Array]:
        pixel, t_s = record.pixel[at], record.t_s[at]
        then = t_s - light.at(rows.levels.lag_s, pixel, t_s)
        node, share = light.place(then)
        slope = light.at(slopes, pixel, then)
        return node, (1 - share) * slope, share * slope

    changes, rates = rows.changes, np.flatnonzero(record.measured)
    (node, *later), (since, *earlier) = instants(changes.at), instants(record.origin[changes.at])
    owner, pixel = record.pixel[changes.at], record.pixel[rates]
    fall = [-one for one in earlier]
    changed = FilmRows(
        owner,
        np.stack([node, since], axis=1),
        np.stack([*later, *fall], axis=1),
        changes.weight,
        changes.residual,
        2 * owner + (changes.sign > 0),
    )
    node, nothing = instants(rates)[0], np.zeros(len(rates))
    rise = -slopes[pixel, node] / step, slopes[pixel, node + 1] / step
    moving = FilmRows(
        pixel,
        np.stack([node, node], axis=1),
        np.stack([*rise, nothing, nothing], axis=1),
        rows.times.weight[rates],
        rows.times.residual[rates],
        np.full(len(rates), -1),
    )
    pairs = zip(changed, moving, strict=True)
    joined: list[Any] = [np.concatenate([one, other]) for one, other in pairs]
    order = np.lexsort((joined[-1], joined[0]))
    columns: Any = [column[order] for column in joined]
    return FilmRows(*columns)


def film_equations(rows: FilmRows, light: FilmLight, spread: Array) -> NormalEquations:
    """Return what rows say of a film w [T K]: sums over pixels of a a^T (x) M.

    Args:
        rows: The rows.
        light: The light, for what pixels see of modes.
        spread: Standard deviation of what is not known of each threshold, log units, [2 P]: OFF, ON in turn.
    """
    count, modes = len(light.times_s), light.left.shape[1]
    (j, k), (a, b) = np.tril_indices(count), np.tril_indices(modes)
    total, score = np.zeros((len(j), len(a)), np.float64), np.zeros((count, modes))
    for first in range(0, len(light.left), _PIXELS):
        here = slice(*np.searchsorted(rows.pixel, (first, first + _PIXELS)))
        left = light.left[first : first + _PIXELS]
        sums = NodeSums(np.zeros((len(left), count, count)), np.zeros((len(left), count)))
        part: Any = [column[here] for column in rows]
        add_rows(FilmRows(*part), first, spread, sums)
        seen, single = sums.matrix[:, j, k].astype(np.float32), left.astype(np.float32)
        total += seen.T @ (single[:, a] * single[:, b])
        score += sums.score.T @ left
    half = np.zeros((len(j), modes, modes))
    half[:, a, b] = half[:, b, a] = total
    whole = np.zeros((count, count, modes, modes))
    whole[j, k] = whole[k, j] = half
    return NormalEquations(whole.transpose(0, 2, 1, 3).reshape(count * modes, -1), score.ravel())


def _on_line(times_s: Array, values: Array, nodes: Array) -> Array:
    """Return values [N, C] at times on a line between them at nodes, [T, C]."""
    return np.stack([np.interp(nodes, times_s, one) for one in values.T], axis=1)


def _of_frames(frames: FilmFrames, cells: Array, rest: Array, nodes: Array) -> NormalEquations:
    """Return what frames say of a film w [T K] beside the rest; constant offsets are integrated out."""
    times, static = frames.film.times_s, frames.film.static
    check_film(frames.operator, frames.frames, times, frames.noise_std, static, None)
    weight = 1 / (frames.film.noise_factor * frames.noise_std.double().flatten().numpy())
    matrix = weight[:, None] * frames.operator.dense(torch.float64).numpy()
    left = matrix @ cells
    data = frames.frames.double().flatten(1).numpy() * weight - _on_line(nodes, rest, times) @ matrix.T
    hats = _on_line(nodes, np.eye(len(nodes)), times)
    offsets = np.full((len(data),) * 2, static**2 / (1 + len(data) * static**2))
    apart = hats.T @ (np.eye(len(data)) - offsets)
    information = np.asarray(np.kron(apart @ hats, left.T @ left), np.float64)
    return NormalEquations(information, np.asarray((apart @ data) @ left, np.float64).ravel())


def _hold_up(total: NormalEquations, w: Array, cells: Array, rest: Array) -> None:
    """Add that no cell is darker than black: exp(-x^2 / 2 s^2) where its brightness x is below 0."""
    films = w.reshape(-1, cells.shape[1])
    modes = films.shape[1]
    for k, film in enumerate(films):
        level = cells @ film + rest[k]
        dark = level < 0
        pull, here = cells[dark] / _BLACK, slice(k * modes, (k + 1) * modes)
        total.information[here, here] += pull.T @ pull
        total.score[here] -= pull.T @ (level[dark] / _BLACK)


def _precision(prior: FilmPrior, times_s: Array, wave_number: Array) -> Array:
    """Return the inverse of the prior's covariance: what changes forgets, what rests stays; [T K, T K]."""
    between = np.abs(times_s[:, None] - times_s)
    fading = np.exp(-between * (prior.speed_m_s * wave_number)[:, None, None])
    steady = fading + prior.resting**2 + 1e-9 * np.eye(len(between))
    each = np.linalg.inv(steady) / prior.deviation**2
    modes, count = each.shape[:2]
    whole = np.zeros((count, modes, count, modes))
    whole[:, np.arange(modes), :, np.arange(modes)] = each
    return whole.reshape(count * modes, -1)
