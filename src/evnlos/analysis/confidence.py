"""Whether images agree with what the frames show, and whether their confidence can be trusted.

- Test-time data consistency: move a network's image to where the calibrated wall agrees with the frame.
- How much of what the frames show the images explain: the light path run forward again; of what the images
  show, how much the events hold.
- Whether a setup fits the light and the events of a capture whose target is solved for.
- Is the confidence right? Support against skill, and coverage of the intervals, sequence by sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.cameras import CrossingLaw, PixelSettings
from evnlos.cameras.streams import WHITE_DN
from evnlos.data import NlosDataset, Samples
from evnlos.errors import DataError
from evnlos.models import (
    Confidence,
    ConfidenceReport,
    FrameOperator,
    Reconstructor,
    Weights,
    halves_of,
    on_target_plane,
)
from evnlos.models.confidence import on_canvas
from evnlos.types import Events, Plane

_TOLERANCE, _MOST_STEPS = 1e-3, 200


def consistent(
    pictures: Tensor, frames: Tensor, operator: FrameOperator, trust: float = 1.0, floor: float = 0.003
) -> Tensor:
    """Return the most probable images, given the network's answer as a prior and the frames as data.

    x = argmin |A x + b - y|^2 / sigma^2 + sum (x - p)^2 / v, with the variance v = trust (p (1 - p) + floor): a
    network whose output p is the probability of a bright pixel is unsure where p is neither 0 nor 1, and there
    the frame may move it. Conjugate gradients in units of sqrt(v); clipped to 0..1.

    Args:
        pictures: The network's images p, float32 [N, H, W], 0..1.
        frames: Frames of the samples y, float32 [N, h, w], white levels, without fixed pattern.
        operator: The setup.
        trust: How much the frames may move the images, above 0; 0 returns the images.
        floor: Smallest variance of a pixel at trust 1.

    Raises:
        DataError: Images and frames are not as many, or not of the operator's size.
    """
    if frames.shape[1:] != operator.size or len(frames) != len(pictures):
        raise DataError(
            f"frames {tuple(frames.shape)} and images {tuple(pictures.shape)} do not fit a setup of "
            f"{operator.size[1]} x {operator.size[0]} samples"
        )
    if trust <= 0:
        return pictures
    known = pictures[:, operator.rows].flatten(1)  # [N, cells]
    spread = (trust * (known * (1 - known) + floor)).sqrt()
    matrix = operator.matrix / operator.sigma
    away = ((frames - operator(pictures)) / operator.sigma).flatten(1)  # [N, h w]

    def normal(z: Tensor) -> Tensor:
        pushed = ((spread * z.squeeze(-2)) @ matrix.T) @ matrix
        return z + (spread * pushed).unsqueeze(-2)

    right = (spread * (away @ matrix)).unsqueeze(-2)  # [N, 1, cells]
    from evnlos.inverse.operators import conjugate_gradient

    found = conjugate_gradient(normal, right, tolerance=_TOLERANCE, max_iterations=_MOST_STEPS)
    moved = pictures.clone()
    move = (spread * found.image.squeeze(-2)).unflatten(1, (-1, pictures.shape[2]))
    moved[:, operator.rows] += move
    return moved.clamp(0, 1)


_BEYOND_NOISE = 0.05
"""What the average object must leave above the noise, as a share of it, for an image to be told from it."""
_MAD = 0.6745  # of a normal distribution, in standard deviations


def explained(
    pictures: Tensor,
    frames: Tensor,
    position_m: NDArray,
    average: Tensor,
    operator: FrameOperator,
    canvas: Plane,
) -> float:
    """Return the share of what the average object leaves unexplained in the frames that the images explain.

    1 - (|m y - g m A x|^2 - n) / (|m y - g0 m A x0|^2 - n), with x the images, x0 the average target where
    the target is, and n the noise. m takes what stands still away, each pixel's mean over the sequence, and the
    gains g and g0 are the best ones: neither ambient light nor the camera's fixed pattern nor how bright the
    object is has to be known, only what the wall does. 1 = the frames are as the images make them; 0 = they
    are as good as those of the average target, or the frames do not tell objects from it, as before a matte
    wall; below 0 = they are worse: the images are not what was in front of the wall, or the wall is another.

    Args:
        pictures: Images of the canvas, float32 [N, H, W], 0..1.
        frames: Frames of the samples y, float32 [N, h, w].
        position_m: The target's centre in each, (x, y) in metres, [N, 2].
        average: The average target, [P, P].
        operator: The setup.
        canvas: Geometry of the images.

    Raises:
        DataError: Images and frames are not as many, or not of the operator's size.
    """
    if frames.shape != (len(pictures), *operator.size):
        raise DataError(
            f"frames {tuple(frames.shape)} and images {tuple(pictures.shape)} do not fit a setup of "
            f"{operator.size[1]} x {operator.size[0]} samples"
        )
    plain = on_canvas(average, canvas, position_m)
    noise, seen = _noise(frames, operator), _moving(frames)
    left, before = (_left(_moving(operator(shown)), seen) - noise for shown in (pictures, plain))
    tiny = 1e-9 * seen.square().sum()  # rounding
    if before <= _BEYOND_NOISE * noise + tiny:
        return 0.0
    return float(1 - left.clamp_min(0) / before)


def share_explained(
    images: Tensor,
    frames: Tensor,
    position_m: NDArray,
    average: Tensor,
    operator: FrameOperator,
    canvas: Plane,
) -> float:
    """Return what `explained` says of what a sequence's images show in the mean, the arguments being the same.

    What changes from image to image is not the object.
    """
    shown = on_canvas(on_target_plane(images, canvas, position_m).mean(dim=0)[0], canvas, position_m)
    return explained(shown, frames, position_m, average, operator, canvas)


@dataclass(frozen=True, eq=False)
class EventChanges:
    """By how much the log light changed from position to position, as the events of a sequence say.

    Args:
        change: Thresholds that were crossed, log units, mean of each sample's pixels, float64 [N - 1, h, w].
        law: Constants of the event model.
    """

    change: Tensor
    law: CrossingLaw

    @classmethod
    def of(
        cls, events: Events, times_us: NDArray[np.int64], pixel: PixelSettings, size: tuple[int, int]
    ) -> EventChanges | None:
        """Return the changes between positions; None for pixels whose model states no thresholds.

        Args:
            events: The events.
            times_us: Times of the positions, [N], microseconds.
            pixel: The setup's event model.
            size: Size (h, w) of the samples.
        """
        if (law := pixel.crossing_law()) is None:
            return None
        from evnlos.tracking.event_motion import event_counts, log_changes

        pixels = events.height * events.width / (size[0] * size[1])  # of the sensor, a sample pixel
        change = log_changes(event_counts(events, np.asarray(times_us * 1e-6, np.float64), size), law) / pixels
        return cls(torch.from_numpy(change).unflatten(1, size), law)

    def made(self, frames: Tensor) -> Tensor:
        """Return the changes of the log light of frames [N, h, w], white levels, [N - 1, h, w]."""
        light = WHITE_DN * frames.double().clamp_min(1e-3).numpy()
        return torch.from_numpy(np.diff(self.law.level(light), axis=0))


def share_held(
    images: Tensor,
    changes: EventChanges,
    position_m: NDArray,
    average: Tensor,
    operator: FrameOperator,
    canvas: Plane,
) -> float:
    """Return the share of what a sequence's images show beyond the average object that its events hold.

    (|m y - g0 m D(x0)|^2 - |m y - g m D(x)|^2) / |g m D(x) - g0 m D(x0)|^2, with D the changes of the log light
    from position to position of what the images show in the mean, x, and of the average target x0; the rest is
    as in `explained`. 1 = events change as the images say; 0 = they are as near to the average object; below 0:
    nearer. Noise, which most events of a dim wall are, drops out in the mean.

    Args:
        images: Images of the canvas, float32 [N, H, W], 0..1.
        changes: What the events say.
        position_m: The target's centre in each, (x, y) in metres, [N, 2].
        average: The average target, [P, P].
        operator: The setup.
        canvas: Geometry of the images.
    """
    found = on_target_plane(images, canvas, position_m).mean(dim=0)[0]
    seen = _moving(changes.change)
    shown, plain = (
        _moving(changes.made(operator(on_canvas(one, canvas, position_m)))) for one in (found, average)
    )
    apart = max(_gain(shown, seen), 0.0) * shown - max(_gain(plain, seen), 0.0) * plain
    nearer = _left(plain, seen) - _left(shown, seen)
    return float(nearer / apart.square().sum().clamp_min(torch.finfo(torch.float64).tiny))


def light_gain(pictures: Tensor, frames: Tensor, operator: FrameOperator) -> float:
    """Return how much brighter the moving light of frames is than the setup makes it from images.

    Args:
        pictures: Images of the canvas, float32 [N, H, W], 0..1.
        frames: Frames of the samples, float32 [N, h, w], white levels.
        operator: The setup.
    """
    return _gain(_moving(operator(pictures)), _moving(frames))


def _moving(frames: Tensor) -> Tensor:
    """Return frames without what stands still, float64."""
    frames = frames.double()
    return frames - frames.mean(dim=0)


def _gain(made: Tensor, seen: Tensor) -> float:
    return float((made * seen).sum() / made.square().sum().clamp_min(torch.finfo(torch.float64).tiny))


def _left(made: Tensor, seen: Tensor) -> Tensor:
    """Return what moving light that was made leaves of the one seen at the best gain, squared and summed."""
    return (seen - max(_gain(made, seen), 0.0) * made).square().sum()


def _noise(frames: Tensor, operator: FrameOperator) -> Tensor:
    """Return what noise adds to the moving light, squared and summed: from the scatter about the neighbours.

    How the noise grows with the level is told by the setup's camera, how strong it is by the frames. The light
    moves slowly and over few pixels; the median over the pixels is that of the others. In time alone:
    `temporal_noise` also takes differences between neighbours, but samples share the sensor's pixels with
    theirs, so that it finds a tenth too little here.
    """
    if len(frames) < 3:
        return torch.zeros((), dtype=torch.float64)
    frames = frames.double()
    beside = 0.5 * (frames[2:] + frames[:-2])
    spread = (frames[1:-1] - beside) / (1.5 * operator.variance(beside)).sqrt()
    excess = (spread.flatten(1).abs().median(dim=1).values.median() / _MAD).square()
    return excess * operator.variance(frames).sum() * (1 - 1 / len(frames))


@torch.inference_mode()
def confidence_of(
    weights: Weights,
    samples: Samples,
    images: Tensor,
    operator: FrameOperator | None = None,
    changes: EventChanges | None = None,
) -> ConfidenceReport | None:
    """Return the confidence in the images of one sequence; None where the weights or the motion do not tell.

    Args:
        weights: The network and its confidence.
        samples: The sequence.
        images: The network's images, float32 [N, H, W].
        operator: The calibrated setup, where it is known.
        changes: What the events say, of images that were made from events alone; they are then the judge.
    """
    if why_no_confidence(weights, samples) is not None:
        return None
    assert weights.confidence is not None and samples.position_m is not None  # see why_no_confidence
    seen = weights.modality.inputs(samples.frame, samples.surface)
    frames = torch.from_numpy(samples.frame)
    sequence = (seen, frames, images, samples.position_m)
    return _report_of(
        weights.network, weights.confidence, *sequence, weights.sampling.canvas, operator, changes
    )


def why_no_confidence(weights: Weights, samples: Samples) -> str | None:
    """Return in one line why `confidence_of` can't tell anything, and the cure; None where it can.

    Args:
        weights: The network.
        samples: The sequence.
    """
    if samples.position_m is None:
        why = "the motion is unknown; state it in capture.yaml, or give --setup and --track to find it"
    elif len(samples) < 2:
        why = f"{len(samples)} position, 2 are the least; record per sequence"
    elif weights.confidence is None:
        why = "these weights never learned it; take those of a whole sequence (`evnlos weights` lists them)"
    else:
        return None
    return f"no confidence: {why}"


def _report_of(
    network: Reconstructor,
    confidence: Confidence,
    inputs: Tensor,
    frames: Tensor,
    images: Tensor,
    position_m: NDArray,
    canvas: Plane,
    operator: FrameOperator | None,
    changes: EventChanges | None = None,
) -> ConfidenceReport:
    share, judge = None, "frames" if changes is None else "events"
    if operator is not None and changes is not None:
        share = share_held(images, changes, position_m, confidence.mean, operator, canvas)
    elif operator is not None and bool(frames.any()):
        share = share_explained(images, frames, position_m, confidence.mean, operator, canvas)
    return confidence.judge(images, halves_of(network, inputs, position_m, canvas), share, judge)


def confidence_values(report: ConfidenceReport) -> dict[str, Any]:
    """Return a judgement as plain values; `explained` is there only where the setup is known."""
    numbers = {name: round(getattr(report, name), 4) for name in ("support", "agreement", "threshold")}
    if report.explained is not None:
        numbers["explained"] = round(report.explained, 4)
    return numbers | {"measured": report.measured, "verdict": report.verdict}


@dataclass(frozen=True)
class ConfidenceCheck:
    """What the confidence said of one sequence, and what was true.

    Args:
        name: Object of the sequence.
        support: What it said, in one number: how much of the image the measurement supports, 0..1.
        agreement: Share of what tells this object from others that both halves of the sequence agree on.
        explained: Share of the frames that the images explain (see `explained`); None without a setup.
        measured: Whether it said that anything was.
        skill: 1 - |x - t|^2 / |x0 - t|^2 over the targets, with x the images, t the truth, and x0 the average
            target: 1 is perfect, 0 is no better than the average object, below 0 is worse.
        coverage: Share of the target planes' pixels whose true level lies in its interval.
        width: Mean length of these intervals, 0..1.
    """

    name: str
    support: float
    agreement: float
    explained: float | None
    measured: bool
    skill: float
    coverage: float
    width: float


@torch.inference_mode()
def check_confidence(
    network: Reconstructor,
    confidence: Confidence,
    samples: NlosDataset,
    images: Tensor,
    canvas: Plane,
    operator: FrameOperator | None = None,
) -> list[ConfidenceCheck]:
    """Compare what the confidence says of images with their truth, for each sequence.

    Args:
        network: The network.
        confidence: Its confidence.
        samples: The sequences, all of known motion.
        images: The network's images of all samples, float32 [N, H, W].
        canvas: Their geometry.
        operator: The setup that the network was trained for; the modality then has a group "frame".

    Raises:
        DataError: The motion of a sequence is unknown.
    """
    found = []
    for name in dict.fromkeys(samples.names.tolist()):
        mine = np.flatnonzero(samples.names == name)
        rows, at = torch.from_numpy(mine), samples.position_m[mine]
        inputs = samples.inputs[rows]
        sequence = (inputs, _frames(samples, inputs), images[rows], at)
        report = _report_of(network, confidence, *sequence, canvas, operator)
        true, shown = samples.truth[rows].float(), images[rows]
        average = on_canvas(confidence.mean, canvas, at)
        missed, blank = (on_target_plane((one - true).square(), canvas, at).sum() for one in (shown, average))
        # Where the resampled truth is a rounding error beyond 0 or 1, it still is 0 or 1.
        held = ((true >= report.low - 1e-3) & (true <= report.high + 1e-3)).float()
        found.append(
            ConfidenceCheck(
                name,
                report.support,
                report.agreement,
                report.explained,
                report.measured,
                float(1 - missed / blank),
                float(on_target_plane(held, canvas, at).mean()),
                float(on_target_plane(report.high - report.low, canvas, at).mean()),
            )
        )
    return found


def _frames(samples: NlosDataset, inputs: Tensor) -> Tensor:
    """Return the frames in inputs, [n, H, W]; zeros where the modality has none."""
    own = samples.modality.slices.get("frame")
    return inputs[:, 0].float() * 0 if own is None else inputs[:, own][:, 0].float()


def risk_coverage(support: ArrayLike, risk: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean risk of what is kept when only the most supported sequences are, for each share kept.

    Args:
        support: What the confidence said of each sequence, [N].
        risk: What was wrong with it, such as 1 - skill, [N].

    Returns:
        Shares kept, ascending to 1, and the mean risk of each, [N] both (El-Yaniv and Wiener, JMLR 2010).

    Example:
        >>> risk_coverage([0.9, 0.1, 0.5], [0.0, 0.6, 0.3])[1].round(2).tolist()
        [0.0, 0.15, 0.3]
    """
    order = np.argsort(-np.asarray(support, np.float64), kind="stable")
    ranks = np.arange(1, len(order) + 1)
    return ranks / len(order), np.cumsum(np.asarray(risk, np.float64)[order]) / ranks


_MOST_LEFT = 0.1  # of the light's own changes
_FURTHEST = 0.15  # of fitted thresholds from the setup's, relative


def shares_left(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return what the setup leaves unexplained of each capture, by most positions, where enough are told."""
    told = sorted((row for row in rows if row.get("unexplained") is not None), key=lambda row: row["positions"])
    return {row["capture"]: row["unexplained"] for row in told}


def left_text(rows: Sequence[dict[str, Any]]) -> str:
    """Return the most that the setup leaves unexplained of a capture, in words; "" where nothing is told."""
    left = shares_left(rows).values()
    return f"{100 * max(left):.1f} % of the light unexplained beside the noise" if left else ""


def sequence_doubts(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return why images are not to be believed, a line each."""
    return [
        f"{name}: the setup leaves {100 * share:.0f} % of the light unexplained beside the noise, right ones 1 "
        "to 3 %: do not believe the image; calibrate this very setup (`evnlos calibrate`)"
        for name, share in shares_left(rows).items()
        if share > _MOST_LEFT
    ] + [
        f"{row['capture']}: the events fit the setup only with thresholds {row['threshold_factors']} times its "
        "own; do not believe the image, calibrate pixel and optics on this sensor"
        for row in rows
        if any(abs(factor - 1) > _FURTHEST for factor in np.ravel(row.get("threshold_factors", ())))
    ]


def levels_text(rows: Sequence[dict[str, Any]]) -> str:
    """Return how bright each colour of pictures is over the truth, in the mean; "" where none is known."""
    levels = [one for row in rows if isinstance(one := row["level"], list) and None not in one]
    told = "red, green, blue are {:.2f}, {:.2f}, {:.2f} of the truth"
    return told.format(*np.mean(levels, axis=0)) if levels else ""
