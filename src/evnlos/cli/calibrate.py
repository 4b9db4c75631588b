"""`evnlos calibrate`: captures with known targets in, a simulation of their rig out."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from evnlos.calibration.settings import PRESETS, Calibration
from evnlos.cli.console import Flat, Folders, Presets
from evnlos.cli.notes import say
from evnlos.setups import load_setup


@dataclass(frozen=True)
class CalibrateCommand:
    """Fit the simulator to captures with known targets; check it on captures held out; write a rig file."""

    PRESETS: ClassVar[Presets[Calibration]] = PRESETS

    captures: Folders
    """Capture folders of one rig and one camera."""
    out: Path
    """Folder for rig.yaml, training.yaml, pattern.safetensors, calibration.json and check.png."""
    preset: str = "default"
    """Kind of wall: `default` is rough metal (GGX roughness, camera), `paper` the tPSF and an affine view."""
    config: Path | None = None
    """YAML file with settings that replace the preset's."""
    setup: str | None = None
    """Where the search starts, of the kind that is fitted: a name, a settings file, or a folder of
    `calibrate`."""
    force: bool = False
    """Write the rig file also where the fit fails on the held-out captures, or where one exists."""
    json: bool = False
    """Print one JSON object instead of tables."""
    settings: Flat[Calibration] = field(default_factory=Calibration)

    @staticmethod
    def with_setup(settings: Calibration, word: str) -> Calibration:
        """Return the calibration that starts from the setup of `--setup`."""
        return replace(settings, start=replace(settings.start, setup=load_setup(word)))

    def run(self) -> None:
        """Fit, print what was found before and after, and write the files."""
        from evnlos.calibration import figures, fit_rig, residual_table, rows_of, table, warnings_of, write_rig
        from evnlos.calibration.summary import TRAINING_FILE, check_out, expectation
        from evnlos.errors import MissingDependencyError
        from evnlos.plot.calibration import draw_calibration

        check_out(self.out, self.force)
        fit = fit_rig(self.captures, self.settings)
        rows = rows_of(fit, self.settings.start.pixel, self.settings.start.frame_camera)
        self.out.mkdir(parents=True, exist_ok=True)
        if self.json:
            print(json.dumps(figures(fit, rows)))
        else:
            print(f"fitted: {' '.join(fit.fitted)}\nheld out: {' '.join(fit.held_out)}\n")
            print(f"{table(rows)}\n\n{residual_table(fit)}")
        try:
            draw_calibration(fit, self.out / "check.png")
        except MissingDependencyError as error:
            say(f"note: {error}")
        for line in warnings_of(fit):
            say(f"warning: {line}")
        path = write_rig(fit, rows, self.out, self.force)
        if not self.json:
            print(
                f"\nto pre-train on:   evnlos simulate --config {path.with_name(TRAINING_FILE)} --out DATASET"
            )
            print(f"captures alike:    evnlos import CAPTURE... --pattern {self.out} --out DATASET")
            print(expectation(fit))
