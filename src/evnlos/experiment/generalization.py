"""What carries over: one network on other hands, other things than characters, and other walls than its own."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from evnlos.analysis.confidence import (
    ConfidenceCheck,
    FrameOperator,
    check_confidence,
    consistent,
    risk_coverage,
)
from evnlos.calibration.transport_fit import values_of
from evnlos.config import config_hash, load_yaml, to_dict
from evnlos.data import Dataset, NlosDataset, Sampling, Simulation, read_shard, simulate
from evnlos.data.pool import processes
from evnlos.errors import DataError
from evnlos.experiment.table import TRUST
from evnlos.files import write_atomically
from evnlos.metrics import psnr
from evnlos.models import Weights, load_weights
from evnlos.models.confidence import on_canvas
from evnlos.progress import Progress, Step, silent
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, DrawingGlyphs, HandwritingGlyphs
from evnlos.scene.drawings import KINDS
from evnlos.setups import calibrated_file


@dataclass(frozen=True)
class GeneralizationResult:
    """What one network made of one set of objects and walls.

    Args:
        name: What the set is.
        psnr_db: Mean PSNR of the network's pictures on the scored canvas, dB.
        average_db: The same of the average target, drawn where the target is, dB.
        consistent_db: The same of the network's pictures after data consistency with the set's own wall, dB;
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
    each: int = 12,
    progress: Progress = silent,
    force: bool = False,
) -> list[GeneralizationResult]:
    """Run one network on all sets and return what came of each.

    Args:
        weights: Weights file, or a run's folder.
        setup: Folder of the calibrated setup.
        out: Folder for datasets and results.
        workers: Processes that simulate; 0 = one for each core.
        each: Objects of a set.
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
    for name, config in evaluation_sets(own, sampling, each).items():
        key = config_hash(config)[:8]
        folder = out / "simulations" / f"{setup.name}-{name.replace(' ', '-')}-{key}"
        dataset = simulate(config, folder, workers, progress=progress, force=force)
        same = operator is None or config.setup == own.setup
        own_wall = operator if same else FrameOperator(config.setup, sampling)
        found.append(_score(name, loaded, dataset, operator, own_wall))
        progress(Step(f"score {folder.name}", 1, 1, "sets", found[-1]))
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


def write_generalization(found: list[GeneralizationResult], path: Path) -> None:
    """Write the findings, sequence by sequence, as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
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
    for order, name in (
        (support, "by support"),
        (skill, "by skill itself"),
        (np.zeros(len(risk)), "as they come"),
    ):
        shares, kept = risk_coverage(order, risk)
        at = [float(kept[np.searchsorted(shares, share)]) for share in (0.25, 0.5, 0.75, 1.0)]
        parts.append(f"{name} " + " / ".join(f"{1 - value:.2f}" for value in at))
    return "Mean skill of the best 25 / 50 / 75 / 100 % of all sequences: " + "; ".join(parts) + "."
