"""How a report was made: commands, settings, machine and versions.

- The commands that make a report again, and the files of settings that they read.
- How a report was made: machine and versions, the commands that make it again, all settings.
- What weights see, how they were trained, and how good they were found to be.
- Of published captures: are they the published ones?
"""

from __future__ import annotations

import hashlib
import html
import platform
import shlex
from collections.abc import Iterator
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from evnlos.config import read_yaml
from evnlos.data import Capture, Dataset, Sampling, read_capture
from evnlos.data.sampling import SOLVED
from evnlos.errors import DataError, printable
from evnlos.machine import Progress, Step, silent
from evnlos.models import GENERIC, Weights, describe_network
from evnlos.registry import __version__
from evnlos.report.tables import RunResult
from evnlos.setups import NamedSetup

_SETUP = "calibrated"  # the folder whose fixed pattern is taken from the frames
_MOST_NAMED = 8  # of more objects, the worst and the best are named
_LIVE = "live"  # what a simulation is called that is made while the network trains


class Commands:
    """What to type to make a report again.

    Args:
        dataset: What the runs were evaluated on.
        results: The runs.
        split: Name of the split.
        setup: The setup that was named; None where none was.
    """

    def __init__(
        self, dataset: Dataset, results: list[RunResult], split: str, setup: NamedSetup | None = None
    ) -> None:
        self._dataset, self._results, self._split, self._setup = dataset, results, split, setup
        self._here = dataset.folder.resolve().name
        self._names: dict[tuple[Any, ...], str] = {}

    def again(self) -> list[str]:
        """Return the commands from the captures to the report, each once; lines with # are remarks."""
        own = [r for r in self._results if not r.is_published]
        lines = [*self._data_here(), *(line for r in own for line in self._trainings(r))]
        words = ["evnlos", "report", *(r.name for r in self._results), "--data", self._here]
        words += ["--split", self._split]
        if self._setup is not None:
            words += ["--setup", self._setup.word]
        return list(dict.fromkeys([*lines, shlex.join([*words, "--out", "report.html"])]))

    def published(self) -> list[str]:
        """Return the commands behind pretrained weights, which the report does not need."""
        come = [r for r in self._results if r.is_published]
        return list(dict.fromkeys(line for r in come for line in self._trainings(r)))

    def files(self) -> dict[str, Any]:
        """Return the settings in each file that the commands read, as far as they are known."""
        known = {f"{out}.yaml": step.get("settings", {}) for r in self._results for out, step in self._steps(r)}
        if self._dataset.origin == "simulation":
            known[f"{self._here}.yaml"] = self._dataset.config
        return known

    def _data_here(self) -> list[str]:
        """Return what makes the dataset that the report was scored on."""
        if self._dataset.origin != "captures":
            return [shlex.join(["evnlos", "simulate", "--config", f"{self._here}.yaml", "--out", self._here])]
        split = self._dataset.split
        held = [word for key in ("validation", "test") for word in _flag(key, split.get(key, []))]
        calibrated = []
        if self._dataset.config.get("pattern"):
            shown = [name for key, names in split.items() if key != "test" for name in names]
            calibrated = [
                shlex.join(["evnlos", "calibrate", *(shown or self._dataset.objects()), "--out", _SETUP])
            ]
            held += ["--pattern", _SETUP]
        flags = _sampling_flags(self._dataset.sampling)
        return [*calibrated, _imported(self._dataset.objects(), self._here, [*held, *flags])]

    def _trainings(self, result: RunResult) -> Iterator[str]:
        """Yield what makes the data of each training behind a run, and trains."""
        before = None
        for out, step in self._steps(result):
            name = self._name_of(step["data"])
            if name == _LIVE:
                yield _unknown_settings(name, step["data"])
                source = ["--simulate", f"{name}.yaml"]
            else:
                yield from self._data_of(name, step["data"], result.sampling)
                source = ["--data", name]
            words = ["evnlos", "finetune" if before else "train", *source]
            words += ["--weights", before] if before else []
            yield shlex.join([*words, "--config", f"{out}.yaml", "--out", out])
            before = out

    def _steps(self, result: RunResult) -> list[tuple[str, dict[str, Any]]]:
        """Return each training behind a run with the folder that it is to go to; the last is the run's own.

        A run of the report that is behind another one keeps its name there: it is trained once.
        """
        found = []
        for k, step in enumerate(result.history, start=1):
            behind = (r.name for r in self._results if r.history == result.history[:k])
            own = result.name if k == len(result.history) else f"{result.name}-{k}"
            found.append((own if k == len(result.history) else next(behind, own), step))
        return found

    def _data_of(self, name: str, data: dict[str, Any], sampling: Sampling) -> Iterator[str]:
        """Yield what makes the data of a training, as its weights tell it; nothing for the report's own."""
        if name == self._here:
            return
        if data["origin"] == "captures":
            held = _flag("validation", data.get("validation", []))
            if data.get("train"):
                captures = [*data["train"], *data.get("validation", [])]
                yield _imported(captures, name, [*held, *_sampling_flags(sampling)])
            return
        yield _unknown_settings(name, data)
        yield shlex.join(["evnlos", "simulate", "--config", f"{name}.yaml", "--out", name])

    def _name_of(self, data: dict[str, Any]) -> str:
        """Return a folder for the data of a training: their name, with a number where others have it."""
        key = (data["origin"], data["name"], data.get("config_hash"), *data.get("train", []))
        if key not in self._names:
            taken = {*self._names.values()} | (set() if self._is_here(data) else {self._here})
            name, number = data["name"], 1
            while name in taken:
                number += 1
                name = f"{data['name']}-{number}"
            self._names[key] = name
        return self._names[key]

    def _is_here(self, data: dict[str, Any]) -> bool:
        """Return whether a training saw the dataset that the report was scored on."""
        same = (data["name"], data["origin"]) == (self._here, self._dataset.origin)
        known = data.get("config_hash") in (None, self._dataset.config_hash)
        return same and known and set(data.get("train", [])) <= set(self._dataset.objects())


def _imported(captures: list[str], out: str, more: list[str]) -> str:
    return shlex.join(["evnlos", "import", *captures, "--out", out, *more])


def _unknown_settings(name: str, data: dict[str, Any]) -> str:
    """Return a remark on a simulation of which the weights know objects and hash, not its settings."""
    count = len(data.get("train", [])) + len(data.get("validation", []))
    hashed = f" of hash {data['config_hash']}" if data.get("config_hash") else ""
    return f"# {name}.yaml: settings{hashed} of {count} simulated objects; weights keep no more of them"


def _flag(name: str, values: list[str]) -> list[str]:
    return [f"--{name}", *values] if values else []


def _sampling_flags(sampling: Sampling) -> list[str]:
    """Return the flags of what differs from the usual sampling."""
    usual, words = Sampling(), []
    for item in fields(Sampling):
        value = getattr(sampling, item.name)
        if value != getattr(usual, item.name):
            words += [f"--sampling.{item.name.replace('_', '-')}", str(value)]
    return words


_MOST_NAMES = 60  # of objects that are listed one by one; a simulation has hundreds
_PACKAGES = ("torch", "numpy", "numba", "h5py", "Pillow")


def provenance_section(
    dataset: Dataset, results: list[RunResult], split: str, setup: NamedSetup | None = None
) -> str:
    """Return the section of environment, commands and settings; `setup` is the one that was named."""
    commands = Commands(dataset, results, split, setup)
    parts = [
        f"<h2>How it was made</h2><p>{html.escape(environment())}</p>"
        "<p>To make it again, where the folders of the captures lie, with the files of settings below:</p>"
        f"{_pre(chr(10).join(commands.again()))}"
    ]
    if behind := commands.published():
        parts.append(
            "<p>Weights of these names are pretrained; the report needs no training of them. They were "
            f"trained so:</p>{_pre(chr(10).join(behind))}"
        )
    about: dict[str, Any] = {"dataset": {"name": dataset.folder.resolve().name, "settings": dataset.config}}
    about["runs"] = {r.name: [_without_settings(step) for step in r.history] for r in results}
    files = "".join(f"<h3>{html.escape(name)}</h3>{_pre(_yaml(one))}" for name, one in commands.files().items())
    return (
        "".join(parts) + f"<details><summary>Files of settings</summary>{files}</details>"
        f"<details><summary>Data and versions of every training</summary>{_pre(_yaml(about))}</details>"
    )


def _without_settings(step: dict[str, Any]) -> dict[str, Any]:
    """Return what a training was apart from its settings; of many objects their number and ends."""
    data = {key: _short(value) for key, value in step["data"].items()}
    return {key: value for key, value in step.items() if key != "settings"} | {"data": data}


def _short(value: Any) -> Any:
    if isinstance(value, list) and len(value) > _MOST_NAMES:
        return f"{len(value)}, {value[0]} to {value[-1]}"
    return value


def _yaml(value: Any) -> str:
    return yaml.safe_dump(value, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)


def _pre(text: str) -> str:
    return f"<pre>{html.escape(text)}</pre>"


def environment() -> str:
    """Return machine and versions in a line, without names of users, hosts or folders."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    parts = [f"evnlos {__version__}", f"Python {platform.python_version()}"]
    for name in _PACKAGES:
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    system = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads, {device}"
    return f"{', '.join(parts)}; {system}"


def about_weights(weights: Weights) -> dict[str, Any]:
    """Return what a user of the weights must know, as plain values."""
    state = weights.network.state_dict().values()
    return {
        **describe_network(weights.network),
        "sees_sequence": weights.network.sees_sequence,
        "parameters": sum(p.numel() for p in weights.network.parameters()),
        "numbers": sum(value.numel() for value in state),
        "history": weights.history,
        "confidence": weights.confidence is not None,
        "scores": weights.scores,
        "digest": weights.is_sealed,
    }


def weights_text(name: str, found: dict[str, Any]) -> str:
    """Return the description as lines for people."""
    sees = "whole sequences" if found["sees_sequence"] else "one time step at a time"
    sampling = found["sampling"]
    is_solved = sampling.get("surface") in SOLVED
    through = f", through the light path of {sampling.get('setup') or 'each setup'}" if is_solved else ""
    lines = [
        f"{name}: {found['modality']}, {found['network']['kind']}: {sees}; {found['parameters']:,} trained "
        f"parameters, {found['numbers'] - found['parameters']:,} numbers in closed form",
        f"  maps {sampling.get('width')} x {sampling.get('height')}, pitch {sampling.get('pitch_m')} m, "
        f"surface {sampling.get('surface')}, tau {sampling.get('tau_s')} s{through}",
    ]
    if name.startswith(f"{GENERIC}-"):
        lines.append(
            "  layers to begin a training with, trained behind many walls: simulate your setup and give "
            "`evnlos finetune --refit-embedding`; not for reconstructions as they are"
        )
        return "\n".join(lines)
    for number, step in enumerate(found["history"], start=1):
        data, plan = step.get("data", {}), step.get("settings", {})
        lines.append(
            f"  {number}. {data.get('origin')} {data.get('name')}: {len(data.get('train', []))} objects, "
            f"{plan.get('epochs')} epochs at {plan.get('learning_rate')}, seed {plan.get('seed')}"
        )
    if not found["digest"]:
        lines.append("  without a digest, as earlier versions wrote them: damage to the numbers goes unseen")
    if found["scores"]:
        lines.append(_score_line(found["scores"]))
    return "\n".join(map(printable, lines))


def _score_line(scores: dict[str, Any]) -> str:
    """Return one line on how good the weights were found to be; a stranger's file may say anything there."""
    try:
        named, between = list(scores["psnr_db"].items()), ", "
        if len(named) > _MOST_NAMED:
            ranked = sorted(named, key=lambda pair: pair[1])
            named, between = [ranked[0], ranked[-1]], " to "
        each = between.join(f"{name} {value:.2f}" for name, value in named)
        return f"  {scores['overall']['psnr_db']:.2f} dB on {scores['data']}, {scores['split']}: {each}"
    except (KeyError, TypeError, ValueError, AttributeError):
        return "  its scores are not what this version writes"


def lab_command(characters: str, seed: int) -> str:
    """Return what renders the usual laboratory's captures again, in the folder `captures`.

    Args:
        characters: What its targets show.
        seed: Its seed.

    Example:
        >>> lab_command("ALT", 3)
        'evnlos lab --out captures --seed 3 --glyphs.characters ALT'
    """
    words = ["evnlos", "lab", "--out", "captures", "--seed", str(seed), "--glyphs.characters", characters]
    return shlex.join(words)


PUBLISHED = Path(__file__).parents[1] / "data" / "published_captures.yaml"
"""For each published set: character -> SHA-256 of its capture's content, and its number of events."""
_ROUNDING = 0.01  # share of the events by which processors and versions of libraries may differ


def content_digest(capture: Capture) -> str:
    """Return the SHA-256 of what a capture holds: events, frames and their times, and the target's mask.

    How the files are packed has no part in it, nor has `capture.yaml`.
    """
    found, events = hashlib.sha256(), capture.events
    mask = b"" if capture.target is None else np.round(capture.target.mask * 255).astype(np.uint8)
    for values in (
        np.asarray(events.t_us, "<i8"),
        np.asarray(events.x, "<u2"),
        np.asarray(events.y, "<u2"),
        np.asarray(events.p, np.uint8),
        np.asarray(capture.frame_times_us, "<i8"),
        capture.frames,
        mask,
    ):
        found.update(np.ascontiguousarray(values).tobytes() if isinstance(values, np.ndarray) else values)
    return found.hexdigest()


def compare_published(name: str, folders: list[Path], progress: Progress = silent) -> dict[str, str]:
    """Compare captures with the published ones, and return what differs, a line for each capture that does.

    Args:
        name: Set, as for `published_lab`.
        folders: Capture folders of the set.
        progress: Called as each is read.

    Raises:
        DataError: A capture is another one: its number of events is more than a hundredth off.
    """
    listed, differing = read_yaml(PUBLISHED)[name], dict[str, str]()
    for done, folder in enumerate(folders):
        progress(Step(f"compare {name}", done, len(folders), "captures", folder))
        digest, events = listed[folder.name.removeprefix(f"{name}_")]
        capture = read_capture(folder)
        count = len(capture.events)
        if abs(count - events) > _ROUNDING * events:
            raise DataError(
                f"{folder} holds {count:,} events, the published one {events:,}; it is another capture: "
                "delete it and render it again"
            )
        if content_digest(capture) != digest:
            differing[folder.name] = f"{count:,} events, published {events:,}"
    progress(Step(f"compare {name}", len(folders), len(folders), "captures"))
    return differing
