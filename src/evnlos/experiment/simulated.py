"""The paper's experiment without captures: learn from handwriting, test on unseen hands, go over to Comic."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from evnlos.analysis import available_lpips, evaluate
from evnlos.config import config_hash, to_dict
from evnlos.data import STANDARD_MODALITIES, Simulation, simulate
from evnlos.data.simulations import paper
from evnlos.experiment.run import Run, train_one
from evnlos.experiment.study import Record, is_scored, keep_scores, records_there
from evnlos.machine import Progress, silent
from evnlos.models import load_weights
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, FontGlyphs, HandwritingGlyphs
from evnlos.setups import SensorSize
from evnlos.training import Training

NAME = "simulation"
"""Name of the experiment."""


@dataclass(frozen=True)
class Simulated:
    """Settings of the experiment."""

    out: Path
    """Folder for datasets, runs and records."""
    sensor: SensorSize = field(default_factory=SensorSize)
    """Sensor; the paper's has 960 x 600 pixels."""
    writers: int = TRAIN_WRITERS
    """Writers of the 26 letters to pre-train on; the paper has 39."""
    pretraining: Training = field(default_factory=lambda: Training(epochs=4))
    """Pre-training on handwriting."""
    finetuning: Training = field(default_factory=lambda: Training(epochs=10, learning_rate=5e-4))
    """Fine-tuning on Comic characters."""
    end_to_end: Training = field(default_factory=lambda: Training(epochs=24))
    """Training on Comic characters alone."""
    modalities: tuple[str, ...] = STANDARD_MODALITIES
    """What the networks see."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of initial weights and order of the samples."""
    test: str = "GK49"
    """Comic characters that no network is trained on."""
    workers: int = 0
    """Processes that simulate; 0 = one for each core."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""


def simulations(settings: Simulated) -> dict[str, Simulation]:
    """Return the three sets: handwriting to train on, a hand held out, and Comic letters and digits."""
    base = replace(paper(), setup=replace(paper().setup, sensor=settings.sensor))
    unseen = HandwritingGlyphs(writers=1, first_writer=TRAIN_WRITERS)
    comic = FontGlyphs(characters=UPPER_CASE + DIGITS)
    return {
        "train": replace(base, glyphs=HandwritingGlyphs(writers=settings.writers)),
        "nist": replace(base, glyphs=unseen, validation=0.0, held_out=UPPER_CASE),
        "comic": replace(base, glyphs=comic, validation=0.0, held_out=settings.test),
    }


def run_simulated(settings: Simulated, progress: Progress = silent) -> list[Record]:
    """Run what is not done yet, and return the records that are new.

    Three arms: "pre-trained" (handwriting alone), "EPNP" (then fine-tuned on Comic), "E2E" (Comic alone). The
    first is scored on the hand held out and on Comic, the others on the Comic characters held out.

    Args:
        settings: What to run, and where.
        progress: Called with each step of simulation, training and scoring.
    """
    data, records = {}, list[Record]()
    for name, config in simulations(settings).items():
        folder = settings.out / "simulations" / f"paper-{name}-{config_hash(config)[:8]}"
        data[name] = simulate(config, folder, settings.workers, progress=progress, force=settings.force)
    for modality in settings.modalities:
        for seed in settings.seeds:
            plans = [
                ("pre-trained", settings.pretraining, "train", False),
                ("EPNP", settings.finetuning, "comic", True),
                ("E2E", settings.end_to_end, "comic", False),
            ]
            first: Path | None = None
            for arm, plan, source, goes_on in plans:
                plan = replace(plan, modality=modality, seed=seed)
                start = first if goes_on else None
                decided = {
                    "settings": to_dict(plan),
                    "data": data[source].config_hash,
                    "from": start.name if start else None,
                }
                key = config_hash(decided)[:8]
                run = settings.out / "runs" / f"paper-{arm.lower()}-{modality}-seed{seed}-{key}"
                train_one(Run((data[source],), plan, run, start), progress)
                first = first or run
                test_sets = ("nist", "comic") if arm == "pre-trained" else ("comic",)
                for tested in test_sets:
                    record = _record(arm, modality, seed, run, tested, decided)
                    folder = settings.out / "records" / NAME
                    if not is_scored(record, records_there(folder)):
                        found = evaluate(load_weights(run), data[tested], "test", available_lpips())
                        records.append(keep_scores(record, found, folder, progress))
    return records


def _record(arm: str, modality: str, seed: int, run: Path, tested: str, decided: dict[str, Any]) -> Record:
    """Return a record without its scores."""
    return Record(NAME, tested, arm, modality, seed, "test", {}, {}, {}, {}, decided | {"run": run.name})
