"""The experiments by name: those of the paper's sections, and those that ask what the paper leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from evnlos.config import from_dict, to_dict
from evnlos.data import Sampling
from evnlos.errors import ConfigError
from evnlos.experiment.study import Arm, Study
from evnlos.models import SequenceConfig, UNetConfig
from evnlos.training import Training, paper_finetuning, paper_pretraining
from evnlos.training.settings import LossName

PRETRAINING = Training(epochs=2)
"""Pre-training of our own experiments; `--pretrain-epochs` changes the number of epochs."""
FINETUNING = Training(epochs=3, learning_rate=2e-4, keep_normalization=True)
"""Fine-tuning after a calibrated simulation, whose scale stays; chosen on validation characters."""
UNCALIBRATED = replace(FINETUNING, epochs=10, learning_rate=1e-3, keep_normalization=False)
"""Fine-tuning after a simulation of another setup: longer, in larger steps, with the scale of the captures."""
END_TO_END = Training(epochs=12)
"""End-to-end training; validation characters gain nothing after half of it."""

_PLAIN = UNetConfig(rank=0, scaling="picture")  # a U-Net as the paper has it: it sees the maps
_E2E = Arm("E2E", "none", None, END_TO_END)
_EPNP = Arm("EPNP", "calibrated", PRETRAINING, FINETUNING)


def captures(setup: str) -> Study:
    """Return the main comparison: E2E, simulation alone, EPNP on the uncalibrated and the calibrated one.

    E2E is there twice: with our network, whose linear embedding it learns from the captures, and as the paper
    has it, with a U-Net that sees the maps.
    """
    plain = replace(END_TO_END, network=_PLAIN)
    return Study(
        "captures",
        setup,
        (
            Arm("E2E plain", "none", None, plain),
            _E2E,
            Arm("simulation only", "calibrated", PRETRAINING, None),
            Arm("EPNP uncalibrated", "uncalibrated", PRETRAINING, UNCALIBRATED),
            _EPNP,
        ),
    )


def paper(setup: str) -> Study:
    """Return the comparison with the paper's own settings: 200 epochs, 1e-4, L1 + 2/SSIM; a GPU's work."""
    fine = paper_finetuning()
    return Study(
        "paper",
        setup,
        (
            Arm("E2E", "none", None, replace(fine, learning_rate=1e-4)),
            Arm("EPNP", "uncalibrated", paper_pretraining(), fine),
        ),
        writers=39,
        correct_pattern=False,
    )


def frozen(setup: str) -> Study:
    """Return the ablation of what stays as pre-trained in fine-tuning."""
    parts = {"nothing": (), "encoder": ("encoder",), "latent": ("latent",), "both": ("encoder", "latent")}
    arms = (
        replace(_EPNP, name=f"frozen: {name}", finetuning=replace(FINETUNING, freeze=freeze))
        for name, freeze in parts.items()
    )
    return Study("frozen", setup, tuple(arms))


def capture_count(setup: str) -> Study:
    """Return the ablation of the number of captures, with and without pre-training."""
    arms = [Arm("EPNP 0 captures", "calibrated", PRETRAINING, None)]
    for count in (1, 2, 4, 8, 16, None):
        words = f"{count or 'all'} captures"
        # As many steps with few captures as with all: an epoch is shorter.
        longer = 1 if count is None else round(28 / count)
        fine = replace(FINETUNING, epochs=FINETUNING.epochs * min(longer, 8))
        alone = replace(END_TO_END, epochs=END_TO_END.epochs * min(longer, 8))
        arms.append(replace(_EPNP, name=f"EPNP {words}", captures=count, finetuning=fine))
        arms.append(replace(_E2E, name=f"E2E {words}", captures=count, finetuning=alone))
    return Study("capture-count", setup, tuple(arms))


def surface(setup: str) -> Study:
    """Return the ablation of the time surface: time constant, kind and radius; events alone."""
    samplings = {f"sae, {tau:g} s": Sampling(tau_s=tau) for tau in (0.05, 0.1, 0.2, 0.4, 0.8)}
    samplings |= {
        f"{kind}, radius {r}": Sampling(surface=kind, radius=r) for kind in ("context", "hots") for r in (1, 3)
    }  # type: ignore[arg-type]
    arms = [
        replace(arm, name=f"{arm.name} {name}", sampling=s)
        for name, s in samplings.items()
        for arm in (_E2E, _EPNP)
    ]
    return Study("surface", setup, tuple(arms), ("event",))


def thresholds(setup: str) -> Study:
    """Return the ablation of the simulated event thresholds: right, and wrong by factors; events alone."""
    arms = []
    for factor in (0.5, 0.75, 1.0, 1.5, 2.0):
        ranges = {
            f"setup.pixel.threshold_{p}": (0.2 * factor * 0.95, 0.2 * factor * 1.05) for p in ("on", "off")
        }
        arms.append(replace(_EPNP, name=f"thresholds {0.2 * factor:.2f}", vary=ranges))
    return Study("thresholds", setup, tuple(arms), ("event",))


def loss(setup: str) -> Study:
    """Return the ablation of the loss: the normalized one and the paper's."""
    arms = []
    losses: dict[str, LossName] = {"normalized": "normalized_bce_mse_ssim", "paper": "paper"}
    for words, name in losses.items():
        arms.append(replace(_E2E, name=f"E2E {words} loss", finetuning=replace(END_TO_END, loss=name)))
        pre, fine = replace(PRETRAINING, loss=name), replace(FINETUNING, loss=name)
        arms.append(replace(_EPNP, name=f"EPNP {words} loss", pretraining=pre, finetuning=fine))
    return Study("loss", setup, tuple(arms))


def width(setup: str) -> Study:
    """Return the ablation of the network's width."""
    arms = []
    for channels in (16, 32, 48, 64):
        net = UNetConfig(width=channels)
        arms.append(replace(_E2E, name=f"E2E width {channels}", finetuning=replace(END_TO_END, network=net)))
        pre = replace(PRETRAINING, network=net)
        arms.append(replace(_EPNP, name=f"EPNP width {channels}", pretraining=pre))
    return Study("width", setup, tuple(arms))


def embedding(setup: str) -> Study:
    """Return the ablation of what the network knows before its first step: scale and linear embedding."""
    kinds = {
        "plain, each picture scaled": _PLAIN,
        "plain": UNetConfig(rank=0),
        "one ridge": UNetConfig(ridge_multipliers=(1.0,)),
        "three ridges": UNetConfig(),
    }
    arms = []
    for name, net in kinds.items():
        arms.append(replace(_E2E, name=f"E2E {name}", finetuning=replace(END_TO_END, network=net)))
        arms.append(replace(_EPNP, name=f"EPNP {name}", pretraining=replace(PRETRAINING, network=net)))
    return Study("embedding", setup, tuple(arms))


_SEQUENCE_NETWORK = SequenceConfig(rank=512, ridge_multipliers=(0.001, 0.01, 0.1, 1.0))
_SEQUENCE = Training(epochs=6, batch_size=16, network=_SEQUENCE_NETWORK)
_SEQUENCE_FINETUNING = replace(FINETUNING, epochs=8, batch_size=16)


def sequence(setup: str) -> Study:
    """Return the comparison of E2E and EPNP where all time steps of a sequence are seen together.

    A sequence is one sample: the simulation has four times the writers of the other studies.
    """
    arms = (
        Arm("E2E sequence", "none", None, replace(_SEQUENCE, epochs=60)),
        Arm("simulation only sequence", "calibrated", _SEQUENCE, None),
        Arm("EPNP sequence", "calibrated", _SEQUENCE, _SEQUENCE_FINETUNING),
    )
    return Study("sequence", setup, arms, writers=44)


def on_sequences(study: Study) -> Study:
    """Return a study of single time steps with sequence networks instead: a whole sequence is one sample.

    A sequence is worth less training than forty time steps: pre-training and end-to-end training make more
    epochs, as many as bring the validation to rest, and so does fine-tuning.

    Args:
        study: Any study; its arms on sequences stay as they are.

    Raises:
        ConfigError: An arm has no linear embedding that could be pooled.
    """
    arms = []
    for arm in study.arms:
        pre, fine = arm.pretraining, arm.finetuning
        if pre is not None:
            pre = _of_sequences(pre, 6, arm.name)
            fine = fine and replace(fine, epochs=round(fine.epochs * 8 / 3), batch_size=_SEQUENCE.batch_size)
        elif fine is not None:
            fine = _of_sequences(fine, 5, arm.name)
        arms.append(replace(arm, pretraining=pre, finetuning=fine))
    return replace(study, name=f"{study.name}-sequence", arms=tuple(arms))


def _of_sequences(single: Training, longer: int, arm: str) -> Training:
    """Return the settings of a first training on whole sequences, in place of one on single time steps."""
    if single.network.kind != UNetConfig.kind:
        return single
    values = to_dict(single.network)
    if not values["rank"]:
        raise ConfigError(
            f"arm {arm!r} has no linear embedding to pool over a sequence; leave it out with --arms"
        )
    values |= {"kind": _SEQUENCE_NETWORK.kind, "rank": _SEQUENCE_NETWORK.rank}
    if values["ridge_multipliers"] == list(UNetConfig().ridge_multipliers):
        values["ridge_multipliers"] = list(_SEQUENCE_NETWORK.ridge_multipliers)
    network = from_dict(SequenceConfig, values)
    return replace(single, epochs=longer * single.epochs, batch_size=_SEQUENCE.batch_size, network=network)


def objects(setup: str) -> Study:
    """Return the ablation of the number of simulated objects, of sequence networks.

    With 396 objects the validation no longer gains after 12 epochs; with more there is time for fewer.
    """
    arms = []
    for writers, epochs in ((3, 12), (11, 12), (44, 6)):
        before, words = replace(_SEQUENCE, epochs=epochs), f"{36 * writers} objects"
        arms.append(Arm(f"simulation only, {words}", "calibrated", before, None, writers=writers))
        arms.append(Arm(f"EPNP, {words}", "calibrated", before, _SEQUENCE_FINETUNING, writers=writers))
    return Study("objects", setup, tuple(arms))


STUDIES: dict[str, Callable[[str], Study]] = {
    "captures": captures,
    "paper": paper,
    "frozen": frozen,
    "capture-count": capture_count,
    "surface": surface,
    "thresholds": thresholds,
    "loss": loss,
    "width": width,
    "embedding": embedding,
    "sequence": sequence,
    "objects": objects,
}
"""Experiments on captures by name."""
