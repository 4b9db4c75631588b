"""Samples of a joint network: passes, or parts of them, pooled over their positions as the plate sees them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.dataset import HeldSamples, NlosDataset
from evnlos.errors import DataError
from evnlos.model import JointNetwork
from evnlos.seeds import derive_seed


class PooledSamples(HeldSamples):
    """Some views of each object's pass: all positions, every other one, then random subsets.

    Subsets have other noise and fewer angles on the same plate, so that the network meets short passes too.

    Args:
        samples: The positions.
        network: The joint network, whose embedding pools them.
        views: Views of each object.
        seed: Seed of the subsets.

    Attributes:
        inputs: float16 [M, S, P, P].
        truth: float16 [M, P, P].
        names: The object of each view, [M].

    Raises:
        DataError: The motion of an object is unknown.
    """

    def __init__(self, samples: NlosDataset, network: JointNetwork, views: int, seed: int) -> None:
        inputs, truth, names = [], [], []
        draw = np.random.default_rng(derive_seed(seed, "views"))
        device = next(network.parameters()).device
        for name in dict.fromkeys(samples.names.tolist()):
            mine = np.flatnonzero(samples.names == name)
            if np.isnan(samples.position_m[mine]).any():
                raise DataError(
                    f"the motion of {name} is unknown, and a joint network pools positions; give it in "
                    "capture.yaml, or train on single positions"
                )
            places = torch.from_numpy(samples.position_m[mine])
            plate = network.plate_of(samples.truth[torch.from_numpy(mine)], places).half()
            for view in range(views):
                kept = torch.from_numpy(_view(view, len(mine), draw))
                seen = samples.inputs[torch.from_numpy(mine)[kept]].to(device)
                inputs.append(network.pooled(seen, places[kept]).half().cpu())
                truth.append(plate)
                names.append(name)
        super().__init__(torch.stack(inputs), torch.stack(truth), np.array(names))


def _view(number: int, positions: int, draw: np.random.Generator) -> NDArray[np.int64]:
    """Return the positions of view `number`: 0 all, 1 every other, then at least a quarter at random."""
    if number == 0 or positions == 1:
        return np.arange(positions)
    if number == 1:
        return np.arange(0, positions, 2)
    count = int(draw.integers(max(1, positions // 4), positions + 1))
    return np.sort(draw.permutation(positions)[:count])
