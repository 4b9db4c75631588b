"""How good a reconstruction is: metrics with their baselines, a character and overall."""

from evnlos.evaluation.evaluate import (
    BASELINES,
    CHECKS,
    Evaluation,
    check_sampling,
    evaluate,
    infer,
    reconstruct,
)
from evnlos.evaluation.lpips import available_lpips, load_lpips
from evnlos.evaluation.score import Scores, score

__all__ = [
    "BASELINES",
    "CHECKS",
    "Evaluation",
    "Scores",
    "available_lpips",
    "check_sampling",
    "evaluate",
    "infer",
    "load_lpips",
    "reconstruct",
    "score",
]
