"""From the words of a command line to its command, and notes on stderr.

What does not fit is one line, not the parser's box; names are looked up before the libraries of the work.
"""

from __future__ import annotations

import contextlib
import difflib
import glob
import importlib
import io
import logging
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_origin

from evnlos.errors import (
    ConfigError,
    DataError,
    MissingDependencyError,
    StderrHandler,
    UnknownNameError,
    for_command_line,
)
from evnlos.machine import PROGRESS, SHOWN, Progress, Step, show_progress
from evnlos.untrusted import no_file

LEVELS = ("debug", "info", "warning", "error")
"""What is said, most first: where an error came from; notes; only warnings; only errors."""
FLAG, VARIABLE = "--log-level", "EVNLOS_LOG"
PROGRESS_FLAG, QUIET_FLAG = "--progress", "--quiet"
"""How progress is shown, with every command; quiet: neither progress nor notes."""
LOG = logging.getLogger("evnlos")
"""The logger of the package; its modules log to it and its children."""


class UnfitWordsError(ConfigError):
    """A word of a command line is none that the command takes, or one that it needs is missing."""


def say(text: str) -> None:
    """Print a note on stderr, so that stdout stays for results; "warning: ..." is shown longer than others."""
    LOG.log(logging.WARNING if text.startswith("warning") else logging.INFO, text)


def drawn(path: Path, draw: Callable[[], object]) -> str | None:
    """Draw the image of a result, and return its path; None and a note where matplotlib is not installed."""
    try:
        return str(draw() or path)
    except MissingDependencyError as error:
        say(f"note: no {path.name}: {error}")
        return None


def told_first(notes: Callable[[], object], progress: Progress) -> Progress:
    """Return a progress that tells notes before its first step: what is refused before it stands alone."""
    untold = [notes]

    def tell(step: Step) -> None:
        while untold:
            untold.pop()()
        progress(step)

    return tell


def listen(arguments: list[str]) -> list[str]:
    """Set what the arguments, else the environment, say of notes and progress; return the other arguments.

    Args:
        arguments: Words of the command line; these flags may stand anywhere before a bare `--`.

    Raises:
        ConfigError: The level is none of `LEVELS`, or the progress none of `evnlos.machine.SHOWN`.

    Example:
        >>> listen(["info", "--log-level", "warning", "events.raw"])
        ['info', 'events.raw']
    """
    rest, level, source = [], os.environ.get(VARIABLE) or "info", VARIABLE
    shown, words = None, iter(arguments)
    for word in words:
        if word == "--":
            rest += [word, *words]
        elif word == FLAG or word.startswith(f"{FLAG}="):
            level = word.partition("=")[2] if "=" in word else next(words, "")
            source = FLAG
        elif word == PROGRESS_FLAG or word.startswith(f"{PROGRESS_FLAG}="):
            shown = word.partition("=")[2] if "=" in word else next(words, "")
        elif word == QUIET_FLAG:
            level, source, shown = "warning", FLAG, "none"
        else:
            rest.append(word)
    if shown is None and "--json" in rest and not os.environ.get(PROGRESS):
        shown = "json"
    if shown is not None and shown not in SHOWN:
        raise ConfigError(f"{PROGRESS_FLAG} is {shown!r}; give one of {', '.join(SHOWN)}")
    show_progress(shown)
    if level.lower() not in LEVELS:
        raise ConfigError(f"{source} is {level!r}; give one of {', '.join(LEVELS)}")
    LOG.handlers = [*(one for one in LOG.handlers if not isinstance(one, StderrHandler)), StderrHandler()]
    LOG.setLevel(level.upper())
    return rest


_RULE = re.compile(r"^[\s─╰╯-]*$")
_HELP_INDENT = 8  # columns before the text that explains an option
_IN_SETUP = {"transport": ""} | {part: f"{part}." for part in ("sensor", "frame-camera", "pixel")}
_RENAMED = {  # flag of an older version -> the words of today
    "--rig": ("--setup",),
    "--paradigm": ("--modality",),
    "--paradigms": ("--modalities",),
    "--views": ("--sequence-augmentations",),
    "--restandardise": ("--no-keep-normalization",),
    "--no-restandardise": ("--keep-normalization",),
}
_RENAMED_IN = {  # the same, of one command
    ("train", "--joint"): ("--network.kind", "sequence"),
    ("train", "--no-joint"): ("--network.kind", "unet"),
    ("experiment", "--rig"): ("--captures-of",),
    ("lab", "--preset"): ("--setup",),
    ("experiment", "--joint"): ("--sequence",),
    ("experiment", "--no-joint"): ("--no-sequence",),
}
_EXPERIMENTS = {"joint": "sequence", "shots": "capture-count", "carry-over": "generalization"}  # today's by old
_MOVED = {  # beginning of the flags of a setting that moved, by command
    verb: {f"--{place}{part}.": f"--{place}setup.{now}" for part, now in _IN_SETUP.items()}
    for verb, place in {"simulate": "", "lab": "", "calibrate": "start."}.items()
}


def todays_words(verb: str, words: list[str]) -> list[str]:
    """Return the words after a verb with the flags of older versions in those of today, and say so on stderr.

    Args:
        verb: The command.
        words: What follows it.
    """
    found: list[str] = []
    for word in words:
        flag, equals, value = word.partition("=")
        today = _RENAMED_IN.get((verb, flag), _RENAMED.get(flag))
        for before, now in _MOVED.get(verb, {}).items():
            if flag.startswith(before):
                today = (now + flag.removeprefix(before),)
        if today is None:
            found.append(word)
            continue
        say(f"note: {flag} is now {' '.join(today)}")
        found += [*today[:-1], f"{today[-1]}{equals}{value}"]
    if verb == "experiment" and found and (name := _EXPERIMENTS.get(found[0])):
        say(f"note: the experiment {found[0]} is now called {name}")
        found[0] = name
    return found


def parse(command: type, words: list[str], verb: str, default: Any = None) -> Any:
    """Return a command with the settings that the words give.

    Args:
        command: Dataclass of the command.
        words: Words of the command line after the verb.
        verb: Name of the command, for its help.
        default: Settings where the words say nothing; None: those of the dataclass.

    Raises:
        ConfigError: A word does not fit.
        SystemExit: Help was asked for, and printed.
    """
    import tyro

    said = io.StringIO()
    # The kinds of glyphs and transport come from preset or file; flags change the numbers of that kind.
    how: Any = {"default": default, "config": (tyro.conf.AvoidSubcommands, tyro.conf.HelptextFromCommentsOff)}
    try:
        with contextlib.redirect_stderr(said), _unwrapped(words):
            found = tyro.cli(command, args=words, prog=f"evnlos {verb}", registry=_rules(), **how)
    except SystemExit as end:
        if not end.code:
            raise
        text = _plain(in_one_line(said.getvalue()))
        lacks = _OUT.search(" ".join(said.getvalue().replace("│", " ").split()))
        if lacks is not None and ";" not in text:
            word = "result.h5" if ".h5" in lacks[1] else "result"
            text += f" ({lacks[1]}), e.g. --out {word}"
            text += _other_faults(command, [*words, "--out", word], verb, default)
        unknown = re.search(r"Unrecognized options: (--[\w.-]+|.*)", text)
        if unknown and not unknown[1].startswith("-"):
            text = f"{unknown[1]}: {verb} takes no more words without a flag; give one at a time"
        elif unknown and "Perhaps you meant" not in text:
            with contextlib.redirect_stdout(io.StringIO()) as page, contextlib.suppress(SystemExit):
                tyro.cli(command, args=["--help"], **how)
            near = difflib.get_close_matches(unknown[1], set(re.findall(r"--[\w.-]*\w", page.getvalue())), 1)
            text += "".join(f"; perhaps you meant {one}" for one in near)
        raise UnfitWordsError(f"{text}; see evnlos {verb} --help") from None
    except (ArithmeticError, MemoryError, ValueError) as error:  # of a setting that only fits together
        raise ConfigError(f"the settings do not fit together ({error}); see evnlos {verb} --help") from None
    importlib.import_module("evnlos.config").check_numbers(found, "")  # needs packages that may be missing
    print(said.getvalue(), end="", file=sys.stderr)  # warnings, if there were any
    return found


def _rules() -> Any:
    """Return tyro's rules with more: numbers are finite, empty and wrong lists say what they are."""
    from tyro.constructors import ConstructorRegistry

    rules, asked = ConstructorRegistry(), list[Any]()

    def ruled(info: Any) -> Any:
        is_many = get_origin(info.type) in (tuple, dict)
        if info in asked or not (is_many or info.type is float):
            return None
        asked.append(info)  # by this rule; the usual ones answer
        spec: Any = ConstructorRegistry.get_primitive_spec(info)
        asked.pop()
        shown = getattr(spec, "str_from_instance", None)

        def read(words: list[str]) -> Any:
            with contextlib.suppress(ValueError):
                value = spec.instance_from_str(words)
                if is_many or math.isfinite(value):
                    return value
            raise ValueError(f"no type matching {spec.metavar} could be instantiated from {words}.")

        return shown and replace(
            spec, instance_from_str=read, str_from_instance=lambda value: shown(value) or ["unset"]
        )

    rules.primitive_rule(ruled)
    return rules


_OUT = re.compile(r"Missing from [^:]*: --out PATH (.*?)\.? (?:[A-Z]|\(required)")  # and what it is, a sentence


def _other_faults(command: type, words: list[str], verb: str, default: Any) -> str:
    """Return what else a command finds wrong as soon as its words are whole."""
    try:
        getattr(parse(command, words, verb, default), "check_names", tuple)()
    except (ConfigError, DataError) as error:
        return f"; {for_command_line(error).partition('; see evnlos')[0]}"
    return ""


@contextlib.contextmanager
def _unwrapped(words: list[str]) -> Iterator[None]:
    """Have messages in lines of any length; help keeps the width of the terminal."""
    before = dict(os.environ)
    if not {"-h", "--help"} & set(words):
        os.environ["COLUMNS"] = "100000"
    try:
        yield
    finally:
        os.environ.pop("COLUMNS", None)
        os.environ.update(before)


def in_one_line(box: str) -> str:
    r"""Return what a box of tyro's says, without frame, descriptions of options and the hint at the help.

    A frame is drawn only where stdout can show it; else the lines begin with the spaces that it would take.

    Example:
        >>> in_one_line(" Wrong \n ------ \n  No such: \n      --a \n  ------ \n  For full helptext, x \n")
        'No such: --a'
    """
    sections: list[list[str]] = [[]]
    for line in (line.rstrip(" │")[2:].rstrip() for line in box.splitlines()[1:]):  # without the title
        if _RULE.match(line):
            sections.append([])
        elif len(line) - len(line.lstrip()) < _HELP_INDENT:
            sections[-1].append(line.strip())
    kept = [part for part in sections if part and not part[0].startswith(("For full", "Argument helptext"))]
    return "; ".join(f"{part[0]} {', '.join(part[1:])}".strip() for part in kept).rstrip(".")


_UNFIT = (  # what tyro says of a value that is no number, and how people say it
    (r"Error parsing (\S+): invalid literal for int\(\) with base 10: (.*)", r"\1 is \2; give a whole number"),
    (r"Error parsing (\S+): no type matching (.*?) could .*? \[(.*?)\](\.. (Got|-) .*)?", r"\1 is \3; give \2"),
    (r"invalid choice ('.*?') for argument '(\S+)'\. Expected one of \((.*?),?\)", r"\2 is \1; give one of \3"),
    (r"\{None\}\||, 'None'(?!,)|'None', ", ""),
    (r"(Perhaps you meant: --.*?, --.*?, --.*?), --.*", r"\1 or others"),  # the rest of a group of flags
    (r"\{([^,|}]*)\}", r"\1"),
    (r"(; give) INT\b(?! INT)", r"\1 a whole number"),
    (r"(; give) FLOAT\b(?! FLOAT)", r"\1 a number"),
    (r"number\|\{(\w+),(\w+)\}", r"number, \1 or \2"),
    (r"\b(number|STR)\|", r"\1 or "),
    (r"\bFLOAT\b", "NUMBER"),
    (r"(?i)( is [^;]*'[+-]?(?:nan|inf|[\d.]+e)[^;]*; give [^;]*?)(?<!whole )(?=number)", r"\1finite "),
)


def _plain(text: str) -> str:
    """Return a message of the parser's in words that say what to give."""
    for pattern, words in _UNFIT:
        text = re.sub(pattern, words, text)
    return text


_RESOLVERS = {  # flag -> module and function of what its word stands for
    "--config": ("config", "read_yaml"),
    "--setup": ("setups", "load_setup"),
    "--pixel": ("cameras", "load_pixel"),
    "--weights": ("models", "find_weights"),
    "--data": ("data", "open_dataset"),
    "--glyphs.family": ("scene.fonts", "find_font"),
}


def check_names(words: list[str]) -> None:
    """Refuse a flag's word that is no file or folder, and stands for no setup, pixel or weights.

    Raises:
        UnknownNameError: There is one.
    """
    for flag, (room, resolver) in _RESOLVERS.items():
        if word := flag_value(words, flag):
            check_there(getattr(importlib.import_module(f"evnlos.{room}"), resolver), word)


def check_there(resolve: Callable[[Any], object], *words: str | Path) -> None:
    """Have what resolves words refuse those that are no file or folder, and names of nothing.

    Raises:
        UnknownNameError: There is one.
    """
    for word in words:
        if not Path(word).exists():
            resolve(word)


def check_files(*paths: Path) -> None:
    """Refuse files that are not there, and patterns of names that match nothing."""
    for path in paths:
        if not (path.exists() or glob.glob(str(path))):  # noqa: PTH207 - it may be absolute
            raise UnknownNameError(no_file(path))


def flag_value(words: list[str], flag: str) -> str | None:
    """Return the value of a flag, given as `--flag value` or `--flag=value`; None where it is not given."""
    for word, following in zip(words, [*words[1:], None], strict=False):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == flag.replace("_", "-") and (equals or following is not None):
            return value if equals else following
    return None


_IMAGES = {".png", ".svg", ".pdf", ".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".webp"}


def refuse_existing(force: bool, *paths: Path) -> None:
    """Raise where a file would be replaced without --force."""
    if not force and (there := next((path for path in paths if path.exists()), None)):
        raise ConfigError(f"{there} exists; give another name, or --force to replace it")


def check_out(path: Path, kind: str, force: bool = False, beside: Sequence[str] = ()) -> None:
    """Raise where a result could not be written, before it is worked for; nothing is made or changed.

    Args:
        path: File or folder that the command will write.
        kind: How the command calls it: OutFolder, OutFile or OutImage of `evnlos.types`; Path tells nothing.
        force: Files may be replaced.
        beside: Endings of the files that the command writes beside its file.

    Raises:
        ConfigError: It, or the folder above it, cannot be written, is of another kind, or would be replaced.
    """
    if kind.startswith("OutFolder") and path.exists() and not path.is_dir():
        raise ConfigError(f"{path} is a file; give the name of a folder")
    _check_writable(path)
    if not kind.startswith(("OutFile", "OutImage")):
        return
    if path.is_dir():
        raise ConfigError(f"{path} is a folder; give the name of a file")
    if kind.startswith("OutImage") and path.suffix.lower() not in _IMAGES:
        raise ConfigError(f"{path} is no image of a known format; end its name in .png, .svg or .pdf")
    refuse_existing(force, path, *map(path.with_suffix, beside))


def _check_writable(path: Path) -> None:
    place = path.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    if place != path.absolute() and not place.is_dir():
        raise ConfigError(f"{path} cannot be made: {place} is a file; give another place")
    try:
        if place.is_dir():  # rights alone do not tell: root has all of them on a disk that is read-only, too
            tempfile.TemporaryFile(dir=place).close()
        elif not os.access(place, os.W_OK):
            raise PermissionError
    except OSError:
        raise ConfigError(f"{path} cannot be written: {place} is not writable; give another place") from None
