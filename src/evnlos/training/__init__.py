"""Learning to reconstruct: pre-training on simulation, fine-tuning on captures, end-to-end training."""

from evnlos.training.choice import Choice, alternatives, between, choose_and_finetune, read_choice
from evnlos.training.loss import LOSSES, balanced_loss, paper_loss
from evnlos.training.presets import finetuning, paper_finetuning, paper_pretraining
from evnlos.training.settings import Training, step_size
from evnlos.training.train import TrainingResult, train

__all__ = [
    "LOSSES",
    "Choice",
    "Training",
    "TrainingResult",
    "alternatives",
    "balanced_loss",
    "between",
    "choose_and_finetune",
    "finetuning",
    "paper_finetuning",
    "paper_loss",
    "paper_pretraining",
    "read_choice",
    "step_size",
    "train",
]
