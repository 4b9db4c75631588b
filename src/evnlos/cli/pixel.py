"""`evnlos pixel fit`: recordings under known light in, the settings of their event pixel out."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from evnlos.calibration.pixel_fit import PixelFitSettings
from evnlos.cli.console import Flat
from evnlos.cli.parsing import say
from evnlos.errors import ConfigError
from evnlos.progress import ProgressBars


@dataclass(frozen=True)
class PixelCommand:
    """Fit the event pixel of a camera to recordings under known light; say what they do not identify."""

    action: Annotated[Literal["fit"], tyro.conf.Positional]
    """fit: find thresholds, mismatch, bandwidth, leak, noise, refractory period and a model."""
    recording: Annotated[Path, tyro.conf.Positional]
    """Event file, capture folder with registered frames, or a YAML manifest of several recordings
    (`recordings: [{file: led.raw, light: {kind: sine, frequency_hz: 10, contrast: 0.5}}, ...]`)."""
    out: Path
    """Folder for pixel.yaml, pixel_fit.json, pixel_maps.npz and pixel_fit.png."""
    light: tuple[str, ...] = ()
    """Light of the recording: static LEVEL, sine HZ CONTRAST [LEVEL], square HZ CONTRAST [LEVEL], edge RATIO
    PX_PER_S [DIRECTION_DEG], frames [FILE], or unknown. Of a capture folder its frames by default."""
    white: float = 255.0
    """The level that counts as 255 DN, so that levels may be lux or any linear unit."""
    force: bool = False
    """Replace pixel.yaml where it exists."""
    json: bool = False
    """Print one JSON object."""
    settings: Flat[PixelFitSettings] = field(default_factory=PixelFitSettings)

    def run(self) -> None:
        """Fit, print what was found, and write the files."""
        from evnlos.calibration.pixel_files import read_manifest
        from evnlos.calibration.pixel_light import KnownLight
        from evnlos.calibration.pixel_report import (
            PIXEL_FIGURE,
            PIXEL_FILE,
            fit_known_light,
            lines_of_fit,
            values_of_fit,
            write_known_light_fit,
        )
        from evnlos.errors import MissingDependencyError
        from evnlos.plot.results import draw_pixel_fit

        if (self.out / PIXEL_FILE).exists() and not self.force:
            raise ConfigError(f"{self.out / PIXEL_FILE} exists; give another --out, or --force to replace it")
        manifest = read_manifest(self.recording, KnownLight.of(self.light) if self.light else None, self.white)
        with ProgressBars() as progress:
            fit = fit_known_light(manifest, self.settings, progress)
        written = write_known_light_fit(fit, self.out)
        if fit.predicted is not None:
            try:
                draw_pixel_fit(fit, self.out / PIXEL_FIGURE)
            except MissingDependencyError as error:
                say(f"note: {error}")
        for line in fit.warnings:
            say(f"warning: {line}")
        if self.json:
            print(json.dumps(values_of_fit(fit)))
            return
        print("\n".join(lines_of_fit(fit)))
        if written is None:
            say(f"note: no {PIXEL_FILE}: nothing decides the pixel")
        else:
            print(f"events of it: evnlos events VIDEO --pixel {written} --out events.h5")
