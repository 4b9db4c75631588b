"""How much of what the frames show the pictures explain: the light path run forward again."""

from __future__ import annotations

import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.errors import DataError
from evnlos.evaluation.consistency import FrameOperator
from evnlos.model.plates import on_canvas
from evnlos.types import Plane


def explained(
    pictures: Tensor,
    frames: Tensor,
    position_m: NDArray,
    average: Tensor,
    operator: FrameOperator,
    canvas: Plane,
) -> float:
    """Return the share of what the average object leaves unexplained in the frames that the pictures explain.

    1 - |y - A x - b|^2 / |y - A x0 - b|^2, with x the pictures and x0 the average plate where the plate is.
    1 = the frames are as the pictures make them; 0 = they are as good as those of the average plate, which is
    all that a matte wall can say; below 0 = they are worse: the pictures are not what was in front of the wall,
    or the rig is another.

    Args:
        pictures: Pictures of the canvas, float32 [N, H, W], 0..1.
        frames: Frames of the samples y, float32 [N, h, w], white levels, without fixed pattern.
        position_m: The plate's centre in each, (x, y) in metres, [N, 2].
        average: The average plate, [P, P].
        operator: The rig.
        canvas: Geometry of the pictures.

    Raises:
        DataError: Pictures and frames are not as many, or not of the operator's size.
    """
    if frames.shape != (len(pictures), *operator.size):
        raise DataError(
            f"frames {tuple(frames.shape)} and pictures {tuple(pictures.shape)} do not fit a rig of "
            f"{operator.size[1]} x {operator.size[0]} samples"
        )
    plain = on_canvas(average, canvas, position_m)
    left, before = ((frames - operator(shown)).square().sum() for shown in (pictures, plain))
    return float(1 - left / before.clamp_min(torch.finfo(torch.float32).tiny))
