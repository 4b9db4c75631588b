"""Networks, one page each, and their weights on disk."""

from evnlos.model.linear import LinearEstimate, fit_linear
from evnlos.model.unet import ResidualUNet, UNetConfig
from evnlos.model.weights import Weights, load_weights, save_weights

__all__ = [
    "LinearEstimate",
    "ResidualUNet",
    "UNetConfig",
    "Weights",
    "fit_linear",
    "load_weights",
    "save_weights",
]
