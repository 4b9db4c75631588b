"""Fine-tuning that cannot lose: how much of it, if any, is chosen on captures that it did not learn from."""

from __future__ import annotations

import json
import shutil
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.config import save_yaml, to_dict, write_atomically
from evnlos.data import Dataset, NlosDataset
from evnlos.errors import ConfigError
from evnlos.files import directory_lock
from evnlos.machine import Progress, Step, silent
from evnlos.metrics import psnr
from evnlos.models import Reconstructor, Weights, load_weights, save_weights
from evnlos.training.settings import Training
from evnlos.training.train import TrainingResult, about_run, check_run, train
from evnlos.types import derive_seed

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the way from the pre-trained to the fine-tuned weights that are tried."""

CHOICE = "choice.json"
"""Name of the file, in the run's folder, that says what was chosen."""


@dataclass(frozen=True)
class Choice:
    """What cross-validation chose for a fine-tuning.

    Args:
        candidate: Index of the settings that were chosen; None: the weights stay as they are.
        share: Share of the way from the old to the fine-tuned weights, 0..1.
        gain_db: Mean gain over the old weights on objects held out, dB.
        error_db: Standard error of that gain over the objects, dB.
        table: Mean gain, dB, of every candidate [C] at every share [S]; the old weights have 0.
    """

    candidate: int | None
    share: float
    gain_db: float
    error_db: float
    table: list[list[float]]

    def sentence(self) -> str:
        """Return the choice in one sentence."""
        if self.candidate is None:
            return "fine-tuning did not help on captures held out: the pre-trained weights stay as they are"
        return (
            f"fine-tuning with settings {self.candidate + 1} of {len(self.table)}, {100 * self.share:.0f} % of "
            f"the way: {self.gain_db:+.2f} dB (standard error {self.error_db:.2f}) on captures held out"
        )


def alternatives(settings: Training) -> tuple[Training, ...]:
    """Return fine-tunings around one: itself, slower and quicker ones, with the normalization kept or not."""
    rate, keeps = settings.learning_rate, settings.keep_normalization
    slower = replace(settings, learning_rate=rate / 5, keep_normalization=True)
    quicker = replace(settings, learning_rate=rate * 5, keep_normalization=False)
    return (settings, slower, quicker, replace(settings, keep_normalization=not keeps))


def choose_and_finetune(
    dataset: Dataset,
    candidates: tuple[Training, ...],
    out: str | Path,
    weights: str | Path,
    folds: int = 2,
    progress: Progress = silent,
) -> TrainingResult:
    """Fine-tune weights on captures as is best for captures held out, or leave them as they are.

    The training objects are dealt into folds. For each candidate and fold the weights are fine-tuned on the
    other folds; weights between the old and the new ones, (1 - a) old + a new, are scored on the fold
    (Wortsman et al., Robust fine-tuning of zero-shot models, CVPR 2022). The best candidate and share `a` are
    taken if they gain more than a standard error over the objects, and then used on all training objects.

    Args:
        dataset: Captures; the split `train` is dealt into folds and learned from, no other is read.
        candidates: Settings of fine-tunings, one or more.
        out: Folder of the run, as of `train`, with `choice.json` beside the weights.
        weights: Weights or run to start from.
        folds: Parts of the training objects, 2 or more; with fewer objects than 2 nothing is fine-tuned.
        progress: As of `train`.

    Returns:
        The run; `read_choice` tells what was chosen.

    Raises:
        ConfigError: No candidate, or fewer than two folds.
        DataError: As of `train`.
    """
    if not candidates or folds < 2:
        raise ConfigError(f"{len(candidates)} candidates in {folds} folds; give at least 1 in at least 2")
    out = Path(out)
    trials = out.with_name(f"{out.name}-trials")
    start = load_weights(weights)
    about = about_run(dataset, candidates[0], start)
    about |= {"candidates": [to_dict(settings) for settings in candidates], "folds": folds}
    with directory_lock(out, check=lambda: check_run(out, about)):
        if (out / "weights.safetensors").is_file():
            return TrainingResult(out, _records(out))
        save_yaml(about, out / "run.yaml")
        gains = _cross_validated(dataset, candidates, trials, weights, start, folds, progress)
        choice = _choice(gains)
        if choice.candidate is None:
            result, network, log = start, start.network, list[dict[str, Any]]()
        else:
            run = train(dataset, candidates[choice.candidate], trials / "all", weights, progress)
            result, log = run.load(), run.records
            network = between(start.network, result.network, choice.share)
        final = Weights(
            network,
            [*start.history, about | {"choice": asdict(choice)}],
            NlosDataset(dataset, "train", network.modality).truth.float().mean(dim=0),
            result.confidence,
        )
        write_atomically(out / CHOICE, json.dumps(asdict(choice), indent=1).encode())
        write_atomically(out / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in log).encode())
        save_weights(out / "weights.safetensors", final)
    shutil.rmtree(trials, ignore_errors=True)
    return TrainingResult(out, log)


def read_choice(run: str | Path) -> Choice | None:
    """Return what was chosen for a run, or None where nothing was to be chosen."""
    path = Path(run) / CHOICE
    return Choice(**json.loads(path.read_text())) if path.is_file() else None


def between(old: Reconstructor, new: Reconstructor, share: float) -> Reconstructor:
    """Return a network between two of one architecture, with the closed-form part and normalization of the new.

    Args:
        old: Network at share 0.
        new: Network at share 1.
        share: Share of the way, 0..1.
    """
    network = deepcopy(new)
    ours = dict(old.named_parameters())
    with torch.no_grad():
        for name, value in network.named_parameters():
            value.lerp_(ours[name].to(value), 1.0 - share)
    return network.eval()


def _cross_validated(
    dataset: Dataset,
    candidates: tuple[Training, ...],
    trials: Path,
    weights: str | Path,
    start: Weights,
    folds: int,
    progress: Progress,
) -> NDArray[np.float64]:
    """Return the gain over the old weights in dB, [candidate, share, object], each object when held out."""
    objects = dataset.objects("train")
    order = np.random.default_rng(derive_seed(candidates[0].seed, "folds")).permutation(len(objects))
    parts = [part for part in np.array_split(order, folds) if len(part)]
    gains = np.zeros((len(candidates), len(SHARES), len(objects)))
    if len(parts) < 2:
        return gains
    total = len(candidates) * len(parts)
    for j, part in enumerate(parts):
        held = [objects[i] for i in part]
        rest = [name for name in objects if name not in held]
        scored = NlosDataset(replace(dataset, split={"train": held}), "train", start.modality)
        before = _scores(start.network, scored, dataset, held)
        for k, settings in enumerate(candidates):
            progress(Step(f"choose {trials.name}", j * len(candidates) + k, total, "trainings"))
            few = replace(dataset, split={"train": rest})
            tuned = train(few, settings, trials / f"{k}-{j}", weights).load().network
            for s, share in enumerate(SHARES):
                gains[k, s, part] = (
                    _scores(between(start.network, tuned, share), scored, dataset, held) - before
                )
    progress(Step(f"choose {trials.name}", total, total, "trainings"))
    return gains


def _scores(
    network: Reconstructor, samples: NlosDataset, dataset: Dataset, objects: list[str]
) -> NDArray[np.float64]:
    """Return the PSNR of each object, the mean over its images, dB [N]."""
    images = network.infer(samples.inputs, samples.position_m, samples.names)
    rows = dataset.sampling.scored
    each = psnr(images[:, rows], samples.truth.float()[:, rows]).numpy()
    return np.array([each[samples.names == name].mean() for name in objects])


def _choice(gains: NDArray[np.float64]) -> Choice:
    """Return the best of the gains [candidate, share, object], if it is more than its standard error."""
    mean = gains.mean(axis=2)
    k, s = np.unravel_index(int(mean.argmax()), mean.shape)
    count = gains.shape[2]
    error = float(gains[k, s].std(ddof=1) / np.sqrt(count)) if count > 1 else float("inf")
    table = np.round(mean, 3).tolist()
    if not mean[k, s] > error:
        return Choice(None, 0.0, 0.0, 0.0, table)
    return Choice(int(k), SHARES[s], round(float(mean[k, s]), 3), round(error, 3), table)


def _records(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
