"""From the words after a verb to its command; what does not fit is one line, not the parser's box."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from typing import Any

from evnlos.errors import ConfigError

_RULE = re.compile(r"^[\s─╰╯-]*$")
_HELP_INDENT = 8  # columns before the text that explains an option


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
    try:
        with contextlib.redirect_stderr(said), _unwrapped(words):
            # The kinds of glyphs and transport come from preset or file; flags change the numbers of that kind.
            config = (tyro.conf.AvoidSubcommands,)
            found = tyro.cli(command, args=words, prog=f"evnlos {verb}", default=default, config=config)
    except SystemExit as end:
        if not end.code:
            raise
        raise ConfigError(f"{in_one_line(said.getvalue())}; see evnlos {verb} --help") from None
    print(said.getvalue(), end="", file=sys.stderr)  # warnings, if there were any
    return found


@contextlib.contextmanager
def _unwrapped(words: list[str]) -> Iterator[None]:
    """Have messages in lines of any length; help keeps the width of the terminal."""
    before = os.environ.get("COLUMNS")
    if {"-h", "--help"} & set(words):
        yield
        return
    os.environ["COLUMNS"] = "100000"
    try:
        yield
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before


def in_one_line(box: str) -> str:
    r"""Return what a box of tyro's says, without frame, descriptions of options and the hint at the help.

    A frame is drawn only where stdout can show it; else the lines begin with the spaces that it would take.

    Example:
        >>> in_one_line(" Wrong \n ------ \n  No such: \n      --a \n  ------ \n  For full helptext, x \n")
        'No such: --a'
    """
    lines = [line.rstrip(" │")[2:].rstrip() for line in box.splitlines()]
    sections: list[list[str]] = [[]]
    for line in lines[1:]:  # without the title
        if _RULE.match(line):
            sections.append([])
        elif len(line) - len(line.lstrip()) < _HELP_INDENT:
            sections[-1].append(line.strip())
    kept = [part for part in sections if part and not part[0].startswith(("For full", "Argument helptext"))]
    return "; ".join(f"{part[0]} {', '.join(part[1:])}".strip() for part in kept).rstrip(".")
