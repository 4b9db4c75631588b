"""The reconstructions of one capture as files: a picture a position, a film strip, an animation."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evnlos.claim import check_folder
from evnlos.config import from_dict, load_yaml, write_atomically
from evnlos.dataset import (
    FixedPattern,
    Sampling,
    Simulation,
    capture_samples,
    read_capture,
)
from evnlos.errors import ConfigError
from evnlos.evaluation import reconstruct, score
from evnlos.evaluation.consistency import FrameOperator, consistent
from evnlos.evaluation.explained import light_gain
from evnlos.evaluation.worth import judgement_of, said, why_unjudged
from evnlos.model import load_weights, published_for, published_rig
from evnlos.report.pictures import grey, polarity, save_animation, save_png, stretched, strip
from evnlos.tracking import track_capture, track_doubts
from evnlos.transport import RadiometricTransport

_SAME_LIGHT = (0.75, 1.33)
"""Range of a capture's brightness, in that of its calibrated rig, in which the rig's gain is the capture's."""


def reconstruct_capture(
    capture: str | Path,
    weights: str | Path | None,
    out: str | Path,
    zoom: int = 4,
    pattern: FixedPattern | None = None,
    rig: Simulation | None = None,
    track: bool = False,
) -> dict[str, Any]:
    """Reconstruct all positions of a capture and write them as pictures.

    Writes `position_00.png` and on, `strip.png` (rows of positions), `animation.gif` (wall frame,
    surface, reconstruction and, where known, truth, side by side) and `reconstruction.npy` (float32
    [N, H, W], 0..1). Where the weights know what their pictures are worth and the motion is known, also
    `interval.npy` (the ends of each pixel's interval, float32 [2, N, H, W]) and `unsure.png`, a strip of the
    intervals' lengths (black is sure, white is anything).

    Args:
        capture: A capture folder; its target may be unknown.
        weights: A weights file, a run's folder or a name of `published`; None: the published frame weights of
            the rig whose distance is nearest, of whole passes where the motion is known or found.
        out: The folder for the pictures; must not exist or be empty.
        zoom: Size of a pixel in the pictures.
        pattern: Fixed pattern of the frame camera, to be taken from the frames.
        rig: The calibrated rig; the pictures are then moved to where the wall agrees with the frames, if these
            are as bright as the rig makes them, and the confidence says how much of the frames they explain.
            Without one, that is told by the rig of published weights, and the pictures stay.
        track: Find the motion in the recording with the rig, also where it is stated; the truth, where it is
            known, stays where the capture states it.

    Returns:
        Capture, weights, paradigm, number of positions; where the truth is known, the mean scores; where it can
        be told, the confidence: support, threshold, measured, verdict and, where a rig is known, explained;
        else no_confidence, which says why. With a rig also `light`, the capture's brightness in that of the
        rig, and whether the pictures were moved; with `track` the warnings of the track.

    Raises:
        ConfigError: `track` without a rig of kind radiometric.
        DataError: The capture or the weights can't be used, the object can't be tracked, or `out` holds other
            files.
    """
    out = Path(out)
    wall = _wall_for_track(rig) if track else None
    shot = read_capture(capture)
    if weights is None:
        distance_m = shot.distance_m or (None if rig is None else _distance_m(rig))
        weights = published_for(distance_m, "frame", is_motion_known=track or shot.motion is not None)
    loaded = load_weights(weights)
    sampling = from_dict(Sampling, loaded.sampling, source="the weights' sampling")
    samples = capture_samples(shot, sampling, pattern)
    check_folder(out)
    warnings: list[str] = []
    if wall is not None:
        path = track_capture(shot, wall, pattern=pattern)
        warnings = track_doubts(shot, wall, path)
        samples = replace(samples, position_m=path.at(samples.time_s))
    images = reconstruct(loaded, samples.frame, samples.surface, samples.position_m)
    unjudged = why_unjudged(loaded, samples)
    known = None if unjudged else published_rig(weights)  # an operator takes a second to make
    judge = rig or (load_yaml(Simulation, known) if known else None)
    operator = None if judge is None else FrameOperator(judge, sampling)
    worth = judgement_of(loaded, samples, images, operator)
    light = None
    if rig is not None and operator is not None:
        frames = torch.from_numpy(samples.frame)
        light = light_gain(images, frames, operator)
        if _is_the_rigs(light):
            images = consistent(images, frames, operator)
            if worth is not None:  # where the frames moved a level out of its interval, the interval follows
                worth = replace(worth, low=worth.low.minimum(images), high=worth.high.maximum(images))
    pictures = [grey(image) for image in images]
    out.mkdir(parents=True, exist_ok=True)
    for k, picture in enumerate(pictures):
        save_png(out / f"position_{k:02d}.png", picture, zoom)
    save_png(out / "strip.png", strip(pictures), 2)
    shown = []
    for k, picture in enumerate(pictures):
        row = [stretched(samples.frame[k]), polarity(samples.surface[k]), picture]
        if samples.truth is not None:
            row.append(grey(samples.truth[k]))
        shown.append(strip(row, columns=4))
    rate_hz = 1e6 / float(np.median(np.diff(shot.frame_times_us)))
    save_animation(out / "animation.gif", shown, rate_hz, 2)
    write_atomically(out / "reconstruction.npy", _npy(images.numpy()))
    found: dict[str, Any] = {
        "capture": shot.name,
        "weights": str(weights),
        "paradigm": loaded.paradigm,
        "positions": len(pictures),
    }
    if light is not None:
        found |= {"light": round(light, 4), "moved_by_the_rig": _is_the_rigs(light)}
    if worth is not None:
        save_png(out / "unsure.png", strip([grey(one) for one in worth.high - worth.low]), 2)
        write_atomically(out / "interval.npy", _npy(torch.stack([worth.low, worth.high]).numpy()))
        found["confidence"] = said(worth)
    else:
        found["no_confidence"] = unjudged
    if track:
        found["warnings"] = warnings
    if samples.truth is not None:
        truth = torch.from_numpy(samples.truth)[:, sampling.scored].contiguous()
        found["scores"] = score(images[:, sampling.scored].contiguous(), truth).mean()
    return found


def _is_the_rigs(light: float) -> bool:
    return _SAME_LIGHT[0] < light < _SAME_LIGHT[1]


def _wall_for_track(rig: Simulation | None) -> RadiometricTransport:
    """Return the rig's wall, with which motion can be found.

    Raises:
        ConfigError: There is none, or of a kind that does not tell motion.
    """
    if rig is None:
        raise ConfigError("--track without --rig; give the calibrated rig, which turns pixels into metres")
    if not isinstance(rig.transport, RadiometricTransport):
        raise ConfigError(f"--track with a rig of kind {rig.transport.kind}; give one of kind radiometric")
    return rig.transport


def _distance_m(rig: Simulation) -> float | None:
    return getattr(rig.transport, "distance_m", None)


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
