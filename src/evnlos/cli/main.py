"""From the words of a command line to a command that runs; bad input is one line and exit code 2."""

from __future__ import annotations

import sys
from dataclasses import MISSING, fields
from types import ModuleType
from typing import Any

import tyro

from evnlos.cli.notes import FLAG, LEVELS, LOG, VARIABLE, listen
from evnlos.cli.verbs import VERBS, module_of
from evnlos.config import load_yaml
from evnlos.errors import ConfigError, EvnlosError
from evnlos.version import __version__


def main(argv: list[str] | None = None) -> None:
    """Run a command; bad input ends with one line on stderr and exit code 2."""
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
    verb, rest = arguments[0], arguments[1:]
    try:
        if verb not in VERBS:
            raise ConfigError(f"unknown command {verb!r}; give one of {', '.join(VERBS)}")
        module = module_of(verb)
        default = _defaults(module, rest)
        # The kinds of glyphs and transport come from preset or file; flags change the numbers of that kind.
        quiet = (tyro.conf.AvoidSubcommands,)
        command = tyro.cli(module.Command, args=rest, prog=f"evnlos {verb}", default=default, config=quiet)
        LOG.debug("%s", command)
        command.run()
    except EvnlosError as error:
        LOG.debug("where the error came from", exc_info=True)
        print(f"evnlos {verb}: error: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        LOG.debug("where the error came from", exc_info=True)
        print(f"evnlos {verb}: error: {error}; nothing half-written was left", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"evnlos {verb}: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


def _defaults(module: ModuleType, rest: list[str]) -> Any:
    """Return the command with the settings of --preset and --config as its defaults, for tyro to override."""
    presets = getattr(module, "PRESETS", None)
    if presets is None:
        return None
    preset, config = _flag(rest, "--preset"), _flag(rest, "--config")
    if preset is not None and preset not in presets:
        raise ConfigError(f"--preset is {preset!r}; give one of {', '.join(presets)}")
    settings = presets[preset or "default"]()
    if config is not None:
        settings = load_yaml(type(settings), config)
    required = {
        item.name: tyro.MISSING
        for item in fields(module.Command)
        if item.default is MISSING and item.default_factory is MISSING
    }
    return module.Command(**required | {"settings": settings})


def _flag(arguments: list[str], name: str) -> str | None:
    """Return the value of a flag, given as `--flag value` or `--flag=value`."""
    for i, argument in enumerate(arguments):
        if argument == name and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith(f"{name}="):
            return argument.split("=", 1)[1]
    return None


def _overview() -> str:
    lines = [f"evnlos {__version__}: seeing moving objects around a corner with an event camera", ""]
    lines.append("usage: evnlos COMMAND [options]; evnlos COMMAND --help shows units and defaults")
    lines.append("")
    lines += [f"  {verb:<12} {module_of(verb).Command.__doc__.splitlines()[0]}" for verb in VERBS]
    lines.append("")
    lines.append(f"with every command: {FLAG} {{{','.join(LEVELS)}}}, or the variable {VARIABLE}; --version")
    return "\n".join(lines)
