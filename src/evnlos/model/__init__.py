"""Networks, one page each, and their weights on disk."""

from evnlos.model.unet import ResidualUNet, UNetConfig
from evnlos.model.weights import Weights, load_weights, save_weights

__all__ = ["ResidualUNet", "UNetConfig", "Weights", "load_weights", "save_weights"]
