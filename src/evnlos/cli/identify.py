"""`evnlos identify`: a setup in, what it can show at all out."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from evnlos.cli.console import Flat
from evnlos.cli.notes import say
from evnlos.errors import ConfigError
from evnlos.evaluation.identify_rig import Bench
from evnlos.files import write_atomically


@dataclass(frozen=True)
class IdentifyCommand:
    """Say what a setup can show at all: modes above the noise, finest stroke, best linear picture, in words."""

    setups: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names (main-near, matte-far, ..., simulate-paper), settings files, folders of `calibrate`, files of
    `scan import`."""
    setup: tuple[str, ...] = ()
    """The same, as in the other commands."""
    all: bool = False
    """All named walls, as a table."""
    out: Path | None = None
    """Folder for a figure of each setup and identify.json with all curves."""
    json: bool = False
    """Print one JSON object, or a list where several setups are asked for."""
    seed: int = 0
    """Seed of the one noisy picture of the figure."""
    bench: Flat[Bench] = field(default_factory=Bench)

    def run(self) -> None:
        """Identify and print."""
        from tqdm import tqdm

        from evnlos.evaluation.identify import identify
        from evnlos.evaluation.identify_table import rig_table
        from evnlos.plot.identify import draw_identification, draw_rigs
        from evnlos.setups import named_setup, setup_names

        names = [*self.setups, *self.setup, *(setup_names() if self.all else [])]
        if not names:
            raise ConfigError(
                f"no setup given; give a settings file, --all, or names: {', '.join(setup_names())}"
            )
        setups = [named_setup(name) for name in names]
        found = [
            identify(one.setup, self.bench, one.name, self.seed)
            for one in tqdm(setups, desc="identify", unit=" setups", disable=len(setups) == 1)
        ]
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
            for one in found:
                draw_identification(one, self.out / f"identify_{one.name}.png")
            if len(found) > 1:
                draw_rigs(found, self.out / "identify_rigs.png")
            curves = json.dumps([one.summary(arrays=True) for one in found], indent=1)
            write_atomically(self.out / "identify.json", curves.encode())
        if self.json:
            plain = [one.summary() for one in found]
            print(json.dumps(plain if len(plain) > 1 else plain[0]))
            return
        print(rig_table(found))
        for one in found:
            print(f"{one.name}: {one.verdict}")
            for warning in one.warnings:
                say(f"warning: {one.name}: {warning}")
        if self.out is not None:
            print(f"{self.out}: figures and identify.json")
