"""What is reconstructed from a sequence, by solvers and by networks.

- Which networks look at a sequence: the user's own, or the pretrained ones that know its setup.
- What can be made of a sequence: two classical images where the setup is known, and one of each network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.analysis import reconstruct
from evnlos.analysis.confidence import confidence_of, consistent, why_no_confidence
from evnlos.analysis.identify import verdict_on
from evnlos.app.controls import COARSE, Recorded
from evnlos.data import STANDARD_MODALITIES, Sampling, as_modality, object_light
from evnlos.errors import DataError
from evnlos.inverse import SequenceOperator, SequenceProblem
from evnlos.metrics import psnr
from evnlos.models import FrameOperator, Weights, load_weights, published, published_for, published_setup
from evnlos.optics import MatrixTransport
from evnlos.scene import Target
from evnlos.setups import Setup, load_setup
from evnlos.types import Plane

_PAGE = "page-{}-sequence"  # trained on the simulation `page`
_TITLES = {"frame": "network, frames", "event": "network, events", "fusion": "network, both"}


@dataclass(frozen=True)
class Networks:
    """The networks of a page.

    Args:
        own: The user's, by name; empty: those of the package.
    """

    own: Mapping[str, Weights] = field(default_factory=dict)

    def of(self, recorded: Recorded) -> Mapping[str, Weights]:
        """Return the networks for a sequence, by the name to show.

        Those of the package see whole sequences, so they need the motion; of a simulated sequence they are the
        page's, of a capture those of the published setup whose distance is nearest.
        """
        if self.own:
            return self.own
        if recorded.motion is None:
            return {}
        is_simulated = recorded.simulation is not None
        found = {}
        for modality in STANDARD_MODALITIES:
            name = _PAGE.format(modality)
            if not is_simulated:
                name = published_for(recorded.distance_m, modality, is_motion_known=True)
            if name in published() and (recorded.frames is not None or not as_modality(modality).needs_frames):
                found[_TITLES[modality]] = _loaded(name)
        return found

    def wall_of(self, recorded: Recorded) -> Callable[[Sampling], FrameOperator] | None:
        """Return the wall that has to turn the images into the frames: the sequence's own, or the networks'.

        None where there are no frames, or where the networks are the user's and so is the recording.
        """
        setup = None if recorded.simulation is None else recorded.simulation.setup
        if setup is None and not self.own and recorded.motion is not None:
            known = published_setup(published_for(recorded.distance_m, "frame", is_motion_known=True))
            setup = load_setup(known) if known else None
        return None if setup is None or recorded.frames is None else cache(partial(FrameOperator, setup))


@cache
def _loaded(name: str) -> Weights:
    return load_weights(name)


def own_networks(paths: Iterable[Path]) -> Networks:
    """Return the user's networks by a short name each: that of the run's folder or of the file.

    Raises:
        DataError: One of them is missing or is no weights file.
    """
    found: dict[str, Weights] = {}
    for path in paths:
        name = path.resolve().name if path.is_dir() or path.stem != "weights" else path.resolve().parent.name
        name = name.removesuffix(".safetensors")
        found[name if name not in found else f"{name} ({len(found) + 1})"] = load_weights(path)
    return Networks(found)


_DIM, _TRUST = 0.02, 4.0  # a dark plane, and how far an image may go from it
_CELLS = 16  # a side of the target plane of the whole sequence
_SMOOTH = 3.0  # weight of the gradient in units of the noise's variance
_STATIC = 1.0  # the camera's fixed pattern is about as strong as its noise


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The images that one method made of a sequence.

    Args:
        name: The method.
        note: What it uses.
        images: The scored rows of the canvas, float32 [N, h, w], 0..1.
        psnr_db: PSNR of each image, [N]; None where the truth is unknown.
        black_db: PSNR of an all-black image, [N].
    """

    name: str
    note: str
    images: NDArray[np.float32]
    psnr_db: NDArray[np.float64] | None = None
    black_db: NDArray[np.float64] | None = None


def from_each_frame(recorded: Recorded) -> Reconstruction:
    """Return the regularised least squares image of each frame alone, the setup and its noise being known.

    Raises:
        DataError: The sequence has no frames, or its setup is unknown.
    """
    setup, frames = _known(recorded)
    operator = FrameOperator(setup, COARSE)
    seen = torch.from_numpy(recorded.samples(COARSE).frame)
    flat = torch.full((len(frames), COARSE.height, COARSE.width), _DIM)
    images = consistent(flat, seen, operator, trust=_TRUST)[:, COARSE.scored].numpy()
    return _scored("least squares", "one frame, setup known, nothing learned", images, recorded, COARSE)


def from_whole_sequence(recorded: Recorded) -> Reconstruction:
    """Return one image from all frames at once, setup and motion being known, drawn where the object was.

    Raises:
        DataError: The sequence has no frames, or its setup or its motion is unknown.
    """
    setup, frames = _known(recorded)
    if recorded.motion is None or recorded.target is None:
        raise DataError("the motion or the target is unknown; the whole sequence needs both")
    size_m, shape = recorded.target.size_m, frames.shape[1:]
    light = object_light(frames, recorded.peak, setup, shape)
    strip = setup.target_cells()
    assert strip is not None  # `_known` refuses setups without
    made = setup.seen_by(shape).operator(strip, dtype=torch.float32)
    places = recorded.motion.position_m(recorded.times_s)
    target_plane = Plane(_CELLS, _CELLS, size_m / _CELLS)
    problem = SequenceProblem(
        SequenceOperator(MatrixTransport(made.dense(torch.float32), strip, shape), target_plane, places),
        _STATIC,
    )
    variance = setup.frame_camera.noise_variance(light.mean() + setup.ambient)
    image = problem.tikhonov(light, _SMOOTH * float(variance)).image
    found = Target("found", image.clamp(0, 1).float().numpy(), size_m)
    fine = Sampling()
    images = found.rasterise(fine.canvas, places)[:, fine.scored]
    return _scored(
        "whole sequence", "all frames, setup and motion known, nothing learned", images, recorded, fine
    )


def from_weights(
    recorded: Recorded,
    name: str,
    weights: Weights,
    wall: Callable[[Sampling], FrameOperator] | None = None,
) -> Reconstruction:
    """Return the images of a network, and how far to believe them.

    Args:
        recorded: The sequence.
        name: What to call the network.
        weights: The network.
        wall: What has to make the frames of these images, for a size of samples; None: the images alone
            are required.

    Raises:
        DataError: The sequence has no frames, and the network needs them.
    """
    if recorded.frames is None and weights.modality.needs_frames:
        raise DataError(
            f"{name} looks at frames ({weights.modality.name}), and the recording has none; "
            "give weights of the modality event, or upload a capture folder"
        )
    sampling = weights.sampling
    samples = recorded.samples(sampling)
    pictures = reconstruct(weights, samples.frame, samples.surface, samples.position_m)
    images = pictures[:, sampling.scored].numpy()
    noun = weights.modality.noun
    saw = f"all {noun}" if weights.network.sees_sequence else f"{noun} of one time step"
    unjudged = why_no_confidence(weights, samples)
    operator = wall(sampling) if wall is not None and unjudged is None else None
    confidence = confidence_of(weights, samples, pictures, operator)
    verdict = verdict_on(None, confidence, unjudged)  # what the wall allows stands in a box of its own
    note = "; ".join([f"network: {saw}", *verdict.lines])
    return _scored(name, note, images, recorded, sampling)


def _known(recorded: Recorded) -> tuple[Setup, NDArray]:
    simulation, frames = recorded.simulation, recorded.frames
    if simulation is None or frames is None or simulation.setup.target_cells() is None:
        raise DataError("the setup or the frames are unknown; a classical image needs both")
    return simulation.setup, frames


def _scored(
    name: str, note: str, images: NDArray[np.float32], recorded: Recorded, sampling: Sampling
) -> Reconstruction:
    truth = recorded.truth(sampling)
    if truth is None:
        return Reconstruction(name, note, images)
    true = torch.from_numpy(truth)
    own, black = (
        psnr(one, true).double().numpy() for one in (torch.from_numpy(images), torch.zeros_like(true))
    )
    return Reconstruction(name, note, images, own, black)
