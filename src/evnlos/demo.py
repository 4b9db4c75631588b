"""The main job on one page: calibrate, simulate the setup, pre-train, fine-tune, train end to end, report.

- What a mismatch costs: the demo's comparison on setups that the simulator does not describe, in one table.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evnlos.calibration import CALIBRATION_VALUES_FILE, Calibration
from evnlos.config import write_atomically
from evnlos.data import STANDARD_MODALITIES, captures_in
from evnlos.data.lab import Lab, lab_of, render_captures
from evnlos.data.sampling import Sampling, character_of
from evnlos.data.simulations import default
from evnlos.errors import CalibrationError, ConfigError, UnknownNameError
from evnlos.experiment import Arm, Place, Record, Study, gain_table, means_of, read_records, run_study
from evnlos.machine import Progress, ProgressBars, silent
from evnlos.models import GENERIC, SequenceConfig, UNetConfig, layers_of, published
from evnlos.report import collect_results, to_text, write_report
from evnlos.scene import FontGlyphs
from evnlos.setups import ROOMS, named_setup
from evnlos.training import Training
from evnlos.types import OutFolder

LAB_CHARACTERS = "ACDEGHKLOPSTUXZ2479"
"""What the rendered captures show."""

# Half the rank of the full experiments: half the time, as good on few objects.
SEQUENCE_NETWORK = SequenceConfig(width=32, rank=256, ridge_multipliers=(0.001, 0.01, 0.1, 1.0))
"""The network that the demo trains."""

_TEST = ("G", "K", "4", "9")


@dataclass(frozen=True)
class Demo:
    """Settings of the demo; a larger one is the same thing with other numbers."""

    out: OutFolder = Path("demo")
    """Folder for everything that the demo makes; run it again to go on after an interruption."""
    captures: tuple[Path, ...] = ()
    """Capture folders, or the folder above them; without any, pseudo-real ones are rendered."""
    test: tuple[str, ...] = _TEST
    """Characters of the captures that neither calibration nor training sees."""
    writers: int = 4
    """Writers of the simulated characters, 36 objects each."""
    redrawn: int = 7
    """How often each known target of the captures is drawn again and simulated."""
    start: str = GENERIC
    """Setup of installed weights whose layers the pre-training begins with; empty: random ones."""
    pretrain_epochs: int | None = None
    """Epochs on the simulated sequences; by default 4 from trained layers, 8 from random ones."""
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
            if type(value) is int and value < (least := int(name not in ("workers", "redrawn", "seed"))):
                raise ConfigError(f"Demo.{name} is {value}; give {least} or more")
        if not self.test:
            raise ConfigError("Demo.test names no character; give some of the captures', e.g. G K 4 9")

    @property
    def lab(self) -> Lab:
        """The laboratory whose captures are rendered where none are given."""
        return Lab(glyphs=FontGlyphs(characters=LAB_CHARACTERS), seed=self.seed)


def run_demo(settings: Demo) -> Path:
    """Run the main job, or what is left of it, and return the path of the report.

    Raises:
        UnknownNameError: One of the captures is none.
        CalibrationError: No setup fits the captures.
    """
    began, out = time.perf_counter(), settings.out
    captures = captures_in(settings.captures)
    place = Place((), out, settings.workers, trainings=settings.workers, force=settings.force)
    out.mkdir(parents=True, exist_ok=True)
    notes = []
    folders = captures
    if not folders:
        lab = settings.lab
        notes.append(
            "Synthetic captures: a rough aluminium wall and cameras were rendered. The simulator does not know "
            "their parameters and has to estimate them by calibration."
        )
        notes += lab.glyphs.notes()
        with ProgressBars() as progress:
            folders = render_captures(
                lab, out / "captures", workers=settings.workers, progress=progress, force=settings.force
            )
    settings, lacking = _with_layers(settings)
    notes += lacking
    study = _study(settings, held_out(folders, settings.test))
    place = replace(place, captures=tuple(sorted(folders)))
    try:
        with ProgressBars() as progress:
            run_study(study, place, progress)
    except CalibrationError as error:
        raise CalibrationError(
            f"{error}; or give --no-calibrate to go on with the default simulation"
        ) from None
    records = read_records(out / "records" / study.name)
    if settings.calibrate:
        notes += _of_calibration(out / "setups" / study.setup)
    else:
        notes.append("The simulator was not fitted to this setup.")

    single = [record for record in records if record.arm in [arm.name for arm in study.arms]]
    runs: list[str | Path] = [out / "runs" / record.settings["run"] for record in single]
    recorded = [out / "recorded" / record.settings["captures"] for record in single]  # E2E sees other surfaces
    with ProgressBars() as progress:
        dataset, results = collect_results(runs, recorded, workers=settings.workers, progress=progress)
    setup = named_setup(out / "setups" / study.setup) if settings.calibrate else None
    path = write_report(out / "report.html", dataset, results, notes, setup=setup)
    for note in notes:
        print(note)
    print(to_text(results))
    print(gain_table(records))
    print(f"report: {path} ({time.perf_counter() - began:.0f} s)")
    return path


def _with_layers(settings: Demo) -> tuple[Demo, list[str]]:
    """Return the settings without layers to begin with where there are none like them, and why."""
    if not settings.start:
        return settings, []
    if not all(name in published() for name in layers_of(settings.start)):
        why = f"The layers {settings.start!r} are not installed (evnlos-weights brings them)"
    elif settings.width != SEQUENCE_NETWORK.width:
        why = f"The layers {settings.start!r} have {SEQUENCE_NETWORK.width} channels, not {settings.width}"
    else:
        return settings, []
    why += ": the pre-training began with random ones, and needs twice the epochs for less."
    return replace(settings, start=""), [why]


def _of_calibration(setup: Path) -> list[str]:
    """Return what the calibration found, and what it warns of."""
    drawn = f" ({setup.parent.name}/{setup.name}/check.png)" if (setup / "check.png").is_file() else ""
    found = json.loads((setup / "calibration.json").read_text())
    notes = [f"The simulator was fitted to this setup, without the test characters{drawn}."]
    notes += [f"Warning: {line}." for line in found.get("warnings", [])]
    return [*notes, f"{found['expectation']}."] if "expectation" in found else notes


def _study(settings: Demo, test: list[str]) -> Study:
    """Return the comparison of E2E and EPNP, with one seed."""
    single = Training(network=UNetConfig(width=settings.width), epochs=settings.single_epochs)
    network = replace(SEQUENCE_NETWORK, width=settings.width)
    alone = Training(epochs=settings.e2e_epochs, batch_size=16, network=network)
    solving = replace(network, frames="likelihood") if settings.calibrate else network
    plan = Training(batch_size=16, network=solving)
    before = anew = replace(plan, epochs=settings.pretrain_epochs or 8, sequence_augmentations=2)
    if settings.start:  # trained layers need less time and smaller steps; validation characters chose both
        before = replace(anew, epochs=settings.pretrain_epochs or 4, learning_rate=1e-3, refit_embedding=True)
    # Gentle, so that it forgets little; captures held out of it choose how much of it is taken, if any.
    after = replace(plan, epochs=settings.finetune_epochs, learning_rate=5e-4, keep_normalization=True)
    source = "calibrated" if settings.calibrate else "uncalibrated"
    alone_sees = Sampling(surface="hots", radius=1)  # of the time surfaces, validation characters chose it
    sees = Sampling(surface="likelihood") if settings.calibrate else alone_sees
    return Study(
        "demo",
        "demo",
        (
            Arm("simulation only", source, before, None, settings.start, anew, sampling=sees),
            Arm("EPNP", source, before, after, settings.start, anew, choose=True, sampling=sees),
            Arm("E2E, single positions", "none", None, single, sampling=alone_sees),
            Arm("E2E", "none", None, alone, sampling=alone_sees),
        ),
        seeds=(settings.seed,),
        test=tuple(test),
        writers=settings.writers,
        redrawn=settings.redrawn,
        simulation=replace(default(), seed=settings.seed),
        calibration=Calibration(event_captures=2, columns=48, seed=settings.seed),
        setups=2,
        robust=settings.robust,
        refine=False,
        average=True,
        correct_pattern=settings.calibrate,
    )


def held_out(folders: list[Path], wanted: tuple[str, ...]) -> list[str]:
    """Return the characters to test on; every seventh where the captures have none of the wanted ones."""
    there = [character_of(folder.resolve().name) for folder in folders]
    return [c for c in wanted if c in there] or there[::7]


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
    """

    setup: str
    refused: str
    warnings: tuple[str, ...]
    expected: str
    left: dict[str, tuple[float, float]]
    mean_image_db: dict[str, float]
    psnr_db: dict[tuple[str, str], list[float]]

    def best_e2e(self, modality: str) -> float:
        """Return the mean PSNR of the strongest end-to-end arm, dB; NaN where there is none."""
        values = [np.mean(v) for (arm, p), v in self.psnr_db.items() if arm.startswith("E2E") and p == modality]
        return float(max(values, default=np.nan))

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
        base: Settings of the demo; `out` holds a folder for each setup and seed.
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
                run_demo(replace(base, captures=tuple(folders), out=out, seed=seed))
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
    return Finding(setup, words, tuple(warnings), expected, left, mean_image, means_of(records))


def _left(residuals: dict[str, dict[str, float]], kind: str) -> tuple[float, float] | None:
    """Return residual and noise of held-out captures, without the frames' pattern where that is there."""
    names = [name for name in residuals if name.startswith(kind) and "held out" in name]
    names = [name for name in names if "without pattern" in name] or names
    return (residuals[names[-1]]["after"], residuals[names[-1]]["noise"]) if names else None


def mismatch_table(found: list[Finding]) -> str:
    """Return Markdown: a row for each setup and modality, and the margins that matter below it."""
    head = ["setup", "sees", "left / noise, %", "mean image", "E2E", "simulation only", "EPNP", "EPNP - E2E"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for one in found:
        for modality in [p for p in STANDARD_MODALITIES if p in one.mean_image_db]:
            kinds = {"frame": (_FRAMES,), "event": (_EVENTS,)}.get(modality, (_FRAMES, _EVENTS))
            left = "; ".join(
                f"{100 * a:.1f} / {100 * b:.1f}" for a, b in (one.left[k] for k in kinds if k in one.left)
            )
            e2e, epnp = one.best_e2e(modality), one.of("EPNP", modality)
            numbers = (one.mean_image_db[modality], e2e, one.of("simulation only", modality), epnp)
            cells = [one.setup, modality, left, *(f"{v:.2f}" for v in numbers), f"{epnp - e2e:+.2f}"]
            lines.append(f"| {' | '.join(cells)} |")
        if one.refused:
            lines.append(f"| {one.setup} | refused: {one.refused} |" + " |" * (len(head) - 2))
    return "\n".join([*lines, "", *_margins(found), "", *_said(found)]) + "\n"


def _margins(found: list[Finding]) -> list[str]:
    """Return a line for each modality: by how much EPNP leads, in the mean and where it leads least."""
    lines = []
    for modality in STANDARD_MODALITIES:
        lead = {one.setup: one.of("EPNP", modality) - one.best_e2e(modality) for one in found}
        above = {
            one.setup: one.of("simulation only", modality) - one.mean_image_db[modality]
            for one in found
            if modality in one.mean_image_db
        }
        lead = {setup: value for setup, value in lead.items() if np.isfinite(value)}
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
