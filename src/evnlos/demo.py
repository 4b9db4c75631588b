"""The main job on one page: calibrate, simulate the rig, pre-train, fine-tune, train end to end, report."""

from __future__ import annotations

import dataclasses
import json
import time
from dataclasses import dataclass
from pathlib import Path

from evnlos.calibration import Calibration
from evnlos.dataset.importer import character_of
from evnlos.dataset.lab import Lab, render_captures
from evnlos.dataset.presets import default
from evnlos.errors import CalibrationError, ConfigError
from evnlos.experiment import SEQUENCE, Arm, Place, Study, gain_table, read_records, run_study
from evnlos.model import UNetConfig
from evnlos.progress import ProgressBars
from evnlos.report import gather, to_text, write_report
from evnlos.scene import FontGlyphs
from evnlos.setups import named_setup
from evnlos.training import Training

LAB_CHARACTERS = "ACDEGHKLOPSTUXZ2479"
"""What the rendered captures show."""

_TEST = ("G", "K", "4", "9")


@dataclass(frozen=True)
class Demo:
    """Settings of the demo; a larger one is the same thing with other numbers."""

    out: Path = Path("demo")
    """Folder for everything that the demo makes; run it again to go on after an interruption."""
    captures: tuple[Path, ...] = ()
    """Capture folders, or the folder above them; without any, pseudo-real ones are rendered."""
    test: tuple[str, ...] = _TEST
    """Characters of the captures that neither calibration nor training sees."""
    writers: int = 4
    """Writers of the simulated characters, 36 objects each."""
    redrawn: int = 7
    """How often each known target of the captures is drawn again and simulated."""
    pretrain_epochs: int = 8
    """Epochs on the simulated sequences."""
    finetune_epochs: int = 12
    """Epochs on the captures when fine-tuning."""
    e2e_epochs: int = 60
    """Epochs on the captures' sequences when training end to end."""
    single_epochs: int = 8
    """Epochs on the captures' single positions when training end to end."""
    width: int = 32
    """Channels of the network at its finest level."""
    workers: int = 0
    """Processes that simulate, and networks trained at a time where there is no GPU; 0 = one for each core."""
    calibrate: bool = True
    """Fit the simulator to the rig of the captures first; without it, pre-train on the default simulation."""
    seed: int = 0
    """Seed of every draw."""


def run_demo(settings: Demo) -> Path:
    """Run the main job and return the path of the report.

    Every step is resumable: what is done is not done again.

    Raises:
        ConfigError: One of the captures is none.
        CalibrationError: No rig fits the captures.
    """
    began, out = time.perf_counter(), settings.out
    captures = _captures_in(settings.captures)
    place = Place((), out, settings.workers, trainings=settings.workers)
    out.mkdir(parents=True, exist_ok=True)
    notes = []
    folders = captures
    if not folders:
        lab = Lab(glyphs=FontGlyphs(characters=LAB_CHARACTERS), seed=settings.seed)
        notes.append(
            "The captures of this page are not recordings: they were rendered with a wall of rough aluminium, "
            "cameras and noise that only calibration can tell the simulator. Give --captures for recordings."
        )
        notes += lab.glyphs.notes()
        with ProgressBars() as progress:
            folders = render_captures(lab, out / "captures", workers=settings.workers, progress=progress)
    study = _study(settings, _held_out(folders, settings.test))
    place = dataclasses.replace(place, captures=tuple(sorted(folders)))
    try:
        with ProgressBars() as progress:
            run_study(study, place, progress)
    except CalibrationError as error:
        raise CalibrationError(
            f"{error}; or give --no-calibrate to go on with the default simulation"
        ) from None
    records = read_records(out / "records" / study.name)
    if settings.calibrate:
        notes += _of_calibration(out / "rigs" / study.rig)
    else:
        notes.append("The simulator was not fitted to this rig.")

    single = [record for record in records if record.arm in [arm.name for arm in study.arms]]
    runs: list[str | Path] = [out / "runs" / record.settings["run"] for record in single]
    dataset, results = gather(runs, out / "shots" / single[0].settings["captures"])
    rig = named_setup(out / "rigs" / study.rig / "rig.yaml") if settings.calibrate else None
    path = write_report(out / "report.html", dataset, results, notes, rig=rig)
    for note in notes:
        print(note)
    print(to_text(results))
    print(gain_table(records))
    print(f"report: {path} ({time.perf_counter() - began:.0f} s)")
    return path


def _captures_in(given: tuple[Path, ...]) -> list[Path]:
    """Return the capture folders among some paths, and in folders among them; files are passed over."""
    found = []
    for path in given:
        inside = (
            [path] if (path / "capture.yaml").is_file() else [f.parent for f in path.glob("*/capture.yaml")]
        )
        if not inside and (path.is_dir() or not path.exists()):
            raise ConfigError(f"{path} holds no capture.yaml; give capture folders, or the folder above them")
        found += inside
    if given and not found:
        raise ConfigError(f"{given[0]} is no capture folder; give folders with a capture.yaml")
    return sorted(found)


def _of_calibration(rig: Path) -> list[str]:
    """Return what the calibration found, and what it warns of."""
    drawn = f" ({rig.parent.name}/{rig.name}/check.png)" if (rig / "check.png").is_file() else ""
    found = json.loads((rig / "calibration.json").read_text())
    notes = [f"The simulator was fitted to this rig, without the test characters{drawn}."]
    notes += [f"Warning: {line}." for line in found.get("warnings", [])]
    return [*notes, f"{found['expectation']}."] if "expectation" in found else notes


def _study(settings: Demo, test: list[str]) -> Study:
    """Return the comparison of E2E and EPNP, with one seed."""
    single = Training(network=UNetConfig(width=settings.width), epochs=settings.single_epochs)
    plan = dataclasses.replace(SEQUENCE, network=dataclasses.replace(SEQUENCE.network, width=settings.width))
    before = dataclasses.replace(plan, epochs=settings.pretrain_epochs)
    # What forgets least comes first; captures that are held out of it choose among these, or nothing at all.
    after = dataclasses.replace(
        plan, epochs=settings.finetune_epochs, learning_rate=2e-4, keep_normalization=True
    )
    quicker = dataclasses.replace(after, learning_rate=1e-3)
    alone = dataclasses.replace(plan, epochs=settings.e2e_epochs)
    source = "calibrated" if settings.calibrate else "uncalibrated"
    return Study(
        "demo",
        "demo",
        (
            Arm("simulation only", source, before, None),
            Arm("E2E, single positions", "none", None, single),
            Arm("E2E", "none", None, alone),
            Arm("EPNP", source, before, after, (quicker,)),
        ),
        seeds=(settings.seed,),
        test=tuple(test),
        writers=settings.writers,
        redrawn=settings.redrawn,
        simulation=dataclasses.replace(default(), seed=settings.seed),
        calibration=Calibration(event_captures=2, columns=48, seed=settings.seed),
        rigs=2,
        refine=False,
        correct_pattern=settings.calibrate,
    )


def _held_out(folders: list[Path], wanted: tuple[str, ...]) -> list[str]:
    """Return the characters to test on; every seventh where the captures have none of the wanted ones."""
    there = [character_of(folder.resolve().name) for folder in folders]
    return [c for c in wanted if c in there] or there[::7]
