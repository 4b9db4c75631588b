"""`evnlos demo`: the main job, small."""

from __future__ import annotations

from dataclasses import dataclass, field

from evnlos.cli.console import Flat
from evnlos.demo import Demo, run_demo


@dataclass(frozen=True)
class DemoCommand:
    """The main job, small: simulate, pre-train, fine-tune on captures, train end to end, evaluate, report."""

    settings: Flat[Demo] = field(default_factory=Demo)

    def run(self) -> None:
        """Run the demo and print the table and the path of the report."""
        run_demo(self.settings)
