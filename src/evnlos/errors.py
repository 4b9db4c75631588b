"""The errors that bad input raises, one sentence with value, limit and cure, and how texts are printed."""

import glob
import logging
import re
import sys
from pathlib import Path
from typing import Any, TextIO

_UNSEEN = "\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff"
_CONTROLS = re.compile(f"[{_UNSEEN}]")
_CONTROLS_OF_LINES = re.compile(f"(?![\n\t])[{_UNSEEN}]")
_MOST = 4000  # characters of a message: a stranger's file may hold names of any length


def printable(text: object, *, lines: bool = False) -> str:
    r"""Return a text whose control characters are written out, as in a Python string.

    Names in a stranger's file may hold line breaks, codes that change the terminal, and marks that turn the
    order of letters round.

    Args:
        text: What to show.
        lines: Whether line breaks and tabs stay.

    Example:
        >>> printable("two\nlines\x1b[31m")
        'two\\nlines\\x1b[31m'
    """
    pattern = _CONTROLS_OF_LINES if lines else _CONTROLS
    return pattern.sub(lambda found: found[0].encode("unicode_escape").decode(), str(text))


def absent(path: str | Path, what: str = ": no such file") -> str:
    """Return the beginning of a message on a path that is not there; a pattern matches nothing.

    Args:
        path: The path, or the pattern.
        what: What to say of it where it is no pattern, with what parts it from the path.

    Example:
        >>> absent("shot_R", " is not a folder"), absent("shot_*", " is not a folder")
        ('shot_R is not a folder', 'shot_* matches nothing')
    """
    return f"{path} matches nothing" if glob.has_magic(str(path)) else f"{path}{what}"


class StderrHandler(logging.Handler):
    """Print each record on the stderr of the moment."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print it."""
        print(printable(self.format(record), lines=True), file=sys.stderr)


class PlainOutput:
    """A stream without the control codes that names in a stranger's file may hold; line breaks and tabs stay.

    Args:
        stream: Where the text goes.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text."""
        self._stream.write(printable(text, lines=True))
        return len(text)

    def flush(self) -> None:
        """Write out what is held."""
        self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


_OF_PYTHON = re.compile(r'(?:\b\w+=(?:"\w+"|\w+(?:\([^()]*\))?)?(?: and)? )+\(((?:--|evnlos )[^()]*)\)')


def for_command_line(text: object) -> str:
    """Return a message that names what to give in Python, and then a flag or a command, with the latter alone.

    Args:
        text: A message, or the error that it is of.

    Example:
        >>> for_command_line("its frames carry no times; give fps= (--fps)")
        'its frames carry no times; give --fps'
        >>> for_command_line('read it with on_error="salvage" (evnlos convert --on-error salvage)')
        'read it with evnlos convert --on-error salvage'
    """
    return _OF_PYTHON.sub(r"\1", str(text))


class EvnlosError(Exception):
    """Base of every error that bad input raises; its text is one line a user can act on."""

    def __str__(self) -> str:
        text = super().__str__()
        return printable(text if len(text) <= _MOST else f"{text[: _MOST // 2]} ... {text[-_MOST // 2 :]}")


class ConfigError(EvnlosError):
    """A setting is unknown, of the wrong type, or outside its range."""


class DataError(EvnlosError):
    """An array, image or dataset does not hold what it should."""


class UnknownNameError(ConfigError, DataError):
    """A name stands for nothing: there is no such setup, pixel, experiment, kind, weights or capture."""


class CalibrationError(DataError):
    """The simulator cannot be fitted to captures, or the fit does not stand on those held out."""


class EventFileError(EvnlosError):
    """An event file is damaged, of an unknown format, or contradicts its own header."""


class MissingDependencyError(EvnlosError):
    """An optional package is needed; the text says how to install it."""
