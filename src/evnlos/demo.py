"""The main job on one page: calibrate, simulate the setup, pre-train, fine-tune, train end to end, report.

- Scenes beyond the main job, each a few commands and a page: colour, depth, several targets, one that changes.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evnlos.config import from_dict, read_yaml, save_yaml
from evnlos.data import MODALITIES, STANDARD_MODALITIES, captures_in, character_of
from evnlos.data.pool import workers_kept
from evnlos.errors import CalibrationError, ConfigError, DataError, UnknownNameError
from evnlos.files import write_atomically
from evnlos.machine import Progress, ProgressBars, Step
from evnlos.types import OutFolder

if TYPE_CHECKING:  # what runs is imported where it runs: help texts and wrong words need none of it
    from evnlos.data.lab import Lab
    from evnlos.experiment import Record, Study
    from evnlos.models import SequenceConfig

LAB_CHARACTERS = "ACDEGHKLOPSTUXZ2479"
"""What the rendered captures show."""

ROBUST = ", robust"
"""Ends the names of arms whose simulations draw sensors and walls from wide ranges."""

_TEST = ("G", "K", "4", "9")
_REPLACE = ("corner", "invert", "preview", "track")  # with --force they replace files
_PARTS = ("render", "calibrate", "import", "simulate", "draw", "train", "score", "evaluate")
"""How the pieces of the main job begin, in their order."""


@dataclass(frozen=True)
class Demo:
    """Settings of the demo; a larger one is the same thing with other numbers."""

    out: OutFolder = Path("demo")
    """Folder for everything that the demo makes; run it again to go on after an interruption."""
    scene: str = ""
    """A scene in place of the main job: colour, several, depth, changing or corner; a page in OUT/SCENE shows
    the commands, what they find, and what fails. Of the other settings it takes `out` alone."""
    captures: tuple[Path, ...] = ()
    """Capture folders, or the folder above them; without any, pseudo-real ones are rendered."""
    test: tuple[str, ...] = _TEST
    """Characters of the captures that neither calibration nor training sees."""
    modalities: tuple[str, ...] = STANDARD_MODALITIES
    """What the networks see."""
    writers: int = 2
    """Writers of the simulated characters, 36 objects each."""
    redrawn: int = 1
    """How often each known target of the captures is drawn again and simulated."""
    start: str = "generic"
    """Setup of installed weights whose layers the pre-training begins with; empty: random ones."""
    drawn: int = 2272
    """Sequences of newly drawn targets in an epoch of the pre-training, made in closed form behind the
    calibrated setup; a fine-tuning sees a sixth beside the captures. 0: learn from rendered sequences."""
    pretrain_epochs: int | None = None
    """Epochs on the simulated sequences; by default 4 from trained layers, 8 from random ones."""
    finetune_epochs: int = 20
    """Epochs on the captures when fine-tuning."""
    e2e_epochs: int = 60
    """Epochs on the captures' sequences when training end to end."""
    single_epochs: int = 8
    """Epochs on the captures' single positions when training end to end."""
    width: int = 32
    """Channels of the network at its finest level."""
    workers: int = 0
    """Processes that simulate, and networks trained at a time where there is no GPU; 0 = one for each core."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""
    robust: bool = False
    """Draw sensors and walls of the simulated objects from wide ranges around the fitted ones."""
    calibrate: bool = True
    """Fit the simulator to the setup of the captures first; without it, pre-train on the default simulation."""
    seed: int = 0
    """Seed of every draw."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = int(name not in ("workers", "redrawn", "drawn", "seed"))
            if type(value) is int and value < least:
                raise ConfigError(f"Demo.{name} is {value}; give {least} or more")
        if self.scene and replace(self, scene="") != Demo(self.out):
            raise ConfigError(
                f"Demo.scene is {self.scene!r}, which takes `out` alone; leave the other settings"
            )
        if self.scene:
            scene_of(self.scene)
        if not self.test:
            raise ConfigError("Demo.test names no character; give some of the captures', e.g. G K 4 9")
        if not self.modalities:
            raise ConfigError("Demo.modalities names none; give some of frame, event, fusion")
        for one in self.modalities:
            MODALITIES.check(one)

    @property
    def lab(self) -> Lab:
        """The laboratory whose captures are rendered where none are given."""
        from evnlos.data.lab import Lab
        from evnlos.scene import FontGlyphs

        return Lab(glyphs=FontGlyphs(characters=LAB_CHARACTERS), seed=self.seed)


def sequence_network(width: int = 32) -> SequenceConfig:
    """Return the network that the demo trains.

    Args:
        width: Channels at its finest level; the layers that come with the package have 32.
    """
    from evnlos.models import SequenceConfig

    # Half the rank of the full experiments: half the time, as good on few objects.
    return SequenceConfig(width=width, rank=256, ridge_multipliers=(0.001, 0.01, 0.1, 1.0))


@workers_kept()
def run_demo(settings: Demo) -> Path:
    """Run the main job or a scene, or what is left of it, and return the path of the report.

    Raises:
        UnknownNameError: One of the captures is none.
        CalibrationError: No setup fits the captures.
    """
    from evnlos.data.lab import render_captures
    from evnlos.experiment import Place, gain_table, read_records, run_study
    from evnlos.report import collect_results, lab_command, to_text, write_report
    from evnlos.setups import named_setup

    if settings.scene:
        return run_scene(settings.scene, settings.out / settings.scene)
    began, out = time.perf_counter(), settings.out
    folders = captures_in(settings.captures)
    left_out = (*(("render",) if folders else ()), *(() if settings.calibrate else ("calibrate",)))
    parts = [name for name in _PARTS if name not in left_out]
    place = Place((), out, settings.workers, trainings=settings.workers, force=settings.force)
    out.mkdir(parents=True, exist_ok=True)
    notes = []
    if not folders:
        lab = settings.lab
        notes += [
            "Synthetic captures: a rough aluminium wall and cameras were rendered. The simulator does not know "
            "their parameters and has to estimate them by calibration.",
            f"They are rendered again by: {lab_command(LAB_CHARACTERS, settings.seed)}",
            *lab.glyphs.notes(),
        ]
        with ProgressBars() as bars:
            folders = render_captures(
                lab,
                out / "captures",
                workers=settings.workers,
                progress=_numbered(bars, parts),
                force=settings.force,
            )
    settings, lacking = _with_layers(settings)
    settings, alone = _with_cameras(settings, folders)
    notes += lacking + alone
    study = _study(settings, held_out(folders, settings.test), events=not alone)
    place = replace(place, captures=tuple(sorted(folders)))
    try:
        with ProgressBars() as bars:
            run_study(study, place, _numbered(bars, parts))
    except CalibrationError as error:
        raise CalibrationError(
            f"{error}; or give --no-calibrate to go on with the default simulation"
        ) from None
    records = read_records(out / "records" / study.name)
    if settings.calibrate:
        notes += _of_calibration(study.setup_folder(out))
    else:
        notes.append("The simulator was not fitted to this setup.")

    single = [record for record in records if record.arm in [arm.name for arm in study.arms]]
    notes += _of_corrections(single, out)
    runs: list[str | Path] = [out / "runs" / record.settings["run"] for record in single]
    recorded = [out / "recorded" / record.settings["captures"] for record in single]  # E2E sees other surfaces
    with ProgressBars() as bars:
        progress = _numbered(bars, parts)
        dataset, results = collect_results(runs, recorded, workers=settings.workers, progress=progress)
    setup = named_setup(study.setup_folder(out)) if settings.calibrate else None
    path = write_report(out / "report.html", dataset, results, notes, setup=setup)
    for note in notes:
        print(note)
    print(to_text(results))
    print(gain_table(records, f"EPNP{ROBUST if settings.robust else ''}"))
    print(f"report: {path} ({time.perf_counter() - began:.0f} s)")
    return path


def _numbered(progress: Progress, parts: list[str]) -> Progress:
    """Return progress that says in which part of the whole each piece of work is."""
    at = 0

    def numbered(step: Step) -> None:
        nonlocal at
        at = max([at, *(k for k, name in enumerate(parts, 1) if step.what.startswith(name))])
        progress(replace(step, what=f"part {at} of {len(parts)}, {step.what}" if at else step.what))

    return numbered


def _with_layers(settings: Demo) -> tuple[Demo, list[str]]:
    """Return the settings without layers to begin with where there are none like them, and why."""
    from evnlos.models import layers_of, published

    if not settings.start:
        return settings, []
    if not all(name in published() for name in layers_of(settings.start)):
        why = f"The layers {settings.start!r} are not installed (evnlos-weights brings them)"
    elif settings.width != (usual := sequence_network().width):
        why = f"The layers {settings.start!r} have {usual} channels, not {settings.width}"
    else:
        return settings, []
    why += ": the pre-training began with random ones, and needs twice the epochs for less."
    return replace(settings, start=""), [why]


def _with_cameras(settings: Demo, folders: list[Path]) -> tuple[Demo, list[str]]:
    """Return the settings that see frames alone where a capture has no events, and why.

    Raises:
        DataError: A capture has no frames, or none of what the networks are to see is of frames alone.
    """
    from evnlos.data.capture_info import read_capture_info

    alone = list[str]()
    for folder in folders:
        info = read_capture_info(folder)
        info.check_cameras(folder.name, frames=True, events=False)
        alone += [folder.name] if info.events is None else []
    if not alone:
        return settings, []
    if not (seen := tuple(name for name in settings.modalities if not MODALITIES[name].needs_events)):
        raise DataError(f"{alone[0]} holds frames alone, no events; give --modalities frame, or leave it out")
    why = (
        f"{len(alone)} of {len(folders)} captures hold frames alone ({alone[0]} first); so networks see frames."
    )
    return replace(settings, modalities=seen), [why]


def _of_calibration(setup: Path) -> list[str]:
    """Return what the calibration found, and what it warns of."""
    drawn = f" ({setup.parent.name}/{setup.name}/check.png)" if (setup / "check.png").is_file() else ""
    found = json.loads((setup / "calibration.json").read_text())
    notes = [f"The simulator was fitted to this setup, without the test characters{drawn}."]
    notes += [f"Warning: {line}." for line in found.get("warnings", [])]
    return [*notes, f"{found['expectation']}."] if "expectation" in found else notes


def _of_corrections(records: list[Record], out: Path) -> list[str]:
    """Return which networks learned from events less what other captures showed that the setup gets wrong."""
    from evnlos.data import open_dataset

    surfaces = [open_dataset(out / "recorded" / one.settings["captures"]).sampling.surface for one in records]
    those = [f"{one.arm} {one.modality}" for one, s in zip(records, surfaces, strict=True) if s == "corrected"]
    what = "What captures showed that the setup gets wrong of events was taken from them, as that helps"
    return [f"{what}: {', '.join(those)}."] if those else []


def _study(settings: Demo, test: list[str], events: bool) -> Study:
    """Return the comparison of E2E and EPNP, with one seed; `events`: whether the captures have any."""
    from evnlos.calibration import Calibration
    from evnlos.data.sampling import Sampling
    from evnlos.data.simulations import default
    from evnlos.experiment import Arm, Study
    from evnlos.models import UNetConfig
    from evnlos.training import Training

    single = Training(network=UNetConfig(width=settings.width), epochs=settings.single_epochs)
    network = sequence_network(settings.width)
    alone = Training(epochs=settings.e2e_epochs, batch_size=16, network=network)
    solving = replace(network, frames="likelihood") if settings.calibrate else network
    plan = Training(batch_size=16, network=solving)
    made = settings.drawn if settings.calibrate and not settings.robust else 0
    before = anew = replace(plan, epochs=settings.pretrain_epochs or 8, sequence_augmentations=2, drawn=made)
    if settings.start:  # trained layers need less time and smaller steps; validation characters chose both
        before = replace(anew, epochs=settings.pretrain_epochs or 4, learning_rate=1e-3, refit_embedding=True)
    # Gentle, so that it forgets little. Captures held out of it choose how much of it is taken, if any, unless
    # the pre-training has drawn their targets again and learned their errors: then they would choose none.
    after = replace(plan, epochs=settings.finetune_epochs, learning_rate=5e-4, drawn=made // 6)
    after = replace(after, keep_normalization=True)
    source = "calibrated" if settings.calibrate else "uncalibrated"
    drawn = ROBUST if settings.robust else ""
    alone_sees = Sampling(surface="hots", radius=1)  # of the time surfaces, validation characters chose it
    sees = Sampling(surface="likelihood") if settings.calibrate else alone_sees
    return Study(
        "demo",
        "demo",
        (
            Arm(f"simulation only{drawn}", source, before, None, settings.start, anew, sampling=sees),
            Arm(f"EPNP{drawn}", source, before, after, settings.start, anew, choose=not made, sampling=sees),
            Arm("E2E, single positions", "none", None, single, sampling=alone_sees),
            Arm("E2E", "none", None, alone, sampling=alone_sees),
        ),
        modalities=settings.modalities,
        seeds=(settings.seed,),
        test=tuple(test),
        writers=settings.writers,
        redrawn=settings.redrawn,
        simulation=replace(default(), seed=settings.seed),
        calibration=Calibration(events=events, event_captures=2, columns=48, seed=settings.seed),
        setups=2,
        robust=settings.robust,
        refine=False,
        average=True,
        correct_pattern=settings.calibrate,
    )


def held_out(folders: list[Path], wanted: tuple[str, ...]) -> list[str]:
    """Return the characters to test on; every seventh where the captures have none of the usual ones."""
    there = [character_of(folder.resolve().name) for folder in folders]
    if wanted != _TEST and (lacking := [c for c in wanted if c not in there]):
        raise UnknownNameError(
            f"test has {lacking[0]!r}, and no capture shows it; give some of {' '.join(there)}"
        )
    return [c for c in wanted if c in there] or there[::7]


@dataclass(frozen=True)
class HiddenScene:
    """Something hidden, the commands that find it, and what to make of what they find."""

    title: str
    shows: str
    right: str
    fails: str
    steps: tuple[str, ...]
    pictures: dict[str, str]
    files: dict[str, dict[str, Any]] = field(default_factory=dict)


def scene_of(name: str) -> HiddenScene:
    """Return a scene by its name.

    Raises:
        UnknownNameError: There is none of this name.
    """
    path = Path(__file__).with_name("scenes.yaml")
    if name not in (scenes := read_yaml(path)):
        raise UnknownNameError(f"scene is {name!r}; give one of {', '.join(scenes)}")
    return from_dict(HiddenScene, scenes[name], source=str(path))


def run_scene(name: str, out: Path) -> Path:
    """Run the commands of a scene, or those that are left, in its folder; write its page and return its path.

    Args:
        name: The scene.
        out: Its folder.

    Raises:
        UnknownNameError: There is no such scene.
        DataError: A command failed; it has said why.
    """
    from evnlos.report.page import scene_page

    scene, began = scene_of(name), time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    for file, content in scene.files.items():
        save_yaml(content, out / file)
    record = out / "steps.json"
    done: dict[str, str] = json.loads(record.read_text()) if record.is_file() else {}
    for number, step in enumerate(scene.steps, 1):
        if step in done:
            continue
        print(f"{number} of {len(scene.steps)}: {step}", flush=True)
        words = shlex.split(step)[1:]
        if words[0] == "calibrate":  # what an interrupted step left
            shutil.rmtree(out / words[words.index("--out") + 1], ignore_errors=True)
        words += ["--force"] if words[0] in _REPLACE else []
        program = [sys.executable, "-m", "evnlos", *words]
        ran = subprocess.run(program, cwd=out, stdout=subprocess.PIPE, encoding="utf-8")
        print(ran.stdout, end="", flush=True)
        if ran.returncode:
            raise DataError(f"step {number} of the scene {name!r} failed; the command again goes on there")
        done[step] = ran.stdout
        write_atomically(record, json.dumps(done, indent=1).encode())
    path = out / "index.html"
    what_is = {"What is right": scene.right, "What fails": scene.fails}
    steps = [(step, done[step]) for step in scene.steps]
    page = scene_page(scene.title, scene.shows, scene.pictures, what_is, steps, out)
    write_atomically(path, page.encode())
    print(f"page: {path} ({time.perf_counter() - began:.0f} s)")
    return path
