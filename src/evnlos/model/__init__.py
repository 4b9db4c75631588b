"""Networks, one page each, and their weights on disk."""

from evnlos.model.infer import infer
from evnlos.model.joint import JointNetwork, new_network
from evnlos.model.linear import LinearEstimate, fit_linear
from evnlos.model.unet import ResidualUNet, UNetConfig
from evnlos.model.weights import Weights, load_weights, save_weights

__all__ = [
    "JointNetwork",
    "LinearEstimate",
    "ResidualUNet",
    "UNetConfig",
    "Weights",
    "fit_linear",
    "infer",
    "load_weights",
    "new_network",
    "save_weights",
]
