"""Studies that need no captures of their own.

- The paper's experiment without captures: learn from handwriting, test on unseen hands, go over to Comic.
- What a mismatch costs: the demo on setups that the simulator does not describe, in one table.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from evnlos.analysis import available_lpips, evaluate
from evnlos.analysis.scores import Interval
from evnlos.calibration import CALIBRATION_VALUES_FILE
from evnlos.config import config_hash, to_dict, write_atomically
from evnlos.data import STANDARD_MODALITIES, Simulation, simulate
from evnlos.data.lab import lab_of, render_captures
from evnlos.data.simulations import paper
from evnlos.demo import ROBUST, Demo, run_demo
from evnlos.errors import CalibrationError, DataError, UnknownNameError
from evnlos.experiment import Record, gains_over_e2e, means_of, read_records
from evnlos.experiment.run import Run, train_one
from evnlos.experiment.study import is_scored, keep_scores, records_there
from evnlos.machine import Progress, silent
from evnlos.models import load_weights
from evnlos.plot.figures import new_figure
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, FontGlyphs, HandwritingGlyphs
from evnlos.setups import ROOMS, SensorSize
from evnlos.training import Training

SIMULATION = "simulation"
"""Name of the experiment without captures."""


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
    """Return the three sets: handwriting to train on, a hand held out, and Comic letters and digits.

    Args:
        settings: The study's settings.
    """
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
                    folder = settings.out / "records" / SIMULATION
                    if not is_scored(record, records_there(folder)):
                        found = evaluate(load_weights(run), data[tested], "test", available_lpips())
                        records.append(keep_scores(record, found, folder, progress))
    return records


def _record(arm: str, modality: str, seed: int, run: Path, tested: str, decided: dict[str, Any]) -> Record:
    """Return a record without its scores."""
    return Record(SIMULATION, tested, arm, modality, seed, "test", {}, {}, {}, {}, decided | {"run": run.name})


_REFUSED = "refused.txt"
_FRAMES, _EVENTS = "frames", "surfaces"


@dataclass(frozen=True)
class Finding:
    """What came of the demo on one setup.

    Args:
        setup: Name of the setup.
        refused: Why the calibration refused the captures; empty where it did not.
        warnings: What the calibration said against itself.
        expected: What the calibration says that EPNP will bring; empty where it said nothing.
        left: "frames" or "surfaces" (of events) -> (residual on held-out captures, what noise leaves), shares.
        mean_image_db: Modality -> PSNR of the mean image, dB.
        psnr_db: (arm, modality) -> PSNR of each seed, dB.
        leads_db: Modality -> the strongest end-to-end arm, and what EPNP is ahead of it, dB.
    """

    setup: str
    refused: str
    warnings: tuple[str, ...]
    expected: str
    left: dict[str, tuple[float, float]]
    mean_image_db: dict[str, float]
    psnr_db: dict[tuple[str, str], list[float]]
    leads_db: dict[str, tuple[str, Interval]]

    def best_e2e(self, modality: str) -> float:
        """Return the mean PSNR of the arm that EPNP is ahead of, dB; NaN where there is none."""
        return self.of(self.leads_db[modality][0], modality) if modality in self.leads_db else math.nan

    def of(self, arm: str, modality: str) -> float:
        """Return the mean PSNR of an arm over its seeds, dB; NaN where it was not run."""
        return float(np.mean(self.psnr_db.get((arm, modality), [np.nan])))


def run_mismatch(
    base: Demo,
    setups: tuple[str, ...] = (),
    captures: Path | None = None,
    seeds: tuple[int, ...] = (0,),
    progress: Progress = silent,
) -> list[Finding]:
    """Run the demo on each setup, one after the other, and return what came of it; run it again to go on.

    Args:
        base: Settings of the demo; `out` holds a folder for each setup and seed. Where they are robust,
            networks that learned from wide ranges stand beside those that learned from the fitted setup.
        setups: Names of setups: of the rooms of `evnlos lab`, or of folders in `captures`; all by default.
        captures: Folder that holds a folder of captures for each setup; None renders the rooms.
        seeds: Seeds of the demo.
        progress: Called as the captures are rendered.

    Raises:
        UnknownNameError: A setup is unknown, or its folder holds no captures.
    """
    found = []
    for name in mismatch_setups(setups, captures):
        if captures is None:
            lab = lab_of(name, Demo().lab)
            folders = render_captures(
                lab, base.out / "captures" / name, workers=base.workers, progress=progress, force=base.force
            )
        else:
            folders = [file.parent for file in sorted((captures / name).glob("*/capture.yaml"))]
        outs = []
        for seed in seeds:
            out = base.out / f"{name}-seed{seed}"
            outs.append(out)
            out.mkdir(parents=True, exist_ok=True)
            try:
                for robust in sorted({False, base.robust}):
                    run_demo(replace(base, captures=tuple(folders), out=out, seed=seed, robust=robust))
            except CalibrationError as error:
                write_atomically(out / _REFUSED, str(error).encode())
        found.append(finding(name, outs))
        write_atomically(base.out / "mismatch.md", mismatch_table(found).encode())
    return found


def mismatch_setups(asked: tuple[str, ...] = (), captures: Path | None = None) -> tuple[str, ...]:
    """Return the names of the setups that `run_mismatch` goes through.

    Args:
        asked: As its `setups`.
        captures: As its `captures`.

    Raises:
        UnknownNameError: A setup is unknown, or there is no folder of captures.
    """
    folders = [] if captures is None else Path(captures).glob("*/*/capture.yaml")
    known = tuple(ROOMS) if captures is None else sorted({file.parent.parent.name for file in folders})
    if not known:
        raise UnknownNameError(f"{captures} holds no folders of captures; give the folder above them")
    for name in asked:
        if name not in known:
            raise UnknownNameError(f"setup {name!r} is unknown; give some of {', '.join(known)}")
    return asked or tuple(known)


def finding(setup: str, outs: list[Path]) -> Finding:
    """Return what the demo left in its folders, one a seed.

    Args:
        setup: Name of the setup.
        outs: The demo's folders.
    """
    refused = [out / _REFUSED for out in outs if (out / _REFUSED).is_file()]
    figures = [
        json.loads(f.read_text()) for out in outs for f in (out / "setups").glob(f"*/{CALIBRATION_VALUES_FILE}")
    ]
    records: list[Record] = []
    for out in outs:
        if any((out / "records").rglob("*.json")):
            records += read_records(out / "records")
    left = {}
    for kind in (_FRAMES, _EVENTS):
        pairs = [_left(one["residuals"], kind) for one in figures]
        pairs = [pair for pair in pairs if pair is not None]
        if pairs:
            left[kind] = (float(np.mean([p[0] for p in pairs])), float(np.mean([p[1] for p in pairs])))
    mean_image = {
        r.modality: float(np.mean(list(r.baselines["mean"]["psnr_db"].values())))
        for r in records
        if "mean" in r.baselines
    }
    warnings = dict.fromkeys(line for one in figures for line in one["warnings"])
    words = refused[0].read_text() if refused else ""
    expected = next((str(one["expectation"]) for one in figures if one.get("expectation")), "")
    psnr_db, leads = means_of(records), gains_over_e2e(records)
    return Finding(setup, words, tuple(warnings), expected, left, mean_image, psnr_db, leads)


def _left(residuals: dict[str, dict[str, float]], kind: str) -> tuple[float, float] | None:
    """Return residual and noise of held-out captures, without the frames' pattern where that is there."""
    names = [name for name in residuals if name.startswith(kind) and "held out" in name]
    names = [name for name in names if "without pattern" in name] or names
    return (residuals[names[-1]]["after"], residuals[names[-1]]["noise"]) if names else None


def mismatch_table(found: list[Finding]) -> str:
    """Return Markdown: a row for each setup and modality, and the margins that matter below it.

    Args:
        found: What came of each setup.
    """
    head = ["setup", "sees", "left / noise, %", "mean image", "E2E", "simulation only", "EPNP", "EPNP - E2E"]
    drawn = [f"{arm}{ROBUST}" for arm in ("simulation only", "EPNP")]
    drawn = [arm for arm in drawn if any(name == arm for one in found for name, _ in one.psnr_db)]
    head += drawn
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for one in found:
        for modality in [p for p in STANDARD_MODALITIES if p in one.mean_image_db]:
            kinds = {"frame": (_FRAMES,), "event": (_EVENTS,)}.get(modality, (_FRAMES, _EVENTS))
            left = "; ".join(
                f"{100 * a:.1f} / {100 * b:.1f}" for a, b in (one.left[k] for k in kinds if k in one.left)
            )
            three = (one.best_e2e(modality), *(one.of(arm, modality) for arm in ("simulation only", "EPNP")))
            numbers = (one.mean_image_db[modality], *three)
            cells = [one.setup, modality, left, *(f"{v:.2f}" for v in numbers)]
            cells.append(str(one.leads_db[modality][1]) if modality in one.leads_db else "")
            cells += [f"{one.of(arm, modality):.2f}" for arm in drawn]
            lines.append(f"| {' | '.join(cells)} |")
        if one.refused:
            lines.append(f"| {one.setup} | refused: {one.refused} |" + " |" * (len(head) - 2))
    return "\n".join([*lines, "", *_margins(found), "", *_said(found)]) + "\n"


def _margins(found: list[Finding]) -> list[str]:
    """Return a line for each modality: by how much EPNP leads, in the mean and where it leads least."""
    lines = []
    for modality in STANDARD_MODALITIES:
        lead = {one.setup: one.leads_db[modality][1].mean for one in found if modality in one.leads_db}
        above = {
            one.setup: one.of("simulation only", modality) - one.mean_image_db[modality]
            for one in found
            if modality in one.mean_image_db
        }
        if not lead:
            continue
        least, lowest = min(lead, key=lead.__getitem__), min(above, key=above.__getitem__)
        lines.append(
            f"- {modality}: EPNP - E2E {np.mean(list(lead.values())):+.2f} dB in the mean, "
            f"{lead[least]:+.2f} at least ({least}); simulation only - mean image {above[lowest]:+.2f} dB at "
            f"least ({lowest})."
        )
    return lines


def _said(found: list[Finding]) -> list[str]:
    """Return what the calibrations said against themselves, and what they expected of EPNP."""
    lines = []
    for one in found:
        words = "; ".join(one.warnings) or one.refused or "nothing"
        expected = f"; it expected: {one.expected}" if one.expected else ""
        lines.append(f"- {one.setup}: the calibration warned of {words}{expected}.")
    return lines


Leads = dict[tuple[str, str], tuple[float, ...]]
"""(Setup, modality) -> PSNR of E2E, of the simulation alone and of EPNP, its lead and the ends of that, dB."""

_COLOURS = {"frame": "#0072b2", "event": "#d55e00", "fusion": "#009e73"}


def leads_of(found: list[Finding]) -> Leads:
    """Return what `lead_figure` draws.

    Args:
        found: What came of each setup.
    """
    return {
        (one.setup, modality): (
            one.best_e2e(modality),
            one.of("simulation only", modality),
            one.of("EPNP", modality),
            *(lead.mean, lead.low, lead.high),
        )
        for one in found
        for modality, (_, lead) in one.leads_db.items()
    }


def lead_figure(leads: Leads) -> Any:
    """Return a figure: PSNR of three networks of each setup, and what EPNP leads by, with its interval.

    Args:
        leads: What is drawn.

    Raises:
        MissingDependencyError: Matplotlib is not installed.
        DataError: There is nothing to draw.
    """
    setups = list(dict.fromkeys(setup for setup, _ in leads))
    if not setups:
        raise DataError("no setup has both EPNP and an end-to-end training to draw")
    figure = new_figure((9, 1.2 + 0.4 * len(setups)))
    left, right = figure.subplots(1, 2, sharey=True)
    for (setup, modality), (e2e, simulated, epnp, lead, low, high) in leads.items():
        y = -setups.index(setup) - 0.25 * (list(_COLOURS).index(modality) - 1)
        colour, is_first = _COLOURS[modality], (setup, modality) == next(iter(leads))
        left.plot([e2e, epnp], [y, y], "-", color=colour, alpha=0.3, lw=1.5)
        for value, mark, name in ((e2e, "|", "E2E"), (simulated, ".", "simulation only"), (epnp, "o", "EPNP")):
            label = name if is_first else None
            left.plot(value, y, mark, color=colour, ms=9 if mark == "|" else 5, label=label)
        bar, label = [[lead - low], [high - lead]], modality if setup == setups[0] else None
        right.errorbar(lead, y, xerr=bar, fmt="o", color=colour, ms=4, capsize=2, lw=1, label=label)
    right.axvline(0, color="#888888", ls="--", lw=1)
    left.set_yticks([-float(number) for number in range(len(setups))], setups)
    left.set_xlabel("PSNR, dB (mean of the held-out characters)")
    right.set_xlabel("EPNP less the strongest E2E, dB (95 % interval)")
    for axes in (left, right):
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3, frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", alpha=0.25)
    return figure
