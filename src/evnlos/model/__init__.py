"""Networks, one page each, and their weights on disk."""

from evnlos.model.confidence import Confidence, Judgement, halves_of
from evnlos.model.infer import infer
from evnlos.model.joint import JointNetwork, new_network
from evnlos.model.linear import LinearEstimate, fit_linear
from evnlos.model.plates import plates
from evnlos.model.published import published, published_for, published_rig, published_single
from evnlos.model.unet import ResidualUNet, UNetConfig
from evnlos.model.weights import Weights, load_weights, save_weights, with_rank

__all__ = [
    "Confidence",
    "JointNetwork",
    "Judgement",
    "LinearEstimate",
    "ResidualUNet",
    "UNetConfig",
    "Weights",
    "fit_linear",
    "halves_of",
    "infer",
    "load_weights",
    "new_network",
    "plates",
    "published",
    "published_for",
    "published_rig",
    "published_single",
    "save_weights",
    "with_rank",
]
