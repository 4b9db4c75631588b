"""`evnlos cite` and `evnlos completion`: what to quote, and what to type.

- `evnlos cite`: BibTeX for what was used.
- `evnlos completion`: a script that completes commands and flags.
"""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class CiteCommand:
    """Print BibTeX for exactly what a settings file, a dataset or a run uses; for everything without one."""

    used: Annotated[Path | None, tyro.conf.Positional] = None
    """Settings file, dataset's folder or run's folder."""
    json: bool = False
    """Print one JSON object: BibTeX by what it is for."""

    def run(self) -> None:
        """Print the entries, each under what it is for."""
        from evnlos.cite import entries_for

        entries = entries_for(self.used)
        if self.json:
            print(json.dumps(entries))
            return
        for name, text in entries.items():
            print(f"% {name}\n{text}\n")


Shell = Literal["bash", "zsh", "fish"]


@dataclass(frozen=True)
class CompletionCommand:
    """Print a script that completes commands, flags and choices: evnlos completion bash >> ~/.bashrc."""

    shell: Annotated[Shell, tyro.conf.Positional] = "bash"
    """Shell that the script is for."""

    def run(self) -> None:
        """Print the script."""
        print(script(self.shell))


def script(shell: Shell) -> str:
    """Return the completion script of all commands for a shell."""
    from evnlos.cli.main import VERBS, command_of

    commands = {verb: command_of(verb) for verb in VERBS}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="evnlos",
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.AvoidSubcommands,),
        )
    # Where nothing of ours fits, bash offers files.
    return printed.getvalue().replace("complete -F ", "complete -o default -F ")
