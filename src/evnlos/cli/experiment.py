"""Commands that show and compare: `demo`, `experiment` and `live`.

- `evnlos demo`: the main job, small.
- `evnlos experiment`: a named comparison in, records and tables out.
- `evnlos live`: events as they come in, images out.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from evnlos import experiment
from evnlos.cli.parsing import UnfitWordsError, drawn, say
from evnlos.cli.recordings import Flat
from evnlos.data import MODALITIES, STANDARD_MODALITIES, captures_in, character_of
from evnlos.demo import LAB_CHARACTERS, Demo, held_out, run_demo
from evnlos.errors import ConfigError, UnknownNameError
from evnlos.files import write_atomically
from evnlos.live.run import RateOptions, Run, latency_table
from evnlos.live.sources import SourceOptions, check_source, film_of, open_live, so_far_of
from evnlos.machine import ProgressBars
from evnlos.types import Evidence, OutFolder

if TYPE_CHECKING:
    from evnlos.experiment import Arm, Study


@dataclass(frozen=True)
class DemoCommand:
    """The main job, small: simulate, pre-train, fine-tune on captures, train end to end, evaluate, report."""

    settings: Flat[Demo] = field(default_factory=Demo)

    def check_names(self) -> None:
        """Refuse captures that are not there, or too few, and characters to test on that none shows."""
        from evnlos.calibration.captures import FEWEST

        one, found = self.settings, captures_in(self.settings.captures)
        left = len(found) - len(held_out(found or [Path(f"lab_{c}") for c in LAB_CHARACTERS], one.test))
        if found and one.calibrate and left < FEWEST:
            given = f"--captures holds {len(found)}, of which {left} are not to test on"
            raise UnfitWordsError(f"{given}; give {FEWEST} or more of these, best 20, or --no-calibrate")

    def run(self) -> None:
        """Show a first reconstruction, run the demo, and print the table and the path of the report."""
        from evnlos.cli.results import show_first

        self.check_names()
        if not (one := self.settings).scene:
            show_first(one.out, one.captures, one.lab, one.force)
        run_demo(one)


_WITHOUT_CAPTURES = ("simulation", "conditions", "generalization", "mismatch")  # no study on captures


@dataclass(frozen=True)
class ExperimentCommand:
    """Run an experiment on captures: calibrate, simulate, pre-train, fine-tune, compare; resumable."""

    name: Annotated[str, tyro.conf.Positional]
    """captures (E2E against EPNP), paper (its settings), frozen, capture-count, surface, thresholds, loss,
    width, embedding, sequence (whole sequences) or objects (how many are simulated); without captures:
    simulation (handwriting, transfer to Comic), conditions (frames against events over light, speed, shade and
    more), generalization (given weights on unseen hands, other things and walls, with what their confidence
    says), and mismatch (the demo on walls, lenses and sensors that the simulator does not describe)."""
    captures: Path | None = None
    """Folder of the capture folders."""
    weights: Path | None = None
    """Weights for generalization, trained for the setup OUT/setups/NAME, NAME as for --captures-of."""
    out: OutFolder = Path("experiments")
    """Folder for setups, datasets, runs, records and tables; experiments in one folder share what they can."""
    captures_of: str = "near"
    """Which captures: those whose names begin with this and an underscore."""
    setups: tuple[str, ...] = ()
    """For mismatch: rooms of `evnlos lab`, or, with --captures, folders of captures in it; all by default."""
    robust: bool = False
    """For mismatch: beside the others, networks that learned from sensors and walls drawn from wide ranges."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of initial weights and order of the samples."""
    modalities: tuple[str, ...] = STANDARD_MODALITIES
    """What the networks see."""
    arms: tuple[str, ...] = ()
    """Only these arms, by name; by default all, but of sequence those of unrolled networks."""
    sequence: bool = False
    """Networks that see all time steps of a sequence together, in an experiment of single time steps."""
    keep_pattern: bool = False
    """Leave the frame camera's fixed pattern in all frames, recorded and simulated ones, on captures."""
    test: tuple[str, ...] = ("G", "K", "4", "9")
    """Characters that nothing sees before the test."""
    validation: tuple[str, ...] = ()
    """Characters to choose settings on: only these are scored, the test characters are not even read."""
    folds: int = 0
    """Deal the characters into so many folds, an even number, and test each by networks that learned from the
    others; two calibrations and pre-trainings serve the half that each has not seen. 0: test --test alone."""
    writers: int | None = None
    """Writers of the simulation, 36 objects each; by default the experiment's own number."""
    pretrain_epochs: int | None = None
    """Passes over the simulation; by default the experiment's own number."""
    finetune_epochs: int | None = None
    """Passes over the captures after pre-training; by default the experiment's own number."""
    e2e_epochs: int | None = None
    """Passes over the captures in end-to-end training; by default the experiment's own number."""
    workers: int = 0
    """Processes that simulate; 0 = one for each core."""
    trainings: int = 1
    """Networks that are trained at a time, on the cores or on one GPU, in as many times the memory; 0 = one for
    each core. For experiments on captures."""
    start: str = ""
    """Published layers that pre-trainings begin with, in smaller steps (generic, for sequence); or none."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""
    metric: Literal["psnr_db", "psnr_box_db", "ssim", "ms_ssim", "haarpsi", "gmsd", "lpips"] = "psnr_db"
    """What the printed tables show; the records hold all."""

    def check_names(self) -> None:
        """Refuse the name of no experiment."""
        if self.name == "mismatch":
            from evnlos.studies import mismatch_setups

            mismatch_setups(self.setups, self.captures)
        known = (*experiment.STUDIES, *_WITHOUT_CAPTURES)
        if self.name not in known:
            raise UnknownNameError(f"experiment {self.name!r} is unknown; give one of {', '.join(known)}")
        if self.name in experiment.STUDIES:
            there = [arm.name for arm in experiment.STUDIES[self.name](self.captures_of).arms]
            if unknown := [arm for arm in self.arms if arm not in there]:
                raise UnknownNameError(f"arm {unknown[0]!r} is unknown; {self.name} has {', '.join(there)}")
        for flag in ("seeds", "modalities", *(() if self.validation or self.folds else ("test",))):
            if not getattr(self, flag):
                raise UnfitWordsError(f"--{flag} is empty; give one or more")
        for one in self.modalities:
            MODALITIES.check(one)

    def run(self) -> None:
        """Run what is left, with a line of progress, and print the tables."""
        self.check_names()
        getattr(self, f"_{self.name}" if self.name in _WITHOUT_CAPTURES else "_on_captures")()

    def _on_captures(self) -> None:
        from evnlos.plot.figures import draw_scores

        study = self._study()
        assert self.captures is not None
        folders = tuple(experiment.captures_of(self.captures, self.captures_of))
        place = experiment.Place(folders, self.out, self.workers, self.trainings, self.force)
        name, studies = study.name, [study]
        if self.folds and self.validation:
            raise ConfigError("folds test every character: leave out --validation, or --folds")
        if self.folds:
            studies = experiment.folds_of(study, self.folds, [character_of(folder.name) for folder in folders])
            name += "-folds"
        with ProgressBars() as progress:
            experiment.run_studies(studies, place, progress)
        records = experiment.read_records(self.out / "records" / name)
        records = experiment.merge_folds(records, self.captures_of) if self.folds else records
        records = [r for r in records if r.setup == self.captures_of and r.split == study.split]
        text = _tables(name, records, self.metric)
        text += experiment.bounds_table(studies[0].setup_folder(self.out), folders[0], self.captures_of)
        name = f"{name}-{self.captures_of}-{study.split}"
        self._tell(name, text, partial(draw_scores, records, self.metric))

    def _tell(self, name: str, text: str, draw: Callable[[Path], object]) -> None:
        """Write a table and print it; draw the image that goes with it."""
        write_atomically(self.out / f"{name}.md", text.encode())
        print(text)
        drawn(image := self.out / f"{name}.png", lambda: draw(image))

    def _study(self) -> Study:
        """Return the named study with what the command line changes."""
        if self.captures is None:
            raise ConfigError(f"the experiment {self.name} needs --captures, the folder of the capture folders")
        study = experiment.STUDIES[self.name](self.captures_of)
        if self.writers and any(arm.writers for arm in study.arms):
            why = f"{self.name} compares numbers of writers; leave it out, or choose among its --arms"
            raise ConfigError(f"--writers {self.writers} would change nothing: {why}")
        asked = self.arms or [arm.name for arm in study.arms if arm.name not in study.asked_for]
        study = replace(
            study,
            arms=tuple(arm for arm in study.arms if arm.name in asked),
            modalities=tuple(p for p in study.modalities if p in self.modalities),
            writers=self.writers or study.writers,
            **{name: getattr(self, name) for name in ("seeds", "test", "validation")},
        )
        study = study.with_pattern() if self.keep_pattern else study
        study = experiment.on_sequences(study) if self.sequence else study
        study = study.begun_with(self.start) if self.start else study
        return replace(study, arms=tuple(self._in_epochs(arm) for arm in study.arms))

    def _in_epochs(self, arm: Arm) -> Arm:
        """Return an arm with the epochs that were asked for."""
        pre, fine = arm.pretraining, arm.finetuning
        tuned = self.finetune_epochs if pre else self.e2e_epochs
        pre = pre and replace(pre, epochs=self.pretrain_epochs or pre.epochs)
        fine = fine and replace(fine, epochs=tuned or fine.epochs)
        return replace(arm, pretraining=pre, finetuning=fine)

    def _simulation(self) -> None:
        from evnlos.plot.figures import draw_scores
        from evnlos.studies import SIMULATION, Simulated, run_simulated

        asked = ("out", "modalities", "seeds", "workers", "force")
        settings = Simulated(**{name: getattr(self, name) for name in asked})
        epochs = self.pretrain_epochs, self.finetune_epochs, self.e2e_epochs
        trainings = zip(("pretraining", "finetuning", "end_to_end"), epochs, strict=True)
        changed = {p: replace(getattr(settings, p), epochs=n) for p, n in trainings if n}
        settings = replace(settings, writers=self.writers or settings.writers, **changed)
        with ProgressBars() as progress:
            run_simulated(settings, progress)
        everything = experiment.read_records(self.out / "records" / SIMULATION)
        for tested in ("nist", "comic"):
            those = [record for record in everything if record.setup == tested]
            text = _tables("simulation", those, self.metric)
            self._tell(f"simulation-{tested}", text, partial(draw_scores, those, self.metric))

    def _conditions(self) -> None:
        from evnlos.plot.figures import draw_regimes

        out = self.out / "conditions"
        with ProgressBars() as progress:
            found = experiment.sweep_parameters(experiment.conditions(), out, self.workers, progress=progress)
            mapped = experiment.sweep_parameters(experiment.regimes(), out, self.workers, "", progress)
        self._tell("conditions", experiment.conditions_table(found) + "\n", partial(draw_regimes, mapped))

    def _generalization(self) -> None:
        from evnlos.plot.results import draw_confidence

        weights = self.weights
        if weights is None:
            raise ConfigError("generalization needs --weights, a weights file or a run's folder")
        setup = self.out / "setups" / self.captures_of
        with ProgressBars() as progress:
            found = experiment.generalization(
                weights, setup, self.out, self.workers, progress=progress, force=self.force
            )
        name = f"generalization-{self.captures_of}-{weights.stem}"
        experiment.write_generalization(found, self.out / f"{name}.json")
        checks = {one.name: one.confidence_checks for one in found}
        self._tell(name, experiment.generalization_table(found) + "\n", partial(draw_confidence, checks))

    def _mismatch(self) -> None:
        from evnlos.plot.figures import save_figure
        from evnlos.studies import lead_figure, leads_of, mismatch_table, run_mismatch

        names = ("out", "test", "modalities", "workers", "force", "robust", "writers")
        names += ("pretrain_epochs", "finetune_epochs", "e2e_epochs")
        base = replace(Demo(), **{name: value for name in names if (value := getattr(self, name))})
        with ProgressBars() as progress:
            found = run_mismatch(base, self.setups, self.captures, self.seeds, progress)
        text, captures = mismatch_table(found), self.captures or self.out / "captures"
        for setup in [one.setup for one in found if not one.refused]:
            fitted = self.out / f"{setup}-seed{self.seeds[0]}" / "setups" / "demo"
            first = min((captures / setup).glob("*/capture.yaml")).parent
            text += experiment.bounds_table(fitted, first, setup)
        self._tell("mismatch", text, lambda image: save_figure(lead_figure(leads_of(found)), image, dpi=110))


def _tables(name: str, records: list, metric: str) -> str:
    parts = [f"# {name}, {records[0].setup}, {records[0].split} characters"]
    parts.append(experiment.summary_table(records, metric))
    arms = {record.arm for record in records if record.seed >= 0}
    tried = any(arm.startswith("E2E") for arm in arms)
    parts += [experiment.gain_table(records, arm) for arm in ("EPNP", "EPNP sequence") if tried and arm in arms]
    if {"EPNP", "E2E"} <= arms:
        parts.append(experiment.character_table(records, ("E2E", "EPNP"), metric))
    parts.append(experiment.checks_table(records))
    return "\n\n".join(parts) + "\n"


_FILM_CONFIDENCE = "no confidence: a film has an error of each cell (evnlos invert --changing), not shown here"
_LIVE_CONFIDENCE = (
    "no confidence: live images are of single time steps; record the sequence (evnlos capture record), then "
    "evnlos reconstruct tells what it supports"
)


@dataclass(frozen=True)
class LiveCommand:
    """Reconstruct while events come in: a replay, a file that grows, a camera, or a stream."""

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Capture folder or event file (replayed); event file with --follow; a camera (evk4, evk3-hd, davis346,
    dvxplorer, centuryarks-vga or triton; NAME:SERIAL where several are connected); - for EVT2 or EVT3 words on
    standard input; udp://127.0.0.1:7000, aestream://127.0.0.1:3333, dv://127.0.0.1:7777."""
    weights: Path | None = None
    """Weights of single positions: file, run's folder, or name; of modality event where SOURCE has no frames.
    None: near-frame for a capture, else near-event; with --changing none: networks know what moves as one."""
    headless: bool = False
    """Show no page; write the video and the latency table to --out."""
    out: OutFolder | None = None
    """Folder for video and latency.json, new or empty; by default live-out where --headless, else none."""
    port: int = 8765
    """Port of the page on 127.0.0.1; 0 = any that is free."""
    pattern: Path | None = None
    """Fixed pattern to take from a capture's frames: the file that `calibrate` wrote, or its folder."""
    so_far: Path | None = None
    """Weights of whole sequences (near-event-sequence): beside the image of the instant, one of all seen so
    far, as often as it is worth it. SOURCE is then a capture that states its motion."""
    changing: tuple[float, float] | None = None
    """Nothing moves as a whole: what a hidden plane of this width and height, metres, shows now, the newest
    image of its film (as `invert --changing`), about the middle of the target plane of --setup."""
    setup: Path | None = None
    """With --changing: the setup, as for `invert`; a name, a settings file, or a folder of `calibrate`."""
    evidence: Annotated[Evidence, tyro.conf.arg(name="from")] = "frames"
    """With --changing: what the film is made of."""
    cells: int = 24
    """With --changing: cells along the plane's longer side."""
    newest: float = 3.0
    """With --changing: seconds of the past that an image knows; with them grows the time that it takes."""
    threads: int = 1
    """Threads of the network; more are quicker only where cores have nothing else to do."""
    json: bool = False
    """Print one JSON object at the end."""
    listening: Flat[SourceOptions] = field(default_factory=SourceOptions)
    pace: Flat[RateOptions] = field(default_factory=RateOptions)

    def check_names(self) -> None:
        """Refuse a source that is nothing, and a port that is none."""
        check_source(self.source, self.listening.follow)
        if not 0 <= self.port <= 65_535:
            raise UnfitWordsError(f"--port is {self.port}; give 1 to 65535, or 0 for any that is free")
        if (self.changing is None) != (self.setup is None) or (self.changing and self.so_far):
            given = f"--changing is {self.changing}, --setup {self.setup}, --so-far {self.so_far}"
            raise UnfitWordsError(f"{given}; give --changing WIDTH HEIGHT and --setup together, or --so-far")

    def run(self) -> None:
        """Show or record images until the source ends, and print how quick they were."""
        import torch

        from evnlos.analysis.identify import verdict_on
        from evnlos.analysis.model import load_model
        from evnlos.data import pattern_of
        from evnlos.inverse import film_plane
        from evnlos.live.display import Page, Recorder, check_folder
        from evnlos.live.engine import Engine
        from evnlos.models import published_for
        from evnlos.setups.load import linear_setup

        self.check_names()
        if self.threads < 1:
            raise ConfigError(f"threads is {self.threads}; give at least 1")
        torch.set_num_threads(self.threads)
        out = self.out or (Path("live-out") if self.headless else None)
        if out is not None:
            check_folder(out)
        name, recorder, beside, wall = self.weights, None, None, None
        model = None if name is None else load_model(name)
        source = open_live(self.source, self.listening, pattern_of(self.setup, self.pattern))
        try:
            with ExitStack() as stack:
                if self.setup is not None and self.changing is not None:
                    wall, plane = linear_setup(self.setup), film_plane(self.changing, self.cells)
                    beside = film_of(wall, plane, source, self.evidence, self.newest)
                elif model is None:
                    name = published_for(None, "frame" if source.has_frames else "event", is_motion_known=False)
                    model = load_model(name)
                    say(f"{name} makes the images: weights of the package, for its own setup; see --weights")
                engine, why = Engine(model and model.weights), _LIVE_CONFIDENCE if model else _FILM_CONFIDENCE
                seen, known = (engine.modality.name, model.known()) if model else ("no network", (wall, None))
                verdict = verdict_on(known[0], None, why, is_stated=model is None, stated_m=known[1])
                verdict = verdict if model else replace(verdict, guessed="")  # no network draws
                if self.so_far is not None:
                    beside = so_far_of(self.so_far, source)
                if beside is not None:
                    say(f"what makes the images ({beside.title}) starts, which takes some seconds")
                run = Run(source, engine, self.pace, beside=beside)
                sinks = []
                if not self.headless:
                    title, again = f"{source.name}, {seen}", getattr(source, "again", None)
                    told = lambda: run.statistics.now() | {"verdict": verdict.lines}  # noqa: E731
                    sinks.append(page := stack.enter_context(Page(told, self.port, title, again)))
                    say(f"{page.url} shows the images; Ctrl-C ends")
                    if source.waits:
                        page.wait_for_viewer(lambda: False)
                if out is not None:
                    recorder = stack.enter_context(Recorder(out))
                    sinks.append(recorder)
                run.go(sinks)
        finally:
            source.close()
        about = {"weights": name and str(name), "modality": seen, "verdict": asdict(verdict)}
        summary = run.statistics.summary() | about | ({"beside": beside.summary()} if beside else {})
        if out is not None and recorder is not None:
            summary |= {"recorded": recorder.recorded, "not_recorded": recorder.left_out}
            write_atomically(out / "latency.json", (json.dumps(summary, indent=1) + "\n").encode())
        if self.json:
            print(json.dumps(summary | {"out": None if out is None else str(out)}))
            return
        print("\n".join([*verdict.lines, latency_table(summary)]))
        if recorder is not None:
            video = f"{recorder.path.name} ({recorder.recorded} images) and " if recorder.recorded else ""
            print(f"{out}: {video}latency.json")
