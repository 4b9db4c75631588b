"""`evnlos identify`: a rig in, what it can show at all out."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from evnlos.cli.console import Flat
from evnlos.cli.notes import say
from evnlos.config import write_atomically
from evnlos.errors import ConfigError
from evnlos.evaluation.identify_rig import Bench


@dataclass(frozen=True)
class Command:
    """Say what a rig can show at all: modes above the noise, finest stroke, best linear picture, in words."""

    rigs: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names (main-near, matte-far, ..., simulate-paper), rig files or folders, settings of `simulate` or
    `lab` (YAML)."""
    all: bool = False
    """All named rigs, as a table."""
    out: Path | None = None
    """Folder for a figure of each rig and identify.json with all curves."""
    json: bool = False
    """Print one JSON object, or a list where several rigs are asked for."""
    seed: int = 0
    """Seed of the one noisy picture of the figure."""
    bench: Flat[Bench] = field(default_factory=Bench)

    def run(self) -> None:
        """Identify and print."""
        from tqdm import tqdm

        from evnlos.evaluation.identify import identify
        from evnlos.evaluation.identify_source import described_rig
        from evnlos.evaluation.identify_table import rig_table
        from evnlos.plot.identify import draw_identification, draw_rigs
        from evnlos.transport.rig import rig_names

        names = [*self.rigs, *(rig_names() if self.all else [])]
        if not names:
            raise ConfigError(f"no rig given; give a rig file, --all, or names: {', '.join(rig_names())}")
        rigs = [described_rig(name) for name in names]
        found = [
            identify(rig.transport, rig.camera, self.bench, rig.name, self.seed)
            for rig in tqdm(rigs, desc="identify", unit=" rigs", disable=len(rigs) == 1)
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
