"""Experiments on simulations alone.

- Where events win: frames and events of the same sequences, over light, noise, exposure and speed.
- The paper's experiment without captures: learn from handwriting, test on unseen hands, go over to Comic.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evnlos.analysis import available_lpips, evaluate
from evnlos.analysis.scores import paired_difference
from evnlos.config import config_hash, to_dict
from evnlos.data import STANDARD_MODALITIES, Simulation, as_modality, simulate, simulate_object
from evnlos.data.pool import processes, run_in_order
from evnlos.data.simulate import check_sequences, object_bytes
from evnlos.data.simulations import paper
from evnlos.experiment.run import Run, train_one
from evnlos.experiment.study import Record, is_scored, keep_scores, records_there
from evnlos.files import write_atomically
from evnlos.machine import Progress, Step, silent
from evnlos.metrics import psnr
from evnlos.models import fit_linear, load_weights
from evnlos.scene import DIGITS, TRAIN_WRITERS, UPPER_CASE, FontGlyphs, HandwritingGlyphs
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.setups.load import FAR_M
from evnlos.training import Training

FULL = 0.85
"""White levels of the brightest pixel: as if the exposure had been set so that nothing is clipped."""

EVENT_BYTES = 4
"""Bytes of an event in a plain stream of 32-bit words."""

FRAME_RATE_HZ = 100.0
"""Frames per second of the paper's frame camera: what its data volume is counted with."""


@dataclass(frozen=True)
class Condition:
    """One setting of the world, changed from the base.

    Args:
        factor: What was changed.
        value: Its value.
        unit: Its unit.
        simulation: The whole simulation.
    """

    factor: str
    value: float
    unit: str
    simulation: Simulation


@dataclass(frozen=True)
class Finding:
    """What frames and events showed under one condition.

    Args:
        factor: What was changed.
        value: Its value.
        unit: Its unit.
        psnr_db: str -> mean PSNR of the linear estimate on the test writer, dB.
        mean_db: PSNR of the mean image, dB.
        gain_db: PSNR of events minus that of frames: mean, low and high end of the 95 % interval over objects.
        events_per_pixel: Events per pixel and sequence.
        event_bytes_s: Data of the events, bytes per second.
        frame_bytes_s: Data of 8-bit frames at `FRAME_RATE_HZ`, bytes per second.
    """

    factor: str
    value: float
    unit: str
    psnr_db: dict[str, float]
    mean_db: float
    gain_db: tuple[float, float, float]
    events_per_pixel: float
    event_bytes_s: float
    frame_bytes_s: float


def base_simulation(writers: int = 2) -> Simulation:
    """Return the world that the conditions are changed from: rough metal, 0.30 m, and the paper's pixel.

    Args:
        writers: Writers to learn from.
    """
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
    return _lit(
        Simulation(
            glyphs=HandwritingGlyphs(characters=letters, writers=writers),
            setup=RadiometricSetup(cell_m=0.005),
            validation=0.0,
        ),
        0.1,
    )


def conditions(base: Simulation) -> list[Condition]:
    """Return all conditions: the base, then one factor at a time.

    - ambient: ambient light over the largest signal; the exposure is set so that nothing is clipped.
    - light: share of the base's light that is left, with the same exposure.
    - read noise of the frame camera, electrons.
    - exposure of the frames, seconds; their gain is set so that the level stays.
    - speed of the target, metres per second, over the same way; the surface's time constant follows it.
    - difficulty of the setup: roughness of the metal, a matte wall, distance from target to wall, metres; the
      brightest pixel stays as bright.
    """
    found = [Condition("base", 1.0, "", base)]
    found += [Condition("ambient", r, "of the signal", _lit(base, r)) for r in (0.0, 0.5, 2.0, 8.0)]
    for share in (0.3, 0.1, 0.03):
        light = replace(base.setup, gain=base.setup.gain * share, ambient=base.setup.ambient * share)
        found.append(Condition("light", share, "of the base", replace(base, setup=light)))
    for noise in (30.0, 100.0, 300.0):
        camera = replace(base.frame_camera, read_noise_e=noise)
        found.append(
            Condition(
                "read noise", noise, "electrons", replace(base, setup=replace(base.setup, frame_camera=camera))
            )
        )
    for exposure in (0.03, 0.1, 0.3):
        camera = replace(base.frame_camera, exposure_s=exposure)
        found.append(
            Condition("exposure", exposure, "s", replace(base, setup=replace(base.setup, frame_camera=camera)))
        )
    length = base.motion.speed_m_s * base.duration_s
    for speed in (0.005, 0.08, 0.32):
        # The time constant follows the time in which the target moves by a stroke.
        tau_s = base.sampling.tau_s * base.motion.speed_m_s / speed
        moved = replace(
            base,
            motion=replace(base.motion, speed_m_s=speed),
            duration_s=length / speed,
            sampling=replace(base.sampling, tau_s=tau_s),
        )
        found.append(Condition("speed", speed, "m/s", moved))
    setup: Any = base.setup  # a radiometric one, see `base_simulation`
    for roughness in (0.02, 0.1, 0.2):
        wall = replace(setup, roughness=roughness)
        found.append(Condition("roughness", roughness, "of the wall", replace(base, setup=wall)))
    matte = replace(setup, wall_material="lambert")
    found.append(Condition("albedo", matte.albedo, "of a matte wall", replace(base, setup=matte)))
    far = replace(setup, distance_m=FAR_M)
    found.append(Condition("distance", FAR_M, "m", replace(base, setup=far)))
    return found


def sweep_parameters(
    chosen: list[Condition],
    out: Path,
    workers: int = 0,
    rank: int = 192,
    progress: Progress = silent,
    force: bool = False,
) -> list[Finding]:
    """Measure each condition and return the findings; what is done is read back.

    All modalities get the same estimator, the linear one that is best for each, fitted anew to each condition:
    a network would add its own luck to every difference.

    Args:
        chosen: The conditions.
        out: Folder for one JSON file a condition.
        workers: Processes; 0 is one for each core.
        rank: Components of the linear estimate.
        progress: Called when the work begins and of a condition and when it is done.
        force: Whether to begin although the machine's memory will hardly do.
    """
    processes(workers, 1)
    out.mkdir(parents=True, exist_ok=True)
    findings = list[Finding]()
    for k, condition in enumerate(chosen):
        path = out / f"{config_hash(condition.simulation)}.json"
        if path.is_file():
            known = json.loads(path.read_text())
            finding = Finding(**known | {"gain_db": tuple(known["gain_db"])})
        else:
            finding = measure(condition, workers, rank, force)
            write_atomically(path, json.dumps(asdict(finding), indent=1).encode())
        findings.append(finding)
        what = f"{condition.factor} {condition.value:g} {condition.unit}".strip()
        progress(Step(f"conditions ({what})", k + 1, len(chosen), "conditions", finding))
    return findings


def measure(condition: Condition, workers: int = 0, rank: int = 192, force: bool = False) -> Finding:
    """Simulate sequences, fit the linear estimate to some writers, and score it on one that it has not seen.

    Args:
        condition: The world.
        workers: Processes; 0 is one for each core.
        rank: Components of the linear estimate.
        force: Whether to begin although the machine's memory will hardly do.
    """
    config = condition.simulation
    assert isinstance(config.glyphs, HandwritingGlyphs)
    if not force:
        check_sequences(object_bytes(config), processes(workers, len(config.glyphs.objects())))
    unseen = replace(config, glyphs=replace(config.glyphs, writers=1, first_writer=TRAIN_WRITERS))
    learned = list(run_in_order(_sequence, [(config, name) for name in config.glyphs.objects()], workers))
    tested = list(run_in_order(_sequence, [(unseen, name) for name in unseen.glyphs.objects()], workers))
    rows = config.sampling.scored
    truth = torch.cat([p.truth for p in tested])[:, rows]
    names = np.concatenate([[p.name] * len(p.truth) for p in tested])
    scores: dict[str, np.ndarray] = {}
    for modality in map(as_modality, STANDARD_MODALITIES):
        seen, known = ([modality.inputs(p.frame, p.surface) for p in part] for part in (learned, tested))
        owners = np.concatenate([[p.name] * len(p.truth) for p in learned])
        truths = torch.cat([p.truth for p in learned])
        estimate = fit_linear(torch.cat(seen), truths, owners, rank, modality=modality)
        scores[modality.name] = psnr(estimate(torch.cat(known))[:, rows], truth).numpy()
    blank = torch.cat([p.truth for p in learned]).mean(dim=0)[rows].expand_as(truth)
    gain = paired_difference(scores["event"], scores["frame"], names)
    pixels = config.sensor.height * config.sensor.width
    events = float(np.mean([p.events for p in tested]))
    return Finding(
        condition.factor,
        condition.value,
        condition.unit,
        {name: round(float(values.mean()), 3) for name, values in scores.items()},
        round(float(psnr(blank, truth).mean()), 3),
        (round(gain.mean, 3), round(gain.low, 3), round(gain.high, 3)),
        round(events / pixels, 3),
        round(events * EVENT_BYTES / config.duration_s),
        round(FRAME_RATE_HZ * pixels),
    )


def conditions_table(findings: list[Finding]) -> str:
    """Return Markdown: a row a condition."""
    lines = [
        "| condition | frame dB | event dB | fusion dB | mean image dB | event - frame dB, 95 % interval | "
        "events per pixel | events kB/s | frames kB/s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for f in findings:
        what = "base" if f.factor == "base" else f"{f.factor} {f.value:g} {f.unit}"
        mean, low, high = f.gain_db
        scores = " | ".join(f"{f.psnr_db[p]:.2f}" for p in STANDARD_MODALITIES)
        lines.append(
            f"| {what} | {scores} | {f.mean_db:.2f} | {mean:+.2f} [{low:+.2f}, {high:+.2f}] | "
            f"{f.events_per_pixel:.1f} | {f.event_bytes_s / 1e3:.0f} | {f.frame_bytes_s / 1e3:.0f} |"
        )
    return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class _Sequence:
    name: str
    frame: np.ndarray
    surface: np.ndarray
    truth: torch.Tensor
    events: int


def _sequence(task: tuple[Simulation, str]) -> _Sequence:
    config, name = task
    samples, events = simulate_object(config, name)
    assert samples.truth is not None  # a simulation knows its target
    return _Sequence(name, samples.frame, samples.surface, torch.from_numpy(samples.truth), len(events))


def _lit(config: Simulation, ratio: float) -> Simulation:
    """Return the simulation with ambient light of `ratio` times the largest signal, both within the range."""
    gain = FULL / (1 + ratio)
    return replace(config, setup=replace(config.setup, gain=gain, ambient=gain * ratio))


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
