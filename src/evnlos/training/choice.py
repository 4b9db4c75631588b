"""How to learn from few captures: no more than helps, and from more than were taken.

- Fine-tuning that cannot lose: how much of it, if any, is chosen on captures that it did not learn from.
- Exact further captures: upside down where the setup is symmetric, and means of two.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.config import config_hash, save_yaml, to_dict, write_atomically
from evnlos.data import Dataset, NlosDataset, Samples, as_modality, open_dataset, read_shard, write_shard
from evnlos.data.store import claim_dataset, read_shard_index
from evnlos.errors import ConfigError, DataError
from evnlos.files import directory_lock
from evnlos.machine import Progress, Step, silent
from evnlos.metrics import psnr
from evnlos.models import Reconstructor, Weights, fit_linear, load_weights, save_weights
from evnlos.training.settings import Training, about_run, check_run
from evnlos.training.train import TrainingResult, train
from evnlos.types import derive_seed

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the way from the pre-trained to the fine-tuned weights that are tried."""

_FOLDS = 2
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
        table: Mean gain, dB, of every candidate [C] at every share [S]; None: the captures are too few for it.
    """

    candidate: int | None
    share: float
    gain_db: float
    error_db: float
    table: list[list[float | None]]

    def sentence(self) -> str:
        """Return the choice in one sentence."""
        if self.candidate is None:
            return "fine-tuning did not help on captures held out: the pre-trained weights stay as they are"
        return (
            f"fine-tuning with settings {self.candidate + 1} of {len(self.table)}, {100 * self.share:.0f} % of "
            f"the way: {self.gain_db:+.2f} dB (standard error {self.error_db:.2f}) on captures held out"
        )


def alternatives(settings: Training, network: Reconstructor) -> tuple[Training, ...]:
    """Return fine-tunings around one: itself, then others.

    Slower, with the weights' normalization; quicker, with the captures'; that alone; more epochs; normalization
    and linear embedding fitted again to the captures; the first part of the network kept.

    Args:
        settings: The fine-tuning to vary.
        network: What is fine-tuned.
    """
    rate, keeps = settings.learning_rate, settings.keep_normalization
    found = [
        settings,
        replace(settings, learning_rate=rate / 5, keep_normalization=True),
        replace(settings, learning_rate=rate * 5, keep_normalization=False),
        replace(settings, keep_normalization=not keeps),
        replace(settings, epochs=3 * settings.epochs),
    ]
    if not settings.refit_embedding:
        again = replace(settings, refit_embedding=True, network=network.settings)
        found.append(replace(again, keep_normalization=False))
    if network.parts and not settings.freeze:
        found.append(replace(settings, freeze=tuple(network.parts)[:1]))
    return tuple(found)


def choose_and_finetune(
    dataset: Dataset,
    candidates: tuple[Training, ...],
    out: str | Path,
    weights: str | Path,
    progress: Progress = silent,
) -> TrainingResult:
    """Fine-tune weights on captures as is best for captures held out, or leave them as they are.

    The training objects are dealt into two folds; of fewer than two objects nothing is learned. For each
    candidate and fold the weights are fine-tuned on the other fold; weights between the old and the new ones,
    (1 - a) old + a new, are scored on the fold (Wortsman et al., Robust fine-tuning of zero-shot models, CVPR
    2022). The best candidate and share `a` are taken if they gain more than a standard error over the objects,
    and then used on all training objects.

    Args:
        dataset: Captures; the split `train` is dealt into folds and learned from, no other is read.
        candidates: One or more; any but the first is left out where the captures are too few for it.
        out: Folder of the run, as of `train`, with `choice.json` beside the weights.
        weights: Weights or run to start from.
        progress: As of `train`.

    Returns:
        The run; `read_choice` tells what was chosen.

    Raises:
        ConfigError: No candidate.
        DataError: As of `train`.
    """
    if not candidates:
        raise ConfigError("there are no candidates; give at least 1")
    out = Path(out)
    trials = out.with_name(f"{out.name}-trials")
    start = load_weights(weights)
    about = about_run(dataset, candidates[0], start)
    about |= {"candidates": [to_dict(settings) for settings in candidates], "folds": _FOLDS}
    with directory_lock(out, check=lambda: check_run(out, about)):
        if (out / "weights.safetensors").is_file():
            log = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
            return TrainingResult(out, log)
        save_yaml(about, out / "run.yaml")
        start = replace(start, network=start.network.seeing(dataset.sampling))
        gains = _cross_validated(dataset, candidates, trials, weights, start, progress)
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


def best_shown(datasets: Sequence[Dataset], weights: str | Path) -> Dataset:
    """Return, of datasets that show the same objects in other ways, the one that weights draw best.

    Args:
        datasets: Their splits `train` hold the same objects, and these alone are read.
        weights: Weights or run that have not learned from them.
    """
    if len(datasets) == 1:
        return datasets[0]
    start = load_weights(weights)
    scores = list[float]()
    for dataset in datasets:
        samples = NlosDataset(dataset, "train", start.modality)
        scores.append(float(_scores(start.network, samples, dataset, dataset.objects("train")).mean()))
    return datasets[int(np.argmax(scores))]


def read_choice(run: str | Path) -> Choice | None:
    """Return what was chosen for a run, or None where nothing was to be chosen.

    Args:
        run: Folder of the run.
    """
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
    progress: Progress,
) -> NDArray[np.float64]:
    """Return the gain over the old weights in dB, [candidate, share, object], each object when held out."""
    objects = dataset.objects("train")
    order = np.random.default_rng(derive_seed(candidates[0].seed, "folds")).permutation(len(objects))
    parts = [part for part in np.array_split(order, _FOLDS) if len(part)]
    gains = np.zeros((len(candidates), len(SHARES), len(objects)))
    if len(parts) < 2:
        return gains
    total, what = len(candidates) * len(parts), f"choose {trials.name}"
    for j, part in enumerate(parts):
        held = [objects[i] for i in part]
        rest = [name for name in objects if name not in held]
        scored = NlosDataset(replace(dataset, split={"train": held}), "train", start.modality)
        before = _scores(start.network, scored, dataset, held)
        for k, settings in enumerate(candidates):
            progress(Step(what, j * len(candidates) + k, total, "trainings"))
            few = replace(dataset, split={"train": rest})
            try:
                tuned = train(few, settings, trials / f"{k}-{j}", weights).load().network
            except DataError:  # too few captures for these settings, as for an embedding fitted to them alone
                if k == 0:
                    raise
                gains[k, :, part] = -math.inf
                continue
            for s, share in enumerate(SHARES):
                after = _scores(between(start.network, tuned, share), scored, dataset, held)
                gains[k, s, part] = after - before
    progress(Step(what, total, total, "trainings"))
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
    mean, count = gains.mean(axis=2), gains.shape[2]
    k, s = np.unravel_index(int(mean.argmax()), mean.shape)
    error = float(gains[k, s].std(ddof=1) / np.sqrt(count)) if count > 1 else float("inf")
    table = [[round(gain, 3) if math.isfinite(gain) else None for gain in row] for row in mean.tolist()]
    if not mean[k, s] > error:
        return Choice(None, 0.0, 0.0, 0.0, table)
    return Choice(int(k), SHARES[s], round(float(mean[k, s]), 3), round(error, 3), table)


MOST_ASYMMETRY = 1.05
"""Up to this `asymmetry` a setup counts as symmetric, and captures upside down as captures."""
_FEWEST = 4  # captures that tell symmetry
_ALIKE_PX = 0.05  # places that differ by less are the same


def asymmetry(dataset: Dataset, progress: Progress = silent) -> float:
    """Return by which factor captures upside down, learned from too, make predictions worse.

    A linear light path is fitted to half of the training objects, without and with the same ones upside down,
    and predicts frames and events of the other half. The worst of their channels counts; symmetric: up to 1.

    Args:
        dataset: Captures with known targets, at least four of them to learn from.
        progress: Called as fits are done.

    Raises:
        DataError: There are fewer.
    """
    lacks = (dataset.config.get("lacks") or {}).values()  # captures of one camera tell it by that one
    modality = "event" if "frames" in lacks else "frame" if "events" in lacks else "fusion"
    samples = NlosDataset(dataset, "train", modality)
    objects = np.unique(samples.names)
    if len(objects) < _FEWEST:
        raise DataError(f"{len(objects)} captures tell no symmetry; give at least {_FEWEST} to learn from")
    truth, seen = samples.truth.float()[:, None], samples.inputs.float()
    errors = torch.zeros(2, seen.shape[1])  # without and with those upside down; of each channel
    half = np.isin(samples.names, objects[::2])
    fits = 0
    for known in (half, ~half):
        chosen = torch.from_numpy(known)
        alone = truth[chosen], seen[chosen], samples.names[known]
        both = *(torch.cat([part, part.flip(-2)]) for part in alone[:2]), np.tile(alone[2], 2)
        for error, (x, y, names) in zip(errors, (alone, both), strict=True):
            progress(Step("how symmetric the setup is", fits, 4, "fits"))
            fits += 1
            predicted = fit_linear(x, y.flatten(1, 2), names)(truth[~chosen])
            error += (predicted.reshape(-1, *seen.shape[1:]) - seen[~chosen]).square().sum(dim=(0, 2, 3))
    progress(Step("how symmetric the setup is", 4, 4, "fits"))
    without, together = errors.clamp_min(1e-9)
    return float((together / without).max())


def augmented(dataset: Dataset, modality: str, progress: Progress = silent) -> Dataset:
    """Return captures with exact further ones to learn from, in a folder beside theirs; made where missing.

    - Upside down, where the setup is symmetric: four captures and more show an `asymmetry` of at most
      `MOST_ASYMMETRY`.
    - For networks of frames alone: weighted means of two captures at the same places, as many as there are
      captures by then. Light adds, so w y1 + (1 - w) y2 is the frame of w x1 + (1 - w) x2, under whatever
      ambient light; the weights add up to 1, so that no truth leaves 0..1 and nothing is clipped. Only its
      noise is less than a capture's. Events are not linear in the light: there are no means of them.

    Args:
        dataset: Captures with known targets and motions.
        modality: What the network sees.
        progress: Called while symmetry is looked for, and as captures are made.

    Raises:
        DataError: A target or a motion is unknown.
    """
    names = dataset.objects("train")
    factor = _measured(dataset.folder, progress) if len(names) >= _FEWEST else math.inf
    parts = {name: [(name, False)] for name in names}
    if factor <= MOST_ASYMMETRY:
        parts |= {f"mirrored_{name}": [(name, True)] for name in names}
    if not as_modality(modality).needs_events:
        parts |= _pairs(dataset, [one for (one,) in parts.values()])
    listed = {name: [list(one) for one in own] for name, own in parts.items()}
    about = {"asymmetry": round(factor, 3) if math.isfinite(factor) else None, "objects": listed}
    new = replace(
        dataset,
        folder=dataset.folder.with_name(f"{dataset.folder.name}-augmented-{config_hash(about)[:8]}"),
        split=dataset.split | {"train": list(parts)},
        config=dataset.config | {"augmented": about},
    )
    with claim_dataset(new):
        for done, name in enumerate(missing := new.missing()):
            progress(Step(f"learn from {new.folder.name}", done, len(missing), "captures", name))
            found = [_turned(dataset, *part) for part in parts.get(name, [(name, False)])]
            weight = float(np.random.default_rng(derive_seed(0, name, "weight")).uniform())
            samples = found[0] if len(found) == 1 else _mean(found[0], found[1], weight)
            write_shard(new.shard(name), samples, {"object": name, "config_hash": new.config_hash})
    return new


_ASYMMETRIES: dict[Path, float] = {}  # of the datasets that were looked at; several networks ask for one


def _measured(folder: Path, progress: Progress) -> float:
    """Return the asymmetry of a dataset's captures; it is looked for once, whoever is told of it."""
    if folder not in _ASYMMETRIES:
        _ASYMMETRIES[folder] = asymmetry(open_dataset(folder), progress)
    return _ASYMMETRIES[folder]


def _pairs(dataset: Dataset, objects: list[tuple[str, bool]]) -> dict[str, list[tuple[str, bool]]]:
    """Return as many pairs of objects, that were at the same places at the same steps, as there are objects."""
    draw, found = np.random.default_rng(derive_seed(0, "pairs")), dict[str, list[tuple[str, bool]]]()
    places = [_places(dataset, *one) for one in objects]
    near_m = _ALIKE_PX * dataset.sampling.pitch_m
    for number, (one, at) in enumerate(zip(objects, places, strict=True)):
        alike = [
            other
            for other, there in zip(objects, places, strict=True)
            if other != one and there.shape == at.shape and np.ptp([at, there], 0).max() < near_m
        ]
        if alike:
            found[f"mean{number:03d}"] = [one, alike[draw.integers(len(alike))]]
    return found


def _places(dataset: Dataset, name: str, is_turned: bool) -> NDArray[np.float64]:
    """Return where an object was at each step, upside down or as it was; its maps are left on disk."""
    index = read_shard_index(dataset.shard(name))
    if not index.has_truth or index.position_m is None:
        raise DataError(f"target or motion of {name} is unknown; learn from captures with both")
    return index.position_m * np.array([1.0, -1.0 if is_turned else 1.0])


def _turned(dataset: Dataset, name: str, is_turned: bool) -> Samples:
    """Return an object's samples, upside down or as they are."""
    places = _places(dataset, name, is_turned)
    samples, _ = read_shard(dataset.shard(name))
    if not is_turned:
        return samples
    maps = {key: np.flip(getattr(samples, key), -2) for key in ("frame", "surface", "truth")}
    return replace(samples, **maps, position_m=places)


def _mean(one: Samples, other: Samples, weight: float) -> Samples:
    """Return the frames and truth of a weighted mean of two objects; it has no events."""
    assert one.truth is not None and other.truth is not None
    frame, truth = (
        (weight * a + (1 - weight) * b).astype(np.float32)
        for a, b in ((one.frame, other.frame), (one.truth, other.truth))
    )
    nothing = np.zeros_like(one.surface), np.zeros_like(one.event_count)
    return replace(one, frame=frame, truth=truth, surface=nothing[0], event_count=nothing[1])
