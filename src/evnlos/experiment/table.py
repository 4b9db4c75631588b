"""Scores of an experiment's arms, and records as tables.

- Scores of an arm: each network, their ensemble, both after data consistency, and what needs no network.
- Records as tables: arms beside the baselines, seeds averaged, with intervals over the characters.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from evnlos.analysis import BASELINES, assess, available_lpips, check_sampling, confusion
from evnlos.analysis.bounds import SequenceAnalysisSettings, sequence_bounds
from evnlos.analysis.confidence import ConfidenceCheck, consistent, risk_coverage
from evnlos.analysis.scores import Interval, aligned_mean, paired_difference
from evnlos.config import to_dict
from evnlos.data import (
    Dataset,
    NlosDataset,
    Sampling,
    as_modality,
    character_of,
    modality_order,
    read_capture,
    read_shard,
)
from evnlos.errors import DataError
from evnlos.experiment.study import Arm, Place, Record, Study, is_scored, keep_scores, records_there
from evnlos.files import write_atomically
from evnlos.inverse import best_bent
from evnlos.inverse.sequence_problem import SequenceOperator, strip_gram_of
from evnlos.machine import Progress
from evnlos.models import DrawnTargets, FrameOperator, drawn_targets, fit_linear, load_weights
from evnlos.models.confidence import SIDE
from evnlos.optics import MatrixTransport
from evnlos.scene import Target
from evnlos.setups import calibrated_file, load_setup
from evnlos.types import Plane

if TYPE_CHECKING:
    from evnlos.experiment.presets import GeneralizationResult


TRUST = 1.0
"""How far the frames may move the images of `+ consistency`: the variance that a probability itself has."""

ENSEMBLE = -1
"""Seed of a record that belongs to all seeds together."""


def score_arm(
    study: Study,
    arm: Arm,
    modality: str,
    runs: list[tuple[Path, dict[str, Any]]],
    made: Dataset | None,
    shown: tuple[Dataset, ...],
    place: Place,
    progress: Progress,
) -> list[Record]:
    """Score what an arm gave, and return the new records; those of the same networks that are there are kept.

    Args:
        study: The study.
        arm: The arm.
        modality: What its networks see.
        runs: Each seed's run and what decided it.
        made: The simulated dataset of the pre-training, where there is one.
        shown: The captures, in one way or several; a network sees them as it learned from them.
        place: Where records are kept.
        progress: Called with each new record.
    """
    recorded, folder = shown[0], place.out / "records" / study.name
    there, new = records_there(folder), list[Record]()
    samples = NlosDataset(recorded, study.split, modality)
    means = NlosDataset(recorded, "train", modality).truth.float().mean(dim=0)
    refined = study.refine and study.correct_pattern and arm.source == "calibrated"
    refined = refined and "frame" in as_modality(modality).slices

    def record(name: str, seed: int, settings: dict[str, Any]) -> Record:
        return Record(study.name, study.setup, name, modality, seed, study.split, {}, {}, {}, {}, settings)

    def score(blank: Record, images: Tensor, mean_image: Tensor | None) -> None:
        found = assess(images, samples, recorded, study.split, mean_image, available_lpips())
        new.append(keep_scores(blank, found, folder, progress))

    def score_variants(images: Tensor, seed: int, settings: dict[str, Any], mean_image: Tensor | None) -> None:
        plain = record(arm.name, seed, settings)
        if not is_scored(plain, there):
            score(plain, images, mean_image)
        moved = record(f"{arm.name} + consistency", seed, settings)
        if refined and not is_scored(moved, there):
            score(moved, _consistent(study, arm, recorded, place, images), mean_image)

    pictures = []
    for (run, settings), seed in zip(runs, study.seeds, strict=True):
        weights = load_weights(run)
        own = next((d for d in shown if d.sampling.surface == weights.sampling.surface), recorded)
        check_sampling(weights, own.sampling)
        inputs, settings = samples.inputs, settings | {"run": run.name}
        if own is not recorded:
            inputs, settings["captures"] = NlosDataset(own, study.split, modality).inputs, own.folder.name
        pictures.append(weights.network.infer(inputs, samples.position_m, samples.names))
        score_variants(pictures[-1], seed, settings, weights.mean_image)
        averaged = record(f"{arm.name}, averaged", seed, settings)
        if study.average and not weights.network.sees_sequence and not is_scored(averaged, there):
            mean = aligned_mean(pictures[-1], samples.position_m, samples.names, recorded.sampling)
            score(averaged, mean, weights.mean_image)
    if len(runs) > 1:
        together = torch.stack(pictures).mean(dim=0)
        score_variants(together, ENSEMBLE, {"runs": [run.name for run, _ in runs]}, means)
    for name, make in _without_network(study, arm, modality, samples, means, made, recorded, place):
        simulation = {"simulation": made.config_hash} if made is not None else {}
        blank = record(name, 0, {"captures": recorded.folder.name} | simulation)
        if not is_scored(blank, there):
            score(blank, make(), means)
    return new


def _without_network(
    study: Study,
    arm: Arm,
    modality: str,
    samples: NlosDataset,
    mean_image: Tensor,
    made: Dataset | None,
    recorded: Dataset,
    place: Place,
) -> Iterator[tuple[str, Callable[[], Tensor]]]:
    """Yield the baselines that belong to an arm, each with what makes its images."""
    if study.name == "captures" and arm.pretraining is None:
        yield "linear, captures", lambda: _linear(recorded, modality, samples)
    if arm.finetuning is not None or made is None:
        return
    if study.retrieval and modality == "frame" and arm.source == "calibrated":
        setup = study.setup_folder(place.out)
        yield (
            "retrieval",
            lambda: retrieved(
                drawn_targets(setup, place.workers), recorded, study.split, _operator(setup, arm.sampling)
            ),
        )
    if study.name == "captures":
        yield "linear, simulation", lambda: _linear(made, modality, samples)
        if modality == "frame":
            start = mean_image.expand(len(samples), -1, -1)
            yield "classical inversion", lambda: _consistent(study, arm, recorded, place, start)


def _linear(data: Dataset, modality: str, samples: NlosDataset) -> Tensor:
    known = NlosDataset(data, "train", modality)
    return fit_linear(known.inputs, known.truth, known.names, modality=known.modality)(samples.inputs)


def retrieved(targets: DrawnTargets, recorded: Dataset, split: str, operator: FrameOperator) -> Tensor:
    """Return the target that explains the frames of each sequence best, drawn where the target was.

    With y the frames, A the light path and x a target at the known places, each less its mean over the
    sequence, it has the least |y - g A x|^2 at its own best brightness g >= 0: the largest
    (x^T A^T y)^2 / (x^T A^T A x), from the normal equations of all time steps together. What stands still
    counts for nothing. The targets that explain most are bent until they explain more (`inverse.best_bent`).

    Args:
        targets: What is searched.
        recorded: The captures.
        split: Which of them.
        operator: The calibrated setup.

    Returns:
        float32 [N, H, W], 0..1.

    Raises:
        DataError: A motion is unknown.
    """
    masks, size_m, canvas = targets.masks.float(), targets.about.size_m, recorded.sampling.canvas
    plane = Plane(SIDE, SIDE, size_m / SIDE)
    cells = Plane(operator.rows.stop - operator.rows.start, canvas.width, canvas.pitch_m)
    transport = MatrixTransport(operator.matrix, cells, operator.size)
    strip_gram = strip_gram_of(transport)
    found = []
    for name in recorded.objects(split):
        samples, _ = read_shard(recorded.shard(name))
        if samples.position_m is None:
            raise DataError(f"the motion of {name} is unknown; retrieval draws targets at known places")
        sight = SequenceOperator(transport, plane, samples.position_m)
        frames = torch.from_numpy(samples.frame)
        back = sight.adjoint(frames - frames.mean(dim=0)).flatten().double()
        explained = partial(_explained, back, sight.gram(strip_gram, math.inf))
        target = Target(name, best_bent(masks, plane.shape, explained).numpy(), size_m)
        found.append(torch.from_numpy(target.rasterise(canvas, samples.position_m)))
    return torch.cat(found)


def _explained(back: Tensor, gram: Tensor, targets: Tensor) -> Tensor:
    """Return how much of |y|^2 each target [K, n] explains, from A^T y [n] and A^T A [n, n]."""
    power = ((targets @ gram) * targets).sum(dim=1)
    return (targets @ back).clamp_min(0).square() / power.clamp_min(1e-12)


def _consistent(study: Study, arm: Arm, recorded: Dataset, place: Place, images: Tensor) -> Tensor:
    """Return images of the scored split after data consistency with the calibrated setup."""
    operator = _operator(study.setup_folder(place.out), arm.sampling)
    names = recorded.objects(study.split)
    frames = torch.cat([torch.from_numpy(read_shard(recorded.shard(name))[0].frame) for name in names])
    return consistent(images, frames, operator, TRUST)


@lru_cache(maxsize=2)
def _operator(setup: Path, sampling: Sampling) -> FrameOperator:
    return FrameOperator(load_setup(setup), sampling)


_PLACES = {"psnr_db": 2, "psnr_box_db": 2}


def means_of(records: list[Record], metric: str = "psnr_db") -> dict[tuple[str, str], list[float]]:
    """Return (arm, modality) -> the mean over all characters of each seed; ensembles stand by themselves."""
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    for record in records:
        name = record.arm if record.seed >= 0 else f"{record.arm}, ensemble"
        found[name, record.modality].append(float(np.mean(list(record.scores[metric].values()))))
    return dict(found)


def difference(records: list[Record], arm: str, other: str, modality: str) -> Interval:
    """Return PSNR of an arm minus that of another, dB, with an interval over characters and seeds.

    Raises:
        DataError: One of the arms has no record.
    """
    stacks, objects = [], None
    for name in (arm, other):
        chosen = [r for r in records if r.arm == name and r.modality == modality and r.seed >= 0]
        if not chosen:
            raise DataError(f"no record of {name!r} on {modality}; run the experiment first")
        objects = [key for key, values in chosen[0].positions.items() for _ in values]
        stacks.append([np.concatenate(list(record.positions.values())) for record in chosen])
    assert objects is not None
    return paired_difference(stacks[0], stacks[1], objects)


def summary_table(records: list[Record], metric: str = "psnr_db") -> str:
    """Return Markdown: a row per arm, a column per modality; mean over characters and seeds, +- over seeds."""
    means = means_of(records, metric)
    modalities = sorted({key[1] for key in means}, key=modality_order)
    digits = _PLACES.get(metric, 3)
    lines = [f"| {metric} | {' | '.join(modalities)} |", "|---|" + "---|" * len(modalities)]
    for name, title in BASELINES.items():
        if not any(name in r.baselines for r in records):
            continue
        cells = []
        for seen in modalities:
            values = [r.baselines[name][metric] for r in records if r.modality == seen and name in r.baselines]
            cells.append(f"{np.mean(list(values[-1].values())):.{digits}f}" if values else "")
        lines.append(f"| {title} | {' | '.join(cells)} |")
    for arm in dict.fromkeys(key[0] for key in means):
        cells = [_cell(means.get((arm, modality)), digits) for modality in modalities]
        lines.append(f"| {arm} | {' | '.join(cells)} |")
    return "\n".join(lines)


def character_table(records: list[Record], arms: tuple[str, ...], metric: str = "psnr_db") -> str:
    """Return Markdown in the paper's layout: a row per character, a column for each arm and modality."""
    chosen = [r for r in records if r.arm in arms and r.seed >= 0]
    seen = sorted({r.modality for r in chosen}, key=modality_order)
    columns = [(a, p) for a in arms for p in seen if any(r.arm == a and r.modality == p for r in chosen)]
    digits = _PLACES.get(metric, 3)
    head = " | ".join(f"{arm} {modality}" for arm, modality in columns)
    lines = [f"| {metric} | {head} |", "|---|" + "---|" * len(columns)]
    for name in dict.fromkeys(name for record in chosen for name in record.scores[metric]):
        values = [
            np.mean([r.scores[metric][name] for r in chosen if (r.arm, r.modality) == column])
            for column in columns
        ]
        best = max(values)
        cells = [f"**{v:.{digits}f}**" if v == best else f"{v:.{digits}f}" for v in values]
        lines.append(f"| {character_of(name)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def gains_over_e2e(records: list[Record], arm: str = "EPNP") -> dict[str, tuple[str, Interval]]:
    """Return modality -> the strongest of end-to-end arms, and what an arm gains over it, dB.

    Args:
        records: Records of a study.
        arm: Name of the arm.
    """
    means, found = means_of([r for r in records if r.seed >= 0]), dict[str, tuple[str, Interval]]()
    for modality in sorted({r.modality for r in records if r.arm == arm}, key=modality_order):
        others = [name for name, seen in means if seen == modality and name.startswith("E2E")]
        if others:
            best = max(others, key=lambda name: float(np.mean(means[name, modality])))
            found[modality] = best, difference(records, arm, best, modality)
    return found


def gain_table(records: list[Record], arm: str = "EPNP") -> str:
    """Return Markdown: `gains_over_e2e`, with 95 % intervals, and PSNR.

    Args:
        records: Records of a study.
        arm: Name of the arm.
    """
    means = means_of([r for r in records if r.seed >= 0])
    lines = [f"| sees | strongest E2E | its PSNR, dB | {arm} | {arm} - E2E, 95 % interval |", "|---" * 5 + "|"]
    for seen, (best, gain) in gains_over_e2e(records, arm).items():
        own, other = (f"{np.mean(means[name, seen]):.2f}" for name in (arm, best))
        lines.append(f"| {seen} | {best} | {other} | {own} | {gain} |")
    return "\n".join(lines)


def checks_table(records: list[Record]) -> str:
    """Return Markdown: shares of images that are recognized and that are no memory, and the confusion.

    Args:
        records: Records of a study.
    """
    found: dict[tuple[str, str], list[Record]] = defaultdict(list)
    for record in records:
        name = record.arm if record.seed >= 0 else f"{record.arm}, ensemble"
        found[name, record.modality].append(record)
    lines = [
        "| | recognized | of the true images | nearer to the truth than to any capture | taken for another |",
        "|---|---|---|---|---|",
    ]
    for (arm, modality), own in found.items():
        checks = [record.checks for record in own]
        cells = []
        for key in ("read", "read_truth", "nearer_to_truth"):
            values = [c[key] for c in checks if key in c]
            cells.append(f"{100 * np.mean(values):.0f} %" if values else "")
        cells.append(confusion([record.read_as for record in own]))
        lines.append(f"| {arm} {modality} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(values: list[float] | None, digits: int) -> str:
    if not values:
        return ""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{np.mean(values):.{digits}f} +- {np.std(values, ddof=1):.{digits}f}"


def bounds_table(setup: Path, capture: Path, name: str) -> str:
    """Return Markdown: what the best linear estimate is worth on a calibrated setup, at a capture's motion.

    Args:
        setup: Folder of the setup; where it is not calibrated the text is empty.
        capture: Folder of a capture.
        name: What to call the setup.
    """
    if not calibrated_file(setup).is_file():
        return ""
    asked = SequenceAnalysisSettings.of_capture(read_capture(capture, needs_frames=False, needs_events=False))
    found = sequence_bounds(load_setup(setup), asked, f"best linear estimate, {name}")
    return f"\n{found.table()}\n"


def write_generalization(found: list[GeneralizationResult], path: Path) -> None:
    """Write the findings, sequence by sequence, as JSON."""
    write_atomically(path, json.dumps([to_dict(one) for one in found], indent=1).encode())


def generalization_table(found: list[GeneralizationResult]) -> str:
    """Return the findings as a table, and how well the support orders all sequences by their skill."""
    head = ["set", "sequences", "PSNR, dB", "+ consistency, dB", "average target, dB"]
    head += ["skill", "support", "agreement", "explained", "measured", "coverage", "width"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for one in found:
        moved = "-" if one.consistent_db is None else f"{one.consistent_db:.2f}"
        row = [one.name, str(len(one.confidence_checks)), f"{one.psnr_db:.2f}", moved, f"{one.average_db:.2f}"]
        row += [f"{one.mean(key):.2f}" for key in ("skill", "support", "agreement")]
        row.append("-" if one.confidence_checks[0].explained is None else f"{one.mean('explained'):.2f}")
        row += [f"{one.mean(key):.0%}" for key in ("measured", "coverage")]
        lines.append(f"| {' | '.join(row)} | {one.mean('width'):.2f} |")
    return "\n".join([*lines, "", _order([sequence for one in found for sequence in one.confidence_checks])])


def _order(sequences: list[ConfidenceCheck]) -> str:
    support, skill = (np.array([getattr(one, key) for one in sequences]) for key in ("support", "skill"))
    risk = 1 - skill
    parts = []
    orders = {"by support": support, "by skill itself": skill, "as they come": np.zeros(len(risk))}
    for name, order in orders.items():
        shares, kept = risk_coverage(order, risk)
        at = [float(kept[np.searchsorted(shares, share)]) for share in (0.25, 0.5, 0.75, 1.0)]
        parts.append(f"{name} " + " / ".join(f"{1 - value:.2f}" for value in at))
    return "Mean skill of the best 25 / 50 / 75 / 100 % of all sequences: " + "; ".join(parts) + "."
