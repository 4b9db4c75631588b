"""From the words of a command line to a command that runs; bad input is one line and exit code 2."""

from __future__ import annotations

import sys
from dataclasses import MISSING, fields
from types import ModuleType
from typing import Any

from evnlos.cli.notes import FLAG, LEVELS, LOG, VARIABLE, listen
from evnlos.cli.parsing import parse
from evnlos.cli.verbs import VERBS, module_of, summary_of
from evnlos.errors import ConfigError, EvnlosError
from evnlos.requirements import fault_behind
from evnlos.version import __version__

# Nothing that may be missing is imported before a command is: help, version and doctor work in any case.


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
        command = _command(verb, rest)
        LOG.debug("%s", command)
        command.run()
    except EvnlosError as error:
        LOG.debug("where the error came from", exc_info=True)
        print(f"evnlos {verb}: error: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(1)
    except KeyboardInterrupt:
        print(f"evnlos {verb}: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        fault = fault_behind(error)
        if fault is not None:
            text = f"{fault.name} is {fault.found}; {fault.cure} (evnlos doctor looks at all that is needed)"
        elif isinstance(error, OSError):
            text = f"{error}; nothing half-written was left"
        else:
            raise
        LOG.debug("where the error came from", exc_info=True)
        print(f"evnlos {verb}: error: {text}", file=sys.stderr)
        sys.exit(2)


def _command(verb: str, rest: list[str]) -> Any:
    """Return the command that the words ask for."""
    module = module_of(verb)
    if verb == "doctor" and set(rest) <= {"--json"}:  # the parser itself may be what is missing
        return module.Command(json="--json" in rest)
    return parse(module.Command, rest, verb, _defaults(module, rest))


def _defaults(module: ModuleType, rest: list[str]) -> Any:
    """Return the command with the settings of --preset and --config as its defaults, for flags to override."""
    presets = getattr(module, "PRESETS", None)
    if presets is None:
        return None
    import tyro

    from evnlos.config import load_yaml

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
    lines += [f"  {verb:<12} {summary_of(verb)}" for verb in VERBS]
    lines.append("")
    lines.append(f"with every command: {FLAG} {{{','.join(LEVELS)}}}, or the variable {VARIABLE}; --version")
    return "\n".join(lines)
