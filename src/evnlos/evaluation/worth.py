"""Is the confidence right? Support against skill, and coverage of the intervals, pass by pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from evnlos.dataset import NlosDataset, Samples
from evnlos.evaluation.consistency import FrameOperator
from evnlos.evaluation.explained import explained
from evnlos.model import Confidence, Judgement, Reconstructor, Weights, halves_of, plates
from evnlos.model.plates import on_canvas
from evnlos.types import Plane


@torch.inference_mode()
def judgement_of(
    weights: Weights, samples: Samples, images: Tensor, operator: FrameOperator | None = None
) -> Judgement | None:
    """Return what the pictures of one pass are worth; None where the weights or the motion do not tell.

    Args:
        weights: The network, and what it learned of its pictures' worth.
        samples: The pass.
        images: The network's pictures, float32 [N, H, W].
        operator: The calibrated rig, where it is known.
    """
    if why_unjudged(weights, samples) is not None:
        return None
    assert weights.confidence is not None and samples.position_m is not None  # see why_unjudged
    seen = weights.modality.inputs(samples.frame, samples.surface)
    frames = torch.from_numpy(samples.frame)
    pass_ = (seen, frames, images, samples.position_m)
    return _judged(weights.network, weights.confidence, *pass_, weights.sampling.canvas, operator)


def why_unjudged(weights: Weights, samples: Samples) -> str | None:
    """Return in one line why `judgement_of` can't tell anything, and the cure; None where it can.

    Args:
        weights: The network.
        samples: The pass.
    """
    if samples.position_m is None:
        why = "the motion is unknown; state it in capture.yaml, or give --rig and --track to find it"
    elif len(samples) < 2:
        why = f"{len(samples)} position, 2 are the least; record a pass"
    elif weights.confidence is None:
        why = "these weights never learned it; take those of a whole pass (`evnlos weights` lists them)"
    else:
        return None
    return f"no confidence: {why}"


def _judged(
    network: Reconstructor,
    confidence: Confidence,
    inputs: Tensor,
    frames: Tensor,
    images: Tensor,
    position_m: NDArray,
    canvas: Plane,
    operator: FrameOperator | None,
) -> Judgement:
    share = None
    if operator is not None and bool(frames.any()):
        # What the pass shows, at each position: what changes from picture to picture is not the object.
        shown = on_canvas(plates(images, canvas, position_m).mean(dim=0)[0], canvas, position_m)
        share = explained(shown, frames, position_m, confidence.mean, operator, canvas)
    return confidence.judge(images, halves_of(network, inputs, position_m, canvas), share)


def said(worth: Judgement) -> dict[str, Any]:
    """Return a judgement as plain values; `explained` is there only where the rig is known."""
    numbers = {name: round(getattr(worth, name), 4) for name in ("support", "agreement", "threshold")}
    if worth.explained is not None:
        numbers["explained"] = round(worth.explained, 4)
    return numbers | {"measured": worth.measured, "verdict": worth.verdict}


@dataclass(frozen=True)
class PassWorth:
    """What the confidence said of one pass, and what was true.

    Args:
        name: Object of the pass.
        support: What it said, in one number: how much of the picture the measurement supports, 0..1.
        agreement: Share of what tells this object from others that both halves of the pass agree on.
        explained: Share of the frames that the pictures explain (see `explained`); None without a rig.
        measured: Whether it said that anything was.
        skill: 1 - |x - t|^2 / |x0 - t|^2 over the plates, with x the pictures, t the truth, and x0 the average
            plate: 1 is perfect, 0 is no better than the average object, below 0 is worse.
        coverage: Share of the plates' pixels whose true level lies in its interval.
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
def worth_of(
    network: Reconstructor,
    confidence: Confidence,
    samples: NlosDataset,
    images: Tensor,
    canvas: Plane,
    operator: FrameOperator | None = None,
) -> list[PassWorth]:
    """Compare what the confidence says of pictures with their truth, for each pass.

    Args:
        network: The network.
        confidence: What it learned of its pictures' worth.
        samples: The passes, all of known motion.
        images: The network's pictures of all samples, float32 [N, H, W].
        canvas: Their geometry.
        operator: The rig that the network was trained for; the modality then has a group "frame".

    Raises:
        DataError: The motion of a pass is unknown.
    """
    found = []
    for name in dict.fromkeys(samples.names.tolist()):
        mine = np.flatnonzero(samples.names == name)
        rows, at = torch.from_numpy(mine), samples.position_m[mine]
        inputs = samples.inputs[rows]
        pass_ = (inputs, _frames(samples, inputs), images[rows], at)
        said = _judged(network, confidence, *pass_, canvas, operator)
        true, shown = samples.truth[rows].float(), images[rows]
        average = on_canvas(confidence.mean, canvas, at)
        missed, blank = (plates((one - true).square(), canvas, at).sum() for one in (shown, average))
        # Where the resampled truth is a rounding error beyond 0 or 1, it still is 0 or 1.
        held = ((true >= said.low - 1e-3) & (true <= said.high + 1e-3)).float()
        found.append(
            PassWorth(
                name,
                said.support,
                said.agreement,
                said.explained,
                said.measured,
                float(1 - missed / blank),
                float(plates(held, canvas, at).mean()),
                float(plates(said.high - said.low, canvas, at).mean()),
            )
        )
    return found


def _frames(samples: NlosDataset, inputs: Tensor) -> Tensor:
    """Return the frames in inputs, [n, H, W]; zeros where the modality has none."""
    own = samples.modality.slices.get("frame")
    return inputs[:, 0].float() * 0 if own is None else inputs[:, own][:, 0].float()


def risk_coverage(support: ArrayLike, risk: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean risk of what is kept when only the most supported passes are, for each share kept.

    Args:
        support: What the confidence said of each pass, [N].
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
