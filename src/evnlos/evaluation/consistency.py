"""Test-time data consistency: move a network's picture to where the calibrated wall agrees with the frame."""

from __future__ import annotations

import torch
from torch import Tensor

from evnlos.dataset import Sampling
from evnlos.dataset.sampling import reduce_by_area
from evnlos.errors import DataError
from evnlos.evaluation.identify_rig import camera_variance
from evnlos.setups import Setup
from evnlos.setups.base import dense_matrix
from evnlos.types import Plane

_TOLERANCE, _MOST_STEPS = 1e-3, 200


class FrameOperator:
    """What a calibrated setup makes of a picture on the canvas: frame = A x + ambient, at the samples' size.

    Args:
        setup: The calibrated setup (`load_setup` of the calibrated folder).
        sampling: Size of samples and canvas.

    Attributes:
        matrix: A, float32 [h w, cells]: white levels a unit of brightness of a canvas cell.
        ambient: Ambient light, float32 [h w], white levels.
        rows: Rows of the canvas that hold cells; beyond them the target never is.
        sigma: Standard deviation of the noise of a sample pixel, white levels.

    Raises:
        ConfigError: The setup is not linear.
    """

    def __init__(self, setup: Setup, sampling: Sampling) -> None:
        self.size = (sampling.height, sampling.width)
        self.matrix, source = _matrix(setup, sampling)
        self.ambient = torch.from_numpy(reduce_by_area(setup.ambient_light().numpy(), self.size)).flatten()
        first = (sampling.height - source.height) // 2
        self.rows = slice(first, first + source.height)
        self._camera, shape = setup.frame_camera, setup.shape
        self._pixels = shape[0] * shape[1] / (self.size[0] * self.size[1])  # of the sensor, a sample pixel
        self.sigma = float(self.variance(self.ambient.mean() + 0.1 * setup.gain).sqrt())

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return the frames [N, h, w] that the rig makes of pictures [N, H, W]."""
        light = pictures[:, self.rows].flatten(1) @ self.matrix.T + self.ambient  # [N, h w]
        return light.unflatten(1, self.size)

    def variance(self, level: Tensor) -> Tensor:
        """Return the variance of a sample pixel at a level, white levels squared: light, reading, rounding."""
        return camera_variance(level, self._camera) / self._pixels


def consistent(
    pictures: Tensor, frames: Tensor, operator: FrameOperator, trust: float = 1.0, floor: float = 0.003
) -> Tensor:
    """Return the most probable pictures, given the network's answer as a prior and the frames as data.

    x = argmin |A x + b - y|^2 / sigma^2 + sum (x - p)^2 / v, with the variance v = trust (p (1 - p) + floor): a
    network whose output p is the probability of a bright pixel is unsure where p is neither 0 nor 1, and there
    the frame may move it. Conjugate gradients in units of sqrt(v); clipped to 0..1.

    Args:
        pictures: The network's pictures p, float32 [N, H, W], 0..1.
        frames: Frames of the samples y, float32 [N, h, w], white levels, without fixed pattern.
        operator: The rig.
        trust: How much the frames may move the pictures, above 0; 0 returns the pictures.
        floor: Smallest variance of a pixel at trust 1.

    Raises:
        DataError: Pictures and frames are not as many, or not of the operator's size.
    """
    if frames.shape[1:] != operator.size or len(frames) != len(pictures):
        raise DataError(
            f"frames {tuple(frames.shape)} and pictures {tuple(pictures.shape)} do not fit a rig of "
            f"{operator.size[1]} x {operator.size[0]} samples"
        )
    if trust <= 0:
        return pictures
    known = pictures[:, operator.rows].flatten(1)  # [N, cells]
    spread = (trust * (known * (1 - known) + floor)).sqrt()
    matrix = operator.matrix / operator.sigma
    away = ((frames - operator(pictures)) / operator.sigma).flatten(1)  # [N, h w]

    def normal(z: Tensor) -> Tensor:
        pushed = ((spread * z.squeeze(-2)) @ matrix.T) @ matrix
        return z + (spread * pushed).unsqueeze(-2)

    right = (spread * (away @ matrix)).unsqueeze(-2)  # [N, 1, cells]
    from evnlos.solver.conjugate_gradient import conjugate_gradient

    found = conjugate_gradient(normal, right, tolerance=_TOLERANCE, max_iterations=_MOST_STEPS)
    moved = pictures.clone()
    move = (spread * found.image.squeeze(-2)).unflatten(1, (-1, pictures.shape[2]))
    moved[:, operator.rows] += move
    return moved.clamp(0, 1)


def _matrix(setup: Setup, sampling: Sampling) -> tuple[Tensor, Plane]:
    """Return the matrix from canvas cells to sample pixels, and the cells: rows that the target reaches."""
    cells, height = setup.target_cells(), sampling.height
    if cells is not None:
        height = min(height, 2 * round(cells.extent_m[0] / sampling.pitch_m / 2))
    plane = Plane(height, sampling.width, sampling.pitch_m)
    matrix = dense_matrix(setup.operator(plane, dtype=torch.float32), torch.float32)
    images = matrix.T.reshape(-1, *setup.shape).numpy()
    small = reduce_by_area(images, (sampling.height, sampling.width)).reshape(len(images), -1)
    return torch.from_numpy(small).T.contiguous(), plane
