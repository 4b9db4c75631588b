"""Commands that measure a setup or a camera: `calibrate`, `scan` and `pixel`.

- `evnlos calibrate`: captures with known targets in, a simulation of their setup out.
- `evnlos scan`: plan a measurement of a setup's own light transport, and import what was recorded.
- `evnlos pixel fit`: recordings under known light in, the settings of their event pixel out.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from evnlos.calibration.captures import PRESETS, Calibration
from evnlos.calibration.pixel_fit import PixelFitSettings
from evnlos.calibration.scan.film import FilmReading
from evnlos.calibration.scan.importer import ScanImport
from evnlos.calibration.scan.plan import ScanPlan
from evnlos.cameras import PIXEL_MAPS_FILE, load_pixel, load_pixel_maps
from evnlos.cli.parsing import check_files, check_out, check_there, drawn, refuse_existing, say
from evnlos.cli.recordings import Flat, Folders, Force, Presets
from evnlos.config import to_dict
from evnlos.files import write_atomically
from evnlos.lab import Phone
from evnlos.machine import ProgressBars
from evnlos.setups import load_setup
from evnlos.types import OutFile, OutFolder

if TYPE_CHECKING:
    from evnlos.calibration.fit import SetupFit
    from evnlos.calibration.scan.film import FilmResult
    from evnlos.calibration.scan.importer import ScanResult


@dataclass(frozen=True)
class CalibrateCommand:
    """Fit the simulator to captures with known targets; check it on captures held out; write a setup file."""

    PRESETS: ClassVar[Presets[Calibration]] = PRESETS

    captures: Folders
    """Capture folders of one setup and one camera."""
    out: OutFolder
    """Folder for setup.yaml, training.yaml, pattern and events.safetensors, calibration.json and check.png."""
    preset: str = "default"
    """Kind of wall: `default` is rough metal (GGX roughness, camera), `paper` the tPSF and an affine view."""
    config: Path | None = None
    """YAML file with settings that replace the preset's."""
    setup: str | None = None
    """Where the search starts, of the kind that is fitted: a name, a settings file, or a folder of
    `calibrate`."""
    pixel: str | None = None
    """The camera's event pixel, known from `evnlos pixel fit`: its YAML file or a preset's name. It is kept,
    and not fitted behind the wall. Thresholds of each pixel beside that file go to the folder with it."""
    force: bool = False
    """Write the setup file also where the fit fails on the held-out captures, or where one exists."""
    json: bool = False
    """Print one JSON object instead of tables."""
    settings: Flat[Calibration] = field(default_factory=Calibration)

    @staticmethod
    def with_setup(settings: Calibration, word: str) -> Calibration:
        """Return the calibration that starts from the setup of `--setup`."""
        return replace(settings, start=replace(settings.start, setup=load_setup(word)))

    @staticmethod
    def with_pixel(settings: Calibration, word: str) -> Calibration:
        """Return the calibration that keeps the pixel of `--pixel`."""
        start = settings.start
        start = replace(start, setup=replace(start.setup, pixel=load_pixel(word)))
        return replace(settings, start=start, events=False)

    def check_names(self) -> None:
        """Refuse a capture that is not there, and a folder that is none."""
        from evnlos.data import captures_in, read_capture

        check_there(read_capture, *self.captures)
        if any(path.is_dir() for path in self.captures):
            captures_in(self.captures)

    def run(self) -> None:
        """Fit, print what was found before and after, and write the files."""
        from evnlos.calibration import calibrate, expectation
        from evnlos.calibration.summary import is_of_no_use
        from evnlos.setups import TRAINING_FILE

        self.check_names()
        with ProgressBars() as progress:
            fit = calibrate(
                self.captures, self.out, self.settings, force=self.force, look=self._show, progress=progress
            )
        maps = None if self.pixel is None else load_pixel_maps(self.pixel)
        if maps is None:  # those of an earlier pixel
            (self.out / PIXEL_MAPS_FILE).unlink(missing_ok=True)
        elif self.pixel is not None:
            write_atomically(
                self.out / PIXEL_MAPS_FILE, (Path(self.pixel).parent / PIXEL_MAPS_FILE).read_bytes()
            )
        if not self.json:
            training = self.out / TRAINING_FILE
            print(f"\nto pre-train on:   evnlos simulate --config {training} --out DATASET")
            print(f"captures alike:    evnlos import CAPTURE... --pattern {self.out} --out DATASET")
            print(expectation(fit))
        if is_of_no_use(fit) and not self.force:
            raise SystemExit(1)

    def _show(self, fit: SetupFit) -> None:
        """Print a fit, its warnings, too, and draw captures held out beside it."""
        from evnlos.calibration import (
            calibration_values,
            residual_table,
            rows_of,
            steps_table,
            table,
            warnings_of,
        )
        from evnlos.plot.results import draw_calibration

        rows = rows_of(fit, self.settings.start.pixel, self.settings.start.frame_camera)
        if self.json:
            print(json.dumps(calibration_values(fit, rows)))
        else:
            print(f"fitted: {' '.join(fit.fitted)}\nheld out: {' '.join(fit.held_out)}\n")
            print("\n\n".join(filter(None, (table(rows), residual_table(fit), steps_table(fit)))))
        drawn(self.out / "check.png", lambda: draw_calibration(fit, self.out / "check.png"))
        for line in warnings_of(fit):
            say(f"warning: {line}")


@dataclass(frozen=True)
class ScanCommand:
    """Measure a setup's own light transport with a display or an LED: plan a scan, import what was seen."""

    action: Annotated[Literal["plan", "import", "rehearse"], tyro.conf.Positional]
    """plan writes scan.yaml, the table of images and what to show; import makes a transport of them, or of a
    film; rehearse films a planned show with a pretended phone: FOLDER/film.mp4."""
    folder: Annotated[Path, tyro.conf.Positional]
    """The folder of the scan."""
    out: OutFile | None = None
    """import: the transport, a .safetensors file; by default transport.safetensors in the folder. A check
    image goes to the same name with .png."""
    force: Force = False
    film: Path | None = None
    """import: a video of the wall while the show of `plan --show page` or `video` ran; characters that it moved
    become captures, FOLDER/captures/*, with simulated events beside the filmed frames."""
    setup: str = "main-near"
    """rehearse: the wall, a linear setup: a name, a settings file, or a measured one."""
    json: bool = False
    """Print one JSON object."""
    plan: Flat[ScanPlan] = field(default_factory=ScanPlan)
    """plan: what to scan, and with what."""
    settings: Flat[ScanImport] = field(default_factory=ScanImport)
    """import: how the images become a matrix."""
    reading: Flat[FilmReading] = field(default_factory=FilmReading)
    """import --film: how the video becomes images."""
    phone: Phone = field(default_factory=Phone)
    """rehearse: the phone, with a phone's faults."""

    def run(self) -> None:
        """Write the plan, import the scan, or rehearse the show."""
        {"plan": self._plan, "import": self._import, "rehearse": self._rehearse}[self.action]()

    def _plan(self) -> None:
        from evnlos.calibration.scan import write_plan

        check_out(self.folder, "OutFolder")
        info, found = self.plan.info(), self.plan.estimate()
        with ProgressBars() as progress:
            files = len(write_plan(self.plan, self.folder, progress))
        if self.json:
            print(json.dumps({"folder": str(self.folder), "files": files, **asdict(found)}))
            return
        plane, minutes = info.plane, found.seconds / 60
        print(
            f"{self.folder}: {info.pattern}, {plane.height} x {plane.width} cells of {1e3 * plane.pitch_m:g} mm"
        )
        print(
            f"{found.scan_frames} images in frames.csv, about {minutes:.1f} min at this exposure and overhead"
        )
        print(
            f"expected noise of an entry, brightest pixel: {100 * found.noise:.2g} % of the brightest one "
            f"({found.cell_level:.2g} white levels); with {found.other}: {100 * found.other_noise:.2g} %"
        )
        for note in found.notes:
            say(f"note: {note}")
        if self.plan.show == "pictures":
            print(f"record the images as frames.csv names them, then: evnlos scan import {self.folder}")
            return
        length, name = self.plan.as_show().duration_s, "html" if self.plan.show == "page" else "mp4"
        print(f"show {self.folder / 'show'}.{name} on the whole display and film the wall: {length:.0f} s")
        print(f"then: evnlos scan import {self.folder} --film VIDEO")

    def _rehearse(self) -> None:
        from evnlos.calibration.scan import rehearse_film
        from evnlos.setups.load import linear_setup

        refuse_existing(self.force, self.folder / "film.mp4")
        with ProgressBars() as progress:
            path = rehearse_film(self.folder, linear_setup(self.setup), self.phone, progress=progress)
        print(json.dumps({"film": str(path)}) if self.json else f"{path}: simulated, no phone saw this")
        if not self.json:
            print(f"then: evnlos scan import {self.folder} --film {path}")

    def _filmed(self) -> FilmResult | None:
        """Make the scan's images of the film, and return what was found in it."""
        from evnlos.calibration.scan import import_film

        if self.film is None:
            return None
        height, width = self.settings.height, self.settings.width
        shape = None if height is None or width is None else (height, width)
        with ProgressBars() as progress:
            found = import_film(self.folder, self.film, self.reading, shape, progress)
        for warning in found.warnings:
            say(f"warning: {warning}")
        return found

    def _import(self) -> None:
        import torch

        from evnlos.calibration.scan import add_events, import_scan
        from evnlos.plot.results import draw_scan
        from evnlos.setups.files import write_measurement
        from evnlos.tensor_file import SUFFIX

        torch.set_num_threads(1)
        out = self.folder / f"transport{SUFFIX}" if self.out is None else self.out
        shown = out.with_suffix(".png")
        refuse_existing(self.force, out, shown)
        film = self._filmed()
        result = import_scan(self.folder, self.settings)
        checksum = write_measurement(out, result.measurement)
        for capture in () if film is None else film.captures:
            add_events(self.folder, capture, out)
        picture = drawn(shown, lambda: draw_scan(shown, result.measurement, result.raw))
        for warning in result.warnings:
            say(f"warning: {warning}")
        found = figures_of(result) | {
            "transport": str(out),
            "checksum": checksum,
            "picture": picture,
        }
        if film is not None:
            found["film"] = asdict(film) | {"captures": [str(capture) for capture in film.captures]}
        if self.json:
            print(json.dumps(found))
            return
        if film is not None:
            print("\n".join(film_lines(film)))
        print("\n".join(to_lines(result)))
        print(f"setup: {{kind: measured, file: {out}, checksum: {checksum}}}")
        if film is not None and film.captures:
            print(f"characters: evnlos invert {self.folder / 'captures'}/* --setup {out}")


def film_lines(film: FilmResult) -> list[str]:
    """Return what was found in a film as lines for people."""
    clock, (g, a) = film.clock, film.tone
    lines = [
        f"the show begins {clock.start_s:.3f} s into the film, clocks differ by {1e6 * (clock.rate - 1):+.0f} "
        f"millionths; flashes agree to {clock.agreement:.3f}"
    ]
    if math.isfinite(film.misfit[1]):
        how = "as stated" if film.tone == (1.0, 0.0) else f"light^{g:.2f} exp({a:.2f} (light - 1)) on top"
        lines.append(
            f"tone curve {how}: the light of halves differs from that of the whole by "
            f"{100 * film.misfit[1]:.1f} % (before: {100 * film.misfit[0]:.1f} %)"
        )
    lines.append(
        f"exposure changed by {100 * film.gain_rms:.1f} %, the phone moved by {film.shift_px:.2f} pixels (root "
        f"mean square), {'taken out' if film.corrected else 'left as it is'}"
    )
    return lines


def figures_of(result: ScanResult) -> dict[str, Any]:
    """Return the figures of an import as plain numbers and words."""
    return {
        "about": to_dict(result.measurement.about),
        "denoising": asdict(result.denoising),
        "agreement": None if result.agreement is None else asdict(result.agreement),
        "linearity": result.linearity,
        "psf": None if result.psf is None else asdict(result.psf),
        "signal_to_noise": round(result.signal_to_noise, 3),
        "bad_pixels": result.bad_pixels,
        "warnings": list(result.warnings),
    }


def to_lines(result: ScanResult) -> list[str]:
    """Return the figures of an import as lines for people."""
    about, how = result.measurement.about, result.denoising
    cells = f"{about.plane.height} x {about.plane.width} cells of {1e3 * about.plane.pitch_m:g} mm"
    lines = [f"{cells} on {about.height} x {about.width} pixels, {about.repeats} x {about.pattern}"]
    if result.agreement is not None:
        one = result.agreement
        lines.append(
            f"repeats: moved {one.shift_px:.3f} pixels, light {100 * one.gain:+.2f} %, worst pattern "
            f"{one.pattern} "
            f"differs by {100 * one.difference:.1f} % beyond noise"
        )
    if result.linearity is not None:
        lines.append(f"linearity: {result.linearity:.3f} (1 is linear)")
    if result.psf is not None and result.psf.checked:
        one = result.psf
        lines.append(
            f"shift-invariant: the moved column differs from {one.checked} measured ones by "
            f"{100 * one.error:.0f} % "
            f"(unmoved: {100 * one.unmoved_error:.0f} %)"
        )
    if how.applied:
        rank = "all" if how.rank is None else how.rank
        lines.append(
            f"denoised: smoothing {how.smoothing_cells:g} cells, rank {rank}; {how.gain:.2f} times less "
            "error, by "
            "held-out repeats"
        )
    else:
        lines.append(f"not denoised: {how.reason}")
    lines.append(
        f"an entry is {result.signal_to_noise:.1f} times its noise; {result.bad_pixels} pixels unusable"
    )
    return lines


@dataclass(frozen=True)
class PixelCommand:
    """Fit the event pixel of a camera to recordings under known light; say what they do not identify."""

    action: Annotated[Literal["fit"], tyro.conf.Positional]
    """fit: find thresholds, mismatch, bandwidth, leak, noise, refractory period and a model."""
    recording: Annotated[Path, tyro.conf.Positional]
    """Event file, capture folder with registered frames, or a YAML manifest of several recordings
    (`recordings: [{file: led.raw, light: {kind: sine, frequency_hz: 10, contrast: 0.5}}, ...]`)."""
    out: OutFolder
    """Folder for pixel.yaml, pixel_fit.json, pixel_maps.npz and pixel_fit.png; the maps are the thresholds of
    each pixel, which `evnlos events`, `calibrate` and `invert` take where they find them beside --pixel."""
    light: tuple[str, ...] = ()
    """Light of the recording: static LEVEL, sine HZ CONTRAST [LEVEL], square HZ CONTRAST [LEVEL], edge RATIO
    PX_PER_S [DIRECTION_DEG], frames [FILE], or unknown. Of a capture folder its frames by default."""
    white: float = 255.0
    """The level that counts as 255 DN, so that levels may be lux or any linear unit."""
    force: Force = False
    json: bool = False
    """Print one JSON object."""
    settings: Flat[PixelFitSettings] = field(default_factory=PixelFitSettings)

    def check_names(self) -> None:
        """Refuse a recording that is not there."""
        check_files(self.recording)

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
        from evnlos.plot.results import draw_pixel_fit

        refuse_existing(self.force, self.out / PIXEL_FILE)
        manifest = read_manifest(self.recording, KnownLight.of(self.light) if self.light else None, self.white)
        with ProgressBars() as progress:
            fit = fit_known_light(manifest, self.settings, progress)
        written = write_known_light_fit(fit, self.out)
        if fit.predicted is not None:
            drawn(self.out / PIXEL_FIGURE, lambda: draw_pixel_fit(fit, self.out / PIXEL_FIGURE))
        for line in fit.warnings:
            say(f"warning: {line}")
        print(json.dumps(values_of_fit(fit)) if self.json else "\n".join(lines_of_fit(fit)))
        if written is not None and not fit.describes:
            say(f"warning: {written} does not describe this sensor: do not simulate events with it")
            raise SystemExit(1)
        if self.json:
            return
        if written is None:
            say(f"note: no {PIXEL_FILE}: nothing decides the pixel")
        else:
            print(f"events of it: evnlos events VIDEO --pixel {written} --out events.h5")
