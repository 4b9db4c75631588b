"""Ambient light on the wall: what is there without the hidden object."""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike

from evnlos.errors import ConfigError, DataError


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
