"""Reconstructors, their closed-form parts, the confidence in their images, and their weights on disk."""

from evnlos.models.confidence import Confidence, ConfidenceReport, halves_of, on_target_plane
from evnlos.models.drawn import DrawnSequences, DrawnTargets, drawn_targets
from evnlos.models.embedding import FrameOperator
from evnlos.models.reconstructor import (
    RECONSTRUCTORS,
    LinearEstimate,
    Reconstructor,
    ReconstructorSettings,
    fit_linear,
)
from evnlos.models.sequence import SequenceConfig, SequenceReconstructor
from evnlos.models.unet import ResidualUNet, UNetConfig, UNetReconstructor
from evnlos.models.weights import (
    GENERIC,
    Weights,
    describe_network,
    find_weights,
    layers_of,
    load_weights,
    published,
    published_for,
    published_setup,
    published_single,
    save_weights,
)

__all__ = [
    "GENERIC",
    "RECONSTRUCTORS",
    "Confidence",
    "ConfidenceReport",
    "DrawnSequences",
    "DrawnTargets",
    "FrameOperator",
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
    "drawn_targets",
    "find_weights",
    "fit_linear",
    "halves_of",
    "layers_of",
    "load_weights",
    "on_target_plane",
    "published",
    "published_for",
    "published_setup",
    "published_single",
    "save_weights",
]
