"""Pictures from weights: position by position, or a whole pass at a time."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.errors import DataError
from evnlos.model.joint import JointNetwork
from evnlos.model.unet import ResidualUNet


@torch.inference_mode()
def infer(
    network: ResidualUNet | JointNetwork,
    inputs: Tensor,
    position_m: NDArray | None = None,
    names: NDArray | None = None,
    batch_size: int = 40,
) -> Tensor:
    """Run a network on inputs; a joint one sees all positions of an object together.

    Args:
        network: The network; changed to evaluation mode.
        inputs: What was measured, [N, C, H, W].
        position_m: The plate's centre at each sample, (x, y) in metres, [N, 2]; only a joint network needs it.
        names: Object of each sample, [N]; None: all are of one.
        batch_size: Samples at a time.

    Returns:
        Pictures on the canvas, float32 [N, H, W], 0..1.

    Raises:
        DataError: A joint network is given no positions.
    """
    network = network.eval()
    if isinstance(network, ResidualUNet):
        return torch.cat([network(part.float())[:, 0] for part in inputs.split(batch_size)])
    if position_m is None or np.isnan(position_m).any():
        raise DataError(
            "a joint network has to know where the target was; give the motion in capture.yaml "
            "(`evnlos track` finds it)"
        )
    places = torch.from_numpy(np.asarray(position_m, dtype=np.float32))
    owners = (
        np.zeros(len(inputs), dtype=np.int64) if names is None else np.unique(names, return_inverse=True)[1]
    )
    pictures = inputs.new_zeros((len(inputs), *inputs.shape[-2:]), dtype=torch.float32)
    for owner in range(int(owners.max()) + 1):
        mine = torch.from_numpy(np.flatnonzero(owners == owner)).to(inputs.device)
        at = places[mine.cpu()]
        pictures[mine] = network.drawn(network.see(inputs[mine], at), at)
    return pictures
