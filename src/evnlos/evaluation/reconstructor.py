"""One position after the other, as fast as a CPU goes: the network as a graph with its constants folded in."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.config import from_dict
from evnlos.dataset import CHANNELS, Sampling, network_input
from evnlos.errors import DataError
from evnlos.model import JointNetwork, Weights, published_single


class Reconstructor:
    """A network for single positions: the same pictures as `reconstruct`, without Python between its layers.

    The graph is traced at the first use (about a second), for the sampling that the weights were trained on.

    Args:
        weights: Network and paradigm.

    Raises:
        DataError: The network sees a whole pass.

    Example:
        >>> from evnlos.model import ResidualUNet, UNetConfig
        >>> network = ResidualUNet(1, UNetConfig(width=4, depth=1, rank=0)).eval()
        >>> sampling = {"height": 16, "width": 24, "scored_rows": 12}
        >>> see = Reconstructor(Weights(network, "frame", sampling, []))
        >>> see(np.zeros((16, 24)), np.zeros((2, 16, 24))).shape
        torch.Size([16, 24])
    """

    def __init__(self, weights: Weights) -> None:
        self.paradigm = weights.paradigm
        if isinstance(weights.network, JointNetwork):
            names = " or ".join(published_single())
            raise DataError(
                f"these weights see a whole pass; give weights of single positions: {names}, which come with "
                "the package, or your own, trained without --joint"
            )
        self.sampling = from_dict(Sampling, weights.sampling, source="the weights' sampling")
        shape = (1, CHANNELS[weights.paradigm], self.sampling.height, self.sampling.width)  # type: ignore[index]
        network = weights.network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        example = torch.zeros(shape).contiguous(memory_format=torch.channels_last)
        with torch.inference_mode(), warnings.catch_warnings():
            # The sizes are fixed here, which is what the tracer warns of.
            warnings.simplefilter("ignore")
            self._graph = torch.jit.freeze(torch.jit.trace(network, example))

    @torch.inference_mode()
    def __call__(self, frame: NDArray, surface: NDArray) -> Tensor:
        """Return the picture, float32 [H, W], 0..1, of one position.

        Args:
            frame: What the frame camera saw, [H, W], as in `Samples`.
            surface: Time surface, [2, H, W].

        Raises:
            DataError: The maps are not of the size that the network was trained on.
        """
        size = (self.sampling.height, self.sampling.width)
        if np.shape(frame) != size or np.shape(surface) != (2, *size):
            raise DataError(
                f"frame {np.shape(frame)} and surface {np.shape(surface)} do not fit weights for {size}; bring "
                "them to that size by `make_samples`"
            )
        seen = network_input(np.asarray(frame)[None], np.asarray(surface)[None], self.paradigm)  # type: ignore[arg-type]
        return self._graph(seen.contiguous(memory_format=torch.channels_last))[0, 0]
