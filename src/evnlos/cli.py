"""The commands, one thin class a verb: flags and help come from the same dataclasses as the YAML files."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tqdm import tqdm

from evnlos.config import load_yaml
from evnlos.dataset import Sampling, Simulation, import_captures, open_dataset, simulate
from evnlos.dataset.lab import Lab, render_captures
from evnlos.dataset.presets import PRESETS
from evnlos.demo import Demo, run_demo
from evnlos.errors import ConfigError, EvnlosError
from evnlos.training import Training, paper_finetuning, paper_pretraining, train
from evnlos.version import __version__

T = TypeVar("T")
Folders = Annotated[tuple[Path, ...], tyro.conf.Positional]
Flat = Annotated[T, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class SimulateCommand:
    """Simulate a dataset: one shard a hidden object. Run it again to go on after an interruption."""

    out: Path
    """Folder of the dataset; new, or begun with the same settings."""
    preset: str = "default"
    """Settings to start from; see the list at the end of `evnlos simulate --help`."""
    config: Path | None = None
    """YAML file with settings that replace the preset's."""
    workers: int = 0
    """Processes; 0 = one for each core."""
    settings: Flat[Simulation] = field(default_factory=Simulation)

    def run(self) -> None:
        """Simulate, with a progress bar over the objects."""
        config = self.settings
        for note in config.glyphs.notes():
            _say(note)
        _say(describe_optics(config))
        total = len(config.glyphs.objects())
        for _ in _progress(simulate(config, self.out, self.workers), total, "objects", self.out):
            pass
        dataset = open_dataset(self.out)
        print(
            f"{self.out}: {total} objects, {total * config.positions} samples, {len(dataset.missing())} missing"
        )


@dataclass(frozen=True)
class ImportCommand:
    """Turn captures (folders with capture.yaml, events and frames) into a dataset to train and test on."""

    captures: Folders
    """Capture folders."""
    out: Path
    """Folder of the dataset."""
    test: tuple[str, ...] = ()
    """Captures or characters that are held out for testing, e.g. G K 4 9."""
    validation: tuple[str, ...] = ()
    """Captures or characters that are held out for validation."""
    sampling: Sampling = field(default_factory=Sampling)
    """Resolution and representation."""

    def run(self) -> None:
        """Import, with a progress bar over the captures."""
        imported = import_captures(
            self.captures, self.out, self.sampling, test=self.test, validation=self.validation
        )
        for _ in _progress(imported, len(self.captures), "captures", self.out):
            pass
        dataset = open_dataset(self.out)
        counts = ", ".join(f"{len(names)} {split}" for split, names in dataset.split.items())
        print(f"{self.out}: {len(dataset.objects())} captures ({counts})")


@dataclass(frozen=True)
class LabCommand:
    """Render pseudo-real captures: rough aluminium, other cameras than the training simulator's."""

    out: Path
    """Folder for the capture folders."""
    config: Path | None = None
    """YAML file with settings of the laboratory."""
    settings: Flat[Lab] = field(default_factory=Lab)

    def run(self) -> None:
        """Render, with a progress bar over the captures."""
        for note in self.settings.glyphs.notes():
            _say(note)
        names = self.settings.glyphs.objects()
        for _ in _progress(render_captures(self.settings, self.out), len(names), "captures", self.out):
            pass
        print(f"{self.out}: {len(names)} captures")


@dataclass(frozen=True)
class TrainCommand:
    """Train a network from random weights: pre-training on a simulation, or end to end (E2E) on captures."""

    data: Path
    """Folder of the dataset."""
    out: Path
    """Folder of the run; new, or begun with the same settings."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 200 epochs, step sizes and loss."""
    config: Path | None = None
    """YAML file with settings."""
    settings: Flat[Training] = field(default_factory=Training)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        _train(self.data, self.settings, self.out, None)


@dataclass(frozen=True)
class FinetuneCommand:
    """Fine-tune weights on few captures (EPNP): paradigm and network are those of the weights."""

    weights: Path
    """Weights file, or the run to start from."""
    data: Path
    """Folder of the dataset of captures."""
    out: Path
    """Folder of the run; new, or begun with the same settings."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 100 epochs at 1e-5 with its loss."""
    config: Path | None = None
    """YAML file with settings."""
    settings: Flat[Training] = field(default_factory=Training)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        _train(self.data, self.settings, self.out, self.weights)


@dataclass(frozen=True)
class EvaluateCommand:
    """Score a network on a split of a dataset, with the baselines beside it."""

    weights: Path
    """Weights file, or a run's folder."""
    data: Path
    """Folder of the dataset."""
    split: str | None = None
    """Split to score: test, validation, train or all; by default `test` where there is one, else `all`."""
    vgg: Path | None = None
    """torchvision's vgg16-397923af.pth for LPIPS; by default it is looked for in the torch hub cache."""
    lpips_heads: Path | None = None
    """The linear heads vgg.pth of LPIPS v0.1; by default those of an installed `lpips`."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> None:
        """Evaluate and print."""
        from evnlos.evaluation import available_lpips, evaluate, load_lpips
        from evnlos.model import load_weights
        from evnlos.report import refuse_seen, seen_in_training

        dataset, weights = open_dataset(self.data), load_weights(self.weights)
        split = self.split or ("test" if dataset.split.get("test") else "all")
        refuse_seen(weights.history, dataset, split)
        metric = load_lpips(self.vgg, self.lpips_heads) if self.vgg or self.lpips_heads else available_lpips()
        found = evaluate(weights, dataset, split, metric).summary()
        about = {
            "weights": str(self.weights),
            "paradigm": weights.paradigm,
            "data": str(self.data),
            "split": split,
        }
        seen = seen_in_training(weights.history, dataset, split)
        if self.json:
            print(json.dumps(about | {"seen_in_training": seen} | found))
        else:
            _print_summary(about, found)
            if seen:
                _say(f"note: training saw {', '.join(seen)}; scores on them say nothing about unseen objects")


@dataclass(frozen=True)
class ReconstructCommand:
    """Reconstruct all positions of a capture: pictures, a film strip and an animation."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder; its target may be unknown."""
    weights: Path
    """Weights file, or a run's folder."""
    out: Path = Path("reconstruction")
    """Folder for the pictures; new or empty."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Reconstruct and print where the pictures are."""
        from evnlos.report import reconstruct_capture

        found = reconstruct_capture(self.capture, self.weights, self.out)
        if self.json:
            print(json.dumps(found | {"out": str(self.out)}))
            return
        print(f"{self.out}: {found['positions']} positions of {found['capture']} ({found['paradigm']})")
        if "scores" in found:
            print("  ".join(f"{name} {value}" for name, value in found["scores"].items() if value is not None))


@dataclass(frozen=True)
class ReportCommand:
    """Score runs on the same captures and write one self-contained HTML page, with a CSV beside it."""

    runs: Folders
    """Folders of the runs."""
    data: Path
    """Folder of the dataset to score on."""
    split: str = "test"
    """Split to score."""
    out: Path = Path("report.html")
    """The page."""

    def run(self) -> None:
        """Evaluate the runs and write the page."""
        from evnlos.report import gather, to_text, write_report

        dataset, results = gather(list(self.runs), self.data, self.split)
        path = write_report(self.out, dataset, results, [], self.split)
        print(to_text(results))
        print(f"report: {path}")


@dataclass(frozen=True)
class DemoCommand:
    """The main job, small: simulate, pre-train, fine-tune on captures, train end to end, evaluate, report."""

    settings: Flat[Demo] = field(default_factory=Demo)

    def run(self) -> None:
        """Run the demo and print the table and the path of the report."""
        run_demo(self.settings)


COMMANDS: dict[str, type] = {
    "demo": DemoCommand,
    "simulate": SimulateCommand,
    "import": ImportCommand,
    "lab": LabCommand,
    "train": TrainCommand,
    "finetune": FinetuneCommand,
    "evaluate": EvaluateCommand,
    "reconstruct": ReconstructCommand,
    "report": ReportCommand,
}


def main(argv: list[str] | None = None) -> None:
    """Run a command; bad input ends with one line on stderr and exit code 2."""
    arguments = sys.argv[1:] if argv is None else argv
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return
    if arguments[0] == "--version":
        print(__version__)
        return
    verb, rest = arguments[0], arguments[1:]
    try:
        if verb not in COMMANDS:
            raise ConfigError(f"unknown command {verb!r}; give one of {', '.join(COMMANDS)}")
        default = _defaults(verb, rest)
        # The kinds of glyphs and transport come from preset or file; flags change the numbers of that kind.
        quiet = (tyro.conf.AvoidSubcommands,)
        command = tyro.cli(COMMANDS[verb], args=rest, prog=f"evnlos {verb}", default=default, config=quiet)
        command.run()
    except EvnlosError as error:
        print(f"evnlos {verb}: error: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        print(f"evnlos {verb}: error: {error}; nothing half-written was left", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"evnlos {verb}: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


def describe_optics(config: Simulation) -> str:
    """Return one line about what diffraction and the wall do to the picture."""
    figures = getattr(config.transport, "figures", None)
    if figures is None:
        return f"radiometric wall, {config.transport.kind}"
    found = figures(config.glyphs.plate.size_m, (config.sensor.height, config.sensor.width))
    return ", ".join(f"{name} {value:.3g}" for name, value in found.items())


def _defaults(verb: str, rest: list[str]) -> Any:
    """Return the command with the settings of --preset and --config as its defaults, for tyro to override."""
    if verb not in ("simulate", "lab", "train", "finetune"):
        return None
    preset, config = _flag(rest, "--preset"), _flag(rest, "--config")
    presets: dict[str, Callable[[], Any]] = {
        "simulate": PRESETS,
        "lab": {"default": Lab},
        "train": {"default": Training, "paper": paper_pretraining},
        "finetune": {"default": Training, "paper": paper_finetuning},
    }[verb]
    if preset is not None and preset not in presets:
        raise ConfigError(f"--preset is {preset!r}; give one of {', '.join(presets)}")
    settings = presets[preset or "default"]()
    if config is not None:
        settings = load_yaml(type(settings), config)
    values: dict[str, Any] = {"settings": settings, "out": tyro.MISSING}
    if verb in ("train", "finetune"):
        values["data"] = tyro.MISSING
    if verb == "finetune":
        values["weights"] = tyro.MISSING
    return COMMANDS[verb](**values)


def _flag(arguments: list[str], name: str) -> str | None:
    """Return the value of a flag, given as `--flag value` or `--flag=value`."""
    for i, argument in enumerate(arguments):
        if argument == name and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith(f"{name}="):
            return argument.split("=", 1)[1]
    return None


def _train(data: Path, settings: Training, out: Path, weights: Path | None) -> None:
    dataset = open_dataset(data)
    record: dict[str, Any] = {}
    with tqdm(
        train(dataset, settings, out, weights), total=settings.epochs, desc=out.name, unit="epoch"
    ) as bar:
        for record in bar:
            bar.set_postfix({key: record[key] for key in ("loss", "psnr_db") if key in record})
    if record.get("collapsed"):
        _say(
            f"warning: the network answers the same to every input ({record['psnr_db']} dB; all-black has "
            f"{record['zero_db']} dB): it has collapsed; use --loss balanced, or train for more epochs"
        )
    print(f"{out}: {record['epoch']} epochs, loss {record['loss']}, weights in {out / 'weights.safetensors'}")


def _progress(steps: Iterable[T], total: int, unit: str, out: Path) -> Iterator[T]:
    done = 0
    if (out / "dataset.yaml").is_file():
        done = total - len(open_dataset(out).missing())
    with tqdm(steps, total=total, initial=done, unit=f" {unit}", desc=out.name) as bar:
        yield from bar


def _print_summary(about: dict[str, str], found: dict[str, Any]) -> None:
    print(
        f"{about['weights']} ({about['paradigm']}) on {about['data']}, split {about['split']}: "
        f"{found['images']} pictures"
    )
    names = list(found["overall"])
    rows = [["", *names]]
    rows += [[name, *(_cell(v[key]) for key in names)] for name, v in found["characters"].items()]
    rows.append(["all", *(_cell(found["overall"][key]) for key in names)])
    rows += [
        [f"{n} image", *(_cell(v["overall"][key]) for key in names)] for n, v in found["baselines"].items()
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print("\n".join("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows))


def _cell(value: float | None) -> str:
    return "not available" if value is None else f"{value:.3f}"


def _overview() -> str:
    lines = [f"evnlos {__version__}: seeing moving objects around a corner with an event camera", ""]
    lines.append("usage: evnlos COMMAND [options]; evnlos COMMAND --help shows units and defaults")
    lines.append("")
    for verb, command in COMMANDS.items():
        lines.append(f"  {verb:<12} {(command.__doc__ or '').splitlines()[0]}")
    return "\n".join(lines)


def _say(text: str) -> None:
    print(text, file=sys.stderr)
