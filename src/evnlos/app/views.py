"""What the page shows of a sequence: what is reconstructed from it, images and words.

- Which networks look at a sequence: the user's own, or the pretrained ones that know its setup.
- What can be made of a sequence: two classical images where the setup is known, and one of each network.
- What the chosen setup can show at all, in plain words.
- From a sequence and its reconstructions to the images that stand side by side on the page.
- Views as one piece of HTML without requests: each a tall image of all positions, of which one is shown.
"""

from __future__ import annotations

import html
import io
import json
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from evnlos.analysis import Identification, identify, reconstruct
from evnlos.analysis.confidence import confidence_of, consistent, why_no_confidence
from evnlos.analysis.identify import QUICK, verdict_on
from evnlos.app.controls import COARSE, FILM_PLANE, Recorded
from evnlos.cameras import EventPixel
from evnlos.data import STANDARD_MODALITIES, Sampling, Simulation, as_modality, object_light
from evnlos.errors import DataError
from evnlos.events import time_surface
from evnlos.events.volume import WORDS
from evnlos.inverse import SequenceOperator, SequenceProblem
from evnlos.inverse.event_film import QUICK_MODES
from evnlos.metrics import psnr
from evnlos.models import (
    FilmSolver,
    FrameOperator,
    Weights,
    load_weights,
    published,
    published_for,
    published_setup,
)
from evnlos.optics import MatrixTransport
from evnlos.plot.figures import (
    CloudSize,
    cloud_images,
    signed_images,
    slice_images,
    smaller,
    time_slices,
)
from evnlos.report.pictures import data_uri, grey
from evnlos.scene import Target
from evnlos.setups import Setup, load_setup
from evnlos.types import Evidence, Plane

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
            setup = nearest_setup(recorded)
        return None if setup is None or recorded.frames is None else cache(partial(FrameOperator, setup))


def nearest_setup(recorded: Recorded) -> Setup | None:
    """Return the published setup whose distance is nearest to that of a recording; None where there is none."""
    name = published_for(recorded.distance_m, "frame", is_motion_known=True) if published() else ""
    known = published_setup(name)
    return load_setup(known) if known else None


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


_MOST_IMAGES = 120  # of a film
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


@lru_cache(maxsize=4)
def _film_solver(setup: Setup, plane: Plane) -> FilmSolver:
    return FilmSolver(setup, plane, modes=QUICK_MODES)


def from_film(
    recorded: Recorded,
    evidence: Evidence,
    taken: tuple[Setup, Plane] | None = None,
) -> Reconstruction:
    """Return the film of a hidden plane that changes, from one in so many positions where there are very many.

    Args:
        recorded: The sequence.
        evidence: What the film is made of.
        taken: Setup and plane that the sequence is taken to be of; None: those of a simulated one.

    Raises:
        DataError: The setup is unknown, or the sequence has no frames or too few.
    """
    setup, plane = taken or (_known(recorded)[0], FILM_PLANE)
    step = -(-len(recorded) // _MOST_IMAGES)
    frames = None if evidence == "events" or recorded.frames is None else recorded.frames[::step]
    events, times_s = None if evidence == "frames" else recorded.events, recorded.times_s[::step]
    found = _film_solver(setup, plane).film(times_s, frames, events, peak=recorded.peak, count=len(times_s))
    images = np.repeat(found.mean.astype(np.float32), step, axis=0)[: len(recorded)]
    seen = {"frames": "frames", "events": "events", "both": "frames and events"}[evidence]
    known = "guessed" if taken else "known"
    note = f"{'all' if step == 1 else f'one in {step}'} {seen}, setup {known}, nothing learned"
    truth = film_truth(recorded)
    if truth is not None:
        low, high = found.interval()
        note += f"; 90 % intervals hold {100 * np.mean((truth >= low) & (truth <= high)):.0f} % of the cells"
    if not found.is_explained:
        note += "; no plane here explains the frames: give a larger one, or the setup is another"
    return _against(f"film, {evidence}", note, images, truth)


def film_truth(recorded: Recorded) -> NDArray[np.float32] | None:
    """Return what a plane that changes shows at each instant, on its cells, [N, h, w]; None where unknown."""
    if recorded.film is None:
        return None
    fine, (rows, columns) = recorded.film.at(recorded.times_s), FILM_PLANE.shape
    return fine.reshape(len(fine), rows, -1, columns, fine.shape[2] // columns).mean(axis=(2, 4))


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
    return _against(name, note, images, recorded.truth(sampling))


def _against(
    name: str, note: str, images: NDArray[np.float32], truth: NDArray[np.float32] | None
) -> Reconstruction:
    """Return images with their PSNR, those of a film within 0 and 1."""
    if truth is None:
        return Reconstruction(name, note, images)
    true = torch.from_numpy(truth)
    own, black = (
        psnr(one, true).double().numpy()
        for one in (torch.from_numpy(images).clamp(0, 1), torch.zeros_like(true))
    )
    return Reconstruction(name, note, images, own, black)


@lru_cache(maxsize=64)
def _identified(setup: Setup, target_m: float) -> Identification:
    return identify(setup, QUICK, stated_m=target_m)


def limits_of(simulation: Simulation) -> Identification:
    """Return what one frame of this setup and camera can show of a target at a known place, whatever the
    method.

    Raises:
        ConfigError: The setup is geometrically impossible, or the camera gets no light.
    """
    # The event pixel is no part of the question: one answer for all of its settings.
    return _identified(replace(simulation.setup, pixel=EventPixel()), simulation.glyphs.target_plane.size_m)


_LONGEST_SIDE = 320  # of an image of the wall or of events: a page shows no more


@dataclass(frozen=True, eq=False)
class View:
    """One place on the page: an image for each position, or one with a cursor that runs through time.

    Args:
        title: What it shows.
        note: How to read it, with units.
        pictures: uint8, grey [N, h, w], RGBA [N, h, w, 4], or with `colours` numbers of colours [N, h, w].
        captions: A line for each position; empty where there is none.
        colours: RGBA, uint8 [K, 4].
        group: "seen", "found" or "events": where on the page it stands.
        cursor: Whether time runs to the right in the one image.
        marks: Words at places of the image: (text, left, top), shares of its sides.
    """

    title: str
    note: str
    pictures: NDArray[np.uint8]
    captions: tuple[str, ...] = ()
    colours: NDArray[np.uint8] | None = None
    group: str = "seen"
    cursor: bool = False
    marks: tuple[tuple[str, float, float], ...] = ()


def seen_views(recorded: Recorded) -> list[View]:
    """Return hidden object, wall, events and time surface."""
    views = []
    truth = recorded.truth(Sampling())
    if truth is not None:
        views.append(View("Hidden object", "the truth, 24 cm x 12 cm; no camera sees it", grey(truth)))
    if recorded.film is not None:
        shown = grey(recorded.film.at(recorded.times_s))
        views.append(View("Hidden plane", "the truth, 8 cm x 8 cm; no camera sees it", shown))
    if recorded.frames is not None:
        views.append(_wall_view(recorded))
    events, edges = smaller(recorded.events, _LONGEST_SIDE), recorded.edges_us
    counts = np.diff(np.searchsorted(events.t_us, edges, side="right"))
    interval_ms = float(np.median(np.diff(edges))) / 1e3
    views.append(
        View(
            "Events",
            f"{WORDS}, of the last {interval_ms:.3g} ms",
            slice_images(events, edges),
            tuple(f"{count:,} events" for count in counts),
        )
    )
    tau_us = max(float(np.median(np.diff(edges))), 1.0)
    surface = time_surface(events, edges, tau_us)
    views.append(
        View(
            "Time surface",
            f"each pixel's newest event; it fades in {interval_ms:.3g} ms",
            signed_images(surface, 1.0, faintest=0.0),
        )
    )
    return views


def found_views(found: Sequence[Reconstruction]) -> list[View]:
    """Return a view of each reconstruction, with its PSNR beside that of an all-black image."""
    views = []
    for one in found:
        captions: tuple[str, ...] = ()
        if one.psnr_db is not None and one.black_db is not None:
            captions = tuple(
                f"{own:.1f} dB, black {black:.1f}" for own, black in zip(one.psnr_db, one.black_db, strict=True)
            )
        views.append(
            View(one.name[:1].upper() + one.name[1:], one.note, grey(one.images), captions, group="found")
        )
    return views


def event_views(recorded: Recorded) -> list[View]:
    """Return the space-time cloud and the slices through its middle."""
    events, edges = smaller(recorded.events, _LONGEST_SIDE), recorded.edges_us
    size = CloudSize()
    pictures, colours = cloud_images(events, edges, size)
    begin, along, across, down = size.axes() / [size.width, size.height]
    seconds = (int(edges[-1]) - int(edges[0])) / 1e6
    foot = begin + across + down
    marks = (
        (f"time, {seconds:.3g} s", *(foot + 0.5 * along + [0, 0.03])),
        (f"x, {recorded.events.width} px", 0.01, float((begin + down + 0.62 * across)[1])),
        (f"y, {recorded.events.height} px", *(begin + 0.9 * down + [0.01, -0.06])),
    )
    drawn = min(len(events), size.most)
    note = f"{drawn:,} of {len(events):,} events; the frame stands at this instant, grey is still to come"
    views = [View("Space-time cloud", note, pictures, (), colours, "events", marks=marks)]
    for name, other, counts in zip("xy", ("rows", "columns"), time_slices(events, edges), strict=True):
        note = f"events of the middle {other}: {name} downwards, time to the right ({seconds:.3g} s)"
        picture = signed_images(counts)[None]
        views.append(View(f"Slice: {name} over time", note, picture, (), None, "events", cursor=True))
    return views


def _wall_view(recorded: Recorded) -> View:
    assert recorded.frames is not None  # asked by the caller
    levels = recorded.frames.astype(np.float32) / recorded.peak
    factor = -(-max(levels.shape[1:]) // _LONGEST_SIDE)
    levels = levels[:, ::factor, ::factor]
    low, high = np.percentile(levels, [0.5, 99.8])
    brightest = levels.max(axis=(1, 2))
    return View(
        "Wall",
        f"what the frame camera sees; black {low:.2f}, white {high:.2f} of full scale",
        grey(levels, low, high),
        tuple(f"brightest pixel {value:.2f}" for value in brightest),
    )


_WORDS = {
    "wall roughness": "How far the wall throws light off the direction in which a mirror would. At 0.02 it is "
    "polished metal, at 0.1 it is dull; matte paint throws light everywhere alike.",
    "white level": "A light of 1 white level just fills a pixel of the frame camera.",
    "event": "A pixel of an event camera sends no images. It reports when its light has changed by a "
    "threshold, brighter or darker, at that instant.",
    "threshold": "How much the natural logarithm of a pixel's light has to change for an event: 0.15 is 16 %.",
    "time surface": "An image made from events: each pixel shows how recent its newest event is.",
    "least squares": "The image that explains one frame best, kept dark where the frame says nothing.",
    "film": "An image for each instant of a plane that changes: nothing moves as a whole. Images close in time "
    "are alike; how much, the frames tell.",
    "whole sequence": "The one image that explains all frames of the sequence together.",
    "dB": "PSNR: ten decibels more are a tenth of the squared error. It means something only beside the value "
    "of an all-black image at the same instant.",
    "verdict": "What wall and noise leave to be seen in one frame, whatever the method; a whole sequence shows "
    "more. Where they leave nothing, a network may still draw a letter: it remembers one.",
}

GLOSSARY = (
    '<details class="ev-words"><summary>What the words mean</summary><dl>'
    + "".join(f"<dt>{word}</dt><dd>{text}</dd>" for word, text in _WORDS.items())
    + "</dl></details>"
)
"""The words explained, as HTML."""


_GROUPS = {
    "seen": "What is there, and what the cameras see",
    "found": "What can be made of it",
    "events": "The events in space and time",
}


def sheet(
    views: Sequence[View],
    times_s: NDArray[np.float64],
    name: str = "sequence",
    link: str = "",
    drawing: str = "",
    moment: tuple[str, str] = ("position", "hidden object"),
) -> str:
    """Return views in their groups, above them a slider over the positions and a button that plays them.

    Moving the slider asks nobody: all positions are in the page already.

    Args:
        views: The views.
        times_s: Instant of each position, [N], seconds.
        name: What the sequence is called, for people who listen to the page.
        link: Address of these settings, or nothing.
        drawing: The setup from above as SVG, or nothing.
        moment: What the slider runs over, and of what.
    """
    count = len(times_s)
    start = count // 2
    words = [f"{moment[0]} {k + 1} of {count}, {time:.2f} s" for k, time in enumerate(times_s)]
    texts = html.escape(json.dumps(words), True)
    parts = [
        '<div class="ev-player">',
        '<button type="button" class="ev-button ev-play" aria-pressed="false" onclick="evnlosPlay(this)">'
        "Play</button>",
        f'<label>{moment[0].capitalize()} <input type="range" class="ev-position" min="0" max="{count - 1}" '
        f'step="1" value="{start}" aria-label="{moment[0].capitalize()} of the {moment[1]}" '
        'oninput="evnlosMove(this)"></label>',
        f'<output class="ev-now" data-texts="{texts}">{words[start]}</output>',
        '<button type="button" class="ev-button" onclick="evnlosSave(this)">Download</button>',
        '<a class="ev-button" onclick="return evnlosShare(this)" '
        f'href="{html.escape(link, True)}">Copy link</a>'
        if link
        else "",
        "</div>",
    ]
    for group, title in _GROUPS.items():
        chosen = [view for view in views if view.group == group]
        if chosen:
            parts.append(f'<h3 class="ev-title">{title}</h3><div class="ev-row ev-{group}">')
            parts += [_figure(view, start) for view in chosen]
            parts.append("</div>")
    if drawing:
        parts.append(f'<h3 class="ev-title">The setup</h3><figure class="ev-setup">{drawing}</figure>')
    content = "".join(parts)
    mark = zlib.crc32(content.encode())  # tells the page that another sequence is shown
    return (
        f'<section class="ev-sheet" data-sequence="{mark:08x}" style="--k:{start};--n:{count}" '
        f'aria-label="{html.escape(name, True)}">{content}</section>'
    )


def verdict_box(found: Identification) -> str:
    """Return what a setup can show as HTML."""
    figures = (
        f"On handwriting, the best linear image from one frame reaches {found.at_camera.psnr_db:.1f} dB; "
        f"a mean character {found.mean_db:.1f} dB, an all-black image {found.zero_db:.1f} dB."
    )
    wall = html.escape(f"{found.wall[:1].upper()}{found.wall[1:]}.")
    reason = html.escape(found.verdict.partition(": ")[0])
    return (
        '<div class="ev-verdict" role="status"><strong>Can this setup show anything? </strong>'
        f"<span>{wall}</span><p>{reason}. {figures}</p></div>"
    )


def waiting_box() -> str:
    """Return what stands where the verdict will be."""
    return (
        '<div class="ev-verdict" role="status"><strong>Can this setup show anything? </strong>'
        "<span>Looking at it.</span></div>"
    )


def message_box(text: str, wrong: bool = True) -> str:
    """Return a message of one line as HTML; nothing in it is taken for HTML."""
    line = html.escape(" ".join(text.split()))
    kind, role = ("ev-wrong", "alert") if wrong else ("ev-note", "status")
    return f'<div class="ev-message {kind}" role="{role}">{line}</div>'


def sprite(view: View) -> bytes:
    """Return all images of a view below each other as one PNG."""
    stack = view.pictures.reshape(-1, *view.pictures.shape[2:])  # [N h, w] or [N h, w, 4]
    image = Image.fromarray(np.ascontiguousarray(stack))
    options: dict[str, bytes] = {}
    if view.colours is not None:
        image = Image.frombytes("P", image.size, stack.tobytes())
        image.putpalette(view.colours[:, :3].tobytes())
        options["transparency"] = view.colours[:, 3].tobytes()
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=3, **options)
    return buffer.getvalue()


def _figure(view: View, start: int) -> str:
    height, width = view.pictures.shape[1:3]
    many = len(view.pictures) > 1
    place = "calc(var(--k) / max(var(--n) - 1, 1) * 100%)" if many else "0"
    tall = "calc(var(--n) * 100%)" if many else "100%"
    ratio = f"{width} / {height}" if not view.cursor else "2 / 1"
    style = (
        f"aspect-ratio:{ratio};background-image:url({data_uri(sprite(view))});"
        f"background-size:100% {tall};background-position:0 {place}"
    )
    title, note = html.escape(view.title), html.escape(view.note)
    inner = '<i class="ev-cursor"></i>' if view.cursor else ""
    inner += "".join(
        f'<span class="ev-mark" style="left:{100 * x:.1f}%;top:{100 * y:.1f}%">{html.escape(text)}</span>'
        for text, x, y in view.marks
    )
    caption = ""
    if view.captions:
        texts = html.escape(json.dumps(view.captions), True)
        caption = f'<span class="ev-value" data-texts="{texts}">{html.escape(view.captions[start])}</span>'
    kind = " ev-line" if view.colours is not None else ""
    return (
        f'<figure><figcaption><b>{title}</b>{caption}</figcaption><div class="ev-image{kind}" role="img" '
        f'aria-label="{title}: {note}" style="{style}">{inner}</div><small>{note}</small></figure>'
    )
