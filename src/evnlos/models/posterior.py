"""What the frames and events of a sequence say of its target, under a Gaussian prior or a learned one.

The Gaussian posterior is that of `inverse.estimate_sequence`. A learned prior is a network that takes noise out
of drawn targets:

D(y, s) = E[x | y = x + s n] of drawn targets x, n normal, knows their density blurred by s: its gradient is
(D - y) / s^2 (Vincent, A connection between score matching and denoising autoencoders, 2011; Karras et al.,
Elucidating the design space of diffusion-based generative models, NeurIPS 2022). A measurement says
L(x) = exp(b^T z - z^T A z / 2) of the coefficients z of a target. Samples of p(x) L(x) are drawn by two steps
in turn, at a distance r that falls to the least (split Gibbs: Vono et al., 2019; Wu et al., Principled
probabilistic imaging using diffusion models as plug-and-play priors, NeurIPS 2024):

- u | x from L(u) N(u; x, r^2), a Gaussian, exactly;
- x | u from p(x) N(u; x, r^2): the noise r is taken out of u in ancestral steps,
  y' = D + (s' / s)^2 (y - D) + s' sqrt(1 - (s' / s)^2) n.

| symbol | meaning | unit |
|---|---|---|
| x, u, y | targets on cells, clean, in between, noisy | brightness, 1 = white |
| s, s', r | standard deviations of noise: now, after a step, between x and u | brightness |
| z | coefficients of a `PatternPrior`, x = mean + patterns z + rest | standard deviations of the prior |
| A, b | information [k, k] and score [k] that the measurement gives of z | |
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from evnlos.cameras import PixelMaps
from evnlos.cameras.streams import WHITE_DN
from evnlos.data import Capture, FixedPattern
from evnlos.data.fixed_pattern import object_light, used_maps
from evnlos.data.frames import own_pixels
from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.inverse import (
    TRACKED_ROOM,
    FilmEstimate,
    FilmFrames,
    FilmPrior,
    FrameTerm,
    PatternPrior,
    SequenceEstimate,
    SequenceLight,
    SequenceLights,
    estimate_event_film,
    estimate_film,
    estimate_sequence,
    record_of,
)
from evnlos.inverse.changing import LEAST_FRAMES
from evnlos.inverse.event_film import MOST_MODES
from evnlos.inverse.event_images import COEFFICIENTS, event_prior
from evnlos.inverse.sequence_problem import matrix_of
from evnlos.machine import Progress, note, silent
from evnlos.models.unet import ResidualUNet, UNetConfig
from evnlos.models.weights import weights_folders
from evnlos.optics import MatrixTransport
from evnlos.setups import Setup
from evnlos.tensor_file import TensorFile
from evnlos.types import Colour, Events, Evidence, Plane

SPREAD = 0.5
"""Standard deviation that inputs of the network are scaled by; of bright and dark cells in equal parts."""
_FOLDER = "priors"
_RATIO = 0.9  # of the noise after a step to that before it
_FARTHEST, _NEAREST = 2.0, 0.05  # distance r at the first and at the last turns
_TURNS, _AT_LAST = 24, 8  # turns on the way, and at the least distance
_TOGETHER = 32  # samples that the network sees at a time
_PATTERNS = 120  # of a target: all that a minute of a core allows where events are solved in full
_GAP_S = 0.4  # between the instants at which silences are looked at
_NORMAL_90 = 1.645
_BESIDE = 0.02  # an interval of samples is widened by it: what is dark for sure is no interval of width 0
OPEN = 0.2
"""Width of an interval, brightness, from which a cell counts as left open."""


@dataclass(frozen=True)
class AboutPrior:
    """Description of a file of a learned prior."""

    width: int
    """Channels of the network at full resolution."""
    cells: int
    """Cells along a side of the targets."""
    trained_on: str
    """What targets it knows, in words."""
    least_noise: float = 0.02
    """Least and"""
    most_noise: float = 10.0
    """most noise that it has learned to take out, in brightness."""

    def __post_init__(self) -> None:
        if not (1 <= self.width <= 512 and 4 <= self.cells <= 256):
            sizes = f"{self.width} channels on {self.cells} cells"
            raise ConfigError(f"a prior of {sizes}; give 1 to 512, and 4 to 256")
        if not 0 < self.least_noise < self.most_noise < math.inf:
            raise ConfigError(f"noise from {self.least_noise} to {self.most_noise}; give two ascending numbers")


class LearnedPrior(nn.Module):
    """The denoiser D of targets.

    Args:
        about: Its size, and what it knows.

    Example:
        >>> prior = LearnedPrior(AboutPrior(width=8, cells=16, trained_on="nothing"))
        >>> prior(torch.zeros(2, 16, 16), torch.tensor([0.1, 1.0])).shape
        torch.Size([2, 16, 16])
    """

    def __init__(self, about: AboutPrior) -> None:
        super().__init__()
        self.about = about
        self.unet = ResidualUNet(2, UNetConfig(width=about.width, depth=2, blocks=1, shuffle=2))

    def forward(self, noisy: Tensor, noise: Tensor) -> Tensor:
        """Return the mean clean target, [B, h, w], 0..1.

        Args:
            noisy: Targets plus noise, [B, h, w].
            noise: Standard deviation of the noise of each, [B], brightness.
        """
        size = noise[:, None, None, None]
        scaled = noisy[:, None] / (size.square() + SPREAD**2).sqrt()
        told = (size.log() / 4).expand_as(scaled)
        return self.unet(torch.cat([scaled, told], dim=1))[:, 0]

    @torch.no_grad()
    def draw(self, noisy: Tensor, noise: float, generator: torch.Generator) -> Tensor:
        """Return a sample of the clean targets behind noisy ones, [B, h, w], each of p(x) N(noisy; x, noise^2).

        Args:
            noisy: Targets plus noise, [B, h, w].
            noise: Standard deviation of the noise, brightness.
            generator: Of the steps.
        """
        least = self.about.least_noise
        steps = max(1, math.ceil(math.log(max(noise / least, 1.0)) / -math.log(_RATIO)))
        sizes = [noise * (least / noise) ** (k / steps) for k in range(steps)] if noise > least else [noise]
        for size, after in zip(sizes, [*sizes[1:], 0.0], strict=True):
            clean = torch.cat([self(part, torch.full((len(part),), size)) for part in noisy.split(_TOGETHER)])
            kept = (after / size) ** 2
            fresh = torch.randn(noisy.shape, generator=generator)
            noisy = clean + kept * (noisy - clean) + after * math.sqrt(1 - kept) * fresh
        return noisy


def _built(about: AboutPrior, **tensors: Tensor) -> LearnedPrior:
    prior, numbers = LearnedPrior(about), tensors["weights"].float()
    count = sum(value.numel() for value in prior.parameters())
    if numbers.numel() != count:
        raise ValueError(f"{numbers.numel()} numbers for a network of {count}")
    vector_to_parameters(numbers, prior.parameters())
    return prior.eval()


PRIOR = TensorFile(
    "evnlos-target-prior-1", ("weights",), AboutPrior, _built, "a learned prior", "the file of a learned prior"
)
"""Learned priors on disk: the parameters of the network in their order, as one array."""


def save_prior(path: str | Path, prior: LearnedPrior) -> None:
    """Write a learned prior, in half precision.

    Args:
        path: The file, NAME.safetensors.
        prior: What is written.
    """
    PRIOR.write(path, {"weights": parameters_to_vector(prior.parameters()).detach().half()}, prior.about)


def load_prior(word: str | Path = "targets") -> LearnedPrior:
    """Return a learned prior.

    Args:
        word: A file of `PRIOR`, or the name of one in the folder `priors` of installed weights.

    Raises:
        UnknownNameError: There is no such file or name.
        DataError: It is damaged.
    """
    if Path(word).is_file():
        return PRIOR.load(word, "")
    known = {one.stem: one for at in weights_folders() for one in (at / _FOLDER).glob("*.safetensors")}
    if str(word) not in known:
        names = f"one of {', '.join(sorted(known))}" if known else "install evnlos-weights"
        raise UnknownNameError(f"there is no learned prior {str(word)!r}; give a file, or {names}")
    return PRIOR.load(known[str(word)], "")


@dataclass(frozen=True, eq=False)
class TargetLikelihood:
    """What a measurement says of a target: exp(b^T z - z^T A z / 2), z its coefficients.

    Args:
        basis: What the coefficients belong to; what its patterns leave out is not measured.
        information: A, [k, k].
        score: b, [k].
    """

    basis: PatternPrior
    information: NDArray[np.float64]
    score: NDArray[np.float64]

    @classmethod
    def of(cls, found: SequenceEstimate, basis: PatternPrior) -> TargetLikelihood:
        """Return what an estimate says without its own Gaussian prior, which has variance 1."""
        total = np.linalg.inv(found.covariance)
        total = (total + total.T) / 2
        return cls(basis, total - np.eye(len(found.z)), total @ found.z)


def posterior_samples(
    prior: LearnedPrior, likelihood: TargetLikelihood, count: int = 32, seed: int = 0
) -> Tensor:
    """Return targets that a measurement and a learned prior allow, float32 [count, h, w], 0..1.

    Where they are alike the measurement tells the target; where they differ, each is drawn from what the prior
    knows, and none is to be believed alone.

    Args:
        prior: What targets look like.
        likelihood: What the measurement says; on the cells of the prior.
        count: Samples.
        seed: Of their noise; the same gives the same samples.

    Raises:
        ConfigError: The cells are not those of the prior, or `count` is below 1.
    """
    basis, cells = likelihood.basis, prior.about.cells
    if count < 1:
        raise ConfigError(f"{count} samples; give 1 or more")
    if basis.target_plane.shape != (cells, cells):
        raise ConfigError(f"targets on {basis.target_plane.shape} cells; the prior knows {cells} x {cells}")
    generator = torch.Generator().manual_seed(seed)
    size = np.sqrt(np.square(basis.patterns).sum(axis=0))
    values, turned = np.linalg.eigh(likelihood.information / np.outer(size, size))
    # of the data alone: in the frame of `axes` [n, k] a target x has precision l and score c about the mean
    axes = torch.from_numpy(basis.patterns / size @ turned)
    precision = torch.from_numpy(values).clamp_min(0.0)
    score = torch.from_numpy(turned.T @ (likelihood.score / size))
    mean = torch.from_numpy(basis.mean)
    image = torch.full((count, cells, cells), float(basis.mean.mean()))
    image += _FARTHEST * torch.randn(image.shape, generator=generator)
    ratio = (_NEAREST / _FARTHEST) ** (1 / (_TURNS - 1))
    distances = [_FARTHEST * ratio**k for k in range(_TURNS)] + _AT_LAST * [_NEAREST]
    for k, distance in enumerate(distances):
        note(f"draw targets, turn {k + 1} of {len(distances)}")
        flat = image.flatten(1).double()
        noise = torch.randn(flat.shape, generator=generator, dtype=torch.float64)
        between = flat + distance * noise
        seen, tighter = (flat - mean) @ axes, precision + distance**-2
        told = (score + seen * distance**-2) / tighter + (noise @ axes) / tighter.sqrt()
        between += (told - seen - distance * (noise @ axes)) @ axes.mT
        image = prior.draw(between.float().view_as(image), distance, generator)
    return image.clamp(0, 1)


def interval_of(samples: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends of the 90 % interval of each cell of samples [S, h, w], two of [h, w]."""
    low, high = (np.quantile(samples, part, axis=0) for part in (0.05, 0.95))
    return low - _BESIDE, high + _BESIDE


@dataclass(frozen=True, eq=False)
class TargetEstimate:
    """A target with its uncertainty.

    Args:
        plane: Its cells.
        image: Its mean, float64 [h, w], brightness.
        deviation: Standard deviation of each cell, [h, w].
        low: Lower end of the 90 % interval of each cell, [h, w].
        high: Upper end of it, [h, w].
        expected_error: Mean squared error of a cell that the variances say.
        seconds: Processor time that it took, the light path aside.
        likelihood: What the measurement says, and what it shows of thresholds, leak and noise.
        samples: Samples of the posterior, float32 [S, h, w], where the prior is learned.
    """

    plane: Plane
    image: NDArray[np.float64]
    deviation: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    expected_error: float
    seconds: float
    likelihood: SequenceEstimate
    samples: Tensor | None = None

    @property
    def open_share(self) -> float:
        """Share of the cells whose interval is wider than a fifth of white: what stands there is a guess."""
        return float((self.high - self.low > OPEN).mean())


def estimate_target(
    capture: Capture,
    setup: Setup,
    evidence: Evidence = "both",
    pattern: FixedPattern | None = None,
    prior: LearnedPrior | None = None,
    samples: int = 32,
    lights: SequenceLights | None = None,
    colour: Colour | None = None,
    maps: PixelMaps | None = None,
) -> TargetEstimate:
    """Return the target of a capture whose motion is known, from the one likelihood of its whole sequence.

    A motion that was found (`capture.path`) is that of the light's middle, which need not be the target's: the
    plane is then larger by a quarter.

    A colour is solved from the pixels that see it alone, which have its share of the light of a wall that is
    grey. Of frames its brightness is that over the white balance, of events that over the ambient light of the
    same colour: a logarithm knows no other unit.

    Args:
        capture: The recording.
        setup: Its setup, linear.
        evidence: What the likelihood is made of.
        pattern: Fixed pattern of the frame camera; None: an offset of each pixel is integrated out.
        prior: A learned prior; None: the Gaussian of handwriting.
        samples: Samples under a learned prior.
        lights: Lights of the setup's sequences, kept from call to call.
        colour: The colour, in which the frames were read if they count; None is what all pixels see, as grey.
        maps: Measured thresholds of the event camera; None: all that is known of them is the setup's.

    Raises:
        ConfigError: The motion is unknown, the event model states no law of its crossings, or no event pixel
            has a filter of the colour.
        DataError: The maps are of another camera.
    """
    motion, size = capture.path, capture.info.target_size_m
    patterns = _PATTERNS if prior is None or evidence != "frames" else COEFFICIENTS
    if motion is not None:
        basis = event_prior(setup, TRACKED_ROOM * size, patterns, size)
    elif capture.motion is not None:
        motion, basis = capture.motion.in_its_plane(), event_prior(setup, size, patterns)
    else:
        raise ConfigError(f"{capture.name}: unknown motion; state it in capture.yaml (`evnlos track` finds it)")
    times = np.asarray(capture.frame_times_us * 1e-6, np.float64)
    span, shape = (float(times[0]), float(times[-1])), (capture.events.height, capture.events.width)
    light = (lights or SequenceLights()).of(setup.seen_by(shape), basis, motion, span, shape)
    frames, record, law, begun = None, None, None, time.process_time()

    def behind(kind: Literal["frames", "events"]) -> tuple[SequenceLight, NDArray[np.bool_]]:
        """Return the light of the pixels of one camera that count, and which these are."""
        if colour is None:
            return light, np.ones(len(light.left), np.bool_)
        info = capture.info.in_colour(colour)
        seen, share = own_pixels(info, colour, kind).ravel(), info.camera.balance
        left, still = share * light.left[seen], light.still[seen] * np.float32(share)
        return replace(light, left=left, still=still, shape=(1, len(left))), seen

    if evidence != "events":
        peak = float(capture.peak)
        levels = capture.frames / peak if pattern is None else pattern.correct(capture.frames, peak)
        shown, own = behind("frames")
        values = np.asarray(levels, np.float64).reshape(len(levels), -1)[:, own]
        frames = FrameTerm(shown, values, times, setup.frame_camera, pattern is not None, setup.frame_doubt)
    if evidence != "frames":
        light, own = behind("events")
        law = replace(setup.pixel.known_law(light.typical_dn), known=used_maps(maps, capture.info, shape))
        record = record_of(capture.events, law, span, _GAP_S)
        if colour is not None:
            kept, law = own[record.pixel], law.mapped(lambda one: one.ravel()[own][None])
            record = replace(record.of_pixels(kept), pixel=(np.cumsum(own) - 1)[record.pixel[kept]])
    found = estimate_sequence(light, basis, law, record, frames)
    image, deviation, error, drawn = found.image, found.deviation, found.expected_error, None
    low, high = image - _NORMAL_90 * deviation, image + _NORMAL_90 * deviation
    if prior is not None:
        drawn = posterior_samples(prior, TargetLikelihood.of(found, basis), samples)
        each = drawn.double().numpy()
        image, deviation = each.mean(axis=0), each.std(axis=0, ddof=min(samples - 1, 1))
        error = float(np.square(deviation).mean())
        low, high = interval_of(each)
    seconds = round(time.process_time() - begun, 1)
    return TargetEstimate(basis.target_plane, image, deviation, low, high, error, seconds, found, drawn)


_FILM_STEP_S = 0.1  # between images of a film that events tell


class FilmSolver:
    """Films of a hidden plane that changes, from what cameras see of its wall; the light path is made once.

    Args:
        setup: The setup, linear.
        plane: The hidden plane, about the middle of the setup's.
        columns: Columns to which frames are reduced, pixels.
        modes: Most modes that events are asked for; time grows with their cube.
    """

    def __init__(self, setup: Setup, plane: Plane, columns: int = 64, modes: int = MOST_MODES) -> None:
        self.setup, self.plane, self._columns, self._modes = setup, plane, columns, modes
        self._paths = dict[tuple[tuple[int, int], bool], MatrixTransport]()

    def path(self, size: tuple[int, int], frames: bool) -> MatrixTransport:
        """Return the light path to a camera, which is made once.

        Args:
            size: Its rows and columns, pixels.
            frames: Whether its images are reduced, as frames are.
        """
        if (size, frames) not in self._paths:
            across = min(self._columns, size[1]) if frames else size[1]
            shape = (max(1, round(size[0] * across / size[1])), across)
            self._paths[size, frames] = matrix_of(self.setup.seen_by(size).operator(self.plane, shape))
        return self._paths[size, frames]

    def film(
        self,
        times_s: NDArray[np.float64],
        frames: NDArray | None = None,
        events: Events | None = None,
        *,
        peak: float = 1.0,
        pattern: FixedPattern | None = None,
        static: float | None = None,
        prior: FilmPrior | None = None,
        begins: bool = True,
        count: int | None = None,
        progress: Progress = silent,
        maps: PixelMaps | None = None,
    ) -> FilmEstimate:
        """Return the film that frames, events, or both tell.

        Args:
            times_s: Times of the frames, [N], seconds; without frames the first and last instant count, and how
                many there are.
            frames: Digital numbers [N, H, W]; None: events alone.
            events: On the clock of the frames; None: frames alone.
            peak: Digital number of white.
            pattern: Fixed pattern of the frame camera, to be taken off.
            static: Standard deviation of a pixel's constant offset over its noise's; None: as the frames say.
            prior: The prior; None: as the frames say, or the one of events alone.
            begins: Whether the pixels of the event camera start with the first instant, or saw events before.
            count: How many images events tell; None: one every tenth of a second, or as many as times.
            progress: Told the iterations.
            maps: Measured thresholds of the event pixels that are used; None: they are not known.

        Raises:
            ConfigError: The event model states no law of its crossings.
            DataError: Too few frames, or too many images.
        """
        setup, beside = self.setup, None
        if frames is not None:
            height, width = frames.shape[1:]
            operator = self.path((height, width), frames=True)
            shape = operator.shape
            light = object_light(frames, peak, setup, shape, pattern).double()
            level = light.mean(dim=0) + setup.ambient_light(shape)
            averaged = height * width / (shape[0] * shape[1])  # of the sensor's pixels, each with its own noise
            noise = (setup.frame_camera.noise_variance(level) / averaged).sqrt()
            found = estimate_film(operator, light, times_s, noise, static=static, prior=prior)
            if events is None:
                return found
            beside = FilmFrames(operator, light, noise, found)
        if events is None:
            raise DataError("there are neither frames nor events; give one of them")
        size, span = events.shape, (float(times_s[0]), float(times_s[-1]))
        still = setup.seen_by(size).ambient_light(size)
        law = setup.pixel.known_law(WHITE_DN * float(still.mean()))
        law = replace(law, starts_at_rest=law.starts_at_rest and begins, known=maps)
        record = record_of(events, law, span, _GAP_S)
        count = count or max(len(times_s), round((span[1] - span[0]) / _FILM_STEP_S) + 1)
        seen = self.path(size, frames=False), still, record, law, np.linspace(*span, count)
        from threadpoolctl import threadpool_limits  # whose import changes the environment

        with threadpool_limits(1):
            return estimate_event_film(*seen, frames=beside, prior=prior, modes=self._modes, progress=progress)


class RunningFilm:
    """The newest image of a film, of what cameras saw in the newest seconds, while they go on.

    The frames' prior is sought again whenever twice as many frames have come as when it was sought.

    Args:
        solver: What makes the film.
        evidence: What it is made of.
        newest_s: How much of the past an image knows, seconds: what bounds the time it takes.

    Raises:
        ConfigError: The seconds are too few for three images, or not finite.
    """

    def __init__(self, solver: FilmSolver, evidence: Evidence, newest_s: float) -> None:
        if not 3 * _FILM_STEP_S <= newest_s < math.inf:
            raise ConfigError(f"newest_s is {newest_s:g}; give {3 * _FILM_STEP_S:g} seconds or more")
        self._solver, self._evidence, self._newest_us = solver, evidence, round(1e6 * newest_s)
        self.forget()

    def forget(self) -> None:
        """Begin anew: what comes next is of another recording."""
        self._events, self._frames = list[Events](), list[tuple[int, NDArray[np.float32]]]()
        self._begin_us: int | None = None
        self._until_us, self._count, self._sought = 0, 0, 0
        self._prior: FilmPrior | None = None

    def add(
        self, events: Events, until_us: int, frame: NDArray | None = None, frame_us: int | None = None
    ) -> None:
        """Take what came next.

        Args:
            events: Events, in order.
            until_us: Instant up to which they are complete, microseconds.
            frame: White levels [H, W], less the camera's fixed pattern; None where none came.
            frame_us: When the frame was taken, microseconds; None: at `until_us`.
        """
        if self._begin_us is None:
            self._begin_us = min(until_us, int(events.t_us[0]) - 1) if len(events) else until_us
        self._until_us = until_us
        self._events += [events] if len(events) and self._evidence != "frames" else []
        if frame is not None and self._evidence != "events":
            self._frames.append((until_us if frame_us is None else frame_us, frame))
            self._count += 1

    def newest(self) -> tuple[NDArray[np.float32], int] | None:
        """Return the newest image, float32 [h, w], and its instant, microseconds; None: too little came."""
        seen = self._events if self._evidence == "events" else self._frames[LEAST_FRAMES - 1 :]
        end_us = self._frames[-1][0] if self._frames else self._until_us
        begin_us = self._begin_us or 0
        first_us = max(begin_us, end_us - self._newest_us)
        if not seen or end_us - first_us < 1e6 * _FILM_STEP_S:
            return None
        times_us, frames, events = np.linspace(first_us, end_us, LEAST_FRAMES), None, None
        if self._evidence != "events":
            recent = sum(t_us >= first_us for t_us, _ in self._frames)
            self._frames = self._frames[-max(recent, LEAST_FRAMES) :]
            times, images = zip(*self._frames, strict=True)
            times_us, frames = np.array(times), np.stack(images)
        if self._events:
            events = Events.concatenate(self._events).between(int(times_us[0]), self._until_us)
            self._events = [events]
        is_old = self._count < 2 * self._sought
        found = self._solver.film(
            times_us * 1e-6,
            frames,
            events,
            prior=self._prior if is_old else None,
            begins=int(times_us[0]) <= begin_us,
            count=max(LEAST_FRAMES, round((times_us[-1] - times_us[0]) * 1e-6 / _FILM_STEP_S) + 1),
        )
        if frames is not None and not is_old:
            self._prior, self._sought = found.prior, self._count
        return found.mean[-1].astype(np.float32), int(end_us)


def estimate_film_of(
    capture: Capture,
    setup: Setup,
    plane: Plane,
    evidence: Evidence = "frames",
    pattern: FixedPattern | None = None,
    columns: int = 64,
    static: float | None = None,
    progress: Progress = silent,
    maps: PixelMaps | None = None,
) -> FilmEstimate:
    """Return the film of a hidden plane that changes, from a capture of it.

    Args:
        capture: The recording; its motion does not matter.
        setup: Its setup, linear.
        plane: The hidden plane, about the middle of the setup's.
        evidence: Frames tell an image each; events one every tenth of a second, or as many as frames.
        pattern: Fixed pattern of the frame camera, to be taken off.
        columns: Columns to which frames are reduced, pixels.
        static: Standard deviation of a pixel's constant offset over that of its noise; None: as the frames say.
        progress: Told the iterations.
        maps: Measured thresholds of the event camera; None: they are not known.

    Raises:
        ConfigError: The event model states no law of its crossings.
        DataError: Too few frames, or too many images, or maps of another camera.
    """
    return FilmSolver(setup, plane, columns).film(
        np.asarray(capture.frame_times_us * 1e-6, np.float64),
        None if evidence == "events" else capture.frames,
        None if evidence == "frames" else capture.events,
        peak=capture.peak,
        pattern=pattern,
        static=static,
        progress=progress,
        maps=used_maps(maps, capture.info, capture.events.shape),
    )
