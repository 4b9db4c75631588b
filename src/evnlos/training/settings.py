"""Everything that decides a training."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from evnlos.config import check_made
from evnlos.dataset import as_modality
from evnlos.errors import ConfigError
from evnlos.model import ReconstructorSettings, UNetConfig
from evnlos.training.loss import LossName


@dataclass(frozen=True)
class Training:
    """Settings of one training; the paper's own are in `evnlos.training.presets`."""

    modality: str = "frame"
    """What the network sees."""
    epochs: int = 20
    """Passes over the training samples."""
    batch_size: int = 32
    """Samples a step."""
    learning_rate: float = 2e-3
    """Adam's step size at the start."""
    schedule: Literal["cosine", "constant", "step"] = "cosine"
    """How the step size falls: to zero along a cosine, not at all, or at once at `step_epoch`."""
    step_epoch: int = 100
    """Epoch after which the schedule `step` multiplies the step size by `step_factor`."""
    step_factor: float = 0.5
    """Factor of the schedule `step`."""
    loss: LossName = "balanced"
    """`balanced` (bounded, does not collapse to black) or `paper` (L1 + 2/SSIM)."""
    sequence_augmentations: int = 3
    """Samples of each sequence, for networks that see it whole: all time steps, every other, random ones."""
    mirror: bool = False
    """Show half of the samples of each epoch upside down, input and picture: further captures at no cost where
    the setup is symmetric about the height of the target; for networks that see single time steps."""
    keep_normalization: bool = False
    """Fine-tuning: keep the inputs' mean and size of the weights, as after a simulation of this very setup; by
    default they are taken from the new data."""
    freeze: tuple[str, ...] = ()
    """Parts of the network whose weights stay as they are: encoder, latent, decoder."""
    precision: Literal["auto", "bf16", "float32"] = "auto"
    """Arithmetic of the convolutions; `auto` takes bf16 where the processor has it."""
    compile: bool = False
    """Let torch.compile fuse the network's operations: minutes at the start; for long trainings on a GPU."""
    network: ReconstructorSettings = field(default_factory=UNetConfig)
    """The network: its kind and its size (fine-tuning keeps those of its weights)."""
    seed: int = 0
    """Seed of the initial weights and of the order of the samples."""

    def __post_init__(self) -> None:
        as_modality(self.modality)  # refuses an unknown one
        for name in ("epochs", "batch_size", "sequence_augmentations"):
            if getattr(self, name) < 1:
                raise ConfigError(f"Training.{name} is {getattr(self, name)}; give at least 1")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ConfigError(f"Training.learning_rate is {self.learning_rate}; give a positive number")
        check_made(self)


def step_size(settings: Training, progress: float) -> float:
    """Return Adam's step size after `progress` epochs (a fraction within an epoch is allowed).

    Example:
        >>> step_size(Training(epochs=10, learning_rate=1.0, schedule="step", step_epoch=5), 7.5)
        0.5
    """
    if settings.schedule == "cosine":
        return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(progress / settings.epochs, 1.0)))
    if settings.schedule == "step" and progress >= settings.step_epoch:
        return settings.learning_rate * settings.step_factor
    return settings.learning_rate
