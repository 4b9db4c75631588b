"""Trained models at work: on a recording at once, and with growing numbers of time steps.

- A pretrained or trained model: a recording in; images, how far to believe them, and warnings out.
- How the image of a sequence network grows with the positions that it sees, and as the recording goes on.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.analysis.confidence import (
    EventChanges,
    FrameOperator,
    confidence_of,
    consistent,
    light_gain,
    share_explained,
    why_no_confidence,
)
from evnlos.analysis.evaluate import check_sampling, reconstruct
from evnlos.data import Capture, Dataset, FixedPattern, NlosDataset, Samples, capture_samples, read_capture
from evnlos.errors import ConfigError, DataError
from evnlos.machine import Progress, counted, note, silent
from evnlos.metrics import psnr
from evnlos.models import ConfidenceReport, Reconstructor, Weights, load_weights, published_setup
from evnlos.scene import Motion
from evnlos.setups import Setup, named_setup

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
        brought_from: Brightness of the recording in that which the model knows, where the frames were brought
            to that; None where the model took them as they are.
    """

    images: Tensor
    samples: Samples
    confidence: ConfidenceReport | None = None
    warnings: list[str] = field(default_factory=list)
    light: float | None = None
    no_confidence: str | None = None
    brought_from: float | None = None

    @property
    def is_moved(self) -> bool:
        """Whether the images were moved to where the setup agrees with the frames."""
        return self.light is not None and _SAME_LIGHT[0] < self.light < _SAME_LIGHT[1]


_LEVELS = tuple(round(0.75 ** (k / 2), 3) for k in range(-8, 9) if abs(k) > 1)
"""Brightnesses, 0.32 to 3.2 of the known one, that are tried where the frames are poorly explained."""
_POOR, _FINE, _BETTER, _ALIKE = 0.99, 0.9, 0.5, 1.1
"""Share of the frames that images of the known brightness explain for no other to be tried; that of another,
and what it may leave of what these leave; times the least that is left, up to which brightnesses are alike."""


def _in_known_light(
    weights: Weights, samples: Samples, images: Tensor, operator: FrameOperator
) -> tuple[Samples, Tensor, float | None]:
    """Return samples and images at the brightness at which the images explain the frames best, and that.

    A network that knows one brightness draws thinner strokes where it is less: a thin bright object and a thick
    dim one explain nine tenths of each other's light. The rest tells them apart.

    Args:
        weights: The network, its confidence.
        samples: A sequence of known motion.
        images: What the network makes of it, float32 [N, H, W].
        operator: The setup.

    Returns:
        The same, and None, where the images explain the frames well, or no other brightness clearly better.
    """
    assert weights.confidence is not None and samples.position_m is not None  # see why_no_confidence
    mean, canvas, at = weights.confidence.mean, weights.sampling.canvas, samples.position_m
    frames = torch.from_numpy(samples.frame)
    own = share_explained(images, frames, at, mean, operator, canvas)
    if own > _POOR:
        return samples, images, None
    ambient = operator.ambient.unflatten(0, operator.size)
    still = (frames - light_gain(images, frames, operator) * (operator(images) - ambient)).mean(dim=0)
    tried = dict[float, tuple[float, Samples, Tensor]]()
    for level in _LEVELS:
        note(f"light {level:g} x the known")
        seen = replace(samples, frame=(ambient + (frames - still) / level).float().numpy())
        drawn = reconstruct(weights, seen.frame, seen.surface, at)
        tried[level] = share_explained(drawn, frames, at, mean, operator, canvas), seen, drawn
    least = 1 - max(share for share, _, _ in tried.values())
    alike = [level for level, (share, _, _) in tried.items() if 1 - share <= _ALIKE * least]
    share, seen, drawn = tried[level := alike[len(alike) // 2]]
    is_other = share > _FINE and 1 - share < _BETTER * (1 - own)
    return (seen, drawn, level) if is_other else (samples, images, None)


_KNOW_LATER = ("trace", "likelihood", "corrected")
_SO_FAR = "no confidence: it is known of images of the whole recording; leave --so-far away"


class Model:
    """A trained network with what is known about it; make it with `load_model`.

    Args:
        weights: The network, its history, its confidence.
        known_setup: Settings of the calibrated setup that the network was trained for, a YAML file, where the
            training's samples name none.
    """

    def __init__(self, weights: Weights, known_setup: Path | None = None) -> None:
        self.weights, self._known_setup = weights, known_setup

    def known_setup(self) -> Setup | None:
        """Return the setup that the network was trained for; None where it is unknown."""
        return self.known()[0]

    def known(self) -> tuple[Setup | None, float | None]:
        """Return `known_setup` and the side of the targets that its file states, metres."""
        for named in filter(None, (self.weights.sampling.setup, self._known_setup)):
            with suppress(ConfigError, DataError):  # moved, or of another machine
                found = named_setup(named)
                return (found.setup, found.target_m) if found.setup.is_linear else (None, None)
        return None, None

    def reconstruct(
        self,
        recording: str | Path | Capture,
        setup: Setup | None = None,
        pattern: FixedPattern | None = None,
        track: bool = False,
        so_far: bool = False,
    ) -> Reconstruction:
        """Reconstruct all time steps of a recording.

        Args:
            recording: A capture folder, or one that was read; its target may be unknown.
            setup: The calibrated setup of this very recording; the images are then moved to where its wall
                agrees with the frames, if these are as bright as the setup makes them. Without one, the
                confidence asks the `known_setup`, and the images stay.
            pattern: Fixed pattern of the frame camera, to be taken from the frames.
            track: Find the motion in the recording with the setup, also where it is stated.
            so_far: Whether each image is made of what was seen up to its time step alone (the brightness of
                the light counts as known); there is no confidence in it then, and no setup moves it.

        Raises:
            ConfigError: `track` without a linear setup.
            DataError: The recording can't be used, the object can't be tracked, or a network of whole
                sequences is not told the motion.
        """
        tracked = setup_for_track(setup) if track else None
        weights, eyes = self.weights, self.weights.modality
        if not isinstance(recording, Capture):
            recording = read_capture(recording, needs_frames=False, needs_events=False)
        capture = recording
        capture.info.check_cameras(capture.name, frames=eyes.needs_frames, events=eyes.needs_events)
        if so_far:
            shown = weights.network.seeing(replace(weights.sampling, surface="so-far"))
            weights = replace(weights, network=_causal(shown, "leave --so-far away, or take other weights"))
        path, warnings = (None, list[str]()) if tracked is None else _path_of(capture, tracked, pattern)
        samples = capture_samples(replace(capture, path=path), weights.sampling, pattern)
        if (stated := capture.info.motion) is not None and (stated.retreat_m_s or stated.spin_deg_s):
            warnings.append(
                f"capture.yaml states a retreat of {stated.retreat_m_s:g} m/s and a spin of "
                f"{stated.spin_deg_s:g} deg/s; networks know upright targets at one distance, and take x "
                "and y of the motion alone"
            )
        note("network")
        images = reconstruct(weights, samples.frame, samples.surface, samples.position_m)
        unjudged = why_no_confidence(weights, samples)
        # An operator takes a second to make.
        judge = self.known_setup() if setup is None and unjudged is None else setup
        note("light path")
        operator = None if judge is None else FrameOperator(judge, weights.sampling)
        note("confidence")
        seen, level = samples, None
        if operator is not None and unjudged is None and "frame" in eyes.slices:
            seen, images, level = _in_known_light(weights, samples, images, operator)
        if so_far:
            inputs = eyes.inputs(seen.frame, seen.surface)
            images = weights.network.infer(inputs, seen.position_m, so_far=True)
            return Reconstruction(images, samples, warnings=warnings, no_confidence=_SO_FAR, brought_from=level)
        changes, times = None, capture.frame_times_us[-len(samples) :]
        if operator is not None and judge is not None and unjudged is None and "frame" not in eyes.slices:
            changes = EventChanges.of(capture.events, times, judge.pixel, operator.size)
        confidence = confidence_of(weights, seen, images, operator, changes)
        found = Reconstruction(
            images, samples, confidence, warnings, no_confidence=unjudged, brought_from=level
        )
        if setup is None or operator is None or not capture.has_frames:
            return found
        found = replace(found, light=light_gain(images, frames := torch.from_numpy(samples.frame), operator))
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
        weights: A path, or a name such as "near-frame-sequence" (`evnlos weights` lists them).

    Raises:
        DataError: There is no such file or name, or the file is damaged.

    Example:
        >>> load_model("near-frame").weights.modality.name
        'frame'
    """
    return Model(load_weights(weights), published_setup(weights))


def _path_of(capture: Capture, setup: Setup, pattern: FixedPattern | None) -> tuple[Motion, list[str]]:
    """Return the motion that a capture shows, and why it may be wrong."""
    from evnlos.tracking import track_capture, track_warnings

    track = track_capture(capture, setup, pattern=pattern)
    return track.motion, track_warnings(capture, setup, track)


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


_MOST_SUBSETS = 8


@dataclass(frozen=True)
class PositionsPoint:
    """Scores of a sequence network that saw a part of each sequence.

    Args:
        positions: Positions that it saw.
        subsets: Choices of so many positions that the scores are a mean over, at most.
        psnr_db: Mean PSNR over the images that are scored, the scored canvas, dB.
        objects: The same of each object, dB.
    """

    positions: int
    subsets: int
    psnr_db: float
    objects: dict[str, float]


@torch.inference_mode()
def curve_over_positions(
    weights: Weights,
    dataset: Dataset,
    split: str = "test",
    counts: tuple[int, ...] = (1, 2, 5, 10, 20, 40),
    progress: Progress = silent,
) -> list[PositionsPoint]:
    """Reconstruct each sequence from some of its positions and score the image at all of them.

    The choices of n of N positions are equally spaced: begun at the first, the second and so on, up to 8
    choices spread over the N // n that there are. What is scored is the same for every n: the image drawn
    at all N positions, whose places are known.

    Args:
        weights: Those of a network of whole sequences.
        dataset: Where the samples are.
        split: "train", "validation", "test" or "all".
        counts: Numbers of positions, each from 1 to the positions of a sequence.
        progress: Called after each of the numbers.

    Raises:
        DataError: The network sees single time steps, the motion of an object is unknown, a count is more than
            a sequence has, or the samples were made in another way than those of the training.
    """
    network, samples, sequences = _sequences(weights, dataset, split)
    # All of them before the first reconstruction, so that a count that is too large costs no time.
    chosen = {count: {name: choices(len(mine), count) for name, mine in sequences.items()} for count in counts}
    rows = dataset.sampling.scored
    found = []
    for count, parts_of in counted(chosen.items(), progress, "positions", len(chosen), "numbers of them"):
        means = {}
        for name, mine in sequences.items():
            places = torch.from_numpy(samples.position_m[mine].astype(np.float32))
            inputs, truth = (part[torch.from_numpy(mine)].float() for part in (samples.inputs, samples.truth))
            decibel = []
            for part in parts_of[name]:
                some = torch.from_numpy(part)
                drawn = network.draw(inputs[some], places[some], places)
                decibel.append(psnr(drawn[:, rows].contiguous(), truth[:, rows].contiguous()).mean())
            means[name] = float(torch.stack(decibel).mean())
        subsets = max(len(parts) for parts in parts_of.values())
        found.append(PositionsPoint(count, subsets, float(np.mean(list(means.values()))), means))
    return found


@torch.inference_mode()
def curve_so_far(
    weights: Weights, dataset: Dataset, split: str = "test", progress: Progress = silent
) -> list[PositionsPoint]:
    """Score the image at each time step that is made of what was seen up to it, and of nothing later.

    Args:
        weights: Those of a network of whole sequences.
        dataset: Where the samples are; where events were solved for the target, of the surface `so-far`.
        split: "train", "validation", "test" or "all".
        progress: Called after each of the objects.

    Returns:
        A point for each number of positions so far, up to those of the shortest sequence: what is scored is the
        image at the last of them.

    Raises:
        DataError: As of `curve_over_positions`, or the surfaces of the events know later ones.
    """
    network, samples, sequences = _sequences(weights, dataset, split)
    network = _causal(network.seeing(dataset.sampling), "import the captures with --sampling.surface so-far")
    rows, steps = dataset.sampling.scored, min(map(len, sequences.values()))
    decibel = np.empty((steps, len(sequences)))
    mine_of = counted(sequences.values(), progress, "so far", len(sequences), "sequences")
    for number, mine in enumerate(mine_of):
        inputs, truth = (part[torch.from_numpy(mine)].float() for part in (samples.inputs, samples.truth))
        drawn = network.infer(inputs, samples.position_m[mine], so_far=True)
        found = psnr(drawn[:, rows].contiguous(), truth[:, rows].contiguous())
        decibel[:, number] = found[:steps].numpy()
    return [
        PositionsPoint(step + 1, 1, float(row.mean()), dict(zip(sequences, row.tolist(), strict=True)))
        for step, row in enumerate(decibel)
    ]


def _causal(network: Reconstructor, cure: str) -> Reconstructor:
    """Return a reconstructor whose surfaces of events know no later ones; raise a DataError of any other."""
    if network.modality.needs_events and (surface := network.sampling.surface) in _KNOW_LATER:
        raise DataError(f"surfaces of {surface!r} know later events, not only those so far; {cure}")
    return network


def _sequences(
    weights: Weights, dataset: Dataset, split: str
) -> tuple[Reconstructor, NlosDataset, dict[str, NDArray[np.int64]]]:
    """Return a network of whole sequences, the samples of a split, and which of them each object has."""
    network = weights.network
    if not network.sees_sequence:
        raise DataError(
            "these weights see single time steps; give those of a network of whole sequences (train with "
            "--network.kind sequence)"
        )
    check_sampling(weights, dataset.sampling)
    samples = NlosDataset(dataset, split, weights.modality)
    if np.isnan(samples.position_m).any():
        raise DataError("the motion of an object is unknown; give it in capture.yaml (`evnlos track` finds it)")
    sequences = {name: np.flatnonzero(samples.names == name) for name in dict.fromkeys(samples.names.tolist())}
    return network.eval(), samples, sequences


def choices(positions: int, count: int) -> list[np.ndarray]:
    """Return up to 8 choices of `count` equally spaced ones of `positions`.

    Raises:
        DataError: There are not so many.

    Example:
        >>> [part.tolist() for part in choices(6, 3)]
        [[0, 2, 4], [1, 3, 5]]
    """
    if not 1 <= count <= positions:
        raise DataError(f"{count} positions are requested; a sequence has {positions}: give 1 to {positions}")
    stride = positions // count
    starts = np.unique(np.linspace(0, stride - 1, min(stride, _MOST_SUBSETS)).round().astype(int))
    return [start + stride * np.arange(count) for start in starts]
