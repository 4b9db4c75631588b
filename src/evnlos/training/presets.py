"""Training settings by name: our fine-tuning, and the paper's (Wang et al., EPNP, section on training)."""

from __future__ import annotations

from evnlos.model import UNetConfig
from evnlos.training.settings import Training

PLAIN_NETWORK = UNetConfig(width=24, depth=4, shuffle=2, scaling="picture", rank=0)
"""A U-Net as the paper has it: it sees the maps, each image normalized by itself, and no embedding."""


def finetuning(modality: str = "frame") -> Training:
    """Return our fine-tuning after a simulation of any rig: smaller steps than those of a training."""
    return Training(modality=modality, epochs=10, learning_rate=1e-3)


def paper_pretraining(modality: str = "fusion") -> Training:
    """Return the paper's pre-training: 200 epochs of Adam, 1e-4 for 100 then 5e-5, batch 16, L1 + 2/SSIM."""
    return Training(
        modality=modality,
        epochs=200,
        batch_size=16,
        learning_rate=1e-4,
        schedule="step",
        step_epoch=100,
        loss="paper",
        network=PLAIN_NETWORK,
    )


def paper_finetuning(modality: str = "fusion") -> Training:
    """Return the paper's fine-tuning: from the pre-trained weights, 100 epochs at 1e-5, batch 16."""
    return Training(
        modality=modality, epochs=100, batch_size=16, learning_rate=1e-5, schedule="constant", loss="paper"
    )
