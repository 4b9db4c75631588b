"""Linear operators between grids of patches: what a transport must offer.

- A grid of rectangular patches, for screens and walls whose samples are not square or do not touch.
- The operator protocol: a transport maps a scene image to a wall image; a linear one also has its adjoint.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch.nn.functional import pad

from evnlos.errors import ConfigError, DataError
from evnlos.machine import note
from evnlos.types import Plane

_COLUMNS = 256  # unit images carried over at a time


@dataclass(frozen=True, eq=False)
class Patches:
    """Equal rectangles at the crossings of given columns and rows.

    Args:
        x_m: Middles of the columns, float64 [W], metres, to the right.
        y_m: Middles of the rows, float64 [H], metres, downwards.
        size_m: Width and height of one patch, metres.

    Raises:
        DataError: A list of middles is empty or not finite, or a patch has no size.

    Example:
        >>> Patches([0.2, 0.1], [0.0, 0.1, 0.2], (0.08, 0.05)).shape
        (3, 2)
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    size_m: tuple[float, float]

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m"):
            object.__setattr__(self, name, _middles(getattr(self, name), name))
        width, height = (float(side) for side in self.size_m)
        if not (np.isfinite([width, height]).all() and width > 0 and height > 0):
            raise DataError(f"Patches.size_m is {self.size_m}; give a positive width and height, metres")
        object.__setattr__(self, "size_m", (width, height))

    @property
    def height(self) -> int:
        """Number of rows."""
        return len(self.y_m)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.x_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Size (rows, columns)."""
        return self.height, self.width


def as_patches(grid: Plane | Patches) -> Patches:
    """Return the touching squares of a sampled plane, or the patches themselves."""
    if isinstance(grid, Patches):
        return grid
    return Patches(grid.x_m, grid.y_m, (grid.pitch_m, grid.pitch_m))


def _middles(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)  # a copy: the caller's array stays his own
    if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
        raise DataError(f"Patches.{name} must be one or more finite numbers, metres")
    array.setflags(write=False)
    return array


class Transport(ABC):
    """A map from images on a source plane, [..., h, w], to images [..., H, W]; linear only if
    `LinearTransport`.

    Attributes:
        source: Plane, or grid of patches, on which the input image is sampled.
    """

    source: Plane | Patches

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the images that the transport makes."""

    @property
    def output(self) -> Plane | None:
        """Plane on which the result is sampled; None when it is a camera image."""
        return None

    @abstractmethod
    def _forward(self, scene: torch.Tensor) -> torch.Tensor: ...

    def __call__(self, scene: torch.Tensor) -> torch.Tensor:
        """Carry a scene image to the other side.

        Args:
            scene: Real image [..., h, w] on `source`, float32 or float64, any device; leading axes are a batch.

        Returns:
            Image [..., H, W] of the same type.

        Raises:
            DataError: The image does not have the size of `source` or is not real floating point.
        """
        return self._forward(_checked(scene, self.source.shape, "scene"))

    def then(self, following: Transport) -> Transport:
        """Return the transport that applies this one and then `following`; linear if both are."""
        return compose(self, following)


class LinearTransport(Transport):
    """A transport with A(a x + b y) = a A x + b A y, and therefore an adjoint."""

    @abstractmethod
    def _adjoint(self, image: torch.Tensor) -> torch.Tensor: ...

    def adjoint(self, image: torch.Tensor) -> torch.Tensor:
        """Apply the transpose, for which <A x, y> = <x, A^T y>.

        Args:
            image: Real image [..., H, W] of the size that the transport makes.

        Returns:
            Image [..., h, w] on `source`.

        Raises:
            DataError: The image does not have the size `shape` or is not real floating point.
        """
        return self._adjoint(_checked(image, self.shape, "image"))

    def dense(self, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Return the matrix of the map, [H W, h w], rows and columns in row-major order.

        Args:
            dtype: Floating-point type of the matrix, and of the images that it is found from.
        """
        return dense_matrix(self, torch.zeros(self.source.shape, dtype=dtype))


def compose(*transports: Transport) -> Transport:
    """Return the transport that applies the given ones in order; it is linear if all of them are.

    Args:
        transports: One or more; each takes images of the size that the one before makes.

    Raises:
        ConfigError: Nothing was given, or a transport makes images of another size than the next one takes.
    """
    if not transports:
        raise ConfigError("compose() got no transport; give one or more")
    for first, second in pairwise(transports):
        if first.shape != second.source.shape:
            raise ConfigError(
                f"a transport makes {first.shape} samples, the next one takes {second.source.shape}"
            )
    linear = [transport for transport in transports if isinstance(transport, LinearTransport)]
    return LinearChain(tuple(linear)) if len(linear) == len(transports) else Chain(tuple(transports))


class Chain(Transport):
    """Transports applied one after the other; built by `compose`."""

    def __init__(self, steps: tuple[Transport, ...]) -> None:
        self.steps = steps
        self.source = steps[0].source

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the last step's images."""
        return self.steps[-1].shape

    @property
    def output(self) -> Plane | None:
        """Plane of the last step."""
        return self.steps[-1].output

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        return reduce(lambda image, step: step(image), self.steps, scene)


class LinearChain(Chain, LinearTransport):
    """Linear transports applied one after the other; built by `compose`."""

    steps: tuple[LinearTransport, ...]  # pyright: ignore[reportIncompatibleVariableOverride]

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        return reduce(lambda wall, step: step.adjoint(wall), reversed(self.steps), image)


class MatrixTransport(LinearTransport):
    """A transport given by its matrix, for walls that no convolution describes.

    Args:
        matrix: Real tensor [H W, h w], rows and columns in row-major order.
        source: Plane or patches of the scene image, h x w.
        shape: Size (H, W) of the images that it makes.

    Raises:
        ConfigError: The matrix does not have H W rows and h w columns.
    """

    def __init__(self, matrix: torch.Tensor, source: Plane | Patches, shape: tuple[int, int]) -> None:
        expected = (shape[0] * shape[1], source.height * source.width)
        if tuple(matrix.shape) != expected:
            raise ConfigError(f"the matrix is {tuple(matrix.shape)}; these planes need {expected}")
        self.matrix = matrix
        self.source = source
        self._shape = (int(shape[0]), int(shape[1]))

    @property
    def shape(self) -> tuple[int, int]:
        """Size (H, W) of the images that it makes."""
        return self._shape

    def _forward(self, scene: torch.Tensor) -> torch.Tensor:
        image = scene.flatten(-2) @ self.matrix.to(scene).mT  # [..., H W]
        return image.unflatten(-1, self.shape)

    def _adjoint(self, image: torch.Tensor) -> torch.Tensor:
        scene = image.flatten(-2) @ self.matrix.to(image)  # [..., h w]
        return scene.unflatten(-1, self.source.shape)


_NEAR = 4  # matrices that one in between is made of
# Coefficients of Lagrange's cubics over the steps -1, 0, 1, 2, [power, matrix]
_LAGRANGE = np.linalg.inv(np.vander(np.arange(-1.0, _NEAR - 1.0), increasing=True))
DEPTH_STEP = 0.05
"""Of the distance's logarithm between two matrices, to begin with: less than most walls' blur."""
_DEPTH_ERROR = 1e-3  # of the light, root mean square
_MOST_HALVINGS, _SKETCH = 3, 64  # of the step; images that a basis grows by


class DepthTransport:
    """Matrices from a plane of cells at any distance from the wall: A(d) = U C(d).

    U [P, r] are orthonormal camera images, the same at all distances; C(d) [r, cells] is interpolated in ln d
    by Lagrange's cubics. What is further away is smaller in the image, more blurred, dimmer and seen elsewhere.
    `error` is that of A(d), relative and root mean square: the largest of those amid three steps.
    Steps of the distance are halved, and images added, until it is 1e-3.

    Args:
        matrix: Exact matrix [P, cells] at a distance, metres.
        low_m: Smallest distance, metres.
        high_m: Largest distance, metres.
        source: The cells.
        shape: Size (H, W) of the images, pixels.

    Raises:
        ConfigError: Steps 8 times as fine do not suffice.
    """

    def __init__(
        self,
        matrix: Callable[[float], torch.Tensor],
        low_m: float,
        high_m: float,
        source: Plane,
        shape: tuple[int, int],
    ) -> None:
        self.source, self.shape, self.low_m, self.high_m = source, shape, low_m, high_m
        self.basis = torch.zeros(shape[0] * shape[1], 0)
        low, high = math.log(low_m), math.log(high_m)
        steps = max(_NEAR - 1, math.ceil((high - low) / DEPTH_STEP))
        made: dict[int, torch.Tensor] = {}  # C at places of the finest grid
        finest = steps * 2**_MOST_HALVINGS
        for halving in range(_MOST_HALVINGS + 1):
            self._low, self._step = low, (high - low) / (steps * 2**halving)
            for k in sorted({*range(0, finest + 1, 2 ** (_MOST_HALVINGS - halving))} - made.keys()):
                there_m = math.exp(low + k * (high - low) / finest)
                note(f"light path at {there_m:.3f} m")
                made[k] = self._added(matrix(there_m), _DEPTH_ERROR / 4)
            rank = self.basis.shape[1]
            self.nodes = torch.stack([pad(one, (0, 0, 0, rank - len(one))) for _, one in sorted(made.items())])
            values, ways = torch.linalg.eigh(torch.einsum("grc,gsc->rs", self.nodes, self.nodes).double())
            carries = values.cumsum(0) > (_DEPTH_ERROR / 4) ** 2 * values.sum()
            ways = ways[:, carries].float()
            basis, self.basis, self.nodes = self.basis, self.basis @ ways, ways.mT @ self.nodes
            self.error = self._worst(matrix)
            if self.error <= _DEPTH_ERROR:
                return
            self.basis = basis
        raise ConfigError(
            f"matrices interpolated over the distance are off by {self.error:.2g} of the light, "
            f"{_DEPTH_ERROR:g} is the most; give a rougher wall, or a path with less depth"
        )

    def coefficients(self, distance_m: float) -> torch.Tensor:
        """Return C(d), [r, cells], at a distance in metres."""
        first, along = self._place(distance_m)
        return self._sum(np.power(along, np.arange(_NEAR)) @ _LAGRANGE, first)

    def slope(self, distance_m: float) -> torch.Tensor:
        """Return the derivative of C by ln d, [r, cells], at a distance in metres."""
        first, along = self._place(distance_m)
        powers = np.arange(1, _NEAR)
        return self._sum(powers * np.power(along, powers - 1) @ _LAGRANGE[1:] / self._step, first)

    def at(self, distance_m: float) -> MatrixTransport:
        """Return the matrix at a distance in metres."""
        return MatrixTransport(self.basis @ self.coefficients(distance_m), self.source, self.shape)

    def _sum(self, weights: NDArray[np.floating], first: int) -> torch.Tensor:
        near = self.nodes[first : first + _NEAR]
        return torch.einsum("g,grc->rc", torch.from_numpy(weights).to(near), near)

    def _place(self, distance_m: float) -> tuple[int, float]:
        """Return the first matrix around a distance, and the place between the middle two, in steps."""
        if not self.low_m * (1 - 1e-9) <= distance_m <= self.high_m * (1 + 1e-9):
            raise DataError(
                f"{distance_m:g} m is not between {self.low_m:g} and {self.high_m:g} m; ask for that"
            )
        steps = (math.log(distance_m) - self._low) / self._step
        first = min(max(int(steps) - 1, 0), len(self.nodes) - _NEAR)
        return first, steps - first - 1

    def _added(self, matrix: torch.Tensor, tolerance: float) -> torch.Tensor:
        """Return U^T A of a matrix [P, cells], with images added to U until the rest is below the tolerance."""
        matrix = matrix.float()
        draw, limit = torch.Generator().manual_seed(0), tolerance * float(matrix.norm())
        rest = matrix - self.basis @ (self.basis.mT @ matrix)
        while float(rest.norm()) > limit:
            probes = torch.randn(matrix.shape[1], _SKETCH, generator=draw)
            images = torch.linalg.qr(rest @ (rest.mT @ (rest @ probes)))[0]
            turn, light, _ = torch.linalg.svd(images.mT @ rest, full_matrices=False)
            images = images @ turn[:, light > 0.05 * limit]  # the others are rounding
            images = torch.linalg.qr(images - self.basis @ (self.basis.mT @ images))[0]
            self.basis = torch.cat([self.basis, images], dim=1)
            rest = rest - images @ (images.mT @ rest)
        return self.basis.mT @ matrix

    def _worst(self, matrix: Callable[[float], torch.Tensor]) -> float:
        last, worst = len(self.nodes) - 2, 0.0
        for k in {0, last // 2, last}:
            far_m = math.exp(self._low + (k + 0.5) * self._step)
            exact = matrix(far_m).float()
            worst = max(worst, float((self.at(far_m).matrix - exact).norm() / exact.norm()))
        return worst


def dense_matrix(operator: Callable[[torch.Tensor], torch.Tensor], like: torch.Tensor) -> torch.Tensor:
    """Return the matrix [outputs, h w] of an operator, column by column, in the type of `like` [h, w].

    A `MatrixTransport` hands over the matrix that it holds.

    Args:
        operator: A linear map.
        like: An image that it takes, [h, w]; its values are not used, its size, type and device are.
    """
    held = getattr(operator, "matrix", None)
    if isinstance(held, torch.Tensor):
        return held.to(like)
    count = like.numel()
    columns = []
    for start in range(0, count, _COLUMNS):
        stop = min(start + _COLUMNS, count)
        note(f"light path, {start} of {count} cells")
        units = torch.eye(stop - start, count, dtype=like.dtype, device=like.device).roll(start, 1)
        columns.append(operator(units.reshape(-1, *like.shape)).flatten(1).mT)  # [outputs, columns]
    return torch.cat(columns, dim=1)


def _checked(image: torch.Tensor, shape: tuple[int, int], name: str) -> torch.Tensor:
    if image.ndim < 2 or tuple(image.shape[-2:]) != shape:
        raise DataError(
            f"{name} has shape {tuple(image.shape)}; this transport takes [..., {shape[0]}, {shape[1]}]"
        )
    if not image.is_floating_point():
        raise DataError(f"{name} has dtype {image.dtype}; give float32 or float64")
    return image
