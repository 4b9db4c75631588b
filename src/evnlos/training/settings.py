"""Everything that decides a training."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from evnlos.dataset import Paradigm
from evnlos.errors import ConfigError
from evnlos.model import UNetConfig
from evnlos.training.loss import LossName

Part = Literal["encoder", "latent", "decoder"]


@dataclass(frozen=True)
class Training:
    """Settings of one training; the paper's own are in `evnlos.training.presets`."""

    paradigm: Paradigm = "frame"
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
    joint: bool = False
    """Train a joint network: all positions of a pass together give one picture of the plate."""
    views: int = 3
    """Joint training: views of each pass; all its positions, every other one, then random subsets."""
    restandardise: bool = True
    """Fine-tuning: take the inputs' mean and size from the new data, as an uncalibrated simulation needs it."""
    freeze: tuple[Part, ...] = ()
    """Parts of the network whose weights stay as they are."""
    precision: Literal["auto", "bf16", "float32"] = "auto"
    """Arithmetic of the convolutions; `auto` takes bf16 where the processor has it."""
    compile: bool = False
    """Let torch.compile fuse the network's operations: minutes at the start; for long trainings on a GPU."""
    network: UNetConfig = field(default_factory=UNetConfig)
    """Size of the network (fine-tuning keeps that of its weights)."""
    seed: int = 0
    """Seed of the initial weights and of the order of the samples."""

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size", "views"):
            if getattr(self, name) < 1:
                raise ConfigError(f"Training.{name} is {getattr(self, name)}; give at least 1")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ConfigError(f"Training.learning_rate is {self.learning_rate}; give a positive number")


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
