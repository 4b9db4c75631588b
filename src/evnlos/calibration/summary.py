"""A calibration from captures to files: the verb `calibrate`, and what it found as a table and plain values."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from evnlos.calibration.captures import Calibration
from evnlos.calibration.event_fit import EVENT_RESIDUALS, Row, event_warnings, pixel_rows, went
from evnlos.calibration.event_statistics import write_event_errors
from evnlos.calibration.fit import SetupFit, fit_setup
from evnlos.calibration.frame_model import FITTED
from evnlos.calibration.transport_fit import Residual, values_of
from evnlos.calibration.wall_search import curve_warning
from evnlos.config import save_yaml
from evnlos.data import captures_in, randomized
from evnlos.data.fixed_pattern import PATTERN_FILE, save_pattern
from evnlos.data.simulate import Simulation
from evnlos.errors import ConfigError, DataError, MissingDependencyError, UnknownNameError
from evnlos.files import write_atomically
from evnlos.machine import Progress, silent
from evnlos.registry import __version__, kind_of
from evnlos.scene import HandwritingGlyphs, find_font
from evnlos.scene.handwriting import FACES
from evnlos.setups import CALIBRATED_FILE, TRAINING_FILE
from evnlos.types import aligned

CALIBRATION_VALUES_FILE = "calibration.json"
TARGETS = "targets"
"""Folder, beside the setup's file, of the known targets' images."""

_SOME_OF_COUNTS = 1.1  # times what noise leaves of counts held out: from there on less comes of events
_GOOD, _FAIR, _POOR = 3.0, 6.0, 10.0  # per cent of the light beside the noise
_LEAST_GAIN_DB = 1.0  # of the best linear image over the mean target: matte walls have 0.5 to 0.8
_DOUBTED = 100.0  # times the noise's variance: the light path misses what the frames would tell

_UNTOLD = "not told by unknown targets: arbitrary"
_ANOTHER_WALL = "the wall may be of another kind: measure its transport (evnlos scan), or try"
_TRY = {"known": "another --preset or start", "unknown": "known targets or another start"}


def rows_of(fit: SetupFit, start_pixel: Any, start_camera: Any) -> list[Row]:
    """Return all fitted numbers: optics, light, frame camera, event pixel.

    Args:
        fit: The calibration.
        start_pixel: Event pixel of the start.
        start_camera: Frame camera of the start.
    """
    optics = fit.optics
    first, last = optics.before, optics.setup
    start, end = values_of(first), values_of(last)
    bound = {name: f"on the bound of the search: {value:.4g}" for name, value in optics.on_bound.items()}
    rows = [
        Row(f"setup.{p.name}", start[p.name], end[p.name], float(e), p.unit, bound.get(p.name, ""))
        for p, e in zip(optics.parameters, optics.error, strict=True)
    ]
    gain, ambient = (_UNTOLD, "") if fit.targets == "unknown" else fit.light_words
    rows += [
        Row("setup.gain", first.gain, last.gain, None, "white levels", gain),
        Row("setup.ambient", first.ambient, last.ambient, None, "white levels", ambient),
    ]
    rows += [
        Row(f"setup.ambient_gradient.{k}", first.ambient_gradient[k], last.ambient_gradient[k], None, "")
        for k in range(2)
    ]
    camera, units = fit.noise.camera, FITTED[kind_of(fit.noise.camera)]
    start_camera = start_camera if kind_of(start_camera) == kind_of(camera) else type(camera)()
    rows += [
        Row(f"setup.frame_camera.{name}", getattr(start_camera, name), getattr(camera, name), None, unit)
        for name, unit in units.items()
    ]
    left = fit.noise.remaining
    rows += [Row(f"{n} after correction", getattr(camera, n), left[n], None, units[n]) for n in left]
    return rows if fit.pixel is None else rows + pixel_rows(fit.pixel, start_pixel)


def table(rows: list[Row]) -> str:
    """Return the rows as a text table: parameter, before, after, standard error, unit.

    Args:
        rows: Parameters before and after.
    """
    cells = [["parameter", "before", "after", "+-", "unit"]]
    for row in rows:
        error = "" if row.error is None else "unknown" if math.isinf(row.error) else f"{row.error:.2g}"
        cells.append(
            [row.name, f"{row.before:.4g}", f"{row.after:.4g}", error, " ".join((row.unit, row.note)).strip()]
        )
    return aligned(cells)


def residual_table(fit: SetupFit) -> str:
    """Return the residuals as a text table, in per cent of the standard deviation of what the camera saw.

    Args:
        fit: The calibration.
    """
    cells = [["residual, % of standard deviation", "before", "after", "noise alone"]]
    for name, r in fit.residuals.items():
        cells.append([name, *(f"{100 * v:.1f}" for v in (r.before, r.after, r.noise))])
    return aligned(cells)


def steps_table(fit: SetupFit) -> str:
    """Return how much each step of the fit of a wall explains, as a text table; empty for other setups.

    Args:
        fit: The calibration.
    """
    if not (steps := fit.simulation.setup.steps()):
        return ""
    cells = [["step of the wall's fit, % of what was left beside the noise", "taken away", ""]]
    cells += [[n, f"{100 * share:.1f}", "kept" if kept else "left out"] for n, (share, kept) in steps.items()]
    return aligned(cells)


def warnings_of(fit: SetupFit) -> list[str]:
    """Return why a fit should not be believed as it stands, one line each; none where nothing was found.

    Args:
        fit: The calibration.
    """
    found, cure = fit.stray_words + fit.motion_words, f"{_ANOTHER_WALL} {_TRY[fit.targets]}"
    if on_bound := fit.optics.on_bound:
        names = ", ".join(f"setup.{name} ({value:.4g})" for name, value in on_bound.items())
        found.append(f"{names}: ended on the bound of the search, so its error means nothing; {cure}")
    found += fit.saturated_words + curve_warning(fit.curved)
    if fit.unexplained is not None:
        found.append(f"{_left(fit.unexplained)}; {cure}")
    if little := _little_shown(fit):
        found.append(f"{little}, so expect little or nothing of any method")
    of_events = _event_warnings(fit)
    if not of_events and (other := _other_kind(fit)):
        found.append(other)
    if drawn := "sensors and walls" if fit.unexplained is not None else "event pixels" if of_events else "":
        of_events.append(f"{TRAINING_FILE} draws {drawn} from wide ranges around this fit")
    return [*found, *of_events]


def _little_shown(fit: SetupFit) -> str:
    """Return in words that one frame shows hardly more than the mean target; empty where it shows more."""
    if fit.shown is None or fit.shown.gain_db >= _LEAST_GAIN_DB:
        return ""
    return (
        f"one frame of this wall shows {fit.shown.patterns} patterns of a target above the noise, and its best "
        f"linear image is {fit.shown.gain_db:.1f} dB above the mean target"
    )


def is_of_no_use(fit: SetupFit) -> bool:
    """Return whether captures held out got worse, or the wall shows hardly anything: more than a warning."""
    return bool(fit.worse or _little_shown(fit))


def _to_train_on(fit: SetupFit) -> Simulation:
    """Return the simulation for training: what makes nothing like the recordings is drawn from wide ranges."""
    if fit.unexplained is None and not _event_warnings(fit):
        return fit.training
    return randomized(fit.training, walls=fit.unexplained is not None)


def _other_kind(fit: SetupFit) -> str:
    """Return in words that no event model makes events like the recorded ones; empty where one does."""
    if fit.pixel is None or fit.pixel.near:
        return ""
    return "captures held out: no event model makes such events, the sensor may be of another kind; fine-tune"


def _event_warnings(fit: SetupFit) -> list[str]:
    return [] if fit.pixel is None else event_warnings(fit.pixel, fit.residuals, fit.worse)


def expectation(fit: SetupFit) -> str:
    """Return in one line what training on the calibrated simulation can be expected to bring.

    Args:
        fit: The calibration.
    """
    left = fit.residuals["frames held out, without pattern"]
    share, frames = 100 * left.unexplained, "frames"
    if not left.after < 1:
        return f"EPNP: do not use this setup, its {frames} are further from the camera's than their mean"
    if little := _little_shown(fit):
        return f"EPNP, like any other method: expect little or nothing here; {little}"
    if fit.optics.on_bound:
        what = "not told, as a number of the setup ended on the bound of the search"
    elif share < _POOR and fit.frame_doubt >= _DOUBTED:
        what = f"only fine-tuned networks, as frames are doubted (variance of the noise x {fit.frame_doubt:g})"
    elif share < _GOOD:
        what = "ahead of end-to-end training, by 1 to 7 dB on the setups tried"
    elif share < _FAIR:
        what = "ahead of end-to-end training by about 1 dB"
    elif share < _POOR:
        what = "about level with end-to-end training; only fine-tuned networks"
    else:
        what = "behind end-to-end training; measure the wall instead (evnlos scan)"
    counts, events = fit.residuals.get("counts held out"), ""
    if _event_warnings(fit) or _other_kind(fit):
        events = "; events: not to be trusted without fine-tuning"
    elif counts is not None and counts.after > _SOME_OF_COUNTS * counts.noise:
        events = (
            f"; events: expect less, {100 * counts.after:.0f} % of their counts is left where noise leaves "
            f"{100 * counts.noise:.0f} %"
        )
    return f"EPNP on this setup: {what} ({share:.1f} % of the light unexplained beside the noise){events}"


def _left(r: Residual) -> str:
    return (
        f"frames held out, without pattern: {100 * r.after:.1f} % is left where noise alone leaves "
        f"{100 * r.noise:.1f} %"
    )


def calibration_values(fit: SetupFit, rows: list[Row]) -> dict[str, Any]:
    """Return a calibration as plain values for JSON; an unknown error is null.

    Args:
        fit: The calibration.
        rows: Parameters before and after.
    """
    return {
        "evnlos": __version__,
        "fitted": list(fit.fitted),
        "held_out": list(fit.held_out),
        "targets": fit.targets,
        "worse_on_held_out": list(fit.worse),
        "event_models": {} if fit.pixel is None else fit.pixel.compared,
        "on_bound": [f"setup.{name}" for name in fit.optics.on_bound],
        "warnings": warnings_of(fit),
        "expectation": expectation(fit),
        "shown": None if fit.shown is None else asdict(fit.shown),
        "own": {name: own._asdict() for name, own in zip(fit.captures, fit.own, strict=False)},
        "steps": {n: {"explained": e, "kept": k} for n, (e, k) in fit.simulation.setup.steps().items()},
        "residuals": {
            name: {"before": round(r.before, 5), "after": round(r.after, 5), "noise": round(r.noise, 5)}
            for name, r in fit.residuals.items()
        },
        "parameters": {
            row.name: {
                "before": row.before,
                "after": row.after,
                "error": None if row.error is None or math.isinf(row.error) else row.error,
                "unit": row.unit,
                "note": row.note,
            }
            for row in rows
        },
    }


def calibrate(
    captures: str | Path | Iterable[str | Path],
    out: str | Path | None = None,
    settings: Calibration | None = None,
    *,
    force: bool = False,
    look: Callable[[SetupFit], None] | None = None,
    progress: Progress = silent,
    workers: int = 1,
) -> SetupFit:
    """Fit the simulator to captures of a setup, check it on some that are held out, and write what was found.

    `warnings_of` says why a fit should not be believed as it stands, `expectation` what training on it brings.

    Args:
        captures: Capture folders of one setup and one camera, 3 or more.
        out: Folder for the files that `write_setup` names and, where events were fitted to known targets, for
            the errors of events (`events.safetensors`); None writes nothing.
        settings: What to hold out, what to fit and where to start; None is a wall of rough metal.
        force: Write the setup also where the fit fails on captures held out, or where the folder has one.
        look: Called with the fit before anything is written, also where writing is then refused.
        progress: Called as each stage begins.
        workers: Processes that solve the captures' events for their errors, 0 is one for each core.

    Returns:
        The calibrated simulation, its parameters' errors, and the residuals before and after.

    Raises:
        ConfigError: The folder is a file or holds a setup, or something is measured that the fit has no number
            for; nothing is read then.
        MissingDependencyError: A font of the handwriting for which the fitted wall is judged is missing;
            nothing is read then.
        DataError: As for `fit_setup`, and as for `write_setup`.
    """
    settings = Calibration() if settings is None else settings
    folders = [Path(one) for one in ([captures] if isinstance(captures, str | Path) else captures)]
    if out is not None:
        check_out(Path(out), force)
    if any(path.is_dir() for path in folders):
        captures_in(folders)  # a folder that is no capture is named, not counted
    _check_fonts()
    fit = fit_setup(folders, settings, progress)
    if look is not None:
        look(fit)
    if out is not None:
        rows = rows_of(fit, settings.start.pixel, settings.start.frame_camera)
        path = write_setup(fit, rows, Path(out), force)
        if fit.pixel is not None and fit.known:
            write_event_errors(path.parent, folders, fit.captures, progress, workers)
    return fit


def _check_fonts() -> None:
    """Refuse before the work where its last question, what the wall shows of handwriting, cannot be asked."""
    try:
        lacking = next((name for name in FACES["both"] if find_font(name).note), "")
    except (MissingDependencyError, UnknownNameError) as error:
        lacking = str(error).partition(";")[0]
    if lacking:
        cure = "pip install evnlos[fonts]"
        raise MissingDependencyError(
            f"the wall is judged for handwriting, whose fonts are missing ({lacking}); {cure}"
        )


def check_out(out: Path, force: bool) -> None:
    """Refuse a folder that already holds a setup, so that an old one is never taken for a new one.

    Raises:
        ConfigError: The folder is a file or holds a setup file.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; give a folder for the setup")
    if (out / CALIBRATED_FILE).exists() and not force:
        raise ConfigError(f"{out / CALIBRATED_FILE} exists; give another folder, or --force to replace it")


def write_setup(fit: SetupFit, rows: list[Row], out: Path, force: bool = False) -> Path:
    """Write `calibration.json` and, where the fit stands on captures that it has not seen, the setup.

    The setup is `setup.yaml` (the simulation that matches it), `training.yaml` (that simulation, varied, to
    pre-train on; `randomized` where no wall or no event pixel fits), `targets` (the known targets, which it
    draws again) and `pattern.safetensors` (the frame camera's fixed pattern, for `import --pattern`).

    Args:
        fit: The calibration.
        rows: Its numbers (see `rows_of`).
        out: Folder; made where it is missing.
        force: Write the setup file although the frames fit no better on the held-out captures, or one exists.

    Returns:
        The setup file, which `evnlos simulate --config` takes.

    Raises:
        DataError: Frames of held-out captures fit no better than at the start, or, with unknown targets, are
            left far above the noise. Where events alone fit no better the setup is written, and warns.
    """
    check_out(out, force)
    write_atomically(
        out / CALIBRATION_VALUES_FILE, json.dumps(calibration_values(fit, rows), indent=2).encode()
    )
    if (of_frames := [name for name in fit.worse if name not in EVENT_RESIDUALS]) and not force:
        raise DataError(
            f"{went(of_frames[0], fit.residuals)}, so it is no fit of the setup and no setup file was written; "
            "check that all captures show one unmoved setup, or try another --preset or start"
        )
    if fit.targets == "unknown" and fit.unexplained is not None and not force:
        raise DataError(
            f"{_left(fit.unexplained)}, so it is no fit of the setup and no setup file was written; "
            f"{_ANOTHER_WALL} {_TRY[fit.targets]}"
        )
    save_pattern(fit.noise.pattern, out / PATTERN_FILE)
    training = _with_targets(fit, _with_findings(fit, _to_train_on(fit), out), out / TARGETS)
    save_yaml(training, out / TRAINING_FILE)
    save_yaml(_with_findings(fit, fit.simulation, out), out / CALIBRATED_FILE)
    return out / CALIBRATED_FILE


def _with_findings(fit: SetupFit, simulation: Simulation, out: Path) -> Simulation:
    """Return the simulation with the fit's warnings, and a fitted wall's file in the setup's folder."""
    left = round(fit.residuals["frames held out, without pattern"].unexplained, 4)
    setup = replace(simulation.setup, misfit="; ".join(warnings_of(fit)))
    setup = setup.kept_in(out, unexplained=left, frame_doubt=fit.frame_doubt, ink=fit.ink)
    return replace(simulation, setup=setup)


def _with_targets(fit: SetupFit, simulation: Simulation, folder: Path) -> Simulation:
    """Return the simulation that draws the known targets again, about as many as those of its writers."""
    glyphs = simulation.glyphs
    if not fit.known or not isinstance(glyphs, HandwritingGlyphs):
        return simulation
    folder.mkdir(exist_ok=True)
    for name, mask in fit.known.items():
        picture = BytesIO()
        Image.fromarray(np.round(255 * np.clip(mask, 0, 1)).astype(np.uint8)).save(picture, "PNG")
        write_atomically(folder / f"{name}.png", picture.getvalue())
    each = max(1, round(glyphs.writers * len(glyphs.characters) / len(fit.known)))
    return replace(simulation, glyphs=replace(glyphs, known=str(folder.resolve()), redrawn=each))
