"""A pretrained or trained model: a recording in; images, how far to believe them, and warnings out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from evnlos.dataset import Capture, FixedPattern, Samples, capture_samples, read_capture
from evnlos.errors import ConfigError
from evnlos.evaluation.consistency import FrameOperator, consistent
from evnlos.evaluation.evaluate import reconstruct
from evnlos.evaluation.explained import light_gain
from evnlos.evaluation.worth import judgement_of, why_unjudged
from evnlos.model import Judgement, Weights, load_weights, published_rig
from evnlos.setups import Setup, load_setup

_SAME_LIGHT = (0.75, 1.33)
"""Range of a recording's brightness, in that of its calibrated setup, in which the setup's gain is its own."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What a model makes of a recording.

    Args:
        images: The hidden object on the canvas at each time step, float32 [N, H, W], 0..1.
        samples: What the model saw; with the truth, where the recording states it.
        confidence: How far to believe the images; None where that can't be told.
        warnings: What is doubtful, one line each.
        light: Brightness of the recording in that of the given setup; None without one.
        no_confidence: Why there is no confidence, in one line; None where there is.
    """

    images: Tensor
    samples: Samples
    confidence: Judgement | None = None
    warnings: list[str] = field(default_factory=list)
    light: float | None = None
    no_confidence: str | None = None

    @property
    def is_moved(self) -> bool:
        """Whether the images were moved to where the setup agrees with the frames."""
        return self.light is not None and _SAME_LIGHT[0] < self.light < _SAME_LIGHT[1]


class Model:
    """A trained network with what is known about it; make it with `load_model`.

    Args:
        weights: The network, its history, its confidence.
        known_setup: Settings of the calibrated setup that the network was trained for, a YAML file; None where
            they are unknown.
    """

    def __init__(self, weights: Weights, known_setup: Path | None = None) -> None:
        self.weights, self._known_setup = weights, known_setup

    def reconstruct(
        self,
        recording: str | Path | Capture,
        setup: Setup | None = None,
        pattern: FixedPattern | None = None,
        track: bool = False,
    ) -> Reconstruction:
        """Reconstruct all time steps of a recording.

        Args:
            recording: A capture folder, or one that was read; its target may be unknown.
            setup: The calibrated setup of this very recording; the images are then moved to where its wall
                agrees with the frames, if these are as bright as the setup makes them. Without one, the
                confidence asks the setup that pretrained weights were trained for, and the images stay.
            pattern: Fixed pattern of the frame camera, to be taken from the frames.
            track: Find the motion in the recording with the setup, also where it is stated.

        Raises:
            ConfigError: `track` without a linear setup.
            DataError: The recording can't be used, the object can't be tracked, or a network of whole
                sequences is not told the motion.
        """
        tracked = setup_for_track(setup) if track else None
        shot = recording if isinstance(recording, Capture) else read_capture(recording)
        samples = capture_samples(shot, self.weights.sampling, pattern)
        warnings: list[str] = []
        if tracked is not None:
            from evnlos.tracking import track_capture, track_doubts

            path = track_capture(shot, tracked, pattern=pattern)
            warnings = track_doubts(shot, tracked, path)
            samples = replace(samples, position_m=path.at(samples.time_s))
        images = reconstruct(self.weights, samples.frame, samples.surface, samples.position_m)
        unjudged = why_unjudged(self.weights, samples)
        judge = setup
        if judge is None and unjudged is None and self._known_setup is not None:
            judge = load_setup(self._known_setup)  # an operator takes a second to make
        operator = None if judge is None else FrameOperator(judge, self.weights.sampling)
        confidence = judgement_of(self.weights, samples, images, operator)
        found = Reconstruction(images, samples, confidence, warnings, no_confidence=unjudged)
        if setup is None or operator is None:
            return found
        frames = torch.from_numpy(samples.frame)
        found = replace(found, light=light_gain(images, frames, operator))
        if not found.is_moved:
            return found
        images = consistent(images, frames, operator)
        if confidence is not None:  # where the frames moved a level out of its interval, the interval follows
            low, high = confidence.low.minimum(images), confidence.high.maximum(images)
            confidence = replace(confidence, low=low, high=high)
        return replace(found, images=images, confidence=confidence)


def load_model(weights: str | Path) -> Model:
    """Return the model of a weights file, of a run, or of pretrained weights.

    Args:
        weights: A path, or a name such as "near-frame-pass" (`evnlos weights` lists them).

    Raises:
        DataError: There is no such file or name, or the file is damaged.

    Example:
        >>> load_model("near-frame").weights.modality.name
        'frame'
    """
    return Model(load_weights(weights), published_rig(weights))


def setup_for_track(setup: Setup | None) -> Setup:
    """Return the setup with which motion can be found.

    Args:
        setup: The calibrated setup.

    Raises:
        ConfigError: There is none, or one that is not linear.
    """
    if setup is None:
        raise ConfigError("--track without --setup; give the calibrated setup, which turns pixels into metres")
    if not setup.is_linear:
        raise ConfigError(
            f"--track with a setup of kind {setup.kind}, which is not linear; calibrate one that is"
        )
    return setup
