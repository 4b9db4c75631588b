"""The main job on one page: simulate, pre-train, fine-tune on captures, train end to end, evaluate, report."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from evnlos.dataset import PARADIGMS, Dataset, Simulation, import_captures, open_dataset, simulate
from evnlos.dataset.importer import character_of
from evnlos.dataset.lab import Lab, render_captures
from evnlos.dataset.presets import default
from evnlos.model import UNetConfig
from evnlos.report import gather, to_text, write_report
from evnlos.scene import FontGlyphs, HandwritingGlyphs
from evnlos.training import Training, train

LAB_CHARACTERS = "ACDEGHKLOPSTUXZ2479"
"""What the rendered captures show."""

_TEST = ("G", "K", "4", "9")


@dataclass(frozen=True)
class Demo:
    """Settings of the demo; a larger one is the same thing with other numbers."""

    out: Path = Path("demo")
    """Folder for everything that the demo makes; run it again to go on after an interruption."""
    captures: tuple[Path, ...] = ()
    """Capture folders; without any, pseudo-real ones are rendered."""
    test: tuple[str, ...] = _TEST
    """Characters of the captures that no training sees."""
    writers: int = 2
    """Writers of the simulated handwriting, 36 characters each."""
    pretrain_epochs: int = 6
    """Passes over the simulated samples."""
    finetune_epochs: int = 8
    """Passes over the captures when fine-tuning."""
    e2e_epochs: int = 8
    """Passes over the captures when training end to end."""
    width: int = 16
    """Channels of the network at its finest level."""
    workers: int = 0
    """Processes that simulate; 0 = one for each core."""
    seed: int = 0
    """Seed of every draw."""


def run_demo(settings: Demo) -> Path:
    """Run the main job and return the path of the report.

    Every step is resumable: what is done is not done again.
    """
    began, out = time.perf_counter(), settings.out
    out.mkdir(parents=True, exist_ok=True)
    notes = []
    simulation = _simulation(settings)
    total = len(simulation.glyphs.objects())
    _drain(simulate(simulation, out / "simulation", settings.workers), total, "simulate")
    pretraining = open_dataset(out / "simulation")

    folders = list(settings.captures)
    if not folders:
        lab = Lab(glyphs=FontGlyphs(characters=LAB_CHARACTERS), seed=settings.seed)
        notes.append(
            "The captures of this page are not recordings: they were rendered with a wall of rough aluminium, "
            "which the training simulator does not know, and other cameras. Give --captures for recordings."
        )
        notes += lab.glyphs.notes()
        names = lab.glyphs.objects()
        folders = list(_drain(render_captures(lab, out / "captures"), len(names), "render captures"))
    test = _held_out(folders, settings.test)
    _drain(import_captures(folders, out / "shots", test=test), len(folders), "import captures")
    shots = open_dataset(out / "shots")

    runs: list[str | Path] = []
    network = UNetConfig(width=settings.width)
    for paradigm in PARADIGMS:
        plan = Training(paradigm=paradigm, network=network, seed=settings.seed)
        pre = out / "runs" / f"pretrained-{paradigm}"
        _fit(pretraining, dataclasses.replace(plan, epochs=settings.pretrain_epochs), pre, None)
        e2e = out / "runs" / f"e2e-{paradigm}"
        _fit(shots, dataclasses.replace(plan, epochs=settings.e2e_epochs), e2e, None)
        epnp = out / "runs" / f"epnp-{paradigm}"
        _fit(shots, dataclasses.replace(plan, epochs=settings.finetune_epochs), epnp, pre)
        runs += [pre, e2e, epnp]

    dataset, results = gather(runs, out / "shots")
    notes.append(
        f"{len(shots.objects('train'))} captures to learn from; the simulator was not fitted to this rig."
    )
    path = write_report(out / "report.html", dataset, results, notes)
    for note in notes:
        print(note)
    print(to_text(results))
    print(f"report: {path} ({time.perf_counter() - began:.0f} s)")
    return path


def _simulation(settings: Demo) -> Simulation:
    base = default()
    assert isinstance(base.glyphs, HandwritingGlyphs)
    glyphs = dataclasses.replace(base.glyphs, writers=settings.writers)
    return dataclasses.replace(base, glyphs=glyphs, seed=settings.seed)


def _held_out(folders: list[Path], wanted: tuple[str, ...]) -> list[str]:
    """Return the characters to test on; every seventh where the captures have none of the wanted ones."""
    there = [character_of(folder.resolve().name) for folder in folders]
    return [c for c in wanted if c in there] or there[::7]


def _fit(dataset: Dataset, settings: Training, out: Path, weights: Path | None) -> None:
    records: Iterator[dict[str, Any]] = train(dataset, settings, out, weights)
    _drain(records, settings.epochs, f"train {out.name}")


def _drain(steps: Iterator[Any], total: int, title: str) -> list[Any]:
    with tqdm(steps, total=total, desc=title.ljust(24)) as bar:
        return list(bar)
