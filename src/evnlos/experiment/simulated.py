"""The paper's experiment without captures: learn from handwriting, test on unseen hands, go over to Comic."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from evnlos.config import config_hash, to_dict
from evnlos.dataset import PARADIGMS, Dataset, Paradigm, SensorSize, Simulation, open_dataset
from evnlos.dataset.presets import paper
from evnlos.evaluation import available_lpips, evaluate
from evnlos.experiment.making import simulated_steps
from evnlos.experiment.records import keep_scores, names_there
from evnlos.experiment.study import Record, Step
from evnlos.experiment.trainings import Run, train_one
from evnlos.model import load_weights
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, FontGlyphs, HandwritingGlyphs
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
    paradigms: tuple[Paradigm, ...] = PARADIGMS
    """What the networks see."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of initial weights and order of the samples."""
    test: str = "GK49"
    """Comic characters that no network is trained on."""
    workers: int = 0
    """Processes that simulate; 0 = one for each core."""


def simulations(settings: Simulated) -> dict[str, Simulation]:
    """Return the three sets: handwriting to train on, a hand held out, and Comic letters and digits."""
    base = replace(paper(), sensor=settings.sensor)
    unseen = HandwritingGlyphs(writers=1, first_writer=TRAIN_WRITERS)
    comic = FontGlyphs(characters=UPPER_CASE + DIGITS)
    return {
        "train": replace(base, glyphs=HandwritingGlyphs(writers=settings.writers)),
        "nist": replace(base, glyphs=unseen, validation=0.0, held_out=UPPER_CASE),
        "comic": replace(base, glyphs=comic, validation=0.0, held_out=settings.test),
    }


def run_simulated(settings: Simulated) -> Iterator[Step]:
    """Run what is not done yet, yielding each step.

    Three arms: "pre-trained" (handwriting alone), "EPNP" (then fine-tuned on Comic), "E2E" (Comic alone). The
    first is scored on the hand held out and on Comic, the others on the Comic characters held out.

    Args:
        settings: What to run, and where.
    """
    data = {}
    for name, config in simulations(settings).items():
        folder = settings.out / "simulations" / f"paper-{name}-{config_hash(config)[:8]}"
        yield from simulated_steps(config, folder, settings.workers)
        data[name] = open_dataset(folder)
    for paradigm in settings.paradigms:
        for seed in settings.seeds:
            plans = [
                ("pre-trained", settings.pretraining, "train", False),
                ("EPNP", settings.finetuning, "comic", True),
                ("E2E", settings.end_to_end, "comic", False),
            ]
            first: Path | None = None
            for arm, plan, source, goes_on in plans:
                plan = replace(plan, paradigm=paradigm, seed=seed)
                start = first if goes_on else None
                decided = {
                    "settings": to_dict(plan),
                    "data": data[source].config_hash,
                    "from": start.name if start else None,
                }
                key = config_hash(decided)[:8]
                run = settings.out / "runs" / f"paper-{arm.lower()}-{paradigm}-seed{seed}-{key}"
                yield from train_one(Run(data[source], plan, run, start))
                first = first or run
                sets = ("nist", "comic") if arm == "pre-trained" else ("comic",)
                for tested in sets:
                    yield from _score(settings, arm, paradigm, seed, run, tested, data[tested], decided)


def _score(
    settings: Simulated,
    arm: str,
    paradigm: Paradigm,
    seed: int,
    run: Path,
    tested: str,
    data: Dataset,
    decided: dict[str, Any],
) -> Iterator[Step]:
    folder = settings.out / "records" / NAME
    record = Record(NAME, tested, arm, paradigm, seed, "test", {}, {}, {}, {}, decided | {"run": run.name})
    if record.name not in names_there(folder):
        yield keep_scores(record, evaluate(load_weights(run), data, "test", available_lpips()), folder)
