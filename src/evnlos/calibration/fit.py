"""From captures of a setup to a simulation of it, with the proof on captures that the fit has not seen.

- What to pre-train on once a setup is known: its simulation, varied a little, with strokes like the targets'.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.analysis.identify import QUICK, identify
from evnlos.calibration.blind_calibration import fit_blind
from evnlos.calibration.captures import Calibration, CaptureSet, Own, read_capture_set
from evnlos.calibration.event_fit import PixelFit, choose_pixel, fit_pixel
from evnlos.calibration.event_statistics import event_residuals, read_recordings
from evnlos.calibration.frame_model import (
    EVERY,
    FrameModel,
    FrameNoise,
    coarse_shape,
    fit_frame_noise,
    steadied,
)
from evnlos.calibration.transport_fit import Residual, TransportFit, fit_transport
from evnlos.calibration.wall_search import check_measured, curvature, fit_wall, frame_doubt
from evnlos.cameras import PixelSettings
from evnlos.cameras.pixel import continuous
from evnlos.data.simulate import Simulation, ranges_around
from evnlos.data.simulations import fitting
from evnlos.errors import ConfigError, DataError
from evnlos.inverse.prior import written_alike
from evnlos.machine import Progress, Step, note, silent
from evnlos.scene import HandwritingGlyphs, Ink, LineMotion, Strokes, Target
from evnlos.setups import SensorSize, Setup

_AT_NOISE = 1.03  # times the noise's residual: what is below has nothing left to explain
_EXAMPLES = 3
_FEWEST_FOR_ANY = 5  # captures: fewer do not tell a wall's slopes from a camera's place
_WITHOUT_PATTERN = "frames held out, without pattern"
_MOST_OF_NOISE = 1.1
_MOST_UNEXPLAINED = {"known": 0.05, "unknown": 0.2}  # targets that nobody knows are never expected exactly

_STEADIER = 0.9  # of what is left that another fit has to reach
_MOST_STEADYING = 3  # fits of captures that were steadied: each tells their light better
_DOUBTFUL, _STRAY = 2.0, 3.0  # times what captures keep in the median: with the capture in the fit, without it
_MOST_STRAYS = 0.25  # of all captures: where more do not fit, the fit is wrong

Surfaces = dict[str, tuple[NDArray, NDArray]]
"""Time surfaces [N, 2, h, w] of camera and model by capture."""


@dataclass(frozen=True)
class Example:
    """What a held-out capture looks like beside the fit: white levels, and time surfaces.

    Args:
        name: Name of the capture.
        frame: A frame [H, W].
        model: The fit's frame [H, W].
        surface: Time surface at that frame [2, h, w]; None without events.
        model_surface: The fit's.
    """

    name: str
    frame: NDArray
    model: NDArray
    surface: NDArray | None = None
    model_surface: NDArray | None = None


@dataclass(frozen=True)
class Shown:
    """What one frame of a wall shows of a target, whatever the method; a coarse `analysis.identify`.

    Args:
        patterns: Patterns in which handwritten targets differ by more than the frame camera's noise.
        gain_db: Mean PSNR of the best linear image above that of the mean target, dB.
    """

    patterns: int
    gain_db: float

    @classmethod
    def by(cls, simulation: Simulation) -> Shown | None:
        """Return what the setup of a simulation shows of its targets; None where it has no linear part."""
        try:
            found = identify(simulation.setup, QUICK, stated_m=simulation.glyphs.target_plane.size_m)
        except ConfigError:
            return None
        return cls(found.at_camera.patterns, found.at_camera.psnr_db - found.mean_db)


@dataclass(frozen=True)
class SetupFit:
    """A calibrated simulation and its residuals.

    Args:
        simulation: The settings that make the simulator match the setup.
        training: The same, varied around the fit, with strokes like the targets': what to pre-train on.
        fitted: Names of the captures that were fitted.
        held_out: Names of the captures that it was checked on.
        optics: The fitted transport, its start and its errors.
        noise: The frame camera's noise.
        pixel: The fitted event pixel; None where only frames were fitted.
        residuals: By "frames fit" and "frames held out"; with events also of "counts" and "surfaces"; and of
            "frames held out, without pattern", before and after the fixed pattern is taken from the frames.
        example: Held-out captures beside the fit.
        targets: Whether the captures' targets were known.
        mean_frame: Residual of the frames held out where the mean of the fitted frames stands for the model.
        known: Masks of the known targets by capture, [S, S] each: pre-training draws them again.
        frame_doubt: By how much the variance of the frames' noise is raised when they are solved for a target.
        ink: Where the known targets have their ink.
        shown: What one frame shows of a target, whatever the method; None where that is not known.
        curved: What `curvature` says of the frames held out; zeros where it can only be the wall's.
        own: What each capture has of its own beside the setup and its notes; () where nothing differs.
        strays: What captures that were left out keep, over the median of all: they do not fit the others.
        saturated: Share of the pixels that some fitted frame shows saturated; they take no part.
    """

    simulation: Simulation
    training: Simulation
    fitted: tuple[str, ...]
    held_out: tuple[str, ...]
    optics: TransportFit
    noise: FrameNoise
    pixel: PixelFit | None
    residuals: dict[str, Residual]
    example: tuple[Example, ...]
    targets: Literal["known", "unknown"] = "known"
    mean_frame: float = math.inf
    known: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    frame_doubt: float = 1.0
    ink: Ink = field(default_factory=Ink)
    shown: Shown | None = None
    curved: tuple[float, float] = (0.0, 0.0)
    own: tuple[Own, ...] = ()
    strays: dict[str, float] = field(default_factory=dict)
    saturated: float = 0.0

    @property
    def stray_words(self) -> list[str]:
        """Which captures were left out because they do not fit the others, a line; none where all do."""
        if not self.strays:
            return []
        names, kept = " and ".join(self.strays), " and ".join(f"{k:.1f}" for k in self.strays.values())
        what = f"{names}: left out, what the others show leaves {kept} times as much of them as of most"
        return [f"{what}; check target, direction and start of their motion, and whether the camera moved"]

    @property
    def light_words(self) -> tuple[str, str]:
        """How target and ambient light differ from capture to capture; empty where they do not."""
        gain, ambient = (_range_words([getattr(one, n) for one in self.own]) for n in ("target", "ambient"))
        return gain, ambient

    @property
    def motion_words(self) -> list[str]:
        """How far targets were from where notes place them, a line; none where they were there."""
        speeds = [100 * (one.speed - 1) for one in self.own]
        if not any(speeds):
            return []
        far, name = max((abs(one.ahead_m), name) for one, name in zip(self.own, self.captures, strict=True))
        what = f"targets are up to {1e3 * far:.1f} mm beside their stated places ({name} most), their speeds"
        what += f" {min(speeds):+.1f} to {max(speeds):+.1f} % off"
        return [f"{what}; the fit takes that off (calibration.json says each): mend `motion` in capture.yaml"]

    @property
    def saturated_words(self) -> list[str]:
        """Why pixels take no part in the fit, a line; none where hardly any is saturated."""
        share = 100 * self.saturated
        return (
            [f"frames: {share:.0f} % of the pixels are saturated at times; expose for less"]
            if share > 2
            else []
        )

    @property
    def captures(self) -> tuple[str, ...]:
        """Names of all captures that the calibration saw."""
        return (*self.fitted, *self.held_out)

    @property
    def unexplained(self) -> Residual | None:
        """What is left of the frames held out, the pattern taken, where that is far above noise; else None.

        Far is a tenth more than noise alone leaves and, beside the noise, more than 5 % of the standard
        deviation; 20 % where targets are unknown.
        """
        left = self.residuals[_WITHOUT_PATTERN]
        far = left.after > _MOST_OF_NOISE * left.noise and left.unexplained > _MOST_UNEXPLAINED[self.targets]
        return left if far else None

    @property
    def worse(self) -> tuple[str, ...]:
        """Residuals on held-out captures that the fit did not lower, or not below those of the mean frame.

        One that is as low as the noise of the fitted cameras has nothing left to lower: the start's may be
        lower still, as too few events are nearer to noisy ones than others that are as noisy.
        """
        found = [
            name
            for name, r in self.residuals.items()
            if name.endswith("held out") and not r.after < r.before and r.after > _AT_NOISE * r.noise
        ]
        if not self.residuals["frames held out"].after < self.mean_frame and "frames held out" not in found:
            found.append("frames held out")
        return tuple(found)


def _range_words(own: Sequence[float]) -> str:
    """Return how factors of captures differ; empty where they do not."""
    low, high = min(own, default=1.0), max(own, default=1.0)
    return f"{low:.2f} to {high:.2f} times it from capture to capture" if high > low else ""


def fit_setup(
    folders: Iterable[str | Path], settings: Calibration | None = None, progress: Progress = silent
) -> SetupFit:
    """Fit the simulator to captures of a setup whose targets are known, or, with `targets="unknown"`, are not.

    Where they are not, everything behind the optics (noise, event pixel) is fitted with the targets that are
    expected; they show what reaches the wall, which is all that counts for it.

    Args:
        folders: Capture folders of one setup and one camera.
        settings: What to hold out, what to fit and where to start; None is a wall of rough metal.
        progress: Called at the begin of each stage.

    Returns:
        The calibrated simulation, its parameters' errors, and the residuals before and after on the captures
        that were fitted and on those held out.

    Raises:
        DataError: Too few captures, unknown targets or motions, different setups or cameras, or frames that do
            not follow the targets.
        ConfigError: Something is measured that the fit has no number for, or that cannot be.
    """
    settings = Calibration() if settings is None else settings
    check_measured(settings.measured)
    stages = ("read the captures", "fit the wall", "fit the noise of the frames", "fit the event pixel")
    stages = (*stages[: 4 if settings.events else 3], "judge the fit, and what the wall shows")

    def begin(stage: int) -> None:
        progress(Step("calibrate", stage, len(stages), "stages", within=stages[stage]))

    begin(0)
    fit, held = read_capture_set(
        folders,
        exclude=settings.exclude,
        holdout=settings.holdout,
        share=settings.holdout_share,
        seed=settings.seed,
        target_size_m=settings.start.glyphs.target_plane.size_m if settings.targets == "unknown" else None,
    )
    alone = [one.name for one in (*fit.captures, *held.captures) if not one.has_events]
    if settings.events and alone:
        raise DataError(f"{alone[0]} holds frames alone, no events; fit the frames alone (--no-events)")
    start, fixed = _at_known_distance(settings, fit)
    residuals, strays = dict[str, Residual](), dict[str, float]()
    is_any = start.wall_start() is not None and _is_any(settings, fit)
    if settings.measured and not is_any:
        raise ConfigError(
            f"measured.{next(iter(settings.measured))} is a prior of the fit of any wall, and this one is by a "
            "formula; leave it out, or give --wall any"
        )
    begin(1)
    if is_any:
        optics, fit, held, strays = _fit_any(settings, fit, held, start)
    elif settings.targets == "known":
        optics = fit_transport(fit, start, fixed=fixed, columns=settings.columns)
    else:
        found = fit_blind(fit, held, start, fixed=fixed)
        optics, fit, held = found.optics, found.fitted, found.held_out
        residuals["every other frame held out"] = found.check
    begin(2)
    models = {"fit": FrameModel(fit, fit.shape), "held out": FrameModel(held, held.shape)}
    predicted = {name: model.predict(optics.setup) for name, model in models.items()}
    noise = fit_frame_noise(fit, predicted["fit"].numpy(), settings.start.frame_camera)
    for name, model in models.items():
        before, after = model.left(model.predict(optics.before)), model.left(predicted[name])
        spread = float(model.frames.std(correction=0))
        residuals[f"frames {name}"] = Residual(before, after, noise.temporal / spread)
    lit = torch.from_numpy(noise.pattern.correct(held.frames(), held.peak))
    seen = models["held out"]
    corrected = seen.left(predicted["held out"], lit)
    residuals[_WITHOUT_PATTERN] = replace(
        residuals["frames held out"], before=residuals["frames held out"].after, after=corrected
    )
    if not is_any:
        optics = optics.raised(residuals[_WITHOUT_PATTERN])
    start_pixel: PixelSettings = settings.start.pixel
    if settings.events:
        start_pixel = continuous(start_pixel)
    simulation = _simulation(settings, fit, optics.setup, noise, start_pixel)
    pixel: PixelFit | None = None
    surfaces: Surfaces = {}
    if settings.events:
        begin(3)
        recordings = read_recordings(fit, optics.setup, settings.event_captures)
        there = read_recordings(held, optics.setup, settings.event_captures)
        pixel = fit_pixel(recordings, continuous(start_pixel), seed=settings.seed)
        pixel = choose_pixel(pixel, recordings, there, seed=settings.seed)
        simulation = simulation.with_setup(pixel=pixel.pixel)
        for name, (capture_set, found) in {"fit": (fit, recordings), "held out": (held, there)}.items():
            events, surfaces = event_residuals(
                capture_set, found, start_pixel, pixel.pixel, simulation.sampling, settings.seed
            )
            residuals |= {f"{kind} {name}": r for kind, r in events.items()}
    begin(len(stages) - 1)
    about, curved = held.captures[0].info.camera, curvature(lit.numpy(), predicted["held out"].numpy())
    examples = _examples(held, models["held out"], predicted["held out"].numpy(), surfaces)
    known, shown = dict[str, NDArray[np.float32]](), list[Target]()
    if settings.targets == "known":
        shown = [scene.target for scene in fit.scenes]
        seen_targets = [*zip(fit.names, fit.scenes, strict=True), *zip(held.names, held.scenes, strict=True)]
        side = simulation.glyphs.target_plane.size_m
        known = {name: scene.target.mask for name, scene in seen_targets if scene.target.size_m == side}
    training = training_simulation(simulation, noise, pixel, shown, (*fit.own, *held.own))
    result = SetupFit(
        simulation,
        training,
        fit.names,
        held.names,
        optics,
        noise,
        pixel,
        residuals,
        examples,
        settings.targets,
        seen.left(models["fit"].frames.mean(dim=0)),
        known,
        frame_doubt(held, optics.setup, noise) if is_any else 1.0,
        Ink.of(shown),
        Shown.by(simulation),
        curved if curved[0] < 0 or about.tone or about.log else (0.0, 0.0),  # else it is the wall's
        (*fit.own, *held.own),
        strays,
        float((fit.frames() >= fit.peak).any(axis=0).mean()),
    )
    progress(Step("calibrate", len(stages), len(stages), "stages"))
    return result


def _fit_any(
    settings: Calibration, fit: CaptureSet, held: CaptureSet, start: Setup
) -> tuple[TransportFit, CaptureSet, CaptureSet, dict[str, float]]:
    """Return the fit of a wall of any kind, the captures behind it, and those that do not fit the others.

    A capture of a wrong target or motion spoils the fit of all: one that keeps much more than the others is
    left out where it does so behind the fit of these, too. It comes with what it keeps over the median.
    """

    def wall(one: CaptureSet, other: CaptureSet) -> TransportFit:
        how = {"fit_distance": settings.fit_distance, "measured": settings.measured}
        return fit_wall(one, other, start, **how).optics

    recorded = fit, held
    optics, fit, held = _fit_steadied(wall, fit, held)
    doubtful = [name for name, kept in _kept(fit, held, optics.setup).items() if kept > _DOUBTFUL]
    fewer = _without(fit, doubtful), _without(held, doubtful)
    most = _MOST_STRAYS * (len(fit.captures) + len(held.captures))
    if not 0 < len(doubtful) <= most or len(fewer[0].captures) < _FEWEST_FOR_ANY or not fewer[1].captures:
        return optics, fit, held, {}
    note(f"without {' and '.join(doubtful)}, which the others do not explain")
    again = wall(*fewer)
    strays = {name: kept for name, kept in _kept(fit, held, again.setup).items() if kept > _STRAY}
    if not strays:
        return optics, fit, held, {}
    if fit.own:  # it was told with strays among the captures
        fit, held = (_without(one, strays) for one in recorded)
        optics, fit, held, more = _fit_any(settings, fit, held, start)
        return optics, fit, held, strays | more
    return again, _without(fit, strays), _without(held, strays), strays


def _fit_steadied(
    wall: Callable[[CaptureSet, CaptureSet], TransportFit], fit: CaptureSet, held: CaptureSet
) -> tuple[TransportFit, CaptureSet, CaptureSet]:
    """Return the fit of a wall and the captures behind it, `steadied` where that helps."""

    def left(setup: Setup, other: CaptureSet) -> float:
        model = FrameModel(other, other.shape, EVERY)
        return model.left(model.predict(setup))

    optics = wall(fit, held)
    steadier = steadied(fit, held, optics.setup)
    if steadier is None:
        return optics, fit, held
    note("what differs from capture to capture")
    if any(own[:2] != (1.0, 1.0) for one in steadier for own in one.own):  # light: it spoils the fit of all
        steadier = steadied(fit, held, wall(replace(fit, drifts=True), replace(held, drifts=True)).setup)
    steady, again = (fit, held), optics
    for _ in range(_MOST_STEADYING):
        if steadier is None:
            break
        steady, again = steadier, wall(*steadier)
        steadier = steadied(*steady, again.setup)
    is_better = left(again.setup, steady[1]) < _STEADIER * left(optics.setup, held)
    return (again, *steady) if is_better else (optics, fit, held)


def _kept(captures: CaptureSet, others: CaptureSet, setup: Setup) -> dict[str, float]:
    """Return what a fit leaves of each capture, over the median of all."""
    kept = dict[str, float]()
    for one in (captures, others):
        model, of = FrameModel(one, coarse_shape(one), EVERY), one.frame_of(EVERY)
        squares = ((model.frames - model.predict(setup)) * model.weight).square().mean(dim=(1, 2)).numpy()
        kept |= {name: math.sqrt(squares[of == k].mean()) for k, name in enumerate(one.names)}
    middle = float(np.median(list(kept.values())))
    return {name: value / middle for name, value in kept.items()}


def _without(captures: CaptureSet, names: Collection[str]) -> CaptureSet:
    """Return the captures but some."""
    stay = [k for k, name in enumerate(captures.names) if name not in names]
    own = tuple(captures.own[k] for k in stay) if captures.own else ()
    return replace(captures, captures=tuple(captures.captures[k] for k in stay), own=own)


def _is_any(settings: Calibration, fit: CaptureSet) -> bool:
    """Return whether a wall of any kind is fitted."""
    enough = settings.wall == "any" or (settings.wall == "auto" and len(fit.captures) >= _FEWEST_FOR_ANY)
    return settings.targets == "known" and enough


def _at_known_distance(settings: Calibration, capture_set: CaptureSet) -> tuple[Setup, tuple[str, ...]]:
    """Return the start at the measured distance of target and wall, and the names of what is known."""
    noted = capture_set.captures[0].info.setup.get("distance_m")
    setup = settings.start.setup
    if noted is not None and setup.default_distance_m is not None:
        setup = setup.with_parameters({"distance_m": float(noted)})
    return setup, () if settings.fit_distance else ("distance_m",)


def _simulation(
    settings: Calibration, capture_set: CaptureSet, setup: Setup, noise: FrameNoise, pixel: PixelSettings
) -> Simulation:
    """Return the start with everything that the captures tell: target, motion, length, positions, sensor."""
    scene, start = capture_set.scenes[0], settings.start
    times = capture_set.times_s(0)
    motion = scene.motion
    assert isinstance(motion, LineMotion)  # the only motion that a capture describes
    x, y = motion.position_m(times[0])
    target_plane = replace(start.glyphs.target_plane, size_m=scene.target.size_m)
    across, down = np.ptp(motion.position_m(times), axis=0)
    return replace(
        start,
        sampling=fitting(start.sampling, scene.target.size_m, (float(across), float(down))),
        glyphs=replace(start.glyphs, target_plane=target_plane),
        motion=replace(motion, start_m=(float(x), float(y)), start_s=0.0),
        duration_s=float(times[-1] - times[0]),
        positions=len(times) - 1,
        setup=replace(setup, sensor=SensorSize(*capture_set.shape), frame_camera=noise.camera, pixel=pixel),
    )


def _examples(
    held: CaptureSet, model: FrameModel, predicted: NDArray, surfaces: Surfaces
) -> tuple[Example, ...]:
    """Return the middle frame of some held-out captures beside the model's, and the surfaces at that frame."""
    of = held.frame_of()
    chosen = []
    for name in [n for n in held.names if n in surfaces or not surfaces][:_EXAMPLES]:
        rows = np.flatnonzero(of == held.names.index(name))
        middle = len(rows) // 2
        seen, made = surfaces.get(name, (None, None))
        k = max(0, middle - 1)  # the first frame has no surface
        chosen.append(
            Example(
                name,
                model.frames[rows[middle]].numpy(),
                predicted[rows[middle]],
                None if seen is None else seen[k],
                None if made is None else made[k],
            )
        )
    return tuple(chosen)


_SPREAD = {
    "setup.roughness": 0.04,
    "setup.slopes": 0.03,
    "setup.gain": 0.08,
    "setup.ambient": 0.08,
    "setup.frame_camera.full_well_e": 0.1,
    "setup.frame_camera.read_noise_e": 0.1,
    "setup.frame_camera.noise_codes": 0.1,
    "setup.pixel.threshold_on": 0.05,
    "setup.pixel.threshold_off": 0.05,
    "setup.pixel.shot_noise_rate_hz": 0.1,
    "setup.pixel.photon_noise": 0.2,
    "setup.pixel.leak_rate_per_dn_hz": 0.1,
}
"""Relative half-widths: far more than the fit's own errors, because no wall is exactly its model."""

_SLACK_M = 0.0005  # of the place of the travel
_SETUPS = 6  # different walls and cameras: each costs a light-transport matrix
_LEAK_HZ = 0.1  # captures of some seconds do not show a smaller leak


def training_simulation(
    fitted: Simulation,
    noise: FrameNoise,
    pixel: PixelFit | None,
    shown: Sequence[Target],
    own: Sequence[Own] = (),
) -> Simulation:
    """Return the simulation to pre-train on: the fitted one, varied from object to object.

    The frame camera has the fixed pattern that stays after correction, a new one for each object. Letters are
    as large as those of the known targets, and with pens like theirs; they are not copied.

    Args:
        fitted: The simulation that matches the setup.
        noise: The frame camera's noise.
        pixel: The fitted event pixel; None where only frames were fitted.
        shown: The known targets; none where they are unknown.
        own: What the captures have of their own.
    """
    glyphs = fitted.glyphs
    if isinstance(glyphs, HandwritingGlyphs):
        glyphs = written_alike(replace(glyphs, strokes=Strokes("both")), shown)
    vary = fitted.vary | ranges_around(fitted, _SPREAD)
    for name, factors in zip(("setup.gain", "setup.ambient"), zip(*own, strict=True), strict=False):
        low, high = vary[name]
        vary[name] = (low * min(1.0, *factors), high * max(1.0, *factors))
    slack = max([_SLACK_M, *(abs(one.ahead_m) for one in own)])
    for one in fitted.setup.parameters():
        if one.role == "place":
            vary[f"setup.{one.name}"] = (one.value - slack, one.value + slack)
    if pixel is not None:
        if pixel.cutoff_range_hz is not None:
            vary["setup.pixel.cutoff_hz"] = pixel.cutoff_range_hz
        vary["setup.pixel.leak_rate_hz"] = (0.0, max(_LEAK_HZ, getattr(pixel.pixel, "leak_rate_hz", 0.0)))
    camera = replace(fitted.frame_camera, **noise.remaining, pattern_seed=None)  # type: ignore[type-var]
    return replace(
        fitted, glyphs=glyphs, setup=replace(fitted.setup, frame_camera=camera), vary=vary, setups=_SETUPS
    )
