"""The experiments by name: those of the paper's sections, and those that ask what the paper leaves open.

- What carries over: one network on other hands, other things than characters, and other walls than its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from evnlos.analysis.confidence import ConfidenceCheck, FrameOperator, check_confidence, consistent
from evnlos.calibration.transport_fit import values_of
from evnlos.config import config_hash, from_dict, load_yaml, to_dict
from evnlos.data import Dataset, NlosDataset, Sampling, Simulation, read_shard, simulate
from evnlos.data.pool import processes
from evnlos.errors import ConfigError, DataError
from evnlos.experiment.study import Arm, Study
from evnlos.experiment.table import TRUST
from evnlos.machine import Progress, Step, silent
from evnlos.metrics import psnr
from evnlos.models import SequenceConfig, UNetConfig, UnrolledConfig, Weights, load_weights
from evnlos.models.confidence import on_canvas
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, DrawingGlyphs, HandwritingGlyphs
from evnlos.scene.drawings import KINDS
from evnlos.setups import calibrated_file
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

    E2E is there three times: with our network, whose linear embedding it learns from the captures, the same
    with exact further captures, and as the paper has it, with a U-Net that sees the maps.
    """
    plain = replace(END_TO_END, network=_PLAIN)
    return Study(
        "captures",
        setup,
        (
            Arm("E2E plain", "none", None, plain),
            _E2E,
            replace(_E2E, name="E2E augmented", augment=True),
            Arm("simulation only", "calibrated", PRETRAINING, None),
            Arm("EPNP uncalibrated", "uncalibrated", PRETRAINING, UNCALIBRATED),
            _EPNP,
        ),
        retrieval=True,
    )


def paper(setup: str) -> Study:
    """Return the comparison with the paper's own settings: 200 epochs, 1e-4, L1 + 2/SSIM."""
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
    samplings["trace, 2 s"] = Sampling(surface="trace", tau_s=2.0)
    samplings["sae-trace"] = Sampling(surface="sae-trace")
    samplings["likelihood"] = Sampling(surface="likelihood")  # of the calibrated setup
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
        "plain, each image scaled": _PLAIN,
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
_DRAWN_PRETRAINING = replace(
    _SEQUENCE, epochs=16, drawn=2272, network=replace(_SEQUENCE_NETWORK, frames="likelihood")
)
_UNROLLED = UnrolledConfig(rank=_SEQUENCE_NETWORK.rank)
_DRAWN_FINETUNING = replace(_SEQUENCE_FINETUNING, epochs=20, learning_rate=5e-4, drawn=378)


def sequence(setup: str) -> Study:
    """Return the comparison of E2E and EPNP where all time steps of a sequence are seen together.

    A sequence is one sample. The images of an end-to-end network of single positions, aligned and averaged, are
    the stronger E2E. What knows the calibrated light path sees the target that all frames, and all events, make
    most likely through it, and learns from newly drawn targets: what is simulated tells light path, noise and
    scale. Both E2E have exact further captures, too. Unrolled networks are trained where they are asked for.
    """
    sees, in_steps = Sampling(surface="likelihood"), replace(_DRAWN_PRETRAINING, network=_UNROLLED)
    arms = (
        Arm("E2E, single positions", "none", None, END_TO_END),
        Arm("E2E, single positions, augmented", "none", None, END_TO_END, augment=True),
        Arm("E2E sequence", "none", None, replace(_SEQUENCE, epochs=60)),
        Arm("E2E sequence, augmented", "none", None, replace(_SEQUENCE, epochs=60), augment=True),
        Arm("simulation only sequence", "calibrated", _DRAWN_PRETRAINING, None, sampling=sees),
        Arm("EPNP sequence", "calibrated", _DRAWN_PRETRAINING, _DRAWN_FINETUNING, sampling=sees),
        Arm("simulation only unrolled", "calibrated", in_steps, None, sampling=sees),
        Arm("EPNP unrolled", "calibrated", in_steps, _DRAWN_FINETUNING, sampling=sees),
    )
    asked_for = "simulation only unrolled", "EPNP unrolled"
    return Study("sequence", setup, arms, asked_for=asked_for, writers=2, average=True, retrieval=True)


def on_sequences(study: Study) -> Study:
    """Return a study of single time steps with sequence networks instead: a whole sequence is one sample.

    A sequence is worth less training than forty time steps: pre-training and end-to-end training make more
    epochs, as many as bring the validation to rest, and so does fine-tuning.

    Args:
        study: Any study; arms on sequences stay as they are, and those of `sae-trace`, not seen, are left out.

    Raises:
        ConfigError: An arm has no linear embedding that could be pooled.
    """
    arms = []
    for arm in (one for one in study.arms if one.sampling.surface != "sae-trace"):
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


@dataclass(frozen=True)
class GeneralizationResult:
    """What one network made of one set of objects and walls.

    Args:
        name: What the set is.
        psnr_db: Mean PSNR of the network's images on the scored canvas, dB.
        average_db: The same of the average target, drawn where the target is, dB.
        consistent_db: The same of the network's images after data consistency with the set's own wall, dB;
            None for events alone.
        confidence_checks: What the confidence said of each sequence, and what was true.
    """

    name: str
    psnr_db: float
    average_db: float
    consistent_db: float | None
    confidence_checks: list[ConfidenceCheck]

    def mean(self, key: str) -> float:
        """Return the mean of one number of the sequences."""
        return float(np.mean([getattr(one, key) for one in self.confidence_checks]))


def evaluation_sets(setup: Simulation, sampling: Sampling, each: int) -> dict[str, Simulation]:
    """Return the sets: unseen hands, each kind of drawings, and the same hands in front of other walls.

    Args:
        setup: The calibrated setup.
        sampling: Resolution and representation of the network's samples.
        each: Objects of a set; of the unseen hand all 36 characters.

    Raises:
        DataError: The setup's wall is not radiometric.
    """
    wall: Any = setup.setup  # of rough metal, as the sets say
    known = values_of(wall)
    if "roughness" not in known:
        raise DataError(f"the setup is {wall.kind!r}; give a calibrated one (radiometric)")
    base = replace(setup, sampling=sampling, vary={}, setups=0, validation=0.0, held_out="", keep_events=False)
    hand = HandwritingGlyphs(characters=UPPER_CASE + DIGITS, writers=1, first_writer=TRAIN_WRITERS)
    some = replace(hand, characters="".join((UPPER_CASE + DIGITS)[:: max(1, 36 // each)][:each]))
    offset = wall.target_offset_m  # None: in the mirror direction, at any distance
    beyond = None if offset is None else (1.5 * offset[0], 1.5 * offset[1])
    farther = replace(wall, distance_m=1.5 * known["distance_m"], target_offset_m=beyond)
    walls = {
        "wall 1.5 x as rough": wall.with_parameters({"roughness": 1.5 * known["roughness"]}),
        "wall 3 x as rough": wall.with_parameters({"roughness": min(1.0, 3 * known["roughness"])}),
        "1.5 x as far": farther,
        "a third of the light": replace(wall, gain=wall.gain / 3, ambient=wall.ambient / 3),
        "matte wall": replace(wall, wall_material="lambert"),
    }
    found = {"characters of an unseen hand": replace(base, glyphs=hand)}
    found |= {kind: replace(base, glyphs=DrawingGlyphs(kinds=(kind,), each=each)) for kind in KINDS}
    return found | {name: replace(base, glyphs=some, setup=other) for name, other in walls.items()}


def generalization(
    weights: Path,
    setup: Path,
    out: Path,
    workers: int = 0,
    progress: Progress = silent,
    force: bool = False,
) -> list[GeneralizationResult]:
    """Run one network on all sets and return what came of each.

    Args:
        weights: Weights file, or a run's folder.
        setup: Folder of the calibrated setup.
        out: Folder for datasets and results.
        workers: Processes that simulate; 0 = one for each core.
        progress: Called with each step of the simulations, and after each set, with what came of it.
        force: Whether to begin although the machine's memory will hardly do.

    Raises:
        DataError: The weights hold no confidence, or the setup can't be used.
    """
    loaded = load_weights(weights)
    if loaded.confidence is None:
        raise DataError(f"{weights} holds no confidence; train on a dataset with a validation split")
    sampling = loaded.sampling
    own = load_yaml(Simulation, calibrated_file(setup))
    operator = FrameOperator(own.setup, sampling) if "frame" in loaded.modality.slices else None
    processes(workers, 1)
    found = list[GeneralizationResult]()
    sets = evaluation_sets(own, sampling, 12)
    for done, (name, config) in enumerate(sets.items()):
        key = config_hash(config)[:8]
        folder = out / "simulations" / f"{setup.name}-{name.replace(' ', '-')}-{key}"
        dataset = simulate(config, folder, workers, progress=progress, force=force)
        same = operator is None or config.setup == own.setup
        own_wall = operator if same else FrameOperator(config.setup, sampling)
        progress(Step("score", done, len(sets), "sets", within=name))
        found.append(_score(name, loaded, dataset, operator, own_wall))
        progress(Step("score", done + 1, len(sets), "sets", found[-1]))
    return found


def _score(
    name: str,
    weights: Weights,
    dataset: Dataset,
    operator: FrameOperator | None,
    own_wall: FrameOperator | None,
) -> GeneralizationResult:
    """Score a set; `operator` is the setup that the network was trained for, `own_wall` that of the set."""
    assert weights.confidence is not None
    samples = NlosDataset(dataset, "all", weights.modality)
    images = weights.network.infer(samples.inputs, samples.position_m, samples.names)
    canvas, rows = dataset.sampling.canvas, dataset.sampling.scored
    truth = samples.truth.float()[:, rows]
    average = on_canvas(weights.confidence.mean, canvas, samples.position_m)

    def mean_db(pictures: Tensor) -> float:
        return float(psnr(pictures[:, rows].contiguous(), truth).mean())

    consistent_db = None
    if own_wall is not None:
        frames = [torch.from_numpy(read_shard(dataset.shard(one))[0].frame) for one in dataset.objects("all")]
        consistent_db = mean_db(consistent(images, torch.cat(frames), own_wall, TRUST))
    confidence_checks = check_confidence(weights.network, weights.confidence, samples, images, canvas, operator)
    return GeneralizationResult(name, mean_db(images), mean_db(average), consistent_db, confidence_checks)
