"""Notes on stderr: how much a command says beside its result (`--log-level`, EVNLOS_LOG)."""

from __future__ import annotations

import logging
import os
import sys
from typing import Any, TextIO

from evnlos.errors import ConfigError, printable

LEVELS = ("debug", "info", "warning", "error")
"""What is said, most first: where an error came from; notes; only warnings; only errors."""
FLAG, VARIABLE = "--log-level", "EVNLOS_LOG"
LOG = logging.getLogger("evnlos")
"""The logger of the package; its modules log to it and its children."""


class _Stderr(logging.Handler):
    """Print each record on the stderr of the moment."""

    def emit(self, record: logging.LogRecord) -> None:
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


def say(text: str) -> None:
    """Print a note on stderr, so that stdout stays for results; "warning: ..." is shown longer than others."""
    LOG.log(logging.WARNING if text.startswith("warning") else logging.INFO, text)


def listen(arguments: list[str]) -> list[str]:
    """Set the level that the arguments, else EVNLOS_LOG, ask for; return the arguments without the flag.

    Args:
        arguments: Words of the command line; the flag may stand anywhere before a bare `--`.

    Raises:
        ConfigError: The level is none of `LEVELS`.

    Example:
        >>> listen(["info", "--log-level", "warning", "events.raw"])
        ['info', 'events.raw']
    """
    rest, level, source = [], os.environ.get(VARIABLE) or "info", VARIABLE
    words = iter(arguments)
    for word in words:
        if word == "--":
            rest += [word, *words]
        elif word == FLAG or word.startswith(f"{FLAG}="):
            level = word.partition("=")[2] if "=" in word else next(words, "")
            source = FLAG
        else:
            rest.append(word)
    if level.lower() not in LEVELS:
        raise ConfigError(f"{source} is {level!r}; give one of {', '.join(LEVELS)}")
    for handler in [one for one in LOG.handlers if isinstance(one, _Stderr)]:
        LOG.removeHandler(handler)
    LOG.addHandler(_Stderr())
    LOG.setLevel(level.upper())
    return rest
