"""`evnlos invert CAPTURE... --setup SETUP`: one picture of each object from its whole pass."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cli.notes import say
from evnlos.dataset import Capture, load_pattern, read_capture
from evnlos.dataset.sampling import Sampling
from evnlos.errors import ConfigError
from evnlos.metrics import psnr
from evnlos.scene import Target
from evnlos.setups import Setup, load_setup
from evnlos.setups.base import linear_kinds
from evnlos.solver import JointProblem, PlatePass
from evnlos.solver.plate_pass import matrix_of, strip_gram_of, strip_of
from evnlos.solver.recording import object_light, position_subsets
from evnlos.types import Plane


@dataclass(frozen=True)
class PassOptions:
    """What `evnlos invert` was told about captures."""

    setup: Path
    positions: tuple[int, ...]
    pattern: Path | None
    track: bool
    solvers: tuple[str, ...]
    lam: dict[str, float | None]
    cells: int
    columns: int
    static: float
    subsets: int


def linear_setup(word: Path | str) -> Setup:
    """Return the setup of a word (see `load_setup`), which has to be linear.

    Raises:
        ConfigError: It is of another kind, or there is none.
    """
    setup = load_setup(word)
    if not setup.is_linear:
        raise ConfigError(
            f"{word} holds a setup of kind {setup.kind}, which is not linear; give one of kind "
            f"{' or '.join(linear_kinds())}"
        )
    return setup


def invert_captures(
    folders: Sequence[Path], options: PassOptions
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the figures, and the plates [cells, cells] by name, of every capture and solver."""
    clock = time.perf_counter()
    setup = linear_setup(options.setup)
    captures = [read_capture(folder) for folder in folders]
    pattern = None if options.pattern is None else load_pattern(options.pattern)
    height, width = captures[0].frames.shape[1:]
    if any(capture.frames.shape != captures[0].frames.shape for capture in captures):
        raise ConfigError(
            "the captures differ in the number or the size of their frames; invert them one by one"
        )
    columns = min(options.columns, width)
    shape = (max(1, round(height * columns / width)), columns)
    light = torch.stack([object_light(c.frames[1:], c.peak, setup, shape, pattern) for c in captures])
    pictures: dict[str, torch.Tensor] = {}
    rows: list[dict[str, Any]] = []
    for motion, members in _by_motion(captures, options, setup):
        size = _plate_m(captures[members[0]], _is_tracked(captures[members[0]], options))
        plate = Plane(options.cells, options.cells, size / options.cells)
        transport = matrix_of(setup.resized((height, width)).operator(strip_of(motion, plate), shape))
        gram = strip_gram_of(transport)
        for count in options.positions or (len(motion),):
            for chosen in position_subsets(len(motion), count, options.subsets):
                problem = JointProblem(PlatePass(transport, plate, motion[chosen]), options.static, gram)
                images = light[members][:, chosen]
                for solver in options.solvers:
                    found = _solve(problem, images, solver, options.lam[solver])
                    for member, image in zip(members, found, strict=True):
                        name = captures[member].name
                        db = _score(captures[member], image, size, motion)
                        rows.append({"capture": name, "positions": count, "solver": solver, "psnr_db": db})
                        pictures[f"{name}_{solver}_{count}"] = image
    figures = {"setup": str(options.setup), "captures": [c.name for c in captures], "rows": rows}
    figures["seconds"] = round(time.perf_counter() - clock, 1)
    return figures, pictures


def pass_table(rows: list[dict[str, Any]]) -> str:
    """Return mean PSNR by number of positions and solver, over captures and subsets, as lines for people."""
    solvers = list(dict.fromkeys(row["solver"] for row in rows))
    lines = ["positions " + "".join(f"{s:>12}" for s in solvers)]
    for count in dict.fromkeys(row["positions"] for row in rows):
        values = []
        for solver in solvers:
            known = [r["psnr_db"] for r in rows if (r["positions"], r["solver"]) == (count, solver)]
            db = [v for v in known if v is not None]
            values.append(f"{np.mean(db):9.2f} dB" if db else f"{'-':>12}")
        lines.append(f"{count:9d} " + "".join(values))
    return "\n".join(lines)


def pass_text(found: dict[str, Any]) -> str:
    """Return the figures as lines for people."""
    return f"{' '.join(found['captures'])}\n{pass_table(found['rows'])}\n{found['seconds']} s"


def print_pass(found: dict[str, Any], as_json: bool) -> None:
    """Print the figures."""
    print(json.dumps(found) if as_json else pass_text(found))


def _solve(problem: JointProblem, images: torch.Tensor, solver: str, factor: float | None) -> torch.Tensor:
    first = problem.tikhonov(images)
    if factor is None:
        return first.image
    lam = factor * first.noise_sigma**2
    if solver == "tikhonov":
        return problem.tikhonov(images, lam).image
    found = problem.total_variation(images, lam, tolerance=1e-5)
    if not found.converged:
        say(f"warning: tv stopped after {found.iterations} iterations before it had converged")
    return found.image


def _by_motion(
    captures: Sequence[Capture], options: PassOptions, setup: Setup
) -> list[tuple[NDArray[np.float64], list[int]]]:
    """Return each motion [N, 2], metres, of frames 1..N with the captures that share it."""
    groups: dict[bytes, tuple[NDArray[np.float64], list[int]]] = {}
    for k, capture in enumerate(captures):
        if _is_tracked(capture, options):
            from evnlos.tracking import track_capture, track_doubts

            found = track_capture(capture, setup)
            for doubt in track_doubts(capture, setup, found):
                say(f"warning: {capture.name}: {doubt}")
            motion = found.at(capture.frame_times_us[1:] * 1e-6)
        else:
            assert capture.motion is not None  # else it would be tracked
            motion = capture.motion.position_m(capture.frame_times_us[1:] * 1e-6)
        groups.setdefault(motion.tobytes(), (motion, []))[1].append(k)
    return list(groups.values())


def _is_tracked(capture: Capture, options: PassOptions) -> bool:
    return options.track or capture.motion is None


def _plate_m(capture: Capture, tracked: bool) -> float:
    # A tracked position is that of the light's middle, which need not be the plate's.
    size = 0.08 if capture.info.target is None else capture.info.target.plate_m
    return 1.25 * size if tracked else size


def _score(capture: Capture, image: torch.Tensor, size_m: float, motion: NDArray[np.float64]) -> float | None:
    scene = capture.scene
    if scene is None:
        return None
    sampling = Sampling()
    plate = Target("found", image.clamp(0, 1).float().numpy(), size_m)
    drawn = plate.rasterise(sampling.canvas, motion)
    truth = scene.truth(sampling.canvas, capture.frame_times_us[1:] * 1e-6)
    rows = sampling.scored
    return round(float(psnr(torch.from_numpy(drawn[:, rows]), torch.from_numpy(truth[:, rows])).mean()), 3)
