"""Reconstructors, their closed-form parts, what their images are worth, and their weights on disk."""

from evnlos.model.confidence import Confidence, Judgement, halves_of
from evnlos.model.linear import LinearEstimate, fit_linear
from evnlos.model.plates import plates
from evnlos.model.published import published, published_for, published_rig, published_single
from evnlos.model.reconstructor import RECONSTRUCTORS, Reconstructor, ReconstructorSettings
from evnlos.model.sequence import SequenceConfig, SequenceReconstructor
from evnlos.model.unet import ResidualUNet, UNetConfig, UNetReconstructor
from evnlos.model.weights import Weights, describe_network, load_weights, save_weights, with_rank

__all__ = [
    "RECONSTRUCTORS",
    "Confidence",
    "Judgement",
    "LinearEstimate",
    "Reconstructor",
    "ReconstructorSettings",
    "ResidualUNet",
    "SequenceConfig",
    "SequenceReconstructor",
    "UNetConfig",
    "UNetReconstructor",
    "Weights",
    "describe_network",
    "fit_linear",
    "halves_of",
    "load_weights",
    "plates",
    "published",
    "published_for",
    "published_rig",
    "published_single",
    "save_weights",
    "with_rank",
]
