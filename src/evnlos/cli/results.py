"""Commands that show results: `reconstruct`, `track`, `identify`, `report`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from evnlos.analysis.bounds import SequenceAnalysisSettings
from evnlos.analysis.linearized import AnalysisSettings
from evnlos.cli.parsing import check_there, drawn, refuse_existing, say
from evnlos.cli.recordings import Flat, Folders, Force, result
from evnlos.errors import ConfigError, EvnlosError
from evnlos.files import write_atomically
from evnlos.machine import ProgressBars
from evnlos.tracking import Tracking
from evnlos.types import OutFile, OutFolder, OutImage, length_text

if TYPE_CHECKING:
    from evnlos.analysis import Identification
    from evnlos.data import Capture
    from evnlos.data.lab import Lab
    from evnlos.scene import Scene
    from evnlos.tracking import Track


@dataclass(frozen=True)
class ReconstructCommand:
    """Reconstruct all positions of a capture: images, a film strip and an animation."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder; its target may be unknown."""
    weights: Path | None = None
    """Weights file, run's folder, or name of published weights (`evnlos weights` lists them); none takes the
    published ones for frames of the setup with the nearest distance, of whole sequences if the motion is known
    or found (--track)."""
    out: OutFolder = Path("reconstruction")
    """Folder for the images; new or empty."""
    pattern: Path | None = None
    """Fixed pattern to take from the frames: the file that `calibrate` wrote, or its folder."""
    setup: Path | None = None
    """The recording's setup: the folder that `calibrate` wrote, a settings file, or a room's name. Its fixed
    pattern is taken from the frames, the images are moved to where its wall agrees with the frames, and it is
    printed how much of the frames they explain. A wall such as main-near states neither light nor cameras.
    Without it, the setup that the weights were trained for explains the frames, if known."""
    track: bool = False
    """Find the motion in the recording, as `evnlos track` does, also where capture.yaml states it; needs
    --setup, and takes about a minute."""
    so_far: bool = False
    """Make each image of what was seen up to its position alone: a film of what becomes known as the recording
    goes on. By default a network of whole sequences makes one image of the whole recording."""
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse a capture that is not there."""
        from evnlos.data import read_capture

        check_there(read_capture, self.capture)

    def run(self) -> None:
        """Reconstruct and print where the images are."""
        from evnlos.data import pattern_of
        from evnlos.report import reconstruct_capture
        from evnlos.setups import lit_setup, stated_target_m

        setup = lit_setup(self.setup) if self.setup else None
        how: dict[str, Any] = {"setup": setup, "pattern": pattern_of(self.setup, self.pattern)}
        how |= {"track": self.track, "so_far": self.so_far}
        how["target_m"] = stated_target_m(self.setup) if self.setup else None
        with ProgressBars() as progress:
            found = reconstruct_capture(self.capture, self.weights, self.out, **how, progress=progress)
        for warning in found.get("warnings", []):
            say(f"warning: {warning}")
        if self.json:
            print(json.dumps(found | {"out": str(self.out)}))
            return
        print(f"{self.out}: {found['positions']} positions of {found['capture']} by {found['weights']}")
        once = f"{self.out / 'result.png'} shows them once, with what was seen and what to believe"
        print("\n".join([once, *found["in_words"]]))
        if "scores" in found:
            print("  ".join(f"{name} {value}" for name, value in found["scores"].items() if value is not None))


def show_first(demo: Path, captures: Sequence[Path], lab: Lab, force: bool) -> None:
    """Reconstruct one of the demo's captures with published weights, before anything is trained.

    Args:
        demo: Folder of the demo; the result is its folder `first`, and made once.
        captures: Capture folders, patterns of them, or folders above them.
        lab: Renders the demo's captures where there are none.
        force: Begin although the machine's memory will hardly do.

    Raises:
        UnknownNameError: There is no capture in what was given.
    """
    from evnlos.data import captures_in
    from evnlos.data.lab import render_captures
    from evnlos.report import reconstruct_capture

    if (out := demo / "first").exists():
        return
    capture = next(iter(captures_in(captures)), None)
    try:
        with ProgressBars() as progress:
            if capture is None:
                names = [name for name in lab.glyphs.objects() if name.endswith("_S")]
                capture = render_captures(lab, demo / "captures", names, 1, progress, force)[0]
            found = reconstruct_capture(capture, None, out, progress=progress)
    except EvnlosError as error:
        say(f"note: no first reconstruction: {error}")
        return
    first = f"{out / 'result.png'}: {capture.name} by {found['weights']}, published"
    print("\n".join([first, *found["in_words"]]))
    if not found.get("confidence", {}).get("measured", True):
        print(
            "these weights know another wall or light; the demo now calibrates and trains for the captures' own"
        )


@dataclass(frozen=True)
class TrackCommand:
    """Follow the hidden object of a capture, or several (--targets): position and speed over time."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder; what it says of the motion serves for comparison only."""
    setup: Path | None = None
    """Setup of the capture (a file, or the folder that `evnlos calibrate` wrote): positions in metres; without
    it they are in image pixels."""
    pattern: Path | None = None
    """The camera's fixed pattern, to be removed; a file, or the folder of its calibrated setup. By default that
    of a calibrated --setup."""
    out: OutImage = Path("track.png")
    """The figure; the numbers go to the same name with .json. With a setup NAME_image.png, NAME_image.npz
    (several targets: NAME_images) show what moves."""
    force: Force = False
    json: bool = False
    """Print one JSON object."""
    settings: Flat[Tracking] = field(default_factory=Tracking)

    def check_names(self) -> None:
        """Refuse a capture that is not there."""
        from evnlos.data import read_capture

        check_there(read_capture, self.capture)

    def run(self) -> None:
        """Follow, print, write the image."""
        from torch import from_numpy

        from evnlos.analysis import track_psnr
        from evnlos.cli.invert import save_arrays, show_tracks
        from evnlos.data import pattern_of, read_capture
        from evnlos.plot.results import draw_inversion, draw_track
        from evnlos.setups.load import linear_setup
        from evnlos.tracking import Tracks, track_capture, track_several, track_warnings

        image_path = self.out.with_stem(f"{self.out.stem}_image")
        if self.setup is not None or self.settings.targets != 1:
            ends = ("image",) if self.settings.targets == 1 else ("1", "images")
            refuse_existing(self.force, *(self.out.with_stem(f"{self.out.stem}_{k}") for k in ends))
        with ProgressBars() as progress:
            with progress.stage("track", "read the capture", 0, 3):
                capture = read_capture(self.capture, needs_frames=False, needs_events=False)
            with progress.stage("track", "render the light of the setup", 1, 3):
                setup = None if self.setup is None else linear_setup(self.setup)
                pattern = pattern_of(self.setup, self.pattern)
            with progress.stage("track", "follow the target", 2, 3):
                follow = track_capture if self.settings.targets == 1 else track_several
                track = follow(capture, setup, self.settings, pattern)
        if isinstance(track, Tracks):
            odd = track_warnings(capture, setup, track.tracks[0]) if track.tracks else []
            show_tracks(capture, track, self.out, self.json, odd)
            return
        scene = capture.scene if track.unit == "m" else None
        found = track_values(capture, track, scene)
        found["warnings"] = track_warnings(capture, setup, track)
        found["picture"] = drawn(self.out, lambda: draw_track(track, self.out, scene, capture.name))
        if track.image is not None:
            save_arrays(image_path, {"image": track.image})
            panels = [("found", from_numpy(track.image)[None])]
            found["image"] = drawn(image_path, lambda: draw_inversion(image_path, panels))
            known = None if capture.scene is None else (capture.scene, track.image, track.size_m)
            found["psnr_db"] = None if known is None else track_psnr(*known, track.frame_time_s)
        text = json.dumps({**found, "track": track.summary()})
        write_atomically(self.out.with_suffix(".json"), text.encode())
        print(json.dumps(found) if self.json else to_text(found))
        for warning in found["warnings"]:
            say(f"warning: {warning}")


def track_values(capture: Capture, track: Track, scene: Scene | None) -> dict[str, Any]:
    """Return what the command prints: means, and errors where the truth is known."""
    step = track.position[-1] - track.position[0]
    found: dict[str, Any] = {
        "capture": capture.name,
        "unit": track.unit,
        "frames": 0 if track.events else len(track.frame_time_s),
        "events": track.events,
        "event_windows": track.event_windows,
        "travel": float(np.hypot(*step)),
        "direction_deg": float(np.degrees(np.arctan2(step[1], step[0]))),
        "mean_speed": float(track.speed.mean()),
        "position_sigma": float(track.position_sigma.mean()),
        "speed_sigma": float(track.speed_sigma.mean()),
    }
    if np.isfinite(track.size).all():
        found["size_change"] = float(track.size[-1] / track.size[0])
    if track.misfit is not None:
        found["misfit"] = track.misfit
    if (away := track.distance) is not None:
        found["distance"] = [float(away.distance_m[0]), float(away.distance_m[-1])]
        found["distance_sigma"] = float(away.distance_sigma.mean())
        found["retreat"] = float((away.distance_m[-1] - away.distance_m[0]) / np.ptp(away.time_s))
        found |= {"distance_spread": float(away.distance_m.std()), "distance_feigned": away.feigned_m}
        found["distance_identified"] = away.is_identified
    if track.turn is not None:
        found["turn_deg"] = float(track.turn.rotation_deg[-1] - track.turn.rotation_deg[0])
        found["turn_sigma_deg"] = float(track.turn.rotation_sigma.mean())
        found["turn_identified"] = track.turn.is_identified
    return found if scene is None else found | track.errors(scene)


def to_text(found: dict[str, Any]) -> str:
    """Return the figures as lines for people."""
    unit = found["unit"]

    def length(name: str, digits: int = 2, of: float | None = None) -> str:
        return length_text(found[name] if of is None else of, unit, digits)

    of = "{events:,} events alone" if found["events"] else "{frames} frames, {event_windows} windows of events"
    lines = [
        f"{found['capture']}: {of.format(**found)}",
        f"travel      {length('travel'):>11}, direction {found['direction_deg']:.1f} deg"
        + ("" if unit == "m" else "; image pixels: give --setup for metres"),
        f"mean speed  {length('mean_speed', 3):>11}/s, +- {length('speed_sigma', 3)}/s at an instant",
        f"position    {length('position_sigma', 3):>11} standard deviation"
        + (" by the noise; the setup's own errors come on top" if unit == "m" else ""),
    ]
    if "size_change" in found:
        lines.append(f"size        {found['size_change']:8.3f} at the end over the start")
    if "misfit" in found:
        lines.append(f"misfit      {found['misfit']:8.2f} times the noise is left by target and setup")
    if "distance" in found:
        first, last = (length("distance", of=v) for v in found["distance"])
        lines.append(
            f"distance    {first:>11} at the start, {last} at the end, +- {length('distance_sigma')}; "
            f"{length('distance_spread')} rms about its mean, which is the setup's, whose errors may make "
            f"{length('distance_feigned')} of it"
            + ("" if found["distance_identified"] else "; not identified: its changes drown in these errors")
        )
    if "turn_deg" in found:
        lines.append(
            f"turn        {found['turn_deg']:8.2f} deg from start to end, +- {found['turn_sigma_deg']:.2f} deg"
            + ("" if found["turn_identified"] else "; not identified: this target shows no turn")
        )
    if "position_error" in found:
        x, y = (length("position_offset", of=v) for v in found["position_offset"])
        lines.append(
            f"error       {length('position_error', 3):>11} rms about an offset of ({x}, {y}); "
            f"speed {found['speed_error_percent']:.2f} % rms"
            + (f", distance {length('distance_error')} rms about its own" if "distance_error" in found else "")
            + (f", turn {found['turn_error_deg']:.2f} deg rms" if "turn_error_deg" in found else "")
        )
    if "image" in found:
        known = found["psnr_db"]
        lines.append("image       at its mean distance and turn" + (f", PSNR {known:.2f} dB" if known else ""))
    return "\n".join([*lines, *(found[name] for name in ("picture", "image") if found.get(name))])


@dataclass(frozen=True)
class IdentifyCommand:
    """Say what a setup can show at all: modes above the noise, finest stroke, best linear image, in words."""

    setups: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names (main-near, matte-far, ..., rooms such as worn, simulate-paper), settings files, folders of
    `calibrate`, files of `scan import`."""
    setup: tuple[str, ...] = ()
    """The same, as in the other commands."""
    all: bool = False
    """All named walls, as a table."""
    out: OutFolder | None = None
    """Folder for a figure of each setup and identify.json with all curves."""
    force: Force = False
    json: bool = False
    """Print one JSON object, or a list where several setups are requested."""
    seed: int = 0
    """Seed of the one noisy image of the figure."""
    settings: Flat[AnalysisSettings] = field(default_factory=AnalysisSettings)
    bounds: bool = False
    """Also print the expected PSNR of the best linear estimate of a moving target, from frames, from events and
    from both, over the number of positions and for each event model; some ten seconds more for each setup."""
    sequence: SequenceAnalysisSettings = field(default_factory=SequenceAnalysisSettings)

    def check_names(self) -> None:
        """Refuse a word that stands for no setup."""
        from evnlos.setups import load_setup

        check_there(load_setup, *self.setups, *self.setup)

    def run(self) -> None:
        """Identify and print."""
        from evnlos.analysis.bounds import sequence_bounds
        from evnlos.analysis.identify import identify, setup_table
        from evnlos.plot.setup import draw_identification, draw_setups
        from evnlos.setups import ROOMS, named_setup, setup_names

        names = [*self.setups, *self.setup, *(setup_names() if self.all else [])]
        if not names:
            listed = ", ".join([*setup_names(), *ROOMS])
            raise ConfigError(f"no setup given; give a file, --all, or names: {listed}")
        setups = [named_setup(name) for name in names]
        made = ["identify.json", *(f"identify_{one.name}.png" for one in setups), "identify_setups.png"]
        refuse_existing(self.force, *(self.out / name for name in made if self.out))
        found, limits, stages = [], {}, len(setups) * (1 + self.bounds)
        with ProgressBars() as progress:
            for one in setups:
                with progress.stage("identify", f"{one.name}: modes above the noise", len(found), stages):
                    found.append(identify(one.setup, self.settings, one.name, self.seed, one.target_m))
            for one in setups if self.bounds else ():
                done = len(found) + len(limits)
                with progress.stage("identify", f"{one.name}: moving targets", done, stages):
                    limits[one.name] = sequence_bounds(one.setup, self.sequence, one.name, self.seed)

        def summary(one: Identification, arrays: bool) -> dict[str, Any]:
            known = {"bounds": limits[one.name].summary()} if one.name in limits else {}
            return one.summary(arrays=arrays) | known

        written = list[str | None]()
        if self.out is not None:
            for one in found:
                path = self.out / f"identify_{one.name}.png"
                written.append(drawn(path, partial(draw_identification, one, path, limits.get(one.name))))
            if len(found) > 1:
                path = self.out / "identify_setups.png"
                written.append(drawn(path, partial(draw_setups, found, path)))
            curves = json.dumps([summary(one, True) for one in found], indent=1)
            write_atomically(self.out / "identify.json", curves.encode())
        if self.json:
            plain = [summary(one, False) for one in found]
            print(json.dumps(plain if len(plain) > 1 else plain[0]))
            return
        print(setup_table(found))
        for one in found:
            print(f"{one.name}: {one.verdict}")
            for warning in one.warnings:
                say(f"warning: {one.name}: {warning}")
        whole = "what a whole sequence of frames, of events, of both shows: --bounds (ten seconds per setup)"
        print("\n".join(f"\n{limit.table(in_columns=True)}" for limit in limits.values()) or whole)
        if self.out is not None:
            print(f"{self.out}: identify.json", *(Path(one).name for one in written if one), sep=", ")


@dataclass(frozen=True)
class ReportCommand:
    """Score runs on the same captures and write one self-contained HTML page, with a CSV beside it."""

    runs: Folders
    """Folders of the runs."""
    data: Path
    """Folder of the dataset to score on."""
    split: str = "test"
    """Split to score."""
    setup: str | None = None
    """The setup: a name, a settings file, or the folder that `calibrate` wrote, as `identify` takes it: it is
    drawn, and what it can show stands beside the results. The setup of a simulated dataset is known."""
    out: OutFile = Path("report.html")
    """The page; the scores go to the same name with .csv."""
    force: Force = False
    json: bool = False
    """Print one JSON object: mean scores of each run and baseline."""

    def run(self) -> None:
        """Evaluate the runs and write the page."""
        from evnlos.analysis.identify import identify
        from evnlos.report import collect_results, to_text, write_report
        from evnlos.report.tables import baselines_of
        from evnlos.setups import named_setup

        with ProgressBars() as progress:
            dataset, results = collect_results(list(self.runs), self.data, self.split, progress=progress)
            with progress.stage("report", "what the setup can show", 0, 2):
                setup = None if self.setup is None else named_setup(self.setup)
                limits = (
                    None if setup is None else identify(setup.setup, name=setup.name, stated_m=setup.target_m)
                )
                if setup is None and dataset.origin == "simulation":
                    setup = named_setup(self.data / "dataset.yaml")
            with progress.stage("report", "images, films and page", 1, 2):
                path = write_report(self.out, dataset, results, [], self.split, setup, limits)
        about: dict[str, Any] = {"report": str(path), "csv": str(path.with_suffix(".csv"))}
        about["runs"] = {r.name: r.evaluation.scores.mean() for r in results}
        about["baselines"] = {name: scores.mean() for name, scores in baselines_of(results).items()}
        result(self.json, about, f"{to_text(results)}\nreport: {path}")
