"""What an experiment is (arms compared on the same captures, modalities, and seeds), and its results as small
JSON files that can be kept, compared and put into tables.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from evnlos.analysis import Evaluation, Scores
from evnlos.calibration import Calibration
from evnlos.config import to_dict
from evnlos.data import STANDARD_MODALITIES, Sampling, Simulation
from evnlos.errors import ConfigError, DataError
from evnlos.files import write_atomically
from evnlos.machine import Progress, Step
from evnlos.models import layers_of, load_weights
from evnlos.registry import migrate
from evnlos.training import Training

Source = Literal["calibrated", "uncalibrated", "none"]


@dataclass(frozen=True)
class Arm:
    """One way from data to weights.

    Pre-training and fine-tuning take modality and seed from the study; without fine-tuning the weights have
    seen no capture (simulation only), without pre-training they have seen nothing else (E2E).
    """

    name: str
    """Name in the tables; also of the runs' folders."""
    source: Source = "calibrated"
    """Simulation to pre-train on: of the calibrated setup, the uncalibrated default, or none."""
    pretraining: Training | None = None
    """Settings of the pre-training."""
    finetuning: Training | None = None
    """Settings of the fine-tuning, or of the end-to-end training where there is no pre-training."""
    start: str = ""
    """Setup of installed weights whose layers the arm's first training begins with. Empty: random ones."""
    anew: Training | None = None
    """Settings of the pre-training of networks that `start` has no layers for; None: those of the others."""
    choose: bool = False
    """Choose on captures held out of the fine-tuning how much of it is taken, if any."""
    writers: int | None = None
    """Writers of the simulated characters; None is as many as the study says."""
    augment: bool = False
    """Train end to end on exact further captures too (`evnlos.training.augmented`)."""
    captures: int | None = None
    """Captures to train on; None is all that are there, otherwise the first of a seeded order."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation."""
    vary: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Ranges that replace those of the simulation: dotted name -> (low, high)."""

    def __post_init__(self) -> None:
        if (self.source == "none") != (self.pretraining is None):
            raise ConfigError(
                f"arm {self.name!r}: pre-training needs a simulation, and a simulation pre-training"
            )
        if self.pretraining is None and self.finetuning is None:
            raise ConfigError(f"arm {self.name!r} trains nothing; give pre-training, fine-tuning or both")
        if self.augment and self.pretraining is not None:
            raise ConfigError(f"arm {self.name!r}: only an end-to-end training is augmented; leave it off")
        if self.choose and (self.pretraining is None or self.finetuning is None):
            raise ConfigError(f"arm {self.name!r}: only a fine-tuning can be chosen; give both trainings")
        if self.captures is not None and self.captures < 1:
            raise ConfigError(
                f"arm {self.name!r}: captures is {self.captures}; give at least 1, or leave out fine-tuning"
            )

    def layers(self, modality: str) -> str | None:
        """Return the name of the installed layers that a network begins with; None: there are none like it.

        Layers are like it where they saw frames and events solved, or embedded, as the network does.

        Args:
            modality: What the network sees.
        """
        if not self.start or self.pretraining is None:
            return None
        (name,) = layers_of(self.start, modality)
        network = load_weights(name).network
        if network.modality.needs_events and network.sampling.surface != self.sampling.surface:
            return None
        both = network.settings, self.pretraining.network
        given, own = ((one.kind, getattr(one, "frames", "")) for one in both)
        return name if given == own else None

    def first_training(self, modality: str) -> Training:
        """Return the settings of the pre-training of the network that sees a modality."""
        assert self.pretraining is not None
        return self.pretraining if self.anew is None or self.layers(modality) else self.anew

    @property
    def held_out(self) -> float:
        """Least share of simulated objects that tell the confidence alone: more where others are drawn."""
        return 0.3 if self.pretraining and self.pretraining.drawn else 0.0

    @property
    def needs_setup(self) -> bool:
        """Whether the captures have to be calibrated first."""
        return self.source == "calibrated" or self.sampling.is_solved

    def with_light_path(self, setup: Path, *, sees_events: bool = True) -> Arm:
        """Return the arm with a setup, where it names none, for the surface `likelihood`.

        Args:
            setup: Folder of the calibrated setup.
            sees_events: Whether a network sees the surface; else a quick one takes its place.
        """
        if not self.sampling.is_solved:
            return self
        seen = replace(self.sampling, setup=self.sampling.setup or str(setup))
        return replace(self, sampling=seen if sees_events else replace(seen, surface=Sampling().surface))

    def enlarged(self, factor: float) -> Arm:
        """Return the arm with a canvas that is larger by a factor."""
        return replace(self, sampling=replace(self.sampling, pitch_m=self.sampling.pitch_m * factor))


@dataclass(frozen=True)
class Study:
    """Arms, compared on the captures of one setup."""

    name: str
    """Name of the experiment."""
    setup: str = "near"
    """Name of the setup, under which the calibrated one and all that follows from it are kept."""
    arms: tuple[Arm, ...] = ()
    """What is compared."""
    modalities: tuple[str, ...] = STANDARD_MODALITIES
    """What the networks see."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of initial weights and of the order of the samples."""
    test: tuple[str, ...] = ("G", "K", "4", "9")
    """Characters that nothing sees: neither calibration nor fine-tuning nor the choice of a setting."""
    validation: tuple[str, ...] = ()
    """Characters that settings are chosen on. Where there are any, only these are scored, and the test
    characters are not even read."""
    writers: int = 11
    """Writers of the simulated characters, 36 objects each."""
    redrawn: int = 0
    """How often the calibrated simulation draws each known target of the captures again."""
    simulation: Simulation | None = None
    """What an uncalibrated arm is pre-trained on; None is the default simulation."""
    calibration: Calibration = field(default_factory=Calibration)
    """How the setup is calibrated; whatever it says, characters that are scored are left out of it."""
    setups: int | None = None
    """Different walls and cameras in the calibrated simulation; None is as many as the calibration says."""
    robust: bool = False
    """Draw sensors and walls of the simulations from wide ranges (`evnlos.data.randomized`)."""
    refine: bool = True
    """Also score images after data consistency, where there are a frame and a calibrated setup."""
    average: bool = False
    """Also score images of single positions, aligned along the known motion and averaged over the sequence."""
    retrieval: bool = False
    """Also score the simulated object that explains the frames of a sequence best."""
    correct_pattern: bool = True
    """Take the frame camera's fixed pattern, as the calibration found it, from all frames; else the calibrated
    simulation has it, another one for each object."""
    asked_for: tuple[str, ...] = ()
    """Names of arms that are left out unless they are asked for (`--arms`)."""

    def __post_init__(self) -> None:
        if not self.arms or not self.modalities or not self.seeds:
            raise ConfigError(f"the study {self.name!r} has no arm, no modality or no seed")
        if len(set(names := [arm.name for arm in self.arms])) != len(names):
            raise ConfigError(f"the study {self.name!r} has two arms of one name among {', '.join(names)}")
        if set(self.test) & set(self.validation):
            raise ConfigError("a character is for testing or for validation, not for both")

    def begun_with(self, start: str) -> Study:
        """Return the study whose pre-trainings begin with installed layers, as wide as these, in smaller steps.

        Args:
            start: First part of the names of the weights: "generic".

        Raises:
            ConfigError: They are like no network of the study.
            DataError: They are not installed.
        """
        arms = list[Arm]()
        for own in self.arms:
            arm = replace(own, start=start, anew=own.pretraining)
            names = [name for modality in self.modalities if (name := arm.layers(modality))]
            if own.pretraining is not None and names:
                layers, network = load_weights(names[0]).network.settings, cast(Any, own.pretraining.network)
                network = replace(network, width=cast(Any, layers).width)
                changed = replace(own.pretraining, network=network, learning_rate=1e-3, refit_embedding=True)
                arm = replace(arm, pretraining=changed)
            arms.append(arm if names else own)
        if arms == list(self.arms):
            raise ConfigError(f"no network of {self.name} begins with layers {start!r}; those of sequence do")
        return replace(self, arms=tuple(arms))

    def with_pattern(self) -> Study:
        """Return the study of frames that keep the camera's fixed pattern, recorded and simulated."""
        return replace(self, name=f"{self.name}-pattern", correct_pattern=False)

    @property
    def split(self) -> str:
        """The split that is scored."""
        return "validation" if self.validation else "test"

    def setup_folder(self, out: Path) -> Path:
        """Return the folder of the calibrated setup, which has not seen what is scored."""
        without = f"-without-{''.join(self.validation)}" if self.validation else ""
        return out / "setups" / f"{self.setup}{without}"


@dataclass(frozen=True)
class Place:
    """Where an experiment finds its captures and keeps what it makes.

    Args:
        captures: Capture folders of the study's setup.
        out: Folder for setups, datasets, runs and records.
        workers: Processes that simulate, import and solve; 0 is one for each core.
        trainings: Networks that are trained at a time, on the cores or on one GPU; 0 is one for each core.
        force: Whether simulations begin although the machine's memory will hardly do.

    Raises:
        ConfigError: A number of processes below 0.
    """

    captures: tuple[Path, ...]
    out: Path
    workers: int = 0
    trainings: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        for name in ("workers", "trainings"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} is {getattr(self, name)}; give 0 (one for each core) or more")


@dataclass(frozen=True)
class Record:
    """Scores of one network (or ensemble, or refined one) of a study.

    Args:
        study: Name of the study.
        setup: Setup of the captures.
        arm: Name of the arm.
        modality: What the network saw.
        seed: Its seed; -1 for an ensemble over the seeds.
        split: What was scored.
        scores: Metric -> object -> mean over its positions.
        positions: PSNR in dB, object -> one value per position.
        baselines: Baseline -> metric -> object -> mean.
        checks: Shares of images (see `evnlos.analysis.CHECKS`).
        settings: Everything that decided the weights.
        read_as: Object -> character -> how many of its images the reader takes for it.
    """

    study: str
    setup: str
    arm: str
    modality: str
    seed: int
    split: str
    scores: dict[str, dict[str, float]]
    positions: dict[str, list[float]]
    baselines: dict[str, dict[str, dict[str, float]]]
    checks: dict[str, float]
    settings: dict[str, Any]
    read_as: dict[str, dict[str, int]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """File name of the record."""
        seed = "ensemble" if self.seed < 0 else f"seed{self.seed}"
        return f"{self.setup}-{self.split}-{slug(self.arm)}-{self.modality}-{seed}"


def slug(text: str) -> str:
    """Return a name as part of a file name.

    Example:
        >>> slug("EPNP + consistency")
        'epnp-consistency'
    """
    return "-".join("".join(c if c.isalnum() else " " for c in text.lower()).split())


def scores_of(evaluation: Evaluation) -> tuple[dict, dict, dict]:
    """Return scores, PSNR a position and baselines of an evaluation, as plain numbers by object."""

    def table(scores: Scores) -> dict[str, dict[str, float]]:
        names = [item.name for item in fields(scores) if getattr(scores, item.name) is not None]
        objects = evaluation.characters()
        means = {name: scores.mean(evaluation.names == name) for name in objects}
        return {metric: {name: float(means[name][metric] or 0.0) for name in objects} for metric in names}

    positions = {
        name: np.round(evaluation.scores.psnr_db[evaluation.names == name], 3).tolist()
        for name in evaluation.characters()
    }
    baselines = {name: table(scores) for name, scores in evaluation.baselines.items()}
    return table(evaluation.scores), positions, baselines


def keep_scores(blank: Record, evaluation: Evaluation, folder: Path, progress: Progress) -> Record:
    """Fill a record with an evaluation's scores, write it, tell of it, and return it."""
    scores, positions, baselines = scores_of(evaluation)
    record = replace(blank, scores=scores, positions=positions, baselines=baselines)
    record = replace(record, checks=evaluation.checks, read_as=evaluation.read_as)
    write_record(record, folder)
    progress(Step(f"score {record.name}", 1, 1, "networks", record))
    return record


def records_there(folder: Path) -> dict[str, Record]:
    """Return the records that a folder holds, by name; none where it is not there."""
    return {record.name: record for record in read_records(folder)} if any(folder.glob("*.json")) else {}


def is_scored(blank: Record, there: dict[str, Record]) -> bool:
    """Return whether the record of a name is there, and scores the same networks on the same captures.

    Args:
        blank: A record without its scores.
        there: The records that are there, by name.
    """
    kept = there.get(blank.name)
    return kept is not None and all(
        kept.settings.get(key) == blank.settings.get(key) for key in ("run", "runs", "captures")
    )


def write_record(record: Record, folder: Path) -> Path:
    """Write a record as `folder`/NAME.json and return the path."""
    path = folder / f"{record.name}.json"
    write_atomically(path, json.dumps(to_dict(record), indent=1).encode())
    return path


def read_records(folder: str | Path) -> list[Record]:
    """Read all records below a folder, in the order of their names.

    Raises:
        DataError: The folder holds none, or a file is no record.
    """
    paths = sorted(Path(folder).rglob("*.json"))
    if not paths:
        raise DataError(f"{folder} holds no records; run `evnlos experiment` first")
    records = []
    for path in paths:
        try:
            records.append(Record(**migrate("Record", json.loads(path.read_text()))))
        except (ValueError, TypeError) as error:
            raise DataError(f"{path} is no record of an experiment: {error}") from None
    return records


def merge_folds(records: Sequence[Record], setup: str) -> list[Record]:
    """Return one record per arm, modality and seed over all folds; those that lack a fold are left out.

    Args:
        records: Records of the studies of `folds_of`.
        setup: Name of the setup, without that of its half.
    """
    groups: dict[tuple[str, str, int], list[Record]] = {}
    for record in records:
        if record.setup in (f"{setup}-a", f"{setup}-b"):
            groups.setdefault((record.arm, record.modality, record.seed), []).append(record)
    most = max((len(group) for group in groups.values()), default=0)
    return [_merged(group, setup) for group in groups.values() if len(group) == most]


def _merged(group: list[Record], setup: str) -> Record:
    first = group[0]
    scores = {metric: {k: v for r in group for k, v in r.scores[metric].items()} for metric in first.scores}
    baselines = {
        name: {metric: {k: v for r in group for k, v in r.baselines[name][metric].items()} for metric in table}
        for name, table in first.baselines.items()
        if all(name in record.baselines for record in group)
    }
    checks = {
        key: float(np.average([r.checks[key] for r in group], weights=[len(r.positions) for r in group]))
        for key in first.checks
        if all(key in record.checks for record in group)
    }
    merged = replace(first, study=first.study.partition("/")[0], setup=setup, scores=scores)
    return replace(
        merged,
        positions={name: values for record in group for name, values in record.positions.items()},
        baselines=baselines,
        checks=checks,
        settings={"arm": first.arm, "runs": [record.settings.get("run") for record in group]},
        read_as={name: seen for record in group for name, seen in record.read_as.items()},
    )
