"""`evnlos invert`: a photograph, captures or images of a known setup in; what is hidden out."""

from __future__ import annotations

import io
import json
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from evnlos.cli.parsing import check_files, drawn, refuse_existing, say
from evnlos.cli.recordings import Folders, Force, tracks_text
from evnlos.errors import ConfigError
from evnlos.files import write_atomically
from evnlos.machine import ProgressBars
from evnlos.types import Evidence, OutImage

if TYPE_CHECKING:
    from evnlos.data import Capture
    from evnlos.tracking import Tracks

REGULARIZATION_TIKHONOV = 4.0  # best on eight characters of one setup, docs/inversion.md
REGULARIZATION_TV = 0.3  # likewise


_LEAST = dict.fromkeys(("cells", "columns"), 2) | dict.fromkeys(("subsets", "bin"), 1)
_LEAST |= dict.fromkeys(("samples", "static", "background_degree"), 0) | {"noise_sigma": 1e-12}


@dataclass(frozen=True)
class InvertCommand:
    """Invert a photograph of a matte wall, or whole sequences of captures, by the operator alone."""

    files: Folders
    """One NPZ file with a wall's image and geometry (docs/inversion.md), or capture folders with --setup, or
    images of the wall with a measured --setup."""
    setup: Path | None = None
    """The setup of the captures: a name, a settings file, the folder that `evnlos calibrate` wrote, or the file
    of `evnlos scan import`."""
    dark: Path | None = None
    """Images: one taken without the hidden object; by default the scan's own dark frames."""
    positions: tuple[int, ...] = ()
    """Captures: how many of the frames 1, 2, ... to use, equally spaced; none = all, several = a curve."""
    pattern: Path | None = None
    """Captures: the camera's fixed pattern, to be removed; a file, or the folder of its calibrated setup. By
    default that of a calibrated --setup."""
    pixel: str | None = None
    """With --from events or both: the event pixel instead of the setup's, a YAML file as `evnlos pixel fit`
    writes it, or a preset's name. Thresholds of each pixel that lie beside it, or in the folder of a calibrated
    --setup, count as known, and hot pixels are left out."""
    track: bool = False
    """Captures: find the motion in the recording also where capture.yaml states it."""
    static: float | None = None
    """Captures: standard deviation of a pixel's constant offset over that of its noise; by default 1, with
    --changing that of what rests and no plane explains."""
    cells: int = 24
    """Captures: cells per side of the target plane; with --changing along its longer side."""
    columns: int = 64
    """Captures: columns to which frames are reduced, pixels."""
    subsets: int = 1
    """Captures: choices of so many positions to average the scores over."""
    colours: bool = False
    """Captures: an image in colour, of frames in colour, with --from of events behind colour filters too."""
    evidence: Annotated[Evidence | None, tyro.conf.arg(name="from")] = None
    """Captures: estimate the target from these by one likelihood of the whole sequence and a Gaussian prior of
    handwriting, with the uncertainty of each cell; none = the solvers, which take frames. Events need the
    thresholds and the optics of this very sensor: it is said where they do not fit."""
    samples: int = 0
    """With --from: targets to draw from what the data and a learned prior of letters and drawings allow, some
    30; their mean is the image, and where they differ it is a guess. 0 = the Gaussian prior, none are drawn."""
    changing: tuple[float, float] | None = None
    """One capture: nothing moves as a whole; estimate a film of a hidden plane of this width and height,
    metres, whose middle is that of the setup's target plane, with an error of each cell, and a NAME.gif that
    shows it: an image per frame, or with --from events or both ten a second and more."""
    solver: Literal["all", "tikhonov", "tv"] = "all"
    """Smooth (`tikhonov`), sharp and not below 0 (`tv`), or both and, as a control, without the occluders."""
    regularization: str = "cv"
    """Weight of the prior: `cv`, `gcv` (tikhonov only), `discrepancy`, or a number (operator's norm = 1);
    captures: `gcv`, or a number in units of the noise's variance (by default 4 for tikhonov, 0.3 for tv)."""
    noise_sigma: float | None = None
    """Noise of a wall sample over the largest, for `discrepancy`; by default it is estimated."""
    background_degree: int | None = None
    """Degree of the smooth background to ignore; by default the one that predicts left-out blocks best."""
    no_occluder: bool = False
    """Leave the occluders out of the model."""
    bin: int | None = None
    """Wall pixels per side to average; by default at most 48 a side are left."""
    emission_exponent: tuple[float, float] | None = None
    """Exponents of the screen's falloff, horizontal and vertical; by default the file's."""
    out: OutImage = Path("inversion.png")
    """The image; the numbers go to the same name with .npz."""
    force: Force = False
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse captures and images that are not there."""
        check_files(*self.files)

    def run(self) -> None:
        """Invert, print the figures, write the image."""
        for flag, least in _LEAST.items():
            if (value := getattr(self, flag)) is not None and value < least:
                raise ConfigError(f"--{flag.replace('_', '-')} is {value:g}; give {least} or more")
        if self.regularization == "gcv" and self.solver != "tikhonov":
            raise ConfigError("--regularization gcv serves --solver tikhonov only; give that, or a number")
        if self.colours and (self.setup is None or self.samples or self.changing or self.pattern):
            raise ConfigError("--colours takes captures with a --setup; leave --samples, --changing, --pattern")
        if self.samples and self.evidence is None:
            raise ConfigError(f"--samples {self.samples} takes --from frames, events or both; give one of them")
        if self.pixel is not None and self.evidence not in ("events", "both"):
            raise ConfigError(f"--pixel {self.pixel} takes --setup, and --from events or both")
        if self.setup is not None:
            still = all(path.is_file() for path in self.files)
            (self._invert_stills if still else self._invert_captures)(self.setup)
            return
        if len(self.files) != 1 or self.files[0].is_dir():
            one = len(self.files) == 1
            given = f"{self.files[0]} is a folder" if one else f"{len(self.files)} files or folders"
            cure = "give one NPZ file, or capture folders and their --setup, e.g. main-near"
            raise ConfigError(f"{given}, without --setup; {cure}")
        from evnlos.cli.invert_captures import figures_of
        from evnlos.inverse import prepare_inversion, read_photograph
        from evnlos.plot.results import draw_inversion

        regularization, rule = _weight(self.regularization)
        # Matrices of a thousand rows: threads that wait for each other cost more than they save.
        torch.set_num_threads(1)
        clock = time.perf_counter()
        photograph = read_photograph(self.files[0], self.emission_exponent)
        occluded = bool(photograph.occluders) and not self.no_occluder
        options = {"occluded": occluded, "bin": self.bin}
        names: list[Literal["tikhonov", "tv"]]
        names = ["tikhonov", "tv"] if self.solver == "all" else [self.solver]
        controlled = self.solver == "all" and occluded
        solved = {}
        with ProgressBars() as progress:
            with progress.stage("invert", "light path", 0, 1 + len(names) + controlled):
                inversion = prepare_inversion(photograph, degree=self.background_degree, **options)
            for done, name in enumerate(names, 1):
                with progress.stage("invert", name, done, 1 + len(names) + controlled):
                    solved[name] = inversion.solve(name, regularization, rule, self.noise_sigma)
            if controlled:
                options["occluded"] = False
                with progress.stage("invert", "without occluder", 1 + len(names), 2 + len(names)):
                    control = prepare_inversion(photograph, degree=inversion.degree, **options)
                    solved["without occluder"] = control.solve(
                        "tikhonov", regularization, rule, self.noise_sigma
                    )
        found: dict[str, Any] = {
            "file": str(self.files[0]),
            "wall": list(inversion.operator.shape),
            "background_degree": inversion.degree,
            "solutions": {},
        }
        for name, solution in solved.items():
            row = figures_of(name, solution)
            if photograph.truth is not None:
                row["r"] = correlation(solution.image, photograph.truth)
            found["solutions"][name] = row
        panels = [] if photograph.truth is None else [("truth", photograph.truth)]
        panels += [
            (name + (f", r = {row['r']:.3f}" if "r" in row else ""), solved[name].image)
            for name, row in found["solutions"].items()
        ]
        found["picture"] = drawn(self.out, lambda: draw_inversion(self.out, panels))
        save_arrays(self.out, {name: solution.image for name, solution in solved.items()})
        found["seconds"] = round(time.perf_counter() - clock, 1)
        print(json.dumps(found) if self.json else to_text(found))

    def _invert_stills(self, path: Path) -> None:
        from evnlos.cli.invert_captures import StillOptions, invert_stills
        from evnlos.plot.results import draw_inversion
        from evnlos.setups import load_setup

        setup = load_setup(path)
        regularization, rule = _weight(self.regularization)
        torch.set_num_threads(1)
        solvers = ("tikhonov", "tv") if self.solver == "all" else (self.solver,)
        options = StillOptions(
            self.dark, solvers, regularization, rule, self.noise_sigma, self.background_degree, self.bin
        )
        with ProgressBars() as progress, progress.stage("invert", f"{len(self.files)} images"):
            found, pictures = invert_stills(self.files, setup, options)
        panels = [
            (f"{file.stem}, {name}", image[None])
            for name, images in pictures.items()
            for file, image in zip(self.files, images, strict=True)
        ]
        found["picture"] = drawn(self.out, lambda: draw_inversion(self.out, panels))
        save_arrays(self.out, pictures)
        found["file"] = " ".join(found["files"])
        print(json.dumps(found) if self.json else to_text(found))

    def _invert_captures(self, setup: Path) -> None:
        from evnlos.analysis.confidence import left_text, levels_text, sequence_doubts
        from evnlos.cli import invert_captures as work
        from evnlos.plot.results import draw_inversion, sequence_panels

        torch.set_num_threads(1)
        if self.changing is not None:
            self._film(setup, self.changing)
            return
        if self.evidence is not None:
            self._estimate(setup, self.evidence)
            return
        regularization: dict[str, float | None] = {"tikhonov": REGULARIZATION_TIKHONOV, "tv": REGULARIZATION_TV}
        if self.regularization != "cv":
            number, rule = _weight(self.regularization)
            if number is None and rule != "gcv":
                raise ConfigError(f"--regularization is {self.regularization!r}; give gcv or a number")
            regularization = dict.fromkeys(regularization, number)
        solvers = tuple(regularization) if self.solver == "all" else (self.solver,)
        used = (self.positions, self.pattern, self.track, solvers, regularization)
        static = 1.0 if self.static is None else self.static
        options = work.SequenceOptions(setup, *used, self.cells, self.columns, static, self.subsets)
        with ProgressBars() as progress:
            invert = work.invert_colours if self.colours else work.invert_captures
            found, pictures = invert(self.files, options, progress)
        for doubt in sequence_doubts(found["rows"]):
            say(f"warning: {doubt}")
        verdict = left_text(found["rows"])
        panels, side_m = sequence_panels(found["rows"], pictures)
        found["picture"] = drawn(self.out, lambda: draw_inversion(self.out, panels, side_m, verdict))
        save_arrays(self.out, pictures)
        if told := levels_text(found["rows"]):
            say(told)
        told = f"{verdict}; " if verdict else ""
        table = (
            f"{' '.join(found['captures'])}\n{work.sequence_table(found['rows'])}\n{told}{found['seconds']} s"
        )
        print(json.dumps(found) if self.json else table)

    def _film(self, word: Path, sides_m: tuple[float, float]) -> None:
        from evnlos.cli.invert_captures import capture_of
        from evnlos.data import pattern_of
        from evnlos.inverse import film_plane
        from evnlos.models import estimate_film_of
        from evnlos.plot.results import draw_inversion
        from evnlos.report.pictures import grey, save_animation
        from evnlos.setups.load import measured_setup

        refuse_existing(self.force, film := self.out.with_suffix(".gif"))
        if len(self.files) != 1 or self.samples or self.positions or self.track:
            raise ConfigError("--changing takes one capture; leave --samples, --positions, --track")
        plane = film_plane(sides_m, self.cells)
        clock = time.perf_counter()
        evidence = self.evidence or "frames"
        (setup, maps), capture = measured_setup(word, self.pixel), capture_of(self.files[0], evidence)
        pattern = None if evidence == "events" else pattern_of(word, self.pattern)
        how = evidence, pattern, self.columns, self.static
        with ProgressBars() as progress:
            found = estimate_film_of(capture, setup, plane, *how, progress, maps)
        shown = np.linspace(0, len(found.mean) - 1, min(6, len(found.mean))).round().astype(int)
        panels = [(f"{found.times_s[k]:.2f} s", torch.from_numpy(found.mean[k])[None]) for k in shown]
        result: dict[str, Any] = {
            "setup": str(word),
            "capture": capture.name,
            "from": evidence,
            "images": len(found.mean),
            "cells": list(plane.shape),
            "prior": found.prior._asdict(),
            "noise_factor": found.noise_factor,
            "static": found.static,
            "is_explained": found.is_explained,
            "evidence": found.evidence if evidence == "frames" else None,
            "picture": drawn(self.out, lambda: draw_inversion(self.out, panels)),
            "animation": str(film),
        }
        rate_hz = max(len(found.mean) - 1, 1) / max(float(np.ptp(found.times_s)), 0.02)
        save_animation(film, [grey(one) for one in found.mean], rate_hz, zoom=8)
        arrays = {"times_s": found.times_s, "film": found.mean, "film_deviation": found.deviation}
        save_arrays(self.out, arrays)
        result["seconds"] = round(time.perf_counter() - clock, 1)
        print(json.dumps(result) if self.json else film_text(result))

    def _estimate(self, setup: Path, evidence: Evidence) -> None:
        from evnlos.analysis.confidence import levels_text, sequence_doubts
        from evnlos.cli.invert_captures import estimate_captures, sequence_text
        from evnlos.plot.results import draw_inversion, estimate_panels

        if self.positions or self.solver != "all":
            raise ConfigError("--from takes whole sequences and a prior; leave --positions, --solver")
        if self.track and self.colours:  # each colour would be centred on its own light
            raise ConfigError("--colours needs a motion that is known; leave it or --track")
        with ProgressBars() as progress:
            how = evidence, self.pattern, self.samples, progress, self.colours, self.track, self.pixel
            found, pictures = estimate_captures(self.files, setup, *how)
        for doubt in sequence_doubts(found["rows"]):
            say(f"warning: {doubt}")
        panels, side_m = estimate_panels(found["rows"], pictures)
        found["picture"] = drawn(self.out, lambda: draw_inversion(self.out, panels, side_m))
        save_arrays(self.out, pictures)
        if told := levels_text(found["rows"]):
            say(told)
        print(json.dumps(found) if self.json else sequence_text(found))


def save_arrays(picture: Path, arrays: Mapping[str, torch.Tensor | NDArray]) -> None:
    """Write arrays as NPZ beside the image that shows them, without spaces in their names."""
    content = io.BytesIO()
    named: dict[str, Any] = {name.replace(" ", "_"): np.asarray(one) for name, one in arrays.items()}
    np.savez(content, **named)
    write_atomically(picture.with_suffix(".npz"), content.getvalue())


def correlation(image: torch.Tensor, truth: torch.Tensor) -> float:
    """Return Pearson's correlation over all cells and channels: no gain, no offset is fitted."""
    pair = torch.stack([image.flatten(), truth.to(image).flatten()])
    return round(float(torch.corrcoef(pair)[0, 1]), 4)


def to_text(found: dict[str, Any]) -> str:
    """Return the figures as lines for people."""
    height, width = found["wall"]
    lines = [
        f"{found['file']}: {width} x {height} wall patches, background of degree {found['background_degree']}"
    ]
    lines.append(f"{'':18}{'weight':>10}{'misfit':>10}{'iterations':>12}{'r':>8}")
    for name, row in found["solutions"].items():
        r = f"{row['r']:8.3f}" if "r" in row else f"{'-':>8}"
        lines.append(f"{name:18}{row['regularization']:10.2e}{row['misfit']:10.5f}{row['iterations']:12d}{r}")
    lines.append("; ".join([*([found["picture"]] if found["picture"] else []), f"{found['seconds']} s"]))
    return "\n".join(lines)


def film_text(found: dict[str, Any]) -> str:
    """Return the figures of a film as lines for people."""
    prior, (height, width) = found["prior"], found["cells"]
    lines = [
        f"{found['capture']}: {found['images']} images of {width} x {height} cells, by {found['from']}",
        f"prior of the largest likelihood: cells change by {prior['deviation']:.3g}, rest within "
        f"{prior['deviation'] * prior['resting']:.3g}, at {100 * prior['speed_m_s']:.3g} cm per second",
    ]
    if found["from"] == "frames":
        noise = f"noise {found['noise_factor']:.2f} times the camera's"
        lines.append(f"{noise}, offsets {found['static']:.3g} times that")
    if not found["is_explained"]:
        lines.append("warning: no plane here explains the frames; give a larger one, or check the setup")
    made = [found[name] for name in ("picture", "animation") if found.get(name)]
    return "\n".join([*lines, "; ".join([*made, f"{found['seconds']} s"])])


def _weight(text: str) -> tuple[float | None, Literal["cv", "gcv", "discrepancy"]]:
    if text in ("cv", "gcv", "discrepancy"):
        return None, text
    number = float(text) if re.fullmatch(r"[+]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?", text, re.I) else None
    if number is None:
        raise ConfigError(f"--regularization is {text!r}; give cv, gcv, discrepancy or a number from 0 on")
    return number, "cv"


def show_tracks(capture: Capture, found: Tracks, out: Path, as_json: bool, warnings: list[str]) -> None:
    """Print paths of several objects, each with the nearest true one, and write each path and image.

    Args:
        capture: The recording.
        found: Paths and images.
        out: NAME.png: NAME_1.png, ... show the paths, NAME_images.png the objects.
        as_json: Print one JSON object.
        warnings: Why paths may be wrong by more than they state.
    """
    from evnlos.cli.results import track_values
    from evnlos.plot.results import draw_inversion, draw_track

    rows, pictures = [], []
    for k, track in enumerate(found.tracks):
        known = [] if capture.scene is None else [capture.scene, *capture.others]
        off = [float(np.square(one.light_m(track.time_s) - track.position).sum()) for one in known]
        nearest = known[int(np.argmin(off))] if known else None
        rows.append(track_values(capture, track, nearest))
        rows[-1]["target"] = None if nearest is None else nearest.target.name
        path, title = out.with_stem(f"{out.stem}_{k + 1}"), f"{capture.name}, object {k + 1}"
        pictures.append(drawn(path, partial(draw_track, track, path, nearest, title)))
    if found.tracks:
        panels = [(f"object {k + 1}", torch.from_numpy(one)[None]) for k, one in enumerate(found.images)]
        path = out.with_stem(f"{out.stem}_images")
        pictures.append(drawn(path, partial(draw_inversion, path, panels)))
        save_arrays(path, {f"object_{k + 1}": one for k, one in enumerate(found.images)})
    told = {"capture": capture.name, "targets": len(rows), "evidence_gains": list(found.gains), "objects": rows}
    told |= {"image_size_m": found.size_m, "pictures": [one for one in pictures if one], "warnings": warnings}
    text = json.dumps({**told, "tracks": [track.summary() for track in found.tracks]})
    write_atomically(out.with_suffix(".json"), text.encode())
    print(json.dumps(told) if as_json else tracks_text(told))
    for warning in warnings:
        say(f"warning: {warning}")
