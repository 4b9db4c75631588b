"""A calibration as a table, as plain values, and as files."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evnlos.calibration.fit import RigFit
from evnlos.calibration.residual import Residual
from evnlos.config import save_yaml, write_atomically
from evnlos.dataset.fixed_pattern import PATTERN_FILE, save_pattern
from evnlos.errors import ConfigError, DataError
from evnlos.version import __version__

RIG_FILE, TRAINING_FILE, FIGURES_FILE = "rig.yaml", "training.yaml", "calibration.json"

_UNTOLD = "not told by unknown targets: arbitrary"
_ANOTHER_WALL = "the wall may be of another kind: measure its transport (evnlos scan), or try"
_TRY = {"known": "another --preset or start", "unknown": "known targets or another start"}


@dataclass(frozen=True)
class Row:
    """One fitted number.

    Args:
        name: Dotted name in the simulation's settings.
        before: Its value at the start.
        after: Its fitted value.
        error: Standard error; None where none is known.
        unit: Its unit.
        note: What the captures say about it, beyond a number.
    """

    name: str
    before: float
    after: float
    error: float | None
    unit: str
    note: str = ""


def rows_of(fit: RigFit, start_pixel: Any, start_camera: Any) -> list[Row]:
    """Return all fitted numbers: optics, light, frame camera, event pixel.

    Args:
        fit: The calibration.
        start_pixel: Event pixel of the start.
        start_camera: Frame camera of the start.
    """
    optics = fit.optics
    first, last = optics.before, optics.transport
    bound = {name: f"on the bound of the search: {value:.4g}" for name, value in optics.on_bound.items()}
    rows = [
        Row(f"transport.{p.name}", p.read(first), p.read(last), float(e), p.unit, bound.get(p.name, ""))
        for p, e in zip(optics.parameters, optics.error, strict=True)
    ]
    gain = _UNTOLD if fit.targets == "unknown" else ""
    rows += [
        Row("transport.gain", first.gain, last.gain, None, "white levels", gain),
        Row("transport.ambient", first.ambient, last.ambient, None, "white levels"),
    ]
    rows += [
        Row(f"transport.ambient_gradient.{k}", first.ambient_gradient[k], last.ambient_gradient[k], None, "")
        for k in range(2)
    ]
    camera = fit.noise.camera
    units = {"full_well_e": "electrons", "read_noise_e": "electrons", "prnu": "", "dsnu_e": "electrons"}
    rows += [
        Row(f"frame_camera.{name}", getattr(start_camera, name), getattr(camera, name), None, unit)
        for name, unit in units.items()
    ]
    left = zip(("prnu", "dsnu_e"), fit.noise.remaining, strict=True)
    rows += [
        Row(f"{name} after correction", getattr(camera, name), value, None, units[name]) for name, value in left
    ]
    return rows + _pixel_rows(fit, start_pixel)


def _pixel_rows(fit: RigFit, start: Any) -> list[Row]:
    if fit.pixel is None:
        return []
    pixel, error = fit.pixel.pixel, fit.pixel.error
    rows = [
        Row(f"pixel.{name}", getattr(start, name), getattr(pixel, name), error[name], unit)
        for name, unit in (
            ("threshold_on", "log units"),
            ("threshold_off", "log units"),
            ("threshold_sigma", "log units"),
            ("leak_rate_hz", "Hz"),
            ("shot_noise_rate_hz", "Hz"),
        )
    ]
    low, high = fit.pixel.cutoff_range_hz
    rows.append(
        Row(
            "pixel.cutoff_hz",
            start.cutoff_hz,
            pixel.cutoff_hz,
            None,
            "Hz",
            f"of those tried: {low:g} to {high:g}",
        )
    )
    bound = f"not identified: at most {fit.pixel.dead_time_s:g}"
    rows.append(Row("pixel.refractory_s", start.refractory_s, pixel.refractory_s, None, "s", bound))
    return rows


def table(rows: list[Row]) -> str:
    """Return the rows as a text table: parameter, before, after, standard error, unit."""
    cells = [["parameter", "before", "after", "+-", "unit"]]
    for row in rows:
        error = "" if row.error is None else "unknown" if math.isinf(row.error) else f"{row.error:.2g}"
        cells.append(
            [row.name, f"{row.before:.4g}", f"{row.after:.4g}", error, " ".join((row.unit, row.note)).strip()]
        )
    return _aligned(cells)


def residual_table(fit: RigFit) -> str:
    """Return the residuals as a text table, in per cent of the standard deviation of what the camera saw."""
    cells = [["residual, % of standard deviation", "before", "after", "noise alone"]]
    for name, r in fit.residuals.items():
        cells.append([name, *(f"{100 * v:.1f}" for v in (r.before, r.after, r.noise))])
    return _aligned(cells)


def _aligned(cells: list[list[str]]) -> str:
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join(lines)


def warnings_of(fit: RigFit) -> list[str]:
    """Return why a fit should not be believed as it stands, one line each; none where nothing was found."""
    found, cure = [], f"{_ANOTHER_WALL} {_TRY[fit.targets]}"
    if on_bound := fit.optics.on_bound:
        names = ", ".join(f"transport.{name} ({value:.4g})" for name, value in on_bound.items())
        found.append(f"{names}: ended on the bound of the search, so its error means nothing; {cure}")
    if fit.unexplained is not None:
        found.append(f"{_left(fit.unexplained)}; {cure}")
    return found


def _left(r: Residual) -> str:
    return (
        f"frames held out, without pattern: {100 * r.after:.1f} % is left where noise alone leaves "
        f"{100 * r.noise:.1f} %"
    )


def figures(fit: RigFit, rows: list[Row]) -> dict[str, Any]:
    """Return a calibration as plain values for JSON; an unknown error is null."""
    return {
        "evnlos": __version__,
        "fitted": list(fit.fitted),
        "held_out": list(fit.held_out),
        "targets": fit.targets,
        "worse_on_held_out": list(fit.worse),
        "on_bound": [f"transport.{name}" for name in fit.optics.on_bound],
        "warnings": warnings_of(fit),
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


def check_out(out: Path, force: bool) -> None:
    """Refuse a folder that already holds a rig, so that an old one is never taken for a new one.

    Raises:
        ConfigError: The folder is a file or holds a rig file.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; give a folder for the rig")
    if (out / RIG_FILE).exists() and not force:
        raise ConfigError(f"{out / RIG_FILE} exists; give another folder, or --force to replace it")


def rig_file(path: Path) -> Path:
    """Return the rig file of a folder that `calibrate` wrote; any other path stays as it is.

    Example:
        >>> str(rig_file(Path("rig.yaml")))
        'rig.yaml'
    """
    return path / RIG_FILE if (path / RIG_FILE).is_file() else path


def write_rig(fit: RigFit, rows: list[Row], out: Path, force: bool = False) -> Path:
    """Write `calibration.json` and, where the fit stands on captures that it has not seen, the rig.

    The rig is `rig.yaml` (the simulation that matches it), `training.yaml` (that simulation, varied, to
    pre-train on) and `pattern.safetensors` (the frame camera's fixed pattern, for `import --pattern`).

    Args:
        fit: The calibration.
        rows: Its numbers (see `rows_of`).
        out: Folder; made where it is missing.
        force: Write the rig file although the fit is no better on the held-out captures, or one exists.

    Returns:
        The rig file, which `evnlos simulate --config` takes.

    Raises:
        DataError: The fit is no better than the start on the held-out captures, or, with unknown targets,
            leaves them far above the noise.
    """
    check_out(out, force)
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / FIGURES_FILE, json.dumps(figures(fit, rows), indent=2).encode())
    if fit.worse and not force:
        name = fit.worse[0]
        r = fit.residuals[name]
        raise DataError(
            f"{name}: the residual went from {100 * r.before:.1f} % to {100 * r.after:.1f} %, so it is no fit "
            "of the rig and no rig file was written; check that all captures show one unmoved rig, try another "
            "--preset or start, or --no-events where only events got worse"
        )
    if fit.targets == "unknown" and fit.unexplained is not None and not force:
        raise DataError(
            f"{_left(fit.unexplained)}, so it is no fit of the rig and no rig file was written; "
            f"{_ANOTHER_WALL} {_TRY[fit.targets]}"
        )
    save_pattern(fit.noise.pattern, out / PATTERN_FILE)
    save_yaml(fit.training, out / TRAINING_FILE)
    save_yaml(fit.simulation, out / RIG_FILE)
    return out / RIG_FILE
