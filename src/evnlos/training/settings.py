"""What decides a training: loss, settings, presets; and its whole state on disk.

- What training minimises: the paper's loss, and a default that does not collapse to black.
- Everything that decides a training.
- Training settings by name: our fine-tuning, and the paper's (Wang et al., EPNP, section on training).
- The whole state of a training in one safetensors file, so that a killed run goes on bit for bit.
- What stands in a run's folder of settings, data and versions, and whether a folder is of this run.
"""

from __future__ import annotations

import json
import logging
import math
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from evnlos.config import LONG_YAML, check_made, differing_keys, from_dict, read_yaml, to_dict
from evnlos.data import Dataset, as_modality
from evnlos.errors import ConfigError, DataError
from evnlos.files import is_empty, write_atomically
from evnlos.metrics import ssim
from evnlos.models import Reconstructor, ReconstructorSettings, UNetConfig, Weights, describe_network
from evnlos.registry import __version__, migrate
from evnlos.tensor_file import read_sealed, sealed_bytes

_LOG = logging.getLogger("evnlos")

LossName = Literal["normalized_bce_mse_ssim", "paper"]


class Loss(Protocol):
    """A mean over samples: the losses of the parts of a batch, weighted by their sizes, add up to its loss."""

    def __call__(self, image: Tensor, truth: Tensor, light: Tensor | None = None) -> Tensor:
        """Return the loss of images [B, 1, H, W]; `light` is that of the whole batch, see `light_of`."""
        ...


def light_of(truth: Tensor) -> Tensor:
    """Return mean and mean square of true images [B, 1, H, W], float [2]: what a loss may know of a batch."""
    return torch.stack([truth.mean(), truth.square().mean()])


def paper_loss(image: Tensor, truth: Tensor, light: Tensor | None = None) -> Tensor:
    """Return L1 + 2 / SSIM, as the paper prints it, with the SSIM of each sample, then the mean.

    Unbounded where an SSIM crosses 0, and an all-black image of a sparse target already has SSIM 0.8:
    short trainings sit at exactly that output. The SSIM is kept at or above 0.05 so that the loss stays finite.

    Args:
        image: Images of the network, [B, 1, H, W], 0..1.
        truth: True images, [B, 1, H, W], 0..1.
        light: Of no meaning here: every sample counts alone.
    """
    structure = ssim(image, truth).clamp_min(0.05)  # [B, 1]
    return (image - truth).abs().mean() + (2 / structure).mean()


def normalized_bce_mse_ssim(image: Tensor, truth: Tensor, light: Tensor | None = None) -> Tensor:
    """Return cross-entropy / entropy of the mean + squared error / energy of the truth + (1 - SSIM) / 4.

    The first two terms are those of the best constant image = 1, whatever share of the canvas a
    character covers. Both are least at the posterior mean, which is also what PSNR asks for. The
    cross-entropy of an all-black image is unbounded, and its gradient does not vanish behind a
    saturated sigmoid, so training can't rest there: squared error, SSIM and overlap alone can.

    Args:
        image: Images of the network, [B, 1, H, W], 0..1.
        truth: True images, [B, 1, H, W], 0..1.
        light: Mean and mean square of the true images of the whole batch, where `truth` is a part of it.
    """
    mean, energy = light_of(truth) if light is None else light
    share = mean.clamp(1e-4, 1 - 1e-4)
    entropy = -(share * share.log() + (1 - share) * (1 - share).log())
    cross = F.binary_cross_entropy(image, truth) / entropy
    error = (image - truth).square().mean() / (energy + 1e-4)
    return cross + error + (1 - ssim(image, truth).mean()) / 4


LOSSES: dict[LossName, Loss] = {"normalized_bce_mse_ssim": normalized_bce_mse_ssim, "paper": paper_loss}


@dataclass(frozen=True)
class Training:
    """Settings of one training; the paper's own are in `evnlos.training.settings`."""

    modality: str = "frame"
    """What the network sees."""
    epochs: int = 20
    """Passes over the training samples."""
    batch_size: int = 32
    """Samples per step."""
    learning_rate: float = 2e-3
    """Learning rate of Adam at the start."""
    schedule: Literal["cosine", "constant", "step"] = "cosine"
    """How the learning rate falls: to zero along a cosine, not at all, or at once at `step_epoch`."""
    step_epoch: int = 100
    """Epoch after which the schedule `step` multiplies the learning rate by `step_factor`."""
    step_factor: float = 0.5
    """Factor of the schedule `step`."""
    loss: LossName = "normalized_bce_mse_ssim"
    """`normalized_bce_mse_ssim` (bounded, does not collapse to black) or `paper` (L1 + 2/SSIM)."""
    sequence_augmentations: int = 3
    """Samples of each sequence, for networks that see it whole: all time steps, every other, random ones."""
    drawn: int = 0
    """Sequences of newly drawn targets an epoch, made in closed form and never twice the same: of a network of
    whole sequences that sees frames and events solved through a calibrated setup. A pre-training
    learns from them alone; the samples tell it light path and scale."""
    mirror: bool = False
    """Show half of the samples of each epoch upside down, input and image: further captures at no cost where
    the setup is symmetric about the height of the target; for networks that see single time steps."""
    keep_normalization: bool = False
    """Fine-tuning: keep the inputs' mean and size of the weights, as after a simulation of this very setup; by
    default they are taken from the new data."""
    refit_embedding: bool = False
    """With weights of another setup: take only the layers that gradients trained, and fit normalization and
    linear embedding, which carry the light path, to the new data; kind and size are then those of `network`."""
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
        if self.drawn < 0:
            raise ConfigError(f"Training.drawn is {self.drawn}; give 0, or a number of sequences an epoch")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ConfigError(f"Training.learning_rate is {self.learning_rate}; give a positive number")
        check_made(self)


def learning_rate_at(settings: Training, progress: float) -> float:
    """Return Adam's step size after `progress` epochs (a fraction within an epoch is allowed).

    Args:
        settings: Schedule and step size.
        progress: Epochs done, 0 to `settings.epochs`.

    Example:
        >>> learning_rate_at(Training(epochs=10, learning_rate=1.0, schedule="step", step_epoch=5), 7.5)
        0.5
    """
    if settings.schedule == "cosine":
        return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(progress / settings.epochs, 1.0)))
    if settings.schedule == "step" and progress >= settings.step_epoch:
        return settings.learning_rate * settings.step_factor
    return settings.learning_rate


PLAIN_NETWORK = UNetConfig(width=24, depth=4, shuffle=2, scaling="picture", rank=0)
"""A U-Net as the paper has it: it sees the maps, each image normalized by itself, and no embedding."""


def finetuning(modality: str = "frame") -> Training:
    """Return our fine-tuning after a simulation of any setup: smaller steps than those of a training.

    Args:
        modality: "frame", "event" or "fusion".
    """
    return Training(modality=modality, epochs=10, learning_rate=1e-3)


def paper_pretraining(modality: str = "fusion") -> Training:
    """Return the paper's pre-training: 200 epochs of Adam, 1e-4 for 100 then 5e-5, batch 16, L1 + 2/SSIM.

    Args:
        modality: "frame", "event" or "fusion".
    """
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
    """Return the paper's fine-tuning: from the pre-trained weights, 100 epochs at 1e-5, batch 16.

    Args:
        modality: "frame", "event" or "fusion".
    """
    return Training(
        modality=modality, epochs=100, batch_size=16, learning_rate=1e-5, schedule="constant", loss="paper"
    )


def save_checkpoint(
    path: str | Path,
    network: Reconstructor,
    optimiser: torch.optim.Adam,
    epoch: int,
    log: list[dict],
    key: str,
) -> None:
    """Write weights, optimiser state, number of finished epochs and the log so far, atomically."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        for name, value in state.items():
            tensors[f"optimiser.{index}.{name}"] = torch.as_tensor(value)
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    about = json.dumps({"epoch": epoch, "log": log, "key": key, **describe_network(network)})
    write_atomically(path, sealed_bytes(tensors, about))


def load_checkpoint(
    path: str | Path, network: Reconstructor, optimiser: torch.optim.Adam, key: str
) -> tuple[int, list[dict]]:
    """Restore a training in place; return the number of finished epochs and the log.

    Raises:
        DataError: The file is damaged, or belongs to a training with other settings.
    """
    try:
        text, tensors, _ = read_sealed(path)
        about = json.loads(text)
        if any(value.is_complex() for value in tensors.values()):
            raise ValueError("complex numbers belong to no training")
        epoch, log, their_key = int(about["epoch"]), [dict(line) for line in about["log"]], about["key"]
        if their_key == key:
            weights = {
                network.today(name[8:], network.modality): value
                for name, value in tensors.items()
                if name.startswith("network.")
            }
            state = _optimiser_state(tensors, optimiser)
            network.load_state_dict(weights)
            optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        RuntimeError,
    ) as error:
        raise DataError(
            f"{path} is damaged ({' '.join(str(error).split())[:160]}); delete it to start afresh"
        ) from None
    if their_key != key:
        raise DataError(f"{path} belongs to a training with other settings; give another --out")
    return epoch, log


def _optimiser_state(
    tensors: dict[str, torch.Tensor], optimiser: torch.optim.Adam
) -> dict[int, dict[str, torch.Tensor]]:
    """Return the optimiser's state, each tensor laid out in memory as its parameter is.

    Another layout would be added up in another order, and the training would not end with the same bytes.
    """
    trained = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if not name.startswith("optimiser."):
            continue
        _, index, field = name.split(".")
        parameter = trained[int(index)]
        if value.ndim and value.shape != parameter.shape:
            raise ValueError(f"{name} is {tuple(value.shape)}, not {tuple(parameter.shape)}")
        if value.ndim:
            value = torch.empty_like(parameter, requires_grad=False).copy_(value)
        state.setdefault(int(index), {})[field] = value
    return state


def about_run(
    dataset: Dataset, settings: Training, start: Weights | None, device: torch.device | None = None
) -> dict[str, Any]:
    """Return what `run.yaml` and the history of the weights say of a training: settings, data, versions.

    Args:
        dataset: Where the samples are.
        settings: What decides the training.
        start: Weights that it begins with, if any.
        device: Where it runs, for a simulation that runs beside it.
    """
    return {
        "settings": to_dict(settings),
        "data": {
            "origin": dataset.origin,
            "name": dataset.folder.resolve().name,
            "config_hash": dataset.config_hash,
            "optics": dataset.optics,
            "train": dataset.objects("train"),
            "validation": dataset.split.get("validation", []),
        },
        "from": start.history[-1]["data"]["name"] if start and start.history else None,
        "versions": {
            "evnlos": __version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
            "threads": torch.get_num_threads(),
        },
    }


def tell_of_threads(out: Path) -> None:
    """Warn where a run is taken up with another number of threads: sums are then taken in another order."""
    if (out / "weights.safetensors").is_file():
        return
    versions = read_yaml(out / "run.yaml", LONG_YAML).get("versions")
    stored, threads = versions.get("threads") if isinstance(versions, dict) else None, torch.get_num_threads()
    if stored not in (None, threads):
        _LOG.warning(
            "warning: %s was begun with %s threads and goes on with %d: the weights will not be the same "
            "to the byte; set OMP_NUM_THREADS=%s for that",
            out,
            stored,
            threads,
            stored,
        )


def check_run(out: Path, about: dict[str, Any]) -> None:
    """Refuse a folder that is neither new nor of a run with the same settings and data.

    Args:
        out: Folder of the run.
        about: Settings and data, as its file states them.

    Raises:
        DataError: It holds another run, or something else.
    """
    path = out / "run.yaml"
    if path.is_file():
        stored = migrate("run", read_yaml(path, LONG_YAML))
        if isinstance(stored.get("settings"), dict):
            stored["settings"] = to_dict(from_dict(Training, stored["settings"], source=str(path)))
        differing = differing_keys(
            {key: about[key] for key in ("settings", "data")},
            {key: stored.get(key) for key in ("settings", "data")},
        )
        if differing:
            raise DataError(
                f"{out} holds a run with other settings ({'; '.join(differing[:6])}); give another --out"
            )
        return
    if not is_empty(out):
        raise DataError(f"{out} is not empty and holds no run; give a new folder")
