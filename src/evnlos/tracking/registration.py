"""Where the object's image lies in each frame: the likeliest shift against a template made of them all.

- How fast the image of the object slides, from the events between its frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.data.sampling import reduce_by_area
from evnlos.errors import DataError
from evnlos.events import event_histogram
from evnlos.machine import note
from evnlos.optics.interpolation import MARGIN, spline_coefficients
from evnlos.types import Events

_LEAST_FRAMES = 4
_EDGE = 0.02  # of the template's peak; weaker light is left to the background
_LEAST_SIGNAL = 6.0  # standard deviations of the noise that the object's peak must have
_LEAST_EXPLAINED = 0.5  # share of what changes between the frames that one shifted image must explain
_STEP = np.array([2.0, 2.0, 0.2, 0.2])  # largest step of (x, y, ln size, ln brightness), pixels and shares
_FIT_STEPS = 2
_ROUNDS = 8


def reduced(frames: NDArray, columns: int) -> NDArray:
    """Return frames [N, H, W] of at most so many columns, by area averaging; refuse too few."""
    if len(frames) < _LEAST_FRAMES:
        raise DataError(f"{len(frames)} frames; tracking needs {_LEAST_FRAMES} or more")
    height, width = int(frames.shape[1]), int(frames.shape[2])
    columns = min(columns, width)
    return reduce_by_area(frames, (max(1, round(height * columns / width)), columns))


def temporal_noise(frames: NDArray) -> float:
    """Return the standard deviation of the noise that changes from frame to frame, in the frames' unit.

    Median absolute value of second differences, in time and then over neighbours: a smooth image that moves
    leaves next to nothing there.

    Args:
        frames: Real [N, H, W], three or more along each axis.
    """
    change = (frames[2:] - 2 * frames[1:-1] + frames[:-2]) / np.sqrt(6)
    around = change[:, :-2, 1:-1] + change[:, 2:, 1:-1] + change[:, 1:-1, :-2] + change[:, 1:-1, 2:]
    return float(1.4826 * np.median(np.abs(4 * change[:, 1:-1, 1:-1] - around)) / np.sqrt(20))


@dataclass(frozen=True, eq=False)
class Registration:
    """The object's image and its place in every frame.

    Args:
        place_px: Middle of the object's light (x, y), float64 [N, 2], pixels of these frames.
        size: Size of the image over the template's, [N].
        covariance: Of (x, y, log size, log brightness) of each frame, [N, 4, 4].
        template: The image with its middle in the array's middle, float64 [h, w].
        light: Brightness of each frame over the template's, [N].
        background: What rests, [H, W].
    """

    place_px: NDArray[np.float64]
    size: NDArray[np.float64]
    covariance: NDArray[np.float64]
    template: torch.Tensor
    light: NDArray[np.float64]
    background: NDArray[np.float64]

    def picture(self, place_px: NDArray[np.float64], shape: tuple[int, int]) -> torch.Tensor:
        """Return the object's light alone with its middle at (x, y), pixels, [H, W], at the mean size."""
        row = torch.arange(shape[0], dtype=torch.float64) - place_px[1] + (self.template.shape[0] - 1) / 2
        column = torch.arange(shape[1], dtype=torch.float64) - place_px[0] + (self.template.shape[1] - 1) / 2
        return _sampled(spline_coefficients(self.template), row, column)


def register(frames: NDArray, background: NDArray, noise: float) -> Registration:
    """Fit every frame as background + g T((p - m) / s), T common to all, by alternation.

    T is the mean of the frames' light, each moved back to the middle; then each frame's (m, ln s, ln g) is
    fitted to T by Gauss-Newton (Lucas and Kanade 1981), and the background takes up what no frame's light
    explains. Where the image does not keep its shape, T is the mean shape and the misfit enters the
    covariance.

    Args:
        frames: Real [N, H, W].
        background: First guess of what rests, [H, W].
        noise: Standard deviation of a sample's noise.

    Raises:
        DataError: A frame shows no light that stands out from the noise, or its light does not shift as one
            image does.
    """
    light = torch.from_numpy(np.asarray(frames, np.float64) - background)  # [N, H, W]
    shape = (int(light.shape[1]), int(light.shape[2]))
    values = np.zeros((len(frames), 4))
    values[:, :2] = _middles(light, noise)
    rest = torch.zeros(shape, dtype=torch.float64)
    template = torch.zeros(shape, dtype=torch.float64)
    covariance = np.zeros((len(frames), 4, 4))
    drawn: list[torch.Tensor] = []
    for turn in range(_ROUNDS):
        template = _template(light - rest, values)
        coefficients = spline_coefficients(template)
        drawn = []
        for k in range(len(frames)):
            note(f"register, round {turn + 1}, frame {k + 1} of {len(frames)}")
            try:
                values[k], covariance[k] = _fit(coefficients, light[k] - rest, values[k], noise)
            except RuntimeError:  # a singular matrix: the image is nowhere in the frame
                raise DataError(_unfollowed(f"no place fits frame {k}")) from None
            if not (np.isfinite(values[k]).all() and np.isfinite(covariance[k]).all()):
                raise DataError(_unfollowed(f"no place fits frame {k}"))
            drawn.append(_draw(coefficients, values[k], shape)[0])
        # The template's own size and brightness are free: hold their means at one.
        values[:, 2:] -= values[:, 2:].mean(axis=0)
        if turn + 1 < _ROUNDS:
            rest = (light - torch.stack(drawn)).mean(dim=0)
    _check(values[:, :2], light, torch.stack(drawn), noise)
    return Registration(
        values[:, :2].copy(),
        np.exp(values[:, 2]),
        covariance,
        template,
        np.exp(values[:, 3]),
        background + rest.numpy(),
    )


def middle_of_light(light: NDArray) -> NDArray[np.float64]:
    """Return the first moments (x, y) of images [..., H, W], pixels, [..., 2]."""
    total = light.sum(axis=(-2, -1))
    x = (light.sum(axis=-2) * np.arange(light.shape[-1])).sum(axis=-1) / total
    y = (light.sum(axis=-1) * np.arange(light.shape[-2])).sum(axis=-1) / total
    return np.stack([x, y], axis=-1)


def _middles(light: torch.Tensor, noise: float) -> NDArray[np.float64]:
    """Return the middle (x, y) of each frame's light above a tenth of its peak, pixels, [N, 2].

    Raises:
        DataError: The peak of a frame does not stand out.
    """
    smooth = torch.nn.functional.avg_pool2d(light[:, None], 3, 1, 1)[:, 0]
    peak = smooth.amax(dim=(1, 2))
    signal = (3 * peak / noise).numpy()  # the mean of nine samples has a third of their noise
    weak, strong = np.flatnonzero(signal < _LEAST_SIGNAL), np.flatnonzero(signal >= _LEAST_SIGNAL)
    if len(weak):
        cure = "leave out these frames, which are before or after the object's sequence"
        if not len(strong) or np.ptp(strong) >= len(strong):
            cure = (
                "the object does not stand out on this wall: take a brighter one, a longer exposure, less noise"
            )
        raise DataError(
            f"the brightest light of {len(weak)} of {len(light)} frames is less than {_LEAST_SIGNAL:g} "
            f"standard deviations above the background (frame {weak[0]}: {signal[weak[0]]:.1f}); {cure}"
        )
    bright = smooth > 0.1 * peak[:, None, None]
    return middle_of_light((light * bright).clamp(min=0).numpy())


def _check(place_px: NDArray[np.float64], light: torch.Tensor, drawn: torch.Tensor, noise: float) -> None:
    """Refuse places that mean nothing.

    Args:
        place_px: Places (x, y), [N, 2].
        light: Frames, [N, H, W].
        drawn: The image in each of them, [N, H, W].
        noise: Standard deviation of a sample's noise.

    Raises:
        DataError: A place lies outside the frames, or the image's shifts explain little of what changes.
    """
    height, width = (int(side) for side in light.shape[1:])
    outside = np.flatnonzero(((place_px < -0.5) | (place_px > np.array([width, height]) - 0.5)).any(axis=1))
    if len(outside):
        x, y = place_px[outside[0]]
        raise DataError(
            _unfollowed(f"frame {outside[0]} has it at ({x:.0f}, {y:.0f}) px of {width} x {height}")
        )
    share = explained_change(light, drawn, noise)
    if share < _LEAST_EXPLAINED:
        raise DataError(
            _unfollowed(
                f"one image that shifts explains {100 * share:.0f} % of what changes between the frames, "
                f"{100 * _LEAST_EXPLAINED:.0f} % is the least"
            )
        )


def explained_change(light: torch.Tensor, drawn: torch.Tensor, noise: float) -> float:
    """Return the share of what changes between frames [N, H, W] that the drawn ones explain; 1 without change.

    Noise of the given standard deviation is nobody's to explain.
    """
    own = noise**2 * (1 - 1 / len(light))
    change, left = (float((one - one.mean(dim=0)).square().mean()) - own for one in (light, light - drawn))
    return 1 - max(left, 0.0) / change if change > 0 else 1.0


def _unfollowed(what: str) -> str:
    return (
        f"the light's middle hardly follows any target: {what}; nothing to track on this wall if it is matte "
        "(`evnlos identify` tells what a setup shows), else show more of the wall"
    )


def _template(light: torch.Tensor, values: NDArray[np.float64]) -> torch.Tensor:
    """Return the mean of the frames, each moved to the middle, scaled and weighed back."""
    height, width = (int(side) for side in light.shape[1:])
    middle = ((height - 1) / 2, (width - 1) / 2)
    v, u = torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64)
    total, seen = light.new_zeros(height, width), light.new_zeros(height, width)
    for coefficients, (x, y, log_size, log_light) in zip(_padded(light), values.tolist(), strict=True):
        size, brightness = np.exp(log_size), np.exp(log_light)
        row, column = (v - middle[0]) * size + y, (u - middle[1]) * size + x
        inside = ((row >= 0) & (row <= height - 1))[:, None] & (column >= 0) & (column <= width - 1)
        moved = _sampled(coefficients, row + MARGIN, column + MARGIN)
        total += torch.where(inside, moved, 0.0) * brightness
        seen += inside * brightness**2
    mean = total / seen.clamp(min=1e-9)
    # Compact: what is left far from the light belongs to the background.
    lit = torch.nn.functional.avg_pool2d(mean[None, None], 3, 1, 1)[0, 0] > _EDGE * mean.max()
    mean = (mean * lit).clamp(min=0)
    x, y = middle_of_light(mean.numpy()).tolist()
    centred = _sampled(_padded(mean), v + y - middle[0] + MARGIN, u + x - middle[1] + MARGIN)
    return torch.nn.functional.pad(centred, (MARGIN,) * 4)


def _padded(images: torch.Tensor) -> torch.Tensor:
    return spline_coefficients(torch.nn.functional.pad(images, (MARGIN,) * 4))


def _sampled(coefficients: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Return a spline on the grid of rows [H] and columns [W]; zero outside the array."""
    height, width = coefficients.shape
    return _basis(row, height) @ coefficients @ _basis(column, width).mT


def _basis(at: torch.Tensor, count: int) -> torch.Tensor:
    """Return the values [len(at), count] of the cubic B-splines at whole numbers."""
    x = (at[:, None] - torch.arange(count, dtype=at.dtype)).abs()
    return (2 - x).clamp(min=0) ** 3 / 6 - 4 * (1 - x).clamp(min=0) ** 3 / 6


def _draw(
    coefficients: torch.Tensor, values: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return g T((p - m) / s) [H, W] and its derivatives by (x, y, ln s, ln g), [4, H, W]."""
    x, y, log_size, log_light = (float(v) for v in values)
    size, brightness = np.exp(log_size), np.exp(log_light)
    dv = (torch.arange(shape[0], dtype=torch.float64) - y) / size
    du = (torch.arange(shape[1], dtype=torch.float64) - x) / size
    row, column = dv + (coefficients.shape[0] - 1) / 2, du + (coefficients.shape[1] - 1) / 2
    picture = brightness * _sampled(coefficients, row, column)
    across, down = (
        brightness * (_sampled(coefficients, row + b, column + a) - _sampled(coefficients, row - b, column - a))
        for a, b in ((0.5, 0.0), (0.0, 0.5))
    )
    along = across * du + down * dv[:, None]
    return picture, torch.stack([-across / size, -down / size, -along, picture])


def _fit(
    coefficients: torch.Tensor, light: torch.Tensor, values: NDArray[np.float64], noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the fitted (x, y, ln s, ln g) of a frame and their covariance."""
    shape = (int(light.shape[0]), int(light.shape[1]))
    for _ in range(_FIT_STEPS):
        step = _newton(coefficients, light, values, shape)[0]
        values = values + np.clip(step, -_STEP, _STEP)
    _, normal, picture = _newton(coefficients, light, values, shape)
    left = float((light - picture)[picture > _EDGE * picture.max()].square().mean())
    return values, max(noise**2, left) * torch.linalg.inv(normal).numpy()


def _newton(
    coefficients: torch.Tensor, light: torch.Tensor, values: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[NDArray[np.float64], torch.Tensor, torch.Tensor]:
    """Return the Gauss-Newton step [4], the normal matrix [4, 4] and the image drawn."""
    picture, slopes = _draw(coefficients, values, shape)
    flat = slopes.flatten(1)  # [4, P]
    normal = flat @ flat.mT
    normal += 1e-9 * torch.diag(normal.diagonal() + 1e-300)
    return torch.linalg.solve(normal, flat @ (light - picture).flatten()).numpy(), normal, picture


_FLOOR = 0.02  # of the frames' peak: light below has no logarithm worth a slope
_LEAST_EVENTS = 200
_WINDOWS_AT_A_TIME = 64


@dataclass(frozen=True, eq=False)
class EventVelocity:
    """Velocities of the image.

    Args:
        time_s: Middle of each window, [M], seconds.
        velocity: (x, y), float64 [M, 2], pixels per second, of the reduced frames.
        variance: Of each component, [M, 2].
    """

    time_s: NDArray[np.float64]
    velocity: NDArray[np.float64]
    variance: NDArray[np.float64]


def event_velocity(
    events: Events, found: Registration, times_s: NDArray[np.float64], window_s: float
) -> EventVelocity | None:
    """Return the velocity in windows between the first and the last frame, None where events say nothing.

    A sliding image changes a pixel's log light L by -grad L . d for a small displacement d, and the pixel
    sends an ON event for each rise by its threshold, an OFF event for each fall. Thresholds and noise rates are
    not known: they are found as the two lines (rate of events over expected change) that fit the frames' own
    displacements. Then ON / a - OFF / b in each window is a linear function of d, solved by least squares with
    the variance of Poisson counts.

    Args:
        events: The stream.
        found: Template and places from the frames.
        times_s: Instants of the frames on the events' clock, [N], seconds.
        window_s: Length of a window, seconds.
    """
    count = int(np.floor((times_s[-1] - times_s[0]) / window_s + 1e-9))
    if count < 1 or len(events) < _LEAST_EVENTS:
        return None
    edges = times_s[0] + np.arange(count + 1) * window_s
    middle = (edges[:-1] + edges[1:]) / 2
    shape = (found.background.shape[0], found.background.shape[1])
    counts = _counts(events, edges, shape)  # [M, 2, P], events a reduced pixel
    place, ends = _between(found.place_px, times_s, middle), _between(found.place_px, times_s, edges)
    slopes = _log_slopes(found, place, shape)  # [M, 2, P]
    change = -np.einsum("maP,ma->mP", slopes, np.diff(ends, axis=0))
    lines = [_line(counts[:, k].ravel(), np.maximum(sign * change, 0).ravel()) for k, sign in ((0, 1), (1, -1))]
    (dark_on, on), (dark_off, off) = lines
    if not (on > 0 and off > 0):
        return None
    signed = (counts[:, 0] - dark_on) / on - (counts[:, 1] - dark_off) / off
    rate = (dark_on + on * np.maximum(change, 0)) / on**2 + (dark_off + off * np.maximum(-change, 0)) / off**2
    # A pixel has no opinion before its light has changed by about a threshold since the recording began.
    awake = np.cumsum(np.abs(change), axis=0) >= 0.5 * (1 / on + 1 / off)
    weight = awake / np.maximum(rate, 1e-12)
    normal = np.einsum("maP,mbP,mP->mab", slopes, slopes, weight)
    right = -np.einsum("maP,mP,mP->ma", slopes, signed, weight)
    told = np.linalg.eigvalsh(normal)[:, 0] > 1e-9
    if not told.any():
        return None
    middle, slopes, signed, weight = middle[told], slopes[told], signed[told], weight[told]
    inverse, right = np.linalg.inv(normal[told]), right[told]
    moved = np.einsum("mab,mb->ma", inverse, right)
    left = signed + np.einsum("maP,ma->mP", slopes, moved)
    spread = float(
        (np.square(left) * weight).sum() / np.count_nonzero(weight)
    )  # above 1 where the image is not what was thought
    variance = np.diagonal(inverse, axis1=1, axis2=2) * max(spread, 1.0) / window_s**2
    return EventVelocity(middle, moved / window_s, variance)


def _counts(events: Events, edges_s: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the events of each window, polarity and reduced pixel, [M, 2, P]."""
    edges = np.round(edges_s * 1e6).astype(np.int64)
    scale = events.height * events.width / (shape[0] * shape[1])
    parts = []
    for start in range(0, len(edges) - 1, _WINDOWS_AT_A_TIME):
        full = event_histogram(events, edges[start : start + _WINDOWS_AT_A_TIME + 1])
        parts.append(reduce_by_area(full, shape) * scale)
    return np.concatenate(parts).reshape(len(edges) - 1, 2, -1).astype(np.float64)


def _log_slopes(
    found: Registration, place_px: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the slopes (x, y) of the log light with the object at each place, [M, 2, P], a pixel."""
    floor = _FLOOR * float(found.template.max())
    slopes = np.empty((len(place_px), 2, shape[0] * shape[1]))
    for k, place in enumerate(place_px):
        light = found.picture(place, shape).numpy()
        # What rests has slopes too, but they do not move.
        down, across = (g / np.maximum(light + found.background, floor) for g in np.gradient(light))
        slopes[k] = across.ravel(), down.ravel()
    return slopes


def _line(counts: NDArray[np.float64], change: NDArray[np.float64]) -> tuple[float, float]:
    """Return (events without change, events per unit of change) by least squares."""
    columns = np.stack([np.ones_like(change), change], axis=1)
    dark, slope = np.linalg.lstsq(columns, counts, rcond=None)[0].tolist()
    return max(dark, 1e-6), slope


def _between(
    place: NDArray[np.float64], times_s: NDArray[np.float64], at_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.stack([np.interp(at_s, times_s, place[:, k]) for k in range(2)], axis=-1)
