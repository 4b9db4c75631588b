"""How good a reconstruction is, with its baselines, and how good it could be at all."""

from evnlos.evaluation.evaluate import (
    BASELINES,
    CHECKS,
    Evaluation,
    assess,
    check_sampling,
    evaluate,
    reconstruct,
)
from evnlos.evaluation.identify import Identification, identify
from evnlos.evaluation.identify_rig import Bench
from evnlos.evaluation.lpips import available_lpips, load_lpips
from evnlos.evaluation.model import Model, Reconstruction, load_model
from evnlos.evaluation.positions import PositionsPoint, curve_over_positions
from evnlos.evaluation.score import Scores, score
from evnlos.evaluation.streaming import StreamingReconstructor

__all__ = [
    "BASELINES",
    "CHECKS",
    "Bench",
    "Evaluation",
    "Identification",
    "Model",
    "PositionsPoint",
    "Reconstruction",
    "Scores",
    "StreamingReconstructor",
    "assess",
    "available_lpips",
    "check_sampling",
    "curve_over_positions",
    "evaluate",
    "identify",
    "load_lpips",
    "load_model",
    "reconstruct",
    "score",
]
