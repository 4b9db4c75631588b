"""Where the object's image lies in each frame: the likeliest shift against a template made of them all.

- From the image's motion to the target's: where a camera sees light from a place behind the corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.data.sampling import reduce_by_area
from evnlos.errors import DataError
from evnlos.inverse import BackgroundModel
from evnlos.machine import note
from evnlos.optics.interpolation import MARGIN, spline_coefficients
from evnlos.setups import Setup
from evnlos.types import Plane

_LEAST_FRAMES = 4
_EDGE = 0.02  # of the template's peak; weaker light is left to the background
_LEAST_SIGNAL = 6.0  # standard deviations of the noise that the object's peak must have
_LEAST_EXPLAINED = 0.5  # share of what changes between the frames that one shifted image must explain
_STEP = np.array([2.0, 2.0, 0.2, 0.2])  # largest step of (x, y, ln size, ln brightness), pixels and shares
_REACH = (20, 14)  # cells of the target's plane that the map is fitted on, (x, y), five to a target's side
_SEEN = 0.2  # of the brightest cell's light; darker cells lie partly outside the image
_FIT_STEPS, _ROUNDS, _STATIC_ROUNDS = 2, 8, 20
_ABOVE, _LEAST_SHARE = (
    2.5,
    0.1,
)  # deviations from which a pixel shows the object; share of the wall that is free


def reduced(frames: NDArray, columns: int) -> NDArray:
    """Return frames [N, H, W] of at most so many columns, by area averaging; refuse too few."""
    if len(frames) < _LEAST_FRAMES:
        raise DataError(f"{len(frames)} frames; tracking needs {_LEAST_FRAMES} or more")
    height, width = int(frames.shape[1]), int(frames.shape[2])
    columns = min(columns, width)
    return reduce_by_area(frames, (max(1, round(height * columns / width)), columns))


def static_light(frames: NDArray, degree: int = 2) -> NDArray[np.float64]:
    """Return ambient light as a polynomial through the pixels and times that the object's light does not reach.

    A mean over time would take a slow object for background, and so would a minimum where the object never
    leaves. The object adds light, so samples above the polynomial by more than their noise are dropped, again
    and again until the fit rests.

    Args:
        frames: Real [N, H, W].
        degree: Total degree of the polynomial.

    Returns:
        float64 [H, W], in the frames' unit.

    Raises:
        DataError: Fewer than a tenth of the pixels are free of the object.
    """
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    columns = BackgroundModel(degree).polynomials(shape).numpy().reshape(-1, shape[0] * shape[1]).T  # [P, K]
    middle = np.median(frames, axis=0).ravel().astype(np.float64)
    swing = frames.max(axis=0).ravel() - middle
    used = swing <= np.quantile(swing, 0.5)
    fitted = middle
    for _ in range(_STATIC_ROUNDS):
        if used.mean() < _LEAST_SHARE:
            raise DataError(
                f"{100 * used.mean():.0f} % of the wall is free of the object's light, "
                f"{100 * _LEAST_SHARE:.0f} % is the least; show more of the wall"
            )
        known = np.linalg.lstsq(columns[used], middle[used], rcond=None)[0]
        fitted = (columns @ known).astype(np.float64)
        rest = middle - fitted
        # Half of the noise lies below the polynomial, where no object adds light.
        sigma = np.sqrt(np.mean(np.minimum(rest[used], 0.0) ** 2) * 2)
        before, used = used, rest <= _ABOVE * sigma
        if (before == used).all():
            break
    return fitted.reshape(shape)


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


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """A smooth map from the middle of the light on the sensor to a place on the target's plane.

    Args:
        coefficients: Of 1, u, v, u^2, u v, v^2 for x and y, [6, 2], metres; u, v in half widths.
        shape: Size (H, W) of the image, pixels.
        error_m: Root mean square misfit of the map over the region, metres.
    """

    coefficients: NDArray[np.float64]
    shape: tuple[int, int]
    error_m: float

    def __call__(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places (x, y), metres, [..., 2], of pixels [..., 2]."""
        return _terms(self._scaled(place_px)) @ self.coefficients

    def slope(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return d(x, y) / d(column, row), metres per pixel, [..., 2, 2]."""
        half = 0.5
        steps = half * np.eye(2)
        return np.stack(
            [(self(place_px + step) - self(place_px - step)) / (2 * half) for step in steps], axis=-1
        )

    def _scaled(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        middle = np.array([(self.shape[1] - 1) / 2, (self.shape[0] - 1) / 2])
        return (place_px - middle) / (self.shape[1] / 2)


def plane_map(setup: Setup, shape: tuple[int, int], target_size_m: float = 0.1) -> PlaneMap:
    """Fit the map to the images of small cells all over the target's plane.

    Args:
        setup: The setup.
        shape: Size (H, W) of the image, pixels.
        target_size_m: Side of a target plane, metres: the map is fitted on 4 x 2.8 of them.

    Raises:
        DataError: The middle of the light hardly moves with the cell: a matte wall shows no place that way.
    """
    cells = Plane(_REACH[1], _REACH[0], target_size_m / 5)
    pictures = setup.matrix(shape, cells).mT.reshape(-1, *shape).numpy()
    light = pictures.sum(axis=(1, 2))
    border = np.concatenate([pictures[:, 0], pictures[:, -1], pictures[:, :, 0], pictures[:, :, -1]], axis=1)
    whole = border.max(axis=1) < 0.1 * pictures.max(axis=(1, 2))
    used = (light > _SEEN * light.max()) & whole
    if used.sum() < 12:
        raise DataError(
            f"{int(used.sum())} of {len(used)} places of the target's plane make a bounded image, 12 are the "
            "least: this wall does not show where its light comes from; track without the setup"
        )
    place = np.stack(np.meshgrid(cells.x_m, cells.y_m), axis=-1).reshape(-1, 2)[used]
    blank = PlaneMap(np.zeros((6, 2)), shape, 0.0)
    terms = _terms(blank._scaled(middle_of_light(pictures[used])))
    coefficients = np.linalg.lstsq(terms, place, rcond=None)[0].astype(np.float64)
    error = float(np.sqrt(np.mean(np.square(terms @ coefficients - place).sum(axis=1))))
    return PlaneMap(coefficients, shape, error)


def _terms(scaled: NDArray[np.float64]) -> NDArray[np.float64]:
    u, v = scaled[..., 0], scaled[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
