"""The commands, one thin file a verb: flags and help come from the same dataclasses as the YAML files."""

from evnlos.cli.main import VERBS, main

__all__ = ["VERBS", "main"]
