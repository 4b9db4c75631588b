"""The plate in a picture: the square that holds the hidden object, cut out wherever it is."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor

from evnlos.types import Plane

SIDE = 32
"""Side of a plate's picture, pixels."""


def plates(images: Tensor, canvas: Plane, position_m: ArrayLike, size_m: float = 0.08) -> Tensor:
    """Return the part of each picture that shows the plate, resampled to 32 x 32.

    Args:
        images: Pictures of the canvas, float [N, H, W].
        canvas: Their geometry.
        position_m: Centre (x, y) of the plate in each picture, [N, 2], metres.
        size_m: Side of the plate, metres.

    Returns:
        float32 [N, 1, 32, 32]; zero outside the canvas.
    """
    centre = torch.as_tensor(np.asarray(position_m), dtype=torch.float32)  # [N, 2]
    span = torch.tensor([canvas.width, canvas.height]) * (canvas.pitch_m / 2)
    ticks = (torch.arange(SIDE) + 0.5) / SIDE * size_m - size_m / 2
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    middle = torch.tensor(canvas.center_m, dtype=torch.float32)
    points = torch.stack([x, y], dim=-1) + (centre - middle)[:, None, None]  # [N, 32, 32, 2]
    return F.grid_sample(images[:, None].float(), points / span, align_corners=False)


def on_canvas(plate: Tensor, canvas: Plane, position_m: ArrayLike, size_m: float = 0.08) -> Tensor:
    """Return pictures of the canvas that show one plate at each position; `plates` takes it out again.

    Args:
        plate: Picture of the plate, float [P, P].
        canvas: Geometry of the pictures.
        position_m: Centre (x, y) of the plate in each picture, [N, 2], metres.
        size_m: Side of the plate, metres.

    Returns:
        float32 [N, H, W]; zero beside the plate.
    """
    centre = torch.as_tensor(position_m, dtype=torch.float32, device=plate.device)
    y, x = (torch.from_numpy(at).float().to(plate.device) for at in (canvas.y_m, canvas.x_m))
    place = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1)  # [H, W, 2]
    grid = (place - centre[:, None, None]) / (size_m / 2)
    return F.grid_sample(plate.float().expand(len(grid), 1, -1, -1), grid, align_corners=False)[:, 0]
