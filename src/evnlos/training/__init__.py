"""Learning to reconstruct: pre-training on simulation, fine-tuning on captures, end-to-end training."""

from evnlos.training.loss import LOSSES, balanced_loss, paper_loss
from evnlos.training.presets import finetuning, paper_finetuning, paper_pretraining
from evnlos.training.settings import Training, step_size
from evnlos.training.train import train

__all__ = [
    "LOSSES",
    "Training",
    "balanced_loss",
    "finetuning",
    "paper_finetuning",
    "paper_loss",
    "paper_pretraining",
    "step_size",
    "train",
]
