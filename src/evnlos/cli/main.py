"""The verbs, and from the words of a command line to a command that runs; bad input is a line and exit code 2.

- `evnlos doctor`: is the installation whole?
"""

from __future__ import annotations

import difflib
import importlib
import json
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass, replace
from importlib.resources import files
from itertools import product
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO, cast

from evnlos import doctor
from evnlos.cli.parsing import (
    FLAG,
    LEVELS,
    LOG,
    PROGRESS_FLAG,
    QUIET_FLAG,
    VARIABLE,
    UnfitWordsError,
    check_names,
    check_out,
    flag_value,
    listen,
    parse,
    todays_words,
)
from evnlos.errors import ConfigError, EvnlosError, PlainOutput, UnknownNameError, for_command_line, printable
from evnlos.machine import PROGRESS, SHOWN, sleep_while_waiting
from evnlos.registry import Kinded, __version__, kind_of

# Nothing that may be missing is imported before a command is: help, version and doctor work in any case.

VERBS: dict[str, str] = {
    "demo": "experiment.DemoCommand",
    "simulate": "datasets.SimulateCommand",
    "capture": "datasets.CaptureCommand",
    "import": "datasets.ImportCommand",
    "verify": "about.VerifyCommand",
    "lab": "datasets.LabCommand",
    "calibrate": "calibration.CalibrateCommand",
    "scan": "calibration.ScanCommand",
    "pixel": "calibration.PixelCommand",
    "train": "learning.TrainCommand",
    "finetune": "learning.FinetuneCommand",
    "weights": "learning.WeightsCommand",
    "evaluate": "learning.EvaluateCommand",
    "experiment": "experiment.ExperimentCommand",
    "identify": "results.IdentifyCommand",
    "reconstruct": "results.ReconstructCommand",
    "live": "experiment.LiveCommand",
    "invert": "invert.InvertCommand",
    "track": "results.TrackCommand",
    "corner": "corner.CornerCommand",
    "report": "results.ReportCommand",
    "events": "events.EventsCommand",
    "info": "recordings.InfoCommand",
    "convert": "recordings.ConvertCommand",
    "clean": "events.CleanCommand",
    "preview": "recordings.PreviewCommand",
    "app": "learning.AppCommand",
    "fetch": "about.FetchCommand",
    "cite": "about.CiteCommand",
    "doctor": "main.DoctorCommand",
    "completion": "about.CompletionCommand",
}
"""The command of each verb, as module in `evnlos.cli` and class. A class whose settings have presets names them
in `PRESETS`; one whose settings have a setup says in `with_setup` where it goes."""
_BESIDE = {"track": (".json",), "invert": (".npz",), "report": (".csv",), "scan": (".png",)}
"""Endings of what a command writes beside its `out`, under the same name."""
_GO_ON = ("simulate", "lab", "import", "train", "finetune", "experiment", "demo", "fetch")  # what was begun


def main(argv: list[str] | None = None) -> None:
    """Run a command; bad input ends with one line on stderr and exit code 2."""
    if argv is None:  # a process of its own, not a call from another program
        sleep_while_waiting()
    try:
        arguments = listen(sys.argv[1:] if argv is None else argv)
    except ConfigError as error:
        print(f"evnlos: error: {error}", file=sys.stderr)
        sys.exit(2)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return
    if arguments[0] == "--version":
        print(__version__)
        return
    verb, rest = arguments[0], todays_words(arguments[0], arguments[1:])
    wishes = list[int]()  # signals that asked for the end
    try:
        with _terminable(wishes):
            if verb not in VERBS:
                raise ConfigError(_unknown(verb))
            with _ended_at_once(verb) if argv is None else nullcontext():
                command = _answer_at_once(verb, rest) or _command(verb, rest)
            LOG.debug("%s", command)
            with redirect_stdout(cast(TextIO, PlainOutput(sys.stdout))):
                command.run()
            sys.stdout.flush()  # a full disk behind it is told while the exit code can say so
    except BrokenPipeError:
        sys.exit(1)
    except KeyboardInterrupt as stop:
        _end(verb, signal.SIGTERM if isinstance(stop, _Terminated) else signal.SIGINT)
    except Exception as error:
        LOG.debug("where the error came from", exc_info=True)
        if wishes:  # a library that was interrupted while it was imported says so in its own way
            _end(verb, wishes[-1])
        if isinstance(error, EvnlosError):
            print(f"evnlos {verb}: error: {for_command_line(error)}", file=sys.stderr)
            sys.exit(2)
        fault = doctor.fault_behind(error)
        if fault is not None:
            text = f"{fault.name} is {fault.found}; {fault.cure} (evnlos doctor looks at all that is needed)"
        elif isinstance(error, MemoryError):
            text = "the memory that this process may use is not enough; give it less to do at a time"
        elif isinstance(error, OSError):
            text = f"{error}; nothing half-written was left"
        else:
            raise
        print(f"evnlos {verb}: error: {printable(text)}", file=sys.stderr)
        sys.exit(2)


def _end(verb: str, number: int) -> NoReturn:
    """End as a signal wished, with one line and the exit code that shells give such an end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # once is enough
    print(_farewell(verb, number), file=sys.stderr)
    sys.exit(128 + number)


def _farewell(verb: str, number: int) -> str:
    how = "terminated" if number == signal.SIGTERM else "interrupted"
    return f"evnlos {verb}: {how}; run the same command again{' to go on' if verb in _GO_ON else ''}"


@contextmanager
def _ended_at_once(verb: str) -> Iterator[None]:
    """End the process at Ctrl-C and SIGTERM without unwinding, while a command is imported and parsed.

    Nothing is begun then. An exception would pass through the start of libraries in C++, some of which end the
    process with a core dump where Python code that they call raises.
    """

    def end(number: int, _: FrameType | None) -> None:
        os.write(2, f"{_farewell(verb, number)}\n".encode())
        os._exit(128 + number)

    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
    if threading.current_thread() is not threading.main_thread() or None in before.values():
        yield
        return
    handlers = {one: how for one, how in before.items() if how is not signal.SIG_IGN}
    for one in handlers:
        signal.signal(one, end)
    try:
        yield
    finally:
        for one, how in handlers.items():
            signal.signal(one, how)


class _Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM, and does so as if by Ctrl-C."""


@contextmanager
def _terminable(wishes: list[int]) -> Iterator[None]:
    """Raise `KeyboardInterrupt` at Ctrl-C and `_Terminated` at SIGTERM, so that workers end and part files go.

    What is raised in a callback of the interpreter (`__del__`, a weak reference's) is lost there: then the
    signal is sent again a moment later. Objects that the signal left half made fail as they go, in silence. A
    signal that is ignored (Ctrl-C in the background of a script) or that somebody else handles stays so.

    Args:
        wishes: Each signal that comes is appended.
    """

    def end(number: int, _: FrameType | None) -> None:
        wishes.append(number)
        raise _Terminated if number == signal.SIGTERM else KeyboardInterrupt

    def lost(what: sys.UnraisableHookArgs) -> None:
        if not wishes:
            hook(what)
        elif issubclass(what.exc_type, KeyboardInterrupt):
            again = threading.Timer(0.02, os.kill, (os.getpid(), wishes[-1]))
            again.daemon = True
            again.start()
        else:
            LOG.debug("left half made by the signal: %r", what.object, exc_info=what.exc_value)

    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    handlers = {number: how for number, how in usual.items() if signal.getsignal(number) is how}
    if not handlers or threading.current_thread() is not threading.main_thread():
        yield
        return
    hook, sys.unraisablehook = sys.unraisablehook, lost
    loud, sys.excepthook = sys.excepthook, lambda *error: None if wishes else loud(*error)
    for number in handlers:
        signal.signal(number, end)
    try:
        yield
    except KeyboardInterrupt as stop:
        traceback.clear_frames(stop.__traceback__)  # what it left half made goes while the hook listens
        raise
    finally:
        sys.unraisablehook, sys.excepthook = hook, loud
        for number, how in handlers.items():
            signal.signal(number, how)


def command_of(verb: str) -> type[Any]:
    """Return the command of a verb."""
    module, _, name = VERBS[verb].partition(".")
    return getattr(importlib.import_module(f"evnlos.cli.{module}"), name)


def summary_of(verb: str) -> str:
    """Return the first line of a command's description, without importing what the command needs."""
    module, _, name = VERBS[verb].partition(".")
    source = (files("evnlos.cli") / f"{module}.py").read_text(encoding="utf-8")
    found = re.search(rf'^class {name}\b.*:\n    """(.*?)(?:"""|\n)', source, re.MULTILINE)
    return found[1] if found else ""


def _unknown(verb: str) -> str:
    is_option = verb.startswith("-")
    known = ("--version", "--help", FLAG, PROGRESS_FLAG, QUIET_FLAG) if is_option else (*VERBS,)
    near = difflib.get_close_matches(verb.lower()[:40], known, n=1)
    cure = f"did you mean {near[0]!r}?" if near else f"give one of {', '.join(known)}"
    return f"unknown {'option' if is_option else 'command'} {printable(verb[:80])!r}; {cure}"


def _answer_at_once(verb: str, rest: list[str]) -> Any:
    """Print help, or refuse what does not fit and names of nothing, before the work's libraries are imported.

    Return the command where it needs none of them (`is_light`), else None: so where only they can tell, since a
    setup, a file of settings or a kind that another package brings decides which flags there are.

    Raises:
        UnfitWordsError: A word does not fit.
        UnknownNameError: A name stands for nothing.
        SystemExit: Help was asked for, and printed.
    """
    if verb == "doctor" or set(doctor.WORK_LIBRARIES) & set(sys.modules) or threading.active_count() > 1:
        return None
    refusal = light = None
    try:
        with doctor.without_work_libraries():
            command = command_of(verb)
            if hasattr(command, "PRESETS") and any(_DECIDES.match(word) for word in rest):
                check_names(rest)
                _check_kinds(_preset(command, rest), rest)
            else:
                made = parse(command, rest, verb, _defaults(command, rest))
                check_names(rest)
                getattr(made, "check_names", tuple)()
                light = made if getattr(made, "is_light", False) else None
    except (UnfitWordsError, UnknownNameError) as error:
        refusal = error
    except Exception:  # a library was needed after all
        LOG.debug("%s is not described without its libraries", verb, exc_info=True)
    if refusal is not None:
        raise refusal
    return light


def _check_kinds(settings: Any, words: list[str], prefix: str = "--") -> None:
    """Refuse a flag `--FIELD.kind KIND` of a kind that there is not, as far as the settings have its field.

    Raises:
        UnknownNameError: There is one.
    """
    for item in fields(settings):
        here, flag = getattr(settings, item.name), f"{prefix}{item.name}"
        if isinstance(here, Kinded) and (kind := flag_value(words, f"{flag}.kind")) is not None:
            here.registry.check(kind)
        if is_dataclass(here) and not isinstance(here, type):
            _check_kinds(here, words, f"{flag}.")


# What decides which flags there are.
_DECIDES = re.compile(r"--(config|setup|pixel|pictures|[\w.-]+\.kind)(=|$)")


def _command(verb: str, rest: list[str]) -> Any:
    """Return the command that the words ask for.

    Raises:
        ConfigError: A word does not fit, or the result could not be written, before it is worked for.
    """
    with doctor.told_while_loading():
        command = command_of(verb)
    if verb == "doctor" and set(rest) <= {"--json"}:  # the parser itself may be what is missing
        return command(json="--json" in rest)
    made = parse(command, rest, verb, _defaults(command, rest))
    for one, name in product((made, getattr(made, "settings", None)), ("out", "half", "preview")):
        if isinstance(out := getattr(one, name, None), Path) and not getattr(made, "dry_run", False):
            kind, force = type(one).__annotations__.get(name, ""), getattr(made, "force", False)
            check_out(out, kind, force, _BESIDE.get(verb, ()))
    return made


def _defaults(command: type[Any], rest: list[str]) -> Any:
    """Return the command with what --preset, --config, --setup, --pixel and --pictures name as defaults."""
    if not hasattr(command, "PRESETS"):
        return None
    import tyro

    from evnlos.config import load_yaml

    settings, config = _preset(command, rest), flag_value(rest, "--config")
    if config is not None:
        settings = load_yaml(type(settings), config)
    for name in ("setup", "pixel", "pictures"):
        word = flag_value(rest, f"--{name}")
        if word is not None and hasattr(command, f"with_{name}"):
            settings = getattr(command, f"with_{name}")(settings, word)
    settings = _of_kinds(settings, rest)
    bare = (item for item in fields(command) if item.default is MISSING and item.default_factory is MISSING)
    return command(**{item.name: tyro.MISSING for item in bare} | {"settings": settings})


def _preset(command: type[Any], rest: list[str]) -> Any:
    """Return the settings that --preset names."""
    preset = flag_value(rest, "--preset") or "default"
    if preset not in command.PRESETS:
        raise UnfitWordsError(f"--preset is {preset!r}; give one of {', '.join(command.PRESETS)}")
    return command.PRESETS[preset]()


def _of_kinds(settings: Any, words: list[str], prefix: str = "--") -> Any:
    """Return settings in which the flags `--FIELD.kind KIND` have chosen the kind, with its own defaults.

    The other flags of the field then are those of that kind, also of one that a plugin brings; so for a field
    within a field, as `--setup.pixel.kind`. Cameras stay where only the wall's kind changes.
    """
    for item in fields(settings):
        here, flag = getattr(settings, item.name), f"{prefix}{item.name}"
        if not is_dataclass(here) or isinstance(here, type):
            continue
        kind = flag_value(words, f"{flag}.kind") if isinstance(here, Kinded) else None
        if kind is not None and kind != kind_of(here):
            before, here = here, here.registry[kind]()  # type: ignore[union-attr] - a family's settings
            if hasattr(here, "with_cameras_of"):
                here = here.with_cameras_of(before)
        here = _of_kinds(here, words, f"{flag}.")
        if here is not getattr(settings, item.name):
            settings = replace(settings, **{item.name: here})
    return settings


def _overview() -> str:
    lines = [f"evnlos {__version__}: seeing moving objects around a corner with an event camera", ""]
    lines += ["usage: evnlos COMMAND [options]; evnlos COMMAND --help shows units and defaults", ""]
    lines += [*(f"  {verb:<12} {summary_of(verb)}" for verb in VERBS), ""]
    lines += [f"with every command: {FLAG} {{{','.join(LEVELS)}}}, or the variable {VARIABLE}; --version"]
    shown = f"{PROGRESS_FLAG} {{{','.join(SHOWN)}}}, or the variable {PROGRESS}; {QUIET_FLAG}"
    return "\n".join([*lines, f"                    {shown}"])


@dataclass(frozen=True)
class DoctorCommand:
    """Check the installation (torch, numba, HDF5, fonts, disk, optional parts), with a cure for each fault."""

    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Print each part; exit code 1 where a needed one is broken."""
        parts = doctor.examine()
        if self.json:
            print(json.dumps({"parts": [asdict(part) for part in parts]}))
        else:
            for part in parts:
                mark = "  ok     " if part.there else "! BROKEN " if part.needed else "- without"
                print(f"{mark} {part.name}: {part.found}" + (f"; {part.cure}" if part.cure else ""))
        if any(part.needed and not part.there for part in parts):
            raise SystemExit(1)
