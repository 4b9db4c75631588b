"""Experiments, flat and resumable, on captures and on simulations alone.

- The trainings of an experiment: one after the other, or several at a time on the cores of a CPU.
- Experiments, flat and resumable: calibrate, simulate, import, pre-train, fine-tune, score, record.
- Folds of an experiment, so that all together test every character once.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evnlos.calibration import CALIBRATION_VALUES_FILE, SetupFit, fit_setup, rows_of, write_setup
from evnlos.config import config_hash, load_yaml, to_dict
from evnlos.data import Dataset, Simulation, as_modality, import_captures, load_pattern, simulate
from evnlos.data.pool import processes, run_tasks, workers_kept
from evnlos.data.sampling import character_of
from evnlos.data.simulations import default, randomized
from evnlos.errors import CalibrationError, ConfigError, DataError, MissingDependencyError
from evnlos.experiment.study import Arm, Place, Record, Study, slug
from evnlos.experiment.table import score_arm
from evnlos.machine import Progress, Step, silent
from evnlos.models import drawn_targets
from evnlos.scene import HandwritingGlyphs
from evnlos.setups import calibrated_file
from evnlos.training import Training, augmented, best_shown, choose_and_finetune, train
from evnlos.types import derive_seed


@dataclass(frozen=True)
class Run:
    """One training.

    Args:
        data: What it learns from: one dataset, or several that show the same captures in other ways, of which
            the one is taken that its start draws best.
        settings: How.
        out: Its folder.
        start: Run, or name of installed weights, whose weights it starts from; None: random ones.
        choose: Whether captures held out decide how much of a fine-tuning is taken.
        captures: What shows a pre-training the errors of its setup.
    """

    data: tuple[Dataset, ...]
    settings: Training
    out: Path
    start: Path | str | None = None
    choose: bool = False
    captures: Dataset | None = None


def train_one(run: Run, progress: Progress = silent) -> None:
    """Train what is not trained yet; `progress` is that of `train`."""
    if (run.out / "weights.safetensors").is_file():  # its folder's name holds a hash of what decides it
        return
    data = run.data[0] if run.start is None else best_shown(run.data, run.start)
    if run.choose and run.start is not None:
        choose_and_finetune(data, (run.settings,), run.out, run.start, progress=progress)
        return
    train(data, run.settings, run.out, run.start, progress, run.captures)


def run_study(study: Study, place: Place, progress: Progress = silent) -> list[Record]:
    """Run what is not done yet of a study, and return the records that are new; run it again to go on.

    Setups, datasets and runs have names that hold a hash of what decides them, so arms and studies share what
    they have in common.

    Args:
        study: What to compare.
        place: Where captures and results are.
        progress: Called with each step of calibration, simulation, import, training and scoring.

    Raises:
        DataError: Fewer captures than an arm learns from.
        CalibrationError: Captures that no setup fits, or whose targets are unknown.
    """
    return run_studies((study,), place, progress)


@workers_kept()
def run_studies(studies: Sequence[Study], place: Place, progress: Progress = silent) -> list[Record]:
    """Run what is not done yet of several studies, as the folds of one; otherwise as `run_study`.

    All that they learn from is made first, so that networks of all of them can be trained at a time.

    Args:
        studies: What to compare.
        place: Where captures and results are.
        progress: Called with each step of calibration, simulation, import, training and scoring.

    Raises:
        DataError: Fewer captures than an arm learns from.
        CalibrationError: Captures that no setup fits, or whose targets are unknown.
    """
    for study in studies:
        for arm in study.arms:
            _chosen(study, arm, place)
    networks = list[_Network]()
    for done, study in enumerate(studies):
        if len(studies) > 1:
            progress(Step("prepare folds", done, len(studies), "folds"))
        networks += _prepared(study, place, progress)
    if place.trainings != 1:
        return _together(networks, place.trainings, progress)
    records = list[Record]()
    for network in networks:
        for run in network.runs:
            train_one(run, progress)
        records += network.scored(progress)
    return records


def _prepared(study: Study, place: Place, progress: Progress) -> list[_Network]:
    """Calibrate, simulate and import what a study lacks, and return its networks, which are not trained."""
    setup = study.setup_folder(place.out)
    needs_setup = study.correct_pattern or any(arm.needs_setup for arm in study.arms)
    sees_events = any(as_modality(name).needs_events for name in study.modalities)
    arms = tuple(arm.with_light_path(setup, sees_events=sees_events) for arm in study.arms)
    if needs_setup and not calibrated_file(setup).is_file():
        how = replace(study.calibration, exclude=(*study.calibration.exclude, *study.test, *study.validation))
        progress(Step(f"calibrate {setup.name}", 0, 1, "setups"))
        try:
            fit = fit_setup(place.captures, how, progress)
            write_setup(fit, rows_of(fit, how.start.pixel, how.start.frame_camera), setup)
            _draw(fit, setup / "check.png")
        except DataError as error:
            raise CalibrationError(str(error)) from None
        progress(Step(f"calibrate {study.setup}", 1, 1, "setups"))
    from evnlos.calibration import write_event_errors  # these two take a help text longer to show
    from evnlos.inverse import EVENT_ERRORS_FILE, gains_by_errors

    solves = sees_events and any(arm.sampling.is_solved for arm in arms)
    if needs_setup and solves and not (setup / EVENT_ERRORS_FILE).is_file():
        saw = json.loads((setup / CALIBRATION_VALUES_FILE).read_text())  # maybe another study's
        write_event_errors(setup, place.captures, saw["fitted"] + saw["held_out"], progress, place.workers)
    if needs_setup:  # the canvas is that of its targets and their way
        found, usual = load_yaml(Simulation, calibrated_file(setup)), study.calibration.start
        arms = tuple(arm.enlarged(found.sampling.pitch_m / usual.sampling.pitch_m) for arm in arms)
    study = replace(study, arms=arms)
    networks = list[_Network]()
    for arm in study.arms:
        recorded = (_import(study, arm, place, progress),)
        if sees_events and arm.sampling.is_solved and arm.finetuning and gains_by_errors(setup):
            corrected = replace(arm, sampling=replace(arm.sampling, surface="corrected"))
            recorded += (_import(study, corrected, place, progress),)
        made = _simulate(study, arm, place, progress)
        if arm.pretraining and arm.pretraining.drawn:  # before several trainings want them
            drawn_targets(arm.sampling.setup, place.workers, progress)
        for modality in study.modalities:
            learned = recorded[: 1 + as_modality(modality).needs_events]
            learned = (augmented(recorded[0], modality, progress),) if arm.augment else learned
            plans = [_planned(study, arm, modality, seed, made, learned, place) for seed in study.seeds]
            networks.append(_Network(study, arm, modality, plans, made, recorded, place))
    return networks


@dataclass(frozen=True)
class _Network:
    """The networks of an arm, one a seed, that see one modality, and where their records are kept."""

    study: Study
    arm: Arm
    modality: str
    plans: list[tuple[list[Run], dict[str, Any]]]
    made: Dataset | None
    recorded: tuple[Dataset, ...]
    place: Place

    @property
    def runs(self) -> list[Run]:
        """The trainings of all seeds, each after the one that it starts from."""
        return [run for runs, _ in self.plans for run in runs]

    def scored(self, progress: Progress) -> list[Record]:
        """Score what was trained, and return the new records."""
        last = [(runs[-1].out, decided) for runs, decided in self.plans]
        made, recorded, place = self.made, self.recorded, self.place
        return score_arm(self.study, self.arm, self.modality, last, made, recorded, place, progress)


def _together(networks: list[_Network], at_a_time: int, progress: Progress) -> list[Record]:
    """Train and score several networks at a time, and return the new records.

    A network of this size gains little from a second core, and does not fill a GPU, so that as many trainings
    as there are cores, each with its share of them, take less time than one after the other. What others wait
    for comes first.
    """
    todo = {run.out: run for network in networks for run in network.runs}
    todo = {out: run for out, run in todo.items() if not (out / "weights.safetensors").is_file()}
    awaited = {run.start for run in todo.values()}
    runs = sorted(todo.values(), key=lambda run: run.out not in awaited)
    place = {run.out: number for number, run in enumerate(runs)}
    after = [{place[Path(run.start)]} if run.start and Path(run.start) in place else set() for run in runs]
    after += [{place[run.out] for run in network.runs if run.out in place} for network in networks]
    at_once = max(1, processes(at_a_time, len(after)))
    threads = max(1, torch.get_num_threads() // at_once)
    tasks = [*(partial(_trained, run) for run in runs), *(partial(_scored, network) for network in networks)]
    records, done, scored = list[Record](), 0, 0
    within = partial(epochs_at_work, runs)
    progress(Step("train networks", 0, len(runs), "networks", within=within))
    with closing(run_tasks(partial(_called, threads), tasks, at_once, after)) as finished:
        for name, found in finished:
            if name:
                done += 1
                progress(Step("train networks", done, len(runs), "networks", name, within))
            scored += not name
            if done == len(runs):  # until then the trainings tell
                progress(Step("score networks", scored, len(networks), "networks"))
            for record in found:
                progress(Step(f"score {record.name}", 1, 1, "networks", record))
            records += found
    order = {(n.arm.name, n.modality): number for number, n in enumerate(networks)}
    return sorted(records, key=lambda r: order.get((r.arm, r.modality), len(order)))


def epochs_at_work(runs: Sequence[Run]) -> tuple[float, str]:
    """Return how many networks the unfinished ones of `runs` amount to, and their epochs in words."""
    part, words = 0.0, list[str]()
    for run in runs:
        if run.out.is_dir() and not (run.out / "weights.safetensors").is_file():
            log = run.out / "metrics.jsonl"
            epochs = log.read_text().count("\n") if log.is_file() else 0
            part += epochs / run.settings.epochs
            words.append(f"{run.out.name} epoch {min(epochs + 1, run.settings.epochs)}/{run.settings.epochs}")
    return part, ", ".join(words)


def _called(threads: int, task: Callable[[], tuple[str, list[Record]]]) -> tuple[str, list[Record]]:
    """Call with so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return task()
    finally:
        torch.set_num_threads(before)


def _trained(run: Run) -> tuple[str, list[Record]]:
    """Train to the end; return the name of the run's folder, and no record."""
    train_one(run)
    return run.out.name, []


def _scored(network: _Network) -> tuple[str, list[Record]]:
    """Score; return no name, and the records."""
    return "", network.scored(silent)


def _draw(fit: SetupFit, path: Path) -> None:
    """Draw held-out captures beside the fit, where matplotlib is installed."""
    from evnlos.plot.results import draw_calibration  # matplotlib loads slowly

    with suppress(MissingDependencyError):
        draw_calibration(fit, path)


def captures_of(root: Path, setup: str) -> list[Path]:
    """Return the capture folders of a setup, by name.

    Raises:
        DataError: There are none.
    """
    folders = sorted(path.parent for path in Path(root).glob(f"{setup}_*/capture.yaml"))
    if not folders:
        raise DataError(f"{root} holds no captures {setup}_*; give the folder that holds them with --captures")
    return folders


def simulation_of(study: Study, arm: Arm, place: Place) -> Simulation:
    """Return the simulation that an arm is pre-trained on."""
    if arm.source == "calibrated":
        folder = study.setup_folder(place.out)
        config = load_yaml(Simulation, folder / "training.yaml")
        if not study.correct_pattern:
            camera = load_yaml(Simulation, calibrated_file(folder)).frame_camera
            camera = replace(camera, pattern_seed=None)  # type: ignore[type-var]
            config = replace(config, setup=replace(config.setup, frame_camera=camera))
        config = replace(config, setups=config.setups if study.setups is None else study.setups)
    else:
        config = study.simulation or default()
    glyphs = config.glyphs
    assert isinstance(glyphs, HandwritingGlyphs)
    again = study.redrawn if glyphs.known else glyphs.redrawn
    glyphs = replace(glyphs, writers=study.writers if arm.writers is None else arm.writers, redrawn=again)
    kept, ranges = max(config.validation, arm.held_out), config.vary | arm.vary
    config = replace(config, glyphs=glyphs, sampling=arm.sampling, vary=ranges, validation=kept)
    return randomized(config) if study.robust else config


def _simulate(study: Study, arm: Arm, place: Place, progress: Progress) -> Dataset | None:
    if arm.source == "none":
        return None
    config = simulation_of(study, arm, place)
    folder = place.out / "simulations" / f"{arm.source}-{study.setup}-{config_hash(config)[:8]}"
    return simulate(config, folder, place.workers, progress=progress, force=place.force)


def _chosen(study: Study, arm: Arm, place: Place) -> list[Path]:
    """Return the captures that an arm learns from and is scored on."""
    chosen = [f for f in place.captures if not (study.validation and character_of(f.name) in study.test)]
    return chosen if arm.captures is None else _few(chosen, arm.captures, (*study.test, *study.validation))


def _import(study: Study, arm: Arm, place: Place, progress: Progress) -> Dataset:
    held = study.test if not study.validation else ()
    chosen = _chosen(study, arm, place)
    pattern = load_pattern(study.setup_folder(place.out)) if study.correct_pattern else None
    seen: dict[str, Any] = {"captures": [f.name for f in chosen], "sampling": to_dict(arm.sampling)}
    seen |= {"test": list(held), "validation": list(study.validation), "pattern": pattern and pattern.digest}
    out = place.out / "recorded" / f"{study.setup}-{config_hash(seen)[:8]}"
    how = {"test": held, "validation": study.validation, "pattern": pattern, "workers": place.workers}
    return import_captures(chosen, out, arm.sampling, **how, progress=progress)


def _few(folders: list[Path], count: int, held_out: tuple[str, ...]) -> list[Path]:
    """Return `count` captures to train on, the same order for every number, and those held out."""
    train_on = [f for f in folders if character_of(f.name) not in held_out]
    if count > len(train_on):
        raise DataError(f"{count} captures are required, {len(train_on)} are there; ask for fewer")
    order = np.random.default_rng(derive_seed(0, "shots")).permutation(len(train_on))
    few = {train_on[i] for i in order[:count]}
    return [f for f in folders if f in few or character_of(f.name) in held_out]


def _planned(
    study: Study,
    arm: Arm,
    modality: str,
    seed: int,
    made: Dataset | None,
    recorded: tuple[Dataset, ...],
    place: Place,
) -> tuple[list[Run], dict[str, Any]]:
    """Return the trainings of an arm's network, each from the one before it, and what decided them."""
    runs: list[Run] = []
    begin = arm.layers(modality)
    decided: dict[str, Any] = {"arm": to_dict(arm), "seed": seed, "captures": recorded[0].folder.name}
    if arm.pretraining is not None:
        assert made is not None
        settings = replace(arm.first_training(modality), modality=modality, seed=seed)
        decides: dict[str, Any] = {"data": made.config_hash, "settings": to_dict(settings)}
        if settings.drawn:
            decides["errors of"] = recorded[0].folder.name
        if begin is not None:
            decides["from"] = arm.start
        key = config_hash(decides)[:8]
        out = place.out / "runs" / f"{study.setup}-pretrained-{modality}-seed{seed}-{key}"
        runs.append(Run((made,), settings, out, begin, captures=recorded[0] if settings.drawn else None))
        decided |= {"simulation": made.config_hash}
    if arm.finetuning is not None:
        settings = replace(arm.finetuning, modality=modality, seed=seed)
        start = runs[-1].out if runs else begin
        names = " ".join(one.folder.name for one in recorded)
        decides = {"data": names, "settings": to_dict(settings), "from": start and Path(start).name}
        if arm.choose:
            decides["choose"] = True
        key = config_hash(decides)[:8]
        out = place.out / "runs" / f"{study.setup}-{slug(arm.name)}-{modality}-seed{seed}-{key}"
        runs.append(Run(recorded, settings, out, start, arm.choose))
    return runs, decided


def folds_of(study: Study, folds: int, characters: Sequence[str]) -> list[Study]:
    """Return a study for each fold of the characters, so that all together test every character once.

    The folds are two halves. Each half has one calibration, and so one pre-training, that saw nothing but the
    other half's captures; a fold's fine-tuning and end-to-end training see all captures but the fold's.

    Args:
        study: What to compare; its own test characters are replaced.
        folds: Number of folds, even.
        characters: What the captures show.

    Raises:
        ConfigError: The number of folds is odd, below 2, or more than there are characters.
    """
    known = sorted(set(characters))
    if folds < 2 or folds % 2 or folds > len(known):
        raise ConfigError(f"folds is {folds}; give an even number from 2 to {len(known)}, one per character")
    order = np.random.default_rng(derive_seed(0, "folds")).permutation(len(known))
    parts = [tuple(known[i] for i in sorted(part)) for part in np.array_split(order, folds)]
    found = []
    for half, name in enumerate(("a", "b")):
        own = parts[half * folds // 2 : (half + 1) * folds // 2]
        unseen = tuple(character for part in own for character in part)
        calibration = replace(study.calibration, exclude=(*study.calibration.exclude, *unseen))
        for part in own:
            number = parts.index(part) + 1
            own_name, own_setup = f"{study.name}-folds/{number}-of-{folds}", f"{study.setup}-{name}"
            found.append(replace(study, name=own_name, setup=own_setup, test=part, calibration=calibration))
    return found
