"""Where events win: frames and events of the same moving targets, over light, speed, shade, ripple and more.

The best linear estimate says what each is worth, and simulated sequences what an estimate makes of it. Events
are those of a true logarithm over a dark level; frames collect electrons over the exposure, with the gain, that
tell most of training letters. A pixel that any of those could clip counts neither in bounds nor in estimates.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.analysis import bounds
from evnlos.analysis.scores import paired_difference
from evnlos.cameras import CrossingLaw, EventCamera, EventPixel, FlickeringWall, FrameCamera
from evnlos.config import config_hash, from_dict, to_dict
from evnlos.data.pool import run_in_order
from evnlos.files import write_atomically
from evnlos.inverse import (
    FrameTerm,
    PatternPrior,
    SequenceLight,
    estimate_sequence,
    handwritten_prior,
    record_of,
    sequence_light,
)
from evnlos.inverse.prior import TEST_CHARACTERS, TRAIN_CHARACTERS
from evnlos.inverse.sequence_problem import position_subsets
from evnlos.machine import Progress, Step, silent
from evnlos.scene import TRAIN_WRITERS, HandwritingGlyphs, LineMotion, Scene, Target
from evnlos.setups import RadiometricSetup, SensorSize
from evnlos.setups.load import FAR_M
from evnlos.types import Irradiance, Plane, derive_seed

FULL = 0.85
"""White levels of the brightest pixel of the base at 10 ms: nothing is clipped."""

EVENT_BYTES = 4
"""Bytes of an event in a plain stream of 32-bit words."""

EVIDENCE = ("frames", "events", "both")
"""What a target is estimated from."""

_PIXEL = EventPixel(
    threshold_on=0.2,
    threshold_off=0.2,
    threshold_sigma=0.02,
    cutoff_hz=1000.0,
    leak_rate_hz=0.1,
    shot_noise_rate_hz=0.2,
    logarithm="true",
    dark_dn=0.2,
    cutoff_floor_dn=28.0,  # a tenth of the bandwidth is left in the dark
)
_CAMERA = FrameCamera(electrons_per_s=1.5e6)  # white fills the well in 10 ms
_BLACK = 1 / 16  # of white: four deviations of read noise and offset at the largest gain
_SENSOR = SensorSize(50, 80)
_TRAVEL_M, _FASTEST_HZ, _RIPPLE_HZ = 0.16, 100.0, 100.0
_PLACE_M, _SPEED = 0.01, 0.1  # what an unknown motion may be off by: place, and share of the speed
_CELLS = Plane(32, 32, 0.0025)
_GAINS = tuple(2.0**k for k in range(6))  # at 32, rounding is a hundredth of the read noise's variance
_STRIDE, _FACTORS = 4, 80  # rows and columns at which exposure and gain are chosen, and factors of their light
_SHORTEST_S, _FINER = 1e-3, 1.25  # exposures that are tried: the shortest, and the ratio of two
_ALIKE = 1e-3  # difference of errors, relative, that is none: the shortest exposure and least gain is taken
_UNCLIPPED = 0.85  # of white: pixels that all training letters leave below it
_TUNED_ON = "EMR"  # training letters whose error chooses exposure and gain
_GAP = 0.05  # between the instants at which silences are looked at, share of the sequence
_CROSSING_NOISE = 0.04  # error of a crossing beside the event model's own, log units


@dataclass(frozen=True)
class Condition:
    """One setting of the world; what is not stated is the base's: rough metal, 0.30 m, bright light, 8 s."""

    name: str
    """Its name in tables."""
    light: float = 1.0
    """Share of the base's light."""
    ambient: float = 0.1
    """Ambient light over the largest signal."""
    speed_m_s: float = 0.02
    """Speed of the target over its way of 0.16 m, metres per second."""
    frames: int = 40
    """Most frames of the sequence; a camera takes at most 100 per second."""
    bit_depth: int = 8
    """Bits of the frame camera."""
    shade: float = 1.0
    """How much darker the wall is lit where it is darkest, in smooth patches."""
    ripple: float = 0.0
    """Amplitude of the lamps' ripple at 100 Hz, share of all light."""
    is_ripple_known: bool = False
    """Whether the estimate from events knows by how much the ripple carries crossings ahead."""
    is_motion_known: bool = True
    """Whether place and speed are known, or within 10 mm and a tenth."""
    roughness: float = 0.05
    """Roughness of the metal."""
    distance_m: float = 0.3
    """Distance from target to wall, metres."""

    @property
    def duration_s(self) -> float:
        """Length of the sequence, seconds."""
        return _TRAVEL_M / self.speed_m_s

    @property
    def asked(self) -> bounds.SequenceAnalysisSettings:
        """The motion and the numbers of positions that are asked for."""
        most = max(1, min(self.frames, int(_FASTEST_HZ * self.duration_s)))
        counts = (*(n for n in (1, 2, 5, 10, 20, 40) if n < most), most)
        return bounds.SequenceAnalysisSettings(_TRAVEL_M, self.speed_m_s, most, counts)

    @property
    def setup(self) -> RadiometricSetup:
        """The wall and its cameras; the exposure of the frames is not chosen yet."""
        gain = self.light * FULL / (1 + self.ambient)
        return RadiometricSetup(
            gain=gain,
            ambient=gain * self.ambient,
            roughness=self.roughness,
            distance_m=self.distance_m,
            sensor=_SENSOR,
            frame_camera=replace(_CAMERA, bit_depth=self.bit_depth, black_level=2**self.bit_depth * _BLACK),
            pixel=_PIXEL,
        )

    def light_of(self, prior: PatternPrior) -> SequenceLight:
        """Return the light of the moving target on the shaded wall.

        Args:
            prior: Of the target.
        """
        light = _unit_light(replace(self.setup, gain=1.0, ambient=0.0), prior)
        shade, times = (
            self.shading().reshape(-1, 1),
            light.times_s * (self.asked.duration_s / light.times_s[-1]),
        )
        still = (self.setup.ambient * shade).astype(np.float32)
        return replace(light, left=light.left * shade * self.setup.gain, still=still, times_s=times)

    def swing(self, law: CrossingLaw, light_dn: float) -> float:
        """Return the amplitude that the lamps' ripple has behind the pixel's filter, log units.

        Args:
            law: The pixel's constants.
            light_dn: The light, DN.
        """
        return self.ripple / math.hypot(
            1.0, 2 * math.pi * _RIPPLE_HZ / float(law.bandwidth(np.array(light_dn)))
        )

    def shading(self) -> NDArray[np.float64]:
        """Return what share of its light each part of the wall gets, [H, W], 1 / shade to 1."""
        down, across = (np.arange(n) / n for n in (_SENSOR.height, _SENSOR.width))
        waves = np.sin(4 * np.pi * down)[:, None] * np.sin(6 * np.pi * across)
        return self.shade ** (-0.5 * (1 + waves))


@dataclass(frozen=True)
class Finding:
    """What frames and events are worth under one condition.

    Args:
        condition: The condition.
        exposure_s: The exposure of the frames, at most the time between two.
        gain: Their gain.
        left_out: Share of the pixels that a training letter could clip: they do not count.
        clipped: White values of the measured sequences' frames in pixels that count.
        counts: Numbers of positions.
        prior_db: PSNR of the prior's mean, dB.
        expected_db: "frames", "events", "both" -> expected PSNR for each number of positions, dB; frames alone
            where the ripple itself makes events.
        measured_db: The same, and "frames thinned" to the bytes of the events -> PSNR of simulated whole
            sequences, one a character, dB; empty without motion.
        events_per_pixel: Events per pixel and sequence, noise among them.
        event_bytes: The events as 32-bit words, and packed (zlib), bytes.
        frame_bytes: The frames as they are, and packed, bytes.
        thinned_frames: How many frames, equally spaced, take as many bytes as the events, mean.
    """

    condition: Condition
    exposure_s: float
    gain: float
    left_out: float
    clipped: int
    counts: tuple[int, ...]
    prior_db: float
    expected_db: dict[str, tuple[float, ...]]
    measured_db: dict[str, tuple[float, ...]]
    events_per_pixel: float
    event_bytes: tuple[int, int]
    frame_bytes: tuple[int, int]
    thinned_frames: float


@lru_cache(maxsize=2)
def _unit_light(setup: RadiometricSetup, prior: PatternPrior) -> SequenceLight:
    """Return the light of a way in one second; light and speed of a condition scale it."""
    way = LineMotion((-_TRAVEL_M / 2, 0.0), _TRAVEL_M)
    return sequence_light(setup, prior, way.position_m, (0.0, 1.0), setup.shape, fineness=2.0)


def conditions() -> list[Condition]:
    """Return all conditions, the base first."""
    return [
        Condition("base"),
        *(Condition(f"light {share:g}", light=share) for share in (0.1, 0.01, 0.001)),
        *(Condition(f"speed {speed:g} m/s", speed_m_s=speed) for speed in (0.08, 0.32, 1.28)),
        *(
            Condition(f"light {share:g}, {speed:g} m/s", light=share, speed_m_s=speed)
            for share, speed in ((0.1, 1.28), (0.01, 0.32), (0.001, 0.08))
        ),
        *(Condition(f"shade 1:{shade:g}", shade=shade) for shade in (30.0, 1000.0)),
        Condition("shade 1:1000, 12 bits", shade=1000.0, bit_depth=12),
        *(Condition(f"ripple {100 * ripple:g} %", ripple=ripple) for ripple in (0.04, 0.08, 0.2)),
        Condition("ripple 8 %, known", ripple=0.08, is_ripple_known=True),
        *(Condition(f"{count} frame{'s' * (count > 1)}", frames=count) for count in (10, 3, 1)),
        Condition("motion unknown", is_motion_known=False),
        Condition("motion unknown, 10 frames", frames=10, is_motion_known=False),
        *(Condition(f"ambient {ratio:g} of the signal", ambient=ratio) for ratio in (0.5, 2.0, 8.0)),
        *(Condition(f"roughness {alpha:g}", roughness=alpha) for alpha in (0.02, 0.2)),
        Condition(f"distance {FAR_M:g} m", distance_m=FAR_M),
    ]


def regimes() -> list[Condition]:
    """Return the conditions of the map of light against speed."""
    lights, speeds = (1.0, 0.1, 0.03, 0.01, 0.003, 0.001), (0.02, 0.08, 0.32, 1.28)
    return [Condition("regime", light=share, speed_m_s=speed) for speed in speeds for share in lights]


def sweep_parameters(
    chosen: Sequence[Condition],
    out: Path,
    workers: int = 0,
    characters: str = TEST_CHARACTERS,
    progress: Progress = silent,
) -> list[Finding]:
    """Measure each condition and return the findings; what is done is read back.

    Args:
        chosen: The conditions.
        out: Folder for one JSON file a condition.
        workers: Processes; 0 is one for each core.
        characters: Targets of the simulated sequences, in a hand that the prior does not know; none = bounds
            alone.
        progress: Called when the work begins and of a condition and when it is done.
    """
    keys = [config_hash({"condition": to_dict(one), "characters": characters}) for one in chosen]
    paths = [out / f"{key}.json" for key in keys]
    todo = [k for k, path in enumerate(paths) if not path.is_file()]
    progress(Step("conditions", len(chosen) - len(todo), len(chosen), "conditions"))
    made = run_in_order(partial(measure, characters=characters), [chosen[k] for k in todo], workers)
    for done, (k, finding) in enumerate(zip(todo, made, strict=True), 1):
        write_atomically(paths[k], json.dumps(asdict(finding), indent=1).encode())
        at = len(chosen) - len(todo) + done
        progress(Step(f"conditions ({chosen[k].name})", at, len(chosen), "conditions", finding))
    return [from_dict(Finding, json.loads(path.read_text()), source=str(path)) for path in paths]


def measure(condition: Condition, characters: str = TEST_CHARACTERS) -> Finding:
    """Return the bounds under a condition, and what simulated sequences give.

    The best linear estimate (`evnlos.analysis.bounds`) sets the exposure and the gain of the frames
    (`tuned_camera`). An unknown place (10 mm) and speed (a tenth) are two more unknowns. A ripple of amplitude
    a in filtered log light, its phase unknown, adds an error of a to each crossing, the difference of two
    phases; known, it carries each crossing ahead by a (`CrossingLaw.ahead`), and adds none. Where it spans a
    threshold it makes events itself, and they have neither a bound nor an estimate.

    Args:
        condition: The condition.
        characters: As of `sweep_parameters`.
    """
    setup, asked = condition.setup, condition.asked
    prior = handwritten_prior(_CELLS)
    light = condition.light_of(prior)
    glyphs = HandwritingGlyphs(characters=TEST_CHARACTERS, writers=1, first_writer=TRAIN_WRITERS)
    targets = {name[-1]: glyphs.target(name) for name in glyphs.objects()}
    references = [prior.coefficients(targets[one].rasterise(_CELLS)) for one in "AS2"]
    camera, inside = tuned_camera(light, prior, setup, asked)
    unknown = () if condition.is_motion_known else motion_unknowns(light, references, asked)
    lights = unknown or [light] * len(references)
    law = _PIXEL.crossing_law(light.typical_dn)
    swing = condition.swing(law, light.typical_dn)
    names = EVIDENCE if 2 * swing < _PIXEL.finest_threshold else EVIDENCE[:1]
    noises = (math.hypot(_CROSSING_NOISE, 0.0 if condition.is_ripple_known else swing),)
    found: dict[str, list[NDArray[np.float64]]] = {name: [] for name in names}
    for seen, z in zip(lights, references, strict=True):
        z = np.concatenate([z, np.zeros(seen.right.shape[2] - 1 - len(z))])
        frames = _of_frames(_part(seen.exposed(camera.exposure_s), inside), z, setup, camera, asked)
        each = {"frames": frames}
        if "events" in names:
            each["events"] = bounds.event_information(seen, z, law, asked, noises)[0][0]
            each["both"] = frames + each["events"]
        for name, information in each.items():
            found[name].append(np.stack([marginal_information(one, prior.count) for one in information]))
    expected = {
        name: tuple(
            round(bounds.canvas_decibel(float(np.mean([prior.error(r[n]) for r in each])), _CELLS), 3)
            for n in range(len(asked.counts))
        )
        for name, each in found.items()
    }
    shown = (*names, "frames thinned") if condition.is_motion_known else ()
    runs = [_sequence(condition, light, camera, inside, prior, targets[one], shown) for one in characters]
    measured = {name: tuple(run[name] for run in runs) for name in shown}
    sizes = np.mean([run["bytes"] for run in runs], axis=0) if runs else np.zeros(4)
    per_pixel = float(sizes[0]) / EVENT_BYTES / len(light.left)
    sizes = [round(float(one)) for one in sizes]
    return Finding(
        condition,
        round(camera.exposure_s, 6),
        camera.gain,
        round(1 - float(inside.mean()), 4),
        sum(run["clipped"] for run in runs),
        asked.counts,
        round(bounds.canvas_decibel(prior.error(np.zeros((prior.count, prior.count))), _CELLS), 3),
        expected,
        measured,
        round(per_pixel, 3),
        (sizes[0], sizes[1]),
        (sizes[2], sizes[3]),
        round(float(np.mean([run["thinned"] for run in runs])), 1) if runs else 0.0,
    )


def tuned_camera(
    light: SequenceLight, prior: PatternPrior, setup: RadiometricSetup, asked: bounds.SequenceAnalysisSettings
) -> tuple[FrameCamera, NDArray[np.bool_]]:
    """Return the camera whose exposure and gain tell most, and which pixels it never clips, [P].

    Letters of the prior decide, none that is measured: three by the error that a few frames of every fourth
    row and column leave, all of them by the light at which a pixel clips and is left out.

    Args:
        light: The light.
        prior: The prior of its coefficients.
        setup: The setup; its frame camera is tuned.
        asked: The motion and its positions; a frame is exposed for the time between two at most.
    """
    few = min(asked.positions, 5)
    few = replace(asked, positions=few, counts=(few,))
    letters, usual = _training_letters(prior), setup.frame_camera
    assert isinstance(usual, FrameCamera)
    longest = asked.duration_s / asked.positions
    steps = math.ceil(math.log(longest / _SHORTEST_S) / math.log(_FINER))
    sampled, tried = light.every(_STRIDE, _FACTORS), list[tuple[float, FrameCamera]]()
    for exposure in np.geomspace(_SHORTEST_S, longest, steps + 1).tolist():
        blurred = sampled.exposed(exposure)
        brightest = brightest_light(blurred, letters.values(), _instants(asked))
        for gain in _GAINS:
            camera = replace(usual, exposure_s=exposure, gain=gain)
            part = _part(blurred, brightest * camera.per_light().gain < _UNCLIPPED)
            told = [_STRIDE**2 * _of_frames(part, letters[one], setup, camera, few)[0] for one in _TUNED_ON]
            tried.append((float(np.mean([prior.error(one) for one in told])), camera))
    least = min(error for error, _ in tried)
    camera = next(one for error, one in tried if error <= (1 + _ALIKE) * least)
    brightest = brightest_light(light.exposed(camera.exposure_s), letters.values(), _instants(asked))
    return camera, brightest * camera.per_light().gain < _UNCLIPPED


@lru_cache(maxsize=2)
def _training_letters(prior: PatternPrior) -> dict[str, NDArray[np.float64]]:
    """Return the coefficients of all training characters in one hand, not that of the measured ones."""
    glyphs = HandwritingGlyphs(characters=TRAIN_CHARACTERS, writers=1)
    return {name[-1]: prior.coefficients(glyphs.target(name).rasterise(_CELLS)) for name in glyphs.objects()}


def brightest_light(
    light: SequenceLight, letters: Iterable[NDArray[np.float64]], times_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the brightest light of each pixel about some instants, of all letters, white levels, [P].

    Args:
        light: The light.
        letters: Their coefficients, [k] each.
        times_s: The instants, [N], seconds.
    """
    node, _ = light.place(times_s)
    about = np.union1d(node, node + 1)
    still = light.still[:, about] if light.still.shape[1] > 1 else light.still
    there = replace(light, right=light.right[about], still=still, times_s=light.times_s[about])
    return np.max([there(z).max(axis=1) for z in letters], axis=0)


def _instants(asked: bounds.SequenceAnalysisSettings) -> NDArray[np.float64]:
    """Return the middles of the exposures, seconds: a frame at the end of each position."""
    return np.arange(1, asked.positions + 1) * asked.duration_s / asked.positions


def _part(light: SequenceLight, inside: NDArray[np.bool_]) -> SequenceLight:
    """Return the light of some pixels."""
    return replace(light, left=light.left[inside], still=light.still[inside], shape=(1, int(inside.sum())))


def _of_frames(
    light: SequenceLight,
    z: NDArray[np.float64],
    setup: RadiometricSetup,
    camera: FrameCamera,
    asked: bounds.SequenceAnalysisSettings,
) -> NDArray[np.float64]:
    """Return the information of exposed frames, [counts, k, k]."""
    return bounds.frame_information(light, z, replace(setup, frame_camera=camera.per_light()), asked)


def marginal_information(information: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return what is known of the target alone, [k, k], where further unknowns of variance 1 are left open."""
    target, mixed, rest = information[:count, :count], information[:count, count:], information[count:, count:]
    return target - mixed @ np.linalg.solve(np.eye(len(rest)) + rest, mixed.T) if len(rest) else target


def motion_unknowns(
    light: SequenceLight, references: Sequence[NDArray[np.float64]], asked: bounds.SequenceAnalysisSettings
) -> list[SequenceLight]:
    """Return the light with two more patterns: what place and speed change of each reference's light."""
    found = []
    for z in references:
        rate = np.gradient(light.right @ np.append(1.0, z), light.times_s, axis=0)  # [T, r]
        late = light.times_s[:, None] - asked.duration_s / 2
        more = np.stack([rate * _PLACE_M / asked.speed_m_s, rate * late * _SPEED], axis=2)
        found.append(replace(light, right=np.concatenate([light.right, more], axis=2)))
    return found


class _ShadedWall:
    """A wall in patches of shade."""

    def __init__(self, wall: Irradiance, condition: Condition) -> None:
        self.shape, self.speed_px_s = wall.shape, wall.speed_px_s
        self._wall, self._shade = wall, torch.from_numpy(condition.shading().astype(np.float32))

    def irradiance(self, t_s: ArrayLike) -> torch.Tensor:
        return self._wall.irradiance(t_s) * self._shade


def _sequence(
    condition: Condition,
    light: SequenceLight,
    camera: FrameCamera,
    inside: NDArray[np.bool_],
    prior: PatternPrior,
    target: Target,
    names: Sequence[str],
) -> dict[str, Any]:
    """Return the PSNR of a simulated sequence for each kind of evidence, dB, and the bytes of recordings."""
    setup, asked = condition.setup, condition.asked
    span, pixels = (0.0, asked.duration_s), len(light.left)
    wall = _ShadedWall(setup.observe(Scene(target, asked.motion, asked.duration_s)), condition)
    lit = FlickeringWall(wall, condition.ripple, _RIPPLE_HZ) if condition.ripple else wall
    seed = derive_seed(0, "conditions", target.name)
    events = EventCamera(setup.pixel).record(lit, *span, seed=seed)
    times = _instants(asked)
    frames = camera.capture(lit, times, seed)
    sensitivity, offset_e = camera.fixed_pattern(setup.shape, seed)  # known, as by calibration
    electrons = (frames - camera.black_level) / camera.dn_per_electron - offset_e
    seen = (electrons / (camera.white_e * sensitivity)).reshape(len(times), pixels)[:, inside]
    part = _part(light, inside).exposed(camera.exposure_s)
    few = min(len(times), max(1, EVENT_BYTES * len(events) * len(times) // frames.nbytes))
    kept = position_subsets(len(times), few, 1)[0]
    term, thinned = (FrameTerm(part, seen[k], times[k], camera.per_light(), True) for k in (slice(None), kept))
    law = _PIXEL.crossing_law(light.typical_dn)
    if condition.is_ripple_known:
        law = replace(law, ahead=condition.swing(law, light.typical_dn))
    record = record_of(events, law, span, _GAP * asked.duration_s) if "events" in names else None
    evidence = {"frames": (None, None, term), "events": (law, record, None), "both": (law, record, term)}
    evidence["frames thinned"] = None, None, thinned
    truth = target.rasterise(_CELLS)
    clipped = (frames.reshape(len(times), pixels)[:, inside] >= camera.white).sum()
    found: dict[str, Any] = {"thinned": few, "clipped": int(clipped)}
    for name in names:
        image = estimate_sequence(light, prior, *evidence[name]).image
        found[name] = round(bounds.canvas_decibel(float(np.square(image - truth).mean()), _CELLS), 3)
    steps = np.diff(events.t_us, prepend=0) & 0xFFFF
    place = (2 * (events.y.astype(np.int64) * events.width + events.x) + events.p) & 0xFFFF
    streams = np.stack([steps, place]).astype(np.uint16).tobytes(), frames.tobytes()
    packed = [len(zlib.compress(one)) for one in streams]
    found["bytes"] = (EVENT_BYTES * len(events), packed[0], frames.nbytes, packed[1])
    return found


def conditions_table(findings: Sequence[Finding]) -> str:
    """Return Markdown: a row a condition; of a cell "bound / measured" the whole sequence counts; "-" = none.

    Args:
        findings: What came of each condition.
    """
    head = ["condition", "frames", "exposure, gain", "frame, one: bound", "events, one: bound", "frames, all"]
    head += [
        "events, all",
        "both, all",
        "events - frames, 95 % interval",
        "frames of the events' bytes; events - these",
    ]
    head += ["events per pixel", "events kB", "frames kB"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for one in findings:
        bound, known = one.expected_db, one.measured_db
        tuned = f"{1e3 * one.exposure_s:.3g} ms, {one.gain:g}"
        cells = [one.condition.name, str(one.counts[-1]), tuned + (" *" if one.left_out else "")]
        cells += [_decibel(bound.get(name, ())[:1]) for name in EVIDENCE[:2]]
        for name in EVIDENCE:
            cells.append(f"{_decibel(bound.get(name, ())[-1:])} / {_decibel(known.get(name, ()))}")
        lead = np.subtract(bound["events"][-1:], bound["frames"][-1:]) if "events" in bound else ()
        cells.append(f"{_decibel(lead, '+')} / {_lead(known, 'frames')}")
        thinned = f"{_decibel(known.get('frames thinned', ()))}; {_lead(known, 'frames thinned')}"
        cells.append(f"{one.thinned_frames:.3g}: {thinned}" if known.get("frames") else "-")
        cells.append(f"{one.events_per_pixel:.1f}")
        sizes = one.event_bytes, one.frame_bytes
        cells += [f"{size / 1e3:.0f} ({packed / 1e3:.0f})" for size, packed in sizes]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _decibel(values: ArrayLike, sign: str = "") -> str:
    """Return the mean of some decibels, or "-" of none."""
    known = np.asarray(values, np.float64)
    return f"{known.mean():{sign}.1f}" if known.size else "-"


def _lead(known: dict[str, tuple[float, ...]], frames: str) -> str:
    """Return by how much measured events lead frames, dB, with a 95 % interval, or "-" without events."""
    if not (events := known.get("events")):
        return "-"
    found = paired_difference(events, known[frames], np.arange(len(events)).astype(str))
    return f"{found.mean:+.1f} [{found.low:+.1f}, {found.high:+.1f}]"
