"""Commands on networks: `train`, `finetune`, `evaluate`, `weights`, `app`.

- `evnlos train`: dataset or simulation in, run out.
- `evnlos finetune`: run and dataset in, run out.
- `evnlos evaluate`: weights and dataset in, scores beside their baselines out.
- `evnlos weights`: what a weights file is, where it comes from, and a smaller copy to hand on.
- `evnlos app`: a page to play with, and what networks make of it.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
import tyro

from evnlos.analysis import BASELINES, CHECKS, confusion
from evnlos.app.serve import Server, serve
from evnlos.cli.parsing import check_there, say, told_first
from evnlos.cli.recordings import Flat, Presets, result
from evnlos.config import load_yaml, read_yaml, to_dict
from evnlos.data import Dataset, Simulation, live_dataset, open_dataset
from evnlos.errors import ConfigError, DataError, EvnlosError
from evnlos.machine import ProgressBars
from evnlos.models import (
    find_weights,
    load_weights,
    published,
    save_weights,
)
from evnlos.models.confidence import COVERAGE
from evnlos.training import (
    Training,
    alternatives,
    choose_and_finetune,
    finetuning,
    paper_finetuning,
    paper_pretraining,
    read_choice,
    train,
)
from evnlos.types import OutFolder


@dataclass(frozen=True)
class TrainCommand:
    """Train a network from random weights: pre-training on a simulation, or end to end (E2E) on captures."""

    PRESETS: ClassVar[Presets[Training]] = {"default": Training, "paper": paper_pretraining}

    out: OutFolder
    """Folder of the run; new, or begun with the same settings."""
    data: Path | None = None
    """Folder of the dataset."""
    simulate: Path | None = None
    """YAML file with the settings of a simulation, instead of --data: samples are made while the network
    trains, other ones in each epoch, and nothing is stored."""
    workers: int = 1
    """Processes that simulate beside the training, for --simulate; 0 = one for each core.
    A GPU wants several."""
    captures: Path | None = None
    """Imported captures with known targets: newly drawn sequences (--drawn) err as these do, in place of those
    of --data."""
    force: bool = False
    """Begin --simulate although the machine's memory will hardly do."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 200 epochs, step sizes and loss."""
    config: Path | None = None
    """YAML file with settings."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Training] = field(default_factory=Training)

    def check_names(self) -> None:
        """Refuse settings of a simulation that are not there."""
        if self.simulate is not None:
            check_there(read_yaml, self.simulate)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        if (self.data is None) == (self.simulate is None):
            raise ConfigError("give --data DATASET or --simulate SETTINGS.yaml, one of the two")
        if self.data is not None:
            known = None if self.captures is None else open_dataset(self.captures)
            fit(open_dataset(self.data), self.settings, self.out, None, self.json, known)
        elif self.captures is not None:
            raise ConfigError("--captures shows what drawn sequences err by, and they need --data DATASET")
        else:
            assert self.simulate is not None
            settings = load_yaml(Simulation, self.simulate)
            fit(live_dataset(settings, self.workers, self.force), self.settings, self.out, None, self.json)


def fit(
    dataset: Dataset,
    settings: Training,
    out: Path,
    weights: Path | None,
    as_json: bool,
    captures: Dataset | None = None,
) -> None:
    """Train with a progress bar over the epochs, and warn of a network that ignores its input.

    Of several processes that `torchrun` started, only the first speaks.
    """
    quiet = int(os.environ.get("RANK", "0")) > 0

    def warn() -> None:
        if not quiet and (misfit := dataset.config.get("setup", {}).get("misfit")):
            say(f"warning: the calibration of the simulation's setup warns: {misfit}")

    with ProgressBars(quiet) as progress:
        trained = train(dataset, settings, out, weights, told_first(warn, progress), captures)
    if quiet:
        return
    record = trained.records[-1]
    if record.get("collapsed"):
        say(
            f"warning: the network answers the same to every input ({record['psnr_db']} dB; all-black has "
            f"{record['zero_db']} dB): it has collapsed; use --loss normalized_bce_mse_ssim, or train for "
            "more epochs"
        )
    text = f"{out}: {record['epoch']} epochs, loss {record['loss']}, weights in {trained.file}"
    result(as_json, {"run": str(out), "weights": str(trained.file), **record}, text)


@dataclass(frozen=True)
class FinetuneCommand:
    """Fine-tune weights on few captures (EPNP): modality and network are those of the weights.

    After a simulation that was fitted to the setup, less is better: --epochs 3 --learning-rate 2e-4
    --keep-normalization. With --choose captures that are held out decide, and fine-tuning cannot lose much.
    """

    PRESETS: ClassVar[Presets[Training]] = {"default": finetuning, "paper": paper_finetuning}

    weights: Path
    """Weights file, or the run to start from."""
    data: Path
    """Folder of the dataset of captures; with --refit-embedding it may be a simulation of another setup."""
    out: OutFolder
    """Folder of the run; new, or begun with the same settings."""
    captures: Path | None = None
    """Imported captures with known targets: newly drawn sequences (--drawn) err as these do, in place of those
    of --data."""
    preset: str = "default"
    """`default`, or `paper` for the paper's 100 epochs at 1e-5 with its loss."""
    config: Path | None = None
    """YAML file with settings."""
    choose: bool = False
    """Try these settings, a fifth and five times the learning rate, keeping the normalization and not, three
    times the epochs, the embedding fitted again and the first part of the network kept, on two halves of the
    training captures in turn; take the best, part of the way, or nothing. OUT-trials keeps them till then."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Training] = field(default_factory=finetuning)

    def run(self) -> None:
        """Train, with a progress bar over the epochs."""
        dataset = open_dataset(self.data)
        known = None if self.captures is None else open_dataset(self.captures)
        if not self.choose:
            fit(dataset, self.settings, self.out, self.weights, self.json, known)
            return
        if known is not None:
            raise ConfigError("--choose tells by captures held out of --data; leave --captures away")
        trials = self.out.with_name(f"{self.out.name}-trials")
        candidates = alternatives(self.settings, load_weights(self.weights).network)
        try:
            with ProgressBars() as progress:
                trained = choose_and_finetune(dataset, candidates, self.out, self.weights, progress=progress)
        except EvnlosError as error:
            if any(trials.glob("*/weights.safetensors")):
                cure = f"{trials} keeps what is trained: run the command again to go on, or delete it"
                raise type(error)(f"{error}; {cure}") from None
            shutil.rmtree(trials, ignore_errors=True)
            raise
        if (choice := read_choice(self.out)) is not None:
            about = {"run": str(self.out), "weights": str(trained.file), **asdict(choice)}
            result(self.json, about, f"{self.out}: {choice.sentence()}; weights in {trained.file}")


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
    setup: Path | None = None
    """The setup of the data (folder of `calibrate`, settings file, a room's name): how much of the frames the
    images explain. By default the setup that the weights were trained for, where it is known."""
    positions: tuple[int, ...] = ()
    """Numbers of positions, e.g. 1 2 5 10 20 40: also how the image of a sequence network grows with them."""
    so_far: bool = False
    """Also score the image at each position that a sequence network makes of all up to it, and of nothing
    later; --positions names those that are shown. With events of a dataset of --sampling.surface so-far."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> None:
        """Evaluate and print."""
        from evnlos.analysis import (
            available_lpips,
            curve_over_positions,
            curve_so_far,
            evaluate,
            load_lpips,
            load_model,
        )
        from evnlos.report import refuse_seen, seen_in_training
        from evnlos.setups import lit_setup

        dataset, model = open_dataset(self.data), load_model(self.weights)
        weights = model.weights
        split = self.split or ("test" if dataset.split.get("test") else "all")
        refuse_seen(weights.history, dataset, split)
        metric = load_lpips(self.vgg, self.lpips_heads) if self.vgg or self.lpips_heads else available_lpips()
        known = lit_setup(self.setup) if self.setup else model.known_setup()
        curve = []
        with ProgressBars() as progress:
            if self.so_far:
                curve = curve_so_far(weights, dataset, split, progress)
            elif self.positions:
                curve = curve_over_positions(weights, dataset, split, self.positions, progress)
            found = evaluate(weights, dataset, split, metric, known, progress).summary()
        about = {
            "weights": str(self.weights),
            "modality": weights.modality.name,
            "data": str(self.data),
            "split": split,
        }
        seen = seen_in_training(weights.history, dataset, split)
        if self.json:
            key = "so_far" if self.so_far else "positions"
            points = {key: [to_dict(point) for point in curve]} if curve else {}
            print(json.dumps(about | {"seen_in_training": seen} | found | points))
        else:
            _print_summary(about, found)
            if self.so_far:
                shown = [p for p in curve if not self.positions or p.positions in self.positions]
                print("| positions so far | PSNR at the last, dB |\n|---|---|")
                print("\n".join(f"| {p.positions} | {p.psnr_db:.2f} |" for p in shown))
                print(f"| mean of all | {sum(p.psnr_db for p in curve) / len(curve):.2f} |")
            elif curve:
                print("| positions | choices of them | PSNR, dB |\n|---|---|---|")
                print("\n".join(f"| {p.positions} | {p.subsets} | {p.psnr_db:.2f} |" for p in curve))
            if seen:
                say(f"note: training saw {', '.join(seen)}; scores on them say nothing about unseen objects")


def _print_summary(about: dict[str, str], found: dict[str, Any]) -> None:
    print(
        f"{about['weights']} ({about['modality']}) on {about['data']}, split {about['split']}: "
        f"{found['images']} images"
    )
    names = list(found["overall"])
    rows = [["", *names]]
    rows += [[name, *(_cell(v[key]) for key in names)] for name, v in found["characters"].items()]
    rows.append(["all", *(_cell(found["overall"][key]) for key in names)])
    rows += [
        [BASELINES[n], *(_cell(v["overall"][key]) for key in names)] for n, v in found["baselines"].items()
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print("\n".join("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows))
    for name, share in found["checks"].items():
        print(f"{CHECKS[name]}: {share:.0%}")
    if words := confusion([found["read_as"]]):
        print(f"taken for another character: {words}")
    if confidence_checks := found["confidence"]:
        said = ("support", "skill", "measured", "coverage", "width")
        mean = {key: sum(one[key] for one in confidence_checks) / len(confidence_checks) for key in said}
        print(
            f"confidence: support {mean['support']:.0%} said, {mean['skill']:.0%} found; "
            f"{mean['measured']:.0%} of {len(confidence_checks)} sequences said to be measured; intervals of "
            f"{COVERAGE:.0%} hold {mean['coverage']:.0%} of the pixels, mean length {mean['width']:.2f}"
        )


def _cell(value: float | None) -> str:
    return "not available" if value is None else f"{value:.3f}"


@dataclass(frozen=True)
class WeightsCommand:
    """Show what weights see, how they were trained and on what, or list the pretrained ones."""

    weights: Annotated[Path | None, tyro.conf.Positional] = None
    """Weights file, run's folder, or name of published weights; none lists the published ones."""
    half: Path | None = None
    """File for a copy in half precision, half as large; it must not exist."""
    rank: int | None = None
    """Components of the linear embedding that the copy keeps, the strongest; none keeps all."""
    scores: Path | None = None
    """What `evnlos evaluate --json` printed of these weights, to be kept in the copy."""
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse weights that are not there."""
        if self.weights is not None:
            check_there(find_weights, self.weights)

    def run(self) -> None:
        """Read the weights, print, and write the copy where one is requested."""
        from evnlos.report.provenance import about_weights, weights_text

        if self.half is None and (self.rank is not None or self.scores is not None):
            raise ConfigError("--rank and --scores are of a copy; give its file with --half")
        if self.weights is None:
            if self.half is not None:
                raise ConfigError("--half copies one file of weights; say which")
            self._list()
            return
        loaded = load_weights(self.weights)
        if self.half is not None:
            if self.half.exists():
                raise DataError(f"{self.half} exists; give --half another name")
            if self.rank is not None:
                loaded = replace(loaded, network=loaded.network.reduced(self.rank))
            loaded = replace(loaded, scores=_scores(self.scores) if self.scores else loaded.scores)
            save_weights(self.half, loaded, torch.float16)
        found = about_weights(loaded)
        print(json.dumps(found) if self.json else weights_text(str(self.weights), found))
        if self.half is not None and not self.json:
            print(f"{self.half}: half precision, {self.half.stat().st_size / 1e6:.1f} MB")

    def _list(self) -> None:
        from evnlos.report.provenance import about_weights, weights_text

        found = {name: about_weights(load_weights(path)) for name, path in published().items()}
        if self.json:
            print(json.dumps(found))
            return
        print(
            "\n".join(weights_text(name, about) for name, about in found.items()) or "no weights are published"
        )


def _scores(path: Path) -> dict[str, Any]:
    """Return what a reader of weights wants of an evaluation: on what, how good, and the baselines."""
    try:
        found = json.loads(path.read_text())
        baselines = {name: one["overall"] for name, one in found["baselines"].items()}
        objects = {one["character"]: one["psnr_db"] for one in found["characters"].values()}
        kept = {name: found[name] for name in ("data", "split", "images", "overall", "checks")}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} is not what `evnlos evaluate --json` prints: {error!r}"[:300]) from None
    return kept | {"data": Path(kept["data"]).name, "psnr_db": objects, "baselines": baselines}


@dataclass(frozen=True)
class AppCommand:
    """A page to play with: hide something, choose wall and cameras, watch what can be seen; uploads too."""

    weights: tuple[Path, ...] = ()
    """Weights files, or folders of runs, that reconstruct beside the classical solvers; none takes those of
    the package."""
    server: Flat[Server] = field(default_factory=Server)

    def run(self) -> None:
        """Run the page until it is interrupted."""
        with ProgressBars() as progress:
            serve(self.server, self.weights, lambda at: print(f"{at}  (Ctrl+C stops it)", flush=True), progress)
        say("stopped")  # while compiled code may be at work still, which the interpreter would tear apart
        sys.stdout.flush()
        os._exit(0)
