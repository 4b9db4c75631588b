"""Light on the wall in continuous time: an image that slides, ambient light, strips of rows.

- Ambient light on the wall: what is there without the hidden object.
- Light of a sliding wall for any of its pixels: no more of an image than is requested.
- The wall that the camera sees, in continuous time: an image that slides under a shift-invariant transport.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch.nn.functional import pad

from evnlos.errors import ConfigError, DataError
from evnlos.optics.interpolation import (
    MARGIN,
    box_average,
    spline_coefficients,
    spline_sample,
    spline_scattered,
)
from evnlos.optics.view import View
from evnlos.scene import Motion
from evnlos.types import Plane


def ambient_map(ambient: float | ArrayLike | torch.Tensor, shape: tuple[int, int]) -> torch.Tensor:
    """Return ambient light as a map [H, W], float32, white levels, refusing negative light."""
    level = torch.as_tensor(ambient, dtype=torch.float32)
    if level.ndim and tuple(level.shape) != shape:
        raise DataError(f"the ambient light is {tuple(level.shape)}; give a number or {shape}")
    if not bool((torch.isfinite(level) & (level >= 0)).all()):
        raise ConfigError(
            f"the ambient light reaches {float(level.min())}; give 0 or more white levels everywhere"
        )
    return level.expand(shape).clone()


def ambient_plane(level: float, gradient: tuple[float, float], shape: tuple[int, int]) -> torch.Tensor:
    """Return ambient light that grows linearly: level (1 + gx x + gy y), x and y from -1 to 1 over the image.

    Args:
        level: Light in the middle of the image, white levels.
        gradient: Relative growth (gx, gy) from the middle to the right and the lower border.
        shape: Size (H, W), pixels.

    Example:
        >>> ambient_plane(0.1, (0.5, 0.0), (1, 3))
        tensor([[0.0500, 0.1000, 0.1500]])
    """
    y = torch.linspace(-1, 1, shape[0]) if shape[0] > 1 else torch.zeros(1)
    x = torch.linspace(-1, 1, shape[1]) if shape[1] > 1 else torch.zeros(1)
    return ambient_map(level * (1 + gradient[1] * y[:, None] + gradient[0] * x), shape)


@dataclass(frozen=True)
class ImageStrips:
    """A sliding wall's light at some instants, of which any pixels can be had without the others.

    Args:
        band: Spline coefficients at the camera's rows, float32 or float64 [H, C]; zero outside.
        starts: Column of the band that the first tap of a row's pixel 0 reads at each instant, [T].
        taps: The four weights at each instant, float32 [T, 4].
        gain: White levels per unit of the band.
        ambient: Ambient light, float32 [H, W], white levels.
    """

    band: NDArray
    """Spline coefficients at the camera's rows [H, C]."""
    starts: NDArray[np.int64]
    """Column of the band under each row's first pixel, [T]."""
    taps: NDArray[np.float32]
    """The four weights [T, 4]."""
    gain: float
    """White levels per unit of the band."""
    ambient: NDArray[np.float32]
    """Ambient light [H, W], white levels."""

    def __len__(self) -> int:
        """Number of instants."""
        return len(self.starts)

    def __getitem__(self, instants: slice) -> ImageStrips:
        """Return the light at some of the instants."""
        return ImageStrips(self.band, self.starts[instants], self.taps[instants], self.gain, self.ambient)

    def write(self, first: int, out: NDArray[np.float32], white: float = 1.0) -> None:
        """Write the irradiance of the pixels first, first + 1, ..., counted along the rows, to `out` [T, N].

        `white` is the number that stands for a white level.
        """
        from evnlos.optics.interpolation import expose_shifted  # numba loads slowly

        expose_shifted(out, first, self.band, self.starts, self.taps, self.gain, self.ambient, white)


_MAX_CANVAS = 8192  # pixels per side
_SAME_ROWS_PX = 1e-9


class SlidingWall:
    """A wall image that follows the target: what a shift-invariant transport makes of a translating target.

    irradiance(p, t) = gain W(A p - m(t)) + ambient(p), with W the wall image of the target at the origin, A the
    view and m the motion. W is averaged over a pixel's area (of mean size where the
    view is oblique) and interpolated by a cubic B-spline, so each pixel's signal has two continuous
    derivatives in time and no event is timed by the interpolation. For an affine view W is carried to the
    camera's pixel grid once; a frame is then a sub-pixel shift. Negative light, which interpolation could make,
    is cut at zero.

    Args:
        image: Wall image of the target at the origin, real [h, w]; zero beyond its borders.
        plane: Plane on which `image` is sampled.
        view: The camera's view of the wall.
        motion: Where the target's centre is at every instant.
        gain: White levels per unit of `image`, 0 or more.
        ambient: Light that is always there, white levels: a number or an array [H, W], 0 or more.

    Raises:
        ConfigError: The gain or the ambient light is negative or not finite, or the image of the target is
            too large.
        DataError: The image does not have the size of the plane, or the ambient array that of the view.
    """

    def __init__(
        self,
        image: torch.Tensor,
        plane: Plane,
        view: View,
        motion: Motion,
        *,
        gain: float = 1.0,
        ambient: float | ArrayLike | torch.Tensor = 0.0,
    ) -> None:
        if tuple(image.shape) != plane.shape:
            raise DataError(f"the wall image is {tuple(image.shape)}; its plane has {plane.shape} samples")
        check_gain(gain)
        self.view = view
        self.motion = motion
        self.gain = float(gain)
        self.ambient = ambient_map(ambient, view.shape).to(image.device)
        self._plane = plane
        work = image.to(torch.promote_types(image.dtype, torch.float32))
        pixel = view.pixel_size_m().mean(dim=(0, 1)) / plane.pitch_m  # samples per pixel, across and down
        self._margin = MARGIN + math.ceil(float(pixel.max()))
        coefficients = spline_coefficients(pad(work, (self._margin,) * 4))
        self._wall = box_average(coefficients, float(pixel[1]), float(pixel[0]))
        self._band: tuple[float, torch.Tensor] | None = None
        if view.is_affine:
            self._carry_to_pixels()
        else:
            self._points = view.wall_points_m().to(work.device)  # [H, W, 2]

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the camera image, pixels."""
        return self.view.shape

    @property
    def speed_px_s(self) -> float:
        """Upper bound of the speed of the image on the sensor, pixels per second."""
        # an affine view magnifies alike everywhere: one pixel tells
        view = _shifted_view(self.view, (0, 0), (1, 1)) if self.view.is_affine else self.view
        return self.motion.speed_bound_m_s(-math.inf, math.inf) * view.magnification()

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
        image = self.ambient.new_empty((len(positions), *self.shape))
        if self._compiled:
            self._write(positions, image)
        else:
            frame = self._shifted if self.view.is_affine else self._projected
            for k, (x, y) in enumerate(positions.tolist()):
                image[k] = frame(x, y).clamp(min=0) * self.gain + self.ambient
        return image.reshape((*times.shape, *self.shape))

    def strips(self, t_s: ArrayLike) -> ImageStrips | None:
        """Return the light at times `t_s` [T] for any pixels; None where only whole images can be rendered.

        It can be had where the view is affine, the wall lies in main memory and the target moves along the
        rows; not of a subclass with an `irradiance` of its own.
        """
        if not self._compiled or type(self).irradiance is not SlidingWall.irradiance:
            return None
        return self._strips(self.motion.position_m(checked_times(t_s)).reshape(-1, 2))

    @property
    def _compiled(self) -> bool:
        return self.view.is_affine and self._canvas.device.type == "cpu" and not self._canvas.requires_grad

    def _carry_to_pixels(self) -> None:
        """Sample the wall image on the camera's pixel grid, over all of its support."""
        height, width = (side * self._plane.pitch_m / 2 for side in self._plane.shape)
        cx, cy = self._plane.center_m
        corners = [(cx + a * width, cy + b * height) for a in (-1, 1) for b in (-1, 1)]
        pixels = self.view.pixels(torch.tensor(corners, dtype=torch.float64))
        low = pixels.amin(dim=0).floor().long() - MARGIN
        size = pixels.amax(dim=0).ceil().long() + MARGIN + 1 - low
        if int(size.max()) > _MAX_CANVAS:
            raise ConfigError(
                f"the target's image is {int(size[0])} x {int(size[1])} pixels, above {_MAX_CANVAS}; "
                "lower the magnification or the length of the tPSF"
            )
        self._low = (int(low[0]), int(low[1]))
        units = self.view.pixels(torch.tensor([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], dtype=torch.float64))
        self._pixels_per_m = (units[1:] - units[0]).tolist()  # how far a metre along x, along y moves the image
        canvas_view = _shifted_view(self.view, self._low, (int(size[1]), int(size[0])))
        points = canvas_view.wall_points_m().to(self._wall.device)
        self._canvas = spline_coefficients(spline_sample(*self._at(points, 0.0, 0.0))).contiguous()

    def _at(
        self, points_m: torch.Tensor, x_m: float, y_m: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the wall's coefficients, and row and column of points [H, W, 2], with the target at (x, y)."""
        x, y = points_m.unbind(-1)
        plane = self._plane
        column = (x - x_m - plane.center_m[0]) / plane.pitch_m + (plane.width - 1) / 2 + self._margin
        row = (y - y_m - plane.center_m[1]) / plane.pitch_m + (plane.height - 1) / 2 + self._margin
        return self._wall, row, column

    def _projected(self, x_m: float, y_m: float) -> torch.Tensor:
        return spline_scattered(*self._at(self._points, x_m, y_m))  # an oblique grid is tilted

    def _shifted(self, x_m: float, y_m: float) -> torch.Tensor:
        """Return the canvas displaced by the motion: four taps along each axis, the same for all pixels."""
        (across,), (down,) = self._pixels(np.array([(x_m, y_m)]))
        whole, taps = _taps(-float(across))
        window = _window(self._rows(float(down)), whole - 1 - self._low[0], self.shape[1] + 3)
        frame = taps[0] * window[:, : self.shape[1]]
        for k in range(1, 4):
            frame = frame + taps[k] * window[:, k : k + self.shape[1]]
        return frame

    def _write(self, positions_m: NDArray[np.float64], image: torch.Tensor) -> None:
        """Write the frames with the target at positions [T, 2] to `image`; `_shifted` is the slow reference."""
        strips = self._strips(positions_m)
        if strips is not None:
            strips.write(0, image.flatten(1).numpy())
        else:
            for k in range(len(image)):
                self._write(positions_m[k : k + 1], image[k : k + 1])

    def _strips(self, positions_m: NDArray[np.float64]) -> ImageStrips | None:
        """Return the light with the target at positions [T, 2], unless they differ across the rows."""
        across, down = self._pixels(positions_m)
        if len(down) and float(np.ptp(down)) > _SAME_ROWS_PX:
            return None
        band = self._rows(float(down[0]) if len(down) else 0.0)
        shifts = [_taps(-shift) for shift in across.tolist()]
        starts = np.array([whole - 1 - self._low[0] for whole, _ in shifts], np.int64)
        taps = np.array([weights for _, weights in shifts], np.float32).reshape(-1, 4)
        return ImageStrips(band.numpy(), starts, taps, self.gain, self.ambient.numpy())

    def _pixels(self, positions_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how far positions [T, 2] move the image, pixels along the rows and across them."""
        (right_x, right_y), (down_x, down_y) = self._pixels_per_m
        x, y = positions_m.T
        return right_x * x + down_x * y, right_y * x + down_y * y

    def _rows(self, down: float) -> torch.Tensor:
        """Return the canvas at the camera's rows; motion along the rows asks for the same ones again."""
        if self._band is not None and abs(self._band[0] - down) <= _SAME_ROWS_PX:
            return self._band[1]
        whole, taps = _taps(-down)
        start = whole - 1 - self._low[1]
        window = _window(self._canvas.mT, start, self.shape[0] + 3).mT  # [H + 3, canvas width]
        band = sum(
            (taps[k] * window[k : k + self.shape[0]] for k in range(1, 4)), taps[0] * window[: self.shape[0]]
        )
        band = band.contiguous()
        self._band = (down, band)
        return band


def check_gain(gain: float) -> None:
    """Refuse a gain that is negative or not finite."""
    if not (math.isfinite(gain) and gain >= 0):
        raise ConfigError(f"gain is {gain}; give 0 or more white levels")


def checked_times(t_s: ArrayLike) -> NDArray[np.float64]:
    """Return times as float64 of shape [] or [T], refusing more axes."""
    times = np.asarray(t_s, dtype=np.float64)
    if times.ndim > 1:
        raise DataError(f"t_s has shape {times.shape}; give one time or a 1-D array of times")
    return times


def _taps(shift: float) -> tuple[int, list[float]]:
    """Return the whole part of a shift and `spline_weights` at its fraction, in plain numbers: much quicker."""
    whole = math.floor(shift)
    f = shift - whole
    g = 1 - f
    left, right = (4 - 6 * (f * f) + 3 * (f * f * f)) / 6, (4 - 6 * (g * g) + 3 * (g * g * g)) / 6
    return whole, [g * g * g / 6, left, right, f * f * f / 6]


def _window(image: torch.Tensor, start: int, length: int) -> torch.Tensor:
    """Return columns start..start + length of `image`, zero outside it."""
    width = image.shape[-1]
    first, last = max(0, min(start, width)), max(0, min(start + length, width))
    if last <= first:
        return image.new_zeros((*image.shape[:-1], length))
    return pad(image[..., first:last], (first - start, start + length - last))


def _shifted_view(view: View, low: tuple[int, int], shape: tuple[int, int]) -> View:
    """Return the view whose pixel (0, 0) is pixel `low` (column, row) of `view`."""
    (a, b, c), (d, e, f), last = view.matrix
    u, v = low
    return View(shape, ((a, b, c + a * u + b * v), (d, e, f + d * u + e * v), last))
