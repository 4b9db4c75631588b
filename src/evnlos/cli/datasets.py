"""Commands that make and check data: `simulate`, `lab`, `capture`, `import`."""

from __future__ import annotations

import difflib
import io
import json
import sys
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro
from tqdm import tqdm

from evnlos.cameras import load_pixel
from evnlos.cli.parsing import check_there, say, told_first
from evnlos.cli.recordings import Flat, Folders, Presets, result
from evnlos.data import (
    Capture,
    Sampling,
    Simulation,
    import_captures,
    load_pattern,
    randomized,
    read_capture,
    simulate,
)
from evnlos.data.capture import by_name
from evnlos.data.capture_check import Finding, check_capture, compare_clocks
from evnlos.data.capture_info import CAMERAS, CaptureInfo, begin_capture
from evnlos.data.lab import Lab, lab_of, published_lab, render_captures
from evnlos.data.pool import run_on_dask, run_tasks
from evnlos.data.sampling import split_of
from evnlos.data.simulations import PRESETS, estimate, with_pictures
from evnlos.data.store import CHECKS
from evnlos.errors import ConfigError, DataError, EvnlosError, UnknownNameError
from evnlos.files import check_folder, write_atomically
from evnlos.machine import ProgressBars, counted
from evnlos.plot.preview import check_image
from evnlos.setups import load_setup
from evnlos.setups.base import is_camera
from evnlos.setups.load import is_name
from evnlos.types import OutFolder


@dataclass(frozen=True)
class SimulateCommand:
    """Simulate a dataset: one shard per hidden object. Run it again to go on after an interruption."""

    PRESETS: ClassVar[Presets[Simulation]] = PRESETS

    out: OutFolder
    """Folder of the dataset; new, or begun with the same settings."""
    preset: str = "default"
    """`default`; `paper` for the paper's training set; `paper-nist-test`, `paper-comic-letters` or
    `paper-comic-digits` for its test sets."""
    config: Path | None = None
    """YAML file with settings that replace the preset's."""
    setup: str | None = None
    """The setup instead of the preset's: a name (main-near, matte-far, ...), a settings file, a folder that
    `evnlos calibrate` wrote, or a file of `evnlos scan import`. A wall's name leaves the cameras to the preset,
    a room (worn, circuit, ...) the number of pixels alone; ranges over what it states are dropped."""
    pixel: str | None = None
    """The event pixel instead of the setup's: a preset's name, or a YAML file, as `evnlos pixel fit`
    writes it."""
    pictures: Path | None = None
    """Folder with pictures of yours in place of the characters: each a target, of any size, taken in grey."""
    robust: bool = False
    """Draw sensors and walls from wide ranges around those of the settings: for setups that change."""
    workers: int = 0
    """Processes; 0 = one for each core."""
    shard: str = "1/1"
    """Share of the objects to make here, i/n: run the shares 1/n to n/n anywhere, on one shared folder."""
    engine: Literal["local", "dask"] = "local"
    """Processes on this machine, or a Dask cluster (extra `cluster`) on a shared file system."""
    scheduler: str | None = None
    """Address of a running Dask scheduler, e.g. tcp://node1:8786; by default a cluster on this machine."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""
    dry_run: bool = False
    """Only simulate one object and print what the whole would take: time, disk, memory."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Simulation] = field(default_factory=Simulation)

    @staticmethod
    def with_setup(settings: Simulation, word: str) -> Simulation:
        """Return the simulation with the setup of `--setup`, without the ranges over the wall that it had."""
        setup = load_setup(word)
        is_room = is_name(word) and setup.is_lit
        if is_room:
            setup = replace(setup, sensor=settings.setup.sensor)
        elif is_name(word):
            setup = setup.with_cameras_of(settings.setup)
        # Ranges over cameras go on, but for a room, which states its own.
        stated = [p for p in settings.vary if p.startswith("setup.") and (is_room or not is_camera(p))]
        vary = {path: ends for path, ends in settings.vary.items() if path not in stated}
        return replace(settings, setup=setup, vary=vary)

    @staticmethod
    def with_pixel(settings: Simulation, word: str) -> Simulation:
        """Return the simulation with the pixel of `--pixel`, without the ranges over its settings."""
        setup = replace(settings.setup, pixel=load_pixel(word))
        vary = {path: ends for path, ends in settings.vary.items() if not path.startswith("setup.pixel")}
        return replace(settings, setup=setup, vary=vary)

    with_pictures = staticmethod(with_pictures)

    def run(self) -> None:
        """Simulate, with a progress bar over the objects."""
        config, share = randomized(self.settings) if self.robust else self.settings, _share(self.shard)
        if self.scheduler and self.engine != "dask":
            raise ConfigError(f"--scheduler {self.scheduler} needs --engine dask")

        def notes() -> None:
            warnings = [f"warning: {line}" for line in config.setup.warnings()]
            optics = [f"{name} {value:.3g}" for name, value in config.optics().items()]
            for line in [*config.glyphs.notes(), *warnings, *optics]:
                say(line)

        total = len(config.glyphs.objects())
        if self.dry_run:
            estimated = estimate(config, self.workers, share)
            notes()
            print("\n".join(estimated.lines(self.out)))
            return
        engine = run_tasks if self.engine == "local" else partial(run_on_dask, scheduler=self.scheduler)
        with ProgressBars() as bars:
            progress = told_first(notes, bars)
            missing = simulate(config, self.out, self.workers, share, engine, progress, self.force).missing()
        about = {"out": str(self.out), "objects": total, "samples": total * config.positions}
        text = f"{self.out}: {total} objects, {total * config.positions} samples, {len(missing)} missing"
        result(self.json, about | {"missing": missing}, text)


def _share(text: str) -> tuple[int, int]:
    """Return (i, n) of "i/n"."""
    first, _, stride = text.partition("/")
    if not (first.isdigit() and stride.isdigit() and 1 <= int(first) <= int(stride)):
        raise ConfigError(f"--shard is {text!r}; give i/n with i from 1 to n, e.g. 3/16")
    return int(first), int(stride)


@dataclass(frozen=True)
class LabCommand:
    """Render pseudo-real captures: a wall of metal or paint, other cameras than the training simulator's."""

    PRESETS: ClassVar[Presets[Lab]] = {"default": Lab}

    out: OutFolder
    """Folder for the capture folders; a capture that is there is done."""
    setup: str | None = None
    """The setup: a name (mirror, easy, main, hard, matte or aperture, with -near or -far), a room (two-lobes,
    one-sided, curved, brushed, streaks, torch: outside the simulator's model), a settings file, or a folder
    that `evnlos calibrate` wrote; by default main-near. A name but a room's leaves light and cameras to the
    lab."""
    set: Literal["near", "far"] | None = None
    """A published set: 36 captures each, whose settings, seed and checksums the package holds. What is rendered
    is compared with them. Beside it only --glyphs.characters counts."""
    config: Path | None = None
    """YAML file with settings of the laboratory."""
    pictures: Path | None = None
    """Folder with pictures of yours in place of the characters: each a target, of any size, taken in grey."""
    workers: int = 1
    """Processes; 0 = one for each core. The captures are the same for any number."""
    force: bool = False
    """Begin although the machine's memory will hardly do."""
    settings: Flat[Lab] = field(default_factory=Lab)

    @staticmethod
    def with_setup(settings: Lab, word: str) -> Lab:
        """Return the lab with the setup of `--setup`."""
        return lab_of(word, settings)

    with_pictures = staticmethod(with_pictures)

    def run(self) -> None:
        """Render, with a progress bar over the captures; compare a published set with its checksums."""
        from evnlos.report.provenance import compare_published

        lab, record = self.settings, "lab.yaml"
        if self.set is not None:
            lab, record = published_lab(self.set, lab), f"{self.set}.lab.yaml"
        with ProgressBars() as bars:
            progress = told_first(lambda: [say(note) for note in lab.glyphs.notes()], bars)
            rendered = render_captures(lab, self.out, None, self.workers, progress, self.force, record)
            differing = compare_published(self.set, rendered, progress) if self.set else {}
        print(f"{self.out}: {_counted(len(rendered))}; settings and the drawn sensor in {self.out / record}")
        if self.set is not None:
            print(f"{len(rendered) - len(differing)} of them have the published SHA-256")
        for name, text in differing.items():
            say(f"note: {name}: {text}; another processor or library rounds otherwise")


@dataclass(frozen=True)
class CaptureCommand:
    """Begin a capture folder (init), record one from a camera or stream (record), or tell its worth (check)."""

    action: Annotated[Literal["init", "record", "check"], tyro.conf.Positional]
    """init writes a commented capture.yaml; record writes a whole capture; check reads one and tells what is
    wrong and how to mend it."""
    folders: Folders
    """The folder of the capture; check: or of several."""
    source: str | None = None
    """record: what `evnlos live` takes: a camera such as evk4 or davis346, - for words on standard input,
    udp://, aestream://, dv://."""
    seconds: float | None = None
    """record: length, seconds; by default until the source ends, or Ctrl-C."""
    idle: float = 10.0
    """record: end when the source brought nothing, or a camera stayed away, for so many seconds; 0 = never."""
    format: str | None = None
    """record: words on standard input without a RAW header: evt2, evt21 or evt3, with --width and --height."""
    width: int | None = None
    """Columns of the event camera's sensor, pixels; record: where the source does not say; init: by default the
    camera's."""
    height: int | None = None
    """Rows of the event camera's sensor, pixels."""
    camera: str | None = None
    """init: davis346, davis240, dvxplorer, dvs128, evk4, evk3-hd, gen3-vga, centuryarks-vga, triton or celex-v;
    or, with --width and --height, maker and model of another."""
    json: bool = False
    """record, check: print one JSON object."""

    def run(self) -> None:
        """Write the file, record, or print the findings; exit code 1 where one of them is bad."""
        if not self.folders or (self.action != "check" and len(self.folders) > 1):
            several = " or more" if self.action == "check" else ""
            raise ConfigError(f"{self.action} has {len(self.folders)} folders; give one{several}")
        {"init": self._init, "record": self._record, "check": self._check}[self.action]()

    def check_names(self) -> None:
        """Refuse a camera that is not known and whose sensor is not stated, and a capture that is not there."""
        camera = (self.camera or "").lower()
        if self.action == "init" and camera not in CAMERAS and not (self.width and self.height):
            near = difflib.get_close_matches(camera, CAMERAS, n=1)
            cure = f"did you mean {near[0]}?" if near else f"give one of {', '.join(CAMERAS)}"
            camera = "no --camera" if self.camera is None else f"--camera {self.camera!r} is not known"
            raise UnknownNameError(f"{camera}; {cure}, or --width and --height of its sensor")
        if self.action == "check" and len(self.folders) == 1:
            check_there(read_capture, *self.folders)

    @property
    def is_light(self) -> bool:
        """Whether it runs without the libraries that the others need."""
        return self.action == "init"

    def _init(self) -> None:
        self.check_names()
        folder, other = self.folders[0], (self.camera or "my camera", 0, 0, "events.raw", "frames")
        name, columns, rows, *files = CAMERAS.get((self.camera or "").lower(), other)
        path = begin_capture(folder, self.width or columns, self.height or rows, name, *files)
        print(f"{path}: edit it, put the recordings beside it, then: evnlos capture check {folder}")

    def _check(self) -> None:
        """Tell of each capture in full, or of several in a table with what is not good below it."""
        found, failed, infos = dict[str, list[Finding]](), dict[str, str](), dict[str, CaptureInfo]()
        with ProgressBars() as progress:
            for folder in counted(self.folders, progress, "check", len(self.folders), "captures"):
                try:
                    capture = read_capture(folder, needs_frames=False, needs_events=False)
                    found[str(folder)], infos[str(folder)] = check_capture(capture), capture.info
                except EvnlosError as error:
                    if len(self.folders) == 1:
                        raise
                    failed[str(folder)] = str(error)
                    continue
                if len(self.folders) == 1 and not self.json:
                    print("\n".join(capture.notes))
        found = compare_clocks(found, infos)
        if self.json:
            page = [{"capture": Path(k).name, "findings": [*map(asdict, v)]} for k, v in found.items()]
            page += [{"capture": Path(name).name, "error": text} for name, text in failed.items()]
            print(json.dumps(page[0] if len(self.folders) == 1 else page))
        elif len(self.folders) == 1:
            print("\n".join(map(finding_line, *found.values())))
        else:
            print(findings_table(found, failed))
        if failed:
            raise DataError(f"{len(failed)} of {len(self.folders)} captures can't be read")
        if any(one.level == "bad" for all_ in found.values() for one in all_):
            raise SystemExit(1)

    def _record(self) -> None:
        from evnlos.live.record import record_capture
        from evnlos.live.sources import SourceOptions, open_live

        if self.source is None:
            raise ConfigError("record needs --source: a camera such as evk4, -, udp://HOST:PORT; see --help")
        folder = self.folders[0]
        check_folder(folder)
        how = SourceOptions(idle=self.idle, format=self.format, width=self.width, height=self.height)
        source = open_live(self.source, how)
        is_shown = sys.stderr.isatty()

        def tell(line: str) -> None:
            print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True) if is_shown else say(line)

        say(f"{source.name} is recorded; Ctrl-C ends")
        try:
            every_s = 0.5 if is_shown else 5.0
            done = record_capture(folder, source, seconds=self.seconds, tell=tell, tell_every_s=every_s)
        finally:
            source.close()
            if is_shown:
                print(file=sys.stderr)
        if done.ended_by:
            say(f"warning: it ended early: {done.ended_by}")
        lost = "".join(f", {count:,} {name}" for name, count in done.faults.items())
        text = f"{folder}: {done.events:,} events and {done.frames:,} frames in {done.seconds:.1f} s{lost}"
        about = asdict(done) | {"folder": str(folder)}
        result(self.json, about, f"{text}; next: evnlos capture check {folder}")


def _counted(captures: int) -> str:
    return f"{captures} capture" + "s" * (captures != 1)


_MARKS = {"good": "  good   ", "doubtful": "? look   ", "bad": "! BAD    "}


def finding_line(one: Finding) -> str:
    """Return a finding as a line for people, with its cure where there is one."""
    return f"{_MARKS[one.level]}{one.what}: {one.found}" + (f"; {one.cure}" if one.cure else "")


def findings_table(found: dict[str, list[Finding]], failed: dict[str, str]) -> str:
    """Return a row for each capture and a column for each look (. good, ? look, ! bad), and below what to mend.

    Args:
        found: Findings by capture.
        failed: What is wrong with captures that can't be read.
    """
    looks = list(dict.fromkeys(one.what for several in found.values() for one in several))
    width = max(map(len, [*found, *failed]))
    lines = [f"{'':<{width}}  {k:>2} {look}" for k, look in enumerate(looks, 1)]
    lines.append(f"{'':<{width}}  " + " ".join(f"{k:>2}" for k in range(1, len(looks) + 1)))
    marks, wrong = {"good": " .", "doubtful": " ?", "bad": " !"}, list[str]()
    for name, several in found.items():
        by_look = {one.what: marks[one.level] for one in several}
        lines.append(f"{name:<{width}}  " + " ".join(by_look.get(look, "  ") for look in looks))
        wrong += [f"{name}: {finding_line(one).strip()}" for one in several if one.level != "good"]
    lines += [f"{name:<{width}}  can't be read: {text}" for name, text in failed.items()]
    good = sum(all(one.level == "good" for one in several) for several in found.values())
    return "\n".join([*lines, "", *wrong, f"{good} of {len(found) + len(failed)} captures are good in all"])


@dataclass(frozen=True)
class ImportCommand:
    """Turn captures (folders with capture.yaml, or ROS bags and AEDAT files) into a dataset to train on."""

    captures: Folders
    """Capture folders; or recordings that hold events and frames of one camera (ROS bag, AEDAT)."""
    out: OutFolder
    """Folder of the dataset."""
    topic: str | None = None
    """Stream of the events, of a recording with several; `evnlos info` lists them."""
    frames_topic: str | None = None
    """Stream of the frames, of a recording with several."""
    test: tuple[str, ...] = ()
    """Captures or characters that are held out for testing, e.g. G K 4 9."""
    validation: tuple[str, ...] = ()
    """Captures or characters that are held out for validation."""
    pattern: Path | None = None
    """Fixed pattern to take from the frames: the file that `calibrate` wrote, or its folder."""
    check_images: bool = True
    """Draw one image per capture (frame, events, both, curves) into the folder checks of the dataset."""
    json: bool = False
    """Print one JSON object."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation."""

    def check_names(self) -> None:
        """Refuse a capture that is not there, and names of none."""
        check_there(read_capture, *self.captures)
        split_of([*by_name([one.resolve() for one in self.captures])], [*self.test], [*self.validation])

    def run(self) -> None:
        """Import, with a progress bar over the captures."""
        with ProgressBars() as progress:
            pattern = load_pattern(self.pattern) if self.pattern else None
            dataset = import_captures(
                self.captures, self.out, self.sampling, test=self.test, validation=self.validation,
                pattern=pattern, events_topic=self.topic, frames_topic=self.frames_topic, look=self._look,
                progress=progress,
            )  # fmt: skip
        counts = ", ".join(f"{len(names)} {split}" for split, names in dataset.split.items())
        about = {"out": str(self.out), "split": dataset.split}
        result(self.json, about, f"{self.out}: {_counted(len(dataset.objects()))} ({counts})")
        if self.check_images and not self.json:
            print(f"check images: {self.out / CHECKS}")

    def _look(self, capture: Capture) -> None:
        """Tell what was done to a capture, and draw it."""
        tqdm.write(f"{capture.name}: {'; '.join(capture.notes)}", file=sys.stderr)  # above the bar
        if self.check_images:
            drawn = io.BytesIO()
            check_image(capture).save(drawn, "PNG")
            write_atomically(self.out / CHECKS / f"{capture.name}.png", drawn.getvalue())
