"""The reconstructions of one capture as files: a picture a position, a film strip, an animation."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evnlos.dataset import (
    FixedPattern,
    read_capture,
)
from evnlos.evaluation import load_model, score
from evnlos.evaluation.model import setup_for_track
from evnlos.evaluation.worth import said
from evnlos.files import check_folder, new_folder, write_atomically
from evnlos.model import published_for
from evnlos.report.pictures import grey, polarity, save_animation, save_png, stretched, strip
from evnlos.setups import Setup


def reconstruct_capture(
    capture: str | Path,
    weights: str | Path | None,
    out: str | Path,
    zoom: int = 4,
    pattern: FixedPattern | None = None,
    setup: Setup | None = None,
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
        out: The folder for the pictures; must not exist or be empty. It is there with all of them, or
            not at all.
        zoom: Size of a pixel in the pictures.
        pattern: Fixed pattern of the frame camera, to be taken from the frames.
        setup: The calibrated setup; the pictures are then moved to where the wall agrees with the frames, if
            these are as bright as it makes them, and the confidence says how much of the frames they explain.
            Without one, that is told by the rig of published weights, and the pictures stay.
        track: Find the motion in the recording with the rig, also where it is stated; the truth, where it is
            known, stays where the capture states it.

    Returns:
        Capture, weights, modality, number of positions; where the truth is known, the mean scores; where it can
        be told, the confidence: support, threshold, measured, verdict and, where a rig is known, explained;
        else no_confidence, which says why. With a rig also `light`, the capture's brightness in that of the
        rig, and whether the pictures were moved; with `track` the warnings of the track.

    Raises:
        ConfigError: `track` without a setup.
        DataError: The capture or the weights can't be used, the object can't be tracked, or `out` holds other
            files.
    """
    out = Path(out)
    if track:
        setup_for_track(setup)  # before anything is read
    shot = read_capture(capture)
    if weights is None:
        distance_m = shot.distance_m or (None if setup is None else setup.default_distance_m)
        weights = published_for(distance_m, "frame", is_motion_known=track or shot.motion is not None)
    model = load_model(weights)
    sampling = model.weights.sampling
    check_folder(out)
    made = model.reconstruct(shot, setup, pattern, track)
    images, samples, worth = made.images, made.samples, made.confidence
    pictures = [grey(image) for image in images]
    with new_folder(out) as draft:
        for k, picture in enumerate(pictures):
            save_png(draft / f"position_{k:02d}.png", picture, zoom)
        save_png(draft / "strip.png", strip(pictures), 2)
        shown = []
        for k, picture in enumerate(pictures):
            row = [stretched(samples.frame[k]), polarity(samples.surface[k]), picture]
            if samples.truth is not None:
                row.append(grey(samples.truth[k]))
            shown.append(strip(row, columns=4))
        rate_hz = 1e6 / float(np.median(np.diff(shot.frame_times_us)))
        save_animation(draft / "animation.gif", shown, rate_hz, 2)
        write_atomically(draft / "reconstruction.npy", _npy(images.numpy()))
        found: dict[str, Any] = {
            "capture": shot.name,
            "weights": str(weights),
            "modality": model.weights.modality.name,
            "positions": len(pictures),
        }
        if made.light is not None:
            found |= {"light": round(made.light, 4), "moved_by_the_rig": made.is_moved}
        if worth is not None:
            save_png(draft / "unsure.png", strip([grey(one) for one in worth.high - worth.low]), 2)
            write_atomically(draft / "interval.npy", _npy(torch.stack([worth.low, worth.high]).numpy()))
            found["confidence"] = said(worth)
        else:
            found["no_confidence"] = made.no_confidence
    if track:
        found["warnings"] = made.warnings
    if samples.truth is not None:
        truth = torch.from_numpy(samples.truth)[:, sampling.scored].contiguous()
        found["scores"] = score(images[:, sampling.scored].contiguous(), truth).mean()
    return found


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
