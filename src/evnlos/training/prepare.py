"""What a network takes from the data in closed form, before the first step of its training."""

from __future__ import annotations

import numpy as np
import torch

from evnlos.model import JointNetwork, ResidualUNet
from evnlos.training.source import Source

MOST_SAMPLES = 16_384
"""Samples that the linear embedding is fitted to, at most."""


@torch.inference_mode()
def prepare(
    network: ResidualUNet | JointNetwork, source: Source, seed: int, *, is_new: bool, restandardise: bool
) -> None:
    """Give a new network the scale of the data and its linear embedding; one with weights, at most the scale.

    Args:
        network: The network, changed in place; it need not be on the CPU.
        source: The training's samples.
        seed: Seed of the choice of samples and of the embedding's basis.
        is_new: Whether the network has random weights.
        restandardise: Whether a network with weights takes the scale of these data.
    """
    measures = network.standardise.scaling == "dataset" and (is_new or restandardise)
    embeds = is_new and network.embedding is not None
    if not measures and not embeds:
        return
    inputs, truth, names = source.some(MOST_SAMPLES)
    device = next(network.parameters()).device
    if measures:
        network.standardise.fit(inputs.float().to(device))
    if embeds:
        assert network.embedding is not None
        if len(np.unique(names)) < 2:  # one object: its positions stand for objects
            names = np.arange(len(names)).astype(str)
        seen = torch.cat([network.standardise(part.float().to(device)).cpu() for part in inputs.split(256)])
        network.embedding.fit(seen, truth, names, seed)
