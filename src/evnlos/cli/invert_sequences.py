"""`evnlos invert CAPTURE... --setup SETUP --from events|frames|both`: one likelihood of a whole sequence."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from evnlos.analysis.bounds import canvas_decibel
from evnlos.cameras.light import WHITE_DN
from evnlos.cli.invert_captures import linear_setup, score
from evnlos.data import Capture, load_pattern, read_capture
from evnlos.errors import ConfigError
from evnlos.inverse import (
    FrameTerm,
    SequenceEstimate,
    estimate_sequence,
    handwritten_prior,
    record_of,
    sequence_light,
)
from evnlos.types import Plane

_CELLS, _COEFFICIENTS = 32, 120
_RANK = 120  # factors of the light path; more than a hundred rough walls do not have
_GAP_S = 0.4  # between the instants at which silences are looked at
_NORMAL_90 = 1.645
_FURTHEST = 0.15  # of fitted thresholds from the setup's, relative


def estimate_captures(
    folders: Sequence[Path], word: Path, evidence: Literal["frames", "events", "both"], pattern: Path | None
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the figures, and of each capture the target [cells, cells] and its standard deviation, by name.

    Args:
        folders: Capture folders of one setup, whose motion is stated.
        word: Their setup.
        evidence: What the likelihood is made of.
        pattern: Fixed pattern of the frame camera; without it an offset of each pixel is integrated out.

    Raises:
        ConfigError: The setup is not linear, its event model states no law, or a motion is unknown.
    """
    setup = linear_setup(word)
    known = None if pattern is None else load_pattern(pattern)
    lights: dict[Any, Any] = {}
    rows, pictures = [], {}
    for folder in folders:
        capture = read_capture(folder)
        motion = capture.motion
        if motion is None:
            raise ConfigError(
                f"{folder}: the motion is unknown; state it in capture.yaml (`evnlos track` finds it)"
            )
        size = capture.info.target_size_m
        prior = handwritten_prior(Plane(_CELLS, _CELLS, size / _CELLS), _COEFFICIENTS)
        span = (float(capture.frame_times_us[0]) * 1e-6, float(capture.frame_times_us[-1]) * 1e-6)
        shape = (capture.events.height, capture.events.width)
        key = (motion, span, shape, size)
        if key not in lights:
            lights[key] = sequence_light(setup, prior, motion.position_m, span, shape, _RANK)
        light = lights[key]
        begun = time.process_time()
        frames = record = law = None
        if evidence != "events":
            peak = float(capture.peak)
            levels = capture.frames / peak if known is None else known.correct(capture.frames, peak)
            values = np.asarray(levels, np.float64).reshape(len(levels), -1)
            times = np.asarray(capture.frame_times_us * 1e-6, np.float64)
            frames = FrameTerm(light, values, times, setup.frame_camera, known is not None)
        if evidence != "frames":
            typical = WHITE_DN * float(
                light.still.mean() + light.left.mean(axis=0) @ light.right[:, :, 0].mean(axis=0)
            )
            law = setup.pixel.crossing_law(typical)
            if law is None:
                raise ConfigError(
                    f"{word}: its event model states no law of its crossings; give one of kind continuous, "
                    "v2e, brownian or circuit, or --from frames"
                )
            record = record_of(capture.events, law, span, _GAP_S)
        found = estimate_sequence(light, prior, law, record, frames)
        row = _row(capture, found, prior.target_plane)
        row["seconds"] = round(time.process_time() - begun, 1)
        rows.append(row)
        pictures[capture.name] = torch.from_numpy(found.image)
        pictures[f"{capture.name} deviation"] = torch.from_numpy(found.deviation)
    return {"setup": str(word), "from": evidence, "rows": rows}, pictures


def _row(capture: Capture, found: SequenceEstimate, target_plane: Plane) -> dict[str, Any]:
    """Return the figures of a capture."""
    assert capture.motion is not None
    size = target_plane.pitch_m * target_plane.width
    motion = capture.motion.position_m(capture.frame_times_us[1:] * 1e-6)
    row: dict[str, Any] = {
        "capture": capture.name,
        "psnr_db": score(capture, torch.from_numpy(found.image), size, motion),
        "expected_db": round(canvas_decibel(found.expected_error, target_plane), 2),
    }
    if capture.target is not None:
        truth = capture.target.rasterise(target_plane)
        away = np.abs(found.image - truth) / found.deviation
        row["covered_90"] = round(float((away < _NORMAL_90).mean()), 3)
    if math.isfinite(found.noise):
        row |= {
            "crossing_noise": round(found.noise, 4),
            "noise_share": round(found.noise_share, 3),
            "threshold_factors": [round(factor, 3) for factor in found.thresholds],
            "leak_per_s": round(found.leak, 4),
        }
    return row


def sequence_doubts(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return why estimates from events are not to be believed, a line each."""
    return [
        f"{row['capture']}: the events fit the setup only with thresholds {row['threshold_factors']} times its "
        "own; do not believe the image, calibrate pixel and optics on this sensor"
        for row in rows
        if any(abs(factor - 1) > _FURTHEST for factor in row.get("threshold_factors", ()))
    ]


def sequence_text(found: dict[str, Any]) -> str:
    """Return the figures as lines for people."""
    lines = [f"{'capture':12}{'PSNR':>9}{'expected':>10}{'in 90 %':>9}{'crossing':>10}{'noise':>7}{'CPU':>8}"]
    for row in found["rows"]:
        psnr = "-" if row["psnr_db"] is None else f"{row['psnr_db']:.2f}"
        covered = f"{100 * row['covered_90']:.0f} %" if "covered_90" in row else "-"
        crossing = f"{100 * row['crossing_noise']:.1f} %" if "crossing_noise" in row else "-"
        share = f"{100 * row['noise_share']:.0f} %" if "noise_share" in row else "-"
        lines.append(
            f"{row['capture']:12}{psnr:>9}{row['expected_db']:>10.2f}{covered:>9}{crossing:>10}{share:>7}"
            f"{row['seconds']:>6.1f} s"
        )
    known = [row["psnr_db"] for row in found["rows"] if row["psnr_db"] is not None]
    if known:
        expected = float(np.mean([row["expected_db"] for row in found["rows"]]))
        lines.append(f"{'mean':12}{float(np.mean(known)):>9.2f}{expected:>10.2f}")
    return "\n".join(lines)
