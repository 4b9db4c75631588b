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
from evnlos.evaluation.positions import PositionsPoint, curve_over_positions
from evnlos.evaluation.reconstructor import Reconstructor
from evnlos.evaluation.score import Scores, score

__all__ = [
    "BASELINES",
    "CHECKS",
    "Bench",
    "Evaluation",
    "Identification",
    "PositionsPoint",
    "Reconstructor",
    "Scores",
    "assess",
    "available_lpips",
    "check_sampling",
    "curve_over_positions",
    "evaluate",
    "identify",
    "load_lpips",
    "reconstruct",
    "score",
]
