"""How much of what the frames show the pictures explain: the light path run forward again."""

from __future__ import annotations

import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.errors import DataError
from evnlos.evaluation.consistency import FrameOperator
from evnlos.model.plates import on_canvas
from evnlos.types import Plane

_BEYOND_NOISE = 0.05
"""What the average object must leave above the noise, as a share of it, for a picture to be told from it."""
_MAD = 0.6745  # of a normal distribution, in standard deviations


def explained(
    pictures: Tensor,
    frames: Tensor,
    position_m: NDArray,
    average: Tensor,
    operator: FrameOperator,
    canvas: Plane,
) -> float:
    """Return the share of what the average object leaves unexplained in the frames that the pictures explain.

    1 - (|m y - g m A x|^2 - n) / (|m y - g0 m A x0|^2 - n), with x the pictures, x0 the average plate where the
    plate is, and n the noise. m takes what stands still away, each pixel's mean over the pass, and the gains g
    and g0 are the best ones: neither ambient light nor the camera's fixed pattern nor how bright the object is
    has to be known, only what the wall does. 1 = the frames are as the pictures make them; 0 = they are as good
    as those of the average plate, or the frames do not tell objects from it, as before a matte wall; below 0 =
    they are worse: the pictures are not what was in front of the wall, or the wall is another.

    Args:
        pictures: Pictures of the canvas, float32 [N, H, W], 0..1.
        frames: Frames of the samples y, float32 [N, h, w].
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
    noise, seen = _noise(frames, operator), _moving(frames)
    left, before = (_left(_moving(operator(shown)), seen) - noise for shown in (pictures, plain))
    tiny = 1e-9 * seen.square().sum()  # rounding
    if before <= _BEYOND_NOISE * noise + tiny:
        return 0.0
    return float(1 - left.clamp_min(0) / before)


def light_gain(pictures: Tensor, frames: Tensor, operator: FrameOperator) -> float:
    """Return how much brighter the moving light of frames is than the rig makes it from pictures.

    Args:
        pictures: Pictures of the canvas, float32 [N, H, W], 0..1.
        frames: Frames of the samples, float32 [N, h, w], white levels.
        operator: The rig.
    """
    return _gain(_moving(operator(pictures)), _moving(frames))


def _moving(frames: Tensor) -> Tensor:
    """Return frames without what stands still, float64."""
    frames = frames.double()
    return frames - frames.mean(dim=0)


def _gain(made: Tensor, seen: Tensor) -> float:
    return float((made * seen).sum() / made.square().sum().clamp_min(torch.finfo(torch.float64).tiny))


def _left(made: Tensor, seen: Tensor) -> Tensor:
    """Return what moving light that was made leaves of the one seen at the best gain, squared and summed."""
    return (seen - max(_gain(made, seen), 0.0) * made).square().sum()


def _noise(frames: Tensor, operator: FrameOperator) -> Tensor:
    """Return what noise adds to the moving light, squared and summed: from the scatter about the neighbours.

    How the noise grows with the level is told by the rig's camera, how strong it is by the frames. The light
    moves slowly and over few pixels; the median over the pixels is that of the others. In time alone:
    `temporal_noise` also takes differences between neighbours, but samples share the sensor's pixels with
    theirs, so that it finds a tenth too little here.
    """
    if len(frames) < 3:
        return torch.zeros((), dtype=torch.float64)
    frames = frames.double()
    beside = 0.5 * (frames[2:] + frames[:-2])
    spread = (frames[1:-1] - beside) / (1.5 * operator.variance(beside)).sqrt()
    excess = (spread.flatten(1).abs().median(dim=1).values.median() / _MAD).square()
    return excess * operator.variance(frames).sum() * (1 - 1 / len(frames))
