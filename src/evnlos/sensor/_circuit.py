"""The kernels of the photoreceptor with currents: its state carried from threshold to threshold, exactly."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.sensor._fast_math import fast_log
from evnlos.sensor._order import grown
from evnlos.sensor._random import (
    STREAM_CIRCUIT,
    random_normals,
)

LEVEL = 0.02
"""Distance of two currents of the table, e-fold."""
_SAFE = 7.0
"""Standard deviations of the noise from a threshold at which a pixel's noise need not be drawn."""
_FORGOTTEN = 2048
"""Steps after which noise that was not drawn is drawn anew from its stationary state."""


class Table(NamedTuple):
    """One step h of the equations, for currents `LEVEL` apart."""

    decay: NDArray[np.float64]  # exp(M h), [L, 3, 3]
    push: NDArray[np.float64]  # M^-1 (exp(M h) - 1) c / h: what a change of log light takes away, [L, 3]
    kick: NDArray[np.float64]  # Cholesky factor of the noise of a step, [L, 3, 3]
    settled: NDArray[np.float64]  # Cholesky factor of the stationary noise, [L, 3, 3]


class State(NamedTuple):
    """The pixels. The follower stands at x + lag[2] + noise[2], x being the log current."""

    x: NDArray[np.float64]  # log current over dark current, [N]
    lag: NDArray[np.float64]  # response to light less what it settles at, log units [N, 3]
    noise: NDArray[np.float64]  # log units [N, 3]
    reference: NDArray[np.float64]  # log units [N]
    deaf: NDArray[np.float64]  # end of the refractory period, seconds [N]
    drawn: NDArray[np.uint32]  # pairs of normal numbers so far [N]
    stale: NDArray[np.int64]  # steps by which the noise is behind [N]


class Pixel(NamedTuple):
    """Constants of the array."""

    on: NDArray[np.float64]  # thresholds, log units [N]
    off: NDArray[np.float64]
    factor: float  # light current over dark current, per DN
    top: float  # largest log current of the table
    leak: float  # log units per s
    refractory: float  # s
    seed: np.uint64


def stationary(m: NDArray, noise: NDArray) -> NDArray[np.float64]:
    """Return P of M P + P M^T + noise = 0, [L, 3, 3]: the covariance of what settles."""
    one = np.eye(3)
    system = np.einsum("lij,kn->likjn", m, one) + np.einsum("ij,lkn->likjn", one, m)
    return np.linalg.solve(system.reshape(-1, 9, 9), -noise.reshape(-1, 9, 1)).reshape(-1, 3, 3)


def factor_of(covariance: NDArray) -> NDArray[np.float64]:
    """Return lower-triangular factors of covariances, zero where they are."""
    if not covariance.any():
        return np.zeros_like(covariance)
    scale = np.sqrt(np.einsum("lii->li", covariance))
    correlation = covariance / scale[:, :, None] / scale[:, None, :]
    return scale[:, :, None] * np.linalg.cholesky(correlation + 1e-12 * np.eye(3))


@njit(cache=True, error_model="numpy", inline="always")
def apply(matrix, vector, i, add, scale):
    """Replace row i of `vector` by matrix @ row + scale * add."""
    a, b, c = vector[i, 0], vector[i, 1], vector[i, 2]
    for n in range(3):
        vector[i, n] = matrix[n, 0] * a + matrix[n, 1] * b + matrix[n, 2] * c + scale * add[n]


@njit(cache=True, error_model="numpy")
def normals(seed, stream, pixel, counter, factor, out):
    """Fill `out` [3] with normal numbers of the covariance factor factor^T."""
    a, b = random_normals(seed, stream, pixel, counter)
    c, _ = random_normals(seed, stream, pixel, counter + 1)
    out[0] = factor[0, 0] * a
    out[1] = factor[1, 0] * a + factor[1, 1] * b
    out[2] = factor[2, 0] * a + factor[2, 1] * b + factor[2, 2] * c


@njit(cache=True, error_model="numpy")
def catch_up(i, level, state, table, pixel, kick):
    """Bring a pixel's noise up to date: step by step, or drawn anew where it has forgotten."""
    if state.stale[i] > _FORGOTTEN:
        normals(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.settled[level], kick)
        state.drawn[i] += np.uint32(2)
        for n in range(3):
            state.noise[i, n] = kick[n]
    else:
        for _ in range(state.stale[i]):
            normals(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.kick[level], kick)
            state.drawn[i] += np.uint32(2)
            apply(table.decay[level], state.noise, i, kick, 1.0)
    state.stale[i] = 0


@njit(cache=True, error_model="numpy")
def run_interval(out, count, i, start, length, steps, x1, state, table, pixel, kick):
    """Advance one pixel by `steps` steps of log light, a line to x1; return the columns and their fill."""
    x0, h = state.x[i], length / steps
    change = (x1 - x0) / steps
    top = len(table.decay) - 1
    middle = min(int(0.5 * (x0 + x1) / LEVEL + 0.5), top)
    rms = 0.0
    for n in range(3):
        rms += table.settled[middle, 2, n] ** 2
    margin = _SAFE * math.sqrt(rms)
    deaf = state.deaf[i] > start
    # without its noise: how far does the response go, and can it come near a threshold?
    if not deaf:
        lift = x0 + state.lag[i, 2] - state.reference[i]
        reach = max(abs(state.lag[i, 0]), abs(state.lag[i, 1]), abs(state.lag[i, 2])) + abs(x1 - x0)
        reach += pixel.leak * length + margin
        if lift + reach < pixel.on[i] and lift - reach > -pixel.off[i]:
            for _ in range(steps):
                apply(table.decay[middle], state.lag, i, table.push[middle], -change)
            state.stale[i] += steps
            state.reference[i] -= pixel.leak * length
            state.x[i] = x1
            return out, count
    catch_up(i, middle, state, table, pixel, kick)
    before = x0 + state.lag[i, 2] + state.noise[i, 2]
    for k in range(steps):
        level = min(int((x0 + (k + 0.5) * change) / LEVEL + 0.5), top)
        apply(table.decay[level], state.lag, i, table.push[level], -change)
        normals(pixel.seed, STREAM_CIRCUIT, i, state.drawn[i], table.kick[level], kick)
        state.drawn[i] += np.uint32(2)
        apply(table.decay[level], state.noise, i, kick, 1.0)
        now = x0 + (k + 1) * change + state.lag[i, 2] + state.noise[i, 2]
        state.reference[i] -= pixel.leak * h
        at = start + k * h
        if state.deaf[i] > at:
            if state.deaf[i] >= at + h:
                state.reference[i] = now
                before = now
                continue
            share = (state.deaf[i] - at) / h
            before += share * (now - before)
            at, state.reference[i] = state.deaf[i], before
        left = start + (k + 1) * h - at
        while True:
            lift = now - state.reference[i]
            sign = 1 if lift >= pixel.on[i] else (-1 if lift <= -pixel.off[i] else 0)
            if sign == 0:
                break
            state.reference[i] += pixel.on[i] if sign > 0 else -pixel.off[i]
            share = 0.0
            if now != before:
                share = min(max((state.reference[i] - before) / (now - before), 0.0), 1.0)
            if count == len(out[0]):
                out = grown(out[0]), grown(out[1]), grown(out[2])
            out[0][count] = np.int64(np.rint((at + share * left) * 1e6))
            out[1][count], out[2][count] = i, sign > 0
            count += 1
            if pixel.refractory > 0.0:
                state.deaf[i] = at + share * left + pixel.refractory
                state.reference[i] = now
                break
        before = now
    state.x[i] = x1
    return out, count


@njit(cache=True, error_model="numpy", nogil=True)
def run_frames(frames, origin, times, steps, first, last, state, tables, which, pixel):
    """Run the pixels first..last - 1 through a block of light and return what they sent.

    frames  light, DN [T, M], of the pixels origin..origin + M - 1 at times[1:], seconds [T + 1]
    steps   steps of each interval [T];  tables  `Table` with a first axis for each length of a step
    which   the table of each interval [T];  state, pixel  `State`, changed, and `Pixel`
    Returns three columns: time stamp in microseconds, pixel, polarity.
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count, kick = 0, np.empty(3)
    for k in range(len(frames)):
        length = times[k + 1] - times[k]
        w = which[k]
        table = Table(tables.decay[w], tables.push[w], tables.kick[w], tables.settled[w])
        for i in range(first, last):
            x1 = min(fast_log(1.0 + pixel.factor * np.float64(frames[k, i - origin])), pixel.top)
            out, count = run_interval(out, count, i, times[k], length, steps[k], x1, state, table, pixel, kick)
    return out[0][:count], out[1][:count], out[2][:count]
