"""Test-time data consistency: move a network's picture to where the calibrated wall agrees with the frame."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from evnlos.dataset import Sampling, Simulation
from evnlos.dataset.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.evaluation.identify_rig import camera_variance
from evnlos.solver.conjugate_gradient import conjugate_gradient
from evnlos.transport import RadiometricTransport
from evnlos.transport.ambient import ambient_plane
from evnlos.types import Plane

_TOLERANCE, _MOST_STEPS = 1e-3, 200


class FrameOperator:
    """What a calibrated rig makes of a picture on the canvas: frame = A x + ambient, at the samples' size.

    Args:
        rig: The calibrated simulation (`rig.yaml` or `training.yaml`).
        sampling: Size of samples and canvas.

    Attributes:
        matrix: A, float32 [h w, cells]: white levels a unit of brightness of a canvas cell.
        ambient: Ambient light, float32 [h w], white levels.
        rows: Rows of the canvas that hold cells; beyond them the target never is.
        sigma: Standard deviation of the noise of a sample pixel, white levels.

    Raises:
        ConfigError: The rig has another transport than a radiometric one.
    """

    def __init__(self, rig: Simulation, sampling: Sampling) -> None:
        if not isinstance(rig.transport, RadiometricTransport):
            raise ConfigError(
                f"the rig's transport is {rig.transport.kind!r}; data consistency needs the radiometric one"
            )
        shape = (rig.sensor.height, rig.sensor.width)
        self.size = (sampling.height, sampling.width)
        self.matrix, source = _matrix(rig.transport, shape, sampling)
        ambient = ambient_plane(rig.transport.ambient, rig.transport.ambient_gradient, shape)
        self.ambient = torch.from_numpy(reduce_by_area(torch.as_tensor(ambient).numpy(), self.size)).flatten()
        first = (sampling.height - source.height) // 2
        self.rows = slice(first, first + source.height)
        self._camera = rig.frame_camera
        self._pixels = shape[0] * shape[1] / (self.size[0] * self.size[1])  # of the sensor, a sample pixel
        self.sigma = float(self.variance(self.ambient.mean() + 0.1 * rig.transport.gain).sqrt())

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
    found = conjugate_gradient(normal, right, tolerance=_TOLERANCE, max_iterations=_MOST_STEPS)
    moved = pictures.clone()
    move = (spread * found.image.squeeze(-2)).unflatten(1, (-1, pictures.shape[2]))
    moved[:, operator.rows] += move
    return moved.clamp(0, 1)


def _matrix(
    transport: RadiometricTransport, shape: tuple[int, int], sampling: Sampling
) -> tuple[Tensor, Plane]:
    """Return the matrix from canvas cells to sample pixels, and the cells."""
    height = min(sampling.height, 2 * round(transport.strip_m[1] / sampling.pitch_m / 2))
    canvas = (sampling.width * sampling.pitch_m, height * sampling.pitch_m)
    fine = replace(transport, cell_m=sampling.pitch_m, strip_m=canvas)
    made = fine.transport(shape)
    cells = made.matrix.shape[1]
    images = (transport.gain * made.matrix).T.reshape(cells, *shape).numpy()
    small = reduce_by_area(images, (sampling.height, sampling.width)).reshape(cells, -1)
    # The gain is defined by a lit square of the strip's height: the strip must keep its height.
    return torch.from_numpy(small).T.contiguous(), fine.source()
