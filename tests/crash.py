"""Kills, ends, interrupts and starves commands at random instants, and looks at what is left.

    python tests/crash.py --instants 50 --seed 0     # a line an instant; exit code 1 where something was lost

Each instant takes one command (simulate with one and two workers, train, import, convert, calibrate, an
experiment that imports, simulates, trains and scores, report), runs it until the instant, and ends it by
SIGKILL, SIGTERM, Ctrl-C or a full disk (a small tmpfs as root, else a limit on the size of files). Then: no
process may live, nothing but whole files may stand under their final names, and the error is one line. The
command is run again: it must end well, leave no unfinished file, and give the bytes of a run that nobody
disturbed (of `train` without the seconds in metrics.jsonl).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from watching import alive

EVNLOS = [sys.executable, "-m", "evnlos"]
KINDS = ("kill", "terminate", "interrupt", "full disk")
_SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "interrupt": signal.SIGINT}
_END_S = 30.0  # in which all processes of a command that was hit must be gone


@dataclass(frozen=True)
class Command:
    """A command whose result lies in a folder of its own; OUT stands for what it is to write there."""

    name: str
    words: tuple[str, ...]
    result: str = "out"
    given: Path | None = None
    """What lies in its folder before it begins."""

    def prepare(self, folder: Path) -> None:
        """Put into a folder what is to be there."""
        if self.given is not None:
            shutil.copytree(self.given, folder / self.result)

    def line(self, folder: Path) -> list[str]:
        """Return the command line that writes into a folder."""
        return [*EVNLOS, *(word.replace("OUT", str(folder / self.result)) for word in self.words)]


def contents(folder: Path) -> dict[str, bytes]:
    """Return what is under final names in a folder, without what differs from run to run by design."""
    found, place = {}, str(folder.resolve()).encode()
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and ".part" not in name and not path.name.startswith(".lock"):
            # a calibration's settings name the files beside them by their whole paths
            found[name] = _timeless(path).replace(place, b"FOLDER")
    return found


def _timeless(path: Path) -> bytes:
    content = path.read_bytes()
    if path.name == "metrics.jsonl":
        lines = [{**json.loads(line), "seconds": 0} for line in content.splitlines()]
        return json.dumps(lines).encode()
    return content


def unfinished(folder: Path) -> list[str]:
    """Return the names of unfinished files in a folder."""
    return [
        str(path.relative_to(folder)) for path in folder.rglob("*") if path.name.endswith((".part", ".tmp"))
    ]


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[bool]:
    """Put a disk of so many bytes at a folder; yield whether that was possible."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        yield False
        return
    try:
        yield True
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@dataclass(frozen=True)
class Outcome:
    """What one instant did; `faults` is empty where all is well."""

    command: str
    kind: str
    at: str
    code: int
    faults: list[str]


class Crashes:
    """Commands on small inputs in a folder, their undisturbed results, and how long they took."""

    def __init__(self, commands: list[Command], folder: Path) -> None:
        self.commands, self.folder = commands, folder
        self.whole: dict[str, dict[str, bytes]] = {}
        self.seconds: dict[str, float] = {}

    def undisturbed(self, command: Command) -> dict[str, bytes]:
        """Return what a command gives when nobody disturbs it."""
        if command.name not in self.whole:
            place = self.folder / "whole" / command.name
            place.mkdir(parents=True)
            command.prepare(place)
            began = time.monotonic()
            subprocess.run(command.line(place), check=True, capture_output=True)
            self.seconds[command.name] = time.monotonic() - began
            self.whole[command.name] = contents(place)
        return self.whole[command.name]

    def strike(self, command: Command, kind: str, share: float) -> Outcome:
        """Disturb a command when that share of its time or of its bytes is over; run it again; judge both."""
        whole = self.undisturbed(command)
        place = Path(tempfile.mkdtemp(dir=self.folder))
        size = sum(map(len, whole.values()))
        faults: list[str] = []
        if kind == "full disk":
            least = 0 if command.given is None else 2 * sum(map(len, contents(command.given).values()))
            limit = max(8192, least, int(size * share) // 4096 * 4096)
            with small_disk(place, limit) as is_small:
                command.prepare(place)
                code = self._starved(command, place, None if is_small else limit, faults)
                at = f"{limit} bytes" + ("" if is_small else " a file")
                if is_small:
                    big = ["mount", "-o", f"remount,size={64 * size + (1 << 26)}", str(place)]
                    subprocess.run(big, check=True)
                self._judge(command, place, whole, faults)
        else:
            command.prepare(place)
            at = f"{share * self.seconds[command.name]:.2f} s"
            code = self._hit(command, place, kind, share * self.seconds[command.name], faults)
            self._judge(command, place, whole, faults)
        shutil.rmtree(place)
        return Outcome(command.name, kind, at, code, faults)

    def _starved(self, command: Command, place: Path, limit: int | None, faults: list[str]) -> int:
        def bound() -> None:
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        run = subprocess.run(command.line(place), capture_output=True, text=True, preexec_fn=bound, timeout=600)
        if run.returncode not in (0, 2):
            faults.append(f"exit code {run.returncode}: {run.stderr[-300:]}")
        self._look(run.stderr, faults)
        faults += [f"left {name}" for name in unfinished(place)]
        return run.returncode

    def _hit(self, command: Command, place: Path, kind: str, after_s: float, faults: list[str]) -> int:
        def listens() -> None:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # a suite in the background of a shell ignores it

        errors = (self.folder / "errors").open("w+")
        process = subprocess.Popen(
            command.line(place),
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
            preexec_fn=listens,
        )
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            if kind == "interrupt":
                os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to the whole group
            else:
                process.send_signal(_SIGNALS[kind])
        until = time.monotonic() + _END_S
        while alive(process.pid) and time.monotonic() < until:
            time.sleep(0.05)
        for left in alive(process.pid):
            faults.append(f"process {left} lives on")
            os.kill(left, signal.SIGKILL)
        code = process.wait(10)
        errors.seek(0)
        if kind != "kill":
            self._look(errors.read(), faults)
            faults += [f"left {name}" for name in unfinished(place)]
            began = -_SIGNALS[kind]  # before Python listens, the system ends it
            if code not in (0, began, 128 + _SIGNALS[kind]):
                faults.append(f"exit code {code}")
        errors.close()
        return code

    def _look(self, said: str, faults: list[str]) -> None:
        if "Traceback" in said or "Segmentation" in said:
            faults.append(f"said: {said[-1500:]}")

    def _judge(self, command: Command, place: Path, whole: dict[str, bytes], faults: list[str]) -> None:
        for name, content in contents(place).items():
            is_growing = name.endswith(("metrics.jsonl", "checkpoint.safetensors"))
            if not is_growing and whole.get(name) != content:
                faults.append(f"{name} is there and is not what it should be")
        again = subprocess.run(command.line(place), capture_output=True, text=True, timeout=600)
        if again.returncode:
            faults.append(f"again: exit code {again.returncode}: {again.stderr[-300:]}")
            return
        found = contents(place)
        if found != whole:
            names = [name for name in found.keys() | whole.keys() if found.get(name) != whole.get(name)]
            faults.append(f"again: other bytes in {', '.join(sorted(names)[:5])}")
        faults += [f"again: left {name}" for name in unfinished(place)]


def quick_commands(folder: Path) -> list[Command]:
    """Return a command that takes little more than its start."""
    from evnlos import Events, write_events

    draw, count = np.random.default_rng(0), 300_000
    events = Events(
        np.sort(draw.integers(0, 10**7, count)),
        draw.integers(0, 640, count),
        draw.integers(0, 480, count),
        draw.integers(0, 2, count).astype(bool),
        width=640,
        height=480,
    )
    write_events(folder / "in.raw", events)
    source = str(folder / "in.raw")
    return [
        Command(f"convert {kind}", ("convert", source, "--out", "OUT", "--force"), f"a{kind}")
        for kind in (".h5", ".aedat4", ".csv")
    ]


def all_commands(folder: Path) -> list[Command]:
    """Return all commands, on inputs that are made in a folder."""
    from evnlos.config import save_yaml
    from evnlos.data import FixedPattern, Sampling, SensorSize, Simulation, save_pattern
    from evnlos.data.lab import Lab, render_captures
    from evnlos.scene import FontGlyphs, HandwritingGlyphs
    from evnlos.setups import PaperSetup, RadiometricSetup

    sensor = SensorSize(48, 72)
    simulation = Simulation(
        glyphs=HandwritingGlyphs(characters="ABCEFHLT", writers=2),
        setup=PaperSetup(tpsf_length_m=0.004, pitch_m=1e-3, gain=2.0, field_of_view_m=0.3, sensor=sensor),
        sampling=Sampling(height=32, width=48, pitch_m=0.005, scored_rows=24),
        positions=8,
        validation=0.2,
        held_out="T",
        vary={"setup.gain": (1.5, 2.0)},
    )
    save_yaml(simulation, folder / "tiny.yaml")
    lab = Lab(
        glyphs=FontGlyphs(family="kalam", characters="ALT4"),
        setup=RadiometricSetup(cell_m=0.01, gain=0.7, ambient=0.06, sensor=sensor),
        frame_rate_hz=1.0,
    )
    captures = [str(path) for path in render_captures(lab, folder / "lab")]
    settings, data, run = (str(folder / name) for name in ("tiny.yaml", "data", "run"))
    small = ("--network.width", "8", "--network.depth", "2", "--network.shuffle", "1", "--precision", "float32")
    train = ("train", "--data", data, "--epochs", "3", *small, "--out")
    subprocess.run([*EVNLOS, "simulate", "--config", settings, "--out", data], check=True, capture_output=True)
    subprocess.run([*EVNLOS, *train, run], check=True, capture_output=True)
    given = folder / "given"
    (given / "setups" / "lab").mkdir(parents=True)
    setup = replace(
        simulation, setup=lab.setup, glyphs=HandwritingGlyphs(characters="AB"), held_out="", vary={}
    )
    for name in ("setup.yaml", "training.yaml"):
        save_yaml(replace(setup, validation=0.0), given / "setups" / "lab" / name)
    flat = np.ones((sensor.height, sensor.width), np.float32)
    save_pattern(FixedPattern(flat, 0 * flat), given / "setups" / "lab" / "pattern.safetensors")
    study = ("experiment", "captures", "--captures", str(folder / "lab"), "--captures-of", "lab", "--test", "4")
    study += ("--arms", "E2E", "EPNP", "--seeds", "0", "--modalities", "frame", "--workers", "1")
    study += ("--e2e-epochs", "1", "--pretrain-epochs", "1", "--finetune-epochs", "1", "--writers", "1")
    maps = ("--sampling.height", "32", "--sampling.width", "48", "--sampling.scored-rows", "24")
    return [
        Command("simulate 1", ("simulate", "--config", settings, "--workers", "1", "--out", "OUT")),
        Command("simulate 2", ("simulate", "--config", settings, "--workers", "2", "--out", "OUT")),
        Command("train", (*train, "OUT")),
        Command("import", ("import", *captures, *maps, "--test", "4", "--out", "OUT")),
        *quick_commands(folder),
        Command(
            "calibrate",
            (
                "calibrate",
                *captures,
                "--holdout",
                "4",
                "--no-events",
                "--columns",
                "16",
                "--force",
                "--out",
                "OUT",
            ),
        ),
        Command("experiment", (*study, "--out", "OUT"), given=given),
        Command("report", ("report", run, "--data", data, "--force", "--out", "OUT"), "out.html"),
    ]


def main() -> None:
    """Strike at random instants and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--instants", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="commands whose name begins so")
    given = parser.parse_args()
    draw, bad = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory(prefix="evnlos-crash-") as folder:
        commands = [one for one in all_commands(Path(folder)) if one.name.startswith(given.only)]
        crashes = Crashes(commands, Path(folder))
        for number in range(given.instants):
            command = commands[number % len(commands)]
            kind, share = draw.choice(KINDS), draw.uniform(0.05, 1.0)
            found = crashes.strike(command, kind, share)
            bad += bool(found.faults)
            print(
                f"{number:3d}  {found.command:16}{found.kind:10}{found.at:>16}  code {found.code:4d}  ", end=""
            )
            print("; ".join(found.faults) or "well", flush=True)
    print(f"{given.instants - bad} of {given.instants} ended well")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
