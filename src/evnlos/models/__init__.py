"""Reconstructors, their closed-form parts, the confidence in their images, and their weights on disk."""

from evnlos.models.confidence import Confidence, ConfidenceReport, halves_of, on_target_plane
from evnlos.models.drawn import DrawnSequences, DrawnTargets, drawn_targets
from evnlos.models.embedding import FrameOperator
from evnlos.models.posterior import (
    AboutPrior,
    FilmSolver,
    LearnedPrior,
    RunningFilm,
    TargetEstimate,
    TargetLikelihood,
    estimate_film_of,
    estimate_target,
    load_prior,
    posterior_samples,
    save_prior,
)
from evnlos.models.reconstructor import (
    RECONSTRUCTORS,
    LinearEstimate,
    Reconstructor,
    ReconstructorSettings,
    fit_linear,
)
from evnlos.models.sequence import SequenceConfig, SequenceReconstructor
from evnlos.models.unet import ResidualUNet, UNetConfig, UNetReconstructor
from evnlos.models.unrolled import UnrolledConfig, UnrolledReconstructor
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
    "AboutPrior",
    "Confidence",
    "ConfidenceReport",
    "DrawnSequences",
    "DrawnTargets",
    "FilmSolver",
    "FrameOperator",
    "LearnedPrior",
    "LinearEstimate",
    "Reconstructor",
    "ReconstructorSettings",
    "ResidualUNet",
    "RunningFilm",
    "SequenceConfig",
    "SequenceReconstructor",
    "TargetEstimate",
    "TargetLikelihood",
    "UNetConfig",
    "UNetReconstructor",
    "UnrolledConfig",
    "UnrolledReconstructor",
    "Weights",
    "describe_network",
    "drawn_targets",
    "estimate_film_of",
    "estimate_target",
    "find_weights",
    "fit_linear",
    "halves_of",
    "layers_of",
    "load_prior",
    "load_weights",
    "on_target_plane",
    "posterior_samples",
    "published",
    "published_for",
    "published_setup",
    "published_single",
    "save_prior",
    "save_weights",
]
