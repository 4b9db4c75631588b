"""Where events win: frames and events of the same moving targets, over light, speed, shade, ripple and more.

The best linear estimate says what each is worth, and simulated sequences what an estimate makes of it. Events
are those of a true logarithm over a dark level; frames collect electrons over the best exposure, with the best
gain.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from evnlos.analysis import bounds
from evnlos.analysis.scores import paired_difference
from evnlos.cameras import EventCamera, EventPixel, FlickeringWall, FrameCamera
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
from evnlos.inverse.prior import TEST_CHARACTERS
from evnlos.machine import Progress, Step, silent
from evnlos.scene import TRAIN_WRITERS, HandwritingGlyphs, Scene, Target
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
_SENSOR = SensorSize(50, 80)
_TRAVEL_M, _FASTEST_HZ, _RIPPLE_HZ = 0.16, 100.0, 100.0
_PLACE_M, _SPEED = 0.01, 0.1  # what an unknown motion may be off by: place, and share of the speed
_CELLS = Plane(32, 32, 0.0025)
_GAINS = tuple(2.0**k for k in range(8))
_UNCLIPPED = 0.85  # of white: pixels that other targets leave below it
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
            frame_camera=replace(_CAMERA, bit_depth=self.bit_depth),
            pixel=_PIXEL,
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
        exposure_s: The best exposure of the frames, at most the time between two.
        gain: Their best gain.
        counts: Numbers of positions.
        prior_db: PSNR of the prior's mean, dB.
        expected_db: "frames", "events", "both" -> expected PSNR for each number of positions, dB.
        measured_db: The same -> PSNR of simulated whole sequences, one a character, dB; empty without motion.
        events_per_pixel: Events per pixel and sequence, noise among them.
        event_bytes: The events as 32-bit words, and packed (zlib), bytes.
        frame_bytes: The frames as they are, and packed, bytes.
    """

    condition: Condition
    exposure_s: float
    gain: float
    counts: tuple[int, ...]
    prior_db: float
    expected_db: dict[str, tuple[float, ...]]
    measured_db: dict[str, tuple[float, ...]]
    events_per_pixel: float
    event_bytes: tuple[int, int]
    frame_bytes: tuple[int, int]


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
        *(Condition(f"ripple {100 * ripple:g} %", ripple=ripple) for ripple in (0.04, 0.08)),
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

    The best linear estimate (`evnlos.analysis.bounds`) sets the exposure and the gain of the frames: those with
    which a few of them tell most. An unknown place (10 mm) and speed (a tenth) are two more unknowns.

    Args:
        condition: The condition.
        characters: As of `sweep_parameters`.
    """
    setup, asked = condition.setup, condition.asked
    prior = handwritten_prior(_CELLS)
    span = (0.0, asked.duration_s)
    light = sequence_light(setup, prior, asked.motion.position_m, span, setup.shape, fineness=2.0)
    shade = condition.shading().ravel()
    light = replace(light, left=light.left * shade[:, None], still=light.still * shade[:, None])
    glyphs = HandwritingGlyphs(characters=TEST_CHARACTERS, writers=1, first_writer=TRAIN_WRITERS)
    targets = {name[-1]: glyphs.target(name) for name in glyphs.objects()}
    references = [prior.coefficients(targets[one].rasterise(_CELLS)) for one in "AS2"]
    few, slowest = min(asked.positions, 5), asked.duration_s / asked.positions
    few = replace(asked, positions=few, counts=(few,))
    tried = list[tuple[float, FrameCamera]]()
    for exposure in np.geomspace(1e-4, slowest, 10).tolist():
        blurred = light.exposed(exposure)
        for gain in _GAINS:
            camera = replace(_CAMERA, bit_depth=condition.bit_depth, exposure_s=exposure, gain=gain)
            told = _of_frames(blurred, references[0], setup, camera, few)
            tried.append((prior.error(told[0]), camera))
    camera = min(tried, key=lambda one: one[0])[1]
    unknown = () if condition.is_motion_known else motion_unknowns(light, references, asked)
    lights = unknown or [light] * len(references)
    law = _PIXEL.crossing_law(light.typical_dn)
    found: dict[str, list[NDArray[np.float64]]] = {name: [] for name in EVIDENCE}
    for seen, z in zip(lights, references, strict=True):
        z = np.concatenate([z, np.zeros(seen.right.shape[2] - 1 - len(z))])
        frames = _of_frames(seen.exposed(camera.exposure_s), z, setup, camera, asked)
        events = bounds.event_information(seen, z, law, asked, (_CROSSING_NOISE,))[0][0]
        for name, information in zip(EVIDENCE, (frames, events, frames + events), strict=True):
            found[name].append(np.stack([marginal_information(one, prior.count) for one in information]))
    expected = {
        name: tuple(
            round(bounds.canvas_decibel(float(np.mean([prior.error(r[n]) for r in each])), _CELLS), 3)
            for n in range(len(asked.counts))
        )
        for name, each in found.items()
    }
    # Chosen by what they would show of other targets: pixels that did not clip are those whose noise was low.
    brightest = np.max([light(z).max(axis=1) for z in references], axis=0)
    inside = brightest * camera.per_light().gain < _UNCLIPPED
    runs = [_sequence(condition, light, camera, inside, prior, targets[one]) for one in characters]
    measured = {name: tuple(run[name] for run in runs) for name in EVIDENCE if condition.is_motion_known}
    sizes = np.mean([run["bytes"] for run in runs], axis=0) if runs else np.zeros(4)
    per_pixel = float(sizes[0]) / EVENT_BYTES / len(light.left)
    sizes = [round(float(one)) for one in sizes]
    return Finding(
        condition,
        round(camera.exposure_s, 6),
        camera.gain,
        asked.counts,
        round(bounds.canvas_decibel(prior.error(np.zeros((prior.count, prior.count))), _CELLS), 3),
        expected,
        measured,
        round(per_pixel, 3),
        (sizes[0], sizes[1]),
        (sizes[2], sizes[3]),
    )


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
) -> dict[str, Any]:
    """Return the PSNR of a simulated sequence for each kind of evidence, dB, and the bytes of recordings."""
    setup, asked = condition.setup, condition.asked
    span, pixels = (0.0, asked.duration_s), len(light.left)
    wall = _ShadedWall(setup.observe(Scene(target, asked.motion, asked.duration_s)), condition)
    lit = FlickeringWall(wall, condition.ripple, _RIPPLE_HZ) if condition.ripple else wall
    seed = derive_seed(0, "conditions", target.name)
    events = EventCamera(setup.pixel).record(lit, *span, seed=seed)
    times = np.arange(1, asked.positions + 1) * asked.duration_s / asked.positions
    frames = camera.capture(lit, times, seed)
    sensitivity, offset_e = camera.fixed_pattern(setup.shape, seed)  # known, as by calibration
    seen = (frames / camera.dn_per_electron - offset_e) / (camera.white_e * sensitivity)
    part = replace(light, left=light.left[inside], still=light.still[inside], shape=(1, int(inside.sum())))
    term = FrameTerm(
        part.exposed(camera.exposure_s),
        seen.reshape(len(times), pixels)[:, inside],
        times,
        camera.per_light(),
        known_pattern=True,
    )
    law = _PIXEL.crossing_law(light.typical_dn)
    record = record_of(events, law, span, _GAP * asked.duration_s)
    evidence = {"frames": (None, None, term), "events": (law, record, None), "both": (law, record, term)}
    truth = target.rasterise(_CELLS)
    found: dict[str, Any] = {}
    for name, known in evidence.items():
        image = estimate_sequence(light, prior, *known).image
        found[name] = round(bounds.canvas_decibel(float(np.square(image - truth).mean()), _CELLS), 3)
    steps = np.diff(events.t_us, prepend=0) & 0xFFFF
    place = (2 * (events.y.astype(np.int64) * events.width + events.x) + events.p) & 0xFFFF
    streams = np.stack([steps, place]).astype(np.uint16).tobytes(), frames.tobytes()
    packed = [len(zlib.compress(one)) for one in streams]
    found["bytes"] = (EVENT_BYTES * len(events), packed[0], frames.nbytes, packed[1])
    return found


def conditions_table(findings: Sequence[Finding]) -> str:
    """Return Markdown: a row a condition; of a cell "bound / measured" the whole sequence counts.

    Args:
        findings: What came of each condition.
    """
    head = ["condition", "frames", "exposure, gain", "frame, one", "events, one", "frames, all", "events, all"]
    head += ["both, all", "events - frames, 95 % interval", "events per pixel", "events kB", "frames kB"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for one in findings:
        cells = [one.condition.name, str(one.counts[-1]), f"{1e3 * one.exposure_s:.3g} ms, {one.gain:g}"]
        cells += [f"{one.expected_db[name][0]:.1f}" for name in EVIDENCE[:2]]
        for name in EVIDENCE:
            known = one.measured_db.get(name)
            cells.append(f"{one.expected_db[name][-1]:.1f}" + (f" / {np.mean(known):.1f}" if known else ""))
        gap = one.expected_db["events"][-1] - one.expected_db["frames"][-1]
        if known := one.measured_db.get("events"):
            names = np.arange(len(known)).astype(str)
            gain = paired_difference(np.array(known), np.array(one.measured_db["frames"]), names)
            cells.append(f"{gap:+.1f} / {gain.mean:+.1f} [{gain.low:+.1f}, {gain.high:+.1f}]")
        else:
            cells.append(f"{gap:+.1f}")
        cells.append(f"{one.events_per_pixel:.1f}")
        sizes = one.event_bytes, one.frame_bytes
        cells += [f"{size / 1e3:.0f} ({packed / 1e3:.0f})" for size, packed in sizes]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
