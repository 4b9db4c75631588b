"""What `evnlos invert` does with captures and with still images.

- `CAPTURE... --setup SETUP`: one image of each object from its whole sequence, grey or in colour.
- `PICTURE... --setup transport.safetensors`: still images of the wall, a measured setup.
- `CAPTURE... --setup SETUP --from events|frames|both`: one likelihood of a whole sequence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.analysis import scored_sampling, target_psnr
from evnlos.analysis.bounds import canvas_decibel
from evnlos.calibration.scan.importer import stills_as_scanned
from evnlos.cli.parsing import say
from evnlos.data import Capture, pattern_of, read_capture
from evnlos.data.fixed_pattern import object_light
from evnlos.data.sampling import read_target
from evnlos.errors import ConfigError
from evnlos.inverse import TRACKED_ROOM, SequenceLights, SequenceOperator, SequenceProblem, unexplained
from evnlos.inverse.inversion import Inversion, chosen_degree
from evnlos.inverse.operators import Solution
from evnlos.inverse.sequence_problem import matrix_of, position_subsets, strip_gram_of, strip_of
from evnlos.inverse.tikhonov import Rule
from evnlos.machine import Progress, Step, counted, silent
from evnlos.models import TargetEstimate, estimate_target, load_prior
from evnlos.setups import Setup
from evnlos.setups.load import linear_setup, measured_setup
from evnlos.tracking import temporal_noise
from evnlos.types import COLOURS, Colour, Evidence, Plane


@dataclass(frozen=True)
class SequenceOptions:
    """What `evnlos invert` was told about captures."""

    setup: Path
    positions: tuple[int, ...]
    pattern: Path | None
    track: bool
    solvers: tuple[str, ...]
    regularization: dict[str, float | None]
    cells: int
    columns: int
    static: float
    subsets: int
    colour: Colour | None = None


def invert_captures(
    folders: Sequence[Path], options: SequenceOptions, progress: Progress = silent
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the figures, and the targets [cells, cells] by name, of every capture and solver."""
    clock = time.perf_counter()
    setup = linear_setup(options.setup)
    reads = counted(folders, progress, "read", len(folders), "captures")
    captures = [read_capture(one, needs_events=False, colour=options.colour) for one in reads]
    pattern = pattern_of(options.setup, options.pattern) if options.colour is None else None  # of grey frames
    height, width = captures[0].frames.shape[1:]
    if any(capture.frames.shape != captures[0].frames.shape for capture in captures):
        raise ConfigError("the captures differ in number or size of their frames; invert them one by one")
    columns = min(options.columns, width)
    shape = (max(1, round(height * columns / width)), columns)
    # Of all three colours the setup is that of grey; of one that capture.yaml chose it is its own.
    whites = [one.peak * (one.info.camera.balance if options.colour else 1.0) for one in captures]
    pairs = zip(captures, whites, strict=True)
    light = torch.stack([object_light(one.frames[1:], white, setup, shape, pattern) for one, white in pairs])
    noise = torch.tensor([temporal_noise(one.numpy()) if len(one) > 2 else math.inf for one in light])
    pictures, rows = dict[str, torch.Tensor](), list[dict[str, Any]]()
    groups = _by_motion(captures, options, setup, progress)
    for done, (motion, members) in enumerate(counted(groups, progress, "invert", len(groups), "motions")):
        size = captures[members[0]].info.target_size_m
        if _is_tracked(captures[members[0]], options.track):
            size *= TRACKED_ROOM
        target_plane = Plane(options.cells, options.cells, size / options.cells)
        progress(Step("invert", done, len(groups), "motions", within="light path of the setup"))
        transport = matrix_of(setup.seen_by((height, width)).operator(strip_of(motion, target_plane), shape))
        gram = strip_gram_of(transport)
        for count in options.positions or (len(motion),):
            for chosen in position_subsets(len(motion), count, options.subsets):
                problem = SequenceProblem(
                    SequenceOperator(transport, target_plane, motion[chosen]), options.static, gram
                )
                images = light[members][:, chosen]
                free = problem.tikhonov(images)  # weighted by generalised cross-validation
                shares: list[float | None] = [None] * len(members)
                if count > 2:
                    told = unexplained(free, problem.samples, images, noise[members]).tolist()
                    # Behind a mosaic neighbours share their noise, and where nothing moves there is no share.
                    known = [captures[k].info.camera.mosaic is None for k in members]
                    shares = [a if ok and a < math.inf else None for a, ok in zip(told, known, strict=True)]
                for solver in options.solvers:
                    progress(Step("invert", done, len(groups), "motions", within=f"{solver}, {count} places"))
                    found = _solve(problem, images, solver, options.regularization[solver], free)
                    for member, image, share in zip(members, found, shares, strict=True):
                        one, name = captures[member], captures[member].name
                        row = {"capture": name, "positions": count, "solver": solver, "unexplained": share}
                        row |= {"level": _level(one, image, target_plane), "side_m": size}
                        rows.append({**row, "psnr_db": target_psnr(one, image, size, motion)})
                        pictures[f"{name}_{solver}_{count}"] = image
                        if one.target is not None and options.colour is None:
                            pictures[f"{name} truth"] = _truth(one, target_plane)
    figures = {"setup": str(options.setup), "captures": [c.name for c in captures], "rows": rows}
    return {**figures, "seconds": round(time.perf_counter() - clock, 1)}, pictures


def _level(capture: Capture, image: torch.Tensor, plane: Plane) -> float | None:
    """Return how bright an image is over the truth, by least squares; None where that is not known."""
    if capture.target is None:
        return None
    truth = _truth(capture, plane).to(image)
    if not truth.any():  # a colour that it does not have
        return None
    return round(float((image * truth).sum() / truth.square().sum().clamp(min=1e-12)), 3)


def _truth(capture: Capture, plane: Plane) -> torch.Tensor:
    assert capture.target is not None
    return torch.from_numpy(capture.target.rasterise(plane))


def invert_colours(
    folders: Sequence[Path], options: SequenceOptions, progress: Progress = silent
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return what `invert_captures` does, of red, green and blue: targets [3, cells, cells].

    A PSNR is that of the mean square over the colours; `level` is how bright each is over the truth.

    Raises:
        ConfigError: The frames are grey.
    """
    parts = [invert_captures(folders, replace(options, colour=one), progress) for one in COLOURS]
    pictures = {name: torch.stack([found[name] for _, found in parts]) for name in parts[0][1]}
    for name, image in pictures.items():
        _check_coloured(name, image)
    rows = []
    for same in zip(*(figures["rows"] for figures, _ in parts), strict=True):
        # The least, as a colour that the target hardly has tells nothing of the setup.
        shares = [row["unexplained"] for row in same if row["unexplained"] is not None]
        row = {**same[0], "unexplained": min(shares, default=None), "level": [row["level"] for row in same]}
        rows.append({**row, "psnr_db": _decibel_of(same, "psnr_db")})
    seconds = sum(figures["seconds"] for figures, _ in parts)
    return {**parts[0][0], "rows": rows, "seconds": round(seconds, 1)}, pictures


def _check_coloured(name: str, images: Sequence[Any] | torch.Tensor) -> None:
    """Raise `ConfigError` where red, green and blue are the same."""
    if all(np.array_equal(images[0], one) for one in images):
        raise ConfigError(f"{name}: its frames are grey; leave it or --colours, or state camera.mosaic")


def _decibel_of(rows: Sequence[dict[str, Any]], key: str) -> float | None:
    """Return the decibels of the mean square over the colours; None where none is known."""
    errors = [10 ** (-0.1 * row[key]) for row in rows if row[key] is not None]
    return round(-10 * math.log10(np.mean(errors)), 3) if errors else None


def _solve(
    problem: SequenceProblem, images: torch.Tensor, solver: str, factor: float | None, free: Solution
) -> torch.Tensor:
    if factor is None:
        return free.image
    if solver == "tikhonov":
        return problem.tikhonov(images, factor * free.noise_sigma**2).image
    found = problem.total_variation(images, factor * free.noise_sigma**2, tolerance=1e-5)
    if not found.converged:
        say(f"warning: tv stopped after {found.iterations} iterations before it had converged")
    return found.image


def _by_motion(
    captures: Sequence[Capture], options: SequenceOptions, setup: Setup, progress: Progress
) -> list[tuple[NDArray[np.float64], list[int]]]:
    """Return each motion [N, 2], metres, of frames 1..N with the captures that share it."""
    groups: dict[bytes, tuple[NDArray[np.float64], list[int]]] = {}
    for k, capture in enumerate(captures):
        if _is_tracked(capture, options.track):
            if options.colour is not None:  # each colour would be centred on its own light
                cure = "state it in capture.yaml (`evnlos track` finds it), and leave --track"
                raise ConfigError(f"{capture.name}: --colours needs a motion that is known; {cure}")
            progress(Step("track", k, len(captures), "captures", within=capture.name))
            way = _followed(capture, setup).path
        else:
            way = capture.motion and capture.motion.in_its_plane()
        assert way is not None  # what states no motion is tracked
        motion = way.position_m(capture.frame_times_us[1:] * 1e-6)
        groups.setdefault(motion.tobytes(), (motion, []))[1].append(k)
    return list(groups.values())


def _followed(capture: Capture, setup: Setup, *, by_frames: bool = True) -> Capture:
    """Return a capture with the path that its frames, or its events alone, show; say where it may be wrong."""
    from evnlos.tracking import Tracking, track_capture, track_warnings

    found = track_capture(capture, setup, Tracking(frames=by_frames))
    for warning in track_warnings(capture, setup, found):
        say(f"warning: {capture.name}: {warning}")
    return replace(capture, path=found.motion)


def _is_tracked(capture: Capture, track: bool) -> bool:
    return track or capture.motion is None


@dataclass(frozen=True)
class StillOptions:
    """What `evnlos invert` was told about still images."""

    dark: Path | None
    solvers: tuple[Literal["tikhonov", "tv"], ...]
    regularization: float | None
    rule: Rule
    noise_sigma: float | None
    degree: int | None
    bin: int | None


def invert_stills(
    files: Sequence[Path], setup: Setup, options: StillOptions
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the figures, and the images [files, h, w] on the scanned cells by solver.

    Raises:
        ConfigError: As for `stills_as_scanned`.
        DataError: An image can't be read.
    """
    clock = time.perf_counter()
    operator, image = stills_as_scanned(files, setup, options.dark, options.bin)
    degree = chosen_degree(operator, image) if options.degree is None else options.degree
    found: dict[str, Any] = {"files": [str(path) for path in files], "setup": setup.wall_description()}
    found |= {"wall": list(operator.shape), "background_degree": degree, "solutions": {}}
    images: dict[str, torch.Tensor] = {}
    inversion = Inversion(operator, image, degree)
    for name in options.solvers:
        solution = inversion.solve(name, options.regularization, options.rule, options.noise_sigma)
        found["solutions"][name] = figures_of(name, solution)
        images[name] = solution.image
    return {**found, "seconds": round(time.perf_counter() - clock, 1)}, images


def figures_of(name: str, solution: Solution) -> dict[str, Any]:
    """Return the figures of a solution, with a warning where the solver gave up."""
    if not solution.converged:
        say(f"warning: {name} stopped after {solution.iterations} iterations before it had converged")
    return {
        "regularization": solution.regularization,
        "misfit": solution.noise_sigma,
        "iterations": solution.iterations,
    }


_SHOWN = 3  # samples that stand beside an image


def estimate_captures(
    folders: Sequence[Path],
    word: Path,
    evidence: Evidence,
    pattern: Path | None,
    samples: int = 0,
    progress: Progress = silent,
    colours: bool = False,
    track: bool = False,
    pixel: str | None = None,
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the figures, and of each capture the target [cells, cells] and its standard deviation, by name.

    Args:
        folders: Capture folders of one setup.
        word: Their setup.
        evidence: What the likelihood is made of.
        pattern: Fixed pattern of the frame camera, by default the one in the setup's folder; without any an
            offset of each pixel is integrated out.
        samples: Samples under the learned prior; 0: the Gaussian prior, without any.
        progress: Called as each capture is done.
        colours: Whether the target is solved in red, green and blue: [3, cells, cells].
        track: Whether the motion is found, by frames where they count, also where it is stated.
        pixel: The event pixel instead of the setup's, as `--pixel` takes it.

    Raises:
        ConfigError: The setup is not linear or has no law of events, a motion is unknown, or colours are grey.
    """
    (setup, maps), prior = measured_setup(word, pixel), load_prior() if samples else None
    removed = None if colours or evidence == "events" else pattern_of(word, pattern)
    how = evidence, removed, prior, samples, SequenceLights()
    rows, pictures = [], {}
    for folder in counted(folders, progress, "invert", len(folders), "captures"):
        seen = _read_colours(folder, evidence) if colours else {None: capture_of(folder, evidence)}
        if (one := seen.get(None)) is not None and _is_tracked(one, track):
            seen = {None: _followed(one, setup, by_frames=evidence != "events")}
        each = [estimate_target(one, setup, *how, colour, maps) for colour, one in seen.items()]
        parts = [_row(*pair) for pair in zip(seen.values(), each, strict=True)]
        rows.append(_row_of_colours(parts) if colours else parts[0])
        parted = {(name := parts[0]["capture"]): [torch.from_numpy(one.image) for one in each]}
        parted[f"{name} deviation"] = [torch.from_numpy(one.deviation) for one in each]
        if all(capture.target is not None for capture in seen.values()):
            parted[f"{name} truth"] = [_truth(capture, each[0].plane) for capture in seen.values()]
        pictures |= {key: torch.stack(ones) if colours else ones[0] for key, ones in parted.items()}
        if (drawn := each[0].samples) is not None:
            shown = {f"{name} sample {k}": one for k, one in enumerate(drawn[:_SHOWN], 1)}
            pictures |= {**shown, f"{name} samples": drawn}
    return {"setup": str(word), "from": evidence, "rows": rows}, pictures


def capture_of(folder: Path, evidence: Evidence, colour: Colour | None = None) -> Capture:
    """Return a capture, refused where it lacks what the evidence is made of."""
    needs_frames, needs_events = evidence != "events", evidence != "frames"
    return read_capture(folder, needs_frames=needs_frames, needs_events=needs_events, colour=colour)


def _read_colours(folder: Path, evidence: Evidence) -> dict[Colour | None, Capture]:
    """Return a capture in each colour; where events count alone its frames, which tell the time, stay grey."""
    if evidence != "events":
        found: dict[Colour | None, Capture] = {one: capture_of(folder, evidence, one) for one in COLOURS}
        _check_coloured(folder.name, [one.frames for one in found.values()])
        return found
    grey = capture_of(folder, evidence)
    return {one: replace(grey, target=read_target(folder, grey.info.target, one)) for one in COLOURS}


def _row_of_colours(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return lists of the figures of each colour; decibels are of the mean square, the time is that of all."""
    row: dict[str, Any] = {key: [one[key] for one in rows] for key in rows[0]}
    row |= {key: rows[0][key] for key in ("capture", "side_m")} | {"seconds": round(sum(row["seconds"]), 1)}
    return row | {key: _decibel_of(rows, key) for key in ("psnr_db", "expected_db")}


def _row(capture: Capture, found: TargetEstimate) -> dict[str, Any]:
    """Return the figures of a capture."""
    way = capture.path or capture.motion
    assert way is not None
    size, motion = found.plane.pitch_m * found.plane.width, way.position_m(capture.frame_times_us[1:] * 1e-6)
    seen, data = scored_sampling(capture.info.target_size_m, motion), found.likelihood
    row: dict[str, Any] = {
        "capture": capture.name,
        "psnr_db": target_psnr(capture, torch.from_numpy(found.image), size, motion),
        "expected_db": round(canvas_decibel(found.expected_error, found.plane, seen), 2),
        "level": _level(capture, torch.from_numpy(found.image), found.plane),
        "side_m": size,
    }
    if capture.target is not None and capture.path is None:  # a path is that of the light's middle
        truth = _truth(capture, found.plane).numpy()
        row["covered_90"] = round(float(((truth >= found.low) & (truth <= found.high)).mean()), 3)
    if found.samples is not None:
        row["open_share"] = round(found.open_share, 3)
    if math.isfinite(data.noise):
        row |= {
            "crossing_noise": round(data.noise, 4),
            "noise_share": round(data.noise_share, 3),
            "threshold_factors": [round(factor, 3) for factor in data.thresholds],
            "leak_per_s": round(data.leak, 4),
        }
    row["seconds"] = found.seconds
    return row


def sequence_text(found: dict[str, Any]) -> str:
    """Return the figures as lines for people."""
    is_learned = "open_share" in found["rows"][0]
    first = f"{'capture':12}{'PSNR':>9}{'expected':>10}{'in 90 %':>9}{'crossing':>10}{'noise':>7}{'CPU':>8}"
    lines = [first + (f"{'open':>7}" if is_learned else "")]
    for row in found["rows"]:
        psnr = "-" if row["psnr_db"] is None else f"{row['psnr_db']:.2f}"
        covered = f"{100 * np.mean(row['covered_90']):.0f} %" if "covered_90" in row else "-"
        crossing = f"{100 * np.mean(row['crossing_noise']):.1f} %" if "crossing_noise" in row else "-"
        share = f"{100 * np.mean(row['noise_share']):.0f} %" if "noise_share" in row else "-"
        lines.append(
            f"{row['capture']:12}{psnr:>9}{row['expected_db']:>10.2f}{covered:>9}{crossing:>10}{share:>7}"
            f"{row['seconds']:>6.1f} s" + (f"{100 * row['open_share']:>5.0f} %" if is_learned else "")
        )
    known = [row["psnr_db"] for row in found["rows"] if row["psnr_db"] is not None]
    if known:
        expected = float(np.mean([row["expected_db"] for row in found["rows"]]))
        lines.append(f"{'mean':12}{float(np.mean(known)):>9.2f}{expected:>10.2f}")
    if is_learned:
        lines.append("open: cells that the data leave open; what a sample shows there may be invented")
    return "\n".join(lines)


def sequence_table(rows: list[dict[str, Any]]) -> str:
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
