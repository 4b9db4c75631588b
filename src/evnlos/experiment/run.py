"""Experiments, flat and resumable: calibrate, simulate, import, pre-train, fine-tune, score, record."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evnlos.calibration import RigFit, fit_rig, rows_of, write_rig
from evnlos.config import config_hash, load_yaml, to_dict
from evnlos.dataset import (
    Dataset,
    Simulation,
    import_captures,
    load_pattern,
    simulate,
)
from evnlos.dataset.importer import character_of
from evnlos.dataset.presets import default
from evnlos.errors import CalibrationError, DataError, MissingDependencyError
from evnlos.experiment.scoring import score_arm
from evnlos.experiment.study import Arm, Place, Record, Study, slug
from evnlos.experiment.trainings import Run, train_one, train_together
from evnlos.progress import Progress, Step, silent
from evnlos.scene import HandwritingGlyphs
from evnlos.seeds import derive_seed


def run_study(study: Study, place: Place, progress: Progress = silent) -> list[Record]:
    """Run what is not done yet of a study, and return the records that are new; run it again to go on.

    Rigs, datasets and runs have names that hold a hash of what decides them, so arms and studies share what
    they have in common.

    Args:
        study: What to compare.
        place: Where captures and results are.
        progress: Called with each step of calibration, simulation, import, training and scoring.

    Raises:
        DataError: Fewer captures than an arm learns from.
        CalibrationError: Captures that no rig fits, or whose targets are unknown.
    """
    for arm in study.arms:
        _chosen(study, arm, place)
    rig = place.out / "rigs" / study.rig
    needs_rig = study.correct_pattern or any(arm.source == "calibrated" for arm in study.arms)
    if needs_rig and not (rig / "rig.yaml").is_file():
        settings = replace(study.calibration, exclude=(*study.calibration.exclude, *study.test))
        progress(Step(f"calibrate {study.rig}", 0, 1, "setups"))
        try:
            fit = fit_rig(place.captures, settings)
            write_rig(fit, rows_of(fit, settings.start.pixel, settings.start.frame_camera), rig)
            _draw(fit, rig / "check.png")
        except DataError as error:
            raise CalibrationError(str(error)) from None
        progress(Step(f"calibrate {study.rig}", 1, 1, "setups"))
    networks, records = [], list[Record]()
    for arm in study.arms:
        shots = _import(study, arm, place, progress)
        made = _simulate(study, arm, place, progress)
        for modality in study.modalities:
            plans = [_planned(study, arm, modality, seed, made, shots, place) for seed in study.seeds]
            networks.append((arm, shots, made, modality, plans))
    if place.trainings != 1:
        every = [run for *_, plans in networks for runs, _ in plans for run in runs]
        train_together(every, place.trainings, progress)
    for arm, shots, made, modality, plans in networks:
        for runs, _ in plans:
            for run in runs:
                train_one(run, progress)
        last = [(runs[-1].out, decided) for runs, decided in plans]
        records += score_arm(study, arm, modality, last, made, shots, place, progress)
    return records


def _draw(fit: RigFit, path: Path) -> None:
    """Draw held-out captures beside the fit, where matplotlib is installed."""
    from evnlos.plot.calibration import draw_calibration  # matplotlib loads slowly

    with suppress(MissingDependencyError):
        draw_calibration(fit, path)


def captures_of(root: Path, rig: str) -> list[Path]:
    """Return the capture folders of a rig, by name.

    Raises:
        DataError: There are none.
    """
    folders = sorted(path.parent for path in Path(root).glob(f"{rig}_*/capture.yaml"))
    if not folders:
        raise DataError(f"{root} holds no captures {rig}_*; give the folder that holds them with --captures")
    return folders


def simulation_of(study: Study, arm: Arm, place: Place) -> Simulation:
    """Return the simulation that an arm is pre-trained on."""
    if arm.source == "calibrated":
        config = load_yaml(Simulation, place.out / "rigs" / study.rig / "training.yaml")
        config = replace(config, rigs=config.rigs if study.rigs is None else study.rigs)
    else:
        config = study.simulation or default()
    glyphs = config.glyphs
    assert isinstance(glyphs, HandwritingGlyphs)
    glyphs = replace(glyphs, writers=study.writers if arm.writers is None else arm.writers)
    if glyphs.known:
        glyphs = replace(glyphs, redrawn=study.redrawn)
    return replace(config, glyphs=glyphs, sampling=arm.sampling, vary=config.vary | arm.vary)


def _simulate(study: Study, arm: Arm, place: Place, progress: Progress) -> Dataset | None:
    if arm.source == "none":
        return None
    config = simulation_of(study, arm, place)
    folder = place.out / "simulations" / f"{arm.source}-{study.rig}-{config_hash(config)[:8]}"
    return simulate(config, folder, place.workers, progress=progress)


def _chosen(study: Study, arm: Arm, place: Place) -> list[Path]:
    """Return the captures that an arm learns from and is scored on."""
    chosen = [f for f in place.captures if not (study.validation and character_of(f.name) in study.test)]
    return chosen if arm.shots is None else _few(chosen, arm.shots, (*study.test, *study.validation))


def _import(study: Study, arm: Arm, place: Place, progress: Progress) -> Dataset:
    held = study.test if not study.validation else ()
    chosen = _chosen(study, arm, place)
    pattern = load_pattern(place.out / "rigs" / study.rig) if study.correct_pattern else None
    key = config_hash(
        {
            "captures": [f.name for f in chosen],
            "sampling": to_dict(arm.sampling),
            "test": list(held),
            "validation": list(study.validation),
            "pattern": pattern and pattern.digest,
        }
    )
    out = place.out / "shots" / f"{study.rig}-{key[:8]}"
    split = {"test": held, "validation": study.validation}
    return import_captures(chosen, out, arm.sampling, **split, pattern=pattern, progress=progress)


def _few(folders: list[Path], shots: int, held_out: tuple[str, ...]) -> list[Path]:
    """Return `shots` captures to train on, the same order for every number, and those held out."""
    train_on = [f for f in folders if character_of(f.name) not in held_out]
    if shots > len(train_on):
        raise DataError(f"{shots} shots are asked for, {len(train_on)} are there; ask for fewer")
    order = np.random.default_rng(derive_seed(0, "shots")).permutation(len(train_on))
    few = {train_on[i] for i in order[:shots]}
    return [f for f in folders if f in few or character_of(f.name) in held_out]


def _planned(
    study: Study, arm: Arm, modality: str, seed: int, made: Dataset | None, shots: Dataset, place: Place
) -> tuple[list[Run], dict[str, Any]]:
    """Return the trainings of an arm's network, each from the one before it, and what decided them."""
    runs: list[Run] = []
    decided: dict[str, Any] = {"arm": to_dict(arm), "seed": seed, "captures": shots.folder.name}
    if arm.pretraining is not None:
        assert made is not None
        settings = replace(arm.pretraining, modality=modality, seed=seed)
        key = config_hash({"data": made.config_hash, "settings": to_dict(settings)})[:8]
        out = place.out / "runs" / f"{study.rig}-pretrained-{modality}-seed{seed}-{key}"
        runs.append(Run(made, settings, out))
        decided |= {"simulation": made.config_hash}
    if arm.finetuning is not None:
        settings = replace(arm.finetuning, modality=modality, seed=seed)
        others = tuple(replace(other, modality=modality, seed=seed) for other in arm.alternatives)
        start = runs[-1].out if runs else None
        decides = {"data": shots.folder.name, "settings": to_dict(settings), "from": start and start.name}
        if others:
            decides["alternatives"] = [to_dict(other) for other in others]
        key = config_hash(decides)[:8]
        out = place.out / "runs" / f"{study.rig}-{slug(arm.name)}-{modality}-seed{seed}-{key}"
        runs.append(Run(shots, settings, out, start, others))
    return runs, decided
