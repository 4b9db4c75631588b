"""One time step after the other, as fast as a CPU goes: the network as a graph with its constants folded in."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.errors import DataError
from evnlos.model import Weights, published_single


class StreamingReconstructor:
    """A network of single time steps: the same images as `reconstruct`, without Python between its layers.

    The graph is traced at the first use (about a second), for the sampling that the weights were trained on.

    Args:
        weights: The network.

    Raises:
        DataError: The network sees whole sequences.

    Example:
        >>> from evnlos.dataset import Sampling
        >>> from evnlos.model import UNetConfig
        >>> sampling = Sampling(height=16, width=24, scored_rows=12)
        >>> network = UNetConfig(width=4, depth=1, rank=0).build("frame", sampling)
        >>> see = StreamingReconstructor(Weights(network))
        >>> see(np.zeros((16, 24)), np.zeros((2, 16, 24))).shape
        torch.Size([16, 24])
    """

    def __init__(self, weights: Weights) -> None:
        self.modality, self.sampling = weights.modality, weights.sampling
        if weights.network.sees_sequence:
            names = " or ".join(published_single())
            raise DataError(
                f"these weights see whole sequences; give weights of single time steps: {names}, which come "
                "with the package, or your own, trained with --network.kind unet"
            )
        shape = (1, self.modality.channels, self.sampling.height, self.sampling.width)
        network = weights.network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        example = torch.zeros(shape).contiguous(memory_format=torch.channels_last)
        with torch.inference_mode(), warnings.catch_warnings():
            # The sizes are fixed here, which is what the tracer warns of.
            warnings.simplefilter("ignore")
            self._graph = torch.jit.freeze(torch.jit.trace(network, example))

    @torch.inference_mode()
    def __call__(self, frame: NDArray, surface: NDArray) -> Tensor:
        """Return the image, float32 [H, W], 0..1, of one time step.

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
        seen = self.modality.inputs(np.asarray(frame)[None], np.asarray(surface)[None])
        return self._graph(seen.contiguous(memory_format=torch.channels_last))[0, 0]
